//! Texts and paths from outside, shown without letting them control a terminal.

use std::borrow::Cow;
use std::ffi::OsStr;
use std::fmt;
use std::path::Path;

/// Whether `c` moves the cursor, changes the direction of text or cannot be seen: control characters of both sets (C0
/// and C1), marks of direction, zero-width characters, separators of lines, tags.
fn is_unprintable(c: char) -> bool {
    c.is_control()
        || matches!(c,
            '\u{61c}' | '\u{180e}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}'
            | '\u{feff}' | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}')
}

/// Returns `text` with every unprintable character but line feeds and tabs replaced by its code, as in `<U+001B>`.
pub fn printable(text: &str) -> Cow<'_, str> {
    let is_kept = |c: char| matches!(c, '\n' | '\t') || !is_unprintable(c);
    if text.chars().all(is_kept) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if is_kept(c) { out.push(c) } else { out += &code(c) }
    }
    Cow::Owned(out)
}

/// Returns `text` in quotation marks, unprintable characters by their codes, as in `<U+FEFF>`; at most 120 characters.
pub fn quoted(text: &str) -> String {
    const LONGEST: usize = 120;
    let mut out = String::from("\"");
    for (place, c) in text.chars().enumerate() {
        match c {
            _ if place == LONGEST => {
                out.push('…');
                break;
            }
            c if is_unprintable(c) => out += &code(c),
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

fn code(c: char) -> String {
    format!("<U+{:04X}>", c as u32)
}

/// Paths and file names as messages show them.
pub trait ShowPath {
    /// Returns the path for display, unprintable characters (line feeds too) by their codes, as in `<U+000A>`, bytes that
    /// are not Unicode as U+FFFD.
    fn shown(&self) -> ShownPath<'_>;
}

impl ShowPath for Path {
    fn shown(&self) -> ShownPath<'_> {
        ShownPath(self.as_os_str())
    }
}

impl ShowPath for OsStr {
    fn shown(&self) -> ShownPath<'_> {
        ShownPath(self)
    }
}

/// A path or file name for display; see [`ShowPath`].
#[derive(Debug)]
pub struct ShownPath<'a>(&'a OsStr);

impl fmt::Display for ShownPath<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = self.0.to_string_lossy();
        if !text.contains(is_unprintable) {
            return f.write_str(&text);
        }
        text.chars()
            .try_for_each(|c| if is_unprintable(c) { f.write_str(&code(c)) } else { fmt::Write::write_char(f, c) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shown_paths_have_no_control_characters() {
        let path = Path::new("a\u{1b}[31m\nb\u{9b}2J\u{202e}c\u{61c} d é");
        assert_eq!(path.shown().to_string(), "a<U+001B>[31m<U+000A>b<U+009B>2J<U+202E>c<U+061C> d é");
        assert_eq!(Path::new("plain/name.ply").shown().to_string(), "plain/name.ply");
    }

    #[test]
    fn printable_text_keeps_its_lines() {
        assert_eq!(printable("two\n\tlines"), "two\n\tlines");
        assert_eq!(printable("a\r\n\u{7f}\u{1b}]0;x\u{7}"), "a<U+000D>\n<U+007F><U+001B>]0;x<U+0007>");
    }

    #[test]
    fn quoted_text_is_short_and_printable() {
        assert_eq!(quoted("a\u{1b}b\n"), "\"a<U+001B>b<U+000A>\"");
        assert_eq!(quoted(&"x".repeat(200)).chars().count(), 123);
    }
}
