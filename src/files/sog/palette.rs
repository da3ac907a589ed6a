//! Vector quantization by k-means: chooses a palette of at most k vectors of SH coefficients for N Gaussians. Each
//! Gaussian then refers to the nearest palette entry.
//!
//! K-means first divides the vectors of all Gaussians into √k groups. Each group gets a number of palette entries in
//! proportion to its size, and k-means chooses these entries. This takes about N·√k comparisons of vectors per
//! iteration instead of N·k. Starting points are evenly spaced in the order of the Gaussians, so the same Gaussians
//! give the same palette for any number of threads.

use rayon::prelude::*;

/// Maximum number of palette entries of a `.sog` file.
pub const MAX_ENTRIES: usize = 1 << 16;
/// Number of iterations of k-means.
const ITERATIONS: usize = 6;
/// Number of vectors, per group of vectors, in the sample from which k-means computes the centers of the groups.
const SAMPLES_PER_GROUP: usize = 64;

/// Palette of vectors (SH coefficients), and for each Gaussian the index of its palette entry.
#[derive(Debug, Clone, PartialEq)]
pub struct Palette {
    /// Number of components of a vector (palette entry).
    pub width: usize,
    /// Palette entries, one after another, `width` numbers each.
    pub centroids: Vec<f32>,
    /// Index of the palette entry of each Gaussian.
    pub labels: Vec<u32>,
}

impl Palette {
    /// Chooses a palette of at most `max_entries` vectors with `width` components for `count` Gaussians. `vector`
    /// receives the index of a Gaussian and appends the vector of this Gaussian to a list.
    ///
    /// - If `max_entries` is at least the number of Gaussians, each Gaussian gets its own entry.
    /// - If it is less, similar vectors share an entry, and equal vectors always do.
    pub fn fit(
        count: usize,
        width: usize,
        max_entries: usize,
        vector: impl Fn(usize, &mut Vec<f32>) + Sync,
    ) -> Palette {
        let gather = |rows: &mut dyn Iterator<Item = usize>| {
            let mut vectors = Vec::new();
            rows.for_each(|row| vector(row, &mut vectors));
            vectors
        };
        let entries = max_entries.clamp(1, MAX_ENTRIES).min(count.max(1));
        if entries >= count {
            return Palette { width, centroids: gather(&mut (0..count)), labels: (0..count as u32).collect() };
        }
        let group_count = (entries as f64).sqrt().ceil() as usize;
        let sample_count = count.min(group_count * SAMPLES_PER_GROUP);
        let sample = gather(&mut evenly_spaced(count, sample_count));
        let groups = k_means(&sample, width, group_count);
        let group_of: Vec<u32> = (0..count)
            .into_par_iter()
            .map_init(Vec::new, |row_values, row| {
                row_values.clear();
                vector(row, row_values);
                nearest(row_values, &groups, width)
            })
            .collect();
        let mut members = vec![Vec::new(); group_count];
        group_of.iter().enumerate().for_each(|(row, &group)| members[group as usize].push(row as u32));
        drop(group_of);
        // Every group gets an entry per `count / entries` members, but at least one and not more than it has members.
        let shares = shares(&members.iter().map(Vec::len).collect::<Vec<_>>(), entries);
        let found: Vec<(Vec<f32>, Vec<u32>)> = members
            .par_iter()
            .zip(&shares)
            .map(|(rows, &share)| {
                let vectors = gather(&mut rows.iter().map(|&row| row as usize));
                let centroids = k_means(&vectors, width, share);
                let labels = vectors.chunks_exact(width).map(|row| nearest(row, &centroids, width)).collect();
                (centroids, labels)
            })
            .collect();
        let (mut centroids, mut labels) = (Vec::new(), vec![0; count]);
        for (rows, (of_group, label_of_row)) in members.iter().zip(found) {
            let first = (centroids.len() / width) as u32;
            rows.iter().zip(label_of_row).for_each(|(&row, label)| labels[row as usize] = first + label);
            centroids.extend(of_group);
        }
        Palette { width, centroids, labels }
    }

    /// Returns the number of palette entries.
    pub fn len(&self) -> usize {
        self.centroids.len() / self.width
    }

    /// Returns whether the palette has no entries.
    pub fn is_empty(&self) -> bool {
        self.centroids.is_empty()
    }
}

/// Returns `target_count` evenly spaced numbers below `count`.
fn evenly_spaced(count: usize, target_count: usize) -> impl Iterator<Item = usize> {
    (0..target_count).map(move |i| (i as u128 * count as u128 / target_count as u128) as usize)
}

