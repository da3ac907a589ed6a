//! Tests that the tables of figures in README.md and docs/benchmarks.md have the values of the CSV files in
//! docs/benchmarks.
//!
//! The line before such a table is a comment with the cells of a row:
//!
//! ```text
//! <!-- cells of run_time where kept=10%: model | psnr_db:1 | bytes:, | equal_count/psnr_db[method=paper,kept=10%]:1 -->
//! ```
//!
//! In this example the table is made from the rows of `run_time.csv` that have `10%` in the column `kept`. A cell
//! without a format (here `model`) is a key. The table has one row for each different combination of the values of all
//! keys.
//!
//! A cell with a format is `COLUMN:FORMAT`, or `FILE/COLUMN[CONDITIONS]:FORMAT` for a value from another file. Its
//! value is that of the first row of the file that fulfills the conditions and has the same key values, as far as the
//! file has the key columns. It is a dash if there is no such row. Formats: `1` is one decimal, `,` an integer with
//! commas, `%1` a percentage with one decimal, `=` the value as it is.
//!
//! `SPLATSIEVE_WRITE_DOCS=1` writes the tables instead of comparing them.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Rows of a CSV file, each a value by column name.
type Rows = Vec<BTreeMap<String, String>>;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns the paths of the pages whose tables are compared with the CSV files.
fn pages() -> [PathBuf; 2] {
    ["README.md", "docs/benchmarks.md"].map(|name| root().join(name))
}

