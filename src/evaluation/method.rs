//! Compression methods that the command `sweep` compares: presets, presets without some of their stages, and pruning by
//! one property.

use super::baseline::Baseline;
use crate::error::{Error, Result};
use crate::pipeline::PruneOrMerge;
use crate::recipe::{Coverage, FieldPrecision, Recipe, ShDegreeRule, StaticScoreTerm};

/// Compression method that `sweep` can compare with others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// Preset `default`.
    Default,
    /// Preset `default` without refinement.
    NoRefine,
    /// Preset `paper`, which prunes and merges.
    Paper,
    /// Preset `paper` without merging.
    PaperPrune,
    /// Preset `paper` without pruning.
    PaperMerge,
    /// Pruning by the visible contribution C (Σ alpha · transmittance).
    Visible,
    /// Pruning by the projected coverage C (opacity times projected area, occlusion ignored).
    Projected,
    /// Pruning by opacity.
    Opacity,
    /// Pruning by the largest of the three scales.
    Scale,
    /// Pruning in random order.
    Random,
}

impl Method {
    /// List of all methods, the presets of this project first.
    pub const ALL: [Method; 10] = [
        Method::Default,
        Method::NoRefine,
        Method::Paper,
        Method::PaperPrune,
        Method::PaperMerge,
        Method::Visible,
        Method::Projected,
        Method::Opacity,
        Method::Scale,
        Method::Random,
    ];

    /// Returns the name of this method on the command line and in results.
    pub fn name(self) -> &'static str {
        match self {
            Method::Default => "default",
            Method::NoRefine => "no-refine",
            Method::Paper => "paper",
            Method::PaperPrune => "paper-prune",
            Method::PaperMerge => "paper-merge",
            Method::Visible => "visible",
            Method::Projected => "projected",
            Method::Opacity => "opacity",
            Method::Scale => "scale",
            Method::Random => "random",
        }
    }

    /// Returns the same method with refinement: [`Method::Default`] for [`Method::NoRefine`], `None` for any other
    /// method.
    pub fn with_refinement(self) -> Option<Method> {
        (self == Method::NoRefine).then_some(Method::Default)
    }

    /// Returns how this method compresses. This is either a recipe, together with the stages that run (pruning, merging
    /// or both), or a baseline, which only prunes by one property.
    ///
    /// # Errors
    /// Fails only if a built-in preset does not parse.
    pub(crate) fn kind(self) -> Result<MethodKind> {
        let unrefined = || Ok::<_, Error>(Recipe::preset("default")?.without_refinement());
        let pruning = |coverage| {
            let mut recipe = unrefined()?;
            // Leave out every stage except pruning.
            recipe.field.field = FieldPrecision::Exact;
            recipe.bands.bands = ShDegreeRule::All;
            recipe.scan.coverage = coverage;
            recipe.score.static_term = StaticScoreTerm::Mean;
            // The score S is then C, without clipping. So Gaussians with different C never tie.
            recipe.score.w_dynamic = 0.0;
            recipe.score.clip_norm = false;
            recipe.select.round_fraction = 1.0;
            recipe.select.choose_by_views = false;
            Ok::<_, Error>(MethodKind::Recipe(Box::new(recipe), PruneOrMerge::Prune))
        };
        let paper = |only| Ok(MethodKind::Recipe(Box::new(Recipe::preset("paper")?), only));
        match self {
            Method::Default => Ok(MethodKind::Recipe(Box::new(Recipe::preset("default")?), PruneOrMerge::Both)),
            Method::NoRefine => Ok(MethodKind::Recipe(Box::new(unrefined()?), PruneOrMerge::Both)),
            Method::Paper => paper(PruneOrMerge::Both),
            Method::PaperPrune => paper(PruneOrMerge::Prune),
            Method::PaperMerge => paper(PruneOrMerge::Merge),
            Method::Visible => pruning(Coverage::Visible),
            Method::Projected => pruning(Coverage::Projected),
            Method::Opacity => Ok(MethodKind::Baseline(Baseline::Opacity)),
            Method::Scale => Ok(MethodKind::Baseline(Baseline::Scale)),
            Method::Random => Ok(MethodKind::Baseline(Baseline::Random)),
        }
    }

    /// Returns whether this method can run without a target count: it has thresholds that determine how many Gaussians
    /// stay.
    pub(crate) fn chooses_size(self) -> bool {
        matches!(self, Method::Default | Method::NoRefine | Method::Paper | Method::PaperPrune | Method::PaperMerge)
    }
}

/// Recipe or baseline by which a method compresses:
/// - `Recipe`: a recipe, with the stages that run (pruning, merging or both).
/// - `Baseline`: a baseline, which only prunes by one property of the Gaussians.
pub(crate) enum MethodKind {
    Recipe(Box<Recipe>, PruneOrMerge),
    Baseline(Baseline),
}

/// Name of the recipe parameter that the option `--steps` varies.
pub(crate) const STEPS: &str = "refine_steps";

/// Returns the method that compresses by the preset `default` with `steps` optimization steps of refinement. The number
/// of steps before each prune step (removal of the lowest-ranked Gaussians) changes in proportion to `steps`.
pub(crate) fn refining_by(steps: u32) -> Result<MethodKind> {
    Ok(MethodKind::Recipe(Box::new(Recipe::preset("default")?.with_refinement_steps(steps)), PruneOrMerge::Both))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn setting_the_presets_own_steps_keeps_the_preset() {
        let preset = Recipe::preset("default").unwrap();
        let recipe = |steps| match refining_by(steps).unwrap() {
            MethodKind::Recipe(recipe, PruneOrMerge::Both) => *recipe,
            _ => panic!("not method default"),
        };
        assert_eq!(recipe(preset.refine.refine_steps), preset);
        let half = recipe(preset.refine.refine_steps / 2).refine;
        assert_eq!(half.refine_steps_per_prune, preset.refine.refine_steps_per_prune / 2);
        assert_eq!(recipe(0).refine.refine_steps_per_prune, 0);
        assert!(preset.with_parameter("refine", STEPS, "1").is_ok(), "{STEPS} is no parameter");
    }
}
