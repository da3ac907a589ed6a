//! Formats lists of increasing numbers as text such as `1-5` and `8`.

use std::fmt::Display;

use num_traits::PrimInt;

/// Formats increasing `numbers` as one text for each run of consecutive numbers, such as `3` or `10-20`.
pub fn format_ranges<T: PrimInt + Display>(numbers: &[T]) -> Vec<String> {
    let runs = numbers.chunk_by(|&a, &b| a + T::one() == b);
    let text = |run: &[T]| match (run[0], run[run.len() - 1]) {
        (first, last) if first == last => first.to_string(),
        (first, last) => format!("{first}-{last}"),
    };
    runs.map(text).collect()
}
