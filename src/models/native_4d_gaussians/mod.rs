//! 4D Gaussian Splatting in its native form (fudan-zvg) as a model format: four-dimensional Gaussians in a training
//! checkpoint.
//!
//! Input: a folder with `chkpnt<K>.pth` or `chkpnt_best.pth`, or such a file. It holds `(capture, iteration)`, where
//! the capture is a tuple of 19 values (4D model) or 12 values (static model). Output: the same checkpoint with fewer
//! Gaussians, including optimizer state, `cfg_args`, and the training configuration if it exists. Settings of the
//! training that the files do not record can be given as [`TrainingConventions`].

mod configuration;
mod frame_state;
mod proxies;
mod rotation;

use std::path::Path;

use xxhash_rust::xxh3::Xxh3;

use super::in_checkpoint::still::Still;
use super::in_checkpoint::{
    CheckpointFile, CheckpointModel, CheckpointReader, NumberedFiles, ProxyRule, RowElement, numbered_files, row_count,
};
use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::files::checkpoint::{Checkpoint, Node, NodeId, Pickle};
use crate::limits::ReadLimit;
use crate::model::{Attributes, StoredParams, sh_coefficient_count};
use crate::models::input_model::{ModelDescription, OpenOptions, TrainingConventions};
use crate::models::motion_model::MotionModelFrames;
use crate::models::opened::{InputFormat, Opened};
use crate::recipe::MergeParams;
use configuration::TrainingConfig;
use frame_state::{Native, ROTATION_R, SCALING_T, TERM_WIDTH, TERMS, TIME};

/// Number of values in the capture tuple (training state in a checkpoint) of a 4D model.
const CAPTURE_LENGTH_4D: usize = 19;
/// Number of values in the capture tuple (training state in a checkpoint) of a static model.
const CAPTURE_LENGTH_STATIC: usize = 12;

/// Model format of 4D Gaussian Splatting in its native form: recognizes and opens a training checkpoint, or the model
/// folder that contains it.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| match found.is_folder {
        // Other formats also save checkpoints beside a folder `point_cloud`, so the capture must be that of a 4D model.
        true if found.path.join("point_cloud").is_dir() => {
            checkpoints(found.path).iter().any(|(_, path)| has_capture(path, &[CAPTURE_LENGTH_4D], found.memory))
        }
        true => !checkpoints(found.path).is_empty(),
        false => {
            found.is_checkpoint() && has_capture(found.path, &[CAPTURE_LENGTH_4D, CAPTURE_LENGTH_STATIC], found.memory)
        }
    },
    open,
};

/// Returns the paths of the checkpoints in `folder` with their training iterations: the best one if it exists, then those
/// of numbered iterations, last one first.
fn checkpoints(folder: &Path) -> NumberedFiles {
    let best = Some((None, folder.join("chkpnt_best.pth"))).filter(|(_, path)| path.is_file());
    best.into_iter().chain(numbered_files(folder, "chkpnt", ".pth")).collect()
}

/// Returns whether the checkpoint at `path` is a pair: a capture tuple (the saved training state) and an iteration
/// number. The number of values in the capture tuple must be one of `lengths`.
fn has_capture(path: &Path, lengths: &[usize], memory: ReadLimit) -> bool {
    let Ok(checkpoint) = Checkpoint::open(path, memory) else { return false };
    let pickle = checkpoint.pickle();
    match pickle.elements(pickle.root()) {
        Some(&[capture, iteration]) => {
            let length = pickle.elements(capture).map(<[_]>::len);
            pickle.int(iteration).is_some() && lengths.iter().any(|&expected| length == Some(expected))
        }
        _ => false,
    }
}

/// Returns the SH degree and the number of stored time-dependent SH terms of a model with `coefficients` SH
/// coefficients per channel; `None` if no model has this number. `is_4d` states that the model is 4D, not static.
fn sh_layout(coefficients: usize, is_4d: bool) -> Option<(usize, usize)> {
    match (coefficients, is_4d) {
        (1 | 4 | 9 | 16, _) => Some((coefficients.isqrt() - 1, 0)),
        // Coefficients beyond the first 16 belong to a basis that renderers no longer read.
        (33, true) => Some((3, 0)),
        (32 | 48, true) => Some((3, coefficients / 16 - 1)),
        _ => None,
    }
}

