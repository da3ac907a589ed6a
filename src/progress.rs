//! Events by which the library tells what it is doing. The library itself prints nothing: a program that shows events
//! implements [`EventSink`] and passes it on in [`crate::scene::InputOptions::events`]; `examples/compress.rs` is such a
//! program.

use std::fmt::{self, Debug};
use std::sync::Arc;

/// Receives the events of runs, from any thread. Default implementations ignore an event.
pub trait EventSink: Send + Sync {
    /// A run begins that consists of `stages`, in order. Each stage begins with the task of its name.
    fn run_begun(&self, stages: &[ExpectedStage]) {
        let _ = stages;
    }

    /// The run of the last [`EventSink::run_begun`] has ended, with a result or an error.
    fn run_ended(&self) {}

    /// A task begins. Its progress goes to the returned sink, which is dropped when the task ends; `None` if nobody is
    /// interested in it. Tasks may begin while others go on.
    fn task_begun(&self, task: Task<'_>) -> Option<Box<dyn TaskSink>> {
        let _ = task;
        None
    }

    /// There is something to say.
    fn message(&self, message: Message<'_>) {
        let _ = message;
    }
}

/// Receives the progress of one task, from any thread. It is dropped when the task ends.
pub trait TaskSink: Debug + Send + Sync {
    /// So many more units are done.
    fn advanced(&self, units: u64);

    /// The task begins again, with `total` units.
    fn restarted(&mut self, total: u64);
}

/// Name of a stage and its expected duration in seconds.
pub type ExpectedStage = (&'static str, f64);

/// A task that begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Task<'a> {
    /// Name: that of the stage if it is one.
    pub name: &'static str,
    /// Unit of its work, in the plural ("states").
    pub unit: &'a str,
    /// Number of units; `None` if it is not known in advance.
    pub total: Option<u64>,
}

/// A message about a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Message<'a> {
    /// Part of the memory plan or the forecast of a run: lines of text. Sent if [`crate::memory_plan::Budget::tell`] asks
    /// for it.
    Plan(&'a str),
    /// Something that the user should change before the run goes on, such as missing cameras.
    Warning(&'a str),
    /// The result of a stage is discarded.
    Discarded {
        /// Name of the stage.
        stage: &'a str,
        /// Reason.
        why: &'a str,
    },
}

/// Where the events of a run go: to an [`EventSink`], or nowhere.
#[derive(Clone, Default)]
pub struct Events(Option<Arc<dyn EventSink>>);

impl Debug for Events {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.0.is_some() { "Events(shown)" } else { "Events(ignored)" })
    }
}

impl Events {
    /// Ignores every event.
    pub const IGNORED: Events = Events(None);

    /// Passes every event on to `sink`.
    pub fn new(sink: impl EventSink + 'static) -> Self {
        Events(Some(Arc::new(sink)))
    }

    /// Announces a run of `stages`. It lasts as long as the returned value lives.
    pub fn begin_run(&self, stages: &[ExpectedStage]) -> RunOfStages {
        if let Some(sink) = &self.0 {
            sink.run_begun(stages);
        }
        RunOfStages(self.clone())
    }

    /// Begins the task `name` of `total` units; `unit` is plural ("states").
    pub fn task(&self, name: &'static str, unit: &str, total: u64) -> Progress {
        self.begin(Task { name, unit, total: Some(total) })
    }

    /// Begins the task `name`, whose number of units is not known in advance.
    pub fn counting_task(&self, name: &'static str, unit: &str) -> Progress {
        self.begin(Task { name, unit, total: None })
    }

    fn begin(&self, task: Task<'_>) -> Progress {
        Progress(self.0.as_ref().and_then(|sink| sink.task_begun(task)))
    }

    /// Sends a message.
    pub fn send(&self, message: Message<'_>) {
        if let Some(sink) = &self.0 {
            sink.message(message);
        }
    }
}

/// A run whose stages were announced; it ends when this is dropped.
#[must_use = "the run ends when this is dropped"]
#[derive(Debug)]
pub struct RunOfStages(Events);

impl Drop for RunOfStages {
    fn drop(&mut self) {
        if let Some(sink) = &self.0.0 {
            sink.run_ended();
        }
    }
}

/// Progress of a task, e.g. through Gaussians × frames. Cheap to advance from any thread; the task ends when this is
/// dropped.
#[derive(Debug)]
pub struct Progress(Option<Box<dyn TaskSink>>);

impl Progress {
    /// Progress that nobody is told of.
    pub const IGNORED: Progress = Progress(None);

    /// Marks `units` more units as done.
    pub fn advance(&self, units: u64) {
        if let Some(sink) = &self.0 {
            sink.advanced(units);
        }
    }

    /// Begins the task again, with `total` units.
    pub fn restart(&mut self, total: u64) {
        if let Some(sink) = &mut self.0 {
            sink.restarted(total);
        }
    }
}

/// Formats a duration in seconds for a person.
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
    use std::sync::Mutex;

    use super::*;

    /// Writes down every event.
    #[derive(Debug, Clone, Default)]
    struct Recorder(Arc<Mutex<Vec<String>>>);

    impl Recorder {
        fn record(&self, event: String) {
            self.0.lock().unwrap().push(event);
        }
    }

    impl EventSink for Recorder {
        fn run_begun(&self, stages: &[ExpectedStage]) {
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
        let run = events.begin_run(&[("scan", 1.0)]);
        let mut task = events.task("scan", "states", 7);
        task.advance(2);
        task.restart(9);
        drop((task, events.counting_task("receive", "frames")));
        events.send(Message::Plan("memory"));
        drop(run);
        let expected = [
            r#"run [("scan", 1.0)]"#,
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
    fn durations_are_rounded_for_a_person() {
        for (seconds, text) in [(0.04, "0.0 s"), (59.4, "59.4 s"), (60.0, "1 min 00 s"), (7261.0, "2 h 01 min")] {
            assert_eq!(duration(seconds), text);
        }
    }
}
