//! Tests of the structure of the library: neither its folders nor its files import one another in a cycle.
//!
//! A name that a `mod.rs` re-exports from one of its files counts as a name of that file.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Folders of the library in order. Each folder uses only folders before it.
const FOLDERS: [&str; 27] = [
    "limits",
    "machine",
    "recipe",
    "compressed_model",
    "source",
    "archive",
    "fit",
    "progress",
    "files",
    "cache",
    "passes",
    "outputs",
    "tracking",
    "merging",
    "models",
    "memory_plan",
    "statistics",
    "scene",
    "journal",
    "pruning",
    "refinement",
    "pipeline",
    "evaluation",
    "commands",
    "player",
    "report",
    "diagnostics",
];

/// Names that the root of the library re-exports from other crates.
const FROM_CRATES: [&str; 5] = ["deform", "error", "metrics", "model", "render"];

fn folder_index(folder: &str) -> Option<usize> {
    FOLDERS.iter().position(|name| *name == folder)
}

/// Path of a name or module, as a list of names from the root of the library.
type Names = Vec<String>;

/// Imports of a file of the library: all imported paths, and the paths of its re-exports by name.
#[derive(Default)]
struct Module {
    uses: Vec<Names>,
    passes_on: BTreeMap<String, Names>,
}

/// Modules of the library by path, without tests.
struct Library(BTreeMap<Names, Module>);

impl Library {
    fn parse(files: &BTreeMap<Names, String>) -> Library {
        let read = |(at, text): (&Names, &String)| (at.clone(), Module::read(at, text, files));
        Library(files.iter().map(read).collect())
    }

    /// Returns the module that defines the last name of `path`; re-exports are followed.
    fn home(&self, path: &[String]) -> Names {
        self.follow(path, 0)
    }

    fn follow(&self, path: &[String], depth: usize) -> Names {
        let mut at = Names::new();
        for (k, name) in path.iter().enumerate() {
            let inner = [&at[..], std::slice::from_ref(name)].concat();
            if self.0.contains_key(&inner) {
                at = inner;
                continue;
            }
            let passed = self.0.get(&at).and_then(|module| module.passes_on.get(name));
            return match passed {
                Some(target) if depth < 8 => self.follow(&[&target[..], &path[k + 1..]].concat(), depth + 1),
                _ => at,
            };
        }
        at
    }

    /// Returns for each module the modules that it uses.
    fn dependencies(&self) -> BTreeMap<Names, BTreeSet<Names>> {
        let used = |at: &Names, module: &Module| -> BTreeSet<Names> {
            let homes = module.uses.iter().map(|path| self.home(path));
            homes.filter(|home| home != at && !home.is_empty()).collect()
        };
        self.0.iter().map(|(at, module)| (at.clone(), used(at, module))).collect()
    }
}

impl Module {
    fn read(at: &Names, text: &str, files: &BTreeMap<Names, String>) -> Module {
        let code = without_tests_and_comments(text);
        let mut module = Module::default();
        let mut rest = String::new();
        // Statements end in semicolons; imports begin with `use`.
        for statement in code.split(';') {
            let Some((visibility, tree)) = parse_import(statement) else {
                rest.push_str(statement);
                rest.push(';');
                continue;
            };
            for path in expand(tree) {
                let Some(path) = from_root(at, &path, files) else { continue };
                match visibility {
                    true => _ = module.passes_on.insert(path.last().cloned().unwrap_or_default(), path),
                    false => module.uses.push(path),
                }
            }
        }
        let is_path_char = |c: char| c.is_alphanumeric() || c == '_' || c == ':';
        for word in rest.split(|c: char| !is_path_char(c)).filter(|word| word.contains("::")) {
            let path: Names = word.split("::").filter(|name| !name.is_empty()).map(str::to_owned).collect();
            module.uses.extend(from_root(at, &path, files));
        }
        module
    }
}

/// Parses the import `statement`. Returns whether it is a re-export, and its tree of paths; `None` for other
/// statements.
fn parse_import(statement: &str) -> Option<(bool, &str)> {
    let line = statement.lines().map(str::trim_start).position(|line| {
        line.starts_with("use ") || (line.starts_with("pub") && line.split_whitespace().nth(1) == Some("use"))
    })?;
    let start = statement.lines().take(line).map(|line| line.len() + 1).sum::<usize>();
    let import = statement[start..].trim_start();
    Some((import.starts_with("pub"), import[import.find("use ")? + 4..].trim()))
}

fn without_tests_and_comments(text: &str) -> String {
    let text = text.split("#[cfg(test)]\nmod ").next().unwrap_or("");
    let text = text.split("#[cfg(test)]\npub(crate) mod ").next().unwrap_or("");
    let text = text.lines().map(|line| line.split("//").next().unwrap_or("")).collect::<Vec<_>>().join("\n");
    // The path in `pub(in path)` is a visibility, not an import.
    let mut parts = text.split("pub(in ");
    let first = parts.next().unwrap_or("").to_owned();
    parts.fold(first, |code, part| code + "pub(crate)" + part.split_once(')').map_or("", |(_, after)| after))
}

