//! The page's tables as CSV: a line of names, then one line per row; what does not exist is empty.

use std::fmt::{Display, Write as _};

use super::failure::FailureMode;
use super::run::Summary;
use crate::pipeline::trade_off::TradeOff;

/// One line per failure mode.
pub(super) fn failure_modes(modes: &[FailureMode]) -> String {
    let mut out = String::from(
        "failure_mode,verdict,gaussians,dropped,merged,coverage,coverage_lost,shown,psnr_there,psnr_elsewhere,\
         detail_lost,worst_frame,worst_view,worst_psnr\n",
    );
    for of in modes {
        let worst = of.worst;
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "{},{},{},{},{},{},{},{},{},{},{},{},{},{}",
            quoted(of.name),
            serde_json::to_value(of.verdict).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default(),
            of.gaussians,
            known(of.dropped),
            known(of.merged),
            of.coverage,
            known(of.coverage_lost),
            of.shown,
            known(of.psnr_there),
            known(of.psnr_elsewhere),
            known(of.detail_lost),
            known(worst.map(|worst| worst.frame)),
            known(worst.map(|worst| worst.view)),
            known(worst.map(|worst| worst.psnr)),
        );
    }
    out
}

/// One line per stage of the run.
pub(super) fn stages(summary: &Summary) -> String {
    let mut out = String::from("stage,gaussians_in,gaussians_out,seconds,peak_memory_bytes\n");
    for of in &summary.stages {
        let _ = writeln!(
            out,
            "{},{},{},{},{}",
            quoted(&of.name),
            of.gaussians_in,
            of.gaussians_out,
            of.seconds,
            known(of.peak_memory_bytes)
        );
    }
    out
}

/// One line per point of a sweep.
pub(super) fn trade_off(found: &TradeOff) -> String {
    let mut out = String::from("method,asked,gaussians,bytes,psnr,ssim,temporal,seconds,peak_memory_bytes\n");
    for of in &found.points {
        let _ = writeln!(
            out,
            "{},{},{},{},{},{},{},{},{}",
            quoted(&of.method),
            known(of.asked),
            of.count,
            of.bytes,
            of.psnr,
            of.ssim,
            known(of.temporal),
            of.seconds,
            known(of.peak_memory_bytes)
        );
    }
    out
}

fn known(value: Option<impl Display>) -> String {
    value.map_or(String::new(), |value| value.to_string())
}

/// As RFC 4180 wants text that holds what parts fields.
fn quoted(text: &str) -> String {
    match text.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_with_commas_and_quotes_stays_one_field() {
        assert_eq!(quoted("a, \"b\""), "\"a, \"\"b\"\"\"");
        assert_eq!(quoted("plain"), "plain");
    }
}
