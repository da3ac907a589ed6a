//! A deep network that moves Gaussians: sines of position and time, fully connected layers, linear heads.
//!
//! h = [e(x), e(t)] with e(v) = [v, sin(2⁰v), cos(2⁰v), sin(2¹v), cos(2¹v), …], every block all components, ten octaves of
//! x; with a time network e(t) is its output. Layers are linear, then ReLU; some read [e(x), e(t), h] instead of h. Heads
//! are linear in the last h. Data in: tensors of a state dict, canonical positions, a time. Data out: [`PredictedMotion`].
//! Memory: the tensors twice, [`Network::BYTES_PER_GAUSSIAN`] per encoded Gaussian, and about 64 kB of activations per call.
//! Sources: Yang et al., "Deformable 3D Gaussians for High-Fidelity Monocular Dynamic Scene Reconstruction", 2024; Huang et
//! al., "SC-GS: Sparse-Controlled Gaussian Splatting for Editable Dynamic Scenes", 2024; and their public code.

use std::path::Path;

use super::linear::{CacheLine, LANES, Linear};
use super::tensors::{Lookup, Tensors};
use splat_core::error::{Error, Result};
use splat_core::{Column, Columns};

/// Octaves of a position's sines.
const OCTAVES: usize = 10;
/// Values that a position becomes.
const PLACE: usize = 3 + 6 * OCTAVES;

/// A network. The result of a Gaussian has the same bits whatever block it is evaluated in.
#[derive(Debug, Clone)]
pub struct Network {
    /// Of time's sines.
    octaves: usize,
    /// Two layers between time's sines and what the others read.
    time: Option<[Linear; 2]>,
    layers: Vec<NetworkLayer>,
    heads: Vec<NetworkHead>,
}

#[derive(Debug, Clone)]
struct NetworkLayer {
    linear: Linear,
    /// Whether it reads the encodings before what the layer before it gives.
    joins: bool,
}

#[derive(Debug, Clone)]
struct NetworkHead {
    column: Columns,
    /// Of its first output in the column.
    plane: usize,
    output: Linear,
}

/// Encoded positions of a block of Gaussians, for all times.
#[derive(Debug, Clone, Default)]
pub struct Encoded {
    rows: usize,
    /// Groups of [`LANES`] Gaussians, zero beyond the last: [`PLACE`] values each.
    values: Vec<CacheLine>,
}

/// What heads say of a block of Gaussians; of no rows where there is no head, or where nobody asked.
#[derive(Debug, Clone, Default)]
pub struct PredictedMotion {
    /// `[3]` what is added to positions, scene units; of a network of screws `[6]`, w and then v.
    pub warp: Column,
    /// `[4]` what is added to quaternions, wxyz.
    pub rotation: Column,
    /// `[3]` what is added to scales, scene units.
    pub scaling: Column,
    /// `[1]` what is added to opacities.
    pub opacity: Column,
    /// `[3]` what is added to harmonics of degree 0.
    pub color: Column,
}

/// Activations of one group.
#[derive(Default)]
struct NetworkScratch {
    /// Encodings, and behind them what a layer that joins reads.
    input: Vec<CacheLine>,
    last: Vec<CacheLine>,
    spare: Vec<CacheLine>,
}

impl PredictedMotion {
    fn column_mut(&mut self, which: Columns) -> &mut Column {
        match which {
            Columns::POSITION => &mut self.warp,
            Columns::ROTATION => &mut self.rotation,
            Columns::LOG_SCALE => &mut self.scaling,
            Columns::OPACITY => &mut self.opacity,
            _ => &mut self.color,
        }
    }
}

impl Network {
    /// Bytes that one Gaussian takes in [`Encoded`].
    pub const BYTES_PER_GAUSSIAN: usize = 4 * PLACE;

