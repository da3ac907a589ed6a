//! Progress on standard error. On a terminal, every task has a bar with rate and time left; the bar of a nested task (a
//! task that runs within another) is below it. In a log, a task prints at most one line per minute while it runs, and
//! one line when it ends; a nested task prints none at its end.

use std::fmt::Write as _;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use console::Term;
use indicatif::{HumanCount, MultiProgress, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

use super::message::{is_terminal, show};
use splatsieve::error::printable;
use splatsieve::progress::{EventSink, Message, Task, TaskSink, format_duration};

/// Minimum time between two log lines of one task, seconds.
const LOG_INTERVAL_SECONDS: u64 = 60;

/// Assumed width of a terminal that does not report its width, in columns (characters).
const DEFAULT_COLUMNS: u16 = 80;
/// Width of a progress bar, in columns (characters).
const BAR_COLUMNS: usize = 20;

/// Receiver of the library's events, which displays them on standard error.
pub(super) struct Display {
    /// Whether to hide progress, and messages that the result of a stage is not used ([`Message::Discarded`]). Two
    /// kinds of messages are always shown: warnings, and plans ([`Message::Plan`]), which are sent only on request.
    is_quiet: bool,
    shared: Arc<Shared>,
}

/// State shared by the display and its tasks.
#[derive(Debug)]
struct Shared {
    /// Bars of all running tasks; the bar of a nested task is below that of the outer task.
    bars: MultiProgress,
    /// Number of tasks that are running and whose progress is written as log lines, not shown as a bar.
    logs: AtomicUsize,
    /// Names of the stages of the run that was announced last; empty after it has ended.
    stages: Mutex<Vec<&'static str>>,
}

impl Shared {
    /// Locks the field `stages` and returns its content. Ignores poisoning: a panicked thread cannot leave it
    /// inconsistent.
    fn stages(&self) -> MutexGuard<'_, Vec<&'static str>> {
        self.stages.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the label of the task `name`: `[k/n] name` if it is stage k of the n stages of the run, else `name`.
    fn label(&self, name: &str) -> String {
        let stages = self.stages();
        match stages.iter().position(|stage| *stage == name) {
            Some(place) => format!("[{}/{}] {name}", place + 1, stages.len()),
            None => name.to_owned(),
        }
    }
}

impl Display {
    /// Creates a display of the library's events; `is_quiet` hides progress.
    pub(super) fn new(is_quiet: bool) -> Self {
        let bars = MultiProgress::with_draw_target(ProgressDrawTarget::stderr_with_hz(10));
        Display { is_quiet, shared: Arc::new(Shared { bars, logs: AtomicUsize::new(0), stages: Mutex::default() }) }
    }

    /// Adds a progress bar for `task`, labeled `name`. Returns the bar.
    fn bar(&self, task: Task<'_>, name: String) -> Bar {
        let bar = self.shared.bars.add(task.total.map_or_else(ProgressBar::no_length, ProgressBar::new));
        if let Ok(style) = ProgressStyle::with_template("{line}") {
            let unit = task.unit.to_owned();
            let line = move |state: &ProgressState, out: &mut dyn std::fmt::Write| {
                let columns = Term::stderr().size_checked().map_or(DEFAULT_COLUMNS, |(_, columns)| columns);
                let (done, left) = (state.pos(), state.eta().as_secs_f64());
                let line = bar_line(&name, done, state.len(), &unit, state.per_sec(), left);
                // A line wider than the terminal would not be erased completely when it is redrawn. The last column
                // stays free: some terminals wrap after it. Writing to the draw buffer cannot fail.
                let _ = out.write_str(&line.chars().take(usize::from(columns).saturating_sub(1)).collect::<String>());
            };
            bar.set_style(style.with_key("line", line));
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        Bar { bar, shared: self.shared.clone() }
    }
}

impl EventSink for Display {
    /// Begins a run with the stages `stages`. From now on, labels of stages show `[k/n]`.
    fn run_begun(&self, stages: &[&'static str]) {
        *self.shared.stages() = stages.to_vec();
    }

    fn run_ended(&self) {
        self.shared.stages().clear();
    }

    fn task_begun(&self, task: Task<'_>) -> Option<Box<dyn TaskSink>> {
        if self.is_quiet {
            return None;
        }
        let name = self.shared.label(task.name);
        Some(match is_terminal() {
            true => Box::new(self.bar(task, name)),
            false => Box::new(Log::new(name, task, self.shared.clone())),
        })
    }

    fn message(&self, message: Message<'_>) {
        match message {
            Message::Plan(text) => show(text),
            Message::Warning(text) => show(&format!("warning: {text}")),
            Message::Discarded { .. } if self.is_quiet => (),
            Message::Discarded { stage, why } => {
                let line = format!("{stage}  left out: {why}");
                match is_terminal() {
                    // A failure to write to the terminal is ignored, as for all progress.
                    true => drop(self.shared.bars.println(printable(&line))),
                    false => show(&line),
                }
            }
        }
    }
}

/// Task with a progress bar.
#[derive(Debug)]
struct Bar {
    bar: ProgressBar,
    shared: Arc<Shared>,
}

impl TaskSink for Bar {
    fn advanced(&self, units: u64) {
        self.bar.inc(units);
    }

    fn restarted(&mut self, total: u64) {
        self.bar.set_length(total);
        self.bar.reset();
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
        self.shared.bars.remove(&self.bar);
    }
}

/// Returns the line of a progress bar: name, bar, percentage, count, rate and time left. `total`: number of units of
/// the task; `None` if unknown, 0 while the task is still being prepared. `left`: estimated seconds until the end of
/// the task; shown from 1 second on.
fn bar_line(name: &str, done: u64, total: Option<u64>, unit: &str, per_second: f64, left: f64) -> String {
    let mut line = format!("{name:>10}");
    let total = total.filter(|&total| total > 0);
    if let Some(total) = total {
        let fraction = (done as f64 / total as f64).min(1.0);
        let full = (fraction * BAR_COLUMNS as f64) as usize;
        let percent = (100.0 * fraction).floor();
        line += &format!(" [{}{}] {percent:>3.0}%", "=".repeat(full), " ".repeat(BAR_COLUMNS - full));
    }
    // The rate and the time left are unknown before the first unit is done.
    if done == 0 {
        return line;
    }
    let total_text = total.map_or(String::new(), |total| format!("/{}", HumanCount(total)));
    line += &format!(" {}{total_text} {unit}, {}", HumanCount(done), rate(per_second, unit));
    if left >= 1.0 && total.is_some_and(|total| total > done) {
        line += &format!(", {} left", whole_seconds(left));
    }
    line
}

/// Formats an estimated time, rounded down to whole seconds.
fn whole_seconds(seconds: f64) -> String {
    if seconds < 60.0 { format!("{:.0} s", seconds.floor()) } else { format_duration(seconds.floor()) }
}

/// Task whose progress is shown as lines in a log.
#[derive(Debug)]
struct Log {
    name: String,
    unit: String,
    total: Option<u64>,
    start: Instant,
    done: AtomicU64,
    /// Time of the next log line, in seconds from the start of the task.
    next: AtomicU64,
    /// Whether another task was running when this one began.
    is_nested: bool,
    shared: Arc<Shared>,
}

impl Log {
    /// Creates the log of `task`, which starts at the time of this call. Every log line begins with `name`.
    fn new(name: String, task: Task<'_>, shared: Arc<Shared>) -> Log {
        let (done, next) = (AtomicU64::new(0), AtomicU64::new(LOG_INTERVAL_SECONDS));
        let is_nested = shared.logs.fetch_add(1, Ordering::Relaxed) > 0;
        let (unit, total) = (task.unit.to_owned(), task.total);
        Log { name, unit, total, start: Instant::now(), done, next, is_nested, shared }
    }

    /// Prints the final log line of the task. Prints nothing for a nested task, or if no unit of work was done.
    fn print_summary(&self) {
        // A task that failed before its first unit prints nothing.
        if self.done.load(Ordering::Relaxed) > 0 && !self.is_nested {
            show(&self.line(self.start.elapsed(), true));
        }
    }

    /// Returns the log line of the task at the time `elapsed` after its start: count, rate, and time left. Shows the
    /// elapsed time instead of the time left if the task has ended (`ended`), or if the time left is unknown.
    fn line(&self, elapsed: Duration, ended: bool) -> String {
        let done = self.done.load(Ordering::Relaxed);
        let per_second = done as f64 / elapsed.as_secs_f64().max(1e-9);
        let mut line = format!("{}  {}", self.name, HumanCount(done));
        // Writing to a String cannot fail.
        if let Some(total) = self.total.filter(|&total| total != done) {
            let _ = write!(line, " of {}", HumanCount(total));
        }
        let is_single = done == 1 && self.total.is_none_or(|total| total == 1);
        let unit = if is_single { self.unit.strip_suffix('s').unwrap_or(&self.unit) } else { &self.unit };
        let _ = write!(line, " {unit}, {}, ", rate(per_second, &self.unit));
        let _ = match self.total.filter(|&total| total > done && !ended) {
            Some(total) => write!(line, "{} left", format_duration((total - done) as f64 / per_second)),
            None => write!(line, "{}", format_duration(elapsed.as_secs_f64())),
        };
        line
    }
}

impl TaskSink for Log {
    fn advanced(&self, units: u64) {
        self.done.fetch_add(units, Ordering::Relaxed);
        let (now, due) = (self.start.elapsed().as_secs(), self.next.load(Ordering::Relaxed));
        let relaxed = Ordering::Relaxed;
        // Several threads can find that a line is due; the exchange lets one of them print it.
        if now >= due && self.next.compare_exchange(due, now + LOG_INTERVAL_SECONDS, relaxed, relaxed).is_ok() {
            show(&self.line(self.start.elapsed(), false));
        }
    }

    fn restarted(&mut self, total: u64) {
        self.print_summary();
        (self.total, self.start, self.done) = (Some(total), Instant::now(), AtomicU64::new(0));
        self.next = AtomicU64::new(LOG_INTERVAL_SECONDS);
    }
}

impl Drop for Log {
    fn drop(&mut self) {
        self.shared.logs.fetch_sub(1, Ordering::Relaxed);
        self.print_summary();
    }
}

/// Formats the rate `per_second` (units per second) with two or three digits. Below 0.5 units per second, the text is
/// the time per unit.
fn rate(per_second: f64, unit: &str) -> String {
    if per_second > 0.0 && per_second < 0.5 {
        return format!("{} each", format_duration(1.0 / per_second));
    }
    let (value, scale) = match per_second {
        more if more >= 999.5e6 => (more / 1e9, "G "),
        more if more >= 999.5e3 => (more / 1e6, "M "),
        more if more >= 999.5 => (more / 1e3, "k "),
        few => (few, ""),
    };
    let digits = if value < 9.95 { 1 } else { 0 };
    format!("{value:.digits$} {scale}{unit}/s")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn log(name: &'static str, unit: &str, total: Option<u64>) -> Log {
        Log::new(name.to_owned(), Task { name, unit, total }, Display::new(false).shared)
    }

    #[test]
    fn log_line_has_progress_rate_and_time() {
        let scan = log("scan", "states", Some(1_252_980));
        scan.advanced(626_490);
        let minute = Duration::from_secs(60);
        assert_eq!(scan.line(minute, false), "scan  626,490 of 1,252,980 states, 10 k states/s, 1 min 00 s left");
        assert_eq!(scan.line(minute, true), "scan  626,490 of 1,252,980 states, 10 k states/s, 1 min 00 s");
        scan.advanced(626_490);
        assert_eq!(scan.line(Duration::from_millis(404), true), "scan  1,252,980 states, 3.1 M states/s, 0.4 s");
        let counter = log("receive", "frames", None);
        counter.advanced(72);
        assert_eq!(counter.line(Duration::from_secs(7200), false), "receive  72 frames, 1 min 40 s each, 2 h 00 min");
        let single = log("emit", "frames", Some(1));
        single.done.store(1, Ordering::Relaxed);
        assert_eq!(single.line(Duration::from_secs(1), true), "emit  1 frame, 1.0 frames/s, 1.0 s");
    }

    #[test]
    fn rates_have_two_or_three_digits() {
        for (rate_of, text) in [
            (0.01, "1 min 40 s each"),
            (0.5, "0.5 views/s"),
            (12.4, "12 views/s"),
            (999.6, "1.0 k views/s"),
            (45_600.0, "46 k views/s"),
            (3.14e6, "3.1 M views/s"),
            (2e9, "2.0 G views/s"),
        ] {
            assert_eq!(rate(rate_of, "views"), text);
        }
    }

    #[test]
    fn bar_lines_have_progress_and_hide_times_below_a_second() {
        let line = |total, left| bar_line("[3/9] rounds", 1234, total, "views", 12.0, left);
        assert_eq!(
            line(Some(5000), 313.0),
            "[3/9] rounds [====                ]  24% 1,234/5,000 views, 12 views/s, 5 min 13 s left"
        );
        assert!(!line(Some(5000), 0.4).contains("left"));
        assert_eq!(line(None, 313.0), "[3/9] rounds 1,234 views, 12 views/s");
        let prepared = bar_line("scan", 0, Some(7), "states", 0.0, 0.0);
        assert_eq!(prepared, "      scan [                    ]   0%");
    }

    #[test]
    fn stages_of_a_run_are_numbered() {
        let display = Display::new(false);
        display.run_begun(&["scan", "score", "rounds", "emit"]);
        let labels = ["motion", "scan", "rounds", "rounds"].map(|name| display.shared.label(name));
        assert_eq!(labels, ["motion", "[1/4] scan", "[3/4] rounds", "[3/4] rounds"]);
        display.run_ended();
        assert_eq!(display.shared.label("scan"), "scan");
    }
}
