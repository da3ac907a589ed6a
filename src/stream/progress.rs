//! Progress on stderr. On a terminal a bar with rate and time left; elsewhere, for logs, a line when a stage
//! ends and at most one a minute within it; nothing when quiet.

use std::fmt::Write as _;
use std::io::{self, IsTerminal, Write as _};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{HumanCount, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

/// Seconds between two lines of one stage.
const LINE_EVERY: u64 = 60;

/// A library says nothing unasked.
static QUIET: AtomicBool = AtomicBool::new(true);
static RUN: Mutex<Option<Run>> = Mutex::new(None);

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
    *run() = Some(Run { stages, start: Instant::now(), at: None });
    RunOfStages(())
}

fn run() -> MutexGuard<'static, Option<Run>> {
    RUN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Where a run is.
#[derive(Debug)]
struct Run {
    /// Names, and about how many seconds they take.
    stages: Vec<(&'static str, f64)>,
    start: Instant,
    /// The stage that runs, and since when.
    at: Option<(usize, Instant)>,
}

impl Run {
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
pub struct Hush(bool);

impl Drop for Hush {
    fn drop(&mut self) {
        QUIET.store(self.0, Ordering::Relaxed);
    }
}

/// Progress through `total` units of work, e.g. Gaussians × frames. Cheap to advance from any thread.
#[derive(Debug)]
pub struct Progress(Shown);

#[derive(Debug)]
enum Shown {
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
    pub fn hush() -> Hush {
        Hush(QUIET.swap(true, Ordering::Relaxed))
    }

    /// A bar named after what it does; `unit` is plural ("Gaussian frames").
    pub fn new(what: &'static str, unit: &str, total: u64) -> Self {
        Self::begin(what, unit, Some(total))
    }

    /// A counter of work whose amount nobody knows ahead.
    pub fn counting(what: &'static str, unit: &str) -> Self {
        Self::begin(what, unit, None)
    }

    fn begin(what: &'static str, unit: &str, total: Option<u64>) -> Self {
        if QUIET.load(Ordering::Relaxed) {
            return Progress(Shown::Nothing);
        }
        let name = run().as_mut().map_or_else(|| what.to_owned(), |run| run.enter(what, Instant::now()));
        if !io::stderr().is_terminal() {
            return Progress(Shown::Lines(Log::new(name, unit, total)));
        }
        let bar = ProgressBar::with_draw_target(total, ProgressDrawTarget::stderr_with_hz(10));
        let template = match total {
            Some(_) => format!(
                "{{prefix:>10}} [{{wide_bar}}] {{percent:>3}}% {{human_pos}}/{{human_len}} {unit}, {{rate}}, {{eta}} \
                 left{{run}}"
            ),
            None => format!("{{prefix:>10}} {{spinner}} {{human_pos}} {unit}, {{rate}}"),
        };
        if let Ok(style) = ProgressStyle::with_template(&template) {
            let rate = |state: &ProgressState, out: &mut dyn std::fmt::Write| _ = out.write_str(&rate(state.per_sec()));
            let of_run = |state: &ProgressState, out: &mut dyn std::fmt::Write| {
                let left = run().as_ref().map(|run| run.left(state.eta().as_secs_f64(), Instant::now()));
                let _ = left.map(|left| write!(out, " (about {} in all)", duration(left)));
            };
            bar.set_style(style.with_key("rate", rate).with_key("run", of_run).progress_chars("=> "));
        }
        bar.set_prefix(name);
        bar.enable_steady_tick(Duration::from_millis(200));
        Progress(Shown::Bar(bar))
    }

    /// Marks `units` as done.
    pub fn advance(&self, units: u64) {
        match &self.0 {
            Shown::Nothing => (),
            Shown::Bar(bar) => bar.inc(units),
            Shown::Lines(log) => log.advance(units),
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        match &self.0 {
            Shown::Nothing => (),
            Shown::Bar(bar) => bar.finish_and_clear(),
            Shown::Lines(log) => log.end(),
        }
    }
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
}

impl Log {
    fn new(name: String, unit: &str, total: Option<u64>) -> Log {
        let (done, next) = (AtomicU64::new(0), AtomicU64::new(LINE_EVERY));
        Log { name, unit: unit.to_owned(), total, start: Instant::now(), done, next }
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
        // What failed before its first step has nothing to tell.
        if self.done.load(Ordering::Relaxed) > 0 {
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
        let _ = write!(line, " {}, {}, ", self.unit, rate(per_second));
        let _ = match self.total.filter(|&total| total > done && !ended) {
            Some(total) => write!(line, "{} left", duration((total - done) as f64 / per_second)),
            None => write!(line, "{}", duration(elapsed.as_secs_f64())),
        };
        line
    }
}

/// Says something on stderr; nobody listening is no failure.
fn tell(line: &str) {
    let _ = writeln!(io::stderr(), "{line}");
}

/// A rate as a person reads it: two digits or three.
fn rate(per_second: f64) -> String {
    let (value, unit) = match per_second {
        more if more >= 999.5e6 => (more / 1e9, " G"),
        more if more >= 999.5e3 => (more / 1e6, " M"),
        more if more >= 999.5 => (more / 1e3, " k"),
        few => (few, ""),
    };
    let digits = if value < 9.95 { 1 } else { 0 };
    format!("{value:.digits$}{unit}/s")
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
        let log = Log::new("scan".to_owned(), "Gaussian frames", Some(1_252_980));
        log.advance(626_490);
        let minute = Duration::from_secs(60);
        assert_eq!(log.line(minute, false), "scan  626,490 of 1,252,980 Gaussian frames, 10 k/s, 1 min 00 s left");
        assert_eq!(log.line(minute, true), "scan  626,490 of 1,252,980 Gaussian frames, 10 k/s, 1 min 00 s");
        log.advance(626_490);
        assert_eq!(log.line(Duration::from_millis(404), true), "scan  1,252,980 Gaussian frames, 3.1 M/s, 0.4 s");
        let counter = Log::new("receive".to_owned(), "frames", None);
        counter.advance(7);
        assert_eq!(counter.line(Duration::from_secs(7200), false), "receive  7 frames, 0.0/s, 2 h 00 min");
    }

    #[test]
    fn rates_are_rounded_to_what_a_person_reads() {
        for (rate_of, text) in [
            (0.5, "0.5/s"),
            (12.4, "12/s"),
            (999.6, "1.0 k/s"),
            (45_600.0, "46 k/s"),
            (3.14e6, "3.1 M/s"),
            (2e9, "2.0 G/s"),
        ] {
            assert_eq!(rate(rate_of), text);
        }
    }

    #[test]
    fn stages_of_a_run_are_numbered_and_what_is_left_of_it_follows_how_long_the_first_ones_took() {
        let start = Instant::now();
        let after = |seconds| start + Duration::from_secs(seconds);
        let stages = vec![("scan", 10.0), ("score", 0.0), ("rounds", 30.0), ("emit", 5.0)];
        let mut run = Run { stages, start, at: None };
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
