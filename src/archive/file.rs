//! File layout of an archive: a header with lengths and checksums, and four sections.
//!
//! Input: the contents of the sections. Output: the bytes of the file, and back. Everything read from a file is checked
//! before it is used: lengths against the length of the file, checksums against the bytes, and sizes to allocate
//! against both the length of the file and the memory limit.

use std::path::Path;

use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::xxh3_64;

use crate::error::{Error, Result};
use crate::limits::ReadLimit;

/// First bytes of an archive. Their line ends reveal a file that was transferred as text.
pub const MAGIC: [u8; 8] = *b"\x89GSZ\r\n\x1a\n";
/// Format version that is written, and the only version that can be read.
pub const VERSION: u16 = 2;

/// Number of sections of an archive.
const SECTIONS: usize = 4;
/// Names of the sections in error messages.
const NAMES: [&str; SECTIONS] = ["table", "cloud", "field", "blobs"];
/// Length of the header in bytes: magic, version and two zero bytes; for each section its length in the file, the
/// length of its content and a checksum; checksum of the header.
pub const HEADER_BYTES: usize = 12 + SECTIONS * 24 + 8;
/// Compression level of zstd for the table of contents and the plain bytes (`blobs`), which are small sections.
const ZSTD_LEVEL: i32 = 19;
/// Maximum number of bytes of decoded content per byte of the file. The contents of trained models are 20 to 60 times
/// as large as their archives. In a malicious file, one bit of symbols could stand for about 800 bytes of content, and
/// texels that are not stored could add any amount. This limit prevents a file of 300 KB from taking gigabytes.
const MAX_CONTENT_PER_BYTE: u64 = 512;
/// Number of bytes that may be allocated for decoding any archive, however short its file is.
const ALWAYS_ALLOWED_BYTES: u64 = 64 << 20;

/// Maximum length in bytes of the table of contents. The table of a trained model has about 50 KB. In memory, a parsed
/// table takes up to 16 times as many bytes.
const MAX_TABLE_BYTES: u64 = 1 << 20;

/// Contents of the four sections, before compression.
#[derive(Debug, PartialEq)]
pub(super) struct Sections {
    /// Table of contents, in JSON.
    pub(super) table: Vec<u8>,
    /// Entropy-coded symbols of the Gaussians.
    pub(super) cloud: Vec<u8>,
    /// Entropy-coded symbols of the deformation field.
    pub(super) field: Vec<u8>,
    /// Bytes stored without entropy coding: exact tensors, extra bytes of the Gaussians, and copied files.
    pub(super) blobs: Vec<u8>,
}

/// Size of an archive in bytes, divided by purpose.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ArchiveSize {
    /// Number of bytes that the Gaussians take.
    pub cloud: u64,
    /// Number of bytes that the deformation field takes.
    pub field: u64,
    /// Number of bytes that hold neither Gaussians nor deformation field: header, table of contents, and bytes without
    /// entropy coding (`blobs`).
    pub rest: u64,
}

impl ArchiveSize {
    /// Returns the size of an archive of `total` bytes, divided by purpose: `cloud` bytes for Gaussians, `field` bytes
    /// for the deformation field, and the remaining bytes for everything else.
    fn new(total: u64, cloud: u64, field: u64) -> ArchiveSize {
        ArchiveSize { cloud, field, rest: total - cloud - field }
    }

    /// Returns the same size for an archive without tensors: the bytes of its empty section for the deformation field
    /// count as other bytes.
    pub(super) fn without_field(self) -> ArchiveSize {
        ArchiveSize { field: 0, rest: self.rest + self.field, ..self }
    }

    /// Returns the size of the whole archive in bytes.
    pub fn total(&self) -> u64 {
        self.cloud + self.field + self.rest
    }
}

/// Advice to the user for an archive of another version.
const WRITE_AGAIN: &str = "write the archive again from its model with this version of splatsieve, or open it with the \
                           version that wrote it";

