//! Error check for lossy file formats: compares the values that a file will store (after quantization) with the
//! original values.
//!
//! Input: pairs of original and stored attributes of each Gaussian. Output: the largest errors, or an error that names
//! the Gaussian furthest beyond its bound. A Gaussian whose original and stored opacity are both below 1/255 is never
//! drawn and is not checked.
//!
//! | quantity | maximum error |
//! |---|---|
//! | position | half the median of the Gaussian's three scales, or 1/100 of the scene size if that is larger |
//! | scale | 1/10 of its value, or 1/100 of the scene size if that is larger |
//! | opacity, base color | 1/50 |
//! | SH coefficients above degree 0 | 1 |
//!
//! The scene size is the median distance of the Gaussians from their median position, so a single far Gaussian does not
//! change it. The distance of two positions is the largest of the differences along x, y and z.
//!
//! One exception: a stored scale may be smaller than the original one by any amount if it is still at least ten times
//! the distance from the Gaussian's center to the far side of the scene. This distance is the scene size, which must
//! not be 0, plus the distance of the center from the median position. Along such an axis the density falls by less
//! than 1/200 within the scene, whatever the scale is. Captured scenes have such Gaussians. Formats with a maximum
//! scale, such as `.spz`, store the maximum for them.

use std::path::Path;

use crate::error::{Error, Result, ShowPath};
use crate::model::{AttributeValues, Gaussians, color_from_sh, opacity};

/// Maximum error of a position, as a fraction of the median of the Gaussian's three scales.
const MAX_POSITION_ERROR_IN_SCALES: f64 = 0.5;
/// Lower limit of the maximum error of positions and scales, as a fraction of the scene size. An error up to this limit
/// is allowed for every Gaussian, however small it is.
const MAX_ERROR_IN_SCENE_SIZES: f64 = 0.01;
/// Maximum error of a scale, as a fraction of its value.
const MAX_RELATIVE_SCALE_ERROR: f64 = 0.1;
/// Ratio of a stored scale to the distance from the Gaussian's center to the far side of the scene. At this ratio or
/// above, the exact value of the scale does not matter.
const FLAT_SCALE: f64 = 10.0;
/// Maximum error of opacities and base colors, which are in [0, 1].
const MAX_COLOR_ERROR: f64 = 0.02;
/// Maximum error of an SH coefficient above degree 0. A color is a sum of such coefficients times basis functions.
const MAX_SH_ERROR: f64 = 1.0;
/// Distance from the median position, in scene sizes, beyond which a message names a Gaussian as far from all others.
const FAR_IN_SCENE_SIZES: f64 = 1000.0;
/// Opacity below which a Gaussian is not drawn.
const MIN_OPACITY: f64 = 1.0 / 255.0;

/// Attributes of one Gaussian after activation, as a renderer uses them.
#[derive(Debug, Clone, Copy)]
pub struct RenderedAttributes {
    /// Position in scene units.
    pub position: [f64; 3],
    /// Standard deviations along the three axes, in scene units.
    pub scale: [f64; 3],
    /// Opacity in [0, 1].
    pub opacity: f64,
    /// Base color: red, green, blue.
    pub color: [f64; 3],
}

impl RenderedAttributes {
    /// Returns the position, scales, opacity and base color of Gaussian `row` of `state`, with the activation functions
    /// applied.
    pub fn from_state(state: &Gaussians, row: usize) -> RenderedAttributes {
        RenderedAttributes {
            position: state.position_f64(row),
            scale: state.scales_f64(row),
            opacity: opacity(state.opacity_logit.row::<1>(row)[0]),
            color: state.sh.row::<3>(row).map(color_from_sh),
        }
    }

    /// Returns the median of the Gaussian's three scales.
    fn median_scale(&self) -> f64 {
        let mut scale = self.scale;
        scale.sort_unstable_by(f64::total_cmp);
        scale[1]
    }
}

/// Checks that all positions in `state` are finite. `kind` names the file `path` in the message, for example "a .spz".
///
/// # Errors
/// Returns [`Error::Usage`], which names a Gaussian whose position is not finite.
pub fn check_positions(state: &Gaussians, path: &Path, kind: &str) -> Result<()> {
    let Some(at) = state.position.planes().iter().position(|x| !x.is_finite()) else { return Ok(()) };
    let id = at % state.len();
    Err(Error::usage(format!(
        "{}: the position of Gaussian {id} is not finite, which {kind} cannot store",
        path.shown()
    )))
}

