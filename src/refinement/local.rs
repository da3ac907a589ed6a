//! States at the frames that are shown, and how they change with what is stored, in a scratch file: where most Gaussians are
//! not there, of those alone that are.

use std::path::Path;

use crate::cache::{Spill, SpillWriter};
use crate::error::Result;
use crate::model::{Column, Columns, Gaussians, Jacobian};

/// Logits of opacities that no change makes visible: less than 10⁻¹³.
const NOT_THERE: f32 = -30.0;
/// Those that are there are kept alone where they are no more than one in so many.
const SPARSE: usize = 2;

/// A state, and how it changes with what is stored.
#[derive(Debug, Clone, Default)]
pub(super) struct Local {
    /// Which Gaussians it is of, increasing, the others not being there; none: all.
    pub(super) there: Option<Vec<u32>>,
    pub(super) state: Gaussians,
    pub(super) jacobian: Jacobian,
}

impl Local {
    /// Of no Gaussians, with harmonics up to `sh_degree`.
    pub(super) fn none(sh_degree: usize) -> Local {
        Local { there: None, state: Gaussians::zeros(0, sh_degree), jacobian: Jacobian::default() }
    }

    /// Of the Gaussians at `places`, increasing.
    pub(super) fn pick(&self, places: &[u32]) -> Local {
        let Some(there) = &self.there else { return self.rows(places, None) };
        let stays = |(to, place): (u32, &u32)| Some((there.binary_search(place).ok()? as u32, to));
        let (rows, there): (Vec<u32>, Vec<u32>) = (0..).zip(places).filter_map(stays).unzip();
        self.rows(&rows, Some(there))
    }

    /// The same of those alone that are there, if they are few of all.
    fn thinned(&self) -> Option<Local> {
        let logits = self.state.opacity_logit.plane(0);
        let is_there = |&(_, &logit): &(u32, &f32)| logit >= NOT_THERE;
        let there: Vec<u32> = (0..).zip(logits).filter(is_there).map(|(row, _)| row).collect();
        let is_sparse = self.there.is_none() && SPARSE * there.len() <= logits.len();
        is_sparse.then(|| self.rows(&there, Some(there.clone())))
    }

    /// Of those in `rows`, which are the Gaussians `there`.
    fn rows(&self, rows: &[u32], there: Option<Vec<u32>>) -> Local {
        Local { there, state: self.state.pick(rows), jacobian: self.jacobian.pick(rows) }
    }

    /// What is kept of every frame: the columns `varying` of the state, and the Jacobian.
    fn kept(&mut self, varying: Columns) -> impl Iterator<Item = &mut Column> {
        self.state.columns_mut(varying).chain(self.jacobian.columns_mut())
    }
}

/// [`Local`] of one frame after the other. Memory: one, and 24 bytes a frame.
#[derive(Debug)]
pub(super) struct Locals {
    file: Spill,
    varying: Columns,
    /// The first frame's, of all Gaussians: what does not vary, and the shape of what does.
    first: Option<Local>,
    frames: Vec<StoredFrame>,
}

/// Where a frame's is in the file, and of how many Gaussians, if not of all: those come first.
#[derive(Debug, Clone, Copy)]
struct StoredFrame {
    at: u64,
    there: Option<usize>,
}

/// [`Locals`] that are being kept.
pub(super) struct Keeping {
    file: SpillWriter,
    varying: Columns,
    first: Option<Local>,
    frames: Vec<StoredFrame>,
    end: u64,
}

impl Keeping {
    /// Of no frames yet; the columns `varying` of states differ from frame to frame.
    ///
    /// # Errors
    /// A scratch file that cannot be made in `scratch`.
    pub(super) fn new(scratch: &Path, varying: Columns) -> Result<Keeping> {
        Ok(Keeping { file: SpillWriter::new(scratch)?, varying, first: None, frames: Vec::new(), end: 0 })
    }

    /// Whether nothing is kept yet.
    pub(super) fn is_empty(&self) -> bool {
        self.first.is_none()
    }

    /// The first frame's, if there is one.
    pub(super) fn first(&self) -> Option<&Local> {
        self.first.as_ref()
    }

    fn write(&mut self, bytes: &[u8]) -> Result<()> {
        self.end += bytes.len() as u64;
        self.file.write(bytes)
    }

    /// Keeps the next frame's.
    ///
    /// # Errors
    /// A scratch file that cannot be written.
    pub(super) fn push(&mut self, next: &mut Local) -> Result<()> {
        let mut thinned = if self.is_empty() { None } else { next.thinned() };
        self.first.get_or_insert_with(|| next.clone());
        let next = thinned.as_mut().unwrap_or(next);
        self.frames.push(StoredFrame { at: self.end, there: next.there.as_ref().map(Vec::len) });
        self.write(bytemuck::cast_slice(next.there.as_deref().unwrap_or_default()))?;
        next.kept(self.varying).try_for_each(|column| self.write(bytemuck::cast_slice(column.planes())))
    }

