//! How much memory a run may take, and what follows from it.

/// What stages keep in memory at a time. No result depends on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Frames that a reader which goes frame by frame may hold of those it decodes together; at least 1.
    pub frames_held: usize,
    /// Frames whose states lie ready to be looked at; at least 1.
    pub frames_together: usize,
    /// Pictures worked on at once; at least 1.
    pub pictures_together: usize,
    /// Gaussians of a result whose frames wait together to be written.
    pub gaussians_together: usize,
    /// Pairs of Gaussians whose motion is measured together; at least 1.
    pub pairs_together: usize,
    /// Statistics wait in a scratch file once they have been scored.
    pub rows_aside: bool,
    /// The tiles of a container stay in memory once they are decoded, all of them.
    pub tiles_held: bool,
}

impl Limits {
    /// As much as it takes to be fast.
    pub const NONE: Limits = Limits {
        frames_held: usize::MAX,
        frames_together: usize::MAX,
        pictures_together: usize::MAX,
        gaussians_together: usize::MAX,
        pairs_together: usize::MAX,
        rows_aside: false,
        tiles_held: false,
    };
}
