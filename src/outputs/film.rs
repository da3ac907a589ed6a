//! Films: an animated PNG or GIF, or a video that the program `ffmpeg` encodes.
//!
//! Input: images of one size, one after the other. Output: a file. Memory: one frame, in addition to the memory of the
//! encoder.

use std::env;
use std::fs::File;
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::thread::JoinHandle;

use crate::error::{Error, Result, ShowPath};
use crate::files::image::write::{png_error_to_io, rgb};
use crate::render::Image;

/// Name of the program that encodes video formats.
const ENCODER: &str = "ffmpeg";
/// Speed of the color selection of a GIF, from 1 (best colors) to 30 (fastest). The library recommends 10 as a
/// compromise.
const GIF_SPEED: i32 = 10;
/// Maximum number of bytes of the encoder's messages that are kept and shown if the encoder fails.
const MAX_MESSAGE_BYTES: u64 = 1 << 16;

/// File format of a film.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FilmFormat {
    /// Animated PNG, which stores every frame without loss.
    Apng,
    /// Animated GIF: 256 colors per frame, delays in whole hundredths of a second.
    Gif,
    /// Video. The first field is the path of the program that encodes it, the second its codec and container format.
    Encoded(PathBuf, Codec),
}

/// Video codec and container format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Codec {
    /// H.264 in MP4.
    Mp4,
    /// VP9 in WebM.
    WebM,
}

impl FilmFormat {
    /// Returns the film format for the file name ending of `path`.
    ///
    /// # Errors
    /// Fails if the ending is not that of a film format, or if the format needs an encoder that is not installed.
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
                "{}: {ENCODER}, which makes .{extension}, is in no folder of PATH\n  install it (Debian: apt-get \
                 install {ENCODER}), or give a name that ends in .png (every bit, large) or .gif (256 colors a frame)",
                path.shown()
            ))
        })
    }
}

