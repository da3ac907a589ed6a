//! Options with a fixed set of values: the names of the values, their help, and the values of the library.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

use splatsieve::files::image::write::ImageFormat;
use splatsieve::model::Split;
use splatsieve::models::{LinkMode, ZeroRotation};
use splatsieve::outputs::kind::OutputKind;
use splatsieve::pipeline::FitTarget;
use splatsieve::scene::view_selection::ViewSet;

/// Values of an option: name, help and value of each.
type Choices<T> = &'static [(&'static str, &'static str, T)];

/// Returns a parser that accepts the names in `choices`.
pub(super) fn choice<T: Copy + Send + Sync + 'static>(choices: Choices<T>) -> impl TypedValueParser<Value = T> {
    let names = choices.iter().map(|(name, help, _)| PossibleValue::new(*name).help(*help));
    let value = |name: String| choices.iter().find(|choice| choice.0 == name).expect("one of the names").2;
    PossibleValuesParser::new(names).map(value)
}

/// Handling of Gaussians of a .splatv or .ftgs.ply whose quaternion is zero.
pub(super) const ZERO_ROTATIONS: Choices<ZeroRotation> = &[
    ("drop", "Remove Gaussians with a zero quaternion", ZeroRotation::Drop),
    ("identity", "Keep Gaussians with a zero quaternion, with the identity rotation", ZeroRotation::Identity),
];

/// Layout of the 4D rotations of a 4D Gaussian Splatting checkpoint; the value is whether it is unflipped.
pub(super) const ROTATION_LAYOUTS: Choices<bool> = &[
    ("flipped", "Rows and columns of the 4D rotation matrix in reverse order (code since 15 September 2024)", false),
    ("unflipped", "Product of both quaternions as it is (older code)", true),
];

/// Condition under which frames are tracked.
pub(super) const LINK_MODES: Choices<LinkMode> = &[
    ("auto", "Only where the number of Gaussians changes or their order is not the same", LinkMode::Auto),
    ("always", "Always, also for a container or a stream", LinkMode::Always),
    (
        "apart",
        "Always, but do not join tracks that seem to show the same Gaussian, and store small changes too",
        LinkMode::Apart,
    ),
    ("never", "Never: the same index means the same Gaussian", LinkMode::Never),
];

/// Images to which refinement fits the Gaussians.
pub(super) const FIT_TARGETS: Choices<FitTarget> = &[
    ("renders", "Renders of the original", FitTarget::Renders),
    ("photographs", "Renders of the original, then photographs of the training views", FitTarget::Photographs),
];

/// Splits of a data set.
pub(super) const SPLITS: Choices<ViewSet> = &[
    ("train", "Training views", ViewSet::Split(Split::Train)),
    ("val", "Validation views (transforms_val.json)", ViewSet::Split(Split::Val)),
    ("test", "Test views", ViewSet::Split(Split::Test)),
    ("all", "Every view", ViewSet::All),
];

/// Formats of images.
pub(super) const IMAGE_FORMATS: Choices<ImageFormat> = &[
    ("png", "8 bits per channel, clamped", ImageFormat::Png),
    ("npy", "float32 [H, W, 3], not clamped", ImageFormat::Npy),
];

/// Formats of an output.
pub(super) const OUTPUT_KINDS: Choices<OutputKind> = &[
    ("model", "Model folder in the format of the input", OutputKind::Model),
    ("gseq", "Container with all frames (.gseq)", OutputKind::Gseq),
    ("ply-sequence", "Folder with one PLY file per frame", OutputKind::PlySequence),
    (
        "ply",
        "One PLY file: a single frame; of 4DGaussians also the canonical Gaussians, of SpacetimeGaussians the model \
         with its motion",
        OutputKind::Ply,
    ),
    ("archive", "Archive (.gsz), the smallest: to store and to send", OutputKind::Archive),
    ("splatv", "Gaussians with cubic motion in time windows, for splaTV and WebGS", OutputKind::Splatv),
    ("4dgs", "Gaussians with linear motion in pieces, for readers of 4dgs", OutputKind::FourDgs),
    ("spz", "One frame, for web viewers (.spz)", OutputKind::Spz),
    ("sog", "One frame as images, for web viewers (.sog)", OutputKind::Sog),
    ("glb", "One frame, uncompressed, for viewers of glTF (.glb)", OutputKind::Glb),
    ("sog-sequence", "Folder with one .sog per frame, for the flip book of PlayCanvas", OutputKind::SogSequence),
    ("tsog", "Gaussians with linear motion in time windows as images, SH degree 0 to 3 (.tsog)", OutputKind::Tsog),
    ("ftgs", "Gaussians with linear motion in time windows, for ftgs-player (.ftgs.ply)", OutputKind::Ftgs),
    ("gsd", "Every frame in full, for SplatRenderer of Unreal (.gsd)", OutputKind::Gsd),
];
