//! Fields of CSV tables.

use std::fmt::Display;

/// A value; what does not exist is empty.
pub(crate) fn known(value: Option<impl Display>) -> String {
    value.map_or(String::new(), |value| value.to_string())
}

/// As RFC 4180 wants text that holds what parts fields.
pub(crate) fn quoted(text: &str) -> String {
    match text.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_with_commas_and_quotes_stays_one_field() {
        assert_eq!(quoted("a, \"b\""), "\"a, \"\"b\"\"\"");
        assert_eq!(quoted("plain"), "plain");
    }
}
