//! The file of an archive: a head with lengths and checksums, and four sections.
//!
//! In: sections. Out: bytes, and back. All that is believed of a file has been checked before: lengths against the file,
//! checksums against the bytes, what is to be allocated against the file's length.

use std::path::Path;

use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::xxh3_64;

use crate::error::{Error, Result};

/// How an archive begins; the line ends show when a file was sent as text.
pub const MAGIC: [u8; 8] = *b"\x89GSZ\r\n\x1a\n";
/// The version that is written, and the only one that is read.
pub const VERSION: u16 = 1;

const SECTIONS: usize = 4;
const NAMES: [&str; SECTIONS] = ["table", "cloud", "field", "blobs"];
/// Magic, version, two zero bytes; of each section its length in the file, that of its content and a checksum; their own.
const HEAD: usize = 12 + SECTIONS * 24 + 8;
/// Level of zstd for what is small.
const LEVEL: i32 = 19;
/// Values' bytes that a byte may stand for: symbols take at least 1/200 of a bit each, and what nobody reads none.
const MOST_PER_BYTE: u64 = 8192;
/// What may be allocated whatever the file's length.
const ALWAYS: u64 = 64 << 20;

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
pub struct Parts {
    /// The cloud.
    pub cloud: u64,
    /// The deformation field.
    pub field: u64,
    /// All else.
    pub rest: u64,
}

impl Parts {
    fn of(total: u64, cloud: u64, field: u64) -> Parts {
        Parts { cloud, field, rest: total - cloud - field }
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

    pub(super) fn of(self, path: &Path) -> Error {
        Error::input(path, self.place, self.expected, self.found)
            .hint("the archive is damaged or cut short; copy it again")
    }
}

/// The bytes of an archive and of its parts.
pub(super) fn write(sections: &Sections) -> Result<(Vec<u8>, Parts)> {
    let pack = |bytes: &[u8]| {
        zstd::bulk::compress(bytes, LEVEL).map_err(|error| Error::usage(format!("cannot compress an archive: {error}")))
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
    let parts = Parts::of(out.len() as u64, sections.cloud.len() as u64, sections.field.len() as u64);
    Ok((out, parts))
}

/// The sections of an archive, each with its checksum right, and the sizes of its parts.
pub(super) fn read(bytes: &[u8]) -> std::result::Result<(Sections, Parts), Damage> {
    if !bytes.starts_with(&MAGIC) {
        let head = bytes.get(..8.min(bytes.len())).unwrap_or_default();
        return Err(Damage::new("byte 0", "the first bytes of an archive (.gsz)", format!("{head:02x?}")));
    }
    let version = bytes[MAGIC.len()..].first_chunk().map(|&bytes| u16::from_le_bytes(bytes));
    if let Some(found) = version.filter(|&version| version != VERSION) {
        return Err(Damage::new(
            "byte 8",
            format!("version {VERSION}"),
            format!("version {found}: another splatsieve's"),
        ));
    }
    let Some((head, mut rest)) = bytes.split_at_checked(HEAD) else {
        return Err(Damage::new("head", format!("{HEAD} bytes"), format!("{} bytes", bytes.len())));
    };
    let number = |at: usize| head[at..at + 8].iter().rev().fold(0u64, |sum, &byte| sum << 8 | u64::from(byte));
    if number(HEAD - 8) != xxh3_64(&head[..HEAD - 8]) {
        return Err(Damage::new("head", "its checksum", "another"));
    }
    let mut sections: [&[u8]; SECTIONS] = [&[]; SECTIONS];
    let mut lengths = [0; SECTIONS];
    for (k, name) in NAMES.iter().enumerate() {
        let at = 12 + 24 * k;
        let (stored, content) = (number(at), number(at + 8));
        let place = format!("section {name}");
        let Some((own, after)) = usize::try_from(stored).ok().and_then(|stored| rest.split_at_checked(stored)) else {
            return Err(Damage::new(&place, format!("{stored} bytes"), format!("{} bytes", rest.len())));
        };
        if xxh3_64(own) != number(at + 16) {
            return Err(Damage::new(&place, "its checksum", "another"));
        }
        check_size(usize::try_from(content).ok(), bytes.len())?;
        (sections[k], lengths[k], rest) = (own, content as usize, after);
    }
    if !rest.is_empty() {
        return Err(Damage::new("end", "nothing after the last section", format!("{} bytes", rest.len())));
    }
    let unpack = |k: usize| {
        let place = format!("section {}", NAMES[k]);
        let wrong = |found: String| Damage::new(&place, format!("{} bytes of content", lengths[k]), found);
        let content = zstd::bulk::decompress(sections[k], lengths[k]).map_err(|error| wrong(error.to_string()))?;
        if content.len() == lengths[k] { Ok(content) } else { Err(wrong(content.len().to_string())) }
    };
    let [_, cloud, field, _] = sections;
    let parts = Parts::of(bytes.len() as u64, cloud.len() as u64, field.len() as u64);
    let content = Sections { table: unpack(0)?, cloud: cloud.to_vec(), field: field.to_vec(), blobs: unpack(3)? };
    Ok((content, parts))
}

/// Confirms that so many bytes may be allocated for a file of `length`; none: they have no number.
pub(super) fn check_size(bytes: Option<usize>, length: usize) -> std::result::Result<(), Damage> {
    let most = (length as u64).saturating_mul(MOST_PER_BYTE).saturating_add(ALWAYS);
    match bytes.map(|bytes| bytes as u64) {
        Some(bytes) if bytes <= most => Ok(()),
        bytes => {
            let found = bytes.map_or("more than there are".to_owned(), |bytes| bytes.to_string());
            Err(Damage::new("table", format!("at most {most} bytes of content in {length}"), found))
        }
    }
}
