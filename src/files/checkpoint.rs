//! Reads PyTorch checkpoints, as `torch.save` writes them.
//!
//! Input: a path. Output: the object tree of the pickle (the serialized Python objects in the file), and the values of
//! requested tensors. Nothing in the pickle is executed. Memory: the list of files in the zip archive, the object tree,
//! and one storage (block of tensor values) at a time. Each is checked against the memory limit ([`ReadLimit`]) before
//! it is allocated.
//!
//! A tensor is `torch._utils._rebuild_tensor_v2(storage, offset, size, stride, …)`, or a parameter made of such a
//! tensor. Its storage is an entry of the zip archive and may be shared by several tensors. The device of a storage is
//! ignored.

pub(crate) mod write;

use std::fs::File;
use std::io::{BufReader, Read};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use flate2::Crc;
use half::{bf16, f16};
use hashbrown::HashMap;
use zip::{CompressionMethod, ZipArchive};

use super::open::open_file;
use super::pickle::PickleError;
pub(crate) use super::pickle::{MAX_DEPTH, Node, NodeId, Pickle};
use super::zip_directory::{checksum_matches, declared_directory};
use crate::error::{Error, Result, quoted};
use crate::limits::ReadLimit;

/// Maximum size in bytes of the pickle of a checkpoint. A pickle that describes ten thousand tensors has about one
/// million bytes.
const MAX_PICKLE: u64 = 1 << 23;
/// Maximum number of files in the zip archive of a checkpoint.
const MAX_ENTRIES: u64 = 1 << 16;
/// Estimated memory, in bytes, that the list of files of the zip archive takes per file. The whole list takes
/// `ENTRY_BYTES` × files + 3 × (length in bytes of the list in the archive).
const ENTRY_BYTES: u64 = 640;
/// Maximum ratio of the number of elements of a tensor to the number of values in its storage (block of tensor values).
/// Trained models do not exceed it. The limit is needed because a tensor may repeat stored values (stride 0), so a
/// small file can declare a huge tensor.
const MAX_EXPANSION: usize = 4;

/// Size in bytes of the buffer through which the zip archive is read. It is small, because only the headers of files
/// are read in small parts.
const BUFFER_BYTES: usize = 512;

/// Zip archive of a checkpoint. The file is not memory-mapped, so bytes that were read do not count as memory of the
/// process.
type Archive = ZipArchive<BufReader<File>>;

/// PyTorch checkpoint that is open for reading.
#[derive(Debug)]
pub(crate) struct Checkpoint {
    path: PathBuf,
    memory: ReadLimit,
    /// Zip archive of the file, locked while a file in it is read.
    archive: Mutex<Archive>,
    pickle: Pickle,
    /// Index of the pickle file among the files of the archive.
    pickle_index: usize,
    /// Storages (blocks of tensor values) by key.
    storages: HashMap<String, Storage>,
}

/// Storage (block of tensor values) of a checkpoint.
#[derive(Debug)]
struct Storage {
    /// Index of the storage among the files of the archive.
    index: usize,
    /// Byte range of the values in the checkpoint file.
    range: Range<usize>,
}

/// Type of the values of a tensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ValueType {
    F16,
    BF16,
    F32,
    F64,
    /// Type that is not floating-point (integers, booleans, complex numbers): its name and the bytes per value.
    Other(&'static str, usize),
}

impl ValueType {
    /// Returns the value type of the PyTorch storage class `global`, such as `torch.HalfStorage`; `None` if the class
    /// is unknown.
    fn from_global(global: &str) -> Option<ValueType> {
        Some(match global {
            "torch.HalfStorage" => ValueType::F16,
            "torch.BFloat16Storage" => ValueType::BF16,
            "torch.FloatStorage" => ValueType::F32,
            "torch.DoubleStorage" => ValueType::F64,
            "torch.LongStorage" => ValueType::Other("int64", 8),
            "torch.IntStorage" => ValueType::Other("int32", 4),
            "torch.ShortStorage" => ValueType::Other("int16", 2),
            "torch.CharStorage" => ValueType::Other("int8", 1),
            "torch.ByteStorage" => ValueType::Other("uint8", 1),
            "torch.BoolStorage" => ValueType::Other("bool", 1),
            "torch.ComplexFloatStorage" => ValueType::Other("complex64", 8),
            "torch.ComplexDoubleStorage" => ValueType::Other("complex128", 16),
            _ => return None,
        })
    }

