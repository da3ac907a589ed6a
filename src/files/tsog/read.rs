//! Reader of `.tsog` files.

use std::path::Path;

use serde_json::Value;

use super::write::MAX_FRAMES;
use super::{DEFAULT_FRAMES, TimedGaussians, Timeline, TimelineEntry, TsogMeta, VERSION, Velocity, codes_per_frame};
use crate::error::{Error, Result, quoted};
use crate::files::ftgs::{ClipTimes, FRAME_RATE, LOG_TIME_DEVIATION, TIME_CENTER, VELOCITY};
use crate::files::json;
use crate::files::sog::META_FILE;
use crate::files::sog::images::{Range3, decode_16_bit};
use crate::files::sog::read::{SogFiles, decode};
use crate::files::text::decode_text;
use crate::limits::ReadLimit;
use crate::model::{AttributeValues, StoredParams};

/// Maximum length in bytes of `meta.json`.
const MAX_META_BYTES: u64 = 4 << 20;
/// Bytes of memory per Gaussian for its time window and velocity, and for the images of both.
const TIMELINE_BYTES: u64 = 4 * 5 + 4 * 16;
/// Members of `meta.json` that may be absent. A member that is present must not be null.
const OPTIONAL: [&str; 6] = ["shN", "timeline", "temporal", "fps", "playback", "profile"];
/// Largest accepted frame rate in frames per second. Also the largest accepted duration in seconds.
const MAX_PLAYBACK: f64 = 1e6;

/// Returns whether the file at `path` is a ZIP archive with a `meta.json` of version 4.
pub fn is_tsog(path: &Path) -> bool {
    let meta = || -> Result<Value> {
        let text = SogFiles::open_archive(path)?.read(path, META_FILE, ReadLimit::new(MAX_META_BYTES))?;
        json::parse(decode_text(path, &text)?, path)
    };
    meta().is_ok_and(|meta| meta["version"] == VERSION)
}

/// Reads the `.tsog` file at `path`: the Gaussians, in the order in which the file holds them, and the times at which
/// players show them.
///
/// # Errors
/// Fails if the file is damaged, has another version than 4, or needs more memory than `memory`.
pub fn read_tsog(path: &Path, memory: ReadLimit) -> Result<TimedGaussians> {
    let mut files = SogFiles::open_archive(path)?;
    let text = files.read(path, META_FILE, ReadLimit::new(memory.bytes().min(MAX_META_BYTES)))?;
    let meta = parse(&text, path)?;
    if !(1..=u64::from(u32::MAX)).contains(&meta.sog.count) {
        let expected = "a number from 1 to 4294967295";
        return Err(Error::input(path, "meta.json, count", expected, meta.sog.count.to_string()));
    }
    let bytes = TIMELINE_BYTES.saturating_mul(meta.sog.count);
    memory.check(path, "meta.json, count", "the time windows of the Gaussians", bytes)?;
    let gaussians = decode(&meta.sog, &mut files, path, memory)?;
    let count = gaussians.len();
    let timeline = match &meta.timeline {
        None => Timeline::Still,
        Some(TimelineEntry { kind: 1, .. }) => Timeline::Windows,
        Some(entry) => Timeline::Frames(frame_count(entry, path)?),
    };
    let mut own = AttributeValues::zeros(timeline.param_count(), count);
    if let Some(entry) = &meta.timeline {
        read_timeline(entry, timeline, &mut files, (path, memory), &mut own)?;
    }
    match (&meta.temporal, timeline) {
        (None, _) => {}
        (Some(temporal), Timeline::Windows) => {
            read_velocities(&temporal.means, &mut files, (path, memory), &mut own)?;
        }
        (Some(_), _) => {
            let found = "none, or one of another type";
            return Err(Error::input(path, "meta.json, temporal", "a timeline of type 1 with it", found));
        }
    }
    let clip = clip_times(&meta, timeline, path)?;
    Ok(TimedGaussians { params: StoredParams { gaussians, format_specific: own }, timeline, clip })
}

