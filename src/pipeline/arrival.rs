//! A sequence that arrives on standard input, frame by frame: packed into a scratch container, and measured on
//! the way, so that the stream is read once.
//!
//! Memory, with b the bytes of one Gaussian's varying columns: frames held N·b·F, at most 64 MiB or one frame;
//! two more on their way in; the constant columns; when measuring, the accumulators of all Gaussians
//! ([`crate::stats::BYTES_PER_GAUSSIAN`] each) and what [`Looking`] needs. A thread reads ahead while the frames
//! before are encoded.
//!
//! What only the end of the stream tells (time span, number of frames) is assumed meanwhile: even frames, and
//! pictures taken at exactly the times that arrive. Where that proves wrong the packed frames are
//! measured instead: the result is the same either way.

use std::cell::OnceCell;
use std::collections::BTreeMap;
use std::io::{IsTerminal, Read};
use std::path::{Path, PathBuf};
use std::thread;

use crossbeam_channel::bounded;
use glam::DVec3;
use gseq::Compression;

use super::input::{Input, InputOptions, Opened, Scene, Streamed, load_cameras, open_scene, scene_of};
use super::memory::{Budget, Need, Plan, Workload, keep_to, receiving};
use super::scored::{Measured, looks};
use crate::emit::atomic::ScratchFile;
use crate::emit::container::{ContainerWriter, FRAME_BLOCK};
use crate::error::{Error, Result};
use crate::ingest::cameras;
use crate::ingest::container::Container;
use crate::ingest::frame_stream::{FrameStream, StreamHeader};
use crate::model::{Camera, Gaussians, Rig, Split};
use crate::pass::FrameSource;
use crate::plan::Limits;
use crate::recipe::{self, Recipe};
use crate::stats::{RobustBox, ScanPlan};
use crate::stream::{HeldFrames, Looking, Progress, RunningScan, Sampler};

/// Most bytes of frames that are held together, if that is one frame at least.
const HELD_BYTES: u64 = 64 << 20;
/// Frames that may be on their way from the reading thread.
const AHEAD: usize = 2;

/// What messages call standard input.
pub const STANDARD_INPUT: &str = "standard input";

/// How the scratch container is stored: as `pack` does, so that the digest of the input is the same.
const COMPRESSION: Compression = Compression::Zstd(1);

/// Opens standard input as a stream.
///
/// # Errors
/// A terminal; what is no stream; options that only models have.
pub fn open_stream(options: &InputOptions) -> Result<FrameStream<std::io::Stdin>> {
    if options.frames.is_some() || options.iteration.is_some() {
        return Err(Error::usage("--frames and --iteration are for models, not for a stream"));
    }
    let stdin = std::io::stdin();
    if stdin.is_terminal() {
        return Err(Error::usage("standard input is a terminal; pipe a frame stream into it (format/STREAM.md)"));
    }
    FrameStream::open(stdin, Path::new(STANDARD_INPUT))
}

/// Packs a stream into a scratch container and opens that with its cameras.
///
/// # Errors
/// What is wrong with the stream; a budget that does not hold the frames that are packed together.
pub fn open_arriving(options: &InputOptions) -> Result<Opened> {
    let rig = load_cameras(options, options.cameras.as_deref())?;
    let stream = open_stream(options)?;
    check_memory(options, stream.header())?;
    let streamed = to_scratch(stream, options, |_| Ok(()))?;
    Ok(Opened { input: Input::Stream(streamed), rig, notes: Vec::new() })
}

/// Opens a scene to be measured, with the limits of its budget; `needs` says what is to be done, told whether there
/// are cameras. A stream is measured as it arrives, see [`open_measured`].
pub fn open_to_measure(
    options: &InputOptions,
    recipe: &Recipe,
    check: impl FnOnce(usize) -> Result<()>,
    needs: impl Fn(&Workload, &Limits, bool) -> Vec<Need>,
) -> Result<(Scene, Option<Measured>)> {
    if options.is_stream() {
        return open_measured(options, recipe, check, needs);
    }
    let mut scene = open_scene(options)?;
    let has_cameras = scene.has_cameras;
    keep_to(options.memory, &mut scene, |work, limits| needs(work, limits, has_cameras))?;
    Ok((scene, None))
}

