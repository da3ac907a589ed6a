//! What happens in a run, written down where it happens: stages with their time, memory and reads, what was left out
//! and why, and notes.

pub(crate) mod as_toml;
pub mod records;

use std::time::Instant;

use cpu_time::ProcessTime;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::cache::{Cache, CacheKey, Spill};
use crate::error::Result;
use crate::journal::as_toml::AsToml;
use crate::journal::records::Forecast;
use crate::journal::records::{BandsSummary, FieldSummary, LeftOut, RefinedSummary, Saved, StageRecord};
use crate::machine::peak_memory_bytes;
use crate::scene::Scene;
use crate::source::{FrameSource, Reads};

/// When something began.
#[derive(Debug, Clone, Copy)]
pub struct Clock {
    wall: Instant,
    /// Seconds of all processors.
    processors: Option<f64>,
}

impl Clock {
    /// Now.
    pub fn start() -> Clock {
        Clock { wall: Instant::now(), processors: processor_seconds() }
    }

    /// Seconds since then.
    pub fn seconds(&self) -> f64 {
        self.wall.elapsed().as_secs_f64()
    }

    /// Seconds that this process took since then of all processors together; none where the system does not say.
    pub fn processor_seconds(&self) -> Option<f64> {
        processor_seconds().zip(self.processors).map(|(now, before)| now - before)
    }
}

/// Seconds that this process took of all processors together; none where the system does not say.
fn processor_seconds() -> Option<f64> {
    ProcessTime::try_now().ok().map(|time| time.as_duration().as_secs_f64())
}

/// The record of a run so far, or of a stage that is kept.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Journal {
    /// What reading every frame once reads.
    #[serde(skip)]
    pub whole: Reads,
    /// Everything done, in order.
    pub stages: Vec<StageRecord>,
    /// What the scene did not need.
    pub left_out: Vec<LeftOut>,
    /// Things a person should know.
    pub notes: Vec<String>,
    /// What was found about the field's precision.
    pub field: Option<FieldSummary>,
    /// What was found about the bands of spherical harmonics.
    pub bands: Option<BandsSummary>,
    /// What refining gained.
    pub refined: Option<RefinedSummary>,
    /// What the run was expected to take, where that was said.
    pub forecast: Option<Forecast>,
}

impl Journal {
    /// Runs `work` as a stage that reads `source`; it gives its result and the number of Gaussians that left it.
    ///
    /// # Errors
    /// Those of `work`; nothing is written down then.
    pub fn stage<T>(
        &mut self,
        name: &'static str,
        gaussians_in: usize,
        source: &dyn FrameSource,
        work: impl FnOnce(&mut Journal) -> Result<(T, usize)>,
    ) -> Result<T> {
        let (start, before, scratch) = (Clock::start(), source.reads(), Spill::read_back());
        let (value, gaussians_out) = work(self)?;
        let (reads, scratch) = (source.reads() - before, Spill::read_back() - scratch);
        self.add(name, [gaussians_in, gaussians_out], start, reads, scratch);
        Ok(value)
    }

    /// [`Journal::stage`] of which nothing is divided, with its result kept in the scene's work folder for `key`.
    ///
    /// # Errors
    /// Those of `compute` and of the folder; a run of a part ends before it.
    pub fn kept_stage<T: Serialize + DeserializeOwned>(
        &mut self,
        name: &'static str,
        gaussians_in: usize,
        scene: &Scene,
        key: CacheKey,
        compute: impl FnOnce(&mut Journal) -> Result<(T, usize)>,
    ) -> Result<T> {
        self.kept(&scene.work, name, key, |journal| {
            scene.work.not_divided(name)?;
            journal.stage(name, gaussians_in, scene.source(), compute)
        })
    }

    /// Returns the mean PSNR of the result against the original on validation views, dB: that of the last stage that changed
    /// the result and measured it.
    pub fn result_psnr(&self) -> Option<f64> {
        let bands = self.bands.as_ref().map(|bands| bands.result);
        let field = self.field.as_ref().and_then(|field| field.result);
        bands.or(field).or(self.refined.map(|refined| refined.result))
    }

    /// What `compute` finds, as a piece of `work` called `stage`, with all that it writes down.
    ///
    /// # Errors
    /// Those of `compute` and of the folder.
    pub fn kept<T: Serialize + DeserializeOwned>(
        &mut self,
        work: &Cache,
        stage: &str,
        key: CacheKey,
        compute: impl FnOnce(&mut Journal) -> Result<T>,
    ) -> Result<T> {
        if !work.keeps() {
            return compute(self);
        }
        let mut is_new = false;
        let (found, AsToml(mut own)) = work.known(stage, key, || {
            is_new = true;
            let mut own = Journal { whole: self.whole, ..Journal::default() };
            let found = compute(&mut own)?;
            Ok((found, AsToml(own)))
        })?;
        own.stages.iter_mut().for_each(|stage| stage.kept |= !is_new);
        self.stages.extend(own.stages);
        self.left_out.extend(own.left_out);
        self.notes.extend(own.notes);
        self.field = self.field.take().or(own.field);
        self.bands = self.bands.take().or(own.bands);
        self.refined = own.refined.or(self.refined);
        Ok(found)
    }

    /// Writes down that opening the input, begun at `start`, gave `gaussians` Gaussians and read so much.
    pub fn opened(&mut self, name: &'static str, start: Clock, gaussians: usize, reads: Reads) {
        self.add(name, [0, gaussians], start, reads, 0);
    }

    /// Writes down what was not done, and why not.
    pub fn leave_out(&mut self, what: impl Into<String>, why: impl Into<String>) {
        self.left_out.push(LeftOut { what: what.into(), why: why.into(), saved: None });
    }

    /// The same of what would have taken so much.
    pub fn spare(&mut self, what: impl Into<String>, why: impl Into<String>, saved: Saved) {
        self.left_out.push(LeftOut { what: what.into(), why: why.into(), saved: Some(saved) });
    }

    fn add(
        &mut self,
        name: &str,
        [gaussians_in, gaussians_out]: [usize; 2],
        start: Clock,
        reads: Reads,
        scratch_bytes: u64,
    ) {
        let Reads { bytes, states, .. } = self.whole;
        let (read, whole) = if bytes > 0 { (reads.bytes, bytes) } else { (reads.states, states) };
        self.stages.push(StageRecord {
            name: name.to_owned(),
            gaussians_in,
            gaussians_out,
            reads,
            full_reads: read as f64 / whole.max(1) as f64,
            scratch_bytes,
            kept: false,
            seconds: start.seconds(),
            processor_seconds: start.processor_seconds(),
            peak_memory_bytes: peak_memory_bytes(),
        });
    }
}
