//! Checkpoints of gsplat as a model format: static models, or FreeTimeGS.
//!
//! Input: `ckpts/ckpt_K.pt` in a result folder, or the checkpoint itself: `{"step", "splats": state dict, "optimizers":
//! {name: Adam state}}`. `splats` holds `means` `[N, 3]`, `scales` `[N, 3]` log, `quats` `[N, 4]` wxyz of any length,
//! `opacities` `[N]` logit, `sh0` `[N, 1, 3]`, `shN` `[N, K, 3]`; for FreeTimeGS also `times` `[N, 1]`, `durations`
//! `[N, 1]` log, `velocities` `[N, 3]`. Output: the same checkpoint with fewer Gaussians. Cameras must be those of the
//! trainer's parser: it normalizes the coordinates of the scene and does not store how.

pub(super) mod frame_state;

use std::path::Path;

use super::in_checkpoint::still::Still;
use super::in_checkpoint::{
    CheckpointFile, CheckpointModel, CheckpointReader, NumberedFiles, RowElement, numbered_files, row_count,
};
use crate::error::{Error, Result, quoted};
use crate::files::checkpoint::{Checkpoint, NodeId, Pickle};
use crate::files::ftgs::{LOG_TIME_DEVIATION, PARAMS_PER_GAUSSIAN, TIME_CENTER, VELOCITY};
use crate::files::state_dict::wrapper_note;
use crate::limits::ReadLimit;
use crate::model::{Attributes, MAX_SH_DEGREE, sh_coefficient_count};
use crate::models::input_model::{ModelDescription, OpenOptions};
use crate::models::opened::{InputFormat, Opened};
use frame_state::FreeTime;

/// Name of the subfolder of a result folder that holds the checkpoints.
const CHECKPOINT_FOLDER: &str = "ckpts";

/// Model format of gsplat checkpoints: recognizes and opens a checkpoint, or the result folder of a training.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| match found.is_folder {
        true => !checkpoints(found.path).is_empty(),
        false => found.is_checkpoint() && splats_in(found.path, found.memory),
    },
    open,
};

/// Returns the checkpoints, each with its training iteration, of a result folder or of a folder of checkpoints, in
/// decreasing order of iteration.
fn checkpoints(path: &Path) -> NumberedFiles {
    let in_folder = |folder: &Path| {
        let (mut one, first) = (numbered_files(folder, "ckpt_", ".pt"), numbered_files(folder, "ckpt_", "_rank0.pt"));
        one.extend(first);
        // A whole model comes before the part of one process, `ckpt_K_rank0.pt`.
        one.sort_unstable_by(|a, b| b.0.cmp(&a.0).then_with(|| a.1.cmp(&b.1)));
        one
    };
    let inner = in_folder(&path.join(CHECKPOINT_FOLDER));
    if inner.is_empty() { in_folder(path) } else { inner }
}

/// Fails if the checkpoint `file` holds only the part of the model of one process (rank) of the training.
fn refuse_part_of_model(file: &Path) -> Result<()> {
    let second_rank = file.to_string_lossy().replace("_rank0.pt", "_rank1.pt");
    if second_rank != file.to_string_lossy() && Path::new(&second_rank).exists() {
        return Err(Error::input(file, "", "a model in one file", "one of several ranks")
            .hint("join their tensors along the first axis with torch.cat, and save the checkpoint again"));
    }
    Ok(())
}

/// Returns whether the checkpoint at `path` holds Gaussians in tensors with the names that gsplat uses.
fn splats_in(path: &Path, memory: ReadLimit) -> bool {
    let Ok(checkpoint) = Checkpoint::open(path, memory) else { return false };
    let pickle = checkpoint.pickle();
    pickle.item(pickle.root(), "splats").is_some_and(|splats| splat_tensor(pickle, splats, "means").is_some())
}

/// Returns the tensor `name` of the state dict `splats`. The tensor is also found under the prefix `module.`, which a
/// wrapper of the parameters adds to names.
fn splat_tensor(pickle: &Pickle, splats: NodeId, name: &str) -> Option<NodeId> {
    pickle.item(splats, name).or_else(|| pickle.item(splats, &format!("module.{name}")))
}

