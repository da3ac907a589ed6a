//! Assignment of splats (image footprints of Gaussians) to tiles, in the order from front to back.
//!
//! One radix sort orders all splats of a render by depth. A counting sort then lists the splats of each tile in this
//! order. The lists consist of (splat, tile) pairs. The tiles are processed in strips of consecutive tiles, and only
//! the pairs of one strip are in memory at a time, so their memory is limited in every view. Memory: 16 bytes per
//! splat, and 4 bytes per pair of the strip.

use std::ops::Range;

use super::project::{Splats, TileRect};

/// Maximum number of (splat, tile) pairs in a strip of tiles (the tiles processed together). A single tile with more
/// pairs is a strip by itself.
pub(super) const STRIP_PAIRS: usize = 1 << 20;

/// Number of splats whose rectangles of tiles are read together, so that the processor waits for several of these reads
/// at once.
const PREFETCHED: usize = 64;

/// Lists of the splats of each tile, nearest splat first.
#[derive(Debug, Clone, Default)]
pub(super) struct Bins {
    /// Sort keys of all splats, sorted. The upper half of a key holds the depth, as an integer with the same order. The
    /// lower half holds the index of the splat.
    keys: Vec<u64>,
    /// Buffer that the sort reuses; its content has no meaning.
    spare: Vec<u64>,
    /// Number of tiles in a row of tiles of the render.
    tiles_across: usize,
    /// Prefix sums over the tiles of the whole render, row by row: for each tile, the number of (splat, tile) pairs of
    /// this tile and of all tiles before it. The pairs of a tile begin where the pairs of the previous tile end.
    ends: Vec<usize>,
    /// Number of the first tile that [`Bins::next_strip`] has not returned yet, counted row by row.
    next_tile: usize,
    /// Current strip: the range of tiles whose (splat, tile) pairs are in memory.
    strip: Range<usize>,
    /// For every (splat, tile) pair of the current strip (the tiles that are processed together), the index of its
    /// splat: tile after tile, and nearest splat first within a tile.
    pairs: Vec<u32>,
    /// Used while `pairs` is filled: for each tile of the current strip (the tiles that are processed together), the
    /// index in `pairs` at which the next splat of the tile is written. An additional last entry holds the number of
    /// all pairs.
    next_slots: Vec<u32>,
}

impl Bins {
    /// Sorts `splats` by depth and counts the splats of each tile, in an image of `tiles` = (across, down) tiles. No
    /// (splat, tile) pairs are in memory yet. `parallel`: whether to sort and to count at the same time.
    pub(super) fn begin(&mut self, splats: &Splats, tiles: [u32; 2], parallel: bool) {
        self.tiles_across = tiles[0] as usize;
        self.strip = 0..0;
        self.next_tile = 0;
        let Bins { keys, spare, ends, tiles_across, .. } = self;
        let mut sort = || {
            keys.clear();
            keys.reserve_exact(splats.splats.len());
            let depths = splats.splats.iter().map(|splat| u64::from(ordered_bits(splat.sort_depth)));
            keys.extend(depths.enumerate().map(|(i, bits)| bits << 32 | i as u64));
            sort_by_depth(keys, spare);
        };
        let count = || {
            // `ends` first holds, for each tile, how many more splats it has than the previous tile (a decrease wraps
            // around). The additional last entry takes the end of rectangles at the last tile.
            ends.clear();
            ends.resize(*tiles_across * tiles[1] as usize + 1, 0);
            for rect in &splats.rects {
                for y in rect.y0 as usize..rect.y1 as usize {
                    let row = y * *tiles_across;
                    let (start, end) = (row + rect.x0 as usize, row + rect.x1 as usize);
                    ends[start] = ends[start].wrapping_add(1);
                    ends[end] = ends[end].wrapping_sub(1);
                }
            }
            ends.pop();
            let (mut count, mut total) = (0usize, 0);
            for end in ends {
                count = count.wrapping_add(*end);
                total += count;
                *end = total;
            }
        };
        if parallel {
            rayon::join(sort, count);
        } else {
            sort();
            count();
        }
    }

    /// Makes [`Bins::next_strip`] start again at the first tile. If all tiles were in one strip (range of tiles
    /// processed together), its pairs are still in memory and are not computed again.
    pub(super) fn rewind(&mut self) {
        self.next_tile = 0;
    }

    /// Computes the (splat, tile) pairs of the next strip, which are the tiles that are processed together. Returns the
    /// range of tiles of the strip, or `None` after the last tile. `splats` must be the splats that [`Bins::begin`]
    /// sorted.
    ///
    /// A strip has at most `max_pairs` pairs:
    ///
    /// - It consists of as many whole rows of tiles as this limit allows.
    /// - If a single row has more pairs, the strip is a part of this row.
    /// - If a single tile has more pairs, the strip is this tile, which is the only case in which the limit is
    ///   exceeded.
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