/// Writer of a film to a file.
pub struct FilmOutput {
    /// Path of the film as the user named it, for messages.
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
    /// Creates the film `path`. It will have `frames` frames of `size` (width, height) pixels and show `fps` frames per
    /// second. Messages name the path `shown` instead of `path`.
    ///
    /// # Errors
    /// Fails if the format cannot have that size, if the file cannot be created, or if the encoder cannot be run.
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
                    gif::Encoder::new(file()?, width, height, &[]).map_err(|error| failed(gif_error_to_io(error)))?;
                encoder.set_repeat(gif::Repeat::Infinite).map_err(|error| failed(gif_error_to_io(error)))?;
                FilmWriter::Gif(Box::new(encoder))
            }
            FilmFormat::Encoded(program, codec) => {
                FilmWriter::Encoder(FrameEncoder::start(program, *codec, path, size, fps).map_err(failed)?)
            }
        };
        Ok(FilmOutput { shown: shown.to_owned(), size, fps, frames, added: 0, writer })
    }

    /// Adds the next frame, `image`.
    ///
    /// # Errors
    /// Fails if the frame has another size, if it cannot be written, or if the encoder ended early; the message then
    /// contains the encoder's output.
    pub fn add_frame(&mut self, image: &Image) -> Result<()> {
        let added = if (image.width, image.height) == self.size {
            self.write(image)
        } else {
            let (width, height) = self.size;
            Err(io::Error::other(format!(
                "expected frames of {width}x{height} pixels, found one of {}x{}",
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
                // Returns the time up to a frame in hundredths of a second, rounded, so that each frame starts within
                // half a hundredth of its exact time.
                let hundredths_until =
                    |frame: u32| (2 * 100 * u64::from(frame) + u64::from(self.fps)) / (2 * u64::from(self.fps));
                frame.delay = (hundredths_until(self.added + 1) - hundredths_until(self.added)) as u16;
                encoder.write_frame(&frame).map_err(gif_error_to_io)
            }
            FilmWriter::Encoder(encoder) => encoder.write(&bytes),
        }
    }

    /// Completes the film file.
    ///
    /// # Errors
    /// Fails if fewer frames were added than announced, if the file cannot be written, or if the encoder failed; the
    /// message contains the encoder's output.
    pub fn finish(self) -> Result<()> {
        if self.added != self.frames {
            let missing = io::Error::other(format!("expected {} frames, found {}", self.frames, self.added));
            return Err(Error::io("write", &self.shown)(missing));
        }
        let finished = match self.writer {
            FilmWriter::Apng(writer) => writer.finish().map_err(png_error_to_io),
            FilmWriter::Gif(encoder) => encoder.into_inner().map_err(gif_error_to_io).and_then(|mut file| file.flush()),
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

fn gif_error_to_io(error: gif::EncodingError) -> io::Error {
    match error {
        gif::EncodingError::Io(error) => error,
        other => io::Error::other(other),
    }
}

/// Running process of the program `ffmpeg`.
struct FrameEncoder {
    child: Child,
    /// Standard input of the encoder process; `None` after it was closed.
    stdin: Option<ChildStdin>,
    /// Thread that collects the messages of the encoder process.
    messages: Option<JoinHandle<String>>,
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
        // Players need color at half the resolution, so width and height must be even.
        command.args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]);
        command.args(match codec {
            Codec::Mp4 => &["-c:v", "libx264", "-crf", "18", "-movflags", "+faststart", "-f", "mp4"][..],
            Codec::WebM => &["-c:v", "libvpx-vp9", "-crf", "24", "-b:v", "0", "-f", "webm"],
        });
        command.arg(path).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = command
            .spawn()
            .map_err(|error| io::Error::new(error.kind(), format!("cannot run {}: {error}", program.shown())))?;
        let stdin = child.stdin.take();
        let messages = child.stderr.take().map(|mut stderr| {
            std::thread::spawn(move || {
                let mut messages = Vec::new();
                let _ = stderr.by_ref().take(MAX_MESSAGE_BYTES).read_to_end(&mut messages);
                // Reads on, because the encoder would block if nobody read its output.
                let _ = io::copy(&mut stderr, &mut io::sink());
                String::from_utf8_lossy(&messages).into_owned()
            })
        });
        Ok(FrameEncoder { child, stdin, messages })
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let Some(stdin) = &mut self.stdin else { return Err(io::Error::other(format!("{ENCODER} has ended"))) };
        match stdin.write_all(bytes) {
            // Writing failed because the encoder has ended; its exit status and messages describe the cause.
            Err(_) => Err(self.end().err().unwrap_or_else(|| io::Error::other(format!("{ENCODER} ended too early")))),
            Ok(()) => Ok(()),
        }
    }

    fn finish(mut self) -> io::Result<()> {
        self.end()
    }

    fn end(&mut self) -> io::Result<()> {
        self.stdin = None;
        let status = self.child.wait()?;
        let messages = self.messages.take().and_then(|messages| messages.join().ok()).unwrap_or_default();
        match status.success() {
            true => Ok(()),
            false => Err(io::Error::other(format!("{ENCODER} ended with {status}: {}", messages.trim()))),
        }
    }
}

impl Drop for FrameEncoder {
    fn drop(&mut self) {
        // After `end` the process has already exited.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gif_delays_add_up_to_the_frame_rate() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.gif");
        let mut film = FilmOutput::create((&path, &path), &FilmFormat::Gif, (4, 3), 60, 24).unwrap();
        for _ in 0..60 {
            film.add_frame(&Image { width: 4, height: 3, data: vec![0.25; 36] }).unwrap();
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
    fn unknown_names_and_wrong_frame_sizes_are_refused() {
        for name in ["x", "x.npy", "film.avi"] {
            let message = FilmFormat::from_path(Path::new(name)).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains(".gif, .mp4"), "{message}");
        }
        assert_eq!(FilmFormat::from_path(Path::new("A.APNG")).unwrap(), FilmFormat::Apng);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.png");
        let mut film = FilmOutput::create((&path, &path), &FilmFormat::Apng, (4, 3), 2, 10).unwrap();
        let message = film.add_frame(&Image { width: 3, height: 3, data: vec![0.0; 27] }).unwrap_err().to_string();
        assert!(message.contains("4x3") && message.contains("3x3"), "{message}");
        assert!(film.finish().is_err(), "a film of two frames has none");
    }
}
