//! Encodes and decodes the parts of a frame stream that have a fixed size: the header of the stream, and the mark
//! before each frame and at the end (format/STREAM.md).

use crate::error::quoted;
use crate::model::{Attributes, sh_coefficient_count};

/// Versions of the stream format. In version 1 every frame has the same Gaussians, in version 2 every frame states
/// their number.
const VERSIONS: [u32; 2] = [1, 2];
/// First bytes of the mark (fixed-size part) that precedes each frame of a stream.
const FRAME_MAGIC: [u8; 4] = *b"FRAM";
/// First bytes of the mark (fixed-size part) at the end of a stream.
const END_MAGIC: [u8; 4] = *b"DONE";

/// Header of a stream, before its first frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StreamHeader {
    /// N, the number of Gaussians in every frame; below 2³². 0 if the frames are unlinked, until
    /// [`FrameStream::with_common_indices`](super::FrameStream::with_common_indices) sets it.
    pub count: usize,
    /// SH degree, 0 to 3.
    pub sh_degree: usize,
    /// Attributes that are stored with every frame. The others are constant and stored once, after the header.
    pub varying: Attributes,
    /// Whether frames are unlinked (version 2): every frame states its own number of Gaussians, and the same index in
    /// two frames does not mean the same Gaussian.
    pub is_unlinked: bool,
}

/// Mark: fixed-size part of the stream before the attributes of each frame and at the end of the stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum FrameMark {
    /// Mark before a frame: number of the frame, its time stamp, and the length of its attributes in bytes.
    Frame { index: u32, time: f64, bytes: u64 },
    /// Mark at the end of the stream: number of frames in the stream.
    End(u32),
}

/// Field that violates the stream format, in the header of a stream or in a mark (fixed-size part before each frame and
/// at the end). `offset` is the byte within the header or mark at which the field begins; `expected`, `found` and
/// `hint` are texts for the error message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct IllegalField {
    pub(crate) offset: u64,
    pub(crate) expected: String,
    pub(crate) found: String,
    pub(crate) hint: &'static str,
}

/// Advice in error messages for a stream that is not well-formed. The usual reason is that the exporter printed other
/// text into the stream.
const FOREIGN_OUTPUT: &str = "whatever the exporter prints must go to standard error, never into the stream";

impl StreamHeader {
    /// Length in bytes of the header of a stream.
    pub(crate) const BYTES: usize = 32;
    /// First bytes of every stream, built like the first bytes of a container file.
    pub(crate) const MAGIC: [u8; 8] = *b"\x89GSTR\r\n\x1a";

    /// Returns the number of bytes that the varying attributes of one frame take if all frames have the same Gaussians.
    pub fn frame_bytes(&self) -> u64 {
        self.gaussian_bytes() * self.count as u64
    }

    /// Returns the number of bytes that the varying attributes of one Gaussian take in a frame.
    pub(crate) fn gaussian_bytes(&self) -> u64 {
        4 * self.varying.width(self.sh_degree) as u64
    }

    /// Returns the bytes of the header as stored in the stream.
    pub(crate) fn to_bytes(self) -> [u8; Self::BYTES] {
        let mut bytes = [0; Self::BYTES];
        bytes[..8].copy_from_slice(&Self::MAGIC);
        bytes[8..12].copy_from_slice(&VERSIONS[usize::from(self.is_unlinked)].to_le_bytes());
        bytes[12..16].copy_from_slice(&(self.sh_degree as u32).to_le_bytes());
        bytes[16..24].copy_from_slice(&(self.count as u64).to_le_bytes());
        bytes[24..28].copy_from_slice(&self.varying.bits().to_le_bytes());
        bytes
    }

    /// Decodes a header from its stored bytes, of which the first `received` have been received.
    ///
    /// # Errors
    /// Returns the first field that violates format/STREAM.md.
    pub(crate) fn from_bytes(bytes: &[u8; Self::BYTES], received: usize) -> Result<Self, IllegalField> {
        let illegal = |offset, expected: &str, found: String, hint| {
            Err(IllegalField { offset, expected: expected.to_owned(), found, hint })
        };
        if bytes[..8] != Self::MAGIC {
            return illegal(
                0,
                "a frame stream (format/STREAM.md)",
                quoted(&escaped(&bytes[..received.min(8)])),
                FOREIGN_OUTPUT,
            );
        }
        let version = u32_at(bytes, 8);
        if !VERSIONS.contains(&version) {
            return illegal(8, "version 1 or 2", format!("version {version}"), "a newer splatsieve may read it");
        }
        let is_unlinked = version == VERSIONS[1];
        let degree = u32_at(bytes, 12);
        if degree > 3 {
            return illegal(12, "a degree of spherical harmonics from 0 to 3", degree.to_string(), "");
        }
        let count = u64_at(bytes, 16);
        let Some(count) = usize::try_from(count).ok().filter(|&count| count <= u32::MAX as usize) else {
            return illegal(16, "fewer than 2^32 Gaussians", count.to_string(), "");
        };
        let Some(varying) = Attributes::from_bits(u32_at(bytes, 24)) else {
            return illegal(24, "a set of the five columns", format!("bits {:#x}", u32_at(bytes, 24)), "");
        };
        if is_unlinked && count != 0 {
            return illegal(16, "0 Gaussians in a header of version 2: frames say how many", count.to_string(), "");
        }
        if is_unlinked && varying != Attributes::all() {
            let found = format!("bits {:#x}", varying.bits());
            return illegal(24, "all five columns with every frame of version 2", found, "");
        }
        if u32_at(bytes, 28) != 0 {
            return illegal(28, "a reserved field of 0", u32_at(bytes, 28).to_string(), "");
        }
        Ok(StreamHeader { count, sh_degree: degree as usize, varying, is_unlinked })
    }
}

