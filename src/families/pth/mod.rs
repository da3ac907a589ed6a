//! PyTorch state dicts (`.pth`): the file's tensors as f32, and files of such tensors. The pickle inside is read as data
//! by `pytorch-reader`; nothing in it is executed.

mod write;

use std::fs;
use std::io;
use std::path::Path;

use half::f16;
use pytorch_reader::{DType, PytorchError, PytorchReader};

use crate::deform::{Tensor, Tensors};
use crate::error::{Error, Result};
pub(crate) use write::{Stored, Values, write_state_dict};

/// A view may repeat its storage (stride 0), so a small file can declare any number of values. No
/// trained state dict stores less than a quarter of what it means.
pub(super) const MAX_EXPANSION: u64 = 4;

/// Reads every floating-point tensor of the state dict at `path`, widened or rounded to f32. Integer and
/// boolean tensors are left out.
///
/// Memory: the tensors, at most four times the file, and one tensor's bytes.
///
/// # Errors
/// A file that is no state dict, is cut short or damaged, or declares more values than it can hold.
pub(super) fn read_state_dict(path: &Path) -> Result<Tensors> {
    let file_bytes = fs::metadata(path).map_err(Error::io("open", path))?.len();
    let reader = open(path)?;
    let declared = reader.tensors().values().fold(0u64, |sum, tensor| sum.saturating_add(tensor.byte_len() as u64));
    if declared > file_bytes.saturating_mul(MAX_EXPANSION) {
        return Err(Error::input(
            path,
            "",
            format!("at most {MAX_EXPANSION} times its {file_bytes} bytes of tensors"),
            format!("tensors of {declared} bytes"),
        ));
    }
    let mut tensors = Tensors::new();
    for (name, tensor) in reader.into_tensors() {
        let Some(decode) = decoder(tensor.dtype()) else { continue };
        let bytes = tensor.read().map_err(|error| {
            if is_system(&error) {
                Error::io("read", path)(error)
            } else {
                Error::input(path, format!("tensor {name}"), "its values, undamaged", error.to_string())
                    .hint("the file is damaged or cut short; copy it again")
            }
        })?;
        tensors.insert(name, Tensor { shape: tensor.shape().to_vec(), data: decode(&bytes) });
    }
    Ok(tensors)
}

/// Names of the tensors of the state dict at `path`, in order; no value is read.
///
/// # Errors
/// A file that is no state dict.
pub(super) fn names(path: &Path) -> Result<Vec<String>> {
    Ok(open(path)?.tensors().keys().cloned().collect())
}

/// Whether every tensor of the state dict at `path` is one that [`read_state_dict`] reads.
///
/// # Errors
/// A file that is no state dict.
pub(super) fn is_floating(path: &Path) -> Result<bool> {
    Ok(open(path)?.tensors().values().all(|tensor| decoder(tensor.dtype()).is_some()))
}

fn open(path: &Path) -> Result<PytorchReader> {
    PytorchReader::new(path).map_err(|error| match error {
        PytorchError::Io(source) if is_system(&source) => Error::io("read", path)(source),
        error => Error::input(path, "", "a state dict written by torch.save", error.to_string())
            .hint("is the file complete? save the model again with torch.save(model.state_dict(), path)"),
    })
}

/// Whether the failure is the system's rather than the file's contents'.
fn is_system(error: &io::Error) -> bool {
    !matches!(error.kind(), io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof | io::ErrorKind::InvalidInput)
}

/// Turns the native-endian bytes of a tensor into f32.
type Decode = fn(&[u8]) -> Vec<f32>;

/// How to turn native-endian bytes of a floating-point type into f32; none for other types.
fn decoder(dtype: DType) -> Option<Decode> {
    fn each<const N: usize>(bytes: &[u8], value: fn([u8; N]) -> f32) -> Vec<f32> {
        bytes.as_chunks().0.iter().map(|&chunk| value(chunk)).collect()
    }
    match dtype {
        DType::F64 => Some(|bytes| each(bytes, |b| f64::from_ne_bytes(b) as f32)),
        DType::F32 => Some(|bytes| each(bytes, f32::from_ne_bytes)),
        DType::F16 => Some(|bytes| each(bytes, |b| f16::from_ne_bytes(b).to_f32())),
        DType::BF16 => Some(|bytes| each(bytes, |b| f32::from_bits(u32::from(u16::from_ne_bytes(b)) << 16))),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
