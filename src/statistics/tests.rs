//! Tests of the scan: against slow f64 definitions of the statistics ([`crate::diagnostics::selfcheck::oracle`]),
//! against closed formulas, and of invariants.

use glam::{DMat3, DQuat, DVec3};
use proptest::prelude::*;

use super::{BYTES_PER_GAUSSIAN, BlockScan, BlockStatistics, ScanPlan, snap_noise_to_zero, ulp};
use crate::diagnostics::selfcheck::oracle::statistics as oracle;
use crate::model::hash_id;
use crate::model::{AnomalyFlags, Attributes, Camera, Gaussians, ViewSchedule};
use crate::recipe::{MotionParams, Recipe, ScanParams};

fn recipe(motion: MotionParams) -> ScanParams {
    ScanParams { motion, ..Recipe::preset("default").unwrap().scan }
}

/// Returns the `k`-th number, in [0, 1), of the pseudo-random sequence with the seed `seed`.
fn random(seed: u64, k: u64) -> f64 {
    (hash_id(hash_id(seed) ^ k) >> 11) as f64 / 2f64.powi(53)
}

/// Returns a camera that looks at the origin from a random direction, at a distance of 4 to 4.2. `seed` selects the
/// direction.
fn camera(seed: u64) -> Camera {
    let eye = DQuat::from_rotation_y(6.3 * random(seed, 0)) * DVec3::new(0.0, 2.0 * random(seed, 1) - 1.0, -4.0);
    let forward = -eye.normalize();
    let right = DVec3::Y.cross(forward).normalize();
    let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
    Camera {
        width: 320,
        height: 256,
        fx: 250.0,
        fy: 260.0,
        cx: 163.0,
        cy: 125.5,
        rotation,
        translation: -(rotation * eye),
        near: Camera::NEAR,
    }
}

fn schedule(frames: usize, views: u32) -> ViewSchedule {
    let cameras: Vec<Camera> = (0..views.into()).map(camera).collect();
    let mut schedule = ViewSchedule::new(cameras);
    schedule.push_frames(frames, &(0..views).map(|v| (v, v)).collect::<Vec<_>>());
    schedule
}

/// Returns `frames` frames of `n` Gaussians, whose random attributes differ a little between frames. Each Gaussian is
/// not alive in about a third of the frames. `seed` selects the random numbers.
fn wanderers(n: usize, frames: usize, seed: u64) -> Vec<Gaussians> {
    (0..frames)
        .map(|t| {
            let mut g = Gaussians::zeros(n, 0);
            for i in 0..n {
                let constant = |k: u64| 2.0 * random(seed, (i as u64) << 32 | k) - 1.0;
                let varying = |k: u64| 2.0 * random(seed, ((t as u64) << 20 | i as u64) << 8 | k | 1 << 60) - 1.0;
                g.position.set_row::<3>(
                    i,
                    std::array::from_fn(|a| (3.0 * constant(a as u64) + 0.3 * varying(a as u64)) as f32),
                );
                g.rotation.set_row::<4>(
                    i,
                    std::array::from_fn(|a| (constant(9 + a as u64) + 0.1 * varying(9 + a as u64)) as f32),
                );
                g.log_scale.set_row::<3>(
                    i,
                    std::array::from_fn(|a| (-3.0 + 2.0 * constant(4 + a as u64) + 0.2 * varying(20)) as f32),
                );
                g.opacity_logit.set_row(i, [(if varying(30) < -0.33 { -6.0 } else { 3.0 * varying(31) }) as f32]);
            }
            g
        })
        .collect()
}

fn even_times(frames: usize) -> Vec<f64> {
    (0..frames).map(|t| t as f64).collect()
}

fn scan_at(times: &[f64], frames: &[Gaussians], schedule: &ViewSchedule, scan: &ScanParams) -> BlockStatistics {
    let plan = ScanPlan::new(scan, times, schedule).unwrap();
    let mut block = BlockScan::new(frames.first().map_or(0, Gaussians::len), 0, &plan);
    for (t, frame) in frames.iter().enumerate() {
        let cameras: Vec<&Camera> = schedule.views(t).iter().map(|&(_, c)| &schedule.cameras[c as usize]).collect();
        block.add_frame(t, frame, &cameras, Attributes::all());
    }
    block.finish()
}

