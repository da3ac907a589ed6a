//! Events by which the library reports its work. The library itself prints nothing. A program that shows events
//! implements [`EventSink`] and passes it on in [`crate::scene::InputOptions::events`]; `examples/compress.rs` is such
//! a program.

use std::fmt::{self, Debug, Display};
use std::sync::Arc;

use bytesize::ByteSize;

/// Receiver of the events of runs. Methods are called from any thread; default implementations ignore the event.
///
/// # Examples
/// ```
/// use splatsieve::progress::{EventSink, Events, Message};
///
/// struct Warnings;
///
/// impl EventSink for Warnings {
///     fn message(&self, message: Message<'_>) {
///         if let Message::Warning(text) = message {
///             println!("warning: {text}");
///         }
///     }
/// }
///
/// let events = Events::new(Warnings); // for InputOptions::events
/// events.send(Message::Warning("few cameras"));
/// ```
pub trait EventSink: Send + Sync {
    /// Receives the event that a run begins, with the names of its `stages` in order. Each stage then begins with a task of the
    /// stage's name ([`EventSink::task_begun`]).
    fn run_begun(&self, stages: &[&'static str]) {
        let _ = stages;
    }

    /// Receives the event that the run announced by the last call of [`EventSink::run_begun`] has ended, with a result
    /// or an error.
    fn run_ended(&self) {}

    /// Receives the event that a task begins. Returns a new sink for the progress of the task, or `None` if progress is
    /// not wanted. The new sink is dropped when the task ends. A task may begin while other tasks run.
    fn task_begun(&self, task: Task<'_>) -> Option<Box<dyn TaskSink>> {
        let _ = task;
        None
    }

    /// Receives a message about a run.
    fn message(&self, message: Message<'_>) {
        let _ = message;
    }
}

/// Receiver of the progress of one task. Methods are called from any thread; the sink is dropped when the task ends.
pub trait TaskSink: Debug + Send + Sync {
    /// Reports that `units` more units of the task are done.
    fn advanced(&self, units: u64);

    /// Reports that the task starts again from zero, with `total` units.
    fn restarted(&mut self, total: u64);
}

/// Task that begins, such as a stage or a step of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Task<'a> {
    /// Name of the task; equal to the stage name if the task is a stage.
    pub name: &'static str,
    /// Unit in which progress is counted, in the plural, such as "states" (one state is one Gaussian at one frame).
    pub unit: &'a str,
    /// Number of units of the whole task; `None` if unknown in advance.
    pub total: Option<u64>,
}

/// A message about a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Message<'a> {
    /// Part of the memory plan or of the forecast of a run, as lines of text. Sent only if
    /// [`crate::memory_plan::Budget::tell`] asks for it.
    Plan(&'a str),
    /// Problem that the user should solve before the run goes on, such as missing cameras.
    Warning(&'a str),
    /// Notice that the result of a stage is not used.
    Discarded {
        /// Name of the stage whose result is not used.
        stage: &'a str,
        /// Reason for not using the result.
        why: &'a str,
    },
}

/// Handle through which a run sends its events: to an [`EventSink`], or nowhere.
#[derive(Clone, Default)]
pub struct Events(Option<Arc<dyn EventSink>>);

impl Debug for Events {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.0.is_some() { "Events(shown)" } else { "Events(ignored)" })
    }
}

impl Events {
    /// Handle that ignores every event.
    pub const IGNORED: Events = Events(None);

    /// Returns a handle that passes every event on to `sink`.
    pub fn new(sink: impl EventSink + 'static) -> Self {
        Events(Some(Arc::new(sink)))
    }

