//! From frames to a selection: scan, score, select.

use std::borrow::Cow;

use super::input::Scene;
use super::shelf::Shelf;
use super::summary::{FlagSummary, LeftOut, Stages, TermSummary};
use crate::error::{Error, Result};
use crate::model::{Columns, Flags, Gaussians, Rows};
use crate::recipe::{self, Coverage, NonFinite, Recipe, StaticTerm};
use crate::score::{Scores, Term, score};
use crate::select::{Overrides, Ranking, Selection, select};
use crate::stats::{RobustBox, ScanPlan, fill_anisotropy, snap};
use crate::stream::{Sample, Scanned, Seen, gather, scan, visible_contribution};

/// A scene with statistics and a selection of every Gaussian.
pub struct Scored {
    /// Statistics, noise snapped as the recipe says.
    shelf: Shelf,
    /// T.
    frames: usize,
    /// How the terms of the scores were normalised.
    pub terms: Vec<Term>,
    /// Counts of odd Gaussians.
    pub flags: FlagSummary,
    /// Stages 1 and 2, with the user's overrides.
    pub selection: Selection,
    /// The order in which Gaussians stay: the selection's, until there is a better one.
    pub ranking: Ranking,
    /// What that order goes by, for people.
    pub ranked_by: &'static str,
    /// Ids that are to be kept as they are, unmerged; increasing.
    pub protected: Vec<u32>,
    /// Ids that are to be dropped; increasing.
    pub dropped: Vec<u32>,
    /// Where Gaussians are compared with one another.
    pub reference: Reference,
    /// Distance between f32 values at the scene's largest coordinate: the noise floor of a position.
    pub position_ulp: f64,
}

/// The frame at which Gaussians are compared, and the scale of the scene there.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Reference {
    /// The frame with most Gaussians alive, ties to the first; 0 without frames.
    pub frame: usize,
    /// Robust extent of the positions there, scene units.
    pub extent: f64,
}

/// What the frames say before anything is scored.
pub struct Measured {
    /// Statistics of every Gaussian.
    pub scanned: Scanned,
    /// What the pictures show of each, where that is asked for.
    pub seen: Option<Seen>,
}

/// What the user knows better, before ids are resolved.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct UserOverrides {
    /// Ids to keep.
    pub keep: Vec<u32>,
    /// Ids to drop.
    pub drop: Vec<u32>,
    /// Box (low corner, high corner) whose Gaussians at the reference frame are kept.
    pub keep_box: Option<[f64; 6]>,
}

/// Scans, scores and selects.
pub fn score_scene(scene: &Scene, recipe: &Recipe, user: &UserOverrides, stages: &mut Stages) -> Result<Scored> {
    let measured = measure(scene, recipe, stages)?;
    score_measured(scene, measured, recipe, user, stages)
}

/// Scans the frames and looks at the pictures, one stage each.
pub fn measure(scene: &Scene, recipe: &Recipe, stages: &mut Stages) -> Result<Measured> {
    let source = scene.input.source();
    let info = source.info();
    let plan = ScanPlan::new(&recipe.scan, &info.times, &scene.schedule)?;
    let scanned = stages.run("scan", info.count, 1.0, || {
        let scanned = scan(source, &scene.schedule, &plan)?;
        Ok::<_, Error>((scanned, info.count))
    })?;
    let mut seen = None;
    if looks(scene.has_cameras, recipe.scan.coverage) {
        let sample = Sample::new(&scene.schedule, &recipe.scan);
        let reads = sample.frames() as f64 / info.times.len().max(1) as f64;
        seen = Some(stages.run("visible", info.count, reads, || {
            Ok::<_, Error>((visible_contribution(source, &sample, recipe.scan.pixel_stride, scene.limits)?, info.count))
        })?);
    }
    Ok(Measured { scanned, seen })
}

/// Scores and selects by what was measured.
pub fn score_measured(
    scene: &Scene,
    measured: Measured,
    recipe: &Recipe,
    user: &UserOverrides,
    stages: &mut Stages,
) -> Result<Scored> {
    let source = scene.input.source();
    let info = source.info();
    let Measured { scanned, seen } = measured;
    let mut rows = scanned.rows;
    if let Some(seen) = seen {
        (rows.c, rows.w) = (seen.coverage, seen.peak);
        let odd: Vec<u32> = non_finite(&rows).collect();
        for id in odd {
            (rows.c[id as usize], rows.w[id as usize]) = (0.0, 0.0);
        }
    }
    let reference_frame = first_of_largest(&scanned.alive_per_frame);
    stages.run("score", info.count, 0.0, || {
        if recipe.scan.snap_noise {
            snap(&mut rows, scanned.largest_coordinate);
        }
        let all: Vec<u32> = (0..info.count as u32).collect();
        let state = match info.times.is_empty() {
            true => Gaussians::zeros(info.count, info.sh_degree),
            false => gather(source, &all, reference_frame, Columns::POSITION | Columns::LOG_SCALE)?,
        };
        let extent = RobustBox::of(&state.position).extent();
        let canonical = scene.input.canonical_log_scale();
        fill_anisotropy(&mut rows, canonical.unwrap_or(&state.log_scale), recipe.score.anisotropy, extent);
        check_views(scene, &rows)?;
        let mut protected = user.keep.clone();
        if let Some(corners) = user.keep_box {
            protected.extend(all.iter().copied().filter(|&id| inside(&corners, state.position.row(id as usize))));
        }
        let mut drop = user.drop.clone();
        match recipe.scan.non_finite {
            NonFinite::Error => refuse_non_finite(scene, &rows)?,
            NonFinite::Drop => drop.extend(non_finite(&rows)),
            NonFinite::Keep => protected.extend(non_finite(&rows)),
        }
        for ids in [&mut protected, &mut drop] {
            ids.sort_unstable();
            ids.dedup();
        }
        let scores = score(&rows, info.times.len(), &recipe.score);
        let overrides = Overrides { keep_ids: protected.clone(), drop_ids: drop.clone() };
        let selection = select(&scores, &recipe.select, &overrides)?;
        let reference = Reference { frame: reference_frame, extent };
        let position_ulp = crate::stats::ulp(scanned.largest_coordinate);
        let scored = Scored {
            ranking: selection.ranking.clone(),
            ranked_by: name(recipe.score.static_term),
            frames: info.times.len(),
            terms: scores.terms,
            flags: flags(&rows),
            shelf: match scene.limits.rows_aside {
                true => Shelf::aside(rows, &scene.scratch_folder())?,
                false => Shelf::Memory(rows),
            },
            selection,
            protected,
            dropped: drop,
            reference,
            position_ulp,
        };
        Ok((scored, info.count))
    })
}

