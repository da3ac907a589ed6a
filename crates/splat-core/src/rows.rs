//! Statistics of every Gaussian, as arrays over Gaussians (docs/method.md, section 1).
//!
//! A new statistic is a field of [`Rows`] and a variant of [`Statistic`]. Tables, histograms, temporary files and
//! memory plans then include it.

use bitflags::bitflags;
use serde::{Deserialize, Serialize};

bitflags! {
    /// Anomalies of a Gaussian that the scan found.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    pub struct Flags: u8 {
        /// A value in some frame was NaN or infinite.
        const NON_FINITE = 1;
        /// The quaternion was zero in some frame; the identity was used there.
        const ZERO_ROTATION = 2;
        /// D was below the noise floor of the f32 positions and was set to 0.
        const SNAPPED_D = 4;
        /// κ was below the noise floor of the f32 positions and was set to 0.
        const SNAPPED_KAPPA = 8;
    }
}

/// Statistic of a Gaussian. Its methods declare its names, its meaning, and the array that holds its values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Statistic {
    /// Trajectory magnitude, [`Rows::d`].
    D,
    /// Curvature, [`Rows::kappa`].
    Kappa,
    /// Variance of the opacity, [`Rows::v`].
    V,
    /// Life span, [`Rows::life`].
    Life,
    /// Mean contribution, [`Rows::c`].
    C,
    /// Anisotropy, [`Rows::e`].
    E,
    /// Visibility, [`Rows::vis`].
    Vis,
    /// Largest weight of a pixel, [`Rows::w`].
    W,
}

/// Accessors of the array of a statistic, by value type: for reading and for writing.
#[derive(Debug, Clone, Copy)]
pub enum StatisticAccess {
    /// Array of real numbers.
    F64(fn(&Rows) -> &Vec<f64>, fn(&mut Rows) -> &mut Vec<f64>),
    /// Array of frame counts.
    U32(fn(&Rows) -> &Vec<u32>, fn(&mut Rows) -> &mut Vec<u32>),
}

/// Names, meaning and values of a statistic.
struct Declaration {
    name: &'static str,
    column: &'static str,
    meaning: &'static str,
    property: &'static str,
    values: StatisticAccess,
}

impl Statistic {
    /// Every statistic, in the order of tables.
    pub const ALL: [Statistic; 8] = [Self::D, Self::Kappa, Self::V, Self::Life, Self::C, Self::E, Self::Vis, Self::W];

    /// Returns the declaration of this statistic: the single place to describe a new one.
    const fn declaration(self) -> Declaration {
        use StatisticAccess::{F64, U32};
        match self {
            Statistic::D => Declaration {
                name: "D",
                column: "D",
                meaning: "root mean square step, scene units per frame",
                property: "motion",
                values: F64(|rows| &rows.d, |rows| &mut rows.d),
            },
            Statistic::Kappa => Declaration {
                name: "kappa",
                column: "kappa",
                meaning: "mean curvature of the path, scene units per frame²",
                property: "curvature",
                values: F64(|rows| &rows.kappa, |rows| &mut rows.kappa),
            },
            Statistic::V => Declaration {
                name: "V",
                column: "V",
                meaning: "variance of the opacity",
                property: "opacity variance",
                values: F64(|rows| &rows.v, |rows| &mut rows.v),
            },
            Statistic::Life => Declaration {
                name: "Life",
                column: "life",
                meaning: "fraction of the frames in which it is alive",
                property: "life span",
                values: U32(|rows| &rows.life, |rows| &mut rows.life),
            },
            Statistic::C => Declaration {
                name: "C",
                column: "C",
                meaning: "mean contribution per view, pixels",
                property: "coverage",
                values: F64(|rows| &rows.c, |rows| &mut rows.c),
            },
            Statistic::E => Declaration {
                name: "E",
                column: "E",
                meaning: "anisotropy of the scales",
                property: "anisotropy",
                values: F64(|rows| &rows.e, |rows| &mut rows.e),
            },
            Statistic::Vis => Declaration {
                name: "Vis",
                column: "vis",
                meaning: "fraction of the views it touches",
                property: "visibility",
                values: F64(|rows| &rows.vis, |rows| &mut rows.vis),
            },
            Statistic::W => Declaration {
                name: "W",
                column: "W",
                meaning: "largest alpha · transmittance of a pixel",
                property: "coverage",
                values: F64(|rows| &rows.w, |rows| &mut rows.w),
            },
        }
    }

