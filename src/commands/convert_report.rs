//! Result of the command `convert`.

use std::path::PathBuf;

use serde::Serialize;

use crate::error::ShowPath;
use crate::files::text::serialize_path;
use crate::outputs::kind::OutputKind;
use crate::progress::counted;

/// Result of the command `convert`.
#[derive(Debug, Serialize)]
pub struct ConvertReport {
    /// Path of the output.
    #[serde(serialize_with = "serialize_path")]
    pub path: PathBuf,
    /// Format of the output.
    pub kind: OutputKind,
    /// Number of Gaussians N of the input.
    pub gaussians: usize,
    /// Number of frames T of the input; `None` for an unpacked archive.
    pub frames: Option<usize>,
    /// Size in bytes of the written files of the model, without the summary that marks an output folder.
    pub bytes: u64,
    /// Reason why the output has more bytes than the input; `None` if it does not have more.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub larger: Option<String>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

impl ConvertReport {
    /// Returns the result as a line of text for the terminal: path, numbers of Gaussians and frames, bytes. If the
    /// output is larger than the input, adds a second line with the reason.
    pub fn text(&self) -> String {
        let frames = self.frames.map_or(String::new(), |frames| format!(" x {}", counted(frames, "frame")));
        let larger = self.larger.as_ref().map_or(String::new(), |why| format!("  {why}\n"));
        let gaussians = counted(self.gaussians, "Gaussian");
        format!("{}: {gaussians}{frames}, {} bytes\n{larger}", self.path.shown(), self.bytes)
    }
}