/// Returns the number of palette entries that each group of vectors gets, when `entries` palette entries are divided in
/// proportion to the sizes of the groups. `sizes` holds the number of vectors in each group. A group that is not empty
/// gets at least one entry and at most one per vector; the sum is at most `entries`.
fn shares(sizes: &[usize], entries: usize) -> Vec<usize> {
    let total: usize = sizes.iter().sum();
    let filled = sizes.iter().filter(|&&size| size > 0).count();
    let free = entries.saturating_sub(filled);
    sizes
        .iter()
        .map(|&size| match size {
            0 => 0,
            _ => (1 + (free as u128 * size as u128 / total as u128) as usize).min(size),
        })
        .collect()
}

/// Returns `k` centroids of `vectors` (`width` components each) by Lloyd's k-means. A centroid that loses all its
/// vectors is left unchanged.
fn k_means(vectors: &[f32], width: usize, k: usize) -> Vec<f32> {
    let count = vectors.len() / width;
    let row = |i: usize| &vectors[i * width..][..width];
    let mut centroids: Vec<f32> = evenly_spaced(count, k.min(count)).flat_map(|i| row(i).iter().copied()).collect();
    if k >= count {
        return centroids;
    }
    for _ in 0..ITERATIONS {
        let (mut sums, mut counts) = (vec![0f64; k * width], vec![0u32; k]);
        for vector in vectors.chunks_exact(width) {
            let at = nearest(vector, &centroids, width) as usize;
            counts[at] += 1;
            sums[at * width..][..width].iter_mut().zip(vector).for_each(|(sum, &x)| *sum += f64::from(x));
        }
        let mut moved = false;
        for (at, centroid) in centroids.chunks_exact_mut(width).enumerate().filter(|&(at, _)| counts[at] > 0) {
            for (c, sum) in centroid.iter_mut().zip(&sums[at * width..]) {
                let mean = (sum / f64::from(counts[at])) as f32;
                moved |= mean != *c;
                *c = mean;
            }
        }
        if !moved {
            break;
        }
    }
    centroids
}

/// Returns the index of the centroid nearest to `vector` among `centroids` (`width` components each), the first of
/// several equally near ones.
fn nearest(vector: &[f32], centroids: &[f32], width: usize) -> u32 {
    let (mut best, mut least) = (0, f32::INFINITY);
    for (at, centroid) in centroids.chunks_exact(width).enumerate() {
        // Eight partial sums in a fixed order, which the compiler can compute with vector instructions.
        let mut sums = [0f32; 8];
        for (a, b) in vector.chunks(8).zip(centroid.chunks(8)) {
            for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
                *sum += (a - b) * (a - b);
            }
        }
        let distance: f32 = sums.iter().sum();
        if distance < least {
            (best, least) = (at as u32, distance);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns component `c` of test vector number `row`. The vectors form 20 clusters with a little noise.
    fn component(row: usize, c: usize) -> f32 {
        let cluster = (row * 7919) % 20;
        let noise = ((row * 31 + c * 17) % 101) as f32 / 101.0 - 0.5;
        ((cluster * (c + 3)) % 11) as f32 / 5.0 + 0.02 * noise
    }

    fn fit(count: usize, max_entries: usize) -> Palette {
        Palette::fit(count, 9, max_entries, |row, out| out.extend((0..9).map(|c| component(row, c))))
    }

    fn mean_square(palette: &Palette) -> f64 {
        let error = |(row, &label): (usize, &u32)| {
            let entry = &palette.centroids[9 * label as usize..][..9];
            entry.iter().enumerate().map(|(c, x)| f64::from(x - component(row, c)).powi(2)).sum::<f64>()
        };
        palette.labels.iter().enumerate().map(error).sum::<f64>() / palette.labels.len() as f64
    }

    #[test]
    fn vectors_are_near_their_entries() {
        let palette = fit(5000, 400);
        assert!(palette.len() <= 400 && palette.labels.len() == 5000);
        assert!(palette.labels.iter().all(|&label| (label as usize) < palette.len()));
        let found = mean_square(&palette);
        assert!(found < 9.0 * 0.02f64.powi(2) / 12.0, "{found}");
    }

    #[test]
    fn palette_ignores_thread_count() {
        let with =
            |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| fit(3000, 128));
        assert_eq!(with(1), with(3));
    }

    #[test]
    fn few_vectors_are_stored_exactly() {
        for count in [0, 1, 2, 7, 50] {
            let palette = fit(count, 1024);
            assert_eq!(palette.labels.len(), count);
            assert!(count == 0 || mean_square(&palette) < 1e-12, "{count}");
        }
    }
}
