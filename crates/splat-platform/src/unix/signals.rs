//! Handling of the signals that ask the process to end, on Linux and macOS.

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use signal_hook::low_level::exit;

/// Installs a handler for the signals SIGINT, SIGTERM and SIGHUP, which ask the process to end.
///
/// - The handler calls `clean_up`. The value that `clean_up` returns is kept until the process ends.
/// - It then ends the process with the exit code that `exit_code` returns for the number of the signal.
/// - A signal that the process already ignores, for example because of `nohup`, stays ignored.
///
/// Also makes the process ignore SIGXFSZ: a write beyond the file size limit of `ulimit -f` then fails with an error
/// instead of ending the process.
///
/// Call this function before the process starts other threads. If the system refuses to install the handler, a signal
/// ends the process at once, without `clean_up`.
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