    /// Builds the network from the tensors of `path` whose names begin with `prefix`. Depth, widths, octaves of time,
    /// joins and heads follow from the tensors.
    ///
    /// # Errors
    /// A tensor that is missing, of the wrong shape, or not finite; the error names it.
    pub fn new(tensors: &Tensors, prefix: &str, path: &Path) -> Result<Network> {
        let lookup = Lookup { tensors, path };
        let name = |of: &str| format!("{prefix}{of}");
        let has = |of: &str| lookup.has(&format!("{prefix}{of}.weight"));
        let load = |of: &str, inputs: usize, outputs: Option<usize>, why: &str| {
            Linear::load(lookup, &name(of), inputs, outputs, why)
        };
        let wide = |of: &str| lookup.matrix(&format!("{prefix}{of}.weight"), "the network's layers");

        let [_, inputs] = wide("linear.0")?;
        let time = match has("timenet.0") {
            true => {
                let [_, inputs] = wide("timenet.0")?;
                let first = load("timenet.0", inputs, None, "time's sines")?;
                let outputs = first.outputs;
                Some((inputs, [first, load("timenet.2", outputs, None, "the hidden layer of the time network")?]))
            }
            false => None,
        };
        let of_time = inputs.checked_sub(PLACE).filter(|&width| width > 0);
        let sines = time.as_ref().map_or(of_time, |(inputs, _)| Some(*inputs));
        let Some((of_time, octaves)) = of_time.zip(sines.filter(|width| width % 2 == 1).map(|width| width / 2)) else {
            let (of, expected) = match time {
                Some(_) => {
                    ("timenet.0", "an odd number of inputs, a time and its sines, after which linear.0 reads more")
                }
                None => ("linear.0", "63 inputs of a position and an odd number of a time"),
            };
            let found = format!(
                "linear.0 reads {inputs}{}",
                sines.map_or(String::new(), |width| format!(", {width} of a time"))
            );
            return Err(lookup.mismatch(&name(&format!("{of}.weight")), expected, found));
        };
        let time = time.map(|(_, layers)| layers);
        if let Some([_, last]) = &time
            && last.outputs != of_time
        {
            let expected = format!("{of_time} outputs, which linear.0 reads after {PLACE} of a position");
            return Err(lookup.mismatch(&name("timenet.2.weight"), expected, last.outputs.to_string()));
        }

        let mut layers: Vec<NetworkLayer> = Vec::new();
        let mut width = 0;
        while has(&format!("linear.{}", layers.len())) {
            let of = format!("linear.{}", layers.len());
            let joins = !layers.is_empty() && wide(&of)?[1] == width + inputs;
            let reads = if layers.is_empty() || joins { width + inputs } else { width };
            let linear = load(&of, reads, None, "the layer before it, with or without the encodings")?;
            width = linear.outputs;
            layers.push(NetworkLayer { linear, joins });
        }

        let mut heads = Vec::new();
        let mut add = |column: Columns, plane: usize, of: &str, outputs: usize, why: &str| -> Result<()> {
            let output = load(of, width, Some(outputs), why)?;
            heads.push(NetworkHead { column, plane, output });
            Ok(())
        };
        if has("branch_w") {
            add(Columns::POSITION, 0, "branch_w", 3, "the axis of a screw")?;
            add(Columns::POSITION, 3, "branch_v", 3, "the way along a screw")?;
        } else {
            add(Columns::POSITION, 0, "gaussian_warp", 3, "what is added to a position")?;
        }
        add(Columns::ROTATION, 0, "gaussian_rotation", 4, "what is added to a rotation")?;
        add(Columns::LOG_SCALE, 0, "gaussian_scaling", 3, "what is added to scales")?;
        if has("gaussian_opacity") {
            add(Columns::OPACITY, 0, "gaussian_opacity", 1, "what is added to an opacity")?;
        }
        if has("gaussian_color") {
            add(Columns::SH, 0, "gaussian_color", 3, "what is added to a colour")?;
        }
        Ok(Network { octaves, time, layers, heads })
    }

    /// Columns that have a head.
    pub fn active(&self) -> Columns {
        self.heads.iter().map(|head| head.column).collect()
    }

    /// Whether positions move by screws: [`PredictedMotion::warp`] is then w and v.
    pub fn has_screws(&self) -> bool {
        self.heads.iter().any(|head| head.plane > 0)
    }

    /// Multiplications by weights that a Gaussian takes at one time.
    pub fn multiplications(&self) -> usize {
        let layers = self.layers.iter().map(|layer| &layer.linear);
        layers.chain(self.heads.iter().map(|head| &head.output)).map(Linear::multiplications).sum()
    }

    /// Encodes canonical positions `[N, 3]`.
    ///
    /// Sine and cosine are exact to f32 of 2ᵏ times the f32 position: those of the position in f64, doubled. Each doubling
    /// doubles an error of 1e-16, which is 1e-13 at the last.
    pub fn encode(&self, position: &Column) -> Encoded {
        let rows = position.len();
        let mut values = vec![CacheLine([0.0; LANES]); rows.div_ceil(LANES) * PLACE];
        for (axis, row) in (0..3).flat_map(|axis| (0..rows).map(move |row| (axis, row))) {
            let (group, lane) = (row / LANES, row % LANES);
            let out = &mut values[group * PLACE..][..PLACE];
            for (k, value) in sines(position.plane(axis)[row], OCTAVES).into_iter().enumerate() {
                out[3 * k + axis].0[lane] = value;
            }
        }
        Encoded { rows, values }
    }

