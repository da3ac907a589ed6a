//! Histograms of the scores of kept, merged and dropped Gaussians.
//!
//! Input: one value per Gaussian, and its fate (kept, merged or dropped). Output: counts per bin and fate. Bins of most
//! scores have equal ratios of upper to lower edge, because scores span many powers of ten. Bins of values that are
//! fractions of the frames have equal width from 0 to 1. Zeros are counted separately.

use std::borrow::Cow;

use serde::Serialize;

use super::run::Fate;
use crate::files::csv::table;
use crate::model::{Statistic, StatisticArray, StatisticRows};
use crate::statistics::score::{ScoredQuantity, Scores};

/// Maximum number of bins of a histogram.
const BINS: usize = 40;
/// Minimum of the lower edge of the first bin, as a fraction of the largest value. Smaller positive values are counted
/// in the first bin.
const MIN_LOW_EDGE: f64 = 1e-8;

/// One value for each fate of Gaussians: kept, merged, dropped.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct ByFate<T> {
    /// Value for Gaussians that remain unchanged.
    pub kept: T,
    /// Value for Gaussians that were merged into a proxy (Gaussian that replaces a cluster).
    pub merged: T,
    /// Value for Gaussians that were removed without being merged.
    pub dropped: T,
}

impl<T> ByFate<T> {
    /// Returns a mutable reference to the value for the Gaussians with the fate `fate` (kept, merged or dropped).
    pub fn get_mut(&mut self, fate: Fate) -> &mut T {
        match fate {
            Fate::Kept => &mut self.kept,
            Fate::Merged => &mut self.merged,
            Fate::Dropped => &mut self.dropped,
        }
    }
}

/// Histogram of one score over all Gaussians.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Histogram {
    /// Name of the score or statistic.
    pub name: &'static str,
    /// Meaning of the score or statistic, with its unit.
    pub meaning: &'static str,
    /// Whether the bins are logarithmic: all bins have the same ratio of upper to lower edge. Bins that are not
    /// logarithmic have the same width and cover 0 to 1.
    pub log: bool,
    /// Edges of the bins in increasing order, one more than there are bins; empty if no value is positive.
    pub edges: Vec<f64>,
    /// Numbers of kept, merged and dropped Gaussians in each bin. A bin includes its lower edge, the last bin also its
    /// upper edge. The first bin also has the positive values below its lower edge.
    pub bins: ByFate<Vec<usize>>,
    /// Numbers of kept, merged and dropped Gaussians whose value is not positive or not finite.
    pub zero: ByFate<usize>,
}

/// Returns the histograms of every score and statistic, with separate counts for each fate (kept, merged, dropped).
/// `frames` is the number of frames.
pub fn histograms(rows: &StatisticRows, scores: &Scores, frames: usize, fates: &[Fate]) -> Vec<Histogram> {
    use Statistic::{C, D, Kappa, Life, V, Vis, W};
    let scores = [
        ("S", "the whole score", &scores.score),
        (ScoredQuantity::Static.name(), ScoredQuantity::Static.measured_property(), &scores.static_score),
        (ScoredQuantity::Dynamic.name(), ScoredQuantity::Dynamic.measured_property(), &scores.dynamic_score),
    ];
    let part = |&count: &u32| f64::from(count) / frames.max(1) as f64;
    let statistic = |of: Statistic| {
        let (values, most) = match of.accessors() {
            StatisticArray::F64(values, _) => (Cow::Borrowed(&values(rows)[..]), None),
            StatisticArray::U32(values, _) => (values(rows).iter().map(part).collect(), Some(frames)),
        };
        (of.name(), of.meaning(), values, most)
    };
    let scores = scores.map(|(name, meaning, values)| (name, meaning, Cow::Borrowed(&values[..]), None));
    let all = scores.into_iter().chain([C, W, D, Kappa, V, Life, Vis].map(statistic));
    // W exists only with visible coverage.
    all.filter(|(_, _, values, _)| values.len() == fates.len() && !fates.is_empty())
        .map(|(name, meaning, values, parts)| match parts {
            Some(frames) => Histogram::within(name, meaning, even(frames), &values, fates),
            None => Histogram::from_values(name, meaning, &values, fates),
        })
        .collect()
}

/// Returns the edges of bins of equal width from 0 to 1, for values that are multiples of 1 / `frames`. There are at
/// most [`BINS`] bins, and at most `frames`, so that no bin is narrower than 1 / `frames`.
fn even(frames: usize) -> Vec<f64> {
    let bins = frames.clamp(1, BINS);
    (0..=bins).map(|k| k as f64 / bins as f64).collect()
}

impl Histogram {
    /// Counts `values` (one per Gaussian, with its fate in `fates`) in bins with equal ratios of upper to lower edge.
    /// Returns the histogram of the quantity `name`, whose meaning is `meaning`.
    fn from_values(name: &'static str, meaning: &'static str, values: &[f64], fates: &[Fate]) -> Histogram {
        let positive = |v: &f64| *v > 0.0 && v.is_finite();
        let (mut low, high) = values
            .iter()
            .copied()
            .filter(positive)
            .fold((f64::INFINITY, 0.0f64), |(low, high), v| (low.min(v), high.max(v)));
        low = low.max(high * MIN_LOW_EDGE);
        let bins = if high == 0.0 {
            0
        } else if low == high {
            1
        } else {
            BINS
        };
        let step = (high / low).ln() / bins.max(1) as f64;
        let edges = match bins {
            0 => Vec::new(),
            1 => vec![low / 1.1, high * 1.1],
            _ => (0..=bins).map(|k| if k == bins { high } else { low * (step * k as f64).exp() }).collect(),
        };
        Histogram { log: true, ..Histogram::within(name, meaning, edges, values, fates) }
    }