    /// Returns PyTorch's name of the value type, such as `float16`.
    pub(crate) fn name(self) -> &'static str {
        match self {
            ValueType::F16 => "float16",
            ValueType::BF16 => "bfloat16",
            ValueType::F32 => "float32",
            ValueType::F64 => "float64",
            ValueType::Other(name, _) => name,
        }
    }

    /// Returns the number of bytes per value.
    pub(crate) fn bytes(self) -> usize {
        match self {
            ValueType::F16 | ValueType::BF16 => 2,
            ValueType::F32 => 4,
            ValueType::F64 => 8,
            ValueType::Other(_, bytes) => bytes,
        }
    }

    /// Returns whether the values are floating-point numbers.
    pub(crate) fn is_float(self) -> bool {
        !matches!(self, ValueType::Other(..))
    }

    /// Decodes one floating-point value from its bytes `stored`. Returns NaN for types that are not floating-point.
    fn decode(self, stored: &[u8]) -> f32 {
        match (self, stored) {
            (ValueType::F16, &[a, b]) => f16::from_le_bytes([a, b]).to_f32(),
            (ValueType::BF16, &[a, b]) => bf16::from_le_bytes([a, b]).to_f32(),
            (ValueType::F32, &[a, b, c, d]) => f32::from_le_bytes([a, b, c, d]),
            (ValueType::F64, _) => stored.try_into().map_or(f32::NAN, |stored| f64::from_le_bytes(stored) as f32),
            _ => f32::NAN,
        }
    }

    /// Encodes `value` into the bytes `stored`. Writes zeros for types that are not floating-point.
    pub(crate) fn encode(self, value: f32, stored: &mut [u8]) {
        match self {
            ValueType::F16 => stored.copy_from_slice(&f16::from_f32(value).to_le_bytes()),
            ValueType::BF16 => stored.copy_from_slice(&bf16::from_f32(value).to_le_bytes()),
            ValueType::F32 => stored.copy_from_slice(&value.to_le_bytes()),
            ValueType::F64 => stored.copy_from_slice(&f64::from(value).to_le_bytes()),
            ValueType::Other(..) => stored.fill(0),
        }
    }
}

/// Description of a tensor, without its values. The values are in a storage (block of values): the element with indices
/// `i` is value number `offset + Σ i·stride` of the storage. All strides and offsets count values.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TensorView {
    /// Index of the node of this tensor in the object tree of the pickle, which has one node per Python value. The node
    /// is the function call that builds the tensor. For a PyTorch `Parameter`, it is the node of the tensor that it
    /// wraps.
    pub(crate) id: NodeId,
    /// Key of the storage (block of tensor values) that holds the values of this tensor.
    pub(crate) storage: String,
    pub(crate) kind: ValueType,
    pub(crate) shape: Vec<usize>,
    pub(crate) stride: Vec<usize>,
    pub(crate) offset: usize,
    /// Byte ranges, in the pickle, of the numbers that describe this tensor.
    pub(crate) places: NumberRanges,
}

/// Byte ranges, in the pickle, of the numbers that describe one tensor. A writer replaces these numbers to change the
/// shape of the tensor.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct NumberRanges {
    /// Byte range of the number that states how many values the storage holds.
    pub(crate) numel: Range<usize>,
    pub(crate) offset: Range<usize>,
    pub(crate) shape: Vec<Range<usize>>,
    pub(crate) stride: Vec<Range<usize>>,
}

impl TensorView {
    /// Returns the type and shape of the tensor as text for messages.
    pub(crate) fn describe(&self) -> String {
        let shape = &self.shape;
        format!("{} {shape:?}", self.kind.name())
    }

    /// Returns the number of elements of the tensor; `None` if it overflows.
    pub(crate) fn len(&self) -> Option<usize> {
        self.shape.iter().try_fold(1usize, |product, &length| product.checked_mul(length))
    }

    /// Calls `take` for every element, the last axis fastest, with the index of the element in the storage (block of
    /// values).
    pub(crate) fn each(&self, mut take: impl FnMut(usize)) {
        if self.shape.contains(&0) {
            return;
        }
        let (mut index, mut at) = (vec![0; self.shape.len()], self.offset);
        loop {
            take(at);
            let mut axis = self.shape.len();
            loop {
                let Some(next) = axis.checked_sub(1) else { return };
                axis = next;
                index[axis] += 1;
                at += self.stride[axis];
                if index[axis] < self.shape[axis] {
                    break;
                }
                at -= self.shape[axis] * self.stride[axis];
                index[axis] = 0;
            }
        }
    }
}

