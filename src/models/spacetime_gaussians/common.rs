//! Functions shared by SpacetimeGaussians model folders and `.splatv` files.

use crate::error::{Error, Result};
use crate::model::{Attributes, Jacobian};
use crate::models::input_model::MemoryProfile;
use crate::models::trajectories::state_bytes;
use crate::outputs::container::GAUSSIAN_BLOCK;
use crate::outputs::kind::OutputKind;

/// Returns how much memory an open model takes, and how much time and memory reading it takes. `param_count` is the
/// number of its format-specific parameters per Gaussian.
pub(super) fn memory_profile(param_count: usize) -> MemoryProfile {
    let whole = state_bytes(0, Attributes::all()) + 4 * param_count as u64;
    MemoryProfile {
        per_gaussian: whole,
        opening: whole,
        // A copy of the stored parameters with the values prepared from them.
        reader: whole + 16 + 8,
        compressed: 2 * whole,
        jacobian: Jacobian::BYTES_PER_GAUSSIAN as u64,
        file: whole + 24,
        gaussian_block: GAUSSIAN_BLOCK as u64,
        seconds_per_state: 4e-8,
        ..MemoryProfile::default()
    }
}

/// Fails if a SpacetimeGaussians model cannot be written as the kind of output `kind`: a full model (`is_full`) cannot
/// be written as `.splatv`, which stores no features. The caller itself checks whether a model folder or a single PLY
/// file can be written.
pub(super) fn check_kind(kind: OutputKind, is_full: bool) -> Result<()> {
    match kind {
        OutputKind::Splatv if is_full => Err(Error::usage(
            "a .splatv stores colors, not features: it holds only lite models of SpacetimeGaussians\n  write a model \
             folder or a .gseq",
        )),
        _ => Ok(()),
    }
}
