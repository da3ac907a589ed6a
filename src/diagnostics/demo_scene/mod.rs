//! Two generated dynamic scenes: [`Playground`] for `splatsieve demo`, and [`DemoScene`] for tests.
//!
//! The test scene has one [`DemoBody`] for each property of trained scenes that the program handles, with motion in
//! closed form: a room with needless Gaussians, rigid and non-rigid motion, fading and flashing, thin structures.
//! Every value is a function of the Gaussian's number, the scene's size and the time, so nothing is stored and any
//! block can be read on its own.
//!
//! Memory: at most 192 bytes per Gaussian of an open block.

mod bodies;
mod motion;
mod playground;

#[cfg(test)]
mod tests;

use std::ops::Range;

use glam::DVec3;

use crate::error::{Error, Result};
use crate::model::{Attributes, Camera, Gaussians, Rig, SequenceInfo, Shot, Split};
use crate::source::{BlockReader, FrameSource, Ids};
use bodies::BodyLayout;
use motion::DemoGaussian;

pub use bodies::DemoBody;
pub use playground::Playground;

/// SH degree of both scenes: enough view dependence to exercise the code, few enough coefficients to keep the scenes small.
const SH_DEGREE: usize = 1;

/// Number of cameras of [`DemoScene::rig`].
const CAMERAS: u32 = 6;
/// Index of the camera whose view is the test view. It is an inner one, so that its view lies between training views.
const HELD_OUT: u32 = 2;

/// The test scene: a room 4 units wide, 4 deep and 2.5 high, z up, open toward −y.
///
/// With more Gaussians the surfaces consist of smaller ones, with more frames the same motion is
/// sampled more finely. A Gaussian's values depend on the scene's count.
///
/// ```
/// use splatsieve::diagnostics::demo_scene::{DemoBody, DemoScene};
/// use splatsieve::source::FrameSource;
///
/// let scene = DemoScene::new(DemoScene::COUNT, DemoScene::FRAMES);
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
    pub const COUNT: usize = 6000;
    /// Default number of frames of the generated scene.
    pub const FRAMES: usize = 48;

    /// Returns the scene as `count` Gaussians at `frames` times from 0 to 1; either may be any number.
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

    /// Returns the ids of a body's Gaussians. Bodies follow one another in the order of [`DemoBody::ALL`].
    pub fn body_ids(&self, body: DemoBody) -> Range<usize> {
        self.layout.members(body)
    }

    /// Returns six cameras in front of the open side of the room, 256×192 pixels, each at every frame; the third is
    /// for testing.
    pub fn rig(&self) -> Rig {
        let camera = |view: u32| {
            let eye = DVec3::new(-1.7 + 0.68 * f64::from(view), -4.2, 1.2 + 0.4 * f64::from(view % 2));
            Camera::look_at(eye, DVec3::new(0.0, 0.5, 1.0), 55f64.to_radians(), (256, 192))
        };
        let shot = |view| Shot {
            view,
            camera: view,
            time: None,
            split: if view == HELD_OUT { Split::Test } else { Split::Train },
            image: None,
        };
        Rig {
            cameras: (0..CAMERAS).map(camera).collect(),
            shots: (0..CAMERAS).map(shot).collect(),
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

/// Reader of consecutive or listed Gaussians of a generated scene.
struct Reader<'a> {
    times: &'a [f64],
    parts: Vec<DemoGaussian>,
}

impl<'a> Reader<'a> {
    /// Opens the Gaussians `ids` of a scene with the description `info`. `part`: returns the Gaussian with an id.
    ///
    /// # Errors
    /// Fails if an id is too large.
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

/// Returns the cameras of `rig` as a `cameras.json` of 3DGS: camera-to-world rotations, every camera at every frame.
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