    /// Counts `values` (one per Gaussian, with its fate in `fates`) in the bins between `edges`. Returns the histogram
    /// of the quantity `name`, whose meaning is `meaning`.
    fn within(name: &'static str, meaning: &'static str, edges: Vec<f64>, values: &[f64], fates: &[Fate]) -> Histogram {
        let positive = |v: &f64| *v > 0.0 && v.is_finite();
        let bins = edges.len().saturating_sub(1);
        let empty = || vec![0; bins];
        let mut found = Histogram {
            name,
            meaning,
            log: false,
            edges,
            bins: ByFate { kept: empty(), merged: empty(), dropped: empty() },
            zero: ByFate::default(),
        };
        for (value, &fate) in values.iter().zip(fates) {
            if !positive(value) {
                *found.zero.get_mut(fate) += 1;
                continue;
            }
            // Rounding of a logarithm could put an edge into the bin below.
            let bin = found.edges.partition_point(|edge| edge <= value).clamp(1, bins) - 1;
            found.bins.get_mut(fate)[bin] += 1;
        }
        found
    }
}

/// Returns a CSV table of all histograms: one line per bin, and one line per score for the values that are not positive
/// or not finite.
pub fn csv(histograms: &[Histogram]) -> String {
    let mut rows = Vec::new();
    for Histogram { name, edges, bins, zero, .. } in histograms {
        let mut add = |from: f64, to: f64, counts: [usize; 3]| {
            let edges = [name.to_string(), from.to_string(), to.to_string()];
            rows.push(edges.into_iter().chain(counts.map(|count| count.to_string())).collect());
        };
        add(0.0, 0.0, [zero.kept, zero.merged, zero.dropped]);
        for (bin, edges) in edges.windows(2).enumerate() {
            add(edges[0], edges[1], [bins.kept[bin], bins.merged[bin], bins.dropped[bin]]);
        }
    }
    table(&["score", "from", "to", "kept", "merged", "dropped"], rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_gaussian_is_counted_once_in_the_bin_that_holds_it() {
        let values: Vec<f64> = (0..1000).map(|i| if i % 7 == 0 { 0.0 } else { 1.01f64.powi(i) }).collect();
        let fates: Vec<Fate> = (0..1000).map(|i| [Fate::Kept, Fate::Merged, Fate::Dropped][(i % 3) as usize]).collect();
        let found = Histogram::from_values("S", "", &values, &fates);
        for (fate, bins, zero) in [
            (Fate::Kept, &found.bins.kept, found.zero.kept),
            (Fate::Merged, &found.bins.merged, found.zero.merged),
            (Fate::Dropped, &found.bins.dropped, found.zero.dropped),
        ] {
            let of: Vec<f64> = values.iter().zip(&fates).filter(|(_, f)| **f == fate).map(|(v, _)| *v).collect();
            assert_eq!(zero, of.iter().filter(|v| **v == 0.0).count());
            for (bin, edges) in found.edges.windows(2).enumerate() {
                let last = bin + 2 == found.edges.len();
                let inside = |v: &&f64| **v >= edges[0] && (**v < edges[1] || (last && **v == edges[1]));
                assert_eq!(bins[bin], of.iter().filter(inside).count(), "{fate:?}, bin {bin}");
            }
        }
    }

    #[test]
    fn one_value_has_one_bin_and_no_value_has_no_bin() {
        let found = Histogram::from_values("V", "", &[2.0, 2.0, f64::NAN], &[Fate::Kept; 3]);
        assert_eq!((found.bins.kept.clone(), found.zero.kept), (vec![2], 1));
        assert!(found.edges[0] < 2.0 && found.edges[1] > 2.0);
        let found = Histogram::from_values("V", "", &[0.0; 3], &[Fate::Dropped; 3]);
        assert_eq!((found.edges.len(), found.zero.dropped), (0, 3));
        let far = Histogram::from_values("D", "", &[1e-300, 1.0], &[Fate::Kept; 2]);
        assert_eq!(far.bins.kept.iter().sum::<usize>(), 2);
        assert_eq!(far.bins.kept[0], 1, "what is far below is in the first bin");
    }

    #[test]
    fn fractions_of_frames_have_bins_from_0_to_1() {
        // 4 of 10 frames, 7 of 10, and twice all of them.
        let found = Histogram::within("life", "", even(10), &[0.4, 0.7, 1.0, 1.0, 0.0], &[Fate::Kept; 5]);
        assert_eq!((found.edges[0], found.edges[10], found.log), (0.0, 1.0, false));
        assert_eq!(found.bins.kept, [0, 0, 0, 0, 1, 0, 0, 1, 0, 2]);
        assert_eq!(found.zero.kept, 1);
        assert_eq!((even(1000).len(), even(1).len(), even(0).len()), (BINS + 1, 2, 2));
    }

    #[test]
    fn csv_is_these_bytes() {
        let bins = ByFate { kept: vec![1, 0], merged: vec![2, 3], dropped: vec![0, 4] };
        let zero = ByFate { kept: 5, merged: 0, dropped: 6 };
        let of = Histogram { name: "C", meaning: "", log: true, edges: vec![1e-7, 0.5, 2.0], bins, zero };
        assert_eq!(
            csv(&[of]),
            "score,from,to,kept,merged,dropped\nC,0,0,5,0,6\nC,0.0000001,0.5,1,2,0\nC,0.5,2,0,3,4\n"
        );
    }
}
