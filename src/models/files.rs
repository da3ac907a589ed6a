//! Copies input files that are part of the output unchanged.

use std::fs::File;
use std::io;
use std::path::Path;

use crate::error::{Error, Result};
use crate::files::open::open_file;

/// Copies the content of the file `from` to `to`, but not its permissions, so that the output of a read-only model can
/// be replaced.
pub(super) fn copy(from: &Path, to: &Path) -> Result<()> {
    let mut source = open_file(from)?;
    let mut target = File::create(to).map_err(Error::io("create", to))?;
    io::copy(&mut source, &mut target).map_err(Error::io("copy", from))?;
    Ok(())
}
