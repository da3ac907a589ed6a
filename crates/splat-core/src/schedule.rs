//! List of the views (cameras) of every frame.

use serde::{Deserialize, Serialize};

use super::camera::Camera;

/// Schedule of views: for every frame the cameras that see it, with their view numbers.
///
/// Consecutive frames with equal views form a run. Memory: 16 bytes per run, and 8 bytes per view of a run. Memory
/// grows with the number of images that the camera file names, not with the number of frames.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ViewSchedule {
    /// Distinct cameras. The camera indices of the views are indices in this list. A camera may have no view.
    pub cameras: Vec<Camera>,
    runs: Vec<ViewRun>,
    /// Views of all runs (consecutive frames with equal views), one run after the other, as pairs (view number, camera
    /// index).
    views: Vec<(u32, u32)>,
    frames: usize,
}

/// Run: consecutive frames that have equal views. A run ends at the first frame of the next run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct ViewRun {
    /// Index in the sequence of the first frame of the run.
    frame: usize,
    /// Index of the first view of the run in the field `views` of [`ViewSchedule`]. The views of the run end where
    /// those of the next run begin.
    view: usize,
}

/// One camera at one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameView {
    /// Index of the frame in the sequence.
    pub frame: usize,
    /// Number of the view in the data set.
    pub view: u32,
    /// Index of the camera in [`ViewSchedule::cameras`].
    pub camera: u32,
}

impl FrameView {
    /// Returns the name of the view, such as `t012_v03` for frame 12 and view 3. Larger numbers have more digits.
    pub fn name(&self) -> String {
        format!("t{:03}_v{:02}", self.frame, self.view)
    }
}

impl ViewSchedule {
    /// Creates a schedule with `cameras` and no frames.
    pub fn new(cameras: Vec<Camera>) -> ViewSchedule {
        ViewSchedule { cameras, ..ViewSchedule::default() }
    }

    /// Creates a schedule with `cameras` and the views `views`, which must be sorted by frame. The schedule ends with
    /// the frame of the last view.
    pub fn from_views(cameras: Vec<Camera>, views: &[FrameView]) -> ViewSchedule {
        let mut schedule = ViewSchedule::new(cameras);
        for of_frame in views.chunk_by(|a, b| a.frame == b.frame) {
            schedule.push_frames(of_frame[0].frame - schedule.frames, &[]);
            let pairs: Vec<(u32, u32)> = of_frame.iter().map(|view| (view.view, view.camera)).collect();
            schedule.push_frames(1, &pairs);
        }
        schedule
    }

    /// Appends `count` frames that all have the views `views`: pairs (view number, camera index).
    pub fn push_frames(&mut self, count: usize, views: &[(u32, u32)]) {
        let extends_last_run = self.runs.last().is_some_and(|last| &self.views[last.view..] == views);
        if count > 0 && !extends_last_run {
            self.runs.push(ViewRun { frame: self.frames, view: self.views.len() });
            self.views.extend_from_slice(views);
        }
        self.frames += count;
    }

    /// Returns the bytes of memory that a schedule takes, for `runs` runs with at most `views` views each. The bytes of
    /// the entries are doubled, because a growing vector reserves up to twice its length.
    pub const fn bytes(runs: u64, views: u64) -> u64 {
        2 * runs * (size_of::<ViewRun>() as u64 + views * size_of::<(u32, u32)>() as u64)
    }

    /// Returns the number of frames T.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Returns the views of frame `frame` as pairs (view number, camera index).
    ///
    /// # Panics
    /// Panics if there is no such frame.
    pub fn views(&self, frame: usize) -> &[(u32, u32)] {
        assert!(frame < self.frames, "no frame {frame} of {}", self.frames);
        self.views_of_run(self.runs.partition_point(|run| run.frame <= frame) - 1)
    }

    /// Iterates over the frames; yields the views of each as pairs (view number, camera index).
    pub fn iter(&self) -> impl Iterator<Item = &[(u32, u32)]> {
        (0..self.runs.len()).flat_map(|run| std::iter::repeat_n(self.views_of_run(run), self.run_length(run)))
    }