/// Parses `text`, the content of `meta.json`. Fails if it is malformed, has another version than 4, or has a null in
/// place of an optional member.
fn parse(text: &[u8], path: &Path) -> Result<TsogMeta> {
    let meta_path = path.join(META_FILE);
    let value: Value = json::parse(decode_text(&meta_path, text)?, &meta_path)?;
    if value["version"] != VERSION {
        let found = quoted(&value["version"].to_string()).to_string();
        return Err(Error::input(path, "meta.json, version", VERSION.to_string(), found));
    }
    if let Some(name) = OPTIONAL.into_iter().find(|name| value.get(name).is_some_and(Value::is_null)) {
        return Err(Error::input(path, format!("meta.json, {name}"), "a value, or no such member", "null"));
    }
    serde_json::from_value(value).map_err(|error| {
        Error::input(path, META_FILE, "the members of version 4 of the format", quoted(&error.to_string()))
    })
}

/// Returns the number of frames of the timeline `entry`. Fails if the timeline is not of type 0 or its numbers are
/// invalid.
fn frame_count(entry: &TimelineEntry, path: &Path) -> Result<usize> {
    let place = |name: &str| format!("meta.json, timeline, {name}");
    if entry.kind != 0 {
        return Err(Error::input(path, place("type"), "0 or 1", entry.kind.to_string()));
    }
    let number = |value: Option<u64>| value.map_or("none".to_owned(), |value| value.to_string());
    let frames = entry.frames.and_then(|frames| usize::try_from(frames).ok());
    let Some(frames) = frames.filter(|frames| (1..=MAX_FRAMES).contains(frames)) else {
        return Err(Error::input(path, place("N"), format!("1 to {MAX_FRAMES} frames"), number(entry.frames)));
    };
    let delta = codes_per_frame(frames) as u64;
    if entry.delta != Some(delta) {
        return Err(Error::input(path, place("delta"), delta.to_string(), number(entry.delta)));
    }
    Ok(frames)
}

/// Reads when each Gaussian is visible: decodes the two images of the timeline `entry` from `files`. Writes the result
/// to `format_specific`, the format-specific parameters: the index of the one frame in which the Gaussian is seen, or
/// the center and deviation of its time window. `timeline` says which of the two the file has.
fn read_timeline(
    entry: &TimelineEntry,
    timeline: Timeline,
    files: &mut SogFiles,
    (path, memory): (&Path, ReadLimit),
    format_specific: &mut AttributeValues,
) -> Result<()> {
    let count = format_specific.len();
    let mut image = |name: &str| files.image_of_gaussians(path, name, count, memory);
    let (low, high) = (image(&entry.files[0])?, image(&entry.files[1])?);
    let codes = (0..count).map(|i| decode_16_bit(low.pixels[i], high.pixels[i]));
    if let Timeline::Frames(frames) = timeline {
        let delta = codes_per_frame(frames);
        let frame = codes.map(|[code, ..]| (usize::from(code) / delta).min(frames - 1) as f32);
        format_specific.plane_mut(0).iter_mut().zip(frame).for_each(|(to, frame)| *to = frame);
        return Ok(());
    }
    let range = |name: &str, values: Option<[f64; 2]>| {
        let place = format!("meta.json, timeline, {name}");
        let values = values.ok_or_else(|| Error::input(path, place.clone(), "two numbers", "none"))?;
        let is_valid = values.iter().all(|&value| is_f32(value)) && (values[1] as f32) > 0.0;
        let found = || format!("{}, {}", values[0], values[1]);
        is_valid.then_some(values).ok_or_else(|| Error::input(path, place, "a number and one above 0", found()))
    };
    let ([c0, s0], [c1, s1]) = (range("mins", entry.mins)?, range("maxs", entry.maxs)?);
    let range = checked(Range3 { mins: [c0, s0, 0.0], maxs: [c1, s1, 0.0] }, path, "timeline")?;
    for (i, code) in codes.enumerate() {
        format_specific.plane_mut(TIME_CENTER)[i] = range.decode(0, code[0]) as f32;
        format_specific.plane_mut(LOG_TIME_DEVIATION)[i] = range.decode(1, code[1]).ln() as f32;
    }
    Ok(())
}

