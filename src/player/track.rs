//! Encoding of a sequence of frames for the player page as chunks of bytes. The first chunk holds the first frame. Each
//! later chunk holds one group of consecutive frames as differences in time.
//!
//! Input: a source of frames. Output: chunks of bytes, in order. Memory: one state, and the quantized values of the
//! frames of one group, which are at most [`MAX_VALUES_PER_FRAME_GROUP`] unless the group has only one frame.
//!
//! Values are quantized to integers. A component is one scalar of every Gaussian, such as the x of the position. Chunk
//! 0 holds all components; later chunks hold only the components of attributes that vary in time. To decode a chunk,
//! only this chunk and chunk 0 are needed.
//!
//! A chunk is a zlib stream (RFC 1950). For each of its components, one after another, it holds:
//! 1. One byte of flags. Bits 0 to 2: number of planes. Bit 3: differences are of second order. Bit 4: some value of
//!    the component does not fit into a signed 16-bit integer.
//! 2. The planes. Plane k holds byte k (byte 0 is the lowest) of the code of every difference: first the differences of
//!    Gaussian 0 at all frames of the chunk, then those of Gaussian 1, and so on. Without planes, all
//!    differences are 0.
//!
//! The code of a difference d is 2d, or −2d − 1 if d is negative.
//!
//! A difference is the value of a Gaussian at a frame minus a prediction. The prediction depends on the frame:
//! - First frame of chunk 0: 0.
//! - First frame of a later chunk: the value at the first frame of the sequence.
//! - Second frame of a chunk: the value at the frame before.
//! - Later frames, first order: the value at the frame before.
//! - Later frames, second order: the value at the frame before plus the last change. If a and b are the values at the
//!   two frames before, this is b + (b − a).

use std::io::Write;

use flate2::Compression;
use flate2::write::ZlibEncoder;
use rayon::prelude::*;
use serde::Serialize;

use super::quantization::{PlayerSteps, check_positions, component_count, component_range, quantize_into};
use crate::error::{Error, Result};
use crate::model::{Attributes, Gaussians};
use crate::passes::FrameStates;
use crate::progress::Events;
use crate::source::{FrameSource, ReadPlan};

/// Maximum number of quantized values of a group of frames, which are in memory at once. A group of one frame may have
/// more.
pub const MAX_VALUES_PER_FRAME_GROUP: usize = 1 << 23;
/// Maximum number of frames of a group. The page must decode a whole group to jump to another time.
const GROUP_FRAMES: usize = 20;
/// Compression level of deflate. Differences are mostly noise, so higher levels gain little for their time.
const LEVEL: u32 = 6;
/// Flag in the first byte of an encoded component: its differences are of second order.
const SECOND_ORDER: u8 = 8;
/// Flag in the first byte of an encoded component: it has values of more than 16 bits.
const WIDE: u8 = 16;

/// Description of a sequence of frames, which the player page reads before the chunks.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PageSequence {
    /// Number of Gaussians.
    pub count: usize,
    /// SH degree of the encoded frames.
    pub sh_degree: usize,
    /// Time stamps of the encoded frames.
    pub times: Vec<f64>,
    /// Quantization steps of the encoded values: positions, rotations, scales, opacities and SH coefficients.
    pub steps: PlayerSteps,
    /// Scalar components of a Gaussian that vary with time, as ranges in increasing order: index of the first
    /// component, and number of components.
    pub varying: Vec<[usize; 2]>,
    /// Index of the first frame of each group, followed by the total number of frames. Frame 0 is stored separately and
    /// belongs to no group.
    pub groups: Vec<usize>,
    /// Largest number of Gaussians that are invisible in one frame of the page, because a value is NaN or a position is
    /// too far away for the quantization grid.
    #[serde(skip)]
    pub unseen: usize,
}

impl PageSequence {
    /// Plans the encoding of the frames `frames` of `source`, with SH coefficients up to `sh_degree` and the
    /// quantization steps `steps`. Divides the frames into groups and returns the description of the sequence.
    pub fn plan(source: &dyn FrameSource, frames: &[usize], sh_degree: usize, steps: PlayerSteps) -> PageSequence {
        let info = source.info();
        let sh_degree = sh_degree.min(info.sh_degree);
        let of_frame = info.varying.width(sh_degree).max(1) * info.count.max(1);
        let together = (MAX_VALUES_PER_FRAME_GROUP / of_frame).clamp(1, GROUP_FRAMES);
        // Groups are about equally long, because each costs about the same to start.
        let groups = (frames.len().saturating_sub(1)).div_ceil(together);
        let varying = if groups == 0 { Attributes::empty() } else { changing(info.varying) };
        PageSequence {
            count: info.count,
            sh_degree,
            times: frames.iter().map(|&frame| info.times[frame]).collect(),
            steps,
            varying: varying
                .iter()
                .map(|column| component_range(column, sh_degree))
                .map(|c| [c.start, c.len()])
                .collect(),
            groups: (0..=groups).map(|k| 1 + k * frames.len().saturating_sub(1) / groups.max(1)).collect(),
            unseen: 0,
        }
    }
}

