//! Warnings about failures that leave an output complete, such as a failure to remove an earlier output.

use std::sync::{Mutex, PoisonError};

/// Warnings recorded since the last call of [`take_warnings`].
static WARNINGS: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Records a warning, to be returned by [`take_warnings`].
pub(super) fn warn(message: String) {
    WARNINGS.lock().unwrap_or_else(PoisonError::into_inner).push(message);
}

/// Returns the warnings recorded since the last call. They report failures after which an output is nevertheless
/// complete and at its final path, such as a failure to remove an earlier output or the files of a killed run.
pub fn take_warnings() -> Vec<String> {
    std::mem::take(&mut WARNINGS.lock().unwrap_or_else(PoisonError::into_inner))
}
