//! Invariance properties (case 40 of the table in `main.rs`, and the unit of time): statistics and selection do not
//! depend on position, orientation, unit of length or unit of time of a scene. Scenes contain near-equal, subnormal,
//! huge, missing and repeated values.
//!
//! Half turns, powers of two and steps on a grid are exact in floats: the set of survivors and every bit of motion are
//! the same. Other changes round, such as a change of the logarithm of a scale, or a unit of time that is no power of
//! two. Statistics then agree within the tolerance that the test states, and the survivors are the same, except for
//! Gaussians whose score is within this tolerance of the threshold.

use std::collections::BTreeMap;

use glam::{DMat3, DVec3};
use proptest::prelude::*;
use splatsieve::files::container::Container;
use splatsieve::model::{Attributes, Camera, Gaussians, Rig, RigView, Split, StatisticRows};
use splatsieve::outputs::container::write_container;
use splatsieve::passes::FramesInMemory;
use splatsieve::pipeline::score_scene;
use splatsieve::pruning::score::UserOverrides;
use splatsieve::recipe::{MotionParams, Recipe};
use splatsieve::scene::Scene;

use super::scene::by_formula;

/// Generated sequence with cameras around it.
#[derive(Debug, Clone)]
struct GeneratedScene {
    frames: Vec<Gaussians>,
    times: Vec<f64>,
    cameras: Vec<Camera>,
}

/// Statistics of a [`GeneratedScene`], and its survivors.
struct Measured {
    rows: StatisticRows,
    keep: Vec<bool>,
}

impl GeneratedScene {
    fn measure(&self, motion: MotionParams) -> Measured {
        let mut recipe: Recipe = by_formula("default");
        recipe.scan.motion = motion;
        // Thresholds that do not depend on the unit of length, unlike the preset of the paper.
        recipe.select.tau_dynamic = 0.5;
        recipe.select.tau_static = 0.3;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("world.gseq");
        let mut held = FramesInMemory::new(self.frames[0].len(), 0, Attributes::all(), Gaussians::zeros(0, 0));
        self.times.iter().zip(&self.frames).for_each(|(&time, frame)| held.push(time, frame.clone()));
        write_container(&held, &path, gseq::Compression::Raw, BTreeMap::new(), |_| ()).unwrap();
        let rig_view = |view: usize| RigView {
            view: view as u32,
            camera: view as u32,
            time: None,
            split: Split::Train,
            image: None,
        };
        let rig = Rig {
            cameras: self.cameras.clone(),
            views: (0..self.cameras.len()).map(rig_view).collect(),
            background: None,
            origin: "made up".to_owned(),
        };
        let scene = Scene::new(path.clone(), Box::new(Container::open(&path).unwrap()), rig, None).unwrap();
        let scored = score_scene(&scene, &recipe, &UserOverrides::default()).unwrap();
        Measured { rows: scored.rows().unwrap().into_owned(), keep: scored.selection.keep() }
    }

    /// Returns a copy with `edit` applied to every Gaussian in every frame.
    fn map_states(&self, edit: impl Fn(&mut Gaussians, usize)) -> GeneratedScene {
        let mut world = self.clone();
        for frame in &mut world.frames {
            (0..frame.len()).for_each(|i| edit(frame, i));
        }
        world
    }
}

/// Generates a coordinate: on a grid, next to 1, subnormal, huge of either sign, or a zero of either sign.
fn coordinate() -> impl Strategy<Value = f32> {
    prop_oneof![
        8 => (-2048i32..2048).prop_map(|k| k as f32 / 1024.0),
        3 => (-4i32..4).prop_map(|k| f32::from_bits((1f32.to_bits() as i32 + k) as u32)),
        1 => (0u32..1 << 23, any::<bool>()).prop_map(|(bits, sign)| f32::from_bits(bits | u32::from(sign) << 31)),
        1 => (-20i32..20, -1.0f32..1.0).prop_map(|(power, x)| x * 10f32.powi(power)),
        1 => prop_oneof![Just(0.0f32), Just(-0.0f32)],
    ]
}

fn logit() -> impl Strategy<Value = f32> {
    // Some Gaussians are never alive, some are solid, and some lie at the threshold of being alive.
    prop_oneof![6 => -6.0f32..6.0, 1 => Just(-100.0f32), 1 => Just(100.0f32), 1 => -4.596f32..-4.594]
}

