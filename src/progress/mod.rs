//! Progress on stderr. On a terminal a bar with rate and time left, a line each for what goes on within another;
//! elsewhere, for logs, a line when a stage ends and at most one a minute within it, none where what goes on within another
//! ends; nothing when quiet.
//!
//! A line that is longer than the terminal is wide would leave its end behind when it is drawn anew: so lines are put
//! together here, of what there is room for.

mod message;

use std::fmt::Write as _;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use console::Term;
use indicatif::{HumanCount, MultiProgress, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

use crate::error::printable;
use message::is_terminal;

pub use message::tell;

/// Seconds between two lines of one stage.
const LINE_EVERY: u64 = 60;

/// Columns of a terminal that does not say how many it has.
const USUAL_COLUMNS: u16 = 80;
/// Columns that a bar has at most, and at least: a shorter one shows nothing that the percentage does not.
const BAR: [usize; 2] = [30, 8];

/// All bars of this process: one that begins within another has a line below it.
static BARS: LazyLock<MultiProgress> =
    LazyLock::new(|| MultiProgress::with_draw_target(ProgressDrawTarget::stderr_with_hz(10)));
/// A library says nothing unasked.
static QUIET: AtomicBool = AtomicBool::new(true);
/// Of those that are told of line by line, how many go on.
static LOGS: AtomicUsize = AtomicUsize::new(0);
static RUN: Mutex<Option<RunPosition>> = Mutex::new(None);

/// What this process shows of its progress.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Bars on a terminal, else lines.
    Auto,
    /// Nothing, until something else is asked for.
    Quiet,
}

