//! File `cfg_args` of a model folder: the training arguments, as the text of a Python `Namespace(...)`. The text is
//! parsed and never evaluated.

use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use crate::files::names::last_component;
use crate::files::python_literal::{Argument, Literal, parse_call};
use crate::files::text::read_text;

/// Maximum bytes of a `cfg_args` file, more than any namespace that an argument parser prints.
const MAX_BYTES: u64 = 1 << 20;
/// Name of the Python call that a `cfg_args` file consists of.
const CALL_NAME: &str = "Namespace";
/// Key of the SH degree in `cfg_args`.
pub(super) const SH_DEGREE: &str = "sh_degree";

/// Returns the text of the `cfg_args` file at `path`. Fails if the file cannot be read, is not UTF-8 text or has more
/// than [`MAX_BYTES`] bytes.
pub(super) fn read(path: &Path) -> Result<String> {
    read_text(path, MAX_BYTES)
}

/// Keys of a `cfg_args` file and their values.
#[derive(Debug, Default)]
pub(super) struct Arguments {
    keys: Vec<Argument>,
    path: PathBuf,
}

impl Arguments {
    /// Reads the `cfg_args` file at `path`.
    ///
    /// # Errors
    /// Fails if the file cannot be read or its text is not a `Namespace(…)`.
    pub(super) fn read(path: &Path) -> Result<Arguments> {
        Arguments::parse(&read(path)?, path)
    }

    /// Parses `text`, the content of the `cfg_args` file at `path`.
    ///
    /// # Errors
    /// Fails if `text` is not a `Namespace(…)`.
    pub(super) fn parse(text: &str, path: &Path) -> Result<Arguments> {
        let keys = parse_call(text, CALL_NAME).map_err(|error| error.in_file(path, text))?;
        Ok(Arguments { keys, path: path.to_owned() })
    }

    /// Returns the path of the `cfg_args` file.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the key `name` with its value: [`Literal::None`] if the file lacks the key. If the file has the key
    /// several times, as Python does not allow, the last value counts.
    pub(super) fn get(&self, name: &'static str) -> ConfigKey<'_> {
        let found = self.keys.iter().rev().find(|key| key.name == name);
        ConfigKey { name, value: found.map_or(&Literal::None, |key| &key.value), path: &self.path }
    }
}

/// Returns `text`, the content of a `cfg_args` file, with the SH degree `degree` and all other bytes unchanged. If
/// `text` does not give the SH degree, it becomes the first key. `path` is for error messages. Fails if `text` is not a
/// `Namespace(…)`.
pub(super) fn with_sh_degree(text: &str, degree: usize, path: &Path) -> Result<String> {
    let keys = Arguments::parse(text, path)?.keys;
    let (place, value) = match keys.iter().rev().find(|key| key.name == SH_DEGREE) {
        Some(key) => (key.place.clone(), degree.to_string()),
        None => {
            let start = text.find('(').map_or(text.len(), |bracket| bracket + 1);
            let separator = if keys.is_empty() { "" } else { ", " };
            (start..start, format!("{SH_DEGREE}={degree}{separator}"))
        }
    };
    Ok([&text[..place.start], &value, &text[place.end..]].concat())
}

/// Returns the text of the `cfg_args` file at `path` for an output with SH degree `degree`. `input_degree` is the SH
/// degree of the input. If `degree` is lower than `input_degree`, `degree` replaces the SH degree in the text;
/// otherwise the text is unchanged. Fails if the file cannot be read.
pub(super) fn read_for_degree(path: &Path, input_degree: usize, degree: usize) -> Result<String> {
    let text = read(path)?;
    if degree < input_degree { with_sh_degree(&text, degree, path) } else { Ok(text) }
}

/// Returns `text`, the content of the `cfg_args` file at `path`, without the folders of the training machine, because
/// archives are made to be shared. The strings of `source_path` and `model_path`, and all strings that are absolute
/// paths, are replaced by their last path components; all other bytes are unchanged. Fails if `text` is not a
/// `Namespace(…)`.
pub(super) fn without_folder_paths(text: &str, path: &Path) -> Result<String> {
    let keys = Arguments::parse(text, path)?.keys;
    let (mut out, mut end) = (String::with_capacity(text.len()), 0);
    for key in &keys {
        out += &text[end..key.place.start];
        out += &without_paths(&text[key.place.clone()], ["source_path", "model_path"].contains(&key.name.as_str()));
        end = key.place.end;
    }
    Ok(out + &text[end..])
}

/// Returns the Python expression `expression` with strings replaced by their last path components: all strings if
/// `all`, else only absolute paths.
fn without_paths(expression: &str, all: bool) -> String {
    let mut out = String::with_capacity(expression.len());
    let mut rest = expression;
    while let Some(start) = rest.find(['\'', '"']) {
        let quote = rest[start..].chars().next().unwrap_or('"');
        let content = &rest[start + 1..];
        let mut is_escaped = false;
        let end = content.find(|c: char| {
            let ends = c == quote && !is_escaped;
            is_escaped = c == '\\' && !is_escaped;
            ends
        });
        // A quote without a closing quote does not begin a string.
        let Some(end) = end else { break };
        let string = &content[..end];
        let is_absolute = string.starts_with(['/', '~', '\\']) || string.get(1..2) == Some(":");
        let last = last_component(string);
        out += &rest[..=start];
        match all || is_absolute {
            true => out.extend(last.chars().filter(|&c| c != quote)),
            false => out += string,
        }
        out.push(quote);
        rest = &content[end + 1..];
    }
    out + rest
}

/// Key of a `cfg_args` file with its value. A missing key has the value `None`, which selects the default.
#[derive(Clone, Copy)]
pub(super) struct ConfigKey<'a> {
    pub(super) name: &'static str,
    pub(super) value: &'a Literal,
    pub(super) path: &'a Path,
}

