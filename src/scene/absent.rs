//! Absent Gaussians: Gaussians that are dropped because some of their values are NaN or infinite. They are invisible in
//! every frame that is read.
//!
//! Ids do not change. An absent Gaussian keeps its row in the arrays, but its values are replaced by invisible ones
//! ([`clear_row`]). So it has no effect on renders, contributions, removal errors, statistics and bounds of the other
//! Gaussians. Memory: 4 bytes per absent Gaussian, and as many again in every reader.

use std::sync::{Arc, PoisonError, RwLock};

use crate::error::Result;
use crate::model::{Attributes, Gaussians};
use crate::source::{BlockReader, Ids, ReadPlan};

/// Ids, in increasing order, of the absent Gaussians: those that are made invisible because some of their values are
/// NaN or infinite.
#[derive(Debug, Default)]
pub(super) struct Absent(RwLock<Arc<[u32]>>);

impl Absent {
    /// Returns the ids of the absent (invisible) Gaussians, in increasing order.
    fn ids(&self) -> Arc<[u32]> {
        self.0.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Replaces the ids of the absent (invisible) Gaussians by `ids`, which must be in increasing order.
    pub(super) fn set(&self, ids: &[u32]) {
        debug_assert!(ids.is_sorted(), "absent ids are sorted");
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = ids.into();
    }

    /// Returns whether no Gaussian is absent (made invisible).
    pub(super) fn is_empty(&self) -> bool {
        self.ids().is_empty()
    }

    /// Wraps `reader`, which reads the Gaussians with the ids `ids`, in a reader that makes absent Gaussians invisible.
    /// Returns `reader` itself if none of these Gaussians is absent.
    pub(super) fn hiding<'a>(&self, reader: Box<dyn BlockReader + 'a>, ids: &Ids<'_>) -> Box<dyn BlockReader + 'a> {
        let absent = self.ids();
        let rows = ids.iter().enumerate().filter(|(_, id)| absent.binary_search(&(*id as u32)).is_ok());
        let rows: Vec<usize> = rows.map(|(row, _)| row).collect();
        if rows.is_empty() { reader } else { Box::new(HidingReader { reader, rows }) }
    }
}

/// Reader that returns the Gaussians of another reader, but makes the absent Gaussians (those with NaN or infinite
/// values) invisible.
struct HidingReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    /// Indices of the Gaussians to make invisible, in the arrays that `reader` fills.
    rows: Vec<usize>,
}

impl BlockReader for HidingReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        self.reader.read(frame, want, out)?;
        self.rows.iter().for_each(|&row| clear_row(out, want, row));
        Ok(())
    }

    fn expect(&mut self, plan: &ReadPlan) {
        self.reader.expect(plan);
    }
}

/// Makes the Gaussian in row `row` of `state` invisible by overwriting its attributes `want`: position NaN (which lies
/// in no box and is not rendered), opacity 0, the identity rotation, scale 1 on each axis, and SH coefficients 0.
fn clear_row(state: &mut Gaussians, want: Attributes, row: usize) {
    for column in want.iter() {
        let value = match column {
            Attributes::POSITION => f32::NAN,
            Attributes::OPACITY => f32::NEG_INFINITY,
            _ => 0.0,
        };
        let values = state.attribute_values_mut(column);
        (0..values.width()).for_each(|plane| values.plane_mut(plane)[row] = value);
        if column == Attributes::ROTATION {
            values.plane_mut(0)[row] = 1.0;
        }
    }
}