fn scan(frames: &[Gaussians], schedule: &ViewSchedule, scan: &ScanParams) -> BlockStatistics {
    scan_at(&even_times(frames.len()), frames, schedule, scan)
}

/// Scans one Gaussian over `frames` frames and returns its statistics. At frame t its x coordinate is `x(t)` and its
/// opacity is `opacity(t)`. No camera sees it. `motion`: definition of the statistics of motion.
fn scan_one(
    frames: usize,
    x: impl Fn(usize) -> f32,
    opacity: impl Fn(usize) -> f64,
    motion: MotionParams,
) -> BlockStatistics {
    let plan = ScanPlan::new(&recipe(motion), &even_times(frames), &schedule(frames, 0)).unwrap();
    let mut block = BlockScan::new(1, 0, &plan);
    let mut g = Gaussians::zeros(1, 0);
    g.rotation.set_row(0, [1.0, 0.0, 0.0, 0.0]);
    for t in 0..frames {
        g.position.set_row(0, [x(t), 0.0, 0.0]);
        let alpha = opacity(t);
        g.opacity_logit.set_row(0, [(alpha / (1.0 - alpha)).ln() as f32]);
        block.add_frame(t, &g, &[], Attributes::POSITION | Attributes::OPACITY);
    }
    block.finish()
}

fn close(name: &str, got: f64, expected: f64, relative: f64, absolute: f64) {
    let tolerance = relative * expected.abs() + absolute;
    assert!((got - expected).abs() <= tolerance, "{name}: got {got:e}, expected {expected:e}, tolerance {tolerance:e}");
}

const ALIVE: f64 = 0.5;
const DEAD: f64 = 0.001;
const BOTH: [MotionParams; 2] = [MotionParams::Literal, MotionParams::Runs];

#[test]
fn rows_equal_the_slow_definitions_to_1e_9() {
    for (motion, n, t, views) in
        [(BOTH[0], 700, 17, 3), (BOTH[1], 700, 17, 3), (BOTH[0], 40, 1, 2), (BOTH[1], 40, 2, 1)]
    {
        let (frames, schedule, recipe) = (wanderers(n, t, 1), schedule(t, views), recipe(motion));
        let got = scan(&frames, &schedule, &recipe).rows;
        let resolution = ScanPlan::new(&recipe, &even_times(t), &schedule).unwrap().coverage_resolution_px();
        let mut seen = 0;
        for i in 0..n {
            let expected = oracle::row(i, &frames, &schedule, &recipe);
            close("D", got.d[i], expected.d, 1e-9, 0.0);
            close("kappa", got.kappa[i], expected.kappa, 1e-9, 0.0);
            close("V", got.v[i], expected.v, 1e-9, 1e-18);
            close("C", got.c[i], expected.c, 1e-9, resolution);
            assert_eq!((got.life[i], got.vis[i]), (expected.life, expected.vis), "Gaussian {i}");
            seen += u32::from(expected.c > 0.0 && expected.kappa > 0.0);
        }
        assert!(t < 3 || seen > 300, "the case must exercise what it claims: {seen}");
    }
}

#[test]
fn sinusoid_over_100_000_steps_has_its_analytic_motion() {
    let (steps, omega) = (100_000, std::f64::consts::TAU / 1000.0);
    let half = (omega / 2.0).sin();
    for motion in BOTH {
        let rows = scan_one(steps + 1, |t| (omega * t as f64).sin() as f32, |_| ALIVE, motion).rows;
        // Mean of (sin ωt − sin ω(t−1))² over whole periods: 2 sin²(ω/2). The paper divides by the number of life
        // frames.
        let divisor = steps + usize::from(motion == MotionParams::Literal);
        close("D", rows.d[0], half * (2.0 * steps as f64 / divisor as f64).sqrt(), 1e-6, 0.0);
        // Second difference 4 sin²(ω/2)·|sin ωt|; the mean of |sin| over 1000 samples is cot(ω/2)/500. Frame 0,
        // where it vanishes, is no center.
        let mean = 4.0 * half * half / (500.0 * (omega / 2.0).tan());
        close("kappa", rows.kappa[0], mean * steps as f64 / (steps - 1) as f64, 1e-3, 0.0);
        close("kappa", rows.kappa[0], mean, 0.0, 1e-6);
    }
}

