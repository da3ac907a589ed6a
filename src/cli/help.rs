//! Help: what the tool and each verb is, examples, then options in groups; and the same as manual pages.

use std::fs;
use std::path::Path;

use clap::{Command, CommandFactory};

use super::args::Cli;
use splatsieve::error::{Error, Result, ShowPath};
use splatsieve::files::atomic::{Kind, Replace, StagedFile, StagedFolder, check_target};

/// Text that every manual page of this program holds: its title.
const PAGE: &str = ".TH splatsieve";

/// What it is comes first, then how it is used.
const TEMPLATE: &str = "{about-section}\n{before-help}{usage-heading} {usage}\n\n{all-args}{after-help}";

const EXAMPLES: &str = "\
Examples:
  splatsieve demo                                    a scene of its own
  splatsieve compress model --cameras data -o small  a 4DGaussians model
  splatsieve evaluate model small --cameras data     what it cost
  splatsieve report model small -o page              the same, as a page
  splatsieve view model small -o scene.html          both moving, in a browser
  splatsieve compress model -o small.gsz             smallest, to send
  splatsieve unpack small.gsz -o small               the model folder in it
`splatsieve VERB -h`: its examples and usual options; `--help`: all of them.";

/// Examples of every verb; two spaces stand before what is said about one.
const OF_VERBS: &[(&str, &[&str])] = &[
    (
        "compress",
        &[
            "splatsieve compress model --cameras data -o small     drop-in result",
            "splatsieve compress model -o small --target-ratio 0.3  exactly 30% of them",
            "splatsieve compress model -o small --min-psnr 35dB    fewest as close",
            "splatsieve compress model -o small --target-size 5MB  best no larger",
            "splatsieve compress model -o small.gsz                smallest, to send",
            "splatsieve compress model -o small --dry-run          what it would take",
            "splatsieve compress frames -o small.gseq --preset paper",
            "exporter | splatsieve compress - -o small.gseq        frames as they come",
        ],
    ),
    (
        "score",
        &[
            "splatsieve score model --cameras data -o rows.npz  statistics, nothing removed",
            "splatsieve score model -o rows.csv --preset paper",
        ],
    ),
    (
        "render",
        &[
            "splatsieve render model --frame 0 --view 1 -o x.png  one picture",
            "splatsieve render model --all -o pictures            all held-out ones",
            "splatsieve render model --video x.mp4                a film of the first view",
            "splatsieve render model --video x.gif --path 0,3,5 --beside small",
        ],
    ),
    (
        "evaluate",
        &[
            "splatsieve evaluate model small --cameras data       on held-out pictures",
            "splatsieve evaluate model small --flip --csv scores.csv",
        ],
    ),
    (
        "sweep",
        &[
            "splatsieve sweep model --cameras data -o curves      every method and size",
            "splatsieve sweep model -o curves --methods default,paper --fractions 0.5,0.2",
        ],
    ),
    (
        "precision",
        &[
            "splatsieve precision model --cameras data -o page    error against run time",
            "splatsieve precision model -o page --knobs look,rounds",
        ],
    ),
    (
        "report",
        &[
            "splatsieve report model small -o page                 open page/report.html",
            "splatsieve report model small smaller -o page         several results",
        ],
    ),
    (
        "view",
        &[
            "splatsieve view model small --cameras data -o scene.html  both in motion",
            "splatsieve view scan.ply -o scan.html                a static scene",
            "splatsieve view long.gseq --max-frames 600 -o scene  open scene/index.html",
        ],
    ),
    (
        "convert",
        &[
            "splatsieve convert model scene.splatv --cameras data  for splaTV and WebGS",
            "splatsieve convert small.gseq scene.4dgs             pieces of straight motion",
            "splatsieve convert scan.ply scan.spz                 for most web viewers",
            "splatsieve convert model frames --as ply-sequence    a PLY per frame",
        ],
    ),
    (
        "pack",
        &[
            "splatsieve pack frames -o scene.gseq                 every bit kept",
            "splatsieve pack frames -o scene.gseq --max-error position=0.01%",
        ],
    ),
    ("info", &["splatsieve info scene.gseq", "splatsieve info model --json"]),
    ("verify", &["splatsieve verify scene.gseq"]),
    (
        "unpack",
        &[
            "splatsieve unpack small.gsz -o small                 the model in an archive",
            "splatsieve unpack scene.gseq -o frames               a PLY per frame",
            "splatsieve unpack scene.gseq --stream | splatsieve compress - -o small.gseq",
        ],
    ),
    ("recover", &["splatsieve recover cut.gseq -o saved.gseq"]),
    ("work", &["splatsieve work folder                               what is in it", "splatsieve work folder --clean"]),
    ("demo", &["splatsieve demo -o folder                            pages to look at"]),
    ("test-scene", &["splatsieve test-scene -o folder --gaussians 2000     a scene for tests"]),
    ("selfcheck", &["splatsieve selfcheck                                 are the numbers right?"]),
    ("recipe", &["splatsieve recipe > recipe.toml                      every parameter"]),
    ("completions", &["splatsieve completions bash > splatsieve.bash"]),
    ("man", &["splatsieve man share/man/man1                       man splatsieve-compress"]),
];

