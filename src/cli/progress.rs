//! Progress on standard error. On a terminal, every task has a bar with rate and time left; the bar of a nested task (a
//! task that runs within another) is below it. In a log, a task prints at most one line per minute while it runs, and
//! one line when it ends; a nested task prints none at its end.
//!
//! A line wider than the terminal would not be erased completely when it is redrawn. Therefore lines are composed from
//! the parts that fit.

use std::fmt::Write as _;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use console::Term;
use indicatif::{HumanCount, MultiProgress, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

use super::message::{is_terminal, show};
use splatsieve::error::printable;
use splatsieve::progress::{EventSink, ExpectedStage, Message, Task, TaskSink, format_duration};

/// Minimum time between two log lines of one task, seconds.
const LOG_INTERVAL_SECONDS: u64 = 60;

/// Assumed width of a terminal that does not report its width, in columns (characters).
const DEFAULT_COLUMNS: u16 = 80;
/// Maximum width of a progress bar, in columns (characters).
const MAX_BAR_COLUMNS: usize = 30;
/// Minimum width of a progress bar, in columns (characters). A shorter bar shows no more than the percentage does.
const MIN_BAR_COLUMNS: usize = 8;

/// Receiver of the library's events, which displays them on standard error.
pub(super) struct Display {
    /// Whether to hide progress, and messages that the result of a stage is not used ([`Message::Discarded`]). Two
    /// kinds of messages are always shown: warnings, and memory plans with time forecasts ([`Message::Plan`]), which
    /// are sent only on request.
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
    /// Stages, start and running stage of the compression that is running; `None` if none is running.
    run: Mutex<Option<RunPosition>>,
}

impl Shared {
    /// Locks the field `run` and returns its content. Ignores poisoning: a panicked thread cannot leave it
    /// inconsistent.
    fn run(&self) -> MutexGuard<'_, Option<RunPosition>> {
        self.run.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Display {
    /// Creates a display of the library's events; `is_quiet` hides progress.
    pub(super) fn new(is_quiet: bool) -> Self {
        let bars = MultiProgress::with_draw_target(ProgressDrawTarget::stderr_with_hz(10));
        Display { is_quiet, shared: Arc::new(Shared { bars, logs: AtomicUsize::new(0), run: Mutex::new(None) }) }
    }

    /// Adds a progress bar for `task`, labeled `name`. Returns the bar.
    fn bar(&self, task: Task<'_>, name: String) -> Bar {
        let bar = self.shared.bars.add(task.total.map_or_else(ProgressBar::no_length, ProgressBar::new));
        if let Ok(style) = ProgressStyle::with_template("{line}") {
            let (unit, shared) = (task.unit.to_owned(), self.shared.clone());
            // Only the bar of a stage shows the time left of the run. The label of a stage differs from the task name:
            // it begins with the number `[k/n]`.
            let is_stage = name != task.name;
            let line = move |state: &ProgressState, out: &mut dyn std::fmt::Write| {
                let columns = Term::stderr().size_checked().map_or(DEFAULT_COLUMNS, |(_, columns)| columns);
                let run = shared.run();
                let run = run.as_ref().filter(|_| is_stage);
                // Writing to the draw buffer cannot fail. The last column stays free: some terminals wrap after it.
                let _ = out.write_str(
                    &BarSnapshot::new(state, &name, run, &unit).line(usize::from(columns).saturating_sub(1)),
                );
            };
            bar.set_style(style.with_key("line", line));
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        Bar { bar, shared: self.shared.clone() }
    }
}

impl EventSink for Display {
    /// Begins a run with the stages `stages`. From now on, labels of stages show `[k/n]`, and bars show the time left
    /// of the run.
    fn run_begun(&self, stages: &[ExpectedStage]) {
        *self.shared.run() = Some(RunPosition { stages: stages.to_vec(), start: Instant::now(), current: None });
    }

    fn run_ended(&self) {
        *self.shared.run() = None;
    }

    fn task_begun(&self, task: Task<'_>) -> Option<Box<dyn TaskSink>> {
        if self.is_quiet {
            return None;
        }
        let mut run = self.shared.run();
        let name = run.as_mut().map_or_else(|| task.name.to_owned(), |run| run.enter(task.name, Instant::now()));
        drop(run);
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

/// Progress of a run (one compression): its stages, its start, and the stage that is running.
#[derive(Debug)]
struct RunPosition {
    /// Name and expected duration, in seconds, of each stage.
    stages: Vec<(&'static str, f64)>,
    start: Instant,
    /// Index of the running stage and the time of its start; `None` before the first stage.
    current: Option<(usize, Instant)>,
}

impl RunPosition {
    /// Returns the label of the task `name`, which begins at the time `now`. If the task is a stage of the run, records
    /// it as the running stage, and the label is `[k/n] name`: stage k of n. For any other task the label is `name`.
    fn enter(&mut self, name: &str, now: Instant) -> String {
        let Some(place) = self.stages.iter().position(|(stage, _)| *stage == name) else { return name.to_owned() };
        if self.current.is_none_or(|(stage, _)| stage != place) {
            self.current = Some((place, now));
        }
        format!("[{}/{}] {name}", place + 1, self.stages.len())
    }

    /// Returns the estimated time from `now` until the end of the run, seconds. `step`: estimated time until the end of
    /// the running stage, extrapolated from the speed of its progress bar, seconds; 0 if unknown.
    /// - Before the first stage, the result is `step`.
    /// - Later, the result is the sum of two times: the time left of the running stage, and the expected times of all
    ///   later stages. The time left of the running stage is its expected time minus its elapsed time, but at least
    ///   `step`.
    /// - Expected times are first multiplied by a correction: the ratio of actual to expected time of all finished
    ///   stages, limited to 0.1 to 10. The correction is 1 if their expected time is below half a second.
    fn left(&self, step: f64, now: Instant) -> f64 {
        let Some((place, since)) = self.current else { return step };
        let expected = |stages: &[(&str, f64)]| stages.iter().map(|(_, seconds)| seconds).sum::<f64>();
        let before = expected(&self.stages[..place]);
        // Below half a second of expected time, the ratio is too noisy.
        let correction = match before >= 0.5 {
            true => ((since - self.start).as_secs_f64() / before).clamp(0.1, 10.0),
            false => 1.0,
        };
        let stage_left = correction * self.stages[place].1 - (now - since).as_secs_f64();
        stage_left.max(step) + correction * expected(&self.stages[place + 1..])
    }
}

/// Data that a progress bar shows at one moment.
struct BarSnapshot<'a> {
    name: &'a str,
    unit: &'a str,
    done: u64,
    total: Option<u64>,
    per_second: f64,
    /// Estimated seconds left of the task; `None` if unknown.
    left: Option<f64>,
    /// Estimated seconds until the end of the whole run to which the task belongs; `None` for a task outside a run.
    run: Option<f64>,
}

impl<'a> BarSnapshot<'a> {
    /// Returns the data that a progress bar shows about the task `name`. `state`: progress of the task, counted in
    /// `unit`. `run`: progress of the run, if the task is a stage of it; `None` for any other task.
    fn new(state: &ProgressState, name: &'a str, run: Option<&RunPosition>, unit: &'a str) -> BarSnapshot<'a> {
        let (done, total) = (state.pos(), state.len());
        // The rate is unknown before the first unit is done.
        let left = total.filter(|&total| done > 0 && total > done).map(|_| state.eta().as_secs_f64());
        let run = run.map(|run| run.left(left.unwrap_or(0.0), Instant::now()));
        BarSnapshot { name, unit, done, total, per_second: state.per_sec(), left, run }
    }

    /// Returns the text of the bar, at most `columns` characters long. The name is always shown; the other parts are
    /// added while they fit, in this order: percentage, time left, count, rate, time left of the run, bar.
    fn line(&self, columns: usize) -> String {
        let BarSnapshot { name, unit, done, total, per_second, left, run } = self;
        let is_shown = |seconds: &&f64| **seconds >= 1.0;
        // A total of 0 means that the task is still being prepared.
        let total = total.filter(|&total| total > 0);
        let fraction = total.map(|total| (*done as f64 / total as f64).min(1.0));
        let total_text = total.map_or(String::new(), |total| format!("/{}", HumanCount(total)));
        let pieces = [
            fraction.map(|fraction| format!("{:>3.0}%", (100.0 * fraction).floor())),
            left.as_ref().filter(is_shown).map(|left| format!("{} left", whole_seconds(*left))),
            Some(format!("{}{total_text} {unit}", HumanCount(*done))).filter(|_| *done > 0 || total.is_some()),
            Some(rate(*per_second, unit)).filter(|_| *done > 0),
            run.as_ref().filter(is_shown).map(|run| format!("the run {}", whole_seconds(*run))),
        ];
        let mut shown = [false; 5];
        let mut width = name.chars().count().max(10);
        for (piece, shown) in pieces.iter().zip(&mut shown) {
            let more = piece.as_ref().map_or(0, |piece| piece.chars().count() + 2);
            *shown = piece.is_some() && width + more <= columns;
            width += if *shown { more } else { 0 };
        }
        let [percent, left, count, rate, run] = std::array::from_fn(|k| pieces[k].as_ref().filter(|_| shown[k]));
        let mut line = format!("{name:>10}");
        if let Some(fraction) = fraction {
            let bar_columns = columns.saturating_sub(width + 3).min(MAX_BAR_COLUMNS);
            if bar_columns >= MIN_BAR_COLUMNS {
                let full = (fraction * bar_columns as f64) as usize;
                line += &format!(" [{}{}]", "=".repeat(full), " ".repeat(bar_columns - full));
            }
        }
        line.extend(percent.map(|percent| format!(" {percent}")));
        let rest: Vec<&str> = [count, rate, left, run].into_iter().flatten().map(String::as_str).collect();
        if !rest.is_empty() {
            line += &format!(" {}", rest.join(", "));
        }
        line.chars().take(columns).collect()
    }
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
    fn bar_lines_fit_the_columns_and_hide_times_below_a_second() {
        let snapshot = BarSnapshot {
            name: "[3/9] rounds",
            unit: "views",
            done: 1234,
            total: Some(5000),
            per_second: 12.0,
            left: Some(313.0),
            run: Some(4000.0),
        };
        for columns in 0..200 {
            let line = snapshot.line(columns);
            assert!(line.chars().count() <= columns, "{columns}: {line}");
        }
        assert_eq!(
            snapshot.line(113),
            "[3/9] rounds [=====                   ]  24% 1,234/5,000 views, 12 views/s, 5 min 13 s left, \
             the run 1 h 06 min"
        );
        assert_eq!(snapshot.line(75), "[3/9] rounds  24% 1,234/5,000 views, 12 views/s, 5 min 13 s left");
        assert_eq!(snapshot.line(29), "[3/9] rounds [=       ]  24%");
        let nearly = BarSnapshot { left: Some(0.4), run: Some(0.2), ..snapshot };
        assert!(!nearly.line(119).contains("left") && !nearly.line(119).contains("run"), "{}", nearly.line(119));
        let counting = BarSnapshot { total: None, left: None, run: None, ..nearly };
        assert_eq!(counting.line(119), "[3/9] rounds 1,234 views, 12 views/s");
    }

    #[test]
    fn stages_are_numbered_and_time_left_follows_past_stages() {
        let start = Instant::now();
        let after = |seconds| start + Duration::from_secs(seconds);
        let stages = vec![("scan", 10.0), ("score", 0.0), ("rounds", 30.0), ("emit", 5.0)];
        let mut run = RunPosition { stages, start, current: None };
        assert_eq!(run.enter("motion", start), "motion");
        assert_eq!(run.left(2.0, start), 2.0);
        assert_eq!(run.enter("scan", start), "[1/4] scan");
        assert_eq!(run.left(8.0, after(4)), 8.0 + 35.0);
        // The first stage took twice the expected time, so later stages are expected to.
        assert_eq!(run.enter("rounds", after(20)), "[3/4] rounds");
        assert_eq!(run.left(1.0, after(30)), 50.0 + 10.0);
        // Entering the same stage again does not restart it.
        assert_eq!(run.enter("rounds", after(60)), "[3/4] rounds");
        assert_eq!(run.left(7.0, after(90)), 7.0 + 10.0);
    }
}