impl FrameMark {
    /// Length in bytes of a mark: the fixed-size part of a stream before each frame and at the end.
    pub(crate) const BYTES: usize = 24;

    /// Returns the bytes of this mark (before a frame or at the end) as stored in the stream.
    pub(crate) fn to_bytes(self) -> [u8; Self::BYTES] {
        let (mark, index, time, length) = match self {
            FrameMark::Frame { index, time, bytes } => (FRAME_MAGIC, index, time, bytes),
            FrameMark::End(frames) => (END_MAGIC, frames, 0.0, 0),
        };
        let mut bytes = [0; Self::BYTES];
        bytes[..4].copy_from_slice(&mark);
        bytes[4..8].copy_from_slice(&index.to_le_bytes());
        bytes[8..16].copy_from_slice(&time.to_le_bytes());
        bytes[16..].copy_from_slice(&length.to_le_bytes());
        bytes
    }

    /// Decodes a mark (fixed-size part before a frame or at the end of the stream) from its stored bytes. The stream
    /// has the header `header`. Before the mark it held `frames` complete frames; `before` is the time of the last one.
    ///
    /// # Errors
    /// Returns the first field that violates format/STREAM.md.
    pub(crate) fn from_bytes(
        bytes: &[u8; Self::BYTES],
        header: &StreamHeader,
        frames: u32,
        before: Option<f64>,
    ) -> Result<Self, IllegalField> {
        let illegal =
            |offset, expected: String, found: String, hint| Err(IllegalField { offset, expected, found, hint });
        let index = u32_at(bytes, 4);
        match [bytes[0], bytes[1], bytes[2], bytes[3]] {
            END_MAGIC => {
                if index != frames {
                    let found = format!("an end mark after {index}");
                    return illegal(
                        4,
                        format!("{frames} frames, which arrived"),
                        found,
                        "frames were lost or repeated",
                    );
                }
                if bytes[8..].iter().any(|&byte| byte != 0) {
                    return illegal(8, "a reserved field of 0".into(), "another value".into(), "");
                }
                Ok(FrameMark::End(frames))
            }
            FRAME_MAGIC => {
                let time = f64::from_bits(u64_at(bytes, 8));
                let length = u64_at(bytes, 16);
                if index != frames {
                    let found = format!("frame {index}");
                    return illegal(4, format!("frame {frames}"), found, "frames come once each, in order");
                }
                if !time.is_finite() {
                    return illegal(8, "a time stamp".into(), time.to_string(), "");
                }
                if let Some(before) = before.filter(|&before| before >= time) {
                    let expected = format!("a time stamp above {before}, that of frame {}", frames - 1);
                    return illegal(8, expected, time.to_string(), "frames come in the order of their times");
                }
                if header.is_unlinked {
                    let fits = length.is_multiple_of(header.gaussian_bytes())
                        && length / header.gaussian_bytes() <= u64::from(u32::MAX);
                    if !fits {
                        let expected = format!("bytes of fewer than 2^32 Gaussians, {} each", header.gaussian_bytes());
                        return illegal(16, expected, format!("{length} bytes"), FOREIGN_OUTPUT);
                    }
                } else if length != header.frame_bytes() {
                    return illegal(16, expected_length(header), found_length(header, length), SAME_IN_EVERY_FRAME);
                }
                Ok(FrameMark::Frame { index, time, bytes: length })
            }
            _ => illegal(0, format!("frame {frames} or the end mark"), quoted(&escaped(&bytes[..4])), FOREIGN_OUTPUT),
        }
    }
}

/// Advice in error messages for a frame that has another length than the header requires.
const SAME_IN_EVERY_FRAME: &str = "every frame must hold the same Gaussians in the same columns";

/// Returns, as text for messages, the length in bytes that a frame must have according to the header.
fn expected_length(header: &StreamHeader) -> String {
    let names: Vec<&str> = header.varying.iter().map(Attributes::name).collect();
    format!("{} bytes: {} Gaussians of {}", header.frame_bytes(), header.count, names.join(", "))
}

/// Returns `length`, the wrong length of a frame in bytes, as text for messages. The text adds how many Gaussians have
/// this length, or that no number of Gaussians has it. `header` determines the bytes per Gaussian.
fn found_length(header: &StreamHeader, length: u64) -> String {
    let per_gaussian = 4 * header.varying.width(header.sh_degree) as u64;
    if length.checked_rem(per_gaussian) == Some(0) {
        return format!("{length} bytes, as {} Gaussians have", length / per_gaussian);
    }
    format!("{length} bytes, which no number of Gaussians of these columns has")
}

/// Returns bytes as text for messages; bytes that are not printable ASCII are escaped.
fn escaped(bytes: &[u8]) -> String {
    bytes.escape_ascii().to_string()
}

/// Returns the little-endian `u32` that begins at index `at` of `bytes`.
fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|i| bytes[at + i]))
}

/// Returns the little-endian `u64` that begins at index `at` of `bytes`.
fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(std::array::from_fn(|i| bytes[at + i]))
}

/// Compile-time check that the number of bytes of a frame fits into `u64` for every legal header.
const _: () = assert!((u32::MAX as u64).checked_mul(4 * (11 + 3 * sh_coefficient_count(3)) as u64).is_some());
