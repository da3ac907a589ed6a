//! Formats CSV tables: a header line of names, then one line per row. A missing value is an empty field.
//!
//! Spreadsheets execute a field that begins with one of `= + - @`, a tab or a carriage return as a formula. This module
//! puts an apostrophe before such a field, which marks it as text. Numbers stay unchanged.

use std::fmt::Display;

/// Formats a value as a CSV field; `None` becomes an empty field.
pub(crate) fn optional_field(value: Option<impl Display>) -> String {
    value.map_or(String::new(), |value| value.to_string())
}

/// Returns the CSV field `field`, with an apostrophe put before it if a spreadsheet would execute it as a formula.
fn without_formula(field: String) -> String {
    // Skip leading spaces as spreadsheets do. They also treat the full-width East Asian forms of these characters like
    // the plain ones.
    let first = field.chars().find(|&c| c != ' ');
    let runs = matches!(first, Some('=' | '+' | '-' | '@' | '\t' | '\r' | '\n' | '＝' | '＋' | '－' | '＠'));
    if runs && field.parse::<f64>().is_err() { format!("'{field}") } else { field }
}

/// Returns a table as CSV text: a header line with the column names `names`, then one line for each of `rows`. Fields
/// with delimiters are quoted according to RFC 4180.
///
/// # Panics
/// Panics if a row does not have as many fields as there are names.
pub(crate) fn table(names: &[impl AsRef<[u8]>], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut out = csv::Writer::from_writer(Vec::new());
    out.write_record(names).expect("memory takes what is written");
    for row in rows {
        out.write_record(row.into_iter().map(without_formula)).expect("a field for every name");
    }
    String::from_utf8(out.into_inner().expect("memory takes what is written")).expect("made of text")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formulas_are_escaped_and_numbers_unchanged() {
        let row =
            ["=1+1", "+cmd", "-2+3", "@SUM(A1)", "\tx", "\rx", " =1", "＝1", "-1.5", "+3", "-inf", "-1e-7", "a=b", ""];
        let text = table(&row.map(|_| "n"), [row.map(str::to_owned).to_vec()]);
        let line = text.split_once('\n').unwrap().1;
        let expected = "'=1+1,'+cmd,'-2+3,'@SUM(A1),'\tx,\"'\rx\",' =1,'＝1,-1.5,+3,-inf,-1e-7,a=b,\n";
        assert_eq!(line, expected);
    }
}
