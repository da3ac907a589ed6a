//! Writer of `.tsog` files.

use std::path::Path;

use super::{
    OriginalTimes, PROFILE, Playback, Profile, Temporal, TimedGaussians, Timeline, TimelineEntry, TsogMeta, VERSION,
    Velocity, codes_per_frame,
};
use crate::error::{Error, Result, ShowPath};
use crate::files::accuracy::check_positions;
use crate::files::ftgs::{LOG_TIME_DEVIATION, TIME_CENTER, VELOCITY};
use crate::files::sog::images::{ImageSize, Range3, encode_16_bit, morton_order};
use crate::files::sog::write::{NamedImages, SogErrors, encode, write_archive};
use crate::model::{StoredParams, logit, opacity};

/// Largest standard deviation of a time window that is stored, as a multiple of the length of the sequence. Wider
/// windows are replaced by windows of this width, which changes the opacity by at most 1/500 of its value. With a
/// larger limit, the 65536 steps of the stored deviation would be too coarse for narrow windows.
const MAX_DEVIATION: f64 = 8.0;
/// Largest opacity that a Gaussian gets when its time window is narrowed. It is below 1, so that its logit is finite.
const MAX_OPACITY: f64 = 1.0 - 1e-6;
/// Maximum number of frames of a timeline of type 0, in which each Gaussian is seen in a single frame.
pub const MAX_FRAMES: usize = 1 << 16;
/// Maximum position errors that rounding velocities to 8 bits may cause; if one of them is exceeded, velocities are
/// stored with 16 bits. The first number is the root of the mean squared error over all Gaussians, the second the
/// largest error. The unit is the middle one of a Gaussian's three scales.
const MAX_8_BIT_ERRORS: [f64; 2] = [0.03, 0.25];

/// Writes `content` to a `.tsog` file at `path`, in Morton order. The bytes depend only on `content`. Returns the
/// largest errors of the stored values.
///
/// # Errors
/// Fails if there are no Gaussians, or more than the images can hold; if there are too many frames; if a position is
/// not finite; if stored values would exceed the error bounds of [`accuracy`](crate::files::accuracy); or if writing
/// fails.
pub fn write_tsog(content: &TimedGaussians, path: &Path) -> Result<SogErrors> {
    let count = content.params.len();
    let refused = |what: String| Error::usage(format!("{}: {what}", path.shown()));
    if count == 0 {
        return Err(refused("a .tsog needs at least one visible Gaussian".to_owned()));
    }
    let size = ImageSize::for_count(count).ok_or_else(|| refused(format!("{count} Gaussians are too many")))?;
    let params = if content.timeline == Timeline::Windows { narrowed(&content.params) } else { content.params.clone() };
    check_positions(&params.gaussians, path, "a .tsog")?;
    let order = morton_order(&params.gaussians.position);
    let (mut sog, mut images, errors) = encode(&params.gaussians, size, &order, "a .tsog")?;
    sog.version = VERSION;
    let clip = content.clip;
    let (timeline, temporal, frames) = match content.timeline {
        Timeline::Still => (None, None, 1),
        Timeline::Frames(frames) if frames > MAX_FRAMES => {
            return Err(refused(format!("{frames} frames do not fit a .tsog, which has at most {MAX_FRAMES}")));
        }
        Timeline::Frames(frames) => (Some(encode_frames(&params, frames, size, &order, &mut images)), None, frames),
        Timeline::Windows => {
            let timeline = encode_windows(&params, size, &order, &mut images);
            let temporal = encode_velocities(&params, size, &order, &mut images);
            // The first frame of a sequence is at the time 0, the last one at 1.
            (Some(timeline), temporal, clip.frames.unwrap_or(super::DEFAULT_FRAMES).max(2) - 1)
        }
    };
    let is_mapped = (clip.first, clip.last) != (0.0, 1.0);
    let meta = TsogMeta {
        sog,
        profile: Some(Profile { id: PROFILE.to_owned(), version: 1 }),
        timeline,
        temporal,
        fps: Some(clip.frame_rate),
        playback: Some(Playback { duration: Some(frames as f64 / clip.frame_rate), fps: Some(clip.frame_rate) }),
        splatsieve: is_mapped.then_some(OriginalTimes { times: [clip.first, clip.last] }),
    };
    write_archive(path, images, &meta)?;
    Ok(errors)
}

