//! Head of the report page: the verdict, and what compression changed. The changes are shown on four cards, or in one
//! table if there are several compressed models.

use super::analysis::Analysis;
use super::findings::CompressedModelData;
use super::html::{bytes, count, db, escape, figure, percent};
use crate::evaluation::results::OriginalAndCompressed;
use crate::models::ModelSize;

/// Returns the HTML of the head of the page: names of the models, verdict, and changes. The changes of a single
/// compressed model are shown on cards, those of several in a table.
pub(super) fn header(results: &[Analysis], names: &[String]) -> String {
    let found = &results[0].data.evaluation;
    let original = escape(&found.path.original);
    let mut out = String::new();
    match results {
        [result] => {
            out += &format!(
                "<p class=\"paths\">{original} → {}</p>\n<h1>What compression cost</h1>\n<p class=\"verdict\">{}</p>\n",
                escape(&found.path.compressed),
                escape(&result.data.verdict)
            );
            out += &cards(&result.data);
        }
        _ => {
            out += &format!(
                "<p class=\"paths\">{original} → {}</p>\n<h1>What compression cost</h1>\n",
                escape(&names.join(", "))
            );
            for (result, name) in results.iter().zip(names) {
                out += &format!("<p class=\"verdict\"><b>{}</b> {}</p>\n", escape(name), escape(&result.data.verdict));
            }
            out += &table(results, names);
        }
    }
    out += &format!(
        "<p class=\"note\">Compared on {} renders of {} frame{} from {} camera{}: {}. PSNR has peak 1 and is averaged \
         over renders; higher is better. From 40 dB on, two renders look alike.</p>\n",
        count(found.cameras.pairs),
        found.loss.per_frame.len(),
        plural(found.loss.per_frame.len()),
        found.cameras.cameras,
        plural(found.cameras.cameras),
        escape(&found.cameras.origin)
    );
    out
}

fn plural(number: usize) -> &'static str {
    if number == 1 { "" } else { "s" }
}

/// Returns the HTML of a card: its label, the value of the original (`before`), the value of the compressed model
/// (`after`), and a line with further figures (`more`).
fn card(label: &str, before: &str, after: &str, more: &str) -> String {
    format!(
        "<div class=\"card\"><span class=\"label\">{label}</span><span class=\"change\"><span>{before}</span> \
         <i aria-label=\"to\">→</i> <b>{after}</b></span><small>{more}</small></div>\n"
    )
}

/// Returns the HTML of the four cards of a result. The first three are Gaussians, size and quality. The fourth is the
/// comparison with photographs if there are any, else the render time if it was measured, else SSIM.
fn cards(result: &CompressedModelData) -> String {
    let found = &result.evaluation;
    let (counts, sizes, mean) = (found.count, found.bytes, found.loss.overall);
    let mut out = String::from("<div class=\"cards\">\n");
    out += &card(
        "Gaussians",
        &count(counts.original),
        &count(counts.compressed),
        &times_fewer(counts.original as f64, counts.compressed as f64, "fewer", "more"),
    );
    let parts: String = size_parts(&found.size)
        .iter()
        .map(|(part, before, after)| format!("<br>{}: {} → {}", escape(part), bytes(*before), bytes(*after)))
        .collect();
    let smaller = times_fewer(sizes.original as f64, sizes.compressed as f64, "smaller", "larger");
    out += &card("Size", &bytes(sizes.original), &bytes(sizes.compressed), &(smaller + &parts));
    let views = format!("SSIM {:.4}, against the original’s renders", mean.ssim);
    out += &card("Quality (PSNR)", "exact", &db(mean.psnr), &views);
    out += &match (&found.ground_truth, result.render_time) {
        (Some(truth), _) => {
            let (before, after) = (truth.original.overall, truth.compressed.overall);
            let change = after.psnr - before.psnr;
            let more = format!("{change:+.2} dB, SSIM {:.4} → {:.4}", before.ssim, after.ssim);
            card("Against photographs (PSNR)", &db(before.psnr), &db(after.psnr), &more)
        }
        (None, Some(time)) => {
            let more =
                times_fewer(time.before, time.after, "faster", "slower") + " per view, one thread of this machine";
            card("Render time", &milliseconds(time.before), &milliseconds(time.after), &more)
        }
        (None, None) => {
            let more = "structural similarity to the original’s renders; 1 is the same";
            card("Similarity (SSIM)", "1", &format!("{:.4}", mean.ssim), more)
        }
    };
    out + "</div>\n"
}

/// Returns the change from `before` to `after` as text, such as "10.0× fewer (10%)". `fewer` and `more` are the words
/// for a decrease and an increase.
fn times_fewer(before: f64, after: f64, fewer: &str, more: &str) -> String {
    if before == after {
        return "unchanged".to_owned();
    }
    match before > after {
        true if after > 0.0 => format!("{:.1}× {fewer} ({})", before / after, percent(after, before)),
        true => "nothing left".to_owned(),
        false => format!("{} {more}", percent(after - before, before)),
    }
}

fn milliseconds(value: f64) -> String {
    format!("{value:.1} ms")
}

/// Returns the parts of the size (such as Gaussians and deformation field) that both models have and that take more
/// than 1% of the compressed model's bytes. Each is a tuple: name, bytes of the original, bytes of the compressed
/// model. Returns an empty list if there are fewer than two such parts.
pub(super) fn size_parts(size: &OriginalAndCompressed<ModelSize>) -> Vec<(&'static str, u64, u64)> {
    let parts = size.original.named_parts().into_iter().zip(size.compressed.named_parts());
    let parts: Vec<_> = parts.map(|((name, before), (_, after))| (name, before, after)).collect();
    // Parts below 1% of the compressed model are left out.
    let least = size.compressed.total() / 100;
    let both: Vec<_> = parts.into_iter().filter(|&(_, before, after)| before > 0 && after > least).collect();
    if both.len() > 1 { both } else { Vec::new() }
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
        count(first.count.original),
        bytes(first.bytes.original),
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
            count(found.count.compressed) + &share(found.count.compressed as f64, found.count.original as f64),
            bytes(found.bytes.compressed) + &share(found.bytes.compressed as f64, found.bytes.original as f64),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decreases_are_factors_and_increases_are_percentages() {
        assert_eq!(times_fewer(20_880.0, 2_088.0, "fewer", "more"), "10.0× fewer (10%)");
        assert_eq!(times_fewer(10.0, 10.0, "fewer", "more"), "unchanged");
        assert_eq!(times_fewer(10.0, 12.0, "smaller", "larger"), "20% larger");
        assert_eq!(times_fewer(10.0, 0.0, "fewer", "more"), "nothing left");
    }
}
