//! NumPy `.npz` archives, whose arrays are read directly from the memory-mapped file where possible.
//!
//! Input: a path. Output: the shape of every array, and the values of requested arrays. Memory: at most about 2 MiB of
//! the mapped file. An array that is compressed or not f32 is decoded once into an unnamed scratch file, and this file
//! is mapped.

pub(crate) mod write;

use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use flate2::{Crc, CrcReader};
use half::f16;
use npyz::{DType, Endianness, NpyHeader, Order, TypeChar};
use zip::ZipArchive;
use zip::read::ZipFile;

use super::map::FileMap;
use super::npy::{HEAD, header_is_sound};
use super::open::open_file;
use super::zip_directory::{DeclaredDirectory, check_checksum, declared_directory};
use crate::error::{Error, Result};

/// Maximum number of arrays in an `.npz` archive.
const MAX_ARRAYS: usize = 4096;
/// Maximum size in bytes of the list of files that an archive has at its end.
const MAX_LIST: u64 = 4 << 20;
/// Number of bytes of decoded arrays, which are written to scratch files, that are allowed per byte of the archive. The
/// limit for an archive of n bytes is [`BASE_SCRATCH_BYTES`] + `SCRATCH_PER_BYTE` · n. Trained models need n to 2n
/// bytes.
const SCRATCH_PER_BYTE: u64 = 64;
/// Number of bytes of decoded arrays that are allowed for any archive, however small it is; see [`SCRATCH_PER_BYTE`].
const BASE_SCRATCH_BYTES: u64 = 64 << 20;
/// Largest possible ratio of decompressed to compressed bytes with DEFLATE.
const MAX_DEFLATE_FACTOR: u64 = 1032;
/// The checksum of a mapped array is computed in parts of this many bytes. After each part, its pages are released from
/// memory.
const CHECKED_BYTES: usize = 1 << 20;

/// Open `.npz` archive.
#[derive(Debug)]
pub(crate) struct Npz {
    path: PathBuf,
    map: Arc<FileMap>,
    entries: Vec<NpzArray>,
}

/// Array in an `.npz` archive.
#[derive(Debug, Clone)]
pub(crate) struct NpzArray {
    /// Name of the array, without `.npy`.
    pub(crate) name: String,
    /// Length of every axis, the slowest axis first.
    pub(crate) shape: Vec<usize>,
    /// Floating-point type of the values; `None` if the values cannot be read as floats in C order (last axis fastest).
    pub(crate) float: Option<Float>,
    /// Type of the values in NumPy's notation, such as `<f4`.
    pub(crate) descr: String,
    /// Whether the first axis is the fastest (Fortran order).
    pub(crate) is_fortran: bool,
    /// Whether the array is compressed in the archive.
    pub(crate) is_compressed: bool,
    /// Size of the array in the archive, in bytes; the compressed size if the array is compressed.
    stored: u64,
    /// Checksum (CRC-32) that the archive lists for the header and the values of the array.
    checksum: u32,
    /// Index of the array among the files of the archive.
    index: usize,
    /// Length in bytes of the array's header.
    header: usize,
    /// Byte offset, in the archive, of the first value; meaningless if the array is compressed.
    start: usize,
}

/// Floating-point type of stored values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Float {
    /// Number of bytes per value: 2, 4 or 8.
    pub(crate) bytes: usize,
    big_endian: bool,
}

impl Float {
    /// Type of values that can be read without decoding: little-endian float32.
    const F32: Float = Float { bytes: 4, big_endian: false };

    /// Returns the type of the values if the header describes floating-point numbers in C order, else `None`.
    fn from_header(header: &NpyHeader) -> Option<Float> {
        let DType::Plain(plain) = header.dtype() else { return None };
        let bytes = plain.num_bytes().filter(|bytes| [2, 4, 8].contains(bytes))?;
        let is_float = plain.type_char() == TypeChar::Float && header.order() == Order::C;
        is_float.then_some(Float { bytes, big_endian: plain.endianness() == Endianness::Big })
    }

    /// Decodes one value from its bytes `stored`, which must be [`Float::bytes`] many.
    pub(crate) fn decode(self, stored: &[u8]) -> f32 {
        let mut bytes = [0; 8];
        bytes[..self.bytes].copy_from_slice(stored);
        if self.big_endian {
            bytes[..self.bytes].reverse();
        }
        let [a, b, c, d, ..] = bytes;
        match self.bytes {
            2 => f16::from_le_bytes([a, b]).to_f32(),
            4 => f32::from_le_bytes([a, b, c, d]),
            _ => f64::from_le_bytes(bytes) as f32,
        }
    }