/// Generates log scales from points to sizes that fill the image.
fn log_scale() -> impl Strategy<Value = [f32; 3]> {
    prop_oneof![6 => prop::array::uniform3(-5.0f32..-1.0), 1 => prop::array::uniform3(-28.0f32..3.0), 1 => Just([-3.0; 3])]
}

fn rotation() -> impl Strategy<Value = [f32; 4]> {
    prop_oneof![6 => prop::array::uniform4(-1.0f32..1.0), 1 => Just([0.0; 4]), 1 => Just([1e-20, 0.0, 0.0, 1e-20])]
}

/// Generates time stamps, evenly spaced or with steps that differ by up to a factor of a million, from some start in
/// some unit.
fn times(frames: usize) -> impl Strategy<Value = Vec<f64>> {
    let steps = prop_oneof![
        Just(vec![1.0; frames]),
        prop::collection::vec(prop_oneof![Just(1.0), Just(2.0), 0.5f64..1.5, Just(1e-3), Just(1e3)], frames)
    ];
    steps.prop_map(|steps| steps.iter().scan(0.0, |time, step| Some(std::mem::replace(time, *time + step))).collect())
}

fn world() -> impl Strategy<Value = GeneratedScene> {
    (20usize..60, 1usize..7).prop_flat_map(|(count, frames)| {
        let gaussian = (prop::array::uniform3(coordinate()), rotation(), log_scale(), -1.5f32..1.5);
        // (step, whether the Gaussian moves, index of the Gaussian that it copies)
        let motion = (prop::array::uniform3(-4i32..5), any::<bool>(), prop::option::weighted(0.15, 0usize..20));
        let all = prop::collection::vec((gaussian, motion), count);
        let logits = prop::collection::vec(prop::collection::vec(logit(), count), frames);
        (all, logits, times(frames)).prop_map(move |(all, logits, times)| {
            let mut states = vec![Gaussians::zeros(count, 0); frames];
            for i in 0..count {
                let source = all[i].1.2.unwrap_or(i);
                let ((place, turn, size, gray), (step, moves, _)) = all[source];
                for (t, state) in states.iter_mut().enumerate() {
                    // On the grid, so that most steps are exact.
                    let by = |c: usize| if moves { (step[c] * (t * t % 5) as i32) as f32 / 256.0 } else { 0.0 };
                    state.position.set_row(i, std::array::from_fn::<f32, 3, _>(|c| place[c] + by(c)));
                    state.rotation.set_row(i, turn);
                    state.log_scale.set_row(i, size);
                    state.opacity_logit.set_row(i, [logits[t][if moves { source } else { 0 }.min(source)]]);
                    state.sh.set_row(i, [gray; 3]);
                }
            }
            // Gaussian 0 is in view of every camera.
            for state in &mut states {
                state.position.set_row(0, [0.25, -0.5, 0.125]);
                state.opacity_logit.set_row(0, [1.0]);
                state.log_scale.set_row(0, [-2.0; 3]);
            }
            let eye = |eye: [f64; 3]| Camera::look_at(DVec3::from(eye), DVec3::ZERO, 1.2, (96, 64));
            let cameras = vec![eye([4.0, 1.0, 2.0]), eye([-1.0, -5.0, 0.5]), eye([0.5, 3.0, -3.0])];
            GeneratedScene { frames: states, times, cameras }
        })
    })
}

fn motion() -> impl Strategy<Value = MotionParams> {
    prop_oneof![Just(MotionParams::Runs), Just(MotionParams::Literal)]
}

/// Checks that each value of `found` differs from that of `expected` by at most `relative` times the expected value
/// plus `absolute`. `what` names the values in failures.
fn check_near(what: &str, found: &[f64], expected: &[f64], relative: f64, absolute: f64) -> Result<(), TestCaseError> {
    for (i, (a, b)) in found.iter().zip(expected).enumerate() {
        let tolerance = relative * b.abs() + absolute;
        prop_assert!(
            (a - b).abs() <= tolerance,
            "{} of {}: got {:e}, expected {:e}, tolerance {:e}",
            what,
            i,
            a,
            b,
            tolerance
        );
    }
    Ok(())
}

