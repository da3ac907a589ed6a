//! How close pictures are to one another.
