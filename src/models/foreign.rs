//! Models that are recognized but cannot be read. Their error names the model and says how to convert it.
//!
//! Any renderer can export frames as PLY files or as a frame stream, so every message suggests that.

use std::path::Path;

use crate::error::Error;
use crate::files::checkpoint::{Checkpoint, Pickle};
use crate::limits::ReadLimit;
use crate::models::opened::InputFormat;

/// Advice at the end of every error message of this module. It works for models of any renderer.
const ADVICE: &str = "export its frames with its own renderer, either as PLY files (one per frame, with the same \
                      Gaussians in the same order) or as a frame stream, and give those";

/// Entry for checkpoints of unsupported trainers and for folders that contain one: recognizes them, and refuses to open
/// them with an error that says how to convert the model.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| match found.is_folder {
        true => describe_folder(found.path).is_some(),
        false => found.is_checkpoint(),
    },
    open: |path, options| {
        let description = if path.is_dir() {
            describe_folder(path).unwrap_or(UNKNOWN)
        } else {
            describe_checkpoint(path, options.memory)?
        };
        Err(Error::input(path, "", "a supported model format", description).hint(ADVICE))
    },
};

const UNKNOWN: &str = "an unsupported checkpoint, such as those of Ex4DGS, Gaussian-Flow, MEGA or OMG4";
const ROTOR: &str = "a 4D-Rotor model of nerfstudio";

/// Returns the description of an unsupported model folder, which is recognized by file names that no other format uses;
/// `None` for other folders.
fn describe_folder(folder: &Path) -> Option<&'static str> {
    let has = |name: &str| folder.join(name).exists();
    if has("nerfstudio_models") {
        return Some(ROTOR);
    }
    if has("NTC.pth") || has("frame000001/NTC.pth") {
        return Some("a 3DGStream model (one network per frame)");
    }
    None
}

/// Returns the description of the model in an unsupported checkpoint, which is recognized by the names of its tensors.
///
/// # Errors
/// Fails if the file is not a checkpoint.
fn describe_checkpoint(path: &Path, memory: ReadLimit) -> crate::error::Result<&'static str> {
    let checkpoint = Checkpoint::open(path, memory)?;
    let pickle = checkpoint.pickle();
    let has = |name: &str| pickle.item(pickle.root(), name).is_some();
    let named = |part: &str| tensor_names(pickle).any(|name| name.contains(part));
    Ok(match () {
        () if has("pipeline") && named("gauss_params.scales_t") => ROTOR,
        () if has("pipeline") => "a nerfstudio model",
        () if named("hash_encoder") || named("encoding.embeddings") => "a network with hash grids, such as Grid4D",
        () => UNKNOWN,
    })
}

/// Returns an iterator over the names of tensors in the root of the checkpoint, if the root is a dictionary, and in
/// dictionaries directly below it.
fn tensor_names(pickle: &Pickle) -> impl Iterator<Item = &str> {
    let root = pickle.root();
    let inner = pickle.items(root).into_iter().flatten().map(|(_, id)| id);
    let parts = pickle.elements(root).unwrap_or_default().iter().copied();
    [root].into_iter().chain(inner).chain(parts).filter_map(|id| pickle.items(id)).flatten().map(|(name, _)| name)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::files::checkpoint::made::{PythonValue, named, tensor};
    use crate::models;
    use crate::models::OpenOptions;

    #[test]
    fn unsupported_models_are_named_with_advice() {
        let folder = tempfile::tempdir().unwrap();
        let error_message = |path: &Path| {
            models::open(path, &OpenOptions::default()).and_then(models::Opened::into_linked).err().unwrap().to_string()
        };
        let file = folder.path().join("step-000029999.ckpt");
        let one = || PythonValue::Tensor(tensor(0, &[1], &[0.0]));
        let pipeline =
            |name| PythonValue::Dict(named(vec![("pipeline", PythonValue::Dict(named(vec![(name, one())])))]));
        for (made, expected) in [
            (pipeline("_model.gauss_params.scales_t"), "4D-Rotor"),
            (pipeline("_model.gauss_params.means"), "nerfstudio"),
            (PythonValue::Tuple(vec![PythonValue::Ordered(named(vec![("hash_encoder.params", one())]))]), "Grid4D"),
            (PythonValue::Int(7), "unsupported checkpoint"),
        ] {
            fs::write(&file, made.file()).unwrap();
            let message = error_message(&file);
            let parts = ["step-000029999.ckpt", expected, "PLY", "frame stream"];
            assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        }
        for (name, expected) in [("a/nerfstudio_models", "4D-Rotor"), ("b/frame000001/NTC.pth", "3DGStream")] {
            fs::create_dir_all(folder.path().join(name)).unwrap();
            let message = error_message(&folder.path().join(&name[..1]));
            assert!(message.contains(expected) && message.contains("PLY"), "{message}");
        }
    }
}
