//! Tiles of a container that stay in memory once they have been decoded.
//!
//! In: the values of tiles, as they are decoded. Out: the same, to any thread, as long as the container is open. Memory:
//! what is allowed and no more; [`HeldTiles::BYTES_PER_SLOT`] for every tile, held or not. What is held is never given
//! up: passes go over all frames, so that the tile that was not used for longest is the next to be asked for.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};

use crate::error::Result;

type TileSlot = OnceLock<Box<[f32]>>;

/// Locks that tiles share while they are decoded: more than there are threads, so that hardly two wait for one another.
const TURNS: usize = 256;

/// The tiles held, each with a place of its own, so that nobody who reads one waits for another.
pub(super) struct HeldTiles {
    slots: Vec<TileSlot>,
    /// Held by whoever decodes the tile of a slot, by its number modulo theirs.
    turns: Vec<Mutex<()>>,
    /// Bytes allowed.
    capacity: AtomicU64,
    /// Bytes of these that are free.
    left: AtomicU64,
    /// Whether a tile did not fit: then nobody asks how large the next would be.
    full: AtomicBool,
}

impl HeldTiles {
    /// Memory of a tile's place.
    pub(super) const BYTES_PER_SLOT: u64 = size_of::<TileSlot>() as u64;

    /// Room for no tile yet.
    pub(super) fn new(slots: usize) -> HeldTiles {
        let slots = (0..slots).map(|_| TileSlot::new()).collect();
        let turns = (0..TURNS).map(|_| Mutex::default()).collect();
        HeldTiles { slots, turns, capacity: AtomicU64::new(0), left: AtomicU64::new(0), full: AtomicBool::new(false) }
    }

    /// Allows values of `bytes` altogether, if that is more than before.
    pub(super) fn allow(&self, bytes: u64) {
        let before = self.capacity.fetch_max(bytes, Ordering::Relaxed);
        self.left.fetch_add(bytes.saturating_sub(before), Ordering::Relaxed);
        if bytes > before {
            self.full.store(false, Ordering::Relaxed);
        }
    }

    /// The values of the tile of slot `at`, which `decode` writes the first time to room for as many as `count` says; none
    /// if they do not fit. Of threads that come at the same time one decodes and the others wait for it.
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
        let _turn = self.turns[at % TURNS].lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(values) = slot.get() {
            return Ok(Some(values));
        }
        let count = count()?;
        let bytes = 4 * count as u64;
        // Relaxed, as all here: numbers that guard no other memory; the slots guard theirs.
        let take = |left: u64| left.checked_sub(bytes);
        if self.left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take).is_err() {
            self.full.store(true, Ordering::Relaxed);
            return Ok(None);
        }
        let mut values = vec![0.0; count].into_boxed_slice();
        if let Err(error) = decode(&mut values) {
            self.left.fetch_add(bytes, Ordering::Relaxed);
            return Err(error);
        }
        Ok(Some(slot.get_or_init(|| values)))
    }

    /// Whether the tile of `slot` is held.
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
    fn what_fits_stays_what_does_not_is_left_alone_and_more_may_be_allowed() {
        let held = HeldTiles::new(3);
        assert_eq!(decode(&held, 0, 1), None);
        held.allow(20);
        assert_eq!(decode(&held, 0, 3), Some(&[0.0; 3][..]));
        assert_eq!(decode(&held, 1, 3), None);
        assert_eq!(decode(&held, 2, 1), None, "it would fit, but nobody asks any more");
        held.allow(12);
        assert_eq!(decode(&held, 1, 3), None, "less than before is no more");
        held.allow(24);
        assert_eq!(decode(&held, 1, 3), Some(&[1.0; 3][..]));
        let unasked = held.get_or_decode(0, || Err(Error::usage("counted")), |_| Err(Error::usage("decoded"))).unwrap();
        assert_eq!(unasked, Some(&[0.0; 3][..]));
    }

    #[test]
    fn threads_that_come_at_once_decode_a_tile_once() {
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
        assert_eq!((decoded.into_inner(), held.left.load(Ordering::Relaxed)), (1, 992));
    }

    #[test]
    fn what_cannot_be_decoded_takes_no_room() {
        let held = HeldTiles::new(2);
        held.allow(8);
        assert!(held.get_or_decode(0, || Ok(2), |_| Err(Error::usage("unreadable"))).is_err());
        assert!(!held.has(0));
        assert_eq!(decode(&held, 1, 2), Some(&[1.0; 2][..]));
    }
}
