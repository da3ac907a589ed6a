//! One row of statistics per Gaussian (method.md, section 1), as arrays over Gaussians.
//!
//! A new statistic is a field of [`Rows`] and a [`Statistic`]: tables, histograms, scratch files and plans follow.

use bitflags::bitflags;
use serde::{Deserialize, Serialize};

bitflags! {
    /// What was odd about a Gaussian.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    pub struct Flags: u8 {
        /// Some value in some frame was NaN or infinite.
        const NON_FINITE = 1;
        /// The quaternion was zero in some frame; the identity was used.
        const ZERO_ROTATION = 2;
        /// D fell below the noise floor of its f32 positions and was set to 0.
        const SNAPPED_D = 4;
        /// κ fell below the noise floor of its f32 positions and was set to 0.
        const SNAPPED_KAPPA = 8;
    }
}

/// A statistic of a Gaussian: the one place that says what it is called, where its values are, and what they take.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Statistic {
    /// [`Rows::d`].
    D,
    /// [`Rows::kappa`].
    Kappa,
    /// [`Rows::v`].
    V,
    /// [`Rows::life`].
    Life,
    /// [`Rows::c`].
    C,
    /// [`Rows::e`].
    E,
    /// [`Rows::vis`].
    Vis,
    /// [`Rows::w`].
    W,
}

/// Where the values of a statistic are, by their type: to read, and to write.
#[derive(Debug, Clone, Copy)]
pub enum Values {
    /// Quantities.
    F64(fn(&Rows) -> &Vec<f64>, fn(&mut Rows) -> &mut Vec<f64>),
    /// Counts of frames.
    U32(fn(&Rows) -> &Vec<u32>, fn(&mut Rows) -> &mut Vec<u32>),
}

/// What is declared of a statistic.
struct Declaration {
    name: &'static str,
    column: &'static str,
    meaning: &'static str,
    property: &'static str,
    values: Values,
}

impl Statistic {
    /// Every statistic, in the order of tables.
    pub const ALL: [Statistic; 8] = [Self::D, Self::Kappa, Self::V, Self::Life, Self::C, Self::E, Self::Vis, Self::W];

    const fn declared(self) -> Declaration {
        use Values::{F64, U32};
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
                meaning: "part of the frames it lives in",
                property: "life span",
                values: U32(|rows| &rows.life, |rows| &mut rows.life),
            },
            Statistic::C => Declaration {
                name: "C",
                column: "C",
                meaning: "mean coverage, pixels",
                property: "coverage",
                values: F64(|rows| &rows.c, |rows| &mut rows.c),
            },
            Statistic::E => Declaration {
                name: "E",
                column: "E",
                meaning: "how far its scales differ",
                property: "anisotropy",
                values: F64(|rows| &rows.e, |rows| &mut rows.e),
            },
            Statistic::Vis => Declaration {
                name: "Vis",
                column: "vis",
                meaning: "part of the pictures it touches",
                property: "visibility",
                values: F64(|rows| &rows.vis, |rows| &mut rows.vis),
            },
            Statistic::W => Declaration {
                name: "W",
                column: "W",
                meaning: "largest share of a pixel",
                property: "coverage",
                values: F64(|rows| &rows.w, |rows| &mut rows.w),
            },
        }
    }

    /// As scores and reports call it.
    pub fn name(self) -> &'static str {
        self.declared().name
    }

    /// As tables of rows call it.
    pub fn column(self) -> &'static str {
        self.declared().column
    }

    /// What it measures, with the unit; counts of frames are told as a part of all.
    pub fn meaning(self) -> &'static str {
        self.declared().meaning
    }

    /// The property that it grades Gaussians by.
    pub fn property(self) -> &'static str {
        self.declared().property
    }

    /// Where its values are.
    pub const fn values(self) -> Values {
        self.declared().values
    }

    /// Bytes of a Gaussian's value.
    pub const fn bytes(self) -> usize {
        match self.values() {
            Values::F64(..) => size_of::<f64>(),
            Values::U32(..) => size_of::<u32>(),
        }
    }
}

/// Statistics of N Gaussians; every array has N entries, but for a `w` that is empty.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Rows {
    /// D, trajectory magnitude: root mean square step, scene units per frame.
    pub d: Vec<f64>,
    /// κ, mean norm of the second difference, scene units per frame².
    pub kappa: Vec<f64>,
    /// V, variance of the opacity over the life span.
    pub v: Vec<f64>,
    /// Life span in frames.
    pub life: Vec<u32>,
    /// C, mean projected or visible coverage, pixels.
    pub c: Vec<f64>,
    /// W, largest alpha · transmittance of any pixel of any picture, in [0, 0.99]; empty where C is
    /// projected coverage.
    pub w: Vec<f64>,
    /// E, anisotropy: largest over smallest canonical scale.
    pub e: Vec<f64>,
    /// Fraction of (frame, view) pairs in which the Gaussian is alive and touches the image.
    pub vis: Vec<f64>,
    /// What was odd.
    pub flags: Vec<Flags>,
}

impl Rows {
    /// Memory of a row that has a W.
    pub const BYTES_PER_GAUSSIAN: usize = {
        let (mut bytes, mut k) = (size_of::<Flags>(), 0);
        while k < Statistic::ALL.len() {
            bytes += Statistic::ALL[k].bytes();
            k += 1;
        }
        bytes
    };

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.d.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.d.is_empty()
    }

    /// Appends the rows of the next block.
    pub fn append(&mut self, next: &mut Rows) {
        for of in Statistic::ALL {
            match of.values() {
                Values::F64(_, of) => of(self).append(of(next)),
                Values::U32(_, of) => of(self).append(of(next)),
            }
        }
        self.flags.append(&mut next.flags);
    }

    /// Sets the statistics of Gaussian `i` to 0; its flags stay.
    pub fn clear(&mut self, i: usize) {
        for of in Statistic::ALL {
            match of.values() {
                Values::F64(_, of) => of(self).get_mut(i).into_iter().for_each(|value| *value = 0.0),
                Values::U32(_, of) => of(self).get_mut(i).into_iter().for_each(|value| *value = 0),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_statistics_are_told_apart() {
        for name in [Statistic::name, Statistic::column] {
            let mut names = Statistic::ALL.map(name);
            names.sort_unstable();
            assert!(names.windows(2).all(|two| two[0] != two[1]), "{names:?}");
        }
    }

    #[test]
    fn every_array_of_rows_is_a_statistic_with_values_of_its_own() {
        let mut rows = Rows::default();
        for (k, of) in Statistic::ALL.into_iter().enumerate() {
            match of.values() {
                Values::F64(_, of) => of(&mut rows).push(k as f64),
                Values::U32(_, of) => of(&mut rows).push(k as u32),
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
