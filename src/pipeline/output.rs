//! What a run writes: the smaller model and, beside it, the recipe, the index map and the summary.

use std::path::{Path, PathBuf};

use super::input::Input;
use crate::error::{Error, Result};
use crate::recipe::Recipe;

/// Kinds of result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputKind {
    /// A 4DGaussians model folder.
    Model,
    /// A container.
    Gseq,
    /// A folder with one PLY per frame.
    PlySequence,
    /// One PLY: the canonical cloud of a model, or a sequence of one frame.
    Ply,
}

impl OutputKind {
    /// The kind a path asks for by its name, or the one asked for outright, checked against what the
    /// input can give. A folder is of the input's own kind.
    pub fn of(path: &Path, asked: Option<OutputKind>, input: &Input) -> Result<OutputKind> {
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
        let is_model = matches!(input, Input::Model(_));
        let by_name = match extension.as_str() {
            "gseq" => OutputKind::Gseq,
            "ply" => OutputKind::Ply,
            _ if is_model => OutputKind::Model,
            _ => OutputKind::PlySequence,
        };
        let kind = asked.unwrap_or(by_name);
        if kind == OutputKind::Model && !is_model {
            return Err(Error::usage("only a 4DGaussians model can be written as a model folder\n  write a .gseq or --as ply-sequence"));
        }
        let frames = input.source().info().times.len();
        if kind == OutputKind::Ply && !is_model && frames != 1 {
            return Err(Error::usage(format!(
                "{}: {frames} frames do not fit one .ply\n  write a .gseq or --as ply-sequence",
                path.display()
            )));
        }
        Ok(kind)
    }

    /// Whether the result is a folder.
    pub fn is_folder(self) -> bool {
        matches!(self, OutputKind::Model | OutputKind::PlySequence)
    }
}

/// Path of a file beside the result: inside a folder, next to a file and named after it.
pub fn beside(result: &Path, is_folder: bool, name: &str) -> PathBuf {
    if is_folder {
        return result.join(name);
    }
    let mut file = result.file_name().unwrap_or_default().to_owned();
    file.push(".");
    file.push(name);
    result.with_file_name(file)
}

/// Text of `recipe.toml`: where it comes from, then every parameter.
pub fn recipe_text(recipe: &Recipe, input_digest: &str) -> String {
    format!(
        "# What this result was made with; give it to --recipe to repeat the run.\n\
         [provenance]\ntool = \"splatsieve {}\"\ninput_digest = \"{input_digest}\"\n\n{}",
        env!("CARGO_PKG_VERSION"),
        recipe.to_toml()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recipe_beside_a_result_repeats_the_run() {
        let recipe = Recipe::preset("paper").unwrap();
        assert_eq!(Recipe::from_toml(&recipe_text(&recipe, "00ff"), "default").unwrap(), recipe);
    }

    #[test]
    fn files_beside_results_of_other_kinds_do_not_collide() {
        assert_eq!(beside(Path::new("a/small"), true, "summary.json"), Path::new("a/small/summary.json"));
        assert_eq!(beside(Path::new("a/small.ply"), false, "summary.json"), Path::new("a/small.ply.summary.json"));
        assert_eq!(beside(Path::new("small.gseq"), false, "summary.json"), Path::new("small.gseq.summary.json"));
    }
}
