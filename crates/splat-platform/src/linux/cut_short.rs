//! Truncation of a mapped input file by another program: an error that names the file instead of SIGBUS.
//!
//! Readers check lengths before they access a map, but the file may shrink in between. The kernel then sends SIGBUS to
//! the thread that touches the missing page. Reading cannot continue, so the handler reports the file and ends the
//! process with code 1. It removes no files: the next run removes outputs that were begun under a temporary name.

use std::sync::OnceLock;

use crate::TruncatedMapMessage;

/// Text of the handler. It is set before the handler is installed.
static MESSAGE: OnceLock<TruncatedMapMessage> = OnceLock::new();

/// Installs a handler for access to a mapped file that has been truncated. The handler writes `message` with the path
/// of the file to standard error and ends the process with code 1. The message of the first call stays.
pub fn report_cut_short_maps(message: TruncatedMapMessage) {
    MESSAGE.get_or_init(|| message);
    let mut action: libc::sigaction = unsafe {
        // SAFETY: all fields of `sigaction` are integers or pointers that may be null, so zero bytes are a valid value.
        std::mem::zeroed()
    };
    action.sa_sigaction = handler as extern "C" fn(i32, *mut libc::siginfo_t, *mut libc::c_void) as usize;
    action.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK;
    // SAFETY: `action` is initialized, with an empty mask and a handler that calls only async-signal-safe functions. If
    // the system refuses, the default stays, which ends the process.
    unsafe { libc::sigaction(libc::SIGBUS, &action, std::ptr::null_mut()) };
}

/// Reports the truncated file and ends the process. Restores the default for any other cause of the signal.
extern "C" fn handler(signal: i32, info: *mut libc::siginfo_t, _: *mut libc::c_void) {
    // SAFETY: the kernel passes a valid `siginfo_t` to a handler installed with SA_SIGINFO, and for SIGBUS with this
    // code it holds the address. signal, raise, write and _exit are async-signal-safe, and so is reading MESSAGE, a
    // single atomic load.
    unsafe {
        let message = MESSAGE.get().filter(|_| (*info).si_code == libc::BUS_ADRERR);
        let Some(message) = message else {
            libc::signal(signal, libc::SIG_DFL);
            libc::raise(signal);
            return;
        };
        let mut path = [0; PATH_BYTES];
        let length = path_mapped_at((*info).si_addr() as usize, &mut path);
        write(message.before.as_bytes());
        write(if length == 0 { message.unknown_path.as_bytes() } else { &path[..length] });
        write(message.after.as_bytes());
        libc::_exit(1);
    }
}

/// Maximum number of bytes of the path in the message.
const PATH_BYTES: usize = 1024;

/// Writes bytes to standard error.
fn write(bytes: &[u8]) {
    // SAFETY: the pointer and length are those of a slice. A short write only loses a part of the message.
    unsafe { libc::write(libc::STDERR_FILENO, bytes.as_ptr().cast(), bytes.len()) };
}

/// Writes the path of the file that is mapped at `address` to `path`. Returns its length, or 0 if the file is unknown.
///
/// Reads `/proc/self/maps` with only open and read, which are async-signal-safe, and allocates nothing.
fn path_mapped_at(address: usize, path: &mut [u8; PATH_BYTES]) -> usize {
    // SAFETY: the name ends with a zero byte.
    let file = unsafe { libc::open(c"/proc/self/maps".as_ptr(), libc::O_RDONLY | libc::O_CLOEXEC) };
    if file < 0 {
        return 0;
    }
    let mut line = MapsLine::new();
    let mut buffer = [0u8; 512];
    loop {
        // SAFETY: the pointer and length are those of `buffer`.
        let read = unsafe { libc::read(file, buffer.as_mut_ptr().cast(), buffer.len()) };
        let Some(bytes) = usize::try_from(read).ok().filter(|&read| read > 0).and_then(|read| buffer.get(..read))
        else {
            return 0;
        };
        for &byte in bytes {
            if byte != b'\n' {
                line.push(byte, path);
                continue;
            }
            if (line.range[0]..line.range[1]).contains(&address) {
                return line.length;
            }
            line = MapsLine::new();
        }
    }
}

/// State of a parser that reads a line of `/proc/self/maps`, `START-END MODE OFFSET DEVICE INODE PATH`, byte by byte.
struct MapsLine {
    /// Start and end address.
    range: [usize; 2],
    /// Number of separators read so far: a dash and five runs of blanks precede the path.
    field: usize,
    /// Whether the last byte was a blank.
    after_blank: bool,
    /// Number of path bytes so far.
    length: usize,
}

impl MapsLine {
    /// Creates the parser at the start of a line.
    fn new() -> MapsLine {
        MapsLine { range: [0; 2], field: 0, after_blank: false, length: 0 }
    }

    /// Reads the next byte of the line. Appends bytes of the path to `path`.
    fn push(&mut self, byte: u8, path: &mut [u8; PATH_BYTES]) {
        const PATH: usize = 6;
        if self.field < PATH && (byte == b' ' || self.field == 0 && byte == b'-') {
            self.field += usize::from(!self.after_blank);
            self.after_blank = byte == b' ';
            return;
        }
        if self.field == PATH && self.length == 0 && byte == b' ' {
            return;
        }
        self.after_blank = false;
        match self.field {
            0 | 1 => {
                let digit = (byte as char).to_digit(16).unwrap_or(0) as usize;
                self.range[self.field] = self.range[self.field] << 4 | digit;
            }
            PATH if self.length < PATH_BYTES => {
                // Control characters could contain terminal escape sequences.
                path[self.length] = if byte.is_ascii_control() { b'?' } else { byte };
                self.length += 1;
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mapped_address_gives_the_path_of_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a name with blanks");
        std::fs::write(&path, vec![7; 10_000]).unwrap();
        let file = std::fs::File::open(&path).unwrap();
        // SAFETY: no other code has access to the file, so it does not change while it is mapped.
        let map = unsafe { memmap2::Mmap::map(&file) }.unwrap();
        let mut found = [0; PATH_BYTES];
        let length = path_mapped_at(map.as_ptr() as usize + 5000, &mut found);
        assert_eq!(&found[..length], path.canonicalize().unwrap().as_os_str().as_encoded_bytes());
        assert_eq!(path_mapped_at(1, &mut found), 0);
    }
}