/// Packs a stream into a scratch container and measures it meanwhile, if there is memory for that beside the frames
/// held. `check` is told the number of Gaussians before any frame is read, and `needs` what is known, for the
/// stages to come.
///
/// Gives the scene, and the statistics if what was assumed held.
fn open_measured(
    options: &InputOptions,
    recipe: &Recipe,
    check: impl FnOnce(usize) -> Result<()>,
    needs: impl Fn(&Workload, &Limits, bool) -> Vec<Need>,
) -> Result<(Scene, Option<Measured>)> {
    let loaded = load_cameras(options, options.cameras.as_deref())?;
    let has_cameras = loaded.is_some();
    let stream = open_stream(options)?;
    let count = stream.header().count;
    check(count)?;
    let of_rig = loaded.clone().unwrap_or_else(|| cameras::virtual_rig(DVec3::ZERO, 1.0));
    let block = frame_block(stream.header());
    let work = Workload::of_stream(stream.header(), block, &of_rig);
    let (held, visible) = (block + AHEAD, looks(has_cameras, recipe.scan.coverage));
    let plan = |explain: bool, measuring: Option<bool>| {
        Plan::fit(work, Budget { explain, ..options.memory }, |work, limits| {
            let mut all = vec![receiving(work, limits, held as u64, measuring)];
            all.extend(needs(work, limits, has_cameras));
            all
        })
    };
    let measures = plan(false, Some(visible)).is_ok();
    let memory = plan(options.memory.explain, measures.then_some(visible))?;
    // Without cameras the rig stands around the first frame, and everything else around the rig.
    let (rig, plan_of_scan) = (OnceCell::new(), OnceCell::new());
    if let Some(loaded) = loaded {
        let _ = rig.set(loaded);
    }
    let mut measuring: Option<Measuring<'_>> = None;
    let streamed = to_scratch(stream, options, |held| {
        let measuring = match &mut measuring {
            Some(measuring) => measuring,
            none if measures => {
                let rig: &Rig = rig.get_or_init(|| rig_around(held));
                let plan = plan_of_scan.get_or_init(|| ScanPlan::arriving(&recipe.scan, &rig.cameras));
                let looking = visible.then(|| Looking::new(count, recipe.scan.pixel_stride, memory.limits));
                none.insert(Measuring::new(count, rig, options.split, plan, &recipe.scan, looking))
            }
            _ => return Ok(()),
        };
        measuring.add(held)
    })?;
    let input = Input::Stream(streamed);
    let opened = Opened { rig: has_cameras.then(|| rig.get().cloned()).flatten(), input, notes: Vec::new() };
    let mut scene = Scene { limits: memory.limits, ..scene_of(opened, options)? };
    // Now that the frames are counted; what they add is small, and no reason to throw away what has arrived.
    let counted = Budget { explain: false, ..options.memory };
    if let Ok(plan) = Plan::fit(Workload::of(&scene), counted, |work, limits| needs(work, limits, has_cameras)) {
        scene.limits = plan.limits;
    }
    let Some(measuring) = measuring else { return Ok((scene, None)) };
    let complete = ScanPlan::new(&recipe.scan, &scene.input.source().info().times, &scene.schedule)?;
    if let Some(why) = measuring.wrong(&complete, &scene) {
        scene.notes.push(format!("statistics were taken from the packed frames, not as they arrived: {why}"));
        return Ok((scene, None));
    }
    Ok((scene, Some(measuring.finish(&complete))))
}

