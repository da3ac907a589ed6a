//! File `params.npz` of Dynamic3DGaussians: position, rotation and color of every Gaussian at every frame; scale and
//! opacity constant in time.
//!
//! Arrays, with T frames and N Gaussians: `means3D` [T, N, 3], scene units; `unnorm_rotations` [T, N, 4], quaternions
//! wxyz of any length; `rgb_colors` [T, N, 3], colors independent of direction; `log_scales` [N, 3]; `logit_opacities`
//! [N, 1]; `seg_colors` [N, 3], where a red value above ½ marks the foreground. Other arrays do not affect renders.
//! Source: `load_scene_data` of the authors' visualizer.

use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use crate::files::npz::write::GaussianAxis;
use crate::files::npz::{Floats, Npz, NpzArray};
use crate::model::{Attributes, Gaussians, SequenceInfo, finite_logit, sh_from_color};
use crate::models::archive::reopen::Reopener;
use crate::source::{BlockReader, FrameSource, Ids, ReadCounts, SharedCounter};

/// Name of the array of positions.
pub(super) const MEANS: &str = "means3D";
/// Name of the array of quaternions.
pub(super) const ROTATIONS: &str = "unnorm_rotations";
/// Name of the array of colors.
pub(super) const COLORS: &str = "rgb_colors";
/// Name of the array of log scales.
pub(super) const LOG_SCALES: &str = "log_scales";
/// Name of the array of opacity logits.
pub(super) const OPACITIES: &str = "logit_opacities";
/// Name of the array of segment colors, whose red value tells foreground from background.
const SEGMENTS: &str = "seg_colors";

/// Red value of the segment color above which a Gaussian belongs to the foreground.
const FOREGROUND: f32 = 0.5;

/// Opened `params.npz` file.
#[derive(Debug)]
pub(super) struct Params {
    npz: Npz,
    info: SequenceInfo,
    means: Floats,
    rotations: Floats,
    colors: Floats,
    log_scales: Floats,
    opacities: Floats,
    segments: Option<Floats>,
    states: SharedCounter,
    reopener: Reopener,
}

impl Params {
    /// Opens the file at `path`. Frame i of T frames has the time i / (T − 1). Arrays that are compressed or not f32
    /// are decoded into temporary files in the folder `scratch`. `reopener` serves to open the model again from an
    /// archive.
    ///
    /// # Errors
    /// Fails if the file is not an `.npz` archive, if arrays are missing or have other shapes, or if the model is
    /// static.
    pub(super) fn open(path: &Path, scratch: &Path, reopener: Reopener) -> Result<Params> {
        let npz = Npz::open(path)?;
        let [frames, count] = match npz.entry(MEANS).map(|entry| &entry.shape[..]) {
            Some(&[frames, count, 3]) if frames > 0 => [frames, count],
            Some(&[_, _]) if npz.entry("cam_unnorm_rots").is_some() => {
                return Err(Error::input(path, MEANS, "shape [T, N, 3]", "a static map of SplaTAM")
                    .hint("export it as a PLY in the 3DGS layout, and give that"));
            }
            found => {
                let found = found.map_or("no such array".to_owned(), |shape| format!("{shape:?}"));
                return Err(Error::input(path, MEANS, "shape [T, N, 3], T at least 1", found));
            }
        };
        let shape_text = |shape: &[usize]| format!("shape {shape:?}");
        let has_segments = npz.entry(SEGMENTS).is_some();
        let expected: [(&str, &[usize]); 6] = [
            (MEANS, &[frames, count, 3]),
            (ROTATIONS, &[frames, count, 4]),
            (COLORS, &[frames, count, 3]),
            (LOG_SCALES, &[count, 3]),
            (OPACITIES, &[count, 1]),
            (SEGMENTS, &[count, 3]),
        ];
        let expected = &expected[..if has_segments { 6 } else { 5 }];
        // Check the shapes and types of all arrays before decoding any.
        for &(name, shape) in expected {
            if let Some(entry) = npz.entry(name).filter(|entry| entry.shape != shape) {
                return Err(Error::input(path, name, shape_text(shape), shape_text(&entry.shape))
                    .hint(format!("{MEANS} has {frames} frames of {count} Gaussians: all arrays must")));
            }
        }
        npz.check_floats(&expected.iter().map(|&(name, _)| name).collect::<Vec<_>>())?;
        let floats = |name: &str| npz.floats(name, scratch);
        let segments = has_segments.then(|| floats(SEGMENTS)).transpose()?;
        let varying = Attributes::POSITION | Attributes::ROTATION | Attributes::SH;
        let last = frames.saturating_sub(1).max(1) as f64;
        let info = SequenceInfo {
            count,
            times: (0..frames).map(|frame| frame as f64 / last).collect(),
            sh_degree: 0,
            varying: if frames > 1 { varying } else { Attributes::empty() },
        };
        Ok(Params {
            means: floats(MEANS)?,
            rotations: floats(ROTATIONS)?,
            colors: floats(COLORS)?,
            log_scales: floats(LOG_SCALES)?,
            opacities: floats(OPACITIES)?,
            segments,
            npz,
            info,
            states: SharedCounter::default(),
            reopener,
        })
    }

