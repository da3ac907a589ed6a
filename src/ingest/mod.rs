//! Sources: model folders, PLY files and sequences, containers, cameras.

mod cfg_args;
mod model_folder;
mod pth;
mod python_literal;

pub use cfg_args::ModelConfig;
pub use model_folder::{ModelFolder, ModelPaths};
pub use pth::read_state_dict;
