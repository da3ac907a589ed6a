//! The deformation field: features, trunk, heads, and how their deltas change raw parameters.
//!
//! Data in: tensors of a state dict, canonical positions, a time. Data out: deltas and masks per
//! Gaussian. Memory: the tensors, [`Field::bytes_per_gaussian`] per prepared Gaussian, and about
//! 4·LANES·(features + trunk + heads) bytes of scratch per reader.
//! Source: Wu et al., "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering", 2024, and the
//! behavior of its public renderer.

use std::path::Path;

use splat_core::error::{Error, Result};
use splat_core::{Column, Columns, Gaussians};

use super::deltas::Deltas;
use super::linear::{CacheLine, LANES, Linear};
use super::planes::{Planes, PreparedPlanes, TimeLines};
use super::tensors::{Lookup, Tensors};
use super::voxel::VoxelMask;

/// What of a model's hyper-parameters decides the evaluation and cannot be told from tensor shapes.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldConfig {
    /// Columns whose heads are on (`no_dx`, `no_ds`, `no_dr`, `no_do`, `no_dshs` are off).
    pub active: Columns,
    /// A head of the hidden features gives the mask; takes precedence over `empty_voxel`.
    pub static_mlp: bool,
    /// A voxel grid gives the mask.
    pub empty_voxel: bool,
    /// Above 1: features become `[f, sin(p·f), cos(p·f)]` with p this number.
    pub grid_pe: i64,
    /// The trunk reads `[x, y, z, t]` instead of plane features.
    pub no_grid: bool,
    /// The rotation delta multiplies the quaternion instead of being added.
    pub apply_rotation: bool,
}

#[derive(Debug, Clone)]
pub(super) enum Mask {
    None,
    /// The last head, of the hidden features: varies with time.
    Head,
    /// Constant in time.
    Voxel(VoxelMask),
}

/// One head: hidden layer, ReLU, output layer, on top of the trunk's ReLU.
#[derive(Debug, Clone)]
pub(super) struct Head {
    /// The column it deforms; none for the mask of `static_mlp`.
    pub(super) column: Option<Columns>,
    pub(super) hidden: Linear,
    pub(super) output: Linear,
}

/// A 4DGaussians deformation field. Evaluates any block of Gaussians at any time; the result of a
/// Gaussian has the same bits whatever block it is evaluated in.
#[derive(Debug, Clone)]
pub struct Field {
    pub(super) config: FieldConfig,
    /// None when the trunk reads positions.
    pub(super) planes: Option<Planes>,
    pub(super) trunk: Vec<Linear>,
    pub(super) heads: Vec<Head>,
    pub(super) mask: Mask,
}

/// What does not depend on time for one block of Gaussians.
#[derive(Debug, Clone)]
pub struct Prepared {
    rows: usize,
    input: PreparedInput,
    /// Mask of `empty_voxel`.
    voxel: Option<Vec<f32>>,
}

#[derive(Debug, Clone)]
enum PreparedInput {
    Planes(PreparedPlanes),
    Position(Column),
}

/// Reusable activations of one reader.
#[derive(Debug, Clone, Default)]
pub struct Scratch {
    features: Vec<CacheLine>,
    trunk: [Vec<CacheLine>; 2],
    hidden: Vec<CacheLine>,
}

/// Name of a column's head in the state dict and its flag in `cfg_args`.
fn head_name(column: Columns) -> (&'static str, &'static str) {
    match column {
        Columns::POSITION => ("pos_deform", "no_dx=False"),
        Columns::LOG_SCALE => ("scales_deform", "no_ds=False"),
        Columns::ROTATION => ("rotations_deform", "no_dr=False"),
        Columns::OPACITY => ("opacity_deform", "no_do=False"),
        _ => ("shs_deform", "no_dshs=False"),
    }
}

