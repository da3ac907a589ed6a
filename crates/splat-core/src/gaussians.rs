//! The state of a block of Gaussians at one instant, as planes of f32.

use bitflags::bitflags;
use serde::{Deserialize, Serialize};

use super::sh_coefficients;

/// One attribute of `len` Gaussians: `width` planes, plane `c` holding component `c` of every
/// Gaussian. Planes keep the inner loops of projection and statistics contiguous.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Column {
    width: usize,
    len: usize,
    data: Vec<f32>,
}

impl Column {
    /// `width × len` zeros.
    pub fn zeros(width: usize, len: usize) -> Self {
        Column { width, len, data: vec![0.0; width * len] }
    }

    /// Planes of equal length, one after the other: `[width, len]`.
    ///
    /// # Panics
    /// If `width` planes of equal length do not make up `data`.
    pub fn from_planes(width: usize, data: Vec<f32>) -> Self {
        assert!(data.len().is_multiple_of(width), "{} values are not {width} planes", data.len());
        Column { width, len: data.len() / width, data }
    }

    /// Components per Gaussian.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Makes room for `len` Gaussians; the values are unspecified until written.
    pub fn resize(&mut self, len: usize) {
        self.len = len;
        self.data.resize(self.width * len, 0.0);
    }

    /// Leaves the first `width` components, of more.
    fn narrow(&mut self, width: usize) {
        self.width = width;
        self.data.truncate(width * self.len);
    }

    /// Component `c` of every Gaussian.
    pub fn plane(&self, c: usize) -> &[f32] {
        &self.data[c * self.len..(c + 1) * self.len]
    }

    /// Component `c` of every Gaussian, to write.
    pub fn plane_mut(&mut self, c: usize) -> &mut [f32] {
        &mut self.data[c * self.len..(c + 1) * self.len]
    }

    /// All planes, one after the other: `[width, len]`.
    pub fn planes(&self) -> &[f32] {
        &self.data
    }

    /// All planes, to write: `[width, len]`.
    pub fn planes_mut(&mut self) -> &mut [f32] {
        &mut self.data
    }

    /// The first `W` components of Gaussian `i`.
    pub fn row<const W: usize>(&self, i: usize) -> [f32; W] {
        std::array::from_fn(|c| self.data[c * self.len + i])
    }

    /// The Gaussians `rows`, in that order.
    pub fn pick(&self, rows: &[u32]) -> Column {
        let data = (0..self.width).flat_map(|c| rows.iter().map(move |&i| self.plane(c)[i as usize])).collect();
        Column { width: self.width, len: rows.len(), data }
    }

    /// Writes the first `W` components of Gaussian `i`.
    pub fn set_row<const W: usize>(&mut self, i: usize, row: [f32; W]) {
        for (c, value) in row.into_iter().enumerate() {
            self.data[c * self.len + i] = value;
        }
    }
}

/// Gaussians at one instant in stored encoding: position, wxyz quaternion (not necessarily unit),
/// natural log of the scales, opacity logit, spherical harmonics.
///
/// Plane `3·k + channel` of `sh` is coefficient `k` of a channel (red, green, blue).
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Gaussians {
    /// `[3]`, scene units.
    pub position: Column,
    /// `[4]`, wxyz, any length.
    pub rotation: Column,
    /// `[3]`, natural log of scene units.
    pub log_scale: Column,
    /// `[1]`, logit of the opacity.
    pub opacity_logit: Column,
    /// `[3·(degree + 1)²]`.
    pub sh: Column,
}