    /// Encodes `value` into the bytes `stored`, which must be [`Float::bytes`] many.
    pub(crate) fn encode(self, value: f32, stored: &mut [u8]) {
        match self.bytes {
            2 => stored.copy_from_slice(&f16::from_f32(value).to_le_bytes()),
            4 => stored.copy_from_slice(&value.to_le_bytes()),
            _ => stored.copy_from_slice(&f64::from(value).to_le_bytes()),
        }
        if self.big_endian {
            stored.reverse();
        }
    }
}

impl NpzArray {
    /// Returns the number of values of the array.
    pub(crate) fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Returns the byte offset, in the archive, of the first value; meaningless if the array is compressed.
    pub(crate) fn start(&self) -> usize {
        self.start
    }

    /// Returns whether the values are stored as little-endian f32, the last axis fastest.
    pub(crate) fn is_little_f32(&self) -> bool {
        self.float == Some(Float::F32)
    }
}

impl Npz {
    /// Opens the archive at `path` and reads the headers of its arrays.
    ///
    /// # Errors
    /// Fails if the file is not a zip archive or is cut short, if a header is malformed, or if values of an array are
    /// missing.
    pub(crate) fn open(path: &Path) -> Result<Npz> {
        let map = FileMap::open(path)?;
        let wrong = |place: String, found: String| {
            Error::input(path, place, "arrays as numpy.savez writes them", found)
                .hint("if the file was copied, copy it again: one that is cut short has lost its list of arrays")
        };
        let mut archive = open_zip(path)?.map_err(|found| wrong("list of arrays".into(), found))?;
        if archive.len() > MAX_ARRAYS {
            return Err(wrong("list of arrays".into(), format!("{} arrays", archive.len())));
        }
        let mut entries: Vec<NpzArray> = Vec::new();
        for index in 0..archive.len() {
            let mut file =
                archive.by_index(index).map_err(|error| wrong(format!("array {index}"), error.to_string()))?;
            let Some(name) = npyz::npz::array_name_from_file_name(file.name()).map(str::to_owned) else { continue };
            if entries.iter().any(|entry| entry.name == name) {
                return Err(wrong(name, "two arrays of this name".into()));
            }
            let entry = NpzArray::read(&mut file, index, name.clone()).map_err(|found| wrong(name.clone(), found))?;
            let bytes = entry.float.map(|float| entry.len() * float.bytes);
            if bytes.is_some_and(|bytes| (entry.header + bytes) as u64 != file.size())
                || entry.stored > map.len() as u64
                || file.size() > entry.stored.saturating_mul(MAX_DEFLATE_FACTOR).saturating_add(64)
                || !entry.is_compressed && entry.start as u64 + (file.size() - entry.header as u64) > map.len() as u64
            {
                return Err(wrong(name, {
                    let (shape, bytes) = (&entry.shape, file.size());
                    format!("{shape:?} values in {bytes} bytes")
                }));
            }
            entries.push(entry);
        }
        drop(archive);
        Ok(Npz { path: path.to_owned(), map: Arc::new(map), entries })
    }

    /// Returns the path of the archive.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the arrays in the order of the archive.
    pub(crate) fn entries(&self) -> &[NpzArray] {
        &self.entries
    }

    /// Returns the array called `name`; `None` if the archive has no such array.
    pub(crate) fn entry(&self, name: &str) -> Option<&NpzArray> {
        self.entries.iter().find(|entry| entry.name == name)
    }

    /// Checks the headers of the arrays called `names`, without decoding values:
    ///
    /// - Each array exists and holds floating-point numbers in C order (last axis fastest).
    /// - The decoded arrays together do not take more scratch space than the limit for this archive
    ///   ([`SCRATCH_PER_BYTE`]).
    ///
    /// # Errors
    /// Fails if one of these conditions does not hold; the message names the array.
    pub(crate) fn check_floats(&self, names: &[&str]) -> Result<()> {
        let most = BASE_SCRATCH_BYTES + SCRATCH_PER_BYTE * self.map.len() as u64;
        let mut decoded = 0u64;
        for name in names {
            let (entry, float) = self.float(name)?;
            if !entry.is_in_place(float) {
                decoded = decoded.saturating_add(4 * entry.len() as u64);
            }
            if decoded > most {
                let expected = format!("arrays of at most {most} bytes in an archive of {}", self.map.len());
                return Err(Error::input(&self.path, *name, expected, format!("{decoded} bytes up to this one"))
                    .hint("if the model is meant to hold so many equal values, save it with numpy.savez"));
            }
        }
        Ok(())
    }

