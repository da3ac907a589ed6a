//! Serialization of encoded tiles (each one column for a block of Gaussians and frames) that are kept outside a
//! container until they are written.

use xxhash_rust::xxh3::xxh3_64;

use crate::codec::EncodedTile;
use crate::error::{Error, Result};
use crate::layout::TileId;
use crate::record::{RECORD_BYTES, Record, TileRecord};

/// Length in bytes of the fields that precede the stored bytes in a serialized tile: a tile record (64 bytes, with
/// offset 0), then width, number of Gaussians, and error bound.
const HEAD_BYTES: usize = RECORD_BYTES as usize + 16;

impl EncodedTile {
    /// Serializes the tile, to be restored by [`EncodedTile::from_bytes`] of the same version of this library. These
    /// bytes are not a part of the file format.
    pub fn to_bytes(&self) -> Vec<u8> {
        let record = TileRecord {
            id: TileId { column: 0, gaussian_block: 0, frame_block: 0 },
            frames: self.frames,
            encoding: self.encoding,
            constant: self.constant,
            offset: 0,
            stored_bytes: self.bytes.len() as u32,
            checksum: self.checksum,
            stats: self.stats,
        };
        let mut out = Vec::with_capacity(HEAD_BYTES + self.bytes.len());
        out.extend_from_slice(&Record::Tile(record).to_bytes());
        out.extend_from_slice(&self.width.to_le_bytes());
        out.extend_from_slice(&self.len.to_le_bytes());
        out.extend_from_slice(&self.max_error.to_le_bytes());
        out.extend_from_slice(&self.bytes);
        out
    }

    /// Restores a tile that [`EncodedTile::to_bytes`] serialized. Fails if `bytes` were cut or changed.
    pub fn from_bytes(bytes: &[u8]) -> Result<EncodedTile> {
        let not_a_tile = || Error::usage(format!("{} bytes are not an encoded tile, or it was damaged", bytes.len()));
        let (record, rest) = bytes.split_first_chunk().ok_or_else(not_a_tile)?;
        let (width, rest) = rest.split_first_chunk().ok_or_else(not_a_tile)?;
        let (len, rest) = rest.split_first_chunk().ok_or_else(not_a_tile)?;
        let (max_error, stored) = rest.split_first_chunk().ok_or_else(not_a_tile)?;
        match Record::from_bytes(record, 0) {
            Ok(Record::Tile(tile))
                if tile.stored_bytes as usize == stored.len() && tile.checksum == xxh3_64(stored) =>
            {
                Ok(EncodedTile {
                    frames: tile.frames,
                    width: u32::from_le_bytes(*width),
                    len: u32::from_le_bytes(*len),
                    constant: tile.constant,
                    encoding: tile.encoding,
                    max_error: f64::from_le_bytes(*max_error),
                    stats: tile.stats,
                    checksum: tile.checksum,
                    bytes: stored.to_vec(),
                })
            }
            _ => Err(not_a_tile()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::{Compression, encode_tile};

    #[test]
    fn tile_round_trips_and_damaged_bytes_are_refused() {
        let values: Vec<f32> = (0..2 * 3 * 50).map(|k| (k as f32 * 0.1).sin()).collect();
        let bounded = Compression::Bounded { max_error: 1e-3, level: 3 };
        for compression in [Compression::Raw, Compression::Zstd(1), bounded] {
            let tile = encode_tile(&values, 2, 3, 50, compression).unwrap();
            let bytes = tile.to_bytes();
            assert_eq!(EncodedTile::from_bytes(&bytes).unwrap(), tile);
            for length in [0, 63, HEAD_BYTES - 1, bytes.len() - 1] {
                assert!(EncodedTile::from_bytes(&bytes[..length]).is_err(), "{compression:?}, {length} bytes");
            }
            for byte in (0..RECORD_BYTES as usize).chain(HEAD_BYTES..bytes.len()) {
                let mut flipped = bytes.clone();
                flipped[byte] ^= 4;
                assert!(EncodedTile::from_bytes(&flipped).is_err(), "{compression:?}, byte {byte}");
            }
        }
        let constant = encode_tile(&[1.5; 40], 4, 1, 10, Compression::Zstd(1)).unwrap();
        assert!(constant.is_constant());
        assert_eq!(EncodedTile::from_bytes(&constant.to_bytes()).unwrap(), constant);
    }
}
