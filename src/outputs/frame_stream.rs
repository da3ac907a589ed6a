//! Writes a sequence as a frame stream, which another program reads from a pipe (format/STREAM.md).

use std::io::Write;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use crate::files::frame_stream::{FrameMark, StreamHeader};
use crate::model::{AttributeValues, Attributes, Gaussians};

/// Writer of a frame stream. The stream is complete only after [`StreamWriter::finish`].
#[derive(Debug)]
pub struct StreamWriter<W> {
    to: W,
    name: PathBuf,
    header: StreamHeader,
    frames: u32,
    last_time: Option<f64>,
}

impl<W: Write> StreamWriter<W> {
    /// Creates a writer of a stream to `to` and begins the stream: writes `header`, and the attributes of `constant`
    /// that are the same in all frames. `name` is the name of the stream in messages.
    ///
    /// # Errors
    /// Fails if an attribute has another length than `header` says, or if the stream cannot be written.
    pub fn new(to: W, name: &Path, header: StreamHeader, constant: &Gaussians) -> Result<StreamWriter<W>> {
        let mut stream = StreamWriter { to, name: name.to_owned(), header, frames: 0, last_time: None };
        stream.write_bytes(&header.to_bytes())?;
        stream.write_columns(Attributes::all().difference(header.varying), constant)?;
        Ok(stream)
    }

    /// Writes the next frame, at the time `time`: the attributes of `state` that vary with time.
    ///
    /// # Errors
    /// Fails if `time` is not finite or not later than the time of the frame before, if an attribute has another length
    /// than the header says, if there are more than 2³² − 1 frames, or if the stream cannot be written.
    pub fn write_frame(&mut self, time: f64, state: &Gaussians) -> Result<()> {
        let mark = FrameMark::Frame { index: self.frames, time, bytes: self.header.frame_bytes() }.to_bytes();
        // A reader would reject the mark (the record before each frame) for the same reason.
        if let Err(illegal) = FrameMark::from_bytes(&mark, &self.header, self.frames, self.last_time) {
            let (frame, expected, found) = (self.frames, illegal.expected, illegal.found);
            return Err(Error::usage(format!("frame {frame}: expected {expected}, found {found}")));
        }
        let Some(next) = self.frames.checked_add(1) else {
            return Err(Error::usage("a stream has fewer than 2^32 frames"));
        };
        self.write_bytes(&mark)?;
        self.write_columns(self.header.varying, state)?;
        (self.frames, self.last_time) = (next, Some(time));
        Ok(())
    }

    /// Writes the mark that ends the stream, and all bytes still in the buffer.
    pub fn finish(mut self) -> Result<()> {
        self.write_bytes(&FrameMark::End(self.frames).to_bytes())?;
        self.to.flush().map_err(Error::io("write", &self.name))
    }

    fn write_columns(&mut self, columns: Attributes, state: &Gaussians) -> Result<()> {
        for column in columns.iter() {
            let values: &AttributeValues = state.attribute_values(column);
            let (len, width) = (self.header.count, column.width(self.header.sh_degree));
            if (values.len(), values.width()) != (len, width) {
                let (name, found) = (column.name(), (values.len(), values.width()));
                return Err(Error::internal(format!("{name}: {} x {} values, not {len} x {width}", found.0, found.1)));
            }
            if cfg!(target_endian = "little") {
                self.write_bytes(bytemuck::cast_slice(values.planes()))?;
            } else {
                let bytes: Vec<u8> = values.planes().iter().flat_map(|value| value.to_le_bytes()).collect();
                self.write_bytes(&bytes)?;
            }
        }
        Ok(())
    }

    fn write_bytes(&mut self, bytes: &[u8]) -> Result<()> {
        self.to.write_all(bytes).map_err(Error::io("write", &self.name))
    }
}