/// Returns the error for a damaged part `place`, such as a section, of the archive at `path`. `expected` and `found`
/// describe the expected content and the content found.
pub(super) fn damage(path: &Path, place: &str, expected: impl Into<String>, found: impl Into<String>) -> Error {
    Error::input(path, place, expected, found).hint("the archive is damaged or cut short; copy it again")
}

/// Returns the bytes of an archive with the contents `sections`, and its size by purpose.
///
/// # Errors
/// Fails if the compression of a section fails, or if the table of contents is longer than a reader accepts.
pub(super) fn write(sections: &Sections) -> Result<(Vec<u8>, ArchiveSize)> {
    if sections.table.len() as u64 > MAX_TABLE_BYTES {
        return Err(Error::usage(format!(
            "the table of an archive has at most {MAX_TABLE_BYTES} bytes; that of this model has {}\n  write a .gseq of \
             its frames",
            sections.table.len()
        )));
    }
    let pack = |bytes: &[u8]| {
        zstd::bulk::compress(bytes, ZSTD_LEVEL)
            .map_err(|error| Error::internal(format!("cannot compress an archive: {error}")))
    };
    let (table, blobs) = (pack(&sections.table)?, pack(&sections.blobs)?);
    let stored = [&table, &sections.cloud, &sections.field, &blobs];
    let lengths = [sections.table.len(), sections.cloud.len(), sections.field.len(), sections.blobs.len()];
    let mut out = Vec::with_capacity(HEADER_BYTES + stored.iter().map(|bytes| bytes.len()).sum::<usize>());
    out.extend(MAGIC);
    out.extend(VERSION.to_le_bytes());
    out.extend([0; 2]);
    for (bytes, length) in stored.iter().zip(lengths) {
        out.extend((bytes.len() as u64).to_le_bytes());
        out.extend((length as u64).to_le_bytes());
        out.extend(xxh3_64(bytes).to_le_bytes());
    }
    out.extend(xxh3_64(&out).to_le_bytes());
    stored.iter().for_each(|bytes| out.extend_from_slice(bytes));
    let parts = ArchiveSize::new(out.len() as u64, sections.cloud.len() as u64, sections.field.len() as u64);
    Ok((out, parts))
}

/// Header of an archive file: its lengths and checksums.
pub(super) struct ArchiveHeader {
    /// Length of the whole file in bytes.
    whole: u64,
    /// For each section: number of bytes in the file, number of bytes of content, and checksum of the bytes in the
    /// file.
    sections: [[u64; 3]; SECTIONS],
}

impl ArchiveHeader {
    /// Parses the header of the file at `path`, which has `whole` bytes. `head` holds the first
    /// [`HEADER_BYTES`] bytes of the file or more, or the whole file if it is shorter.
    pub(super) fn parse(path: &Path, head: &[u8], whole: u64) -> Result<ArchiveHeader> {
        if !head.starts_with(&MAGIC) {
            let first = head.get(..8.min(head.len())).unwrap_or_default();
            return Err(damage(path, "byte 0", "the first bytes of an archive (.gsz)", format!("{first:02x?}")));
        }
        let version = head[MAGIC.len()..].first_chunk().map(|&bytes| u16::from_le_bytes(bytes));
        if let Some(found) = version.filter(|&version| version != VERSION) {
            let found = format!("version {found}, of another version of splatsieve");
            return Err(Error::input(path, "byte 8", format!("version {VERSION}"), found).hint(WRITE_AGAIN));
        }
        let Some(head) = head.get(..HEADER_BYTES) else {
            return Err(damage(path, "head", format!("{HEADER_BYTES} bytes"), format!("{whole} bytes")));
        };
        let number = |at: usize| head[at..at + 8].iter().rev().fold(0u64, |sum, &byte| sum << 8 | u64::from(byte));
        if number(HEADER_BYTES - 8) != xxh3_64(&head[..HEADER_BYTES - 8]) {
            return Err(damage(path, "head", "its checksum", "another"));
        }
        let sections = std::array::from_fn(|k| [0, 8, 16].map(|field| number(12 + 24 * k + field)));
        let mut rest = whole.saturating_sub(HEADER_BYTES as u64);
        for ([stored, content, _], name) in sections.into_iter().zip(NAMES) {
            let place = format!("section {name}");
            let Some(after) = rest.checked_sub(stored) else {
                return Err(damage(path, &place, format!("{stored} bytes"), format!("{rest} bytes")));
            };
            check_size(path, usize::try_from(content).ok(), whole)?;
            rest = after;
        }
        if rest != 0 {
            return Err(damage(path, "end", "nothing after the last section", format!("{rest} bytes")));
        }
        let table = sections[0][1];
        if table > MAX_TABLE_BYTES {
            let expected = format!("at most {MAX_TABLE_BYTES} bytes of content");
            return Err(damage(path, "section table", expected, format!("{table} bytes")));
        }
        Ok(ArchiveHeader { whole, sections })
    }

