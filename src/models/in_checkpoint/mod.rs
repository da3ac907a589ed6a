//! Models whose Gaussians are rows of a checkpoint's tensors: what their families share.
//!
//! A result is the same checkpoint with fewer rows, and the small files that lay beside it.

pub(super) mod linear;
mod rows;
pub(super) mod still;

use std::fs;
use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::Xxh3;

use super::files::copy;
use super::size::{Size, bytes_below, bytes_of};
use super::trajectories::{check_output, state_bytes, write_sequence};
use crate::compressed_model::{Cluster, CompressedModel, Proxies, Reference};
use crate::error::{Error, Result};
use crate::files::cameras::Clock;
use crate::files::digest::hash_file;
use crate::limits::Limits;
use crate::model::{Columns, Jacobian, Raw};
use crate::models::input_model::{InputModel, MemoryProfile, Timing};
use crate::models::motion_model;
use crate::models::motion_model::{MotionModel, MotionModelFrames};
use crate::outputs::container::GAUSSIAN_BLOCK;
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::FrameSource;
pub(super) use rows::{Reading, RowElement, RowTensors, count_of};

/// Most bytes of a file beside the checkpoint that a result has too.
const SMALL: u64 = 1 << 20;

/// A law by which several Gaussians become one.
pub(super) trait ProxyRule: MotionModel {
    /// Raw parameters of the proxies of `clusters`, before they are held to what their members do.
    ///
    /// # Errors
    /// Frames that cannot be evaluated.
    fn proposed(model: &MotionModelFrames<Self>, clusters: &[Cluster], rule: &MergeParams) -> Result<Raw>
    where
        Self: Sized;

    /// Adds to `hash` what states follow from that the file does not say.
    fn follow(&self, hash: &mut Xxh3);

    /// The law for frames at `times`, if it depends on them.
    fn at(&self, times: &[f64]) -> Option<Self>
    where
        Self: Sized,
    {
        let _ = times;
        None
    }

    /// Things a person should know of it.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// How long it lasts in its own time.
    fn span(&self) -> f64 {
        1.0
    }
}

/// What is known of a model beside its Gaussians.
#[derive(Debug, Default)]
pub(super) struct About {
    /// What it is, for people.
    pub(super) kind: &'static str,
    /// The folder that was given; none: the file itself was.
    pub(super) root: Option<PathBuf>,
    /// The checkpoint.
    pub(super) file: PathBuf,
    /// Things a person should know.
    pub(super) notes: Vec<String>,
    pub(super) data_folder: Option<String>,
    pub(super) white_background: bool,
    /// Seconds of one processor that a state takes (`benches/families.rs`).
    pub(super) seconds_per_state: f64,
}

/// A model in a checkpoint.
#[derive(Debug)]
pub(super) struct InCheckpoint<L: MotionModel> {
    table: RowTensors,
    model: MotionModelFrames<L>,
    about: About,
}

impl<L: ProxyRule> InCheckpoint<L> {
    /// What was read, whose states follow by `law`.
    pub(super) fn new(reading: Reading, law: L, about: About) -> Result<InCheckpoint<L>> {
        let sh_degree = reading.raw.gaussians.sh_degree();
        let model = MotionModelFrames::new(law, reading.raw, sh_degree);
        let is_still = model.law().varying().is_empty();
        let model = if is_still { model.with_times(vec![0.0])? } else { model };
        Ok(InCheckpoint { table: reading.table, model, about })
    }

    /// Files that a result has too, from the root.
    fn beside(&self) -> Vec<PathBuf> {
        const NAMES: [&str; 2] = ["cfg_args", "cameras.json"];
        let Some(root) = &self.about.root else { return Vec::new() };
        let named = NAMES.iter().map(|name| root.join(name)).filter(|path| is_small(path));
        let mut found: Vec<PathBuf> = named.chain(texts_in(root)).collect();
        found.sort();
        found
    }

    /// Where in a result the checkpoint is.
    fn place(&self) -> PathBuf {
        let root = self.about.root.as_deref().or(self.about.file.parent()).unwrap_or(Path::new(""));
        self.about.file.strip_prefix(root).unwrap_or(&self.about.file).to_owned()
    }

    fn write_model(&self, reduction: &CompressedModel, path: &Path) -> Result<()> {
        for file in self.beside() {
            copy(&file, &path.join(file.file_name().unwrap_or_default()))?;
        }
        let to = path.join(self.place());
        let folder = to.parent().unwrap_or(path);
        fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
        self.table.write(self.model.raw(), &motion_model::left(self.model.raw(), reduction), reduction, &to)
    }
}

