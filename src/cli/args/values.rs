//! Parsers of option values.

use std::path::PathBuf;

use splatsieve::error::quoted;
use splatsieve::files::cameras::TimesSource;

use crate::cli::recipe_flags::numbers;

/// Returns `folder`, a folder for temporary files, after a check that files can be created in it.
pub(super) fn check_scratch_folder(folder: PathBuf) -> Result<PathBuf, String> {
    match tempfile::tempfile_in(&folder) {
        Ok(_) => Ok(folder),
        Err(error) => Err(format!("cannot create a file in it: {error}; name a folder that exists and can be written")),
    }
}

/// Parses a length of time, such as `10`, or the start and the end of a time span, such as `0,10`. Returns the length.
pub(super) fn parse_duration(text: &str) -> Result<f64, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse::<f64>()).collect();
    let length = match numbers.as_deref() {
        Ok(&[length]) => length,
        Ok(&[start, end]) => end - start,
        _ => return Err("expected a length such as 10, or two times such as 0,10".to_owned()),
    };
    let is_length = length.is_finite() && length > 0.0;
    is_length.then_some(length).ok_or_else(|| format!("expected a length above 0, found {length}"))
}

/// Parses `WIDTHxHEIGHT` in pixels.
pub(super) fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let expected = || format!("expected WIDTHxHEIGHT such as 800x800, found {}", quoted(text));
    let (width, height) = text.split_once('x').ok_or_else(expected)?;
    match (width.parse(), height.parse()) {
        (Ok(width @ 1..=65_535), Ok(height @ 1..=65_535)) => Ok((width, height)),
        _ => Err(expected()),
    }
}

/// Parses a fraction of the Gaussians in (0, 1]: `0.1`, `10%` or `10x` (ten times fewer).
pub(super) fn parse_ratio(text: &str) -> Result<f64, String> {
    let text = text.trim();
    let number = |digits: &str| digits.trim().parse::<f64>().ok();
    let ratio = match (text.strip_suffix('%'), text.strip_suffix(['x', 'X', '×'])) {
        (Some(percent), _) => number(percent).map(|percent| percent / 100.0),
        (_, Some(times)) => number(times).map(|times| 1.0 / times),
        _ => number(text),
    };
    let hint = "expected a fraction above 0 and at most 1, such as 0.1, 10% or 10x";
    match ratio {
        Some(ratio) if ratio > 0.0 && ratio <= 1.0 => Ok(ratio),
        // A number above 1 may be meant as a percentage or as a count.
        Some(ratio) if ratio > 1.0 && ratio.is_finite() && text.parse::<f64>().is_ok() => Err(format!(
            "{hint}, found {text}; write {text}% for a percentage, or --count {text} for a number of Gaussians"
        )),
        _ => Err(format!("{hint}, found {}", quoted(text))),
    }
}

/// Parses a number of Gaussians.
pub(super) fn parse_count(text: &str) -> Result<u64, String> {
    text.trim().parse().map_err(|_| {
        let ratio = parse_ratio(text).map_or(String::new(), |_| format!("; write --ratio {text} for a fraction"));
        format!("expected a number of Gaussians such as 5000, found {}{ratio}", quoted(text))
    })
}

/// Parses a number of threads.
pub(super) fn parse_threads(text: &str) -> Result<u16, String> {
    let threads = text.parse().ok().filter(|threads| (1..=1024).contains(threads));
    threads.ok_or_else(|| format!("expected a whole number from 1 to 1024, found {}", quoted(text)))
}

/// Parses the source of image times: `names`, `none` or the path of a table.
pub(super) fn parse_times(text: &str) -> Result<TimesSource, String> {
    Ok(TimesSource::parse(text))
}

/// Parses a number of bytes above 0, with an optional unit.
pub(super) fn parse_bytes(text: &str) -> Result<u64, String> {
    match text.parse::<bytesize::ByteSize>() {
        Ok(bytes) if bytes.as_u64() > 0 => Ok(bytes.as_u64()),
        _ => Err(format!("expected a size such as 512MiB or 4GB, found {}", quoted(text))),
    }
}

/// Parses decibels above 0 and at most 100, with or without `dB`.
pub(super) fn parse_decibels(text: &str) -> Result<f64, String> {
    let number = text.trim().trim_end_matches(['b', 'B']).trim_end_matches(['d', 'D']).trim_end();
    match number.parse::<f64>() {
        Ok(decibels) if decibels > 0.0 && decibels <= 100.0 => Ok(decibels),
        _ => Err(format!("expected decibels above 0 and at most 100, such as 0.5 or 35dB, found {}", quoted(text))),
    }
}

/// Parses a color: red, green and blue, separated by commas.
pub(super) fn parse_color(text: &str) -> Result<[f32; 3], String> {
    let channels: Vec<f32> = numbers(text)?;
    channels.try_into().map_err(|c: Vec<f32>| format!("expected three numbers, found {}", c.len()))
}

/// Parses a box: the minimum corner, then the maximum corner, as six numbers.
pub(super) fn parse_box(text: &str) -> Result<[f64; 6], String> {
    let corners: [f64; 6] =
        numbers(text)?.try_into().map_err(|n: Vec<f64>| format!("expected six numbers, found {}", n.len()))?;
    // NaN compares as neither less nor equal, so it is rejected.
    let in_order = |axis: usize| corners[axis].partial_cmp(&corners[axis + 3]).is_some_and(|order| order.is_le());
    match (0..3).find(|&axis| !in_order(axis)) {
        Some(axis) => Err(format!("axis {axis}: {} is not below {}", corners[axis], corners[axis + 3])),
        None => Ok(corners),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_are_none_are_refused_with_the_expected_ones() {
        let message = parse_count("10%").unwrap_err();
        assert!(message.contains("expected a number of Gaussians") && message.contains("--ratio 10%"), "{message}");
        assert!(parse_count("-3").unwrap_err().ends_with("such as 5000, found \"-3\""));
        assert_eq!(parse_count("5000"), Ok(5000));
        for text in ["a", "0", "1025", "2.5", ""] {
            let message = parse_threads(text).unwrap_err();
            assert!(message.contains("from 1 to 1024, found "), "{message}");
        }
        assert_eq!(["1", "1024"].map(parse_threads), [Ok(1), Ok(1024)]);
    }
}
