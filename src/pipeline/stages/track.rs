//! Stage `track`: links the Gaussians of frames that do not identify them into tracks (Gaussians followed through
//! frames). Inputs that identify their Gaussians do not need it.
//!
//! This stage is not in the list `STAGES`: it runs before a plan is made, because the number of tracks is the number of
//! Gaussians in the scene, on which the plan of all other stages depends.

use crate::error::Result;
use crate::journal::{Journal, Stopwatch};
use crate::memory_plan::Verbosity;
use crate::models::Opened;
use crate::progress::Message;
use crate::scene::{InputOptions, OpenedInput, UntrackedInput};
use crate::source::ReadCounts;

/// Name of this stage in plans and summaries.
pub(crate) const NAME: &str = "track";

/// Returns `input` with linked frames. If they have to be linked, records the stage in `journal`. `start` is a stopwatch
/// that was started before the input was opened; it is restarted at the end of the stage, so that the time of the stage
/// is counted once.
///
/// # Errors
/// Fails if the frames cannot be linked, or in the cases in which [`UntrackedInput::track`] fails.
pub(crate) fn run(
    input: UntrackedInput,
    options: &InputOptions,
    start: &mut Stopwatch,
    journal: &mut Journal,
) -> Result<OpenedInput> {
    let Opened::Unlinked(frames) = &input.opened else { return input.track(&options.path) };
    if options.memory.tell == Verbosity::Plan {
        let text = format!("{NAME}: the Gaussians of {} frames are linked ({})", frames.times().len(), frames.why());
        options.events.send(Message::Plan(&text));
    }
    let tracked = input.track(&options.path)?;
    journal.record_opening(NAME, *start, tracked.input.source().info().count, ReadCounts::default());
    *start = Stopwatch::start();
    Ok(tracked)
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;
    use std::sync::{Arc, Mutex};

    use super::*;
    use crate::cache::Completion;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::files::ply::write::write_inria;
    use crate::memory_plan::Budget;
    use crate::model::Attributes;
    use crate::passes::gather_all;
    use crate::pipeline::{Request, Target, compress};
    use crate::progress::{EventSink, Events, Task, TaskSink};
    use crate::recipe::Recipe;
    use crate::scene::open_untracked;

    /// Sink that records the names of tasks and the texts of plans.
    #[derive(Clone, Default)]
    struct Recorder(Arc<Mutex<Vec<String>>>);

    impl EventSink for Recorder {
        fn task_begun(&self, task: Task<'_>) -> Option<Box<dyn TaskSink>> {
            self.0.lock().unwrap().push(task.name.to_owned());
            None
        }

        fn message(&self, message: Message<'_>) {
            if let Message::Plan(text) = message {
                self.0.lock().unwrap().push(text.to_owned());
            }
        }
    }

    /// Writes three PLY frames with different numbers of Gaussians to `folder/frames`, so that they have to be linked.
    /// Returns options to open them, with an empty folder for temporary files, and the sink of all events.
    fn unlinked_frames(folder: &Path) -> (InputOptions, Recorder) {
        let (frames, scratch) = (folder.join("frames"), folder.join("scratch"));
        fs::create_dir(&frames).unwrap();
        fs::create_dir(&scratch).unwrap();
        let scene = DemoScene::new(300, 3);
        for frame in 0..3 {
            let state = gather_all(&scene, frame, Attributes::all()).unwrap();
            let rows: Vec<u32> = (0..(state.len() - frame) as u32).collect();
            write_inria(&state.pick(&rows), &[], &frames.join(format!("frame_{frame}.ply"))).unwrap();
        }
        let recorder = Recorder::default();
        let memory = Budget { tell: Verbosity::Plan, ..Budget::default() };
        let events = Events::new(recorder.clone());
        (InputOptions { path: frames, scratch: Some(scratch), memory, events, ..InputOptions::default() }, recorder)
    }

    #[test]
    fn opening_links_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let (options, recorder) = unlinked_frames(folder.path());
        let input = open_untracked(&options).unwrap();
        let Opened::Unlinked(frames) = &input.opened else { panic!("the frames have to be linked") };
        assert_eq!(frames.times(), [0.0, 1.0 / 3.0, 2.0 / 3.0]);
        assert_eq!(frames.why(), "frame_1.ply has 299 Gaussians, the first frame 300");
        assert!(recorder.0.lock().unwrap().is_empty());
        assert_eq!(fs::read_dir(options.scratch.as_ref().unwrap()).unwrap().count(), 0);
    }

    #[test]
    fn cameras_of_another_sequence_are_refused_before_linking() {
        let folder = tempfile::tempdir().unwrap();
        let (options, recorder) = unlinked_frames(folder.path());
        let cameras = folder.path().join("cameras.json");
        let frame = |time: f64| {
            serde_json::json!({
                "file_path": format!("r_{time}"),
                "time": time,
                "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]],
            })
        };
        let size = serde_json::json!({ "camera_angle_x": 0.7, "w": 32, "h": 24, "frames": [frame(0.0), frame(0.5)] });
        fs::write(&cameras, size.to_string()).unwrap();
        let error = open_untracked(&InputOptions { cameras: Some(cameras), ..options }).err().unwrap().to_string();
        assert!(error.contains("3 frames, but the cameras of") && error.contains("2 distinct times"), "{error}");
        assert!(recorder.0.lock().unwrap().is_empty());
    }

    #[test]
    fn requests_are_refused_before_linking() {
        let folder = tempfile::tempdir().unwrap();
        let (options, recorder) = unlinked_frames(folder.path());
        let exists = folder.path().join("exists.gseq");
        fs::write(&exists, "old").unwrap();
        for (output, part) in [(exists, "exists"), (folder.path().join("small.spz"), "3 frames do not fit one .spz")] {
            let request = Request::new(options.clone(), output, Recipe::preset("paper").unwrap());
            let error = compress(&request).err().unwrap().to_string();
            assert!(error.contains(part), "{error}");
        }
        assert!(recorder.0.lock().unwrap().is_empty());
    }

    #[test]
    fn tracking_is_the_first_stage_of_the_plan_and_of_the_summary() {
        let folder = tempfile::tempdir().unwrap();
        let (options, recorder) = unlinked_frames(folder.path());
        let recipe = Recipe::from_toml("[refine]\nrefine = \"none\"\n", "default").unwrap();
        let request = Request::new(options, folder.path().join("small.gseq"), recipe);
        let request = Request { target: Some(Target::Ratio(0.5)), ..request };
        let Completion::Whole(summary) = compress(&request).unwrap() else { panic!("the run is not divided") };
        let stage = &summary.stages[0];
        assert_eq!((stage.name.as_str(), stage.gaussians_out), (NAME, summary.input.gaussians));
        let events = recorder.0.lock().unwrap();
        assert!(
            events[0].starts_with("track: the Gaussians of 3 frames are linked (frame_1.ply has 299"),
            "{events:?}"
        );
        assert_eq!(events[1..3], ["link", "pack"]);
    }
}
