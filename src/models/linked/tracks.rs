//! Assigns the Gaussians of all PLY files to tracks (Gaussians followed through frames), and computes the state of
//! every track at every frame.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use gseq::Compression;

use super::memory::Sizes;
use super::steady::{HeldMeans, Steady};
use crate::cache::{Spill, SpillWriter};
use crate::error::{Result, ShowPath};
use crate::files::ply::{Ply, PlyOptions};
use crate::files::ply_frames::PlyFrames;
use crate::model::{Attributes, Gaussians, SequenceInfo};
use crate::outputs::container::{BlockChange, ContainerWriter, GAUSSIAN_BLOCK};
use crate::progress::Events;
use crate::source::{BlockReader, FrameSource, Ids};
use crate::tracking::{Joiner, Linker, blend_rows};

/// Opacity logit of a track (Gaussian followed through frames) in frames where it is absent; the opacity is then
/// 4·10⁻¹⁸.
const ABSENT_LOGIT: f32 = -40.0;

/// Row of a Gaussian in the file of a frame, and the track (Gaussian followed through frames) to which it belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct TrackedRow {
    pub(super) track: u32,
    pub(super) row: u32,
}

/// Place of a track (Gaussian followed through frames) in one frame: number of the frame, and row in the file of that
/// frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct TrackPosition {
    pub(super) frame: u32,
    row: u32,
}

/// Frames, and the track (Gaussian followed through frames) to which each Gaussian of each frame belongs. If tracks are
/// joined, several Gaussians of a frame may belong to one track.
pub(super) struct LinkedTracks {
    frames: PlyFrames,
    count: usize,
    /// Number of tracks (Gaussians followed through frames) that may continue in the next frame: the maximum over all
    /// frames, before tracks are joined.
    live_tracks: usize,
    /// For each track that linking found: index of the joined track to which it belongs. Tracks that seem to be the
    /// same Gaussian are joined to one. `None` if no tracks are joined.
    joined: Option<Vec<u32>>,
    /// Attributes that are constant along tracks (Gaussians followed through frames), with their values; `None` if
    /// there are none.
    steady: Option<Steady>,
    /// For each track that linking found (before joining): its first frame, and the row of its Gaussian in the file of
    /// this frame.
    births: Vec<TrackPosition>,
    /// For every Gaussian, frame by frame: index of the track (Gaussian followed through frames) to which linking
    /// assigned it, before tracks are joined.
    track_of_rows: Spill,
    /// Index in `track_of_rows` of the first entry of each frame, followed by the total number of entries.
    starts: Vec<u64>,
}

/// Number of frames in which each track (Gaussian followed through frames) is present, and the frames in which several
/// Gaussians of one track have to be blended.
pub(super) struct TrackLengths {
    /// Number of frames in which each track (Gaussian followed through frames) is present, by index of the track.
    frames_per_track: Vec<u32>,
    /// Indices of the frames in which a joined track has several Gaussians, which are blended into one. A joined track
    /// consists of tracks (Gaussians followed through frames) that seem to be the same Gaussian.
    pub(super) blended: Vec<u32>,
}

impl TrackLengths {
    /// Returns the median length of a track (Gaussian followed through frames): the number of frames in which it is
    /// present.
    pub(super) fn median(mut self) -> u32 {
        let middle = self.frames_per_track.len() / 2;
        if self.frames_per_track.is_empty() { 0 } else { *self.frames_per_track.select_nth_unstable(middle).1 }
    }
}

/// Counts from linking Gaussians into tracks (Gaussians followed through frames), for notes to the user.
pub(super) struct LinkingResult {
    /// Number of Gaussians in all frames together, before linking.
    states: u64,
    /// Indices of the frames that begin a new scene: no track (Gaussian followed through frames) continues into them.
    cuts: Vec<usize>,
    /// Number of links between Gaussians of different frames that were ambiguous and therefore not made.
    doubtful: usize,
}

