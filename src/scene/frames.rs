//! A scene as a source of frames: the frames of its input, with absent Gaussians (those with NaN or infinite values)
//! made invisible.

use super::Scene;
use crate::error::Result;
use crate::model::SequenceInfo;
use crate::source::{BlockReader, Deformation, FeatureDecoder, FrameSource, Ids, ReadCounts, ReadPlan};

impl Scene {
    /// Makes the Gaussians with the ids `ids` (in increasing order) invisible in all later reads of the scene's frames.
    /// Gaussians that an earlier call made invisible become visible again, unless they are in `ids`. The cache keys of
    /// stage results include these ids.
    pub fn set_excluded_ids(&self, ids: &[u32]) {
        self.work.set_excluded_ids(ids);
        self.absent.set(ids);
    }

    /// Returns the source of the scene's frames. Gaussians that are absent (see [`Scene::set_excluded_ids`]) are
    /// invisible in it.
    pub fn source(&self) -> &dyn FrameSource {
        if self.absent.is_empty() { self.input.source() } else { self }
    }
}

impl FrameSource for Scene {
    fn info(&self) -> &SequenceInfo {
        self.input.source().info()
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(self.absent.hiding(self.input.source().open(ids.clone())?, &ids))
    }

    fn open_all(&self, plan: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        let opened = self.input.source().open_all(plan)?;
        Some(opened.map(|reader| self.absent.hiding(reader, &Ids::Range(0..self.info().count))))
    }

    fn deformation(&self) -> Option<&dyn Deformation> {
        self.input.source().deformation()
    }

    fn decoder(&self) -> Option<&dyn FeatureDecoder> {
        self.input.source().decoder()
    }

    fn reads(&self) -> ReadCounts {
        self.input.source().reads()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::RobustBox;
    use crate::model::{Attributes, Gaussians};
    use crate::passes::gather_all;
    use crate::pipeline::tests::scene;
    use crate::render::render;

    #[test]
    fn absent_gaussians_change_neither_renders_nor_boxes() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let absent = [3, 4, 700, 1499];
        let whole = gather_all(scene.source(), 2, Attributes::all()).unwrap();
        let others: Vec<u32> = (0..1500).filter(|id| !absent.contains(id)).collect();
        scene.set_excluded_ids(&absent);
        let hidden = gather_all(scene.source(), 2, Attributes::all()).unwrap();
        let expected = whole.pick(&others);
        assert!(hidden.pick(&others) == expected);
        let camera = &scene.schedule.cameras[0];
        assert_eq!(render(&hidden, camera, [0.2; 3]).data, render(&expected, camera, [0.2; 3]).data);
        let [found, expected] = [&hidden, &expected].map(|state| RobustBox::from_positions(&state.position));
        assert_eq!((found.low, found.high), (expected.low, expected.high));
        scene.set_excluded_ids(&[]);
        assert!(gather_all(scene.source(), 2, Attributes::all()).unwrap() == whole);
    }

    #[test]
    fn readers_of_id_lists_hide_absent_gaussians() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        scene.set_excluded_ids(&[7]);
        let mut state = Gaussians::zeros(0, scene.info().sh_degree);
        scene.source().open(Ids::List(&[9, 7, 3])).unwrap().read(0, Attributes::all(), &mut state).unwrap();
        let is_absent = |row: usize| state.opacity_logit.row::<1>(row) == [f32::NEG_INFINITY];
        assert_eq!([0, 1, 2].map(is_absent), [false, true, false]);
        assert!(state.position.row::<3>(1)[0].is_nan() && state.rotation.row::<4>(1) == [1.0, 0.0, 0.0, 0.0]);
    }
}