/// Confirms that there is memory to pack a stream.
pub fn check_memory(options: &InputOptions, header: &StreamHeader) -> Result<()> {
    let block = frame_block(header);
    let held = (block + AHEAD) as u64;
    let nobody = Rig { cameras: Vec::new(), shots: Vec::new(), background: None, origin: String::new() };
    let work = Workload::of_stream(header, block, &nobody);
    Plan::fit(work, options.memory, |work, limits| vec![receiving(work, limits, held, None)])?;
    Ok(())
}

/// Writes a stream to the container `path`; gives the number of bytes that arrived. `take` sees the frames
/// of every frame block, in order.
pub fn pack_stream(
    mut stream: FrameStream<impl Read + Send + 'static>,
    path: &Path,
    compression: Compression,
    mut take: impl FnMut(&HeldFrames) -> Result<()>,
) -> Result<u64> {
    let StreamHeader { count, sh_degree, varying } = *stream.header();
    let block = frame_block(stream.header());
    let mut writer = ContainerWriter::create(path, count, sh_degree, block, compression, BTreeMap::new())?;
    let mut held = HeldFrames::new(count, sh_degree, varying, stream.take_constant());
    let progress = Progress::counting("receive", "frames");
    let mut put = |held: &mut HeldFrames| -> Result<Vec<Gaussians>> {
        writer.append(held, 0..held.len(), |_| ())?;
        take(held)?;
        Ok(held.drain().collect())
    };

    // Every buffer there will ever be goes round: empty to the reader, filled to the packer.
    let (to_fill, empty) = bounded(block + AHEAD);
    for _ in 0..block + AHEAD {
        let _ = to_fill.send(Gaussians::zeros(0, sh_degree));
    }
    let (filled, arrived) = bounded(AHEAD);
    // Not joined on failure: it may wait for a program that writes nothing more, and ends at its next frame.
    let reader = thread::spawn(move || {
        while let Ok(mut state) = empty.recv() {
            let frame = stream.next_frame(&mut state).map(|time| time.map(|time| (time, state)));
            let last = !matches!(frame, Ok(Some(_)));
            if filled.send(frame).is_err() || last {
                break;
            }
        }
        stream.received()
    });
    for frame in &arrived {
        let Some((time, state)) = frame? else { break };
        held.push(time, state);
        progress.advance(1);
        if held.len() == block {
            for state in put(&mut held)? {
                let _ = to_fill.send(state);
            }
        }
    }
    if !held.is_empty() {
        put(&mut held)?;
    }
    writer.finish()?;
    reader.join().map_err(|_| Error::usage("the thread that reads standard input failed"))
}

/// Frames that are held together, which the container's tiles are made of: as many as fit [`HELD_BYTES`], from 1
/// to [`FRAME_BLOCK`]. The header alone decides, so that the bytes of the container depend on nothing else.
fn frame_block(header: &StreamHeader) -> usize {
    (HELD_BYTES / header.frame_bytes().max(1)).clamp(1, FRAME_BLOCK as u64) as usize
}

fn to_scratch(
    stream: FrameStream<impl Read + Send + 'static>,
    options: &InputOptions,
    take: impl FnMut(&HeldFrames) -> Result<()>,
) -> Result<Streamed> {
    let folder = options.scratch.clone().unwrap_or_else(std::env::temp_dir);
    let scratch = ScratchFile::new(&folder)?;
    let received = pack_stream(stream, scratch.path(), COMPRESSION, take)?;
    let container = Container::open(scratch.path())?;
    Ok(Streamed { container, received, _scratch: scratch })
}

/// A virtual rig around the first of the frames.
fn rig_around(held: &HeldFrames) -> Rig {
    let bounds = RobustBox::of(held.position(0));
    cameras::virtual_rig(bounds.middle, bounds.extent())
}

/// Statistics of the frames so far.
struct Measuring<'a> {
    plan: &'a ScanPlan,
    cameras: &'a [Camera],
    assumed: AssumedTimes<'a>,
    /// For every frame its (view number, camera index) pairs, as assumed.
    frames: Vec<Vec<(u32, u32)>>,
    scan: RunningScan<'a>,
    looking: Option<(Sampler, Looking)>,
}

