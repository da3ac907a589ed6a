//! The field's derivative: how the state changes with raw parameters.
//!
//! state = raw + delta(position, time), so a position's state changes as it does and, through its own delta, by ∂delta/
//! ∂position: for each of its three components head and trunk transposed, with the masks of their ReLUs, then the planes.
//! Through the deltas of other columns nothing changes: that is worth less than 0.1 dB of a refinement and costs most of
//! the field's time. Data in: raw positions and rotations. Data out: a [`Jacobian`]. Memory: that, and one group of
//! [`LANES`] Gaussians. Derived in method.md, section 8.2.

use super::deltas::{Deltas, finite};
use super::field::{Field, Head, Mask, Scratch, add_frequencies, place_features};
use super::linear::{CacheLine, LANES, Linear};
use splat_core::error::{Error, Result};
use splat_core::{Column, Columns, Gaussians, Jacobian};

/// Derivatives and activations of one group of Gaussians.
#[derive(Default)]
struct JacobianGroup {
    features: Vec<CacheLine>,
    /// Derivatives of the planes' features by position, by axis.
    slopes: [Vec<CacheLine>; 3],
    /// Of every layer, as ReLU left them.
    trunk: Vec<Vec<CacheLine>>,
    hidden: Vec<CacheLine>,
    /// By what the last step reads.
    by: Vec<CacheLine>,
    spare: Vec<CacheLine>,
}

impl Field {
    /// How the columns `want` of the state at `time` of a block of Gaussians change with their raw parameters. `raw` has
    /// rows in position, and in rotation where `want` has it. A value that would not be finite is 0, of a position that of no
    /// delta.
    ///
    /// Under a mask (`static_mlp`, `empty_voxel`) masks and deltas count as constant: a position's state changes by the
    /// mask times its change.
    ///
    /// # Errors
    /// A time that is not finite.
    pub fn jacobian(&self, raw: &Gaussians, time: f64, want: Columns) -> Result<Jacobian> {
        if !time.is_finite() {
            return Err(Error::internal(format!("a deformation field has no state at time {time}")));
        }
        let want = self.config.active & want;
        let mut found = Jacobian::default();
        if let Mask::None = self.mask {
            let head = self.heads.iter().find(|head| head.column == Some(Columns::POSITION));
            if let Some(head) = head.filter(|_| want.contains(Columns::POSITION)) {
                *found.column_mut(Columns::POSITION) = self.of_position(head, &raw.position, time as f32);
            }
        }
        let held = match self.mask {
            Mask::None if self.config.apply_rotation => want & Columns::ROTATION,
            Mask::None => Columns::empty(),
            Mask::Head | Mask::Voxel(_) => want,
        };
        if !held.is_empty() {
            let mut deltas = Deltas::new(raw.sh_degree());
            self.deltas(&self.prepare(&raw.position), time, held, &mut Scratch::default(), &mut deltas)?;
            deltas.jacobian(&raw.rotation, &mut found);
        }
        Ok(found)
    }

    /// How positions change.
    fn of_position(&self, head: &Head, position: &Column, time: f32) -> Column {
        let mut out = Column::zeros(9, position.len());
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            // SAFETY: the line above saw that this processor has AVX2 and FMA.
            unsafe { self.of_groups_fma(head, position, time, &mut out) };
            return out;
        }
        self.of_groups::<false>(head, position, time, &mut out);
        out
    }

    /// [`Field::of_groups`] compiled for AVX2 and FMA.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn of_groups_fma(&self, head: &Head, position: &Column, time: f32, out: &mut Column) {
        self.of_groups::<true>(head, position, time, out);
    }

    /// Group by group; inlined, with all it calls, into each instruction set's copy.
    #[inline(always)]
    fn of_groups<const FMA: bool>(&self, head: &Head, position: &Column, time: f32, out: &mut Column) {
        let lines = self.planes.as_ref().map_or(Vec::new(), |planes| planes.lines(time));
        let mut group = JacobianGroup::default();
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

            for component in 0..3 {
                group.by.clear();
                group.by.resize(head.output.padded_outputs(), CacheLine([0.0; LANES]));
                group.by[component] = CacheLine([1.0; LANES]);
                group.backward::<FMA>(self, head);
                if self.planes.is_some() && self.config.grid_pe > 1 {
                    pull_frequencies(&group.features, self.config.grid_pe as f32, &mut group.by);
                }
                for axis in 0..3 {
                    let parts = match &self.planes {
                        Some(_) => group.along(axis),
                        None => group.by[axis],
                    };
                    let of_raw = f32::from(u8::from(component == axis));
                    let out = &mut out.plane_mut(3 * component + axis)[rows.clone()];
                    out.iter_mut().zip(parts.0).for_each(|(out, part)| *out = of_raw + finite(part));
                }
            }
        }
    }
}

impl JacobianGroup {
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
    fn along(&self, axis: usize) -> CacheLine {
        let mut sums = CacheLine([0.0; LANES]);
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
        let JacobianGroup { trunk, hidden, by, spare, .. } = self;
        let mut step = |layer: &Linear, kept: Option<&[CacheLine]>| {
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
fn pull_frequencies(features: &[CacheLine], p: f32, by: &mut [CacheLine]) {
    let n = features.len() / 3;
    for c in 0..n {
        for lane in 0..LANES {
            let (sine, cosine) = (features[n + c].0[lane], features[2 * n + c].0[lane]);
            let turned = cosine * by[n + c].0[lane] - sine * by[2 * n + c].0[lane];
            by[c].0[lane] += p * turned;
        }
    }
}
