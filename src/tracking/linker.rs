//! Linking of frames in time order: finds which Gaussian of a frame continues which track (Gaussian followed through
//! frames).

use std::mem::size_of;

use rayon::prelude::*;

use super::appearance::ComparedAppearance;
use super::confidence::LinkConfidence;
use super::grid::CellGrid;
use super::links::Links;
use super::track::{Candidate, MAX_CANDIDATES, NONE, OpenTrack, ROUNDS};
use crate::model::Gaussians;

/// Maximum number of consecutive frames in which a track (Gaussian followed through frames) may have no Gaussian before
/// it ends.
pub const MAX_GAP_FRAMES: u32 = 3;
/// Parameters of the test whether a Gaussian has taken the place of a track (Gaussian followed through frames) that has
/// no Gaussian in this frame. The Gaussian passes the test if a cost is at most 1. The first parameter is the distance
/// from the expected position that adds 1 to the cost, in units of a size: the smaller one of the sizes of this
/// Gaussian and of the track's last Gaussian. The second is the factor by which the difference in appearance is
/// multiplied in the cost.
const SUCCESSION: (f32, f32) = (0.25, 1.0);
/// Minimum number of Gaussians of a frame for the detection of cuts (frames whose content is unrelated to the frame
/// before).
const MIN_FOR_CUT: usize = 16;

/// Linker of the Gaussians of successive frames into tracks (Gaussians followed through frames). It takes the frames
/// one by one in time order.
#[derive(Default)]
pub struct Linker {
    /// Tracks (Gaussians followed through frames) that may still continue, in the order of their numbers.
    tracks: Vec<OpenTrack>,
    born: u32,
}

/// Result of linking the Gaussians of one frame to tracks (Gaussians followed through frames).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameLinks {
    /// For every Gaussian the number of the track that it continues or begins.
    pub tracks: Vec<u32>,
    /// Number of Gaussians that continue a track and equal its last Gaussian bit by bit (exact repeats).
    pub repeated: usize,
    /// Number of Gaussians that continue a track of earlier frames, exact repeats included.
    pub linked: usize,
    /// Number of Gaussians whose link to a track was dropped because it was probably wrong. They begin new tracks.
    pub doubtful: usize,
    /// Whether this frame is a cut: its content is unrelated to the previous frame, so all tracks end before it.
    pub is_cut: bool,
}

impl Linker {
    /// Bytes of memory for each Gaussian of the frame that is being linked, not counting the frame itself.
    pub const BYTES_PER_GAUSSIAN: usize = 3 * size_of::<ComparedAppearance>() + 9 * size_of::<u32>();
    /// Bytes of memory for each open track (Gaussian followed through frames, which may continue). The list of tracks
    /// is counted twice, because it is copied when it grows.
    pub const BYTES_PER_TRACK: usize =
        2 * size_of::<OpenTrack>() + 2 * size_of::<u32>() + MAX_CANDIDATES * size_of::<Candidate>() + size_of::<f32>();

    /// Returns the number of open tracks: tracks (Gaussians followed through frames) that may still continue.
    pub fn open_track_count(&self) -> usize {
        self.tracks.len()
    }

    /// Returns the tracks (Gaussians followed through frames) that may still continue, in the order of their numbers.
    pub(super) fn open_tracks(&self) -> &[OpenTrack] {
        &self.tracks
    }

    /// Returns the number of tracks (Gaussians followed through frames) that have begun so far, including those that
    /// have ended.
    pub fn track_count(&self) -> u32 {
        self.born
    }