impl Checkpoint {
    /// Opens the checkpoint at `path`. Reading may use at most `memory` bytes of memory.
    ///
    /// # Errors
    /// Fails if the file is not a zip archive of uncompressed entries or is cut short, if its pickle cannot be read, or
    /// if it needs more memory than allowed.
    pub(crate) fn open(path: &Path, memory: ReadLimit) -> Result<Checkpoint> {
        let mut file = open_file(path)?;
        let length = file.metadata().map_err(Error::io("read the size of", path))?.len();
        let wrong = |place: &str, found: String| {
            Error::input(path, place, "a checkpoint as torch.save writes it", found)
                .hint("if the file was copied, copy it again; otherwise load it and save it again with torch.save")
        };
        let mut head = Vec::new();
        (&mut file).take(64).read_to_end(&mut head).map_err(Error::io("read", path))?;
        if has_legacy_magic(&head) {
            return Err(legacy_format(path));
        }
        let broken = |error: zip::result::ZipError| wrong(LIST, error.to_string());
        let directory = declared_directory(&mut file).map_err(|error| wrong(LIST, error.to_string()))?;
        if directory.entries > MAX_ENTRIES {
            return Err(wrong(LIST, format!("{} files", directory.entries)));
        }
        let listed = 3 * directory.bytes.min(length) + ENTRY_BYTES * directory.entries;
        memory.check(path, LIST, &format!("the names of {} files", directory.entries), listed)?;
        let mut archive = ZipArchive::new(BufReader::with_capacity(BUFFER_BYTES, file)).map_err(broken)?;
        let (mut storages, mut pickle_index, mut byte_order) = (HashMap::new(), None, None);
        for index in 0..archive.len() {
            let entry = archive.by_index(index).map_err(broken)?;
            let at = |found: &str| wrong(&format!("file {}", quoted(entry.name())), found.to_owned());
            if entry.compression() != CompressionMethod::Stored || entry.compressed_size() != entry.size() {
                return Err(Error::input(
                    path,
                    format!("file {}", quoted(entry.name())),
                    "an uncompressed file, as torch.save writes it",
                    "a compressed one",
                )
                .hint("load the checkpoint with torch.load and save it again with torch.save"));
            }
            if entry.data_start().checked_add(entry.size()).is_none_or(|end| end > length) {
                return Err(at("cut short"));
            }
            match without_first_folder(entry.name()) {
                PICKLE if entry.size() > MAX_PICKLE => {
                    let place = entry.name().to_owned();
                    return Err(Error::input(
                        path,
                        place,
                        format!("a pickle of at most {MAX_PICKLE} bytes"),
                        format!("{} bytes", entry.size()),
                    ));
                }
                PICKLE if pickle_index.is_some() => return Err(at("a second pickle")),
                PICKLE => pickle_index = Some((index, entry.size())),
                "byteorder" => byte_order = Some(index),
                other => {
                    if let Some(key) = other.strip_prefix("data/") {
                        let start = entry.data_start() as usize;
                        storages.insert(key.to_owned(), Storage { index, range: start..start + entry.size() as usize });
                    }
                }
            }
        }
        if byte_order.is_some_and(|index| is_big_endian_marker(&mut archive, index)) {
            return Err(wrong("byteorder", "big-endian values".into()));
        }
        let (pickle_index, bytes) = pickle_index.ok_or_else(|| wrong(LIST, format!("no {PICKLE}")))?;
        memory.check(path, PICKLE, "the list of files and the pickle", listed + bytes)?;
        // Leave an eighth of the memory to the allocator, which cannot always reuse freed memory for new requests.
        let left = (memory.bytes() - listed - bytes) / 8 * 7;
        let bytes = read_entry(&mut archive, pickle_index).map_err(|error| wrong(PICKLE, error.to_string()))?;
        let pickle = Pickle::read(&bytes, left).map_err(|error| match error {
            PickleError::Malformed(at, found) => wrong(&format!("{PICKLE}, byte {at}"), found),
            PickleError::TooMuch(at, expected, found) => {
                Error::input(path, format!("{PICKLE}, byte {at}"), expected, found)
                    .hint("a trained model has far fewer: load the checkpoint and save its state dict alone")
            }
            PickleError::Memory(at, taken) => {
                let place = format!("{PICKLE}, byte {at}");
                let whole = listed + bytes.len() as u64 + taken / 7 * 8 + 8;
                memory.check(path, &place, "the values of the pickle", whole).err().unwrap_or_else(|| {
                    Error::input(path, place, "values of fewer than 128 MiB", "more")
                        .hint("a trained model has far fewer: load the checkpoint and save its state dict alone")
                })
            }
        })?;
        let archive = Mutex::new(archive);
        Ok(Checkpoint { path: path.to_owned(), memory, archive, pickle, pickle_index, storages })
    }