    /// What the heads of the columns `want` say at `time`, which is rounded to f32 as the originals do; other columns of
    /// `out` are left alone.
    ///
    /// # Errors
    /// A time that is not finite.
    pub fn motion(&self, encoded: &Encoded, time: f64, want: Columns, out: &mut PredictedMotion) -> Result<()> {
        let time = finite(time)?;
        for head in self.heads.iter().filter(|head| want.contains(head.column)) {
            let column = out.column_mut(head.column);
            let width = head.plane + head.output.outputs;
            if column.width() < width {
                *column = Column::zeros(width, encoded.rows);
            }
            column.resize(encoded.rows);
        }
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            // SAFETY: the line above saw that this processor has AVX2 and FMA.
            unsafe { self.evaluate_fma(encoded, time, want, out) };
            return Ok(());
        }
        self.evaluate::<false>(encoded, time, want, out);
        Ok(())
    }

    /// How [`PredictedMotion::warp`] at `time` changes with canonical `position` `[N, 3]`: output o along axis a in plane 3·o + a.
    ///
    /// # Errors
    /// A time that is not finite.
    pub fn slopes(&self, position: &Column, time: f64) -> Result<Column> {
        let time = finite(time)?;
        let encoded = self.encode(position);
        let outputs = if self.has_screws() { 6 } else { 3 };
        let mut out = Column::zeros(3 * outputs, encoded.rows);
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            // SAFETY: the line above saw that this processor has AVX2 and FMA.
            unsafe { self.differentiate_fma(&encoded, time, &mut out) };
            return Ok(out);
        }
        self.differentiate::<false>(&encoded, time, &mut out);
        Ok(out)
    }

    /// [`Network::evaluate`] compiled for AVX2 and FMA.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn evaluate_fma(&self, encoded: &Encoded, time: f32, want: Columns, out: &mut PredictedMotion) {
        self.evaluate::<true>(encoded, time, want, out);
    }

    /// [`Network::differentiate`] compiled for AVX2 and FMA.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn differentiate_fma(&self, encoded: &Encoded, time: f32, out: &mut Column) {
        self.differentiate::<true>(encoded, time, out);
    }

    /// Fills the columns of `out`; inlined, with all it calls, into each instruction set's copy.
    #[inline(always)]
    fn evaluate<const FMA: bool>(&self, encoded: &Encoded, time: f32, want: Columns, out: &mut PredictedMotion) {
        let (of_time, mut scratch) = (self.of_time::<FMA>(time), NetworkScratch::default());
        for (group, place) in encoded.values.chunks_exact(PLACE).enumerate() {
            let NetworkScratch { input, last, spare } = &mut scratch;
            input.clear();
            input.extend_from_slice(place);
            input.extend_from_slice(&of_time);
            for (k, layer) in self.layers.iter().enumerate() {
                std::mem::swap(last, spare);
                if layer.joins {
                    input.truncate(PLACE + of_time.len());
                    input.extend_from_slice(&spare[..self.layers[k - 1].linear.outputs]);
                }
                layer.linear.activate::<FMA>(if k == 0 || layer.joins { input } else { spare }, last);
            }
            let start = group * LANES;
            let lanes = LANES.min(encoded.rows - start);
            for head in self.heads.iter().filter(|head| want.contains(head.column)) {
                let planes = &mut out.column_mut(head.column).planes_mut()[head.plane * encoded.rows..];
                head.output.write::<FMA>(last, lanes, planes, encoded.rows, start);
            }
        }
    }

    /// What the layers read of a time.
    #[inline(always)]
    fn of_time<const FMA: bool>(&self, time: f32) -> Vec<CacheLine> {
        let mut now: Vec<CacheLine> =
            sines(time, self.octaves).into_iter().map(|value| CacheLine([value; LANES])).collect();
        if let Some([first, last]) = &self.time {
            let (mut hidden, mut planes) = (Vec::new(), vec![0.0; last.outputs]);
            first.activate::<FMA>(&now, &mut hidden);
            last.write::<FMA>(&hidden, 1, &mut planes, 1, 0);
            now = planes.into_iter().map(|value| CacheLine([value; LANES])).collect();
        }
        now
    }

    /// Forward once, and back for each output of the heads of positions.
    #[inline(always)]
    fn differentiate<const FMA: bool>(&self, encoded: &Encoded, time: f32, out: &mut Column) {
        let of_time = self.of_time::<FMA>(time);
        let encodings = PLACE + of_time.len();
        let mut kept: Vec<Vec<CacheLine>> = vec![Vec::new(); self.layers.len()];
        let (mut input, mut by, mut spare, mut of_place) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for (group, place) in encoded.values.chunks_exact(PLACE).enumerate() {
            input.clear();
            input.extend_from_slice(place);
            input.extend_from_slice(&of_time);
            for (k, layer) in self.layers.iter().enumerate() {
                let (before, now) = kept.split_at_mut(k);
                let before = before.last().map_or(&[][..], |before| &before[..]);
                if layer.joins {
                    input.truncate(encodings);
                    input.extend_from_slice(&before[..self.layers[k - 1].linear.outputs]);
                }
                layer.linear.activate::<FMA>(if k == 0 || layer.joins { &input } else { before }, &mut now[0]);
            }
            let start = group * LANES;
            let lanes = LANES.min(encoded.rows - start);
            let heads = self.heads.iter().filter(|head| head.column == Columns::POSITION);
            for (head, component) in heads.flat_map(|head| (0..head.output.outputs).map(move |o| (head, o))) {
                by.clear();
                by.resize(head.output.padded_outputs(), CacheLine([0.0; LANES]));
                by[component] = CacheLine([1.0; LANES]);
                of_place.clear();
                of_place.resize(PLACE, CacheLine([0.0; LANES]));
                head.output.pull::<FMA>(&by, kept.last().map(Vec::as_slice), &mut spare);
                std::mem::swap(&mut by, &mut spare);
                for (k, layer) in self.layers.iter().enumerate().rev() {
                    // What a layer that joins reads first is no output of a ReLU.
                    let before = k.checked_sub(1).map(|before| &kept[before][..]);
                    layer.linear.pull::<FMA>(&by, before.filter(|_| !layer.joins), &mut spare);
                    std::mem::swap(&mut by, &mut spare);
                    if k == 0 || layer.joins {
                        add(&by[..PLACE], &mut of_place);
                    }
                    if let Some(before) = before.filter(|_| layer.joins) {
                        by.drain(..encodings);
                        by.resize(before.len(), CacheLine([0.0; LANES]));
                        by.iter_mut().zip(before).for_each(|(by, kept)| keep_positive(by, kept));
                    }
                }
                for axis in 0..3 {
                    let slope = along(axis, place, &of_place);
                    let plane = out.plane_mut(3 * (head.plane + component) + axis);
                    plane[start..][..lanes].copy_from_slice(&slope.0[..lanes]);
                }
            }
        }
    }
}

