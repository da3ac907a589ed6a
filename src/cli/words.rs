//! The words of a command line as people type them, put as the parser takes them: `--flag no`, lists with blanks.

use std::ffi::OsString;

use clap::{Arg, ArgAction, Command};

/// `words`, the program's name first, with every flag that is given a truth value as one that is there or not, and every
/// list as one word with commas between.
pub(super) fn regular(words: impl IntoIterator<Item = OsString>, command: &Command) -> Vec<OsString> {
    let mut words = words.into_iter().peekable();
    let mut out: Vec<OsString> = words.next().into_iter().collect();
    let mut verb: Option<&Command> = None;
    while let Some(word) = words.next() {
        let Some(text) = word.to_str().filter(|text| text.starts_with('-') && text.len() > 1) else {
            verb = verb.or_else(|| command.find_subcommand(&word));
            out.push(word);
            continue;
        };
        if text == "--" {
            out.push(word);
            break;
        }
        let (name, given) = match text.split_once('=') {
            Some((name, value)) => (name, Some(value.to_owned())),
            None => (text, None),
        };
        let Some(arg) = verb.into_iter().chain([command]).find_map(|of| find(of, name)) else {
            out.push(word);
            continue;
        };
        if is_flag(arg) {
            let value = given.as_deref().or_else(|| words.peek()?.to_str()).and_then(truth);
            if value.is_some() && given.is_none() {
                words.next();
            }
            match (value, arg.get_action()) {
                (None, _) => out.push(word),
                (Some(value), ArgAction::Set) => out.push(format!("{name}={value}").into()),
                (Some(true), _) => out.push(name.into()),
                (Some(false), _) => (),
            }
            continue;
        }
        if is_list(arg) {
            let next = || words.peek()?.to_str().filter(|next| !takes_none(arg, next)).map(str::to_owned);
            let mut value = match given.or_else(next) {
                Some(value) => value,
                None => {
                    out.push(word);
                    continue;
                }
            };
            if !text.contains('=') {
                words.next();
            }
            // As it comes from `0.5, 0.2` without quotation marks.
            while value.trim_end().ends_with(',') {
                let Some(more) = words.peek().and_then(|more| more.to_str()).filter(|more| !is_option(more)) else {
                    break;
                };
                value += more;
                words.next();
            }
            if arg.get_value_delimiter().is_some() {
                let parts = value.split(|c: char| c == ',' || c.is_whitespace()).filter(|part| !part.is_empty());
                value = parts.collect::<Vec<_>>().join(",");
            }
            out.push(format!("{name}={value}").into());
            continue;
        }
        let takes_next = given.is_none() && matches!(arg.get_action(), ArgAction::Set | ArgAction::Append);
        let is_alone = text.starts_with("--") || text.len() == 2;
        out.push(word);
        let is_value = |next: &OsString| !next.to_str().is_some_and(|next| takes_none(arg, next));
        out.extend(words.next_if(|next| takes_next && is_alone && is_value(next)));
    }
    out.extend(words);
    out
}

/// The option of `command` that is called `name`, hyphens and all; of a short one whatever stands behind its letter.
fn find<'a>(command: &'a Command, name: &str) -> Option<&'a Arg> {
    command.get_arguments().find(|arg| match name.strip_prefix("--") {
        Some(long) => arg.get_long() == Some(long),
        None => arg.get_short().is_some() && arg.get_short() == name.chars().nth(1),
    })
}

/// Whether an option is there or not, and takes no value or only that.
fn is_flag(arg: &Arg) -> bool {
    let is_truth = |names: &[clap::builder::Str]| names.iter().any(|name| name == "true|false");
    matches!(arg.get_action(), ArgAction::SetTrue) || arg.get_value_names().is_some_and(is_truth)
}

/// Whether the value of an option is a list, by how its help shows it.
fn is_list(arg: &Arg) -> bool {
    let named = |part: &str| arg.get_value_names().is_some_and(|names| names.iter().any(|name| name.contains(part)));
    arg.get_value_delimiter().is_some() || named(",") || named("IDS") || arg.get_long() == Some("refine")
}

/// Whether an option that may stand without a value does, before the word `next`.
fn takes_none(arg: &Arg, next: &str) -> bool {
    arg.get_num_args().is_some_and(|count| count.min_values() == 0) && is_option(next)
}

/// Whether a word is an option, and no negative number.
fn is_option(word: &str) -> bool {
    word.starts_with('-') && !word[1..].starts_with(|c: char| c.is_ascii_digit() || c == '.')
}

fn truth(word: &str) -> Option<bool> {
    match word.to_ascii_lowercase().as_str() {
        "true" | "yes" | "on" => Some(true),
        "false" | "no" | "off" => Some(false),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::super::args::Cli;
    use super::*;

    fn regular(line: &[&str]) -> Vec<String> {
        let words = std::iter::once("splatsieve").chain(line.iter().copied()).map(OsString::from);
        let out = super::regular(words, &Cli::command());
        out.into_iter().skip(1).map(|word| word.into_string().unwrap()).collect()
    }

    #[test]
    fn flags_take_a_truth_value_or_none() {
        for (line, expected) in [
            (&["compress", "m", "--choose-by-views", "false"][..], &["compress", "m", "--choose-by-views=false"][..]),
            (&["compress", "m", "--choose-by-views=No"], &["compress", "m", "--choose-by-views=false"]),
            (&["compress", "--choose-by-views", "m"], &["compress", "--choose-by-views", "m"]),
            (&["compress", "m", "--json", "yes", "--dry-run=off"], &["compress", "m", "--json"]),
            (&["--quiet", "false", "info", "m"], &["info", "m"]),
            (&["info", "--", "--json", "no"], &["info", "--", "--json", "no"]),
            // A value is none of an option that it belongs to.
            (&["compress", "m", "-o", "--json", "no"], &["compress", "m", "-o", "--json", "no"]),
            (&["info", "m", "--json=maybe", "--unknown", "no"], &["info", "m", "--json=maybe", "--unknown", "no"]),
        ] {
            assert_eq!(regular(line), expected, "{line:?}");
        }
    }

    #[test]
    fn lists_take_commas_and_blanks() {
        for (line, expected) in [
            (&["sweep", "m", "--fractions", "0.5, 0.2"][..], &["sweep", "m", "--fractions=0.5,0.2"][..]),
            (&["sweep", "m", "--fractions", "0.5,", "0.2", "--json"], &["sweep", "m", "--fractions=0.5,0.2", "--json"]),
            (&["sweep", "--methods=paper visible", "m"], &["sweep", "--methods=paper,visible", "m"]),
            (&["compress", "m", "--keep-box", "-1,", "-1,-1,1,1,1"], &["compress", "m", "--keep-box=-1,-1,-1,1,1,1"]),
            (&["compress", "m", "--drop-ids", "3,", "5"], &["compress", "m", "--drop-ids=3,5"]),
            (&["compress", "m", "--keep-ids", "my ids.txt"], &["compress", "m", "--keep-ids=my ids.txt"]),
            (&["compress", "m", "--refine", "colour,", "scale"], &["compress", "m", "--refine=colour,scale"]),
            (&["sweep", "m", "--fractions"], &["sweep", "m", "--fractions"]),
        ] {
            assert_eq!(regular(line), expected, "{line:?}");
        }
    }
}