/// Returns the Gaussians `params` with time windows whose standard deviation is at most [`MAX_DEVIATION`]. A wider
/// window becomes a window with this deviation. Its center and the opacity are chosen so that the opacity in the middle
/// of the sequence, and the slope of its logarithm there, stay the same. The path of the Gaussian does not change.
fn narrowed(params: &StoredParams) -> StoredParams {
    let mut params = params.clone();
    for row in 0..params.len() {
        let own = |plane: usize| f64::from(params.format_specific.plane(plane)[row]);
        let (center, deviation) = (own(TIME_CENTER), own(LOG_TIME_DEVIATION).exp());
        if deviation <= MAX_DEVIATION {
            continue;
        }
        let exponent = |center: f64, deviation: f64| -0.5 * ((0.5 - center) / deviation).powi(2);
        let moved = 0.5 - (0.5 - center) * (MAX_DEVIATION / deviation).powi(2);
        let factor = (exponent(center, deviation) - exponent(moved, MAX_DEVIATION)).exp();
        let alpha = (factor * opacity(params.gaussians.opacity_logit.row::<1>(row)[0])).min(MAX_OPACITY);
        let velocity = [0, 1, 2].map(|c| own(VELOCITY + c));
        let at = params.gaussians.position.row::<3>(row);
        let place = [0, 1, 2].map(|c| (f64::from(at[c]) + velocity[c] * (moved - center)) as f32);
        params.gaussians.position.set_row(row, place);
        params.gaussians.opacity_logit.set_row(row, [logit(alpha) as f32]);
        params.format_specific.plane_mut(TIME_CENTER)[row] = moved as f32;
        params.format_specific.plane_mut(LOG_TIME_DEVIATION)[row] = MAX_DEVIATION.ln() as f32;
    }
    params
}

/// Adds two images of size `size` to `images` that hold the frame in which each Gaussian of `params` is seen, and
/// returns the member `timeline` of `meta.json`. The sequence has `frames` frames. Pixel i holds the Gaussian
/// `order[i]`.
fn encode_frames(
    params: &StoredParams,
    frames: usize,
    size: ImageSize,
    order: &[u32],
    images: &mut NamedImages,
) -> TimelineEntry {
    let delta = codes_per_frame(frames);
    let pair = encode_16_bit(size, order, |row| {
        let frame = params.format_specific.plane(0)[row] as usize;
        // The middle of the codes of a frame, so that rounding in a player cannot reach another frame.
        [(frame * delta + delta / 2) as u16, 0, 0]
    });
    let files = add_pair(images, "timeline", pair);
    TimelineEntry { kind: 0, frames: Some(frames as u64), delta: Some(delta as u64), mins: None, maxs: None, files }
}

/// Adds two images of size `size` to `images` that hold the time window of each Gaussian of `params`, and returns the
/// member `timeline` of `meta.json`. Pixel i holds the Gaussian `order[i]`.
fn encode_windows(params: &StoredParams, size: ImageSize, order: &[u32], images: &mut NamedImages) -> TimelineEntry {
    let window = |row: usize| {
        let deviation =
            f64::from(params.format_specific.plane(LOG_TIME_DEVIATION)[row]).exp().max(f64::from(f32::MIN_POSITIVE));
        [f64::from(params.format_specific.plane(TIME_CENTER)[row]), deviation, 0.0]
    };
    let range = Range3::from_rows((0..params.len()).map(window));
    let pair = encode_16_bit(size, order, |row| {
        let values = window(row);
        [range.encode(0, values[0]), range.encode(1, values[1]), 0]
    });
    let files = add_pair(images, "timeline", pair);
    let [mins, maxs] = [range.mins, range.maxs].map(|[center, deviation, _]| Some([center, deviation]));
    TimelineEntry { kind: 1, frames: None, delta: None, mins, maxs, files }
}

