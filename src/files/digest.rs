//! Hashes files. A file is read in chunks, so that the memory does not depend on its length.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use xxhash_rust::xxh3::Xxh3;

use super::open::open_file;
use crate::error::{Error, Result};

/// Number of bytes that are read and hashed at a time.
const CHUNK_BYTES: usize = 1 << 18;

/// Returns a digest of the bytes of the files `paths`, one after the other, as 32 hexadecimal digits.
///
/// # Errors
/// Fails if a file cannot be read.
pub(crate) fn digest_of_files<'a>(paths: impl IntoIterator<Item = &'a Path>) -> Result<String> {
    let mut hash = Xxh3::new();
    paths.into_iter().try_for_each(|path| hash_file(path, &mut hash))?;
    Ok(format!("{:032x}", hash.digest128()))
}

/// Adds the bytes of the file at `path` to `hash`. Fails if the file cannot be read.
pub(crate) fn hash_file(path: &Path, hash: &mut Xxh3) -> Result<()> {
    hash_rest(&mut open_file(path)?, path, hash)
}

/// Adds the bytes of `file`, from its current position to its end, to `hash`. `path` is the path of the file, for
/// messages.
pub(crate) fn hash_rest(file: &mut File, path: &Path, hash: &mut Xxh3) -> Result<()> {
    let mut chunk = vec![0; CHUNK_BYTES];
    loop {
        match file.read(&mut chunk).map_err(Error::io("read", path))? {
            0 => return Ok(()),
            read => hash.update(&chunk[..read]),
        }
    }
}