/// Coding error of one attribute of Gaussian `id` that exceeds its allowed maximum `bound`. `error` is the magnitude of
/// the difference between the original and the stored value. `quantity` is the name of the attribute for messages.
#[derive(Debug, Clone, Copy)]
struct Excess {
    id: usize,
    quantity: &'static str,
    error: f64,
    bound: f64,
}

/// Largest coding errors of a file, collected Gaussian by Gaussian.
#[derive(Debug)]
pub struct CodingErrors {
    /// Median position of the Gaussians, in scene units.
    middle: [f64; 3],
    /// Scene size: median distance of the Gaussians from their median position, in scene units.
    scene: f64,
    /// Index of the Gaussian that is furthest from the median position of all Gaussians. A message about a position
    /// error names it, because such an outlier enlarges the range in which positions are stored.
    furthest: usize,
    /// Largest error of a position so far, in scene units.
    position: f64,
    /// Number of Gaussians with a scale that is stored too small by more than its bound. This is allowed, because the
    /// stored scale is still at least ten times the distance from the Gaussian to the far side of the scene.
    reduced_scales: usize,
    /// Error that exceeds its allowed maximum by the largest factor; `None` if no error exceeds its maximum.
    worst: Option<Excess>,
}

impl CodingErrors {
    /// Creates a record of coding errors that has no errors yet. `positions` holds the positions of all Gaussians of
    /// the file. They determine the scene size, on which the bounds of position and scale errors depend.
    pub fn new(positions: &AttributeValues) -> CodingErrors {
        let count = positions.len();
        let axis = |axis: usize| positions.plane(axis).iter().map(|&x| f64::from(x));
        let middle = [0, 1, 2].map(|k| median(axis(k).collect()));
        let distances: Vec<f64> = (0..count).map(|i| distance(positions.row::<3>(i).map(f64::from), middle)).collect();
        let furthest = (0..count).max_by(|&a, &b| distances[a].total_cmp(&distances[b])).unwrap_or(0);
        CodingErrors { middle, scene: median(distances), furthest, position: 0.0, reduced_scales: 0, worst: None }
    }

    /// Returns the largest position error among the Gaussians added so far, in scene units.
    pub fn position_error(&self) -> f64 {
        self.position
    }

    /// Returns the number of Gaussians added so far with a scale that is stored too small by more than its bound. This
    /// is allowed, because the stored scale is still at least ten times the distance from the Gaussian to the far side
    /// of the scene.
    pub fn reduced_scales(&self) -> usize {
        self.reduced_scales
    }

    /// Compares the original attributes `expected` of Gaussian `id` with its stored attributes `actual` and records the
    /// errors. Ignores a Gaussian whose opacity is below 1/255 in both.
    pub fn add(&mut self, id: usize, expected: &RenderedAttributes, actual: &RenderedAttributes) {
        if expected.opacity < MIN_OPACITY && actual.opacity < MIN_OPACITY {
            return;
        }
        let scene_bound = MAX_ERROR_IN_SCENE_SIZES * self.scene;
        let largest = |errors: [f64; 3]| {
            errors.into_iter().fold(0.0, |most: f64, x| if x > most || x.is_nan() { x } else { most })
        };
        let max_difference = |a: [f64; 3], b: [f64; 3]| largest([0, 1, 2].map(|k| (a[k] - b[k]).abs()));
        let position_error = max_difference(expected.position, actual.position);
        self.position = largest([self.position, position_error, 0.0]);
        // Clamp colors to [0, 1] before comparing them, as a screen does.
        let [before, after] = [expected, actual].map(|drawn| drawn.color.map(|c| c.clamp(0.0, 1.0)));
        self.check_error(
            id,
            "position",
            position_error,
            scene_bound.max(MAX_POSITION_ERROR_IN_SCALES * expected.median_scale()),
        );
        let flat = FLAT_SCALE * (self.scene + distance(expected.position, self.middle));
        let mut is_reduced = false;
        for (before, after) in expected.scale.into_iter().zip(actual.scale) {
            let (error, bound) = ((before - after).abs(), scene_bound.max(MAX_RELATIVE_SCALE_ERROR * before));
            // False for NaN.
            let is_flat = self.scene > 0.0 && flat <= after && after <= before;
            if is_flat {
                is_reduced |= error > bound;
            } else {
                self.check_error(id, "scale", error, bound);
            }
        }
        self.reduced_scales += usize::from(is_reduced);
        self.check_error(id, "opacity", (expected.opacity - actual.opacity).abs(), MAX_COLOR_ERROR);
        self.check_error(id, "color", max_difference(before, after), MAX_COLOR_ERROR);
    }

