//! Reads the files beside a checkpoint that record how the model was trained: `cfg_args`, and the YAML configuration of
//! the training. The trainer does not save the YAML with the model, so it exists only if somebody copied it.

use std::path::Path;

use crate::error::{Error, Result, quoted};
use crate::files::text::read_text;
use crate::models::cfg_args::Arguments;
use crate::models::in_checkpoint::yaml_files_in;

/// Values of the training configuration that affect how the model is read or rendered.
#[derive(Debug, Default)]
pub(super) struct TrainingConfig {
    pub(super) source_path: Option<String>,
    /// Whether the background of the training images is white; else it is black.
    pub(super) white_background: bool,
    /// Variance in time (`prefilter_var`) that the training added to the temporal variance Σ_tt of each Gaussian.
    pub(super) prefilter: f64,
    /// Period L after which colors repeat, in the model's time unit, and the name of the file that gives it.
    pub(super) time_duration: Option<(f64, String)>,
}

impl TrainingConfig {
    /// Reads the training configuration of the model in the folder `root`.
    ///
    /// # Errors
    /// Fails if a file cannot be read or parsed, or if two files contradict each other.
    pub(super) fn read(root: &Path) -> Result<TrainingConfig> {
        let time_duration = time_duration(root)?;
        let path = root.join("cfg_args");
        let arguments = if path.is_file() { Arguments::read(&path)? } else { Arguments::default() };
        Ok(TrainingConfig {
            // Only a hint where the cameras may be, so a value of another type is no error.
            source_path: arguments.get("source_path").string().unwrap_or_default(),
            white_background: arguments.get("white_background").bool(false)?,
            prefilter: arguments.get("prefilter_var").float(0.0)?,
            time_duration,
        })
    }
}

/// Returns the period L of colors from the YAML files in `root`, and the name of the file that gives it. Returns `None`
/// if no file gives it. Fails if two files give different periods, or if the entry of a file is not a pair of
/// increasing times.
fn time_duration(root: &Path) -> Result<Option<(f64, String)>> {
    let mut found: Option<(f64, String)> = None;
    for path in yaml_files_in(root) {
        // Text files that have nothing to do with the model may be unreadable, so skip such files.
        let Ok(text) = read_text(&path, 1 << 20) else { continue };
        let Some(span) = time_duration_entries(&text) else { continue };
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let wrong = |expected: String, found: String| Err(Error::input(&path, "key time_duration", expected, found));
        let length = match span[..] {
            [start, end] => start.parse::<f64>().ok().zip(end.parse::<f64>().ok()).map(|(start, end)| end - start),
            _ => None,
        };
        let Some(length) = length.filter(|length| length.is_finite() && *length > 0.0) else {
            return wrong("two times such as [0.0, 10.0]".to_owned(), quoted(&span.join(", ")).to_string());
        };
        match &found {
            Some((other, file)) if *other != length => {
                return wrong(format!("{other}, as in {file}"), length.to_string());
            }
            _ => found = Some((length, name)),
        }
    }
    Ok(found)
}

/// Returns the entries of the list `time_duration` in a YAML text. The list may be written in one line or one entry per
/// line.
fn time_duration_entries(text: &str) -> Option<Vec<&str>> {
    let mut lines = text.lines().map(|line| line.split('#').next().unwrap_or_default().trim_end());
    let after = lines.find_map(|line| line.strip_prefix("time_duration:"))?.trim();
    Some(match after.is_empty() {
        true => lines.map_while(|line| line.trim_start().strip_prefix('-')).map(str::trim).collect(),
        false => after.trim_matches(['[', ']']).split(',').map(str::trim).collect(),
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn time_duration_is_found_in_every_list_notation() {
        for (text, expected) in [
            ("gaussian_dim: 4\ntime_duration: [0.0, 10.0] # seconds\nModelParams:\n", Some(vec!["0.0", "10.0"])),
            ("time_duration:\n- -0.5\n  - 0.5\nrot_4d: True\n", Some(vec!["-0.5", "0.5"])),
            ("time_duration: soon\n", Some(vec!["soon"])),
            ("ModelParams:\n  time_duration: [0, 1]\n", None),
        ] {
            assert_eq!(time_duration_entries(text), expected, "{text}");
        }
    }

    #[test]
    fn configuration_files_give_the_duration_or_an_error() {
        let root = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| fs::write(root.path().join(name), text).unwrap();
        let read = || time_duration(root.path());
        assert_eq!(read().unwrap(), None);
        write("config.yaml", "time_duration: [-1, 1.5]\n");
        write("notes.yml", "of: something else\n");
        assert_eq!(read().unwrap(), Some((2.5, "config.yaml".to_owned())));
        for (text, parts) in [
            ("time_duration: [0, 1]\n", ["2.5, as in config.yaml", "1"]),
            ("time_duration: [1, 1]\n", ["two times", "1, 1"]),
            ("time_duration: 3\n", ["two times", "3"]),
        ] {
            write("notes.yml", text);
            let message = read().unwrap_err().to_string();
            assert!(message.contains("notes.yml, key time_duration"), "{message}");
            assert!(parts.iter().all(|part| message.contains(part)), "{parts:?} are not in {message}");
        }
    }
}
