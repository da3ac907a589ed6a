//! Frames in PLY files: a folder with one file per frame, or a single file. If the files do not tell which Gaussian is
//! which in other frames, the frames are [linked](super::linked).
//!
//! Output files keep the properties, comments and names of the input files.

use std::fs;
use std::path::Path;

use rayon::prelude::*;

use super::archive::files::add_cloud;
use super::linked::UnlinkedFrames;
use super::size::{ModelSize, file_bytes};
use super::trajectories::{merged, state_bytes, write_trajectories};
use crate::archive::ArchiveContent;
use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::files::names::shown_name;
use crate::files::ply::write::{rows_of_model, write_like_template};
use crate::files::ply_frames::PlyFrames;
use crate::files::ply_sequence::PlySequence;
use crate::limits::Limits;
use crate::model::{Attributes, Gaussians};
use crate::models::input_model::{InputModel, LinkMode, MemoryProfile, ModelDescription, OpenOptions};
use crate::models::opened::{InputFormat, Opened};
use crate::outputs::container::GAUSSIAN_BLOCK;
use crate::outputs::kind::OutputKind;
use crate::passes::{FramesInMemory, gather_all};
use crate::progress::Events;
use crate::source::{FrameSource, Ids};
use crate::tracking::{OrderDifference, compare_order};

/// Format of frames in PLY files: recognizes and opens a folder with one PLY file per frame.
pub(super) const FOLDER: InputFormat = InputFormat {
    recognizes: |found| found.is_folder && has_ply(found.path),
    open: |path, options| {
        let by = if options.allow_gaps { PlyFrames::open_with_gaps } else { PlyFrames::open };
        open_frames(by(path, &options.ply())?, path, options)
    },
};

/// Returns whether `folder` holds an entry whose name ends in `.ply`. Also returns true if the folder cannot be listed;
/// opening it then reports the error.
fn has_ply(folder: &Path) -> bool {
    let is_ply = |path: &Path| path.extension().is_some_and(|found| found.eq_ignore_ascii_case("ply"));
    fs::read_dir(folder)
        .map_or(true, |mut entries| entries.any(|entry| entry.map_or(true, |entry| is_ply(&entry.path()))))
}

/// Model format of a single PLY file: recognizes and opens the file, which becomes the only frame.
pub(super) const FILE: InputFormat = InputFormat {
    recognizes: |found| found.is_file_of(b"ply", "ply"),
    open: |path, options| {
        options.refuse_for(path)?;
        Ok(Opened::from_model(PlySequence::open_single(path, &options.ply())?))
    },
};

/// Opens the PLY frames `frames`, which were found at `path`. They have to be linked (their Gaussians matched between
/// frames) if `options` request this, or if the same index does not mean the same Gaussian in all frames.
pub(super) fn open_frames(frames: PlyFrames, path: &Path, options: &OpenOptions) -> Result<Opened> {
    options.refuse_for(path)?;
    let order = match options.link {
        _ if frames.paths().len() == 1 => FrameOrder::Assumed,
        link if link.links_frames_always() => FrameOrder::Lost(LinkMode::REQUESTED.to_owned()),
        LinkMode::Auto => measure_order(&frames)?,
        _ => FrameOrder::Assumed,
    };
    Ok(match order {
        FrameOrder::Assumed => Opened::from_model(PlySequence::new(frames)?),
        FrameOrder::Confirmed(note) => Opened::from_model(PlySequence::new(frames)?.with_note(note)),
        FrameOrder::Lost(why) => Opened::Unlinked(Box::new(UnlinkedFrames::from_files(frames, path, why, options))),
    })
}

/// Maximum number of pairs of neighboring frames that are compared to find whether their Gaussians have a common order.
const MAX_MEASURED_PAIRS: usize = 5;

/// Whether the same index means the same Gaussian in every frame.
enum FrameOrder {
    /// The same index is assumed to mean the same Gaussian in every frame. Frames were not compared.
    Assumed,
    /// A comparison of frames showed that the same index means the same Gaussian. Holds a note for the user with the
    /// measured differences.
    Confirmed(String),
    /// The same index does not mean the same Gaussian in every frame. Holds the reason, for messages.
    Lost(String),
}