    /// Records `error`, the magnitude of the difference between the original and the stored value of one SH coefficient
    /// above degree 0 of Gaussian `id`.
    pub fn add_sh(&mut self, id: usize, error: f64) {
        self.check_error(id, "SH coefficient", error, MAX_SH_ERROR);
    }

    /// Compares `error` with its maximum `bound`. Records the error as the worst one if it exceeds `bound` by a larger
    /// factor than every earlier error exceeds its own bound. `quantity` names the attribute of Gaussian `id` for
    /// messages.
    fn check_error(&mut self, id: usize, quantity: &'static str, error: f64, bound: f64) {
        let excess = |e: &Excess| if e.error.is_nan() { f64::INFINITY } else { e.error / e.bound };
        let now = Excess { id, quantity, error, bound };
        // `!is_within` rather than `error > bound`, so that NaN counts as beyond every bound.
        let is_within = error <= bound;
        if !is_within && self.worst.is_none_or(|worst| excess(&now) > excess(&worst)) {
            self.worst = Some(now);
        }
    }

    /// Checks that no recorded error exceeds its allowed maximum. `kind` names the file in the message, for example "a
    /// .spz".
    ///
    /// # Errors
    /// Fails if an error exceeds its maximum. The message names the Gaussian, the error and a remedy.
    pub fn check(&self, kind: &str) -> Result<()> {
        let Some(Excess { id, quantity, error, bound }) = self.worst else { return Ok(()) };
        let unit = if matches!(quantity, "position" | "scale") { " scene units" } else { "" };
        let why = match quantity {
            "position" => format!(
                "\n  Gaussian {} is the furthest from the others: drop it (compress --drop-ids), or write a .ply or .gseq",
                self.furthest
            ),
            _ => "\n  drop it (compress --drop-ids), or write a .ply or .gseq".to_owned(),
        };
        Err(Error::usage(format!(
            "{kind} cannot store the {quantity} of Gaussian {id} of the output accurately: expected an error of at most \
             {bound:.2e}{unit}, found {error:.2e}{why}"
        )))
    }
}

/// Names the Gaussians that are far from all others: further from the median position than [`FAR_IN_SCENE_SIZES`] times
/// the median distance. `positions` has one row per Gaussian, or several; `id` returns the index of the Gaussian of a
/// row. Returns for example "Gaussian 7 at (90000, 0.2, 1)", with at most three Gaussians; `None` if none is far.
pub fn far_gaussians(positions: &AttributeValues, id: impl Fn(usize) -> usize) -> Option<String> {
    let CodingErrors { middle, scene, .. } = CodingErrors::new(positions);
    let far_distance = FAR_IN_SCENE_SIZES * scene;
    let is_far = |&row: &usize| scene > 0.0 && distance(positions.row(row).map(f64::from), middle) > far_distance;
    let rows = (0..positions.len()).filter(is_far);
    let mut far: Vec<(usize, [f32; 3])> = rows.map(|row| (id(row), positions.row(row))).collect();
    far.sort_by_key(|found| found.0);
    far.dedup_by_key(|found| found.0);
    let named = far.iter().take(3).map(|(id, [x, y, z])| format!("Gaussian {id} at ({x}, {y}, {z})"));
    let mut text = named.collect::<Vec<_>>().join(", ");
    if far.len() > 3 {
        text.push_str(&format!(" and {} more", far.len() - 3));
    }
    (!far.is_empty()).then_some(text)
}

