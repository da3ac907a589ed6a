//! Stage `refine`: moving what is stored of the survivors until their pictures come closest to the original's.
//!
//! Pruning leaves holes that only what is left can fill: footprints must grow over them. So the stored values of the
//! survivors descend the gradient of the squared error of one picture after another, of the cameras that the scene is
//! scored by and of cameras in between, so that what comes out fits no view more than others. Every fourth picture is
//! kept apart; the state that those like best stays, the start included. A field stays as it is.
//!
//! Memory: what [`Descent`] and one differentiated picture take, three states, and the best change so far. The
//! original's pictures and the states that they show wait in scratch files.

use super::journal::Journal;
use super::score::{Scored, scored};
use crate::budget::{Need, RENDER, Workload};
use crate::emit::atomic::Spill;
use crate::error::Result;
use crate::limits::Limits;
use crate::model::{Camera, Columns, Gaussians, Gradients, Picture};
use crate::recipe;
use crate::reduction::{Change, Reduction};
use crate::refine::{self, Descent};
use crate::render::{GRADIENT_BYTES_PER_VISIBLE, GRADIENT_STRIP_BYTES, Image, Renderer, render};
use crate::scene::Scene;
use crate::scene::between::{Dice, between};
use crate::source::{FrameSource, Wanted};
use crate::stream::{Batch, Progress, States, Subject, VIEWS_AT_ONCE, show, spread};

use rayon::prelude::*;

/// What the stage is called.
const NAME: &str = "refine";

/// Pictures of the scene's cameras that are looked at, and as many in between.
const PICTURES: usize = 130;
/// Of both every fourth is kept apart.
const APART_EVERY: usize = 4;
/// Steps between two looks at the pictures kept apart.
const JUDGE_EVERY: usize = 100;

/// The refinement of a run.
#[derive(Debug, Clone)]
pub struct Refine {
    /// Pictures that are stepped along, one at a time.
    pub steps: usize,
}

impl Refine {
    /// The stage, unless `recipe` asks for no steps.
    pub fn of(recipe: &recipe::Refine) -> Option<Refine> {
        let steps = recipe.refine_steps as usize;
        (steps > 0).then_some(Refine { steps })
    }

    /// States, the descent, and a picture that is differentiated.
    pub fn need(&self, work: &Workload, limits: &Limits) -> Need {
        let whole = work.state(Columns::all());
        let per_gaussian = vec![
            ("kept", 24),
            ("states", 3 * whole),
            ("descent", whole + refine::bytes_per_gaussian(Columns::all(), work.sh_degree) as u64),
            ("result", work.input.reduced),
            ("readers", 2 * work.input.reader),
            ("held", 2 * work.held(limits, Columns::all())),
            ("pictures", 2 * GRADIENT_BYTES_PER_VISIBLE as u64),
        ];
        let pictures = 2 * PICTURES as u64;
        let frames = (PICTURES as u64).min(work.frames.max(1));
        let judged = pictures.div_ceil(APART_EVERY as u64) * (2 + self.steps.div_ceil(JUDGE_EVERY) as u64);
        let left = 0.5 * work.count();
        Need {
            stage: NAME,
            reads: 2.0 * work.scattered_reads(frames, limits),
            seconds: work.reading(1.5 * work.count(), frames as f64)
                + work.picturing(pictures as f64, work.count(), RENDER)
                + work.picturing(judged as f64 + 2.5 * self.steps as f64, left, RENDER),
            per_gaussian: [scored(limits), per_gaussian].concat(),
            fixed: vec![
                work.arriving(),
                ("pairs", GRADIENT_STRIP_BYTES as u64),
                ("pictures", (work.threads + 4) * 12 * work.pixels),
            ],
        }
    }

