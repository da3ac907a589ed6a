//! `cfg_args`: what training was told.

use std::path::{Path, PathBuf};

use crate::error::Result;
use crate::files::python_literal::{Argument, Literal, parse_call};
use crate::models::four_d_gaussians::cfg_args::{ConfigKey, NAME, read};

/// The keys of a `cfg_args`.
#[derive(Debug)]
pub(in crate::models) struct Arguments {
    keys: Vec<Argument>,
    path: PathBuf,
}

impl Arguments {
    /// Reads the file at `path`.
    ///
    /// # Errors
    /// A file that cannot be read; text that is no `Namespace(…)`.
    pub(in crate::models) fn read(path: &Path) -> Result<Arguments> {
        let text = read(path)?;
        let keys = parse_call(&text, NAME).map_err(|error| error.in_file(path, &text))?;
        Ok(Arguments { keys, path: path.to_owned() })
    }

    /// The file.
    pub(in crate::models) fn path(&self) -> &Path {
        &self.path
    }

    /// The last value of `name`; none stands for a missing key too.
    pub(in crate::models) fn get(&self, name: &'static str) -> ConfigKey<'_> {
        let found = self.keys.iter().rev().find(|key| key.name == name);
        ConfigKey { name, value: found.map_or(&Literal::None, |key| &key.value), path: &self.path }
    }
}