/// Returns the attributes that are encoded for every frame: the attributes that vary with time (`varying`) and, if
/// there are any, the opacity. The opacity is needed because a Gaussian is hidden by opacity 0 at frames where it has
/// values that cannot be shown.
fn changing(varying: Attributes) -> Attributes {
    if varying.is_empty() { varying } else { varying | Attributes::OPACITY }
}

/// Encodes the frames `frames` of `source` for the player page. `track` is the description of the sequence, planned for
/// these frames. Passes each chunk with its index to `sink`, in order. Stores the largest number of invisible Gaussians
/// in `track.unseen`. `held`: maximum number of decoded frames in memory, for sources that decode several frames
/// together.
///
/// # Errors
/// Fails if a frame cannot be read, if a position cannot be stored accurately, or if `sink` fails.
pub fn encode(
    source: &dyn FrameSource,
    frames: &[usize],
    track: &mut PageSequence,
    held: usize,
    events: &Events,
    mut sink: impl FnMut(usize, Vec<u8>) -> Result<()>,
) -> Result<()> {
    let Some(&first) = frames.first() else { return Ok(()) };
    let progress = events.task("view", "frames", frames.len() as u64);
    let mut states = FrameStates::open(source, &ReadPlan::new(frames.iter().copied()).with_max_kept_frames(held))?;
    let mut shown = Gaussians::default();
    let (count, degree) = (track.count, track.sh_degree);
    let mut points = vec![0; component_count(degree) * count];
    let mut read = |frame: usize, which: Attributes, points: &mut [i32], states: &mut FrameStates| -> Result<()> {
        let state = states.read(frame)?;
        let mut unseen = 0;
        if degree < state.sh_degree() {
            shown.clone_from(state);
            shown.truncate_sh(degree);
            unseen += quantize_into(&shown, which, &track.steps, points);
        } else {
            unseen += quantize_into(state, which, &track.steps, points);
        }
        if which == Attributes::all() {
            check_positions(state, degree, &track.steps, points)?;
        }
        track.unseen = track.unseen.max(unseen);
        progress.advance(1);
        Ok(())
    };
    read(first, Attributes::all(), &mut points, &mut states)?;
    let zeros = vec![0; count];
    let planes: Vec<&[i32]> = points.chunks_exact(count.max(1)).collect();
    sink(0, pack(planes.iter().map(|plane| (&zeros[..], vec![*plane])).collect())?)?;

    let base = points.clone();
    let varying = changing(source.info().varying);
    let moving: Vec<usize> = track.varying.iter().flat_map(|&[start, len]| start..start + len).collect();
    for (chunk, group) in track.groups.windows(2).enumerate() {
        let mut together = Vec::with_capacity(moving.len() * count * (group[1] - group[0]));
        for &frame in &frames[group[0]..group[1]] {
            read(frame, varying, &mut points, &mut states)?;
            moving.iter().for_each(|&c| together.extend_from_slice(&points[c * count..][..count]));
        }
        let plane = |of: usize| &together[of * count..][..count];
        let of_component = |(k, &c): (usize, &usize)| {
            let frames = (0..group[1] - group[0]).map(|frame| plane(frame * moving.len() + k)).collect();
            (&base[c * count..][..count], frames)
        };
        sink(chunk + 1, pack(moving.iter().enumerate().map(of_component).collect())?)?;
    }
    Ok(())
}

/// Encodes scalar components (such as the x of the position) as a compressed chunk. `components` has for each component
/// the quantized values of all Gaussians at the first frame of the sequence, and a list of their values at each frame
/// of the chunk.
fn pack(components: Vec<(&[i32], Vec<&[i32]>)>) -> Result<Vec<u8>> {
    let failed = |error| Error::io("compress", "the page's frames".as_ref())(error);
    let mut to = ZlibEncoder::new(Vec::new(), Compression::new(LEVEL));
    // A few components at a time on all threads; their bytes are compressed in order.
    for some in components.chunks(8) {
        let bytes: Vec<Vec<u8>> = some.par_iter().map(|(start, frames)| component_bytes(start, frames)).collect();
        bytes.iter().try_for_each(|bytes| to.write_all(bytes)).map_err(failed)?;
    }
    to.finish().map_err(failed)
}