    /// Refines what is left, if pictures kept apart come closer to the original's by it; protected Gaussians keep what
    /// is stored of them.
    ///
    /// # Errors
    /// Frames that cannot be read; a scratch file that cannot be written.
    pub fn run(
        &self,
        scene: &Scene,
        scored: &Scored,
        mut reduction: Reduction,
        journal: &mut Journal,
    ) -> Result<Reduction> {
        let columns = scene.input.refinable();
        let count = reduction.len();
        let (cameras, pictures) = looked_at(scene);
        if columns.is_empty() || count == 0 || pictures.len() < APART_EVERY {
            let why = match columns.is_empty() {
                true => "nothing that is stored of such an input can move without its field",
                false => "there is nothing to be seen",
            };
            journal.leave_out("refinement", why);
            return Ok(reduction);
        }
        let change = journal.stage(NAME, count, scene.source(), |journal| {
            let result = scene.input.reduced(&reduction)?;
            let fixed = reduction.kept.iter().map(|id| scored.protected.binary_search(id).is_ok()).collect();
            let mut table = Table::new(scene, &*result, &cameras, &pictures)?;
            let (apart, mut fitted): (Vec<usize>, Vec<usize>) =
                (0..pictures.len()).partition(|k| k % APART_EVERY == APART_EVERY - 1);
            let before = table.judge(&apart, |_| ())?;
            let mut descent = Descent::new(&table.still, columns, fixed, self.steps, before.error);
            let mut gradients = Gradients::new(count, columns, scene.source().info().sh_degree);
            let (mut best, mut kept) = (before, Change::default());
            let mut dice = Dice(1);
            let progress = Progress::new(NAME, "steps", self.steps as u64);
            for step in 0..self.steps {
                let turn = step % fitted.len();
                if turn == 0 {
                    dice.shuffle(&mut fitted);
                }
                gradients.clear();
                table.slope(fitted[turn], |state| descent.add_to(state), &mut gradients)?;
                descent.step(&gradients);
                progress.advance(1);
                if (step + 1) % JUDGE_EVERY == 0 || step + 1 == self.steps {
                    let now = table.judge(&apart, |state| descent.add_to(state))?;
                    if now.psnr > best.psnr {
                        (best, kept) = (now, descent.change());
                    }
                }
            }
            let [start, end] = [before.psnr, best.psnr];
            if kept.is_empty() {
                journal.leave_out("refinement", format!("pictures kept apart never kept more than {start:.2} dB"));
            } else {
                journal.notes.push(format!("refined: pictures kept apart keep {end:.2} dB, not {start:.2}"));
            }
            Ok((kept, count))
        })?;
        reduction.change = reduction.change.and(change);
        Ok(reduction)
    }
}

/// Cameras and pictures that are looked at, by frame: those that the scene is scored by, and as many in between.
fn looked_at(scene: &Scene) -> (Vec<Camera>, Vec<Picture>) {
    let mut pictures = spread(&scene.schedule, PICTURES, VIEWS_AT_ONCE);
    let mut own: Vec<u32> = scene.schedule.frames.iter().flatten().map(|&(_, camera)| camera).collect();
    own.sort_unstable();
    own.dedup();
    let mut cameras: Vec<Camera> = own.iter().map(|&camera| scene.schedule.cameras[camera as usize].clone()).collect();
    for picture in &mut pictures {
        picture.camera = own.binary_search(&picture.camera).unwrap_or_default() as u32;
    }
    let (seen, mut dice) = (pictures.len(), Dice(2));
    for camera in between(&cameras, seen) {
        let frame = pictures[dice.below(seen)].frame;
        pictures.push(Picture { frame, view: u32::MAX, camera: cameras.len() as u32 });
        cameras.push(camera);
    }
    pictures.sort_by_key(|picture| picture.frame);
    (cameras, pictures)
}

/// How close pictures are to the original's.
#[derive(Debug, Clone, Copy)]
struct Closeness {
    /// Mean, dB.
    psnr: f64,
    /// Root of the mean square error of all.
    error: f64,
}

/// The original's pictures and the states of what is left that they show, in scratch files.
struct Table<'a> {
    cameras: &'a [Camera],
    pictures: &'a [Picture],
    background: [f32; 3],
    /// Of every picture its values from 0 to 1 as 16 bits, one after the other from its place.
    targets: Spill,
    places: Vec<u64>,
    /// Of every frame that is shown the columns that vary.
    states: Spill,
    frames: Vec<usize>,
    varying: Columns,
    /// The state at the first frame that is shown: the other columns.
    still: Gaussians,
    /// The state of the picture in the making.
    now: Gaussians,
    renderer: Renderer,
}