#[test]
fn constant_opacity_has_variance_exactly_0_over_100_000_frames() {
    for alpha in [0.3, 0.999, 1.0 - 1e-7] {
        assert_eq!(scan_one(100_000, |_| 0.0, |_| alpha, MotionParams::Runs).rows.v[0], 0.0);
    }
}

#[test]
fn nearly_constant_opacity_keeps_its_variance() {
    let rows = scan_one(10_000, |_| 0.0, |t| 0.999 + 1e-5 * (t % 2) as f64, MotionParams::Runs).rows;
    // f32 logits around 7 give the two opacities with an error of 5e-10, which is 5e-5 of their difference.
    close("V", rows.v[0], 2.5e-11, 1e-3, 0.0);
}

#[test]
fn one_frame_has_no_motion_and_two_have_one_step() {
    for motion in BOTH {
        let rows = scan_one(1, |_| 5.0, |_| ALIVE, motion).rows;
        assert_eq!((rows.d[0], rows.kappa[0], rows.v[0], rows.life[0]), (0.0, 0.0, 0.0, 1));
    }
    let rows = scan_one(2, |t| 3.0 * t as f32, |_| ALIVE, MotionParams::Runs).rows;
    assert_eq!((rows.d[0], rows.kappa[0]), (3.0, 0.0));
    let rows = scan_one(2, |t| 3.0 * t as f32, |_| ALIVE, MotionParams::Literal).rows;
    assert_eq!((rows.d[0], rows.kappa[0]), ((9.0f64 / 2.0).sqrt(), 0.0), "the paper divides one step by |life| = 2");
}

#[test]
fn jumps_count_as_motion_only_while_alive() {
    let x = |t: usize| if t < 5 { 0.0 } else { 100.0 };
    let dead = scan_one(10, x, |t| if t == 4 || t == 5 { DEAD } else { ALIVE }, MotionParams::Runs).rows;
    assert_eq!((dead.d[0], dead.kappa[0]), (0.0, 0.0));
    let alive = scan_one(10, x, |_| ALIVE, MotionParams::Runs).rows;
    assert_eq!((alive.d[0], alive.kappa[0]), ((1e4f64 / 9.0).sqrt(), 200.0 / 8.0));
}

#[test]
fn life_span_of_1_2_3_frames_has_0_0_1_curvature_terms() {
    for motion in BOTH {
        for (life, expected) in [(1, 0.0), (2, 0.0), (3, 2.0)] {
            let alive = |t: usize| if (2..2 + life).contains(&t) { ALIVE } else { DEAD };
            let rows = scan_one(8, |t| (t * t) as f32, alive, motion).rows;
            assert_eq!((rows.life[0] as usize, rows.kappa[0]), (life, expected), "{motion:?}, life of {life}");
        }
    }
}

#[test]
fn alternating_opacity_has_no_interior_triples() {
    let alive = |t: usize| if t.is_multiple_of(2) { ALIVE } else { DEAD };
    let rows = scan_one(9, |t| (t * t) as f32, alive, MotionParams::Runs).rows;
    assert_eq!((rows.d[0], rows.kappa[0], rows.life[0]), (0.0, 0.0, 5));
    // In the paper's formula, the neighbors of a turn's central frame need not be alive: the turns about frames 2, 4
    // and 6 are 2 each.
    assert_eq!(scan_one(9, |t| (t * t) as f32, alive, MotionParams::Literal).rows.kappa[0], 2.0);
}

