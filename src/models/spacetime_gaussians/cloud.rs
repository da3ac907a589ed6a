//! Point cloud file of a SpacetimeGaussians model, and which of its properties hold which parameters.
//!
//! Its properties are, in any order: `x y z trbf_center trbf_scale nx ny nz motion_0..8 f_dc_0..(2|5) opacity
//! scale_0..2 rot_0..3 omega_0..3 [f_t_0..2]`. The authors' loader counts properties by name prefix, so the file may
//! have no other properties with these prefixes. Source: `save_ply`, `load_ply` of their code.

use std::path::Path;

use super::decoder::ColorActivation;
use super::frame_state::{FIRST_FEATURE, FULL_PARAM_COUNT, MOTION, OMEGA, SHARED_PARAM_COUNT};
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::files::ply::write::{put, rows_of_model, value, write_rows_like};
use crate::files::ply::{PlaneSource, Ply, PlyEncoding, PlyOptions, Property};
use crate::model::{AttributeValues, Attributes, SH_C0, StoredParams, sh_from_color};

/// Name of a property that only the point cloud files of SpacetimeGaussians have, by which these files are recognized.
pub(super) const MARKER_PROPERTY: &str = "trbf_center";

/// Opened point cloud file of a SpacetimeGaussians model.
#[derive(Debug)]
pub(super) struct PointCloudFile {
    ply: Ply,
    /// Property of the file for each parameter in [`StoredParams::format_specific`].
    parameter_properties: Vec<Property>,
}

impl PointCloudFile {
    /// Opens the PLY file at `path`.
    ///
    /// # Errors
    /// Fails if the file holds no Gaussians, or if properties are missing or too many.
    pub(super) fn open(path: &Path, options: &PlyOptions) -> Result<PointCloudFile> {
        let ply = Ply::open_with(path, options)?;
        let count_prefix =
            |prefix: &str| ply.properties().iter().filter(|property| property.name.starts_with(prefix)).count();
        let features = count_prefix("f_dc");
        let is_full = features > 3;
        let counts: [(&str, &[usize]); 8] = [
            ("f_dc", &[3, 6]),
            ("f_t", if is_full { &[3] } else { &[0] }),
            ("f_rest", &[0]),
            ("motion", &[9]),
            ("omega", &[4]),
            ("rot", &[4]),
            ("scale_", &[3]),
            ("trbf_", &[2]),
        ];
        for (prefix, expected) in counts {
            let found = count_prefix(prefix);
            if !expected.contains(&found) {
                let expected: Vec<String> = expected.iter().map(usize::to_string).collect();
                let expected = format!("{} properties that begin with {prefix}", expected.join(" or "));
                let hint = match is_full {
                    true => "the full model of SpacetimeGaussians has f_dc_0..5 and f_t_0..2",
                    false => "the lite model of SpacetimeGaussians has f_dc_0..2 and no f_t",
                };
                return Err(Error::input(path, "element vertex", expected, found.to_string()).hint(hint));
            }
        }
        let properties = parameter_property_names(is_full).into_iter().map(|name| {
            let found = ply.properties().iter().find(|property| property.name == name).cloned();
            found.ok_or_else(|| Error::input(path, "element vertex", format!("property {name}"), "none"))
        });
        Ok(PointCloudFile { parameter_properties: properties.collect::<Result<_>>()?, ply })
    }

    /// Returns notes for the user on the defects of the file. Fails if it was cut short since it was opened.
    pub(super) fn notes(&self) -> Result<Vec<String>> {
        self.ply.notes()
    }

    /// Returns whether the file belongs to the full model (with features and a decoder network), not to the lite model.
    pub(super) fn is_full(&self) -> bool {
        self.parameter_properties.len() == FULL_PARAM_COUNT
    }

    /// Reads the parameters of all Gaussians. `activation` turns the first three features of the full model into
    /// colors.
    ///
    /// # Errors
    /// Fails if a value is not finite or the file was cut short since it was opened.
    pub(super) fn raw(&self, activation: ColorActivation) -> Result<StoredParams> {
        let count = self.ply.count();
        let mut raw = StoredParams { gaussians: self.ply.whole()?, format_specific: AttributeValues::zeros(0, count) };
        let mut values = Vec::with_capacity(self.parameter_properties.len() * count);
        for property in &self.parameter_properties {
            values.extend(self.ply.values(&property.name)?.unwrap_or_default());
        }
        raw.format_specific = match values.is_empty() {
            true => AttributeValues::zeros(self.parameter_properties.len(), 0),
            false => AttributeValues::from_planes(self.parameter_properties.len(), values),
        };
        for column in Attributes::all().iter() {
            let names = self.ply.layout().planes(column).iter().map(|plane| match plane {
                PlaneSource::Property(property) => property.name.as_str(),
                PlaneSource::Thin => "scale_2",
            });
            names
                .enumerate()
                .try_for_each(|(c, name)| self.check(name, raw.gaussians.attribute_values(column).plane(c)))?;
        }
        for (plane, property) in self.parameter_properties.iter().enumerate() {
            self.check(&property.name, raw.format_specific.plane(plane))?;
        }
        set_colors(&mut raw, self.is_full().then_some(activation));
        Ok(raw)
    }

