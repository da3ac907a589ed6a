//! Text of a summary for people: a table of Gaussians, size, render time and quality before and after.

use std::fmt::Write as _;
use std::path::Path;

use super::summary::{Summary, SummaryDetail};
use crate::error::ShowPath;
use crate::journal::records::{PhotographSummary, QualitySummary, ShDegreeSummary, ViewKind};
use crate::metrics::{PSNR_CAP_DB, decibels_text};
use crate::models::ModelSize;
use crate::outputs::kind::OutputKind;
use crate::progress::{counted, decimal_bytes, format_duration, grouped};
use crate::refinement::photographs::FIT;

/// Maximum number of notes that the text of a summary shows unless all details are requested.
const NOTES: usize = 2;

/// Minimum width, in characters, of the title of the table, which names the input and the output.
const TITLE_WIDTH: usize = 52;

impl Summary {
    /// Returns the summary as text for people: the table that compares the result with the original, some notes, and
    /// commands to run next. With [`SummaryDetail::All`], the stages come before the table, and all notes are included.
    pub fn text(&self, detail: SummaryDetail) -> String {
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = match detail {
            SummaryDetail::All => self.write_stages(&mut out),
            SummaryDetail::Brief => Ok(()),
        };
        let _ = self.write_table(&mut out);
        let _ = self.write_notes(&mut out, detail);
        let _ = self.write_next_steps(&mut out);
        out
    }

    /// Writes lines about the input, the cameras, each stage (Gaussians, time, reads, memory), and the omitted stages
    /// to `out`.
    fn write_stages(&self, out: &mut String) -> std::fmt::Result {
        let input = &self.input;
        writeln!(
            out,
            "{}: {}, {} x {}, SH degree {}",
            Path::new(&input.path).shown(),
            input.kind,
            counted(input.gaussians, "Gaussian"),
            counted(input.frames.unwrap_or(0), "frame"),
            input.sh_degree
        )?;
        writeln!(
            out,
            "cameras: {} ({}, {})",
            self.cameras.origin,
            counted(self.cameras.cameras, "camera"),
            counted(self.cameras.pairs, "view")
        )?;
        for stage in &self.stages {
            let scratch = match stage.scratch_bytes {
                0 => String::new(),
                bytes => format!(", {:.1} MiB of scratch", bytes as f64 / f64::from(1 << 20)),
            };
            let processors = stage.processor_seconds.map_or(String::new(), |s| format!(" ({s:.1} s of processors)"));
            let memory = stage.peak_memory_bytes.map_or(String::new(), |b| format!(", peak {} MiB", b >> 20));
            writeln!(
                out,
                "  {:<7} {:>9} -> {:>9}  {:8.2} s{processors}, {:.2} reads{scratch}{memory}",
                stage.name, stage.gaussians_in, stage.gaussians_out, stage.seconds, stage.full_reads
            )?;
        }
        if let Some(planned) = self.planned_reads {
            writeln!(out, "full reads of the input: {:.2}, planned at most {planned:.2}", self.full_reads())?;
        }
        if let Some(field) = self.field.as_ref().filter(|field| field.half) {
            writeln!(out, "deformation field: in half precision: {}", field.why())?;
        }
        if let Some(bands) = self.bands.as_ref().filter(|bands| bands.sh_degree < input.sh_degree) {
            writeln!(out, "SH degree: {} of {}: {}", bands.sh_degree, input.sh_degree, bands.why())?;
        }
        writeln!(out, "bytes: {}", self.output_size.format_relative_to(&input.size))?;
        for left in &self.left_out {
            writeln!(out, "  left out: {} ({})", left.what, left.reason())?;
        }
        writeln!(out)
    }

