//! Stage `score`: turns the statistics of the Gaussians into scores, and the scores into a ranking and a selection of
//! the Gaussians to keep.

use std::borrow::Cow;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::compressed_model::ReferenceFrame;
use crate::error::{Error, Result, ShowPath};
use crate::files::defects::first_of;
use crate::journal::Journal;
use crate::journal::records::{SavedCost, TermSummary, UnusualValueCounts};
use crate::limits::Limits;
use crate::memory_plan::{MemoryPart, ResourceEstimate, Workload};
use crate::model::RobustBox;
use crate::model::{AnomalyFlags, Attributes, Gaussians, StatisticRows};
use crate::models::trajectories::state_bytes;
use crate::passes::{frames_needed_to_see_all, gather};
use crate::pruning;
use crate::pruning::contribution::VisibleContribution;
use crate::pruning::{Ranking, Selection, select};
use crate::recipe::{self, NonFinitePolicy};
use crate::scene::Scene;
use crate::statistics::pass::ScanResult;
use crate::statistics::score::{Scores, Term, score};
use crate::statistics::spilled::StatisticsRows;
use crate::statistics::{fill_anisotropy, snap_noise_to_zero, ulp};

/// Name of this stage in messages and in the cache.
pub(crate) const NAME: &str = "score";

/// Bytes of memory per Gaussian, while scoring, for its statistics, its scores and the selection of Gaussians to keep.
pub const SCORING_BYTES_PER_GAUSSIAN: u64 =
    (StatisticRows::BYTES_PER_GAUSSIAN + Scores::BYTES_PER_GAUSSIAN + pruning::BYTES_PER_GAUSSIAN) as u64;

/// Returns the named parts of the memory per Gaussian, in bytes, that stay in use after scoring: the selection of
/// Gaussians to keep, and, if they are not in a scratch file, the statistics.
pub fn scored_memory(limits: &Limits) -> Vec<MemoryPart> {
    let rows = if limits.statistics_on_disk { 0 } else { StatisticRows::BYTES_PER_GAUSSIAN as u64 };
    vec![("statistics", rows), ("selection", pruning::BYTES_PER_GAUSSIAN as u64)]
}

/// Stage that scores the Gaussians and selects those to keep, with its parameters.
#[derive(Debug, Clone)]
pub struct ScoreStage {
    /// Whether motion that could be rounding noise of the positions is set to zero.
    pub snap_noise: bool,
    /// Policy for Gaussians with NaN or infinity in an attribute: the run stops with an error, drops them, or keeps
    /// them unchanged.
    pub non_finite: NonFinitePolicy,
    /// Normalization and weights of the scores.
    pub score: recipe::ScoreParams,
    /// Parameters of the selection: fraction kept by score, and thresholds of the static and the dynamic score.
    pub select: recipe::SelectParams,
    /// Gaussians that are kept or dropped because the user says so, whatever their scores.
    pub user: UserOverrides,
}

/// Life spans count as short if the number of frames is at least this multiple of the median life span (number of
/// frames in which a Gaussian is alive, by its opacity). The user is then told about linking, which joins Gaussians
/// that continue one another in later frames.
const SHORT_LIFE_RATIO: usize = 4;

/// [`NonFinitePolicy::Few`] drops the Gaussians with NaN or infinity if they are at most this fraction of all Gaussians;
/// otherwise the run stops.
const FEW_FRACTION: f64 = 0.01;