    /// Checks that `bytes` bytes of memory may be used for reading `what`, which is at `place` in the file. Fails if
    /// the memory limit for reading is exceeded; the error names `what` and `place`.
    pub(crate) fn allow(&self, place: &str, what: &str, bytes: u64) -> Result<()> {
        self.memory.check(&self.path, place, what, bytes)
    }

    /// Returns the object tree of the checkpoint.
    pub(crate) fn pickle(&self) -> &Pickle {
        &self.pickle
    }

    /// Returns the error for a file in which `found` is at `place` instead of `expected`.
    pub(crate) fn wrong(&self, place: &str, expected: impl Into<String>, found: impl Into<String>) -> Error {
        Error::input(&self.path, place, expected, found)
    }

    /// Returns a description of node `id` of the object tree for messages.
    pub(crate) fn describe(&self, id: NodeId) -> String {
        self.tensor(id).map_or_else(|| self.pickle.describe(id), |tensor| format!("a tensor, {}", tensor.describe()))
    }

    /// Returns the tensor at node `id` of the object tree: the tensor that the node builds, or the one inside a
    /// parameter. Returns `None` for other nodes.
    pub(crate) fn tensor(&self, id: NodeId) -> Option<TensorView> {
        match self.pickle.call(id)? {
            ("torch._utils._rebuild_parameter" | "torch._utils._rebuild_parameter_with_state", [tensor, ..]) => {
                self.plain_tensor(*tensor)
            }
            _ => self.plain_tensor(id),
        }
    }

    /// Returns the tensor that node `id` of the object tree builds. Returns `None` for all other nodes, even for a
    /// PyTorch `Parameter`, which contains the node of a tensor.
    fn plain_tensor(&self, id: NodeId) -> Option<TensorView> {
        let (name, arguments) = self.pickle.call(id)?;
        let [storage, offset, size, stride, ..] = *arguments else { return None };
        let Node::PersistentId(named) = self.pickle.node(storage) else { return None };
        let [what, kind, key, _device, numel] = *self.pickle.elements(*named)? else { return None };
        let Node::Global(kind) = self.pickle.node(kind) else { return None };
        let is_tensor = name == "torch._utils._rebuild_tensor_v2" && self.pickle.text(what)? == "storage";
        let (_, numel) = self.number(numel)?;
        let (offset, offset_at) = self.number(offset)?;
        let (shape, shape_at) = self.numbers(size)?;
        let (stride, stride_at) = self.numbers(stride)?;
        (is_tensor && shape.len() == stride.len()).then_some(())?;
        Some(TensorView {
            id,
            storage: self.pickle.text(key)?.to_owned(),
            kind: ValueType::from_global(kind)?,
            shape,
            stride,
            offset,
            places: NumberRanges { numel, offset: offset_at, shape: shape_at, stride: stride_at },
        })
    }

    /// Returns every tensor in the object tree once.
    pub(crate) fn tensors(&self) -> impl Iterator<Item = TensorView> {
        self.pickle.ids().filter_map(|id| self.plain_tensor(id))
    }

    /// Returns the bytes of the file that hold the storage (block of tensor values) `key`; `None` if there is no such
    /// storage.
    pub(crate) fn storage_range(&self, key: &str) -> Option<Range<usize>> {
        self.storages.get(key).map(|storage| storage.range.clone())
    }

    /// Locks and returns the zip archive.
    fn archive(&self) -> MutexGuard<'_, Archive> {
        self.archive.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the number of values of the type `kind` that the storage `key` holds; 0 if there is no such storage.
    fn stored_values(&self, key: &str, kind: ValueType) -> usize {
        self.storages.get(key).map_or(0, |storage| storage.range.len() / kind.bytes())
    }

