//! Handling of an input file that is mapped to memory while another program truncates it: the process ends with an
//! error message that names the file, and is not killed by the signal SIGBUS.
//!
//! Readers check the length of a file before they access its memory map, but the file may shrink in between. The kernel
//! then sends SIGBUS to the thread that touches the missing page. Reading cannot continue, so the handler reports the
//! file and ends the process with code 1. It removes no files; the next run removes unfinished outputs, which have
//! temporary names.

use std::sync::OnceLock;

use crate::TruncatedMapMessage;

/// Message that the handler of SIGBUS writes if a mapped file was truncated. It is set before the handler is installed.
static MESSAGE: OnceLock<TruncatedMapMessage> = OnceLock::new();

/// Installs a handler for the case that this process accesses a mapped file that another program has truncated. The
/// handler writes `message` with the path of the file to standard error and ends the process with code 1. If this
/// function is called again, the first message stays.
pub fn report_truncated_maps(message: TruncatedMapMessage) {
    MESSAGE.get_or_init(|| message);
    let mut action: libc::sigaction = unsafe {
        // SAFETY: all fields of `sigaction` are integers or pointers that may be null, so zero bytes are a valid value.
        std::mem::zeroed()
    };
    action.sa_sigaction = handler as extern "C" fn(i32, *mut libc::siginfo_t, *mut libc::c_void) as usize;
    action.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK;
    // SAFETY: `action` is initialized, with an empty mask and a handler that calls only async-signal-safe functions. If
    // the system refuses, the default action stays, which ends the process.
    unsafe { libc::sigaction(libc::SIGBUS, &action, std::ptr::null_mut()) };
}

/// Handles SIGBUS: reports the truncated file and ends the process. For any other cause of the signal, restores the
/// default action and raises the signal again.
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

/// Maximum number of bytes of the path in the message; a longer path is cut off.
const PATH_BYTES: usize = 1024;

/// Writes `bytes` to standard error, from within the signal handler.
fn write(bytes: &[u8]) {
    // SAFETY: the pointer and length are those of a slice. A short write only loses a part of the message.
    unsafe { libc::write(libc::STDERR_FILENO, bytes.as_ptr().cast(), bytes.len()) };
}

/// Finds the file that is mapped at the memory address `address`, and writes its path to `path`. Returns the number of
/// bytes of the path, or 0 if no file is found.
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

/// Parser that reads a line of `/proc/self/maps` byte by byte: `START-END MODE OFFSET DEVICE INODE PATH`.
struct MapsLine {
    /// START and END: the addresses between which the memory region described by the line lies.
    range: [usize; 2],
    /// Index of the field of the line of `/proc/self/maps` that is being read: 0 for START, 1 for END, and so on up to
    /// 6 for PATH. START ends at a dash, each of the other fields before PATH at a run of blanks.
    field: usize,
    /// Whether the last byte read was a blank. Further blanks then belong to the same run, and end no further field.
    after_blank: bool,
    /// Number of bytes of the field PATH read so far.
    length: usize,
}

impl MapsLine {
    /// Creates a parser at the start of a line, with no byte read.
    fn new() -> MapsLine {
        MapsLine { range: [0; 2], field: 0, after_blank: false, length: 0 }
    }

    /// Reads `byte`, the next byte of a line of `/proc/self/maps`. Appends the byte to `path` if it belongs to the file
    /// path at the end of the line; a control character becomes `?`.
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
                // Control characters are replaced, because they could form terminal escape sequences.
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
