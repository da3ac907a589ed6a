//! Warnings about failures after a result was put in place.

use std::sync::{Mutex, PoisonError};

/// Warnings since the last call of [`take_warnings`].
static WARNINGS: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Records a warning for [`take_warnings`].
pub(super) fn warn(message: String) {
    WARNINGS.lock().unwrap_or_else(PoisonError::into_inner).push(message);
}

/// Returns the warnings recorded since the last call. The results that they name are complete and in place.
pub fn take_warnings() -> Vec<String> {
    std::mem::take(&mut WARNINGS.lock().unwrap_or_else(PoisonError::into_inner))
}
