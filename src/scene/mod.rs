//! An input with the cameras that look at it: what every verb starts from.

mod input;
mod open;
pub mod pictures;
mod stream;

use std::path::PathBuf;

use crate::budget::{Budget, Need, Plan, Workload};
use crate::error::Result;
use crate::families::Family;
use crate::model::{Rig, Schedule, Split};
use crate::pass::FrameSource;
use crate::plan::Limits;

pub use input::{InputOptions, Opened, load_cameras};
pub use open::{open_input, open_scene, scene_of, scratch_beside};
pub use stream::{check_memory, open_stream, receiving};

/// An input with the cameras that look at it.
pub struct Scene {
    /// Path as given.
    pub path: PathBuf,
    /// The input.
    pub input: Box<dyn Family>,
    /// All cameras.
    pub rig: Rig,
    /// The cameras of the chosen split, frame by frame.
    pub schedule: Schedule,
    /// Whether the cameras were given or found; else they are a virtual rig.
    pub has_cameras: bool,
    /// Colour behind the scene, red, green, blue in [0, 1]: the cameras' own, else the one that the input was trained
    /// with, else black.
    pub background: [f32; 3],
    /// What passes over it keep in memory at a time.
    pub limits: Limits,
    /// Folder for scratch files while the run lasts.
    pub scratch: PathBuf,
    /// Things a person should know.
    pub notes: Vec<String>,
}

impl Scene {
    /// `input` as the cameras of `rig` in `split` see it, without limits.
    ///
    /// # Errors
    /// Cameras at times that are no frame's.
    pub fn new(path: PathBuf, input: Box<dyn Family>, rig: Rig, split: Option<Split>) -> Result<Scene> {
        let schedule = rig.schedule(&input.source().info().times, split)?;
        let background = rig.background.or(input.background()).unwrap_or([0.0; 3]);
        let (limits, scratch, notes) = (Limits::NONE, std::env::temp_dir(), Vec::new());
        Ok(Scene { path, input, rig, schedule, has_cameras: true, background, limits, scratch, notes })
    }

    /// Its frames.
    pub fn source(&self) -> &dyn FrameSource {
        self.input.source()
    }

    /// What the need for memory depends on.
    pub fn workload(&self) -> Workload {
        Workload::new(self.source().info(), self.input.residence()).seen(&self.rig, &self.schedule)
    }

    /// Plans what is to be done, stages that need what `needs` says, and takes the limits of that plan.
    ///
    /// # Errors
    /// A budget that cannot work.
    pub fn keep_to(&mut self, budget: Budget, needs: impl Fn(&Workload, &Limits) -> Vec<Need>) -> Result<()> {
        self.limits = Plan::fit(self.workload(), budget, needs)?.limits;
        Ok(())
    }
}
