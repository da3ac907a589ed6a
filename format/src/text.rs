//! Escapes text and paths that come from files and arguments, so that they cannot control a terminal when they are
//! printed.

use std::borrow::Cow;
use std::ffi::OsStr;
use std::fmt;
use std::path::Path;

/// Returns whether `c` moves the cursor, changes the direction of text, or is invisible: control characters of both
/// sets (C0 and C1), direction marks, zero-width characters, line separators, tags.
fn is_unprintable(c: char) -> bool {
    c.is_control()
        || matches!(c,
            '\u{61c}' | '\u{180e}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}'
            | '\u{feff}' | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}')
}

/// Returns `text` with every unprintable character except line feeds and tabs replaced by its code, as in `<U+001B>`.
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

/// Returns `text` in quotation marks with unprintable characters replaced by their codes, as in `<U+FEFF>`. Text beyond
/// 120 characters is replaced by "…".
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

/// Returns the code of `c` as messages show it, for example `<U+001B>`.
fn code(c: char) -> String {
    format!("<U+{:04X}>", c as u32)
}

/// Display of paths and file names in messages, with unprintable characters escaped.
pub trait ShowPath {
    /// Returns the path for display: unprintable characters (line feeds too) are replaced by their codes, as in
    /// `<U+000A>`, and bytes that are not Unicode by U+FFFD.
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

/// A path or file name that displays with unprintable characters escaped; see [`ShowPath`].
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
