//! Named tensors of a state dict (the saved parameters of a network), looked up one by one with an expected shape.

use std::collections::BTreeMap;
use std::path::Path;

use splat_core::error::{Error, Result};

/// Dense tensor, row-major (last index fastest).
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    /// Number of elements along each index, outermost index first. Empty for a scalar.
    pub shape: Vec<usize>,
    /// Values of all elements; their number is the product of `shape`.
    pub data: Vec<f32>,
}

/// State dict (saved parameters of a network): tensors by dotted name.
pub type Tensors = BTreeMap<String, Tensor>;

/// State dict that was read from the file `path`, for looking up tensors. Every error names the file and the tensor.
#[derive(Clone, Copy)]
pub(super) struct Lookup<'a> {
    pub(super) tensors: &'a Tensors,
    pub(super) path: &'a Path,
}

impl<'a> Lookup<'a> {
    /// Returns the tensor `name`. Fails if the tensor is missing or a value is not finite. Errors show `why`, the
    /// reason why the tensor is expected.
    pub(super) fn get(&self, name: &str, why: &str) -> Result<&'a Tensor> {
        let tensor = self.tensors.get(name).ok_or_else(|| {
            Error::input(self.path, format!("tensor {name}"), format!("a tensor of this name ({why})"), "none")
                .hint("does cfg_args belong to this file?")
        })?;
        if let Some(at) = tensor.data.iter().position(|value| !value.is_finite()) {
            return Err(self.mismatch(name, "finite values", format!("{} at element {at}", tensor.data[at])));
        }
        Ok(tensor)
    }

    /// Returns the tensor `name`. Fails if the tensor is missing, a value is not finite, or its shape differs from
    /// `shape`, in which `None` accepts any extent. Errors show `why`, the reason why the tensor is expected with this
    /// shape.
    pub(super) fn get_shaped(&self, name: &str, shape: &[Option<usize>], why: &str) -> Result<&'a Tensor> {
        let tensor = self.get(name, why)?;
        let fits = tensor.shape.len() == shape.len()
            && tensor.shape.iter().zip(shape).all(|(&found, want)| found > 0 && want.is_none_or(|want| want == found));
        if fits {
            return Ok(tensor);
        }
        let want: Vec<String> = shape.iter().map(|w| w.map_or("any".to_owned(), |w| w.to_string())).collect();
        Err(self.mismatch(name, format!("shape [{}] ({why})", want.join(", ")), format!("{:?}", tensor.shape)))
    }

    /// Returns the numbers of outputs (rows) and inputs (columns) of the weight matrix `name`. Errors show `why`, the
    /// reason why the matrix is expected.
    pub(super) fn matrix(&self, name: &str, why: &str) -> Result<[usize; 2]> {
        let shape = &self.get_shaped(name, &[None, None], why)?.shape;
        Ok([shape[0], shape[1]])
    }

    /// Returns whether the state dict has a tensor `name`.
    pub(super) fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// Creates the error of a tensor `name` whose shape or values are not as expected.
    pub(super) fn mismatch(&self, name: &str, expected: impl Into<String>, found: impl Into<String>) -> Error {
        Error::input(self.path, format!("tensor {name}"), expected, found)
    }
}
