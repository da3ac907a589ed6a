//! `cfg_args`: what training was told.

use std::path::{Path, PathBuf};

use crate::error::Result;
use crate::families::four_d_gaussians::cfg_args::{Key, NAME, read};
use crate::families::python_literal::{Argument, Literal, parse_call};

/// The keys of a `cfg_args`.
#[derive(Debug)]
pub(in crate::families) struct Arguments {
    keys: Vec<Argument>,
    path: PathBuf,
}

impl Arguments {
    /// Reads the file at `path`.
    ///
    /// # Errors
    /// A file that cannot be read; text that is no `Namespace(…)`.
    pub(in crate::families) fn read(path: &Path) -> Result<Arguments> {
        let text = read(path)?;
        let keys = parse_call(&text, NAME).map_err(|error| error.in_file(path, &text))?;
        Ok(Arguments { keys, path: path.to_owned() })
    }

    /// The file.
    pub(in crate::families) fn path(&self) -> &Path {
        &self.path
    }

    /// The last value of `name`; none stands for a missing key too.
    pub(in crate::families) fn get(&self, name: &'static str) -> Key<'_> {
        let found = self.keys.iter().rev().find(|key| key.name == name);
        Key { name, value: found.map_or(&Literal::None, |key| &key.value), path: &self.path }
    }
}
