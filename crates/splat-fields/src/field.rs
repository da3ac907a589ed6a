//! Deformation field of a 4DGaussians model: plane features, an MLP shared by all attributes (the trunk), and one small
//! MLP per attribute (the heads).
//!
//! Input: tensors of a state dict, stored positions, a time. Output: for each Gaussian the deltas of its attributes,
//! and a mask that multiplies its stored attributes.
//!
//! Memory: the tensors; one [`LayerBuffers`] of about 4·LANES·(features + trunk + heads) bytes, where the three names
//! stand for the widths of these layers; and for each prepared Gaussian [`Field::bytes_per_gaussian`], or
//! [`Field::bytes_per_gaussian_with_slopes`] if its Jacobian is computed. Source: Wu et al., "4D Gaussian Splatting for
//! Real-Time Dynamic Scene Rendering", 2024, and the behavior of its public renderer.

use std::path::Path;

use splat_core::error::{Error, Result};
use splat_core::{AttributeValues, Attributes, Gaussians};

use super::deltas::Deltas;
use super::instruction_set::{Evaluation, InstructionSet, run_on_best};
use super::linear::{CacheLine, LANES, Linear};
use super::planes::{Planes, PreparedPlanes};
use super::tensors::{Lookup, Tensors};
use super::voxel::VoxelMask;

/// Options of a trained field that change its evaluation and cannot be inferred from the shapes of its tensors.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldConfig {
    /// Attributes that the field changes. In training, one option per attribute turns its head (output MLP) off:
    /// `no_dx`, `no_ds`, `no_dr`, `no_do` or `no_dshs`. This set contains the attributes whose option is false.
    pub deformed_attributes: Attributes,
    /// Whether the field computes a mask (a factor on the stored attributes of each Gaussian) with an additional head
    /// (output MLP). If true, `empty_voxel` is ignored.
    pub static_mlp: bool,
    /// Whether the field reads a mask from a grid of voxels in space, at the stored position of the Gaussian.
    pub empty_voxel: bool,
    /// Frequency p of the encoding of the plane features f. If p is above 1, the trunk (first MLP) reads f, sin(p·f)
    /// and cos(p·f); otherwise it reads only f.
    pub grid_pe: i64,
    /// Whether the trunk (first MLP) reads `[x, y, z, t]` instead of plane features.
    pub no_grid: bool,
    /// Whether the rotation at a time is the product of the stored quaternion and the rotation delta. If false, it is
    /// their sum.
    pub apply_rotation: bool,
}

/// Source of the mask. A mask is a factor by which all stored attributes of a Gaussian except the rotation are
/// multiplied.
#[derive(Debug, Clone)]
pub(super) enum Mask {
    /// The field has no mask: deltas are added to the stored attributes themselves.
    None,
    /// The last head (output MLP) of the field computes the mask, which varies with time (option `static_mlp`).
    Head,
    /// A voxel grid contains the mask, which is constant in time (option `empty_voxel`).
    Voxel(VoxelMask),
}

/// Head: small MLP that computes the deltas of one attribute, or the mask.
///
/// Its input is the output of the trunk (the MLP shared by all attributes) after ReLU. It consists of a hidden layer,
/// ReLU and an output layer.
#[derive(Debug, Clone)]
pub(super) struct Head {
    /// Attribute whose deltas the head (output MLP) computes; `None` if it computes the mask of the option
    /// `static_mlp`.
    pub(super) column: Option<Attributes>,
    pub(super) hidden: Linear,
    pub(super) output: Linear,
}

/// Deformation field of a 4DGaussians model. It can be evaluated for any block of Gaussians at any time. The result for
/// a Gaussian has the same bits whichever other Gaussians are in its block.
#[derive(Debug, Clone)]
pub struct Field {
    pub(super) config: FieldConfig,
    /// Planes of features; `None` if the trunk (first MLP) reads positions and time instead.
    pub(super) planes: Option<Planes>,
    pub(super) trunk: Vec<Linear>,
    pub(super) heads: Vec<Head>,
    pub(super) mask: Mask,
}

/// Intermediate results of a field for one block of Gaussians. They do not depend on time and are used for every frame.
#[derive(Debug, Clone)]
pub struct PreparedPositions {
    rows: usize,
    pub(super) input: PreparedInput,
    /// Mask of each Gaussian, interpolated in the voxel grid of the field; `None` if the field has no voxel grid. A
    /// mask is a factor on the stored attributes of the Gaussian, before deltas are added.
    voxel: Option<Vec<f32>>,
}

/// Time-independent part of the input of the trunk (first MLP): plane features, or positions.
#[derive(Debug, Clone)]
pub(super) enum PreparedInput {
    Planes(PreparedPlanes),
    Position(AttributeValues),
}

/// Reusable buffers for the outputs of the layers of a field. Each thread that evaluates the field needs its own.
#[derive(Debug, Clone, Default)]
pub struct LayerBuffers {
    features: Vec<CacheLine>,
    trunk: [Vec<CacheLine>; 2],
    hidden: Vec<CacheLine>,
}

