//! Skeleton of an HTML page that needs no network, and small parts for its content.
//!
//! All text from files or paths passes through [`escape`]. The content security policy in the head allows a browser to
//! load only images that the file contains and to run only the scripts whose digests it lists.

use super::chart;
use super::html::escape;
use crate::files::page_policy::{policy_digest, policy_meta_element};

const STYLE: &str = include_str!("page.css");

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
         <title>{}</title>\n<style>\n{STYLE}{}</style>\n</head>\n<body>\n<main>\n{body}{scripts}</main>\n</body>\n</html>\n",
        escape(title),
        chart::STYLE,
    )
}

/// Returns an HTML figure: the chart `svg` with the caption `caption` above it.
pub(super) fn figure_of(caption: &str, svg: &str) -> String {
    format!("<figure><figcaption>{}</figcaption>{svg}</figure>\n", escape(caption))
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
