//! Containers and frame streams: packing, checking and repairing a container, writing frames, and the command `info`.

use std::collections::BTreeMap;
use std::fs;
use std::io::{Read, Stdin, Write};
use std::ops::Range;
use std::path::Path;

use gseq::{Compression, Reader, RecoverReport, VerifyReport};
use serde::Serialize;

use crate::cache::{Completion, SpillWriter};
use crate::commands::archive::is_archive;
use crate::commands::convert_report::ConvertReport;
use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::{Replace, StagedFile, TargetKind, check_target};
use crate::files::container::Container;
use crate::files::frame_stream::{FrameStream, StreamHeader};
use crate::files::open::open_file;
use crate::limits::Limits;
use crate::memory_plan::{Budget, MemoryPlan, ResourceEstimate, Workload};
use crate::model::Attributes;
use crate::models;
use crate::models::stream::pack_stream;
use crate::models::{ColumnInfo, InputModel, ModelSize, TimeOrigin};
use crate::outputs::bounds::{ErrorBounds, MaxError};
use crate::outputs::container::{
    FRAME_BLOCK, FRAME_BLOCK_WITH_ERROR_BOUNDS, Packing, join_container, spill_blocks, write_container,
};
use crate::outputs::frame_stream::StreamWriter;
use crate::outputs::kind::{OutputKind, check_container_name};
use crate::passes::FrameReaders;
use crate::pipeline::stages::write::ENCODE_SECONDS_PER_STATE;
use crate::pipeline::summary::InputSummary;
use crate::progress::counted;
use crate::scene::{
    InputOptions, OpenedInput, first_frame_box, frame_quota, is_linked, no_frames_error, open_cache, open_input,
    open_stream, receive_untracked,
};
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan};

/// Name of the packing stage, for progress and cache entries.
const PACK_STAGE: &str = "pack";

/// Precision with which [`pack`] stores the values in a container.
#[derive(Debug, Clone)]
pub enum StoragePrecision {
    /// All values exact to the bit, with the given compression.
    Exact(Compression),
    /// Values of the listed attributes with at most the listed errors, all other values exact to the bit. The second
    /// field is the level of zstd compression.
    Within(Vec<MaxError>, i32),
}

impl StoragePrecision {
    /// Returns the packing of a container, that is, its compression and the error bound of each attribute. `extent`
    /// returns the extent of the scene in scene units; it is called only if an error bound is given relative to the
    /// extent.
    fn packing(&self, extent: impl Fn() -> Result<f64>) -> Result<Packing> {
        match self {
            StoragePrecision::Exact(compression) => Ok((*compression).into()),
            StoragePrecision::Within(errors, level) => {
                Ok(Packing::with_bounds(ErrorBounds::from_errors(errors, extent)?, *level))
            }
        }
    }
}

/// Packs any input into a container. A stream that needs no tracking is packed while it arrives. Its container holds no
/// digest of it, because the digest is known only after the header of the container is written.
///
/// # Errors
/// Fails if the input cannot be read, if the output exists already or cannot be written, or if an error bound is
/// relative to the extent of a stream, which is known only at its end.
pub fn pack(
    input: &InputOptions,
    output: &Path,
    storing: &StoragePrecision,
    overwrite: Replace,
) -> Result<Completion<ConvertReport>> {
    Completion::from_result(pack_whole(input, output, storing, overwrite))
}