impl Gaussians {
    /// `len` Gaussians with every value zero.
    pub fn zeros(len: usize, sh_degree: usize) -> Self {
        Gaussians {
            position: Column::zeros(3, len),
            rotation: Column::zeros(4, len),
            log_scale: Column::zeros(3, len),
            opacity_logit: Column::zeros(1, len),
            sh: Column::zeros(3 * sh_coefficients(sh_degree), len),
        }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.position.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Degree of the spherical harmonics.
    pub fn sh_degree(&self) -> usize {
        (self.sh.width() / 3).isqrt().saturating_sub(1)
    }

    /// Drops harmonics above degree `sh_degree`.
    pub fn drop_bands(&mut self, sh_degree: usize) {
        self.sh.narrow(3 * sh_coefficients(sh_degree.min(self.sh_degree())));
    }

    /// Makes room for `len` Gaussians; the values are unspecified until written.
    pub fn resize(&mut self, len: usize) {
        for column in Columns::all().iter() {
            self.column_mut(column).resize(len);
        }
    }

    /// The Gaussians `rows`, in that order.
    pub fn pick(&self, rows: &[u32]) -> Gaussians {
        Gaussians {
            position: self.position.pick(rows),
            rotation: self.rotation.pick(rows),
            log_scale: self.log_scale.pick(rows),
            opacity_logit: self.opacity_logit.pick(rows),
            sh: self.sh.pick(rows),
        }
    }

    /// Writes the rows of `block`, which may have more harmonics, from row `first` on.
    ///
    /// # Panics
    /// If there are not as many rows.
    pub fn write_rows(&mut self, first: usize, block: &Gaussians) {
        for column in Columns::all().iter() {
            let (from, to) = (block.column(column), self.column_mut(column));
            for c in 0..to.width() {
                to.plane_mut(c)[first..][..from.len()].copy_from_slice(from.plane(c));
            }
        }
    }

    /// The column of a single-column set.
    ///
    /// # Panics
    /// If `which` is not exactly one column.
    pub fn column(&self, which: Columns) -> &Column {
        match which {
            Columns::POSITION => &self.position,
            Columns::ROTATION => &self.rotation,
            Columns::LOG_SCALE => &self.log_scale,
            Columns::OPACITY => &self.opacity_logit,
            Columns::SH => &self.sh,
            _ => panic!("one column expected, {which:?} given"),
        }
    }

    /// The columns `which`, to write, in the order of [`Columns::all`].
    pub fn columns_mut(&mut self, which: Columns) -> impl Iterator<Item = &mut Column> {
        let Gaussians { position, rotation, log_scale, opacity_logit, sh } = self;
        let all = [position, rotation, log_scale, opacity_logit, sh];
        Columns::all().iter().zip(all).filter(move |(column, _)| which.contains(*column)).map(|(_, column)| column)
    }

    /// The column of a single-column set, to write.
    ///
    /// # Panics
    /// If `which` is not exactly one column.
    pub fn column_mut(&mut self, which: Columns) -> &mut Column {
        match which {
            Columns::POSITION => &mut self.position,
            Columns::ROTATION => &mut self.rotation,
            Columns::LOG_SCALE => &mut self.log_scale,
            Columns::OPACITY => &mut self.opacity_logit,
            Columns::SH => &mut self.sh,
            _ => panic!("one column expected, {which:?} given"),
        }
    }
}

bitflags! {
    /// A set of columns, in storage order from bit 0; frame streams hold these bits.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct Columns: u32 {
        /// `position`.
        const POSITION = 1;
        /// `rotation`.
        const ROTATION = 2;
        /// `log_scale`.
        const LOG_SCALE = 4;
        /// `opacity_logit`.
        const OPACITY = 8;
        /// `sh`.
        const SH = 16;
    }
}

impl Columns {
    /// Components per Gaussian of all columns of the set together, for harmonics of degree `sh_degree`.
    pub fn width(self, sh_degree: usize) -> usize {
        let of = |column: Columns| match column {
            Columns::OPACITY => 1,
            Columns::ROTATION => 4,
            Columns::SH => 3 * sh_coefficients(sh_degree),
            _ => 3,
        };
        self.iter().map(of).sum()
    }

    /// Name of a single column as the container and messages spell it.
    pub fn name(self) -> &'static str {
        match self {
            Columns::POSITION => "position",
            Columns::ROTATION => "rotation",
            Columns::LOG_SCALE => "log_scale",
            Columns::OPACITY => "opacity_logit",
            Columns::SH => "sh",
            _ => "several columns",
        }
    }
}
