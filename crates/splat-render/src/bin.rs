//! Assignment of splats to tiles, front to back.
//!
//! One radix sort orders all splats of a render by depth. A counting sort then assigns them to tiles and keeps that
//! order. It handles one strip of tiles at a time: the total number of pairs depends on the view, the number in memory
//! does not. Memory: 16 bytes per splat, 4 bytes per pair of a splat and a tile of the strip.

use std::ops::Range;

use super::project::{Splats, TileRect};

/// Maximum number of pairs in a strip, unless a single tile has more.
pub(super) const STRIP_PAIRS: usize = 1 << 20;

/// Number of splats whose tiles are read together. Read one by one, each would wait for memory alone.
const PREFETCHED: usize = 64;

/// Indices of splats, grouped by tile, nearest first.
#[derive(Debug, Clone, Default)]
pub(super) struct Bins {
    /// Sort key of every splat, sorted: (ordered depth bits, splat index).
    keys: Vec<u64>,
    /// Buffer for sorting.
    spare: Vec<u64>,
    /// Number of tiles per row.
    tiles_across: usize,
    /// End of each tile's pairs among the pairs of the whole render. Tile t begins where tile t − 1 ends.
    ends: Vec<usize>,
    /// First tile that has not been returned yet.
    next_tile: usize,
    /// Tiles whose pairs are in memory.
    strip: Range<usize>,
    /// Splat indices of the strip, tile after tile.
    pairs: Vec<u32>,
    /// Index in `pairs` for the next pair of each tile of the strip, then the end of all pairs.
    next_slots: Vec<u32>,
}

impl Bins {
    /// Sorts `splats` and counts their pairs with `tiles` = (across, down) tiles. No pairs are in memory yet.
    pub(super) fn begin(&mut self, splats: &Splats, tiles: [u32; 2]) {
        self.keys.clear();
        self.keys.reserve_exact(splats.splats.len());
        let depths = splats.splats.iter().map(|splat| u64::from(ordered_bits(splat.sort_depth)));
        self.keys.extend(depths.enumerate().map(|(i, bits)| bits << 32 | i as u64));
        sort_by_depth(&mut self.keys, &mut self.spare);

        self.tiles_across = tiles[0] as usize;
        self.ends.clear();
        self.ends.resize(self.tiles_across * tiles[1] as usize, 0);
        for rect in &splats.rects {
            for y in rect.y0 as usize..rect.y1 as usize {
                for count in
                    &mut self.ends[y * self.tiles_across + rect.x0 as usize..y * self.tiles_across + rect.x1 as usize]
                {
                    *count += 1;
                }
            }
        }
        let mut total = 0;
        for end in &mut self.ends {
            total += *end;
            *end = total;
        }
        self.strip = 0..0;
        self.next_tile = 0;
    }

    /// Restarts [`Bins::next_strip`] at the first tile. If one strip held all tiles, its pairs are kept.
    pub(super) fn rewind(&mut self) {
        self.next_tile = 0;
    }

    /// Computes the pairs of the next strip of tiles and returns its tiles, or `None` after the last tile.
    ///
    /// A strip consists of whole rows of tiles with at most `max_pairs` pairs, else of a part of a row, else of one
    /// tile. `splats` are those of [`Bins::begin`].
    pub(super) fn next_strip(&mut self, splats: &Splats, max_pairs: usize) -> Option<Range<usize>> {
        if self.is_last_strip() {
            return None;
        }
        let strip = self.first_part(self.next_tile..self.ends.len(), max_pairs);
        let before = self.start(strip.start);
        self.next_tile = strip.end;
        if strip == self.strip {
            return Some(strip);
        }
        self.strip = strip;

        self.next_slots.clear();
        self.next_slots.push(0);
        // A strip with more than `max_pairs` pairs is one tile, which has at most as many pairs as there are splats.
        self.next_slots.extend(self.ends[self.strip.clone()].iter().map(|end| (end - before) as u32));
        // Old content of `pairs` is overwritten below.
        self.pairs.resize(self.next_slots.last().map_or(0, |&total| total as usize), 0);
        let rows = self.strip.start / self.tiles_across..self.strip.end.div_ceil(self.tiles_across);
        for keys in self.keys.chunks(PREFETCHED) {
            let mut splat_rects = [(0, TileRect::default()); PREFETCHED];
            for (splat_rects, &key) in splat_rects.iter_mut().zip(keys) {
                *splat_rects = (key as u32, splats.rects[key as u32 as usize]);
            }
            for &(splat, rect) in &splat_rects[..keys.len()] {
                for y in rows.start.max(rect.y0 as usize)..rows.end.min(rect.y1 as usize) {
                    let row = y * self.tiles_across;
                    let from = (row + rect.x0 as usize).max(self.strip.start);
                    let to = (row + rect.x1 as usize).min(self.strip.end);
                    for tile in from..to {
                        let at = &mut self.next_slots[tile - self.strip.start];
                        self.pairs[*at as usize] = splat;
                        *at += 1;
                    }
                }
            }
        }
        Some(self.strip.clone())
    }

