//! Statistics of every Gaussian in one pass over the frames (METHOD section 1).
