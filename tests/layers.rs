//! The layers of the library: a module uses its own layer and those below, never one above.

use std::fs;
use std::path::{Path, PathBuf};

/// Modules of each layer, from the vocabulary up.
const LAYERS: [&[&str]; 5] = [
    &["error", "machine", "model", "pass", "plan", "recipe"],
    &["deform", "stats", "score", "select", "merge", "render", "refit", "metrics"],
    &["ingest", "stream", "emit", "demo"],
    &["pipeline", "report"],
    &["cli"],
];

fn layer(module: &str) -> Option<usize> {
    LAYERS.iter().position(|modules| modules.contains(&module))
}

fn rust_files(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rust_files(&path, out);
        } else if path.extension().is_some_and(|e| e == "rs") {
            out.push(path);
        }
    }
}

/// Module names a line reaches through `crate::`, with `crate::{a, b::c}` taken apart.
fn uses(line: &str) -> Vec<String> {
    let mut found = Vec::new();
    for (at, _) in line.match_indices("crate::") {
        let rest = &line[at + "crate::".len()..];
        let names: Vec<&str> = match rest.strip_prefix('{') {
            Some(list) => list.split('}').next().unwrap_or("").split(',').collect(),
            None => vec![rest],
        };
        found.extend(
            names
                .into_iter()
                .map(|name| name.trim().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>()),
        );
    }
    found
}

#[test]
fn modules_use_only_their_own_layer_and_those_below() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    rust_files(&src, &mut files);
    let mut seen = 0;
    for file in files {
        let module = file.strip_prefix(&src).unwrap().iter().next().unwrap().to_str().unwrap();
        let module = module.trim_end_matches(".rs");
        if matches!(module, "lib" | "main") {
            continue;
        }
        let own = layer(module).unwrap_or_else(|| panic!("module {module} belongs to no layer"));
        for line in fs::read_to_string(&file).unwrap().lines() {
            let code = line.split("//").next().unwrap();
            for used in uses(code) {
                if let Some(other) = layer(&used) {
                    seen += 1;
                    assert!(other <= own, "{}: layer {own} uses `{used}` of layer {other}: {line}", file.display());
                }
            }
        }
    }
    assert!(seen > 10, "the scan found only {seen} uses: it no longer reads this code");
}

#[test]
fn upward_use_would_be_seen() {
    assert_eq!(uses("use crate::{cli, model::Camera};"), ["cli", "model"]);
    assert_eq!(uses("let x = crate::pipeline::compress();"), ["pipeline"]);
}
