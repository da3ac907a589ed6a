//! What the user knows better than the scores: Gaussians to keep or to drop.

use std::fs;
use std::path::Path;

use crate::error::{Error, Result};

/// Ids from a file with one id (or range) per line, or from a list such as `3,10-20`; increasing,
/// without repetition. Every id is below `count`.
pub(super) fn parse_ids(spec: &str, count: usize) -> Result<Vec<u32>> {
    let is_list = spec.chars().all(|c| c.is_ascii_digit() || matches!(c, ',' | '-' | ' '));
    let (text, origin) = if is_list {
        (spec.replace(',', "\n"), "id list".to_owned())
    } else {
        (fs::read_to_string(spec).map_err(Error::io("read", Path::new(spec)))?, spec.to_owned())
    };
    let mut ids = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let line = line.split('#').next().unwrap_or("").trim();
        if line.is_empty() {
            continue;
        }
        let bounds = match line.split_once('-') {
            None => line.parse().map(|id: u32| (id, id)),
            Some((from, to)) => from.trim().parse().and_then(|from| Ok((from, to.trim().parse()?))),
        };
        let (from, to) = bounds.map_err(|_| {
            Error::usage(format!(
                "{origin}, line {}: expected an id or a range such as 10-20, found {line:?}",
                number + 1
            ))
        })?;
        if from > to || to as usize >= count {
            return Err(Error::usage(format!(
                "{origin}, line {}: expected ids below {count}, the number of Gaussians, found {line:?}",
                number + 1
            )));
        }
        ids.extend(from..=to);
    }
    ids.sort_unstable();
    ids.dedup();
    Ok(ids)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_and_files_give_the_same_ids() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), "12 # by hand\n3\n\n10-12\n").unwrap();
        let from_file = parse_ids(file.path().to_str().unwrap(), 20).unwrap();
        assert_eq!(from_file, [3, 10, 11, 12]);
        assert_eq!(parse_ids("3,10-12,12", 20).unwrap(), from_file);
    }

    #[test]
    fn ids_that_do_not_exist_are_refused_with_their_line() {
        for spec in ["20", "5-3", "1-99", "4294967296"] {
            let message = parse_ids(spec, 20).unwrap_err().to_string();
            assert!(message.contains("line 1") && message.contains(spec), "{message}");
        }
        assert!(parse_ids("0", 0).is_err());
        assert!(parse_ids("no-such-file", 5).unwrap_err().to_string().contains("no-such-file"));
    }
}
