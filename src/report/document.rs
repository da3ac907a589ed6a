//! Skeleton of an HTML page that needs no network, and small parts for its content.
//!
//! All text from files or paths passes through [`escape`]. The content security policy in the head allows a browser to
//! load only images that the file contains and to run only the scripts whose digests it lists.

use super::html::{escape, file_name};
use crate::files::page_policy::{policy_digest, policy_meta_element};

/// Style sheet of pages.
const STYLE: &str = include_str!("page.css");
/// Style sheet of charts.
const CHART_STYLE: &str = include_str!("chart.css");

/// Returns a complete HTML file with the title `title` and the content `body`. The JavaScript texts `scripts` run at
/// the end of the page; they must not contain text from files.
pub(super) fn document(title: &str, body: &str, scripts: &[&str]) -> String {
    let scripts: Vec<String> = scripts.iter().map(|script| format!("\n{script}")).collect();
    let digests: Vec<String> = scripts.iter().map(|script| policy_digest(script)).collect();
    let policy = policy_meta_element(&[
        ("img-src", &["data:".to_owned()]),
        // Sizes of images are attributes, which no digest can allow.
        ("style-src", &["'unsafe-inline'".to_owned()]),
        ("script-src", &digests),
    ]);
    let scripts: String = scripts.iter().map(|script| format!("<script>{script}</script>\n")).collect();
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         {policy}\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>{}</title>\n<style>\n{STYLE}{CHART_STYLE}</style>\n</head>\n<body>\n<main>\n\
         {body}{scripts}</main>\n</body>\n</html>\n",
        escape(title),
    )
}

/// Returns the HTML page of the measurements of the model `path`. `heading` begins the title. `files`: names of the
/// data files beside the page. `tool`: program that made it.
pub(super) fn measurements_page(heading: &str, path: &str, body: &str, files: &[&str], tool: &str) -> String {
    let title = format!("{heading}: {}", file_name(path));
    let body = format!(
        "<header>\n<h1>{}</h1>\n</header>\n{body}<p>Everything on this page, as data beside it: {}.</p>\n\
         <p class=\"note\">Made by {}.</p>\n",
        escape(&title),
        links(files),
        escape(tool)
    );
    document(&title, &body, &[])
}

/// Returns an HTML figure: the chart `svg` with the caption `caption` above it.
pub(super) fn figure_of(caption: &str, svg: &str) -> String {
    format!("<figure><figcaption>{}</figcaption>{svg}</figure>\n", escape(caption))
}

/// Returns an HTML table of the CSS class `class`: a row with the column headings `heads`, then `rows`. Headings and
/// cells are HTML.
pub(super) fn table<const N: usize>(
    class: &str,
    heads: [&str; N],
    rows: impl IntoIterator<Item = [String; N]>,
) -> String {
    let row = |tag: &str, cells: &[String]| {
        let cells = cells.iter().map(|cell| format!("<{tag}>{cell}</{tag}>"));
        format!("<tr>{}</tr>\n", cells.collect::<String>())
    };
    let head = row("th", &heads.map(str::to_owned));
    let rows: String = rows.into_iter().map(|cells| row("td", &cells)).collect();
    format!("<table class=\"{class}\">\n{head}{rows}</table>\n")
}

/// Returns an HTML list of the notes `notes`; empty without notes.
pub(super) fn list<'a>(notes: impl IntoIterator<Item = &'a String>) -> String {
    let items: Vec<String> = notes.into_iter().map(|note| format!("<li>{}</li>", escape(note))).collect();
    if items.is_empty() { String::new() } else { format!("<ul class=\"note\">{}</ul>\n", items.join("\n")) }
}

/// Returns HTML links to the files `names`, which lie beside the page.
pub(super) fn links(names: &[&str]) -> String {
    let links: Vec<String> = names.iter().map(|name| format!("<a href=\"{name}\">{name}</a>")).collect();
    links.join(", ")
}

/// Returns the HTML heading of the compressed model with the index `number` in `names`; empty if there is only one
/// compressed model.
pub(super) fn heading(names: &[String], number: usize) -> String {
    if names.len() < 2 { String::new() } else { format!("<h3>{}</h3>\n", escape(&names[number])) }
}
