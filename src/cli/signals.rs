//! Handling of events that interrupt a run: signals, and input files that other programs truncate.

use splat_platform::{TruncatedMapMessage, end_on_signals, report_truncated_maps};
use splatsieve::error::ErrorKind;
use splatsieve::files::atomic::remove_unfinished;

/// Installs handlers for two events:
/// - A signal ends the process: the handler first removes unfinished outputs.
/// - Another program truncates a memory-mapped input file: the handler ends the process with a message that names the
///   file, if its path is known.
pub(super) fn install() {
    end_on_signals(remove_unfinished, |signal| ErrorKind::Interrupted { signal }.exit_code());
    report_truncated_maps(TruncatedMapMessage {
        before: "splatsieve: ",
        unknown_path: "an input file",
        after: ", end of file: expected the bytes that were there when it was opened, found fewer\n  the file was cut short \
                while it was being read; start again when nothing writes to it\n",
    });
}
