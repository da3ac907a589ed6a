//! `gseq`: a chunked, memory-mapped container for sequences of Gaussians. See `SPEC.md`.

/// What can be wrong with a container.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Placeholder until the reader lands.
    #[error("malformed container")]
    Malformed,
}
