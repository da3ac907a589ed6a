//! Extent of a scene, computed without outliers. Lengths that are given relative to the size of the scene have this
//! extent as their unit.

use glam::DVec3;

use crate::AttributeValues;

/// Box between the 1st and the 99th percentile of the positions along each axis. A few floaters (stray Gaussians far
/// from the scene) do not enlarge this box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RobustBox {
    /// 1st percentile of the positions along each axis, scene units.
    pub low: DVec3,
    /// Median of the positions along each axis, scene units.
    pub median: DVec3,
    /// 99th percentile of the positions along each axis, scene units.
    pub high: DVec3,
}

impl RobustBox {
    /// Computes the box of the positions `position` (`[3, N]`). Percentiles are nearest ranks among the finite values.
    /// An axis without finite values gets percentiles of 0.
    pub fn from_positions(position: &AttributeValues) -> RobustBox {
        let mut found = RobustBox { low: DVec3::ZERO, median: DVec3::ZERO, high: DVec3::ZERO };
        for axis in 0..3 {
            let mut values: Vec<f32> = position.plane(axis).iter().copied().filter(|x| x.is_finite()).collect();
            let mut percentile = |p: usize| -> f64 {
                if values.is_empty() {
                    return 0.0;
                }
                let rank = (values.len() * p).div_ceil(100).max(1) - 1;
                (*values.select_nth_unstable_by(rank, f32::total_cmp).1).into()
            };
            found.low[axis] = percentile(1);
            found.median[axis] = percentile(50);
            found.high[axis] = percentile(99);
        }
        found
    }

    /// Returns the longest side of the box in scene units, or 1 if all sides are 0, so that lengths can be divided by
    /// it.
    pub fn extent(&self) -> f64 {
        let longest = (self.high - self.low).max_element();
        if longest > 0.0 { longest } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floaters_and_nan_do_not_enlarge_the_box() {
        let mut position = AttributeValues::zeros(3, 1000);
        for i in 0..1000 {
            position.set_row(i, [i as f32, 2.0, -(i as f32)]);
        }
        position.set_row(0, [-1e9, f32::NAN, f32::INFINITY]);
        let found = RobustBox::from_positions(&position);
        assert_eq!(found.low, DVec3::new(9.0, 2.0, -990.0));
        assert_eq!(found.high.x, 989.0);
        assert_eq!(found.extent(), 980.0);
    }

    #[test]
    fn extent_of_an_empty_or_flat_scene_is_one() {
        assert_eq!(RobustBox::from_positions(&AttributeValues::zeros(3, 0)).extent(), 1.0);
        assert_eq!(RobustBox::from_positions(&AttributeValues::zeros(3, 7)).extent(), 1.0);
    }
}