/// Encodes the velocities of `params` and adds them to `images`: one image with 8 bits per axis if
/// [`are_8_bits_enough`], else two images with the low and the high bytes of 16 bits per axis. The images have the size
/// `size`, and pixel i belongs to the Gaussian `order[i]`. Returns the member `temporal` of `meta.json`; `None` if no
/// Gaussian moves.
fn encode_velocities(
    params: &StoredParams,
    size: ImageSize,
    order: &[u32],
    images: &mut NamedImages,
) -> Option<Temporal> {
    let velocity = |row: usize| [0, 1, 2].map(|c| f64::from(params.format_specific.plane(VELOCITY + c)[row]));
    let range = Range3::from_rows((0..params.len()).map(velocity));
    if range.mins == [0.0; 3] && range.maxs == [0.0; 3] {
        return None;
    }
    let byte = |row: usize| {
        let value = velocity(row);
        [0, 1, 2].map(|axis| {
            let span = range.maxs[axis] - range.mins[axis];
            if span > 0.0 { (255.0 * (value[axis] - range.mins[axis]) / span).round() as u8 } else { 0 }
        })
    };
    let files = if are_8_bits_enough(params, &range) {
        let name = "motion.webp".to_owned();
        let image = size.image(order, |row| {
            let [x, y, z] = byte(row);
            [x, y, z, 255]
        });
        images.push((name.clone(), image));
        vec![name]
    } else {
        let pair = encode_16_bit(size, order, |row| {
            let value = velocity(row);
            [0, 1, 2].map(|axis| range.encode(axis, value[axis]))
        });
        add_pair(images, "motion", pair).to_vec()
    };
    Some(Temporal { means: Velocity { mins: [range.mins], maxs: [range.maxs], files } })
}

/// Returns whether 8 bits per axis are enough for the velocities of `params`, whose ranges are `range`: the position
/// errors must not exceed [`MAX_8_BIT_ERRORS`]. The error of a Gaussian grows with the distance in time from the center
/// of its window. It is taken at the furthest time within the sequence, but at most two standard deviations from the
/// center.
fn are_8_bits_enough(params: &StoredParams, range: &Range3) -> bool {
    let half_step = (0..3).map(|axis| ((range.maxs[axis] - range.mins[axis]) / 510.0).powi(2)).sum::<f64>().sqrt();
    let (mut squares, mut most) = (0.0, 0.0f64);
    for row in 0..params.len() {
        let own = |plane: usize| f64::from(params.format_specific.plane(plane)[row]);
        let center = own(TIME_CENTER);
        let reach = center.abs().max((1.0 - center).abs()).min(2.0 * own(LOG_TIME_DEVIATION).exp());
        let mut scales = params.gaussians.log_scale.row::<3>(row);
        scales.sort_by(f32::total_cmp);
        let error = half_step * reach / f64::from(scales[1]).exp().max(1e-12);
        squares += error * error;
        most = most.max(error);
    }
    (squares / params.len() as f64).sqrt() <= MAX_8_BIT_ERRORS[0] && most <= MAX_8_BIT_ERRORS[1]
}

/// Adds the images `low` and `high` to `images` under the file names `NAME_l.webp` and `NAME_u.webp`, where NAME is
/// `name`, and returns these two file names.
fn add_pair(images: &mut NamedImages, name: &str, [low, high]: [crate::files::webp::RgbaImage; 2]) -> [String; 2] {
    let names = [format!("{name}_l.webp"), format!("{name}_u.webp")];
    images.extend(names.iter().cloned().zip([low, high]));
    names
}
