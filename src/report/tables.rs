//! The page's tables as CSV: a line of names, then one line per row; what does not exist is empty.

use std::fmt::Write as _;

use super::failure::FailureMode;
use crate::compress::summary::Summary;
use crate::verbs::csv::{known, quoted};

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