impl Field {
    /// Builds the field from the state dict read from `path`, for a cloud of `sh_degree`.
    ///
    /// Depth, widths, levels and resolutions follow from the tensors' shapes. Tensors the evaluation
    /// does not use (`timenet.*`, `*_poc`, heads that are off) are ignored.
    ///
    /// # Errors
    /// A tensor that is missing, of the wrong shape, or not finite; the error names it.
    pub fn new(tensors: &Tensors, config: FieldConfig, sh_degree: usize, path: &Path) -> Result<Self> {
        let lookup = Lookup { tensors, path };
        let planes = if config.no_grid { None } else { Some(Planes::load(lookup)?) };
        let inputs = match &planes {
            None => 4,
            Some(planes) if config.grid_pe > 1 => 3 * planes.width(),
            Some(planes) => planes.width(),
        };
        let layer = |i: usize| format!("deformation_net.feature_out.{}", 2 * i);
        let mut trunk = vec![Linear::load(lookup, &layer(0), inputs, None, "the features it reads")?];
        let width = trunk[0].outputs;
        while lookup.has(&format!("{}.weight", layer(trunk.len()))) {
            trunk.push(Linear::load(lookup, &layer(trunk.len()), width, Some(width), "the width of the network")?);
        }

        let shape = Gaussians::zeros(0, sh_degree);
        let mut wanted: Vec<_> = config
            .active
            .iter()
            .map(|column| (Some(column), head_name(column), shape.column(column).width()))
            .collect();
        let mask = if config.static_mlp {
            wanted.push((None, ("static_mlp", "static_mlp=True"), 1));
            Mask::Head
        } else if config.empty_voxel {
            Mask::Voxel(VoxelMask::load(lookup, planes.as_ref().map(Planes::corners))?)
        } else {
            Mask::None
        };
        let mut heads = Vec::new();
        for (column, (name, why), outputs) in wanted {
            let name = format!("deformation_net.{name}");
            let hidden = Linear::load(lookup, &format!("{name}.1"), width, Some(width), why)?;
            let output = Linear::load(lookup, &format!("{name}.3"), width, Some(outputs), why)?;
            heads.push(Head { column, hidden, output });
        }
        Ok(Field { config, planes, trunk, heads, mask })
    }

    /// Columns that change with time.
    pub fn active(&self) -> Columns {
        self.config.active
    }

    /// Whether a mask multiplies what is stored.
    pub fn has_mask(&self) -> bool {
        !matches!(self.mask, Mask::None)
    }

    /// The hyper-parameters the field was built with.
    pub fn config(&self) -> &FieldConfig {
        &self.config
    }

    /// Bytes one Gaussian takes in [`Prepared`].
    pub fn bytes_per_gaussian(&self) -> usize {
        let input = self.planes.as_ref().map_or(12, Planes::bytes_per_gaussian);
        input + if matches!(self.mask, Mask::Voxel(_)) { 4 } else { 0 }
    }

    /// Multiplications by weights that a Gaussian takes at one time.
    pub fn multiplications(&self) -> usize {
        let heads = self.heads.iter().flat_map(|head| [&head.hidden, &head.output]);
        self.trunk.iter().chain(heads).map(Linear::multiplications).sum()
    }

    /// Computes what does not depend on time for Gaussians at canonical `position` `[N, 3]`.
    pub fn prepare(&self, position: &Column) -> Prepared {
        Prepared {
            rows: position.len(),
            input: match &self.planes {
                Some(planes) => PreparedInput::Planes(planes.prepare(position)),
                None => PreparedInput::Position(position.clone()),
            },
            voxel: match &self.mask {
                Mask::Voxel(voxel) => Some(voxel.sample(position)),
                _ => None,
            },
        }
    }

