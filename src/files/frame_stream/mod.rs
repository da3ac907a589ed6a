//! Reads a frame stream that another program writes to a pipe (format/STREAM.md).
//!
//! Input: bytes from any source. Output: the attributes that are constant over all frames, then one frame after
//! another. Memory: the constant attributes and the current frame. If they exceed the memory limit, they are refused
//! before they are read. The memory grows only as bytes arrive: it exceeds twice the number of bytes received by at
//! most 1 MiB, whatever the header declares.

mod framing;
#[cfg(test)]
mod tests;

use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use crate::limits::ReadLimit;
use crate::model::{AttributeValues, Attributes, Gaussians};
pub use framing::StreamHeader;
pub(crate) use framing::{FrameMark, IllegalField};

/// Minimum number of bytes by which the buffer for received values grows. Each time, it grows by the number of bytes
/// received so far, but at least by this number.
const MIN_ALLOCATION_BYTES: u64 = 1 << 20;

/// Frame stream of which the header and the constant attributes have been read.
#[derive(Debug)]
pub struct FrameStream<R> {
    bytes: CountingReader<R>,
    header: StreamHeader,
    constant: Gaussians,
    frames: u32,
    last_time: Option<f64>,
    ended: bool,
    memory: ReadLimit,
    /// Mark that was read ahead of its frame.
    next_mark: Option<FrameMark>,
    /// Whether the same index means the same Gaussian in every frame, although the stream does not say so.
    has_common_indices: bool,
}

/// Source of bytes that counts how many it has delivered.
#[derive(Debug)]
struct CountingReader<R> {
    from: R,
    /// Name of the stream in error messages.
    name: PathBuf,
    received: u64,
}

impl<R: Read> FrameStream<R> {
    /// Reads the header and the attributes that are constant over all frames from the source `from`. `name` is the name
    /// of the stream in error messages.
    ///
    /// # Errors
    /// Fails if the header violates format/STREAM.md, if the stream ends early, or if the constant attributes need more
    /// than `memory`.
    pub fn open(from: R, name: &Path, memory: ReadLimit) -> Result<FrameStream<R>> {
        let mut bytes = CountingReader { from, name: name.to_owned(), received: 0 };
        let mut header = [0; StreamHeader::BYTES];
        let got = bytes.read_up_to(&mut header)?;
        // Report a stream that ends within the header only if its first bytes are those of a frame stream. Otherwise
        // the error names these bytes.
        if got < header.len() && (got == 0 || header[..got.min(8)] == StreamHeader::MAGIC[..got.min(8)]) {
            return Err(bytes.ended("the header of a frame stream", None));
        }
        let header = StreamHeader::from_bytes(&header, got).map_err(|illegal| bytes.error(0, None, illegal))?;
        let mut constant = Gaussians::zeros(0, header.sh_degree);
        let columns = Attributes::all().difference(header.varying);
        let announced = 4 * columns.width(header.sh_degree) as u64 * header.count as u64;
        memory.check(name, "byte 16", &format!("the constant columns of {} Gaussians", header.count), announced)?;
        for column in columns.iter() {
            if !bytes.read_attribute(header.count, constant.attribute_values_mut(column))? {
                return Err(bytes.ended(&format!("the constant column {}", column.name()), None));
            }
        }
        Ok(FrameStream {
            bytes,
            header,
            constant,
            frames: 0,
            last_time: None,
            ended: false,
            memory,
            next_mark: None,
            has_common_indices: false,
        })
    }

    /// Returns this stream of unlinked frames as one in which the same index means the same Gaussian in every frame.
    /// The mark of the first frame gives the number of Gaussians in the header; later frames must have as many.
    ///
    /// # Errors
    /// Fails if the mark violates format/STREAM.md, or if the stream has no frames.
    pub fn with_common_indices(mut self) -> Result<FrameStream<R>> {
        let mark = self.read_mark()?;
        let FrameMark::Frame { bytes, .. } = mark else {
            return Err(Error::input(&self.bytes.name, "", "at least one frame", "the end of the stream"));
        };
        self.header.count = (bytes / self.header.gaussian_bytes()) as usize;
        (self.next_mark, self.has_common_indices) = (Some(mark), true);
        Ok(self)
    }

    /// Returns the header of the stream.
    pub fn header(&self) -> &StreamHeader {
        &self.header
    }

    /// Takes the attributes that are constant over all frames. In the returned value, the varying attributes are empty.
    pub fn take_constant_attributes(&mut self) -> Gaussians {
        std::mem::take(&mut self.constant)
    }

    /// Returns the number of bytes received so far.
    pub fn received_bytes(&self) -> u64 {
        self.bytes.received
    }