    /// Writes the title and the table, which compares the result with the original, to `out`.
    fn write_table(&self, out: &mut String) -> std::fmt::Result {
        let (seconds, peak) = self.taken();
        let memory = peak.map_or(String::new(), |bytes| format!(", {} MiB peak", bytes >> 20));
        let from = Path::new(&self.input.path).shown().to_string();
        let to = Path::new(&self.output).shown().to_string();
        let title = if to.is_empty() { from } else { format!("{from} → {to}") };
        writeln!(out, "{title:<TITLE_WIDTH$}  {}{memory}\n", format_duration(seconds))?;
        writeln!(out, "{:<14}{:>12}{:>12}", "", "before", "after")?;
        let (all, kept) = (self.input.gaussians as u64, self.gaussians as u64);
        row(out, "Gaussians", &grouped(all), &grouped(kept), &times(all, kept, "fewer"))?;
        let (before, after) = (self.input.bytes, self.output_bytes);
        row(out, "Size", &decimal_bytes(before), &decimal_bytes(after), &times(before, after, "smaller"))?;
        self.write_size_parts(out)?;
        if let Some(time) = self.quality.and_then(|quality| quality.render_ms) {
            let [before, after] = [time.before, time.after].map(|ms| format!("{ms:.1} ms"));
            row(out, "Render time", &before, &after, "per view, one thread of this machine")?;
        }
        writeln!(out, "{:<14}  {}", "Quality", self.quality_text())?;
        if let Some(PhotographSummary { photographs, before, result }) = self.photographs {
            let held_back = counted(photographs, "photograph");
            writeln!(
                out,
                "{:<14}  {result:.2} dB PSNR, {before:.2} dB before the fit to photographs ({held_back} not fitted to)",
                "Photographs"
            )?;
        } else if let Some(left) = self.left_out.iter().find(|left| left.what == FIT) {
            writeln!(out, "{:<14}  not fitted to: {}", "Photographs", left.reason())?;
        }
        if let Some(goal) = &self.goal {
            let of = if goal.name == "max_loss" { "loss against photographs" } else { "PSNR vs. original" };
            let views = goal.held_views.len();
            let stage = if goal.before_conversion { ", before conversion" } else { "" };
            let not_reached = if goal.is_met { "" } else { " and not reached" };
            writeln!(
                out,
                "{:<14}  {} dB {of} asked for{not_reached}, {:.2} dB on {} apart from the search{stage}",
                "Target",
                goal.asked,
                goal.held,
                counted(views, "view")
            )?;
        }
        if let Some(archive) = &self.archive {
            write!(out, "{:<14}  {:.2} dB PSNR vs. the result before quantization", "Archive", archive.psnr)?;
            match (archive.is_refined, archive.level < PSNR_CAP_DB) {
                (true, _) => writeln!(out, "; quantization and refinement for it cost {:.2} dB", archive.loss)?,
                (false, true) => writeln!(out, "; quantization costs {:.2} dB", archive.loss)?,
                (false, false) => writeln!(out)?,
            }
        }
        Ok(())
    }

    /// Writes to `out` the number of bytes of each part (Gaussians, deformation field, frames, other) of the input and
    /// of the result. Marks a part other than the Gaussians that takes more than half of the result. Writes nothing if
    /// the result has fewer than two parts.
    fn write_size_parts(&self, out: &mut String) -> std::fmt::Result {
        let named = |size: &ModelSize| {
            [
                ("  Gaussians", size.cloud),
                ("  deformation", size.field),
                ("  frames", size.frames),
                ("  other", size.rest),
            ]
        };
        let (before, after) = (named(&self.input.size), named(&self.output_size));
        if after.iter().filter(|(_, bytes)| *bytes > 0).count() < 2 {
            return Ok(());
        }
        let largest = after.iter().map(|(_, bytes)| *bytes).max().unwrap_or(0);
        for ((name, before), (_, after)) in before.into_iter().zip(after) {
            if before + after == 0 {
                continue;
            }
            let is_most = after == largest && 2 * after > self.output_bytes && name != "  Gaussians";
            row(
                out,
                name,
                &decimal_bytes(before),
                &decimal_bytes(after),
                if is_most { "← most of what is left" } else { "" },
            )?;
        }
        Ok(())
    }

    /// Returns the quality of the result as text: how close its renders are to those of the original.
    fn quality_text(&self) -> String {
        let Some(QualitySummary { kind, views, psnr, ssim, before_conversion, .. }) = self.quality else {
            let hint = if self.is_unreadable { "" } else { "; `splatsieve evaluate` measures it" };
            return format!("not measured{hint}");
        };
        let views = match kind {
            ViewKind::Test => counted(views, "test view"),
            ViewKind::Validation => counted(views, "validation view"),
            ViewKind::Training => counted(views, "training view"),
            ViewKind::Virtual => counted(views, "virtual view"),
        };
        let views = if before_conversion { views + ", before conversion to the format of the output" } else { views };
        if psnr >= PSNR_CAP_DB {
            return format!("no difference from the original ({views})");
        }
        let ssim = ssim.map_or(String::new(), |ssim| format!(", {ssim:.3} SSIM"));
        format!("{} PSNR{ssim} vs. original ({views})", decibels_text(psnr, 2))
    }

