//! Tables with the statistics, the scores and the decision (kept or not) of every Gaussian, for people and notebooks.
//!
//! Input: [`RowTable`]. Output: `.npz` (one array per column) or `.csv` (one line per Gaussian), with the same columns
//! and, to the bit, the same values. Memory: none that grows with the number of Gaussians. The bytes depend only on the
//! table: the entries of the `.npz` are stored uncompressed and dated 1980-01-01.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use npyz::WriterBuilder;
use npyz::npz::NpzWriter;
use zip::write::FileOptions;

use crate::error::{Error, Result};
use crate::files::zip_output::{ZipOutput, stored_file_options};
use crate::model::{self, Statistic, StatisticRows};

/// Statistics and scores of N Gaussians, and whether the selection keeps each of them. Every slice has one value per
/// Gaussian.
#[derive(Debug, Clone, Copy)]
pub struct RowTable<'a> {
    /// Statistics, each a column of the table ([`Statistic::column_name`]). The peak contribution W, if measured, is
    /// the last column of the table.
    pub rows: &'a StatisticRows,
    /// Static score S_static of each Gaussian, from its contribution and shape.
    pub static_score: &'a [f64],
    /// Dynamic score S_dynamic of each Gaussian, from its motion and opacity.
    pub dynamic_score: &'a [f64],
    /// Total score S of each Gaussian.
    pub score: &'a [f64],
    /// Whether each Gaussian is kept by the selection (stage 2 of the paper's method).
    pub keep: &'a [bool],
}

/// Column of the table of statistics and scores: one value per Gaussian.
#[derive(Clone, Copy)]
enum TableColumn<'a> {
    F64(&'a [f64]),
    U32(&'a [u32]),
    Bool(&'a [bool]),
}

impl TableColumn<'_> {
    fn len(&self) -> usize {
        match self {
            TableColumn::F64(values) => values.len(),
            TableColumn::U32(values) => values.len(),
            TableColumn::Bool(values) => values.len(),
        }
    }

    fn text(&self, id: usize) -> String {
        match self {
            TableColumn::F64(values) => format!("{:?}", values[id]),
            TableColumn::U32(values) => values[id].to_string(),
            TableColumn::Bool(values) => values[id].to_string(),
        }
    }
}

impl RowTable<'_> {
    /// Writes the table to `path` as an archive that `numpy.load` opens. Its arrays `[N]` are float64, except `life`,
    /// which is uint32, and `keep`, which is bool.
    ///
    /// # Errors
    /// Fails if the slices have different lengths or the file cannot be written.
    pub fn write_npz(&self, path: &Path) -> Result<()> {
        self.check_lengths()?;
        let file = BufWriter::new(File::create(path).map_err(Error::io("create", path))?);
        self.write_npz_to(file).map_err(Error::io("write", path))
    }

    /// Writes the table to `path` as text with a header line: `id`, then the columns. Floats are written as the
    /// shortest text that reads back as the same f64 (or `NaN`, `inf`), and `keep` as `true` or `false`.
    ///
    /// # Errors
    /// Fails if the slices have different lengths or the file cannot be written.
    pub fn write_csv(&self, path: &Path) -> Result<()> {
        self.check_lengths()?;
        let file = File::create(path).map_err(Error::io("create", path))?;
        self.write_csv_to(file).map_err(Error::io("write", path))
    }

    /// Returns the columns of the table in the order in which they are written, each with its name.
    fn columns(&self) -> Vec<(&'static str, TableColumn<'_>)> {
        let column = |statistic: Statistic| match statistic.accessors() {
            model::StatisticArray::F64(values, _) => (statistic.column_name(), TableColumn::F64(values(self.rows))),
            model::StatisticArray::U32(values, _) => (statistic.column_name(), TableColumn::U32(values(self.rows))),
        };
        let mut columns: Vec<_> =
            Statistic::ALL.into_iter().filter(|&statistic| statistic != Statistic::W).map(column).collect();
        columns.extend([
            ("static_score", TableColumn::F64(self.static_score)),
            ("dynamic_score", TableColumn::F64(self.dynamic_score)),
            ("score", TableColumn::F64(self.score)),
            ("keep", TableColumn::Bool(self.keep)),
        ]);
        columns.extend((!self.rows.w.is_empty()).then(|| column(Statistic::W)));
        columns
    }

    fn check_lengths(&self) -> Result<()> {
        match self.columns().into_iter().find(|(_, values)| values.len() != self.rows.len()) {
            None => Ok(()),
            Some((name, values)) => {
                let (len, rows) = (values.len(), self.rows.len());
                Err(Error::internal(format!("column {name} has {len} values for {rows} Gaussians")))
            }
        }
    }

    fn write_npz_to(&self, out: impl Write + io::Seek) -> io::Result<()> {
        let mut archive = NpzWriter::new(ZipOutput::new(out));
        // An entry has at most 8 bytes per Gaussian and a header.
        let options = stored_file_options(self.rows.len() as u64 * 8 + 4096);
        for (name, values) in self.columns() {
            match values {
                TableColumn::F64(values) => add_array(&mut archive, name, options, values)?,
                TableColumn::U32(values) => add_array(&mut archive, name, options, values)?,
                TableColumn::Bool(values) => add_array(&mut archive, name, options, values)?,
            }
        }
        archive.zip_writer().finish()?.close()
    }

    fn write_csv_to(&self, out: impl Write) -> io::Result<()> {
        let columns = self.columns();
        let mut out = csv::Writer::from_writer(out);
        out.write_record(std::iter::once("id").chain(columns.iter().map(|(name, _)| *name)))?;
        for id in 0..self.rows.len() {
            out.write_field(id.to_string())?;
            for (_, values) in &columns {
                out.write_field(values.text(id))?;
            }
            out.write_record(None::<&[u8]>)?;
        }
        out.flush()
    }
}

