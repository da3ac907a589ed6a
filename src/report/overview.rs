//! Head of the report page: the verdict, and a table of what compression changed.

use super::analysis::Analysis;
use super::html::{db, escape, figure, percent};
use crate::progress::{counted, decimal_bytes, grouped};

/// Returns the HTML of the head of the page: names of the models, verdicts, and a table of the changes.
pub(super) fn header(results: &[Analysis], names: &[String]) -> String {
    let found = &results[0].data.evaluation;
    let mut out = format!(
        "<p class=\"paths\">{} → {}</p>\n<h1>What compression cost</h1>\n",
        escape(&found.path.original),
        escape(&names.join(", "))
    );
    for (result, name) in results.iter().zip(names) {
        let name = if names.len() > 1 { format!("<b>{}</b> ", escape(name)) } else { String::new() };
        out += &format!("<p class=\"verdict\">{name}{}</p>\n", escape(&result.data.verdict));
    }
    out += &table(results, names);
    let has_times = results.iter().all(|result| result.data.render_time.is_some());
    let times = if has_times { " Render times are per view, on one thread of this machine." } else { "" };
    out += &format!(
        "<p class=\"note\">Compared on {} renders of {} from {}: {}. PSNR has peak 1 and is averaged \
         over renders; higher is better. From 40 dB on, two renders look alike.{times}</p>\n",
        grouped(found.cameras.pairs),
        counted(found.loss.per_frame.len(), "frame"),
        counted(found.cameras.cameras, "camera"),
        escape(&found.cameras.origin)
    );
    out
}

fn milliseconds(value: f64) -> String {
    format!("{value:.1} ms")
}

/// Returns an HTML table with a row for the original and one for each compressed model in `results`. `names` has the
/// names of the compressed models.
fn table(results: &[Analysis], names: &[String]) -> String {
    let first = &results[0].data.evaluation;
    let has_photographs = results.iter().all(|result| result.data.evaluation.ground_truth.is_some());
    let has_times = results.iter().all(|result| result.data.render_time.is_some());
    let mut heads = vec!["Model", "Gaussians", "Size", "PSNR", "SSIM", "Worst render"];
    heads.extend(has_photographs.then_some("Photographs"));
    heads.extend(has_times.then_some("Render time"));
    let mut rows = vec![vec![
        escape(&first.path.original),
        grouped(first.count.original),
        decimal_bytes(first.bytes.original),
        "exact".to_owned(),
        "1".to_owned(),
        "exact".to_owned(),
    ]];
    rows[0]
        .extend(first.ground_truth.as_ref().filter(|_| has_photographs).map(|truth| db(truth.original.overall.psnr)));
    let time = results[0].data.render_time.filter(|_| has_times);
    rows[0].extend(time.map(|time| milliseconds(time.before)));
    for (result, name) in results.iter().zip(names) {
        let found = &result.data.evaluation;
        let share = |part: f64, whole: f64| format!("<small>{}</small>", percent(part, whole));
        let worst = found.worst_render().map_or(f64::NAN, |render| render.loss.psnr);
        let mut row = vec![
            escape(name),
            grouped(found.count.compressed) + &share(found.count.compressed as f64, found.count.original as f64),
            decimal_bytes(found.bytes.compressed) + &share(found.bytes.compressed as f64, found.bytes.original as f64),
            db(found.loss.overall.psnr),
            figure(found.loss.overall.ssim),
            db(worst),
        ];
        let truth = found.ground_truth.as_ref().filter(|_| has_photographs);
        row.extend(truth.map(|truth| db(truth.compressed.overall.psnr)));
        let time = result.data.render_time.filter(|_| has_times);
        row.extend(time.map(|time| milliseconds(time.after)));
        rows.push(row);
    }
    let mut out = String::from("<table class=\"results\">\n<thead><tr>");
    out += &heads.iter().map(|head| format!("<th scope=\"col\">{head}</th>")).collect::<String>();
    out += "</tr></thead>\n<tbody>\n";
    for row in rows {
        let mut cells = row.iter().zip(&heads);
        let name = cells.next().map_or(String::new(), |(name, _)| format!("<th scope=\"row\">{name}</th>"));
        let cells: String = cells.map(|(cell, head)| format!("<td data-label=\"{head}\">{cell}</td>")).collect();
        out += &format!("<tr>{name}{cells}</tr>\n");
    }
    out + "</tbody>\n</table>\n"
}
