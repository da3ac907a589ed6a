//! Tiles of a container that stay in memory once they have been decoded.
//!
//! In: the values of tiles, as they are decoded. Out: the same, to any thread, as long as the container is open. Memory:
//! what is allowed and no more; [`HeldTiles::BYTES_PER_SLOT`] for every tile, held or not. What is held is never given
//! up: passes go over all frames, so that the tile that was not used for longest is the next to be asked for.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crate::error::Result;

type Slot = OnceLock<Box<[f32]>>;

/// The tiles held, each with a place of its own, so that no reader waits for another.
pub(super) struct HeldTiles {
    slots: Vec<Slot>,
    /// Bytes allowed.
    capacity: AtomicU64,
    /// Bytes of these that are free.
    left: AtomicU64,
    /// Whether a tile did not fit: then nobody asks how large the next would be.
    full: AtomicBool,
}

impl HeldTiles {
    /// Memory of a tile's place.
    pub(super) const BYTES_PER_SLOT: u64 = size_of::<Slot>() as u64;

    /// Room for no tile yet.
    pub(super) fn new(slots: usize) -> HeldTiles {
        let slots = (0..slots).map(|_| Slot::new()).collect();
        HeldTiles { slots, capacity: AtomicU64::new(0), left: AtomicU64::new(0), full: AtomicBool::new(false) }
    }

    /// Allows values of `bytes` altogether, if that is more than before.
    pub(super) fn allow(&self, bytes: u64) {
        let before = self.capacity.fetch_max(bytes, Ordering::Relaxed);
        self.left.fetch_add(bytes.saturating_sub(before), Ordering::Relaxed);
        if bytes > before {
            self.full.store(false, Ordering::Relaxed);
        }
    }

    /// The values of the tile of `slot`, which `decode` writes the first time to room for as many as `count` says; none
    /// if they do not fit. Threads that come first at the same time decode each for itself, and one outcome stays.
    pub(super) fn get_or_decode(
        &self,
        slot: usize,
        count: impl FnOnce() -> Result<usize>,
        decode: impl FnOnce(&mut [f32]) -> Result<()>,
    ) -> Result<Option<&[f32]>> {
        let slot = &self.slots[slot];
        if let Some(values) = slot.get() {
            return Ok(Some(values));
        }
        if self.full.load(Ordering::Relaxed) {
            return Ok(None);
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
        let stays = decode(&mut values).map(|()| slot.set(values).is_ok());
        if !matches!(stays, Ok(true)) {
            self.left.fetch_add(bytes, Ordering::Relaxed);
        }
        stays.map(|_| slot.get().map(|values| &**values))
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
    fn what_cannot_be_decoded_takes_no_room() {
        let held = HeldTiles::new(2);
        held.allow(8);
        assert!(held.get_or_decode(0, || Ok(2), |_| Err(Error::usage("unreadable"))).is_err());
        assert!(!held.has(0));
        assert_eq!(decode(&held, 1, 2), Some(&[1.0; 2][..]));
    }
}