/// Returns two texts for an attribute: the name of its head (output MLP) in the state dict, and the option in
/// `cfg_args` that turns this head on.
fn head_name(column: Attributes) -> (&'static str, &'static str) {
    match column {
        Attributes::POSITION => ("pos_deform", "no_dx=False"),
        Attributes::LOG_SCALE => ("scales_deform", "no_ds=False"),
        Attributes::ROTATION => ("rotations_deform", "no_dr=False"),
        Attributes::OPACITY => ("opacity_deform", "no_do=False"),
        _ => ("shs_deform", "no_dshs=False"),
    }
}

impl Field {
    /// Builds the field from the state dict read from `path`, for Gaussians of SH degree `sh_degree`.
    ///
    /// The shapes of the tensors give the number and widths of the layers, and the number and resolutions of the
    /// planes. Unused tensors (`timenet.*`, `*_poc`, heads that are off) are ignored.
    ///
    /// # Errors
    /// Fails if a tensor is missing, has the wrong shape, or contains values that are not finite. The message names the
    /// tensor.
    pub fn new(tensors: &Tensors, config: FieldConfig, sh_degree: usize, path: &Path) -> Result<Self> {
        let lookup = Lookup { tensors, path };
        let planes = if config.no_grid { None } else { Some(Planes::load(lookup)?) };
        let inputs = match &planes {
            None => 4,
            Some(planes) if config.grid_pe > 1 => 3 * planes.width(),
            Some(planes) => planes.width(),
        };
        let layer = |i: usize| format!("deformation_net.feature_out.{}", 2 * i);
        let mut trunk = vec![Linear::load(lookup, &layer(0), inputs, None, "one input per feature")?];
        let width = trunk[0].outputs;
        while lookup.has(&format!("{}.weight", layer(trunk.len()))) {
            trunk.push(Linear::load(lookup, &layer(trunk.len()), width, Some(width), "width of the network")?);
        }

        let shape = Gaussians::zeros(0, sh_degree);
        let mut wanted: Vec<_> = config
            .deformed_attributes
            .iter()
            .map(|column| (Some(column), head_name(column), shape.attribute_values(column).width()))
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

    /// Returns the attributes that the field changes with time.
    pub fn deformed_attributes(&self) -> Attributes {
        self.config.deformed_attributes
    }

    /// Returns whether the field has a mask, a factor on the stored attributes of each Gaussian.
    pub fn has_mask(&self) -> bool {
        !matches!(self.mask, Mask::None)
    }

    /// Returns the options with which the field was trained.
    pub fn config(&self) -> &FieldConfig {
        &self.config
    }

    /// Returns the bytes of memory per Gaussian that the result of [`Field::prepare`] takes.
    pub fn bytes_per_gaussian(&self) -> usize {
        let input = self.planes.as_ref().map_or(12, Planes::bytes_per_gaussian);
        input + if matches!(self.mask, Mask::Voxel(_)) { 4 } else { 0 }
    }

    /// Returns the bytes of memory per Gaussian that the result of [`Field::prepare_with_slopes`] takes.
    pub fn bytes_per_gaussian_with_slopes(&self) -> usize {
        let planes = self.planes.as_ref().filter(|_| self.needs_slopes());
        self.bytes_per_gaussian() + planes.map_or(0, Planes::slope_bytes_per_gaussian)
    }

    /// Returns the number of multiplications by weights that one evaluation of one Gaussian at one time takes.
    pub fn multiplications(&self) -> usize {
        let heads = self.heads.iter().flat_map(|head| [&head.hidden, &head.output]);
        self.trunk.iter().chain(heads).map(Linear::multiplications).sum()
    }

    /// Computes the part of the evaluation that does not depend on time, for Gaussians at the stored positions
    /// `position` (`[3, N]`).
    pub fn prepare(&self, position: &AttributeValues) -> PreparedPositions {
        PreparedPositions {
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

    /// Prepares a block of Gaussians for [`Field::jacobian`] as well as for [`Field::deltas`]: computes the result of
    /// [`Field::prepare`], and the part of the derivatives that does not depend on time.
    pub fn prepare_with_slopes(&self, position: &AttributeValues) -> PreparedPositions {
        let mut prepared = self.prepare(position);
        if let (Some(planes), PreparedInput::Planes(block)) = (&self.planes, &mut prepared.input)
            && self.needs_slopes()
        {
            block.slopes = planes.slopes_in_space(position);
        }
        prepared
    }

    /// Returns whether [`Field::jacobian`] needs derivatives of plane features. It needs them only if the field moves
    /// positions and has no mask.
    fn needs_slopes(&self) -> bool {
        matches!(self.mask, Mask::None) && self.config.deformed_attributes.contains(Attributes::POSITION)
    }

    /// Evaluates the field at `time` for the Gaussians of a prepared block. Writes two results to `out`:
    /// - the deltas of those attributes in `want` that the field changes; deltas of other attributes in `out` stay
    ///   unchanged;
    /// - the mask of each Gaussian, a factor on its stored attributes except the rotation.
    ///
    /// [`Deltas::apply`] computes the attributes at `time` from these results: stored value times mask, plus delta.
    ///
    /// `prepared` is the result of [`Field::prepare`] or [`Field::prepare_with_slopes`] for the block. `time` is passed
    /// to the field unscaled; the feature planes clamp it to [−1, 1].
    ///
    /// # Errors
    /// Fails if `time` is not finite, or if `out` has another SH degree than the field.
    pub fn deltas(
        &self,
        prepared: &PreparedPositions,
        time: f64,
        want: Attributes,
        scratch: &mut LayerBuffers,
        out: &mut Deltas,
    ) -> Result<()> {
        if !time.is_finite() {
            return Err(Error::internal(format!(
                "time of a deformation field: expected a finite number, found {time}"
            )));
        }
        let want = want & self.config.deformed_attributes;
        if let Some(head) = self.heads.iter().find(|head| {
            head.column
                .is_some_and(|c| want.contains(c) && out.delta.attribute_values(c).width() != head.output.outputs)
        }) {
            let name = head.column.map_or("mask", Attributes::name);
            return Err(Error::internal(format!(
                "the deformation field has {} values of {name}, and the output another number",
                head.output.outputs
            )));
        }
        out.begin(prepared.rows, want, self.config.apply_rotation);
        let masked = !want.difference(Attributes::ROTATION).is_empty();
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
            return Err(Error::internal("the block was prepared by another deformation field"));
        }
        let time = time as f32;
        run_on_best(DeltaEvaluation { field: self, prepared, time, scratch, out });
        Ok(())
    }
}

/// [`Evaluation`] that computes the result of [`Field::deltas`] at `time` into `out`.
struct DeltaEvaluation<'a> {
    field: &'a Field,
    prepared: &'a PreparedPositions,
    time: f32,
    scratch: &'a mut LayerBuffers,
    out: &'a mut Deltas,
}

impl Evaluation for DeltaEvaluation<'_> {
    /// Evaluates the field in groups of [`LANES`] Gaussians.
    #[inline(always)]
    fn run<S: InstructionSet>(self) {
        let DeltaEvaluation { field, prepared, time, scratch, out } = self;
        let lines = field.planes.as_ref().map_or(Vec::new(), |planes| planes.lines(time));
        let LayerBuffers { features, trunk, hidden } = scratch;
        for start in (0..prepared.rows).step_by(LANES) {
            let lanes = LANES.min(prepared.rows - start);
            match (&field.planes, &prepared.input) {
                (Some(planes), PreparedInput::Planes(block)) => {
                    planes.features(block, &lines, start, lanes, features);
                    if field.config.grid_pe > 1 {
                        add_frequencies(features, field.config.grid_pe as f32);
                    }
                }
                (_, PreparedInput::Position(position)) => {
                    let positions = [0, 1, 2].map(|axis| &position.plane(axis)[start..start + lanes]);
                    position_time_features(positions, time, features);
                }
                (None, PreparedInput::Planes(_)) => {}
            }
            let trunk = run_trunk::<S>(&field.trunk, features, trunk);
            for head in &field.heads {
                let (planes, len) = match (head.column, &mut out.mask) {
                    (Some(column), _) if out.active.contains(column) => {
                        let column = out.delta.attribute_values_mut(column);
                        let len = column.len();
                        (column.planes_mut(), len)
                    }
                    (None, Some(mask)) => (mask.as_mut_slice(), prepared.rows),
                    _ => continue,
                };
                head.hidden.activate::<S>(trunk, hidden);
                head.output.write::<S>(hidden, lanes, planes, len, start);
            }
        }
    }
}

