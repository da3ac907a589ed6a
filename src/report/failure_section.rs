//! Section of the report page about the failure modes (damage to kinds of Gaussians that compression is known to hurt).

use super::failure::{FailureMode, MIN_LOST_CONTRIBUTION, MIN_PSNR_GAP_DB, VISIBLE_ERROR_PSNR_DB, Verdict};
use super::findings::WorstPlaceImages;
use super::html::{db, escape, figure, percent};
use crate::progress::grouped;

/// Returns the HTML of one card for each failure mode in `modes`. A card has the measurements of the failure mode and,
/// if they are in `worst_places`, the images of the place where it is worst.
pub(super) fn modes(modes: &[FailureMode], worst_places: &[WorstPlaceImages]) -> String {
    let mut out = format!(
        "<p class=\"note\">Each pixel knows the share of its color that comes from a kind of Gaussian. A mode is flagged if \
         the PSNR where the kind is visible is below {VISIBLE_ERROR_PSNR_DB} dB and at least {MIN_PSNR_GAP_DB} dB below the PSNR elsewhere, \
         and {}% or more of the kind’s coverage was dropped or merged.</p>\n<div class=\"modes\">\n",
        figure(100.0 * MIN_LOST_CONTRIBUTION)
    );
    for (number, mode) in modes.iter().enumerate() {
        let (class, word) = match mode.verdict {
            Verdict::Absent => ("none", "not in this scene"),
            Verdict::Unseen => ("none", "hardly in any render"),
            Verdict::Untouched => ("good", "nothing lost"),
            Verdict::Passed => ("good", "does not show"),
            Verdict::Flagged => ("bad", "shows"),
        };
        out += &format!(
            "<article class=\"{class}\"><h4>{} <em>{word}</em></h4>\n<p>{}.</p>\n<table>\n",
            capitalized(mode.name),
            escape(&mode.kind_description)
        );
        for (name, value) in rows(mode) {
            out += &format!("<tr><th>{name}</th><td>{value}</td></tr>\n");
        }
        out += "</table>\n";
        if let Some(worst) = worst_places.iter().find(|place| place.mode == number) {
            let [original, compressed] = &worst.images;
            out += &format!(
                "<div class=\"close\"><img alt=\"original\" src=\"{original}\"><img alt=\"compressed\" src=\"{compressed}\"></div>\n\
                 <p class=\"note\">original and compressed where most of the error is, from pixel {}, {}: {}</p>\n",
                worst.corner.0,
                worst.corner.1,
                db(worst.psnr)
            );
        }
        out += "</article>\n";
    }
    out + "</div>\n"
}

/// Returns the table rows for a failure mode: the name and the value (as text) of each measurement that is known.
fn rows(mode: &FailureMode) -> Vec<(&'static str, String)> {
    let of =
        |part: Option<usize>| part.map(|n| format!("{} ({})", grouped(n), percent(n as f64, mode.gaussians as f64)));
    let mut rows = vec![("Gaussians", Some(grouped(mode.gaussians)))];
    if mode.gaussians > 0 {
        let edges = |lost: f64| if lost <= 0.0 { "none".into() } else { percent(lost, 1.0) };
        rows.extend([
            ("dropped", of(mode.dropped)),
            ("merged", of(mode.merged)),
            ("part of the scene’s coverage", Some(percent(mode.coverage, 1.0))),
            ("of that dropped or merged", mode.coverage_lost.map(|lost| percent(lost, 1.0))),
            ("part of all pixels", Some(percent(mode.pixel_share, 1.0))),
            ("PSNR there", mode.psnr_on_kind.map(db)),
            ("PSNR elsewhere", mode.psnr_elsewhere.map(db)),
            ("edges there that are lost", mode.detail_lost.map(edges)),
            ("worst", mode.worst.map(|w| format!("frame {}, view {}: {}", w.frame, w.view, db(w.psnr)))),
        ]);
    }
    rows.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
}

fn capitalized(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}
