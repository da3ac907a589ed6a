//! 4D Gaussian Splatting in its native form (fudan-zvg): four-dimensional Gaussians in a training checkpoint.
//!
//! Input: a folder with `chkpnt<K>.pth` or `chkpnt_best.pth`, or such a file: `(capture, iteration)`, where the capture
//! is a tuple of 19 (4D) or 12 (static model). Output: the same checkpoint with fewer rows, including optimizer state,
//! `cfg_args` and the training configuration if it is there. Settings of the training that the files do not record can
//! be given as [`Conventions`].

mod configuration;
mod law;
mod proxies;
mod rotation;

use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::Xxh3;

use super::in_checkpoint::still::Still;
use super::in_checkpoint::{About, InCheckpoint, ProxyRule, Reading, RowElement, count_of, numbered};
use crate::compressed_model::Cluster;
use crate::error::{Error, Result};
use crate::files::checkpoint::{Checkpoint, Node, NodeId};
use crate::limits::ReadLimit;
use crate::model::{Columns, Raw, sh_coefficients};
use crate::models::input_model::{InputModel, ModelFormat, OpenOptions};
use crate::models::motion_model::MotionModelFrames;
use crate::recipe::MergeParams;
use configuration::TrainingConfig;
use law::{Native, ROTATION_R, SCALING_T, TERM, TERMS, TIME};

/// Length of the capture tuple of a 4D model.
const MOVING: usize = 19;
/// Length of the capture tuple of a static model.
const STATIC: usize = 12;

/// Checkpoint, or the folder of a model.
pub(super) const ENTRY: ModelFormat = ModelFormat {
    expected: "a 4D Gaussian Splatting checkpoint",
    recognizes: |found| match found.is_folder {
        // Other formats save checkpoints of their own beside a folder `point_cloud`.
        true if found.path.join("point_cloud").is_dir() => {
            checkpoints(found.path).iter().any(|path| captures(path, &[MOVING], found.memory))
        }
        true => !checkpoints(found.path).is_empty(),
        false => found.is_checkpoint() && captures(found.path, &[MOVING, STATIC], found.memory),
    },
    open: |path, options| {
        let about = match path.is_dir() {
            true => {
                let (file, notes) = choose(path, options)?;
                About { root: Some(path.to_owned()), file, notes, ..About::default() }
            }
            false => {
                options.refuse_for(path)?;
                About { file: path.to_owned(), ..About::default() }
            }
        };
        open(about, options)
    },
};

/// Returns the best checkpoint, then those of iterations, last one first.
fn checkpoints(folder: &Path) -> Vec<PathBuf> {
    let best = folder.join("chkpnt_best.pth");
    let by_number = numbered(folder, "chkpnt", ".pth").into_iter().rev().map(|(_, path)| path);
    best.is_file().then_some(best).into_iter().chain(by_number).collect()
}

