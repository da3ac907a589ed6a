//! Writes state dicts in the format of `torch.save`: a zip archive of uncompressed files, of which one is a pickle that
//! names every tensor, and the others hold the values of one tensor each.
//!
//! Input: tensors in the layout to be stored. Output: a file of version 3 of PyTorch's zip format, which `torch.load`
//! opens, with or without `weights_only`. Memory: the pickle. Source: the files that PyTorch 1.6 and later writes.

use std::io::Write;
use std::path::Path;

use half::f16;
use half::slice::HalfFloatSliceExt;

use crate::error::{Error, Result};
use crate::files::pickle::int;
use crate::files::zip_output::{create_zip, finish_zip, stored_file_options};

/// Alignment in bytes of the values of each tensor in the file, as in files that PyTorch writes.
const ALIGNMENT: u16 = 64;

/// Tensor in the layout in which it is stored: the element with indices `i` is value number `offset + Σ i·stride` of
/// `values`. Strides may be 0, and several elements may be the same stored value.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct StoredTensor {
    /// Name of the tensor; the keys of nested dicts are joined by dots.
    pub(crate) name: String,
    /// Stored values, of which the tensor is a view: `offset` and `stride` give the index in `values` of each element.
    pub(crate) values: TensorValues,
    /// Index in `values` of the first element.
    pub(crate) offset: usize,
    /// Length of each axis, the slowest axis first; empty for a scalar.
    pub(crate) shape: Vec<usize>,
    /// For each axis, the distance in `values` from an element to the next one along this axis.
    pub(crate) stride: Vec<usize>,
}

/// Stored values of a tensor.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum TensorValues {
    /// 32-bit floating-point values (IEEE 754 binary32).
    F32(Vec<f32>),
    /// 16-bit floating-point values (IEEE 754 binary16).
    F16(Vec<f16>),
}

impl TensorValues {
    /// Returns the number of stored values.
    pub(crate) fn len(&self) -> usize {
        match self {
            TensorValues::F32(values) => values.len(),
            TensorValues::F16(values) => values.len(),
        }
    }

    /// Returns the number of bytes of one value.
    pub(crate) fn width(&self) -> usize {
        match self {
            TensorValues::F32(_) => size_of::<f32>(),
            TensorValues::F16(_) => size_of::<f16>(),
        }
    }

    /// Returns the name of PyTorch's storage class for this type of values, as written in the pickle.
    fn class(&self) -> &'static str {
        match self {
            TensorValues::F32(_) => "FloatStorage",
            TensorValues::F16(_) => "HalfStorage",
        }
    }

    /// Returns the bytes of the values, in the byte order of this machine.
    fn bytes(&self) -> &[u8] {
        match self {
            TensorValues::F32(values) => bytemuck::cast_slice(values),
            TensorValues::F16(values) => bytemuck::cast_slice(values.reinterpret_cast()),
        }
    }
}

impl StoredTensor {
    /// Returns the tensor `name` of the shape `shape`, whose `values` are contiguous, with the last axis fastest.
    pub(crate) fn dense(name: String, shape: Vec<usize>, values: TensorValues) -> StoredTensor {
        let mut stride = vec![1; shape.len()];
        for axis in (1..shape.len()).rev() {
            stride[axis - 1] = stride[axis] * shape[axis].max(1);
        }
        StoredTensor { name, values, offset: 0, shape, stride }
    }
}

/// Writes a state dict of `tensors`, in the given order, to the file `path`.
///
/// # Errors
/// Fails if the file cannot be written.
pub(crate) fn write_state_dict(path: &Path, tensors: &[StoredTensor]) -> Result<()> {
    let failed = |error| Error::io("write", path)(error);
    let mut archive = create_zip(path)?;
    let mut add = |name: &str, bytes: &[u8]| -> Result<()> {
        let options = stored_file_options(bytes.len() as u64);
        let begun = archive.start_file_aligned(format!("archive/{name}"), options, ALIGNMENT);
        begun.map_err(|error| failed(error.into()))?;
        archive.write_all(bytes).map_err(failed)
    };
    // Write the pickle first, and all files into one folder: readers find the other files by the folder of the pickle.
    add("data.pkl", &pickle(tensors))?;
    add("byteorder", if cfg!(target_endian = "big") { b"big" } else { b"little" })?;
    for (key, tensor) in tensors.iter().enumerate() {
        add(&format!("data/{key}"), tensor.values.bytes())?;
    }
    add("version", b"3\n")?;
    finish_zip(archive, path)
}

