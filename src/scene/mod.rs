//! An input with the cameras that look at it: what every verb starts from.

mod absent;
pub mod between;
mod compressed;
mod frames;
mod input;
mod open;
pub mod path;
pub mod photographs;
pub mod pictures;
mod stream;
mod work;

use std::path::PathBuf;

use crate::cache::Cache;
use crate::error::Result;
use crate::limits::Limits;
use crate::memory_plan::{Budget, Plan, ResourceEstimate, Throughput, Workload};
use crate::model::{Rig, Schedule, Split};
use crate::models::InputModel;
use crate::progress::Events;
use crate::source::Reads;

use absent::Absent;
pub use compressed::open_compressed;
pub use input::{InputOptions, Opened, load_cameras};
pub use open::{first_box, open_input, open_scene, scene_of, scratch_beside};
pub use stream::{FrameQuota, is_linked, link_stream, open_stream, receiving, room_to_pack};
pub use work::kept_work;
pub(crate) use work::stamps;

/// An input with the cameras that look at it.
pub struct Scene {
    /// Path as given.
    pub path: PathBuf,
    /// The input.
    pub input: Box<dyn InputModel>,
    /// All cameras.
    pub rig: Rig,
    /// The cameras of the chosen split, frame by frame.
    pub schedule: Schedule,
    /// Whether the cameras were given or found, or surround a still scene: what they see is then the scene. Else they are a
    /// virtual rig, which may see only what is in front of it.
    pub has_cameras: bool,
    /// Color behind the scene, red, green, blue in [0, 1]: the cameras' own, else the one that the input was trained
    /// with, else the model in whose folder the cameras are, else black.
    pub background: [f32; 3],
    /// What passes over it keep in memory at a time.
    pub limits: Limits,
    /// Full reads of the input at most, of the plan that the limits are from.
    pub planned_reads: Option<f64>,
    /// How fast it is looked at here.
    pub pace: Throughput,
    /// Folder for scratch files while the run lasts.
    pub scratch: PathBuf,
    /// Where what stages find is kept, if anywhere.
    pub work: Cache,
    /// Digest of the input, where it is known already.
    digest: Option<String>,
    /// Things a person should know.
    pub notes: Vec<String>,
    /// Where the events of the run go.
    pub events: Events,
    /// Gaussians that its frames are read without.
    absent: Absent,
}

impl Scene {
    /// `input` as the cameras of `rig` in `split` see it, without limits.
    ///
    /// # Errors
    /// Cameras at times that are no frame's.
    pub fn new(path: PathBuf, input: Box<dyn InputModel>, rig: Rig, split: Option<Split>) -> Result<Scene> {
        let schedule = rig.schedule(&input.source().info().times, split)?;
        let background = rig.background.or(input.background()).unwrap_or([0.0; 3]);
        Ok(Scene {
            path,
            input,
            rig,
            schedule,
            has_cameras: true,
            background,
            limits: Limits::NONE,
            planned_reads: None,
            pace: Throughput::UNKNOWN,
            scratch: std::env::temp_dir(),
            work: Cache::none(),
            digest: None,
            notes: Vec::new(),
            events: Events::IGNORED,
            absent: Absent::default(),
        })
    }

    /// What the need for memory depends on.
    pub fn workload(&self) -> Workload {
        let work = Workload::new(self.source().info(), self.input.residence()).seen(&self.rig, &self.schedule);
        Workload { pace: self.pace, ..work }
    }

    /// Plans what is to be done, stages that need what `needs` says, and takes the limits of that plan.
    ///
    /// # Errors
    /// A budget that cannot work.
    pub fn keep_to(
        &mut self,
        budget: Budget,
        needs: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> Result<()> {
        let plan = Plan::fit(self.workload(), budget, &self.events, needs)?;
        plan.tell_time(budget.tell, &self.events);
        self.follow(&plan);
        Ok(())
    }

    /// Takes the limits of a plan.
    pub fn follow(&mut self, plan: &Plan) {
        self.limits = plan.limits;
        self.planned_reads = Some(plan.reads());
        if plan.limits.tiles_held {
            self.input.hold_decoded();
        }
    }

    /// What reading every frame once reads.
    ///
    /// # Errors
    /// A file that is not there any more.
    pub fn whole(&self) -> Result<Reads> {
        let info = self.source().info();
        let states = info.count as u64 * info.times.len() as u64;
        let bytes = if self.input.residence().frame_block > 0 { self.input.stored_bytes()? } else { 0 };
        Ok(Reads { bytes, tiles: 0, states })
    }
}
