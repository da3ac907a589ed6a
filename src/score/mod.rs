//! Robust normalisation and scores (METHOD sections 2 and 3).
