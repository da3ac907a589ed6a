//! Maximum errors of the values in a container, one for each attribute.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result, quoted};
use crate::model::Attributes;

/// Maximum error of each attribute in the attribute's own unit, in the order of [`Attributes::all`]. 0 means that the
/// attribute is stored without loss.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ErrorBounds([f64; 5]);

/// Requested maximum error of one attribute: `position=1e-3` in the attribute's unit, or `position=0.01%` of the scene
/// extent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaxError {
    column: Attributes,
    bound: f64,
    /// Whether the maximum error is a fraction of the scene extent.
    is_relative: bool,
}

impl ErrorBounds {
    /// Creates error bounds from the maximum errors of all attributes, in the order of [`Attributes::all`].
    pub fn new(bounds: [f64; 5]) -> ErrorBounds {
        ErrorBounds(bounds)
    }

    /// Creates error bounds from the maximum errors that the user requests. `extent` returns the scene extent in scene
    /// units; it is called only if a maximum error is relative to the extent.
    ///
    /// # Errors
    /// Fails if an attribute is named twice, or if `extent` fails.
    pub fn from_errors(requested: &[MaxError], extent: impl Fn() -> Result<f64>) -> Result<ErrorBounds> {
        let mut bounds = ErrorBounds::default();
        for &MaxError { column, bound, is_relative } in requested {
            let slot = &mut bounds.0[column.bits().trailing_zeros() as usize];
            if *slot != 0.0 {
                return Err(Error::usage(format!("--max-error: {} is named twice", column.name())));
            }
            *slot = if is_relative { bound * extent()? } else { bound };
        }
        Ok(bounds)
    }

    /// Returns the maximum error of the attribute `column`; 0 if it is stored without loss.
    pub fn max_error(&self, column: Attributes) -> f64 {
        self.0[column.bits().trailing_zeros() as usize]
    }
}

impl FromStr for MaxError {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<MaxError, String> {
        let names: Vec<&str> = Attributes::all().iter().map(Attributes::name).collect();
        let (name, number) =
            text.split_once('=').ok_or_else(|| format!("expected COLUMN=BOUND, found {}", quoted(text)))?;
        let column = Attributes::all().iter().find(|column| column.name() == name);
        let column =
            column.ok_or_else(|| format!("expected a column of {}, found {}", names.join(", "), quoted(name)))?;
        let (number, is_relative) = number.strip_suffix('%').map_or((number, false), |percent| (percent, true));
        if is_relative && column != Attributes::POSITION {
            return Err(format!(
                "expected a bound in the unit of {name} (only of positions a percentage is possible), found {}",
                quoted(text)
            ));
        }
        let bound = number.parse::<f64>().ok().filter(|bound| (1e-30..=1e30).contains(bound));
        let bound =
            bound.ok_or_else(|| format!("expected a bound above 0, from 1e-30 to 1e30, found {}", quoted(number)))?;
        Ok(MaxError { column, bound: if is_relative { bound / 100.0 } else { bound }, is_relative })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_read_by_attribute_or_as_a_percentage() {
        let requested = ["position=0.5%", "sh=1e-2"].map(|text| text.parse::<MaxError>().unwrap());
        let bounds = ErrorBounds::from_errors(&requested, || Ok(20.0)).unwrap();
        let found: Vec<f64> = Attributes::all().iter().map(|column| bounds.max_error(column)).collect();
        assert_eq!(found, [0.1, 0.0, 0.0, 0.0, 0.01]);
        assert!(ErrorBounds::from_errors(&requested, || Err(Error::usage("no extent"))).is_err());
        let twice = [requested[1], requested[1]];
        assert!(ErrorBounds::from_errors(&twice, || Ok(1.0)).unwrap_err().to_string().contains("sh is named twice"));
    }

    #[test]
    fn invalid_bounds_are_refused() {
        for (text, expected) in [
            ("position", "COLUMN=BOUND"),
            ("color=1", "position, rotation, log_scale, opacity_logit, sh"),
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
