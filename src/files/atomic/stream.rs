//! Writes outputs into character devices and FIFOs, which cannot be replaced like a file.

use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use splat_platform::{is_standard_output, open_stream};

use super::destination::{Destination, destination};
use crate::error::{Error, Result, ShowPath};

/// Maximum time to wait for another program to open a FIFO for reading.
const MAX_WAIT: Duration = Duration::from_secs(10);

/// Whether this process has written an output to standard output.
static IS_STANDARD_OUTPUT_USED: AtomicBool = AtomicBool::new(false);

/// Returns whether an output was written to the device or pipe that is standard output. The caller must then not print
/// reports on standard output.
pub fn is_standard_output_used() -> bool {
    IS_STANDARD_OUTPUT_USED.load(Ordering::Relaxed)
}

/// Copies the content of the file `content` into the device or FIFO `target`.
///
/// # Errors
/// Fails if `target` is no longer a device or FIFO, if no program opens the FIFO for reading within 10 s, or if a write
/// fails.
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

/// Opens the device or FIFO `target` for writing. If no program has a FIFO open for reading, retries for 10 s
/// ([`MAX_WAIT`]), then fails.
fn open(target: &Path) -> io::Result<File> {
    let start = Instant::now();
    loop {
        if let Some(file) = open_stream(target)? {
            return Ok(file);
        }
        if start.elapsed() > MAX_WAIT {
            return Err(io::Error::new(
                io::ErrorKind::TimedOut,
                "no program has opened this FIFO for reading for 10 s",
            ));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}
