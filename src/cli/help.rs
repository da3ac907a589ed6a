//! Help of the program and of each command: description, examples, options in groups. Manual pages are written from the
//! same texts.

use std::fs;
use std::path::Path;

use clap::{Command, CommandFactory};

use super::args::Cli;
use splatsieve::error::{Error, Result, ShowPath};
use splatsieve::files::atomic::{Replace, StagedFile, StagedFolder, TargetKind, check_target};

/// Start of the title line in the source of every manual page; identifies pages that this program wrote.
const PAGE_TITLE: &str = ".TH splatsieve";

/// Template of the help of a command: description, examples, usage, options.
const TEMPLATE: &str = "{about-section}\n{before-help}{usage-heading} {usage}\n\n{all-args}{after-help}";

/// Template of the help of the program: description, examples, usage, groups of commands, options.
const TOP_TEMPLATE: &str = "{about-section}\n{before-help}{usage-heading} {usage}\n\n{after-help}\n{options}";

/// Examples in the help of the program.
const EXAMPLES: &str = "\
Examples:
  splatsieve demo                                             a built-in scene
  splatsieve compress model --cameras data -o small --ratio 10%
  splatsieve evaluate model small --cameras data              what was lost
  splatsieve report model small --cameras data -o page        the same, as page
  splatsieve view model small --cameras data -o compare.html  plays both
  splatsieve compress model --cameras data -o small.gsz       smallest file
  splatsieve convert small.gsz small                          unpacks this file
`splatsieve COMMAND -h` prints examples and common options, `--help` all options.";

/// Groups of commands in the help of the program: the heading of each group, and the names of its commands.
const GROUPS: [(&str, &[&str]); 3] = [
    ("Everyday", &["compress", "evaluate", "report", "view", "render", "convert", "info"]),
    ("Study", &["score", "sweep", "precision"]),
    ("Other", &["demo", "cache", "recipe", "selfcheck", "completions", "man"]),
];

/// Examples in the help of each command: the name of the command, and one line of text per example. In a line, two
/// spaces separate the command line from its explanation.
const COMMAND_EXAMPLES: &[(&str, &[&str])] = &[
    (
        "compress",
        &[
            "splatsieve compress model --cameras data -o small     opens as model did",
            "splatsieve compress model --cameras data -o small --ratio 30%",
            "splatsieve compress model --cameras data -o small --min-psnr 35dB",
            "splatsieve compress model --cameras data -o small --size 5MB",
            "splatsieve compress model --cameras data -o small.gsz  smallest file",
            "splatsieve compress model --cameras data -o small --dry-run  plan only",
            "splatsieve compress model --cameras data -o small --set refine_steps=3000",
            "exporter | splatsieve compress - --cameras data -o small.gseq",
        ],
    ),
    (
        "score",
        &[
            "splatsieve score model --cameras data -o scores.npz",
            "splatsieve score model --cameras data -o scores.csv --preset paper",
        ],
    ),
    (
        "render",
        &[
            "splatsieve render model --cameras data --frame 0 --view 1 -o x.png",
            "splatsieve render model --cameras data --all -o renders  all test views",
            "splatsieve render model --cameras data --video x.mp4  from the first view",
            "splatsieve render model --cameras data --video x.gif --path --beside small",
        ],
    ),
    (
        "evaluate",
        &[
            "splatsieve evaluate model small --cameras data       on test views",
            "splatsieve evaluate model small --cameras data --ground-truth data",
            "splatsieve evaluate model small --cameras data --flip --csv views.csv",
        ],
    ),
    (
        "sweep",
        &[
            "splatsieve sweep model --cameras data -o curves      up to 55 complete runs",
            "splatsieve sweep model --cameras data -o curves --methods default,paper",
        ],
    ),
    (
        "precision",
        &[
            "splatsieve precision model --cameras data -o page    error against run time",
            "splatsieve precision model --cameras data -o page --knobs scoring,rounds",
        ],
    ),
    (
        "report",
        &[
            "splatsieve report model small --cameras data -o page  see page/report.html",
            "splatsieve report model small smaller --cameras data -o page",
        ],
    ),
    (
        "view",
        &[
            "splatsieve view model small --cameras data -o compare.html  side by side",
            "splatsieve view scan.ply -o scan.html                a scene without motion",
            "splatsieve view long.gseq --max-frames 600 -o scene  open scene/index.html",
        ],
    ),
    (
        "convert",
        &[
            "splatsieve convert small.gsz small                   unpack the model",
            "splatsieve convert model scene.splatv --cameras data  for splaTV and WebGS",
            "splatsieve convert scan.ply scan.spz                 for web viewers",
            "splatsieve convert scene.gseq frames                 one PLY per frame",
            "splatsieve convert frames scene.gseq --max-error position=0.01%",
            "splatsieve convert scene.gseq - | splatsieve compress - -o small.gseq",
        ],
    ),
    (
        "info",
        &[
            "splatsieve info model",
            "splatsieve info scene.gseq --check                   verify every byte",
            "splatsieve info cut.gseq --repair saved.gseq         save complete frames",
        ],
    ),
    ("cache", &["splatsieve cache folder                              list", "splatsieve cache folder --clean"]),
    ("demo", &["splatsieve demo -o folder                            pages to look at"]),
    ("test-scene", &["splatsieve test-scene -o folder --gaussians 2000     a scene for tests"]),
    ("selfcheck", &["splatsieve selfcheck                                 are the numbers right?"]),
    (
        "recipe",
        &[
            "splatsieve recipe > recipe.toml                      the default, to edit",
            "splatsieve recipe --preset paper                     explains every parameter",
        ],
    ),
    ("completions", &["splatsieve completions bash > splatsieve.bash"]),
    ("man", &["splatsieve man share/man/man1                       man splatsieve-compress"]),
];

