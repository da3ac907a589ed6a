//! Attributes of Gaussians at one frame, stored as planes: one array of f32 for each component of an attribute.

use bitflags::bitflags;
use serde::{Deserialize, Serialize};

use super::sh_coefficient_count;

/// Values of one attribute (such as the position) of `len` Gaussians, stored as `width` planes. Plane `c` holds
/// component `c` of every Gaussian, so that the inner loops of projection and statistics read memory contiguously.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct AttributeValues {
    width: usize,
    len: usize,
    data: Vec<f32>,
}

impl AttributeValues {
    /// Creates an attribute of `width` components for `len` Gaussians. All values are 0.
    pub fn zeros(width: usize, len: usize) -> Self {
        AttributeValues { width, len, data: vec![0.0; width * len] }
    }

    /// Creates an attribute of `width` components from `data`, which holds its planes one after the other (`[width,
    /// len]`).
    ///
    /// # Panics
    /// Panics if the length of `data` is not a multiple of `width`.
    pub fn from_planes(width: usize, data: Vec<f32>) -> Self {
        assert!(data.len().is_multiple_of(width), "{} values are not {width} planes", data.len());
        AttributeValues { width, len: data.len() / width, data }
    }

    /// Returns the number of components per Gaussian.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Changes the number of Gaussians to `len`. All values are unspecified until they are written.
    pub fn resize(&mut self, len: usize) {
        self.len = len;
        self.data.resize(self.width * len, 0.0);
    }

    /// Drops all components of the attribute but the first `width` ones, for every Gaussian.
    fn narrow(&mut self, width: usize) {
        self.width = width;
        self.data.truncate(width * self.len);
    }

    /// Returns component `c` of every Gaussian.
    pub fn plane(&self, c: usize) -> &[f32] {
        &self.data[c * self.len..(c + 1) * self.len]
    }

    /// Returns component `c` of every Gaussian for writing.
    pub fn plane_mut(&mut self, c: usize) -> &mut [f32] {
        &mut self.data[c * self.len..(c + 1) * self.len]
    }

    /// Returns all planes in one slice, one after the other: `[width, len]`.
    pub fn planes(&self) -> &[f32] {
        &self.data
    }

    /// Returns all planes for writing in one slice, one after the other: `[width, len]`.
    pub fn planes_mut(&mut self) -> &mut [f32] {
        &mut self.data
    }

    /// Returns the first `W` components of Gaussian `i`.
    pub fn row<const W: usize>(&self, i: usize) -> [f32; W] {
        std::array::from_fn(|c| self.data[c * self.len + i])
    }

    /// Returns the values of the Gaussians with the indices `rows`, in the order of `rows`.
    pub fn pick(&self, rows: &[u32]) -> AttributeValues {
        let data = (0..self.width).flat_map(|c| rows.iter().map(move |&i| self.plane(c)[i as usize])).collect();
        AttributeValues { width: self.width, len: rows.len(), data }
    }

    /// Sets the first `W` components of Gaussian `i` to `row`.
    pub fn set_row<const W: usize>(&mut self, i: usize, row: [f32; W]) {
        for (c, value) in row.into_iter().enumerate() {
            self.data[c * self.len + i] = value;
        }
    }
}

/// Attributes of Gaussians at one frame, in the encoding of trained models: scales as logarithms, opacity as logit,
/// color as spherical harmonics (SH).
///
/// Plane `3·k + channel` of `sh` holds SH coefficient `k` of a color channel (0 red, 1 green, 2 blue).
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Gaussians {
    /// Position: 3 planes, scene units.
    pub position: AttributeValues,
    /// Rotation: 4 planes, a quaternion in the order w, x, y, z, not necessarily of unit length.
    pub rotation: AttributeValues,
    /// Natural logarithm of the scales: 3 planes. Scales are standard deviations in scene units.
    pub log_scale: AttributeValues,
    /// Logit of the opacity: 1 plane.
    pub opacity_logit: AttributeValues,
    /// SH coefficients of the color: 3·(degree + 1)² planes.
    pub sh: AttributeValues,
}

