//! A sequence with its base colours changed, frame by frame as it is read.

use crate::error::Result;
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::pass::{BlockReader, FrameSource, Ids, Reads, Wanted};

/// A source whose base colours (`f_dc`) are changed, the same at every frame.
pub struct Recolored<'a> {
    source: Box<dyn FrameSource + 'a>,
    change: &'a [[f32; 3]],
}

impl<'a> Recolored<'a> {
    /// `source` with `change` `[N]` added to the first spherical-harmonic coefficients of its Gaussians; none:
    /// the source as it is.
    pub fn new(source: Box<dyn FrameSource + 'a>, change: &'a [[f32; 3]]) -> Self {
        Recolored { source, change }
    }
}

impl FrameSource for Recolored<'_> {
    fn info(&self) -> &SequenceInfo {
        self.source.info()
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        if self.change.is_empty() {
            return self.source.open(ids);
        }
        let change = ids.iter().map(|id| self.change[id]).collect();
        Ok(Box::new(RecoloredReader { reader: self.source.open(ids)?, change }))
    }

    fn open_all(&self, wanted: &Wanted) -> Option<Result<Box<dyn BlockReader + '_>>> {
        let opened = self.source.open_all(wanted)?;
        if self.change.is_empty() {
            return Some(opened);
        }
        let recolored = |reader| -> Box<dyn BlockReader + '_> {
            Box::new(RecoloredReader { reader, change: self.change.to_vec() })
        };
        Some(opened.map(recolored))
    }

    fn reads(&self) -> Reads {
        self.source.reads()
    }
}

struct RecoloredReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    change: Vec<[f32; 3]>,
}

impl BlockReader for RecoloredReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        self.reader.read(frame, want, out)?;
        if want.contains(Columns::SH) {
            recolor(out, &self.change);
        }
        Ok(())
    }

    fn expect(&mut self, wanted: &Wanted) {
        self.reader.expect(wanted);
    }
}

/// Adds `change` to the first coefficients of every Gaussian.
pub fn recolor(state: &mut Gaussians, change: &[[f32; 3]]) {
    for c in 0..3 {
        state.sh.plane_mut(c).iter_mut().zip(change).for_each(|(value, change)| *value += change[c]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demo::Scene;

    #[test]
    fn any_block_of_ids_gets_the_changes_of_its_own_gaussians_and_of_nothing_but_base_colours() {
        let plain = Scene::new(40, 3);
        let change: Vec<[f32; 3]> = (0..40).map(|i| [0.5, -0.25, 1.0].map(|x| x * i as f32)).collect();
        let recolored = Recolored::new(Box::new(Scene::new(40, 3)), &change);
        for ids in [Ids::List(&[39, 5, 0]), Ids::Range(7..12)] {
            let read = |source: &dyn FrameSource| {
                let mut state = Gaussians::zeros(ids.len(), plain.info().sh_degree);
                source.open(ids.clone()).unwrap().read(2, Columns::all(), &mut state).unwrap();
                state
            };
            let (mut expected, got) = (read(&plain), read(&recolored));
            for (row, id) in ids.iter().enumerate() {
                for (c, by) in change[id].iter().enumerate() {
                    expected.sh.plane_mut(c)[row] += by;
                }
            }
            assert!(got == expected, "{ids:?}");
        }
        let mut untouched = Gaussians::zeros(40, plain.info().sh_degree);
        Recolored::new(Box::new(Scene::new(40, 3)), &[])
            .open(Ids::Range(0..40))
            .unwrap()
            .read(1, Columns::all(), &mut untouched)
            .unwrap();
        let mut expected = untouched.clone();
        plain.open(Ids::Range(0..40)).unwrap().read(1, Columns::all(), &mut expected).unwrap();
        assert!(untouched == expected);
    }
}