#[test]
fn turn_about_the_last_frame_alive_is_ignored() {
    // Straight motion while alive, then a jump: only the turn about the last frame alive would include the jump.
    for (last, motion) in [(6, BOTH[0]), (6, BOTH[1]), (9, BOTH[0]), (9, BOTH[1])] {
        let x = |t: usize| if t <= last { t as f32 } else { 50.0 };
        assert_eq!(scan_one(10, x, |t| if t <= last { ALIVE } else { DEAD }, motion).rows.kappa[0], 0.0);
    }
    // If a later frame is alive, the turn's central frame is not the last one, and the jump counts.
    let rows =
        scan_one(10, |t| if t <= 6 { t as f32 } else { 50.0 }, |t| if t == 7 { DEAD } else { ALIVE }, BOTH[0]).rows;
    close("kappa", rows.kappa[0], (43.0 + 0.0) / 7.0, 1e-12, 0.0);
}

#[test]
fn opacities_0_and_1_give_zero_variance() {
    let nothing = scan_one(20, |t| t as f32, |_| 1e-30, MotionParams::Runs).rows;
    assert_eq!((nothing.d[0], nothing.kappa[0], nothing.v[0], nothing.life[0]), (0.0, 0.0, 0.0, 0));
    let plan = ScanPlan::new(&recipe(MotionParams::Runs), &even_times(20), &schedule(20, 0)).unwrap();
    let mut block = BlockScan::new(1, 0, &plan);
    let mut g = Gaussians::zeros(1, 0);
    g.opacity_logit.set_row(0, [80.0]);
    (0..20).for_each(|t| block.add_frame(t, &g, &[], Attributes::empty()));
    let full = block.finish().rows;
    assert_eq!((full.v[0], full.life[0]), (0.0, 20));
}

#[test]
fn non_finite_values_clear_only_their_own_row() {
    let (clean, schedule, recipe) = (wanderers(300, 6, 2), schedule(6, 2), recipe(MotionParams::Runs));
    let expected = scan(&clean, &schedule, &recipe);
    for (k, column) in Attributes::all().iter().enumerate() {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut frames = clean.clone();
            let (t, i) = (k, 37 * k + 5);
            frames[t].attribute_values_mut(column).plane_mut(0)[i] = bad;
            let got = scan(&frames, &schedule, &recipe).rows;
            assert!(got.flags[i].contains(AnomalyFlags::NON_FINITE), "{} = {bad} is flagged", column.name());
            let zeros = [got.d[i], got.kappa[i], got.v[i], got.c[i], got.vis[i], f64::from(got.life[i])];
            assert_eq!(zeros, [0.0; 6], "{} = {bad}", column.name());
            for j in (0..300).filter(|&j| j != i) {
                assert_eq!(
                    (got.d[j], got.c[j], got.flags[j]),
                    (expected.rows.d[j], expected.rows.c[j], AnomalyFlags::empty())
                );
            }
        }
    }
}

#[test]
fn zero_quaternion_is_flagged_and_counts_as_identity() {
    let (mut frames, schedule, recipe) = (wanderers(2, 4, 3), schedule(4, 3), recipe(MotionParams::Runs));
    for frame in &mut frames {
        frame.rotation.set_row(0, [1.0, 0.0, 0.0, 0.0]);
    }
    let expected = scan(&frames, &schedule, &recipe).rows;
    frames[2].rotation.set_row(0, [0.0, -0.0, 0.0, 0.0]);
    let got = scan(&frames, &schedule, &recipe).rows;
    assert_eq!((got.c, got.flags), (expected.c, vec![AnomalyFlags::ZERO_ROTATION, AnomalyFlags::empty()]));
}

/// Measures one Gaussian in one view. Returns three values: the area that it covers (pixels) and its visibility, both
/// computed by the scan, and then the area as computed by the slow reference (oracle).
fn one_view(position: DVec3, scale: [f64; 3], rotation: [f32; 4]) -> (f64, f64, f64) {
    let schedule = schedule(1, 1);
    let mut g = Gaussians::zeros(1, 0);
    g.position.set_row(0, position.to_array().map(|x| x as f32));
    g.log_scale.set_row(0, scale.map(|varying| varying.ln() as f32));
    g.rotation.set_row(0, rotation);
    let rows = scan(std::slice::from_ref(&g), &schedule, &recipe(MotionParams::Runs)).rows;
    // The opacity is ½, so the area is twice C.
    (2.0 * rows.c[0], rows.vis[0], oracle::area(&g, 0, &schedule.cameras[0]))
}