/// Measures whether the same index means the same Gaussian in every frame. At most five evenly spread pairs of
/// neighboring frames are compared; the index must identify Gaussians in at least half of them.
///
/// Frames with different numbers of Gaussians have no common order.
fn measure_order(frames: &PlyFrames) -> Result<FrameOrder> {
    if let Some(other) = frames.first_differing_frame() {
        let (counts, name) = (frames.gaussian_counts(), shown_name(&frames.shown_paths()[other]));
        return Ok(FrameOrder::Lost(format!("{name} has {} Gaussians, the first frame {}", counts[other], counts[0])));
    }
    let pairs = frames.paths().len() - 1;
    let mut found = Vec::new();
    for k in 0..pairs.min(MAX_MEASURED_PAIRS) {
        let first = k * pairs / pairs.min(MAX_MEASURED_PAIRS);
        let state = |frame: usize| -> Result<Gaussians> {
            let mut state = Gaussians::zeros(0, frames.sh_degree());
            frames.frame(frame)?.gather_range(
                0..frames.gaussian_counts()[frame] as usize,
                Attributes::all(),
                &mut state,
            )?;
            Ok(state)
        };
        found.push(compare_order(&state(first)?, &state(first + 1)?));
    }
    let lost = found.iter().filter(|identity| !identity.is_common).count();
    let is_lost = 2 * lost > found.len();
    let Some(OrderDifference {
        position_difference: moved,
        unrelated_position_difference: apart,
        appearance_difference: unlike,
        unrelated_appearance_difference: strangers,
        ..
    }) = found.iter().find(|found| found.is_common != is_lost)
    else {
        return Ok(FrameOrder::Assumed);
    };
    let apart = format!("({moved:.1} vs. {apart:.1} sizes)");
    Ok(match is_lost {
        true => FrameOrder::Lost(format!(
            "Gaussians of the same index are as far apart as unrelated ones {apart} or as different in appearance \
             ({unlike:.2} vs. {strangers:.2})"
        )),
        false => FrameOrder::Confirmed(format!(
            "frames have a common order: Gaussians of the same index are nearer than unrelated ones {apart} and more \
             alike in appearance ({unlike:.2} vs. {strangers:.2})"
        )),
    })
}

impl InputModel for PlySequence {
    fn description(&self) -> ModelDescription {
        ModelDescription {
            kind: "PLY frames",
            notes: self.notes().to_vec(),
            has_explicit_frames: true,
            archives_as_frames: self.paths().len() > 1,
            ..ModelDescription::default()
        }
    }

    fn source(&self) -> &dyn FrameSource {
        self
    }

    fn digest(&self) -> Result<String> {
        PlySequence::digest(self)
    }

    fn size(&self) -> Result<ModelSize> {
        Ok(ModelSize::from_frames(file_bytes(self.paths())?))
    }

    fn memory_profile(&self) -> MemoryProfile {
        MemoryProfile {
            reader: 4,
            // Besides its attributes, a Gaussian has normals and other extra properties in the file: about 24 bytes.
            file: state_bytes(self.info().sh_degree, Attributes::all()) + 24,
            gaussian_block: GAUSSIAN_BLOCK as u64,
            seconds_per_state: 1e-7,
            ..MemoryProfile::default()
        }
    }

    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        Ok(Box::new(PlySequence::with_times(*self, times)?))
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        let mut content = ArchiveContent { times: [0.0, 1.0], ..ArchiveContent::default() };
        content.cloud = gather_all(&*self.compressed_frames(compressed)?, 0, Attributes::all())?;
        add_cloud(&mut content, &self.frame(0)?, compressed.kept.iter().copied())?;
        Ok(content)
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        let (count, degree) = (content.cloud.len(), content.cloud.sh_degree());
        let mut frames = FramesInMemory::new(count, degree, Attributes::empty(), content.cloud.clone());
        self.info().times.iter().for_each(|&time| frames.push(time, Gaussians::zeros(0, degree)));
        Ok(Box::new(frames))
    }

    fn write(
        &self,
        compressed: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        match kind {
            OutputKind::Ply | OutputKind::PlySequence => {
                write_files(self, compressed, (kind, path), events).map(|()| Vec::new())
            }
            _ => write_trajectories(self, compressed, kind, path, limits, events),
        }
    }
}

/// Writes the frames of `compressed`, the compressed model of `sequence`, as PLY files with the properties, comments
/// and names of the input files. `path` is the folder of these files if `kind` is [`OutputKind::PlySequence`];
/// otherwise it is the only file.
fn write_files(
    sequence: &PlySequence,
    compressed: &CompressedModel,
    (kind, path): (OutputKind, &Path),
    events: &Events,
) -> Result<()> {
    let result = merged(sequence, compressed);
    let places: Vec<u32> = compressed.clusters.iter().map(|cluster| cluster.output).collect();
    let rows = rows_of_model(compressed);
    let progress = events.task("emit", "frames", sequence.paths().len() as u64);
    let write = |&frame: &usize| {
        let mut proxies = Gaussians::zeros(0, sequence.info().sh_degree);
        result.open(Ids::List(&places))?.read(frame, Attributes::all(), &mut proxies)?;
        let template = sequence.frame(frame)?;
        let target = match (kind, template.path().file_name()) {
            (OutputKind::PlySequence, Some(name)) => path.join(name),
            _ => path.to_owned(),
        };
        let change = compressed.delta_at(frame, sequence.paths().len());
        write_like_template(&template, &rows, &proxies, &change, compressed.sh_degree, &target)?;
        progress.advance(1);
        Ok(())
    };
    // Frames are written in batches: while a thread waits for proxies, it would otherwise begin another frame.
    let all: Vec<usize> = (0..sequence.paths().len()).collect();
    all.chunks(rayon::current_num_threads()).try_for_each(|batch| batch.par_iter().try_for_each(write))
}
