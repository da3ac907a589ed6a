//! Stage `score`: statistics to scores, scores to a ranking and to who stays.

use std::borrow::Cow;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::compressed_model::Reference;
use crate::error::{Error, Result, ShowPath};
use crate::journal::Journal;
use crate::journal::records::{FlagSummary, Saved, TermSummary};
use crate::limits::Limits;
use crate::memory_plan::{MemoryPart, ResourceEstimate, Workload};
use crate::model::RobustBox;
use crate::model::{Columns, Flags, Gaussians, Rows};
use crate::models::trajectories::state_bytes;
use crate::passes::{frames_to_see, gather};
use crate::pruning;
use crate::pruning::contribution::VisibleContribution;
use crate::pruning::{Overrides, Ranking, Selection, select};
use crate::recipe::{self, NonFinite};
use crate::scene::Scene;
use crate::statistics::aside::StatisticsRows;
use crate::statistics::pass::Scanned;
use crate::statistics::score::{Scores, Term, score};
use crate::statistics::{fill_anisotropy, snap, ulp};

/// What the stage is called.
pub(crate) const NAME: &str = "score";

/// Bytes per Gaussian of statistics, scores and a selection: while scores are looked at.
pub const SCORED: u64 = (Rows::BYTES_PER_GAUSSIAN + Scores::BYTES_PER_GAUSSIAN + pruning::BYTES_PER_GAUSSIAN) as u64;

/// What stays of scoring: the selection, and the statistics unless they are set aside.
pub fn scored_memory(limits: &Limits) -> Vec<MemoryPart> {
    let rows = if limits.rows_aside { 0 } else { Rows::BYTES_PER_GAUSSIAN as u64 };
    vec![("rows", rows), ("selection", pruning::BYTES_PER_GAUSSIAN as u64)]
}

/// The scoring of a run.
#[derive(Debug, Clone)]
pub struct ScoreStage {
    /// Whether motion within rounding is taken as none.
    pub snap_noise: bool,
    /// What becomes of Gaussians with NaN or infinity.
    pub non_finite: NonFinite,
    /// Normalization and weights.
    pub score: recipe::ScoreParams,
    /// Stages 1 and 2 of the selection.
    pub select: recipe::Select,
    /// What the user knows better.
    pub user: UserOverrides,
}

/// Lives of at most this part of all frames are short: it is worth asking which of them are one.
const SHORT_LIFE: usize = 4;

/// A scene with statistics and a selection of every Gaussian.
#[derive(Serialize, Deserialize)]
pub struct Scored {
    /// Statistics, noise snapped as the recipe says.
    statistics: StatisticsRows,
    /// T.
    frames: usize,
    /// See [`frames_to_see`].
    pub frames_to_see: usize,
    /// How the terms of the scores were normalized.
    pub terms: Vec<Term>,
    /// Counts of odd Gaussians.
    pub flags: FlagSummary,
    /// Stages 1 and 2, with the user's overrides.
    pub selection: Selection,
    /// Ids that are to be kept as they are, unmerged; increasing.
    pub protected: Vec<u32>,
    /// Ids that were dropped because their values are not finite, increasing: the scene is read without them.
    pub absent: Vec<u32>,
    /// Where Gaussians are compared with one another.
    pub reference: Reference,
    /// Distance between f32 values at the scene's largest coordinate: the noise floor of a position.
    pub position_ulp: f64,
}

/// What the user knows better, before ids are resolved.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct UserOverrides {
    /// Ids to keep.
    pub keep: Vec<u32>,
    /// Ids to drop.
    pub drop: Vec<u32>,
    /// Box (low corner, high corner) whose Gaussians at the reference frame are kept.
    pub keep_box: Option<[f64; 6]>,
}

impl ScoreStage {
    /// Statistics, scores and a selection, and the states at one frame.
    pub fn need(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        ResourceEstimate {
            stage: NAME,
            reads: work.reads(1, limits),
            seconds: 2e-6 * work.count(),
            per_gaussian: vec![
                ("rows", SCORED),
                ("sorting", pruning::WORKING_BYTES_PER_GAUSSIAN as u64),
                ("states", work.state(Columns::POSITION | Columns::LOG_SCALE)),
            ],
            fixed: vec![work.arriving()],
        }
    }

    /// Returns the ids of the Gaussians that are to be dropped because their values are not finite, increasing.
    pub fn absent(&self, rows: &Rows) -> Vec<u32> {
        if self.non_finite == NonFinite::Drop { non_finite(rows).collect() } else { Vec::new() }
    }