/// Result of stage `score`: statistics of every Gaussian of a scene, and a selection of those to keep.
#[derive(Serialize, Deserialize)]
pub struct Scored {
    /// Statistics of every Gaussian. If the recipe says so, motion within rounding noise has been set to 0.
    statistics: StatisticsRows,
    /// Number of frames of the scene.
    frames: usize,
    /// Number of evenly spaced frames that must be rendered so that Gaussians with short life spans are seen too; see
    /// [`frames_needed_to_see_all`].
    #[serde(rename = "frames_to_see")]
    pub frames_needed_to_see_all: usize,
    /// Terms of the scores: the quantities that are added, each with the percentiles by which it is normalized.
    pub terms: Vec<Term>,
    /// Number of Gaussians with unusual values, for each kind of unusual value (such as NaN).
    pub flags: UnusualValueCounts,
    /// Selected Gaussians and ranking, with the user's overrides applied.
    pub selection: Selection,
    /// Ids of protected Gaussians, which are kept, not changed and not merged; increasing.
    pub protected: Vec<u32>,
    /// Ids of Gaussians that were dropped because a value is not finite; increasing. The scene is read without these
    /// Gaussians.
    pub absent: Vec<u32>,
    /// Reference frame, at which Gaussians are compared for merging (the frame with the most Gaussians alive, opacity ≥
    /// alpha_min), and the extent of the scene at this frame.
    pub reference: ReferenceFrame,
    /// Noise level of a position, in scene units: the distance between neighboring f32 values at the scene's largest
    /// coordinate.
    pub position_ulp: f64,
}

/// Gaussians that are kept or dropped because the user says so. They are given by ids and by a box.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct UserOverrides {
    /// Ids of Gaussians to keep. These Gaussians are not changed.
    pub keep: Vec<u32>,
    /// Ids of Gaussians to drop.
    pub drop: Vec<u32>,
    /// Box in scene units: low corner (x, y, z), then high corner. Gaussians whose centers are inside it at the
    /// reference frame are kept.
    pub keep_box: Option<[f64; 6]>,
}

impl ScoreStage {
    /// Estimates the memory and time that this stage needs for the input `work`: statistics, scores, a selection, and
    /// the states at one frame.
    pub fn resource_estimate(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        ResourceEstimate {
            stage: NAME,
            reads: work.whole_input_reads(1, limits),
            seconds: 2e-6 * work.gaussian_count(),
            per_gaussian: vec![
                ("statistics", SCORING_BYTES_PER_GAUSSIAN),
                ("sorting", pruning::WORKING_BYTES_PER_GAUSSIAN as u64),
                ("states", work.state_bytes(Attributes::POSITION | Attributes::LOG_SCALE)),
            ],
            fixed: vec![work.block_buffer_memory()],
        }
    }

    /// Returns the ids, in increasing order, of the Gaussians that are dropped because one of their values is not
    /// finite. There are none if the recipe does not drop such Gaussians.
    pub fn non_finite_ids_to_drop(&self, rows: &StatisticRows) -> Vec<u32> {
        let ids: Vec<u32> = non_finite(rows).collect();
        let are_dropped = match self.non_finite {
            NonFinitePolicy::Drop => true,
            NonFinitePolicy::Few => ids.len() as f64 <= FEW_FRACTION * rows.len() as f64,
            NonFinitePolicy::Error | NonFinitePolicy::Keep => false,
        };
        if are_dropped { ids } else { Vec::new() }
    }