    /// Returns the non-negative integer at node `id` and its byte range in the pickle; `None` for other nodes.
    fn number(&self, id: NodeId) -> Option<(usize, Range<usize>)> {
        match self.pickle.node(id) {
            Node::Int(value, at) => Some((usize::try_from(*value).ok()?, at.start as usize..at.end as usize)),
            _ => None,
        }
    }

    /// Returns the non-negative integers in the tuple or list at node `id`, and the byte range of each in the pickle;
    /// `None` for other nodes.
    fn numbers(&self, id: NodeId) -> Option<(Vec<usize>, Vec<Range<usize>>)> {
        self.pickle.elements(id)?.iter().map(|&id| self.number(id)).collect()
    }

    /// Returns the floating-point tensor at node `id` of the object tree; `place` names it in messages.
    ///
    /// # Errors
    /// Fails if the node is not such a tensor, or if the storage of the tensor is missing or too short.
    pub(crate) fn float_tensor(&self, id: NodeId, place: &str) -> Result<TensorView> {
        let wrong = |expected: &str, found: String| self.wrong(place, expected, found);
        let tensor = self.tensor(id).filter(|tensor| tensor.kind.is_float());
        let tensor = tensor.ok_or_else(|| wrong("a tensor of floating-point numbers", self.describe(id)))?;
        self.check(&tensor).map_err(|found| wrong("values for all of its elements", found))?;
        Ok(tensor)
    }

    /// Checks that the storage of `tensor` holds all of its elements, and that the tensor has at most 4
    /// ([`MAX_EXPANSION`]) elements per stored value. The error describes the tensor and its storage.
    pub(crate) fn check(&self, tensor: &TensorView) -> std::result::Result<(), String> {
        self.check_extent(tensor)?;
        let values = self.stored_values(&tensor.storage, tensor.kind);
        match tensor.len().is_some_and(|len| len <= values.saturating_mul(MAX_EXPANSION)) {
            true => Ok(()),
            false => Err(format!("{}, and {values} values in data/{}", tensor.describe(), tensor.storage)),
        }
    }

    /// Checks that the storage of `tensor` holds all of its elements. The error describes the tensor and its storage.
    pub(crate) fn check_extent(&self, tensor: &TensorView) -> std::result::Result<(), String> {
        if !self.storages.contains_key(&tensor.storage) {
            return Err(format!("no file data/{}", tensor.storage));
        }
        let values = self.stored_values(&tensor.storage, tensor.kind);
        let too_short = || format!("{}, and {values} values in data/{}", tensor.describe(), tensor.storage);
        let len = tensor.len().ok_or_else(too_short)?;
        let last = tensor.shape.iter().zip(&tensor.stride).try_fold(tensor.offset, |last, (&length, &stride)| {
            last.checked_add(length.saturating_sub(1).checked_mul(stride)?)
        });
        match last {
            Some(last) if len == 0 || last < values => Ok(()),
            _ => Err(too_short()),
        }
    }

    /// Returns the maximum number of elements, of type `kind`, that all tensors in the storage `key` may have together:
    /// 4 ([`MAX_EXPANSION`]) times the number of stored values; 0 if the storage is missing.
    pub(crate) fn max_values(&self, key: &str, kind: ValueType) -> usize {
        self.stored_values(key, kind).saturating_mul(MAX_EXPANSION)
    }

    /// Reads the bytes of the storage (block of tensor values) `key`.
    ///
    /// # Errors
    /// Fails if the storage is missing or damaged.
    pub(crate) fn storage(&self, key: &str) -> Result<Vec<u8>> {
        let place = format!("data/{key}");
        let wrong = |found: String| {
            self.wrong(&place, "the values as they were written", found)
                .hint("the file is damaged or cut short: copy it again")
        };
        let storage = self.storages.get(key).ok_or_else(|| wrong("no such file".into()))?;
        self.allow(&place, "its values", storage.range.len() as u64)?;
        read_entry(&mut self.archive(), storage.index).map_err(|error| wrong(error.to_string()))
    }

    /// Reads the elements of a floating-point tensor as f32, the last axis fastest; `place` names it in messages.
    /// Elements may be NaN or infinite.
    ///
    /// # Errors
    /// Fails if values are damaged or need more memory than allowed.
    pub(crate) fn values(&self, tensor: &TensorView, place: &str) -> Result<Vec<f32>> {
        let stored = self.storages.get(&tensor.storage).map_or(0, |storage| storage.range.len() as u64);
        let (bytes, len) = (tensor.kind.bytes(), tensor.len().unwrap_or(0));
        self.allow(place, "its values", stored.saturating_add(4 * len as u64))?;
        let stored = self.storage(&tensor.storage)?;
        let mut values = Vec::with_capacity(len);
        tensor.each(|at| values.push(tensor.kind.decode(&stored[at * bytes..][..bytes])));
        Ok(values)
    }

