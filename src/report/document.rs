//! HTML files that need no network, and their parts.
//!
//! Everything that comes from files or paths passes through [`escape`]; the content policy in the head lets a browser
//! load nothing but what is inside.

use super::chart;
use super::html::escape;

const STYLE: &str = include_str!("page.css");

/// A whole file.
pub(super) fn document(title: &str, body: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src data:; \
         style-src 'unsafe-inline'; script-src 'unsafe-inline'\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>{}</title>\n<style>\n{STYLE}{}</style>\n</head>\n<body>\n<main>\n{body}</main>\n</body>\n</html>\n",
        escape(title),
        chart::STYLE,
    )
}

/// A chart under its name.
pub(super) fn figure_of(caption: &str, svg: &str) -> String {
    format!("<figure><figcaption>{}</figcaption>{svg}</figure>\n", escape(caption))
}

/// Things a person should know; of none nothing.
pub(super) fn list<'a>(notes: impl IntoIterator<Item = &'a String>) -> String {
    let items: Vec<String> = notes.into_iter().map(|note| format!("<li>{}</li>", escape(note))).collect();
    if items.is_empty() { String::new() } else { format!("<ul class=\"note\">{}</ul>\n", items.join("\n")) }
}

/// Files beside the page.
pub(super) fn links(names: &[&str]) -> String {
    let links: Vec<String> = names.iter().map(|name| format!("<a href=\"{name}\">{name}</a>")).collect();
    links.join(", ")
}
