//! Statistics of every Gaussian over all frames, one array per statistic (docs/method.md, section 1).
//!
//! A new statistic is a field of [`StatisticRows`] and a variant of [`Statistic`]. Tables, histograms, temporary files
//! and memory plans then include it.

use bitflags::bitflags;
use serde::{Deserialize, Serialize};

bitflags! {
    /// Anomalies of one Gaussian, found while its statistics over all frames were computed.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    pub struct AnomalyFlags: u8 {
        /// A value in some frame was NaN or infinite.
        const NON_FINITE = 1;
        /// The quaternion was zero in some frame; the identity was used there.
        const ZERO_ROTATION = 2;
        /// The trajectory magnitude D was below the rounding noise of f32 positions and was set to 0.
        const SNAPPED_D = 4;
        /// The curvature κ of the trajectory was below the rounding noise of f32 positions and was set to 0.
        const SNAPPED_KAPPA = 8;
        /// The opacity logit reached ±[`INFINITE_LOGIT`](crate::INFINITE_LOGIT) in some frame; readers replace infinite
        /// logits by this value.
        const INFINITE_LOGIT = 16;
    }
}

/// Statistic that is computed for each Gaussian. The methods return its names, its meaning, and the array of
/// [`StatisticRows`] that holds its values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Statistic {
    /// Trajectory magnitude: root mean square of the distance moved from frame to frame ([`StatisticRows::d`]).
    D,
    /// Curvature of the trajectory: mean change of the velocity from frame to frame ([`StatisticRows::kappa`]).
    Kappa,
    /// Variance of the opacity over time, see [`StatisticRows::v`].
    V,
    /// Number of frames in which the opacity reaches a threshold, see [`StatisticRows::life`].
    Life,
    /// Mean contribution to a render in pixels: visible weight or projected area ([`StatisticRows::c`]).
    C,
    /// Anisotropy: how long the longest axis of the Gaussian is compared with its other axes ([`StatisticRows::e`]).
    E,
    /// Fraction of the (frame, view) pairs in which the Gaussian is alive and touches the image
    /// ([`StatisticRows::vis`]).
    Vis,
    /// Largest blending weight (alpha · transmittance) of the Gaussian in any pixel ([`StatisticRows::w`]).
    W,
}

/// Access to the array that holds the values of one statistic in [`StatisticRows`]. The variant states the type of the
/// values. Each variant has two functions:
/// - The first returns a shared reference to the array.
/// - The second returns a mutable reference to the same array.
#[derive(Debug, Clone, Copy)]
pub enum StatisticArray {
    /// For a statistic whose values are real numbers: functions that return the array for reading, and for writing.
    F64(fn(&StatisticRows) -> &Vec<f64>, fn(&mut StatisticRows) -> &mut Vec<f64>),
    /// For a statistic whose values are numbers of frames: functions that return the array for reading, and for
    /// writing.
    U32(fn(&StatisticRows) -> &Vec<u32>, fn(&mut StatisticRows) -> &mut Vec<u32>),
}

/// Declaration of a statistic. Each field is the result of a method of [`Statistic`]: `name`, `column`
/// ([`Statistic::column_name`]), `meaning`, `property` ([`Statistic::measured_property`]) and `values`
/// ([`Statistic::accessors`]).
struct Declaration {
    name: &'static str,
    column: &'static str,
    meaning: &'static str,
    property: &'static str,
    values: StatisticArray,
}

impl Statistic {
    /// Every statistic, in the order in which tables list them.
    pub const ALL: [Statistic; 8] = [Self::D, Self::Kappa, Self::V, Self::Life, Self::C, Self::E, Self::Vis, Self::W];

    /// Returns the declaration of this statistic. A new statistic is described here and nowhere else.
    const fn declaration(self) -> Declaration {
        use StatisticArray::{F64, U32};
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

    /// Returns the name of the statistic in score formulas and reports.
    pub fn name(self) -> &'static str {
        self.declaration().name
    }

    /// Returns the name of the statistic as a column of exported tables.
    pub fn column_name(self) -> &'static str {
        self.declaration().column
    }

    /// Returns a description of the statistic with its unit. A statistic that counts frames is described as a fraction
    /// of all frames.
    pub fn meaning(self) -> &'static str {
        self.declaration().meaning
    }

    /// Returns a short text that names the property of a Gaussian that this statistic measures, such as "motion".
    pub fn measured_property(self) -> &'static str {
        self.declaration().property
    }

    /// Returns the functions that access the values of the statistic in [`StatisticRows`].
    pub const fn accessors(self) -> StatisticArray {
        self.declaration().values
    }

    /// Returns the bytes that one value of the statistic takes.
    pub const fn bytes(self) -> usize {
        match self.accessors() {
            StatisticArray::F64(..) => size_of::<f64>(),
            StatisticArray::U32(..) => size_of::<u32>(),
        }
    }
}

