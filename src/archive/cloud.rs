//! Encodes the canonical Gaussians of a model. Each attribute and each column (values of a Gaussian beyond its
//! attributes) has its own quantization grid.
//!
//! Input: Gaussians with their attributes and columns, and a quantization step for each attribute and column. Output:
//! entropy-coded symbols, and the order in which a decoder restores the Gaussians. This order follows a Morton curve. A
//! position is stored as the distance along the curve from the previous position. All other values are coded plane by
//! plane; a plane is one scalar component for all Gaussians.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::entropy::{SYMBOLS, SymbolDecoder, SymbolEncoder, SymbolModel};
use super::predict::{PredictorFit, PredictorWeights, expected, factors};
use super::residual::Residuals;
use super::step::QuantizationGrid;
use crate::model::{AttributeValues, Attributes, Gaussians, MAX_SH_DEGREE, sh_coefficient_count};

/// Names of the attributes that each have their own quantization step, in the order of [`CloudSteps`]; SH coefficients
/// have one step per SH degree.
pub const ATTRIBUTES: [&str; 8] =
    ["position", "rotation", "log_scale", "opacity_logit", "sh_0", "sh_1", "sh_2", "sh_3"];

/// Exponents `k` of the quantization steps 2^(k/8) of the attributes, in the order of [`ATTRIBUTES`]; see
/// [`super::step_size()`].
pub type CloudSteps = [i32; ATTRIBUTES.len()];

/// Index in [`ATTRIBUTES`] of the SH coefficients of degree 0; those of higher degrees follow.
pub const FIRST_SH_ATTRIBUTE: usize = 4;

/// Returns the attribute of the values whose name is [`ATTRIBUTES`]`[k]`.
pub fn attribute(k: usize) -> Attributes {
    const BEFORE_SH: [Attributes; FIRST_SH_ATTRIBUTE] =
        [Attributes::POSITION, Attributes::ROTATION, Attributes::LOG_SCALE, Attributes::OPACITY];
    BEFORE_SH.get(k).copied().unwrap_or(Attributes::SH)
}

/// Number of known values from which a value is predicted:
/// - the value of the previous Gaussian
/// - the mean value of the previous four Gaussians
/// - the values of this Gaussian in the two planes (scalar components) that are coded before this plane
const NEIGHBORS: usize = 4;
/// Number of bits per axis in an index along the Morton curve; the three axes together take 63 bits.
const CURVE_BITS: u32 = 21;

/// Column: values of the Gaussians beyond their attributes, which only some model formats have, such as coefficients of
/// a motion. All values of a column share one quantization step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Column {
    /// Name of the column, unique among the columns of an archive.
    pub name: String,
    /// Values of the column, one row per Gaussian.
    pub values: AttributeValues,
    /// Index in [`ATTRIBUTES`] of the attribute whose later frames this column holds, if the Gaussians hold its first
    /// frame. The attribute then has the quantization step of the column. Not stored in an archive: `None` after
    /// decoding.
    pub first_frame: Option<usize>,
}

/// Parameters that are needed to decode a [`Column`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ColumnShape {
    pub(super) name: String,
    /// Number of planes (scalar components) of the column.
    pub(super) planes: usize,
    /// Exponent `k` of the quantization step 2^(k/8) of the column; see [`super::step_size()`].
    pub(super) step: i32,
}

/// Parameters of encoded Gaussians that a decoder needs besides the symbols.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PointCloudShape {
    pub(super) gaussians: usize,
    pub(super) sh_degree: usize,
    pub(super) steps: CloudSteps,
    pub(super) columns: Vec<ColumnShape>,
    /// Minimum of the positions of all Gaussians on each axis, in quantization steps.
    pub(super) lowest: [i64; 3],
    /// Number of low bits of each coordinate of a position that are stored as plain bits, because the index along the
    /// Morton curve has no room for them.
    #[serde(rename = "loose")]
    pub(super) plain_bits: u32,
    /// Mean of every plane (scalar component), in quantization steps. The three planes of the position have none.
    pub(super) means: Vec<i64>,
    /// Predictor weights (with which a value is predicted from known values) of every plane (scalar component), except
    /// the three planes of the position.
    #[serde(rename = "parts")]
    pub(super) weights: Vec<PredictorWeights<NEIGHBORS>>,
}

