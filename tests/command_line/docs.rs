//! Tests of README and user documentation: commands parse, links lead to files, generated pages are up to date, and the
//! README is short.
//!
//! `SPLATSIEVE_WRITE_DOCS=1` writes the generated pages, `docs/cli.md` and `docs/parameters.md`, instead of comparing
//! them.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::scene::{Workplace, program};
use splatsieve::recipe::{PRESETS, parameters};

/// Commands of the program in the order of `splatsieve --help`.
pub(crate) const COMMANDS: [&str; 16] = [
    "compress",
    "evaluate",
    "report",
    "view",
    "render",
    "convert",
    "info",
    "score",
    "sweep",
    "precision",
    "demo",
    "cache",
    "recipe",
    "selfcheck",
    "completions",
    "man",
];
/// Maximum number of lines of the README.
const README_LINES: usize = 200;
/// Maximum number of words of the README, separated by blanks.
const README_WORDS: usize = 1800;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns path and text of the README, of the other top-level pages for people, and of the pages in `docs`.
fn pages() -> Vec<(PathBuf, String)> {
    let docs = fs::read_dir(root().join("docs")).unwrap().map(|entry| entry.unwrap().path());
    let top = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"].map(|name| root().join(name));
    let mut paths: Vec<PathBuf> =
        top.into_iter().chain(docs.filter(|path| path.extension().is_some_and(|ending| ending == "md"))).collect();
    paths.sort();
    paths.into_iter().map(|path| (path.clone(), fs::read_to_string(&path).unwrap())).collect()
}

/// Returns the lines of `text` outside of code blocks, without code between single backquotes.
fn prose(text: &str) -> Vec<String> {
    let mut is_code = false;
    let mut lines = Vec::new();
    for line in text.lines() {
        if line.starts_with("```") {
            is_code = !is_code;
        } else if !is_code {
            lines.push(line.split('`').step_by(2).collect::<Vec<_>>().join("`"));
        }
    }
    lines
}

/// Returns the commands in the shell blocks (```` ```sh ````) of `text`, one per line, continuation lines joined.
fn shell_lines(text: &str) -> Vec<String> {
    let mut is_shell = false;
    let mut lines: Vec<String> = Vec::new();
    let mut continues = false;
    for line in text.lines() {
        if line.starts_with("```") {
            is_shell = !is_shell && line == "```sh";
        } else if is_shell {
            let (part, more) = line.strip_suffix('\\').map_or((line, false), |part| (part, true));
            match lines.last_mut().filter(|_| continues) {
                Some(last) => last.push_str(part),
                None => lines.push(part.to_owned()),
            }
            continues = more;
        }
    }
    lines
}

/// Returns the words of every command of a shell line: quotes removed, cut at `|`, `&&`, `;`, redirections and
/// comments.
fn shell_commands(line: &str) -> Vec<Vec<String>> {
    let mut commands = vec![Vec::new()];
    let (mut word, mut quote, mut is_word, mut is_redirected) = (String::new(), None, false, false);
    for c in line.chars().chain([' ']) {
        match (quote, c) {
            (None, '\'' | '"') => (quote, is_word) = (Some(c), true),
            (Some(open), c) if c == open => quote = None,
            (None, ' ') if is_word => {
                match word.as_str() {
                    "|" | "&&" | ";" => {
                        commands.push(Vec::new());
                        is_redirected = false;
                    }
                    ">" | ">>" | "<" => is_redirected = true,
                    text if text.starts_with('#') => return commands,
                    text if !is_redirected => commands.last_mut().expect("one command").push(text.to_owned()),
                    _ => {}
                }
                word.clear();
                is_word = false;
            }
            (None, ' ') => {}
            (_, c) => {
                word.push(c);
                is_word = true;
            }
        }
    }
    commands
}

/// Returns the arguments of `splatsieve` if the shell command `words` runs it, directly or by `cargo run`. Returns
/// `None` for other commands.
fn arguments(words: &[String]) -> Option<&[String]> {
    match words {
        [name, rest @ ..] if name == "splatsieve" => Some(rest),
        [cargo, run, release, dashes, rest @ ..]
            if [cargo, run, release, dashes].map(String::as_str) == ["cargo", "run", "--release", "--"] =>
        {
            Some(rest)
        }
        _ => None,
    }
}

/// Returns the arguments of every call of `splatsieve` in `text`, in shell blocks and between single backquotes. Each
/// call is a list of arguments.
///
/// Calls with words in capitals, such as `splatsieve COMMAND -h`, are patterns and are left out.
fn calls(text: &str) -> Vec<Vec<String>> {
    let quoted = text.lines().flat_map(|line| line.split('`').skip(1).step_by(2)).map(str::to_owned);
    let inline = quoted.filter(|code| code.starts_with("splatsieve ") && !code.contains(['…', '│']));
    let lines = shell_lines(text).into_iter().chain(inline);
    let words = lines.flat_map(|line| shell_commands(&line));
    let called = words.filter_map(|words| arguments(&words).map(<[String]>::to_vec));
    let is_form = |word: &String| word.len() > 1 && word.chars().all(|c| c.is_ascii_uppercase());
    called.filter(|arguments| !arguments.is_empty() && !arguments.iter().take(2).any(is_form)).collect()
}