fn scaled(values: &[f64], by: f64) -> Vec<f64> {
    values.iter().map(|x| x * by).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn half_turns_change_no_bit_of_motion_and_no_survivor(world in world(), axis in 0usize..3, motion in motion()) {
        // Multiplication by i, j or k from the left exchanges the components of a quaternion and some signs.
        const TURNS: [[(usize, f32); 4]; 3] = [
            [(1, -1.0), (0, 1.0), (3, -1.0), (2, 1.0)],
            [(2, -1.0), (3, 1.0), (0, 1.0), (1, -1.0)],
            [(3, -1.0), (2, -1.0), (1, 1.0), (0, 1.0)],
        ];
        let mut turned = world.map_states(|state, i| {
            let (place, q) = (state.position.row::<3>(i), state.rotation.row::<4>(i));
            state.position.set_row(i, std::array::from_fn::<f32, 3, _>(|c| if c == axis { place[c] } else { -place[c] }));
            if q != [0.0; 4] {
                state.rotation.set_row(i, TURNS[axis].map(|(component, sign)| sign * q[component]));
            } else {
                // A zero quaternion means the identity, which turns too.
                state.rotation.set_row(i, std::array::from_fn::<f32, 4, _>(|c| if c == axis + 1 { 1.0 } else { 0.0 }));
            }
        });
        let turn = DMat3::from_diagonal(DVec3::from_array(std::array::from_fn(|c| if c == axis { 1.0 } else { -1.0 })));
        for camera in &mut turned.cameras {
            camera.rotation *= turn;
        }
        let (expected, found) = (world.measure(motion), turned.measure(motion));
        prop_assert_eq!(&found.rows.d, &expected.rows.d);
        prop_assert_eq!(&found.rows.kappa, &expected.rows.kappa);
        prop_assert_eq!((&found.rows.v, &found.rows.life), (&expected.rows.v, &expected.rows.life));
        // The sums of products in the rotation have another order.
        check_near("C", &found.rows.c, &expected.rows.c, 1e-11, 1e-9)?;
        prop_assert_eq!(&found.rows.vis, &expected.rows.vis);
        prop_assert_eq!(found.keep, expected.keep);
    }

    #[test]
    fn power_of_two_length_units_scale_motion_exactly(
        world in world(), power in 0i32..20, motion in motion(),
    ) {
        let by = 2f64.powi(power);
        // All Gaussians are as small as points, because changing the logarithm of any other scale would round.
        let points = world.map_states(|state, i| state.log_scale.set_row(i, [-90.0; 3]));
        let mut larger = points.map_states(|state, i| {
            let place = state.position.row::<3>(i);
            state.position.set_row(i, place.map(|x| x * by as f32));
        });
        for camera in &mut larger.cameras {
            (camera.translation, camera.near) = (camera.translation * by, camera.near * by);
        }
        let (expected, found) = (points.measure(motion), larger.measure(motion));
        prop_assert_eq!(&found.rows.d, &scaled(&expected.rows.d, by));
        prop_assert_eq!(&found.rows.kappa, &scaled(&expected.rows.kappa, by));
        prop_assert_eq!((&found.rows.c, &found.rows.vis), (&expected.rows.c, &expected.rows.vis));
        prop_assert_eq!((found.rows.v, found.rows.life), (expected.rows.v, expected.rows.life));
        prop_assert_eq!(found.keep, expected.keep);
    }

    /// Checks that a change of the unit of length changes areas and anisotropies only by rounding. A log scale is below
    /// 32 in magnitude, so adding the logarithm of the unit rounds it by at most 2^-20 in f32. The tolerances are four
    /// times this error.
    #[test]
    fn length_units_change_areas_only_by_rounding_of_scales(world in world(), power in 0i32..20) {
        let by = 2f64.powi(power);
        let mut larger = world.map_states(|state, i| {
            let (place, size) = (state.position.row::<3>(i), state.log_scale.row::<3>(i));
            state.position.set_row(i, place.map(|x| x * by as f32));
            state.log_scale.set_row(i, size.map(|s| (f64::from(s) + by.ln()) as f32));
        });
        for camera in &mut larger.cameras {
            (camera.translation, camera.near) = (camera.translation * by, camera.near * by);
        }
        let (expected, found) = (world.measure(MotionParams::Runs), larger.measure(MotionParams::Runs));
        check_near("C", &found.rows.c, &expected.rows.c, 4e-6, 1e-9)?;
        check_near("E", &found.rows.e, &expected.rows.e, 0.0, 4e-6)?;
        prop_assert_eq!(found.rows.vis, expected.rows.vis);
    }

    #[test]
    fn grid_translations_change_no_survivor(
        world in world(), steps in prop::array::uniform3(-512i32..512), motion in motion(),
    ) {
        // Moves positions to the grid, within 4 of the center: sums with integers up to 512 are exact, and the noise is
        // that of 512.
        let by = steps.map(f64::from);
        let on_grid = world.map_states(|state, i| {
            let place = state.position.row::<3>(i).map(|x| (x.clamp(-4.0, 4.0) * 1024.0).round() / 1024.0);
            state.position.set_row(i, place);
        });
        let mut moved = on_grid.map_states(|state, i| {
            let place = state.position.row::<3>(i);
            state.position.set_row(i, std::array::from_fn::<f32, 3, _>(|c| place[c] + by[c] as f32));
        });
        for camera in &mut moved.cameras {
            camera.translation -= camera.rotation * DVec3::from(by);
        }
        let (expected, found) = (on_grid.measure(motion), moved.measure(motion));
        prop_assert_eq!((&found.rows.d, &found.rows.kappa), (&expected.rows.d, &expected.rows.kappa));
        prop_assert_eq!((&found.rows.v, &found.rows.life), (&expected.rows.v, &expected.rows.life));
        // The cameras are 900 units away in f64: depths of 0.2 and more have a relative error of 1e-12.
        check_near("C", &found.rows.c, &expected.rows.c, 1e-9, 1e-9)?;
        let threshold = |measured: &Measured| {
            let kept = measured.keep.iter().zip(&measured.rows.c).filter(|(keep, _)| **keep).map(|(_, c)| *c);
            kept.fold(f64::INFINITY, f64::min)
        };
        for i in 0..found.keep.len() {
            let near_border = (expected.rows.c[i] - threshold(&expected)).abs() <= 1e-8 * expected.rows.c[i].abs() + 1e-8;
            prop_assert!(found.keep[i] == expected.keep[i] || near_border, "Gaussian {} of C {}", i, expected.rows.c[i]);
        }
    }

    #[test]
    fn power_of_two_time_units_change_nothing(world in world(), power in -60i32..60, motion in motion()) {
        let mut other = world.clone();
        other.times.iter_mut().for_each(|time| *time *= 2f64.powi(power));
        let (expected, found) = (world.measure(motion), other.measure(motion));
        prop_assert!(found.rows == expected.rows, "{:?}, expected {:?}", found.rows, expected.rows);
        prop_assert_eq!(found.keep, expected.keep);
    }

    /// Checks that a change of the unit and the origin of time changes motion only by rounding. Each time stamp is
    /// rounded twice, by the sum with the origin and by the product with the unit, and a step has two stamps: its error
    /// is at most four times 2^-53 of the stamp farthest from time 0. Steps may be as short as 2e-7 of the duration.
    #[test]
    fn time_units_change_motion_only_by_rounding_of_stamps(
        world in world(), unit in -12f64..12.0, start in -3f64..3.0,
    ) {
        let mut other = world.clone();
        let span = (world.times[world.times.len() - 1] - world.times[0]).max(1.0);
        other.times.iter_mut().for_each(|time| *time = 10f64.powf(unit) * (*time + start * span));
        let farthest = world.times.iter().map(|time| (time + start * span).abs()).fold(0.0, f64::max);
        let shortest = world.times.windows(2).map(|pair| pair[1] - pair[0]).fold(span, f64::min);
        let relative = 2.0 * f64::EPSILON * farthest / shortest + 1e-12;
        let (expected, found) = (world.measure(MotionParams::Runs), other.measure(MotionParams::Runs));
        check_near("D", &found.rows.d, &expected.rows.d, relative, 0.0)?;
        check_near("kappa", &found.rows.kappa, &expected.rows.kappa, 10.0 * relative, 1e-12 * expected.rows.d.iter().fold(0.0, |a: f64, b| a.max(*b)))?;
        prop_assert_eq!((found.rows.v, found.rows.life), (expected.rows.v, expected.rows.life));
        prop_assert_eq!((found.rows.c, found.rows.vis), (expected.rows.c, expected.rows.vis));
    }
}