    /// Computes scores and a selection of the Gaussians to keep, from the statistics `scanned` and, if measured, the
    /// visible contributions `visible`. Notes for the user are added to `journal`.
    ///
    /// # Errors
    /// Fails if values are not finite (unless the recipe drops or keeps such Gaussians), if no Gaussian is in any view
    /// of the cameras, and if an id is to be both kept and dropped.
    pub fn run(
        &self,
        scene: &Scene,
        scanned: ScanResult,
        visible: Option<VisibleContribution>,
        journal: &mut Journal,
    ) -> Result<Scored> {
        let source = scene.source();
        let info = source.info();
        let mut rows = scanned.rows;
        if let Some(visible) = visible {
            (rows.c, rows.w) = (visible.coverage, visible.peak);
            let non_finite_ids: Vec<u32> = non_finite(&rows).collect();
            for id in non_finite_ids {
                rows.clear(id as usize);
            }
        }
        let reference_frame = first_of_largest(&scanned.alive_per_frame);
        journal.run_stage(NAME, info.count, source, |journal| {
            let progress = scene.events.task(NAME, "Gaussians", info.count as u64);
            if self.snap_noise {
                snap_noise_to_zero(&mut rows, scanned.largest_coordinate);
            }
            let all_ids: Vec<u32> = (0..info.count as u32).collect();
            let state = match info.times.is_empty() {
                true => Gaussians::zeros(info.count, info.sh_degree),
                false => gather(source, &all_ids, reference_frame, Attributes::POSITION | Attributes::LOG_SCALE)?,
            };
            let extent = RobustBox::from_positions(&state.position).extent();
            let canonical = scene.input.canonical().unwrap_or(&state);
            fill_anisotropy(&mut rows, &canonical.log_scale, self.score.anisotropy, extent);
            check_views(scene, &rows)?;
            let mut protected = self.user.keep.clone();
            if let Some(corners) = self.user.keep_box {
                protected
                    .extend(all_ids.iter().copied().filter(|&id| is_inside(&corners, state.position.row(id as usize))));
            }
            let mut drop = self.user.drop.clone();
            let absent = self.non_finite_ids_to_drop(&rows);
            drop.extend(&absent);
            match self.non_finite {
                NonFinitePolicy::Keep => protected.extend(non_finite(&rows)),
                NonFinitePolicy::Error | NonFinitePolicy::Few if absent.is_empty() => refuse_non_finite(scene, &rows)?,
                NonFinitePolicy::Error | NonFinitePolicy::Few | NonFinitePolicy::Drop => {}
            }
            for ids in [&mut protected, &mut drop] {
                ids.sort_unstable();
                ids.dedup();
            }
            let scores = score(&rows, info.times.len(), &self.score);
            let selection = select(&scores, &self.select, &protected, &drop)?;
            let reference = ReferenceFrame { frame: reference_frame, extent };
            let position_ulp = ulp(scanned.largest_coordinate);
            let median_life = median_life(&rows.life);
            let scored = Scored {
                frames: info.times.len(),
                frames_needed_to_see_all: frames_needed_to_see_all(&rows.life, info.times.len()),
                terms: scores.terms,
                flags: count_flags(&rows),
                statistics: match scene.limits.statistics_on_disk {
                    true => StatisticsRows::spill(rows, &scene.scratch)?,
                    false => StatisticsRows::Memory(rows),
                },
                selection,
                protected,
                absent,
                reference,
                position_ulp,
            };
            scored.record(scene, median_life, scanned.is_partial, journal);
            progress.advance(info.count as u64);
            Ok((scored, info.count))
        })
    }
}

fn first_of_largest(counts: &[u32]) -> usize {
    let largest = counts.iter().copied().max().unwrap_or(0);
    counts.iter().position(|&count| count == largest).unwrap_or(0)
}

fn is_inside(corners: &[f64; 6], position: [f32; 3]) -> bool {
    (0..3).all(|axis| (corners[axis]..=corners[axis + 3]).contains(&f64::from(position[axis])))
}

fn non_finite(rows: &StatisticRows) -> impl Iterator<Item = u32> {
    (0..rows.len() as u32).filter(|&id| rows.flags[id as usize].contains(AnomalyFlags::NON_FINITE))
}

fn refuse_non_finite(scene: &Scene, rows: &StatisticRows) -> Result<()> {
    let ids: Vec<u32> = non_finite(rows).collect();
    if ids.is_empty() {
        return Ok(());
    }
    let place = format!("Gaussian {}", first_of(&ids, ids.len()));
    let found = format!("NaN or infinity in {} of {} Gaussians", ids.len(), rows.len());
    Err(Error::input(scene.shown_path(), place, "finite values in every frame", found).hint(
        "at most 1% of such Gaussians are left out without asking; --set non_finite=drop removes any number of \
             them, --set non_finite=keep leaves them as they are",
    ))
}

