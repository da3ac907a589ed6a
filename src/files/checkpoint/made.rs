//! Builds checkpoint files from given values, for tests.

use std::io::{Cursor, Write};

use zip::write::FileOptions;
use zip::{CompressionMethod, ZipWriter};

/// Python value to be written as a pickle.
#[derive(Debug, Clone)]
pub(crate) enum PythonValue {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Text(&'static str),
    Tuple(Vec<PythonValue>),
    List(Vec<PythonValue>),
    Dict(Vec<(PythonValue, PythonValue)>),
    Ordered(Vec<(PythonValue, PythonValue)>),
    Tensor(PickledTensor),
    Parameter(PickledTensor),
}

/// Tensor to be pickled: its storage (block of values) with the type and the bytes of the values, and the offset, shape
/// and strides by which the tensor selects values of the storage. `class` is the name of PyTorch's storage class, and
/// `width` the number of bytes per value.
#[derive(Debug, Clone)]
pub(crate) struct PickledTensor {
    pub(crate) class: &'static str,
    /// Number of the storage (block of values). A storage used by several tensors is stored once.
    pub(crate) storage: usize,
    pub(crate) bytes: Vec<u8>,
    pub(crate) width: usize,
    pub(crate) offset: usize,
    pub(crate) shape: Vec<usize>,
    pub(crate) stride: Vec<usize>,
}

/// Returns a dense f32 tensor of the shape `shape`, whose values are in storage number `storage`.
pub(crate) fn tensor(storage: usize, shape: &[usize], values: &[f32]) -> PickledTensor {
    let mut stride = vec![1; shape.len()];
    (1..shape.len()).rev().for_each(|axis| stride[axis - 1] = stride[axis] * shape[axis].max(1));
    PickledTensor {
        class: "FloatStorage",
        storage,
        bytes: values.iter().flat_map(|value| value.to_le_bytes()).collect(),
        width: 4,
        offset: 0,
        shape: shape.to_vec(),
        stride,
    }
}

/// Converts dict items whose keys are texts to items whose keys are [`PythonValue`] values.
pub(crate) fn named(items: Vec<(&'static str, PythonValue)>) -> Vec<(PythonValue, PythonValue)> {
    items.into_iter().map(|(key, value)| (PythonValue::Text(key), value)).collect()
}

impl PythonValue {
    /// Appends the pickle (protocol 2, without memo) of this value to `out`.
    fn pickle(&self, out: &mut Vec<u8>) {
        let items = |items: &[(PythonValue, PythonValue)], out: &mut Vec<u8>| {
            out.push(b'(');
            items.iter().for_each(|(key, value)| {
                key.pickle(out);
                value.pickle(out);
            });
            out.push(b'u');
        };
        let several = |open: &[u8], elements: &[PythonValue], close: u8, out: &mut Vec<u8>| {
            out.extend(open);
            elements.iter().for_each(|element| element.pickle(out));
            out.push(close);
        };
        match self {
            PythonValue::None => out.push(b'N'),
            PythonValue::Bool(value) => out.push(0x89 - u8::from(*value)),
            PythonValue::Int(value) => out.extend([&[b'J'][..], &(*value as i32).to_le_bytes()].concat()),
            PythonValue::Float(value) => out.extend([&[b'G'][..], &value.to_be_bytes()].concat()),
            PythonValue::Text(text) => {
                out.extend([b"X", &(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat())
            }
            PythonValue::Tuple(elements) => several(b"(", elements, b't', out),
            PythonValue::List(elements) => several(b"](", elements, b'e', out),
            PythonValue::Dict(entries) => {
                out.push(b'}');
                items(entries, out);
            }
            PythonValue::Ordered(entries) => {
                out.extend(b"ccollections\nOrderedDict\n)R");
                items(entries, out);
            }
            PythonValue::Tensor(tensor) => tensor.pickle(out),
            PythonValue::Parameter(tensor) => {
                out.extend(b"ctorch._utils\n_rebuild_parameter\n(");
                tensor.pickle(out);
                out.extend(b"\x88ccollections\nOrderedDict\n)RtR");
            }
        }
    }

    /// Adds the storages (blocks of values) of all tensors in this value to `storages_out`, as (number, bytes).
    fn storages(&self, storages_out: &mut Vec<(usize, Vec<u8>)>) {
        match self {
            PythonValue::Tensor(tensor) | PythonValue::Parameter(tensor) => {
                storages_out.push((tensor.storage, tensor.bytes.clone()))
            }
            PythonValue::Tuple(elements) | PythonValue::List(elements) => {
                elements.iter().for_each(|element| element.storages(storages_out))
            }
            PythonValue::Dict(items) | PythonValue::Ordered(items) => {
                items.iter().for_each(|(_, value)| value.storages(storages_out))
            }
            _ => (),
        }
    }

    /// Returns the bytes of a checkpoint file that holds this value.
    pub(crate) fn file(&self) -> Vec<u8> {
        let mut pickle = b"\x80\x02".to_vec();
        self.pickle(&mut pickle);
        pickle.push(b'.');
        let mut storages = Vec::new();
        self.storages(&mut storages);
        storages.sort_by_key(|storage| storage.0);
        storages.dedup_by_key(|storage| storage.0);
        let mut files = vec![("data.pkl".to_owned(), pickle), ("byteorder".to_owned(), b"little".to_vec())];
        files.extend(storages.into_iter().map(|(key, bytes)| (format!("data/{key}"), bytes)));
        files.push(("version".to_owned(), b"3\n".to_vec()));
        zip(&files)
    }
}

impl PickledTensor {
    /// Appends the pickle of the tensor to `out`.
    fn pickle(&self, out: &mut Vec<u8>) {
        let numbers =
            |values: &[usize]| PythonValue::Tuple(values.iter().map(|&x| PythonValue::Int(x as i64)).collect());
        out.extend(b"ctorch._utils\n_rebuild_tensor_v2\n((");
        PythonValue::Text("storage").pickle(out);
        out.extend(format!("ctorch\n{}\n", self.class).bytes());
        // The keys of storages are their numbers written as texts.
        let key = self.storage.to_string();
        out.extend([b"X", &(key.len() as u32).to_le_bytes()[..], key.as_bytes()].concat());
        PythonValue::Text("cuda:0").pickle(out);
        PythonValue::Int((self.bytes.len() / self.width) as i64).pickle(out);
        out.extend(b"tQ");
        PythonValue::Int(self.offset as i64).pickle(out);
        numbers(&self.shape).pickle(out);
        numbers(&self.stride).pickle(out);
        out.extend(b"\x89ccollections\nOrderedDict\n)RtR");
    }
}

/// Returns the bytes of a zip archive with uncompressed `files`, given as (name, content), in the folder `made`.
pub(crate) fn zip(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in files {
        let options = FileOptions::default().compression_method(CompressionMethod::Stored);
        archive.start_file_aligned(format!("made/{name}"), options, 64).unwrap();
        archive.write_all(bytes).unwrap();
    }
    archive.finish().unwrap().into_inner()
}
