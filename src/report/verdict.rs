//! Verdict of a report in two or three sentences.

use super::failure::{FailureMode, Verdict};
use super::html::percent;
use crate::evaluation::results::Evaluation;
use crate::metrics::PSNR_CAP_DB;
use crate::progress::counted;

/// Words of the verdict for the quality, each with the lowest mean PSNR in dB at which they are used. The root mean
/// square error is below 1/255 from 50 dB on, below 3/255 at 40 dB, 8/255 at 30 dB and 16/255 at 24 dB.
const WORDS: [(f64, &str); 6] = [
    (PSNR_CAP_DB, "renders exactly as the original does"),
    (50.0, "differs from the original by less than a screen can show"),
    (40.0, "looks like the original"),
    (30.0, "differs from the original visibly, side by side"),
    (24.0, "differs from the original at a glance"),
    (f64::NEG_INFINITY, "no longer looks like the original"),
];

/// Returns the verdict in two or three sentences: how much smaller the compressed model is, how visible its differences
/// from the original are, and which kinds of Gaussian are visibly damaged.
pub(super) fn verdict(evaluation: &Evaluation, modes: &[FailureMode]) -> String {
    let mean = evaluation.loss.overall;
    let of = |part: u64, whole: u64| percent(part as f64, whole as f64);
    let words =
        WORDS.iter().find(|(from, _)| mean.psnr >= *from).map_or("cannot be compared with the original", |w| w.1);
    let mut text = format!(
        "With {} of the Gaussians and {} of the bytes, the model {words} ({:.1} dB on average over {}",
        of(evaluation.count.compressed as u64, evaluation.count.original as u64),
        of(evaluation.bytes.compressed, evaluation.bytes.original),
        mean.psnr,
        counted(mean.pairs, "render"),
    );
    if let Some(worst) = evaluation.worst_render().filter(|_| mean.pairs > 1) {
        text += &format!(", {:.1} dB in the worst, frame {} of view {}", worst.loss.psnr, worst.frame, worst.view);
    }
    text += ").";
    if let Some(truth) = &evaluation.ground_truth {
        let lost = truth.original.overall.psnr - truth.compressed.overall.psnr;
        text += &match lost {
            0.005.. => format!(" Against the photographs it is {lost:.2} dB worse than the original."),
            ..-0.005 => format!(" Against the photographs it is {:.2} dB better than the original.", -lost),
            _ => " Against the photographs it is as good as the original.".to_owned(),
        };
    }
    let flagged: Vec<&str> =
        modes.iter().filter(|mode| mode.verdict == Verdict::Flagged).map(|mode| mode.name).collect();
    text += &match flagged.split_last() {
        None => " None of the failure modes looked for shows.".to_owned(),
        Some((last, [])) => format!(" Look at its {last}: it suffers more than the rest."),
        Some((last, others)) => {
            format!(" Look at its {} and {last}: they suffer more than the rest.", others.join(", "))
        }
    };
    text
}
