//! Signals that ask the process to end.

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use signal_hook::low_level::exit;

/// Installs a handler for SIGINT, SIGTERM and SIGHUP. The handler calls `clean_up` and ends the process with the code
/// that `exit_code` returns for the signal number. The value that `clean_up` returns is kept until the process ends. A
/// signal that is already ignored, for example by `nohup`, stays ignored.
///
/// Also ignores SIGXFSZ from now on: writing beyond the limit of `ulimit -f` becomes an error and no longer ends the
/// process.
///
/// Call this function before the process has started other threads. If the system refuses, a signal ends the process at
/// once.
pub fn end_on_signals<T>(clean_up: impl FnOnce() -> T + Send + 'static, exit_code: fn(u8) -> u8) {
    // SAFETY: SIG_IGN is a valid disposition of SIGXFSZ; no other thread exists yet.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
    let handled = [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|&signal| !is_ignored(signal));
    let Ok(mut signals) = Signals::new(handled) else { return };
    let end = move || {
        if let Some(signal) = signals.forever().next() {
            let _kept = clean_up();
            exit(exit_code(signal as u8).into());
        }
    };
    let _ = std::thread::Builder::new().name("signals".to_owned()).spawn(end);
}

/// Returns whether the process ignores `signal`.
fn is_ignored(signal: i32) -> bool {
    let mut action = std::mem::MaybeUninit::<libc::sigaction>::uninit();
    // SAFETY: without a new action the call changes nothing and writes the present action to `action`, which has the
    // expected size and alignment and is read only if the call reports success.
    unsafe {
        libc::sigaction(signal, std::ptr::null(), action.as_mut_ptr()) == 0
            && action.assume_init().sa_sigaction == libc::SIG_IGN
    }
}