    /// Returns the array called `name` and the type of its values. Fails if there is no such array, or if it does not
    /// hold floating-point numbers in C order.
    fn float(&self, name: &str) -> Result<(&NpzArray, Float)> {
        let Some(entry) = self.entry(name) else {
            let names: Vec<&str> = self.entries.iter().map(|entry| entry.name.as_str()).collect();
            return Err(Error::input(&self.path, name, "an array of this name", names.join(", ")));
        };
        let Some(float) = entry.float else {
            let found = format!("{}, another type or Fortran order", entry.descr);
            return Err(Error::input(&self.path, name, "float16, float32 or float64 in C order", found)
                .hint("save the array again as numpy.ascontiguousarray(array, dtype='float32')"));
        };
        Ok((entry, float))
    }

    /// Returns the values of the array called `name`. If they cannot be read directly from the mapped archive, decodes
    /// them into an unnamed file in the folder `scratch`. Reads all values once, to compare their checksum.
    ///
    /// # Errors
    /// Fails if the array is missing, holds no floating-point numbers in C order or cannot be decoded, if its checksum
    /// is wrong, or if the scratch file cannot be written.
    pub(crate) fn floats(&self, name: &str, scratch: &Path) -> Result<Floats> {
        let (entry, float) = self.float(name)?;
        if entry.is_in_place(float) {
            self.check_in_place(entry)?;
            return Ok(Floats { map: Arc::clone(&self.map), start: entry.start, len: entry.len() });
        }
        let file = tempfile::tempfile_in(scratch).map_err(Error::io("create a scratch file in", scratch))?;
        let failed = |error| Error::io("write a scratch file in", scratch)(error);
        let mut out = BufWriter::new(&file);
        let mut chunk = vec![0; entry.len().min(1 << 16) * float.bytes];
        let mut left = entry.len() * float.bytes;
        self.read(entry, |values| {
            while left > 0 {
                let chunk = &mut chunk[..left.min(1 << 16)];
                values.read_exact(chunk).map_err(|error| self.damaged(entry, &error))?;
                for stored in chunk.chunks_exact(float.bytes) {
                    let value = float.decode(stored).to_le_bytes();
                    out.write_all(&value).map_err(failed)?;
                }
                left -= chunk.len();
            }
            out.flush().map_err(failed)
        })?;
        drop(out);
        let map = FileMap::from_scratch(&file, 0..4 * entry.len() as u64, &self.path)?;
        Ok(Floats { map: Arc::new(map), start: 0, len: entry.len() })
    }

    /// Checks the checksum of the array `entry`, which must be uncompressed and of type f32. Fails if it is wrong.
    fn check_in_place(&self, entry: &NpzArray) -> Result<()> {
        self.map.check()?;
        let mut sum = Crc::new();
        let end = entry.start + 4 * entry.len();
        for from in (entry.start - entry.header..end).step_by(CHECKED_BYTES) {
            let range = from..end.min(from + CHECKED_BYTES);
            sum.update(&self.map[range.clone()]);
            self.map.touched(range);
        }
        check_checksum(&self.path, &entry.name, [entry.checksum, sum.sum()])
    }

    /// Calls `take` once, with a reader of the values of the array `entry` as bytes, decompressed and without the
    /// header.
    ///
    /// # Errors
    /// Fails if `take` fails, or if the file was cut short since it was opened. If `take` reads all values, also fails
    /// if their checksum is wrong; otherwise the checksum is not compared.
    pub(crate) fn read(&self, entry: &NpzArray, take: impl FnOnce(&mut dyn Read) -> Result<()>) -> Result<()> {
        self.map.check()?;
        let mut archive = open_zip(&self.path)?.map_err(|found| self.damaged(entry, &found))?;
        let file = archive.by_index(entry.index).map_err(|error| self.damaged(entry, &error))?;
        // `CrcReader` counts bytes modulo 2³².
        let size = file.size() as u32;
        let mut file = CrcReader::new(file);
        let mut header = vec![0; entry.header];
        file.read_exact(&mut header).map_err(|error| self.damaged(entry, &error))?;
        take(&mut file)?;
        match file.crc().amount() == size {
            true => check_checksum(&self.path, &entry.name, [entry.checksum, file.crc().sum()]),
            false => Ok(()),
        }
    }

