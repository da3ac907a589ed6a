//! The field's derivative: from ∂L/∂ state to ∂L/∂ raw parameters.
//!
//! state = raw + delta(position, time), so a position takes what its state takes and, through the position's delta,
//! (∂delta/∂position)ᵀ of that: head and trunk transposed, with the masks of their ReLUs, then the planes. Through the
//! deltas of other columns it takes nothing: that is worth less than 0.1 dB of a refinement and costs most of the
//! field's time. Data in: canonical positions and derivatives by the state. Data out: the same derivatives, changed in
//! place. Memory: positions of a span, and one group of [`LANES`] Gaussians. Derived in method.md, section 8.2.

use super::deltas::Deltas;
use super::field::{Field, Head, Mask, Scratch, add_frequencies, place_features};
use super::linear::{LANES, Lanes, Linear};
use crate::error::{Error, Result};
use crate::model::{Column, Columns, Gaussians, GradientSpan};

/// Derivatives and activations of one group of Gaussians.
#[derive(Default)]
struct Group {
    features: Vec<Lanes>,
    /// Derivatives of the planes' features by position, by axis.
    slopes: [Vec<Lanes>; 3],
    /// Of every layer, as ReLU left them.
    trunk: Vec<Vec<Lanes>>,
    hidden: Vec<Lanes>,
    /// By what the last step reads.
    by: Vec<Lanes>,
    spare: Vec<Lanes>,
}

impl Field {
    /// Turns `gradients`, derivatives by the state at `time` of some Gaussians of `raw`, into derivatives by their raw
    /// parameters.
    ///
    /// Under a mask (`static_mlp`, `empty_voxel`) masks and deltas count as constant: a position takes what its state
    /// takes times the mask and nothing through the field. Moving it by that alone is worse than leaving it where it
    /// is.
    ///
    /// # Errors
    /// A time that is not finite.
    pub fn pull_back(&self, raw: &Gaussians, time: f64, gradients: &mut GradientSpan<'_>) -> Result<()> {
        if !time.is_finite() {
            return Err(Error::usage(format!("a deformation field has no state at time {time}")));
        }
        let active = self.config.active & gradients.columns();
        let rows: Vec<u32> = gradients.ids().map(|id| id as u32).collect();
        if let Mask::None = self.mask {
            let head = self.heads.iter().find(|head| head.column == Some(Columns::POSITION));
            if let Some(head) = head.filter(|_| active.contains(Columns::POSITION)) {
                self.pull_position(head, &raw.position.pick(&rows), time as f32, gradients);
            }
        }
        let held = match self.mask {
            Mask::None if self.config.apply_rotation => active & Columns::ROTATION,
            Mask::None => Columns::empty(),
            Mask::Head | Mask::Voxel(_) => active,
        };
        if !held.is_empty() {
            let mut deltas = Deltas::new(raw.sh_degree());
            self.deltas(&self.prepare(&raw.position.pick(&rows)), time, held, &mut Scratch::default(), &mut deltas)?;
            deltas.pull_back(&raw.rotation.pick(&rows), gradients);
        }
        Ok(())
    }