    /// Links the Gaussians of the next frame, `state`, to tracks (Gaussians followed through frames). Returns the track
    /// of every Gaussian, and how many Gaussians were linked. The result does not depend on the number of threads.
    pub fn link(&mut self, state: &Gaussians) -> FrameLinks {
        let appearances = ComparedAppearance::all_from_state(state);
        let mut links = Links {
            gaussian_of_track: vec![NONE; self.tracks.len()],
            track_of_gaussian: vec![NONE; appearances.len()],
        };
        links.add_repeats(&self.tracks, &appearances);
        let repeated = links.count();
        let mut confidence = LinkConfidence::new(self.tracks.len());
        for round in &ROUNDS {
            let candidates = links.add_round(&self.tracks, &appearances, round);
            confidence.add_round(&links, &candidates, (&self.tracks, &appearances), round);
        }
        let before = self.tracks.iter().filter(|track| track.frames_since_seen == 1).count();
        let fewer = before.min(appearances.len());
        let is_cut = fewer >= MIN_FOR_CUT && 4 * links.count() < fewer;
        if is_cut {
            self.tracks.clear();
            links = Links { gaussian_of_track: Vec::new(), track_of_gaussian: vec![NONE; appearances.len()] };
        }
        let doubtful = if is_cut { Vec::new() } else { confidence.drop_doubtful(&mut links) };
        let linked = links.count();
        let tracks = self.extend_tracks(&links, &appearances, &doubtful);
        FrameLinks { tracks, repeated: if is_cut { 0 } else { repeated }, linked, doubtful: doubtful.len(), is_cut }
    }

    /// Advances the open tracks (Gaussians followed through frames) by a frame. Returns the number of the track of
    /// every Gaussian; each Gaussian without a link begins a track.
    ///
    /// - `links`: links between the open tracks and the Gaussians of the frame.
    /// - `appearances`: appearance of every Gaussian of the frame.
    /// - `in_doubt`: Gaussians whose link was removed because it was probably wrong. The tracks that they begin are
    ///   marked ([`OpenTrack::is_in_doubt`]).
    fn extend_tracks(&mut self, links: &Links, appearances: &[ComparedAppearance], in_doubt: &[u32]) -> Vec<u32> {
        let mut track_numbers = vec![NONE; appearances.len()];
        let born = self.born;
        for track in self.succeeded_tracks(links, appearances) {
            self.tracks[track as usize].is_succeeded = true;
        }
        for (track, &gaussian) in self.tracks.iter_mut().zip(&links.gaussian_of_track) {
            if gaussian == NONE {
                track.frames_since_seen += 1;
            } else {
                track_numbers[gaussian as usize] = track.number;
                track.extend(appearances[gaussian as usize]);
            }
        }
        self.tracks.retain(|track| track.frames_since_seen <= MAX_GAP_FRAMES + 1);
        for (gaussian, track_number) in track_numbers.iter_mut().enumerate().filter(|(_, track)| **track == NONE) {
            *track_number = self.born;
            self.tracks.push(OpenTrack::new(self.born, appearances[gaussian]));
            self.born += 1;
        }
        let first = self.tracks.partition_point(|track| track.number < born);
        for &gaussian in in_doubt {
            self.tracks[first + (track_numbers[gaussian as usize] - born) as usize].is_in_doubt = true;
        }
        track_numbers
    }

    /// Finds the open tracks (Gaussians followed through frames) whose Gaussian another Gaussian has replaced, and
    /// returns their indices in `tracks`. `appearances` holds the appearances of all Gaussians of the frame. Such a
    /// track satisfies two conditions:
    /// - It had a Gaussian in the previous frame, but `links` gives it none in this frame.
    /// - A similar Gaussian is at its expected position.
    fn succeeded_tracks(&self, links: &Links, appearances: &[ComparedAppearance]) -> Vec<u32> {
        let is_newly_missing =
            |&i: &u32| links.gaussian_of_track[i as usize] == NONE && self.tracks[i as usize].frames_since_seen == 1;
        let newly_missing: Vec<u32> = (0..links.gaussian_of_track.len() as u32).filter(is_newly_missing).collect();
        if newly_missing.is_empty() || appearances.is_empty() {
            return Vec::new();
        }
        let (reach, strictness) = SUCCESSION;
        let grid = CellGrid::new(appearances, &Vec::from_iter(0..appearances.len() as u32), reach);
        let is_succeeded = |i: &u32| {
            let track = &self.tracks[*i as usize];
            let appearance = track.appearance.at(track.expected_position());
            let mut found = false;
            grid.for_each_near(&appearance, appearance.position, reach * appearance.size, |_, other| {
                found |= appearance.distance_cost(other, reach, strictness) <= 1.0;
            });
            found
        };
        newly_missing.into_par_iter().with_min_len(1024).filter(is_succeeded).collect()
    }
}
