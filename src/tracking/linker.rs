//! Frames one after the other, and the tracks that go through them.

use std::mem::size_of;

use rayon::prelude::*;

use super::grid::CellGrid;
use super::links::Links;
use super::look::ComparedAppearance;
use super::track::{NAMED, NONE, Offer, OpenTrack, ROUNDS};
use super::trust::LinkConfidence;
use crate::model::Gaussians;

/// Frames that a track may be missing from before it ends.
pub const GAP: u32 = 3;
/// r and q of the [module](super) of what a track that is missed was succeeded by.
const BESIDE: (f32, f32) = (0.25, 1.0);
/// Of fewer, those that go on tell nothing of a cut.
const FEWEST: usize = 16;

/// Links frames that come one after the other.
#[derive(Default)]
pub struct Linker {
    /// Those that may go on, by their numbers.
    tracks: Vec<OpenTrack>,
    born: u32,
}

/// What became of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameLinks {
    /// The track of every Gaussian.
    pub tracks: Vec<u32>,
    /// How many go on by repeating to the bit.
    pub repeated: usize,
    /// How many go on in all.
    pub linked: usize,
    /// How many would go on, but nobody can tell as which: they begin new tracks.
    pub doubtful: usize,
    /// Whether the frame before shows something else, so that nothing goes on.
    pub is_cut: bool,
}

impl Linker {
    /// Bytes for each Gaussian of the frame that is linked, beside the frame.
    pub const BYTES_PER_GAUSSIAN: usize = 3 * size_of::<ComparedAppearance>() + 9 * size_of::<u32>();
    /// Bytes for each track that may go on, in a list that grows by being copied to twice its length.
    pub const BYTES_PER_TRACK: usize =
        2 * size_of::<OpenTrack>() + 2 * size_of::<u32>() + NAMED * size_of::<Offer>() + size_of::<f32>();

    /// How many tracks may go on.
    pub fn may_go_on(&self) -> usize {
        self.tracks.len()
    }

    /// Those that may go on, by their numbers.
    pub(super) fn living(&self) -> &[OpenTrack] {
        &self.tracks
    }

    /// How many tracks there are so far.
    pub fn tracks(&self) -> u32 {
        self.born
    }

    /// Links the next frame. The same for any number of threads.
    pub fn link(&mut self, state: &Gaussians) -> FrameLinks {
        let looks = ComparedAppearance::of_all(state);
        let mut links = Links { of_track: vec![NONE; self.tracks.len()], of_point: vec![NONE; looks.len()] };
        links.take_repeats(&self.tracks, &looks);
        let repeated = links.count();
        let mut trust = LinkConfidence::new(self.tracks.len());
        for round in &ROUNDS {
            let named = links.take(&self.tracks, &looks, round);
            trust.weigh(&links, &named, (&self.tracks, &looks), round);
        }
        let before = self.tracks.iter().filter(|track| track.ago == 1).count();
        let fewer = before.min(looks.len());
        let is_cut = fewer >= FEWEST && 4 * links.count() < fewer;
        if is_cut {
            self.tracks.clear();
            links = Links { of_track: Vec::new(), of_point: vec![NONE; looks.len()] };
        }
        let doubtful = if is_cut { Vec::new() } else { trust.give_up(&mut links) };
        let linked = links.count();
        let tracks = self.go_on(&links, &looks, &doubtful);
        FrameLinks { tracks, repeated: if is_cut { 0 } else { repeated }, linked, doubtful: doubtful.len(), is_cut }
    }

    /// Moves the tracks on by a frame; gives that of every Gaussian. Of those `in_doubt` tracks begin.
    fn go_on(&mut self, links: &Links, looks: &[ComparedAppearance], in_doubt: &[u32]) -> Vec<u32> {
        let mut of_points = vec![NONE; looks.len()];
        let born = self.born;
        for track in self.succeeded(links, looks) {
            self.tracks[track as usize].is_succeeded = true;
        }
        for (track, &point) in self.tracks.iter_mut().zip(&links.of_track) {
            if point == NONE {
                track.ago += 1;
            } else {
                of_points[point as usize] = track.number;
                track.see(looks[point as usize]);
            }
        }
        self.tracks.retain(|track| track.ago <= GAP + 1);
        for (point, of_point) in of_points.iter_mut().enumerate().filter(|(_, track)| **track == NONE) {
            *of_point = self.born;
            self.tracks.push(OpenTrack::begin(self.born, looks[point]));
            self.born += 1;
        }
        let first = self.tracks.partition_point(|track| track.number < born);
        for &point in in_doubt {
            self.tracks[first + (of_points[point as usize] - born) as usize].is_in_doubt = true;
        }
        of_points
    }

    /// Those that are missed for the first time while another is where they are expected and looks like them.
    fn succeeded(&self, links: &Links, looks: &[ComparedAppearance]) -> Vec<u32> {
        let is_missed = |&i: &u32| links.of_track[i as usize] == NONE && self.tracks[i as usize].ago == 1;
        let missed: Vec<u32> = (0..links.of_track.len() as u32).filter(is_missed).collect();
        if missed.is_empty() || looks.is_empty() {
            return Vec::new();
        }
        let (reach, strictness) = BESIDE;
        let grid = CellGrid::new(looks, &Vec::from_iter(0..looks.len() as u32), reach);
        let is_succeeded = |i: &u32| {
            let track = &self.tracks[*i as usize];
            let look = track.look.at(track.expected());
            let mut found = false;
            grid.near(&look, look.position, reach * look.size, |_, other| {
                found |= look.apart(other, reach, strictness) <= 1.0;
            });
            found
        };
        missed.into_par_iter().with_min_len(1024).filter(is_succeeded).collect()
    }
}