/// Returns whether the checkpoint at `path` is a pair of a tuple with one of `lengths` and an iteration number.
fn captures(path: &Path, lengths: &[usize], memory: ReadLimit) -> bool {
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

/// Returns the checkpoint of the requested iteration; without a request the best one, or the last. Adds a note if there
/// are several.
fn choose(folder: &Path, options: &OpenOptions) -> Result<(PathBuf, Vec<String>)> {
    let found = checkpoints(folder);
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let names = || found.iter().map(|path| name(path)).collect::<Vec<_>>().join(", ");
    match options.iteration {
        Some(k) => {
            let wanted = format!("chkpnt{k}.pth");
            let file = found.iter().find(|path| name(path) == wanted);
            Ok((file.ok_or_else(|| Error::input(folder, "", wanted, names()))?.clone(), Vec::new()))
        }
        None => {
            let Some(file) = found.first() else {
                return Err(Error::input(folder, "", "a file chkpnt<K>.pth", "none"));
            };
            let note = format!("of {} {} is read (--iteration)", names(), name(file));
            Ok((file.clone(), if found.len() > 1 { vec![note] } else { Vec::new() }))
        }
    }
}

/// Opens a checkpoint as a 4D or a static model.
fn open(about: About, options: &OpenOptions) -> Result<Box<dyn InputModel>> {
    let conventions = options.conventions;
    let checkpoint = Checkpoint::open(&about.file, options.memory)?;
    let pickle = checkpoint.pickle();
    let capture = match pickle.elements(pickle.root()) {
        Some(&[capture, _]) => capture,
        _ => return Err(checkpoint.wrong("data.pkl", "(capture, iteration)", checkpoint.describe(pickle.root()))),
    };
    let parts = pickle.elements(capture).unwrap_or_default().to_vec();
    if ![MOVING, STATIC].contains(&parts.len()) {
        return Err(checkpoint
            .wrong("capture", "a tuple of 19, or of 12 of a static model", checkpoint.describe(capture))
            .hint("write its frames as PLY files or as a frame stream with its own renderer, and give those"));
    }
    let moves = parts.len() == MOVING;
    let root = about.root.as_deref().or(about.file.parent());
    let config = root.map_or_else(|| Ok(TrainingConfig::default()), TrainingConfig::read)?;
    let part = |i: usize, name: &str| (parts[i], format!("capture[{i}] ({name})"));
    let (xyz, place) = part(1, "xyz");
    let count = count_of(&checkpoint, xyz, &place)?;
    let (rest, place) = part(3, "features_rest");
    let found = checkpoint.float_tensor(rest, &place)?;
    let coefficients = found.shape.get(1).map_or(0, |rest| rest.saturating_add(1));
    let (degree, stored) = match (coefficients, moves) {
        (1 | 4 | 9 | 16, _) => (coefficients.isqrt() - 1, 0),
        // Coefficients beyond the first 16 belong to a basis that renderers no longer read.
        (33, true) => (3, 0),
        (32 | 48, true) => (3, coefficients / 16 - 1),
        _ => {
            let expected = "shape [N, K − 1, 3], K one of 1, 4, 9, 16, and in four dimensions 32, 33, 48";
            return Err(checkpoint.wrong(&place, expected, found.describe()));
        }
    };
    let integer = |i: usize, name: &str| {
        let (id, place) = part(i, name);
        pickle.int(id).ok_or_else(|| checkpoint.wrong(&place, "a whole number", checkpoint.describe(id)))
    };
    let law = match moves {
        true => {
            let (id, place) = part(16, "rot_4d");
            let Node::Bool(turns) = *pickle.node(id) else {
                return Err(checkpoint.wrong(&place, "True or False", checkpoint.describe(id)));
            };
            let active = usize::try_from(integer(18, "active_sh_degree_t")?).unwrap_or(0);
            let configured = config.time_duration.as_ref().map(|(length, _)| *length);
            let given = conventions.time_duration.or(configured);
            Some(Native {
                turns,
                flipped: !conventions.rot4d_unflipped,
                prefilter: config.prefilter,
                terms: active.min(stored),
                given,
                period: given.unwrap_or(1.0),
            })
        }
        false => None,
    };
    let mut notes = about.notes.clone();
    if moves && !matches!(pickle.node(parts[17]), Node::None) {
        notes.push("its environment map, the sky behind everything, is neither drawn nor compared".to_owned());
    }
    if let (Some((length, file)), None, true) = (&config.time_duration, conventions.time_duration, moves) {
        notes.push(format!("{file} beside it says that its time_duration is {length}"));
    }
    let (optimizer, beside) = if moves { (11, 7..11) } else { (10, 7..10) };
    let mut of_training: Vec<NodeId> = parts[beside].to_vec();
    let states = pickle.item(parts[optimizer], "state").and_then(|state| pickle.pairs(state));
    for (_, state) in states.into_iter().flatten() {
        of_training.extend(pickle.items(*state).into_iter().flatten().map(|(_, id)| id));
    }
    let own = law.as_ref().map_or(0, |law| TERMS + TERM * law.terms);
    let bands = sh_coefficients(degree);
    let mut of_rest = RowElement::all_of(Columns::SH, 3, 3 * (bands - 1));
    of_rest.extend(RowElement::own(TERMS, TERM * law.as_ref().map_or(0, |law| law.terms)));
    of_rest.resize(3 * (coefficients - 1), RowElement::Unread);
    let mut reading = Reading::new(checkpoint, count, degree, own)?;
    let mut read = |i: usize, name: &str, row: &[usize], planes| {
        let (id, place) = part(i, name);
        reading.read(id, &place, row, planes)
    };
    read(1, "xyz", &[3], RowElement::all_of(Columns::POSITION, 0, 3))?;
    read(2, "features_dc", &[1, 3], RowElement::all_of(Columns::SH, 0, 3))?;
    read(3, "features_rest", &[coefficients - 1, 3], of_rest)?;
    read(4, "scaling", &[3], RowElement::all_of(Columns::LOG_SCALE, 0, 3))?;
    read(5, "rotation", &[4], RowElement::all_of(Columns::ROTATION, 0, 4))?;
    read(6, "opacity", &[1], RowElement::all_of(Columns::OPACITY, 0, 1))?;
    if let Some(law) = &law {
        read(13, "t", &[1], RowElement::own(TIME, 1))?;
        read(14, "scaling_t", &[1], RowElement::own(SCALING_T, 1))?;
        if law.turns {
            read(15, "rotation_r", &[4], RowElement::own(ROTATION_R, 4))?;
        }
    }
    of_training.into_iter().for_each(|id| reading.beside(id));
    let about = About {
        kind: if moves { "4D Gaussian Splatting checkpoint" } else { "3D Gaussian Splatting checkpoint" },
        data_folder: config.source_path,
        white_background: config.white_background,
        seconds_per_state: if moves { 6e-8 } else { 1e-8 },
        notes,
        ..about
    };
    Ok(match law {
        Some(law) => Box::new(InCheckpoint::new(reading, law, about)?),
        None => Box::new(InCheckpoint::new(reading, Still, about)?),
    })
}

impl ProxyRule for Native {
    fn proposed(model: &MotionModelFrames<Native>, clusters: &[Cluster], rule: &MergeParams) -> Result<Raw> {
        proxies::proposed(model, clusters, rule)
    }

    fn follow(&self, hash: &mut Xxh3) {
        hash.update(&[u8::from(self.flipped)]);
        hash.update(&self.prefilter.to_le_bytes());
        hash.update(&self.given.unwrap_or(0.0).to_le_bytes());
    }

    /// Chooses the period L of colors: the given one, else 10 (the length of the N3V videos) if frames lie beyond time
    /// 1, else 1.
    fn at(&self, times: &[f64]) -> Option<Native> {
        let beyond = times.iter().any(|&time| time > 1.0);
        let guessed = if beyond { 10.0 } else { 1.0 };
        (self.terms > 0).then(|| Native { period: self.given.unwrap_or(guessed), ..self.clone() })
    }

    fn notes(&self) -> Vec<String> {
        if self.terms == 0 || self.given.is_some() {
            return Vec::new();
        }
        vec![format!(
            "the model does not say its time_duration: colours are taken to repeat every {} (--time-duration, as in the \
             configuration it was trained with)",
            self.period
        )]
    }

    fn span(&self) -> f64 {
        self.given.unwrap_or(1.0)
    }
}

#[cfg(test)]
mod tests;
