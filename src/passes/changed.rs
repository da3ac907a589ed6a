//! A sequence with its Gaussians changed, or without the last of their harmonics, frame by frame as it is read.

use crate::compressed_model::{ParamDelta, TrajectoryDelta};
use crate::error::Result;
use crate::model::{Column, Columns, Gaussians, SequenceInfo};
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan, Reads};

/// A source whose parameters are changed, the same at every frame and along a course.
pub struct Changed<'a> {
    source: Box<dyn FrameSource + 'a>,
    change: &'a ParamDelta,
    course: &'a TrajectoryDelta,
    info: SequenceInfo,
}

impl<'a> Changed<'a> {
    /// `source` with `change` and `course` added to its Gaussians, and of their harmonics those up to `sh_degree`; nothing
    /// to add and none above: the source as it is.
    pub fn new(
        source: Box<dyn FrameSource + 'a>,
        change: &'a ParamDelta,
        course: &'a TrajectoryDelta,
        sh_degree: usize,
    ) -> Changed<'a> {
        let mut info = source.info().clone();
        info.sh_degree = info.sh_degree.min(sh_degree);
        info.varying |= course.columns();
        Changed { source, change, course, info }
    }

    fn is_plain(&self) -> bool {
        self.change.is_empty() && self.course.is_empty() && self.drops().is_none()
    }

    fn reader<'b>(
        &self,
        reader: Box<dyn BlockReader + 'b>,
        change: ParamDelta,
        course: TrajectoryDelta,
    ) -> ChangedReader<'b> {
        ChangedReader { reader, change, course, frames: self.info.times.len(), all_sh: self.drops() }
    }

    /// Room for all harmonics, where some of them go.
    fn drops(&self) -> Option<Column> {
        let degree = self.source.info().sh_degree;
        (degree > self.info.sh_degree).then(|| Gaussians::zeros(0, degree).sh)
    }
}

impl FrameSource for Changed<'_> {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        if self.is_plain() {
            return self.source.open(ids);
        }
        let places: Vec<u32> = ids.iter().map(|id| id as u32).collect();
        Ok(Box::new(self.reader(self.source.open(ids)?, self.change.pick(&places), self.course.pick(&places))))
    }

    fn open_all(&self, wanted: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        let opened = self.source.open_all(wanted)?;
        if self.is_plain() {
            return Some(opened);
        }
        let changed = |reader| -> Box<dyn BlockReader + '_> {
            Box::new(self.reader(reader, self.change.clone(), self.course.clone()))
        };
        Some(opened.map(changed))
    }

    fn reads(&self) -> Reads {
        self.source.reads()
    }
}

struct ChangedReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    change: ParamDelta,
    course: TrajectoryDelta,
    /// How many there are.
    frames: usize,
    /// Where harmonics are read into, of which some go.
    all_sh: Option<Column>,
}

impl BlockReader for ChangedReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        match self.all_sh.as_mut().filter(|_| want.contains(Columns::SH)) {
            None => self.reader.read(frame, want, out)?,
            Some(all) => {
                std::mem::swap(&mut out.sh, all);
                let read = self.reader.read(frame, want, out);
                std::mem::swap(&mut out.sh, all);
                read?;
                out.sh.resize(all.len());
                let left = out.sh.planes().len();
                out.sh.planes_mut().copy_from_slice(&all.planes()[..left]);
            }
        }
        match self.course.is_empty() {
            true => self.change.add_to(out, want),
            // The course has no higher bands.
            false => self.course.at(frame, self.frames).and(self.change.clone()).add_to(out, want),
        }
        Ok(())
    }

    fn expect(&mut self, wanted: &ReadPlan) {
        self.reader.expect(wanted);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::Scene;
    use crate::model::ALL_HARMONICS;

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
        let change = ParamDelta(by);
        let straight = TrajectoryDelta::default();
        let changed = Changed::new(Box::new(Scene::new(40, 3)), &change, &straight, ALL_HARMONICS);
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
        for ids in [Ids::List(&[39, 5, 0]), Ids::Range(0..40)] {
            // Without the first band too, whose changes go with it.
            let fewer = Changed::new(Box::new(Scene::new(40, 3)), &change, &straight, 0);
            assert_eq!((fewer.info().sh_degree, plain.info().sh_degree), (0, 1));
            let mut expected = Gaussians::zeros(ids.len(), 1);
            changed.open(ids.clone()).unwrap().read(1, Columns::all(), &mut expected).unwrap();
            expected.drop_bands(0);
            let mut got = Gaussians::zeros(0, 0);
            fewer.open(ids.clone()).unwrap().read(1, Columns::all(), &mut got).unwrap();
            assert!(got == expected, "{ids:?}");
        }
        let none = ParamDelta::default();
        let mut untouched = Gaussians::zeros(40, plain.info().sh_degree);
        let unchanged = Changed::new(Box::new(Scene::new(40, 3)), &none, &straight, ALL_HARMONICS);
        unchanged.open(Ids::Range(0..40)).unwrap().read(1, Columns::all(), &mut untouched).unwrap();
        let mut expected = untouched.clone();
        plain.open(Ids::Range(0..40)).unwrap().read(1, Columns::all(), &mut expected).unwrap();
        assert!(untouched == expected);
    }

    #[test]
    fn what_changes_along_a_course_varies_and_is_read_at_every_frame() {
        let plain = Scene::new(30, 5);
        let knot = |scale: f32| {
            let mut by = Gaussians::zeros(0, 0);
            by.log_scale = Column::from_planes(3, (0..90).map(|k| scale * k as f32).collect());
            ParamDelta(by)
        };
        let (change, course) = (knot(0.5), TrajectoryDelta(vec![knot(0.0), knot(1.0), knot(-1.0)]));
        assert!(!plain.info().varying.contains(Columns::LOG_SCALE));
        let changed = Changed::new(Box::new(Scene::new(30, 5)), &change, &course, ALL_HARMONICS);
        assert_eq!(changed.info().varying, plain.info().varying | Columns::LOG_SCALE);
        let ids = [4, 29, 0];
        let mut reader = changed.open(Ids::List(&ids)).unwrap();
        for (frame, scale) in [(0, 0.5), (1, 1.0), (2, 1.5), (3, 0.5), (4, -0.5)] {
            let mut expected = Gaussians::zeros(3, plain.info().sh_degree);
            plain.open(Ids::List(&ids)).unwrap().read(frame, Columns::all(), &mut expected).unwrap();
            knot(scale).pick(&ids).add_to(&mut expected, Columns::all());
            let mut got = Gaussians::zeros(3, plain.info().sh_degree);
            reader.read(frame, Columns::all(), &mut got).unwrap();
            assert!(got == expected, "frame {frame}");
        }
    }
}