/// The command line with its examples.
pub(super) fn command() -> Command {
    let command = Cli::command().help_template(TEMPLATE).before_help(EXAMPLES);
    OF_VERBS.iter().fold(command, |command, (verb, examples)| {
        let examples = format!("Examples:\n  {}", examples.join("\n  "));
        command.mut_subcommand(verb, |verb| verb.help_template(TEMPLATE).before_help(examples))
    })
}

/// Writes a manual page of the program and one of each command into `folder`, all or none; returns their number. Other files
/// in the folder stay, and earlier pages are replaced.
///
/// # Errors
/// A folder that cannot be made or written to; a file with the name of a page that is no page of this program.
pub(super) fn write_pages(folder: &Path) -> Result<usize> {
    let pages = pages()?;
    let is_missing = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
    let made: Vec<&Path> = folder.ancestors().skip(1).take_while(is_missing).collect();
    let parent = made.first().copied().unwrap_or(Path::new("."));
    fs::create_dir_all(parent).map_err(Error::io("create", parent))?;
    let written = if folder.exists() { write_beside(&pages, folder) } else { write_folder(&pages, folder) };
    if written.is_err() {
        // Whatever else is in them meanwhile keeps them.
        made.iter().for_each(|folder| drop(fs::remove_dir(folder)));
    }
    written.map(|()| pages.len())
}

/// File name and text of every page.
fn pages() -> Result<Vec<(String, Vec<u8>)>> {
    let mut command = command().disable_help_subcommand(true);
    command.build();
    let of_verbs = command.get_subcommands().filter(|verb| !verb.is_hide_set());
    let page = |page: &Command| {
        let name = page.get_display_name().unwrap_or(page.get_name()).to_owned();
        let file = format!("{name}.1");
        let mut text = Vec::new();
        // Manual pages have examples at their end, and one line each.
        let examples = page.get_before_help().map(ToString::to_string).unwrap_or_default();
        let page = page.clone().name(name).before_help("");
        clap_mangen::Man::new(page).render(&mut text).map_err(Error::io("make", Path::new(&file)))?;
        let lines = examples.lines().skip(1).map(|line| format!("{}\n", line.trim().replace('-', "\\-")));
        text.extend(format!(".SH EXAMPLES\n.nf\n{}.fi\n", lines.collect::<String>()).bytes());
        Ok((file, text))
    };
    std::iter::once(&command).chain(of_verbs).map(page).collect()
}

/// Writes pages into a folder that is not there yet.
fn write_folder(pages: &[(String, Vec<u8>)], folder: &Path) -> Result<()> {
    check_target(folder, Kind::Folder, &[], Replace::Never)?;
    let staged = StagedFolder::new(folder, Replace::Never)?;
    for (name, text) in pages {
        let path = staged.path().join(name);
        fs::write(&path, text).map_err(Error::io("write", &path))?;
    }
    staged.commit()
}

/// Writes pages into a folder with whatever else is in it.
fn write_beside(pages: &[(String, Vec<u8>)], folder: &Path) -> Result<()> {
    let mut staged = Vec::new();
    for (name, text) in pages {
        let path = folder.join(name);
        let is_page = |text: Vec<u8>| text.windows(PAGE.len()).any(|part| part == PAGE.as_bytes());
        if path.exists() && !fs::read(&path).is_ok_and(is_page) {
            return Err(Error::usage(format!(
                "{}: expected a manual page of splatsieve, found something else\n  move it away or name another folder",
                path.shown()
            )));
        }
        let file = StagedFile::new(&path, Replace::Any)?;
        fs::write(file.path(), text).map_err(Error::io("write", file.path()))?;
        staged.push(file);
    }
    staged.into_iter().try_for_each(StagedFile::commit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_verb_has_examples_and_every_example_is_understood() {
        for verb in command().get_subcommands() {
            let help = verb.clone().render_help().to_string();
            let examples: Vec<&str> = help.lines().filter(|line| line.starts_with("  splatsieve ")).collect();
            assert!(!examples.is_empty(), "{}: give it an example in OF_VERBS", verb.get_name());
            for example in examples {
                // What follows two spaces is said about it.
                let line = example.trim().split("  ").next().unwrap_or_default();
                for one in line.split(" | ").filter_map(|one| one.split(" > ").next()) {
                    let parsed = command().try_get_matches_from(one.split_whitespace());
                    assert!(parsed.is_ok(), "{one}: {}", parsed.unwrap_err());
                }
            }
        }
    }

    #[test]
    fn help_says_first_what_a_thing_is_then_how_it_is_used_and_its_examples_fit_80_columns() {
        for mut verb in command().get_subcommands().cloned().chain([command()]) {
            let about = verb.get_about().map(ToString::to_string).unwrap_or_default();
            let help = verb.render_help().to_string();
            let first = about.split_whitespace().next().unwrap_or_default();
            assert!(!first.is_empty() && help.starts_with(first), "{help}");
            let [examples, usage] = ["Examples:\n", "Usage: "].map(|part| help.find(part));
            assert!(examples.is_some() && examples < usage, "{help}");
            let mut examples = help[..usage.unwrap_or_default()].lines().filter(|line| line.starts_with("  "));
            let long = examples.find(|line| line.len() > 80);
            assert_eq!(long, None);
        }
    }
}