    /// Reads the next frame. Writes its varying attributes into `out`, leaves the other attributes of `out` unchanged,
    /// and returns the time of the frame. Returns `None` after the end mark.
    ///
    /// # Errors
    /// Fails if the stream violates format/STREAM.md (the message names the frame and the byte), if a frame exceeds the
    /// memory limit, or if reading fails. The stream cannot be used afterwards.
    pub fn next_frame(&mut self, out: &mut Gaussians) -> Result<Option<f64>> {
        if self.ended {
            return Ok(None);
        }
        let frame = self.frames;
        let mark = match self.next_mark.take() {
            Some(mark) => mark,
            None => self.read_mark()?,
        };
        let length_place = place(self.bytes.received - FrameMark::BYTES as u64 + 16, Some(frame));
        let FrameMark::Frame { time, bytes, .. } = mark else {
            self.ended = true;
            return self.expect_end().map(|()| None);
        };
        self.memory.check(&self.bytes.name, &length_place, "one frame", bytes)?;
        let count = match self.header.is_unlinked {
            true => (bytes / self.header.gaussian_bytes()) as usize,
            false => self.header.count,
        };
        if self.has_common_indices && count != self.header.count {
            let expected = format!("{} Gaussians, as in frame 0", self.header.count);
            return Err(Error::input(&self.bytes.name, length_place, expected, format!("{count} Gaussians")).hint(
                "with --link never, every frame must hold the same Gaussians in the same order; leave it out to \
                     link frames",
            ));
        }
        for column in self.header.varying.iter() {
            if !self.bytes.read_attribute(count, out.attribute_values_mut(column))? {
                let expected = format!("the rest of frame {frame} (column {})", column.name());
                return Err(self.bytes.ended(&expected, Some(frame)));
            }
        }
        let Some(next) = frame.checked_add(1) else {
            let place = format!("frame {frame}");
            return Err(Error::input(&self.bytes.name, place, "fewer than 2^32 frames", "more"));
        };
        (self.frames, self.last_time) = (next, Some(time));
        Ok(Some(time))
    }

    /// Reads the mark before the next frame or at the end of the stream.
    fn read_mark(&mut self) -> Result<FrameMark> {
        let (start, frame) = (self.bytes.received, self.frames);
        let mut mark = [0; FrameMark::BYTES];
        if self.bytes.read_up_to(&mut mark)? < mark.len() {
            return Err(self.bytes.ended(&format!("frame {frame} or the end mark"), Some(frame)));
        }
        FrameMark::from_bytes(&mark, &self.header, frame, self.last_time)
            .map_err(|illegal| self.bytes.error(start, Some(frame), illegal))
    }

    /// Checks that no bytes follow the end mark.
    fn expect_end(&mut self) -> Result<()> {
        let mut more = [0];
        let place = format!("byte {}", self.bytes.received);
        if self.bytes.read_up_to(&mut more)? == 0 {
            return Ok(());
        }
        Err(Error::input(&self.bytes.name, place, "nothing after the end mark", "more bytes")
            .hint("one stream at a time; whatever the exporter prints must go to standard error"))
    }
}

impl<R: Read> CountingReader<R> {
    /// Reads bytes until `into` is full or the stream ends. Returns the number of bytes read.
    fn read_up_to(&mut self, into: &mut [u8]) -> Result<usize> {
        let mut got = 0;
        while got < into.len() {
            match self.from.read(&mut into[got..]) {
                Ok(0) => break,
                Ok(more) => got += more,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(Error::io("read", &self.name)(error)),
            }
        }
        self.received += got as u64;
        Ok(got)
    }

    /// Reads the values of one attribute for `len` Gaussians into `column`, which is resized if it has another length.
    /// Returns false if the stream ends early.
    fn read_attribute(&mut self, len: usize, column: &mut AttributeValues) -> Result<bool> {
        if column.len() != len {
            let Some(planes) = self.read_new_values(len * column.width())? else { return Ok(false) };
            *column = AttributeValues::from_planes(column.width(), planes);
            return Ok(true);
        }
        self.read_values(column.planes_mut())
    }

    /// Reads `count` values into a new buffer, which grows as bytes arrive. Returns `None` if the stream ends early.
    fn read_new_values(&mut self, count: usize) -> Result<Option<Vec<f32>>> {
        let mut values: Vec<f32> = Vec::new();
        while values.len() < count {
            let start = values.len();
            let more = (self.received.max(MIN_ALLOCATION_BYTES) / 4).min((count - start) as u64) as usize;
            values.reserve_exact(more);
            values.resize(start + more, 0.0);
            if !self.read_values(&mut values[start..])? {
                return Ok(None);
            }
        }
        Ok(Some(values))
    }

    /// Reads little-endian f32 values until `values` is full. Returns false if the stream ends early.
    fn read_values(&mut self, values: &mut [f32]) -> Result<bool> {
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(values);
        let expected = bytes.len();
        let all = self.read_up_to(bytes)? == expected;
        for value in values {
            *value = f32::from_bits(u32::from_le(value.to_bits()));
        }
        Ok(all)
    }

    /// Returns the error for the illegal field `illegal` of the header or of a mark. A mark stands before every frame
    /// and at the end of the stream. The header or mark begins at byte `start` of the stream. `frame` is the number of
    /// the frame that was expected at the mark; `None` for the header.
    fn error(&self, start: u64, frame: Option<u32>, illegal: IllegalField) -> Error {
        let IllegalField { offset, expected, found, hint } = illegal;
        Error::input(&self.name, place(start + offset, frame), expected, found).hint(hint)
    }

    /// Returns the error for a stream that ended early. `expected` describes what should have followed. `frames` is the
    /// number of complete frames before the end; `None` if the stream ended in its header or constant attributes.
    fn ended(&self, expected: &str, frames: Option<u32>) -> Error {
        let found = match frames {
            None => "the end of the stream, before its first frame".to_owned(),
            Some(1) => "the end of the stream: it ended after 1 complete frame, without its end mark".to_owned(),
            Some(frames) => {
                format!("the end of the stream: it ended after {frames} complete frames, without its end mark")
            }
        };
        Error::input(&self.name, place(self.received, frames), expected, found)
            .hint("the exporter stopped early; its messages on standard error may tell why")
    }
}

/// Returns the text by which messages name the position `byte` in the stream, and the frame, if there is one.
fn place(byte: u64, frame: Option<u32>) -> String {
    frame.map_or(format!("byte {byte}"), |frame| format!("frame {frame}, byte {byte}"))
}
