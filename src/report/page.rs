//! Content of the report page: its sections in order.

use super::analysis::Analysis;
use super::document::document;
use super::html::file_name;
use super::{compare, details, overview, quality};
use crate::evaluation::precision::PrecisionDiagram;
use crate::evaluation::trade_off::TradeOff;

/// JavaScript of the sliders (two images with a movable border between them).
const SLIDER: &str = include_str!("slider.js");
/// JavaScript of the animations.
const FILM: &str = include_str!("film.js");

/// Returns the HTML of the report page for `results`, one or more compressed models of one original. `sweep` and
/// `precision` hold curves to include, if there are any.
pub(super) fn page(results: &[Analysis], sweep: Option<&TradeOff>, precision: Option<&PrecisionDiagram>) -> String {
    let names = names(results);
    let title = format!("{} – splatsieve report", names.join(", "));
    let mut out = format!("<header>\n{}</header>\n", overview::header(results, &names));
    let sections = [
        ("compare", "Before and after", compare::sliders(results, &names)),
        ("motion", "In motion", compare::films(results, &names)),
        ("quality", "Where quality is lost", quality::charts(results, &names)),
        ("details", "Details", details::details(results, &names, sweep, precision)),
    ];
    for (id, heading, body) in sections {
        if !body.is_empty() {
            out += &format!("<section id=\"{id}\">\n<h2>{heading}</h2>\n{body}</section>\n");
        }
    }
    document(&title, &out, &[SLIDER, FILM])
}

/// Returns a short name for each compressed model; all names are different.
fn names(results: &[Analysis]) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for result in results {
        let own = file_name(&result.data.evaluation.path.compressed);
        let same = names.iter().filter(|name| *name == own || name.starts_with(&format!("{own} ("))).count();
        names.push(if same == 0 { own.to_owned() } else { format!("{own} ({})", same + 1) });
    }
    names
}