/// Returns the pickle (protocol 2) of an ordered dictionary that maps names to tensors. The pickle refers to the values
/// of a tensor by a number: the index of the tensor, which is also the name of the file with its values.
fn pickle(tensors: &[StoredTensor]) -> Vec<u8> {
    const DICTIONARY: &[u8] = b"ccollections\nOrderedDict\n)R";
    let mut out = [b"\x80\x02", DICTIONARY, b"("].concat();
    for (key, tensor) in tensors.iter().enumerate() {
        text(&mut out, &tensor.name);
        out.extend(b"ctorch._utils\n_rebuild_tensor_v2\n(");
        // Persistent id of the storage (block of values): kind, class, key, device, number of values.
        out.extend(b"(");
        text(&mut out, "storage");
        out.extend(format!("ctorch\n{}\n", tensor.values.class()).bytes());
        text(&mut out, &key.to_string());
        text(&mut out, "cpu");
        out.extend(int(tensor.values.len() as u64));
        out.extend(b"tQ");
        out.extend(int(tensor.offset as u64));
        for extents in [&tensor.shape, &tensor.stride] {
            out.extend(b"(");
            extents.iter().for_each(|&extent| out.extend(int(extent as u64)));
            out.extend(b"t");
        }
        // The tensor's `requires_grad` is false, and it has no hooks.
        out.extend([b"\x89", DICTIONARY, b"tR"].concat());
    }
    out.extend(b"u.");
    out
}

/// Appends the text `text` to the pickle `out`.
fn text(out: &mut Vec<u8>, text: &str) {
    out.push(b'X');
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.bytes());
}

#[cfg(test)]
mod tests {
    use std::fs;

    use proptest::prelude::*;

    use super::super::read_state_dict;
    use super::*;

    /// Returns the element of `tensor` with the indices `index`, computed by the definition of strides.
    fn element(tensor: &StoredTensor, index: &[usize]) -> f32 {
        let at = tensor.offset + index.iter().zip(&tensor.stride).map(|(i, stride)| i * stride).sum::<usize>();
        match &tensor.values {
            TensorValues::F32(values) => values[at],
            TensorValues::F16(values) => values[at].to_f32(),
        }
    }

    /// Returns all elements of `tensor`, with the last index fastest.
    fn elements(tensor: &StoredTensor) -> Vec<f32> {
        let mut indices = vec![Vec::new()];
        for &extent in &tensor.shape {
            indices = indices.into_iter().flat_map(|at| (0..extent).map(move |i| [&at[..], &[i]].concat())).collect();
        }
        indices.iter().map(|index| element(tensor, index)).collect()
    }

    /// Generates tensors of any shape and strides. Their storage has a few unused values before and after.
    fn tensor() -> impl Strategy<Value = StoredTensor> {
        let extents = proptest::collection::vec((1..5usize, 0..7usize), 0..4);
        (extents, 0..4usize, 0..3usize, any::<bool>(), any::<u64>()).prop_map(
            |(extents, offset, spare, narrow, seed)| {
                let (shape, stride): (Vec<usize>, Vec<usize>) = extents.into_iter().unzip();
                let last = shape.iter().zip(&stride).map(|(extent, stride)| (extent - 1) * stride).sum::<usize>();
                let bits =
                    (0..offset + last + 1 + spare).map(|i| (seed ^ i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15));
                let values = match narrow {
                    true => TensorValues::F16(bits.map(|bits| f16::from_bits((bits >> 48) as u16)).collect()),
                    false => TensorValues::F32(bits.map(|bits| f32::from_bits((bits >> 32) as u32)).collect()),
                };
                StoredTensor { name: String::new(), values, offset, shape, stride }
            },
        )
    }