impl LinkingResult {
    /// Returns notes for the user about the linking of Gaussians across frames, and about the resulting `tracks`
    /// (Gaussians followed through frames).
    ///
    /// # Errors
    /// Fails if a read fails.
    pub(super) fn notes(&self, tracks: &LinkedTracks) -> Result<Vec<String>> {
        let mut notes = vec![format!(
            "{} Gaussians in {} frames are {} tracks with a median length of {} frames",
            self.states,
            tracks.frames.paths().len(),
            tracks.count,
            tracks.lengths()?.median()
        )];
        if self.doubtful > 0 {
            notes.push(format!("{} links were ambiguous and not made: each begins a new track instead", self.doubtful));
        }
        if let Some(&first) = self.cuts.first() {
            let name = tracks.frames.shown_paths()[first].file_name().unwrap_or_default().shown();
            notes.push(match self.cuts.len() {
                1 => format!("a cut at {name}: it shows nothing of the frame before, so all tracks end there"),
                cuts => format!(
                    "{cuts} cuts, the first at {name}: these frames show nothing of the frame before, so \
                                 all tracks end there"
                ),
            });
        }
        Ok(notes)
    }
}

impl LinkedTracks {
    /// Links the Gaussians of `frames`, which messages call `name`, into tracks (Gaussians followed through frames).
    /// Shows each frame to `joiner`, which looks for different tracks of the same Gaussian. Returns the tracks, counts
    /// for notes to the user, and the linker.
    ///
    /// # Errors
    /// Fails if a frame cannot be read, if linking needs more memory than `options` allow, or if a write fails.
    pub(super) fn link(
        frames: PlyFrames,
        name: &Path,
        mut joiner: Option<&mut Joiner>,
        options: &PlyOptions,
    ) -> Result<(LinkedTracks, LinkingResult, Linker)> {
        let scratch = &*options.scratch;
        let of_frame = frames.gaussian_counts().iter().copied().max().unwrap_or(0);
        let (mut linker, mut live_tracks) = (Linker::default(), 0);
        let (mut births, mut cuts, mut doubtful) = (Vec::new(), Vec::new(), 0);
        let (mut track_writer, mut starts, mut end) = (SpillWriter::new(scratch)?, vec![0], 0);
        let mut state = Gaussians::zeros(0, frames.sh_degree());
        let progress = options.events.task("link", "frames", frames.paths().len() as u64);
        for frame in 0..frames.paths().len() {
            // Before a frame is read, assume at least as many tracks as the frame has Gaussians.
            let linked = births.len().max(of_frame as usize) as u64;
            let sizes = Sizes {
                frame_gaussians: of_frame.into(),
                sh_degree: frames.sh_degree(),
                linked,
                live_tracks: live_tracks as u64,
            };
            options.memory.check(name, &format!("frame {frame}"), "linking the frames", sizes.opening())?;
            let ply = frames.frame(frame)?;
            ply.gather_range(0..ply.count(), Attributes::all(), &mut state)?;
            let linked = linker.link(&state);
            live_tracks = live_tracks.max(linker.open_track_count());
            if let Some(joiner) = &mut joiner {
                joiner.add_frame(&linker);
            }
            if linked.is_cut {
                cuts.push(frame);
            }
            doubtful += linked.doubtful;
            for (row, &track) in linked.tracks.iter().enumerate() {
                // New tracks are numbered in the order of their rows in the frame.
                if track as usize == births.len() {
                    births.push(TrackPosition { frame: frame as u32, row: row as u32 });
                }
            }
            track_writer.write(bytemuck::cast_slice(&linked.tracks))?;
            end += linked.tracks.len() as u64;
            starts.push(end);
            progress.advance(1);
        }
        let tracks = LinkedTracks {
            count: births.len(),
            live_tracks,
            frames,
            joined: None,
            steady: None,
            births,
            track_of_rows: track_writer.finish()?,
            starts,
        };
        Ok((tracks, LinkingResult { states: end, cuts, doubtful }, linker))
    }

    /// Joins the linked tracks (Gaussians followed through frames), so that `count` tracks remain. Entry i of
    /// `joined_tracks` is the index of the joined track to which the linked track i belongs.
    pub(super) fn join(&mut self, joined_tracks: Vec<u32>, count: usize) {
        (self.joined, self.count) = (Some(joined_tracks), count);
    }

    /// Sets which attributes are constant along tracks (Gaussians followed through frames), and their values. `None`
    /// makes all attributes vary.
    pub(super) fn set_steady(&mut self, steady: Option<Steady>) {
        self.steady = steady;
    }

    /// Returns the attributes that are constant along tracks (Gaussians followed through frames), with their values;
    /// `None` if there are none.
    pub(super) fn steady(&self) -> Option<&Steady> {
        self.steady.as_ref()
    }

    /// Undoes [`LinkedTracks::join`]: the tracks (Gaussians followed through frames) are separate again.
    pub(super) fn undo_join(&mut self) {
        (self.joined, self.count) = (None, self.births.len());
    }

