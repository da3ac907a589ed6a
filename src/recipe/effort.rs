//! How much time a run may take for how small an error: places on the curves that `splatsieve precision` draws.

use super::{MOST_STEPS, Recipe};

/// A place on the curves of error against run time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effort {
    /// A third of the steps of refinement, and a coarser look and rounds.
    Fast,
    /// As the recipe has it.
    Default,
    /// Three times the steps, and a finer look and rounds.
    Best,
}

/// What a place comes to.
struct Knobs {
    look_pictures: usize,
    round_pictures: usize,
    round_turns: usize,
    round_fraction: f64,
    /// Times the recipe's own.
    steps: f64,
}

impl Effort {
    /// Every one, the fastest first.
    pub const ALL: [Effort; 3] = [Effort::Fast, Effort::Default, Effort::Best];

    /// As the command line names it.
    pub fn name(self) -> &'static str {
        match self {
            Effort::Fast => "fast",
            Effort::Default => "default",
            Effort::Best => "best",
        }
    }

    fn knobs(self) -> Option<Knobs> {
        match self {
            Effort::Fast => Some(Knobs {
                look_pictures: 50,
                round_pictures: 24,
                round_turns: 3,
                round_fraction: 0.85,
                steps: 1.0 / 3.0,
            }),
            Effort::Default => None,
            Effort::Best => {
                Some(Knobs { look_pictures: 400, round_pictures: 96, round_turns: 3, round_fraction: 0.95, steps: 3.0 })
            }
        }
    }
}

impl Recipe {
    /// The same at `effort`: the first look, the rounds and the steps of refinement, as far as the recipe has them, with more
    /// or fewer of them. What a recipe looks at whole stays so.
    pub fn at_effort(&self, effort: Effort) -> Recipe {
        let Some(knobs) = effort.knobs() else { return self.clone() };
        let steps = knobs.steps * f64::from(self.refine.refine_steps);
        let mut recipe = self.refining_by((steps.ceil() as u32).min(MOST_STEPS));
        // Never past what the recipe has by itself.
        let less = knobs.steps < 1.0;
        let moved = |own: usize, to: usize| if less { own.min(to) } else { own.max(to) };
        if recipe.scan.look_pictures > 0 {
            recipe.scan.look_pictures = moved(recipe.scan.look_pictures, knobs.look_pictures);
        }
        if recipe.select.round_fraction < 1.0 {
            let select = &mut recipe.select;
            select.round_pictures = moved(select.round_pictures, knobs.round_pictures);
            select.round_turns = select.round_turns.min(knobs.round_turns);
            let own = select.round_fraction;
            select.round_fraction = if less { own.min(knobs.round_fraction) } else { own.max(knobs.round_fraction) };
        }
        recipe
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_effort_looks_at_more_and_what_a_recipe_does_not_do_stays_undone() {
        let default = Recipe::preset("default").unwrap();
        let at = Effort::ALL.map(|effort| default.at_effort(effort));
        assert_eq!(at[1], default);
        let rising = |of: fn(&Recipe) -> f64| at.iter().map(of).is_sorted_by(|a, b| a < b);
        assert!(rising(|recipe| recipe.scan.look_pictures as f64));
        assert!(rising(|recipe| recipe.select.round_pictures as f64));
        assert!(rising(|recipe| recipe.select.round_fraction));
        assert!(rising(|recipe| recipe.refine.refine_steps.into()));
        at.iter().for_each(|recipe| recipe.validate().unwrap());
        let paper = Recipe::preset("paper").unwrap();
        for effort in Effort::ALL {
            let other = paper.at_effort(effort);
            assert_eq!((&other.scan, &other.select), (&paper.scan, &paper.select), "{}", effort.name());
        }
    }
}
