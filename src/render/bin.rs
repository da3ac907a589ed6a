//! Which splats reach which tile, front to back.
//!
//! One sort by depth over the whole picture, then a counting sort into tiles that keeps that order.
//! Memory: 8 bytes per splat and 4 bytes per (splat, tile) pair.

use std::ops::Range;

use rayon::slice::ParallelSliceMut;

use super::project::Splats;

/// Indices of splats, grouped by tile, nearest first.
#[derive(Debug, Default)]
pub(super) struct Bins {
    /// (ordered depth bits, splat) of every splat, to sort.
    keys: Vec<u64>,
    /// End of each tile's pairs; tile t begins where t − 1 ends.
    ends: Vec<usize>,
    pairs: Vec<u32>,
}

impl Bins {
    /// Bins `splats` into `tiles` = (across, down) tiles, on all threads of the pool if `parallel`.
    pub(super) fn fill(&mut self, splats: &Splats, tiles: [u32; 2], parallel: bool) {
        self.keys.clear();
        // Ties fall to the lower index.
        let depths = splats.splats.iter().map(|splat| u64::from(ordered_bits(splat.order)));
        self.keys.extend(depths.enumerate().map(|(i, bits)| bits << 32 | i as u64));
        if parallel {
            self.keys.par_sort_unstable();
        } else {
            self.keys.sort_unstable();
        }

        let across = tiles[0] as usize;
        self.ends.clear();
        self.ends.resize(across * tiles[1] as usize + 1, 0);
        for rect in &splats.rects {
            for y in rect.y0 as usize..rect.y1 as usize {
                for count in &mut self.ends[y * across + rect.x0 as usize + 1..y * across + rect.x1 as usize + 1] {
                    *count += 1;
                }
            }
        }
        let mut total = 0;
        for end in &mut self.ends {
            total += *end;
            *end = total;
        }
        // From here `ends[t]` is where tile t's next pair goes; once all are placed, it is the tile's end.
        self.pairs.clear();
        self.pairs.resize(total, 0);
        for &key in &self.keys {
            let splat = key as u32;
            let rect = splats.rects[splat as usize];
            for y in rect.y0 as usize..rect.y1 as usize {
                for at in &mut self.ends[y * across + rect.x0 as usize..y * across + rect.x1 as usize] {
                    self.pairs[*at] = splat;
                    *at += 1;
                }
            }
        }
        self.ends.pop();
    }

    /// The splats of every (splat, tile) pair, tile after tile.
    pub(super) fn pairs(&self) -> &[u32] {
        &self.pairs
    }

    /// Where in [`Bins::pairs`] the tiles `tiles` lie.
    pub(super) fn range(&self, tiles: Range<usize>) -> Range<usize> {
        let end = |tile: usize| tile.checked_sub(1).map_or(0, |before| self.ends[before]);
        end(tiles.start)..end(tiles.end)
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