/// Opens a checkpoint as FreeTimeGS if it has velocities, else as a static model.
fn open(path: &Path, options: &OpenOptions) -> Result<Opened> {
    let file = CheckpointFile::find(path, options, checkpoints, "ckpt_<K>.pt", open)?;
    if file.root.is_some() {
        refuse_part_of_model(&file.file)?;
    }
    let checkpoint = Checkpoint::open(&file.file, options.memory)?;
    let pickle = checkpoint.pickle();
    let Some(splats) = pickle.item(pickle.root(), "splats") else {
        let found = checkpoint.describe(pickle.root());
        return Err(checkpoint.wrong("data.pkl", "a dict with \"splats\"", found));
    };
    let missing = |name: &str| checkpoint.wrong(&place(name), "a tensor of this name", checkpoint.describe(splats));
    let find = |name: &'static str| splat_tensor(pickle, splats, name).ok_or_else(|| missing(name));
    if let Some(name) = ["accels", "jerks"].into_iter().find(|name| splat_tensor(pickle, splats, name).is_some()) {
        return Err(checkpoint
            .wrong(&place(name), "motion along straight lines", "a motion term of higher order, written by a fork")
            .hint("export its frames with its own renderer, as PLY files or as a frame stream, and give those"));
    }
    if let Some(name) = ["features", "colors"].into_iter().find(|name| splat_tensor(pickle, splats, name).is_some()) {
        return Err(checkpoint
            .wrong(&place(name), "sh0 and shN", "colors of an appearance network")
            .hint("train without --app_opt, or export its frames as PLY files with its own renderer"));
    }
    let names = ["means", "scales", "quats", "opacities", "sh0", "shN"];
    let nodes = names.iter().map(|name| find(name)).collect::<Result<Vec<NodeId>>>()?;
    let has_motion = splat_tensor(pickle, splats, "velocities").is_some();
    let mut notes = Vec::from_iter(file.note.clone());
    if pickle.item(splats, "means").is_none() {
        notes.push(wrapper_note("module."));
    }
    let motion_nodes = if has_motion {
        ["times", "durations", "velocities"].iter().map(|name| find(name)).collect::<Result<_>>()?
    } else {
        Vec::new()
    };
    let optimizers = pickle.item(pickle.root(), "optimizers");
    let mut training_nodes = Vec::new();
    for (_, state) in optimizers.and_then(|id| pickle.items(id)).into_iter().flatten() {
        let state = pickle.item(state, "state").and_then(|id| pickle.pairs(id));
        for (_, of_parameter) in state.into_iter().flatten() {
            training_nodes.extend(pickle.items(*of_parameter).into_iter().flatten().map(|(_, id)| id));
        }
    }
    let count = row_count(&checkpoint, nodes[0], &place("means"))?;
    let rest = checkpoint.float_tensor(nodes[5], &place("shN"))?;
    let bands = rest.shape.get(1).map(|bands| bands + 1);
    let Some(degree) = (0..=MAX_SH_DEGREE).find(|&degree| bands == Some(sh_coefficient_count(degree))) else {
        return Err(checkpoint.wrong(
            &place("shN"),
            "shape [N, 0, 3], [N, 3, 3], [N, 8, 3] or [N, 15, 3]",
            rest.describe(),
        ));
    };
    let bands = sh_coefficient_count(degree);
    let mut reader =
        CheckpointReader::new(checkpoint, count, degree, if has_motion { PARAMS_PER_GAUSSIAN } else { 0 })?;
    let planes = [
        (Attributes::POSITION, &[3][..], 0, 3),
        (Attributes::LOG_SCALE, &[3], 0, 3),
        (Attributes::ROTATION, &[4], 0, 4),
        (Attributes::OPACITY, &[], 0, 1),
        (Attributes::SH, &[1, 3], 0, 3),
        (Attributes::SH, &[bands - 1, 3], 3, 3 * (bands - 1)),
    ];
    for ((name, id), (column, row, skipped, width)) in names.iter().zip(nodes).zip(planes) {
        reader.read(id, &place(name), row, RowElement::all_of(column, skipped, width))?;
    }
    let motion_tensors = [
        ("times", &[1][..], TIME_CENTER, 1),
        ("durations", &[1], LOG_TIME_DEVIATION, 1),
        ("velocities", &[3], VELOCITY, 3),
    ];
    for (id, (name, row, first, width)) in motion_nodes.into_iter().zip(motion_tensors) {
        reader.read(id, &place(name), row, RowElement::format_specific(first, width))?;
    }
    training_nodes.into_iter().for_each(|id| reader.add_training_tensor(id));
    let kind = if has_motion { "FreeTimeGS checkpoint" } else { "gsplat checkpoint" };
    let description = ModelDescription { kind, notes, ..ModelDescription::default() };
    Ok(match has_motion {
        true => Opened::from_model(CheckpointModel::new(reader, FreeTime::TRAINED, file, 3e-8, description)?),
        false => Opened::from_model(CheckpointModel::new(reader, Still, file, 1e-8, description)?),
    })
}

/// Returns a text for error messages that states where the checkpoint holds the tensor `name`.
fn place(name: &str) -> String {
    format!("splats[{}]", quoted(name))
}

#[cfg(test)]
mod tests;
