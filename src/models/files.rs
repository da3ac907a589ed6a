//! Files that a result has as they are.

use std::fs::File;
use std::io;
use std::path::Path;

use crate::error::{Error, Result};
use crate::files::open::open_file;

/// Copies the bytes, not the permissions: a result of a read-only model can be replaced.
pub(super) fn copy(from: &Path, to: &Path) -> Result<()> {
    let mut source = open_file(from)?;
    let mut target = File::create(to).map_err(Error::io("create", to))?;
    io::copy(&mut source, &mut target).map_err(Error::io("copy", from))?;
    Ok(())
}
