//! The file of an archive: a head with lengths and checksums, and four sections.
//!
//! In: sections. Out: bytes, and back. All that is believed of a file has been checked before: lengths against the file,
//! checksums against the bytes, what is to be allocated against the file's length and the memory that reading may take.

use std::path::Path;

use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::xxh3_64;

use crate::error::{Error, Result};
use crate::limits::ReadLimit;

/// How an archive begins; the line ends show when a file was sent as text.
pub const MAGIC: [u8; 8] = *b"\x89GSZ\r\n\x1a\n";
/// The version that is written, and the only one that is read.
pub const VERSION: u16 = 1;

const SECTIONS: usize = 4;
const NAMES: [&str; SECTIONS] = ["table", "cloud", "field", "blobs"];
/// Magic, version, two zero bytes; of each section its length in the file, that of its content and a checksum; their own.
pub const HEAD: usize = 12 + SECTIONS * 24 + 8;
/// Level of zstd for what is small.
const LEVEL: i32 = 19;
/// Bytes of content that a byte of the file may stand for. Those of trained models are 20 to 60 times as large as their
/// archives. Symbols could stand for 800 bytes each, and unread texels for any number, but a file of 300 KB must not cost
/// gigabytes.
const MOST_PER_BYTE: u64 = 512;
/// What may be allocated whatever the file's length.
const ALWAYS: u64 = 64 << 20;

/// Largest table. Those of trained models have some 50 KB. The values read from it take up to 16 times its bytes.
const MOST_TABLE: u64 = 1 << 20;

/// The contents of the sections.
#[derive(Debug, PartialEq)]
pub(super) struct Sections {
    /// JSON.
    pub(super) table: Vec<u8>,
    /// Symbols.
    pub(super) cloud: Vec<u8>,
    /// Symbols.
    pub(super) field: Vec<u8>,
    /// Bytes as they are.
    pub(super) blobs: Vec<u8>,
}

/// Bytes of an archive, and of its parts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ArchiveSize {
    /// The cloud.
    pub cloud: u64,
    /// The deformation field.
    pub field: u64,
    /// All else.
    pub rest: u64,
}

impl ArchiveSize {
    fn new(total: u64, cloud: u64, field: u64) -> ArchiveSize {
        ArchiveSize { cloud, field, rest: total - cloud - field }
    }

    /// All of them.
    pub fn total(&self) -> u64 {
        self.cloud + self.field + self.rest
    }
}

/// What is wrong with an archive.
#[derive(Debug)]
pub(super) struct Damage {
    place: String,
    expected: String,
    found: String,
}

impl Damage {
    pub(super) fn new(place: &str, expected: impl Into<String>, found: impl Into<String>) -> Damage {
        Damage { place: place.to_owned(), expected: expected.into(), found: found.into() }
    }

    pub(super) fn in_file(self, path: &Path) -> Error {
        Error::input(path, self.place, self.expected, self.found)
            .hint("the archive is damaged or cut short; copy it again")
    }
}