    /// Returns the first part of `tiles` that is processed at once: a range that starts at `tiles.start`, of at least
    /// one tile. `tiles` must not be empty.
    ///
    /// - The range is as long as possible with at most `max_pairs` (splat, tile) pairs. A first tile with more pairs is
    ///   a range by itself.
    /// - The range ends at the end of a row of tiles if it holds at least one row end. If not, it ends within the first
    ///   row.
    /// - If all of `tiles` fits, the range is all of `tiles`.
    fn first_part(&self, tiles: Range<usize>, max_pairs: usize) -> Range<usize> {
        let Range { start: first, end: last } = tiles;
        let before = self.start(first);
        let fitting = self.ends[first..last].partition_point(|&end| end - before <= max_pairs);
        let end = first + fitting.max(1);
        let whole_rows = end - end % self.tiles_across;
        first..if whole_rows > first && end < last { whole_rows } else { end }
    }

    /// Splits `tiles` into consecutive ranges with at most `max_pairs` (splat, tile) pairs each. A tile with more pairs
    /// is a range of its own.
    pub(super) fn parts(&self, mut tiles: Range<usize>, max_pairs: usize) -> impl Iterator<Item = Range<usize>> {
        std::iter::from_fn(move || {
            let part = (!tiles.is_empty()).then(|| self.first_part(tiles.clone(), max_pairs))?;
            tiles.start = part.end;
            Some(part)
        })
    }

    /// Returns whether [`Bins::next_strip`] has returned all tiles.
    pub(super) fn is_last_strip(&self) -> bool {
        self.next_tile == self.ends.len()
    }

    /// Returns the index of the splat of every (splat, tile) pair of `tiles`, tile after tile. The tiles must lie in
    /// the range that [`Bins::next_strip`] returned last, because only its pairs are in memory.
    pub(super) fn pairs(&self, tiles: Range<usize>) -> &[u32] {
        let before = self.start(self.strip.start);
        &self.pairs[self.start(tiles.start) - before..self.start(tiles.end) - before]
    }

    /// Splits the range `tiles` of tile numbers into rows of tiles. Yields for each row that contains one of these
    /// tiles a pair: the index of the row, and the range of columns of these tiles.
    pub(super) fn rows(&self, tiles: Range<usize>) -> impl Iterator<Item = (usize, Range<usize>)> + use<> {
        let tiles_across = self.tiles_across;
        (tiles.start / tiles_across.max(1)..tiles.end.div_ceil(tiles_across.max(1))).map(move |y| {
            let row = y * tiles_across;
            (y, tiles.start.max(row) - row..tiles.end.min(row + tiles_across) - row)
        })
    }

    /// Splits the range `tiles` of tile numbers into parts of rows of tiles: about `count` parts, but no part has tiles
    /// of two rows. Yields for each part the index of its row and the range of columns of its tiles.
    pub(super) fn row_parts(
        &self,
        tiles: Range<usize>,
        count: usize,
    ) -> impl Iterator<Item = (usize, Range<usize>)> + use<> {
        let row_count = self.rows(tiles.clone()).count().max(1);
        let len = self.tiles_across.div_ceil(count.div_ceil(row_count).max(1)).max(1);
        self.rows(tiles)
            .flat_map(move |(y, columns)| columns.clone().step_by(len).map(move |x| (y, x..columns.end.min(x + len))))
    }

    /// Returns the indices of the splats of the tiles in row `y` and columns `x` of the grid of tiles, tile after tile.
    /// The tiles must lie in the range that [`Bins::next_strip`] returned last, because only its pairs are in memory.
    pub(super) fn pairs_in_row(&self, y: usize, x: Range<usize>) -> &[u32] {
        self.pairs(y * self.tiles_across + x.start..y * self.tiles_across + x.end)
    }

    /// Returns the number of (splat, tile) pairs of all tiles before `tile`, over the whole render.
    fn start(&self, tile: usize) -> usize {
        tile.checked_sub(1).map_or(0, |before| self.ends[before])
    }
}

/// Number of bits of a digit of the radix sort. The counts of all values of a digit fit in the first-level cache.
const DIGIT_BITS: u32 = 11;

/// Sorts `keys` (depth in the upper 32 bits, index of the splat in the lower 32) by depth. Keys of equal depth keep
/// their order. The caller passes keys with increasing indices, so the result is sorted by depth, then by index.
/// `spare` is a buffer for reuse; its content has no meaning.
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

/// Maps `x` to an integer so that larger numbers have larger integers. Negative depths occur, because rounding far from
/// the origin can give a visible Gaussian a negative f32 depth.
fn ordered_bits(x: f32) -> u32 {
    let bits = x.to_bits();
    if bits >> 31 == 0 { bits | 1 << 31 } else { !bits }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn row_parts_cover_every_tile_once() {
        let bins = Bins { tiles_across: 7, ..Bins::default() };
        let cases = [(0..35, 1, 5), (0..35, 5, 5), (0..35, 16, 20), (3..26, 16, 13), (9..12, 100, 3), (4..4, 3, 0)];
        for (tiles, count, expected) in cases {
            let parts: Vec<_> = bins.row_parts(tiles.clone(), count).collect();
            let found = parts.iter().flat_map(|(y, columns)| columns.clone().map(move |x| 7 * y + x));
            assert!(found.eq(tiles), "{parts:?}");
            assert_eq!(parts.len(), expected, "{parts:?}");
        }
    }

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
