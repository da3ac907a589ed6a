//! Rows of statistics (one row per Gaussian), in memory or moved to a temporary file while no stage needs them.
//!
//! The temporary file contains the values of one statistic for all Gaussians, then those of the next one, and the flags
//! last, all in the byte order of this machine. Rows in the file take no memory until they are read.

use std::borrow::Cow;
use std::path::Path;

use bytemuck::{AnyBitPattern, NoUninit};
use serde::ser::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::cache::{Spill, SpillWriter};
use crate::error::Result;
use crate::model::{AnomalyFlags, Statistic, StatisticArray, StatisticRows};

/// Statistics of N Gaussians, one row per Gaussian, in memory or in a temporary file.
pub(crate) enum StatisticsRows {
    Memory(StatisticRows),
    Spilled(SpilledRows),
}

/// Statistics of all Gaussians in an unnamed temporary file, which is deleted when this value is dropped.
pub(crate) struct SpilledRows {
    file: Spill,
    count: usize,
    /// Statistics that the file contains, in the order of their values in the file. A statistic without values (such as
    /// W if it was not computed) is not stored.
    columns: Vec<Statistic>,
}

impl Serialize for StatisticsRows {
    fn serialize<S: Serializer>(&self, to: S) -> std::result::Result<S::Ok, S::Error> {
        self.rows().map_err(S::Error::custom)?.serialize(to)
    }
}

impl<'de> Deserialize<'de> for StatisticsRows {
    fn deserialize<D: Deserializer<'de>>(from: D) -> std::result::Result<StatisticsRows, D::Error> {
        StatisticRows::deserialize(from).map(StatisticsRows::Memory)
    }
}

impl StatisticsRows {
    /// Moves `rows` from memory to an unnamed temporary file in `folder`. Returns a handle, from which the rows can be
    /// read again.
    ///
    /// # Errors
    /// Fails if the file cannot be created or written.
    pub(crate) fn spill(rows: StatisticRows, folder: &Path) -> Result<StatisticsRows> {
        let mut file = SpillWriter::new(folder)?;
        let bytes = |statistic: &Statistic| -> &[u8] {
            match statistic.accessors() {
                StatisticArray::F64(values, _) => bytemuck::cast_slice(values(&rows)),
                StatisticArray::U32(values, _) => bytemuck::cast_slice(values(&rows)),
            }
        };
        let columns: Vec<_> = Statistic::ALL.into_iter().filter(|statistic| !bytes(statistic).is_empty()).collect();
        columns.iter().try_for_each(|statistic| file.write(bytes(statistic)))?;
        rows.flags.iter().try_for_each(|flags| file.write(&[flags.bits()]))?;
        let file = file.finish()?;
        Ok(StatisticsRows::Spilled(SpilledRows { file, count: rows.len(), columns }))
    }

    /// Returns the statistics of all Gaussians. Reads them if they are in the temporary file.
    pub(crate) fn rows(&self) -> Result<Cow<'_, StatisticRows>> {
        match self {
            StatisticsRows::Memory(rows) => Ok(Cow::Borrowed(rows)),
            StatisticsRows::Spilled(spilled) => spilled.rows().map(Cow::Owned),
        }
    }

    /// Returns two lists with one value per Gaussian: the contribution C, and Vis, the fraction of the (frame, view)
    /// pairs in which the Gaussian is alive and on screen.
    pub(crate) fn importance(&self) -> Result<[Cow<'_, [f64]>; 2]> {
        Ok(match self {
            StatisticsRows::Memory(rows) => [Cow::Borrowed(&rows.c), Cow::Borrowed(&rows.vis)],
            StatisticsRows::Spilled(spilled) => {
                [Cow::Owned(spilled.column(Statistic::C)?), Cow::Owned(spilled.column(Statistic::Vis)?)]
            }
        })
    }

    /// Returns the number of rows, N, which is the number of Gaussians.
    pub(crate) fn len(&self) -> usize {
        match self {
            StatisticsRows::Memory(rows) => rows.len(),
            StatisticsRows::Spilled(spilled) => spilled.count,
        }
    }
}

impl SpilledRows {
    fn rows(&self) -> Result<StatisticRows> {
        let mut rows = StatisticRows::default();
        for &column in &self.columns {
            match column.accessors() {
                StatisticArray::F64(_, values_mut) => *values_mut(&mut rows) = self.column(column)?,
                StatisticArray::U32(_, values_mut) => *values_mut(&mut rows) = self.column(column)?,
            }
        }
        let flags: Vec<u8> = self.values(&self.columns)?;
        rows.flags = flags.into_iter().map(AnomalyFlags::from_bits_retain).collect();
        Ok(rows)
    }

    /// Reads the values of `statistic` for all Gaussians. Returns an empty list if there are no Gaussians, since the
    /// file then contains no statistic.
    fn column<T: AnyBitPattern + NoUninit>(&self, statistic: Statistic) -> Result<Vec<T>> {
        let index = self.columns.iter().position(|&column| column == statistic).unwrap_or(self.columns.len());
        self.values(&self.columns[..index])
    }

    /// Reads the values of one statistic, or the flags, for all Gaussians. `before` lists all statistics that are
    /// stored before these values in the file; their size gives the offset at which to read.
    fn values<T: AnyBitPattern + NoUninit>(&self, before: &[Statistic]) -> Result<Vec<T>> {
        let start = before.iter().map(|statistic| statistic.bytes() as u64).sum::<u64>() * self.count as u64;
        let mut values = vec![T::zeroed(); self.count];
        self.file.read(start, bytemuck::cast_slice_mut(&mut values))?;
        Ok(values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spilled_rows_come_back_bit_for_bit_from_an_unnamed_file() {
        let folder = tempfile::tempdir().unwrap();
        for (count, peak) in [(0, false), (1, true), (1000, true), (1000, false)] {
            let column = |by: f64| (0..count).map(|i| (i as f64 - 7.3) * by).collect::<Vec<_>>();
            let rows = StatisticRows {
                d: column(0.1),
                kappa: column(-0.0),
                v: column(1e-300),
                life: (0..count as u32).collect(),
                c: column(4.0),
                w: if peak { column(0.01) } else { Vec::new() },
                e: column(1e12),
                vis: column(0.3),
                flags: (0..count).map(|i| AnomalyFlags::from_bits_retain(i as u8)).collect(),
            };
            let statistics = StatisticsRows::spill(rows.clone(), folder.path()).unwrap();
            assert_eq!(statistics.len(), count);
            let StatisticsRows::Spilled(spilled) = &statistics else { panic!("the rows are not spilled") };
            let without = if peak { 0 } else { Statistic::W.bytes() };
            let bytes = ((StatisticRows::BYTES_PER_GAUSSIAN - without) * count) as u64;
            let ends_before = |byte: u64| spilled.file.read(byte, &mut [0]).is_err();
            assert!(ends_before(bytes) && (bytes == 0 || !ends_before(bytes - 1)), "{bytes} bytes were declared");
            assert_eq!(format!("{:?}", statistics.rows().unwrap()), format!("{rows:?}"));
            assert_eq!(statistics.importance().unwrap(), [Cow::Borrowed(&rows.c[..]), Cow::Borrowed(&rows.vis[..])]);
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        }
        let message =
            StatisticsRows::spill(StatisticRows::default(), &folder.path().join("nowhere")).err().unwrap().to_string();
        assert!(message.contains("nowhere"), "{message}");
    }
}
