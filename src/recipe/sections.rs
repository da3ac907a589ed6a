//! Tables of a recipe and the types of their values. `paper.toml` documents every parameter.

use std::num::NonZeroU32;

use serde::{Deserialize, Serialize};

use crate::error::quoted;
use crate::model::{Attributes, MAX_SH_DEGREE};

/// Parameters of the scan, which reads all frames once and gathers statistics.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct ScanParams {
    pub scan_frames: ScanFrames,
    pub outside: f64,
    pub alpha_min: f64,
    pub motion: MotionParams,
    pub snap_noise: bool,
    pub coverage: Coverage,
    pub pixel_stride: NonZeroU32,
    pub view_stride: NonZeroU32,
    pub frame_stride: NonZeroU32,
    pub scoring_views: usize,
    pub non_finite: NonFinitePolicy,
}

/// Frames that the scan reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ScanFrames {
    /// The scan reads every frame.
    All,
    /// The scan reads a few evenly spaced frames if no decision of the run depends on the statistics of motion and
    /// opacity, otherwise every frame.
    Needed,
}

/// Definition of the motion of a Gaussian: which steps from one frame to the next count, and by which number a sum over
/// steps is divided to get a mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionParams {
    /// Motion as the paper defines it. Every step from one frame to the next counts if the Gaussian is alive (opacity ≥
    /// alpha_min) in the second frame, even if it is not alive in the first. Let n be the number of frames in which the
    /// Gaussian is alive. For the mean, the sum over the steps is divided by n. For the curvature, the sum over the
    /// turns (changes from one step to the next) is divided by n − 2.
    Literal,
    /// A step from one frame to the next counts only if the Gaussian is alive (opacity ≥ alpha_min) in both frames. For
    /// the mean, the sum over the steps is divided by their number.
    Runs,
}

/// Quantity that is measured as the contribution C of a Gaussian to renders.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Coverage {
    /// [`Coverage::Visible`] if the scene has cameras of its own, otherwise [`Coverage::Projected`]. A virtual rig
    /// (cameras placed by the program) is not rendered, because its cameras may stand behind walls, where no real
    /// camera looks from.
    Auto,
    /// Sum over pixels of alpha · transmittance, so that hidden Gaussians contribute nothing.
    Visible,
    /// Opacity times the area, inside the image, of the projected ellipse at 3 standard deviations.
    Projected,
}

/// Treatment of a Gaussian that has NaN or infinity in some frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NonFinitePolicy {
    /// Stop the run with an error that states how many Gaussians have NaN or infinity, and the ids of the first five.
    Error,
    /// Remove the Gaussians that have NaN or infinity if they are at most 1% of all; else stop the run like
    /// [`NonFinitePolicy::Error`].
    Few,
    /// Remove every Gaussian that has NaN or infinity in some frame.
    Drop,
    /// Keep Gaussians that have NaN or infinity; the output has them unchanged.
    Keep,
}

/// Parameters of the scores by which Gaussians are ranked and pruned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct ScoreParams {
    pub static_term: StaticScoreTerm,
    pub w_static: f64,
    pub w_dynamic: f64,
    pub lambda: f64,
    pub anisotropy: Anisotropy,
    pub mu: f64,
    pub eta: f64,
    pub xi: f64,
    pub weigh_motion_by_life: bool,
    pub norm_epsilon: f64,
    pub clip_norm: bool,
}

/// First term of the static score S_static, which rates a Gaussian without regard to its motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StaticScoreTerm {
    /// Mean contribution C of the Gaussian per view.
    Mean,
    /// Peak contribution W: the largest alpha · transmittance in any pixel.
    Peak,
    /// Geometric mean √(C·W) of the mean contribution C and the peak contribution W.
    Geometric,
}

/// Formula of the anisotropy E, from the largest, middle and smallest scale s_max, s_mid and s_min of a Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Anisotropy {
    /// s_max / s_min, the largest scale divided by the smallest.
    Ratio,
    /// ln(s_max / s_mid), the logarithm of the largest scale divided by the middle one.
    Log,
}

/// Parameters of the selection of the Gaussians that stay (stages 1 and 2 of the paper).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct SelectParams {
    pub keep_fraction: f64,
    pub tau_static: f64,
    pub tau_dynamic: f64,
    pub low_priority: LowScorePolicy,
    pub round_fraction: f64,
    pub round_views: usize,
    pub round_groups: usize,
    pub contrast_floor: f64,
    pub choose_by_views: bool,
}

/// Treatment of Gaussians that stage 1 of the paper (choice of candidates by score) does not keep.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LowScorePolicy {
    /// Gaussians that stage 1 does not choose as candidates are removed.
    Drop,
    /// Stage 2 also decides on the Gaussians that stage 1 does not choose as candidates, by the same rule as on the
    /// candidates.
    Rescue,
}

/// Parameters of merging, which replaces clusters of Gaussians by one each (stage 3 of the paper).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct MergeParams {
    pub length_unit: LengthUnit,
    pub max_neighbors: usize,
    pub max_scale_ratio: f64,
    pub max_color_difference: f64,
    pub trajectory: MotionSimilarity,
    pub motion_noise: f64,
    pub max_drift: f64,
    pub max_dead_time: f64,
    pub placement: ProxyPosition,
    pub opacity: ProxyOpacity,
    pub sh_high: ProxyHigherSh,
    pub passes: Vec<MergePass>,
}

/// Parameters of refinement, which fits the stored values of the survivors (Gaussians not removed) to renders.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct RefineParams {
    pub refine: AttributeGroups,
    pub refine_steps: u32,
    pub refine_steps_per_prune: u32,
    pub refine_target_views: usize,
    pub refine_between: bool,
    pub refine_validate: bool,
    pub refine_ssim: f64,
    pub refine_keyframes: usize,
    pub refine_archive_steps: u32,
}

