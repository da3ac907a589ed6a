//! Which splats reach which tile, front to back.
//!
//! One radix sort by depth over the whole picture, then a counting sort into tiles that keeps that order, a strip of
//! tiles at a time: how many pairs there are depends on the picture alone, how many lie ready does not.
//! Memory: 16 bytes per splat, 4 per pair of a splat and a tile of the strip.

use std::ops::Range;

use super::project::{Splats, TileRect};

/// Pairs of a strip, unless one tile alone has more.
pub(super) const STRIP_PAIRS: usize = 1 << 20;

/// Splats whose tiles are read together: one after the other, each would wait for memory alone.
const TOGETHER: usize = 64;

/// Indices of splats, grouped by tile, nearest first.
#[derive(Debug, Clone, Default)]
pub(super) struct Bins {
    /// (ordered depth bits, splat) of every splat, sorted.
    keys: Vec<u64>,
    /// Room to sort them.
    spare: Vec<u64>,
    /// Tiles across.
    across: usize,
    /// End of each tile's pairs among those of the whole picture; tile t begins where t − 1 ends.
    ends: Vec<usize>,
    /// Tiles before this one were handed out.
    after: usize,
    /// Tiles whose pairs lie ready.
    strip: Range<usize>,
    pairs: Vec<u32>,
    /// Where in `pairs` the next pair of each tile of the strip goes, then the end of all.
    next: Vec<u32>,
}