/// Returns the definition of the command line, with examples and groups of commands in its help.
pub(super) fn command() -> Command {
    let command = Cli::command().before_help(EXAMPLES);
    let command = COMMAND_EXAMPLES.iter().fold(command, |command, (name, examples)| {
        let examples = format!("Examples:\n  {}", examples.join("\n  "));
        command.mut_subcommand(name, |command| command.help_template(TEMPLATE).before_help(examples))
    });
    let groups = GROUPS.map(|(title, names)| {
        let about = |name: &&str| command.find_subcommand(name).and_then(Command::get_about).map(ToString::to_string);
        let lines = names.iter().map(|name| format!("  {name:<12} {}", about(name).unwrap_or_default()));
        format!("{title}:\n{}\n", lines.collect::<Vec<_>>().join("\n"))
    });
    command.help_template(TOP_TEMPLATE).after_help(groups.join("\n") + "\nOptions:")
}

/// Writes the manual pages, one for the program and one for each command, to `folder`. If a page cannot be written,
/// writes none. Returns the number of pages. Replaces earlier pages and keeps other files in the folder.
///
/// # Errors
/// Fails if the folder cannot be created or written, or if a file with the name of a page is not a page of this
/// program.
pub(super) fn write_pages(folder: &Path) -> Result<usize> {
    let pages = pages()?;
    let is_missing = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
    let missing: Vec<&Path> = folder.ancestors().skip(1).take_while(is_missing).collect();
    let parent = missing.first().copied().unwrap_or(Path::new("."));
    fs::create_dir_all(parent).map_err(Error::io("create", parent))?;
    let written = if folder.exists() { write_beside(&pages, folder) } else { write_folder(&pages, folder) };
    if written.is_err() {
        // Removing fails for a folder into which another program has written meanwhile, so its files are kept.
        missing.iter().for_each(|folder| drop(fs::remove_dir(folder)));
    }
    written.map(|()| pages.len())
}

