//! Moving pictures as files: an animated PNG or GIF, or what `ffmpeg` makes of the frames.
//!
//! In: images, one after the other, all of one size. Out: a file. Memory: one frame; the encoder's own is its business.

use std::env;
use std::fs::File;
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::thread::JoinHandle;

use crate::error::{Error, Result, ShowPath};
use crate::files::image::write::{png_error_to_io, rgb};
use crate::render::Image;

/// Program that encodes what this one does not.
const ENCODER: &str = "ffmpeg";
/// How well colors of a GIF are chosen: 1 is best, 30 fastest; 10 is what its author took.
const GIF_SPEED: i32 = 10;
/// Bytes kept of what the encoder says.
const SAID: u64 = 1 << 16;

/// How a film is stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FilmFormat {
    /// Animated PNG: every bit of every frame.
    Apng,
    /// Animated GIF: 256 colors a frame, delays of whole hundredths of a second.
    Gif,
    /// Encoded by the program at this path.
    Encoded(PathBuf, Codec),
}

/// What the encoder makes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Codec {
    /// H.264 in MP4.
    Mp4,
    /// VP9 in WebM.
    WebM,
}

impl FilmFormat {
    /// The format that a file's name asks for.
    ///
    /// # Errors
    /// A name that asks for none; one that asks for an encoder that is not there.
    pub fn from_path(path: &Path) -> Result<FilmFormat> {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        let codec = match extension.as_str() {
            "png" | "apng" => return Ok(FilmFormat::Apng),
            "gif" => return Ok(FilmFormat::Gif),
            "mp4" => Codec::Mp4,
            "webm" => Codec::WebM,
            _ => {
                return Err(Error::usage(format!(
                    "{}: expected a name that ends in .png, .apng, .gif, .mp4 or .webm",
                    path.shown()
                )));
            }
        };
        let name = format!("{ENCODER}{}", env::consts::EXE_SUFFIX);
        let folders = env::var_os("PATH").unwrap_or_default();
        let found = env::split_paths(&folders).map(|folder| folder.join(&name)).find(|file| file.is_file());
        found.map(|program| FilmFormat::Encoded(program, codec)).ok_or_else(|| {
            Error::usage(format!(
                "{}: {ENCODER}, which makes .{extension}, is in no folder of PATH\n  install it (Debian: apt-get install \
                 {ENCODER}), or give a name that ends in .png (every bit, large) or .gif (256 colours a frame)",
                path.shown()
            ))
        })
    }
}

/// A film that is being written.
pub struct FilmOutput {
    /// As the user named it.
    shown: PathBuf,
    size: (u32, u32),
    fps: u32,
    frames: u32,
    added: u32,
    writer: FilmWriter,
}

enum FilmWriter {
    Apng(Box<png::Writer<BufWriter<File>>>),
    Gif(Box<gif::Encoder<BufWriter<File>>>),
    Encoder(FrameEncoder),
}