    /// Iterates over the views of all frames, in the order of the frames.
    pub fn frame_views(&self) -> impl Iterator<Item = FrameView> {
        self.iter()
            .enumerate()
            .flat_map(|(frame, views)| views.iter().map(move |&(view, camera)| FrameView { frame, view, camera }))
    }

    /// Returns the number M of (frame, view) pairs, which is the number of views summed over all frames.
    pub fn pair_count(&self) -> usize {
        (0..self.runs.len()).map(|run| self.run_length(run) * self.views_of_run(run).len()).sum()
    }

    /// Returns the largest number of views that a frame has, or 0 if there are no frames.
    pub fn max_views_per_frame(&self) -> usize {
        (0..self.runs.len()).map(|run| self.views_of_run(run).len()).max().unwrap_or(0)
    }

    /// Returns the indices of the cameras that see at least one frame, increasing.
    pub fn used_cameras(&self) -> Vec<u32> {
        let mut used: Vec<u32> = self.views.iter().map(|&(_, camera)| camera).collect();
        used.sort_unstable();
        used.dedup();
        used
    }

    /// Returns the views of the run with the index `run`, as pairs (view number, camera index).
    fn views_of_run(&self, run: usize) -> &[(u32, u32)] {
        let end = self.runs.get(run + 1).map_or(self.views.len(), |next| next.view);
        &self.views[self.runs[run].view..end]
    }

    /// Returns the number of frames of the run with the index `run`.
    fn run_length(&self, run: usize) -> usize {
        self.runs.get(run + 1).map_or(self.frames, |next| next.frame) - self.runs[run].frame
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_with_equal_views_share_a_run() {
        let pushed: [(usize, &[(u32, u32)]); 8] = [
            (0, &[(9, 9)]),
            (2, &[]),
            (1, &[(0, 0), (1, 1)]),
            (3, &[(0, 0), (1, 1)]),
            (1, &[(1, 1)]),
            // These frames have as many views as the ones before, but different ones.
            (1, &[(1, 0)]),
            (0, &[(3, 3)]),
            (2, &[]),
        ];
        let mut schedule = ViewSchedule::default();
        let mut expected: Vec<&[(u32, u32)]> = Vec::new();
        for (count, views) in pushed {
            schedule.push_frames(count, views);
            expected.extend(std::iter::repeat_n(views, count));
        }
        assert_eq!(schedule.iter().collect::<Vec<_>>(), expected);
        assert!(expected.iter().enumerate().all(|(frame, views)| schedule.views(frame) == *views));
        assert_eq!((schedule.frames(), schedule.pair_count(), schedule.max_views_per_frame()), (10, 10, 2));
        assert_eq!((schedule.runs.len(), schedule.used_cameras()), (5, vec![0, 1]));
        assert_eq!((ViewSchedule::default().frames(), ViewSchedule::default().pair_count()), (0, 0));
    }

    #[test]
    fn bytes_cover_one_camera_per_frame() {
        for (frames, views) in [(1, 1), (1000, 1), (1025, 3), (70_000, 2)] {
            let mut schedule = ViewSchedule::default();
            for frame in 0..frames {
                let views_of_frame: Vec<(u32, u32)> = (0..views).map(|view| (view, frame)).collect();
                schedule.push_frames(1, &views_of_frame);
            }
            let held =
                schedule.runs.capacity() * size_of::<ViewRun>() + schedule.views.capacity() * size_of::<(u32, u32)>();
            // The first allocation of a vector has a capacity of four.
            let counted = ViewSchedule::bytes(frames.max(4).into(), views.into());
            assert!(held as u64 <= counted, "{frames} frames of {views}: {held} bytes, counted {counted}");
            assert!(schedule.runs.len() == frames as usize && counted <= 2 * (held as u64).max(96), "{held} {counted}");
        }
    }
}
