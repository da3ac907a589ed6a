//! Stage `prune`: how many of the ranking survive, as far as that is known before anything merges.

use super::score::Scored;
use crate::error::{Error, Result};
use crate::journal::Journal;
use crate::pruning::Ranking;
use crate::scene::Scene;

/// What the stage is called.
const NAME: &str = "prune";

/// The pruning of a run.
#[derive(Debug, Clone)]
pub struct Prune {
    /// Whether anybody is pruned who is not to be dropped.
    pub prunes: bool,
    /// Whether survivors merge afterwards.
    pub merges: bool,
    /// Exact size of the output.
    pub target: Option<usize>,
}

impl Prune {
    /// Number of survivors: of a run that is to merge down to a target all that may survive, for only merging tells how
    /// many are needed.
    ///
    /// # Errors
    /// A target that protected or dropped Gaussians rule out.
    pub fn run(&self, scene: &Scene, scored: &Scored, ranked: &Ranking, journal: &mut Journal) -> Result<usize> {
        let all = ranked.order().len();
        if let Some(target) = self.target {
            check_reachable(target, scored, all)?;
        }
        let survivors = match self.target {
            _ if !self.prunes => all,
            None => scored.selection.counts.kept,
            Some(target) if !self.merges => target,
            Some(_) => all,
        };
        journal.stage(NAME, scored.count(), scene.source(), |_| Ok((survivors, survivors)))
    }
}

fn check_reachable(target: usize, scored: &Scored, all: usize) -> Result<()> {
    let protected = scored.protected.len();
    if target < protected {
        return Err(Error::usage(format!("a target of {target} Gaussians, but {protected} are to be kept")));
    }
    if target > all {
        let dropped = scored.selection.counts.total - all;
        return Err(Error::usage(format!(
            "a target of {target} Gaussians, but {dropped} are to be dropped: {all} are left"
        )));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::tests::{scene, score_scene};
    use crate::pruning::score::UserOverrides;
    use crate::recipe::Recipe;

    #[test]
    fn survivors_are_all_where_merging_decides_and_the_target_where_it_does_not() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let user = UserOverrides { keep: vec![1, 2], drop: vec![3], keep_box: None };
        let scored = score_scene(&scene, &Recipe::preset("default").unwrap(), &user);
        let own = scored.selection.counts.kept;
        let run = |prunes, merges, target| {
            Prune { prunes, merges, target }.run(&scene, &scored, &scored.ranked(), &mut Journal::default())
        };
        for (prunes, merges, target, expected) in [
            (true, true, None, own),
            (true, false, None, own),
            (true, false, Some(70), 70),
            (true, true, Some(70), 1499),
            (false, true, None, 1499),
        ] {
            assert_eq!(run(prunes, merges, target).unwrap(), expected, "{prunes} {merges} {target:?}");
        }
        assert!(run(true, true, Some(1)).unwrap_err().to_string().contains("2 are to be kept"));
        assert!(run(true, true, Some(1500)).unwrap_err().to_string().contains("1 are to be dropped"));
    }
}
