//! Stored parameters of the Gaussians of a dynamic model. The model format defines how the attributes at each frame are
//! computed from these parameters.

use serde::{Deserialize, Serialize};

use super::{AttributeValues, Attributes, Gaussians};

/// Stored parameters of N Gaussians, from which a model format computes their attributes at every time.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct StoredParams {
    /// Stored parameters that every model format has: position, rotation, log scales, opacity logit and SH
    /// coefficients.
    pub gaussians: Gaussians,
    /// Further parameters that only this model format has (velocities, time windows, features): one plane per
    /// parameter, with its value for every Gaussian, in an order that the format defines. Has no planes if there are
    /// none.
    #[serde(rename = "own")]
    pub format_specific: AttributeValues,
}

impl StoredParams {
    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.gaussians.len()
    }

    /// Returns whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.gaussians.is_empty()
    }

    /// Returns the parameters of the Gaussians with the indices `rows`, in the order of `rows`.
    pub fn pick(&self, rows: &[u32]) -> StoredParams {
        StoredParams { gaussians: self.gaussians.pick(rows), format_specific: self.format_specific.pick(rows) }
    }

    /// Copies the parameters of Gaussian `row` of `from` to Gaussian `to` of `self`. `from` must have at least as many
    /// values per Gaussian as `self`.
    pub fn set_row(&mut self, to: usize, from: &StoredParams, row: usize) {
        let set = |column: &mut AttributeValues, from: &AttributeValues| {
            (0..column.width()).for_each(|c| column.plane_mut(c)[to] = from.plane(c)[row]);
        };
        for column in Attributes::all().iter() {
            set(self.gaussians.attribute_values_mut(column), from.gaussians.attribute_values(column));
        }
        set(&mut self.format_specific, &from.format_specific);
    }
}

impl From<Gaussians> for StoredParams {
    /// Creates the stored parameters of a model format that has no parameters besides the attributes `gaussians`.
    fn from(gaussians: Gaussians) -> StoredParams {
        let own = AttributeValues::zeros(0, gaussians.len());
        StoredParams { gaussians, format_specific: own }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pick_and_set_row_copy_all_parameters() {
        let mut raw = StoredParams { gaussians: Gaussians::zeros(3, 1), format_specific: AttributeValues::zeros(2, 3) };
        raw.gaussians.selected_attribute_values_mut(Attributes::all()).for_each(|column| {
            column.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = k as f32);
        });
        raw.format_specific.set_row(2, [7.0, 8.0]);
        let picked = raw.pick(&[2, 0]);
        assert_eq!(
            (picked.len(), picked.format_specific.row(0), picked.gaussians.position.row(0)),
            (2, [7.0, 8.0], [2.0, 5.0, 8.0])
        );
        let mut other = raw.clone();
        other.set_row(1, &picked, 0);
        assert_eq!(other.pick(&[1]), raw.pick(&[2]));
        let plain = StoredParams::from(raw.gaussians.clone()).pick(&[1]);
        assert_eq!(
            (plain.format_specific.width(), plain.format_specific.len(), plain.gaussians),
            (0, 1, raw.gaussians.pick(&[1]))
        );
    }
}