/// Packs any input into a container, as [`pack`] does, and returns the report. If the run computes only one shard (part
/// of a divided stage), it ends with the error [`Error::ShardDone`].
fn pack_whole(
    input: &InputOptions,
    output: &Path,
    storing: &StoragePrecision,
    overwrite: Replace,
) -> Result<ConvertReport> {
    check_container_name(output, "convert")?;
    check_target(output, TargetKind::File, &[&input.path], overwrite)?;
    let opened = match input.is_stream().then(|| open_stream(input)).transpose()? {
        Some(stream) if is_linked(stream.header(), input) => {
            receive_untracked(stream, None, input)?.track(&input.path)?
        }
        Some(stream) => return pack_arriving(stream, input, output, storing, overwrite),
        None => open_input(input)?,
    };
    let source = opened.input.source();
    MemoryPlan::fit_budget(workload(&*opened.input), input.memory, &input.events, |work, _| {
        pack_estimates(work, storing)
    })?
    .send_stage_times(input.memory.tell, &input.events);
    let (work, digest) = open_cache(input, &*opened.input)?;
    let extent = || Ok(first_frame_box(source)?.map_or(1.0, |bounds| bounds.extent()));
    let packing = storing.packing(|| work.get_or_compute("extent", work.key(&()), extent))?;
    let attributes = BTreeMap::from([("source_digest".to_owned(), digest.map_or_else(|| opened.input.digest(), Ok)?)]);
    let progress = |frames: usize| input.events.task(PACK_STAGE, "states", (source.info().count * frames) as u64);
    let staged = if work.is_enabled() {
        let encode = |blocks: Range<usize>, to: &mut SpillWriter| {
            let progress = progress(blocks.clone().map(|block| packing.frames_of_block(source, block).len()).sum());
            spill_blocks(source, packing, blocks, to, |done| progress.advance(done))
        };
        let spills = work.spill_in_shards(
            PACK_STAGE,
            packing.cache_key(),
            packing.frame_blocks(source),
            &input.scratch_folder(),
            encode,
        )?;
        work.end_shard_run_before("writing")?;
        let staged = StagedFile::new(output, overwrite)?;
        join_container(source, staged.path(), packing, attributes, &spills)?;
        staged
    } else {
        let staged = StagedFile::new(output, overwrite)?;
        let progress = progress(source.info().times.len());
        write_container(source, staged.path(), packing, attributes, |done| progress.advance(done))?;
        staged
    };
    let bytes = fs::metadata(staged.path()).map_err(Error::io("read", staged.path()))?.len();
    staged.commit()?;
    let info = opened.input.source().info();
    let larger = ModelSize::from_frames(bytes).why_larger_than(&opened.input.size()?);
    let notes = opened.notes.into_iter().chain(work.take_notes()).collect();
    Ok(container_report(output, info.count, info.times.len(), bytes, larger, notes))
}

/// Packs a frame stream into the container `output` while its frames arrive, and returns the report on the container.
/// In the stream, each Gaussian must keep its id from frame to frame. `storing`: precision of the stored values.
fn pack_arriving(
    stream: FrameStream<Stdin>,
    input: &InputOptions,
    output: &Path,
    storing: &StoragePrecision,
    overwrite: Replace,
) -> Result<ConvertReport> {
    let packing = storing.packing(|| {
        let message = "--max-error: expected scene units, as the extent of a stream is known at its end alone, found %";
        Err(Error::usage(message))
    })?;
    let staged = StagedFile::new(output, overwrite)?;
    let mut quota = frame_quota(input, stream.header())?;
    let received = pack_stream(stream, staged.path(), packing, &input.events, |held| quota.count_arrived(held.len()))?;
    let container = Container::open(staged.path())?;
    let (gaussians, frames) = (container.info().count, container.info().times.len());
    if frames == 0 && gaussians > 0 {
        return Err(no_frames_error());
    }
    let bytes = fs::metadata(staged.path()).map_err(Error::io("read", staged.path()))?.len();
    staged.commit()?;
    let larger = ModelSize::from_frames(bytes).why_larger_than(&ModelSize::from_frames(received));
    Ok(container_report(output, gaussians, frames, bytes, larger, Vec::new()))
}

/// Returns the report on the container at the path `output`, which was just written. `bytes`: size of the container.
/// `larger`: reason why the container is larger than the input; `None` if it is not larger.
fn container_report(
    output: &Path,
    gaussians: usize,
    frames: usize,
    bytes: u64,
    larger: Option<String>,
    notes: Vec<String>,
) -> ConvertReport {
    ConvertReport {
        path: output.to_owned(),
        kind: OutputKind::Gseq,
        gaussians,
        frames: Some(frames),
        bytes,
        larger,
        notes,
    }
}

