//! The canonical cloud, each attribute on its grid.
//!
//! In: Gaussians and the steps of their attributes. Out: symbols, and the order in which the Gaussians come back: along
//! a Morton curve, in which a position is told by how far it is from the one before.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::entropy::{SYMBOLS, SymbolDecoder, SymbolEncoder, SymbolModel};
use super::predict::{PredictorFit, PredictorWeights, expected, factors};
use super::residual::Residuals;
use super::step::QuantizationGrid;
use crate::model::{Column, Columns, Gaussians, HIGHEST_DEGREE, sh_coefficients};

/// Attributes with a step each, by place in [`CloudSteps`]: harmonics by degree.
pub const ATTRIBUTES: [&str; 8] =
    ["position", "rotation", "log_scale", "opacity_logit", "sh_0", "sh_1", "sh_2", "sh_3"];

/// The grid of each attribute; see [`super::step()`].
pub type CloudSteps = [i32; ATTRIBUTES.len()];

/// Values that one is expected from: the one before it, the mean of four before it, and the same Gaussian's in the two
/// planes before.
const NEIGHBOURS: usize = 4;
/// Bits of an axis that the curve goes through.
const CURVE_BITS: u32 = 21;

/// What a cloud is, beside its symbols.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PointCloudShape {
    pub(super) gaussians: usize,
    pub(super) sh_degree: usize,
    pub(super) steps: CloudSteps,
    /// Least position on each axis, in steps.
    pub(super) lowest: [i64; 3],
    /// Low bits of a position that the curve does not go through.
    pub(super) loose: u32,
    /// Mean of every plane after the positions, in steps.
    pub(super) means: Vec<i64>,
    /// How values of every plane are expected.
    pub(super) parts: Vec<PredictorWeights<NEIGHBOURS>>,
}

/// The planes after the positions: column, plane of it, and attribute.
fn planes(sh_degree: usize) -> Vec<(Columns, usize, usize)> {
    let mut planes: Vec<_> = (0..4).map(|c| (Columns::ROTATION, c, 1)).collect();
    planes.extend((0..3).map(|c| (Columns::LOG_SCALE, c, 2)));
    planes.push((Columns::OPACITY, 0, 3));
    planes.extend((0..3 * sh_coefficients(sh_degree)).map(|c| (Columns::SH, c, 4 + (c / 3).isqrt())));
    planes
}

impl PointCloudShape {
    /// Whether it goes together, whatever an archive says.
    pub(super) fn is_sound(&self) -> bool {
        self.sh_degree <= HIGHEST_DEGREE
            && self.means.len() == planes(self.sh_degree).len()
            && self.parts.len() == self.means.len()
            && self.steps.iter().all(|step| super::STEPS.contains(step))
            && self.loose <= 32
            && self.gaussians <= u32::MAX as usize
    }

    /// f32 values of all Gaussians.
    pub(super) fn values(&self) -> Option<usize> {
        self.gaussians.checked_mul(Columns::all().width(self.sh_degree))
    }
}