    /// Counts the frames in which each track (Gaussian followed through frames) is present. Returns the counts, and the
    /// frames that have several Gaussians of one track.
    ///
    /// # Errors
    /// Fails if a read fails.
    pub(super) fn lengths(&self) -> Result<TrackLengths> {
        let mut lengths = TrackLengths { frames_per_track: vec![0; self.count], blended: Vec::new() };
        let mut last = vec![u32::MAX; self.count];
        for frame in 0..self.frames.paths().len() {
            let mut is_blended = false;
            for track in self.tracks_in_frame(frame)? {
                let before = std::mem::replace(&mut last[track as usize], frame as u32);
                is_blended |= before == frame as u32;
                lengths.frames_per_track[track as usize] += u32::from(before != frame as u32);
            }
            if is_blended {
                lengths.blended.push(frame as u32);
            }
        }
        Ok(lengths)
    }

    /// Returns for each Gaussian of frame `frame` the index of its track (Gaussian followed through frames), in the
    /// order of the Gaussians in the file.
    fn tracks_in_frame(&self, frame: usize) -> Result<Vec<u32>> {
        let mut tracks = vec![0u32; (self.starts[frame + 1] - self.starts[frame]) as usize];
        self.track_of_rows.read(4 * self.starts[frame], bytemuck::cast_slice_mut(&mut tracks))?;
        if let Some(joined) = &self.joined {
            tracks.iter_mut().for_each(|track| *track = joined[*track as usize]);
        }
        Ok(tracks)
    }

    /// Returns for each track (Gaussian followed through frames) the first frame in which it is present, and its row in
    /// the file of that frame. Tracks are in the order of their first frames.
    pub(super) fn first(&self) -> Vec<TrackPosition> {
        match &self.joined {
            None => self.births.clone(),
            // Joined tracks are numbered in the order of their first frames.
            Some(joined) => {
                let mut first = Vec::with_capacity(self.count);
                for (&track, &birth) in joined.iter().zip(&self.births) {
                    if track as usize == first.len() {
                        first.push(birth);
                    }
                }
                first
            }
        }
    }

    /// Returns the counts of Gaussians and tracks (Gaussians followed through frames) from which memory is estimated.
    pub(super) fn sizes(&self) -> Sizes {
        Sizes {
            frame_gaussians: self.frames.gaussian_counts().iter().copied().max().unwrap_or(0).into(),
            sh_degree: self.frames.sh_degree(),
            linked: self.births.len() as u64,
            live_tracks: self.live_tracks as u64,
        }
    }

    /// Returns the PLY files of the frames.
    pub(super) fn frames(&self) -> &PlyFrames {
        &self.frames
    }

    /// Returns the number of tracks (Gaussians followed through frames); if tracks are joined, the number of joined
    /// ones.
    pub(super) fn count(&self) -> usize {
        self.count
    }

    /// Returns the Gaussians of frame `frame` whose tracks (Gaussians followed through frames) have an index in
    /// `tracks`: the track and the row in the file of the frame, sorted by track.
    pub(super) fn rows(&self, frame: usize, tracks: Range<usize>) -> Result<Vec<TrackedRow>> {
        let rows = self.tracks_in_frame(frame)?.into_iter().enumerate();
        let rows = rows.map(|(row, track)| TrackedRow { track, row: row as u32 });
        let mut rows: Vec<TrackedRow> = rows.filter(|row| tracks.contains(&(row.track as usize))).collect();
        rows.sort_unstable();
        Ok(rows)
    }

    /// Reads the Gaussians `rows`, which are sorted by track, from `file`, the file of a frame. Row i of `state`
    /// receives the Gaussian `rows[i]`. If a track (Gaussian followed through frames) has several Gaussians in the
    /// frame, they are blended into the first of these rows. Returns for each track the index in `rows` of its first
    /// Gaussian.
    ///
    /// # Errors
    /// Fails if a read fails.
    pub(super) fn blended(&self, file: &Ply, rows: &[TrackedRow], state: &mut Gaussians) -> Result<Vec<usize>> {
        let of_file: Vec<u32> = rows.iter().map(|row| row.row).collect();
        file.gather(&Ids::List(&of_file), Attributes::all(), state)?;
        let mut firsts = Vec::with_capacity(rows.len());
        let mut at = 0;
        for of_track in rows.chunk_by(|a, b| a.track == b.track) {
            if of_track.len() > 1 {
                blend_rows(state, &Vec::from_iter(at..at + of_track.len()));
            }
            firsts.push(at);
            at += of_track.len();
        }
        Ok(firsts)
    }

