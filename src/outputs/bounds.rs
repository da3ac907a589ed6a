//! How far the values of a container may be off what they were, column by column.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result, quoted};
use crate::model::Columns;

/// Bound of each column in its unit, in the order of [`Columns::all`]; 0 keeps every bit.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Bounds([f64; 5]);

/// What is asked of one column: `position=1e-3`, in the column's unit, or `position=0.01%` of the scene's extent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaxError {
    column: Columns,
    bound: f64,
    /// Whether the bound is in extents of the scene.
    of_extent: bool,
}

impl Bounds {
    /// Of every column, in the order of [`Columns::all`].
    pub fn new(bounds: [f64; 5]) -> Bounds {
        Bounds(bounds)
    }

    /// Of `asked`, in a scene whose extent is asked for where a bound is of it.
    ///
    /// # Errors
    /// A column that is named twice; no extent.
    pub fn from_errors(asked: &[MaxError], extent: impl Fn() -> Result<f64>) -> Result<Bounds> {
        let mut bounds = Bounds::default();
        for &MaxError { column, bound, of_extent } in asked {
            let of_column = &mut bounds.0[column.bits().trailing_zeros() as usize];
            if *of_column != 0.0 {
                return Err(Error::usage(format!("--max-error: {} is named twice", column.name())));
            }
            *of_column = if of_extent { bound * extent()? } else { bound };
        }
        Ok(bounds)
    }

    /// That of one column.
    pub fn column(&self, column: Columns) -> f64 {
        self.0[column.bits().trailing_zeros() as usize]
    }
}

impl FromStr for MaxError {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<MaxError, String> {
        let names: Vec<&str> = Columns::all().iter().map(Columns::name).collect();
        let (name, number) =
            text.split_once('=').ok_or_else(|| format!("expected COLUMN=BOUND, found {}", quoted(text)))?;
        let column = Columns::all().iter().find(|column| column.name() == name);
        let column =
            column.ok_or_else(|| format!("expected a column of {}, found {}", names.join(", "), quoted(name)))?;
        let (number, of_extent) = number.strip_suffix('%').map_or((number, false), |percent| (percent, true));
        if of_extent && column != Columns::POSITION {
            return Err(format!(
                "expected a bound in the unit of {name} (only of positions a percentage), found {}",
                quoted(text)
            ));
        }
        let bound = number.parse::<f64>().ok().filter(|bound| (1e-30..=1e30).contains(bound));
        let bound =
            bound.ok_or_else(|| format!("expected a bound above 0, from 1e-30 to 1e30, found {}", quoted(number)))?;
        Ok(MaxError { column, bound: if of_extent { bound / 100.0 } else { bound }, of_extent })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_read_by_column_and_of_positions_as_a_percentage() {
        let asked = ["position=0.5%", "sh=1e-2"].map(|text| text.parse::<MaxError>().unwrap());
        let bounds = Bounds::from_errors(&asked, || Ok(20.0)).unwrap();
        let found: Vec<f64> = Columns::all().iter().map(|column| bounds.column(column)).collect();
        assert_eq!(found, [0.1, 0.0, 0.0, 0.0, 0.01]);
        assert!(Bounds::from_errors(&asked, || Err(Error::usage("no extent"))).is_err());
        let twice = [asked[1], asked[1]];
        assert!(Bounds::from_errors(&twice, || Ok(1.0)).unwrap_err().to_string().contains("sh is named twice"));
    }

    #[test]
    fn odd_bounds_are_refused() {
        for (text, expected) in [
            ("position", "COLUMN=BOUND"),
            ("colour=1", "position, rotation, log_scale, opacity_logit, sh"),
            ("sh=1%", "only of positions"),
            ("sh=0", "above 0"),
            ("sh=-1", "above 0"),
            ("sh=nan", "above 0"),
            ("sh=1e31", "above 0"),
        ] {
            let error = text.parse::<MaxError>().unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