    /// Adds what canonical positions take through their deltas. `position` is that of the Gaussians of `gradients`.
    fn pull_position(&self, head: &Head, position: &Column, time: f32, gradients: &mut GradientSpan<'_>) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            // SAFETY: the line above saw that this processor has AVX2 and FMA.
            unsafe { self.pull_groups_fma(head, position, time, gradients) };
            return;
        }
        self.pull_groups::<false>(head, position, time, gradients);
    }

    /// [`Field::pull_groups`] compiled for AVX2 and FMA.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn pull_groups_fma(&self, head: &Head, position: &Column, time: f32, gradients: &mut GradientSpan<'_>) {
        self.pull_groups::<true>(head, position, time, gradients);
    }

    /// Group by group; inlined, with all it calls, into each instruction set's copy.
    #[inline(always)]
    fn pull_groups<const FMA: bool>(
        &self,
        head: &Head,
        position: &Column,
        time: f32,
        gradients: &mut GradientSpan<'_>,
    ) {
        let lines = self.planes.as_ref().map_or(Vec::new(), |planes| planes.lines(time));
        let mut group = Group::default();
        for start in (0..position.len()).step_by(LANES) {
            let rows = start..position.len().min(start + LANES);
            let places = [0, 1, 2].map(|axis| &position.plane(axis)[rows.clone()]);
            match &self.planes {
                Some(planes) => planes.sloped(places, &lines, &mut group.features, &mut group.slopes),
                None => place_features(places, time, &mut group.features),
            }
            if self.planes.is_some() && self.config.grid_pe > 1 {
                add_frequencies(&mut group.features, self.config.grid_pe as f32);
            }
            group.forward::<FMA>(self, head);

            group.by.clear();
            group.by.resize(head.output.padded_outputs(), Lanes([0.0; LANES]));
            for (by, plane) in group.by.iter_mut().zip(gradients.planes(Columns::POSITION).iter()) {
                by.0[..rows.len()].copy_from_slice(&plane[rows.clone()]);
            }
            group.backward::<FMA>(self, head);
            if self.planes.is_some() && self.config.grid_pe > 1 {
                pull_frequencies(&group.features, self.config.grid_pe as f32, &mut group.by);
            }
            let first = gradients.ids().start + start;
            for axis in 0..3 {
                let parts = match &self.planes {
                    Some(_) => group.along(axis),
                    None => group.by[axis],
                };
                gradients.add(Columns::POSITION, axis, first, parts.0[..rows.len()].iter().copied());
            }
        }
    }
}

impl Group {
    /// Activations from features.
    #[inline(always)]
    fn forward<const FMA: bool>(&mut self, field: &Field, head: &Head) {
        self.trunk.resize(field.trunk.len(), Vec::new());
        let mut input = &self.features;
        for (layer, out) in field.trunk.iter().zip(&mut self.trunk) {
            layer.activate::<FMA>(input, out);
            input = out;
        }
        head.hidden.activate::<FMA>(input, &mut self.hidden);
    }

    /// From derivatives by the planes' features to those by one axis.
    #[inline(always)]
    fn along(&self, axis: usize) -> Lanes {
        let mut sums = Lanes([0.0; LANES]);
        for (by, slope) in self.by.iter().zip(&self.slopes[axis]) {
            for lane in 0..LANES {
                sums.0[lane] += by.0[lane] * slope.0[lane];
            }
        }
        sums
    }

    /// From derivatives by the head's outputs to those by features.
    #[inline(always)]
    fn backward<const FMA: bool>(&mut self, field: &Field, head: &Head) {
        let Group { trunk, hidden, by, spare, .. } = self;
        let mut step = |layer: &Linear, kept: Option<&[Lanes]>| {
            layer.pull::<FMA>(by, kept, spare);
            std::mem::swap(by, spare);
        };
        step(&head.output, Some(hidden));
        step(&head.hidden, trunk.last().map(Vec::as_slice));
        for (k, layer) in field.trunk.iter().enumerate().rev() {
            step(layer, k.checked_sub(1).map(|before| &trunk[before][..]));
        }
    }
}

/// From derivatives by `[f, sin(p·f), cos(p·f)]`, which are `features`, to those by f, in the first third of `by`.
fn pull_frequencies(features: &[Lanes], p: f32, by: &mut [Lanes]) {
    let n = features.len() / 3;
    for c in 0..n {
        for lane in 0..LANES {
            let (sine, cosine) = (features[n + c].0[lane], features[2 * n + c].0[lane]);
            let turned = cosine * by[n + c].0[lane] - sine * by[2 * n + c].0[lane];
            by[c].0[lane] += p * turned;
        }
    }
}