/// Statistics of N Gaussians. Every array has one entry per Gaussian, except that `w` may be empty.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct StatisticRows {
    /// Trajectory magnitude D: root mean square of the distance moved between successive frames, scene units per frame.
    pub d: Vec<f64>,
    /// Curvature κ: mean norm of the second difference of the position over time, scene units per frame².
    pub kappa: Vec<f64>,
    /// Variance V of the opacity over the life span (the frames in which the opacity reaches a threshold).
    pub v: Vec<f64>,
    /// Number of frames in which the opacity reaches a threshold: the length of the life span.
    pub life: Vec<u32>,
    /// Contribution C to a render in pixels, mean over the views. The parameter `coverage` of the recipe selects the
    /// sum of alpha · transmittance over the pixels (`visible`), or the opacity times the projected area (`projected`).
    pub c: Vec<f64>,
    /// Largest alpha · transmittance W in any pixel of any view, from 0 to 0.99. Empty if the contribution
    /// [`StatisticRows::c`] is computed from projected areas.
    pub w: Vec<f64>,
    /// Anisotropy E of the canonical (time-independent) scales. The parameter `anisotropy` of the recipe selects the
    /// ratio of the largest scale to the smallest (`ratio`), or ln(largest scale / middle scale) (`log`).
    pub e: Vec<f64>,
    /// Fraction of (frame, view) pairs in which the opacity of the Gaussian reaches a threshold and the Gaussian
    /// touches the image.
    pub vis: Vec<f64>,
    /// Anomalies of each Gaussian, found while its statistics over all frames were computed.
    pub flags: Vec<AnomalyFlags>,
}

impl StatisticRows {
    /// Bytes of memory per Gaussian that all statistics, `w` included, and the flags take.
    pub const BYTES_PER_GAUSSIAN: usize = {
        let (mut bytes, mut k) = (size_of::<AnomalyFlags>(), 0);
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

    /// Appends the statistics in `next`, which belong to the following block of Gaussians. Leaves `next` empty.
    pub fn append(&mut self, next: &mut StatisticRows) {
        for statistic in Statistic::ALL {
            match statistic.accessors() {
                StatisticArray::F64(_, values) => values(self).append(values(next)),
                StatisticArray::U32(_, values) => values(self).append(values(next)),
            }
        }
        self.flags.append(&mut next.flags);
    }

    /// Sets all statistics of Gaussian `i` to 0. Its flags stay unchanged.
    pub fn clear(&mut self, i: usize) {
        for statistic in Statistic::ALL {
            match statistic.accessors() {
                StatisticArray::F64(_, values) => values(self).get_mut(i).into_iter().for_each(|value| *value = 0.0),
                StatisticArray::U32(_, values) => values(self).get_mut(i).into_iter().for_each(|value| *value = 0),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_statistics_are_distinct() {
        for name in [Statistic::name, Statistic::column_name] {
            let mut names = Statistic::ALL.map(name);
            names.sort_unstable();
            assert!(names.windows(2).all(|two| two[0] != two[1]), "{names:?}");
        }
    }

    #[test]
    fn every_array_of_rows_belongs_to_one_statistic() {
        let mut rows = StatisticRows::default();
        for (k, statistic) in Statistic::ALL.into_iter().enumerate() {
            match statistic.accessors() {
                StatisticArray::F64(_, values) => values(&mut rows).push(k as f64),
                StatisticArray::U32(_, values) => values(&mut rows).push(k as u32),
            }
        }
        let mut all = StatisticRows::default();
        all.append(&mut rows.clone());
        assert_eq!(all, rows);
        let StatisticRows { d, kappa, v, life, c, w, e, vis, flags: _ } = rows;
        let arrays = [&d, &kappa, &v, &c, &w, &e, &vis];
        assert!(arrays.iter().all(|array| array.len() == 1) && life.len() == 1);
        let bytes = arrays.map(|array| size_of_val(&array[..])).iter().sum::<usize>() + size_of_val(&life[..]);
        assert_eq!(StatisticRows::BYTES_PER_GAUSSIAN, bytes + size_of::<AnomalyFlags>());
    }
}
