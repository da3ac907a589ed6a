//! Effort of a run: one option that trades time for quality. Its values were chosen from measurements of error against
//! run time (`splatsieve precision`).

use super::{MAX_STEPS, Recipe};

/// Effort of a run: trades run time for quality.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effort {
    /// A third of the recipe's optimization steps, fewer scored views, and more Gaussians removed per pruning round.
    Fast,
    /// Optimization steps, scored views and pruning rounds as the recipe sets them.
    Default,
    /// Three times the recipe's optimization steps, more scored views, and fewer Gaussians removed per pruning round.
    Best,
}

/// Values that an effort (`fast` or `best`) gives to parameters of the recipe; the fields are named like the
/// parameters.
struct EffortSettings {
    scoring_views: usize,
    round_views: usize,
    round_groups: usize,
    round_fraction: f64,
    /// Factor by which the recipe's number of optimization steps is multiplied.
    steps: f64,
}

impl Effort {
    /// Every effort, the fastest first.
    pub const ALL: [Effort; 3] = [Effort::Fast, Effort::Default, Effort::Best];

    /// Returns the name of the effort on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Effort::Fast => "fast",
            Effort::Default => "default",
            Effort::Best => "best",
        }
    }

    fn settings(self) -> Option<EffortSettings> {
        match self {
            Effort::Fast => Some(EffortSettings {
                scoring_views: 50,
                round_views: 24,
                round_groups: 3,
                round_fraction: 0.85,
                steps: 1.0 / 3.0,
            }),
            Effort::Default => None,
            Effort::Best => Some(EffortSettings {
                scoring_views: 400,
                round_views: 144,
                round_groups: 4,
                round_fraction: 0.95,
                steps: 3.0,
            }),
        }
    }
}

impl Recipe {
    /// Returns this recipe at `effort`: with fewer or more scored views, pruning rounds and optimization steps. Parts
    /// of the method that the recipe turns off stay off, and a recipe that scores all views still scores all.
    pub fn with_effort(&self, effort: Effort) -> Recipe {
        let Some(settings) = effort.settings() else { return self.clone() };
        let steps = settings.steps * f64::from(self.refine.refine_steps);
        let mut recipe = self.with_refinement_steps((steps.ceil() as u32).min(MAX_STEPS));
        // Effort `fast` never raises a value of the recipe, and effort `best` never lowers one, except that neither
        // raises the number of groups.
        let less = settings.steps < 1.0;
        let limited = |own: usize, to: usize| if less { own.min(to) } else { own.max(to) };
        if recipe.scan.scoring_views > 0 {
            recipe.scan.scoring_views = limited(recipe.scan.scoring_views, settings.scoring_views);
        }
        if recipe.select.round_fraction < 1.0 {
            let select = &mut recipe.select;
            select.round_views = limited(select.round_views, settings.round_views);
            select.round_groups = select.round_groups.min(settings.round_groups);
            let own = select.round_fraction;
            select.round_fraction =
                if less { own.min(settings.round_fraction) } else { own.max(settings.round_fraction) };
        }
        recipe
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn effort_increases_work_and_adds_no_unused_parts() {
        let default = Recipe::preset("default").unwrap();
        let at = Effort::ALL.map(|effort| default.with_effort(effort));
        assert_eq!(at[1], default);
        let rising = |value: fn(&Recipe) -> f64| at.iter().map(value).is_sorted_by(|a, b| a < b);
        assert!(rising(|recipe| recipe.scan.scoring_views as f64));
        assert!(rising(|recipe| recipe.select.round_views as f64));
        assert!(rising(|recipe| recipe.select.round_fraction));
        assert!(rising(|recipe| recipe.refine.refine_steps.into()));
        at.iter().for_each(|recipe| recipe.validate().unwrap());
        let paper = Recipe::preset("paper").unwrap();
        for effort in Effort::ALL {
            let other = paper.with_effort(effort);
            assert_eq!((&other.scan, &other.select), (&paper.scan, &paper.select), "{}", effort.name());
        }
    }
}