impl<'a> ConfigKey<'a> {
    /// Returns an error which says that the value of this key is wrong; `expected` describes a correct value.
    pub(super) fn wrong(&self, expected: &str) -> Error {
        Error::input(self.path, format!("key {}", self.name), expected, self.value.to_string())
    }

    /// Returns the value as a boolean, or `default` if the key is missing; 0 and 1 count as booleans. Fails for any
    /// other value.
    pub(super) fn bool(&self, default: bool) -> Result<bool> {
        match self.value {
            Literal::None => Ok(default),
            Literal::Bool(value) => Ok(*value),
            Literal::Int(value @ (0 | 1)) => Ok(*value == 1),
            _ => Err(self.wrong("True or False")),
        }
    }

    /// Returns the value as an integer, or `default` if the key is missing. Accepts booleans: Python's `True` is the
    /// integer 1, and some forks write `grid_pe=False`. Fails for any other value.
    pub(super) fn int(&self, default: i64) -> Result<i64> {
        match self.value {
            Literal::None => Ok(default),
            Literal::Int(value) => Ok(*value),
            Literal::Bool(value) => Ok(i64::from(*value)),
            _ => Err(self.wrong("an integer")),
        }
    }

    /// Returns the value as a number, or `default` if the key is missing. Fails if the value is not a number.
    pub(super) fn float(&self, default: f64) -> Result<f64> {
        match self.value {
            Literal::None => Ok(default),
            Literal::Float(value) => Ok(*value),
            Literal::Int(value) => Ok(*value as f64),
            _ => Err(self.wrong("a number")),
        }
    }

    /// Returns the value as a string; `None` if the key is missing. Fails if the value is not a string.
    pub(super) fn string(&self) -> Result<Option<String>> {
        match self.value {
            Literal::None => Ok(None),
            Literal::Str(value) => Ok(Some(value.clone())),
            _ => Err(self.wrong("a string")),
        }
    }

    /// Returns the value as a list of integers, or `default` if the key is missing. Fails if the value is not such a
    /// list.
    pub(super) fn ints(&self, default: &[i64]) -> Result<Vec<i64>> {
        match self.value {
            Literal::None => Ok(default.to_vec()),
            Literal::Sequence(items) => {
                items.iter().map(|value| ConfigKey { value, ..*self }.int(0)).collect::<Result<_>>()
            }
            _ => Err(self.wrong("a list of integers")),
        }
    }

    /// Returns the entry `name` of this key's value, which must be a dictionary. The returned entry has no value if the
    /// key or the entry is missing. Fails if the value is not a dictionary.
    pub(super) fn entry(&self, name: &'static str) -> Result<ConfigKey<'a>> {
        let value = match self.value {
            Literal::None => &Literal::None,
            Literal::Dict(entries) => entries
                .iter()
                .find(|(key, _)| matches!(key, Literal::Str(key) if key == name))
                .map_or(&Literal::None, |(_, value)| value),
            _ => return Err(self.wrong("a dictionary")),
        };
        Ok(ConfigKey { name, value, path: self.path })
    }
}