const IMAGE_PX2: f64 = 320.0 * 256.0;

#[test]
fn behind_the_camera_or_nearer_than_0_2_is_culled() {
    let camera = camera(0);
    let ahead = camera.rotation.row(2);
    for (depth, culled) in [(-3.0, true), (0.0, true), (0.199, true), (0.201, false), (4.0, false)] {
        let (area, vis, _) = one_view(camera.center() + depth * ahead, [0.01; 3], [1.0, 0.0, 0.0, 0.0]);
        assert_eq!((area == 0.0, vis == 0.0), (culled, culled), "depth {depth}: {area}");
    }
}

#[test]
fn area_stays_within_the_image_for_extreme_scales() {
    let camera = camera(0);
    for depth in [0.2001, 0.3, 4.0, 1e4, 1e30] {
        for scale in [[1e-12; 3], [1e6; 3], [1e6, 1e-12, 1e-12], [1e6, 1e6, 1e-12], [1e38, 1.0, 1e-38]] {
            let position = camera.center() + depth * camera.rotation.row(2);
            let (area, vis, _) = one_view(position, scale, [0.3, -0.5, 0.7, 0.1]);
            assert!((0.0..=IMAGE_PX2).contains(&area) && vis.is_finite(), "depth {depth}, {scale:?}: {area}");
            assert!(depth > 4.0 || area > 0.0 || scale[0] > 1e3, "depth {depth}, {scale:?}: {area}");
        }
    }
    let (tiny, _, _) = one_view(DVec3::ZERO, [1e-12; 3], [1.0, 0.0, 0.0, 0.0]);
    close("a point's area is that of the dilation", tiny, 9.0 * std::f64::consts::PI * 0.3, 1e-12, 1e-9);
}

#[test]
fn needle_keeps_the_digits_of_its_area() {
    // For this Gaussian Σ_xx·Σ_yy is 1e13 times det Σ, so the difference Σ_xx Σ_yy − Σ_xy² would keep three digits.
    let camera = camera(0);
    let (length, depth) = (1e5, camera.center().length());
    let mut g = Gaussians::zeros(1, 0);
    g.rotation.set_row(0, [1.0, 0.0, 0.0, 0.0]);
    let along = (camera.rotation.row(0) + camera.rotation.row(1)).normalize();
    let turn = DQuat::from_rotation_arc(DVec3::X, along);
    g.rotation.set_row(0, [turn.w, turn.x, turn.y, turn.z].map(|x| x as f32));
    g.log_scale.set_row(0, [f64::ln(length) as f32, -30.0, -30.0]);
    let mut schedule = ViewSchedule::new(vec![camera.clone()]);
    schedule.push_frames(1, &[(0, 0)]);
    let area = 2.0 * scan(std::slice::from_ref(&g), &schedule, &recipe(MotionParams::Runs)).rows.c[0];
    // A diagonal line: det = 0.3·(Σ_xx + Σ_yy − 0.3), clipped to the fraction of its box inside the image.
    let (sx, sy) = (250.0 * length / depth / 2f64.sqrt(), 260.0 * length / depth / 2f64.sqrt());
    let det = 0.3 * (sx * sx + sy * sy);
    let expected = 9.0 * std::f64::consts::PI * det.sqrt() * IMAGE_PX2 / (36.0 * sx * sy);
    // The quaternion is rounded to f32: 1e-7 of a turn.
    close("area", area, expected, 1e-5, 0.0);
}