/// Reads the velocity of each Gaussian: decodes the one or two images that `entry` describes from `files`. Writes the
/// velocities to `format_specific`, the format-specific parameters of the Gaussians. `path` names the file in errors,
/// and `memory` limits the size of the images.
fn read_velocities(
    entry: &Velocity,
    files: &mut SogFiles,
    (path, memory): (&Path, ReadLimit),
    format_specific: &mut AttributeValues,
) -> Result<()> {
    let count = format_specific.len();
    let mut image = |name: &str| files.image_of_gaussians(path, name, count, memory);
    let range = checked(Range3 { mins: entry.mins[0], maxs: entry.maxs[0] }, path, "temporal, means")?;
    let images = match &entry.files[..] {
        [one] => (image(one)?, None),
        [low, high] => (image(low)?, Some(image(high)?)),
        other => {
            let found = other.len().to_string();
            return Err(Error::input(path, "meta.json, temporal, means, files", "one or two names", found));
        }
    };
    for i in 0..count {
        let codes = match &images {
            // 255 of 8 bits and 65535 of 16 bits stand for the same value.
            (one, None) => [0, 1, 2].map(|c| 257 * u16::from(one.pixels[i][c])),
            (low, Some(high)) => decode_16_bit(low.pixels[i], high.pixels[i]),
        };
        (0..3).for_each(|c| format_specific.plane_mut(VELOCITY + c)[i] = range.decode(c, codes[c]) as f32);
    }
    Ok(())
}

/// Checks the value ranges `range` and returns them: the ends of each range must be finite as f32 and in increasing
/// order. Error messages name the file `path` and the member `member` of `meta.json`.
fn checked(range: Range3, path: &Path, member: &str) -> Result<Range3> {
    let wrong = (0..3).find(|&c| {
        let (min, max) = (range.mins[c], range.maxs[c]);
        !(is_f32(min) && is_f32(max) && is_f32(max - min) && min <= max)
    });
    match wrong {
        None => Ok(range),
        Some(c) => {
            let found = format!("{} to {}", range.mins[c], range.maxs[c]);
            Err(Error::input(path, format!("meta.json, {member}"), "ranges of finite numbers", found))
        }
    }
}

/// Returns whether `value` is finite as f32.
fn is_f32(value: f64) -> bool {
    (value as f32).is_finite()
}

/// Returns the number of frames, the frame rate and the mapping of times of an archive. `meta` is the content of its
/// `meta.json`, and `timeline` says when the Gaussians are visible. The mapping converts times of the original sequence
/// to the times of players, from 0 to 1. If `meta` does not state the original times, the mapping leaves times
/// unchanged.
fn clip_times(meta: &TsogMeta, timeline: Timeline, path: &Path) -> Result<ClipTimes> {
    let playback = meta.playback.as_ref();
    let number = |name: &str, value: Option<f64>| match value {
        Some(value) if !(value > 0.0 && value <= MAX_PLAYBACK) => {
            let expected = format!("a number above 0, at most {MAX_PLAYBACK}");
            Err(Error::input(path, format!("meta.json, {name}"), expected, value.to_string()))
        }
        value => Ok(value),
    };
    let rate = number("playback, fps", playback.and_then(|playback| playback.fps))?;
    let frame_rate = rate.or(number("fps", meta.fps)?).unwrap_or(FRAME_RATE);
    let duration = number("playback, duration", playback.and_then(|playback| playback.duration))?;
    let frames = match timeline {
        Timeline::Still => 1,
        Timeline::Frames(frames) => frames,
        Timeline::Windows => match duration {
            Some(seconds) => ((seconds * frame_rate).round().min(1e9) as usize).saturating_add(1),
            None => DEFAULT_FRAMES,
        },
    };
    let clip = match &meta.splatsieve {
        None => ClipTimes::UNIT_INTERVAL,
        Some(original) => ClipTimes::from_range(original.times[0], original.times[1]).ok_or_else(|| {
            let found = format!("{}, {}", original.times[0], original.times[1]);
            Error::input(path, "meta.json, splatsieve, times", "two increasing numbers", found)
        })?,
    };
    Ok(ClipTimes { frames: Some(frames), frame_rate, ..clip })
}