/// Plane (scalar component of all Gaussians) that is coded after the positions.
#[derive(Debug, Clone, Copy)]
struct Plane {
    source: PlaneOrigin,
    /// Group of planes with which this plane shares its quantization step and entropy models. The planes of an
    /// attribute are one group: its index in [`ATTRIBUTES`]. The planes of a column are one group: the number of
    /// attributes plus the index of the column.
    group: usize,
}

/// Origin of the values of a [`Plane`]: an attribute or a [`Column`].
#[derive(Debug, Clone, Copy)]
enum PlaneOrigin {
    /// Attribute, and index of the scalar component of this attribute that the plane holds.
    Attribute(Attributes, usize),
    /// Index of a [`Column`], and index of the scalar component of this column that the plane holds.
    Column(usize, usize),
}

/// Returns the planes (scalar components) of the attributes in coding order, without the three of the position.
fn attribute_planes(sh_degree: usize) -> Vec<Plane> {
    let plane = |attribute, c, group| Plane { source: PlaneOrigin::Attribute(attribute, c), group };
    let mut planes: Vec<_> = (0..4).map(|c| plane(Attributes::ROTATION, c, 1)).collect();
    planes.extend((0..3).map(|c| plane(Attributes::LOG_SCALE, c, 2)));
    planes.push(plane(Attributes::OPACITY, 0, 3));
    planes.extend(
        (0..3 * sh_coefficient_count(sh_degree))
            .map(|c| plane(Attributes::SH, c, FIRST_SH_ATTRIBUTE + (c / 3).isqrt())),
    );
    planes
}

impl PointCloudShape {
    /// Returns whether the parameters, which may come from an untrusted file, are consistent: a valid SH degree, one
    /// mean and one set of predictor weights per plane, and steps and counts in their allowed ranges.
    pub(super) fn is_sound(&self) -> bool {
        let steps = self.steps.iter().chain(self.columns.iter().map(|column| &column.step));
        self.sh_degree <= MAX_SH_DEGREE
            && self.plane_count() == Some(self.means.len())
            && self.weights.len() == self.means.len()
            && steps.into_iter().all(|step| super::STEP_NUMBERS.contains(step))
            && self.plain_bits <= 32
            && self.gaussians <= u32::MAX as usize
    }

    /// Returns the number of planes (scalar components) other than the three of the position; `None` if the number
    /// overflows.
    fn plane_count(&self) -> Option<usize> {
        let attributes = Attributes::all().width(self.sh_degree.min(MAX_SH_DEGREE)) - 3;
        self.columns.iter().try_fold(attributes, |sum, column| sum.checked_add(column.planes))
    }

    /// Returns the planes (scalar components) of all attributes but the position, then those of all columns, in coding
    /// order. The parameters must have passed [`PointCloudShape::is_sound`].
    fn planes(&self) -> Vec<Plane> {
        let mut planes = attribute_planes(self.sh_degree);
        for (k, column) in self.columns.iter().enumerate() {
            let group = ATTRIBUTES.len() + k;
            planes.extend((0..column.planes).map(|c| Plane { source: PlaneOrigin::Column(k, c), group }));
        }
        planes
    }

    /// Returns the quantization grid of the values of `plane`.
    fn grid(&self, plane: Plane) -> QuantizationGrid {
        QuantizationGrid::new(match plane.group.checked_sub(ATTRIBUTES.len()) {
            Some(column) => self.columns[column].step,
            None => self.steps[plane.group],
        })
    }

    /// Returns the number of f32 values in the attributes and columns of all Gaussians; `None` if it overflows.
    pub(super) fn values(&self) -> Option<usize> {
        self.gaussians.checked_mul(self.plane_count()?.checked_add(3)?)
    }
}

