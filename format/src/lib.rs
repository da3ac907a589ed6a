//! `gseq`: a chunked, memory-mapped container for sequences of Gaussians.
//!
//! A container holds N Gaussians × T frames in *columns* of f32 (each has a name and a number of components per
//! Gaussian), a time stamp per frame, and text attributes. It is divided into *tiles*, one per (column, block of
//! Gaussians, block of frames). Within a tile, values are laid out as `[frame][component][gaussian]`, so that every
//! (frame, component) plane is one contiguous slice. Values are read back with exactly the bits that were written, NaN
//! payloads and −0 included. In columns with an error bound ([`ColumnSpec::max_error`]) a value may differ by at most
//! this bound.
//!
//! ```
//! # fn main() -> Result<(), gseq::Error> {
//! # let folder = tempfile::tempdir().unwrap();
//! # let path = folder.path().join("walk.gseq");
//! use gseq::{ColumnSpec, Compression, Layout, Reader, TileBuffer, TileId, Writer, encode_tile};
//!
//! let layout = Layout {
//!     gaussians: 2,
//!     gaussian_block: 4096,
//!     frame_block: 16,
//!     columns: vec![ColumnSpec { name: "position".into(), width: 3, max_error: 0.0 }],
//!     attributes: Default::default(),
//! };
//! let mut writer = Writer::create(&path, layout)?;
//! let frame_block = writer.append_times(&[0.0, 0.5])?;
//! let at = TileId { column: 0, gaussian_block: 0, frame_block };
//! let values = [0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.5, 1.5, 0.5, 1.5, 0.5, 1.5];
//! writer.write_tile(at, &encode_tile(&values, 2, 3, 2, Compression::Zstd(1))?)?;
//! writer.finish()?;
//!
//! let reader = Reader::open(&path)?;
//! let mut buffer = TileBuffer::default();
//! assert_eq!(reader.tile(at, &mut buffer)?.plane(1, 0), [0.5, 1.5]);
//! # Ok(())
//! # }
//! ```
//!
//! The bytes of a container are specified in `SPEC.md`. [`recover`] saves the complete frame blocks of a file whose
//! writer was killed.

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout, clippy::disallowed_methods))]

mod bounded;
mod codec;
mod error;
mod file;
mod index;
mod layout;
mod reader;
mod record;
mod recover;
mod text;
mod tile_bytes;
mod verify;
mod writer;

pub use codec::{Compression, EncodedTile, Encoding, TileStats, encode_tile};
pub use error::{Error, Result};
pub use layout::{ColumnSpec, Layout, MAGIC, MAX_TILE_BYTES, TileId};
pub use reader::{Reader, Tile, TileBuffer, TileFrames, TileInfo, TileReadCounts, TouchedPages};
pub use recover::{RecoverReport, recover, recover_within};
pub use text::{ShowPath, ShownPath, printable, quoted};
pub use verify::VerifyReport;
pub use writer::Writer;

/// Compiles the example in the README of this crate as a documentation test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
mod readme {}