/// Returns the file name and the text of every manual page.
fn pages() -> Result<Vec<(String, Vec<u8>)>> {
    let mut command = command().disable_help_subcommand(true);
    command.build();
    let subcommands = command.get_subcommands().filter(|command| !command.is_hide_set());
    let page = |page: &Command| {
        let name = page.get_display_name().unwrap_or(page.get_name()).to_owned();
        let file = format!("{name}.1");
        let mut text = Vec::new();
        // In manual pages, the examples are at the end, one per line.
        let examples = page.get_before_help().map(ToString::to_string).unwrap_or_default();
        let page = page.clone().name(name).before_help("").after_help("");
        clap_mangen::Man::new(page).render(&mut text).map_err(Error::io("make", Path::new(&file)))?;
        let lines = examples.lines().skip(1).map(|line| format!("{}\n", line.trim().replace('-', "\\-")));
        text.extend(format!(".SH EXAMPLES\n.nf\n{}.fi\n", lines.collect::<String>()).bytes());
        Ok((file, text))
    };
    std::iter::once(&command).chain(subcommands).map(page).collect()
}

/// Writes the manual pages `pages` (file name and text) to the new folder `folder`.
fn write_folder(pages: &[(String, Vec<u8>)], folder: &Path) -> Result<()> {
    check_target(folder, TargetKind::Folder, &[], Replace::Never)?;
    let staged = StagedFolder::new(folder, Replace::Never)?;
    for (name, text) in pages {
        let path = staged.path().join(name);
        fs::write(&path, text).map_err(Error::io("write", &path))?;
    }
    staged.commit()
}

/// Writes the manual pages `pages` (file name and text) to the existing folder `folder` and keeps its other files.
/// Replaces earlier manual pages of this program. Fails if a page has the name of any other file in the folder.
fn write_beside(pages: &[(String, Vec<u8>)], folder: &Path) -> Result<()> {
    let mut staged = Vec::new();
    for (name, text) in pages {
        let path = folder.join(name);
        let is_page = |text: Vec<u8>| text.windows(PAGE_TITLE.len()).any(|part| part == PAGE_TITLE.as_bytes());
        if path.exists() && !fs::read(&path).is_ok_and(is_page) {
            return Err(Error::usage(format!(
                "{}: expected a manual page of splatsieve, found something else\n  move it away or name another folder",
                path.shown()
            )));
        }
        let file = StagedFile::new(&path, Replace::Existing)?;
        fs::write(file.path(), text).map_err(Error::io("write", file.path()))?;
        staged.push(file);
    }
    staged.into_iter().try_for_each(StagedFile::commit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_is_in_one_group() {
        let grouped: Vec<&str> = GROUPS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
        let command = command();
        let shown = command.get_subcommands().filter(|command| !command.is_hide_set());
        let names: Vec<&str> = shown.map(Command::get_name).collect();
        assert!(names.len() <= 16 && names.len() == grouped.len(), "{names:?}");
        assert!(names.iter().all(|name| grouped.contains(name)), "{names:?}");
    }

    #[test]
    fn compress_has_at_most_45_options() {
        let mut command = command();
        command.build();
        let compress = command.find_subcommand("compress").unwrap();
        let options: Vec<&str> = compress.get_arguments().filter_map(clap::Arg::get_long).collect();
        assert!(options.len() <= 45, "{}: {options:?}", options.len());
    }

    #[test]
    fn every_command_has_examples_that_parse() {
        for subcommand in command().get_subcommands() {
            let help = subcommand.clone().render_help().to_string();
            let examples: Vec<&str> = help.lines().filter(|line| line.starts_with("  splatsieve ")).collect();
            assert!(!examples.is_empty(), "{}: give it an example in COMMAND_EXAMPLES", subcommand.get_name());
            for example in examples {
                // Two spaces separate the command line from its explanation.
                let line = example.trim().split("  ").next().unwrap_or_default();
                for command_line in line.split(" | ").filter_map(|part| part.split(" > ").next()) {
                    let parsed = command().try_get_matches_from(command_line.split_whitespace());
                    assert!(parsed.is_ok(), "{command_line}: {}", parsed.unwrap_err());
                }
            }
        }
    }

    #[test]
    fn help_starts_with_the_description_and_fits_80_columns() {
        for mut subcommand in command().get_subcommands().cloned().chain([command()]) {
            let about = subcommand.get_about().map(ToString::to_string).unwrap_or_default();
            let help = subcommand.render_help().to_string();
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