    /// Calls `take` for every file in the checkpoint's zip archive, in order. The arguments are the path of the file in
    /// the archive, its kind (pickle, storage or other) and its bytes.
    ///
    /// # Errors
    /// Fails if a file is damaged or `take` fails.
    pub(crate) fn files(&self, mut take: impl FnMut(&str, CheckpointFile<'_>, Vec<u8>) -> Result<()>) -> Result<()> {
        let count = self.archive().len();
        for index in 0..count {
            let broken = |error: &dyn std::fmt::Display| {
                self.wrong(&format!("file {index}"), "its bytes as they were written", error.to_string())
            };
            let name = self.archive().by_index(index).map_err(|error| broken(&error))?.name().to_owned();
            let bytes = read_entry(&mut self.archive(), index).map_err(|error| broken(&error))?;
            let what = match without_first_folder(&name).strip_prefix("data/") {
                _ if index == self.pickle_index => CheckpointFile::Pickle,
                Some(key) => CheckpointFile::Storage(key),
                None => CheckpointFile::Other,
            };
            take(&name, what, bytes)?;
        }
        Ok(())
    }
}

/// Kind of a file in the zip archive of a checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CheckpointFile<'a> {
    /// Pickle that describes the objects.
    Pickle,
    /// Storage (block of tensor values), with its key.
    Storage(&'a str),
    /// File that is neither the pickle nor a storage.
    Other,
}

/// Name of the pickle file in the zip archive of a checkpoint.
const PICKLE: &str = "data.pkl";

/// Returns `name`, the path of a file in the archive, without its first folder. PyTorch calls this folder `archive` or
/// names it after the checkpoint file.
fn without_first_folder(name: &str) -> &str {
    name.split_once('/').map_or(name, |(_, rest)| rest)
}

/// Bytes 2 to 13 of a file in the format that PyTorch before 1.6 saves: the pickle of PyTorch's magic number, without
/// the two bytes before it that state the pickle protocol.
const LEGACY_MAGIC: &[u8] = b"\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19";

/// Returns whether `head`, the first bytes of a file, belong to the format that PyTorch before 1.6 saves.
pub(crate) fn has_legacy_magic(head: &[u8]) -> bool {
    head.first() == Some(&0x80) && head.get(2..).is_some_and(|rest| rest.starts_with(LEGACY_MAGIC))
}

/// Returns the error for the file `path`, which has the format that PyTorch before 1.6 saves.
pub(crate) fn legacy_format(path: &Path) -> Error {
    Error::input(
        path,
        "first bytes",
        "a zip archive, as torch.save of PyTorch 1.6 or newer writes it",
        "the older format",
    )
    .hint("convert it: python3 -c \"import torch; torch.save(torch.load('OLD', map_location='cpu'), 'NEW')\"")
}

/// Name that error messages use for the list of files of the zip archive, if the error is in this list.
const LIST: &str = "list of files";

/// Returns whether the file with index `index` in `archive` begins with the text "big". PyTorch stores it if the values
/// are big-endian.
fn is_big_endian_marker(archive: &mut Archive, index: usize) -> bool {
    let mut text = Vec::new();
    archive.by_index_raw(index).is_ok_and(|entry| entry.take(3).read_to_end(&mut text).is_ok()) && text == b"big"
}

/// Reads the bytes of the file with index `index` in the zip archive `archive`. The file in the archive must be
/// uncompressed. Fails if its bytes do not match its checksum.
fn read_entry(archive: &mut Archive, index: usize) -> std::io::Result<Vec<u8>> {
    let mut entry = archive.by_index_raw(index)?;
    let mut bytes = vec![0; entry.size() as usize];
    entry.read_exact(&mut bytes)?;
    let mut sum = Crc::new();
    sum.update(&bytes);
    match checksum_matches(entry.crc32(), sum.sum()) {
        true => Ok(bytes),
        false => Err(std::io::Error::other("bytes that do not match their checksum")),
    }
}

#[cfg(test)]
pub(crate) mod made;
#[cfg(test)]
mod tests;
