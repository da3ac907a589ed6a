//! Standard streams that cannot be written, and file names and texts that a terminal, a spreadsheet or a browser would
//! run as instructions.

use crate::runner::Folder;

#[test]
fn the_runner_reports_code_message_and_memory() {
    let folder = Folder::new();
    let outcome = folder.attack("info missing.gseq").run().refused(1, &["missing.gseq"]);
    assert!(outcome.peak_bytes > 1 << 20 && outcome.seconds > 0.0);
    let outcome = folder.attack("recipe").run().succeeded();
    assert!(outcome.stdout.contains('='));
}