/// Runs the program in `workplace` without standard input. Returns whether it succeeded, and its standard error.
fn run(workplace: &Workplace, arguments: &[String]) -> (bool, String) {
    let mut command = Command::new(program());
    let output = command.current_dir(workplace.path(".")).args(arguments).stdin(Stdio::null()).output().unwrap();
    (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn every_command_in_readme_and_docs_parses() {
    let workplace = Workplace::new();
    let mut found = 0;
    for (path, text) in pages() {
        let mut all = calls(&text);
        all.sort();
        all.dedup();
        for arguments in all {
            let line = format!("{}: splatsieve {}", path.display(), arguments.join(" "));
            // `--help` is acted on where it stands, behind all other options and their values.
            let (is_done, message) = run(&workplace, &[&arguments[..], &["--help".to_owned()]].concat());
            assert!(is_done, "{line}\n{message}");
            // Required options and conflicts are checked without `--help`. These two do long work.
            if !["demo", "selfcheck"].contains(&arguments[0].as_str()) {
                let (_, message) = run(&workplace, &arguments);
                assert!(!message.starts_with("error: "), "{line}\n{message}");
            }
            found += 1;
        }
    }
    assert!(found > 80, "{found} commands");
}

#[test]
fn every_user_page_has_a_command() {
    for (path, text) in pages() {
        let name = path.file_name().unwrap().to_str().unwrap();
        let has_none = ["CHANGELOG.md", "CONTRIBUTING.md", "SUMMARY.md", "architecture.md", "parameters.md"];
        assert!(has_none.contains(&name) || !calls(&text).is_empty(), "{name} has no `splatsieve` command");
    }
}

#[test]
fn shell_lines_are_cut_into_commands() {
    let cut = shell_commands("a 'b c' --d=\"e f\" | splatsieve x - > out # rest | y");
    assert_eq!(cut, [vec!["a", "b c", "--d=e f"], vec!["splatsieve", "x", "-"]]);
    let text =
        "```sh\nsplatsieve a \\\n    b && splatsieve c  # d\n```\n`splatsieve d e` and `splatsieve COMMAND -h`\n";
    assert_eq!(calls(text), [vec!["a", "b"], vec!["c"], vec!["d", "e"]]);
}

/// Returns the targets of the links and images in Markdown lines.
fn links(lines: &[String]) -> Vec<String> {
    let parts = lines.iter().flat_map(|line| line.split("](").skip(1));
    parts.filter_map(|part| part.split(')').next()).map(str::to_owned).collect()
}

/// Returns the anchor of a Markdown heading: lower case, blanks as hyphens, without punctuation.
fn anchor(heading: &str) -> String {
    let letters = heading.trim_start_matches('#').trim().chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
    letters.flat_map(char::to_lowercase).map(|c| if c == ' ' { '-' } else { c }).collect()
}

#[test]
fn relative_links_of_readme_and_docs_lead_to_files() {
    for (path, text) in pages() {
        for link in links(&prose(&text)) {
            if link.contains("://") {
                continue;
            }
            let (file, heading) = link.split_once('#').unwrap_or((&link, ""));
            let target = if file.is_empty() { path.clone() } else { path.parent().unwrap().join(file) };
            assert!(target.exists(), "{}: nothing at {link}", path.display());
            if !heading.is_empty() {
                let text = fs::read_to_string(&target).unwrap();
                let has = text.lines().any(|line| line.starts_with('#') && anchor(line) == heading);
                assert!(has, "{}: no heading of {link}", path.display());
            }
        }
    }
}

#[test]
fn every_page_is_in_the_table_of_contents() {
    let contents = fs::read_to_string(root().join("docs/SUMMARY.md")).unwrap();
    for (path, _) in pages() {
        let name = path.file_name().unwrap().to_str().unwrap();
        if path.parent() == Some(root().join("docs").as_path()) && name != "SUMMARY.md" {
            assert!(contents.contains(&format!("]({name})")), "{name} is not in docs/SUMMARY.md");
        }
    }
}

#[test]
fn readme_is_short() {
    let text = fs::read_to_string(root().join("README.md")).unwrap();
    let (lines, words) = (text.lines().count(), text.split_whitespace().count());
    assert!(lines <= README_LINES, "{lines} lines, at most {README_LINES} expected");
    assert!(words <= README_WORDS, "{words} words, at most {README_WORDS} expected");
}

/// Compares the generated text with the page `name` in `docs`. If `SPLATSIEVE_WRITE_DOCS` is set, writes the page
/// instead.
fn check_generated(name: &str, text: &str) {
    let path = root().join("docs").join(name);
    if std::env::var_os("SPLATSIEVE_WRITE_DOCS").is_some() {
        fs::write(&path, text).unwrap();
        return;
    }
    let found = fs::read_to_string(&path).unwrap();
    let different = found.lines().zip(text.lines()).find(|(found, expected)| found != expected);
    let advice = "SPLATSIEVE_WRITE_DOCS=1 cargo test --test command_line docs";
    assert!(found == text, "{name} is out of date ({different:?}); write it anew: {advice}");
}

/// Returns the parameters in the text of a preset, each as (section, key, value as it is written).
fn values(text: &str) -> Vec<(String, String, String)> {
    let (mut section, mut found) = (String::new(), Vec::new());
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        if let Some(name) = line.strip_prefix('[') {
            section = name.trim_matches(['[', ']']).to_owned();
        } else if let Some((key, value)) = line.split_once('=') {
            found.push((section.clone(), key.trim().to_owned(), value.trim().to_owned()));
        }
    }
    found
}

#[test]
fn parameters_page_is_generated_from_the_recipe() {
    let mut page = fs::read_to_string(root().join("tests/command_line/parameters_intro.md")).unwrap();
    let presets = PRESETS.map(|(name, text)| (name, values(text)));
    let value = |preset: usize, section: &str, key: &str| {
        let found = presets[preset].1.iter().find(|(s, k, _)| s == section && k == key);
        found.map_or(String::new(), |(_, _, value)| format!("`{value}`"))
    };
    let mut section = String::new();
    for parameter in parameters() {
        if parameter.section != section {
            section.clone_from(&parameter.section);
            let _ = writeln!(page, "\n## `[{section}]`\n\n| key | `default` | `paper` | meaning |\n|---|---|---|---|");
        }
        let [default, paper] = [0, 1].map(|preset| value(preset, &section, &parameter.key));
        let meaning = parameter.doc.replace('|', "\\|");
        let _ = writeln!(page, "| `{}` | {default} | {paper} | {meaning} |", parameter.key);
    }
    let _ = writeln!(page, "\n## `gentle` and `strong`\n\n| preset | key | value |\n|---|---|---|");
    for (name, values) in &presets[2..] {
        for (section, key, value) in values.iter().filter(|(section, ..)| !section.is_empty()) {
            let _ = writeln!(page, "| `{name}` | `{section}.{key}` | `{value}` |");
        }
    }
    check_generated("parameters.md", &page);
}

#[test]
fn command_page_is_generated_from_the_help() {
    let workplace = Workplace::new();
    let help = |arguments: &[&str]| {
        let mut command = Command::new(program());
        // Without a terminal the help has the width that this variable gives.
        command.current_dir(workplace.path(".")).args(arguments).arg("--help").env("COLUMNS", "100");
        let output = command.stdin(Stdio::null()).stderr(Stdio::null()).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        text.lines().map(|line| format!("{}\n", line.trim_end())).collect::<String>()
    };
    let mut page = "# Commands and options\n\nThis page is the output of `splatsieve --help` and of `--help` of every command.\n\n\
                    ```sh\nsplatsieve compress --help\n```\n\n"
        .to_owned();
    let _ = write!(page, "## splatsieve\n\n```text\n{}```\n", help(&[]));
    for command in COMMANDS {
        let _ = write!(page, "\n## {command}\n\n```text\n{}```\n", help(&[command]));
    }
    check_generated("cli.md", &page);
}

#[test]
fn python_knows_the_options_that_need_no_value() {
    let workplace = Workplace::new();
    let mut taken = BTreeSet::new();
    for verb in COMMANDS {
        let help = workplace.done(&format!("{verb} --help"));
        // A line of such an option is `--name`, `-n, --name`, `--name[=VALUE]` or `--name [<VALUE>]`, and two spaces
        // before a description.
        let options = help.lines().filter_map(|line| {
            let line = line.trim_start();
            let line = if line.get(2..4) == Some(", ") { &line[4..] } else { line };
            line.strip_prefix("--")?.split("  ").next()?.split("[=").next()?.split(" [<").next()
        });
        let is_name = |text: &&str| text.chars().all(|c| c.is_ascii_alphanumeric() || c == '-');
        taken.extend(options.filter(is_name).map(|name| name.replace('-', "_")));
    }
    for general in ["help", "version"] {
        taken.remove(general);
    }
    let module = fs::read_to_string(root().join("python/splatsieve/_program.py")).unwrap();
    let (_, switches) = module.split_once("SWITCHES = frozenset(").unwrap();
    let (switches, _) = switches.split_once(".split()").unwrap();
    let listed: BTreeSet<String> = switches.replace('"', " ").split_whitespace().map(str::to_owned).collect();
    assert_eq!(listed, taken, "options that need no value: the program of Python, the help of the program");
}
