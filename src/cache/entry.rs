//! File format of cache entries (stored results of stages).
//!
//! Layout, all numbers little-endian:
//!
//! | bytes | content |
//! |---|---|
//! | 8 | `SPLSPIEC` |
//! | 4 | version, 1 |
//! | 4 | length of the text |
//! | 8 | length of the content |
//! | 8 | XXH3-64 of text and content |
//! | 16 | key |
//! | ... | text: description of the input that the entry belongs to, UTF-8; empty in a scratch file |
//! | ... | content |
//!
//! File name: `<stage>.<key, 32 hexadecimal digits>.piece`; for a shard `<stage>.<key>.<i>-of-<n>.piece`.

use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;

use serde::de::DeserializeOwned;
use xxhash_rust::xxh3::Xxh3;

use super::key::CacheKey;
use crate::cache::shard::Shard;
use crate::error::{Error, Result};
use crate::files::digest::hash_rest;

const MAGIC: [u8; 8] = *b"SPLSPIEC";
const VERSION: u32 = 1;
/// Number of bytes of the header, which precedes the text (description of the input).
const HEADER: usize = 48;
/// Extension of the file names of cache entries.
pub(super) const EXTENSION: &str = ".piece";
/// Maximum size, in bytes, of the buffer that holds the strings of a cache entry while its value is deserialized.
const MAX_STRING_BYTES: u64 = 8 << 20;

/// Parts of the file name of a cache entry.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct EntryName {
    pub(super) stage: String,
    /// Cache key of the result as 32 hexadecimal digits.
    pub(super) key: String,
    /// Index of the shard (part of a divided stage), from 1, and number of shards; (1, 1) is the full result.
    pub(super) part: (usize, usize),
}

impl EntryName {
    pub(super) fn new(stage: &str, key: CacheKey, part: Shard) -> EntryName {
        EntryName { stage: stage.to_owned(), key: key.text(), part: part.numbers() }
    }

    pub(super) fn file(&self) -> String {
        let EntryName { stage, key, part } = self;
        match part {
            (_, 1) => format!("{stage}.{key}{EXTENSION}"),
            (index, of) => format!("{stage}.{key}.{index}-of-{of}{EXTENSION}"),
        }
    }

    /// Parses the file name of a cache entry; returns `None` for the names of other files.
    pub(super) fn parse(file: &str) -> Option<EntryName> {
        let mut fields = file.strip_suffix(EXTENSION)?.split('.');
        let (stage, key, part) = (fields.next()?, fields.next()?, fields.next());
        let part = match part {
            None => (1, 1),
            Some(part) => {
                let (index, of) = part.split_once("-of-")?;
                (index.parse().ok()?, of.parse().ok()?)
            }
        };
        let name = EntryName { stage: stage.to_owned(), key: key.to_owned(), part };
        // Accept only names that `EntryName::file` produces.
        (fields.next().is_none() && key.len() == 32 && name.file() == file).then_some(name)
    }
}

/// Returns the parsed file names of all cache entries in `folder`, sorted.
pub(super) fn names(folder: &Path) -> Result<Vec<EntryName>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).map_err(Error::io("read the cache folder", folder))? {
        let entry = entry.map_err(Error::io("read the cache folder", folder))?;
        found.extend(entry.file_name().to_str().and_then(EntryName::parse));
    }
    found.sort();
    Ok(found)
}

/// Writer of the file of a cache entry. Its header is written last.
pub(super) struct EntryWriter {
    file: BufWriter<File>,
    key: u128,
    text: u32,
    length: u64,
    hash: Box<Xxh3>,
    /// Error of the last failed write. The serializer returns another error instead, which does not name the cause, so
    /// the writer keeps the error here.
    pub(super) failed: Option<io::Error>,
}

impl EntryWriter {
    /// Begins the file with an empty header and the text `about`, which describes the input. `key` is the cache key of
    /// the entry.
    pub(super) fn new(file: File, key: u128, about: &str) -> io::Result<EntryWriter> {
        let mut writer = EntryWriter {
            file: BufWriter::new(file),
            key,
            text: about.len() as u32,
            length: 0,
            hash: Box::new(Xxh3::new()),
            failed: None,
        };
        writer.file.write_all(&[0; HEADER])?;
        writer.write_all(about.as_bytes())?;
        writer.length = 0;
        Ok(writer)
    }

    /// Returns the byte offset in the file at which the content begins.
    pub(super) fn start(&self) -> u64 {
        HEADER as u64 + u64::from(self.text)
    }

