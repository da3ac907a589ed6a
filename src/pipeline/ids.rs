//! Parser for lists of ids of Gaussians that the user wants to keep or drop.

use std::ops::RangeInclusive;
use std::path::Path;

use crate::error::{Error, Result, quoted};
use crate::files::text::read_text;

/// Maximum number of bytes of a file of ids; enough for four million ids of eight bytes.
const MAX_LIST: u64 = 32 << 20;

/// Reads the ids of Gaussians that `spec` names: a list of ids and ranges such as `3,10-20`, or the path of a file with
/// such a list, in which `#` begins a comment. Commas, blanks or line ends separate ids. Returns the ids in increasing
/// order without repetition.
///
/// # Errors
/// Fails if a word is no id or range, if a range is reversed, or if an id is not below `count`, the number of
/// Gaussians.
pub(super) fn parse_ids(spec: &str, count: usize) -> Result<Vec<u32>> {
    let mut ids = Vec::new();
    for_each_range(spec, count, |range| ids.extend(range))?;
    ids.sort_unstable();
    ids.dedup();
    Ok(ids)
}

/// Checks the ids that `spec` names, as far as this is possible before the number of Gaussians is known.
///
/// # Errors
/// Fails like [`parse_ids`], except for ids that are too high.
pub(super) fn check_ids(spec: &str) -> Result<()> {
    for_each_range(spec, u32::MAX as usize, |_| ())
}

/// Calls `take` with every range of ids in `spec`; a single id is a range of one. Fails like [`parse_ids`].
fn for_each_range(spec: &str, count: usize, mut take: impl FnMut(RangeInclusive<u32>)) -> Result<()> {
    let is_list = spec.chars().all(|c| c.is_ascii_digit() || matches!(c, ',' | '-') || c.is_ascii_whitespace());
    let (text, origin) = if is_list {
        (spec.to_owned(), "id list".to_owned())
    } else {
        (read_text(Path::new(spec), MAX_LIST)?, spec.to_owned())
    };
    for (number, line) in text.lines().enumerate() {
        let wrong = |expected: String, found: &str| {
            Error::usage(format!("{origin}, line {}: expected {expected}, found {}", number + 1, quoted(found)))
        };
        let line = line.split('#').next().unwrap_or("");
        // A range may have blanks around its hyphen.
        let line = line.split('-').map(str::trim).collect::<Vec<_>>().join("-");
        for word in line.split([',', ' ', '\t']).filter(|word| !word.is_empty()) {
            let bounds = match word.split_once('-') {
                None => word.parse().map(|id: u32| (id, id)),
                Some((from, to)) => from.parse().and_then(|from| Ok((from, to.parse()?))),
            };
            let (from, to) = bounds.map_err(|_| wrong("an id or a range such as 10-20".into(), word))?;
            if from > to {
                return Err(wrong(format!("a range that runs forwards, such as {to}-{from}"), word));
            }
            if to as usize >= count {
                return Err(wrong(format!("ids below {count}, the number of Gaussians"), word));
            }
            take(from..=to);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn lists_and_files_give_the_same_ids() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), "12 # by hand\n3\n\n10-12\n").unwrap();
        let from_file = parse_ids(file.path().to_str().unwrap(), 20).unwrap();
        assert_eq!(from_file, [3, 10, 11, 12]);
        assert_eq!(parse_ids("3,10-12,12", 20).unwrap(), from_file);
        for apart in ["3 10-12", "3, 10 - 12", "12 11\n10\t3,"] {
            assert_eq!(parse_ids(apart, 20).unwrap(), from_file, "{apart:?}");
        }
        fs::write(file.path(), b"\xef\xbb\xbf3, 10-12 # a few\n").unwrap();
        assert_eq!(parse_ids(file.path().to_str().unwrap(), 20).unwrap(), from_file);
    }

    #[test]
    fn reversed_range_is_reported_with_its_correction() {
        let message = parse_ids("3,10-5", 20).unwrap_err().to_string();
        assert!(message.contains("runs forwards, such as 5-10") && message.contains("\"10-5\""), "{message}");
        // A range that is both reversed and too high is reported as reversed first.
        assert!(parse_ids("100-5", 20).unwrap_err().to_string().contains("5-100"));
    }

    #[test]
    fn ids_out_of_range_are_reported_with_their_line() {
        for spec in ["20", "5-3", "1-99", "4294967296"] {
            let message = parse_ids(spec, 20).unwrap_err().to_string();
            assert!(message.contains("line 1") && message.contains(spec), "{message}");
        }
        assert!(parse_ids("0", 0).is_err());
        assert!(parse_ids("no-such-file", 5).unwrap_err().to_string().contains("no-such-file"));
    }
}
