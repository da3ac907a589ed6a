//! Result of the command `sweep` as JSON, text and CSV. The command measures quality, size, time and memory of every
//! method at every requested fraction of kept Gaussians, and of one method at several values of one parameter.

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use crate::files::csv::{optional_field, table};

/// Result of the command `sweep`: size, quality, time and memory of every compression method, and the conditions (such
/// as input and cameras) that are the same for all these measurements.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TradeOff {
    /// Name and version of the program.
    pub tool: String,
    /// Name of the input: the last component of its path.
    pub path: String,
    /// Hash of the bytes of the input.
    pub digest: String,
    /// Number of Gaussians of the input.
    pub gaussians: usize,
    /// Bytes of all files of the input.
    pub bytes: u64,
    /// Number of threads that every measured run used.
    pub threads: usize,
    /// Number of (frame, view) pairs on which every result is compared with the original.
    pub views: usize,
    /// File of the cameras, or description of the virtual rig (cameras that the program placed).
    pub cameras: String,
    /// Number of runs by which each point was measured; times are their medians.
    pub runs: usize,
    /// Measurements in the order of the option `--methods`, then by decreasing requested fraction.
    pub points: Vec<TradeOffPoint>,
    /// Curves of quality against time, one for each varied parameter.
    pub knobs: Vec<EffortCurve>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Measurements of one method at one fraction of kept Gaussians.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TradeOffPoint {
    /// Name of the method, as in the option `--methods`.
    pub method: String,
    /// Requested fraction of the Gaussians to keep; `None` if the method chose the number of Gaussians.
    #[serde(rename = "asked")]
    pub requested_fraction: Option<f64>,
    /// Number of Gaussians of the compressed model.
    pub count: usize,
    /// Size of the compressed model in bytes, over all its files.
    pub bytes: u64,
    /// Mean PSNR in dB of renders of the compressed model against renders of the original.
    pub psnr: f64,
    /// Mean SSIM of renders of the compressed model against renders of the original.
    pub ssim: f64,
    /// Mean temporal error (flicker) against renders of the original; `None` if no view occurs at two frames.
    pub temporal: Option<f64>,
    /// Wall-clock seconds of compression, from opening the input to the written result; median of all runs.
    pub seconds: f64,
    /// Maximum resident memory in bytes during compression, over all runs; `None` if the system does not report it.
    pub peak_memory_bytes: Option<u64>,
}

/// Curve of quality against time: measurements of one method at one fraction of kept Gaussians, for several values of
/// one parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EffortCurve {
    /// Name of the parameter in the recipe.
    pub parameter: String,
    /// Measurements for each value of the parameter, by increasing value.
    pub settings: Vec<EffortSetting>,
}

/// Measurements at one value of the parameter of an [`EffortCurve`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EffortSetting {
    /// Value of the recipe parameter that the curve varies.
    pub value: u32,
    /// Method, fraction of kept Gaussians, and measurements with this value of the parameter.
    #[serde(flatten)]
    pub point: TradeOffPoint,
}

/// Names of the CSV columns that describe one point, that is, one method at one fraction of kept Gaussians.
const COLUMNS: [&str; 10] =
    ["method", "asked", "count", "fraction", "bytes", "psnr", "ssim", "temporal", "seconds", "peak_memory_bytes"];

impl TradeOff {
    /// Returns the measurements of the methods ([`TradeOff::points`]) as a CSV table with one row per point (method and
    /// kept fraction). A missing value is an empty field.
    pub fn csv(&self) -> String {
        table(&COLUMNS, self.points.iter().map(|point| self.row(point)))
    }

    /// Returns the measurements of the varied parameters ([`TradeOff::knobs`]) as a CSV table with one row per value of
    /// a parameter.
    pub fn knobs_csv(&self) -> String {
        let settings = self.knobs.iter().flat_map(|knob| knob.settings.iter().map(move |setting| (knob, setting)));
        let row = |(knob, setting): (&EffortCurve, &EffortSetting)| {
            [vec![knob.parameter.clone(), setting.value.to_string()], self.row(&setting.point)].concat()
        };
        table(&[&["parameter", "value"], &COLUMNS[..]].concat(), settings.map(row))
    }