    /// Ends keeping: only then can be read.
    ///
    /// # Errors
    /// A scratch file that cannot be written.
    pub(super) fn finish(self) -> Result<Locals> {
        Ok(Locals { file: self.file.finish()?, varying: self.varying, first: self.first, frames: self.frames })
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
        let StoredFrame { mut at, there } = self.frames[k];
        let mut read = |values: &mut [u8]| {
            at += values.len() as u64;
            self.file.read(at - values.len() as u64, values)
        };
        to.there = there.map(|count| vec![0; count]);
        read(bytemuck::cast_slice_mut(to.there.as_deref_mut().unwrap_or_default()))?;
        let still = Columns::all().difference(self.varying);
        let shape = |to: &mut Column, of: &Column| {
            if to.width() != of.width() {
                *to = Column::zeros(of.width(), 0);
            }
            to.resize(if of.is_empty() { 0 } else { there.unwrap_or(of.len()) });
        };
        for column in Columns::all().iter() {
            let (of, is_still) = (first.state.column(column), still.contains(column));
            let state = to.state.column_mut(column);
            match &to.there {
                Some(there) if is_still => *state = of.pick(there),
                None if is_still => {
                    shape(state, of);
                    state.planes_mut().copy_from_slice(of.planes());
                }
                _ => shape(state, of),
            }
        }
        to.jacobian.columns_mut().iter_mut().zip(first.jacobian.columns()).for_each(|(to, of)| shape(to, of));
        to.kept(self.varying).try_for_each(|column| read(bytemuck::cast_slice_mut(column.planes_mut())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Positions count up; those in `there` are there.
    fn local(len: usize, there: &[usize]) -> Local {
        let mut local = Local { state: Gaussians::zeros(len, 0), ..Local::default() };
        local.state.position.planes_mut().iter_mut().zip(0..).for_each(|(x, k)| *x = k as f32);
        local.state.opacity_logit.planes_mut().fill(-40.0);
        there.iter().for_each(|&row| local.state.opacity_logit.plane_mut(0)[row] = 1.0);
        *local.jacobian.column_mut(Columns::OPACITY) = Column::from_planes(1, (0..len).map(|k| k as f32).collect());
        local
    }

    #[test]
    fn of_the_first_frame_all_are_kept_and_later_those_alone_that_are_there_if_they_are_few() {
        let folder = tempfile::tempdir().unwrap();
        let varying = Columns::POSITION | Columns::OPACITY;
        let mut keeping = Keeping::new(folder.path(), varying).unwrap();
        let mut pushed = [local(6, &[1]), local(6, &[1, 4]), local(6, &[]), local(6, &[0, 1, 2, 5]), local(6, &[3])];
        pushed[0].state.log_scale.planes_mut().iter_mut().zip(0..).for_each(|(x, k)| *x = k as f32);
        pushed.iter_mut().for_each(|local| keeping.push(local).unwrap());
        let locals = keeping.finish().unwrap();
        let mut read = Local::none(0);
        for (k, there) in [(4, Some(vec![3])), (0, None), (1, Some(vec![1, 4])), (2, Some(vec![])), (3, None)] {
            locals.read(k, &mut read).unwrap();
            assert_eq!(read.there, there, "frame {k}");
            let rows = there.unwrap_or_else(|| (0..6).collect());
            let expected = &pushed[k];
            assert_eq!(read.state.position, expected.state.position.pick(&rows));
            assert_eq!(read.state.opacity_logit, expected.state.opacity_logit.pick(&rows));
            assert_eq!(read.jacobian, expected.jacobian.pick(&rows));
            // What does not vary is the first frame's.
            assert_eq!(read.state.log_scale, pushed[0].state.log_scale.pick(&rows));
        }
        let kept = [6, 2, 0, 6, 1].into_iter().map(|rows| 4 * rows * (3 + 1 + 1)).sum::<u64>() + 4 * (2 + 1);
        assert_eq!(locals.frames[4].at + 4 + 4 * 5, kept);
    }

    #[test]
    fn those_picked_are_found_where_they_then_are() {
        let whole = local(8, &[1, 4, 6]);
        let picked = [0, 1, 5, 6, 7];
        let (of_few, of_all) = (whole.thinned().unwrap().pick(&picked), whole.pick(&picked));
        assert_eq!((of_few.there.as_deref(), of_all.there.as_deref()), (Some(&[1, 3][..]), None));
        assert_eq!(of_few.state, of_all.state.pick(&[1, 3]));
        assert_eq!(of_few.jacobian, of_all.jacobian.pick(&[1, 3]));
        assert!(local(4, &[0, 2, 3]).thinned().is_none());
    }
}
