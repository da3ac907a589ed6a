//! Driving a pass over the frames of a source on all threads, with progress.

mod progress;

pub use progress::Progress;
