//! Finds the times of images whose camera file has none: from the numbers in their names, or from a table.
//!
//! The number of an image is NNN in a name of the form `…tNNN_vNN…`. In other names it is the last number in the file
//! name, for example 12 in `cam03/frame_00012.png`. Its time is (number − smallest)/(largest − smallest), so that the
//! last image is at 1, as in the COLMAP loaders of the supported trainers. A table is a CSV file with lines
//! `name,time`. `name` is the image name in the camera file, or its last component, with or without extension. Times of
//! a table are used as they are.

use std::path::{Path, PathBuf};

use hashbrown::HashMap;

use super::memory::MemoryCounter;
use crate::error::{Error, Result, ShowPath, quoted};
use crate::files::names::shown_name;
use crate::files::text::TextLines;

/// Estimated memory per entry of the time table without its name, in bytes. When the table grows, it is copied to a
/// table of twice the size, and both exist for a moment. So this is 3 times the size of an entry, plus 32 bytes.
const TABLE_ENTRY_BYTES: u64 = 3 * 40 + 32;

/// Source of the times of images.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum TimesSource {
    /// Default source, which depends on the file format. COLMAP: the numbers in the image names, if all names have one.
    /// Other formats: the times in the camera file.
    #[default]
    Own,
    /// The numbers in image names; every name must have one.
    Names,
    /// No times: every image shows the scene at every frame.
    None,
    /// A CSV table of image names and times, at this path.
    Table(PathBuf),
}

impl TimesSource {
    /// Parses `text`, the value of `--times`: `names`, `none`, or the path of a table.
    pub fn parse(text: &str) -> TimesSource {
        match text {
            "names" => TimesSource::Names,
            "none" => TimesSource::None,
            table => TimesSource::Table(table.into()),
        }
    }

    /// Returns the text from which [`TimesSource::parse`] parses this value; `None` for [`TimesSource::Own`].
    pub fn name(&self) -> Option<String> {
        match self {
            TimesSource::Own => None,
            TimesSource::Names => Some("names".to_owned()),
            TimesSource::None => Some("none".to_owned()),
            TimesSource::Table(table) => Some(table.to_string_lossy().into_owned()),
        }
    }
}

/// Finds the times of images. `names` are the names of the images in the camera file `file`, and `times` says where the
/// times come from (for example, image names or a table). Returns the time of each image, and a text that describes for
/// the user where the times come from. Both are empty if the images have no times.
///
/// # Errors
/// Fails if an image name contains no number although its number is needed, or if the table of times is malformed or
/// lacks a name.
pub(super) fn resolve(
    file: &Path,
    names: &[Box<str>],
    times: &TimesSource,
    counter: &mut MemoryCounter,
) -> Result<(Vec<Option<f64>>, String)> {
    counter.take(file, "", "the times of its images", 40 * names.len() as u64)?;
    let none = || Ok((Vec::new(), String::new()));
    match times {
        TimesSource::None => none(),
        TimesSource::Table(table) => {
            let known = read_table(table, counter)?;
            let time = |name: &str| {
                let time = keys(name).find_map(|key| known.get(key)).copied();
                time.map(Some).ok_or_else(|| {
                    Error::input(table, "", format!("a line for the image {}", quoted(name)), "none")
                        .hint(format!("the names are those of {}", file.shown()))
                })
            };
            let given = names.iter().map(|name| time(name)).collect::<Result<Vec<_>>>()?;
            Ok((given, format!("times from {}", shown_name(table))))
        }
        TimesSource::Own | TimesSource::Names => {
            let numbers: Vec<Option<u64>> = names.iter().map(|name| number(name)).collect();
            if let Some(at) = numbers.iter().position(Option::is_none) {
                if *times == TimesSource::Own {
                    return none();
                }
                return Err(Error::input(
                    file,
                    format!("image {}", quoted(&names[at])),
                    "a number in its name",
                    "none",
                )
                .hint("give a table of names and times: --times TABLE.csv"));
            }
            let bounds = numbers.iter().flatten();
            let (Some(&smallest), Some(&largest)) = (bounds.clone().min(), bounds.max()) else { return none() };
            let span = (largest - smallest).max(1) as f64;
            let time = |number: Option<u64>| number.map(|number| (number - smallest) as f64 / span);
            let given = numbers.into_iter().map(time).collect();
            Ok((given, format!("times from the numbers {smallest} to {largest} in names")))
        }
    }
}