/// Returns the number of Gaussians with unusual values, such as NaN, for each kind of unusual value.
fn count_flags(rows: &StatisticRows) -> UnusualValueCounts {
    let count = |flag| rows.flags.iter().filter(|flags| flags.contains(flag)).count();
    UnusualValueCounts {
        non_finite: count(AnomalyFlags::NON_FINITE),
        zero_rotation: count(AnomalyFlags::ZERO_ROTATION),
        infinite_logit: count(AnomalyFlags::INFINITE_LOGIT),
        snapped_d: count(AnomalyFlags::SNAPPED_D),
        snapped_kappa: count(AnomalyFlags::SNAPPED_KAPPA),
        never_alive: rows.life.iter().filter(|&&life| life == 0).count(),
        never_in_view: rows.vis.iter().filter(|&&vis| vis == 0.0).count(),
    }
}

/// Fails if Gaussians are alive (opacity ≥ alpha_min) but none is in any view. This happens if the cameras belong to
/// another scene.
fn check_views(scene: &Scene, rows: &StatisticRows) -> Result<()> {
    let alive = rows.life.iter().filter(|&&life| life > 0).count();
    let seen = rows.vis.iter().filter(|&&vis| vis > 0.0).count();
    if alive > 0 && seen == 0 {
        return Err(Error::usage(format!(
            "{}: none of the {alive} living Gaussians of {} is in any of its {} views\n  \
             give the cameras of this scene",
            scene.rig.origin,
            scene.shown_path().shown(),
            scene.schedule.pair_count()
        )));
    }
    Ok(())
}

impl Scored {
    /// Returns this result, with its statistics moved from memory to a scratch file in `folder` if `limits` requires
    /// this.
    ///
    /// # Errors
    /// Fails if the scratch file cannot be written.
    pub(crate) fn within(self, limits: &Limits, folder: &Path) -> Result<Scored> {
        Ok(match self.statistics {
            StatisticsRows::Memory(rows) if limits.statistics_on_disk => {
                Scored { statistics: StatisticsRows::spill(rows, folder)?, ..self }
            }
            _ => self,
        })
    }

    /// Returns whether Gaussian `id` is protected: kept, not changed and not merged.
    pub fn is_protected(&self, id: u32) -> bool {
        self.protected.binary_search(&id).is_ok()
    }