    /// Writes the header with the final lengths and hash. Returns the file, which is open for reading.
    pub(super) fn finish(self) -> io::Result<File> {
        let mut header = Vec::with_capacity(HEADER);
        header.extend_from_slice(&MAGIC);
        header.extend_from_slice(&VERSION.to_le_bytes());
        header.extend_from_slice(&self.text.to_le_bytes());
        header.extend_from_slice(&self.length.to_le_bytes());
        header.extend_from_slice(&self.hash.digest().to_le_bytes());
        header.extend_from_slice(&self.key.to_le_bytes());
        let mut file = self.file.into_inner().map_err(io::IntoInnerError::into_error)?;
        file.seek(SeekFrom::Start(0))?;
        file.write_all(&header)?;
        Ok(file)
    }
}

impl Write for EntryWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.file.write(bytes).inspect_err(|error| self.failed = Some(copied_error(error)))?;
        self.hash.update(&bytes[..written]);
        self.length += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush().inspect_err(|error| self.failed = Some(copied_error(error)))
    }
}

/// Returns a new error with the code or text of `error`, because [`io::Error`] cannot be cloned.
fn copied_error(error: &io::Error) -> io::Error {
    error.raw_os_error().map_or_else(|| io::Error::new(error.kind(), error.to_string()), io::Error::from_raw_os_error)
}

/// Cache entry whose bytes have been verified, open for reading.
pub(super) struct CacheEntry {
    file: File,
    about: String,
    start: u64,
    length: u64,
}

/// Numbers in the header of a cache entry: lengths in bytes of text and content, hash, and cache key.
struct EntryHeader {
    text: u64,
    content: u64,
    hash: u64,
    key: u128,
}

impl EntryHeader {
    fn from_bytes(bytes: &[u8; HEADER]) -> std::result::Result<EntryHeader, String> {
        let number = |start: usize, length: usize| {
            bytes[start..start + length].iter().rev().fold(0u128, |number, &byte| number << 8 | u128::from(byte))
        };
        if bytes[..8] != MAGIC {
            return Err("it is not a result of this program".to_owned());
        }
        if number(8, 4) != u128::from(VERSION) {
            return Err(format!("version {}, expected {VERSION}", number(8, 4)));
        }
        let [text, content, hash] = [(12, 4), (16, 8), (24, 8)].map(|(start, length)| number(start, length) as u64);
        Ok(EntryHeader { text, content, hash, key: number(32, 16) })
    }
}

impl CacheEntry {
    /// Opens the cache entry at `path` and verifies the hash of all its bytes. Fails if the file cannot be read. If it
    /// is damaged or its key is not `key`, returns `Ok(Err(reason))`.
    ///
    /// Reads the file without a memory map, which for a large entry would count as memory of this process.
    pub(super) fn open(path: &Path, key: &str) -> Result<std::result::Result<CacheEntry, String>> {
        let failed = |error| Error::io("read", path)(error);
        let mut file = File::open(path).map_err(Error::io("open", path))?;
        let length = file.metadata().map_err(failed)?.len();
        if length < HEADER as u64 {
            return Ok(Err(format!("{length} bytes, expected at least {HEADER}")));
        }
        let mut bytes = [0; HEADER];
        file.read_exact(&mut bytes).map_err(failed)?;
        let EntryHeader { text, content, hash, key: own } = match EntryHeader::from_bytes(&bytes) {
            Ok(header) => header,
            Err(why) => return Ok(Err(why)),
        };
        let start = HEADER as u64 + text;
        if u128::from(start) + u128::from(content) != u128::from(length) {
            return Ok(Err(format!("{length} bytes, expected {}", u128::from(start) + u128::from(content))));
        }
        if key != format!("{own:032x}") {
            return Ok(Err("its key does not match its file name".to_owned()));
        }
        let mut found = Xxh3::new();
        hash_rest(&mut file, path, &mut found)?;
        if found.digest() != hash {
            return Ok(Err("its checksum does not match".to_owned()));
        }
        let mut about = vec![0; text as usize];
        file.seek(SeekFrom::Start(HEADER as u64)).and_then(|_| file.read_exact(&mut about)).map_err(failed)?;
        let about = String::from_utf8_lossy(&about).into_owned();
        Ok(Ok(CacheEntry { file, about, start, length: content }))
    }

    /// Returns the file, and the byte offset in it at which the content begins.
    pub(super) fn into_file(self) -> (File, u64) {
        (self.file, self.start)
    }

    /// Deserializes the content of the entry as a value.
    pub(super) fn value<T: DeserializeOwned>(self) -> postcard::Result<T> {
        // Buffer into which the deserializer reads strings one after the other.
        let mut string_buffer = vec![0; self.length.min(MAX_STRING_BYTES) as usize];
        postcard::from_io((BufReader::new(self.file), &mut string_buffer)).map(|(value, _)| value)
    }

    /// Returns the description of the input to which the entry belongs.
    pub(super) fn about(&self) -> &str {
        &self.about
    }
}
