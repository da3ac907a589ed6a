//! Two generated dynamic scenes: [`Playground`] for `splatsieve demo`, and [`DemoScene`] (the test scene) for tests.
//!
//! The test scene is a room. It has one [`DemoBody`] for each property of trained scenes that the program handles:
//! needless Gaussians, rigid and non-rigid motion, fading and flashing, thin structures. The motion of each Gaussian is
//! a closed formula of the time. In both scenes, every value is a function of the id of the Gaussian, the number of
//! Gaussians and the time. So nothing is stored, and any Gaussian can be read without the others.
//!
//! Memory: at most 192 bytes per Gaussian that an open reader covers.

mod bodies;
mod motion;
mod playground;

#[cfg(test)]
mod tests;

use std::ops::Range;

use glam::DVec3;

use crate::error::{Error, Result};
use crate::model::{Attributes, Camera, Gaussians, Rig, RigView, SequenceInfo, Split};
use crate::source::{BlockReader, FrameSource, Ids};
use bodies::BodyLayout;
use motion::DemoGaussian;

pub use bodies::DemoBody;
pub use playground::Playground;

/// SH degree of both scenes. Degree 1 gives enough dependence on the view direction to exercise the code, with so few
/// coefficients that the scenes stay small.
const SH_DEGREE: usize = 1;

/// Number of cameras of [`DemoScene::rig`].
const CAMERAS: u32 = 6;
/// Index of the camera that takes the test view. The camera is neither the first nor the last of the row, so that the
/// test view lies between training views.
const HELD_OUT: u32 = 2;

/// Test scene: a room 4 units wide, 4 deep and 2.5 high, z up, whose side toward −y is open.
///
/// A scene of more Gaussians has the same surfaces, made of smaller Gaussians. A scene of more frames samples the same
/// motion more finely. The values of a Gaussian depend on the number of Gaussians of the scene.
///
/// ```
/// use splatsieve::diagnostics::demo_scene::{DemoBody, DemoScene};
/// use splatsieve::source::FrameSource;
///
/// let scene = DemoScene::new(DemoScene::DEFAULT_COUNT, DemoScene::DEFAULT_FRAMES);
/// assert_eq!(scene.info().times.len(), 48);
/// assert!(scene.body_ids(DemoBody::Cloth).len() > 400);
/// ```
#[derive(Debug, Clone)]
pub struct DemoScene {
    layout: BodyLayout,
    info: SequenceInfo,
}

impl DemoScene {
    /// Default number of Gaussians of the generated scene.
    pub const DEFAULT_COUNT: usize = 6000;
    /// Default number of frames of the generated scene.
    pub const DEFAULT_FRAMES: usize = 48;

    /// Creates the scene with `count` Gaussians and `frames` frames at evenly spaced times from 0 to 1. Every value of
    /// `count` and `frames` is valid, including 0.
    pub fn new(count: usize, frames: usize) -> DemoScene {
        let last = frames.saturating_sub(1).max(1) as f64;
        let info = SequenceInfo {
            count,
            times: (0..frames).map(|frame| frame as f64 / last).collect(),
            sh_degree: SH_DEGREE,
            varying: Attributes::POSITION | Attributes::ROTATION | Attributes::OPACITY,
        };
        DemoScene { layout: BodyLayout::new(count), info }
    }

    /// Returns the ids of the Gaussians of `body`. The Gaussians of the bodies follow one another in the order of
    /// [`DemoBody::ALL`].
    pub fn body_ids(&self, body: DemoBody) -> Range<usize> {
        self.layout.members(body)
    }

    /// Returns the cameras: six in front of the open side of the room, with images of 256×192 pixels. Every camera sees
    /// every frame. The third camera takes test views, the other five take training views.
    pub fn rig(&self) -> Rig {
        let camera = |view: u32| {
            let eye = DVec3::new(-1.7 + 0.68 * f64::from(view), -4.2, 1.2 + 0.4 * f64::from(view % 2));
            Camera::look_at(eye, DVec3::new(0.0, 0.5, 1.0), 55f64.to_radians(), (256, 192))
        };
        let rig_view = |view| RigView {
            view,
            camera: view,
            time: None,
            split: if view == HELD_OUT { Split::Test } else { Split::Train },
            image: None,
        };
        Rig {
            cameras: (0..CAMERAS).map(camera).collect(),
            views: (0..CAMERAS).map(rig_view).collect(),
            background: Some([0.0; 3]),
            origin: "demo scene".into(),
        }
    }
}

impl FrameSource for DemoScene {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Reader::open(&self.info, ids, |id| self.layout.part(id))
    }
}

/// Reader of some Gaussians of a generated scene, selected by a range or a list of ids. It computes their states at
/// each frame from the formulas of their motion.
struct Reader<'a> {
    times: &'a [f64],
    parts: Vec<DemoGaussian>,
}

impl<'a> Reader<'a> {
    /// Opens a reader of the Gaussians with the ids `ids`. `info` describes the scene: number of Gaussians and times of
    /// frames. `part` returns attributes and motion of the Gaussian with a given id.
    ///
    /// # Errors
    /// Fails if an id is not less than the number of Gaussians in `info`.
    fn open(
        info: &'a SequenceInfo,
        ids: Ids<'_>,
        part: impl Fn(usize) -> DemoGaussian,
    ) -> Result<Box<dyn BlockReader + 'a>> {
        if let Some(beyond) = ids.iter().find(|&id| id >= info.count) {
            return Err(Error::internal(format!("demo scene: no Gaussian {beyond}, it has {}", info.count)));
        }
        Ok(Box::new(Reader { times: &info.times, parts: ids.iter().map(part).collect() }))
    }
}

impl BlockReader for Reader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        let Some(&time) = self.times.get(frame) else {
            return Err(Error::internal(format!("demo scene: no frame {frame}, it has {}", self.times.len())));
        };
        out.resize(self.parts.len());
        let moving = want.intersects(Attributes::POSITION | Attributes::ROTATION | Attributes::OPACITY);
        for (i, part) in self.parts.iter().enumerate() {
            if moving {
                let now = part.at(time);
                if want.contains(Attributes::POSITION) {
                    out.position.set_row(i, now.position.as_vec3().to_array());
                }
                if want.contains(Attributes::ROTATION) {
                    let q = now.rotation;
                    out.rotation.set_row(i, [q.w, q.x, q.y, q.z].map(|x| x as f32));
                }
                if want.contains(Attributes::OPACITY) {
                    out.opacity_logit.set_row(i, [now.opacity_logit as f32]);
                }
            }
            if want.contains(Attributes::LOG_SCALE) {
                out.log_scale.set_row(i, part.log_scale);
            }
            if want.contains(Attributes::SH) {
                out.sh.set_row(i, part.sh);
            }
        }
        Ok(())
    }
}

/// Returns the cameras of `rig` as JSON text in the format of the file `cameras.json` of 3DGS, with rotations from
/// camera axes to world axes. The format has no times: every camera sees every frame.
pub fn cameras_json(rig: &Rig) -> String {
    let camera = |(id, camera): (usize, &Camera)| {
        let to_world = camera.rotation.transpose();
        let rows = [0, 1, 2].map(|row| to_world.row(row).to_array());
        serde_json::json!({
            "id": id,
            "img_name": format!("view_{id:02}"),
            "width": camera.width,
            "height": camera.height,
            "position": camera.center().to_array(),
            "rotation": rows,
            "fx": camera.fx,
            "fy": camera.fy,
        })
    };
    let all: Vec<serde_json::Value> = rig.cameras.iter().enumerate().map(camera).collect();
    format!("{:#}\n", serde_json::Value::from(all))
}
