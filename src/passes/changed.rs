//! Frame source that reads frames from another source and changes them: adds parameter deltas (changes made by
//! refinement) to the Gaussians, and leaves out SH coefficients above a given degree.

use crate::compressed_model::{ParamDelta, TrajectoryDelta};
use crate::error::Result;
use crate::model::{AttributeValues, Attributes, Gaussians, SequenceInfo};
use crate::source::{BlockReader, FrameSource, Ids, ReadCounts, ReadPlan};

/// Frame source that adds two changes to the Gaussians of another source: a parameter delta, which is constant in time,
/// and a trajectory delta, which varies in time.
pub struct SourceWithDeltas<'a> {
    source: Box<dyn FrameSource + 'a>,
    delta: &'a ParamDelta,
    trajectory: &'a TrajectoryDelta,
    info: SequenceInfo,
}

impl<'a> SourceWithDeltas<'a> {
    /// Creates a source that returns the frames of `source` with two changes: `delta` and `trajectory` are added to the
    /// Gaussians, and SH coefficients above `sh_degree` are left out. If both deltas are empty and there are no such
    /// coefficients, the frames are returned unchanged.
    pub fn new(
        source: Box<dyn FrameSource + 'a>,
        delta: &'a ParamDelta,
        trajectory: &'a TrajectoryDelta,
        sh_degree: usize,
    ) -> SourceWithDeltas<'a> {
        let mut info = source.info().clone();
        info.sh_degree = info.sh_degree.min(sh_degree);
        info.varying |= trajectory.attributes();
        SourceWithDeltas { source, delta, trajectory, info }
    }

    fn is_unchanged(&self) -> bool {
        self.delta.is_empty() && self.trajectory.is_empty() && self.dropped_sh_buffer().is_none()
    }

    fn reader<'b>(
        &self,
        reader: Box<dyn BlockReader + 'b>,
        delta: ParamDelta,
        trajectory: TrajectoryDelta,
    ) -> ChangedReader<'b> {
        ChangedReader { reader, delta, trajectory, frames: self.info.times.len(), all_sh: self.dropped_sh_buffer() }
    }

    /// Returns an empty buffer for all SH coefficients of `source`, which are read before those of higher degrees are
    /// dropped. Returns `None` if none are dropped.
    fn dropped_sh_buffer(&self) -> Option<AttributeValues> {
        let degree = self.source.info().sh_degree;
        (degree > self.info.sh_degree).then(|| Gaussians::zeros(0, degree).sh)
    }
}

impl FrameSource for SourceWithDeltas<'_> {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        if self.is_unchanged() {
            return self.source.open(ids);
        }
        let ids_of_rows: Vec<u32> = ids.iter().map(|id| id as u32).collect();
        Ok(Box::new(self.reader(
            self.source.open(ids)?,
            self.delta.pick(&ids_of_rows),
            self.trajectory.pick(&ids_of_rows),
        )))
    }

    fn open_all(&self, plan: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        let opened = self.source.open_all(plan)?;
        if self.is_unchanged() {
            return Some(opened);
        }
        let changed = |reader| -> Box<dyn BlockReader + '_> {
            Box::new(self.reader(reader, self.delta.clone(), self.trajectory.clone()))
        };
        Some(opened.map(changed))
    }

    fn reads(&self) -> ReadCounts {
        self.source.reads()
    }
}

struct ChangedReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    delta: ParamDelta,
    trajectory: TrajectoryDelta,
    /// Number of frames of the sequence.
    frames: usize,
    /// Buffer into which all SH coefficients of the source are read; `None` if all of them are kept.
    all_sh: Option<AttributeValues>,
}

