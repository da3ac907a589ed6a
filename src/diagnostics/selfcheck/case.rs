//! Result of one case: a name, a bound, and the largest error found.

use std::panic::{AssertUnwindSafe, catch_unwind};

use serde::Serialize;

use crate::error::Result;

/// Result of one case.
#[derive(Debug, Serialize)]
pub struct Case {
    /// Short name of the case.
    pub name: &'static str,
    /// Values that are compared, and their reference.
    pub what: &'static str,
    /// Largest error of a correct build. Errors are relative or in the unit that `what` names.
    pub bound: f64,
    /// Largest error found; infinite or NaN, which is JSON null, if a value is not a number or nothing could be
    /// measured.
    pub error: f64,
    /// Whether the error is within the bound.
    pub pass: bool,
    /// Reason why nothing could be measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
}

impl Case {
    pub(super) fn new(
        name: &'static str,
        what: &'static str,
        bound: f64,
        measure: impl FnOnce() -> Result<LargestError>,
    ) -> Case {
        // A panic is caught, so that the other cases still run.
        let (error, failure) = match catch_unwind(AssertUnwindSafe(measure)) {
            Ok(Ok(LargestError(error))) => (error, None),
            Ok(Err(error)) => (f64::INFINITY, Some(error.to_string())),
            Err(_) => (f64::INFINITY, Some("a panic".to_owned())),
        };
        Case { name, what, bound, error, pass: error <= bound, failure }
    }
}

/// Largest error so far; NaN, which exceeds every bound, before any value was compared.
#[derive(Debug)]
pub(super) struct LargestError(pub(super) f64);

impl Default for LargestError {
    fn default() -> LargestError {
        LargestError(f64::NAN)
    }
}

impl LargestError {
    /// Adds an error; NaN counts as infinite.
    pub(super) fn add(&mut self, error: f64) {
        self.0 = if error.is_nan() { f64::INFINITY } else { self.0.max(error) };
    }

    /// Adds |got − expected| / `unit`, for a positive unit.
    pub(super) fn near(&mut self, got: f64, expected: f64, unit: f64) {
        self.add((got - expected).abs() / unit);
    }

    /// Adds |got − expected| / |expected|, or 0 if both are equal.
    pub(super) fn relative(&mut self, got: f64, expected: f64) {
        self.add(if got == expected { 0.0 } else { (got - expected).abs() / expected.abs() });
    }

    /// Adds 1 if values differ that must be equal, else 0.
    pub(super) fn same<T: PartialEq + ?Sized>(&mut self, got: &T, expected: &T) {
        self.add(if got == expected { 0.0 } else { 1.0 });
    }
}
