//! Training arguments in the file `cfg_args` of a model folder.

use std::path::{Path, PathBuf};

use crate::error::Result;
use crate::files::python_literal::{Argument, Literal, parse_call};
use crate::models::four_d_gaussians::cfg_args::{CALL_NAME, ConfigKey, read};

/// Keys of a `cfg_args` file and their values.
#[derive(Debug)]
pub(in crate::models) struct Arguments {
    keys: Vec<Argument>,
    path: PathBuf,
}

impl Arguments {
    /// Reads the `cfg_args` file at `path`.
    ///
    /// # Errors
    /// Fails if the file cannot be read or its text is not a `Namespace(…)`.
    pub(in crate::models) fn read(path: &Path) -> Result<Arguments> {
        let text = read(path)?;
        let keys = parse_call(&text, CALL_NAME).map_err(|error| error.in_file(path, &text))?;
        Ok(Arguments { keys, path: path.to_owned() })
    }

    /// Returns the path of the `cfg_args` file.
    pub(in crate::models) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the key `name` with its value: the last value if the file has the key several times, [`Literal::None`]
    /// if it lacks the key.
    pub(in crate::models) fn get(&self, name: &'static str) -> ConfigKey<'_> {
        let found = self.keys.iter().rev().find(|key| key.name == name);
        ConfigKey { name, value: found.map_or(&Literal::None, |key| &key.value), path: &self.path }
    }
}
