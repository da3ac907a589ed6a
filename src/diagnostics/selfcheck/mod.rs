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

/// List of the cases of the self-check, in the order of the pipeline. Each function runs one case.
const CASES: [fn() -> CaseResult; 28] = [
    statistics::motion,
    statistics::motion_far_away,
    statistics::motion_of_any_size,
    statistics::uneven_frames,
    statistics::short_lives,
    statistics::steady_opacity,
    statistics::projected_area,
    statistics::needle_on_screen,
    score::percentiles,
    score::robust_box,
    merging::mixture,
    merging::needle,
    merging::proxy,
    merging::duplicates,
    field::states,
    field::derivative,
    renders::one_gaussian,
    renders::many_gaussians,
    renders::weights,
    renders::removal,
    renders::harmonics,
    renders::gradients,
    renders::comparison,
    storage::container,
    storage::bounded_container,
    storage::archive_grid,
    storage::archive_codes,
    threads::same_bytes,
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
    let cases: Vec<CaseResult> = CASES.iter().map(|case| case()).collect();
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
    use super::case::LargestError;
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
        let case = |error| CaseResult::new("made up", "nothing", 1e-9, || Ok(error));
        let nan = || {
            let mut worst = LargestError::default();
            worst.near(f64::NAN, 0.0, 1.0);
            worst.near(0.0, 0.0, 1.0);
            worst
        };
        let refused = CaseResult::new("refused", "nothing", 1e-9, || Err(Error::usage("no disk")));
        let idle = CaseResult::new("idle", "nothing", 1e-9, || Ok(LargestError::default()));
        let panics = CaseResult::new("panics", "nothing", 1e-9, || panic!("as it should"));
        let report = SelfcheckReport::new(
            vec![case(LargestError(1e-9)), case(LargestError(1.1e-9)), case(nan()), refused, panics, idle],
            0.5,
        );
        let passes: Vec<bool> = report.cases.iter().map(|case| case.pass).collect();
        assert_eq!((passes, report.pass), (vec![true, false, false, false, false, false], false));
        let text = report.text();
        assert!(text.contains("FAIL") && text.contains("no disk") && text.contains("1 of 6 pass"), "{text}");
        let error = report.check_passed().unwrap_err().to_string();
        assert!(error.contains("made up, made up, refused, panics, idle"), "{error}");
    }
}
