//! Tables of a recipe and the types of their values.

use std::num::NonZeroU32;

use serde::{Deserialize, Serialize};

use crate::error::quoted;
use crate::model::{Attributes, MAX_SH_DEGREE};

/// Parameters of the scan over all frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct ScanParams {
    pub alpha_min: f64,
    pub motion: MotionParams,
    pub snap_noise: bool,
    pub coverage: Coverage,
    pub pixel_stride: NonZeroU32,
    pub view_stride: NonZeroU32,
    pub frame_stride: NonZeroU32,
    pub look_pictures: usize,
    pub non_finite: NonFinite,
}

/// Steps between frames that count as motion, and their normalization.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionParams {
    /// The paper's divisors. Steps across gaps of the life span count.
    Literal,
    /// Only steps inside one run of life frames, divided by their number.
    Runs,
}

/// Quantity that the contribution C measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Coverage {
    /// [`Coverage::Visible`] if the scene has cameras of its own, otherwise [`Coverage::Projected`]: cameras of a
    /// virtual rig may be behind walls that no real view shows.
    Auto,
    /// Σ alpha · transmittance over pixels.
    Visible,
    /// Area of the projected 3σ ellipse inside the image × opacity.
    Projected,
}

/// Treatment of a Gaussian that has NaN or infinity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NonFinite {
    /// Stop and name the Gaussians.
    Error,
    /// Prune it.
    Drop,
    /// Keep it as it is.
    Keep,
}

/// Parameters of the scores.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct ScoreParams {
    pub static_term: StaticTerm,
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

/// First term of S_static.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StaticTerm {
    /// C.
    Mean,
    /// W.
    Peak,
    /// √(C·W).
    Geometric,
}

/// Measure of the anisotropy E.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Anisotropy {
    /// s_max / s_min.
    Ratio,
    /// ln(s_max / s_mid).
    Log,
}

/// Parameters of selection (stages 1 and 2 of the paper).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct SelectParams {
    pub keep_fraction: f64,
    pub tau_static: f64,
    pub tau_dynamic: f64,
    pub low_priority: LowPriority,
    pub round_fraction: f64,
    pub round_pictures: usize,
    pub round_turns: usize,
    pub contrast_floor: f64,
    pub choose_by_views: bool,
}

/// Treatment of Gaussians that stage 1 does not keep.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LowPriority {
    /// Pruned.
    Drop,
    /// Judged by stage 2 like the candidates.
    Rescue,
}

/// Parameters of merging (stage 3 of the paper).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct MergeParams {
    pub length_unit: LengthUnit,
    pub max_neighbors: usize,
    pub max_scale_ratio: f64,
    pub max_color_difference: f64,
    pub trajectory: Trajectory,
    pub motion_noise: f64,
    pub max_drift: f64,
    pub max_dead_time: f64,
    pub placement: Placement,
    pub opacity: ProxyOpacity,
    pub sh_high: ShHigh,
    pub passes: Vec<MergePass>,
}

/// Parameters of refinement, which fits the stored values of the survivors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct RefineParams {
    pub refine: AttributeGroups,
    pub refine_steps: u32,
    pub refine_cut_steps: u32,
    pub refine_pictures: usize,
    pub refine_ssim: f64,
    pub refine_knots: usize,
}

/// Parameters of the deformation field of the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct FieldParams {
    pub field: Precision,
    pub field_margin: f64,
}

/// Parameters of the SH degree of the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct ShDegreeParams {
    pub bands: ShDegreeRule,
    pub bands_margin: f64,
}

/// Rule for the SH degree of the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum ShDegreeRule {
    /// SH degree of the input, unchanged.
    All,
    /// Lowest degree at which renders hardly change.
    Needed,
    /// Degrees up to this one. Refinement compensates for the dropped degrees.
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

/// Precision in which a deformation field is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Unchanged, byte for byte.
    #[default]
    Exact,
    /// Half precision (IEEE 754 binary16).
    Half,
}

/// Set of attributes, written as names separated by commas: any of `color,opacity,scale,rotation,position`, or `none`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct AttributeGroups(pub Attributes);

/// Name and attribute of every group.
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

/// Thresholds of one merge pass.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct MergePass {
    pub epsilon: f64,
    pub d0: f64,
    pub rho: f64,
    pub tau_m: f64,
}

/// Unit of lengths in merging.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LengthUnit {
    /// Scene units.
    Scene,
    /// Extent of the scene.
    Extent,
}

impl LengthUnit {
    /// Returns the length of one unit, scene units, in a scene of the given extent.
    pub fn in_scene_units(self, extent: f64) -> f64 {
        match self {
            LengthUnit::Scene => 1.0,
            LengthUnit::Extent => extent,
        }
    }
}

/// Measure by which trajectories are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Trajectory {
    /// The paper's mean cosine of velocities.
    Cosine,
    /// (2Σ a·b + 2nσ²) / (Σ‖a‖² + Σ‖b‖² + 2nσ²).
    Alignment,
}

/// Position of a proxy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Placement {
    /// Weighted mean of its members.
    Mean,
    /// At the leader, with second moments about it.
    Leader,
}

/// Rule for the opacity of a proxy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ProxyOpacity {
    /// Clamped sum.
    Sum,
    /// 1 − Π(1 − α).
    Union,
    /// Σ α·area / area of the proxy, clamped.
    Area,
}

/// Source of a proxy's SH coefficients above degree 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShHigh {
    /// Weighted average of the members.
    Average,
    /// The heaviest member.
    Heaviest,
}
