//! Which splats reach which tile, front to back.
//!
//! One sort by depth over the whole picture, then a counting sort into tiles that keeps that order, a strip of
//! tiles at a time: how many pairs there are depends on the picture alone, how many lie ready does not.
//! Memory: 8 bytes per splat, 4 per pair of a splat and a tile of the strip.

use std::ops::Range;

use rayon::slice::ParallelSliceMut;

use super::project::Splats;

/// Pairs of a strip, unless one tile alone has more.
pub(super) const STRIP_PAIRS: usize = 1 << 20;

/// Indices of splats, grouped by tile, nearest first.
#[derive(Debug, Clone, Default)]
pub(super) struct Bins {
    /// (ordered depth bits, splat) of every splat, sorted.
    keys: Vec<u64>,
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
    next: Vec<usize>,
}

impl Bins {
    /// Sorts `splats` and counts their pairs with `tiles` = (across, down) tiles, on all threads of the pool if
    /// `parallel`; no pairs lie ready yet.
    pub(super) fn begin(&mut self, splats: &Splats, tiles: [u32; 2], parallel: bool) {
        self.keys.clear();
        self.keys.reserve_exact(splats.splats.len());
        // Ties fall to the lower index.
        let depths = splats.splats.iter().map(|splat| u64::from(ordered_bits(splat.order)));
        self.keys.extend(depths.enumerate().map(|(i, bits)| bits << 32 | i as u64));
        if parallel {
            self.keys.par_sort_unstable();
        } else {
            self.keys.sort_unstable();
        }

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
        let first = self.after;
        let before = self.start(first);
        let fitting = self.ends[first..].partition_point(|&end| end - before <= most);
        let end = first + fitting.max(1);
        let whole_rows = end - end % self.across;
        let strip = first..if whole_rows > first { whole_rows } else { end };
        self.after = strip.end;
        if strip == self.strip {
            return Some(strip);
        }
        self.strip = strip;

        self.next.clear();
        self.next.push(0);
        self.next.extend(self.ends[self.strip.clone()].iter().map(|end| end - before));
        self.pairs.clear();
        self.pairs.resize(self.next.last().map_or(0, |&total| total), 0);
        let rows = self.strip.start / self.across..self.strip.end.div_ceil(self.across);
        for &key in &self.keys {
            let splat = key as u32;
            let rect = splats.rects[splat as usize];
            for y in rows.start.max(rect.y0 as usize)..rows.end.min(rect.y1 as usize) {
                let row = y * self.across;
                let from = (row + rect.x0 as usize).max(self.strip.start);
                let to = (row + rect.x1 as usize).min(self.strip.end);
                for tile in from..to {
                    let at = &mut self.next[tile - self.strip.start];
                    self.pairs[*at] = splat;
                    *at += 1;
                }
            }
        }
        Some(self.strip.clone())
    }

    /// Whether no tiles come after those handed out.
    pub(super) fn is_last_strip(&self) -> bool {
        self.after == self.ends.len()
    }

    /// The splats of every (splat, tile) pair of the strip, tile after tile.
    pub(super) fn pairs(&self) -> &[u32] {
        &self.pairs
    }

    /// The rows of tiles of which the strip has some, each with the part it has, as tiles across.
    pub(super) fn rows(&self) -> impl Iterator<Item = (usize, Range<usize>)> + use<> {
        let (across, strip) = (self.across, self.strip.clone());
        (strip.start / across.max(1)..strip.end.div_ceil(across.max(1))).map(move |y| {
            let row = y * across;
            (y, strip.start.max(row) - row..strip.end.min(row + across) - row)
        })
    }

    /// Where in [`Bins::pairs`] tiles `x` of row `y`, of the strip, lie.
    pub(super) fn range(&self, y: usize, x: Range<usize>) -> Range<usize> {
        let (row, before) = (y * self.across, self.start(self.strip.start));
        self.start(row + x.start) - before..self.start(row + x.end) - before
    }

    fn start(&self, tile: usize) -> usize {
        tile.checked_sub(1).map_or(0, |before| self.ends[before])
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
    fn bits_are_ordered_as_their_floats() {
        let values = [f32::NEG_INFINITY, -3.0, -1e-30, 0.0, 1e-40, 0.2, 7.5, f32::INFINITY];
        assert!(values.is_sorted_by(|&a, &b| ordered_bits(a) < ordered_bits(b)));
    }
}