    /// Returns the model with the same frames at other `times`.
    ///
    /// # Errors
    /// Fails if the number of times is not the number of frames, or if times are not finite or do not increase.
    pub(super) fn with_times(mut self, times: Vec<f64>) -> Result<Params> {
        self.info = self.info.with_times(times)?;
        Ok(self)
    }

    /// Returns the opened file with its arrays.
    pub(super) fn npz(&self) -> &Npz {
        &self.npz
    }

    /// Returns the function and options with which the model was opened, to open it again from an archive.
    pub(super) fn reopener(&self) -> &Reopener {
        &self.reopener
    }

    /// Returns how an archive stores the array `entry`: the axis of the array that counts the Gaussians, and the
    /// attribute that holds the first frame of the array (`None` if no attribute does).
    pub(super) fn archived(entry: &NpzArray) -> (GaussianAxis, Option<Attributes>) {
        let attribute = match entry.name.as_str() {
            MEANS => Some(Attributes::POSITION),
            ROTATIONS => Some(Attributes::ROTATION),
            COLORS => Some(Attributes::SH),
            LOG_SCALES => Some(Attributes::LOG_SCALE),
            OPACITIES => Some(Attributes::OPACITY),
            _ => None,
        };
        (Params::axis(entry), attribute)
    }

    /// Returns the path of the `params.npz` file.
    pub(super) fn path(&self) -> PathBuf {
        self.npz.path().to_owned()
    }

    /// Returns whether Gaussian `id` belongs to the foreground; `None` if the file has no segment colors.
    pub(super) fn is_foreground(&self, id: usize) -> Option<bool> {
        self.segments.as_ref().map(|segments| segments.row::<1>(3 * id)[0] > FOREGROUND)
    }

    /// Returns which axis of the array `entry` counts the Gaussians.
    pub(super) fn axis(entry: &NpzArray) -> GaussianAxis {
        match entry.name.as_str() {
            MEANS | ROTATIONS | COLORS => GaussianAxis::Axis1,
            LOG_SCALES | OPACITIES | SEGMENTS => GaussianAxis::Axis0,
            _ => GaussianAxis::None,
        }
    }
}

impl FrameSource for Params {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        if let Some(id) = ids.iter().find(|&id| id >= self.info.count) {
            return Err(Error::internal(format!("Gaussian {id} was asked for, of {}", self.info.count)));
        }
        Ok(Box::new(TrajectoryBlock { params: self, ids: ids.iter().collect() }))
    }

    fn reads(&self) -> ReadCounts {
        let states = self.states.get();
        ReadCounts { states, ..ReadCounts::default() }
    }
}

/// Reader of the states of the Gaussians `ids` of a `params.npz` file, one frame at a time.
struct TrajectoryBlock<'a> {
    params: &'a Params,
    ids: Vec<usize>,
}

impl BlockReader for TrajectoryBlock<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        let Params { info, means, rotations, colors, log_scales, opacities, states, .. } = self.params;
        if frame >= info.times.len() {
            return Err(Error::internal(format!("frame {frame} was asked for, of {}", info.times.len())));
        }
        means.check()?;
        states.add(self.ids.len() as u64);
        out.selected_attribute_values_mut(want).for_each(|column| column.resize(self.ids.len()));
        for (row, &id) in self.ids.iter().enumerate() {
            let at = frame * info.count + id;
            for column in want.iter() {
                match column {
                    Attributes::POSITION => out.position.set_row(row, means.row::<3>(3 * at)),
                    Attributes::ROTATION => out.rotation.set_row(row, rotations.row::<4>(4 * at)),
                    Attributes::LOG_SCALE => out.log_scale.set_row(row, log_scales.row::<3>(3 * id)),
                    Attributes::OPACITY => out.opacity_logit.set_row(row, opacities.row::<1>(id).map(finite_logit)),
                    _ => out.sh.set_row(row, colors.row::<3>(3 * at).map(|color| sh_from_color(color.into()))),
                }
            }
        }
        let (first, last) = (self.ids.iter().min().copied(), self.ids.iter().max().copied());
        if let (Some(first), Some(last)) = (first, last) {
            for (floats, width, row) in [
                (means, 3, frame * info.count),
                (rotations, 4, frame * info.count),
                (colors, 3, frame * info.count),
                (log_scales, 3, 0),
                (opacities, 1, 0),
            ] {
                floats.touched(width * (row + first)..width * (row + last + 1));
            }
        }
        Ok(())
    }
}