/// Returns the number in the image name `name` that determines the time of the image; `None` if there is no number.
fn number(name: &str) -> Option<u64> {
    let file = name.rsplit(['/', '\\']).next()?;
    let stem = file.rsplit_once('.').map_or(file, |(stem, _)| stem);
    let digits = |text: &str| -> Option<u64> {
        let end = text.rfind(|c: char| c.is_ascii_digit())? + 1;
        let start = text[..end].rfind(|c: char| !c.is_ascii_digit()).map_or(0, |at| {
            // Continue after this character, which may take several bytes.
            at + text[at..].chars().next().map_or(1, char::len_utf8)
        });
        text[start..end].parse().ok()
    };
    let before_view = stem.rfind("_v").map(|at| &stem[..at]).filter(|before| {
        let rest = before.trim_end_matches(|c: char| c.is_ascii_digit());
        rest.len() < before.len() && rest.ends_with('t')
    });
    digits(before_view.unwrap_or(stem))
}

/// Returns the names under which an image is searched for in a table of times: the whole name, the file name, the file
/// name without extension.
fn keys(name: &str) -> impl Iterator<Item = &str> {
    let file = name.rsplit(['/', '\\']).next().unwrap_or(name);
    let stem = |text| Path::new(text).file_stem().and_then(|stem| stem.to_str()).unwrap_or(text);
    [name, file, stem(file)].into_iter()
}

/// Reads the CSV table at `path`, which maps image names to times. `counter` limits the memory. Fails if a line is
/// malformed or a name has two different times.
fn read_table(path: &Path, counter: &mut MemoryCounter) -> Result<HashMap<String, f64>> {
    let mut known = HashMap::new();
    let mut lines = TextLines::open(path)?;
    while let Some((number, line)) = lines.next_line()? {
        let (at, line) = (number - 1, line.trim());
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let wrong = |expected: &str, found: String| Error::input(path, format!("line {}", at + 1), expected, found);
        let parts = line.rsplit_once([',', ';', '\t']);
        let (name, time) = parts.ok_or_else(|| wrong("a name, a comma and a time", quoted(line)))?;
        let name = name.trim().trim_matches('"');
        match time.trim().parse::<f64>() {
            Ok(time) if time.is_finite() => {
                counter.take(
                    path,
                    &format!("line {number}"),
                    "the table of times",
                    name.len() as u64 + TABLE_ENTRY_BYTES,
                )?;
                if known.insert(name.to_owned(), time).is_some_and(|before| before != time) {
                    return Err(wrong("every name once", quoted(name)));
                }
            }
            // Skip the first line if its time is not a number: it is a header.
            Err(_) if at == 0 => (),
            _ => return Err(wrong("a finite time behind the name", quoted(time.trim()))),
        }
    }
    Ok(known)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn image_number_is_the_frame_number_or_the_last_number() {
        for (name, expected) in [
            ("cam03/frame_00012.png", Some(12)),
            ("t007_v03.png", Some(7)),
            ("IMG_4411.JPG", Some(4411)),
            ("0009.png", Some(9)),
            ("left1_000123.png", Some(123)),
            ("größe_5ü.png", Some(5)),
            ("cam3/still.png", None),
            ("shot_v2.png", Some(2)),
            ("99999999999999999999.png", None),
        ] {
            assert_eq!(number(name), expected, "{name}");
        }
    }
}
