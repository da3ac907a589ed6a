//! Being told to end: what a run has begun goes before the process does.

/// From now on SIGINT, SIGTERM and SIGHUP remove what has been begun and end the process with the status
/// 128 + signal, as shells name such an end. A signal that is ignored already stays so: `nohup`, `&`.
#[cfg(unix)]
pub(super) fn install() {
    // Without a handler a file that reaches the limit of `ulimit -f` ends the process; so the write fails, with a message.
    // SAFETY: SIG_IGN is a valid disposition of SIGXFSZ; no other thread exists yet.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
    use signal_hook::iterator::Signals;
    use signal_hook::low_level::exit;

    use splatsieve::error::ErrorKind;
    use splatsieve::files::atomic::withdraw_all;

    let heeded = [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|&signal| !is_ignored(signal));
    // Without it a signal ends the process at once, and the next run tidies up.
    let Ok(mut signals) = Signals::new(heeded) else { return };
    let end = move || {
        if let Some(signal) = signals.forever().next() {
            let _withdrawn = withdraw_all();
            exit(ErrorKind::Interrupted { signal: signal as u8 }.exit_code().into());
        }
    };
    let _ = std::thread::Builder::new().name("signals".to_owned()).spawn(end);
}

/// Other systems end a process without asking; the next run tidies up.
#[cfg(not(unix))]
pub(super) fn install() {}

#[cfg(unix)]
fn is_ignored(signal: i32) -> bool {
    let mut action = std::mem::MaybeUninit::<libc::sigaction>::uninit();
    // SAFETY: without a new action the call changes nothing and writes the present one into `action`, which has the
    // size and alignment it expects; it is read only after the call has said that it was written.
    unsafe {
        libc::sigaction(signal, std::ptr::null(), action.as_mut_ptr()) == 0
            && action.assume_init().sa_sigaction == libc::SIG_IGN
    }
}