/// A static term as people know it.
pub fn name(term: StaticTerm) -> &'static str {
    match term {
        StaticTerm::Mean => "C",
        StaticTerm::Peak => "W",
        StaticTerm::Geometric => "sqrt(C*W)",
    }
}

/// Whether C is visible contribution.
pub(super) fn looks(has_cameras: bool, coverage: Coverage) -> bool {
    match coverage {
        Coverage::Auto => has_cameras,
        Coverage::Visible => true,
        Coverage::Projected => false,
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
    (0..rows.len() as u32).filter(|&id| rows.flags[id as usize].has(Flags::NON_FINITE))
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
    let count = |bits| rows.flags.iter().filter(|flags| flags.has(bits)).count();
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
            scene.path.display(),
            scene.schedule.pairs()
        )));
    }
    Ok(())
}

impl Scored {
    /// Statistics of every Gaussian.
    ///
    /// # Errors
    /// They were set aside and cannot be read back.
    pub fn rows(&self) -> Result<Cow<'_, Rows>> {
        self.shelf.rows()
    }

    /// C and Vis of every Gaussian.
    ///
    /// # Errors
    /// They were set aside and cannot be read back.
    pub fn importance(&self) -> Result<[Cow<'_, [f64]>; 2]> {
        self.shelf.importance()
    }

    /// Whether C is visible contribution.
    pub fn has_seen(&self) -> bool {
        self.shelf.has_peak()
    }

    /// N.
    pub fn count(&self) -> usize {
        self.shelf.len()
    }

    /// The scores that were selected by, computed anew.
    ///
    /// # Errors
    /// Those of [`Scored::rows`].
    pub fn scores(&self, recipe: &recipe::Score) -> Result<Scores> {
        let rows = self.rows()?;
        Ok(score(&rows, self.frames, recipe))
    }

    /// The ranking by another static term.
    ///
    /// # Errors
    /// Those of [`Scored::rows`].
    pub fn ranking_by(&self, term: StaticTerm, recipe: &Recipe) -> Result<Ranking> {
        let scores = self.scores(&recipe::Score { static_term: term, ..recipe.score.clone() })?;
        let overrides = Overrides { keep_ids: self.protected.clone(), drop_ids: self.dropped.clone() };
        Ok(select(&scores, &recipe.select, &overrides)?.ranking)
    }

    /// Percentiles of every term.
    pub fn term_summaries(&self) -> Vec<TermSummary> {
        let summarise = |term: &Term| TermSummary {
            name: term.name,
            p1: term.norm.p1,
            p99: term.norm.p99,
            active: term.norm.is_active(),
        };
        self.terms.iter().map(summarise).collect()
    }

    /// What the scene did not need in scan and score.
    pub fn left_out(&self, scene: &Scene) -> Vec<LeftOut> {
        let info = scene.input.source().info();
        let mut out = Vec::new();
        if info.times.len() <= 1 {
            let why = format!("{} frame{}", info.times.len(), if info.times.len() == 1 { "" } else { "s" });
            out.push(LeftOut { what: "motion, curvature, opacity variance", why });
        } else {
            for column in Columns::ALL.without(info.varying).iter() {
                out.push(LeftOut {
                    what: constant(column),
                    why: format!("{} is the same in every frame", column.name()),
                });
            }
        }
        if info.sh_degree == 0 {
            out.push(LeftOut { what: "higher bands of colour", why: "SH degree 0".to_owned() });
        }
        for term in self.terms.iter().filter(|term| !term.norm.is_active()) {
            let why = format!("1st and 99th percentile are both {}", term.norm.p1);
            out.push(LeftOut { what: inactive(term.name), why });
        }
        out
    }
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

fn inactive(term: &str) -> &'static str {
    match term {
        "C" | "W" | "sqrt(C*W)" => "grading by coverage",
        "E" => "grading by anisotropy",
        "D" => "grading by motion",
        "kappa" => "grading by curvature",
        "V" => "grading by opacity variance",
        "Life" => "grading by life span",
        "S_static" => "grading by the static score",
        _ => "grading by the dynamic score",
    }
}