    /// Returns the first part of the non-empty `tiles`: whole rows with at most `max_pairs` pairs, else a part of a
    /// row, else one tile.
    fn first_part(&self, tiles: Range<usize>, max_pairs: usize) -> Range<usize> {
        let Range { start: first, end: last } = tiles;
        let before = self.start(first);
        let fitting = self.ends[first..last].partition_point(|&end| end - before <= max_pairs);
        let end = first + fitting.max(1);
        let whole_rows = end - end % self.tiles_across;
        first..if whole_rows > first && end < last { whole_rows } else { end }
    }

    /// Splits `tiles` into parts of at most `max_pairs` pairs, or of one tile.
    pub(super) fn parts(&self, mut tiles: Range<usize>, max_pairs: usize) -> impl Iterator<Item = Range<usize>> {
        std::iter::from_fn(move || {
            let part = (!tiles.is_empty()).then(|| self.first_part(tiles.clone(), max_pairs))?;
            tiles.start = part.end;
            Some(part)
        })
    }

    /// Returns whether all tiles have been returned.
    pub(super) fn is_last_strip(&self) -> bool {
        self.next_tile == self.ends.len()
    }

    /// Returns the splats of every (splat, tile) pair of `tiles` of the strip, tile after tile.
    pub(super) fn pairs(&self, tiles: Range<usize>) -> &[u32] {
        let before = self.start(self.strip.start);
        &self.pairs[self.start(tiles.start) - before..self.start(tiles.end) - before]
    }

    /// Iterates over the tile rows that `tiles` touches: the row, and the tiles of that row as a range of x.
    pub(super) fn rows(&self, tiles: Range<usize>) -> impl Iterator<Item = (usize, Range<usize>)> + use<> {
        let tiles_across = self.tiles_across;
        (tiles.start / tiles_across.max(1)..tiles.end.div_ceil(tiles_across.max(1))).map(move |y| {
            let row = y * tiles_across;
            (y, tiles.start.max(row) - row..tiles.end.min(row + tiles_across) - row)
        })
    }

    /// Returns the splats of the tiles `x` of row `y`, which must lie in the strip.
    pub(super) fn pairs_in_row(&self, y: usize, x: Range<usize>) -> &[u32] {
        self.pairs(y * self.tiles_across + x.start..y * self.tiles_across + x.end)
    }

    /// Returns the index of the first pair of a tile among the pairs of the whole render.
    fn start(&self, tile: usize) -> usize {
        tile.checked_sub(1).map_or(0, |before| self.ends[before])
    }
}

/// Number of bits of a radix sort digit. The counts of one digit stay in the first-level cache.
const DIGIT_BITS: u32 = 11;

/// Sorts keys by their upper halves. Ties keep their order, so the lower halves must increase at the start. `spare` is
/// a buffer.
fn sort_by_depth(keys: &mut Vec<u64>, spare: &mut Vec<u64>) {
    spare.clear();
    spare.resize(keys.len(), 0);
    for shift in [32, 32 + DIGIT_BITS, 32 + 2 * DIGIT_BITS] {
        let digit = |key: u64| (key >> shift) as usize % (1 << DIGIT_BITS);
        let mut places = [0; 1 << DIGIT_BITS];
        for &key in &*keys {
            places[digit(key)] += 1;
        }
        let mut before = 0;
        for place in &mut places {
            before += std::mem::replace(place, before);
        }
        for &key in &*keys {
            let place = &mut places[digit(key)];
            spare[*place] = key;
            *place += 1;
        }
        std::mem::swap(keys, spare);
    }
}

/// Returns bits that are ordered like the f32 values. Negative values occur, because rounding far from the origin can
/// give a visible Gaussian a negative f32 depth.
fn ordered_bits(x: f32) -> u32 {
    let bits = x.to_bits();
    if bits >> 31 == 0 { bits | 1 << 31 } else { !bits }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_sorted_by_all_depth_bits() {
        let bits = |i: u64| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
        for kept in [u64::MAX, 0x7ff, 0x3f_f800, 0xffc0_0000, 0] {
            let mut keys: Vec<u64> = (0..5000).map(|i| (bits(i) & kept) << 32 | i).collect();
            let mut expected = keys.clone();
            expected.sort_unstable();
            sort_by_depth(&mut keys, &mut Vec::new());
            assert!(keys == expected, "of depths & {kept:#x}");
        }
    }

    #[test]
    fn bits_are_ordered_like_their_floats() {
        let values = [f32::NEG_INFINITY, -3.0, -1e-30, 0.0, 1e-40, 0.2, 7.5, f32::INFINITY];
        assert!(values.is_sorted_by(|&a, &b| ordered_bits(a) < ordered_bits(b)));
    }
}
