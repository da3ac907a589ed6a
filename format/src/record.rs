//! Records and trailer of a container (SPEC.md, "Records"). A record has a header of 64 bytes, whose last 8 bytes are a
//! checksum of the others. The header may be followed by a payload (the stored bytes of the record), which has another
//! checksum.

use std::fmt;

use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use crate::codec::{Encoding, TileStats};
use crate::error::Fault;
use crate::layout::{Layout, TileId};

/// Length in bytes of a record header: the description of a tile, of time stamps or of the footer. Records start at
/// multiples of this length, so payloads are 64-byte aligned in the file and in its memory map.
pub(crate) const RECORD_BYTES: u64 = 64;
/// Length in bytes of the trailer, which ends a finished container and states where its footer lies.
pub(crate) const TRAILER_BYTES: u64 = 32;
/// Last bytes of every finished container.
const END_MAGIC: [u8; 8] = *b"\x1aGSEQEND";

/// Rounds the file offset `offset` up to the next multiple of 64 bytes, at which a record may start.
pub(crate) fn align(offset: u64) -> u64 {
    offset.next_multiple_of(RECORD_BYTES)
}

/// Record of one tile (one column for a block of Gaussians and frames). The same 64 bytes lie before the tile's stored
/// bytes and in the index (table of tiles).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TileRecord {
    pub(crate) id: TileId,
    pub(crate) frames: u32,
    pub(crate) encoding: Encoding,
    pub(crate) constant: bool,
    /// Offset in the file of the tile's stored bytes. A constant tile (all frames equal) may use the stored bytes of an
    /// earlier tile.
    pub(crate) offset: u64,
    pub(crate) stored_bytes: u32,
    pub(crate) checksum: u64,
    pub(crate) stats: TileStats,
}

/// Header of the record whose payload contains the time stamps of one frame block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TimesRecord {
    pub(crate) frame_block: u32,
    pub(crate) frames: u32,
    pub(crate) checksum: u64,
}

/// Header of the footer, the record whose payload contains all time stamps and the index.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FooterRecord {
    pub(crate) frames: u64,
    pub(crate) tiles: u64,
    pub(crate) checksum: u64,
    /// Checksum of the file header, so that a footer cannot be used with another header.
    pub(crate) header_checksum: u64,
}

/// Header of a record. A container has records of three kinds: tiles (values), time stamps, and one footer (index).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Record {
    Tile(TileRecord),
    Times(TimesRecord),
    Footer(FooterRecord),
}

impl fmt::Display for Record {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Record::Tile(tile) => write!(f, "a record of {}, {} frames", tile.id, tile.frames),
            Record::Times(times) => write!(f, "a record of time stamps, frame block {}", times.frame_block),
            Record::Footer(_) => write!(f, "a footer"),
        }
    }
}

impl FooterRecord {
    /// Returns the length in bytes of the footer's payload (8 per frame and 64 per tile), or `None` if this number
    /// overflows.
    pub(crate) fn payload_bytes(&self) -> Option<u64> {
        self.frames.checked_mul(8)?.checked_add(self.tiles.checked_mul(RECORD_BYTES)?)
    }
}

impl Record {
    /// Encodes the 64-byte header of the record, including its checksum.
    pub(crate) fn to_bytes(self) -> [u8; RECORD_BYTES as usize] {
        let mut out = [0; RECORD_BYTES as usize];
        match self {
            Record::Tile(tile) => {
                let (encoding, order) = match tile.encoding {
                    Encoding::Raw => (0, 0),
                    Encoding::Filtered { order } => (1, order),
                    Encoding::Bounded { order } => (2, order),
                };
                out[..4].copy_from_slice(b"TILE");
                out[4..8].copy_from_slice(&tile.id.column.to_le_bytes());
                out[8..12].copy_from_slice(&tile.id.gaussian_block.to_le_bytes());
                out[12..16].copy_from_slice(&tile.id.frame_block.to_le_bytes());
                out[16..20].copy_from_slice(&[encoding, order, tile.constant.into(), 0]);
                out[20..24].copy_from_slice(&tile.frames.to_le_bytes());
                out[24..32].copy_from_slice(&tile.offset.to_le_bytes());
                out[32..40].copy_from_slice(&tile.checksum.to_le_bytes());
                out[40..44].copy_from_slice(&tile.stored_bytes.to_le_bytes());
                out[44..48].copy_from_slice(&tile.stats.min.to_le_bytes());
                out[48..52].copy_from_slice(&tile.stats.max.to_le_bytes());
                out[52..56].copy_from_slice(&tile.stats.non_finite.to_le_bytes());
            }
            Record::Times(times) => {
                out[..4].copy_from_slice(b"TIME");
                out[12..16].copy_from_slice(&times.frame_block.to_le_bytes());
                out[20..24].copy_from_slice(&times.frames.to_le_bytes());
                out[32..40].copy_from_slice(&times.checksum.to_le_bytes());
            }
            Record::Footer(footer) => {
                out[..4].copy_from_slice(b"FOOT");
                out[8..16].copy_from_slice(&footer.frames.to_le_bytes());
                out[16..24].copy_from_slice(&footer.tiles.to_le_bytes());
                out[24..32].copy_from_slice(&footer.header_checksum.to_le_bytes());
                out[32..40].copy_from_slice(&footer.checksum.to_le_bytes());
            }
        }
        let checksum = xxh3_64(&out[..56]);
        out[56..].copy_from_slice(&checksum.to_le_bytes());
        out
    }