#[test]
fn offsets_up_to_1e7_snap_only_noise() {
    for offset in [1e2, 1e4, 1e6, 1e7] {
        let noise = ulp(offset as f32);
        let resting = scan_one(2000, |t| (offset + noise * random(4, t as u64)) as f32, |_| ALIVE, MotionParams::Runs);
        let mut rows = resting.rows;
        assert!(rows.d[0] > 0.0 && rows.d[0] < 2.0 * noise && rows.kappa[0] < 4.0 * noise, "{rows:?}");
        let snapped = snap_noise_to_zero(&mut rows, resting.largest_coordinate);
        assert_eq!((snapped.d, snapped.kappa, rows.d[0], rows.kappa[0]), (1, 1, 0.0, 0.0));
        let moving =
            scan_one(2000, |t| (offset + 8.0 * noise * (t * t % 7) as f64) as f32, |_| ALIVE, MotionParams::Runs);
        let mut rows = moving.rows;
        assert_eq!(snap_noise_to_zero(&mut rows, moving.largest_coordinate).d, 0);
        assert!(rows.d[0].is_finite() && rows.kappa[0].is_finite());
    }
}

#[test]
fn uneven_frames_are_measured_by_their_time_stamps() {
    // x = τ² sampled at uneven τ: the second divided difference is the second derivative, 2, everywhere.
    let stamps = [0.0, 1.0, 1.5, 3.0, 3.25, 5.0, 8.0];
    let unit = 8.0 / 6.0;
    let frames: Vec<Gaussians> = stamps
        .iter()
        .map(|&tau: &f64| {
            let mut g = Gaussians::zeros(1, 0);
            g.position.set_row(0, [(tau * tau) as f32, (-2.0 * tau) as f32, 0.0]);
            g
        })
        .collect();
    let rows = scan_at(&stamps, &frames, &schedule(7, 0), &recipe(MotionParams::Runs)).rows;
    close("kappa", rows.kappa[0], 2.0 * unit * unit, 1e-12, 0.0);
    // For x = τ², the mean velocity over a step is the sum of its two time stamps.
    let squares = stamps.windows(2).map(|pair| (pair[0] + pair[1]).powi(2) + 4.0).sum::<f64>();
    close("D", rows.d[0], unit * (squares / 6.0).sqrt(), 1e-12, 0.0);
    let literal = scan_at(&stamps, &frames, &schedule(7, 0), &recipe(MotionParams::Literal)).rows;
    let even = scan(&frames, &schedule(7, 0), &recipe(MotionParams::Literal)).rows;
    assert_eq!(literal, even, "the paper's formulas know no time stamps");
}

#[test]
fn mean_coverage_of_300_000_equal_views_is_that_of_one() {
    // More contributions than a 64-bit fixed-point sum holds; the mean of equal contributions equals each of them.
    let (mut frames, one) = (wanderers(40, 1, 3), schedule(1, 1));
    frames[0].log_scale.planes_mut().fill(2.0);
    let mut many = ViewSchedule::new(one.cameras.clone());
    many.push_frames(1, &[(0, 0); 300_000]);
    let [one, many] = [one, many].map(|schedule| scan(&frames, &schedule, &recipe(MotionParams::Runs)).rows);
    assert!(one.c.iter().filter(|&&c| c * 300_000.0 > 2f64.powi(64 - 34)).count() > 10, "the case must overflow");
    for i in 0..40 {
        close("C", many.c[i], one.c[i], 1e-15, 0.0);
    }
    assert_eq!(many.vis, one.vis);
}

#[test]
fn unchanged_attributes_may_be_omitted_from_changed() {
    let (mut frames, schedule) = (wanderers(300, 5, 8), schedule(5, 2));
    let first = frames[0].clone();
    for frame in &mut frames {
        frame.rotation = first.rotation.clone();
        frame.opacity_logit = first.opacity_logit.clone();
    }
    let recipe = recipe(MotionParams::Runs);
    let plan = ScanPlan::new(&recipe, &even_times(5), &schedule).unwrap();
    let mut block = BlockScan::new(300, 0, &plan);
    for (t, frame) in frames.iter().enumerate() {
        let cameras: Vec<&Camera> = schedule.cameras.iter().collect();
        block.add_frame(t, frame, &cameras, Attributes::POSITION | Attributes::LOG_SCALE);
    }
    assert_eq!(block.finish(), scan(&frames, &schedule, &recipe));
}