    /// Returns the state that each track (Gaussian followed through frames) of `rows` has in the frame stored in
    /// `file`. `rows` are sorted by track. Gaussians of one track are blended, and constant attributes are set to their
    /// means.
    ///
    /// # Errors
    /// Fails if a read fails.
    pub(super) fn states(&self, file: &Ply, rows: &[TrackedRow]) -> Result<Gaussians> {
        let mut state = Gaussians::zeros(0, self.frames.sh_degree());
        let firsts = self.blended(file, rows, &mut state)?;
        let mut states = state.pick(&firsts.iter().map(|&first| first as u32).collect::<Vec<u32>>());
        if let Some(steady) = &self.steady {
            let tracks: Vec<u32> = firsts.iter().map(|&first| rows[first].track).collect();
            steady.means(&tracks)?.write_to((0..tracks.len()).map(|at| (at, at)), &mut states);
        }
        Ok(states)
    }

    /// Writes the states of all tracks (Gaussians followed through frames) at all frames to the container `path`.
    /// Tracks are in the order of their first frames, so tracks with neighboring indices are often absent from the same
    /// frames. If all tracks of a block of tracks are absent from several successive blocks of frames, they are encoded
    /// only for the first of these blocks.
    pub(super) fn pack(&self, path: &Path, events: &Events) -> Result<()> {
        let mut previous_positions = self.first();
        let (times, degree) = (self.frames.times(), self.frames.sh_degree());
        let compression = Compression::Zstd(1);
        let together = self.sizes().frame_block();
        let mut writer = ContainerWriter::create(path, self.count, degree, together, compression, BTreeMap::new())?;
        let progress = events.task("pack", "frames", times.len() as u64);
        let mut was_still = vec![false; self.count.div_ceil(GAUSSIAN_BLOCK)];
        for start in (0..times.len()).step_by(together) {
            let of_block = start..times.len().min(start + together);
            let files: Vec<Ply> = of_block.clone().map(|frame| self.frames.frame(frame)).collect::<Result<_>>()?;
            let rows: Vec<Vec<TrackedRow>> =
                of_block.clone().map(|frame| self.rows(frame, 0..self.count)).collect::<Result<_>>()?;
            let mut changes: Vec<BlockChange> = was_still
                .iter()
                .map(|&still| if still { BlockChange::Repeating } else { BlockChange::Still })
                .collect();
            for row in rows.iter().flatten() {
                changes[row.track as usize / GAUSSIAN_BLOCK] = BlockChange::New;
            }
            let info = SequenceInfo {
                count: self.count,
                times: times[of_block.clone()].to_vec(),
                sh_degree: degree,
                varying: Attributes::all(),
            };
            let block = FrameBlock {
                info,
                tracks: self,
                start,
                files: &files,
                rows: &rows,
                previous_positions: &previous_positions,
            };
            writer.append_with_changes(&block, 0..of_block.len(), &times[of_block.clone()], &changes)?;
            for (frame, rows) in of_block.clone().zip(&rows) {
                for row in rows {
                    previous_positions[row.track as usize] = TrackPosition { frame: frame as u32, row: row.row };
                }
            }
            was_still = changes.iter().map(|change| *change != BlockChange::New).collect();
            progress.advance(of_block.len() as u64);
        }
        writer.finish()
    }
}

/// States of all tracks (Gaussians followed through frames) at the frames of one frame block, from which the container
/// is written.
struct FrameBlock<'a> {
    info: SequenceInfo,
    tracks: &'a LinkedTracks,
    /// Index of the first frame of this block of consecutive frames.
    start: usize,
    files: &'a [Ply],
    /// For each frame of the block: row in the frame's file and track of every Gaussian, sorted by track (Gaussian
    /// followed through frames).
    rows: &'a [Vec<TrackedRow>],
    /// For each track (Gaussian followed through frames): frame and row of the Gaussian that gives its state just
    /// before this frame block. There are two cases:
    /// - The track has a Gaussian before the block: the last such Gaussian.
    /// - The track begins in the block or after it: the first Gaussian of the track.
    previous_positions: &'a [TrackPosition],
}