    /// Returns the number of bytes of memory that decoding takes, estimated from the header alone. It is the sum of:
    /// - twice the length of the file
    /// - twice the length of the plain bytes (section `blobs`): once decompressed, once copied into the decoded content
    /// - 16 times the length of the table of contents
    pub(super) fn bytes(&self) -> u64 {
        let [[_, table, _], .., [_, blobs, _]] = self.sections;
        2 * self.whole + 16 * table + 2 * blobs
    }

    /// Checks that the archive at `path` can be decoded within the memory limit `memory`. Fails otherwise.
    pub(super) fn check_memory(&self, path: &Path, memory: ReadLimit) -> Result<()> {
        memory.check(path, "head", "the archive and its content", self.bytes())
    }
}

/// Returns the sections of the archive `bytes`, which was read from `path`, decompressed, and its size by purpose. `head`
/// is its parsed header. Fails if a checksum or a length is wrong.
pub(super) fn read(path: &Path, head: &ArchiveHeader, bytes: &[u8]) -> Result<(Sections, ArchiveSize)> {
    let mut rest = &bytes[HEADER_BYTES..];
    let mut sections: [&[u8]; SECTIONS] = [&[]; SECTIONS];
    for (k, name) in NAMES.iter().enumerate() {
        let [stored, _, checksum] = head.sections[k];
        // The header was parsed with the length of `bytes`, so this fails only if `bytes` changed.
        let Some((own, after)) = rest.split_at_checked(stored as usize) else {
            return Err(damage(path, name, format!("{stored} bytes"), format!("{} bytes", rest.len())));
        };
        if xxh3_64(own) != checksum {
            return Err(damage(path, &format!("section {name}"), "its checksum", "another"));
        }
        (sections[k], rest) = (own, after);
    }
    let unpack = |k: usize| {
        let place = format!("section {}", NAMES[k]);
        let length = head.sections[k][1] as usize;
        let wrong = |found: String| damage(path, &place, format!("{length} bytes of content"), found);
        let content = zstd::bulk::decompress(sections[k], length).map_err(|error| wrong(error.to_string()))?;
        if content.len() == length { Ok(content) } else { Err(wrong(content.len().to_string())) }
    };
    let [_, cloud, field, _] = sections;
    let parts = ArchiveSize::new(bytes.len() as u64, cloud.len() as u64, field.len() as u64);
    let content = Sections { table: unpack(0)?, cloud: cloud.to_vec(), field: field.to_vec(), blobs: unpack(3)? };
    Ok((content, parts))
}

/// Checks that `bytes`, the size of the decoded content of the archive at `path`, is not suspiciously large for a file
/// of `length` bytes. Fails if it exceeds 64 MiB plus 512 bytes per byte of the file. `None` stands for a
/// number that overflowed and fails as well.
pub(super) fn check_size(path: &Path, bytes: Option<usize>, length: u64) -> Result<()> {
    let most = length.saturating_mul(MAX_CONTENT_PER_BYTE).saturating_add(ALWAYS_ALLOWED_BYTES);
    match bytes.map(|bytes| bytes as u64) {
        Some(bytes) if bytes <= most => Ok(()),
        bytes => {
            let found = bytes.map_or("a number that overflows".to_owned(), |bytes| bytes.to_string());
            Err(damage(path, "table", format!("at most {most} bytes of content in {length}"), found))
        }
    }
}