#[test]
fn declared_bytes_per_gaussian_are_exact() {
    let plan = ScanPlan::new(&recipe(MotionParams::Runs), &even_times(3), &schedule(3, 1)).unwrap();
    assert_eq!(BlockScan::new(1000, 0, &plan).resident_bytes(), 1000 * BYTES_PER_GAUSSIAN);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn blocks_may_be_cut_anywhere(n in 1usize..600, cut in 0usize..600, seed in any::<u64>(), literal in any::<bool>()) {
        let cut = cut.min(n);
        let (frames, schedule) = (wanderers(n, 5, seed), schedule(5, 2));
        let recipe = recipe(if literal { MotionParams::Literal } else { MotionParams::Runs });
        let whole = scan(&frames, &schedule, &recipe);
        let part = |range: std::ops::Range<usize>| {
            let frames: Vec<Gaussians> = frames.iter().map(|frame| slice(frame, range.clone())).collect();
            scan(&frames, &schedule, &recipe)
        };
        let (mut left, mut right) = (part(0..cut), part(cut..n));
        left.rows.append(&mut right.rows);
        prop_assert_eq!(left.rows, whole.rows);
        prop_assert_eq!(left.largest_coordinate.max(right.largest_coordinate), whole.largest_coordinate);
        let alive: Vec<u32> = left.alive_per_frame.iter().zip(&right.alive_per_frame).map(|(a, b)| a + b).collect();
        prop_assert_eq!(alive, whole.alive_per_frame);
    }

    #[test]
    fn statistics_are_invariant_under_rigid_motion(seed in any::<u64>(), angle in 0.0..6.0f64, shift in -3.0..3.0f64) {
        let (frames, before, recipe) = (wanderers(60, 6, seed), schedule(6, 2), recipe(MotionParams::Runs));
        let turn = DQuat::from_axis_angle(DVec3::new(0.6, -0.48, 0.64), angle);
        let offset = DVec3::new(shift, -shift, 0.5 * shift);
        let moved: Vec<Gaussians> = frames.iter().map(|frame| moved(frame, turn, offset)).collect();
        let mut after = before.clone();
        for camera in &mut after.cameras {
            camera.rotation *= DMat3::from_quat(turn.inverse());
            camera.translation -= camera.rotation * offset;
        }
        let (expected, got) = (scan(&frames, &before, &recipe).rows, scan(&moved, &after, &recipe).rows);
        for i in 0..60 {
            // Positions of size ≤ 10 are rounded to f32 again: 1e-6 each. Pixels differ by f/z_min = 1300 per scene
            // unit.
            close("D", got.d[i], expected.d[i], 0.0, 1e-5);
            close("kappa", got.kappa[i], expected.kappa[i], 0.0, 1e-5);
            prop_assert_eq!((got.v[i], got.life[i]), (expected.v[i], expected.life[i]));
            close("C", got.c[i], expected.c[i], 1e-3, 0.1);
        }
    }
}

/// Returns the Gaussians of `from` with the indices in `range`.
fn slice(from: &Gaussians, range: std::ops::Range<usize>) -> Gaussians {
    let mut out = Gaussians::zeros(range.len(), 0);
    for column in Attributes::all().iter() {
        for c in 0..from.attribute_values(column).width() {
            out.attribute_values_mut(column)
                .plane_mut(c)
                .copy_from_slice(&from.attribute_values(column).plane(c)[range.clone()]);
        }
    }
    out
}

fn moved(from: &Gaussians, turn: DQuat, offset: DVec3) -> Gaussians {
    let mut out = from.clone();
    for i in 0..from.len() {
        let x = turn * DVec3::from_array(from.position_f64(i)) + offset;
        out.position.set_row(i, x.to_array().map(|x| x as f32));
        let [w, x, y, z] = from.rotation_f64(i);
        let q = turn * DQuat::from_xyzw(x, y, z, w);
        out.rotation.set_row(i, [q.w, q.x, q.y, q.z].map(|x| x as f32));
    }
    out
}