    /// Scores and selects by what was measured.
    ///
    /// # Errors
    /// Values that are not finite, unless the recipe says what to do with them; cameras that see nothing; ids that are
    /// to be kept and to be dropped.
    pub fn run(
        &self,
        scene: &Scene,
        scanned: Scanned,
        seen: Option<VisibleContribution>,
        journal: &mut Journal,
    ) -> Result<Scored> {
        let source = scene.source();
        let info = source.info();
        let mut rows = scanned.rows;
        if let Some(seen) = seen {
            (rows.c, rows.w) = (seen.coverage, seen.peak);
            let odd: Vec<u32> = non_finite(&rows).collect();
            for id in odd {
                rows.clear(id as usize);
            }
        }
        let reference_frame = first_of_largest(&scanned.alive_per_frame);
        journal.stage(NAME, info.count, source, |journal| {
            let progress = scene.events.task(NAME, "Gaussians", info.count as u64);
            if self.snap_noise {
                snap(&mut rows, scanned.largest_coordinate);
            }
            let all: Vec<u32> = (0..info.count as u32).collect();
            let state = match info.times.is_empty() {
                true => Gaussians::zeros(info.count, info.sh_degree),
                false => gather(source, &all, reference_frame, Columns::POSITION | Columns::LOG_SCALE)?,
            };
            let extent = RobustBox::from_positions(&state.position).extent();
            let canonical = scene.input.canonical().unwrap_or(&state);
            fill_anisotropy(&mut rows, &canonical.log_scale, self.score.anisotropy, extent);
            check_views(scene, &rows)?;
            let mut protected = self.user.keep.clone();
            if let Some(corners) = self.user.keep_box {
                protected.extend(all.iter().copied().filter(|&id| inside(&corners, state.position.row(id as usize))));
            }
            let mut drop = self.user.drop.clone();
            let absent = self.absent(&rows);
            match self.non_finite {
                NonFinite::Error => refuse_non_finite(scene, &rows)?,
                NonFinite::Drop => drop.extend(&absent),
                NonFinite::Keep => protected.extend(non_finite(&rows)),
            }
            for ids in [&mut protected, &mut drop] {
                ids.sort_unstable();
                ids.dedup();
            }
            let scores = score(&rows, info.times.len(), &self.score);
            let overrides = Overrides { keep_ids: protected.clone(), drop_ids: drop };
            let selection = select(&scores, &self.select, &overrides)?;
            let reference = Reference { frame: reference_frame, extent };
            let position_ulp = ulp(scanned.largest_coordinate);
            let median_life = median_life(&rows.life);
            let scored = Scored {
                frames: info.times.len(),
                frames_to_see: frames_to_see(&rows.life, info.times.len()),
                terms: scores.terms,
                flags: flags(&rows),
                statistics: match scene.limits.rows_aside {
                    true => StatisticsRows::aside(rows, &scene.scratch)?,
                    false => StatisticsRows::Memory(rows),
                },
                selection,
                protected,
                absent,
                reference,
                position_ulp,
            };
            scored.write_down(scene, median_life, journal);
            progress.advance(info.count as u64);
            Ok((scored, info.count))
        })
    }
}

fn first_of_largest(counts: &[u32]) -> usize {
    let largest = counts.iter().copied().max().unwrap_or(0);
    counts.iter().position(|&count| count == largest).unwrap_or(0)
}

fn inside(corners: &[f64; 6], position: [f32; 3]) -> bool {
    (0..3).all(|axis| (corners[axis]..=corners[axis + 3]).contains(&f64::from(position[axis])))
}

fn non_finite(rows: &Rows) -> impl Iterator<Item = u32> {
    (0..rows.len() as u32).filter(|&id| rows.flags[id as usize].contains(Flags::NON_FINITE))
}

fn refuse_non_finite(scene: &Scene, rows: &Rows) -> Result<()> {
    let ids: Vec<u32> = non_finite(rows).collect();
    if ids.is_empty() {
        return Ok(());
    }
    let some: Vec<String> = ids.iter().take(5).map(u32::to_string).collect();
    let more = if ids.len() > some.len() { ", ..." } else { "" };
    let place = format!("Gaussian {}{more}", some.join(", "));
    let found = format!("NaN or infinity in {} of {} Gaussians", ids.len(), rows.len());
    Err(Error::input(&scene.path, place, "finite values in every frame", found)
        .hint("--non-finite drop removes them, --non-finite keep leaves them as they are"))
}

/// Counts of odd Gaussians.
fn flags(rows: &Rows) -> FlagSummary {
    let count = |flag| rows.flags.iter().filter(|flags| flags.contains(flag)).count();
    FlagSummary {
        non_finite: count(Flags::NON_FINITE),
        zero_rotation: count(Flags::ZERO_ROTATION),
        snapped_d: count(Flags::SNAPPED_D),
        snapped_kappa: count(Flags::SNAPPED_KAPPA),
        never_alive: rows.life.iter().filter(|&&life| life == 0).count(),
        never_in_view: rows.vis.iter().filter(|&&vis| vis == 0.0).count(),
    }
}

/// Cameras of another scene see nothing of this one.
fn check_views(scene: &Scene, rows: &Rows) -> Result<()> {
    let alive = rows.life.iter().filter(|&&life| life > 0).count();
    let seen = rows.vis.iter().filter(|&&vis| vis > 0.0).count();
    if alive > 0 && seen == 0 {
        return Err(Error::usage(format!(
            "{}: none of the {alive} living Gaussians of {} is in any of its {} pictures\n  \
             give the cameras of this scene",
            scene.rig.origin,
            scene.path.shown(),
            scene.schedule.pairs()
        )));
    }
    Ok(())
}