/// Returns the lowest 21 bits of `x` with two zero bits inserted between consecutive bits. Higher bits of `x` are
/// dropped.
pub(crate) fn interleave_zeros(x: u64) -> u64 {
    let mut x = x & ((1 << CURVE_BITS) - 1);
    for (shift, mask) in [
        (32, 0x001f_0000_0000_ffff),
        (16, 0x001f_0000_ff00_00ff),
        (8, 0x100f_00f0_0f00_f00f),
        (4, 0x10c3_0c30_c30c_30c3),
        (2, 0x1249_2492_4924_9249),
    ] {
        x = (x | x << shift) & mask;
    }
    x
}

/// Returns the bits 0, 3, 6, … of `x` as the bits 0, 1, 2, … of the result. Undoes [`interleave_zeros`].
fn gather(x: u64) -> u64 {
    let mut x = x & 0x1249_2492_4924_9249;
    for (shift, mask) in [
        (2, 0x10c3_0c30_c30c_30c3),
        (4, 0x100f_00f0_0f00_f00f),
        (8, 0x001f_0000_ff00_00ff),
        (16, 0x001f_0000_0000_ffff),
        (32, (1 << CURVE_BITS) - 1),
    ] {
        x = (x | x >> shift) & mask;
    }
    x
}

/// Rounds all positions to `grid`. Returns three results:
/// - all positions, in quantization steps from the minimum of the positions on each axis
/// - this minimum on each axis, in quantization steps
/// - the number of low bits of each coordinate that an index along the Morton curve leaves out, so that it fits into 64
///   bits
fn grid_positions(position: &AttributeValues, grid: QuantizationGrid) -> (Vec<[u64; 3]>, [i64; 3], u32) {
    let all: Vec<[i64; 3]> = (0..position.len()).map(|i| position.row(i).map(|x| grid.multiple(x))).collect();
    let lowest = [0, 1, 2].map(|axis| all.iter().map(|p| p[axis]).min().unwrap_or(0));
    let above: Vec<[u64; 3]> = all.iter().map(|p| [0, 1, 2].map(|axis| p[axis].abs_diff(lowest[axis]))).collect();
    let most = above.iter().flatten().max().copied().unwrap_or(0);
    (above, lowest, (64 - most.leading_zeros()).saturating_sub(CURVE_BITS))
}

/// Returns the index along the Morton curve of the position `place`, which is given in quantization steps from the
/// minimum on each axis. The index leaves out the `plain_bits` lowest bits of each coordinate.
fn curve_index(place: &[u64; 3], plain_bits: u32) -> u64 {
    let [x, y, z] = place.map(|x| interleave_zeros(x >> plain_bits));
    x | y << 1 | z << 2
}