    /// Announces the start of a run of the stages with the names `stages`. The run ends when the returned value is
    /// dropped.
    pub fn begin_run(&self, stages: &[&'static str]) -> RunGuard {
        if let Some(sink) = &self.0 {
            sink.run_begun(stages);
        }
        RunGuard(self.clone())
    }

    /// Begins the task `name` of `total` units and returns its progress. `unit` names the units in the plural
    /// ("states").
    pub fn task(&self, name: &'static str, unit: &str, total: u64) -> Progress {
        self.begin(Task { name, unit, total: Some(total) })
    }

    /// Begins the task `name`, whose number of units is unknown in advance, and returns its progress. `unit` names the
    /// units in the plural.
    pub fn counting_task(&self, name: &'static str, unit: &str) -> Progress {
        self.begin(Task { name, unit, total: None })
    }

    fn begin(&self, task: Task<'_>) -> Progress {
        Progress(self.0.as_ref().and_then(|sink| sink.task_begun(task)))
    }

    /// Sends a message to the sink, if there is one.
    pub fn send(&self, message: Message<'_>) {
        if let Some(sink) = &self.0 {
            sink.message(message);
        }
    }
}

/// Guard of an announced run. Dropping it announces the end of the run.
#[must_use = "the run ends when this is dropped"]
#[derive(Debug)]
pub struct RunGuard(Events);

impl Drop for RunGuard {
    fn drop(&mut self) {
        if let Some(sink) = &self.0.0 {
            sink.run_ended();
        }
    }
}

/// Progress of a task, counted in units such as states (one Gaussian at one frame). Can be advanced cheaply from any
/// thread. The task ends when this value is dropped.
#[derive(Debug)]
pub struct Progress(Option<Box<dyn TaskSink>>);

impl Progress {
    /// Progress that is reported to nobody.
    pub const IGNORED: Progress = Progress(None);

    /// Reports that `units` more units of the task are done.
    pub fn advance(&self, units: u64) {
        if let Some(sink) = &self.0 {
            sink.advanced(units);
        }
    }

    /// Reports that the task starts again from zero, with `total` units.
    pub fn restart(&mut self, total: u64) {
        if let Some(sink) = &mut self.0 {
            sink.restarted(total);
        }
    }
}

/// Formats a count with its noun: "1 view" or "60 views".
pub fn counted(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

/// Formats a number of bytes with a decimal unit, such as "1.5 MB".
pub fn decimal_bytes(bytes: u64) -> String {
    ByteSize(bytes).display().si().to_string()
}

/// Formats a whole number with a comma between groups of three digits.
pub fn grouped(number: impl Display) -> String {
    let digits = number.to_string();
    let groups: Vec<&str> =
        digits.as_bytes().rchunks(3).rev().filter_map(|group| std::str::from_utf8(group).ok()).collect();
    groups.join(",")
}

/// Formats a duration in seconds for display: "59.4 s", "1 min 00 s", "2 h 01 min".
pub fn format_duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..60 => format!("{seconds:.1} s"),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    /// Sink that records every event as text.
    #[derive(Debug, Clone, Default)]
    struct Recorder(Arc<Mutex<Vec<String>>>);

    impl Recorder {
        fn record(&self, event: String) {
            self.0.lock().unwrap().push(event);
        }
    }

    impl EventSink for Recorder {
        fn run_begun(&self, stages: &[&'static str]) {
            self.record(format!("run {stages:?}"));
        }

        fn run_ended(&self) {
            self.record("run ended".to_owned());
        }

        fn task_begun(&self, task: Task<'_>) -> Option<Box<dyn TaskSink>> {
            self.record(format!("{} {:?} {}", task.name, task.total, task.unit));
            Some(Box::new(self.clone()))
        }

        fn message(&self, message: Message<'_>) {
            self.record(format!("{message:?}"));
        }
    }

    impl TaskSink for Recorder {
        fn advanced(&self, units: u64) {
            self.record(format!("+{units}"));
        }

        fn restarted(&mut self, total: u64) {
            self.record(format!("again {total}"));
        }
    }

    #[test]
    fn every_event_reaches_the_sink_in_order() {
        let recorder = Recorder::default();
        let events = Events::new(recorder.clone());
        let run = events.begin_run(&["scan"]);
        let mut task = events.task("scan", "states", 7);
        task.advance(2);
        task.restart(9);
        drop((task, events.counting_task("receive", "frames")));
        events.send(Message::Plan("memory"));
        drop(run);
        let expected = [
            r#"run ["scan"]"#,
            "scan Some(7) states",
            "+2",
            "again 9",
            "receive None frames",
            r#"Plan("memory")"#,
            "run ended",
        ];
        assert_eq!(*recorder.0.lock().unwrap(), expected);
    }

    #[test]
    fn numbers_are_grouped_by_three_digits() {
        for (number, text) in [(0, "0"), (999, "999"), (20883, "20,883"), (1_234_567, "1,234,567")] {
            assert_eq!(grouped(number), text);
        }
    }

    #[test]
    fn durations_are_rounded_for_display() {
        for (seconds, text) in [(0.04, "0.0 s"), (59.4, "59.4 s"), (60.0, "1 min 00 s"), (7261.0, "2 h 01 min")] {
            assert_eq!(format_duration(seconds), text);
        }
    }
}