impl Scored {
    /// The same within `limits`: statistics wait in a scratch file in `folder`, if they are to.
    ///
    /// # Errors
    /// A scratch file that cannot be written.
    pub(crate) fn within(self, limits: &Limits, folder: &Path) -> Result<Scored> {
        Ok(match self.statistics {
            StatisticsRows::Memory(rows) if limits.rows_aside => {
                Scored { statistics: StatisticsRows::aside(rows, folder)?, ..self }
            }
            _ => self,
        })
    }

    /// Whether Gaussian `id` is to stay as it is.
    pub fn is_protected(&self, id: u32) -> bool {
        self.protected.binary_search(&id).is_ok()
    }

    /// Returns the ids of all Gaussians that are not [absent](Scored::absent), increasing.
    pub fn present(&self) -> Vec<u32> {
        (0..self.count() as u32).filter(|id| self.absent.binary_search(id).is_err()).collect()
    }

    /// Statistics of every Gaussian.
    ///
    /// # Errors
    /// They were set aside and cannot be read back.
    pub fn rows(&self) -> Result<Cow<'_, Rows>> {
        self.statistics.rows()
    }

    /// C and Vis of every Gaussian.
    ///
    /// # Errors
    /// They were set aside and cannot be read back.
    pub fn importance(&self) -> Result<[Cow<'_, [f64]>; 2]> {
        self.statistics.importance()
    }

    /// The selection's own order.
    pub fn ranked(&self) -> Ranking {
        self.selection.ranking.clone()
    }

    /// N.
    pub fn count(&self) -> usize {
        self.statistics.len()
    }

    /// The scores that were selected by, computed anew.
    ///
    /// # Errors
    /// Those of [`Scored::rows`].
    pub fn scores(&self, recipe: &recipe::ScoreParams) -> Result<Scores> {
        let rows = self.rows()?;
        Ok(score(&rows, self.frames, recipe))
    }

    /// Percentiles of every term.
    pub fn term_summaries(&self) -> Vec<TermSummary> {
        let summarize = |term: &Term| TermSummary {
            name: term.of.name().to_owned(),
            p1: term.norm.p1,
            p99: term.norm.p99,
            active: term.norm.is_active(),
        };
        self.terms.iter().map(summarize).collect()
    }

    /// Writes down what the scene did not need in scan and score, how many Gaussians are odd, and what may be done about short
    /// lives.
    fn write_down(&self, scene: &Scene, median_life: u32, journal: &mut Journal) {
        let info = scene.source().info();
        if scene.input.may_be_linked() && (1..=info.times.len() / SHORT_LIFE).contains(&(median_life as usize)) {
            journal.notes.push(format!(
                "Gaussians live {median_life} of {} frames in the median: --link always makes one of lives that are one",
                info.times.len()
            ));
        }
        if info.times.len() <= 1 {
            let why = format!("{} frame{}", info.times.len(), if info.times.len() == 1 { "" } else { "s" });
            journal.leave_out("motion, curvature, opacity variance", why);
        } else {
            for column in Columns::all().difference(info.varying).iter() {
                let why = format!("{} is the same in every frame", column.name());
                let again = (info.times.len() - 1) as u64 * info.count as u64;
                let bytes = again * state_bytes(info.sh_degree, column);
                journal.spare(constant(column), why, Saved::Values { bytes });
            }
        }
        if info.sh_degree == 0 {
            journal.leave_out("higher bands of colour", "SH degree 0");
        }
        for term in self.terms.iter().filter(|term| !term.norm.is_active()) {
            let why = format!("1st and 99th percentile are both {}", term.norm.p1);
            journal.leave_out(format!("grading by {}", term.of.property()), why);
        }
        for (count, what) in [
            (self.flags.non_finite, "with NaN or infinity"),
            (self.flags.zero_rotation, "with a zero quaternion (taken as the identity)"),
            (self.flags.snapped_d, "whose motion D is rounding noise (set to 0)"),
            (self.flags.snapped_kappa, "whose curvature kappa is rounding noise (set to 0)"),
            (self.flags.never_alive, "never alive"),
        ] {
            if count > 0 {
                journal.notes.push(format!("{count} Gaussians {what}"));
            }
        }
    }
}

/// Frames that Gaussians live, in the median of those that do; 0 where none does.
fn median_life(life: &[u32]) -> u32 {
    let mut lives: Vec<u32> = life.iter().copied().filter(|&frames| frames > 0).collect();
    let middle = lives.len() / 2;
    if lives.is_empty() { 0 } else { *lives.select_nth_unstable(middle).1 }
}

fn constant(column: Columns) -> &'static str {
    match column {
        Columns::POSITION => "re-reading positions per frame",
        Columns::ROTATION => "re-reading rotations per frame",
        Columns::LOG_SCALE => "re-reading scales per frame",
        Columns::OPACITY => "re-reading opacities per frame",
        _ => "re-reading colours per frame",
    }
}
