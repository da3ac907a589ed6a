//! A frame stream, as another program pipes it in (format/STREAM.md).
//!
//! In: bytes from anywhere. Out: the columns that hold for all frames, then frame after frame. Memory: the constant
//! columns and the frame that is read, both refused before they are read if they exceed the limit; nothing is allocated
//! for more than 1 MiB beyond twice the bytes received.

mod framing;
#[cfg(test)]
mod tests;

use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use crate::limits::ReadLimit;
use crate::model::{Column, Columns, Gaussians};
pub use framing::StreamHeader;
pub(crate) use framing::{FrameMark, Illegal};

/// Least bytes to make room for at a time.
const PIECE_BYTES: u64 = 1 << 20;

/// A stream whose header and constant columns have arrived.
#[derive(Debug)]
pub struct FrameStream<R> {
    bytes: Counted<R>,
    header: StreamHeader,
    constant: Gaussians,
    frames: u32,
    last_time: Option<f64>,
    ended: bool,
    memory: ReadLimit,
}

/// A source of bytes with the number of those that have come.
#[derive(Debug)]
struct Counted<R> {
    from: R,
    /// What messages call it.
    name: PathBuf,
    received: u64,
}

impl<R: Read> FrameStream<R> {
    /// Reads the header and the columns that hold for every frame. Messages call the stream `name`.
    ///
    /// # Errors
    /// A header that STREAM.md refuses; a stream that ends within; constant columns that exceed `memory`.
    pub fn open(from: R, name: &Path, memory: ReadLimit) -> Result<FrameStream<R>> {
        let mut bytes = Counted { from, name: name.to_owned(), received: 0 };
        let mut header = [0; StreamHeader::BYTES];
        let got = bytes.fill(&mut header)?;
        // What is no stream at all is better told by its first bytes than by its length.
        if got < header.len() && (got == 0 || header[..got.min(8)] == StreamHeader::MAGIC[..got.min(8)]) {
            return Err(bytes.ended("the header of a frame stream", None));
        }
        let header = StreamHeader::from_bytes(&header).map_err(|illegal| bytes.error(0, None, illegal))?;
        let mut constant = Gaussians::zeros(0, header.sh_degree);
        let columns = Columns::all().difference(header.varying);
        let announced = 4 * columns.width(header.sh_degree) as u64 * header.count as u64;
        memory.check(name, "byte 16", &format!("the constant columns of {} Gaussians", header.count), announced)?;
        for column in columns.iter() {
            if !bytes.column(header.count, constant.column_mut(column))? {
                return Err(bytes.ended(&format!("the constant column {}", column.name()), None));
            }
        }
        Ok(FrameStream { bytes, header, constant, frames: 0, last_time: None, ended: false, memory })
    }

    /// What the stream said of itself.
    pub fn header(&self) -> &StreamHeader {
        &self.header
    }

    /// The columns that hold for every frame; the others are empty.
    pub fn constant(&self) -> &Gaussians {
        &self.constant
    }

    /// The columns that do not vary; [`FrameStream::constant`] has none afterwards.
    pub fn take_constant(&mut self) -> Gaussians {
        std::mem::take(&mut self.constant)
    }

    /// Bytes that have come so far.
    pub fn received(&self) -> u64 {
        self.bytes.received
    }

    /// Reads the next frame: writes the columns that come with every frame into `out`, whose others are left
    /// alone, and gives its time; none after the end mark.
    ///
    /// # Errors
    /// Everything STREAM.md calls one, with the frame and the byte; a frame that exceeds the memory limit; a failed
    /// read. The stream is of no use afterwards.
    pub fn next_frame(&mut self, out: &mut Gaussians) -> Result<Option<f64>> {
        if self.ended {
            return Ok(None);
        }
        let (start, frame) = (self.bytes.received, self.frames);
        let mut mark = [0; FrameMark::BYTES];
        if self.bytes.fill(&mut mark)? < mark.len() {
            return Err(self.bytes.ended(&format!("frame {frame} or the end mark"), Some(frame)));
        }
        let mark = FrameMark::from_bytes(&mark, &self.header, frame, self.last_time)
            .map_err(|illegal| self.bytes.error(start, Some(frame), illegal))?;
        let FrameMark::Frame { time, bytes, .. } = mark else {
            self.ended = true;
            return self.expect_nothing().map(|()| None);
        };
        self.memory.check(&self.bytes.name, &place(start + 16, Some(frame)), "one frame", bytes)?;
        let count = match self.header.is_unlinked {
            true => (bytes / self.header.gaussian_bytes()) as usize,
            false => self.header.count,
        };
        for column in self.header.varying.iter() {
            if !self.bytes.column(count, out.column_mut(column))? {
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

    fn expect_nothing(&mut self) -> Result<()> {
        let mut more = [0];
        let place = format!("byte {}", self.bytes.received);
        if self.bytes.fill(&mut more)? == 0 {
            return Ok(());
        }
        Err(Error::input(&self.bytes.name, place, "nothing after the end mark", "more bytes")
            .hint("one stream at a time; whatever the exporter prints must go to standard error"))
    }
}

impl<R: Read> Counted<R> {
    /// Reads until `into` is full or the stream ends; gives the number of bytes that came.
    fn fill(&mut self, into: &mut [u8]) -> Result<usize> {
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

    /// Reads a column of `len` Gaussians; whether all of it came.
    fn column(&mut self, len: usize, column: &mut Column) -> Result<bool> {
        if column.len() != len {
            let Some(planes) = self.grow(len * column.width())? else { return Ok(false) };
            *column = Column::from_planes(column.width(), planes);
            return Ok(true);
        }
        self.values(column.planes_mut())
    }

    /// Reads `count` values for which there is no room yet; none if the stream ends before.
    fn grow(&mut self, count: usize) -> Result<Option<Vec<f32>>> {
        let mut values: Vec<f32> = Vec::new();
        while values.len() < count {
            let start = values.len();
            let more = (self.received.max(PIECE_BYTES) / 4).min((count - start) as u64) as usize;
            values.reserve_exact(more);
            values.resize(start + more, 0.0);
            if !self.values(&mut values[start..])? {
                return Ok(None);
            }
        }
        Ok(Some(values))
    }

    fn values(&mut self, values: &mut [f32]) -> Result<bool> {
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(values);
        let expected = bytes.len();
        let all = self.fill(bytes)? == expected;
        for value in values {
            *value = f32::from_bits(u32::from_le(value.to_bits()));
        }
        Ok(all)
    }

    fn error(&self, start: u64, frame: Option<u32>, illegal: Illegal) -> Error {
        let Illegal { offset, expected, found, hint } = illegal;
        Error::input(&self.name, place(start + offset, frame), expected, found).hint(hint)
    }

    /// The stream ended where `expected` should have come, after `frames` complete ones.
    fn ended(&self, expected: &str, frames: Option<u32>) -> Error {
        let found = match frames {
            None => "the end of the stream, before its first frame".to_owned(),
            Some(1) => "the end of the stream: it ended after 1 complete frame, without its end mark".to_owned(),
            Some(frames) => {
                format!("the end of the stream: it ended after {frames} complete frames, without its end mark")
            }
        };
        Error::input(&self.name, place(self.received, frames), expected, found)
            .hint("the exporter stopped early; what it says on standard error tells why")
    }
}

fn place(byte: u64, frame: Option<u32>) -> String {
    frame.map_or(format!("byte {byte}"), |frame| format!("frame {frame}, byte {byte}"))
}
