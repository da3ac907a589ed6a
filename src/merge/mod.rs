//! Motion-consistent merging by moment matching (METHOD section 5).