    /// Returns the statistics of every Gaussian; reads them back first if they are in the scratch file.
    ///
    /// # Errors
    /// Fails if the statistics are in a scratch file that cannot be read back.
    pub fn rows(&self) -> Result<Cow<'_, StatisticRows>> {
        self.statistics.rows()
    }

    /// Returns two statistics of every Gaussian: the contribution C, and the visibility Vis (fraction of the views in
    /// which the Gaussian is alive and on screen).
    ///
    /// # Errors
    /// Fails if the statistics are in a scratch file that cannot be read back.
    pub fn importance(&self) -> Result<[Cow<'_, [f64]>; 2]> {
        self.statistics.importance()
    }

    /// Returns the ranking of the Gaussians, best first.
    pub fn ranking(&self) -> Ranking {
        self.selection.ranking.clone()
    }

    /// Returns the number of all Gaussians of the scene.
    pub fn gaussian_count(&self) -> usize {
        self.statistics.len()
    }

    /// Computes the scores again from the statistics. The selection is based on these scores but does not hold them.
    /// `recipe`: normalization and weights of the scores.
    ///
    /// # Errors
    /// Fails if the statistics are in a scratch file that cannot be read back.
    pub fn scores(&self, recipe: &recipe::ScoreParams) -> Result<Scores> {
        let rows = self.rows()?;
        Ok(score(&rows, self.frames, recipe))
    }

    /// Returns for each term of the scores its name, the 1st and 99th percentile between which it is normalized, and
    /// whether these differ.
    pub fn term_summaries(&self) -> Vec<TermSummary> {
        let summarize = |term: &Term| TermSummary {
            name: term.quantity.name().to_owned(),
            p1: term.norm.p1,
            p99: term.norm.p99,
            active: term.norm.has_spread(),
        };
        self.terms.iter().map(summarize).collect()
    }

    /// Writes notes for the user to `journal`, the record of the run:
    /// - parts of scanning and scoring that the scene did not need;
    /// - numbers of Gaussians with unusual values;
    /// - advice if life spans are short. `median_life`: median number of frames in which a Gaussian is alive.
    ///
    /// `is_partial`: whether only some frames were scanned. Terms of motion and opacity were then not measured and are
    /// not mentioned.
    fn record(&self, scene: &Scene, median_life: u32, is_partial: bool, journal: &mut Journal) {
        let info = scene.source().info();
        if scene.input.description().may_be_linked
            && (1..=info.times.len() / SHORT_LIFE_RATIO).contains(&(median_life as usize))
        {
            journal.notes.push(format!(
                "Gaussians are alive in {median_life} of {} frames (median): --link always joins Gaussians that \
                 continue one another",
                info.times.len()
            ));
        }
        if info.times.len() <= 1 {
            let why = format!("{} frame{}", info.times.len(), if info.times.len() == 1 { "" } else { "s" });
            journal.leave_out("motion, curvature, opacity variance", why);
        } else {
            for column in Attributes::all().difference(info.varying).iter() {
                let why = format!("{} is the same in every frame", column.name());
                let again = (info.times.len() - 1) as u64 * info.count as u64;
                let bytes = again * state_bytes(info.sh_degree, column);
                journal.leave_out_with_saving(saved_reads(column), why, SavedCost::Values { bytes });
            }
        }
        if info.sh_degree == 0 {
            journal.leave_out("SH coefficients above degree 0", "SH degree 0");
        }
        let was_measured = |term: &&Term| !(is_partial && term.quantity.describes_motion());
        for term in self.terms.iter().filter(was_measured).filter(|term| !term.norm.has_spread()) {
            let why = format!("1st and 99th percentile are both {}", term.norm.p1);
            journal.leave_out(format!("grading by {}", term.quantity.measured_property()), why);
        }
        let absent = self.absent.len();
        if absent > 0 {
            let (all, percent) = (info.count, 100.0 * absent as f64 / info.count as f64);
            let ids = first_of(&self.absent, absent);
            journal.notes.push(format!(
                "{absent} of {all} Gaussians ({percent:.2}%) left out: NaN or infinity in some frame, which no renderer \
                 draws (Gaussian {ids})"
            ));
        }
        for (count, what) in [
            (self.flags.non_finite - absent, "with NaN or infinity"),
            (self.flags.zero_rotation, "with a zero quaternion (taken as the identity)"),
            (self.flags.infinite_logit, "with an opacity logit of ±100 or beyond (infinite ones are read as ±100)"),
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

/// Returns the median number of frames in which a Gaussian is alive (opacity ≥ alpha_min). Gaussians that are never
/// alive are ignored; if all are, returns 0.
fn median_life(life: &[u32]) -> u32 {
    let mut lives: Vec<u32> = life.iter().copied().filter(|&frames| frames > 0).collect();
    let middle = lives.len() / 2;
    if lives.is_empty() { 0 } else { *lives.select_nth_unstable(middle).1 }
}

fn saved_reads(column: Attributes) -> &'static str {
    match column {
        Attributes::POSITION => "re-reading positions per frame",
        Attributes::ROTATION => "re-reading rotations per frame",
        Attributes::LOG_SCALE => "re-reading scales per frame",
        Attributes::OPACITY => "re-reading opacities per frame",
        _ => "re-reading colors per frame",
    }
}