    /// Builds the error that says that the values of `entry` are damaged.
    pub(crate) fn damaged(&self, entry: &NpzArray, error: &dyn std::fmt::Display) -> Error {
        Error::input(&self.path, &entry.name, "the values as they were written", error.to_string())
    }
}

/// Opens the zip archive at `path`. Returns one of three results:
///
/// - `Err`: the file cannot be opened.
/// - `Ok(Err(found))`: the file is no valid zip archive; `found` says what is wrong.
/// - `Ok(Ok(archive))`: the open archive.
fn open_zip(path: &Path) -> Result<std::result::Result<ZipArchive<BufReader<File>>, String>> {
    let mut file = open_file(path)?;
    let directory = match declared_directory(&mut file) {
        Ok(directory) => directory,
        Err(error) => return Ok(Err(error.to_string())),
    };
    if directory.entries > MAX_ARRAYS as u64 || directory.bytes > MAX_LIST {
        let DeclaredDirectory { entries, bytes } = directory;
        return Ok(Err(format!(
            "{entries} files in a list of {bytes} bytes, more than the limits of {MAX_ARRAYS} files and {MAX_LIST} bytes"
        )));
    }
    Ok(ZipArchive::new(BufReader::new(file)).map_err(|error| error.to_string()))
}

impl NpzArray {
    /// Returns whether the values of this array can be read directly from the mapped archive: they are not compressed,
    /// and their type `float` is little-endian f32.
    fn is_in_place(&self, float: Float) -> bool {
        !self.is_compressed && float == Float::F32
    }

    /// Reads the header of the array `name` in `file`, the file of the archive with index `index`. The error text
    /// describes what was found instead of a header.
    fn read(file: &mut ZipFile<'_>, index: usize, name: String) -> std::result::Result<NpzArray, String> {
        let is_compressed = file.compression() != zip::CompressionMethod::Stored;
        let start = file.data_start();
        let mut text = Vec::new();
        file.by_ref().take(HEAD).read_to_end(&mut text).map_err(|error| error.to_string())?;
        if !header_is_sound(&text, file.size()) {
            return Err("a header that no array of numbers has".into());
        }
        let mut rest = &text[..];
        let header = NpyHeader::from_reader(&mut rest).map_err(|error| error.to_string())?;
        let before = text.len() - rest.len();
        Ok(NpzArray {
            name,
            shape: header.shape().iter().map(|&length| length as usize).collect(),
            float: Float::from_header(&header),
            descr: header.dtype().descr(),
            is_fortran: header.order() == Order::Fortran,
            is_compressed,
            stored: file.compressed_size(),
            checksum: file.crc32(),
            index,
            header: before,
            start: start as usize + before,
        })
    }
}

/// Values of one array as f32, in the order in which the array stores them: `len` values from byte `start` on in a
/// memory-mapped file. This file is the archive itself or a scratch file with the decoded values.
#[derive(Debug, Clone)]
pub(crate) struct Floats {
    map: Arc<FileMap>,
    start: usize,
    len: usize,
}

impl Floats {
    /// Checks that the mapped file has not been cut short. Readers call this before they read each block.
    pub(crate) fn check(&self) -> Result<()> {
        self.map.check()
    }

    /// Records that the values with the indices `range` were read, so that their pages can be released from memory.
    pub(crate) fn touched(&self, range: Range<usize>) {
        self.map.touched(self.start + 4 * range.start..self.start + 4 * range.end);
    }

    /// Returns `W` values starting at index `first`.
    ///
    /// # Panics
    /// Panics if fewer than `W` values follow.
    pub(crate) fn row<const W: usize>(&self, first: usize) -> [f32; W] {
        assert!(first + W <= self.len, "values {first} to {} of {}", first + W, self.len);
        let (stored, _) = self.map[self.start + 4 * first..][..4 * W].as_chunks::<4>();
        std::array::from_fn(|c| f32::from_le_bytes(stored[c]))
    }
}
