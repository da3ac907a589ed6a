//! One case: a name, a bound, and the largest error found.

use std::panic::{AssertUnwindSafe, catch_unwind};

use serde::Serialize;

use crate::error::Result;

/// What was checked, how far off it may be, and how far off it is.
#[derive(Debug, Serialize)]
pub struct Case {
    /// A few words that name it.
    pub name: &'static str,
    /// What is compared with what.
    pub what: &'static str,
    /// Largest error of a sound build. Errors are relative or in the unit that `what` names.
    pub bound: f64,
    /// The largest error; infinite or NaN, as JSON null, where one is no number or nothing could be measured.
    pub error: f64,
    /// Whether the error is within the bound.
    pub pass: bool,
    /// Why nothing could be measured.
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
        // A build so broken that it panics has other cases to show.
        let (error, failure) = match catch_unwind(AssertUnwindSafe(measure)) {
            Ok(Ok(LargestError(error))) => (error, None),
            Ok(Err(error)) => (f64::INFINITY, Some(error.to_string())),
            Err(_) => (f64::INFINITY, Some("a panic".to_owned())),
        };
        Case { name, what, bound, error, pass: error <= bound, failure }
    }
}

/// The largest error so far; NaN, which is within no bound, of nothing looked at.
#[derive(Debug)]
pub(super) struct LargestError(pub(super) f64);

impl Default for LargestError {
    fn default() -> LargestError {
        LargestError(f64::NAN)
    }
}

impl LargestError {
    /// An error, which is infinite where it is no number.
    pub(super) fn add(&mut self, error: f64) {
        self.0 = if error.is_nan() { f64::INFINITY } else { self.0.max(error) };
    }

    /// |got − expected| in parts of `unit`, which is positive.
    pub(super) fn near(&mut self, got: f64, expected: f64, unit: f64) {
        self.add((got - expected).abs() / unit);
    }

    /// |got − expected| in parts of what is expected, or 0 where both are the same.
    pub(super) fn relative(&mut self, got: f64, expected: f64) {
        self.add(if got == expected { 0.0 } else { (got - expected).abs() / expected.abs() });
    }

    /// 1 where things differ that must be the same.
    pub(super) fn same<T: PartialEq + ?Sized>(&mut self, got: &T, expected: &T) {
        self.add(if got == expected { 0.0 } else { 1.0 });
    }
}
