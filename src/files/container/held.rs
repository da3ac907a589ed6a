//! Keeps decoded tiles of a container in memory, so that later passes over the frames need not read and decode them
//! again.
//!
//! A tile holds the values of one attribute for a block of consecutive Gaussians and frames. Input: the values of tiles
//! as they are decoded. Output: the same values, for any thread, as long as the container is open. Memory: at most the
//! bytes allowed for values, plus [`HeldTiles::BYTES_PER_SLOT`] for every tile of the file, whether it is kept or not.
//! Kept tiles are never evicted: every pass goes over all frames, so the least recently used tile is the next one to be
//! needed.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};

use crate::error::Result;

/// Place for the decoded values of one tile; empty until the tile has been decoded.
type TileSlot = OnceLock<Box<[f32]>>;

/// Number of locks for decoding, shared by all tiles. It is larger than the number of threads, so two threads rarely
/// need the same lock.
const LOCKS: usize = 256;

/// Decoded tiles that are kept in memory. Each tile of the file has its own slot, so that readers of a decoded tile
/// never wait.
pub(super) struct HeldTiles {
    slots: Vec<TileSlot>,
    /// Locks for decoding. The thread that decodes the tile with the slot number `s` holds lock number `s % LOCKS`.
    locks: Vec<Mutex<()>>,
    /// Maximum number of bytes of tile values that are kept in memory.
    capacity: AtomicU64,
    /// Number of bytes of tile values that may still be added until `capacity` is reached.
    remaining_bytes: AtomicU64,
    /// Whether a tile has been refused because it did not fit into the remaining memory. While this is set, every
    /// further tile is refused at once, without looking up its size in the file.
    full: AtomicBool,
}

impl HeldTiles {
    /// Bytes of memory of one slot (place for the decoded values of one tile), without these values.
    pub(super) const BYTES_PER_SLOT: u64 = size_of::<TileSlot>() as u64;

    /// Creates storage for the decoded values of `slots` tiles. It is empty, and can hold no values until
    /// [`HeldTiles::allow`] grants memory for them.
    pub(super) fn new(slots: usize) -> HeldTiles {
        let slots = (0..slots).map(|_| TileSlot::new()).collect();
        let locks = (0..LOCKS).map(|_| Mutex::default()).collect();
        HeldTiles {
            slots,
            locks,
            capacity: AtomicU64::new(0),
            remaining_bytes: AtomicU64::new(0),
            full: AtomicBool::new(false),
        }
    }

    /// Raises the maximum memory for tile values to `bytes` bytes. Has no effect if `bytes` is below the present
    /// maximum.
    pub(super) fn allow(&self, bytes: u64) {
        let before = self.capacity.fetch_max(bytes, Ordering::Relaxed);
        self.remaining_bytes.fetch_add(bytes.saturating_sub(before), Ordering::Relaxed);
        if bytes > before {
            self.full.store(false, Ordering::Relaxed);
        }
    }

    /// Returns the values of the tile with the slot number `at`. If they are not in memory yet, decodes and keeps them:
    /// `count` returns their number, and `decode` writes them into the given buffer. Returns `None` if they do not fit
    /// into the allowed memory. If several threads need the same tile, one decodes it and the others wait.
    ///
    /// # Errors
    /// Fails if `count` or `decode` fails; the tile is then not kept.
    pub(super) fn get_or_decode(
        &self,
        at: usize,
        count: impl FnOnce() -> Result<usize>,
        decode: impl FnOnce(&mut [f32]) -> Result<()>,
    ) -> Result<Option<&[f32]>> {
        let slot = &self.slots[at];
        if let Some(values) = slot.get() {
            return Ok(Some(values));
        }
        if self.full.load(Ordering::Relaxed) {
            return Ok(None);
        }
        let _lock = self.locks[at % LOCKS].lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(values) = slot.get() {
            return Ok(Some(values));
        }
        let count = count()?;
        let bytes = 4 * count as u64;
        // Relaxed ordering suffices for these counters: they guard no other memory, and the slots guard their own
        // values.
        let take = |remaining: u64| remaining.checked_sub(bytes);
        if self.remaining_bytes.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take).is_err() {
            self.full.store(true, Ordering::Relaxed);
            return Ok(None);
        }
        let mut values = vec![0.0; count].into_boxed_slice();
        if let Err(error) = decode(&mut values) {
            self.remaining_bytes.fetch_add(bytes, Ordering::Relaxed);
            return Err(error);
        }
        Ok(Some(slot.get_or_init(|| values)))
    }

    /// Returns whether the decoded values of the tile with the slot number `slot` are in memory.
    pub(super) fn has(&self, slot: usize) -> bool {
        self.slots[slot].get().is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;

    fn decode(held: &HeldTiles, slot: usize, count: usize) -> Option<&[f32]> {
        let fill = |values: &mut [f32]| {
            values.fill(slot as f32);
            Ok(())
        };
        held.get_or_decode(slot, || Ok(count), fill).unwrap()
    }

    #[test]
    fn tiles_are_held_up_to_a_limit_that_may_grow() {
        let held = HeldTiles::new(3);
        assert_eq!(decode(&held, 0, 1), None);
        held.allow(20);
        assert_eq!(decode(&held, 0, 3), Some(&[0.0; 3][..]));
        assert_eq!(decode(&held, 1, 3), None);
        assert_eq!(decode(&held, 2, 1), None, "it would fit, but sizes are no longer looked up");
        held.allow(12);
        assert_eq!(decode(&held, 1, 3), None, "less than before is no more");
        held.allow(24);
        assert_eq!(decode(&held, 1, 3), Some(&[1.0; 3][..]));
        let unasked = held.get_or_decode(0, || Err(Error::usage("counted")), |_| Err(Error::usage("decoded"))).unwrap();
        assert_eq!(unasked, Some(&[0.0; 3][..]));
    }

    #[test]
    fn concurrent_threads_decode_a_tile_once() {
        let held = HeldTiles::new(1);
        held.allow(1000);
        let decoded = AtomicU64::new(0);
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    let decode = |values: &mut [f32]| {
                        decoded.fetch_add(1, Ordering::Relaxed);
                        std::thread::sleep(std::time::Duration::from_millis(20));
                        values.fill(3.0);
                        Ok(())
                    };
                    assert_eq!(held.get_or_decode(0, || Ok(2), decode).unwrap(), Some(&[3.0; 2][..]));
                });
            }
        });
        assert_eq!((decoded.into_inner(), held.remaining_bytes.load(Ordering::Relaxed)), (1, 992));
    }

    #[test]
    fn a_tile_that_fails_to_decode_takes_no_memory() {
        let held = HeldTiles::new(2);
        held.allow(8);
        assert!(held.get_or_decode(0, || Ok(2), |_| Err(Error::usage("unreadable"))).is_err());
        assert!(!held.has(0));
        assert_eq!(decode(&held, 1, 2), Some(&[1.0; 2][..]));
    }
}