    /// Returns the CSV fields of `point`, in the order of [`COLUMNS`].
    fn row(&self, point: &TradeOffPoint) -> Vec<String> {
        vec![
            point.method.clone(),
            optional_field(point.requested_fraction),
            point.count.to_string(),
            self.kept_fraction(point).to_string(),
            point.bytes.to_string(),
            point.psnr.to_string(),
            point.ssim.to_string(),
            optional_field(point.temporal),
            point.seconds.to_string(),
            optional_field(point.peak_memory_bytes),
        ]
    }

    /// Returns the measurements of the methods and of the varied parameters as a table for the terminal.
    pub fn text(&self) -> String {
        let mut out = String::new();
        let _ = writeln!(
            out,
            "{}: {} Gaussians, compared on {} views: {}",
            self.path, self.gaussians, self.views, self.cameras
        );
        let _ = writeln!(
            out,
            "  {:<12} {:>9} {:>6} {:>12} {:>8} {:>8} {:>9} {:>8} {:>9}",
            "method", "Gaussians", "kept", "bytes", "PSNR dB", "SSIM", "temporal", "time", "memory"
        );
        for point in &self.points {
            let more = if point.requested_fraction.is_none() { "  (its own choice)" } else { "" };
            let _ = writeln!(out, "  {}{more}", self.line(point));
        }
        for knob in &self.knobs {
            for EffortSetting { value, point } in &knob.settings {
                let _ = writeln!(out, "  {}  ({} {value})", self.line(point), knob.parameter);
            }
        }
        if self.runs > 1 {
            let _ = writeln!(out, "  times are medians of {} runs", self.runs);
        }
        for note in &self.notes {
            let _ = writeln!(out, "  note: {note}");
        }
        out
    }

    /// Returns the row of `point` in the table for the terminal.
    fn line(&self, point: &TradeOffPoint) -> String {
        let temporal = point.temporal.map_or("-".to_owned(), |error| format!("{error:.5}"));
        let memory = point.peak_memory_bytes.map_or("-".to_owned(), |bytes| format!("{} MiB", bytes >> 20));
        format!(
            "{:<12} {:>9} {:>5.1}% {:>12} {:>8.2} {:>8.5} {temporal:>9} {:>6.2} s {memory:>9}",
            point.method,
            point.count,
            100.0 * self.kept_fraction(point),
            point.bytes,
            point.psnr,
            point.ssim,
            point.seconds,
        )
    }

    /// Returns the fraction of the Gaussians that the result `point` keeps; 1 for an empty input.
    pub fn kept_fraction(&self, point: &TradeOffPoint) -> f64 {
        if self.gaussians == 0 { 1.0 } else { point.count as f64 / self.gaussians as f64 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn csv_matches_the_expected_text() {
        let point = TradeOffPoint {
            method: "paper".to_owned(),
            requested_fraction: Some(0.5),
            count: 6,
            bytes: 1 << 40,
            psnr: f64::INFINITY,
            ssim: 1.0,
            temporal: Some(1e-7),
            seconds: 2.5,
            peak_memory_bytes: Some(4096),
        };
        let own = TradeOffPoint {
            method: "of \"others\", unknown".to_owned(),
            requested_fraction: None,
            temporal: None,
            peak_memory_bytes: None,
            ..point.clone()
        };
        let settings = vec![EffortSetting { value: 100, point: point.clone() }];
        let found = TradeOff {
            tool: String::new(),
            path: String::new(),
            digest: String::new(),
            gaussians: 8,
            bytes: 0,
            threads: 1,
            views: 1,
            cameras: String::new(),
            runs: 1,
            points: vec![point, own],
            knobs: vec![EffortCurve { parameter: "refine_steps".to_owned(), settings }],
            notes: Vec::new(),
        };
        assert_eq!(
            found.csv(),
            "method,asked,count,fraction,bytes,psnr,ssim,temporal,seconds,peak_memory_bytes\n\
             paper,0.5,6,0.75,1099511627776,inf,1,0.0000001,2.5,4096\n\
             \"of \"\"others\"\", unknown\",,6,0.75,1099511627776,inf,1,,2.5,\n"
        );
        assert_eq!(
            found.knobs_csv(),
            "parameter,value,method,asked,count,fraction,bytes,psnr,ssim,temporal,seconds,peak_memory_bytes\n\
             refine_steps,100,paper,0.5,6,0.75,1099511627776,inf,1,0.0000001,2.5,4096\n"
        );
    }
}
