//! Ways to make a model smaller that a sweep compares: presets, parts of them, prunings by one number, and how each
//! compresses.

use super::baseline::Baseline;
use crate::error::{Error, Result};
use crate::pipeline::Only;
use crate::recipe::{Coverage, Precision, Recipe, ShDegreeRule, StaticTerm};

/// A way to make a model smaller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// Preset `default`.
    Default,
    /// Preset `default` that leaves what stays as it was.
    NoRefine,
    /// Preset `paper`: prunes and merges.
    Paper,
    /// Preset `paper` without merging.
    PaperPrune,
    /// Preset `paper` without pruning.
    PaperMerge,
    /// Prunes by visible contribution C alone.
    Visible,
    /// Prunes by projected coverage C alone.
    Projected,
    /// Prunes by opacity alone.
    Opacity,
    /// Prunes by size alone.
    Scale,
    /// Prunes at random.
    Random,
}

impl Method {
    /// Every method, ours first.
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

    /// As the command line and the results name it.
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

    /// The method that does the same and refines what stays, if this one leaves that out.
    pub fn refined(self) -> Option<Method> {
        (self == Method::NoRefine).then_some(Method::Default)
    }

    /// How it compresses.
    ///
    /// # Errors
    /// None but of presets that do not parse.
    pub(crate) fn means(self) -> Result<MethodKind> {
        let unrefined = || Ok::<_, Error>(Recipe::preset("default")?.unrefined());
        let pruning = |coverage| {
            let mut recipe = unrefined()?;
            // Pruning and nothing else.
            recipe.field.field = Precision::Exact;
            recipe.bands.bands = ShDegreeRule::All;
            recipe.scan.coverage = coverage;
            recipe.score.static_term = StaticTerm::Mean;
            // S = C without clipping, so that no two Gaussians tie that differ in C.
            recipe.score.w_dynamic = 0.0;
            recipe.score.clip_norm = false;
            recipe.select.round_fraction = 1.0;
            recipe.select.choose_by_views = false;
            Ok::<_, Error>(MethodKind::Recipe(Box::new(recipe), Only::Prune))
        };
        let paper = |only| Ok(MethodKind::Recipe(Box::new(Recipe::preset("paper")?), only));
        match self {
            Method::Default => Ok(MethodKind::Recipe(Box::new(Recipe::preset("default")?), Only::Both)),
            Method::NoRefine => Ok(MethodKind::Recipe(Box::new(unrefined()?), Only::Both)),
            Method::Paper => paper(Only::Both),
            Method::PaperPrune => paper(Only::Prune),
            Method::PaperMerge => paper(Only::Merge),
            Method::Visible => pruning(Coverage::Visible),
            Method::Projected => pruning(Coverage::Projected),
            Method::Opacity => Ok(MethodKind::Baseline(Baseline::Opacity)),
            Method::Scale => Ok(MethodKind::Baseline(Baseline::Scale)),
            Method::Random => Ok(MethodKind::Baseline(Baseline::Random)),
        }
    }

    /// Whether it has a size of its own choice, by thresholds.
    pub(crate) fn chooses_size(self) -> bool {
        matches!(self, Method::Default | Method::NoRefine | Method::Paper | Method::PaperPrune | Method::PaperMerge)
    }
}

/// How a method compresses.
pub(crate) enum MethodKind {
    Recipe(Box<Recipe>, Only),
    Baseline(Baseline),
}

/// The parameter that `--steps` turns.
pub(crate) const STEPS: &str = "refine_steps";

/// [`Method::Default`] with so many steps, and before each cut as many in proportion.
pub(crate) fn refining_by(steps: u32) -> Result<MethodKind> {
    Ok(MethodKind::Recipe(Box::new(Recipe::preset("default")?.refining_by(steps)), Only::Both))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turning_steps_to_the_presets_own_leaves_the_preset() {
        let preset = Recipe::preset("default").unwrap();
        let recipe = |steps| match refining_by(steps).unwrap() {
            MethodKind::Recipe(recipe, Only::Both) => *recipe,
            _ => panic!("not method default"),
        };
        assert_eq!(recipe(preset.refine.refine_steps), preset);
        let half = recipe(preset.refine.refine_steps / 2).refine;
        assert_eq!(half.refine_cut_steps, preset.refine.refine_cut_steps / 2);
        assert_eq!(recipe(0).refine.refine_cut_steps, 0);
        assert!(preset.with("refine", STEPS, "1").is_ok(), "{STEPS} is no parameter");
    }
}
