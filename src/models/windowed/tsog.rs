//! `.tsog` files as a model format.

use std::path::Path;

use super::WindowedModel;
use super::frame_by_frame::FrameByFrame;
use super::ftgs::{FTGS, SMALLEST_DEVIATION};
use crate::error::Result;
use crate::files::cameras::TimeConvention;
use crate::files::tsog::read::{is_tsog, read_tsog};
use crate::files::tsog::{TimedGaussians, Timeline};
use crate::models::archive::reopen::Reopener;
use crate::models::free_time_gs::frame_state::FreeTime;
use crate::models::in_checkpoint::ProxyRule;
use crate::models::in_checkpoint::still::Still;
use crate::models::input_model::{ModelDescription, TimeOrigin};
use crate::models::motion_model::MotionModelFrames;
use crate::models::opened::{InputFormat, Opened};
use crate::outputs::kind::OutputKind;

/// Model format of `.tsog` files of web players: recognizes and opens a file with linear motion in time windows, with
/// single frames, or with a model without motion.
pub(in crate::models) const TSOG: InputFormat = InputFormat {
    recognizes: |found| !found.is_folder && is_named_or_zip(found.path, &found.head),
    open: |path, options| {
        options.refuse_for(path)?;
        let TimedGaussians { params, timeline, clip } = read_tsog(path, options.memory)?;
        let sh_degree = params.gaussians.sh_degree();
        match timeline {
            Timeline::Windows => {
                let motion = FreeTime { clip, deviation_floor: [SMALLEST_DEVIATION, 0.0], min_opacity: 0.0 };
                let model = MotionModelFrames::new(motion, params, sh_degree);
                let archived = Some(Reopener::new(FTGS.open, options));
                opened(path, TimeOrigin::Continuous, model, archived, Vec::new())
            }
            Timeline::Frames(frames) => {
                let motion = FrameByFrame::new(frames, clip);
                let note = format!(
                    "{} Gaussians in {frames} single frames: each is visible in one frame only, so none is followed \
                     through time",
                    params.len()
                );
                let times = motion.times().to_vec();
                let model = MotionModelFrames::new(motion, params, sh_degree).with_times(times)?;
                opened(path, TimeOrigin::Numbered, model, None, vec![note])
            }
            Timeline::Still => {
                let model = MotionModelFrames::new(Still, params, sh_degree).with_times(vec![0.0])?;
                opened(path, TimeOrigin::Numbered, model, None, Vec::new())
            }
        }
    },
};

/// Returns whether the file is named `.tsog`, or is a ZIP archive with the content of a `.tsog` file. `head` holds the
/// first bytes of the file.
fn is_named_or_zip(path: &Path, head: &[u8]) -> bool {
    let is_named = path.extension().is_some_and(|found| found.eq_ignore_ascii_case("tsog"));
    is_named || (head.starts_with(b"PK\x03\x04") && is_tsog(path))
}

/// Creates the input model of the `.tsog` file at `path`, whose frames `model` computes. `timing` states whether frames
/// can be at any time; `reopener` opens the `.ftgs.ply` in an archive of the file.
fn opened<L: ProxyRule + 'static>(
    path: &Path,
    timing: TimeOrigin,
    model: MotionModelFrames<L>,
    reopener: Option<Reopener>,
    notes: Vec<String>,
) -> Result<Opened> {
    let description = ModelDescription {
        kind: "TSOG model",
        notes,
        timing,
        time_convention: TimeConvention::Given,
        default_output_kind: OutputKind::Tsog,
        archives_as_frames: reopener.is_none(),
        ..ModelDescription::default()
    };
    Ok(Opened::from_model(WindowedModel { path: path.to_owned(), description, model, reopener }))
}
