//! Outputs that are written into a character device or a FIFO instead of getting a name.

use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use splat_platform::{is_standard_output, open_stream};

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
    if is_standard_output(&to).map_err(failed)? {
        IS_STANDARD_OUTPUT_USED.store(true, Ordering::Relaxed);
    }
    io::copy(&mut from, &mut to).map_err(failed)?;
    Ok(())
}

/// Opens a device or FIFO for writing. A FIFO that nobody reads is tried again for a while, then is an error.
fn open(target: &Path) -> io::Result<File> {
    let start = Instant::now();
    loop {
        if let Some(file) = open_stream(target)? {
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