/// Encodes the Gaussians `cloud` with the quantization steps `steps` of their attributes, and the further values
/// `columns` with the steps `column_steps`. Returns three results:
/// - the parameters that a decoder needs
/// - the entropy-coded symbols
/// - for each Gaussian in the order of the decoder: its index in `cloud`
///
/// Adds the approximate number of bits of every attribute and column to `bits`.
pub(super) fn encode(
    cloud: &Gaussians,
    columns: &[Column],
    (steps, column_steps): (&CloudSteps, &[i32]),
    bits: &mut BTreeMap<String, f64>,
) -> (PointCloudShape, Vec<u8>, Vec<u32>) {
    let mut encoder = SymbolEncoder::default();
    let (places, lowest, plain_bits) = grid_positions(&cloud.position, QuantizationGrid::new(steps[0]));
    let mut order: Vec<u32> = (0..cloud.len() as u32).collect();
    // The sort is stable: Gaussians with the same curve index stay in their original order.
    order.sort_by_key(|&id| curve_index(&places[id as usize], plain_bits));
    let (mut lengths, mut before) = (CurveDistances::new(), 0);
    for &id in &order {
        let place = &places[id as usize];
        let at = curve_index(place, plain_bits);
        lengths.encode(at - before, &mut encoder);
        before = at;
        place.iter().for_each(|&x| encoder.long_bits(x, plain_bits));
    }
    bits.insert(ATTRIBUTES[0].to_owned(), encoder.cost());
    let column_shape = |(column, &step): (&Column, &i32)| ColumnShape {
        name: column.name.clone(),
        planes: column.values.width(),
        step,
    };
    let mut shape = PointCloudShape {
        gaussians: cloud.len(),
        sh_degree: cloud.sh_degree(),
        steps: *steps,
        columns: columns.iter().zip(column_steps).map(column_shape).collect(),
        lowest,
        plain_bits,
        means: Vec::new(),
        weights: Vec::new(),
    };
    let mut coder = PlaneCoder::new(cloud.len());
    let rotation = nonzero_rotations(&cloud.rotation, QuantizationGrid::new(steps[1]));
    for coded in shape.planes() {
        let (grid, group) = (shape.grid(coded), coded.group);
        let plane = match coded.source {
            PlaneOrigin::Attribute(Attributes::ROTATION, c) => rotation.plane(c),
            PlaneOrigin::Attribute(attribute, c) => cloud.attribute_values(attribute).plane(c),
            PlaneOrigin::Column(k, c) => columns[k].values.plane(c),
        };
        let multiples: Vec<i64> = order.iter().map(|&id| grid.multiple(plane[id as usize])).collect();
        let sum: i128 = multiples.iter().map(|&multiple| i128::from(multiple)).sum();
        let mean = (sum / multiples.len().max(1) as i128) as i64;
        let mut fit = PredictorFit::new();
        coder.clone().code_plane(group, grid, mean, |i, around, _, _| {
            fit.add(around, grid.value(multiples[i]) - grid.value(mean));
            (multiples[i], 0)
        });
        let weights = fit.weights();
        let factors = factors(&weights);
        let before = encoder.cost();
        coder.code_plane(group, grid, mean, |i, around, size, models| {
            let predicted = grid.predicted(expected(grid.value(mean), &factors, around));
            (multiples[i], models.encode(multiples[i], predicted, size, &mut encoder))
        });
        let name = match group.checked_sub(ATTRIBUTES.len()) {
            Some(column) => columns[column].name.as_str(),
            None => ATTRIBUTES[group],
        };
        *bits.entry(name.to_owned()).or_default() += encoder.cost() - before;
        shape.means.push(mean);
        shape.weights.push(weights);
    }
    (shape, encoder.finish(), order)
}

/// Decodes Gaussians from their symbols `bytes`. Returns their attributes, and the columns with their other values.
/// Returns `None` if the bytes do not match `shape`, which must have passed [`PointCloudShape::is_sound`].
pub(super) fn decode(shape: &PointCloudShape, bytes: &[u8]) -> Option<(Gaussians, Vec<Column>)> {
    let mut decoder = SymbolDecoder::new(bytes)?;
    let mut cloud = Gaussians::zeros(shape.gaussians, shape.sh_degree);
    let zeros = |column: &ColumnShape| Column {
        name: column.name.clone(),
        values: AttributeValues::zeros(column.planes, shape.gaussians),
        first_frame: None,
    };
    let mut columns: Vec<Column> = shape.columns.iter().map(zeros).collect();
    let grid = QuantizationGrid::new(shape.steps[0]);
    let (mut lengths, mut at) = (CurveDistances::new(), 0u64);
    for i in 0..shape.gaussians {
        at = at.wrapping_add(lengths.decode(&mut decoder));
        let place = [0, 1, 2].map(|axis| {
            let x = gather(at >> axis) << shape.plain_bits | decoder.long_bits(shape.plain_bits);
            grid.value(shape.lowest[axis].wrapping_add(x as i64))
        });
        cloud.position.set_row(i, place);
    }
    let mut coder = PlaneCoder::new(shape.gaussians);
    for (k, coded) in shape.planes().into_iter().enumerate() {
        let (grid, mean) = (shape.grid(coded), shape.means[k]);
        let factors = factors(&shape.weights[k]);
        let plane = match coded.source {
            PlaneOrigin::Attribute(attribute, c) => cloud.attribute_values_mut(attribute).plane_mut(c),
            PlaneOrigin::Column(column, c) => columns[column].values.plane_mut(c),
        };
        coder.code_plane(coded.group, grid, mean, |i, around, size, models| {
            let predicted = grid.predicted(expected(grid.value(mean), &factors, around));
            let (multiple, residual) = models.decode(predicted, size, &mut decoder);
            plane[i] = grid.value(multiple);
            (multiple, residual)
        });
    }
    decoder.is_finished().then_some((cloud, columns))
}