impl FrameSource for FrameBlock<'_> {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        let ids: Vec<usize> = ids.iter().collect();
        let range = ids.first().map_or(0..0, |&first| first..first + ids.len());
        let tracks: Vec<u32> = range.clone().map(|track| track as u32).collect();
        let means = self.tracks.steady.as_ref().map(|steady| steady.means(&tracks)).transpose()?;
        let [state, part] = [range.len(), 0].map(|len| Gaussians::zeros(len, self.info.sh_degree));
        let mut reader = TrackReader { block: self, range, next: 0, means, state, part };
        reader.begin()?;
        Ok(Box::new(reader))
    }
}

impl FrameBlock<'_> {
    /// Writes to `state` the states that the tracks of `range` (Gaussians followed through frames) have just before the
    /// first frame of this block of frames. A track that begins in this block or after it gets its first state.
    fn hold(&self, range: Range<usize>, state: &mut Gaussians) -> Result<()> {
        let mut by_frame: Vec<(TrackPosition, usize)> =
            self.previous_positions[range].iter().enumerate().map(|(i, &at)| (at, i)).collect();
        by_frame.sort_by_key(|(at, i)| (at.frame, *i));
        let mut part = Gaussians::zeros(0, self.info.sh_degree);
        for of_frame in by_frame.chunk_by(|(a, _), (b, _)| a.frame == b.frame) {
            let frame = of_frame[0].0.frame as usize;
            let rows: Vec<u32> = of_frame.iter().map(|(at, _)| at.row).collect();
            let opened;
            let ply = match frame.checked_sub(self.start).and_then(|at| self.files.get(at)) {
                Some(ply) => ply,
                None => {
                    opened = self.tracks.frames.frame(frame)?;
                    &opened
                }
            };
            ply.gather(&Ids::List(&rows), Attributes::all(), &mut part)?;
            scatter(&part, of_frame.iter().map(|&(_, i)| i).enumerate(), state);
        }
        Ok(())
    }
}

/// Reader of the states of consecutive tracks (Gaussians followed through frames), frame by frame.
struct TrackReader<'a> {
    block: &'a FrameBlock<'a>,
    range: Range<usize>,
    /// Index, within its block of consecutive frames, of the next frame that the reader copies to `state`.
    next: usize,
    /// Values of the attributes that are constant along the tracks (Gaussians followed through frames) of `range`;
    /// `None` if there are none.
    means: Option<HeldMeans>,
    state: Gaussians,
    part: Gaussians,
}

impl TrackReader<'_> {
    /// Resets the reader to the beginning of its block of frames: sets `state` to the states that its tracks (Gaussians
    /// followed through frames) have just before the first frame of the block.
    fn begin(&mut self) -> Result<()> {
        self.block.hold(self.range.clone(), &mut self.state)?;
        if let Some(means) = &self.means {
            means.write_to((0..self.range.len()).map(|at| (at, at)), &mut self.state);
        }
        self.next = 0;
        Ok(())
    }
}

impl BlockReader for TrackReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        if frame + 1 < self.next {
            self.begin()?;
        }
        while self.next <= frame {
            let rows = &self.block.rows[self.next];
            let first = rows.partition_point(|row| (row.track as usize) < self.range.start);
            let rows = &rows[first..];
            let rows = &rows[..rows.partition_point(|row| (row.track as usize) < self.range.end)];
            self.state.opacity_logit.planes_mut().fill(ABSENT_LOGIT);
            let firsts = self.block.tracks.blended(&self.block.files[self.next], rows, &mut self.part)?;
            let place = |first: usize| rows[first].track as usize - self.range.start;
            scatter(&self.part, firsts.iter().map(|&first| (first, place(first))), &mut self.state);
            if let Some(means) = &self.means {
                means.write_to(firsts.iter().map(|&first| (place(first), place(first))), &mut self.state);
            }
            self.next += 1;
        }
        for column in want.iter() {
            out.attribute_values_mut(column).clone_from(self.state.attribute_values(column));
        }
        Ok(())
    }
}

/// Copies rows of `part` to `state`. Each pair of `places` is the index of a row of `part` and the index of the row of
/// `state` that it replaces.
fn scatter(part: &Gaussians, places: impl Iterator<Item = (usize, usize)> + Clone, state: &mut Gaussians) {
    for column in Attributes::all().iter() {
        let (from, to) = (part.attribute_values(column), state.attribute_values_mut(column));
        for c in 0..to.width() {
            let (from, to) = (from.plane(c), to.plane_mut(c));
            places.clone().for_each(|(row, place)| to[place] = from[row]);
        }
    }
}
