//! A mapped input file that another program cuts short: an error that names the file in place of SIGBUS.
//!
//! Readers compare lengths before they touch a map, but the file may shrink between the two. The kernel then sends SIGBUS
//! to the thread that touches the missing page. Nothing can be read on, so the handler says which file it was and ends the
//! process with code 1. It removes no files: what was begun under a temporary name is removed by the next run.

use std::sync::OnceLock;

use crate::CutShortMessage;

/// Text of the handler, set before the handler is installed.
static MESSAGE: OnceLock<CutShortMessage> = OnceLock::new();

/// From now on touching a page of a mapped file that has been cut short writes `message` with the path of the file to
/// standard error and ends the process with code 1. The first message stays.
pub fn report_cut_short_maps(message: CutShortMessage) {
    MESSAGE.get_or_init(|| message);
    let mut action: libc::sigaction = unsafe {
        // SAFETY: all fields of `sigaction` are integers, or pointers that may be null.
        std::mem::zeroed()
    };
    action.sa_sigaction = handler as extern "C" fn(i32, *mut libc::siginfo_t, *mut libc::c_void) as usize;
    action.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK;
    // SAFETY: `action` is initialized, with an empty mask and a handler that calls async-signal-safe functions only. A
    // refusal leaves the default, which ends the process.
    unsafe { libc::sigaction(libc::SIGBUS, &action, std::ptr::null_mut()) };
}

extern "C" fn handler(signal: i32, info: *mut libc::siginfo_t, _: *mut libc::c_void) {
    // SAFETY: the kernel passes a valid `siginfo_t` to a handler installed with SA_SIGINFO, and for SIGBUS with this code
    // it holds the address. signal, raise, write and _exit are async-signal-safe, and so is reading MESSAGE, one atomic
    // load.
    unsafe {
        let message = MESSAGE.get().filter(|_| (*info).si_code == libc::BUS_ADRERR);
        let Some(message) = message else {
            libc::signal(signal, libc::SIG_DFL);
            libc::raise(signal);
            return;
        };
        let mut path = [0; PATH_BYTES];
        let length = path_of((*info).si_addr() as usize, &mut path);
        write(message.before.as_bytes());
        write(if length == 0 { message.unknown_path.as_bytes() } else { &path[..length] });
        write(message.after.as_bytes());
        libc::_exit(1);
    }
}

/// Longest path that the message shows.
const PATH_BYTES: usize = 1024;

fn write(bytes: &[u8]) {
    // SAFETY: the pointer and length are those of a slice. A short write loses a part of the message.
    unsafe { libc::write(libc::STDERR_FILENO, bytes.as_ptr().cast(), bytes.len()) };
}

/// Writes the path of the file that is mapped at `address` to `path` and returns its length; 0 if it is not known.
///
/// Reads `/proc/self/maps` with open and read alone, which are async-signal-safe, and allocates nothing.
fn path_of(address: usize, path: &mut [u8; PATH_BYTES]) -> usize {
    // SAFETY: the name ends with a zero byte.
    let file = unsafe { libc::open(c"/proc/self/maps".as_ptr(), libc::O_RDONLY | libc::O_CLOEXEC) };
    if file < 0 {
        return 0;
    }
    let mut line = MapsLine::new();
    let mut piece = [0u8; 512];
    loop {
        // SAFETY: the pointer and length are those of `piece`.
        let read = unsafe { libc::read(file, piece.as_mut_ptr().cast(), piece.len()) };
        let Some(bytes) = usize::try_from(read).ok().filter(|&read| read > 0).and_then(|read| piece.get(..read)) else {
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

/// A line of `/proc/self/maps`, `START-END MODE OFFSET DEVICE INODE PATH`, read byte by byte.
struct MapsLine {
    range: [usize; 2],
    /// Number of separators before the path that have passed: one dash and five runs of blanks.
    field: usize,
    after_blank: bool,
    /// Bytes of the path so far.
    length: usize,
}

impl MapsLine {
    fn new() -> MapsLine {
        MapsLine { range: [0; 2], field: 0, after_blank: false, length: 0 }
    }

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
                // Control characters could be instructions to a terminal.
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
    fn a_mapped_address_leads_to_the_path_of_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a name with blanks");
        std::fs::write(&path, vec![7; 10_000]).unwrap();
        let file = std::fs::File::open(&path).unwrap();
        // SAFETY: nothing else knows the file.
        let map = unsafe { memmap2::Mmap::map(&file) }.unwrap();
        let mut found = [0; PATH_BYTES];
        let length = path_of(map.as_ptr() as usize + 5000, &mut found);
        assert_eq!(&found[..length], path.canonicalize().unwrap().as_os_str().as_encoded_bytes());
        assert_eq!(path_of(1, &mut found), 0);
    }
}
