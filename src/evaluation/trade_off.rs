//! What a sweep found, for people and for programs: quality, size, time and memory of every method at
//! every kept fraction, and of one method as a parameter is turned.

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use crate::files::csv::{known, table};

/// Every point of a sweep, and what they share.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TradeOff {
    /// Program and version.
    pub tool: String,
    /// Input, as given.
    pub path: String,
    /// Hash over the input's bytes.
    pub digest: String,
    /// Gaussians of the input.
    pub gaussians: usize,
    /// Bytes of everything the model consists of.
    pub bytes: u64,
    /// Threads at work.
    pub threads: usize,
    /// Pictures that every point is compared on: (frame, view) pairs, and where their cameras come from.
    pub pictures: usize,
    /// File of the cameras, or the recipe of a virtual rig.
    pub cameras: String,
    /// Times that every point was run.
    pub runs: usize,
    /// By method, as listed in `--methods`, then by the fraction asked for, falling.
    pub points: Vec<TradeOffPoint>,
    /// Parameters that were turned.
    pub knobs: Vec<EffortCurve>,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// One method at one size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TradeOffPoint {
    /// Name of the method, as `--methods` takes it.
    pub method: String,
    /// Kept fraction that was asked for; none: the method's own choice.
    pub asked: Option<f64>,
    /// Gaussians in the result.
    pub count: usize,
    /// Bytes of everything the result consists of.
    pub bytes: u64,
    /// Mean PSNR against the original's own pictures, dB.
    pub psnr: f64,
    /// Mean SSIM against them.
    pub ssim: f64,
    /// Mean temporal error against them; none if no view is seen twice.
    pub temporal: Option<f64>,
    /// Wall-clock time of compressing, from opening the input to the result on the disk: the median of all runs.
    pub seconds: f64,
    /// Largest resident memory while compressing, of any run; none where the system does not tell.
    pub peak_memory_bytes: Option<u64>,
}

/// One method at one size as one parameter is turned, all others as they are: what more time buys.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EffortCurve {
    /// Name of the parameter, as a recipe has it.
    pub parameter: String,
    /// By value, rising.
    pub settings: Vec<Setting>,
}

/// What a value of a [`EffortCurve`]'s parameter comes to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Setting {
    /// The parameter's value.
    pub value: u32,
    /// Method, size and what was measured.
    #[serde(flatten)]
    pub point: TradeOffPoint,
}

/// A point's columns in a table.
const COLUMNS: [&str; 10] =
    ["method", "asked", "count", "fraction", "bytes", "psnr", "ssim", "temporal", "seconds", "peak_memory_bytes"];

impl TradeOff {
    /// As JSON, for programs.
    pub fn json(&self) -> String {
        let mut text = serde_json::to_string_pretty(self).expect("plain data");
        text.push('\n');
        text
    }

    /// One line per point under a line of names; a value that does not exist is empty.
    pub fn csv(&self) -> String {
        table(&COLUMNS, self.points.iter().map(|point| self.row(point)))
    }

    /// The same of every setting of every knob.
    pub fn knobs_csv(&self) -> String {
        let settings = self.knobs.iter().flat_map(|knob| knob.settings.iter().map(move |setting| (knob, setting)));
        let row = |(knob, setting): (&EffortCurve, &Setting)| {
            [vec![knob.parameter.clone(), setting.value.to_string()], self.row(&setting.point)].concat()
        };
        table(&[&["parameter", "value"], &COLUMNS[..]].concat(), settings.map(row))
    }

    /// Fields of [`COLUMNS`].
    fn row(&self, point: &TradeOffPoint) -> Vec<String> {
        vec![
            point.method.clone(),
            known(point.asked),
            point.count.to_string(),
            self.fraction(point).to_string(),
            point.bytes.to_string(),
            point.psnr.to_string(),
            point.ssim.to_string(),
            known(point.temporal),
            point.seconds.to_string(),
            known(point.peak_memory_bytes),
        ]
    }

    /// A table for a person.
    pub fn text(&self) -> String {
        let mut out = String::new();
        let _ = writeln!(
            out,
            "{}: {} Gaussians, compared on {} pictures: {}",
            self.path, self.gaussians, self.pictures, self.cameras
        );
        let _ = writeln!(
            out,
            "  {:<12} {:>9} {:>6} {:>12} {:>8} {:>8} {:>9} {:>8} {:>9}",
            "method", "Gaussians", "kept", "bytes", "PSNR dB", "SSIM", "temporal", "time", "memory"
        );
        for point in &self.points {
            let more = if point.asked.is_none() { "  (its own choice)" } else { "" };
            let _ = writeln!(out, "  {}{more}", self.line(point));
        }
        for knob in &self.knobs {
            for Setting { value, point } in &knob.settings {
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

    /// A point in the table.
    fn line(&self, point: &TradeOffPoint) -> String {
        let temporal = point.temporal.map_or("-".to_owned(), |error| format!("{error:.5}"));
        let memory = point.peak_memory_bytes.map_or("-".to_owned(), |bytes| format!("{} MiB", bytes >> 20));
        format!(
            "{:<12} {:>9} {:>5.1}% {:>12} {:>8.2} {:>8.5} {temporal:>9} {:>6.2} s {memory:>9}",
            point.method,
            point.count,
            100.0 * self.fraction(point),
            point.bytes,
            point.psnr,
            point.ssim,
            point.seconds,
        )
    }

    /// Part of the Gaussians that a point keeps; 1 of none.
    pub fn fraction(&self, point: &TradeOffPoint) -> f64 {
        if self.gaussians == 0 { 1.0 } else { point.count as f64 / self.gaussians as f64 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn csv_is_these_bytes() {
        let point = TradeOffPoint {
            method: "paper".to_owned(),
            asked: Some(0.5),
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
            asked: None,
            temporal: None,
            peak_memory_bytes: None,
            ..point.clone()
        };
        let settings = vec![Setting { value: 100, point: point.clone() }];
        let found = TradeOff {
            tool: String::new(),
            path: String::new(),
            digest: String::new(),
            gaussians: 8,
            bytes: 0,
            threads: 1,
            pictures: 1,
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
