//! Lists of increasing numbers as text.

use std::fmt::Display;

use num_traits::PrimInt;

/// Returns increasing numbers as texts of consecutive runs, such as `3` and `10-20`.
pub fn ranges<T: PrimInt + Display>(numbers: &[T]) -> Vec<String> {
    let runs = numbers.chunk_by(|&a, &b| a + T::one() == b);
    let text = |run: &[T]| match (run[0], run[run.len() - 1]) {
        (first, last) if first == last => first.to_string(),
        (first, last) => format!("{first}-{last}"),
    };
    runs.map(text).collect()
}
