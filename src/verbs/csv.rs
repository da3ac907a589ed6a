//! Tables as CSV: a line of names, then one line per row; what does not exist is empty.

use std::fmt::Display;

/// A value; what does not exist is empty.
pub(crate) fn known(value: Option<impl Display>) -> String {
    value.map_or(String::new(), |value| value.to_string())
}

/// The text of a table; a field that holds what parts fields is quoted, as RFC 4180 wants it.
///
/// # Panics
/// If a row has not as many fields as there are names.
pub(crate) fn table(names: &[impl AsRef<[u8]>], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut out = csv::Writer::from_writer(Vec::new());
    out.write_record(names).expect("memory takes what is written");
    for row in rows {
        out.write_record(row).expect("a field for every name");
    }
    String::from_utf8(out.into_inner().expect("memory takes what is written")).expect("made of text")
}
