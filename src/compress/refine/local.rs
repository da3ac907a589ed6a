//! States at the frames that are shown, and how they change with what is stored, in a scratch file.

use std::path::Path;

use crate::error::Result;
use crate::model::{Column, Columns, Gaussians, Jacobian};
use crate::work::{Spill, Spilling};

/// A state, and how it changes with what is stored.
#[derive(Debug, Clone, Default)]
pub(super) struct Local {
    pub(super) state: Gaussians,
    pub(super) jacobian: Jacobian,
}

impl Local {
    /// Of no Gaussians, with harmonics up to `sh_degree`.
    pub(super) fn none(sh_degree: usize) -> Local {
        Local { state: Gaussians::zeros(0, sh_degree), jacobian: Jacobian::default() }
    }

    /// The Gaussians at `places`, in that order.
    pub(super) fn pick(&self, places: &[u32]) -> Local {
        Local { state: self.state.pick(places), jacobian: self.jacobian.pick(places) }
    }

    /// What is kept of every frame: the columns `varying` of the state, and the Jacobian.
    fn kept(&mut self, varying: Columns) -> impl Iterator<Item = &mut Column> {
        self.state.columns_mut(varying).chain(self.jacobian.columns_mut())
    }
}

/// [`Local`] of one frame after the other. Memory: one.
#[derive(Debug)]
pub(super) struct Locals {
    file: Spill,
    varying: Columns,
    /// The first frame's: what does not vary, and the shape of what does.
    first: Option<Local>,
}

/// [`Locals`] that are being kept.
pub(super) struct Keeping {
    file: Spilling,
    varying: Columns,
    first: Option<Local>,
}

impl Keeping {
    /// Of no frames yet; the columns `varying` of states differ from frame to frame.
    ///
    /// # Errors
    /// A scratch file that cannot be made in `scratch`.
    pub(super) fn new(scratch: &Path, varying: Columns) -> Result<Keeping> {
        Ok(Keeping { file: Spilling::new(scratch)?, varying, first: None })
    }

    /// Whether nothing is kept yet.
    pub(super) fn is_empty(&self) -> bool {
        self.first.is_none()
    }

    /// Keeps the next frame's.
    ///
    /// # Errors
    /// A scratch file that cannot be written.
    pub(super) fn push(&mut self, next: &mut Local) -> Result<()> {
        for column in next.kept(self.varying) {
            self.file.write(bytemuck::cast_slice(column.planes()))?;
        }
        self.first.get_or_insert_with(|| next.clone());
        Ok(())
    }

    /// Ends keeping: only then can be read.
    ///
    /// # Errors
    /// A scratch file that cannot be written.
    pub(super) fn finish(self) -> Result<Locals> {
        Ok(Locals { file: self.file.finish()?, varying: self.varying, first: self.first })
    }
}

impl Locals {
    /// The first frame's, if there is one.
    pub(super) fn first(&self) -> Option<&Local> {
        self.first.as_ref()
    }

    /// Makes `to` that of frame `k`, counted as they were kept.
    ///
    /// # Errors
    /// A scratch file that cannot be read.
    pub(super) fn read(&self, k: usize, to: &mut Local) -> Result<()> {
        let Some(first) = &self.first else { return Ok(()) };
        let still = Columns::all().difference(self.varying);
        let shape = |to: &mut Column, of: &Column| {
            if to.width() != of.width() {
                *to = Column::zeros(of.width(), of.len());
            }
            to.resize(of.len());
        };
        for column in Columns::all().iter() {
            let (to, of) = (to.state.column_mut(column), first.state.column(column));
            shape(to, of);
            if still.contains(column) {
                to.planes_mut().copy_from_slice(of.planes());
            }
        }
        to.jacobian.columns_mut().iter_mut().zip(first.jacobian.columns()).for_each(|(to, of)| shape(to, of));
        let bytes: u64 = to.kept(self.varying).map(|column| 4 * column.planes().len() as u64).sum();
        let mut at = k as u64 * bytes;
        for column in to.kept(self.varying) {
            let values = bytemuck::cast_slice_mut(column.planes_mut());
            self.file.read(at, values)?;
            at += values.len() as u64;
        }
        Ok(())
    }
}
