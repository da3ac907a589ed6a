//! Absent Gaussians: Gaussians that are dropped because some of their values are NaN or infinite. They are invisible in
//! every frame that is read.
//!
//! Ids do not change. An absent Gaussian keeps its row in the arrays, but with invisible values ([`clear_row`]). So
//! renders, contributions, removal errors, statistics and bounds are those of the other Gaussians. Memory: 4 bytes per
//! absent Gaussian, and as many again in every reader.

use std::sync::{Arc, PoisonError, RwLock};

use crate::error::Result;
use crate::model::{Attributes, Gaussians};
use crate::source::{BlockReader, Ids, ReadPlan};

/// Ids of the absent Gaussians, in increasing order.
#[derive(Debug, Default)]
pub(super) struct Absent(RwLock<Arc<[u32]>>);

impl Absent {
    /// Returns the ids of the absent Gaussians.
    fn ids(&self) -> Arc<[u32]> {
        self.0.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Replaces the absent Gaussians by those with the ids `ids`, which must be in increasing order.
    pub(super) fn set(&self, ids: &[u32]) {
        debug_assert!(ids.is_sorted(), "absent ids are sorted");
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = ids.into();
    }

    /// Returns whether no Gaussian is absent.
    pub(super) fn is_empty(&self) -> bool {
        self.ids().is_empty()
    }

    /// Wraps `reader`, which reads the Gaussians `ids`, so that it returns invisible values for absent Gaussians.
    /// Returns `reader` unchanged if none of its Gaussians is absent.
    pub(super) fn hiding<'a>(&self, reader: Box<dyn BlockReader + 'a>, ids: &Ids<'_>) -> Box<dyn BlockReader + 'a> {
        let absent = self.ids();
        let rows = ids.iter().enumerate().filter(|(_, id)| absent.binary_search(&(*id as u32)).is_ok());
        let rows: Vec<usize> = rows.map(|(row, _)| row).collect();
        if rows.is_empty() { reader } else { Box::new(HidingReader { reader, rows }) }
    }
}

/// Reader that makes some of the Gaussians of another reader invisible: those that are excluded from the scene, because
/// a value of theirs is NaN or infinite.
struct HidingReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    /// Rows of the absent Gaussians among those that are read.
    rows: Vec<usize>,
}

impl BlockReader for HidingReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        self.reader.read(frame, want, out)?;
        self.rows.iter().for_each(|&row| clear_row(out, want, row));
        Ok(())
    }

    fn expect(&mut self, wanted: &ReadPlan) {
        self.reader.expect(wanted);
    }

    fn prepare(&mut self, frame: usize, want: Attributes) -> Result<()> {
        self.reader.prepare(frame, want)
    }
}

/// Makes the Gaussian in row `row` of `state` invisible by setting its attributes `want`: a position of NaN (which lies
/// in no box and is not rendered), an opacity of 0, the identity rotation, size 1 and no color.
fn clear_row(state: &mut Gaussians, want: Attributes, row: usize) {
    for column in want.iter() {
        let value = match column {
            Attributes::POSITION => f32::NAN,
            Attributes::OPACITY => f32::NEG_INFINITY,
            _ => 0.0,
        };
        let values = state.column_mut(column);
        (0..values.width()).for_each(|plane| values.plane_mut(plane)[row] = value);
        if column == Attributes::ROTATION {
            values.plane_mut(0)[row] = 1.0;
        }
    }
}