/// Returns every path of an import tree. The tree `crate::{a, b::{c, d}}` has three paths.
fn expand(tree: &str) -> Vec<Names> {
    let tree = tree.trim();
    let Some(open) = tree.find('{') else {
        let tree = tree.split(" as ").next().unwrap_or("");
        return vec![tree.split("::").map(|name| name.trim().to_owned()).filter(|name| name != "self").collect()];
    };
    let stem: Names =
        tree[..open].split("::").map(str::trim).filter(|name| !name.is_empty()).map(str::to_owned).collect();
    let inside = &tree[open + 1..tree.rfind('}').unwrap_or(tree.len())];
    let (mut depth, mut start, mut parts) = (0, 0, Vec::new());
    for (at, c) in inside.char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(&inside[start..at]);
                start = at + 1;
            }
            _ => (),
        }
    }
    parts.push(&inside[start..]);
    let branches = parts.into_iter().filter(|part| !part.trim().is_empty()).flat_map(expand);
    branches.map(|branch| [&stem[..], &branch[..]].concat()).collect()
}

/// Converts `path`, as written in the module `at`, to a path from the root of the library. Returns `None` if it leads
/// outside of the library.
fn from_root(at: &Names, path: &[String], files: &BTreeMap<Names, String>) -> Option<Names> {
    match path.first().map(String::as_str)? {
        "crate" => Some(path[1..].to_vec()),
        "self" => Some([&at[..], &path[1..]].concat()),
        "super" => {
            let ups = path.iter().take_while(|name| *name == "super").count();
            Some([&at[..at.len().checked_sub(ups)?], &path[ups..]].concat())
        }
        name => {
            let inner = [&at[..], &[name.to_owned()]].concat();
            files.contains_key(&inner).then(|| [&at[..], path].concat())
        }
    }
}

/// Collects the text of every file below `folder` in `found`, by module path, except tests.
fn modules(folder: &Path, at: &Names, found: &mut BTreeMap<Names, String>) {
    let mut entries: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    for path in entries {
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        let inner = [&at[..], std::slice::from_ref(&name)].concat();
        if path.is_dir() {
            // The command line belongs to the program.
            if name != "cli" {
                modules(&path, &inner, found);
            }
        } else if path.extension().is_some_and(|e| e == "rs") && !["tests", "main"].contains(&name.as_str()) {
            let own = if ["mod", "lib"].contains(&name.as_str()) { at.clone() } else { inner };
            found.insert(own, fs::read_to_string(&path).unwrap());
        }
    }
}

fn library() -> Library {
    let mut files = BTreeMap::new();
    modules(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &Names::new(), &mut files);
    Library::parse(&files)
}

/// Returns a cycle of modules that use one another; `None` if there is none.
fn cycle(dependencies: &BTreeMap<Names, BTreeSet<Names>>) -> Option<Vec<Names>> {
    let mut left = dependencies.clone();
    // A module that uses no remaining module is in no cycle.
    while let Some(free) = left.iter().find(|(_, used)| used.is_empty()).map(|(at, _)| at.clone()) {
        left.remove(&free);
        left.values_mut().for_each(|used| _ = used.remove(&free));
    }
    let mut walk = vec![left.keys().next()?.clone()];
    loop {
        let next = left[walk.last()?].iter().find(|used| left.contains_key(*used))?.clone();
        if let Some(start) = walk.iter().position(|at| *at == next) {
            return Some(walk[start..].to_vec());
        }
        walk.push(next);
    }
}

#[test]
fn folders_use_only_those_before_them() {
    let mut seen = 0;
    for (at, used) in library().dependencies() {
        let Some(folder) = at.first() else { continue };
        let own = folder_index(folder).unwrap_or_else(|| panic!("{folder} is missing in FOLDERS"));
        for home in used {
            let other = &home[0];
            let is_before =
                FROM_CRATES.contains(&other.as_str()) || folder_index(other).is_some_and(|index| index <= own);
            seen += 1;
            assert!(is_before, "{} uses {}, which comes after it", at.join("::"), home.join("::"));
        }
    }
    assert!(seen > 300, "the scan found only {seen} uses: it no longer reads this code");
}

#[test]
fn files_form_no_cycle() {
    if let Some(cycle) = cycle(&library().dependencies()) {
        let names: Vec<String> = cycle.iter().map(|at| at.join("::")).collect();
        panic!("these files use one another: {}", names.join(" -> "));
    }
}

#[test]
fn violations_are_detected() {
    let files = |list: &[(&str, &str)]| -> BTreeMap<Names, String> {
        let names = |at: &str| at.split("::").filter(|name| !name.is_empty()).map(str::to_owned).collect();
        list.iter().map(|&(at, text)| (names(at), text.to_owned())).collect()
    };
    let round = files(&[
        ("", "pub mod a;"),
        ("a", "mod b;\nmod c;\npub use b::B;\n"),
        ("a::b", "use super::c::C;\nfn f() {}"),
        ("a::c", "use crate::a::{B, d};\n"),
    ]);
    assert_eq!(cycle(&Library::parse(&round).dependencies()).map(|found| found.len()), Some(2));
    let inline = files(&[("", ""), ("a", "fn f() { crate::b::g(); }"), ("b", "fn g() { super::a::f() }")]);
    assert!(cycle(&Library::parse(&inline).dependencies()).is_some());
    let straight = files(&[
        ("", ""),
        ("a", "pub use b::B;\nmod b;"),
        ("a::b", "// use crate::a::c::C;\nuse crate::c::D;"),
        ("c", ""),
    ]);
    assert!(cycle(&Library::parse(&straight).dependencies()).is_none());
}
