//! A sequence with its Gaussians changed, frame by frame as it is read.

use crate::error::Result;
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::reduction::Change;
use crate::source::{BlockReader, FrameSource, Ids, Reads, Wanted};

/// A source whose parameters are changed, the same at every frame.
pub struct Changed<'a> {
    source: Box<dyn FrameSource + 'a>,
    change: &'a Change,
}

impl<'a> Changed<'a> {
    /// `source` with `change` added to its Gaussians; an empty one: the source as it is.
    pub fn new(source: Box<dyn FrameSource + 'a>, change: &'a Change) -> Self {
        Changed { source, change }
    }
}

impl FrameSource for Changed<'_> {
    fn info(&self) -> &SequenceInfo {
        self.source.info()
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        if self.change.is_empty() {
            return self.source.open(ids);
        }
        let places: Vec<u32> = ids.iter().map(|id| id as u32).collect();
        Ok(Box::new(ChangedReader { reader: self.source.open(ids)?, change: self.change.pick(&places) }))
    }

    fn open_all(&self, wanted: &Wanted) -> Option<Result<Box<dyn BlockReader + '_>>> {
        let opened = self.source.open_all(wanted)?;
        if self.change.is_empty() {
            return Some(opened);
        }
        let changed =
            |reader| -> Box<dyn BlockReader + '_> { Box::new(ChangedReader { reader, change: self.change.clone() }) };
        Some(opened.map(changed))
    }

    fn reads(&self) -> Reads {
        self.source.reads()
    }
}

struct ChangedReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    change: Change,
}

impl BlockReader for ChangedReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        self.reader.read(frame, want, out)?;
        self.change.add_to(out, want);
        Ok(())
    }

    fn expect(&mut self, wanted: &Wanted) {
        self.reader.expect(wanted);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demo::Scene;

    #[test]
    fn any_block_of_ids_gets_the_changes_of_its_own_gaussians_in_any_column() {
        let plain = Scene::new(40, 3);
        let mut by = Gaussians::zeros(40, 0);
        by.log_scale = Default::default();
        for i in 0..40 {
            by.position.set_row(i, [0.5, -0.25, 1.0].map(|x| x * i as f32));
            by.opacity_logit.set_row(i, [-(i as f32)]);
            by.sh.set_row(i, [0.125 * i as f32; 3]);
        }
        let change = Change(by);
        let changed = Changed::new(Box::new(Scene::new(40, 3)), &change);
        for ids in [Ids::List(&[39, 5, 0]), Ids::Range(7..12)] {
            let read = |source: &dyn FrameSource| {
                let mut state = Gaussians::zeros(ids.len(), plain.info().sh_degree);
                source.open(ids.clone()).unwrap().read(2, Columns::all(), &mut state).unwrap();
                state
            };
            let (mut expected, got) = (read(&plain), read(&changed));
            for (row, id) in ids.iter().enumerate() {
                for column in change.columns().iter() {
                    let by = change.0.column(column);
                    (0..by.width()).for_each(|c| expected.column_mut(column).plane_mut(c)[row] += by.plane(c)[id]);
                }
            }
            assert!(got == expected, "{ids:?}");
        }
        let none = Change::default();
        let mut untouched = Gaussians::zeros(40, plain.info().sh_degree);
        let unchanged = Changed::new(Box::new(Scene::new(40, 3)), &none);
        unchanged.open(Ids::Range(0..40)).unwrap().read(1, Columns::all(), &mut untouched).unwrap();
        let mut expected = untouched.clone();
        plain.open(Ids::Range(0..40)).unwrap().read(1, Columns::all(), &mut expected).unwrap();
        assert!(untouched == expected);
    }
}
