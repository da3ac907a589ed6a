//! Self-check: compares numbers that this program computes on this machine with exact formulas and with oracles (slow
//! reference computations in f64).
//!
//! Input: none; every case generates its data, the same on every run. Output: a [`SelfcheckReport`], one line per case.
//! Memory: a few sequences of at most 3000 Gaussians; on disk one sequence at a time, in a temporary folder that is
//! deleted.
//!
//! A case runs the code that `compress` runs. The expected values come from other code: from a formula, from exact
//! integer arithmetic, or from the definition written out in f64 over whole arrays ([`oracle`]). The error of a case is
//! the largest error of all values that it compares.

mod case;
mod field;
pub mod generated;
mod merging;
pub mod oracle;
mod renders;
mod score;
mod statistics;
mod storage;
mod threads;

use std::time::Instant;

use serde::Serialize;

use crate::TOOL;
use crate::error::{Error, Result};

pub use case::CaseResult;
use case::LargestError;

/// Case of the self-check. The fields are, in order: its name, what it compares, the bound of its error, and the
/// function that adds the error of every compared value to its argument.
type Case = (&'static str, &'static str, f64, fn(&mut LargestError) -> Result<()>);

/// List of the cases of the self-check, in the order of the pipeline. The documentation of each function gives the
/// reason of the bound.
const CASES: [Case; 28] = [
    ("motion and life", "D, κ, V, life: definition, f64", 1e-13, statistics::motion),
    ("motion far away", "D, κ at 1e6: whole numbers of ulps", 1e-13, statistics::motion_far_away),
    ("motion of any size", "D, κ at 1e-42, 1e37: whole numbers", 1e-13, statistics::motion_of_any_size),
    ("uneven frames", "D, κ of t² at odd stamps: formula", 1e-13, statistics::uneven_frames),
    ("short lives", "D, κ, V of 0 to 3 life frames: exact", 0.0, statistics::short_lives),
    ("steady opacity", "V of 0.9 ± 1e-6: two passes in f64", 1e-9, statistics::steady_opacity),
    ("projected area", "C, Vis: full matrices, f64 (px)", 1e-9, statistics::projected_area),
    ("needle on screen", "C of 1e4 × 1e-8 px: closed form (px)", 1e-9, statistics::needle_on_screen),
    ("percentiles", "nearest ranks: the sorted values", 0.0, score::percentiles),
    ("extent of a scene", "P1, P50, P99: the sorted values", 0.0, score::robust_box),
    ("mixture", "mean, covariance: Σ formed in f64", 1e-13, merging::mixture),
    ("needle and its twin", "scales of 1 : 1e12: themselves", 1e-12, merging::needle),
    ("proxy of five", "mass, mean, covariance, color: f64", 1e-10, merging::proxy),
    ("duplicates", "8 copies and 1 apart: 2, opacity", 1e-6, merging::duplicates),
    ("deformation field", "states: planes, layers in f64", 5e-6, field::states),
    ("field's derivative", "of positions: differences in f64", 1e-5, field::derivative),
    ("one Gaussian", "its render: closed form (of white)", 3e-7, renders::one_gaussian),
    ("many Gaussians", "their render: f64 (of white)", 2e-6, renders::many_gaussians),
    ("contributions", "C, W as seen: sums in f64 (px)", 2e-6, renders::weights),
    ("removal errors", "renders without one: f64 (px)", 5e-6, renders::removal),
    ("harmonics", "16 Y of a direction: Legendre, f64", 3e-7, renders::harmonics),
    ("backward pass", "derivatives: differences in f64", 5e-5, renders::gradients),
    ("PSNR and SSIM", "whole numbers; windows in f64", 1e-12, renders::comparison),
    ("container", "values of 70 frames: the same bits", 0.0, storage::container),
    ("container in bounds", "values: within 1 bound of theirs", 1.0, storage::bounded_container),
    ("archive's grid", "values: within ½ step of theirs", 1.0, storage::archive_grid),
    ("archive's codes", "symbols and bytes: the same", 0.0, storage::archive_codes),
    ("1 and 2 threads", "demo compressed, gradients: same bits", 0.0, threads::same_bytes),
];

