//! Signals that ask the process to end.

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use signal_hook::low_level::exit;

/// From now on SIGINT, SIGTERM and SIGHUP call `clean_up` and end the process with the code that `exit_code` returns for the
/// number of the signal. The value that `clean_up` returns is not dropped before. A signal that is ignored already, as by
/// `nohup`, stays ignored.
///
/// SIGXFSZ is ignored from now on: writing beyond the limit of `ulimit -f` is an error instead of the end of the process.
///
/// Call this before the process has started other threads. If the system refuses, a signal ends the process at once.
pub fn end_on_signals<T>(clean_up: impl FnOnce() -> T + Send + 'static, exit_code: fn(u8) -> u8) {
    // SAFETY: SIG_IGN is a valid disposition of SIGXFSZ; no other thread exists yet.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
    let heeded = [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|&signal| !is_ignored(signal));
    let Ok(mut signals) = Signals::new(heeded) else { return };
    let end = move || {
        if let Some(signal) = signals.forever().next() {
            let _kept = clean_up();
            exit(exit_code(signal as u8).into());
        }
    };
    let _ = std::thread::Builder::new().name("signals".to_owned()).spawn(end);
}

fn is_ignored(signal: i32) -> bool {
    let mut action = std::mem::MaybeUninit::<libc::sigaction>::uninit();
    // SAFETY: without a new action the call changes nothing and writes the present one into `action`, which has the
    // size and alignment it expects; it is read only after the call has said that it was written.
    unsafe {
        libc::sigaction(signal, std::ptr::null(), action.as_mut_ptr()) == 0
            && action.assume_init().sa_sigaction == libc::SIG_IGN
    }
}