    proptest! {
        #[test]
        fn any_tensors_are_read_back_unchanged(mut tensors in proptest::collection::vec(tensor(), 0..6)) {
            tensors.iter_mut().enumerate().for_each(|(k, tensor)| tensor.name = format!("net.{k}.weight ✓"));
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a.pth");
            write_state_dict(&path, &tensors).unwrap();
            let read = read_state_dict(&path, crate::limits::ReadLimit::NONE).unwrap();
            prop_assert_eq!(read.len(), tensors.len());
            for tensor in &tensors {
                let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
                // Treat all NaNs as equal, because converting them to a wider type may change their bits.
                let plain = |values: Vec<f32>| {
                    bits(&values.into_iter().map(|x| if x.is_nan() { f32::NAN } else { x }).collect::<Vec<_>>())
                };
                let found = &read[&tensor.name];
                prop_assert_eq!(&found.shape, &tensor.shape);
                prop_assert_eq!(plain(found.data.clone()), plain(elements(tensor)));
            }
        }
    }

    /// Returns the name, offset and content of every file in the zip archive `bytes`, read by the definition of the zip
    /// format.
    fn entries(bytes: &[u8]) -> Vec<(String, usize, Vec<u8>)> {
        let word = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]) as usize;
        let long = |at: usize| word(at) | word(at + 2) << 16;
        let end = bytes.len() - 22;
        assert_eq!(&bytes[end..end + 4], b"PK\x05\x06");
        let (count, mut at) = (word(end + 10), long(end + 16));
        let mut found = Vec::new();
        for _ in 0..count {
            assert_eq!(&bytes[at..at + 4], b"PK\x01\x02");
            assert_eq!((word(at + 10), long(at + 20)), (0, long(at + 24)), "stored as it is");
            let (name, extra, comment) = (word(at + 28), word(at + 30), word(at + 32));
            let local = long(at + 42);
            let start = local + 30 + word(local + 26) + word(local + 28);
            let text = String::from_utf8(bytes[at + 46..at + 46 + name].to_vec()).unwrap();
            found.push((text, start, bytes[start..start + long(at + 24)].to_vec()));
            at += 46 + name + extra + comment;
        }
        found
    }

    #[test]
    fn entries_have_the_names_order_and_alignment_of_pytorch() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.pth");
        let tensor = |name: &str, values| StoredTensor::dense(name.to_owned(), vec![3], values);
        let half = [1.0, -2.0, 0.25].map(f16::from_f32).to_vec();
        write_state_dict(
            &path,
            &[tensor("a", TensorValues::F32(vec![1.0, 2.0, 3.0])), tensor("b", TensorValues::F16(half))],
        )
        .unwrap();
        let found = entries(&fs::read(&path).unwrap());
        let names: Vec<&str> = found.iter().map(|entry| entry.0.as_str()).collect();
        let expected = ["data.pkl", "byteorder", "data/0", "data/1", "version"].map(|name| format!("archive/{name}"));
        assert_eq!(names, expected);
        assert!(found.iter().all(|entry| entry.1 % 64 == 0), "{found:?}");
        assert_eq!(found[3].2, [0x00, 0x3C, 0x00, 0xC0, 0x00, 0x34]);
        assert_eq!((&found[1].2[..], &found[4].2[..]), (&b"little"[..], &b"3\n"[..]));
    }

    #[test]
    fn the_pickle_has_the_expected_bytes() {
        let values = TensorValues::F16(vec![f16::ZERO; 300]);
        let tensor =
            StoredTensor { name: "w".to_owned(), values, offset: 7, shape: vec![2, 70_000], stride: vec![0, 0] };
        let expected = [
            &b"\x80\x02ccollections\nOrderedDict\n)R("[..],
            b"X\x01\0\0\0wctorch._utils\n_rebuild_tensor_v2\n(",
            b"(X\x07\0\0\0storagectorch\nHalfStorage\nX\x01\0\0\x000X\x03\0\0\0cpuM\x2C\x01tQ",
            b"K\x07(K\x02J\x70\x11\x01\0t(K\0K\0t\x89ccollections\nOrderedDict\n)RtR",
            b"u.",
        ];
        assert_eq!(pickle(&[tensor]), expected.concat());
        assert_eq!(int(1 << 31), [0x8A, 9, 0, 0, 0, 0x80, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn write_errors_name_the_file() {
        let error = write_state_dict(Path::new("nowhere/a.pth"), &[]).unwrap_err().to_string();
        assert!(error.contains("nowhere/a.pth"), "{error}");
    }
}