impl Bins {
    /// Sorts `splats` and counts their pairs with `tiles` = (across, down) tiles; no pairs lie ready yet.
    pub(super) fn begin(&mut self, splats: &Splats, tiles: [u32; 2]) {
        self.keys.clear();
        self.keys.reserve_exact(splats.splats.len());
        let depths = splats.splats.iter().map(|splat| u64::from(ordered_bits(splat.order)));
        self.keys.extend(depths.enumerate().map(|(i, bits)| bits << 32 | i as u64));
        sort_by_depth(&mut self.keys, &mut self.spare);

        self.across = tiles[0] as usize;
        self.ends.clear();
        self.ends.resize(self.across * tiles[1] as usize, 0);
        for rect in &splats.rects {
            for y in rect.y0 as usize..rect.y1 as usize {
                for count in &mut self.ends[y * self.across + rect.x0 as usize..y * self.across + rect.x1 as usize] {
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
        self.after = 0;
    }

    /// Lets [`Bins::next_strip`] begin again with the first tiles; if one strip held all, its pairs are kept.
    pub(super) fn rewind(&mut self) {
        self.after = 0;
    }

    /// Makes the pairs of the next strip of tiles ready: whole rows of tiles with at most `most` pairs, else part
    /// of a row, else one tile; none after the last. `splats` are those of [`Bins::begin`].
    pub(super) fn next_strip(&mut self, splats: &Splats, most: usize) -> Option<Range<usize>> {
        if self.is_last_strip() {
            return None;
        }
        let strip = self.first_part(self.after..self.ends.len(), most);
        let before = self.start(strip.start);
        self.after = strip.end;
        if strip == self.strip {
            return Some(strip);
        }
        self.strip = strip;

        self.next.clear();
        self.next.push(0);
        // A strip of more than `most` is one tile, with no more pairs than there are splats.
        self.next.extend(self.ends[self.strip.clone()].iter().map(|end| (end - before) as u32));
        // What is there already will be written over.
        self.pairs.resize(self.next.last().map_or(0, |&total| total as usize), 0);
        let rows = self.strip.start / self.across..self.strip.end.div_ceil(self.across);
        for keys in self.keys.chunks(TOGETHER) {
            let mut reached = [(0, TileRect::default()); TOGETHER];
            for (reached, &key) in reached.iter_mut().zip(keys) {
                *reached = (key as u32, splats.rects[key as u32 as usize]);
            }
            for &(splat, rect) in &reached[..keys.len()] {
                for y in rows.start.max(rect.y0 as usize)..rows.end.min(rect.y1 as usize) {
                    let row = y * self.across;
                    let from = (row + rect.x0 as usize).max(self.strip.start);
                    let to = (row + rect.x1 as usize).min(self.strip.end);
                    for tile in from..to {
                        let at = &mut self.next[tile - self.strip.start];
                        self.pairs[*at as usize] = splat;
                        *at += 1;
                    }
                }
            }
        }
        Some(self.strip.clone())
    }

    /// Of `tiles`, which are some: whole rows with at most `most` pairs from the first, else part of a row, else one tile.
    fn first_part(&self, tiles: Range<usize>, most: usize) -> Range<usize> {
        let Range { start: first, end: last } = tiles;
        let before = self.start(first);
        let fitting = self.ends[first..last].partition_point(|&end| end - before <= most);
        let end = first + fitting.max(1);
        let whole_rows = end - end % self.across;
        first..if whole_rows > first && end < last { whole_rows } else { end }
    }

    /// `tiles` in parts of at most `most` pairs, else of one tile.
    pub(super) fn parts(&self, mut tiles: Range<usize>, most: usize) -> impl Iterator<Item = Range<usize>> {
        std::iter::from_fn(move || {
            let part = (!tiles.is_empty()).then(|| self.first_part(tiles.clone(), most))?;
            tiles.start = part.end;
            Some(part)
        })
    }

    /// Whether no tiles come after those handed out.
    pub(super) fn is_last_strip(&self) -> bool {
        self.after == self.ends.len()
    }

    /// The splats of every (splat, tile) pair of `tiles` of the strip, tile after tile.
    pub(super) fn pairs(&self, tiles: Range<usize>) -> &[u32] {
        let before = self.start(self.strip.start);
        &self.pairs[self.start(tiles.start) - before..self.start(tiles.end) - before]
    }

    /// The rows of which `tiles` has some, each with the part it has, as tiles across.
    pub(super) fn rows(&self, tiles: Range<usize>) -> impl Iterator<Item = (usize, Range<usize>)> + use<> {
        let across = self.across;
        (tiles.start / across.max(1)..tiles.end.div_ceil(across.max(1))).map(move |y| {
            let row = y * across;
            (y, tiles.start.max(row) - row..tiles.end.min(row + across) - row)
        })
    }

    /// The splats of tiles `x` of row `y`, of the strip.
    pub(super) fn pairs_of(&self, y: usize, x: Range<usize>) -> &[u32] {
        self.pairs(y * self.across + x.start..y * self.across + x.end)
    }

    fn start(&self, tile: usize) -> usize {
        tile.checked_sub(1).map_or(0, |before| self.ends[before])
    }
}

/// Bits of a digit: its counts stay in the first-level cache.
const DIGIT: u32 = 11;

/// Sorts keys that increase in their lower halves by their upper halves, ties in the order they have; `spare` is room.
fn sort_by_depth(keys: &mut Vec<u64>, spare: &mut Vec<u64>) {
    spare.clear();
    spare.resize(keys.len(), 0);
    for shift in [32, 32 + DIGIT, 32 + 2 * DIGIT] {
        let digit = |key: u64| (key >> shift) as usize % (1 << DIGIT);
        let mut places = [0; 1 << DIGIT];
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

/// The bits of an f32, ordered as its values are. (Rounding far from the origin can leave a visible
/// Gaussian a negative f32 depth.)
fn ordered_bits(x: f32) -> u32 {
    let bits = x.to_bits();
    if bits >> 31 == 0 { bits | 1 << 31 } else { !bits }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_sorted_by_all_their_bits() {
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
    fn bits_are_ordered_as_their_floats() {
        let values = [f32::NEG_INFINITY, -3.0, -1e-30, 0.0, 1e-40, 0.2, 7.5, f32::INFINITY];
        assert!(values.is_sorted_by(|&a, &b| ordered_bits(a) < ordered_bits(b)));
    }
}