/// Parameters of the precision with which the deformation field is written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct FieldParams {
    pub field: FieldPrecision,
    pub field_margin: f64,
}

/// Parameters by which the SH degree of the result is chosen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct ShDegreeParams {
    pub bands: ShDegreeRule,
    pub bands_margin: f64,
}

/// Rule by which the SH degree of the result is chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum ShDegreeRule {
    /// The result keeps the SH degree of the input.
    All,
    /// The result gets the lowest SH degree with which its renders hardly change.
    Needed,
    /// The result has at most this SH degree. Refinement compensates for the dropped coefficients.
    UpTo(usize),
}

impl TryFrom<String> for ShDegreeRule {
    type Error = String;

    fn try_from(text: String) -> std::result::Result<ShDegreeRule, String> {
        match text.as_str() {
            "all" => Ok(ShDegreeRule::All),
            "needed" => Ok(ShDegreeRule::Needed),
            degree => match degree.parse() {
                Ok(degree) if degree <= MAX_SH_DEGREE => Ok(ShDegreeRule::UpTo(degree)),
                _ => Err(format!("{}: expected all, needed, or a degree from 0 to {MAX_SH_DEGREE}", quoted(degree))),
            },
        }
    }
}

impl From<ShDegreeRule> for String {
    fn from(bands: ShDegreeRule) -> String {
        match bands {
            ShDegreeRule::All => "all".to_owned(),
            ShDegreeRule::Needed => "needed".to_owned(),
            ShDegreeRule::UpTo(degree) => degree.to_string(),
        }
    }
}

/// Number format in which the deformation field (network or polynomial that moves the Gaussians) is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FieldPrecision {
    /// The deformation field is copied from the input, byte for byte.
    #[default]
    Exact,
    /// The deformation field is written in half precision (IEEE 754 binary16, 2 bytes per value).
    Half,
}

/// Set of attributes, written as names separated by commas: any of `color,opacity,scale,rotation,position`, or `none`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct AttributeGroups(pub Attributes);

/// Attributes that can be refined, each with its name in a recipe.
const GROUPS: [(&str, Attributes); 5] = [
    ("color", Attributes::SH),
    ("opacity", Attributes::OPACITY),
    ("scale", Attributes::LOG_SCALE),
    ("rotation", Attributes::ROTATION),
    ("position", Attributes::POSITION),
];

impl TryFrom<String> for AttributeGroups {
    type Error = String;

    fn try_from(text: String) -> std::result::Result<AttributeGroups, String> {
        let mut columns = Attributes::empty();
        for name in text.split([',', ' ']).filter(|&name| text != "none" && !name.is_empty()) {
            let group = GROUPS.iter().find(|group| group.0 == name).ok_or_else(|| {
                let names = GROUPS.map(|group| group.0).join(",");
                format!("{}: expected some of {names}, or none", quoted(name))
            })?;
            columns |= group.1;
        }
        Ok(AttributeGroups(columns))
    }
}

impl From<AttributeGroups> for String {
    fn from(groups: AttributeGroups) -> String {
        let names: Vec<&str> = GROUPS.iter().filter(|group| groups.0.contains(group.1)).map(|group| group.0).collect();
        if names.is_empty() { "none".to_owned() } else { names.join(",") }
    }
}

/// Thresholds of one merge pass (one round of finding and replacing clusters).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct MergePass {
    pub epsilon: f64,
    pub d0: f64,
    pub rho: f64,
    pub tau_m: f64,
}

/// Unit in which the lengths among the merge parameters are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LengthUnit {
    /// Scene units, the unit of the positions in the input.
    Scene,
    /// Extent of the scene: longest side of the box between the 1st and the 99th percentile of the positions.
    Extent,
}

impl LengthUnit {
    /// Returns the length of one unit in scene units, for a scene with the extent `extent` (scene units).
    pub fn in_scene_units(self, extent: f64) -> f64 {
        match self {
            LengthUnit::Scene => 1.0,
            LengthUnit::Extent => extent,
        }
    }
}

/// Formula of the motion similarity of two Gaussians; 1 means equal motion. a and b are the steps of the two Gaussians
/// from one frame to the next.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionSimilarity {
    /// Mean cosine of the angle between the steps a and b of the two Gaussians from frame to frame. This is the formula
    /// of "Temporally-Aware Pruning for Compact 4D Gaussian Splatting Models".
    Cosine,
    /// (2Σ a·b + 2nσ²) / (Σ‖a‖² + Σ‖b‖² + 2nσ²), summed over n steps a and b of the two Gaussians from frame to frame;
    /// σ is the parameter `motion_noise`.
    Alignment,
}

/// Position of a proxy (Gaussian that replaces a merged cluster).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ProxyPosition {
    /// Weighted mean of the positions of the cluster's members.
    Mean,
    /// Position of the leader, the member of the cluster that the other members were merged into. The covariance of the
    /// proxy is then computed about this position.
    Leader,
}

/// Rule for the opacity of a proxy (Gaussian that replaces a merged cluster), from the opacities α of its members.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ProxyOpacity {
    /// Sum of the members' opacities α, limited to the valid range.
    Sum,
    /// 1 − Π(1 − α), the opacity of all members one behind the other.
    Union,
    /// Sum of opacity α times projected area over the members, divided by the projected area of the proxy; limited to
    /// the valid range.
    Area,
}

/// Source of the SH coefficients above degree 0 of a proxy (Gaussian that replaces a merged cluster).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ProxyHigherSh {
    /// Weighted average of the SH coefficients of the cluster's members.
    Average,
    /// SH coefficients of the cluster's member with the largest weight.
    Heaviest,
}