/// Returns the text of `docs/benchmarks/NAME.csv`.
fn csv_text(name: &str) -> String {
    let path = root().join(format!("docs/benchmarks/{name}.csv"));
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Returns the rows of `docs/benchmarks/NAME.csv` for the name `name`, without comment lines, which begin with `#`.
fn rows(name: &str) -> Rows {
    let text = csv_text(name);
    let mut reader = csv::ReaderBuilder::new().comment(Some(b'#')).from_reader(text.as_bytes());
    reader.deserialize().collect::<Result<_, _>>().unwrap_or_else(|error| panic!("{name}.csv: {error}"))
}

/// Parses conditions such as `model=deform2,kept=10%`. Returns the pairs (column, required value).
fn conditions(text: &str) -> Vec<(String, String)> {
    let pairs = text.split(',').filter(|pair| !pair.is_empty());
    pairs.map(|pair| pair.split_once('=').expect("COLUMN=VALUE")).map(|(a, b)| (a.to_owned(), b.to_owned())).collect()
}

fn fulfills(row: &BTreeMap<String, String>, conditions: &[(String, String)]) -> bool {
    conditions.iter().all(|(column, value)| row.get(column) == Some(value))
}

/// Returns the text of a table cell: `value`, the text in the CSV file, in the format `how` (see the top of this file).
/// An empty `value` becomes a dash, and `inf` becomes `exact`.
fn formatted(value: &str, how: &str) -> String {
    if value.is_empty() {
        return "–".to_owned();
    }
    if how == "=" || value == "inf" {
        return value.replace("inf", "exact");
    }
    let number: f64 = value.parse().unwrap_or_else(|_| panic!("{value} is no number"));
    match how.strip_prefix('%') {
        Some(decimals) => format!("{:.*}%", decimals.parse().unwrap(), 100.0 * number),
        None if how == "," => with_commas(number),
        None => format!("{number:.*}", how.parse().unwrap()),
    }
}

fn with_commas(number: f64) -> String {
    let digits = format!("{number:.0}");
    let groups = digits.as_bytes().rchunks(3).rev().map(|group| std::str::from_utf8(group).unwrap());
    groups.collect::<Vec<_>>().join(",")
}

/// Returns the rows of the Markdown table that the comment `<!-- cells of … -->` describes.
fn table_of(comment: &str) -> Vec<String> {
    let inside = comment.trim_start_matches("<!-- cells of ").trim_end_matches(" -->");
    let (source, cells) = inside.split_once(": ").expect("cells of FILE: CELLS");
    let (base, filter) = source.split_once(" where ").unwrap_or((source, ""));
    let cells: Vec<&str> = cells.split(" | ").collect();
    let keys: Vec<&str> = cells.iter().copied().filter(|cell| !cell.contains(':')).collect();
    let mut combinations: Vec<Vec<(String, String)>> = Vec::new();
    for row in rows(base).iter().filter(|row| fulfills(row, &conditions(filter))) {
        let found = keys.iter().map(|key| ((*key).to_owned(), row[*key].clone())).collect();
        if !combinations.contains(&found) {
            combinations.push(found);
        }
    }
    assert!(!combinations.is_empty(), "no row for {comment}");
    let written = |key: &[(String, String)]| {
        let values: Vec<String> = cells.iter().map(|cell| cell_of(cell, base, &conditions(filter), key)).collect();
        format!("| {} |", values.join(" | "))
    };
    combinations.iter().map(|key| written(key)).collect()
}

/// Returns the text of one table cell. `cell` describes it, as the comment above the table does (see the top of this
/// file).
///
/// - `base` and `filter`: name of the CSV file of the table, and the conditions for its rows.
/// - `key`: values of the key columns in this row of the table, as pairs (column, value).
fn cell_of(cell: &str, base: &str, filter: &[(String, String)], key: &[(String, String)]) -> String {
    let Some((place, how)) = cell.rsplit_once(':') else {
        return key.iter().find(|(column, _)| column == cell).unwrap().1.clone();
    };
    let (place, own) = place.strip_suffix(']').and_then(|place| place.split_once('[')).unwrap_or((place, ""));
    let (file, column) = place.split_once('/').unwrap_or((base, place));
    let own = conditions(own);
    let fits = |row: &&BTreeMap<String, String>| {
        fulfills(row, &own)
            && (file != base || fulfills(row, filter))
            && key.iter().all(|(column, value)| row.get(column).is_none_or(|found| found == value))
    };
    let rows = rows(file);
    assert!(rows.iter().all(|row| row.contains_key(column)), "{file}.csv has no column {column}");
    rows.iter().find(fits).map_or("–".to_owned(), |row| formatted(&row[column], how))
}

/// Returns the Markdown page `text` with new rows in each table that has a comment `<!-- cells of … -->`. The rows are
/// made from the CSV files as this comment describes.
fn with_tables(text: &str) -> String {
    let (mut written, mut lines) = (String::new(), text.lines().peekable());
    while let Some(line) = lines.next() {
        written += &format!("{line}\n");
        if !line.starts_with("<!-- cells of ") {
            continue;
        }
        // The comment takes one line or several.
        let mut comment = line.to_owned();
        while !comment.ends_with("-->") {
            let next = lines.next().expect("the end of the comment");
            written += &format!("{next}\n");
            comment += &format!(" {}", next.trim());
        }
        let expected = table_of(&comment);
        for _ in 0..2 {
            let head = lines.next().filter(|line| line.starts_with('|')).expect("a table below its comment");
            assert_eq!(head.matches('|').count(), expected[0].matches('|').count(), "columns of {comment}");
            written += &format!("{head}\n");
        }
        while lines.next_if(|line| line.starts_with('|')).is_some() {}
        written += &expected.iter().map(|row| format!("{row}\n")).collect::<String>();
    }
    written
}

#[test]
fn benchmark_tables_have_the_values_of_their_files() {
    for path in pages() {
        let text = fs::read_to_string(&path).unwrap();
        let expected = with_tables(&text);
        if std::env::var_os("SPLATSIEVE_WRITE_DOCS").is_some() {
            fs::write(&path, &expected).unwrap();
            continue;
        }
        let different = text.lines().zip(expected.lines()).find(|(found, expected)| found != expected);
        let advice = "SPLATSIEVE_WRITE_DOCS=1 cargo test --test command_line benchmark";
        assert!(text == expected, "{}: {different:?}; write it anew: {advice}", path.display());
    }
}

#[test]
fn every_table_on_the_benchmarks_page_has_a_file() {
    let text = fs::read_to_string(root().join("docs/benchmarks.md")).unwrap();
    let mut before = "";
    for line in text.lines() {
        let begins = line.starts_with('|') && !before.starts_with('|');
        assert!(
            !begins || before.ends_with("-->"),
            "a table without a comment above it that names its CSV file: {line}"
        );
        before = line;
    }
}

#[test]
fn every_benchmark_file_names_its_origin_and_is_shown() {
    let shown: String = pages().iter().map(|path| fs::read_to_string(path).unwrap()).collect();
    for entry in fs::read_dir(root().join("docs/benchmarks")).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|ending| ending == "csv") {
            let name = path.file_stem().unwrap().to_str().unwrap();
            let text = csv_text(name);
            for (line, start) in text.lines().zip(["# program: ", "# machine: ", "# date: ", "# command: "]) {
                assert!(line.starts_with(start), "{name}.csv: expected {start:?}, found {line}");
            }
            assert!(!rows(name).is_empty(), "{name}.csv has no rows");
            assert!(shown.contains(&format!("benchmarks/{name}.csv")), "no page names {name}.csv");
        }
    }
}

#[test]
fn a_table_with_a_wrong_value_is_found() {
    let text = fs::read_to_string(root().join("docs/benchmarks.md")).unwrap();
    let row = text.lines().skip_while(|line| !line.starts_with("<!-- cells of ")).find(|line| line.starts_with("|---"));
    let head = row.expect("a table");
    let wrong = text.replacen(head, &format!("{head}\n| a | wrong | row |"), 1);
    assert_ne!(with_tables(&wrong), wrong);
}
