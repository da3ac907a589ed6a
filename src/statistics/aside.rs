//! Statistics that nothing needs until later: in memory, or set aside in a scratch file.
//!
//! The file: the values of one statistic after the other, then the flags; all as this machine has them. Memory: nothing,
//! until something is asked for.

use std::borrow::Cow;
use std::path::Path;

use bytemuck::{AnyBitPattern, NoUninit};
use serde::ser::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::cache::{Spill, SpillWriter};
use crate::error::Result;
use crate::model::{Flags, Rows, Statistic, Values};

/// The rows of N Gaussians.
pub(crate) enum StatisticsRows {
    Memory(Rows),
    Aside(Aside),
}

/// Rows in a nameless file that lasts as long as this.
pub(crate) struct Aside {
    file: Spill,
    count: usize,
    /// What is in it.
    columns: Vec<Statistic>,
}

impl Serialize for StatisticsRows {
    fn serialize<S: Serializer>(&self, to: S) -> std::result::Result<S::Ok, S::Error> {
        self.rows().map_err(S::Error::custom)?.serialize(to)
    }
}

impl<'de> Deserialize<'de> for StatisticsRows {
    fn deserialize<D: Deserializer<'de>>(from: D) -> std::result::Result<StatisticsRows, D::Error> {
        Rows::deserialize(from).map(StatisticsRows::Memory)
    }
}

impl StatisticsRows {
    /// Writes `rows` to a file in `folder`.
    pub(crate) fn aside(rows: Rows, folder: &Path) -> Result<StatisticsRows> {
        let mut file = SpillWriter::new(folder)?;
        let bytes = |of: &Statistic| -> &[u8] {
            match of.values() {
                Values::F64(of, _) => bytemuck::cast_slice(of(&rows)),
                Values::U32(of, _) => bytemuck::cast_slice(of(&rows)),
            }
        };
        let columns: Vec<_> = Statistic::ALL.into_iter().filter(|of| !bytes(of).is_empty()).collect();
        columns.iter().try_for_each(|of| file.write(bytes(of)))?;
        rows.flags.iter().try_for_each(|flags| file.write(&[flags.bits()]))?;
        let file = file.finish()?;
        Ok(StatisticsRows::Aside(Aside { file, count: rows.len(), columns }))
    }

    /// All rows.
    pub(crate) fn rows(&self) -> Result<Cow<'_, Rows>> {
        match self {
            StatisticsRows::Memory(rows) => Ok(Cow::Borrowed(rows)),
            StatisticsRows::Aside(aside) => aside.rows().map(Cow::Owned),
        }
    }

    /// C and Vis of every Gaussian.
    pub(crate) fn importance(&self) -> Result<[Cow<'_, [f64]>; 2]> {
        Ok(match self {
            StatisticsRows::Memory(rows) => [Cow::Borrowed(&rows.c), Cow::Borrowed(&rows.vis)],
            StatisticsRows::Aside(aside) => {
                [Cow::Owned(aside.column(Statistic::C)?), Cow::Owned(aside.column(Statistic::Vis)?)]
            }
        })
    }

    /// N.
    pub(crate) fn len(&self) -> usize {
        match self {
            StatisticsRows::Memory(rows) => rows.len(),
            StatisticsRows::Aside(aside) => aside.count,
        }
    }
}

impl Aside {
    fn rows(&self) -> Result<Rows> {
        let mut rows = Rows::default();
        for &column in &self.columns {
            match column.values() {
                Values::F64(_, of) => *of(&mut rows) = self.column(column)?,
                Values::U32(_, of) => *of(&mut rows) = self.column(column)?,
            }
        }
        let flags: Vec<u8> = self.values(&self.columns)?;
        rows.flags = flags.into_iter().map(Flags::from_bits_retain).collect();
        Ok(rows)
    }

    /// Of no Gaussians nothing is in the file, and nothing is read of it.
    fn column<T: AnyBitPattern + NoUninit>(&self, of: Statistic) -> Result<Vec<T>> {
        let place = self.columns.iter().position(|&column| column == of).unwrap_or(self.columns.len());
        self.values(&self.columns[..place])
    }

    /// A value for every Gaussian, from behind the columns `before` on.
    fn values<T: AnyBitPattern + NoUninit>(&self, before: &[Statistic]) -> Result<Vec<T>> {
        let start = before.iter().map(|of| of.bytes() as u64).sum::<u64>() * self.count as u64;
        let mut values = vec![T::zeroed(); self.count];
        self.file.read(start, bytemuck::cast_slice_mut(&mut values))?;
        Ok(values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_set_aside_comes_back_bit_for_bit_from_a_file_without_a_name() {
        let folder = tempfile::tempdir().unwrap();
        for (count, peak) in [(0, false), (1, true), (1000, true), (1000, false)] {
            let column = |by: f64| (0..count).map(|i| (i as f64 - 7.3) * by).collect::<Vec<_>>();
            let rows = Rows {
                d: column(0.1),
                kappa: column(-0.0),
                v: column(1e-300),
                life: (0..count as u32).collect(),
                c: column(4.0),
                w: if peak { column(0.01) } else { Vec::new() },
                e: column(1e12),
                vis: column(0.3),
                flags: (0..count).map(|i| Flags::from_bits_retain(i as u8)).collect(),
            };
            let statistics = StatisticsRows::aside(rows.clone(), folder.path()).unwrap();
            assert_eq!(statistics.len(), count);
            let StatisticsRows::Aside(aside) = &statistics else { panic!("it is aside") };
            let without = if peak { 0 } else { Statistic::W.bytes() };
            let bytes = ((Rows::BYTES_PER_GAUSSIAN - without) * count) as u64;
            let ends_before = |byte: u64| aside.file.read(byte, &mut [0]).is_err();
            assert!(ends_before(bytes) && (bytes == 0 || !ends_before(bytes - 1)), "{bytes} bytes were declared");
            assert_eq!(format!("{:?}", statistics.rows().unwrap()), format!("{rows:?}"));
            assert_eq!(statistics.importance().unwrap(), [Cow::Borrowed(&rows.c[..]), Cow::Borrowed(&rows.vis[..])]);
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        }
        let message = StatisticsRows::aside(Rows::default(), &folder.path().join("nowhere")).err().unwrap().to_string();
        assert!(message.contains("nowhere"), "{message}");
    }
}