impl BlockReader for ChangedReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        match self.all_sh.as_mut().filter(|_| want.contains(Attributes::SH)) {
            None => self.reader.read(frame, want, out)?,
            Some(all) => {
                std::mem::swap(&mut out.sh, all);
                let read = self.reader.read(frame, want, out);
                std::mem::swap(&mut out.sh, all);
                read?;
                out.sh.resize(all.len());
                let kept = out.sh.planes().len();
                out.sh.planes_mut().copy_from_slice(&all.planes()[..kept]);
            }
        }
        match self.trajectory.is_empty() {
            true => self.delta.add_to(out, want),
            // The trajectory delta has no coefficients of the dropped SH degrees.
            false => self.trajectory.at_frame(frame, self.frames).plus(self.delta.clone()).add_to(out, want),
        }
        Ok(())
    }

    fn expect(&mut self, plan: &ReadPlan) {
        self.reader.expect(plan);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::NO_SH_LIMIT;

    #[test]
    fn each_gaussian_gets_its_own_delta_in_every_attribute() {
        let plain = DemoScene::new(40, 3);
        let mut by = Gaussians::zeros(40, 0);
        by.log_scale = Default::default();
        for i in 0..40 {
            by.position.set_row(i, [0.5, -0.25, 1.0].map(|x| x * i as f32));
            by.opacity_logit.set_row(i, [-(i as f32)]);
            by.sh.set_row(i, [0.125 * i as f32; 3]);
        }
        let delta = ParamDelta(by);
        let no_trajectory = TrajectoryDelta::default();
        let changed = SourceWithDeltas::new(Box::new(DemoScene::new(40, 3)), &delta, &no_trajectory, NO_SH_LIMIT);
        for ids in [Ids::List(&[39, 5, 0]), Ids::Range(7..12)] {
            let read = |source: &dyn FrameSource| {
                let mut state = Gaussians::zeros(ids.len(), plain.info().sh_degree);
                source.open(ids.clone()).unwrap().read(2, Attributes::all(), &mut state).unwrap();
                state
            };
            let (mut expected, got) = (read(&plain), read(&changed));
            for (row, id) in ids.iter().enumerate() {
                for column in delta.attributes().iter() {
                    let by = delta.0.attribute_values(column);
                    (0..by.width())
                        .for_each(|c| expected.attribute_values_mut(column).plane_mut(c)[row] += by.plane(c)[id]);
                }
            }
            assert!(got == expected, "{ids:?}");
        }
        for ids in [Ids::List(&[39, 5, 0]), Ids::Range(0..40)] {
            // SH degree 1 is dropped here, and the change of its coefficients with it.
            let fewer = SourceWithDeltas::new(Box::new(DemoScene::new(40, 3)), &delta, &no_trajectory, 0);
            assert_eq!((fewer.info().sh_degree, plain.info().sh_degree), (0, 1));
            let mut expected = Gaussians::zeros(ids.len(), 1);
            changed.open(ids.clone()).unwrap().read(1, Attributes::all(), &mut expected).unwrap();
            expected.truncate_sh(0);
            let mut got = Gaussians::zeros(0, 0);
            fewer.open(ids.clone()).unwrap().read(1, Attributes::all(), &mut got).unwrap();
            assert!(got == expected, "{ids:?}");
        }
        let none = ParamDelta::default();
        let mut untouched = Gaussians::zeros(40, plain.info().sh_degree);
        let unchanged = SourceWithDeltas::new(Box::new(DemoScene::new(40, 3)), &none, &no_trajectory, NO_SH_LIMIT);
        unchanged.open(Ids::Range(0..40)).unwrap().read(1, Attributes::all(), &mut untouched).unwrap();
        let mut expected = untouched.clone();
        plain.open(Ids::Range(0..40)).unwrap().read(1, Attributes::all(), &mut expected).unwrap();
        assert!(untouched == expected);
    }

    #[test]
    fn attributes_of_a_trajectory_delta_vary_in_time() {
        let plain = DemoScene::new(30, 5);
        let keyframe = |scale: f32| {
            let mut by = Gaussians::zeros(0, 0);
            by.log_scale = AttributeValues::from_planes(3, (0..90).map(|k| scale * k as f32).collect());
            ParamDelta(by)
        };
        let (delta, trajectory) = (keyframe(0.5), TrajectoryDelta(vec![keyframe(0.0), keyframe(1.0), keyframe(-1.0)]));
        assert!(!plain.info().varying.contains(Attributes::LOG_SCALE));
        let changed = SourceWithDeltas::new(Box::new(DemoScene::new(30, 5)), &delta, &trajectory, NO_SH_LIMIT);
        assert_eq!(changed.info().varying, plain.info().varying | Attributes::LOG_SCALE);
        let ids = [4, 29, 0];
        let mut reader = changed.open(Ids::List(&ids)).unwrap();
        for (frame, scale) in [(0, 0.5), (1, 1.0), (2, 1.5), (3, 0.5), (4, -0.5)] {
            let mut expected = Gaussians::zeros(3, plain.info().sh_degree);
            plain.open(Ids::List(&ids)).unwrap().read(frame, Attributes::all(), &mut expected).unwrap();
            keyframe(scale).pick(&ids).add_to(&mut expected, Attributes::all());
            let mut got = Gaussians::zeros(3, plain.info().sh_degree);
            reader.read(frame, Attributes::all(), &mut got).unwrap();
            assert!(got == expected, "frame {frame}");
        }
    }
}