    /// Decodes the record header `bytes`, which lies at `offset` in the file, and checks each field by itself.
    /// [`TileRecord::check`] checks the record of a tile against the layout.
    pub(crate) fn from_bytes(bytes: &[u8; RECORD_BYTES as usize], offset: u64) -> Result<Record, Fault> {
        let u32_at = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
        let u64_at = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
        let (stored, computed) = (u64_at(56), xxh3_64(&bytes[..56]));
        if stored != computed {
            return Err(Fault::new(offset + 56, format!("record checksum {computed:016x}"), format!("{stored:016x}")));
        }
        let record = match &bytes[..4] {
            b"TILE" => {
                let encoding = match (bytes[16], bytes[17]) {
                    (0, 0) => Encoding::Raw,
                    (1, order @ 0..=2) => Encoding::Filtered { order },
                    (2, order @ 1..=2) => Encoding::Bounded { order },
                    (encoding, order) => {
                        return Err(Fault::new(
                            offset + 16,
                            "encoding 0 order 0, encoding 1 order 0 to 2, or encoding 2 order 1 or 2",
                            format!("encoding {encoding} order {order}"),
                        ));
                    }
                };
                Record::Tile(TileRecord {
                    id: TileId { column: u32_at(4), gaussian_block: u32_at(8), frame_block: u32_at(12) },
                    encoding,
                    constant: bytes[18] != 0,
                    frames: u32_at(20),
                    offset: u64_at(24),
                    checksum: u64_at(32),
                    stored_bytes: u32_at(40),
                    stats: TileStats {
                        min: f32::from_bits(u32_at(44)),
                        max: f32::from_bits(u32_at(48)),
                        non_finite: u32_at(52),
                    },
                })
            }
            b"TIME" => Record::Times(TimesRecord { frame_block: u32_at(12), frames: u32_at(20), checksum: u64_at(32) }),
            b"FOOT" => Record::Footer(FooterRecord {
                frames: u64_at(8),
                tiles: u64_at(16),
                header_checksum: u64_at(24),
                checksum: u64_at(32),
            }),
            other => return Err(Fault::new(offset, "a record TILE, TIME or FOOT", format!("{other:02x?}"))),
        };
        // Reserved bytes must be zero and flags 0 or 1: encoding the record again must give the same bytes.
        if record.to_bytes() != *bytes {
            return Err(Fault::new(offset, "zero in every reserved byte and flags of 0 or 1", "something else"));
        }
        Ok(record)
    }
}

impl TileRecord {
    /// Returns the number of f32 values that the tile stores: those of all frames, or of one frame if all are equal.
    pub(crate) fn value_count(&self, layout: &Layout) -> usize {
        let frames = if self.constant { 1 } else { self.frames as usize };
        frames
            * layout.columns[self.id.column as usize].width as usize
            * layout.block_len(self.id.gaussian_block) as usize
    }

