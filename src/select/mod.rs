//! Sampling and pruning (METHOD section 4).