/// A time as the network reads it.
fn finite(time: f64) -> Result<f32> {
    match time.is_finite() {
        true => Ok(time as f32),
        false => Err(Error::internal(format!("a deformation network has no state at time {time}"))),
    }
}

/// `[v, sin(v), cos(v), sin(2v), cos(2v), …]`.
fn sines(value: f32, octaves: usize) -> Vec<f32> {
    let mut all = Vec::with_capacity(1 + 2 * octaves);
    all.push(value);
    let (mut sine, mut cosine) = f64::from(value).sin_cos();
    for _ in 0..octaves {
        all.extend([sine as f32, cosine as f32]);
        (sine, cosine) = (2.0 * sine * cosine, (cosine - sine) * (cosine + sine));
    }
    all
}

#[inline(always)]
fn add(of: &[CacheLine], to: &mut [CacheLine]) {
    for (to, of) in to.iter_mut().zip(of) {
        to.0.iter_mut().zip(&of.0).for_each(|(to, of)| *to += of);
    }
}

#[inline(always)]
fn keep_positive(by: &mut CacheLine, kept: &CacheLine) {
    by.0.iter_mut().zip(&kept.0).for_each(|(by, &kept)| *by = if kept > 0.0 { *by } else { 0.0 });
}

/// From derivatives by encoded values, which are `place`, to those along one axis.
#[inline(always)]
fn along(axis: usize, place: &[CacheLine], by: &[CacheLine]) -> CacheLine {
    let mut sum = by[axis];
    for k in 0..OCTAVES {
        let (sine, cosine) = (3 * (2 * k + 1) + axis, 3 * (2 * k + 2) + axis);
        let times = (1 << k) as f32;
        for lane in 0..LANES {
            let turned = place[cosine].0[lane] * by[sine].0[lane] - place[sine].0[lane] * by[cosine].0[lane];
            sum.0[lane] += times * turned;
        }
    }
    sum
}

#[cfg(test)]
mod tests;
