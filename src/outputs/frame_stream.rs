//! A sequence as a frame stream, for another program to read from a pipe (format/STREAM.md).

use std::io::Write;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use crate::files::frame_stream::{FrameMark, StreamHeader};
use crate::model::{Column, Columns, Gaussians};

/// A stream being written. What it has written is no stream until [`StreamWriter::finish`].
#[derive(Debug)]
pub struct StreamWriter<W> {
    to: W,
    name: PathBuf,
    header: StreamHeader,
    frames: u32,
    last_time: Option<f64>,
}

impl<W: Write> StreamWriter<W> {
    /// Writes the header and, from `constant`, the columns that hold for every frame. Messages call the
    /// stream `name`.
    ///
    /// # Errors
    /// Columns of another length than the header says; a failed write.
    pub fn new(to: W, name: &Path, header: StreamHeader, constant: &Gaussians) -> Result<StreamWriter<W>> {
        let mut stream = StreamWriter { to, name: name.to_owned(), header, frames: 0, last_time: None };
        stream.put(&header.to_bytes())?;
        stream.columns(Columns::all().difference(header.varying), constant)?;
        Ok(stream)
    }

    /// Writes the next frame: of `state` the columns that come with every frame.
    ///
    /// # Errors
    /// A time that is not finite or not above the last; columns of another length; more than 2³² − 1 frames;
    /// a failed write.
    pub fn frame(&mut self, time: f64, state: &Gaussians) -> Result<()> {
        let mark = FrameMark::Frame { index: self.frames, time, bytes: self.header.frame_bytes() }.to_bytes();
        // A reader would refuse it for the same reason.
        if let Err(illegal) = FrameMark::from_bytes(&mark, &self.header, self.frames, self.last_time) {
            let (frame, expected, found) = (self.frames, illegal.expected, illegal.found);
            return Err(Error::usage(format!("frame {frame}: expected {expected}, found {found}")));
        }
        let Some(next) = self.frames.checked_add(1) else {
            return Err(Error::usage("a stream has fewer than 2^32 frames"));
        };
        self.put(&mark)?;
        self.columns(self.header.varying, state)?;
        (self.frames, self.last_time) = (next, Some(time));
        Ok(())
    }

    /// Writes the end mark and whatever was held back.
    pub fn finish(mut self) -> Result<()> {
        self.put(&FrameMark::End(self.frames).to_bytes())?;
        self.to.flush().map_err(Error::io("write", &self.name))
    }

    fn columns(&mut self, columns: Columns, state: &Gaussians) -> Result<()> {
        for column in columns.iter() {
            let values: &Column = state.column(column);
            let (len, width) = (self.header.count, column.width(self.header.sh_degree));
            if (values.len(), values.width()) != (len, width) {
                let (name, found) = (column.name(), (values.len(), values.width()));
                return Err(Error::internal(format!("{name}: {} x {} values, not {len} x {width}", found.0, found.1)));
            }
            if cfg!(target_endian = "little") {
                self.put(bytemuck::cast_slice(values.planes()))?;
            } else {
                let bytes: Vec<u8> = values.planes().iter().flat_map(|value| value.to_le_bytes()).collect();
                self.put(&bytes)?;
            }
        }
        Ok(())
    }

    fn put(&mut self, bytes: &[u8]) -> Result<()> {
        self.to.write_all(bytes).map_err(Error::io("write", &self.name))
    }
}