impl<L: ProxyRule + 'static> InputModel for InCheckpoint<L> {
    fn kind(&self) -> &'static str {
        self.about.kind
    }

    fn source(&self) -> &dyn FrameSource {
        &self.model
    }

    fn digest(&self) -> Result<String> {
        let mut hash = Xxh3::new();
        hash_file(&self.about.file, &mut hash)?;
        self.model.law().follow(&mut hash);
        Ok(format!("{:032x}", hash.digest128()))
    }

    fn bytes(&self) -> Result<u64> {
        Ok(self.size()?.whole())
    }

    fn size(&self) -> Result<Size> {
        let rest = bytes_of(self.beside().iter().map(PathBuf::as_path))?;
        Ok(Size { cloud: bytes_of([&*self.about.file])?, rest, ..Size::default() })
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<Size> {
        match kind {
            OutputKind::Model => {
                let cloud = bytes_of([&*path.join(self.place())])?;
                Ok(Size { cloud, rest: bytes_below(path)?.saturating_sub(cloud), ..Size::default() })
            }
            _ => Ok(Size::of_frames(bytes_below(path)?)),
        }
    }

    fn residence(&self) -> MemoryProfile {
        let raw = self.model.raw();
        let whole = state_bytes(raw.gaussians.sh_degree(), Columns::all()) + 4 * raw.own.width() as u64;
        MemoryProfile {
            per_gaussian: whole,
            // The widest tensor, as it is stored and as f32.
            opening: 2 * whole,
            // The parameters again, and what is prepared of them.
            reader: whole + 128,
            reduced: 2 * whole,
            jacobian: Jacobian::BYTES_PER_GAUSSIAN as u64,
            // Training keeps two values more for each.
            file: 3 * whole,
            fixed: 0,
            frame_block: 0,
            gaussian_block: GAUSSIAN_BLOCK as u64,
            columns: 0,
            seconds_per_state: self.about.seconds_per_state,
            decoded: 0,
        }
    }

    fn timing(&self) -> Timing {
        if self.model.law().varying().is_empty() { Timing::Numbered } else { Timing::Continuous }
    }

    fn clock(&self) -> Clock {
        Clock::Given
    }

    fn span(&self) -> f64 {
        self.model.law().span()
    }

    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        let InCheckpoint { table, model, about } = *self;
        let found = model.info().times.len();
        if !model.info().times.is_empty() && model.law().varying().is_empty() && times.len() != found {
            return Err(Error::usage(format!("{} times were given for {found} frames", times.len())));
        }
        let model = match model.law().at(&times) {
            Some(law) => MotionModelFrames::new(law, model.raw().clone(), model.info().sh_degree),
            None => model,
        };
        Ok(Box::new(InCheckpoint { table, model: model.with_times(times)?, about }))
    }

    fn notes(&self) -> Vec<String> {
        self.about.notes.iter().cloned().chain(self.model.law().notes()).collect()
    }

    fn data_folder(&self) -> Option<&str> {
        self.about.data_folder.as_deref()
    }

    fn background(&self) -> Option<[f32; 3]> {
        self.about.white_background.then_some([1.0; 3])
    }

    fn own_output(&self) -> OutputKind {
        OutputKind::Model
    }

    fn check_output(&self, kind: OutputKind, path: &Path) -> Result<()> {
        match kind {
            OutputKind::Model => Ok(()),
            _ => check_output(self.model.info().times.len(), kind, path),
        }
    }

    fn needs_all_bands(&self) -> Option<&'static str> {
        Some("the checkpoint's own loaders expect them")
    }

    fn solve(&self, clusters: &[Cluster], reference: Reference, rule: &MergeParams) -> Result<Proxies> {
        motion_model::solve(&self.model, clusters, reference, rule, |clusters| L::proposed(&self.model, clusters, rule))
    }

    fn reduced<'a>(&'a self, reduction: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        Ok(Box::new(self.model.reduced(reduction)))
    }

    fn write(
        &self,
        reduction: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        match kind {
            OutputKind::Model => self.write_model(reduction, path).map(|()| Vec::new()),
            _ => write_sequence(&*self.reduced(reduction)?, kind, path, limits.frames_held, events),
        }
    }
}

fn is_small(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|found| found.is_file() && found.len() <= SMALL)
}

/// Small YAML files of a folder, by name.
pub(super) fn texts_in(root: &Path) -> Vec<PathBuf> {
    let is_one = |path: &Path| {
        path.extension().is_some_and(|found| ["yaml", "yml"].iter().any(|ending| found == *ending)) && is_small(path)
    };
    let entries = fs::read_dir(root).into_iter().flatten().flatten();
    let mut found: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(|path| is_one(path)).collect();
    found.sort();
    found
}

/// The files of a folder called `<prefix><number><suffix>`, by number.
pub(super) fn numbered(folder: &Path, prefix: &str, suffix: &str) -> Vec<(u32, PathBuf)> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let number = |name: &str| name.strip_prefix(prefix)?.strip_suffix(suffix)?.parse::<u32>().ok();
    let mut found: Vec<(u32, PathBuf)> =
        entries.filter_map(|entry| Some((number(entry.file_name().to_str()?)?, entry.path()))).collect();
    found.sort();
    found
}