/// The bytes of an archive and of its parts.
pub(super) fn write(sections: &Sections) -> Result<(Vec<u8>, ArchiveSize)> {
    let pack = |bytes: &[u8]| {
        zstd::bulk::compress(bytes, LEVEL)
            .map_err(|error| Error::internal(format!("cannot compress an archive: {error}")))
    };
    let (table, blobs) = (pack(&sections.table)?, pack(&sections.blobs)?);
    let stored = [&table, &sections.cloud, &sections.field, &blobs];
    let lengths = [sections.table.len(), sections.cloud.len(), sections.field.len(), sections.blobs.len()];
    let mut out = Vec::with_capacity(HEAD + stored.iter().map(|bytes| bytes.len()).sum::<usize>());
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

/// The head of an archive.
pub(super) struct ArchiveHeader {
    /// Bytes of the whole file.
    whole: u64,
    /// Of each section: bytes in the file, bytes of content, checksum of the bytes in the file.
    sections: [[u64; 3]; SECTIONS],
}

impl ArchiveHeader {
    /// Parses the first bytes of a file of `whole` bytes, at least [`HEAD`] of them if the file has so many.
    pub(super) fn parse(head: &[u8], whole: u64) -> std::result::Result<ArchiveHeader, Damage> {
        if !head.starts_with(&MAGIC) {
            let first = head.get(..8.min(head.len())).unwrap_or_default();
            return Err(Damage::new("byte 0", "the first bytes of an archive (.gsz)", format!("{first:02x?}")));
        }
        let version = head[MAGIC.len()..].first_chunk().map(|&bytes| u16::from_le_bytes(bytes));
        if let Some(found) = version.filter(|&version| version != VERSION) {
            return Err(Damage::new(
                "byte 8",
                format!("version {VERSION}"),
                format!("version {found}: another splatsieve's"),
            ));
        }
        let Some(head) = head.get(..HEAD) else {
            return Err(Damage::new("head", format!("{HEAD} bytes"), format!("{whole} bytes")));
        };
        let number = |at: usize| head[at..at + 8].iter().rev().fold(0u64, |sum, &byte| sum << 8 | u64::from(byte));
        if number(HEAD - 8) != xxh3_64(&head[..HEAD - 8]) {
            return Err(Damage::new("head", "its checksum", "another"));
        }
        let sections = std::array::from_fn(|k| [0, 8, 16].map(|field| number(12 + 24 * k + field)));
        let mut rest = whole.saturating_sub(HEAD as u64);
        for ([stored, content, _], name) in sections.into_iter().zip(NAMES) {
            let place = format!("section {name}");
            let Some(after) = rest.checked_sub(stored) else {
                return Err(Damage::new(&place, format!("{stored} bytes"), format!("{rest} bytes")));
            };
            check_size(usize::try_from(content).ok(), whole)?;
            rest = after;
        }
        if rest != 0 {
            return Err(Damage::new("end", "nothing after the last section", format!("{rest} bytes")));
        }
        let table = sections[0][1];
        if table > MOST_TABLE {
            let expected = format!("at most {MOST_TABLE} bytes of content");
            return Err(Damage::new("section table", expected, format!("{table} bytes")));
        }
        Ok(ArchiveHeader { whole, sections })
    }

    /// Bytes that the file and the contents of its sections take in memory, each twice: as a whole and in parts.
    pub(super) fn bytes(&self) -> u64 {
        let [[_, table, _], .., [_, blobs, _]] = self.sections;
        2 * self.whole + 16 * table + 2 * blobs
    }

    /// Confirms that reading the archive at `path` keeps within `memory`.
    pub(super) fn admit(&self, path: &Path, memory: ReadLimit) -> Result<()> {
        memory.check(path, "head", "the archive and its content", self.bytes())
    }
}

/// The sections of an archive with head `head`, each with its checksum right, and the sizes of its parts.
pub(super) fn read(head: &ArchiveHeader, bytes: &[u8]) -> std::result::Result<(Sections, ArchiveSize), Damage> {
    let mut rest = &bytes[HEAD..];
    let mut sections: [&[u8]; SECTIONS] = [&[]; SECTIONS];
    for (k, name) in NAMES.iter().enumerate() {
        let [stored, _, checksum] = head.sections[k];
        // The head was parsed with the length of `bytes`.
        let Some((own, after)) = rest.split_at_checked(stored as usize) else {
            return Err(Damage::new(name, format!("{stored} bytes"), format!("{} bytes", rest.len())));
        };
        if xxh3_64(own) != checksum {
            return Err(Damage::new(&format!("section {name}"), "its checksum", "another"));
        }
        (sections[k], rest) = (own, after);
    }
    let unpack = |k: usize| {
        let place = format!("section {}", NAMES[k]);
        let length = head.sections[k][1] as usize;
        let wrong = |found: String| Damage::new(&place, format!("{length} bytes of content"), found);
        let content = zstd::bulk::decompress(sections[k], length).map_err(|error| wrong(error.to_string()))?;
        if content.len() == length { Ok(content) } else { Err(wrong(content.len().to_string())) }
    };
    let [_, cloud, field, _] = sections;
    let parts = ArchiveSize::new(bytes.len() as u64, cloud.len() as u64, field.len() as u64);
    let content = Sections { table: unpack(0)?, cloud: cloud.to_vec(), field: field.to_vec(), blobs: unpack(3)? };
    Ok((content, parts))
}

/// Confirms that so many bytes may be allocated for a file of `length`; none: they have no number.
pub(super) fn check_size(bytes: Option<usize>, length: u64) -> std::result::Result<(), Damage> {
    let most = length.saturating_mul(MOST_PER_BYTE).saturating_add(ALWAYS);
    match bytes.map(|bytes| bytes as u64) {
        Some(bytes) if bytes <= most => Ok(()),
        bytes => {
            let found = bytes.map_or("more than there are".to_owned(), |bytes| bytes.to_string());
            Err(Damage::new("table", format!("at most {most} bytes of content in {length}"), found))
        }
    }
}
