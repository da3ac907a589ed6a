//! A scene: an input together with its cameras. Every command that reads frames starts by opening one.

mod absent;
pub mod camera_path;
mod compressed;
mod frames;
mod input;
mod open;
pub mod photographs;
mod stream;
pub mod view_selection;
pub mod views_between;
pub mod views_outside;
mod work;

use std::path::{Path, PathBuf};

use crate::cache::Cache;
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::memory_plan::{Budget, MemoryPlan, ResourceEstimate, Workload};
use crate::model::{Rig, Split, ViewSchedule};
use crate::models::{InputModel, TimeOrigin};
use crate::progress::Events;
use crate::source::ReadCounts;

use absent::Absent;
pub use compressed::{check_compressed, open_compressed, tracking_notes};
pub use input::{InputOptions, OpenedInput, UntrackedInput, with_cameras};
pub use open::{first_frame_box, from_input, open_input, open_scene, open_untracked, scratch_beside};
pub use stream::{
    FrameQuota, frame_quota, is_linked, load_stream_cameras, no_frames_error, open_stream, receive_untracked,
    receiving_estimate,
};
pub(crate) use work::add_file_stamps;
pub use work::open_cache;

/// Input (a model or a sequence of frames) together with its cameras, the schedule of its views, and the memory limits,
/// folders and cache of the run.
pub struct Scene {
    /// Path of the input as the user gave it.
    pub path: PathBuf,
    /// Model or sequence that was opened.
    pub input: Box<dyn InputModel>,
    /// Cameras and the views they took, of all splits (training, validation, test).
    pub rig: Rig,
    /// Views at each frame: those of the cameras of the chosen split, and those of cameras outside the rig if these
    /// were added. A camera is outside the rig if it sees the scene from a new direction.
    pub schedule: ViewSchedule,
    /// Weight, from 0 (ignored) to 1, of the quality of renders from directions in which the rig has no cameras. It is
    /// the argument `reach` of [`Scene::add_outside_views`]. If `reach` is at least
    /// [`views_outside::MIN_SCORED_OUTSIDE`] but no camera outside the rig can be found, it is 0.
    pub outside: f64,
    /// Whether the views show the whole scene: cameras were given or found, or were placed all around a scene of one
    /// frame. Otherwise the cameras are a virtual rig, which may see only what is in front of it, such as the outside
    /// of a wall.
    pub has_cameras: bool,
    /// Whether the program placed the cameras, because none were given or found.
    pub has_virtual_rig: bool,
    /// Background color: red, green, blue in [0, 1]. Taken from the cameras, else from the input's training parameters,
    /// else from the model in whose folder the cameras are, else black.
    pub background: [f32; 3],
    /// Maximum amounts (frames, views, Gaussians) that passes over the scene keep in memory at a time.
    pub limits: Limits,
    /// Maximum number of times that the run reads the whole input, according to the memory plan that set `limits`;
    /// `None` before a plan is made.
    pub planned_reads: Option<f64>,
    /// Folder for temporary files during the run.
    pub scratch: PathBuf,
    /// Cache of stage results. A disabled cache stores nothing.
    pub work: Cache,
    /// Hash of the input's content; `None` if it has not been computed yet.
    digest: Option<String>,
    /// Notes about the input to show to the user.
    pub notes: Vec<String>,
    /// Receiver of progress, notes and warnings during the run.
    pub events: Events,
    /// Gaussians that are made invisible in all reads of frames, because some of their values are NaN or infinite.
    absent: Absent,
}

impl Scene {
    /// Returns the name of the input in messages: its path, or "standard input".
    pub fn shown_path(&self) -> &Path {
        stream::shown_input(&self.path)
    }

    /// Creates the scene of `input` and the cameras of `rig`, with the views of `split` (`None`: of all splits) and
    /// without memory limits.
    ///
    /// # Errors
    /// Fails if a camera has a time that is not the time of any frame.
    pub fn new(path: PathBuf, input: Box<dyn InputModel>, rig: Rig, split: Option<Split>) -> Result<Scene> {
        let schedule =
            rig.schedule(&input.source().info().times, split).map_err(|error| match input.description().timing {
                TimeOrigin::Continuous => {
                    Error::usage(format!("{error}, or set --frames to the number of times in the camera file"))
                }
                TimeOrigin::Numbered | TimeOrigin::Stamped => error,
            })?;
        let background = rig.background.or(input.description().background).unwrap_or([0.0; 3]);
        Ok(Scene {
            path,
            input,
            rig,
            schedule,
            outside: 0.0,
            has_cameras: true,
            has_virtual_rig: false,
            background,
            limits: Limits::NONE,
            planned_reads: None,
            scratch: std::env::temp_dir(),
            work: Cache::disabled(),
            digest: None,
            notes: Vec::new(),
            events: Events::IGNORED,
            absent: Absent::default(),
        })
    }

    /// Returns the properties of the scene from which memory and time are estimated.
    pub fn workload(&self) -> Workload {
        Workload::new(self.source().info(), self.input.memory_profile()).with_views(&self.rig, &self.schedule)
    }

    /// Plans the memory of the stages whose estimates `needs` returns, and makes this scene keep to the limits of the
    /// plan.
    ///
    /// # Errors
    /// Fails if the stages do not fit into the memory budget under any limits.
    pub fn plan_memory(
        &mut self,
        budget: Budget,
        needs: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> Result<()> {
        let plan = MemoryPlan::fit_budget(self.workload(), budget, &self.events, needs)?;
        plan.send_stage_times(budget.tell, &self.events);
        self.apply_plan(&plan);
        Ok(())
    }

    /// Applies the memory plan `plan`: sets the limits for passes over this scene, and lets the input keep decoded
    /// tiles (separately compressed parts of a container) in memory if the plan says so.
    pub fn apply_plan(&mut self, plan: &MemoryPlan) {
        self.limits = plan.limits;
        self.planned_reads = Some(plan.whole_input_reads());
        if plan.limits.keeps_tiles {
            self.input.hold_decoded();
        }
    }

    /// Returns how many bytes and how many Gaussian states (one Gaussian at one frame) one full read of the input
    /// takes.
    ///
    /// # Errors
    /// Fails if a file of the input does not exist any more.
    pub fn full_read(&self) -> Result<ReadCounts> {
        let info = self.source().info();
        let states = info.count as u64 * info.times.len() as u64;
        let bytes = if self.input.memory_profile().frame_block > 0 { self.input.stored_bytes()? } else { 0 };
        Ok(ReadCounts { bytes, tiles: 0, states })
    }
}
