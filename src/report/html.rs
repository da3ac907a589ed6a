//! Formatting of text and numbers for HTML pages.

use crate::error::printable;
use crate::files::names::last_component;

/// Escapes characters that could end an HTML text or a quoted attribute. Replaces unprintable characters, such as marks
/// of text direction, by their codes.
pub(super) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for letter in printable(text).chars() {
        match letter {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            _ => out.push(letter),
        }
    }
    out
}

/// Returns the last component of `path`, or `path` itself if that component is empty.
pub(super) fn file_name(path: &str) -> &str {
    let name = last_component(path);
    if name.is_empty() { path } else { name }
}

/// Formats a value in decibels with two decimals, such as "40.00 dB".
pub(super) fn db(value: f64) -> String {
    format!("{value:.2} dB")
}

/// Formats a number with at most four significant digits and without trailing zeros, for ticks of axes.
pub(super) fn figure(value: f64) -> String {
    let size = value.abs();
    if value == 0.0 || !value.is_finite() {
        return if value == 0.0 { "0".to_owned() } else { "–".to_owned() };
    }
    if !(1e-3..1e6).contains(&size) {
        return format!("{value:.1e}").replace(".0e", "e");
    }
    let decimals = (3 - size.log10().floor() as i32).max(0) as usize;
    let text = format!("{value:.decimals$}");
    match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text,
    }
}

/// Formats `part` as a percentage of `whole`; 100% if `whole` is 0. Percentages above 0 and below 0.1% become "under
/// 0.1%".
pub(super) fn percent(part: f64, whole: f64) -> String {
    let share = if whole > 0.0 { 100.0 * part / whole } else { 100.0 };
    match share {
        0.0 | 10.0.. => format!("{share:.0}%"),
        0.1.. => format!("{share:.1}%"),
        _ => "under 0.1%".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn html_special_characters_are_escaped() {
        let escaped = escape("<script>alert(\"x\")</script> & 'y'");
        assert!(!escaped.contains(['<', '>', '"', '\'']), "{escaped}");
        assert_eq!(escape("a&b"), "a&amp;b");
    }

    #[test]
    fn formatted_numbers_are_short() {
        let cases = [
            (0.0, "0"),
            (48.912, "48.91"),
            (0.05, "0.05"),
            (1234.5, "1234"),
            (20.0, "20"),
            (1e-7, "1e-7"),
            (2.5e9, "2.5e9"),
            (-0.25, "-0.25"),
            (f64::NAN, "–"),
        ];
        for (value, expected) in cases {
            assert_eq!(figure(value), expected, "{value}");
        }
        assert_eq!([percent(1.0, 2.0), percent(1.0, 3000.0), percent(0.0, 0.0)], ["50%", "under 0.1%", "100%"]);
    }
}
