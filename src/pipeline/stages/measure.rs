//! From frames to a selection: the stages `scan`, `visible` and `score`, which `score` and `report` run too.

use super::scan::ScanStage;
use crate::error::Result;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::outputs::kind::OutputKind;
use crate::pruning::contribution::VisibleContribution;
use crate::pruning::score;
use crate::pruning::score::{ScoreStage, Scored, UserOverrides};
use crate::pruning::visible::Visible;
use crate::recipe::Recipe;
use crate::scene::Scene;
use crate::statistics::pass::Scanned;

/// What is known of a scene before its frames are read.
#[derive(Debug, Clone, Copy)]
pub struct InputMeta {
    /// N.
    pub gaussians: usize,
    /// Whether the cameras are the scene's own, not a virtual rig.
    pub has_cameras: bool,
    /// The kind of result to which neither the user nor its name gives one.
    pub own_output: OutputKind,
}

impl InputMeta {
    /// Of an open scene.
    pub fn from_scene(scene: &Scene) -> InputMeta {
        InputMeta {
            gaussians: scene.source().info().count,
            has_cameras: scene.has_cameras,
            own_output: scene.input.own_output(),
        }
    }
}

/// What is done with a scene that begins with measuring it.
pub trait Stages {
    /// The stages that measure.
    fn measure(&self) -> &Measure;

    /// What all its stages need.
    fn needs(&self, work: &Workload, limits: &Limits) -> Vec<ResourceEstimate>;

    /// What they need at best, where pictures hardly differ without a part `hardly_seen` of the Gaussians.
    fn easiest(&self, work: &Workload, limits: &Limits, _hardly_seen: f64) -> Vec<ResourceEstimate> {
        self.needs(work, limits)
    }

    /// Whether it is only found on the way how much there is to do.
    fn searches(&self) -> bool {
        false
    }
}

/// The stages that measure and score.
#[derive(Debug, Clone)]
pub struct Measure {
    /// Looks at every frame.
    pub scan: ScanStage,
    /// Looks at pictures, where C is measured by them.
    pub visible: Option<Visible>,
    /// Scores and selects.
    pub score: ScoreStage,
}

/// What the frames say before anything is scored.
pub struct Measured {
    /// Statistics of every Gaussian.
    pub scanned: Scanned,
    /// What the pictures show of each, where they were looked at.
    pub seen: Option<VisibleContribution>,
}

impl Measure {
    /// As `recipe` has it; `has_cameras`: the scene has cameras of its own.
    pub fn new(recipe: &Recipe, has_cameras: bool, user: UserOverrides) -> Measure {
        Measure {
            scan: ScanStage { recipe: recipe.scan.clone() },
            visible: Visible::from_recipe(&recipe.scan, has_cameras),
            score: ScoreStage {
                snap_noise: recipe.scan.snap_noise,
                non_finite: recipe.scan.non_finite,
                score: recipe.score.clone(),
                select: recipe.select.clone(),
                user,
            },
        }
    }

    /// Measures, unless the scene was measured as it arrived, and scores.
    ///
    /// # Errors
    /// Those of the stages.
    pub fn run(&self, scene: &Scene, arrived: Option<Measured>, journal: &mut Journal) -> Result<Scored> {
        scene.set_absent(&[]);
        let ScoreStage { snap_noise, non_finite, score, select, user, .. } = &self.score;
        let key = scene.work.key(&(
            (&self.scan.recipe, self.visible.is_some(), snap_noise, non_finite, score, user),
            (select.keep_fraction, select.tau_static, select.tau_dynamic, select.low_priority),
        ));
        let scored = journal.kept(&scene.work, score::NAME, key, |journal| self.measure(scene, arrived, journal))?;
        scene.set_absent(&scored.absent);
        scored.within(&scene.limits, &scene.scratch)
    }

    /// Scans all frames. If Gaussians that are not finite are to be dropped, they are absent from the scene from then on, and
    /// it is scanned again without them.
    ///
    /// # Errors
    /// Frames that cannot be read, or whose times cannot be scanned.
    pub fn scan(&self, scene: &Scene, journal: &mut Journal) -> Result<Scanned> {
        scene.set_absent(&[]);
        let scanned = self.scan.run(scene, journal)?;
        let absent = self.score.absent(&scanned.rows);
        if absent.is_empty() {
            return Ok(scanned);
        }
        scene.set_absent(&absent);
        self.scan.run(scene, journal)
    }

    fn measure(&self, scene: &Scene, arrived: Option<Measured>, journal: &mut Journal) -> Result<Scored> {
        let Measured { scanned, seen } = match arrived {
            Some(measured) => measured,
            None => Measured { scanned: self.scan(scene, journal)?, seen: None },
        };
        let seen = match (&self.visible, seen) {
            (Some(visible), None) => Some(visible.run(scene, &scanned.rows.life, journal)?),
            (_, seen) => seen,
        };
        self.score.run(scene, scanned, seen, journal)
    }
}

impl Stages for Measure {
    fn measure(&self) -> &Measure {
        self
    }

    fn needs(&self, work: &Workload, limits: &Limits) -> Vec<ResourceEstimate> {
        let visible = self.visible.as_ref().map(|visible| visible.need(work, limits));
        let scan = self.scan.need(work, limits);
        [Some(scan), visible, Some(self.score.need(work, limits))].into_iter().flatten().collect()
    }
}