    /// Writes the notes of the summary to `out`. With [`SummaryDetail::Brief`], writes only the first [`NOTES`] of
    /// them.
    fn write_notes(&self, out: &mut String, detail: SummaryDetail) -> std::fmt::Result {
        let shown = match detail {
            SummaryDetail::All => self.notes.len(),
            SummaryDetail::Brief => self.notes.len().min(NOTES),
        };
        for note in &self.notes[..shown] {
            writeln!(out, "note: {note}")?;
        }
        match self.notes.len() - shown {
            0 => Ok(()),
            more => writeln!(out, "{} with --verbose", counted(more, "more note")),
        }
    }

    /// Writes to `out` commands that the user may want to run next.
    fn write_next_steps(&self, out: &mut String) -> std::fmt::Result {
        let output = Path::new(&self.output);
        if self.output.is_empty() || self.input.path == "-" || self.gaussians == 0 || self.is_unreadable {
            return Ok(());
        }
        let beside = |ending: &str| {
            let mut path = output.with_extension("").into_os_string();
            path.push(ending);
            shell_word(Path::new(&path))
        };
        let given = self.given_cameras.as_deref();
        let cameras = given.map_or(String::new(), |cameras| format!(" --cameras {}", shell_word(cameras)));
        let [original, result] = [Path::new(&self.input.path), output].map(shell_word);
        let page = beside(".html");
        let kind = OutputKind::from_path(output, None, OutputKind::Model);
        match self.leaves_out_motion {
            // A still cannot be shown beside a model with other frames.
            true => writeln!(out, "\nSee it:   splatsieve view {result} -o {page}")?,
            false => writeln!(out, "\nSee it:   splatsieve view {original} {result}{cameras} -o {page}")?,
        }
        if kind == OutputKind::Model && self.output_size.field > 0 {
            // The archive would have all SH degrees, because only its quantization removes colors.
            let has_dropped =
                |bands: &ShDegreeSummary| bands.tried.iter().any(|(degree, _)| *degree >= bands.sh_degree);
            let degrees = if self.bands.as_ref().is_some_and(has_dropped) { " of all SH degrees" } else { "" };
            writeln!(
                out,
                "Smaller:  -o {} writes an archive; convert restores a model folder{degrees} from it",
                beside(".gsz")
            )?;
        }
        Ok(())
    }

    /// Returns the total wall-clock seconds of the stages that this run computed (rather than took from the cache), and
    /// the largest resident memory of any stage in bytes.
    fn taken(&self) -> (f64, Option<u64>) {
        let seconds = self.stages.iter().filter(|stage| !stage.from_cache).map(|stage| stage.seconds).sum();
        (seconds, self.stages.iter().filter_map(|stage| stage.peak_memory_bytes).max())
    }
}

/// Returns `path` as a word of a shell command: in single quotes if it has characters with a meaning for the shell, and
/// after `./` if it would be taken for an option.
fn shell_word(path: &Path) -> String {
    let text = path.shown().to_string();
    let text = if text.starts_with('-') { format!("./{text}") } else { text };
    let is_plain = |c: char| c.is_alphanumeric() || "_-./+=:@%,".contains(c);
    if !text.is_empty() && text.chars().all(is_plain) { text } else { format!("'{}'", text.replace('\'', r"'\''")) }
}

/// Writes a row of the table to `out`: the name of a quantity, its value for the original, its value for the result,
/// and a comment.
fn row(out: &mut String, name: &str, before: &str, after: &str, comment: &str) -> std::fmt::Result {
    let line = format!("{name:<14}{before:>12}{after:>12}    {comment}");
    writeln!(out, "{}", line.trim_end())
}

/// Returns the ratio of `before` and `after` as text:
/// - if `after` is smaller, for example "10.0× fewer", where `word` is "fewer";
/// - if `after` is larger, for example "2.0× larger";
/// - if both are equal or `after` is 0, an empty text.
fn times(before: u64, after: u64, word: &str) -> String {
    match after {
        0 => String::new(),
        after if after < before => format!("{:.1}× {word}", before as f64 / after as f64),
        after if after > before => format!("{:.1}× larger", after as f64 / before.max(1) as f64),
        _ => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_words_of_the_shell() {
        for (path, word) in [
            ("out/small.ply", "out/small.ply"),
            ("my scene", "'my scene'"),
            ("it's", r"'it'\''s'"),
            ("-x.ply", "./-x.ply"),
            ("$HOME", "'$HOME'"),
        ] {
            assert_eq!(shell_word(Path::new(path)), word);
        }
    }

    #[test]
    fn factors_say_which_way_a_value_changed() {
        assert_eq!(times(20_883, 2_088, "fewer"), "10.0× fewer");
        assert_eq!(times(10, 20, "smaller"), "2.0× larger");
        assert_eq!(times(10, 10, "fewer"), "");
        assert_eq!(times(10, 0, "fewer"), "");
    }
}
