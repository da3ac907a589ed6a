//! Command line of the program: arguments, streams and exit codes. Data goes to standard output, everything else to
//! standard error; [`Error`] has the table of exit codes.

mod args;
mod help;
mod message;
mod options;
mod output;
mod progress;
mod recipe_flags;
mod run;
mod signals;

use std::ffi::OsString;
use std::num::{ParseFloatError, ParseIntError};
use std::process::ExitCode;

use clap::FromArgMatches;
use clap::error::ContextKind;

use args::Cli;
use message::show;
use run::run;
use splatsieve::error::{Error, ShowPath};
use splatsieve::files::atomic::{take_warnings, with_user_path};
use splatsieve::memory_plan;

/// Runs the program on the arguments of this process, and returns its exit code.
pub(crate) fn main() -> ExitCode {
    let (cli, explains) = match parse(std::env::args_os()) {
        Ok(parsed) => parsed,
        Err(error) => {
            // The message quotes arguments, which may hold control characters: parse again with them replaced.
            let shown = std::env::args_os().map(|word| word.shown().to_string().into());
            let error = parse(shown).err().unwrap_or(error);
            // `--help` and `--version` are errors of clap too, with exit code 0.
            let code = error.exit_code() as u8;
            return output::print_clap(&error).map_or_else(ended_by, |()| ExitCode::from(code));
        }
    };
    // Must run before the first output is begun.
    signals::install();
    let result = run(cli);
    // The outputs that these warnings name are complete, so the exit code does not change.
    for warning in take_warnings() {
        show(&format!("warning: {warning}"));
    }
    match result {
        Ok(()) => {
            if let Some(peak_memory) = memory_plan::peak_memory_text().filter(|_| explains) {
                show(&peak_memory);
            }
            ExitCode::SUCCESS
        }
        Err(error) => ended_by(error),
    }
}

/// Parses the words of a command line. The first word is the name of the program. Also returns whether the peak memory
/// is shown at the end: if `--explain` is given, except for commands that make several runs and measure each.
fn parse(words: impl Iterator<Item = OsString>) -> std::result::Result<(Cli, bool), clap::Error> {
    let found = help::command().try_get_matches_from(words).map_err(with_plain_number_error)?;
    let explains = found.subcommand().is_some_and(|(command, flags)| {
        let is_given = matches!(flags.try_get_one("explain"), Ok(Some(true)));
        is_given && !["sweep", "precision"].contains(&command)
    });
    Ok((Cli::from_arg_matches(&found).map_err(with_plain_number_error)?, explains))
}

/// Returns `error`. If a value could not be parsed as a number, its message names the expected kind of number instead of
/// the error of Rust's parser.
fn with_plain_number_error(error: clap::Error) -> clap::Error {
    let source = std::error::Error::source(&error);
    let expected = match source {
        Some(source) if source.is::<ParseIntError>() => "a whole number",
        Some(source) if source.is::<ParseFloatError>() => "a number",
        _ => return error,
    };
    let [value, option] = [ContextKind::InvalidValue, ContextKind::InvalidArg]
        .map(|kind| error.get(kind).map_or(String::new(), ToString::to_string));
    let more = "For more information, try '--help'.";
    clap::Error::raw(error.kind(), format!("invalid value '{value}' for '{option}': expected {expected}\n\n{more}\n"))
}

/// Prints the error that ended a run and returns its exit code. Returns success without a message if the run ended
/// because the program that reads its standard output has ended.
fn ended_by(error: Error) -> ExitCode {
    if output::has_no_reader(&error) {
        return ExitCode::SUCCESS;
    }
    let error = with_user_path(error);
    show(&format!("splatsieve: {error}"));
    ExitCode::from(error.kind().exit_code())
}