/// Writes all frames of `input` to `to` as a frame stream and returns the opened input.
///
/// Memory: see [`unpack_estimates`].
pub fn unpack_stream(input: &InputOptions, to: impl Write) -> Result<OpenedInput> {
    let opened = open_input(input)?;
    let source = opened.input.source();
    let info = source.info();
    let header =
        StreamHeader { count: info.count, sh_degree: info.sh_degree, varying: info.varying, is_unlinked: false };
    let plan = MemoryPlan::fit_budget(workload(&*opened.input), input.memory, &input.events, unpack_estimates)?;
    plan.send_stage_times(input.memory.tell, &input.events);
    let max_held = plan.limits.max_kept_frames;
    let read_plan = ReadPlan::all_frames().with_max_kept_frames(max_held);
    let mut frames = FrameReaders::open(source, Ids::Range(0..source.info().count), Attributes::all(), &read_plan)?;
    let mut state = frames.state_buffer();
    if !info.times.is_empty() {
        frames.read(0, Attributes::all(), &mut state)?;
    }
    let progress = input.events.task("unpack", "frames", info.times.len() as u64);
    let mut stream = StreamWriter::new(to, Path::new("standard output"), header, &state)?;
    for (frame, &time) in info.times.iter().enumerate() {
        frames.read(frame, info.varying, &mut state)?;
        stream.write_frame(time, &state)?;
        progress.advance(1);
    }
    stream.finish()?;
    drop((progress, frames));
    Ok(opened)
}

/// Checks that the file at `path` is a container, possibly damaged. Fails unless its extension is `.gseq` or its first
/// bytes are those of a container.
fn check_is_container(path: &Path) -> Result<()> {
    let mut head = Vec::new();
    open_file(path)?.take(16).read_to_end(&mut head).map_err(Error::io("read", path))?;
    let is_named = path.extension().is_some_and(|found| found.eq_ignore_ascii_case("gseq"));
    if is_named || head.starts_with(&gseq::MAGIC[..4.min(head.len())]) {
        return Ok(());
    }
    let found = if is_archive(path)? { "an archive (.gsz)" } else { "another kind of file" };
    Err(Error::input(path, "", "a .gseq container", found)
        .hint(format!("`splatsieve info {}` reads it and says what it holds", path.shown())))
}

/// Reads and checks every byte of the container at `path`, within the default memory limit.
pub fn verify(path: &Path) -> Result<VerifyReport> {
    check_is_container(path)?;
    let memory = Budget::default().read_limit().bytes();
    Ok(Reader::open_within(path, memory)?.verify_within(memory)?)
}

/// Copies the complete frames of the truncated or damaged container `input` to the new container `output`. Fails if no
/// frame is complete. Returns how many frames and tiles were found and saved.
pub fn recover(input: &Path, output: &Path, overwrite: Replace) -> Result<RecoverReport> {
    check_container_name(output, "info --repair")?;
    check_is_container(input)?;
    check_target(output, TargetKind::File, &[input], overwrite)?;
    let staged = StagedFile::new(output, overwrite)?;
    let report = gseq::recover_within(input, staged.path(), Budget::default().read_limit().bytes())?;
    if report.frames == 0 {
        let found = format!("{} time stamps and {} intact tiles", report.frames_seen, report.tiles_seen);
        return Err(Error::input(input, "", "at least one complete frame to save", found)
            .hint("nothing was written: a frame is saved if every tile of its block, and all before it, are intact"));
    }
    staged.commit()?;
    Ok(report)
}

/// Description of an input, as `info` prints it.
#[derive(Debug, Serialize)]
pub struct InputInfo {
    /// Summary of the input.
    #[serde(flatten)]
    pub input: InputSummary,
    /// Time stamps of the first and the last frame; `None` if the input has no frames, or if the cameras determine the
    /// times of its frames.
    pub times: Option<(f64, f64)>,
    /// Stored attributes (columns) of a container; empty for other inputs.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub columns: Vec<ColumnInfo>,
    /// Notes for the user.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<String>,
}

/// Returns the description of an input. Reads its bytes once to compute the digest, but computes no frame.
pub fn info(options: &InputOptions) -> Result<InputInfo> {
    let input: Box<dyn InputModel> = match options.is_stream() {
        true => open_input(options)?.input,
        false => models::open(&options.path, &options.open_options())?.into_linked()?,
    };
    let times = &input.source().info().times;
    let times = times.first().zip(times.last()).map(|(&first, &last)| (first, last));
    let mut summary = InputSummary::new(&*input, &options.path, input.digest()?)?;
    let description = input.description();
    if description.timing == TimeOrigin::Continuous {
        summary.frames = None;
    }
    Ok(InputInfo { input: summary, times, columns: input.columns()?, notes: description.notes })
}

