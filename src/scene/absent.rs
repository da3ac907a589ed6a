//! Gaussians that were dropped because some of their values are NaN or infinite: absent from every state that is read.
//!
//! A scene from which Gaussians are absent is a [`FrameSource`] itself. Ids stay what they are: an absent Gaussian keeps its
//! row, with a state that shows nothing ([`clear_row`]), so renders, contributions, removal errors, statistics and bounds
//! are those of the others. Memory: 4 bytes per absent Gaussian, and as many in every reader.

use std::sync::{Arc, PoisonError, RwLock};

use super::Scene;
use crate::error::Result;
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::source::{Ahead, BlockReader, Decoder, Deformation, FrameSource, Ids, Reads, Wanted};

/// Ids of the absent Gaussians, increasing.
#[derive(Debug, Default)]
pub(super) struct Absent(RwLock<Arc<[u32]>>);

impl Absent {
    /// Returns the ids.
    fn ids(&self) -> Arc<[u32]> {
        self.0.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Scene {
    /// Hides the Gaussians `ids`, in increasing order, from everything that reads the scene's frames from now on, and shows
    /// those hidden before. Keys of results in the work folder follow from the ids.
    pub fn set_absent(&self, ids: &[u32]) {
        debug_assert!(ids.is_sorted(), "absent ids are sorted");
        self.work.set_absent(ids);
        *self.absent.0.write().unwrap_or_else(PoisonError::into_inner) = ids.into();
    }

    /// Returns the scene's frames, without the absent Gaussians.
    pub fn source(&self) -> &dyn FrameSource {
        if self.absent.ids().is_empty() { self.input.source() } else { self }
    }

    fn hiding<'a>(&'a self, reader: Box<dyn BlockReader + 'a>, ids: &Ids<'_>) -> Box<dyn BlockReader + 'a> {
        let absent = self.absent.ids();
        let rows = ids.iter().enumerate().filter(|(_, id)| absent.binary_search(&(*id as u32)).is_ok());
        let rows: Vec<usize> = rows.map(|(row, _)| row).collect();
        if rows.is_empty() { reader } else { Box::new(HidingReader { reader, rows }) }
    }
}

impl FrameSource for Scene {
    fn info(&self) -> &SequenceInfo {
        self.input.source().info()
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(self.hiding(self.input.source().open(ids.clone())?, &ids))
    }

    fn open_all(&self, wanted: &Wanted) -> Option<Result<Box<dyn BlockReader + '_>>> {
        let opened = self.input.source().open_all(wanted)?;
        Some(opened.map(|reader| self.hiding(reader, &Ids::Range(0..self.info().count))))
    }

    fn deformation(&self) -> Option<&dyn Deformation> {
        self.input.source().deformation()
    }

    fn decoder(&self) -> Option<&dyn Decoder> {
        self.input.source().decoder()
    }

    fn reads(&self) -> Reads {
        self.input.source().reads()
    }

    fn ahead(&self) -> Option<&dyn Ahead> {
        self.input.source().ahead()
    }
}

/// Reader of a block some of whose rows are absent.
struct HidingReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    /// Rows of the absent Gaussians in the block.
    rows: Vec<usize>,
}

impl BlockReader for HidingReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        self.reader.read(frame, want, out)?;
        self.rows.iter().for_each(|&row| clear_row(out, want, row));
        Ok(())
    }

    fn expect(&mut self, wanted: &Wanted) {
        self.reader.expect(wanted);
    }

    fn prepare(&mut self, frame: usize, want: Columns) -> Result<()> {
        self.reader.prepare(frame, want)
    }
}

/// Gives row `row` the state of an absent Gaussian in the columns `want`: a position of NaN, which is in no box and not
/// drawn, an opacity of 0, and the identity, size 1 and no color.
fn clear_row(state: &mut Gaussians, want: Columns, row: usize) {
    for column in want.iter() {
        let value = match column {
            Columns::POSITION => f32::NAN,
            Columns::OPACITY => f32::NEG_INFINITY,
            _ => 0.0,
        };
        let values = state.column_mut(column);
        (0..values.width()).for_each(|plane| values.plane_mut(plane)[row] = value);
        if column == Columns::ROTATION {
            values.plane_mut(0)[row] = 1.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compress::tests::scene;
    use crate::render::render;
    use crate::stats::RobustBox;
    use crate::stream::gather_all;

    #[test]
    fn renders_and_boxes_are_those_of_the_others() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let absent = [3, 4, 700, 1499];
        let whole = gather_all(scene.source(), 2, Columns::all()).unwrap();
        let others: Vec<u32> = (0..1500).filter(|id| !absent.contains(id)).collect();
        scene.set_absent(&absent);
        let hidden = gather_all(scene.source(), 2, Columns::all()).unwrap();
        let expected = whole.pick(&others);
        assert!(hidden.pick(&others) == expected);
        let camera = &scene.schedule.cameras[0];
        assert_eq!(render(&hidden, camera, [0.2; 3]).data, render(&expected, camera, [0.2; 3]).data);
        let [found, expected] = [&hidden, &expected].map(|state| RobustBox::of(&state.position));
        assert_eq!((found.low, found.high), (expected.low, expected.high));
        scene.set_absent(&[]);
        assert!(gather_all(scene.source(), 2, Columns::all()).unwrap() == whole);
    }

    #[test]
    fn lists_of_ids_hide_the_same_gaussians() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        scene.set_absent(&[7]);
        let mut state = Gaussians::zeros(0, scene.info().sh_degree);
        scene.source().open(Ids::List(&[9, 7, 3])).unwrap().read(0, Columns::all(), &mut state).unwrap();
        let is_absent = |row: usize| state.opacity_logit.row::<1>(row) == [f32::NEG_INFINITY];
        assert_eq!([0, 1, 2].map(is_absent), [false, true, false]);
        assert!(state.position.row::<3>(1)[0].is_nan() && state.rotation.row::<4>(1) == [1.0, 0.0, 0.0, 0.0]);
    }
}