    /// Returns the name in scores and reports.
    pub fn name(self) -> &'static str {
        self.declaration().name
    }

    /// Returns the name of the table column.
    pub fn column(self) -> &'static str {
        self.declaration().column
    }

    /// Returns a description with the unit. Counts of frames are described as a fraction of all frames.
    pub fn meaning(self) -> &'static str {
        self.declaration().meaning
    }

    /// Returns the property of a Gaussian that this statistic measures.
    pub fn property(self) -> &'static str {
        self.declaration().property
    }

    /// Returns the accessors of the values.
    pub const fn values(self) -> StatisticAccess {
        self.declaration().values
    }

    /// Returns the bytes per Gaussian.
    pub const fn bytes(self) -> usize {
        match self.values() {
            StatisticAccess::F64(..) => size_of::<f64>(),
            StatisticAccess::U32(..) => size_of::<u32>(),
        }
    }
}

/// Statistics of N Gaussians. Every array has N entries, except that `w` may be empty.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Rows {
    /// Trajectory magnitude D: root mean square step, scene units per frame.
    pub d: Vec<f64>,
    /// Curvature κ: mean norm of the second difference of the position, scene units per frame².
    pub kappa: Vec<f64>,
    /// Variance V of the opacity over the life span.
    pub v: Vec<f64>,
    /// Life span in frames.
    pub life: Vec<u32>,
    /// Mean projected or visible contribution C, pixels.
    pub c: Vec<f64>,
    /// Largest alpha · transmittance W of any pixel of any view, in [0, 0.99]. Empty if C is the projected
    /// contribution.
    pub w: Vec<f64>,
    /// Anisotropy E of the canonical scales: s_max/s_min, or ln(s_max/s_mid) in the logarithmic form.
    pub e: Vec<f64>,
    /// Fraction of (frame, view) pairs in which the Gaussian is alive and touches the image.
    pub vis: Vec<f64>,
    /// Anomalies that the scan found.
    pub flags: Vec<Flags>,
}

impl Rows {
    /// Bytes of all statistics and flags of one Gaussian, W included.
    pub const BYTES_PER_GAUSSIAN: usize = {
        let (mut bytes, mut k) = (size_of::<Flags>(), 0);
        while k < Statistic::ALL.len() {
            bytes += Statistic::ALL[k].bytes();
            k += 1;
        }
        bytes
    };

    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.d.len()
    }

    /// Returns whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.d.is_empty()
    }

    /// Appends the statistics of the next block and leaves `next` empty.
    pub fn append(&mut self, next: &mut Rows) {
        for statistic in Statistic::ALL {
            match statistic.values() {
                StatisticAccess::F64(_, values) => values(self).append(values(next)),
                StatisticAccess::U32(_, values) => values(self).append(values(next)),
            }
        }
        self.flags.append(&mut next.flags);
    }

    /// Sets the statistics of Gaussian `i` to 0. The flags stay.
    pub fn clear(&mut self, i: usize) {
        for statistic in Statistic::ALL {
            match statistic.values() {
                StatisticAccess::F64(_, values) => values(self).get_mut(i).into_iter().for_each(|value| *value = 0.0),
                StatisticAccess::U32(_, values) => values(self).get_mut(i).into_iter().for_each(|value| *value = 0),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_statistics_are_distinct() {
        for name in [Statistic::name, Statistic::column] {
            let mut names = Statistic::ALL.map(name);
            names.sort_unstable();
            assert!(names.windows(2).all(|two| two[0] != two[1]), "{names:?}");
        }
    }

    #[test]
    fn every_array_of_rows_belongs_to_one_statistic() {
        let mut rows = Rows::default();
        for (k, statistic) in Statistic::ALL.into_iter().enumerate() {
            match statistic.values() {
                StatisticAccess::F64(_, values) => values(&mut rows).push(k as f64),
                StatisticAccess::U32(_, values) => values(&mut rows).push(k as u32),
            }
        }
        let mut all = Rows::default();
        all.append(&mut rows.clone());
        assert_eq!(all, rows);
        let Rows { d, kappa, v, life, c, w, e, vis, flags: _ } = rows;
        let arrays = [&d, &kappa, &v, &c, &w, &e, &vis];
        assert!(arrays.iter().all(|array| array.len() == 1) && life.len() == 1);
        let bytes = arrays.map(|array| size_of_val(&array[..])).iter().sum::<usize>() + size_of_val(&life[..]);
        assert_eq!(Rows::BYTES_PER_GAUSSIAN, bytes + size_of::<Flags>());
    }
}
