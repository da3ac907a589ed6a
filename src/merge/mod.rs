//! Motion-consistent merging by moment matching (METHOD section 5).

pub mod greedy;
pub mod moments;
pub mod neighbors;
