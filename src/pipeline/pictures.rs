//! Which pictures of a rig to make: at which frame, by which camera, over what background.

use super::input::{Input, Scene};
use crate::error::{Error, Result};
use crate::model::{Columns, Gaussians, Rig, Split};
use crate::pass::FrameSource;
use crate::stream::gather;

/// The part of a rig's pictures that is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Part {
    /// The held-out pictures; of cameras that hold none out, every one.
    #[default]
    HeldOut,
    /// One split, which must not be empty.
    Split(Split),
    /// Every picture.
    All,
}

/// A picture to make.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Picture {
    /// Frame of the sequence.
    pub frame: usize,
    /// View number.
    pub view: u32,
    /// Index into [`Rig::cameras`].
    pub camera: usize,
    /// Index into [`Rig::shots`].
    pub shot: usize,
}

impl Picture {
    /// `tNNN_vNN`: frame and view, with more digits where they need them.
    pub fn name(&self) -> String {
        format!("t{:03}_v{:02}", self.frame, self.view)
    }
}

/// The pictures of `part`, by frame, then view.
///
/// # Errors
/// A picture at no frame's time; a split without pictures; two cameras that share frame and view, which
/// only splits of one numbering can.
pub fn pictures(rig: &Rig, frame_times: &[f64], part: Part) -> Result<Vec<Picture>> {
    let split = part.split(rig);
    let mut found = Vec::new();
    for (index, shot) in rig.shots.iter().enumerate() {
        if split.is_some_and(|split| split != shot.split) {
            continue;
        }
        let frames = match rig.frame_of(shot, frame_times)? {
            Some(frame) => frame..frame + 1,
            None => 0..frame_times.len(),
        };
        let camera = shot.camera as usize;
        found.extend(frames.map(|frame| Picture { frame, view: shot.view, camera, shot: index }));
    }
    found.sort_unstable_by_key(|picture| (picture.frame, picture.view, picture.shot));
    // Train and test files may both list a picture.
    found.dedup_by_key(|picture| (picture.frame, picture.view, picture.camera));
    if let Some(pair) = found.windows(2).find(|pair| (pair[0].frame, pair[0].view) == (pair[1].frame, pair[1].view)) {
        return Err(Error::usage(format!(
            "{}: two cameras are view {} at frame {}\n  choose one part with --split train or --split test",
            rig.origin, pair[0].view, pair[0].frame
        )));
    }
    if found.is_empty() {
        return Err(Error::usage(format!("{}: no picture in this split (--split)", rig.origin)));
    }
    Ok(found)
}

/// The picture of `view` at `frame`.
///
/// # Errors
/// As [`pictures`]; a frame that the sequence does not have, a view that does not see it.
pub fn picture(rig: &Rig, frame_times: &[f64], part: Part, frame: usize, view: u32) -> Result<Picture> {
    if frame >= frame_times.len() {
        let last = frame_times.len().saturating_sub(1);
        return Err(Error::usage(format!("--frame {frame}: expected 0 to {last}, the frames of this sequence")));
    }
    let here: Vec<Picture> =
        pictures(rig, frame_times, part)?.into_iter().filter(|picture| picture.frame == frame).collect();
    here.iter().find(|picture| picture.view == view).copied().ok_or_else(|| {
        let views: Vec<String> = here.iter().map(|picture| picture.view.to_string()).collect();
        let views = if views.is_empty() { "none".to_owned() } else { views.join(", ") };
        Error::usage(format!("--view {view}: expected a view of frame {frame}, which are {views} ({})", rig.origin))
    })
}

/// At most `count` (at least one) of the frames that `pictures` show, evenly from first to last: of K frames those
/// numbered round(i·(K − 1)/(count − 1)), halves to even, as numpy's `round(linspace(0, K - 1, count))`.
pub fn thin(pictures: Vec<Picture>, count: usize) -> Vec<Picture> {
    let count = count.max(1);
    let mut frames: Vec<usize> = pictures.iter().map(|picture| picture.frame).collect();
    frames.dedup();
    if count >= frames.len() {
        return pictures;
    }
    let step = (frames.len() - 1) as f64 / (count - 1).max(1) as f64;
    // Fewer than there are frames: steps above 1 never take one twice.
    let kept: Vec<usize> = (0..count).map(|i| frames[(i as f64 * step).round_ties_even() as usize]).collect();
    pictures.into_iter().filter(|picture| kept.binary_search(&picture.frame).is_ok()).collect()
}

/// Hands every frame's state and its pictures to `visit`, in order, no more pictures at once than there
/// are threads; each state is read once.
///
/// Memory: of each source twice the state of one frame.
pub fn for_each_batch<const S: usize>(
    sources: [&dyn FrameSource; S],
    pictures: &[Picture],
    mut visit: impl FnMut(&[Gaussians; S], &[Picture]) -> Result<()>,
) -> Result<()> {
    let ids = sources.map(|source| (0..source.info().count as u32).collect::<Vec<u32>>());
    for frame in pictures.chunk_by(|a, b| a.frame == b.frame) {
        let mut states: [Gaussians; S] = std::array::from_fn(|_| Gaussians::default());
        for ((state, source), ids) in states.iter_mut().zip(sources).zip(&ids) {
            *state = gather(source, ids, frame[0].frame, Columns::ALL)?;
        }
        for batch in frame.chunks(rayon::current_num_threads()) {
            visit(&states, batch)?;
        }
    }
    Ok(())
}

/// Colour behind a scene: the one asked for, else the cameras' own, else the one a model was trained
/// with, else black.
///
/// # Errors
/// A colour that is not from 0 to 1.
pub fn background(asked: Option<[f32; 3]>, scene: &Scene) -> Result<[f32; 3]> {
    if let Some(rgb) = asked.filter(|rgb| rgb.iter().any(|c| !(0.0..=1.0).contains(c))) {
        return Err(Error::usage(format!("--background: expected red, green, blue from 0 to 1, found {rgb:?}")));
    }
    let trained = match &scene.input {
        Input::Model(model) if model.config().white_background => Some([1.0; 3]),
        _ => None,
    };
    Ok(asked.or(scene.rig.background).or(trained).unwrap_or([0.0; 3]))
}

impl Part {
    /// The split it comes to with these cameras; none: every picture.
    fn split(self, rig: &Rig) -> Option<Split> {
        match self {
            Part::HeldOut => Some(Split::Test).filter(|_| rig.shots.iter().any(|shot| shot.split == Split::Test)),
            Part::Split(split) => Some(split),
            Part::All => None,
        }
    }
}