/// Returns the workload (sizes from which memory and time are estimated) of reading `input` without rendering it.
fn workload(input: &dyn InputModel) -> Workload {
    Workload::new(input.source().info(), input.memory_profile())
}

/// Returns the resource estimate (memory and time) of packing all frames into a container with the precision `storing`.
fn pack_estimates(work: &Workload, storing: &StoragePrecision) -> Vec<ResourceEstimate> {
    let seconds = work.reading_seconds(work.gaussian_count(), work.frames as f64)
        + work.gaussian_count() * work.frames as f64 * ENCODE_SECONDS_PER_STATE;
    let level = match storing {
        StoragePrecision::Exact(Compression::Zstd(level)) | StoragePrecision::Within(_, level) => *level,
        StoragePrecision::Exact(_) => 0,
    };
    // Error bounds may be relative to the extent of the scene, which is computed from the positions of the first frame.
    let (together, positions) = match storing {
        StoragePrecision::Within(..) => (FRAME_BLOCK_WITH_ERROR_BOUNDS, 16),
        StoragePrecision::Exact(_) => (FRAME_BLOCK, 0),
    };
    let per_gaussian = vec![("positions", positions)];
    let fixed = [work.tile_write_buffers(together), vec![work.compressor_memory(level, together)]].concat();
    vec![ResourceEstimate { stage: PACK_STAGE, reads: 1.0, seconds, per_gaussian, fixed }]
}

/// Returns the resource estimate (memory and time) of writing all frames as a stream.
fn unpack_estimates(work: &Workload, limits: &Limits) -> Vec<ResourceEstimate> {
    let states = ("states", work.state_bytes(Attributes::all()));
    let per_gaussian = vec![
        states,
        ("readers", work.input.reader),
        ("kept frames", work.kept_frames_bytes(limits, Attributes::all())),
    ];
    let seconds = 2.0 * work.reading_seconds(work.gaussian_count(), work.frames as f64);
    vec![ResourceEstimate {
        stage: "unpack",
        reads: 1.0,
        seconds,
        per_gaussian,
        fixed: vec![work.block_buffer_memory()],
    }]
}

impl InputInfo {
    /// Returns this description of an input as text for the terminal.
    pub fn text(&self) -> String {
        let input = &self.input;
        let mut out = format!(
            "{}: {}\n  {}, SH degree {}, {}\n  varying: {}\n  {} bytes{}, digest {}\n",
            Path::new(&input.path).shown(),
            input.kind,
            counted(input.gaussians, "Gaussian"),
            input.sh_degree,
            match self.times {
                Some((first, last)) => {
                    format!("{} from t = {first} to {last}", counted(input.frames.unwrap_or(0), "frame"))
                }
                None => match input.frames {
                    Some(_) => "no frames".to_owned(),
                    None => "continuous in time".to_owned(),
                },
            },
            if input.varying.is_empty() { "nothing".to_owned() } else { input.varying.join(", ") },
            input.bytes,
            if input.bytes == 0 { String::new() } else { format!(": {}", input.size.parts_text()) },
            input.digest,
        );
        for column in &self.columns {
            let range = match (column.min, column.max) {
                (Some(min), Some(max)) => format!("{min} to {max}"),
                _ => "no finite value".to_owned(),
            };
            out += &format!(
                "  {:<14} x{:<3} {:>6} tiles ({} constant, {} raw)  {:>12} bytes of {:>12}  {range}{}\n",
                column.name,
                column.width,
                column.tiles,
                column.constant_tiles,
                column.raw_tiles,
                column.stored_bytes,
                column.raw_bytes,
                match column.max_error {
                    0.0 => String::new(),
                    bound => format!(", at most {bound} off"),
                }
            );
        }
        self.notes.iter().for_each(|note| out += &format!("  note: {note}\n"));
        out
    }
}