/// Creates the motion model of a 4D model from the values `capture_values` of its capture tuple, the training state in
/// the checkpoint. `stored_terms` is the number of time-dependent SH terms that the model stores; the motion model uses
/// at most that many. Fails if a value has the wrong type.
fn motion_model(
    checkpoint: &Checkpoint,
    capture_values: &[NodeId],
    config: &TrainingConfig,
    conventions: &TrainingConventions,
    stored_terms: usize,
) -> Result<Native> {
    let pickle = checkpoint.pickle();
    let wrong = |i: usize, name: &str, expected: &str| {
        checkpoint.wrong(&place(i, name), expected, checkpoint.describe(capture_values[i]))
    };
    let Node::Bool(has_4d_rotation) = *pickle.node(capture_values[16]) else {
        return Err(wrong(16, "rot_4d", "True or False"));
    };
    let active = pickle.int(capture_values[18]).ok_or_else(|| wrong(18, "active_sh_degree_t", "a whole number"))?;
    let configured = config.time_duration.as_ref().map(|(length, _)| *length);
    let given_period = conventions.time_duration.or(configured);
    Ok(Native {
        has_4d_rotation,
        flipped: !conventions.rot4d_unflipped,
        prefilter: config.prefilter,
        terms: usize::try_from(active).unwrap_or(0).min(stored_terms),
        given_period,
        period: given_period.unwrap_or(1.0),
    })
}

/// Returns the values of a capture tuple (training state in the checkpoint) that only the training reads: statistics,
/// and the tensors of the optimizer. `capture_values` are all values of the tuple. `is_4d` states that they belong to a
/// 4D model, not to a static one.
fn training_nodes(pickle: &Pickle, capture_values: &[NodeId], is_4d: bool) -> Vec<NodeId> {
    let (optimizer, statistics) = if is_4d { (11, 7..11) } else { (10, 7..10) };
    let mut nodes: Vec<NodeId> = capture_values[statistics].to_vec();
    let states = pickle.item(capture_values[optimizer], "state").and_then(|state| pickle.pairs(state));
    for (_, state) in states.into_iter().flatten() {
        nodes.extend(pickle.items(*state).into_iter().flatten().map(|(_, id)| id));
    }
    nodes
}

/// Returns a text for error messages that identifies value `i`, called `name`, of a capture tuple (training state in
/// the checkpoint).
fn place(i: usize, name: &str) -> String {
    format!("capture[{i}] ({name})")
}