fn add_array<T, W>(archive: &mut NpzWriter<W>, name: &str, options: FileOptions, values: &[T]) -> io::Result<()>
where
    T: npyz::AutoSerialize + Copy,
    W: Write + io::Seek,
{
    let array = archive.array::<T>(name, options)?;
    let mut array = array.default_dtype().shape(&[values.len() as u64]).begin_nd()?;
    array.extend(values.iter().copied())?;
    array.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::AnomalyFlags;

    const N: usize = 3;

    fn rows() -> StatisticRows {
        let ramp = |by: f64| (0..N).map(|i| (i as f64 + 0.1) * by).collect::<Vec<_>>();
        StatisticRows {
            d: vec![0.1, f64::NAN, 1e-300],
            kappa: ramp(2.0),
            v: ramp(1.0 / 3.0),
            life: vec![0, 7, u32::MAX],
            c: ramp(4.0),
            w: ramp(0.2),
            e: vec![1.0, 1e12, f64::INFINITY],
            vis: ramp(0.3),
            flags: vec![AnomalyFlags::empty(); N],
        }
    }

    fn with_table<R>(test: impl FnOnce(RowTable<'_>) -> R) -> R {
        let (rows, scores, keep) = (rows(), [-0.0, 0.1 + 0.2, 5e-324], [true, false, true]);
        test(RowTable { rows: &rows, static_score: &scores, dynamic_score: &scores, score: &scores, keep: &keep })
    }

    #[test]
    fn npz_reads_back_bit_for_bit_and_is_reproducible() {
        let folder = tempfile::tempdir().unwrap();
        let [a, b] = ["a", "b"].map(|name| folder.path().join(name));
        with_table(|table| {
            table.write_npz(&a).unwrap();
            table.write_npz(&b).unwrap();
            assert_eq!(std::fs::read(&a).unwrap(), std::fs::read(&b).unwrap());
            let mut archive = npyz::npz::NpzArchive::open(&a).unwrap();
            assert_eq!(archive.array_names().count(), table.columns().len());
            let stamp = archive.zip_archive().by_name("D.npy").unwrap().last_modified();
            assert_eq!((stamp.year(), stamp.month(), stamp.day()), (1980, 1, 1));
            for (name, values) in table.columns() {
                let array = archive.by_name(name).unwrap().unwrap();
                assert_eq!(array.shape(), [N as u64], "{name}");
                match values {
                    TableColumn::F64(values) => {
                        let bits = |values: &[f64]| values.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
                        assert_eq!(bits(&array.into_vec().unwrap()), bits(values), "{name}");
                    }
                    TableColumn::U32(values) => assert_eq!(array.into_vec::<u32>().unwrap(), values, "{name}"),
                    TableColumn::Bool(values) => assert_eq!(array.into_vec::<bool>().unwrap(), values, "{name}"),
                }
            }
        });
    }

    #[test]
    fn csv_floats_read_back_bit_for_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows.csv");
        with_table(|table| {
            table.write_csv(&path).unwrap();
            let text = std::fs::read_to_string(&path).unwrap();
            let mut lines = text.lines();
            let header = lines.next().unwrap();
            assert_eq!(header, "id,D,kappa,V,life,C,E,vis,static_score,dynamic_score,score,keep,W");
            for (id, line) in lines.enumerate() {
                let cells: Vec<&str> = line.split(',').collect();
                assert_eq!(cells[0], id.to_string());
                for (cell, (_, column)) in cells[1..].iter().zip(table.columns()) {
                    match column {
                        TableColumn::F64(values) => {
                            let read: f64 = cell.parse().unwrap();
                            assert_eq!(read.to_bits(), values[id].to_bits(), "{cell} for {}", values[id]);
                        }
                        TableColumn::U32(values) => assert_eq!(cell.parse::<u32>().unwrap(), values[id]),
                        TableColumn::Bool(values) => assert_eq!(cell.parse::<bool>().unwrap(), values[id]),
                    }
                }
            }
            assert_eq!(text.lines().count(), N + 1);
        });
    }

    #[test]
    fn csv_bytes_are_fixed() {
        let mut text = Vec::new();
        with_table(|table| table.write_csv_to(&mut text).unwrap());
        let expected = "id,D,kappa,V,life,C,E,vis,static_score,dynamic_score,score,keep,W\n\
            0,0.1,0.2,0.03333333333333333,0,0.4,1.0,0.03,-0.0,-0.0,-0.0,true,0.020000000000000004\n\
            1,NaN,2.2,0.3666666666666667,7,4.4,1000000000000.0,0.33,\
            0.30000000000000004,0.30000000000000004,0.30000000000000004,false,0.22000000000000003\n\
            2,1e-300,4.2,0.7,4294967295,8.4,inf,0.63,5e-324,5e-324,5e-324,true,0.42000000000000004\n";
        assert_eq!(String::from_utf8(text).unwrap(), expected);
    }

    #[test]
    fn a_column_of_wrong_length_is_named() {
        let rows = StatisticRows { w: Vec::new(), ..rows() };
        let table = RowTable {
            rows: &rows,
            static_score: &[0.0; N],
            dynamic_score: &[0.0; 2],
            score: &[0.0; N],
            keep: &[true; N],
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows.csv");
        let message = table.write_csv(&path).unwrap_err().to_string();
        assert!(message.contains("dynamic_score has 2 values for 3"), "{message}");
        assert!(!path.exists());
    }

    #[test]
    fn no_gaussians_give_empty_tables() {
        let rows = StatisticRows::default();
        let table = RowTable { rows: &rows, static_score: &[], dynamic_score: &[], score: &[], keep: &[] };
        let folder = tempfile::tempdir().unwrap();
        let (npz, csv) = (folder.path().join("a.npz"), folder.path().join("a.csv"));
        table.write_npz(&npz).unwrap();
        table.write_csv(&csv).unwrap();
        assert_eq!(std::fs::read_to_string(csv).unwrap().lines().count(), 1);
        let mut archive = npyz::npz::NpzArchive::open(npz).unwrap();
        assert!(archive.by_name("score").unwrap().unwrap().into_vec::<f64>().unwrap().is_empty());
    }
}