impl<'a> Table<'a> {
    fn new(
        scene: &Scene,
        result: &dyn FrameSource,
        cameras: &'a [Camera],
        pictures: &'a [Picture],
    ) -> Result<Table<'a>> {
        let (background, limits) = (scene.background, &scene.limits);
        let (mut targets, mut places, mut end) = (Spill::new(&scene.scratch)?, Vec::new(), 0);
        show([Subject::all(scene.source())], cameras, pictures, Batch::of_frame(limits), |views| {
            let made: Vec<Vec<u16>> =
                views.par_iter().map(|view| narrow(&render(view.states[0], view.camera, background))).collect();
            made.iter().try_for_each(|values| {
                places.push(end);
                end += 2 * values.len() as u64;
                targets.write(bytemuck::cast_slice(values))
            })
        })?;
        targets.finish()?;
        let mut frames: Vec<usize> = pictures.iter().map(|picture| picture.frame).collect();
        frames.dedup();
        let varying = result.info().varying;
        let mut of_result = States::open(result, &Wanted::of(frames.clone()).holding(limits.frames_held))?;
        let (mut states, mut still) = (Spill::new(&scene.scratch)?, None);
        for &frame in &frames {
            let state = of_result.at(frame)?;
            varying.iter().try_for_each(|column| states.write(bytemuck::cast_slice(state.column(column).planes())))?;
            still.get_or_insert_with(|| state.clone());
        }
        states.finish()?;
        let still = still.unwrap_or_default();
        let (now, renderer) = (still.clone(), Renderer::new());
        Ok(Table { cameras, pictures, background, targets, places, states, frames, varying, still, now, renderer })
    }

    /// The original's picture `k`.
    fn target(&self, k: usize) -> Result<Vec<u16>> {
        let camera = &self.cameras[self.pictures[k].camera as usize];
        let mut values = vec![0u16; 3 * camera.width as usize * camera.height as usize];
        self.targets.read(self.places[k], bytemuck::cast_slice_mut(&mut values))?;
        Ok(values)
    }

    /// Makes the state that picture `k` shows, `moved`.
    fn set(&mut self, k: usize, moved: impl Fn(&mut Gaussians)) -> Result<()> {
        let place = self.frames.binary_search(&self.pictures[k].frame).unwrap_or_default() as u64;
        let bytes = |column: Columns| 4 * self.still.column(column).planes().len() as u64;
        let mut at = place * self.varying.iter().map(bytes).sum::<u64>();
        for column in Columns::all().iter() {
            let to = self.now.column_mut(column).planes_mut();
            if self.varying.contains(column) {
                self.states.read(at, bytemuck::cast_slice_mut(to))?;
                at += bytes(column);
            } else {
                to.copy_from_slice(self.still.column(column).planes());
            }
        }
        moved(&mut self.now);
        Ok(())
    }

    /// Adds how the squared error of picture `k` changes with what is stored to `gradients`.
    fn slope(&mut self, k: usize, moved: impl Fn(&mut Gaussians), gradients: &mut Gradients) -> Result<()> {
        let target = self.target(k)?;
        self.set(k, moved)?;
        let camera = &self.cameras[self.pictures[k].camera as usize];
        let pull = |picture: &Image| {
            let mut slope = picture.clone();
            for (value, &wanted) in slope.data.iter_mut().zip(&target) {
                // What a screen cannot show does not count.
                let shown = value.clamp(0.0, 1.0);
                *value = if shown == *value { 2.0 * (shown - wide(wanted)) } else { 0.0 };
            }
            (0.0, slope)
        };
        self.renderer.gradient(&self.now, camera, self.background, pull, gradients);
        Ok(())
    }

    /// How close the pictures numbered `of` are, with what is left `moved`.
    fn judge(&mut self, of: &[usize], moved: impl Fn(&mut Gaussians)) -> Result<Closeness> {
        let (mut psnr, mut error) = (0.0, 0.0);
        for &k in of {
            let target = self.target(k)?;
            self.set(k, &moved)?;
            let picture = render(&self.now, &self.cameras[self.pictures[k].camera as usize], self.background);
            let square = |(value, &wanted): (&f32, &u16)| f64::from(value.clamp(0.0, 1.0) - wide(wanted)).powi(2);
            let sum: f64 = picture.data.iter().zip(&target).map(square).sum();
            let mean = sum / target.len().max(1) as f64;
            psnr += -10.0 * mean.max(1e-10).log10();
            error += mean;
        }
        let count = of.len().max(1) as f64;
        Ok(Closeness { psnr: psnr / count, error: (error / count).sqrt() })
    }
}

/// Values from 0 to 1 as 16 bits.
fn narrow(picture: &Image) -> Vec<u16> {
    // NaN becomes 0.
    picture.data.iter().map(|value| (value.clamp(0.0, 1.0) * f32::from(u16::MAX)).round() as u16).collect()
}