impl<'a> Measuring<'a> {
    fn new(
        count: usize,
        rig: &'a Rig,
        split: Option<Split>,
        plan: &'a ScanPlan,
        scan: &recipe::Scan,
        looking: Option<Looking>,
    ) -> Self {
        Measuring {
            plan,
            cameras: &rig.cameras,
            assumed: AssumedTimes::new(rig, split),
            frames: Vec::new(),
            scan: RunningScan::new(count, plan),
            looking: looking.map(|looking| (Sampler::new(scan), looking)),
        }
    }

    fn add(&mut self, held: &HeldFrames) -> Result<()> {
        let first = self.frames.len();
        self.frames.extend(held.info().times.iter().map(|&time| self.assumed.at(time)));
        let new = &self.frames[first..];
        let cameras: Vec<Vec<&Camera>> =
            new.iter().map(|views| views.iter().map(|&(_, camera)| &self.cameras[camera as usize]).collect()).collect();
        self.scan.add(held, &cameras)?;
        if let Some((sampler, looking)) = &mut self.looking {
            let taken = new.iter().map(|views| sampler.next(views, self.cameras)).enumerate();
            let pictures: Vec<(usize, Vec<&Camera>)> = taken.filter(|(_, cameras)| !cameras.is_empty()).collect();
            looking.add(held, &pictures, |_| ())?;
        }
        Ok(())
    }

    /// What was assumed wrongly, if anything was.
    fn wrong(&self, complete: &ScanPlan, scene: &Scene) -> Option<&'static str> {
        if !complete.finishes(self.plan) {
            return Some("the frames are not evenly spaced in time");
        }
        (self.frames != scene.schedule.frames).then_some("the cameras' times are not exactly those of the frames")
    }

    fn finish(self, complete: &ScanPlan) -> Measured {
        Measured { scanned: self.scan.finish(complete), seen: self.looking.map(|(_, looking)| looking.finish()) }
    }
}

/// Which cameras see a frame, while the other frames are unknown: those whose pictures were taken at its very
/// time, and those without a time.
struct AssumedTimes<'a> {
    rig: &'a Rig,
    /// Places in the rig of the pictures of the split, by time, then place.
    timed: Vec<(f64, usize)>,
    timeless: Vec<usize>,
    tolerance: f64,
}

impl<'a> AssumedTimes<'a> {
    fn new(rig: &'a Rig, split: Option<Split>) -> Self {
        let (mut timed, mut timeless) = (Vec::new(), Vec::new());
        for (place, shot) in rig.shots.iter().enumerate() {
            if split.is_none_or(|split| split == shot.split) {
                match shot.time {
                    Some(time) => timed.push((time, place)),
                    None => timeless.push(place),
                }
            }
        }
        timed.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        AssumedTimes { rig, timed, timeless, tolerance: rig.time_tolerance() }
    }

    /// (View number, camera index) of the cameras that see a frame at `time`, in the order of the rig.
    fn at(&self, time: f64) -> Vec<(u32, u32)> {
        let near = self.timed.partition_point(|&(other, _)| other < time - self.tolerance);
        let near = self.timed[near..].iter().take_while(|&&(other, _)| other <= time + self.tolerance);
        let mut places: Vec<usize> = near.map(|&(_, place)| place).chain(self.timeless.iter().copied()).collect();
        places.sort_unstable();
        places.iter().map(|&place| (self.rig.shots[place].view, self.rig.shots[place].camera)).collect()
    }
}

/// Folder for scratch files of a run that writes `output`: where the result goes there is room for its input.
pub fn scratch_beside(output: &Path) -> Option<PathBuf> {
    let parent = output.parent()?;
    Some(if parent.as_os_str().is_empty() { PathBuf::from(".") } else { parent.to_owned() })
}
