//! A small dynamic scene made from nothing: for trying the program without files, and for tests.
//!
//! It holds what trained scenes hold and this program is about, each in a [`DemoBody`] whose motion is
//! known in closed form: a room with needless Gaussians in it, things that move rigidly and not,
//! things that fade and flash, thin things. Every value is a function of the Gaussian's number, the
//! scene's size and the time, so nothing is stored and any block can be read on its own.
//!
//! Memory: at most 192 bytes per Gaussian of an open block.

mod bodies;

#[cfg(test)]
mod tests;

use std::ops::Range;

use glam::DVec3;

use crate::error::{Error, Result};
use crate::model::{Attributes, Camera, Gaussians, Rig, SequenceInfo, Shot, Split};
use crate::source::{BlockReader, FrameSource, Ids};
use bodies::{BodyLayout, DemoGaussian};

pub use bodies::DemoBody;

/// Degree of the scene's spherical harmonics: view-dependent enough to exercise the code, small
/// enough to keep the scene so.
const SH_DEGREE: usize = 1;

/// Cameras of [`Scene::rig`].
const CAMERAS: u32 = 6;
/// The camera that is held out: an inner one, so that its view is between the others'.
const HELD_OUT: u32 = 2;

/// The scene, in units in which its room is 4 wide, 4 deep and 2.5 high, z up, open towards −y.
///
/// With more Gaussians the surfaces are made of smaller ones, with more frames the same motion is
/// sampled more finely. A Gaussian's values depend on the scene's count.
///
/// ```
/// use splatsieve::diagnostics::demo_scene::{DemoBody, Scene};
/// use splatsieve::source::FrameSource;
///
/// let scene = Scene::new(Scene::COUNT, Scene::FRAMES);
/// assert_eq!(scene.info().times.len(), 48);
/// assert!(scene.members(DemoBody::Cloth).len() > 400);
/// ```
#[derive(Debug, Clone)]
pub struct Scene {
    layout: BodyLayout,
    info: SequenceInfo,
}

impl Scene {
    /// Usual number of Gaussians.
    pub const COUNT: usize = 6000;
    /// Usual number of frames.
    pub const FRAMES: usize = 48;

    /// The scene as `count` Gaussians at `frames` times from 0 to 1; either may be any number.
    pub fn new(count: usize, frames: usize) -> Scene {
        let last = frames.saturating_sub(1).max(1) as f64;
        let info = SequenceInfo {
            count,
            times: (0..frames).map(|frame| frame as f64 / last).collect(),
            sh_degree: SH_DEGREE,
            varying: Attributes::POSITION | Attributes::ROTATION | Attributes::OPACITY,
        };
        Scene { layout: BodyLayout::new(count), info }
    }

    /// The Gaussians of a body, which are consecutive; bodies follow one another in the order of
    /// [`DemoBody::ALL`].
    pub fn members(&self, body: DemoBody) -> Range<usize> {
        self.layout.members(body)
    }

    /// Six cameras before the open side of the room, 256×192 pixels, each at every frame; the third
    /// is for testing.
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

impl FrameSource for Scene {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        if let Some(beyond) = ids.iter().find(|&id| id >= self.info.count) {
            return Err(Error::internal(format!("demo scene: no Gaussian {beyond}, it has {}", self.info.count)));
        }
        let parts = ids.iter().map(|id| self.layout.part(id)).collect();
        Ok(Box::new(Reader { times: &self.info.times, parts }))
    }
}

struct Reader<'a> {
    times: &'a [f64],
    parts: Vec<DemoGaussian>,
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
