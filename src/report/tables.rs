//! CSV tables that are written beside the report page.

use super::failure::FailureMode;
use crate::files::csv::{optional_field, table};
use crate::journal::records::StageRecord;

/// Returns a CSV table of the measurements of all failure modes, one line per failure mode.
pub(super) fn failure_modes(modes: &[FailureMode]) -> String {
    let names = [
        "failure_mode",
        "verdict",
        "gaussians",
        "dropped",
        "merged",
        "coverage",
        "coverage_lost",
        "shown",
        "psnr_there",
        "psnr_elsewhere",
        "detail_lost",
        "worst_frame",
        "worst_view",
        "worst_psnr",
    ];
    let row = |of: &FailureMode| {
        vec![
            of.name.to_owned(),
            serde_json::to_value(of.verdict).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default(),
            of.gaussians.to_string(),
            optional_field(of.dropped),
            optional_field(of.merged),
            of.coverage.to_string(),
            optional_field(of.coverage_lost),
            of.pixel_share.to_string(),
            optional_field(of.psnr_on_kind),
            optional_field(of.psnr_elsewhere),
            optional_field(of.detail_lost),
            optional_field(of.worst.map(|worst| worst.frame)),
            optional_field(of.worst.map(|worst| worst.view)),
            optional_field(of.worst.map(|worst| worst.psnr)),
        ]
    };
    table(&names, modes.iter().map(row))
}

/// Returns a CSV table of the stages of the run that wrote the compressed model, one line per stage.
pub(super) fn stages(stages: &[StageRecord]) -> String {
    let row = |of: &StageRecord| {
        vec![
            of.name.clone(),
            of.gaussians_in.to_string(),
            of.gaussians_out.to_string(),
            of.seconds.to_string(),
            optional_field(of.processor_seconds),
            optional_field(of.peak_memory_bytes),
        ]
    };
    table(
        &["stage", "gaussians_in", "gaussians_out", "seconds", "processor_seconds", "peak_memory_bytes"],
        stages.iter().map(row),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::failure::{Verdict, WorstPlace};
    use crate::source::ReadCounts;

    #[test]
    fn failure_modes_are_these_bytes() {
        let seen = FailureMode {
            name: "fast, and small",
            kind_description: String::new(),
            verdict: Verdict::Flagged,
            gaussians: 9,
            dropped: Some(2),
            merged: Some(3),
            coverage: 0.25,
            coverage_lost: Some(1e-7),
            pixel_share: 1.0,
            psnr_on_kind: Some(30.5),
            psnr_elsewhere: Some(40.0),
            detail_lost: Some(-0.5),
            worst: Some(WorstPlace { place: 0, frame: 4, view: 7, psnr: 12.0 }),
        };
        let unknown = FailureMode {
            name: "slow",
            verdict: Verdict::Absent,
            dropped: None,
            merged: None,
            coverage_lost: None,
            psnr_on_kind: None,
            psnr_elsewhere: None,
            detail_lost: None,
            worst: None,
            ..seen.clone()
        };
        assert_eq!(
            failure_modes(&[seen, unknown]),
            "failure_mode,verdict,gaussians,dropped,merged,coverage,coverage_lost,shown,psnr_there,psnr_elsewhere,\
             detail_lost,worst_frame,worst_view,worst_psnr\n\
             \"fast, and small\",flagged,9,2,3,0.25,0.0000001,1,30.5,40,-0.5,4,7,12\n\
             slow,absent,9,,,0.25,,1,,,,,,\n"
        );
    }

    #[test]
    fn stages_are_these_bytes() {
        let stage = StageRecord {
            name: "scan".to_owned(),
            gaussians_in: 10,
            gaussians_out: 7,
            reads: ReadCounts::default(),
            full_reads: 0.0,
            scratch_bytes: 0,
            from_cache: false,
            seconds: 0.125,
            processor_seconds: Some(0.25),
            peak_memory_bytes: Some(4096),
        };
        let merge = StageRecord {
            name: "\"merge\"".to_owned(),
            seconds: 3.0,
            processor_seconds: None,
            peak_memory_bytes: None,
            ..stage.clone()
        };
        assert_eq!(
            stages(&[stage, merge]),
            "stage,gaussians_in,gaussians_out,seconds,processor_seconds,peak_memory_bytes\nscan,10,7,0.125,0.25,4096\n\
             \"\"\"merge\"\"\",10,7,3,,\n"
        );
    }
}