/// Opens a checkpoint as a 4D or a static model.
fn open(path: &Path, options: &OpenOptions) -> Result<Opened> {
    let file = CheckpointFile::find(path, options, checkpoints, "chkpnt<K>.pth", open)?;
    let conventions = options.conventions;
    let checkpoint = Checkpoint::open(&file.file, options.memory)?;
    let pickle = checkpoint.pickle();
    let capture = match pickle.elements(pickle.root()) {
        Some(&[capture, _]) => capture,
        _ => return Err(checkpoint.wrong("data.pkl", "(capture, iteration)", checkpoint.describe(pickle.root()))),
    };
    let capture_values = pickle.elements(capture).unwrap_or_default().to_vec();
    if ![CAPTURE_LENGTH_4D, CAPTURE_LENGTH_STATIC].contains(&capture_values.len()) {
        return Err(checkpoint
            .wrong("capture", "a tuple of 19 values, or of 12 for a static model", checkpoint.describe(capture))
            .hint("export its frames with its own renderer, as PLY files or as a frame stream, and give those"));
    }
    let is_4d = capture_values.len() == CAPTURE_LENGTH_4D;
    let root = file.root.as_deref().or(file.file.parent());
    let config = root.map_or_else(|| Ok(TrainingConfig::default()), TrainingConfig::read)?;
    let part = |i: usize, name: &str| (capture_values[i], place(i, name));
    let (xyz, place) = part(1, "xyz");
    let count = row_count(&checkpoint, xyz, &place)?;
    let (rest, place) = part(3, "features_rest");
    let found = checkpoint.float_tensor(rest, &place)?;
    let coefficients = found.shape.get(1).map_or(0, |rest| rest.saturating_add(1));
    let Some((degree, stored_terms)) = sh_layout(coefficients, is_4d) else {
        let expected = "shape [N, K − 1, 3] with K = 1, 4, 9 or 16, or for 4D models also 32, 33 or 48";
        return Err(checkpoint.wrong(&place, expected, found.describe()));
    };
    let motion_model = match is_4d {
        true => Some(motion_model(&checkpoint, &capture_values, &config, &conventions, stored_terms)?),
        false => None,
    };
    let mut notes = Vec::from_iter(file.note.clone());
    if is_4d && !matches!(pickle.node(capture_values[17]), Node::None) {
        notes.push("the environment map of the model (its sky) is neither rendered nor compared".to_owned());
    }
    if let (Some((length, file)), None, true) = (&config.time_duration, conventions.time_duration, is_4d) {
        notes.push(format!("time_duration = {length} is taken from {file} beside the checkpoint"));
    }
    let training_nodes = training_nodes(pickle, &capture_values, is_4d);
    let terms = motion_model.as_ref().map_or(0, |motion_model| motion_model.terms);
    let own = if is_4d { TERMS + TERM_WIDTH * terms } else { 0 };
    let bands = sh_coefficient_count(degree);
    let mut rest_elements = RowElement::all_of(Attributes::SH, 3, 3 * (bands - 1));
    rest_elements.extend(RowElement::format_specific(TERMS, TERM_WIDTH * terms));
    rest_elements.resize(3 * (coefficients - 1), RowElement::Unread);
    let mut reader = CheckpointReader::new(checkpoint, count, degree, own)?;
    let mut read = |i: usize, name: &str, row: &[usize], planes| {
        let (id, place) = part(i, name);
        reader.read(id, &place, row, planes)
    };
    read(1, "xyz", &[3], RowElement::all_of(Attributes::POSITION, 0, 3))?;
    read(2, "features_dc", &[1, 3], RowElement::all_of(Attributes::SH, 0, 3))?;
    read(3, "features_rest", &[coefficients - 1, 3], rest_elements)?;
    read(4, "scaling", &[3], RowElement::all_of(Attributes::LOG_SCALE, 0, 3))?;
    read(5, "rotation", &[4], RowElement::all_of(Attributes::ROTATION, 0, 4))?;
    read(6, "opacity", &[1], RowElement::all_of(Attributes::OPACITY, 0, 1))?;
    if let Some(motion_model) = &motion_model {
        read(13, "t", &[1], RowElement::format_specific(TIME, 1))?;
        read(14, "scaling_t", &[1], RowElement::format_specific(SCALING_T, 1))?;
        if motion_model.has_4d_rotation {
            read(15, "rotation_r", &[4], RowElement::format_specific(ROTATION_R, 4))?;
        }
    }
    training_nodes.into_iter().for_each(|id| reader.add_training_tensor(id));
    let given_period = motion_model.as_ref().and_then(|motion_model| motion_model.given_period);
    let description = ModelDescription {
        kind: if is_4d { "4D Gaussian Splatting checkpoint" } else { "3D Gaussian Splatting checkpoint" },
        notes,
        duration: given_period.unwrap_or(1.0),
        data_folder: config.source_path,
        background: config.white_background.then_some([1.0; 3]),
        ..ModelDescription::default()
    };
    Ok(match motion_model {
        Some(motion_model) => Opened::from_model(CheckpointModel::new(reader, motion_model, file, 6e-8, description)?),
        None => Opened::from_model(CheckpointModel::new(reader, Still, file, 1e-8, description)?),
    })
}

impl ProxyRule for Native {
    fn propose(model: &MotionModelFrames<Native>, clusters: &[Cluster], rule: &MergeParams) -> Result<StoredParams> {
        proxies::propose(model, clusters, rule)
    }

    fn hash_settings(&self, hash: &mut Xxh3) {
        hash.update(&[u8::from(self.flipped)]);
        hash.update(&self.prefilter.to_le_bytes());
        hash.update(&self.given_period.unwrap_or(0.0).to_le_bytes());
    }

    /// Returns the motion model with the period L of colors for frames at `times`: the given period, else 10 (the
    /// length of the N3V videos) if frames lie beyond time 1, else 1.
    fn for_times(&self, times: &[f64]) -> Option<Native> {
        let beyond = times.iter().any(|&time| time > 1.0);
        let guessed = if beyond { 10.0 } else { 1.0 };
        (self.terms > 0).then(|| Native { period: self.given_period.unwrap_or(guessed), ..self.clone() })
    }

    fn notes(&self) -> Vec<String> {
        if self.terms == 0 || self.given_period.is_some() {
            return Vec::new();
        }
        vec![format!(
            "the model does not store its time_duration: its colors are assumed to repeat every {} (set \
             --time-duration to the value of its training configuration)",
            self.period
        )]
    }
}

#[cfg(test)]
mod tests;
