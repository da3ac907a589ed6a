//! Wrapper [`AsToml`], with which summaries of stages are stored in cache entries (files with the result of a stage).

use serde::de::{DeserializeOwned, Error as _};
use serde::ser::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Wrapper that serializes a summary as TOML text, for storage in a cache entry. Summaries may leave fields out, which
/// the binary format of cache entries does not support. TOML supports this and, unlike JSON, also stores NaN and
/// infinities.
#[derive(Debug)]
pub(crate) struct AsToml<T>(pub(crate) T);

impl<T: Serialize> Serialize for AsToml<T> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        toml::to_string(&self.0).map_err(S::Error::custom)?.serialize(to)
    }
}

impl<'de, T: DeserializeOwned> Deserialize<'de> for AsToml<T> {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        let text = String::deserialize(from)?;
        toml::from_str(&text).map(AsToml).map_err(D::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::journal::Journal;
    use crate::journal::records::{FieldPrecisionSummary, RefinedSummary, SavedCost, ShDegreeSummary};
    use crate::pipeline::summary::{ArchiveSummary, GoalSummary};

    fn kept<T: Serialize + DeserializeOwned>(value: T) -> T {
        postcard::from_bytes::<AsToml<T>>(&postcard::to_stdvec(&AsToml(value)).unwrap()).unwrap().0
    }

    /// Checks that `value` is unchanged after it was stored and read. Compares texts, because NaN is not equal to
    /// itself.
    fn same<T: Serialize + DeserializeOwned + Clone + std::fmt::Debug>(value: &T) {
        assert_eq!(format!("{:?}", kept(value.clone())), format!("{value:?}"));
    }

    #[test]
    fn nan_and_infinity_are_read_back_unchanged() {
        for odd in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.1 + 0.2, 1e-300, -0.0] {
            let tried = vec![(7, odd), (9, 30.0)];
            same(&ArchiveSummary {
                asked: odd,
                psnr: odd,
                level: odd,
                loss: odd,
                is_refined: true,
                parts: None,
                bounds: Some(BTreeMap::from([("position".to_owned(), odd)])),
                bits: BTreeMap::new(),
                measured: vec![("a.b \"c\"".to_owned(), odd, 1.0, odd)],
            });
            let (name, held_views) = ("min_psnr".to_owned(), vec!["t000_between".to_owned()]);
            same(&GoalSummary {
                name,
                is_met: false,
                asked: 30.0,
                before_conversion: true,
                searched: odd,
                held: odd,
                held_views,
                tried: tried.clone(),
            });
            let mut journal = Journal::default();
            journal.leave_out("a", "b");
            journal.leave_out_with_saving("c", "d", SavedCost::Stage { seconds: odd, reads: 2.0 });
            journal.leave_out_with_saving("e", "f", SavedCost::Values { bytes: 1 << 50 });
            journal.notes.push("several\nlines, 40.1 dB".to_owned());
            journal.field =
                Some(FieldPrecisionSummary { half: true, views: 3, rounding: odd, result: Some(odd), least: odd });
            journal.bands = Some(ShDegreeSummary { sh_degree: 2, views: 3, tried, result: odd, least: odd });
            journal.refined = Some(RefinedSummary { views: 3, before: odd, result: odd });
            let shown = format!("{journal:?}");
            assert_eq!(format!("{:?}", kept(journal)), shown);
        }
    }
}
