//! Location of each plane (one component of an attribute, such as the x of the position) in the row of a Gaussian in a
//! PLY file.
//!
//! Input: the properties of the element `vertex`. Output: [`PlyLayout`].

use std::path::Path;

use super::header::{Element, Property};
use crate::error::{Error, Result};
use crate::model::{Attributes, MAX_SH_DEGREE, sh_coefficient_count};

/// Natural logarithm of 1/1000: the thickness that a surfel gets, as a fraction of its smaller axis. (A surfel is a
/// flat Gaussian of 2DGS. Its file has no `scale_2`.) The thickness is relative, so that results do not depend on the
/// unit of length of the scene. It is thin enough to vanish under the rasterizer's dilation of 0.3 px², and thick
/// enough to give a valid f32 covariance.
pub const THIN_LOG_SCALE: f32 = -6.907_755_4;

/// Largest SH degree that a PLY file may have.
const MAX_STORED_DEGREE: usize = 4;

/// Source of the values of one plane (component of an attribute, such as the x of the position).
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum PlaneSource {
    /// Property of the row that holds the value.
    Property(Property),
    /// No property: the missing third log scale of a surfel is min(scale_0, scale_1) + [`THIN_LOG_SCALE`].
    Thin,
}

/// Layout of a row (Gaussian) in a PLY file: for each plane (one component of an attribute, such as the x of the
/// position), the source of its values.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PlyLayout {
    /// SH degree of the Gaussians after reading, 0 to 3.
    pub(crate) sh_degree: usize,
    /// SH degree of the file, 0 to 4. Coefficients of degree 4 are left out.
    pub(crate) stored_degree: usize,
    planes: [Vec<PlaneSource>; 5],
}

impl PlyLayout {
    /// Finds, for each component of each attribute, the property of `vertex` that holds it. Other properties are
    /// ignored.
    ///
    /// # Errors
    /// Fails if a property is missing, or if the number of properties `f_rest_*` belongs to no SH degree.
    pub(crate) fn from_element(path: &Path, vertex: &Element) -> Result<PlyLayout> {
        let find = |name: &str| vertex.properties.iter().find(|property| property.name == name);
        let need = |name: &str| match find(name) {
            Some(property) => Ok(PlaneSource::Property(property.clone())),
            None => Err(missing(path, vertex, name)),
        };
        let need_all = |names: &[&str]| names.iter().map(|name| need(name)).collect::<Result<Vec<PlaneSource>>>();

        let position = need_all(&["x", "y", "z"])?;
        let mut sh = need_all(&["f_dc_0", "f_dc_1", "f_dc_2"])?;
        let opacity = need_all(&["opacity"])?;
        let mut log_scale = need_all(&["scale_0", "scale_1"])?;
        log_scale.push(find("scale_2").map_or(PlaneSource::Thin, |property| PlaneSource::Property(property.clone())));
        let rotation = need_all(&["rot_0", "rot_1", "rot_2", "rot_3"])?;

        let rest = vertex.properties.iter().filter(|property| property.name.starts_with("f_rest_")).count();
        let is_degree = |&degree: &usize| 3 * (sh_coefficient_count(degree) - 1) == rest;
        let Some(stored_degree) = (0..=MAX_STORED_DEGREE).find(is_degree) else {
            let expected = "0, 9, 24, 45 or 72 properties f_rest_* (degree 0 to 4)";
            return Err(Error::input(path, "element vertex", expected, rest.to_string())
                .hint("export the model again with whole SH degrees, or without any f_rest_*"));
        };
        let sh_degree = stored_degree.min(MAX_SH_DEGREE);
        // The file stores the SH coefficients of red, then those of green, then those of blue. A plane has the index 3
        // · coefficient + channel.
        let per_channel = rest / 3;
        for coefficient in 0..sh_coefficient_count(sh_degree) - 1 {
            for channel in 0..3 {
                sh.push(need(&format!("f_rest_{}", channel * per_channel + coefficient))?);
            }
        }
        Ok(PlyLayout { sh_degree, stored_degree, planes: [position, rotation, log_scale, opacity, sh] })
    }

    /// Returns the source of the values of each plane (component) of the attribute `column`.
    pub(crate) fn planes(&self, column: Attributes) -> &[PlaneSource] {
        let index = Attributes::all().iter().take_while(|&one| one != column).count();
        &self.planes[index]
    }
}

/// Returns the new name of the property `name` when the SH degree is reduced from `from` to `to`; `None` if the
/// property is removed.
pub(crate) fn name_at_sh_degree(name: &str, from: usize, to: usize) -> Option<String> {
    let [old_count, new_count] = [from, to.min(from)].map(|degree| sh_coefficient_count(degree) - 1);
    let Some(number) = name.strip_prefix("f_rest_").and_then(|number| number.parse::<usize>().ok()) else {
        return Some(name.to_owned());
    };
    // Avoid a division by zero: only a header with SH coefficients above degree 0 has such a name.
    let (channel, coefficient) = (number / old_count.max(1), number % old_count.max(1));
    (coefficient < new_count).then(|| format!("f_rest_{}", channel * new_count + coefficient))
}

/// Returns the error that the element `vertex` of the file `path` lacks the property `name`. If other properties show
/// what kind of file it is, the error names that kind.
fn missing(path: &Path, vertex: &Element, name: &str) -> Error {
    let has = |name: &str| vertex.properties.iter().any(|property| property.name == name);
    let names: Vec<&str> = vertex.properties.iter().map(|property| property.name.as_str()).take(80).collect();
    let hint = if has("packed_position") {
        "this is a compressed PLY; convert it to the plain layout first"
    } else if has("trbf_center") {
        "a SpacetimeGaussians model has x y z f_dc_0..2 opacity scale_0..2 rot_0..3 too"
    } else if has("red") || has("face") {
        "this looks like a point cloud or a mesh, not a trained Gaussian model: train a model from it (3DGS starts from \
         such points), and give the point_cloud.ply that the training writes"
    } else {
        "a Gaussian model has x y z f_dc_0..2 opacity scale_0..2 rot_0..3"
    };
    Error::input(path, "element vertex", format!("property {name}"), format!("only {}", names.join(" "))).hint(hint)
}