/// Results of all cases of the self-check.
#[derive(Debug, Serialize)]
pub struct SelfcheckReport {
    /// Name and version of the program.
    pub tool: &'static str,
    /// Whether every case passes.
    pub pass: bool,
    /// Time that all cases took, in seconds.
    pub seconds: f64,
    /// Result of each case, in the order of the pipeline.
    pub cases: Vec<CaseResult>,
}

/// Runs all cases of the self-check and returns their results.
pub fn run() -> SelfcheckReport {
    let start = Instant::now();
    let cases = CASES.map(|(name, what, bound, measure)| CaseResult::new(name, what, bound, measure)).into();
    SelfcheckReport::new(cases, start.elapsed().as_secs_f64())
}

impl SelfcheckReport {
    fn new(cases: Vec<CaseResult>, seconds: f64) -> SelfcheckReport {
        SelfcheckReport { tool: TOOL, pass: cases.iter().all(|case| case.pass), seconds, cases }
    }

    /// Returns the report as a text table.
    pub fn text(&self) -> String {
        let mut out = format!("{:<20} {:>7} {:>7} {:<4} {}\n", "case", "bound", "error", "", "what is compared");
        for case in &self.cases {
            let pass = if case.pass { "pass" } else { "FAIL" };
            let (name, what) = (case.name, case.what);
            out += &format!(
                "{name:<20} {:>7} {:>7} {pass:<4} {what}\n",
                short_number(case.bound),
                short_number(case.error)
            );
            if let Some(failure) = &case.failure {
                out += &format!("    {failure}\n");
            }
        }
        let passed = self.cases.iter().filter(|case| case.pass).count();
        out + &format!("{passed} of {} pass in {:.1} s: {}\n", self.cases.len(), self.seconds, self.tool)
    }

    /// Checks that every case passed.
    ///
    /// # Errors
    /// Returns [`Error::SelfCheckFailed`] with the names of all failed cases.
    pub fn check_passed(&self) -> Result<()> {
        let failed: Vec<&str> = self.cases.iter().filter(|case| !case.pass).map(|case| case.name).collect();
        if failed.is_empty() {
            return Ok(());
        }
        Err(Error::SelfCheckFailed(failed.join(", ")))
    }
}

/// Formats a number with two significant digits, such as `1.0e-13`, in at most seven characters; 0 becomes `0`.
fn short_number(value: f64) -> String {
    match value {
        0.0 => "0".to_owned(),
        _ => format!("{value:.1e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_cases_pass_and_the_table_fits_a_terminal() {
        let report = run();
        assert!(report.pass, "{}", report.text());
        report.check_passed().unwrap();
        for line in report.text().lines() {
            assert!(line.chars().count() <= 80, "{line}");
        }
        let mut names: Vec<&str> = report.cases.iter().map(|case| case.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), CASES.len(), "two cases of one name");
    }

    #[test]
    fn large_errors_nan_errors_and_panics_fail_a_case() {
        let case = |error| {
            CaseResult::new("made up", "nothing", 1e-9, |worst| {
                worst.add(error);
                Ok(())
            })
        };
        let nan = CaseResult::new("made up", "nothing", 1e-9, |worst| {
            worst.near(f64::NAN, 0.0, 1.0);
            worst.near(0.0, 0.0, 1.0);
            Ok(())
        });
        let refused = CaseResult::new("refused", "nothing", 1e-9, |_| Err(Error::usage("no disk")));
        let idle = CaseResult::new("idle", "nothing", 1e-9, |_| Ok(()));
        let panics = CaseResult::new("panics", "nothing", 1e-9, |_| panic!("as it should"));
        let report = SelfcheckReport::new(vec![case(1e-9), case(1.1e-9), nan, refused, panics, idle], 0.5);
        let passes: Vec<bool> = report.cases.iter().map(|case| case.pass).collect();
        assert_eq!((passes, report.pass), (vec![true, false, false, false, false, false], false));
        let text = report.text();
        assert!(text.contains("FAIL") && text.contains("no disk") && text.contains("1 of 6 pass"), "{text}");
        let error = report.check_passed().unwrap_err().to_string();
        assert!(error.contains("made up, made up, refused, panics, idle"), "{error}");
    }
}
