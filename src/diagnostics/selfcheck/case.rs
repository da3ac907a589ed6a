//! Result of one case of the self-check: a name, a bound, and the largest error found.

use std::panic::{AssertUnwindSafe, catch_unwind};

use serde::Serialize;

use crate::error::Result;

/// Result of one case of the self-check.
#[derive(Debug, Serialize)]
pub struct CaseResult {
    /// Short name of the self-check case.
    pub name: &'static str,
    /// Description, for tables, of the compared values and of the reference with which they are compared.
    pub what: &'static str,
    /// Largest error that a correct program may have. Errors are relative, or in the unit that `what` names.
    pub bound: f64,
    /// Largest error found. It is infinite if a value is not a number or the case failed, and NaN if nothing was
    /// compared; both are null in JSON.
    pub error: f64,
    /// Whether the error found is at most the bound.
    pub pass: bool,
    /// Reason why nothing could be measured; `None` if the case ran.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
}

impl CaseResult {
    /// Runs the case `name`, whose function `measure` adds the error of every compared value to its argument.
    pub(super) fn new(
        name: &'static str,
        what: &'static str,
        bound: f64,
        measure: impl FnOnce(&mut LargestError) -> Result<()>,
    ) -> CaseResult {
        let mut worst = LargestError::default();
        // A panic is caught, so that the other cases still run.
        let (error, failure) = match catch_unwind(AssertUnwindSafe(|| measure(&mut worst))) {
            Ok(Ok(())) => (worst.0, None),
            Ok(Err(error)) => (f64::INFINITY, Some(error.to_string())),
            Err(_) => (f64::INFINITY, Some("a panic".to_owned())),
        };
        CaseResult { name, what, bound, error, pass: error <= bound, failure }
    }
}

/// Largest error of the values compared so far. Before the first comparison it is NaN, with which a case fails whatever
/// its bound is.
#[derive(Debug)]
pub(super) struct LargestError(pub(super) f64);

impl Default for LargestError {
    fn default() -> LargestError {
        LargestError(f64::NAN)
    }
}

impl LargestError {
    /// Updates the largest error with `error`, the error of one value. A NaN counts as infinite.
    pub(super) fn add(&mut self, error: f64) {
        self.0 = if error.is_nan() { f64::INFINITY } else { self.0.max(error) };
    }

    /// Compares `got` with `expected` and updates the largest error with |got − expected| / `unit`; `unit` must be
    /// positive.
    pub(super) fn near(&mut self, got: f64, expected: f64, unit: f64) {
        self.add((got - expected).abs() / unit);
    }

    /// Compares `got` with `expected` and updates the largest error with |got − expected| / |expected|, or with 0 if
    /// both are equal.
    pub(super) fn relative(&mut self, got: f64, expected: f64) {
        self.add(if got == expected { 0.0 } else { (got - expected).abs() / expected.abs() });
    }

    /// Compares `got` with `expected` and updates the largest error with 1 if they differ, else with 0.
    pub(super) fn same<T: PartialEq + ?Sized>(&mut self, got: &T, expected: &T) {
        self.add(if got == expected { 0.0 } else { 1.0 });
    }
}
