//! `.ftgs.ply` files as a model format.

use super::WindowedModel;
use crate::files::cameras::TimeConvention;
use crate::files::ftgs::{FtgsFile, MARKER_COMMENT};
use crate::files::ply::header_contains;
use crate::models::archive::reopen::Reopener;
use crate::models::free_time_gs::frame_state::FreeTime;
use crate::models::input_model::{ModelDescription, TimeOrigin};
use crate::models::motion_model::MotionModelFrames;
use crate::models::opened::{InputFormat, Opened};
use crate::outputs::kind::OutputKind;

/// Minimum standard deviation of a time window, as a fraction of the length of the clip. Smaller ones are raised to it,
/// because a standard deviation of 0 could lead to 0/0.
pub(super) const SMALLEST_DEVIATION: f64 = 1e-9;

/// Model format of `.ftgs.ply` files of ftgs-player, with linear motion in time windows: recognizes and opens a file.
pub(in crate::models) const FTGS: InputFormat = InputFormat {
    recognizes: |found| {
        found.is_file_of(b"ply", "ply") && header_contains(found.path, &format!("comment {MARKER_COMMENT} "))
    },
    open: |path, options| {
        options.refuse_for(path)?;
        let file = FtgsFile::open(path, &options.ply(), options.conventions.zero_rotation.unwrap_or_default())?;
        let motion = FreeTime {
            clip: file.header.clip,
            deviation_floor: [file.header.min_deviation.max(SMALLEST_DEVIATION), 0.0],
            min_opacity: file.header.opacity_floor,
        };
        let sh_degree = file.params.gaussians.sh_degree();
        Ok(Opened::from_model(WindowedModel {
            path: path.to_owned(),
            description: ModelDescription {
                kind: "ftgs-player model",
                notes: file.defects.notes(),
                timing: TimeOrigin::Continuous,
                time_convention: TimeConvention::Given,
                default_output_kind: OutputKind::Ftgs,
                ..ModelDescription::default()
            },
            model: MotionModelFrames::new(motion, file.params, sh_degree),
            reopener: Some(Reopener::new(FTGS.open, options)),
        }))
    },
};
