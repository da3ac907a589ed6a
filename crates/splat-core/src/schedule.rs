//! Which cameras see which frame.

use serde::{Deserialize, Serialize};

use super::camera::Camera;

/// Which cameras see which frame.
///
/// Memory: 16 bytes for a run of frames that the same cameras see, 8 for each of these: it grows with the pictures that the
/// cameras name, not with frames.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Schedule {
    /// Distinct cameras.
    pub cameras: Vec<Camera>,
    runs: Vec<FrameRun>,
    /// (View number, camera index) pairs of run after run.
    views: Vec<(u32, u32)>,
    frames: usize,
}

/// Frames one after the other that have the same pictures; they end where the next run begins.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct FrameRun {
    /// Its first frame.
    frame: usize,
    /// Its first pair.
    view: usize,
}

/// A picture to make: what a camera sees at a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Picture {
    /// Frame of the sequence.
    pub frame: usize,
    /// View number.
    pub view: u32,
    /// Index of its camera.
    pub camera: u32,
}

impl Picture {
    /// `tNNN_vNN`: frame and view, with more digits where they need them.
    pub fn name(&self) -> String {
        format!("t{:03}_v{:02}", self.frame, self.view)
    }
}

impl Schedule {
    /// No frames yet, for pictures by `cameras`.
    pub fn new(cameras: Vec<Camera>) -> Schedule {
        Schedule { cameras, ..Schedule::default() }
    }

    /// The next `count` frames are each seen by `views`: (view number, camera index) pairs.
    pub fn push(&mut self, count: usize, views: &[(u32, u32)]) {
        let goes_on = self.runs.last().is_some_and(|last| &self.views[last.view..] == views);
        if count > 0 && !goes_on {
            self.runs.push(FrameRun { frame: self.frames, view: self.views.len() });
            self.views.extend_from_slice(views);
        }
        self.frames += count;
    }

    /// Bytes of `runs` runs of at most `views` pictures a frame, twice over, as vectors grow.
    pub const fn bytes(runs: u64, views: u64) -> u64 {
        2 * runs * (size_of::<FrameRun>() as u64 + views * size_of::<(u32, u32)>() as u64)
    }

    /// T, the number of frames.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// (View number, camera index) pairs of a frame.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn views(&self, frame: usize) -> &[(u32, u32)] {
        assert!(frame < self.frames, "no frame {frame} of {}", self.frames);
        self.of_run(self.runs.partition_point(|run| run.frame <= frame) - 1)
    }

    /// [`Schedule::views`] of every frame.
    pub fn iter(&self) -> impl Iterator<Item = &[(u32, u32)]> {
        (0..self.runs.len()).flat_map(|run| std::iter::repeat_n(self.of_run(run), self.run_length(run)))
    }

    /// M, the number of (time, view) pairs.
    pub fn pairs(&self) -> usize {
        (0..self.runs.len()).map(|run| self.run_length(run) * self.of_run(run).len()).sum()
    }

    /// Most pictures of one frame.
    pub fn most_views(&self) -> usize {
        (0..self.runs.len()).map(|run| self.of_run(run).len()).max().unwrap_or(0)
    }

    /// Indices of the cameras that see any frame, increasing.
    pub fn used(&self) -> Vec<u32> {
        let mut used: Vec<u32> = self.views.iter().map(|&(_, camera)| camera).collect();
        used.sort_unstable();
        used.dedup();
        used
    }

    fn of_run(&self, run: usize) -> &[(u32, u32)] {
        let end = self.runs.get(run + 1).map_or(self.views.len(), |next| next.view);
        &self.views[self.runs[run].view..end]
    }

    fn run_length(&self, run: usize) -> usize {
        self.runs.get(run + 1).map_or(self.frames, |next| next.frame) - self.runs[run].frame
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_have_what_was_pushed_and_equal_ones_share_a_run() {
        let pushed: [(usize, &[(u32, u32)]); 8] = [
            (0, &[(9, 9)]),
            (2, &[]),
            (1, &[(0, 0), (1, 1)]),
            (3, &[(0, 0), (1, 1)]),
            (1, &[(1, 1)]),
            // As many views, but others.
            (1, &[(1, 0)]),
            (0, &[(3, 3)]),
            (2, &[]),
        ];
        let mut schedule = Schedule::default();
        let mut expected: Vec<&[(u32, u32)]> = Vec::new();
        for (count, views) in pushed {
            schedule.push(count, views);
            expected.extend(std::iter::repeat_n(views, count));
        }
        assert_eq!(schedule.iter().collect::<Vec<_>>(), expected);
        assert!(expected.iter().enumerate().all(|(frame, views)| schedule.views(frame) == *views));
        assert_eq!((schedule.frames(), schedule.pairs(), schedule.most_views()), (10, 10, 2));
        assert_eq!((schedule.runs.len(), schedule.used()), (5, vec![0, 1]));
        assert_eq!((Schedule::default().frames(), Schedule::default().pairs()), (0, 0));
    }

    #[test]
    fn what_a_camera_of_its_own_for_every_frame_takes_is_counted() {
        for (frames, views) in [(1, 1), (1000, 1), (1025, 3), (70_000, 2)] {
            let mut schedule = Schedule::default();
            for frame in 0..frames {
                let of_frame: Vec<(u32, u32)> = (0..views).map(|view| (view, frame)).collect();
                schedule.push(1, &of_frame);
            }
            let held =
                schedule.runs.capacity() * size_of::<FrameRun>() + schedule.views.capacity() * size_of::<(u32, u32)>();
            // A vector begins with room for four.
            let counted = Schedule::bytes(frames.max(4).into(), views.into());
            assert!(held as u64 <= counted, "{frames} frames of {views}: {held} bytes, counted {counted}");
            assert!(schedule.runs.len() == frames as usize && counted <= 2 * (held as u64).max(96), "{held} {counted}");
        }
    }
}
