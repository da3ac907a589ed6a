//! Sources: model folders, PLY files and sequences, containers, streams, cameras, pictures.

pub mod cameras;
mod cfg_args;
pub mod container;
mod digest;
pub mod frame_stream;
pub mod image;
mod map;
mod model_folder;
pub mod ply;
pub mod ply_sequence;
mod pth;
mod python_literal;

pub use cfg_args::ModelConfig;
pub use model_folder::{ModelFolder, ModelPaths};
pub use pth::read_state_dict;