    /// Reads the stored red, green and blue of all Gaussians (`f_dc_0..2`).
    ///
    /// # Errors
    /// Fails if the file was cut short since it was opened.
    pub(super) fn colors(&self) -> Result<[Vec<f32>; 3]> {
        let values = |name: &str| -> Result<Vec<f32>> { Ok(self.ply.values(name)?.unwrap_or_default()) };
        Ok([values("f_dc_0")?, values("f_dc_1")?, values("f_dc_2")?])
    }

    /// Fails if one of `values`, which are the values of the property `name` of all Gaussians, is not finite.
    fn check(&self, name: &str, values: &[f32]) -> Result<()> {
        match values.iter().position(|x| !x.is_finite()) {
            Some(row) => {
                let found = values[row].to_string();
                Err(Error::input(self.ply.path(), format!("Gaussian {row}, {name}"), "a finite number", found).hint(
                    "remove such Gaussians from the model: the file may hold them even if no renderer draws them",
                ))
            }
            None => Ok(()),
        }
    }

    /// Writes the compressed model to a PLY file with the same properties. Rows of unchanged Gaussians are copied byte
    /// for byte. Proxies (Gaussians that replace merged ones) are written in place of their leaders (the most important
    /// members of the clusters), and parameter deltas are added to the stored values.
    ///
    /// # Errors
    /// Fails if the file was cut short since it was opened or a write fails.
    pub(super) fn write(&self, compressed: &CompressedModel, path: &Path) -> Result<()> {
        let (layout, rows) = (self.ply.layout(), rows_of_model(compressed));
        let big_endian = self.ply.header().encoding == PlyEncoding::BigEndian;
        let (proxies, by) = (compressed.proxies.raw.as_ref(), &compressed.delta.0);
        let places = |column: Attributes| layout.planes(column).iter().enumerate();
        let columns: Vec<Attributes> =
            Attributes::all().iter().filter(|&of| of != Attributes::SH || !self.is_full()).collect();
        // The lite model stores colors, not SH coefficients.
        let color_scale = |column: Attributes| if column == Attributes::SH { SH_C0 } else { 1.0 };
        let color_offset = |column: Attributes| if column == Attributes::SH { 0.5 } else { 0.0 };
        write_rows_like(
            &self.ply,
            &compressed.kept,
            |name| Some(name.to_owned()),
            path,
            |place, bytes| {
                for &column in &columns {
                    for (c, plane) in places(column) {
                        let PlaneSource::Property(property) = plane else { continue };
                        let change = Some(by.attribute_values(column))
                            .filter(|by| !by.is_empty())
                            .map_or(0.0, |by| by.plane(c)[place]);
                        let proxy = rows[place].proxy.zip(proxies);
                        if proxy.is_none() && change == 0.0 {
                            continue;
                        }
                        let before = match proxy {
                            Some((proxy, raw)) => {
                                let stored = f64::from(raw.gaussians.attribute_values(column).plane(c)[proxy as usize]);
                                color_offset(column) + color_scale(column) * stored
                            }
                            None => f64::from(value(bytes, property, big_endian)),
                        };
                        put(
                            bytes,
                            property,
                            big_endian,
                            before as f32 + (color_scale(column) * f64::from(change)) as f32,
                        );
                    }
                }
                if let Some((proxy, raw)) = rows[place].proxy.zip(proxies) {
                    for (plane, property) in self.parameter_properties.iter().enumerate() {
                        put(bytes, property, big_endian, raw.format_specific.plane(plane)[proxy as usize]);
                    }
                }
            },
        )
    }
}

/// Returns the name of the PLY property of each parameter in [`StoredParams::format_specific`], in order: for the full
/// model if `is_full`, else for the lite model.
fn parameter_property_names(is_full: bool) -> Vec<String> {
    let numbered = |name: &'static str, count: usize| (0..count).map(move |k| format!("{name}_{k}"));
    let mut names: Vec<String> = vec![MARKER_PROPERTY.to_owned(), "trbf_scale".to_owned()];
    names.extend(numbered("motion", OMEGA - MOTION).chain(numbered("omega", SHARED_PARAM_COUNT - OMEGA)));
    if is_full {
        names.extend(numbered("f_dc", 6).chain(numbered("f_t", 3)));
    }
    names
}

/// Sets the colors in `raw`, as SH coefficients of degree 0. There are two cases:
/// - Full model (`activation` is given): a color is `activation` applied to the first three features of the Gaussian.
/// - Lite model (`None`): `raw` holds the stored colors in place of SH coefficients, and the function converts them.
fn set_colors(raw: &mut StoredParams, activation: Option<ColorActivation>) {
    for c in 0..3 {
        let features = raw.format_specific.width() > FIRST_FEATURE;
        let from: Vec<f32> =
            if features { raw.format_specific.plane(FIRST_FEATURE + c) } else { raw.gaussians.sh.plane(c) }.to_vec();
        let color = |x: f32| activation.map_or(f64::from(x), |activation| activation.apply(f64::from(x)));
        raw.gaussians.sh.plane_mut(c).iter_mut().zip(from).for_each(|(to, x)| *to = sh_from_color(color(x)));
    }
}