/// Names the stages that a run is made of, in order, with the seconds that each takes, about: as long as what it gives
/// lives, a bar or line of one of them says `[k/n]`, and a bar how long the whole run will take yet.
pub fn begin_run(stages: Vec<(&'static str, f64)>) -> RunOfStages {
    *run() = Some(RunPosition { stages, start: Instant::now(), at: None });
    RunOfStages(())
}

fn run() -> MutexGuard<'static, Option<RunPosition>> {
    RUN.lock().unwrap_or_else(PoisonError::into_inner)
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

/// A run whose stages are numbered.
#[must_use = "stages are numbered as long as this lives"]
#[derive(Debug)]
pub struct RunOfStages(());

impl Drop for RunOfStages {
    fn drop(&mut self) {
        *run() = None;
    }
}

/// Silence, and whether there was silence before.
#[must_use = "it is quiet as long as this lives"]
#[derive(Debug)]
pub struct QuietGuard(bool);

impl Drop for QuietGuard {
    fn drop(&mut self) {
        QUIET.store(self.0, Ordering::Relaxed);
    }
}

/// Progress through `total` units of work, e.g. Gaussians × frames. Cheap to advance from any thread.
#[derive(Debug)]
pub struct Progress(ProgressDisplay);

#[derive(Debug)]
enum ProgressDisplay {
    Nothing,
    Bar(ProgressBar),
    Lines(Log),
}

impl Progress {
    /// Decides for everything that begins from now on.
    pub fn set_mode(mode: Mode) {
        QUIET.store(mode == Mode::Quiet, Ordering::Relaxed);
    }

    /// Nothing is shown of what begins while what this gives lives.
    pub fn hush() -> QuietGuard {
        QuietGuard(QUIET.swap(true, Ordering::Relaxed))
    }

    /// A bar named after what it does; `unit` is plural ("states").
    pub fn new(what: &'static str, unit: &str, total: u64) -> Self {
        Self::begin(what, unit, Some(total))
    }

    /// A counter of work whose amount nobody knows ahead.
    pub fn counting(what: &'static str, unit: &str) -> Self {
        Self::begin(what, unit, None)
    }

    fn begin(what: &'static str, unit: &str, total: Option<u64>) -> Self {
        if QUIET.load(Ordering::Relaxed) {
            return Progress(ProgressDisplay::Nothing);
        }
        let name = run().as_mut().map_or_else(|| what.to_owned(), |run| run.enter(what, Instant::now()));
        if !is_terminal() {
            return Progress(ProgressDisplay::Lines(Log::new(name, unit, total)));
        }
        let bar = BARS.add(total.map_or_else(ProgressBar::no_length, ProgressBar::new));
        if let Ok(style) = ProgressStyle::with_template("{line}") {
            let unit = unit.to_owned();
            // Of what goes on around a run nobody knows how it follows from the run.
            let is_stage = name != what;
            let line = move |state: &ProgressState, out: &mut dyn std::fmt::Write| {
                let columns = Term::stderr().size_checked().map_or(USUAL_COLUMNS, |(_, columns)| columns);
                // Writing to what is drawn cannot fail. The last column stays free: some terminals go on to the next line.
                let _ = out.write_str(
                    &BarSnapshot::new(state, (&name, is_stage), &unit).line(usize::from(columns).saturating_sub(1)),
                );
            };
            bar.set_style(style.with_key("line", line));
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        Progress(ProgressDisplay::Bar(bar))
    }

    /// Begins anew, with `total` units.
    pub fn restart(&mut self, total: u64) {
        match &mut self.0 {
            ProgressDisplay::Nothing => (),
            ProgressDisplay::Bar(bar) => {
                bar.set_length(total);
                bar.reset();
            }
            ProgressDisplay::Lines(log) => {
                log.sum_up();
                (log.total, log.start, log.done) = (Some(total), Instant::now(), AtomicU64::new(0));
                log.next = AtomicU64::new(LINE_EVERY);
            }
        }
    }

    /// Tells that what the stage `what` did is undone, and `why`: nobody is to take it for progress.
    pub fn report_skipped(what: &str, why: &str) {
        if QUIET.load(Ordering::Relaxed) {
            return;
        }
        let line = format!("{what}  left out: {why}");
        match is_terminal() {
            // A terminal that cannot be written to shows nothing of the rest either.
            true => drop(BARS.println(printable(&line))),
            false => tell(&line),
        }
    }

    /// Marks `units` as done.
    pub fn advance(&self, units: u64) {
        match &self.0 {
            ProgressDisplay::Nothing => (),
            ProgressDisplay::Bar(bar) => bar.inc(units),
            ProgressDisplay::Lines(log) => log.advance(units),
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        match &self.0 {
            ProgressDisplay::Nothing => (),
            ProgressDisplay::Bar(bar) => {
                bar.finish_and_clear();
                BARS.remove(bar);
            }
            ProgressDisplay::Lines(log) => log.end(),
        }
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
    fn new(state: &ProgressState, (name, is_stage): (&'a str, bool), unit: &'a str) -> BarSnapshot<'a> {
        let (done, total) = (state.pos(), state.len());
        // Of what has not begun to move nobody knows how fast it is.
        let left = total.filter(|&total| done > 0 && total > done).map(|_| state.eta().as_secs_f64());
        let run = run().as_ref().filter(|_| is_stage).map(|run| run.left(left.unwrap_or(0.0), Instant::now()));
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

/// A stage that is told of line by line.
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
}

impl Log {
    fn new(name: String, unit: &str, total: Option<u64>) -> Log {
        let (done, next) = (AtomicU64::new(0), AtomicU64::new(LINE_EVERY));
        let is_within = LOGS.fetch_add(1, Ordering::Relaxed) > 0;
        Log { name, unit: unit.to_owned(), total, start: Instant::now(), done, next, is_within }
    }

    fn advance(&self, units: u64) {
        self.done.fetch_add(units, Ordering::Relaxed);
        let (now, due) = (self.start.elapsed().as_secs(), self.next.load(Ordering::Relaxed));
        let relaxed = Ordering::Relaxed;
        // One of the threads that find a line due writes it.
        if now >= due && self.next.compare_exchange(due, now + LINE_EVERY, relaxed, relaxed).is_ok() {
            tell(&self.line(self.start.elapsed(), false));
        }
    }

    fn end(&self) {
        LOGS.fetch_sub(1, Ordering::Relaxed);
        self.sum_up();
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

/// A time as a person reads it.
pub fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..60 => format!("{seconds:.1} s"),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_says_what_is_done_how_fast_and_how_long_it_took_or_will_take() {
        let log = Log::new("scan".to_owned(), "states", Some(1_252_980));
        log.advance(626_490);
        let minute = Duration::from_secs(60);
        assert_eq!(log.line(minute, false), "scan  626,490 of 1,252,980 states, 10 k states/s, 1 min 00 s left");
        assert_eq!(log.line(minute, true), "scan  626,490 of 1,252,980 states, 10 k states/s, 1 min 00 s");
        log.advance(626_490);
        assert_eq!(log.line(Duration::from_millis(404), true), "scan  1,252,980 states, 3.1 M states/s, 0.4 s");
        let counter = Log::new("receive".to_owned(), "frames", None);
        counter.advance(72);
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