/// Encodes one scalar component (such as the x of the position) for a chunk, and returns its bytes: a byte of flags,
/// then the codes of the differences between frames (see [`differences`]). The lowest byte of every code comes first,
/// then the next byte of every code, and so on. `start` has the values at the first frame of the sequence, `frames` the
/// values at the frames of the chunk.
fn component_bytes(start: &[i32], frames: &[&[i32]]) -> Vec<u8> {
    let mut orders = [false, true].map(|is_second| differences(start, frames, is_second));
    let cost = |values: &[u32]| values.iter().map(|&v| u64::from(32 - v.leading_zeros())).sum::<u64>();
    let is_second = frames.len() > 1 && cost(&orders[1]) < cost(&orders[0]);
    let values = std::mem::take(&mut orders[usize::from(is_second)]);
    let largest = values.iter().copied().max().unwrap_or(0);
    let planes = (32 - largest.leading_zeros()).div_ceil(8) as usize;
    let is_wide = frames.iter().any(|frame| frame.iter().any(|&x| i16::try_from(x).is_err()));
    let mut bytes = Vec::with_capacity(1 + planes * values.len());
    bytes.push(planes as u8 | if is_second { SECOND_ORDER } else { 0 } | if is_wide { WIDE } else { 0 });
    (0..planes).for_each(|plane| bytes.extend(values.iter().map(|value| (value >> (8 * plane)) as u8)));
    bytes
}