impl FilmOutput {
    /// Begins a film of `frames` frames of `size` (width, height), `fps` a second, in the file `path`; errors name `shown`.
    ///
    /// # Errors
    /// A size that the format does not have; the system refuses; an encoder that cannot be run.
    pub fn create(
        (path, shown): (&Path, &Path),
        format: &FilmFormat,
        size: (u32, u32),
        frames: u32,
        fps: u32,
    ) -> Result<FilmOutput> {
        let failed = |error: io::Error| Error::io("write", shown)(error);
        let file = || File::create(path).map(BufWriter::new).map_err(Error::io("create", shown));
        let writer = match format {
            FilmFormat::Apng => {
                let mut encoder = png::Encoder::new(file()?, size.0, size.1);
                encoder.set_color(png::ColorType::Rgb);
                encoder.set_depth(png::BitDepth::Eight);
                let mut begin = || {
                    encoder.set_animated(frames, 0)?;
                    encoder.set_frame_delay(1, fps.try_into().unwrap_or(u16::MAX))
                };
                begin().map_err(|error| failed(png_error_to_io(error)))?;
                FilmWriter::Apng(Box::new(encoder.write_header().map_err(|error| failed(png_error_to_io(error)))?))
            }
            FilmFormat::Gif => {
                let [width, height] = gif_size(size).map_err(failed)?;
                let mut encoder =
                    gif::Encoder::new(file()?, width, height, &[]).map_err(|error| failed(of_gif(error)))?;
                encoder.set_repeat(gif::Repeat::Infinite).map_err(|error| failed(of_gif(error)))?;
                FilmWriter::Gif(Box::new(encoder))
            }
            FilmFormat::Encoded(program, codec) => {
                FilmWriter::Encoder(FrameEncoder::start(program, *codec, path, size, fps).map_err(failed)?)
            }
        };
        Ok(FilmOutput { shown: shown.to_owned(), size, fps, frames, added: 0, writer })
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// A frame of another size; the system refuses; an encoder that gave up, with what it said.
    pub fn add(&mut self, image: &Image) -> Result<()> {
        let added = if (image.width, image.height) == self.size {
            self.write(image)
        } else {
            let (width, height) = self.size;
            Err(io::Error::other(format!(
                "frames of {width}x{height} pixels, then one of {}x{}",
                image.width, image.height
            )))
        };
        added.map_err(Error::io("write", &self.shown))?;
        self.added += 1;
        Ok(())
    }

    fn write(&mut self, image: &Image) -> io::Result<()> {
        let bytes = rgb(image);
        match &mut self.writer {
            FilmWriter::Apng(writer) => writer.write_image_data(&bytes).map_err(png_error_to_io),
            FilmWriter::Gif(encoder) => {
                let [width, height] = gif_size(self.size)?;
                let mut frame = gif::Frame::from_rgb_speed(width, height, &bytes, GIF_SPEED);
                // Of the whole film as long as it should be, to half a hundredth of a second.
                let until = |frame: u32| (2 * 100 * u64::from(frame) + u64::from(self.fps)) / (2 * u64::from(self.fps));
                frame.delay = (until(self.added + 1) - until(self.added)) as u16;
                encoder.write_frame(&frame).map_err(of_gif)
            }
            FilmWriter::Encoder(encoder) => encoder.write(&bytes),
        }
    }

    /// Ends the film.
    ///
    /// # Errors
    /// Fewer frames than were promised; the system refuses; an encoder that failed, with what it said.
    pub fn finish(self) -> Result<()> {
        if self.added != self.frames {
            let few = io::Error::other(format!("{} frames of {}", self.added, self.frames));
            return Err(Error::io("write", &self.shown)(few));
        }
        let finished = match self.writer {
            FilmWriter::Apng(writer) => writer.finish().map_err(png_error_to_io),
            FilmWriter::Gif(encoder) => encoder.into_inner().map_err(of_gif).and_then(|mut file| file.flush()),
            FilmWriter::Encoder(encoder) => encoder.finish(),
        };
        finished.map_err(Error::io("write", &self.shown))
    }
}

fn gif_size((width, height): (u32, u32)) -> io::Result<[u16; 2]> {
    match (width.try_into(), height.try_into()) {
        (Ok(width), Ok(height)) => Ok([width, height]),
        _ => Err(io::Error::other(format!("a GIF has 65535 pixels each way at most, found {width}x{height}"))),
    }
}

fn of_gif(error: gif::EncodingError) -> io::Error {
    match error {
        gif::EncodingError::Io(error) => error,
        other => io::Error::other(other),
    }
}

/// The encoder at work.
struct FrameEncoder {
    child: Child,
    /// None: there is nothing more to come.
    to: Option<ChildStdin>,
    /// Gathers what it says.
    said: Option<JoinHandle<String>>,
}

impl FrameEncoder {
    fn start(
        program: &Path,
        codec: Codec,
        path: &Path,
        (width, height): (u32, u32),
        fps: u32,
    ) -> io::Result<FrameEncoder> {
        let mut command = Command::new(program);
        command.args(["-hide_banner", "-loglevel", "error", "-nostdin", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
        command.args(["-s", &format!("{width}x{height}"), "-r", &fps.to_string(), "-i", "pipe:0", "-an"]);
        // Players want colors at half the resolution, and for that even sizes.
        command.args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]);
        command.args(match codec {
            Codec::Mp4 => &["-c:v", "libx264", "-crf", "18", "-movflags", "+faststart", "-f", "mp4"][..],
            Codec::WebM => &["-c:v", "libvpx-vp9", "-crf", "24", "-b:v", "0", "-f", "webm"],
        });
        command.arg(path).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = command
            .spawn()
            .map_err(|error| io::Error::new(error.kind(), format!("cannot run {}: {error}", program.shown())))?;
        let to = child.stdin.take();
        let said = child.stderr.take().map(|mut from| {
            std::thread::spawn(move || {
                let mut said = Vec::new();
                let _ = from.by_ref().take(SAID).read_to_end(&mut said);
                // Whoever cannot say more would wait for ever.
                let _ = io::copy(&mut from, &mut io::sink());
                String::from_utf8_lossy(&said).into_owned()
            })
        });
        Ok(FrameEncoder { child, to, said })
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let Some(to) = &mut self.to else { return Err(io::Error::other(format!("{ENCODER} has ended"))) };
        match to.write_all(bytes) {
            // It has ended; how, and what it said, says more.
            Err(_) => Err(self.end().err().unwrap_or_else(|| io::Error::other(format!("{ENCODER} ended too early")))),
            Ok(()) => Ok(()),
        }
    }