/// Adaptive entropy models of the distances between consecutive positions along the Morton curve. The length of a
/// distance in bits is coded as two symbols: the length divided by 16, and the remainder. The bits of the distance
/// below its highest one are stored as plain bits.
struct CurveDistances {
    high: SymbolModel,
    low: [SymbolModel; 4],
}

impl CurveDistances {
    /// Creates the entropy models of distances along the Morton curve. At first, all symbols are equally probable.
    fn new() -> CurveDistances {
        CurveDistances { high: SymbolModel::NEW, low: [const { SymbolModel::NEW }; 4] }
    }

    /// Writes a distance along the Morton curve to `encoder`, and adapts the entropy models to it.
    fn encode(&mut self, distance: u64, encoder: &mut SymbolEncoder) {
        let length = 64 - distance.leading_zeros();
        encoder.symbol(&mut self.high, length as usize / SYMBOLS);
        encoder.symbol(&mut self.low[length as usize / SYMBOLS], length as usize % SYMBOLS);
        encoder.long_bits(distance, length.saturating_sub(1));
    }

    /// Reads a distance along the Morton curve from `decoder`, and adapts the entropy models to it.
    fn decode(&mut self, decoder: &mut SymbolDecoder<'_>) -> u64 {
        let high = decoder.symbol(&mut self.high) & 3;
        let length = (high * SYMBOLS + decoder.symbol(&mut self.low[high])) as u32;
        let below = decoder.long_bits(length.saturating_sub(1));
        if length == 0 { 0 } else { 1 << (length - 1) | below }
    }
}

/// Coder of planes (scalar components of all Gaussians): the state that it carries from one plane to the next.
#[derive(Clone)]
struct PlaneCoder {
    /// Values of the two planes (scalar components of all Gaussians) coded last, the most recent one first: one value
    /// per Gaussian, minus the mean of its plane.
    previous_planes: [Vec<f32>; 2],
    /// For each Gaussian: moving average, over the planes coded so far, of the absolute prediction error of its values,
    /// in quantization steps.
    sizes: Vec<f32>,
    /// Group ([`Plane::group`]) of the plane that is being coded. All planes of a group share the entropy models.
    group: usize,
    models: Residuals,
}

impl PlaneCoder {
    /// Creates the coder of the planes (scalar components) of `count` Gaussians. No plane has been coded yet.
    fn new(count: usize) -> PlaneCoder {
        let none = || vec![0.0; count];
        PlaneCoder { previous_planes: [none(), none()], sizes: none(), group: usize::MAX, models: Residuals::new() }
    }

    /// Codes one plane (scalar component of all Gaussians): calls `code` once for each Gaussian, in coding order.
    ///
    /// The plane:
    /// - `group`: [`Plane::group`]; planes of one group share the entropy models.
    /// - `grid`: quantization grid of the values.
    /// - `mean`: mean of the values, in quantization steps.
    ///
    /// `code` encodes or decodes one value of the plane:
    /// - Arguments: index of the Gaussian, known values to predict from (each minus the mean of its plane), expected
    ///   absolute prediction error in quantization steps, entropy models.
    /// - Results: quantized value, and prediction error (quantized minus predicted value), both in quantization steps.
    #[inline(always)]
    fn code_plane(
        &mut self,
        group: usize,
        grid: QuantizationGrid,
        mean: i64,
        mut code: impl FnMut(usize, &[f32; NEIGHBORS], f32, &mut Residuals) -> (i64, i64),
    ) {
        if self.group != group {
            (self.group, self.models) = (group, Residuals::new());
        }
        let mean = grid.value(mean);
        let [previous, second_previous] = &mut self.previous_planes;
        let (mut last, mut size) = ([0.0f32; 4], 0.0f32);
        for (i, mean_error) in self.sizes.iter_mut().enumerate() {
            let mean_of_four = (last[0] + last[1] + last[2] + last[3]) * 0.25;
            let around = [last[0], mean_of_four, previous[i], second_previous[i]];
            let (multiple, residual) = code(i, &around, (size + *mean_error) * 0.5, &mut self.models);
            let off = residual.unsigned_abs() as f32;
            last = [grid.value(multiple) - mean, last[0], last[1], last[2]];
            size = size * 0.75 + off * 0.25;
            *mean_error = *mean_error * 0.75 + off * 0.25;
            second_previous[i] = last[0];
        }
        std::mem::swap(previous, second_previous);
    }
}

