//! Progress on standard error. On a terminal every task has a bar with rate and time left, tasks within a task a line each
//! below it. Elsewhere, for logs, a task has a line when it ends and at most one a minute before; a task within another has
//! none when it ends.
//!
//! A line that is wider than the terminal would leave its end behind when it is redrawn: lines are composed here from
//! the parts that fit.

use std::fmt::Write as _;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use console::Term;
use indicatif::{HumanCount, MultiProgress, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

use super::message::{is_terminal, tell};
use splatsieve::error::printable;
use splatsieve::progress::{EventSink, ExpectedStage, Message, Task, TaskSink, duration};

/// Seconds between two lines of one task in a log.
const LINE_EVERY: u64 = 60;

/// Columns of a terminal that does not say how many it has.
const USUAL_COLUMNS: u16 = 80;
/// Columns that a bar has at most, and at least: a shorter one shows nothing that the percentage does not.
const BAR: [usize; 2] = [30, 8];

/// Shows events on standard error.
pub(super) struct Display {
    /// Whether neither progress nor discarded results are shown; plans are, for they were asked for.
    is_quiet: bool,
    shared: Arc<Shared>,
}

/// What the display and its tasks share.
#[derive(Debug)]
struct Shared {
    /// All bars: a task that begins within another has a line below it.
    bars: MultiProgress,
    /// Number of tasks of a log that go on.
    logs: AtomicUsize,
    run: Mutex<Option<RunPosition>>,
}

impl Shared {
    fn run(&self) -> MutexGuard<'_, Option<RunPosition>> {
        self.run.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Display {
    pub(super) fn new(is_quiet: bool) -> Self {
        let bars = MultiProgress::with_draw_target(ProgressDrawTarget::stderr_with_hz(10));
        Display { is_quiet, shared: Arc::new(Shared { bars, logs: AtomicUsize::new(0), run: Mutex::new(None) }) }
    }

    /// Adds a bar for a task called `name` in its line.
    fn bar(&self, task: Task<'_>, name: String) -> Bar {
        let bar = self.shared.bars.add(task.total.map_or_else(ProgressBar::no_length, ProgressBar::new));
        if let Ok(style) = ProgressStyle::with_template("{line}") {
            let (unit, shared) = (task.unit.to_owned(), self.shared.clone());
            // Time left in a task that is no stage says nothing about the rest of the run.
            let is_stage = name != task.name;
            let line = move |state: &ProgressState, out: &mut dyn std::fmt::Write| {
                let columns = Term::stderr().size_checked().map_or(USUAL_COLUMNS, |(_, columns)| columns);
                let run = shared.run();
                let run = run.as_ref().filter(|_| is_stage);
                // Writing to what is drawn cannot fail. The last column stays free: some terminals go on to the next line.
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
    /// From now on a bar or line of one of `stages` says `[k/n]`, and a bar how long the whole run will take yet.
    fn run_begun(&self, stages: &[ExpectedStage]) {
        *self.shared.run() = Some(RunPosition { stages: stages.to_vec(), start: Instant::now(), at: None });
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
            Message::Plan(text) => tell(text),
            Message::Warning(text) => tell(&format!("warning: {text}")),
            Message::Discarded { .. } if self.is_quiet => (),
            Message::Discarded { stage, why } => {
                let line = format!("{stage}  left out: {why}");
                match is_terminal() {
                    // A terminal that cannot be written to shows nothing of the rest either.
                    true => drop(self.shared.bars.println(printable(&line))),
                    false => tell(&line),
                }
            }
        }
    }
}

/// A task with a bar.
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

/// Where a run is.
#[derive(Debug)]
struct RunPosition {
    /// Names, and about how many seconds they take.
    stages: Vec<(&'static str, f64)>,
    start: Instant,
    /// The stage that runs, and since when.
    at: Option<(usize, Instant)>,
}

impl RunPosition {
    /// A stage's name with its place among the stages, if it is one of them: the one that runs now.
    fn enter(&mut self, what: &str, now: Instant) -> String {
        let Some(place) = self.stages.iter().position(|(stage, _)| *stage == what) else { return what.to_owned() };
        if self.at.is_none_or(|(stage, _)| stage != place) {
            self.at = Some((place, now));
        }
        format!("[{}/{}] {what}", place + 1, self.stages.len())
    }

    /// Seconds until its end, about, when the step that runs takes `step` more: what is expected of the stages to come,
    /// corrected by how long those before took.
    fn left(&self, step: f64, now: Instant) -> f64 {
        let Some((place, since)) = self.at else { return step };
        let expected = |stages: &[(&str, f64)]| stages.iter().map(|(_, seconds)| seconds).sum::<f64>();
        let before = expected(&self.stages[..place]);
        // What hardly takes time tells little.
        let correction = match before >= 0.5 {
            true => ((since - self.start).as_secs_f64() / before).clamp(0.1, 10.0),
            false => 1.0,
        };
        let of_stage = correction * self.stages[place].1 - (now - since).as_secs_f64();
        of_stage.max(step) + correction * expected(&self.stages[place + 1..])
    }
}

/// What a bar shows.
struct BarSnapshot<'a> {
    name: &'a str,
    unit: &'a str,
    done: u64,
    total: Option<u64>,
    per_second: f64,
    /// Seconds that this will take yet, and the whole run; none where nobody knows.
    left: Option<f64>,
    run: Option<f64>,
}

impl<'a> BarSnapshot<'a> {
    /// A bar in the state `state` of a task that is a stage of `run`, if there is one.
    fn new(state: &ProgressState, name: &'a str, run: Option<&RunPosition>, unit: &'a str) -> BarSnapshot<'a> {
        let (done, total) = (state.pos(), state.len());
        // Of what has not begun to move nobody knows how fast it is.
        let left = total.filter(|&total| done > 0 && total > done).map(|_| state.eta().as_secs_f64());
        let run = run.map(|run| run.left(left.unwrap_or(0.0), Instant::now()));
        BarSnapshot { name, unit, done, total, per_second: state.per_sec(), left, run }
    }

    /// All of it that has room in so many columns: its name always, then how much is done, how long it takes yet, how
    /// much, how fast, how long the run takes, and a bar.
    fn line(&self, columns: usize) -> String {
        let BarSnapshot { name, unit, done, total, per_second, left, run } = self;
        let soon = |seconds: &&f64| **seconds >= 1.0;
        // What has no steps yet is being prepared.
        let total = total.filter(|&total| total > 0);
        let part = total.map(|total| (*done as f64 / total as f64).min(1.0));
        let of = total.map_or(String::new(), |total| format!("/{}", HumanCount(total)));
        let pieces = [
            part.map(|part| format!("{:>3.0}%", (100.0 * part).floor())),
            left.as_ref().filter(soon).map(|left| format!("{} left", whole(*left))),
            Some(format!("{}{of} {unit}", HumanCount(*done))).filter(|_| *done > 0 || total.is_some()),
            Some(rate(*per_second, unit)).filter(|_| *done > 0),
            run.as_ref().filter(soon).map(|run| format!("the run {}", whole(*run))),
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
        if let Some(part) = part {
            let room = columns.saturating_sub(width + 3).min(BAR[0]);
            if room >= BAR[1] {
                let full = (part * room as f64) as usize;
                line += &format!(" [{}{}]", "=".repeat(full), " ".repeat(room - full));
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

/// A time to come, in whole seconds: nobody knows it better.
fn whole(seconds: f64) -> String {
    if seconds < 60.0 { format!("{:.0} s", seconds.floor()) } else { duration(seconds.floor()) }
}

/// A task in a log.
#[derive(Debug)]
struct Log {
    name: String,
    unit: String,
    total: Option<u64>,
    start: Instant,
    done: AtomicU64,
    /// Seconds from the start to the next line.
    next: AtomicU64,
    /// Whether it goes on within another.
    is_within: bool,
    shared: Arc<Shared>,
}

impl Log {
    fn new(name: String, task: Task<'_>, shared: Arc<Shared>) -> Log {
        let (done, next) = (AtomicU64::new(0), AtomicU64::new(LINE_EVERY));
        let is_within = shared.logs.fetch_add(1, Ordering::Relaxed) > 0;
        let (unit, total) = (task.unit.to_owned(), task.total);
        Log { name, unit, total, start: Instant::now(), done, next, is_within, shared }
    }

    fn sum_up(&self) {
        // What failed before its first step has nothing to tell.
        if self.done.load(Ordering::Relaxed) > 0 && !self.is_within {
            tell(&self.line(self.start.elapsed(), true));
        }
    }

    /// What is known `elapsed` after the start, within the stage or when it has ended.
    fn line(&self, elapsed: Duration, ended: bool) -> String {
        let done = self.done.load(Ordering::Relaxed);
        let per_second = done as f64 / elapsed.as_secs_f64().max(1e-9);
        let mut line = format!("{}  {}", self.name, HumanCount(done));
        // Writing to a String cannot fail.
        if let Some(total) = self.total.filter(|&total| total != done) {
            let _ = write!(line, " of {}", HumanCount(total));
        }
        let _ = write!(line, " {}, {}, ", self.unit, rate(per_second, &self.unit));
        let _ = match self.total.filter(|&total| total > done && !ended) {
            Some(total) => write!(line, "{} left", duration((total - done) as f64 / per_second)),
            None => write!(line, "{}", duration(elapsed.as_secs_f64())),
        };
        line
    }
}

impl TaskSink for Log {
    fn advanced(&self, units: u64) {
        self.done.fetch_add(units, Ordering::Relaxed);
        let (now, due) = (self.start.elapsed().as_secs(), self.next.load(Ordering::Relaxed));
        let relaxed = Ordering::Relaxed;
        // One of the threads that find a line due writes it.
        if now >= due && self.next.compare_exchange(due, now + LINE_EVERY, relaxed, relaxed).is_ok() {
            tell(&self.line(self.start.elapsed(), false));
        }
    }

    fn restarted(&mut self, total: u64) {
        self.sum_up();
        (self.total, self.start, self.done) = (Some(total), Instant::now(), AtomicU64::new(0));
        self.next = AtomicU64::new(LINE_EVERY);
    }
}

impl Drop for Log {
    fn drop(&mut self) {
        self.shared.logs.fetch_sub(1, Ordering::Relaxed);
        self.sum_up();
    }
}

/// A rate as a person reads it: two digits or three, or how long each takes.
fn rate(per_second: f64, unit: &str) -> String {
    if per_second > 0.0 && per_second < 0.5 {
        return format!("{} each", duration(1.0 / per_second));
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
    fn a_line_says_what_is_done_how_fast_and_how_long_it_took_or_will_take() {
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
    }

    #[test]
    fn rates_are_rounded_to_what_a_person_reads() {
        for (rate_of, text) in [
            (0.01, "1 min 40 s each"),
            (0.5, "0.5 pictures/s"),
            (12.4, "12 pictures/s"),
            (999.6, "1.0 k pictures/s"),
            (45_600.0, "46 k pictures/s"),
            (3.14e6, "3.1 M pictures/s"),
            (2e9, "2.0 G pictures/s"),
        ] {
            assert_eq!(rate(rate_of, "pictures"), text);
        }
    }

    #[test]
    fn a_bar_is_never_longer_than_its_room_says_most_in_most_and_no_time_of_no_seconds() {
        let moment = BarSnapshot {
            name: "[3/9] rounds",
            unit: "pictures",
            done: 1234,
            total: Some(5000),
            per_second: 12.0,
            left: Some(313.0),
            run: Some(4000.0),
        };
        for columns in 0..200 {
            let line = moment.line(columns);
            assert!(line.chars().count() <= columns, "{columns}: {line}");
        }
        assert_eq!(
            moment.line(119),
            "[3/9] rounds [=====                   ]  24% 1,234/5,000 pictures, 12 pictures/s, 5 min 13 s left, \
             the run 1 h 06 min"
        );
        assert_eq!(moment.line(79), "[3/9] rounds  24% 1,234/5,000 pictures, 12 pictures/s, 5 min 13 s left");
        assert_eq!(moment.line(30), "[3/9] rounds [==       ]  24%");
        let nearly = BarSnapshot { left: Some(0.4), run: Some(0.2), ..moment };
        assert!(!nearly.line(119).contains("left") && !nearly.line(119).contains("run"), "{}", nearly.line(119));
        let counting = BarSnapshot { total: None, left: None, run: None, ..nearly };
        assert_eq!(counting.line(119), "[3/9] rounds 1,234 pictures, 12 pictures/s");
    }

    #[test]
    fn stages_of_a_run_are_numbered_and_what_is_left_of_it_follows_how_long_the_first_ones_took() {
        let start = Instant::now();
        let after = |seconds| start + Duration::from_secs(seconds);
        let stages = vec![("scan", 10.0), ("score", 0.0), ("rounds", 30.0), ("emit", 5.0)];
        let mut run = RunPosition { stages, start, at: None };
        assert_eq!(run.enter("motion", start), "motion");
        assert_eq!(run.left(2.0, start), 2.0);
        assert_eq!(run.enter("scan", start), "[1/4] scan");
        assert_eq!(run.left(8.0, after(4)), 8.0 + 35.0);
        // Twice as slow as was thought: so will be what follows.
        assert_eq!(run.enter("rounds", after(20)), "[3/4] rounds");
        assert_eq!(run.left(1.0, after(30)), 50.0 + 10.0);
        // A second round does not begin the stage anew.
        assert_eq!(run.enter("rounds", after(60)), "[3/4] rounds");
        assert_eq!(run.left(7.0, after(90)), 7.0 + 10.0);
    }
}