    fn finish(mut self) -> io::Result<()> {
        self.end()
    }

    fn end(&mut self) -> io::Result<()> {
        self.to = None;
        let status = self.child.wait()?;
        let said = self.said.take().and_then(|said| said.join().ok()).unwrap_or_default();
        match status.success() {
            true => Ok(()),
            false => Err(io::Error::other(format!("{ENCODER} ended with {status}: {}", said.trim()))),
        }
    }
}

impl Drop for FrameEncoder {
    fn drop(&mut self) {
        // After `end` there is nobody to be stopped.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gif_lasts_as_long_as_its_frames_a_second_say() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.gif");
        let mut film = FilmOutput::create((&path, &path), &FilmFormat::Gif, (4, 3), 60, 24).unwrap();
        for _ in 0..60 {
            film.add(&Image { width: 4, height: 3, data: vec![0.25; 36] }).unwrap();
        }
        film.finish().unwrap();
        let mut decoder = gif::DecodeOptions::new().read_info(File::open(&path).unwrap()).unwrap();
        let mut delays = Vec::new();
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            delays.push(frame.delay);
        }
        assert_eq!((delays.len(), delays.iter().sum::<u16>()), (60, 250), "60 frames of 24 a second are 2.5 s");
        assert!(delays.iter().all(|delay| (4..=5).contains(delay)), "{delays:?}");
    }

    #[test]
    fn names_that_ask_for_no_film_and_frames_of_another_size_are_refused() {
        for name in ["x", "x.npy", "film.avi"] {
            let message = FilmFormat::from_path(Path::new(name)).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains(".gif, .mp4"), "{message}");
        }
        assert_eq!(FilmFormat::from_path(Path::new("A.APNG")).unwrap(), FilmFormat::Apng);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.png");
        let mut film = FilmOutput::create((&path, &path), &FilmFormat::Apng, (4, 3), 2, 10).unwrap();
        let message = film.add(&Image { width: 3, height: 3, data: vec![0.0; 27] }).unwrap_err().to_string();
        assert!(message.contains("4x3") && message.contains("3x3"), "{message}");
        assert!(film.finish().is_err(), "a film of two frames has none");
    }
}
