//! Motion-consistent merging by moment matching (METHOD section 5).

pub mod gates;
pub mod greedy;
pub mod moments;
pub mod motion;
pub mod neighbors;
