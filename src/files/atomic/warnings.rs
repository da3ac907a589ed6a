//! Warnings about failures that leave an output complete, such as a failure to remove an earlier output.

use std::sync::{Mutex, PoisonError};

/// Warnings recorded since the last call of [`take_warnings`].
static WARNINGS: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Records a warning, to be returned by [`take_warnings`].
pub(super) fn warn(message: String) {
    WARNINGS.lock().unwrap_or_else(PoisonError::into_inner).push(message);
}

/// Returns the warnings recorded since the last call. They concern steps around an output, such as removing an earlier
/// output or the remains of a killed run. The outputs named in them are complete and at their final paths.
pub fn take_warnings() -> Vec<String> {
    std::mem::take(&mut WARNINGS.lock().unwrap_or_else(PoisonError::into_inner))
}
