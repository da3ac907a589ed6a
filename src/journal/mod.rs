//! Journal of a run: records of its stages with their time, memory and reads, omitted stages with reasons, and notes.
//! The code that does a piece of work adds the entry for it.

pub(crate) mod as_toml;
pub mod records;

use std::time::Instant;

use cpu_time::ProcessTime;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::cache::{Cache, CacheKey, Spill};
use crate::error::Result;
use crate::journal::as_toml::AsToml;
use crate::journal::records::{
    FieldPrecisionSummary, Forecast, OmittedWork, PhotographSummary, RefinedSummary, SavedCost, ShDegreeSummary,
    StageRecord,
};
use crate::machine::peak_memory_bytes;
use crate::progress::{Events, Message};
use crate::scene::Scene;
use crate::source::{FrameSource, ReadCounts};

/// Clock that measures the wall-clock time and the processor time of a piece of work.
#[derive(Debug, Clone, Copy)]
pub struct Stopwatch {
    wall: Instant,
    /// Processor time, in seconds, that the process had used when this stopwatch was started; `None` if the system does
    /// not report it.
    processors: Option<f64>,
}

impl Stopwatch {
    /// Starts a new stopwatch.
    pub fn start() -> Stopwatch {
        Stopwatch { wall: Instant::now(), processors: processor_seconds() }
    }

    /// Returns the wall-clock time since this stopwatch was started, seconds.
    pub fn seconds(&self) -> f64 {
        self.wall.elapsed().as_secs_f64()
    }

    /// Returns the processor time that this process used since this stopwatch was started, summed over all processors,
    /// seconds; `None` if the system does not report it.
    pub fn processor_seconds(&self) -> Option<f64> {
        processor_seconds().zip(self.processors).map(|(now, before)| now - before)
    }
}

/// Returns the processor time of this process so far, summed over all processors, seconds; `None` if the system does
/// not report it.
fn processor_seconds() -> Option<f64> {
    ProcessTime::try_now().ok().map(|time| time.as_duration().as_secs_f64())
}

/// Journal: record of the stages of a run so far, or of one stage whose result is in the cache.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Journal {
    /// Amounts that one full read of the input (every frame once) takes: bytes, tiles (compressed blocks of values),
    /// and states (one Gaussian at one frame). The reads of a stage are reported as multiples of these amounts.
    #[serde(skip)]
    pub whole: ReadCounts,
    /// Records of the stages that have run, in order.
    pub stages: Vec<StageRecord>,
    /// Stages that the run omitted, with reasons.
    pub left_out: Vec<OmittedWork>,
    /// Notes for the user.
    pub notes: Vec<String>,
    /// Measured effect on renders of writing the deformation field in half precision, if it was measured.
    pub field: Option<FieldPrecisionSummary>,
    /// Measured effect on renders of dropping SH degrees, if it was measured.
    pub bands: Option<ShDegreeSummary>,
    /// PSNR before and after refinement, if the run refined.
    pub refined: Option<RefinedSummary>,
    /// PSNR against photographs before and after the fit to them, if it changed the result.
    pub photographs: Option<PhotographSummary>,
    /// Forecast of time and memory, if one was made before the run.
    pub forecast: Option<Forecast>,
}

impl Journal {
    /// Shows the warning `text` to the user, and makes it the first note, because a summary may show only its first
    /// notes.
    pub fn warn(&mut self, events: &Events, text: String) {
        events.send(Message::Warning(&text));
        self.notes.insert(0, text);
    }

    /// Runs the stage `name`, whose work is the function `work`, and returns its result. Records the time, the memory,
    /// and the reads of `source`. `gaussians_in` is the number of Gaussians before the stage. `work` returns its result
    /// together with the number of Gaussians after the stage.
    ///
    /// # Errors
    /// Fails if `work` fails; the stage is not recorded then.
    pub fn run_stage<T>(
        &mut self,
        name: &'static str,
        gaussians_in: usize,
        source: &dyn FrameSource,
        work: impl FnOnce(&mut Journal) -> Result<(T, usize)>,
    ) -> Result<T> {
        let (start, before, scratch) = (Stopwatch::start(), source.reads(), Spill::bytes_read_back());
        let (value, gaussians_out) = work(self)?;
        let (reads, scratch) = (source.reads() - before, Spill::bytes_read_back() - scratch);
        self.record_stage(name, [gaussians_in, gaussians_out], start, reads, scratch);
        Ok(value)
    }

