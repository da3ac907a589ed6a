//! The verbs around containers: pack, info, verify, unpack, recover.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::Path;

use gseq::{Compression, Encoding, Reader, RecoverReport, TileId, VerifyReport};
use serde::Serialize;

use super::arrival::{check_memory, open_stream, pack_stream};
use super::input::{Input, InputOptions, Opened, open_input};
use super::memory::{Plan, Workload, packing, unpacking};
use super::output::{OutputKind, write_sequence};
use super::summary::InputSummary;
use crate::emit::atomic::{Kind, MARKER, StagedFile, StagedFolder, check_target};
use crate::emit::container::write_container;
use crate::emit::frame_stream::StreamWriter;
use crate::error::{Error, Result};
use crate::ingest::container::Container;
use crate::ingest::frame_stream::StreamHeader;
use crate::model::Columns;
use crate::pass::{BlockReader, FrameSource, Ids, Wanted};
use crate::stream::{Frames, Progress};

/// What `pack` wrote.
#[derive(Debug)]
pub struct Packed {
    /// N.
    pub gaussians: usize,
    /// T.
    pub frames: usize,
    /// Size of the container.
    pub bytes: u64,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// Packs any input into a container. That of a stream names no digest of its source, which is known only
/// when the container's header has long been written.
pub fn pack(input: &InputOptions, output: &Path, compression: Compression, overwrite: bool) -> Result<Packed> {
    check_target(output, Kind::File, &[&input.path], overwrite)?;
    if input.is_stream() {
        let staged = StagedFile::new(output, overwrite)?;
        let stream = open_stream(input)?;
        check_memory(input, stream.header())?;
        pack_stream(stream, staged.path(), compression, |_| Ok(()))?;
        let container = Container::open(staged.path())?;
        let (gaussians, frames) = (container.info().count, container.info().times.len());
        let bytes = fs::metadata(staged.path()).map_err(Error::io("read", staged.path()))?.len();
        staged.commit()?;
        return Ok(Packed { gaussians, frames, bytes, notes: Vec::new() });
    }
    let opened = open_input(input)?;
    let source = opened.input.source();
    Plan::fit(Workload::of_input(&opened.input), input.memory, packing)?;
    let staged = StagedFile::new(output, overwrite)?;
    let work = source.info().count as u64 * source.info().times.len() as u64;
    let progress = Progress::new("pack", "Gaussian frames", work);
    let attributes = BTreeMap::from([("source_digest".to_owned(), opened.input.digest()?)]);
    write_container(source, staged.path(), compression, attributes, |done| progress.advance(done))?;
    drop(progress);
    let bytes = fs::metadata(staged.path()).map_err(Error::io("read", staged.path()))?.len();
    staged.commit()?;
    let info = opened.input.source().info();
    Ok(Packed { gaussians: info.count, frames: info.times.len(), bytes, notes: opened.notes })
}

/// Writes any input as a frame stream; gives the input.
///
/// Memory: see [`unpacking`].
pub fn unpack_stream(input: &InputOptions, to: impl Write) -> Result<Opened> {
    let opened = open_input(input)?;
    let source = opened.input.source();
    let info = source.info();
    let header = StreamHeader { count: info.count, sh_degree: info.sh_degree, varying: info.varying };
    let held = Plan::fit(Workload::of_input(&opened.input), input.memory, unpacking)?.limits.frames_held;
    let wanted = Wanted::every().holding(held);
    let mut frames = Frames::open(source, Ids::Range(0..source.info().count), Columns::ALL, &wanted)?;
    let mut state = frames.state();
    if !info.times.is_empty() {
        frames.read(0, Columns::ALL, &mut state)?;
    }
    let progress = Progress::new("unpack", "frames", info.times.len() as u64);
    let mut stream = StreamWriter::new(to, Path::new("standard output"), header, &state)?;
    for (frame, &time) in info.times.iter().enumerate() {
        frames.read(frame, info.varying, &mut state)?;
        stream.frame(time, &state)?;
        progress.advance(1);
    }
    stream.finish()?;
    drop((progress, frames));
    Ok(opened)
}

/// Writes every frame of an input as a PLY file into the folder `output`; gives the input.
pub fn unpack(input: &InputOptions, output: &Path, overwrite: bool) -> Result<Opened> {
    check_target(output, Kind::Folder, &[&input.path], overwrite)?;
    let opened = open_input(input)?;
    let source = opened.input.source();
    Plan::fit(Workload::of_input(&opened.input), input.memory, unpacking)?;
    let staged = StagedFolder::new(output, overwrite)?;
    write_sequence(source, OutputKind::PlySequence, staged.path())?;
    let marker = serde_json::json!({
        "tool": format!("splatsieve {}", env!("CARGO_PKG_VERSION")),
        "input": opened.input.summary(&input.path)?,
    });
    let path = staged.path().join(MARKER);
    fs::write(&path, format!("{marker:#}\n")).map_err(Error::io("write", &path))?;
    staged.commit()?;
    Ok(opened)
}

/// Reads every byte of a container and checks it.
pub fn verify(path: &Path) -> Result<VerifyReport> {
    Ok(Reader::open(path)?.verify()?)
}

/// Saves the complete frames of a container that was cut short.
pub fn recover(input: &Path, output: &Path, overwrite: bool) -> Result<RecoverReport> {
    check_target(output, Kind::File, &[input], overwrite)?;
    let staged = StagedFile::new(output, overwrite)?;
    let report = gseq::recover(input, staged.path())?;
    staged.commit()?;
    Ok(report)
}

/// What an input holds.
#[derive(Debug, Serialize)]
pub struct Info {
    /// The input.
    #[serde(flatten)]
    pub input: InputSummary,
    /// Time stamps of first and last frame; none without frames, or where cameras choose them.
    pub times: Option<(f64, f64)>,
    /// Columns of a container.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub columns: Vec<ColumnInfo>,
}

/// One column of a container.
#[derive(Debug, Serialize)]
pub struct ColumnInfo {
    /// Its name.
    pub name: String,
    /// f32 components per Gaussian.
    pub width: u32,
    /// Number of tiles.
    pub tiles: usize,
    /// Of those, tiles that hold one frame for all.
    pub constant_tiles: usize,
    /// Of those, tiles stored as they are.
    pub raw_tiles: usize,
    /// Bytes stored, of shared tiles once.
    pub stored_bytes: u64,
    /// Bytes of the same values as one f32 per frame, component and Gaussian.
    pub raw_bytes: u64,
    /// Smallest finite value; none if there is no finite value.
    pub min: Option<f32>,
    /// Largest finite value; none if there is no finite value.
    pub max: Option<f32>,
}

/// Looks at an input. Its bytes are read once for the digest, but no frame is evaluated.
pub fn info(options: &InputOptions) -> Result<Info> {
    let input = match options.is_stream() {
        true => open_input(options)?.input,
        false => Input::open(&options.path, options.iteration)?,
    };
    let columns = match &input {
        Input::Container(container) => columns(container.reader())?,
        _ => Vec::new(),
    };
    let times = &input.source().info().times;
    let times = times.first().zip(times.last()).map(|(&first, &last)| (first, last));
    let mut summary = input.summary(&options.path)?;
    if matches!(input, Input::Model(_)) {
        summary.frames = None;
    }
    Ok(Info { input: summary, times, columns })
}

fn columns(reader: &Reader) -> Result<Vec<ColumnInfo>> {
    let layout = reader.layout();
    let mut out = Vec::new();
    for (column, spec) in layout.columns.iter().enumerate() {
        let mut found = ColumnInfo {
            name: spec.name.clone(),
            width: spec.width,
            tiles: 0,
            constant_tiles: 0,
            raw_tiles: 0,
            stored_bytes: 0,
            raw_bytes: 4 * u64::from(spec.width) * layout.gaussians * reader.frames() as u64,
            min: None,
            max: None,
        };
        for gaussian_block in 0..layout.gaussian_blocks() {
            let mut last_offset = None;
            for frame_block in 0..reader.frame_blocks() {
                let tile = reader.tile_info(TileId { column: column as u32, gaussian_block, frame_block })?;
                found.tiles += 1;
                found.constant_tiles += usize::from(tile.constant);
                found.raw_tiles += usize::from(tile.encoding == Encoding::Raw);
                if last_offset != Some(tile.offset) {
                    found.stored_bytes += tile.stored_bytes;
                }
                last_offset = Some(tile.offset);
                if tile.stats.min <= tile.stats.max {
                    found.min = Some(found.min.map_or(tile.stats.min, |min| min.min(tile.stats.min)));
                    found.max = Some(found.max.map_or(tile.stats.max, |max| max.max(tile.stats.max)));
                }
            }
        }
        out.push(found);
    }
    Ok(out)
}

impl Info {
    /// A few lines for a person.
    pub fn text(&self) -> String {
        let input = &self.input;
        let mut out = format!(
            "{}: {}\n  {} Gaussians, SH degree {}, {}\n  varying: {}\n  {} bytes, digest {}\n",
            input.path,
            input.kind,
            input.gaussians,
            input.sh_degree,
            match self.times {
                Some((first, last)) => format!("{} frames from t = {first} to {last}", input.frames.unwrap_or(0)),
                None => match input.frames {
                    Some(_) => "no frames".to_owned(),
                    None => "continuous in time".to_owned(),
                },
            },
            if input.varying.is_empty() { "nothing".to_owned() } else { input.varying.join(", ") },
            input.bytes,
            input.digest,
        );
        for column in &self.columns {
            let range = match (column.min, column.max) {
                (Some(min), Some(max)) => format!("{min} to {max}"),
                _ => "no finite value".to_owned(),
            };
            out += &format!(
                "  {:<14} x{:<3} {:>6} tiles ({} constant, {} raw)  {:>12} bytes of {:>12}  {range}\n",
                column.name,
                column.width,
                column.tiles,
                column.constant_tiles,
                column.raw_tiles,
                column.stored_bytes,
                column.raw_bytes
            );
        }
        out
    }
}