/// Returns one entry for each plane (scalar component) of the attributes, including the position: the attribute, the
/// index of the component in this attribute, and the index of the attribute in [`ATTRIBUTES`].
fn components(sh_degree: usize) -> impl Iterator<Item = (Attributes, usize, usize)> {
    let positions = (0..3).map(|c| (Attributes::POSITION, c, 0));
    positions.chain(attribute_planes(sh_degree).into_iter().filter_map(|plane| match plane.source {
        PlaneOrigin::Attribute(attribute, c) => Some((attribute, c, plane.group)),
        PlaneOrigin::Column(..) => None,
    }))
}

/// Returns a copy of the quaternions `rotation`. A quaternion that is not zero, but that `grid` would round to zero, is
/// replaced by ± one step in its largest component and zeros in the others. Renderers cannot show a Gaussian with a
/// quaternion of zero.
fn nonzero_rotations(rotation: &AttributeValues, grid: QuantizationGrid) -> AttributeValues {
    let mut nonzero = rotation.clone();
    for i in 0..rotation.len() {
        let row: [f32; 4] = rotation.row(i);
        if row.iter().all(|&value| grid.multiple(value) == 0) {
            let largest = (1..4).fold(0, |largest, c| if row[c].abs() > row[largest].abs() { c } else { largest });
            if row[largest] != 0.0 {
                let sign = if row[largest] > 0.0 { 1 } else { -1 };
                nonzero.set_row::<4>(i, std::array::from_fn(|c| grid.value(if c == largest { sign } else { 0 })));
            }
        }
    }
    nonzero
}

/// Rounds attributes of the Gaussians `cloud` in place to the quantization grids of `steps`, as an archive would, but
/// keeps the order of the Gaussians. `attributes` lists the attributes to round, as indices in [`ATTRIBUTES`].
pub fn round_cloud(cloud: &mut Gaussians, steps: &CloudSteps, attributes: &[usize]) {
    if attributes.contains(&1) {
        cloud.rotation = nonzero_rotations(&cloud.rotation, QuantizationGrid::new(steps[1]));
    }
    for (column, c, attribute) in components(cloud.sh_degree()) {
        if attributes.contains(&attribute) {
            round_all(cloud.attribute_values_mut(column).plane_mut(c), steps[attribute]);
        }
    }
}

/// Rounds the values of `column` to the quantization grid with the step 2^(`step`/8), as an archive would.
pub fn round_column(column: &mut Column, step: i32) {
    round_all(column.values.planes_mut(), step);
}

/// Rounds `values` to the quantization grid with the step 2^(`step`/8).
fn round_all(values: &mut [f32], step: i32) {
    let grid = QuantizationGrid::new(step);
    values.iter_mut().for_each(|value| *value = grid.round(*value));
}

/// Returns the values of the attribute [`ATTRIBUTES`]`[k]` of the Gaussians `cloud`: the first scalar component of all
/// Gaussians, then the second, and so on.
pub fn attribute_values(cloud: &Gaussians, k: usize) -> impl Iterator<Item = f32> {
    let own = components(cloud.sh_degree()).filter(move |plane| plane.2 == k);
    own.flat_map(|(column, c, _)| cloud.attribute_values(column).plane(c).iter().copied())
}