    /// Deltas and masks at `time` of the prepared block, for the active columns among `want`; other
    /// columns of `out` are left alone. `time` is used as it is, clamped to [−1, 1] by the planes.
    ///
    /// # Errors
    /// A time that is not finite, or `out` of another SH degree than the field was built for.
    pub fn deltas(
        &self,
        prepared: &Prepared,
        time: f64,
        want: Columns,
        scratch: &mut Scratch,
        out: &mut Deltas,
    ) -> Result<()> {
        if !time.is_finite() {
            return Err(Error::internal(format!("a deformation field has no state at time {time}")));
        }
        let want = want & self.config.active;
        if let Some(head) = self.heads.iter().find(|head| {
            head.column.is_some_and(|c| want.contains(c) && out.delta.column(c).width() != head.output.outputs)
        }) {
            let name = head.column.map_or("mask", Columns::name);
            return Err(Error::internal(format!("the field deforms {} values of {name}", head.output.outputs)));
        }
        out.begin(prepared.rows, want, self.config.apply_rotation);
        let masked = !want.difference(Columns::ROTATION).is_empty();
        match (&self.mask, &prepared.voxel) {
            (Mask::None, _) => out.mask = None,
            (Mask::Head, _) => out.mask = masked.then(|| vec![0.0; prepared.rows]),
            (Mask::Voxel(_), voxel) => out.mask = voxel.clone(),
        }
        if want.is_empty() {
            return Ok(());
        }
        if let (None, PreparedInput::Planes(_)) | (Some(_), PreparedInput::Position(_)) =
            (&self.planes, &prepared.input)
        {
            return Err(Error::internal("a block prepared by another field was given"));
        }
        let time = time as f32;
        let lines = self.planes.as_ref().map_or(Vec::new(), |planes| planes.lines(time));
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            // SAFETY: the line above saw that this processor has AVX2 and FMA.
            unsafe { self.evaluate_fma(prepared, time, &lines, scratch, out) };
            return Ok(());
        }
        self.evaluate::<false>(prepared, time, &lines, scratch, out);
        Ok(())
    }

    /// [`Field::evaluate`] compiled for AVX2 and FMA.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn evaluate_fma(
        &self,
        prepared: &Prepared,
        time: f32,
        lines: &[TimeLines],
        scratch: &mut Scratch,
        out: &mut Deltas,
    ) {
        self.evaluate::<true>(prepared, time, lines, scratch, out);
    }

    /// Fills what `out` has begun; inlined, with all it calls, into each instruction set's copy.
    #[inline(always)]
    fn evaluate<const FMA: bool>(
        &self,
        prepared: &Prepared,
        time: f32,
        lines: &[TimeLines],
        scratch: &mut Scratch,
        out: &mut Deltas,
    ) {
        let Scratch { features, trunk, hidden } = scratch;
        for start in (0..prepared.rows).step_by(LANES) {
            let lanes = LANES.min(prepared.rows - start);
            match (&self.planes, &prepared.input) {
                (Some(planes), PreparedInput::Planes(block)) => {
                    planes.features(block, lines, start, lanes, features);
                    if self.config.grid_pe > 1 {
                        add_frequencies(features, self.config.grid_pe as f32);
                    }
                }
                (_, PreparedInput::Position(position)) => {
                    let places = [0, 1, 2].map(|axis| &position.plane(axis)[start..start + lanes]);
                    place_features(places, time, features);
                }
                (None, PreparedInput::Planes(_)) => {}
            }
            let trunk = run_trunk::<FMA>(&self.trunk, features, trunk);
            for head in &self.heads {
                let (planes, len) = match (head.column, &mut out.mask) {
                    (Some(column), _) if out.active.contains(column) => {
                        let column = out.delta.column_mut(column);
                        let len = column.len();
                        (column.planes_mut(), len)
                    }
                    (None, Some(mask)) => (mask.as_mut_slice(), prepared.rows),
                    _ => continue,
                };
                head.hidden.activate::<FMA>(trunk, hidden);
                head.output.write::<FMA>(hidden, lanes, planes, len, start);
            }
        }
    }
}

/// What the trunk reads where it reads `[x, y, z, t]`; `places` are by axis.
#[inline(always)]
pub(super) fn place_features(places: [&[f32]; 3], time: f32, features: &mut Vec<CacheLine>) {
    features.clear();
    features.resize(4, CacheLine([time; LANES]));
    for (out, place) in features.iter_mut().zip(places) {
        out.0[..place.len()].copy_from_slice(place);
    }
}

/// Runs the trunk on `input`; gives its ReLU-ed output, as every head wants it.
#[inline(always)]
fn run_trunk<'a, const FMA: bool>(
    layers: &[Linear],
    input: &[CacheLine],
    [last, spare]: &'a mut [Vec<CacheLine>; 2],
) -> &'a [CacheLine] {
    for (i, layer) in layers.iter().enumerate() {
        std::mem::swap(last, spare);
        layer.activate::<FMA>(if i == 0 { input } else { spare }, last);
    }
    last
}

/// `[f, sin(p·f), cos(p·f)]` of features f.
pub(super) fn add_frequencies(features: &mut Vec<CacheLine>, p: f32) {
    let plain = features.clone();
    for of in [f32::sin, f32::cos] {
        features.extend(plain.iter().map(|f| CacheLine(f.0.map(|f| of(p * f)))));
    }
}
