//! Index map: a file with the index in the output of each Gaussian of the input.
//!
//! Input: for every Gaussian of the input its index in the output, or `None` if it was pruned. Output: a `.npy` file of
//! int64 `[N]`, −1 for pruned Gaussians. Users can reorder other tensors that have one entry per Gaussian with this
//! file. Memory: none besides a write buffer.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use npyz::{WriteOptions, WriterBuilder};

use crate::error::{Error, Result};

/// Writes the index map `new_index` (`[N]`) to `path`. Gaussians that were merged have the index of the proxy that
/// replaces them.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn write_index_map(new_index: &[Option<u32>], path: &Path) -> Result<()> {
    let mut out = BufWriter::new(File::create(path).map_err(Error::io("create", path))?);
    write_npy(&mut out, new_index).and_then(|()| out.flush()).map_err(Error::io("write", path))
}

fn write_npy(out: &mut impl Write, new_index: &[Option<u32>]) -> io::Result<()> {
    let mut array =
        WriteOptions::<i64>::new().default_dtype().shape(&[new_index.len() as u64]).writer(out).begin_nd()?;
    array.extend(new_index.iter().map(|index| index.map_or(-1, i64::from)))?;
    array.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kept_and_pruned_read_back_as_int64() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index_map.npy");
        write_index_map(&[Some(0), None, Some(u32::MAX), Some(0)], &path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let array = npyz::NpyFile::new(&bytes[..]).unwrap();
        assert_eq!(array.shape(), [4]);
        assert_eq!(array.into_vec::<i64>().unwrap(), [0, -1, 4_294_967_295, 0]);
    }

    #[test]
    fn no_gaussians_give_an_empty_array() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index_map.npy");
        write_index_map(&[], &path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        assert!(npyz::NpyFile::new(&bytes[..]).unwrap().into_vec::<i64>().unwrap().is_empty());
    }
}