/// Returns the largest of the differences of two positions along x, y and z.
fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| (a[k] - b[k]).abs()).fold(0.0, f64::max)
}

/// Returns the median of the finite values among `values` (the lower one of two middle values); 0 if none is finite.
fn median(mut values: Vec<f64>) -> f64 {
    values.retain(|value| value.is_finite());
    if values.is_empty() {
        return 0.0;
    }
    let middle = (values.len() - 1) / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(x: f64, scale: f64) -> RenderedAttributes {
        RenderedAttributes { position: [x, 0.0, 0.0], scale: [scale; 3], opacity: 0.5, color: [0.5; 3] }
    }

    /// Returns a record of coding errors for six Gaussians on a line: five with a spacing of 2, and one far away. The
    /// scene size is 2.
    fn accuracy() -> CodingErrors {
        let mut positions = AttributeValues::zeros(3, 6);
        positions.plane_mut(0).copy_from_slice(&[0.0, 2.0, 4.0, 6.0, 8.0, 1e7]);
        CodingErrors::new(&positions)
    }

    #[test]
    fn far_gaussian_does_not_widen_the_bound() {
        let mut found = accuracy();
        found.add(1, &drawn(2.0, 1e-3), &drawn(2.019, 1e-3));
        found.check("a file").unwrap();
        assert!((found.position_error() - 0.019).abs() < 1e-12);
        found.add(2, &drawn(4.0, 1e-3), &drawn(4.5, 1e-3));
        let message = found.check("a file").unwrap_err().to_string();
        let parts =
            ["position of Gaussian 2", "at most 2.00e-2 scene units", "found 5.00e-1", "Gaussian 5 is the furthest"];
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    }

    #[test]
    fn scales_far_beyond_the_scene_are_not_checked() {
        // Median position 4, scene size 2: the far side of the scene is 4 from the Gaussian at 2.
        let mut found = accuracy();
        found.add(1, &drawn(2.0, 500.0), &drawn(2.0, 40.1));
        found.add(2, &drawn(2.0, 500.0), &drawn(2.0, 499.0));
        found.check("a file").unwrap();
        assert_eq!(found.reduced_scales(), 1);
        for (wanted, stored) in [(500.0, 39.9), (39.9, 500.0), (500.0, f64::NAN)] {
            let mut found = accuracy();
            found.add(1, &drawn(2.0, wanted), &drawn(2.0, stored));
            found.check("a file").unwrap_err();
        }
    }

    #[test]
    fn large_gaussians_may_move_by_half_of_their_scale() {
        let mut found = accuracy();
        found.add(0, &drawn(0.0, 3.0), &drawn(1.5, 3.0));
        found.check("a file").unwrap();
        found.add(0, &drawn(0.0, 3.0), &drawn(1.51, 3.0));
        found.check("a file").unwrap_err();
    }

    #[test]
    fn scales_opacities_colors_and_nan_have_bounds() {
        let wanted = drawn(0.0, 1.0);
        for (found, quantity) in [
            (RenderedAttributes { scale: [1.0, 1.0, 1.11], ..wanted }, "scale"),
            (RenderedAttributes { opacity: 0.53, ..wanted }, "opacity"),
            (RenderedAttributes { color: [0.5, 0.53, 0.5], ..wanted }, "color"),
            (RenderedAttributes { position: [0.0, f64::NAN, 0.0], ..wanted }, "position"),
            (RenderedAttributes { opacity: f64::NAN, ..wanted }, "opacity"),
        ] {
            let mut accuracy = accuracy();
            accuracy.add(3, &wanted, &found);
            let message = accuracy.check("a file").unwrap_err().to_string();
            assert!(message.contains(&format!("the {quantity} of Gaussian 3")), "{message}");
        }
        let mut accuracy = accuracy();
        let color = |value: f64| RenderedAttributes { color: [value; 3], ..wanted };
        accuracy.add(0, &color(7.0), &color(1.0));
        let unseen = RenderedAttributes { opacity: 0.0, ..wanted };
        accuracy.add(0, &unseen, &RenderedAttributes { position: [9.0; 3], ..unseen });
        accuracy.check("a file").unwrap();
    }
}