/// Writes the input of the trunk (first MLP) of a field without planes, `[x, y, z, t]`, to `features` for a group of up
/// to [`LANES`] Gaussians. `positions` holds the x, y and z values of the group.
#[inline(always)]
pub(super) fn position_time_features(positions: [&[f32]; 3], time: f32, features: &mut Vec<CacheLine>) {
    features.clear();
    features.resize(4, CacheLine([time; LANES]));
    for (out, position) in features.iter_mut().zip(positions) {
        out.0[..position.len()].copy_from_slice(position);
    }
}

/// Evaluates the layers of the trunk for `input`. Returns the output of the last layer after ReLU, which every head
/// (MLP of one attribute) reads. `last` and `spare` are buffers for the outputs of the layers; the returned slice is
/// the content of `last`.
#[inline(always)]
fn run_trunk<'a, S: InstructionSet>(
    layers: &[Linear],
    input: &[CacheLine],
    [last, spare]: &'a mut [Vec<CacheLine>; 2],
) -> &'a [CacheLine] {
    for (i, layer) in layers.iter().enumerate() {
        std::mem::swap(last, spare);
        layer.activate::<S>(if i == 0 { input } else { spare }, last);
    }
    last
}

/// Appends sin(p·f) and cos(p·f) to the features f in `features`.
pub(super) fn add_frequencies(features: &mut Vec<CacheLine>, p: f32) {
    let plain = features.clone();
    for function in [f32::sin, f32::cos] {
        features.extend(plain.iter().map(|f| CacheLine(f.0.map(|f| function(p * f)))));
    }
}