/// Returns the codes of the differences of one component between successive frames, Gaussian by Gaussian. The code of a
/// difference d is 2d, or −2d − 1 if d is negative. A value of a Gaussian is compared with:
/// - its value in `start`, if it is the first value;
/// - its value at the frame before, if it is the second value, or a later value and `is_second` is false;
/// - the linear extrapolation of its two values before, if it is a later value and `is_second` is true. Steady motion
///   then gives 0.
fn differences(start: &[i32], frames: &[&[i32]], is_second: bool) -> Vec<u32> {
    let mut values = Vec::with_capacity(start.len() * frames.len());
    for (i, &first) in start.iter().enumerate() {
        let (mut before, mut step) = (first, 0i32);
        for (place, frame) in frames.iter().enumerate() {
            let expected = if is_second { before.wrapping_add(step) } else { before };
            let off = frame[i].wrapping_sub(expected);
            values.push(((off << 1) ^ (off >> 31)) as u32);
            // The first frame of the sequence may be far away in time, so its difference is not extrapolated.
            step = if place == 0 { 0 } else { frame[i].wrapping_sub(before) };
            before = frame[i];
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use flate2::read::ZlibDecoder;

    use super::*;
    use crate::diagnostics::demo_scene;
    use crate::passes::gather_all;

    /// Decodes `chunks` of the sequence `track`, and returns the values `[frames][components][N]` of every frame. Works
    /// value by value as the description at the top of this file says, and shares no code with the encoder.
    fn unpacked(track: &PageSequence, chunks: &[Vec<u8>]) -> Vec<Vec<Vec<i64>>> {
        let (count, width) = (track.count, component_count(track.sh_degree));
        let chunk = |k: usize, moving: &[usize], frames: usize, base: &[Vec<i64>]| {
            let mut bytes = Vec::new();
            ZlibDecoder::new(&chunks[k][..]).read_to_end(&mut bytes).unwrap();
            let mut found = vec![base.to_vec(); frames];
            let mut at = 0;
            for &component in moving {
                let flags = bytes[at];
                let planes = usize::from(flags & 7);
                for i in 0..count {
                    let mut history = vec![base[component][i]];
                    for frame in 0..frames {
                        let byte = |plane: usize| {
                            i64::from(bytes[at + 1 + plane * count * frames + i * frames + frame]) << (8 * plane)
                        };
                        let code: i64 = (0..planes).map(byte).sum();
                        let off = if code % 2 == 0 { code / 2 } else { -(code + 1) / 2 };
                        let drift = match flags & 8 != 0 && frame > 1 {
                            true => history[frame] - history[frame - 1],
                            false => 0,
                        };
                        history.push(history[frame] + drift + off);
                        found[frame][component][i] = history[frame + 1];
                        assert!(flags & 16 != 0 || i16::try_from(history[frame + 1]).is_ok(), "not told to be wide");
                    }
                }
                at += 1 + planes * count * frames;
            }
            assert_eq!(at, bytes.len(), "chunk {k}");
            found
        };
        let all: Vec<usize> = (0..width).collect();
        let mut frames = chunk(0, &all, 1, &vec![vec![0; count]; width]);
        let base = frames[0].clone();
        let moving: Vec<usize> = track.varying.iter().flat_map(|&[start, len]| start..start + len).collect();
        for (k, group) in track.groups.windows(2).enumerate() {
            frames.extend(chunk(k + 1, &moving, group[1] - group[0], &base));
        }
        frames
    }

    fn encoded(source: &dyn FrameSource, frames: &[usize], degree: usize) -> (PageSequence, Vec<Vec<u8>>) {
        let mut track = PageSequence::plan(source, frames, degree, PlayerSteps::from_extent(2.0));
        let mut chunks = Vec::new();
        let sink = |place: usize, bytes| {
            assert_eq!(place, chunks.len());
            chunks.push(bytes);
            Ok(())
        };
        encode(source, frames, &mut track, 2, &Events::IGNORED, sink).unwrap();
        assert_eq!(chunks.len(), track.groups.len());
        (track, chunks)
    }

    #[test]
    fn decoded_values_are_within_half_a_step() {
        let scene = demo_scene::DemoScene::new(700, 47);
        let frames = [0, 1, 2, 5, 9, 12, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32, 33, 34, 35, 36, 46];
        let (track, chunks) = encoded(&scene, &frames, 3);
        assert!(track.groups.len() > 2 && track.groups.last() == Some(&frames.len()), "{:?}", track.groups);
        let found = unpacked(&track, &chunks);
        assert_eq!(found.len(), frames.len());
        let steps = track.steps;
        for (&frame, found) in frames.iter().zip(&found) {
            let state = gather_all(&scene, frame, Attributes::all()).unwrap();
            let near = |component: usize, i: usize, value: f64, step: f64| {
                let off = (found[component][i] as f64 * step - value).abs();
                assert!(off <= 0.5 * step * (1.0 + 1e-9), "frame {frame}, component {component}: {off} of {step}");
            };
            (0..track.count).for_each(|i| {
                for c in 0..3 {
                    near(c, i, state.position.plane(c)[i].into(), steps.position);
                    near(7 + c, i, state.log_scale.plane(c)[i].into(), steps.log_scale);
                }
                near(10, i, crate::model::opacity(state.opacity_logit.plane(0)[i]), steps.opacity);
                for c in 0..state.sh.width() {
                    near(11 + c, i, state.sh.plane(c)[i].into(), steps.sh);
                }
                let q: [f64; 4] = std::array::from_fn(|c| state.rotation.plane(c)[i].into());
                let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
                let along: f64 = (0..4).map(|c| q[c] * found[3 + c][i] as f64).sum();
                (0..4).for_each(|c| near(3 + c, i, along.signum() * q[c] / length, steps.rotation));
            });
        }
    }

    #[test]
    fn one_frame_is_one_chunk_and_degree_0_has_14_components() {
        let scene = demo_scene::DemoScene::new(300, 5);
        let (track, chunks) = encoded(&scene, &[3], 0);
        assert_eq!((track.groups.len(), track.sh_degree, track.varying.len()), (1, 0, 0));
        let found = unpacked(&track, &chunks);
        assert_eq!((found.len(), found[0].len()), (1, 14));
        assert!(encoded(&scene, &[3], 3).1[0].len() >= chunks[0].len());
    }

    #[test]
    fn the_bytes_do_not_depend_on_the_threads() {
        let scene = demo_scene::DemoScene::new(900, 12);
        let frames: Vec<usize> = (0..12).collect();
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| encoded(&scene, &frames, 3))
        };
        assert!(with(1) == with(5));
    }

    #[test]
    fn a_gaussian_takes_few_bytes_per_frame() {
        let scene = demo_scene::DemoScene::new(2000, 48);
        let frames: Vec<usize> = (0..48).collect();
        let bytes: usize = encoded(&scene, &frames, 3).1.iter().map(Vec::len).sum();
        let of_each = bytes as f64 / (2000.0 * 48.0);
        assert!(of_each < 4.0, "{of_each} bytes for what takes 44 as f32");
    }
}