    /// Checks this record against `layout`: the tile exists and has a legal size, and its stored bytes lie within the
    /// range `payloads` of the file. `place` is the offset of the record in the file.
    pub(crate) fn check(&self, layout: &Layout, payloads: std::ops::Range<u64>, place: u64) -> Result<(), Fault> {
        if layout.index_of(self.id).is_none() {
            return Err(Fault::new(place + 4, "a column and a Gaussian block of this container", self.id));
        }
        if !(1..=layout.frame_block).contains(&self.frames) {
            return Err(Fault::new(place + 20, format!("1 to {} frames", layout.frame_block), self.frames));
        }
        let raw = 4 * self.value_count(layout) as u64;
        let stored = u64::from(self.stored_bytes);
        let legal = match self.encoding {
            Encoding::Raw => stored == raw,
            Encoding::Filtered { .. } | Encoding::Bounded { .. } => (1..raw).contains(&stored),
        };
        let exact = layout.columns[self.id.column as usize].max_error == 0.0;
        if exact && matches!(self.encoding, Encoding::Bounded { .. }) {
            let expected = "an encoding that keeps every bit, as the column has no bound";
            return Err(Fault::new(place + 16, expected, self.encoding));
        }
        if !legal {
            let expected = format!("{raw} stored bytes, or fewer if compressed");
            return Err(Fault::new(place + 40, expected, format!("{stored}, {}", self.encoding)));
        }
        let inside =
            self.offset >= payloads.start && self.offset.checked_add(stored).is_some_and(|end| end <= payloads.end);
        if !inside || !self.offset.is_multiple_of(RECORD_BYTES) {
            let expected = format!(
                "a payload within bytes {} to {}, at a multiple of {RECORD_BYTES}",
                payloads.start, payloads.end
            );
            return Err(Fault::new(place + 24, expected, format!("{stored} bytes from {}", self.offset)));
        }
        Ok(())
    }

    /// Returns whether the tiles of this record and of `other` may use the same stored bytes. Three conditions must
    /// hold:
    /// - Both tiles are constant.
    /// - They belong to the same column and Gaussian block.
    /// - All other fields of the records are equal, except for the frame block and the number of frames.
    pub(crate) fn may_share(&self, other: &TileRecord) -> bool {
        let shared = |tile: &TileRecord| TileRecord { id: TileId { frame_block: 0, ..tile.id }, frames: 0, ..*tile };
        self.constant && shared(self).same_bits(&shared(other))
    }

    /// Returns whether the records of two tiles have the same bytes when encoded. Numbers are thus compared as bits:
    /// NaN equals a NaN of the same bits, and −0 differs from +0.
    fn same_bits(&self, other: &TileRecord) -> bool {
        Record::Tile(*self).to_bytes() == Record::Tile(*other).to_bytes()
    }
}

/// Encodes the last bytes of a finished file: the offset `footer` of the footer record, a checksum, and the end magic.
pub(crate) fn trailer_to_bytes(footer: u64) -> [u8; TRAILER_BYTES as usize] {
    let mut out = [0; TRAILER_BYTES as usize];
    out[..8].copy_from_slice(&footer.to_le_bytes());
    let checksum = xxh3_64(&out[..16]);
    out[16..24].copy_from_slice(&checksum.to_le_bytes());
    out[24..].copy_from_slice(&END_MAGIC);
    out
}

/// Decodes the trailer, which lies at `offset` in the file, and returns the offset of the footer record.
pub(crate) fn trailer_from_bytes(bytes: &[u8; TRAILER_BYTES as usize], offset: u64) -> Result<u64, Fault> {
    let footer = u64::from_le_bytes(std::array::from_fn(|i| bytes[i]));
    if trailer_to_bytes(footer) != *bytes {
        let fault = Fault::new(
            offset,
            "the trailer of a finished container",
            "something else: the file is cut short or damaged",
        );
        return Err(fault.hint(
            "to save its complete frames: `splatsieve info NAME.gseq --repair saved.gseq` (`gseq::recover` in the \
             library)",
        ));
    }
    Ok(footer)
}

/// Hash (xxh3-64) that identifies the content of a container: header, time stamps, and the records of all tiles in the
/// order of the index. The offset of a tile is hashed as 0, so that the order of writing does not matter.
pub(crate) struct Digest(Xxh3);

impl Digest {
    /// Creates the hash of a header and the time stamps; tiles are added by [`Digest::tile`].
    pub(crate) fn new(header: &[u8], times: &[f64]) -> Self {
        let mut hash = Xxh3::new();
        hash.update(header);
        times.iter().for_each(|time| hash.update(&time.to_le_bytes()));
        Digest(hash)
    }

    /// Adds the record (64-byte description) of the next tile to the hash. Tiles must be added in the order of the
    /// index, the table of tiles.
    pub(crate) fn tile(&mut self, tile: &TileRecord) {
        self.0.update(&Record::Tile(TileRecord { offset: 0, ..*tile }).to_bytes());
    }

    /// Returns the hash of the header, the time stamps and the tiles added so far.
    pub(crate) fn value(&self) -> u64 {
        self.0.digest()
    }
}
