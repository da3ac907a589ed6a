//! Outputs that are written into a character device or a FIFO instead of getting a name.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::fd::AsFd;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::destination::{Destination, destination};
use crate::error::{Error, Result, ShowPath};

/// Longest wait for a program that opens the other end of a FIFO.
const LONGEST_WAIT: Duration = Duration::from_secs(10);

static IS_STANDARD_OUTPUT_USED: AtomicBool = AtomicBool::new(false);

/// Whether an output was written into the same device or pipe that is standard output: reports must not follow it there.
pub fn is_standard_output_used() -> bool {
    IS_STANDARD_OUTPUT_USED.load(Ordering::Relaxed)
}

/// Writes the file `content` into the device or FIFO `target`.
///
/// # Errors
/// A target that is no device or FIFO any more; a FIFO that no program reads for 10 s; a failed write.
pub(super) fn copy(content: &Path, target: &Path) -> Result<()> {
    let failed = |error| Error::io("write to", target)(error);
    let mut from = File::open(content).map_err(Error::io("read back", content))?;
    if destination(target)? != Destination::Stream {
        return Err(Error::usage(format!("{} was replaced during the run; give another output", target.shown())));
    }
    let mut to = open(target).map_err(failed)?;
    let found = to.metadata().map_err(failed)?;
    #[expect(clippy::disallowed_methods, reason = "nothing is written to it here")]
    let out = io::stdout().as_fd().try_clone_to_owned().and_then(|out| File::from(out).metadata());
    if out.is_ok_and(|out| (out.dev(), out.ino()) == (found.dev(), found.ino())) {
        IS_STANDARD_OUTPUT_USED.store(true, Ordering::Relaxed);
    }
    io::copy(&mut from, &mut to).map_err(failed)?;
    Ok(())
}

/// Opens a device or FIFO for writing. A FIFO that nobody reads is tried again for a while, then is an error.
fn open(target: &Path) -> io::Result<File> {
    let start = Instant::now();
    let is_fifo = fs::metadata(target).is_ok_and(|found| std::os::unix::fs::FileTypeExt::is_fifo(&found.file_type()));
    loop {
        let opened = OpenOptions::new().write(true).custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY).open(target);
        let waits = is_fifo && opened.as_ref().is_err_and(|error| error.raw_os_error() == Some(libc::ENXIO));
        if !waits {
            let file = opened?;
            let flags = rustix::fs::fcntl_getfl(&file)?;
            rustix::fs::fcntl_setfl(&file, flags - rustix::fs::OFlags::NONBLOCK)?;
            return Ok(file);
        }
        if start.elapsed() > LONGEST_WAIT {
            return Err(io::Error::new(
                io::ErrorKind::TimedOut,
                "no program has opened this FIFO for reading for 10 s",
            ));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}