impl Gaussians {
    /// Creates `len` Gaussians whose values are all zero.
    pub fn zeros(len: usize, sh_degree: usize) -> Self {
        Gaussians {
            position: AttributeValues::zeros(3, len),
            rotation: AttributeValues::zeros(4, len),
            log_scale: AttributeValues::zeros(3, len),
            opacity_logit: AttributeValues::zeros(1, len),
            sh: AttributeValues::zeros(3 * sh_coefficient_count(sh_degree), len),
        }
    }

    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.position.len()
    }

    /// Returns whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the position of Gaussian `i` in f64.
    pub fn position_f64(&self, i: usize) -> [f64; 3] {
        self.position.row(i).map(f64::from)
    }

    /// Returns the quaternion (w, x, y, z) of Gaussian `i` in f64, as stored.
    pub fn rotation_f64(&self, i: usize) -> [f64; 4] {
        self.rotation.row(i).map(f64::from)
    }

    /// Returns the scales (not their logarithms) of Gaussian `i` in f64.
    pub fn scales_f64(&self, i: usize) -> [f64; 3] {
        self.log_scale.row(i).map(|log| f64::from(log).exp())
    }

    /// Returns the degree of the SH coefficients.
    pub fn sh_degree(&self) -> usize {
        (self.sh.width() / 3).isqrt().saturating_sub(1)
    }

    /// Drops the SH coefficients above degree `sh_degree`.
    pub fn truncate_sh(&mut self, sh_degree: usize) {
        self.sh.narrow(3 * sh_coefficient_count(sh_degree.min(self.sh_degree())));
    }

    /// Changes the number of Gaussians to `len`. All values are unspecified until they are written.
    pub fn resize(&mut self, len: usize) {
        for attribute in Attributes::all().iter() {
            self.attribute_values_mut(attribute).resize(len);
        }
    }

    /// Returns a copy of the Gaussians with the indices `rows`, in the order of `rows`.
    pub fn pick(&self, rows: &[u32]) -> Gaussians {
        Gaussians {
            position: self.position.pick(rows),
            rotation: self.rotation.pick(rows),
            log_scale: self.log_scale.pick(rows),
            opacity_logit: self.opacity_logit.pick(rows),
            sh: self.sh.pick(rows),
        }
    }

    /// Copies all Gaussians of `block` over the Gaussians of `self` from index `first` on. Ignores SH coefficients of
    /// `block` above the SH degree of `self`.
    ///
    /// # Panics
    /// Panics if `self` ends before the last Gaussian of `block` is copied.
    pub fn write_rows(&mut self, first: usize, block: &Gaussians) {
        for attribute in Attributes::all().iter() {
            let (from, to) = (block.attribute_values(attribute), self.attribute_values_mut(attribute));
            for c in 0..to.width() {
                to.plane_mut(c)[first..][..from.len()].copy_from_slice(from.plane(c));
            }
        }
    }

    /// Returns the values of the single attribute `which`.
    ///
    /// # Panics
    /// Panics if `which` is not exactly one attribute.
    pub fn attribute_values(&self, which: Attributes) -> &AttributeValues {
        match which {
            Attributes::POSITION => &self.position,
            Attributes::ROTATION => &self.rotation,
            Attributes::LOG_SCALE => &self.log_scale,
            Attributes::OPACITY => &self.opacity_logit,
            Attributes::SH => &self.sh,
            _ => panic!("one column expected, {which:?} given"),
        }
    }

    /// Returns the values of the attributes `which` for writing, in the order of [`Attributes::all`].
    pub fn selected_attribute_values_mut(&mut self, which: Attributes) -> impl Iterator<Item = &mut AttributeValues> {
        let Gaussians { position, rotation, log_scale, opacity_logit, sh } = self;
        let all = [position, rotation, log_scale, opacity_logit, sh];
        Attributes::all().iter().zip(all).filter(move |(column, _)| which.contains(*column)).map(|(_, column)| column)
    }

    /// Returns the values of the single attribute `which` for writing.
    ///
    /// # Panics
    /// Panics if `which` is not exactly one attribute.
    pub fn attribute_values_mut(&mut self, which: Attributes) -> &mut AttributeValues {
        match which {
            Attributes::POSITION => &mut self.position,
            Attributes::ROTATION => &mut self.rotation,
            Attributes::LOG_SCALE => &mut self.log_scale,
            Attributes::OPACITY => &mut self.opacity_logit,
            Attributes::SH => &mut self.sh,
            _ => panic!("one column expected, {which:?} given"),
        }
    }
}

bitflags! {
    /// Set of attributes. The bits are in storage order. They are part of the format in which other programs stream
    /// frames to the standard input of splatsieve, so they must not change.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct Attributes: u32 {
        /// Position of the center.
        const POSITION = 1;
        /// Rotation, as a quaternion.
        const ROTATION = 2;
        /// Natural logarithm of the three scales.
        const LOG_SCALE = 4;
        /// Logit of the opacity.
        const OPACITY = 8;
        /// Spherical-harmonic (SH) coefficients of the color.
        const SH = 16;
    }
}

impl Attributes {
    /// Returns the number of components per Gaussian of all attributes in the set, for SH degree `sh_degree`.
    pub fn width(self, sh_degree: usize) -> usize {
        let components = |column: Attributes| match column {
            Attributes::OPACITY => 1,
            Attributes::ROTATION => 4,
            Attributes::SH => 3 * sh_coefficient_count(sh_degree),
            _ => 3,
        };
        self.iter().map(components).sum()
    }

    /// Returns the name of a single attribute, as it appears in containers (files of frames) and messages.
    pub fn name(self) -> &'static str {
        match self {
            Attributes::POSITION => "position",
            Attributes::ROTATION => "rotation",
            Attributes::LOG_SCALE => "log_scale",
            Attributes::OPACITY => "opacity_logit",
            Attributes::SH => "sh",
            _ => "several columns",
        }
    }
}