/// Bits of `x` three apart.
fn spread(x: u64) -> u64 {
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

/// The reverse of [`spread`].
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

/// Positions on their grid above the lowest, the lowest, and the loose bits.
fn on_grid(position: &Column, grid: QuantizationGrid) -> (Vec<[u64; 3]>, [i64; 3], u32) {
    let all: Vec<[i64; 3]> = (0..position.len()).map(|i| position.row(i).map(|x| grid.multiple(x))).collect();
    let lowest = [0, 1, 2].map(|axis| all.iter().map(|p| p[axis]).min().unwrap_or(0));
    let above: Vec<[u64; 3]> = all.iter().map(|p| [0, 1, 2].map(|axis| p[axis].abs_diff(lowest[axis]))).collect();
    let most = above.iter().flatten().max().copied().unwrap_or(0);
    (above, lowest, (64 - most.leading_zeros()).saturating_sub(CURVE_BITS))
}

fn on_curve(place: &[u64; 3], loose: u32) -> u64 {
    let [x, y, z] = place.map(|x| spread(x >> loose));
    x | y << 1 | z << 2
}

/// Writes a cloud; gives its shape, the symbols, and the ids of the Gaussians in their new order.
/// The bits of every attribute are added to `bits`.
pub(super) fn encode(
    cloud: &Gaussians,
    steps: &CloudSteps,
    bits: &mut BTreeMap<String, f64>,
) -> (PointCloudShape, Vec<u8>, Vec<u32>) {
    let mut encoder = SymbolEncoder::default();
    let (places, lowest, loose) = on_grid(&cloud.position, QuantizationGrid::new(steps[0]));
    let mut order: Vec<u32> = (0..cloud.len() as u32).collect();
    // Stable: ties by id.
    order.sort_by_key(|&id| on_curve(&places[id as usize], loose));
    let (mut lengths, mut before) = (RunLengths::new(), 0);
    for &id in &order {
        let place = &places[id as usize];
        let at = on_curve(place, loose);
        lengths.encode(at - before, &mut encoder);
        before = at;
        place.iter().for_each(|&x| encoder.long_bits(x, loose));
    }
    bits.insert(ATTRIBUTES[0].to_owned(), encoder.cost());
    let planes = planes(cloud.sh_degree());
    let mut shape = PointCloudShape {
        gaussians: cloud.len(),
        sh_degree: cloud.sh_degree(),
        steps: *steps,
        lowest,
        loose,
        means: Vec::new(),
        parts: Vec::new(),
    };
    let mut walk = PlaneWalker::new(cloud.len());
    for (column, c, attribute) in planes {
        let grid = QuantizationGrid::new(steps[attribute]);
        let plane = cloud.column(column).plane(c);
        let multiples: Vec<i64> = order.iter().map(|&id| grid.multiple(plane[id as usize])).collect();
        let sum: i128 = multiples.iter().map(|&multiple| i128::from(multiple)).sum();
        let mean = (sum / multiples.len().max(1) as i128) as i64;
        let mut fit = PredictorFit::new();
        walk.clone().plane(attribute, grid, mean, |i, around, _, _| {
            fit.add(around, grid.value(multiples[i]) - grid.value(mean));
            (multiples[i], 0)
        });
        let parts = fit.parts();
        let factors = factors(&parts);
        let before = encoder.cost();
        walk.plane(attribute, grid, mean, |i, around, size, models| {
            let expected = grid.nearest(f64::from(expected(grid.value(mean), &factors, around)));
            let residual = multiples[i] - expected;
            models.encode(residual, size, &mut encoder);
            (multiples[i], residual)
        });
        *bits.entry(ATTRIBUTES[attribute].to_owned()).or_default() += encoder.cost() - before;
        shape.means.push(mean);
        shape.parts.push(parts);
    }
    (shape, encoder.finish(), order)
}

/// Reads a cloud; none where the bytes are of another.
pub(super) fn decode(shape: &PointCloudShape, bytes: &[u8]) -> Option<Gaussians> {
    let mut decoder = SymbolDecoder::new(bytes)?;
    let mut cloud = Gaussians::zeros(shape.gaussians, shape.sh_degree);
    let grid = QuantizationGrid::new(shape.steps[0]);
    let (mut lengths, mut at) = (RunLengths::new(), 0u64);
    for i in 0..shape.gaussians {
        at = at.wrapping_add(lengths.decode(&mut decoder));
        let place = [0, 1, 2].map(|axis| {
            let x = gather(at >> axis) << shape.loose | decoder.long_bits(shape.loose);
            grid.value(shape.lowest[axis].wrapping_add(x as i64))
        });
        cloud.position.set_row(i, place);
    }
    let mut walk = PlaneWalker::new(shape.gaussians);
    for (k, (column, c, attribute)) in planes(shape.sh_degree).into_iter().enumerate() {
        let grid = QuantizationGrid::new(shape.steps[attribute]);
        let mean = shape.means[k];
        let factors = factors(&shape.parts[k]);
        let plane = cloud.column_mut(column).plane_mut(c);
        walk.plane(attribute, grid, mean, |i, around, size, models| {
            let expected = grid.nearest(f64::from(expected(grid.value(mean), &factors, around)));
            let residual = models.decode(size, &mut decoder);
            let multiple = expected.wrapping_add(residual);
            plane[i] = grid.value(multiple);
            (multiple, residual)
        });
    }
    decoder.is_finished().then_some(cloud)
}

/// Distances along the curve: how many bits they have as two symbols, and the bits below the first.
struct RunLengths {
    high: SymbolModel,
    low: [SymbolModel; 4],
}

impl RunLengths {
    fn new() -> RunLengths {
        RunLengths { high: SymbolModel::NEW, low: [const { SymbolModel::NEW }; 4] }
    }

    fn encode(&mut self, distance: u64, to: &mut SymbolEncoder) {
        let length = 64 - distance.leading_zeros();
        to.symbol(&mut self.high, length as usize / SYMBOLS);
        to.symbol(&mut self.low[length as usize / SYMBOLS], length as usize % SYMBOLS);
        to.long_bits(distance, length.saturating_sub(1));
    }

    fn decode(&mut self, from: &mut SymbolDecoder<'_>) -> u64 {
        let high = from.symbol(&mut self.high) & 3;
        let length = (high * SYMBOLS + from.symbol(&mut self.low[high])) as u32;
        let below = from.long_bits(length.saturating_sub(1));
        if length == 0 { 0 } else { 1 << (length - 1) | below }
    }
}

/// Goes through one plane after another.
#[derive(Clone)]
struct PlaneWalker {
    /// Differences from their mean in the plane before and the one before that.
    known: [Vec<f32>; 2],
    /// How far values of an attribute were from what was expected, in steps: of late, by Gaussian.
    sizes: Vec<f32>,
    /// The attribute, and the models that its planes share.
    attribute: usize,
    models: Residuals,
}

impl PlaneWalker {
    fn new(count: usize) -> PlaneWalker {
        let none = || vec![0.0; count];
        PlaneWalker { known: [none(), none()], sizes: none(), attribute: usize::MAX, models: Residuals::new() }
    }

    /// Visits every Gaussian of a plane. `code` is given what lies around, how large differences were there, in steps,
    /// and the models; it gives the multiple of the Gaussian and how far that is from what was expected.
    #[inline(always)]
    fn plane(
        &mut self,
        attribute: usize,
        grid: QuantizationGrid,
        mean: i64,
        mut code: impl FnMut(usize, &[f32; NEIGHBOURS], f32, &mut Residuals) -> (i64, i64),
    ) {
        if self.attribute != attribute {
            (self.attribute, self.models) = (attribute, Residuals::new());
        }
        let mean = grid.value(mean);
        let [one, two] = &mut self.known;
        let (mut last, mut size) = ([0.0f32; 4], 0.0f32);
        for (i, own) in self.sizes.iter_mut().enumerate() {
            let of_four = (last[0] + last[1] + last[2] + last[3]) * 0.25;
            let around = [last[0], of_four, one[i], two[i]];
            let (multiple, residual) = code(i, &around, (size + *own) * 0.5, &mut self.models);
            let off = residual.unsigned_abs() as f32;
            last = [grid.value(multiple) - mean, last[0], last[1], last[2]];
            size = size * 0.75 + off * 0.25;
            *own = *own * 0.75 + off * 0.25;
            two[i] = last[0];
        }
        std::mem::swap(one, two);
    }
}

/// Puts the values of `attributes` on their grids.
pub(super) fn round(cloud: &mut Gaussians, steps: &CloudSteps, attributes: &[usize]) {
    let positions = (0..3).map(|c| (Columns::POSITION, c, 0));
    for (column, c, attribute) in positions.chain(planes(cloud.sh_degree())) {
        if attributes.contains(&attribute) {
            let grid = QuantizationGrid::new(steps[attribute]);
            cloud.column_mut(column).plane_mut(c).iter_mut().for_each(|value| *value = grid.round(*value));
        }
    }
}

/// The values of an attribute.
pub(super) fn values(cloud: &Gaussians, attribute: usize) -> impl Iterator<Item = f32> {
    let positions = (0..3).map(|c| (Columns::POSITION, c, 0));
    let own = positions.chain(planes(cloud.sh_degree())).filter(move |plane| plane.2 == attribute);
    own.flat_map(|(column, c, _)| cloud.column(column).plane(c).iter().copied())
}
