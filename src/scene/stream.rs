//! Standard input as a scene: what arrives is packed first, then read like any container.

use std::io::{IsTerminal, Stdin};
use std::path::Path;

use super::input::{InputOptions, Opened, load_cameras};
use crate::budget::{Need, Plan, Workload};
use crate::error::{Error, Result};
use crate::families::Residence;
use crate::families::stream::{AHEAD, Streamed, frame_block};
use crate::ingest::frame_stream::{FrameStream, StreamHeader};
use crate::limits::Limits;
use crate::model::{Columns, Rig};
use crate::stats;
use crate::stream::BLOCK;

/// What messages call standard input.
const STANDARD_INPUT: &str = "standard input";

/// Opens standard input as a stream.
///
/// # Errors
/// A terminal; what is no stream; options that only models have.
pub fn open_stream(options: &InputOptions) -> Result<FrameStream<Stdin>> {
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
pub(super) fn open_arriving(options: &InputOptions) -> Result<Opened> {
    let rig = load_cameras(options, options.cameras.as_deref())?;
    let stream = open_stream(options)?;
    check_memory(options, stream.header())?;
    let streamed = Streamed::receive(stream, &options.scratch_folder(), |_| Ok(()))?;
    Ok(Opened { input: Box::new(streamed), rig, notes: Vec::new() })
}

/// Confirms that there is memory to pack a stream.
///
/// # Errors
/// A budget that does not hold the frames that are packed together.
pub fn check_memory(options: &InputOptions, header: &StreamHeader) -> Result<()> {
    let block = frame_block(header);
    let held = (block + AHEAD) as u64;
    let nobody = Rig { cameras: Vec::new(), shots: Vec::new(), background: None, origin: String::new() };
    let work = Workload::of_stream(header, block, &nobody);
    Plan::fit(work, options.memory, |work, limits| vec![receiving(work, limits, held, None)])?;
    Ok(())
}

/// What it takes to pack a stream of which `held` frames are in memory together, and to scan it on the way unless
/// `measuring` is none; if it says so, to look at pictures too.
pub fn receiving(work: &Workload, limits: &Limits, held: u64, measuring: Option<bool>) -> Need {
    let whole = work.state(Columns::all());
    let mut per_gaussian =
        vec![("frames", held * work.state(work.varying)), ("constant columns", whole - work.state(work.varying))];
    let mut fixed = work.writing();
    if let Some(visible) = measuring {
        per_gaussian.push(("accumulators", stats::BYTES_PER_GAUSSIAN as u64));
        fixed.push(("blocks", work.threads * BLOCK as u64 * whole));
        if visible {
            let nothing_held = Workload { input: Residence { frame_block: 0, ..work.input }, ..*work };
            let (more, pictures) = nothing_held.looking(limits, Columns::all().difference(Columns::SH), 12);
            per_gaussian.extend(more);
            fixed.extend(pictures);
        }
    }
    Need { stage: "receive", reads: 0.0, seconds: 0.0, per_gaussian, fixed }
}