    /// Returns the result of the stage `name` from the cache of `scene`. If the cache has no result for `key`, runs the
    /// stage with `compute` as [`Journal::run_stage`] does, and stores the result under `key`. `gaussians_in` is the
    /// number of Gaussians before the stage. Only for stages that one process runs as a whole.
    ///
    /// # Errors
    /// Fails in these cases:
    /// - `compute` fails.
    /// - The cache cannot be read or written.
    /// - The run is limited to one shard (part of a divided stage), and the result is not in the cache. The error is
    ///   then [`Error::ShardDone`](crate::error::Error::ShardDone), which ends the run.
    pub fn run_cached_stage<T: Serialize + DeserializeOwned>(
        &mut self,
        name: &'static str,
        gaussians_in: usize,
        scene: &Scene,
        key: CacheKey,
        compute: impl FnOnce(&mut Journal) -> Result<(T, usize)>,
    ) -> Result<T> {
        self.cached(&scene.work, name, key, |journal| {
            scene.work.end_shard_run_before(name)?;
            journal.run_stage(name, gaussians_in, scene.source(), compute)
        })
    }

    /// Returns the mean PSNR of the result against the original on validation views (used to choose, not to fit), dB,
    /// before a fit to photographs. The value is from the last stage that measured it; `None` if no stage did.
    pub fn result_psnr(&self) -> Option<f64> {
        let bands = self.bands.as_ref().map(|bands| bands.result);
        let field = self.field.as_ref().and_then(|field| field.result);
        bands.or(field).or(self.refined.map(|refined| refined.result))
    }

    /// Returns the result of the stage `stage` for `key` from the cache `work`. If the cache has none, runs `compute`
    /// and stores its result. The stages and notes that `compute` records are stored together with the result. They are
    /// added to this journal (record of the run) even if the result comes from the cache.
    ///
    /// # Errors
    /// Fails if `compute` fails or the cache cannot be used.
    pub fn cached<T: Serialize + DeserializeOwned>(
        &mut self,
        work: &Cache,
        stage: &str,
        key: CacheKey,
        compute: impl FnOnce(&mut Journal) -> Result<T>,
    ) -> Result<T> {
        if !work.is_enabled() {
            return compute(self);
        }
        let mut is_new = false;
        let (found, AsToml(mut own)) = work.get_or_compute(stage, key, || {
            is_new = true;
            let mut own = Journal { whole: self.whole, ..Journal::default() };
            let found = compute(&mut own)?;
            Ok((found, AsToml(own)))
        })?;
        own.stages.iter_mut().for_each(|stage| stage.from_cache |= !is_new);
        self.stages.extend(own.stages);
        self.left_out.extend(own.left_out);
        self.notes.extend(own.notes);
        self.field = self.field.take().or(own.field);
        self.bands = self.bands.take().or(own.bands);
        self.refined = own.refined.or(self.refined);
        self.photographs = own.photographs.or(self.photographs);
        Ok(found)
    }

    /// Adds an entry for the opening of the input, as the stage `name`. `start`: stopwatch that was started before the
    /// opening. `gaussians`: number of Gaussians found. `reads`: amounts that were read.
    pub fn record_opening(&mut self, name: &'static str, start: Stopwatch, gaussians: usize, reads: ReadCounts) {
        self.record_stage(name, [0, gaussians], start, reads, 0);
    }

    /// Adds an entry for the omitted work `what` with the reason `why`.
    pub fn leave_out(&mut self, what: impl Into<String>, why: impl Into<String>) {
        self.left_out.push(OmittedWork { what: what.into(), why: why.into(), saved: None });
    }

    /// Adds an entry for the omitted work `what` with the reason `why` and `saved`, the cost that it would have had
    /// (time and reads).
    pub fn leave_out_with_saving(&mut self, what: impl Into<String>, why: impl Into<String>, saved: SavedCost) {
        self.left_out.push(OmittedWork { what: what.into(), why: why.into(), saved: Some(saved) });
    }

    /// Adds the record of the stage `name`, which began at `start` and ends now. `reads`: amounts that it read from the
    /// input. `scratch_bytes`: number of bytes that it read back from scratch files.
    fn record_stage(
        &mut self,
        name: &str,
        [gaussians_in, gaussians_out]: [usize; 2],
        start: Stopwatch,
        reads: ReadCounts,
        scratch_bytes: u64,
    ) {
        let ReadCounts { bytes, states, .. } = self.whole;
        let (read, whole) = if bytes > 0 { (reads.bytes, bytes) } else { (reads.states, states) };
        self.stages.push(StageRecord {
            name: name.to_owned(),
            gaussians_in,
            gaussians_out,
            reads,
            full_reads: read as f64 / whole.max(1) as f64,
            scratch_bytes,
            from_cache: false,
            seconds: start.seconds(),
            processor_seconds: start.processor_seconds(),
            peak_memory_bytes: peak_memory_bytes(),
        });
    }
}