fn wide(value: u16) -> f32 {
    f32::from(value) / f32::from(u16::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compress::score::UserOverrides;
    use crate::compress::tests::{scene, score_scene};
    use crate::metrics::psnr;
    use crate::model::{Rig, Split};
    use crate::recipe::Recipe;
    use crate::stream::gather_all;

    /// The first `count` of the ranking of `scene`, refined in `steps` steps; `keep` are protected.
    fn refined(scene: &Scene, count: usize, steps: usize, keep: Vec<u32>) -> (Reduction, Journal) {
        let recipe = Recipe::preset("default").unwrap();
        let scored = score_scene(scene, &recipe, &UserOverrides { keep, ..UserOverrides::default() });
        let reduction = Reduction::pruned(scored.ranked().ranking.take(count), &recipe.merge);
        let mut journal = Journal::default();
        (Refine { steps }.run(scene, &scored, reduction, &mut journal).unwrap(), journal)
    }

    /// Mean PSNR of `reduction` over the pictures of `rig` that the scene is not scored by.
    fn held_out(scene: &Scene, rig: &Rig, reduction: &Reduction) -> f64 {
        let schedule = rig.schedule(&scene.source().info().times, Some(Split::Test)).unwrap();
        let result = scene.input.reduced(reduction).unwrap();
        let of_frame = |(frame, views): (usize, &Vec<(u32, u32)>)| -> f64 {
            let [original, now] =
                [scene.source(), &*result].map(|source| gather_all(source, frame, Columns::all()).unwrap());
            let of_view = |&(_, camera): &(u32, u32)| {
                let made = |state| render(state, &schedule.cameras[camera as usize], scene.background);
                psnr(&made(&now), &made(&original))
            };
            views.iter().map(of_view).sum()
        };
        schedule.frames.iter().enumerate().map(of_frame).sum::<f64>() / schedule.pairs() as f64
    }

    #[test]
    fn pictures_of_no_camera_that_was_looked_through_come_closer_by_it() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let rig = scene.rig.clone();
        let (plain, _) = refined(&scene, 300, 0, Vec::new());
        let (moved, journal) = refined(&scene, 300, 200, Vec::new());
        let [before, after] = [&plain, &moved].map(|reduction| held_out(&scene, &rig, reduction));
        assert!(after > before + 3.0, "{before:.2} dB before, {after:.2} after");
        assert_eq!((journal.left_out.len(), journal.notes.len()), (0, 1));
        assert_eq!(moved.kept, plain.kept);
    }

    #[test]
    fn what_comes_out_depends_neither_on_threads_nor_on_limits_and_what_is_protected_stays() {
        let folder = tempfile::tempdir().unwrap();
        let mut scene = scene(folder.path());
        let keep: Vec<u32> = (100..140).collect();
        let on = |threads: usize, scene: &Scene| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| refined(scene, 200, 110, keep.clone())).0
        };
        let one = on(1, &scene);
        assert!(!one.change.is_empty());
        assert!(on(3, &scene).change == one.change, "threads change it");
        scene.limits = Limits { frames_held: 1, pictures_together: 1, ..Limits::NONE };
        assert!(on(2, &scene).change == one.change, "limits change it");
        for (place, id) in one.kept.iter().enumerate().filter(|(_, id)| keep.contains(id)) {
            let moved = |column: Columns| {
                let of = one.change.0.column(column);
                (0..of.width()).any(|c| of.plane(c)[place] != 0.0)
            };
            assert!(!Columns::all().iter().any(moved), "Gaussian {id} is protected and moved");
        }
    }

    #[test]
    fn what_cannot_come_closer_stays_and_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let (whole, journal) = refined(&scene, 1500, 120, Vec::new());
        assert!(whole.change.is_empty());
        assert_eq!((journal.left_out.len(), journal.left_out[0].what.as_str()), (1, "refinement"));
        let (none, journal) = refined(&scene, 0, 120, Vec::new());
        assert_eq!((none.len(), journal.left_out.len()), (0, 1));
    }

    #[test]
    fn sixteen_bits_hold_a_value_to_a_hundred_thousandth() {
        let picture = Image { width: 1, height: 1, data: vec![0.0, 1.0, 0.123_456] };
        let back: Vec<f32> = narrow(&picture).into_iter().map(wide).collect();
        assert!(back.iter().zip(&picture.data).all(|(a, b)| (a - b).abs() < 1e-5), "{back:?}");
        let odd = Image { data: vec![-3.0, f32::NAN, 7.0], ..picture };
        assert_eq!(narrow(&odd), [0, 0, u16::MAX]);
    }
}
