//! `.ftgs.ply` files as a model format.

use std::io::Read;
use std::path::Path;

use super::WindowedModel;
use crate::files::ftgs::{FtgsFile, MARKER_COMMENT};
use crate::files::open::open_file;
use crate::models::archive::reopen::Reopener;
use crate::models::free_time_gs::frame_state::FreeTime;
use crate::models::input_model::{ModelFormat, TimeOrigin};
use crate::models::motion_model::MotionModelFrames;
use crate::outputs::kind::OutputKind;

/// Minimum standard deviation of a time window, as a fraction of the length of the clip. Smaller ones are raised to it,
/// because a standard deviation of 0 could lead to 0/0.
pub(super) const SMALLEST_DEVIATION: f64 = 1e-9;

/// Model format of `.ftgs.ply` files of ftgs-player, with linear motion in time windows: recognizes and opens a file.
pub(in crate::models) const FTGS: ModelFormat = ModelFormat {
    recognizes: |found| found.is_file_of(b"ply", "ply") && has_marker(found.path),
    open: |path, options| {
        options.refuse_for(path)?;
        let file = FtgsFile::open(path, &options.ply(), options.conventions.zero_rotation.unwrap_or_default())?;
        let motion = FreeTime {
            clip: file.header.clip,
            deviation_floor: [file.header.min_deviation.max(SMALLEST_DEVIATION), 0.0],
            min_opacity: file.header.opacity_floor,
        };
        let sh_degree = file.params.gaussians.sh_degree();
        Ok(Box::new(WindowedModel {
            path: path.to_owned(),
            name: "ftgs-player model",
            default_output: OutputKind::Ftgs,
            timing: TimeOrigin::Continuous,
            notes: file.defects.notes(),
            model: MotionModelFrames::new(motion, file.params, sh_degree),
            reopener: Some(Reopener::new(FTGS.open, options)),
        }))
    },
};

/// Returns whether the header of the PLY file at `path` has the comment that marks this format.
fn has_marker(path: &Path) -> bool {
    // The marker is at the start of the header; the rest of the file is not read.
    let mut head = Vec::new();
    let read = open_file(path).is_ok_and(|file| file.take(1 << 14).read_to_end(&mut head).is_ok());
    let header = head.windows(10).position(|bytes| bytes == b"end_header").map_or(&head[..], |end| &head[..end]);
    let marker = format!("comment {MARKER_COMMENT} ");
    read && header.windows(marker.len()).any(|bytes| bytes == marker.as_bytes())
}
