//! Motion-consistent merging by moment matching (METHOD section 5).

pub mod moments;
