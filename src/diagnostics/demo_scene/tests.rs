//! Tests of the properties of the bodies (objects) of the test scene.

use super::*;
use crate::model::AttributeValues;

const ALPHA_MIN: f64 = 0.01;

fn frame(scene: &DemoScene, ids: Ids<'_>, frame: usize) -> Gaussians {
    let mut out = Gaussians::zeros(0, SH_DEGREE);
    scene.open(ids).unwrap().read(frame, Attributes::all(), &mut out).unwrap();
    out
}

/// Returns the Gaussians of `body` (an object of the scene), one entry per frame.
fn film(scene: &DemoScene, body: DemoBody) -> Vec<Gaussians> {
    let members = scene.body_ids(body);
    (0..scene.info().times.len()).map(|t| frame(scene, Ids::Range(members.clone()), t)).collect()
}

fn usual() -> DemoScene {
    DemoScene::new(DemoScene::DEFAULT_COUNT, DemoScene::DEFAULT_FRAMES)
}

fn point(column: &AttributeValues, i: usize) -> DVec3 {
    DVec3::from_array(column.row::<3>(i).map(f64::from))
}

fn opacity(state: &Gaussians, i: usize) -> f64 {
    1.0 / (1.0 + (-f64::from(state.opacity_logit.row::<1>(i)[0])).exp())
}

fn bits(column: &AttributeValues) -> Vec<u32> {
    column.planes().iter().map(|x| x.to_bits()).collect()
}

#[test]
fn gaussian_and_frame_give_the_same_bits_in_any_block() {
    let scene = DemoScene::new(503, 5);
    for t in [4, 0, 2] {
        let whole = frame(&scene, Ids::Range(0..503), t);
        let some: Vec<u32> = (0..503).rev().step_by(7).collect();
        let mut blocks: Vec<Vec<usize>> = (0..503).step_by(64).map(|at| (at..503.min(at + 64)).collect()).collect();
        blocks.extend((0..503).map(|id| vec![id]));
        let picked = frame(&scene, Ids::List(&some), t);
        let check = |ids: &[usize], part: &Gaussians| {
            assert_eq!(part.len(), ids.len());
            for column in Attributes::all().iter() {
                let (whole, part) = (whole.attribute_values(column), part.attribute_values(column));
                for c in 0..whole.width() {
                    for (i, &id) in ids.iter().enumerate() {
                        let (got, expected) = (part.plane(c)[i], whole.plane(c)[id]);
                        assert_eq!(got.to_bits(), expected.to_bits(), "{} of {id} at {t}", column.name());
                    }
                }
            }
        };
        check(&some.iter().map(|&id| id as usize).collect::<Vec<_>>(), &picked);
        for ids in blocks {
            check(&ids, &frame(&scene, Ids::Range(ids[0]..ids[0] + ids.len()), t));
        }
    }
}

#[test]
fn scene_of_any_size_is_finite_with_unit_rotations() {
    for (count, frames) in [(0, 3), (1, 1), (2, 2), (3, 2), (17, 3), (1000, 7), (DemoScene::DEFAULT_COUNT, 3), (5, 0)] {
        let scene = DemoScene::new(count, frames);
        assert_eq!((scene.info().count, scene.info().times.len()), (count, frames));
        assert!(scene.info().times.is_sorted_by(|a, b| a < b));
        assert_eq!(DemoBody::ALL.iter().map(|&body| scene.body_ids(body).len()).sum::<usize>(), count);
        for t in 0..frames {
            let state = frame(&scene, Ids::Range(0..count), t);
            for column in Attributes::all().iter() {
                assert!(
                    state.attribute_values(column).planes().iter().all(|x| x.is_finite()),
                    "{} of {count}",
                    column.name()
                );
            }
            for i in 0..count {
                let length: f32 = state.rotation.row::<4>(i).iter().map(|x| x * x).sum();
                assert!((length - 1.0).abs() < 1e-5, "{length}");
            }
        }
    }
}

#[test]
fn still_bodies_and_constant_columns_keep_every_bit() {
    let scene = usual();
    for body in DemoBody::ALL {
        let film = film(&scene, body);
        let still =
            matches!(body, DemoBody::Wall | DemoBody::Double | DemoBody::Buried | DemoBody::Dust | DemoBody::Wire);
        for column in Attributes::all().iter() {
            let constant =
                film.iter().all(|state| bits(state.attribute_values(column)) == bits(film[0].attribute_values(column)));
            let must = still || !scene.info().varying.contains(column);
            assert!(constant || !must, "{body:?} {}", column.name());
        }
        let moves = film.iter().any(|state| state.position != film[0].position);
        assert_eq!(moves, matches!(body, DemoBody::Egg | DemoBody::Cloth | DemoBody::Spark), "{body:?}");
    }
}

#[test]
fn egg_moves_as_one_body() {
    let film = film(&usual(), DemoBody::Egg);
    let n = film[0].len();
    let quaternion = |state: &Gaussians, i: usize| {
        let [w, x, y, z] = state.rotation_f64(i);
        glam::DQuat::from_xyzw(x, y, z, w)
    };
    for state in &film[1..] {
        let turn = quaternion(state, 0) * quaternion(&film[0], 0).inverse();
        let (from, to) = (point(&film[0].position, 0), point(&state.position, 0));
        for i in (1..n).step_by(13) {
            let expected = to + turn * (point(&film[0].position, i) - from);
            let off = (point(&state.position, i) - expected).length();
            assert!(off < 1e-6, "Gaussian {i} is {off:e} from where the body takes it");
            let turned = quaternion(state, i).dot(turn * quaternion(&film[0], i)).abs();
            assert!(turned > 1.0 - 1e-6, "Gaussian {i} turns by itself: {turned}");
        }
    }
    let step = (point(&film[1].position, 0) - point(&film[0].position, 0)).length();
    assert!(step > 0.01, "it moves by {step} a frame");
}

#[test]
fn cloth_is_held_at_one_edge_and_bends_at_the_other() {
    let film = film(&usual(), DemoBody::Cloth);
    let n = film[0].len();
    let sway = |i: usize| {
        let y = || film.iter().map(|state| f64::from(state.position.plane(1)[i]));
        y().fold(f64::MIN, f64::max) - y().fold(f64::MAX, f64::min)
    };
    let x = |i: usize| film[0].position.plane(0)[i];
    let left = (0..n).min_by(|&a, &b| x(a).total_cmp(&x(b))).unwrap();
    let right = (0..n).max_by(|&a, &b| x(a).total_cmp(&x(b))).unwrap();
    assert!(sway(left) < 0.01 && sway(right) > 0.3, "{} {}", sway(left), sway(right));
    let stretch = |a: usize, b: usize| {
        let apart = |state: &Gaussians| (point(&state.position, a) - point(&state.position, b)).length();
        film.iter().map(apart).fold(f64::MIN, f64::max) - film.iter().map(apart).fold(f64::MAX, f64::min)
    };
    assert!((0..n).any(|i| stretch(i, right) > 0.05), "distances change: no rigid motion does that");
    // Between two close Gaussians the surface is normal to the mean of their thin axes up to y‴d²/12, 0.02 at a
    // distance of 0.05.
    let state = &film[5];
    let normal = |i: usize| {
        let [w, x, y, z] = state.rotation_f64(i);
        glam::DQuat::from_xyzw(x, y, z, w) * DVec3::Z
    };
    for (i, j) in (0..n).flat_map(|i| (0..i).map(move |j| (i, j))) {
        let between = point(&state.position, i) - point(&state.position, j);
        if between.length() < 0.05 {
            let along = (normal(i) + normal(j)).normalize().dot(between.normalize());
            assert!(along.abs() < 0.05, "Gaussians {i} and {j}: {along}");
        }
    }
}

#[test]
fn fading_cloud_is_monotone_and_crosses_the_threshold_of_life() {
    let film = film(&usual(), DemoBody::Fading);
    let mut both = [0, 0];
    for i in 0..film[0].len() {
        let series: Vec<f64> = film.iter().map(|state| opacity(state, i)).collect();
        let falls = series.is_sorted_by(|a, b| a > b);
        assert!(falls || series.is_sorted_by(|a, b| a < b), "Gaussian {i}");
        both[usize::from(falls)] += 1;
        let alive = series.iter().filter(|&&a| a >= ALPHA_MIN).count();
        assert!(alive > 24 && alive < 48 && series.iter().any(|&a| a > 0.9), "{alive}");
    }
    assert!(both[0] > 50 && both[1] > 50, "{both:?}");
}

#[test]
fn sparks_live_once_and_briefly_and_do_not_move_while_dead() {
    let film = film(&usual(), DemoBody::Spark);
    let mut first = Vec::new();
    for i in 0..film[0].len() {
        let life: Vec<usize> = (0..film.len()).filter(|&t| opacity(&film[t], i) >= ALPHA_MIN).collect();
        assert!((1..=6).contains(&life.len()), "{life:?}");
        assert!(life.windows(2).all(|pair| pair[1] == pair[0] + 1), "one run: {life:?}");
        first.push(life[0]);
        let moved = |t: usize| film[t].position.row::<3>(i) != film[t + 1].position.row::<3>(i);
        assert!(life.windows(2).all(|pair| moved(pair[0])), "flies while alive");
        let (start, end) = (life[0], life[life.len() - 1]);
        assert!((0..start.saturating_sub(2)).all(|t| !moved(t)) && (end + 2..film.len() - 1).all(|t| !moved(t)));
    }
    first.sort_unstable();
    first.dedup();
    assert!(first.len() > 20, "they start in {} frames", first.len());
}

#[test]
fn doubles_lie_within_a_size_of_a_wall_gaussian_of_their_color() {
    let scene = usual();
    let walls = frame(&scene, Ids::Range(scene.body_ids(DemoBody::Wall)), 0);
    let doubles = frame(&scene, Ids::Range(scene.body_ids(DemoBody::Double)), 0);
    for i in 0..doubles.len() {
        let at = point(&doubles.position, i);
        let apart = |j: usize| (point(&walls.position, j) - at).length();
        let twin = (0..walls.len()).min_by(|&a, &b| apart(a).total_cmp(&apart(b))).unwrap();
        let size = f64::from(doubles.log_scale.plane(0)[i]).exp();
        assert!(apart(twin) < 0.2 * size, "{} of {size}", apart(twin));
        assert_eq!(walls.sh.row::<12>(twin), doubles.sh.row::<12>(i));
    }
}

#[test]
fn wires_are_needles_and_dust_is_tiny() {
    let scene = usual();
    let wires = frame(&scene, Ids::Range(scene.body_ids(DemoBody::Wire)), 0);
    let dust = frame(&scene, Ids::Range(scene.body_ids(DemoBody::Dust)), 0);
    for i in 0..wires.len() {
        let [long, a, b] = wires.log_scale.row::<3>(i);
        assert!(((long - a).exp() - 25.0).abs() < 1e-3 && a == b);
    }
    assert!(dust.log_scale.planes().iter().all(|&s| s < 0.005f32.ln()));
}

#[test]
fn every_camera_sees_moving_bodies_and_none_a_buried_one() {
    let scene = usual();
    let rig = scene.rig();
    assert_eq!((rig.cameras.len(), rig.schedule(&scene.info().times, None).unwrap().pair_count()), (6, 6 * 48));
    assert_eq!(rig.schedule(&scene.info().times, Some(Split::Test)).unwrap().pair_count(), 48);
    for body in [DemoBody::Egg, DemoBody::Cloth, DemoBody::Fading] {
        let state = frame(&scene, Ids::Range(scene.body_ids(body)), 24);
        for camera in &rig.cameras {
            for i in 0..state.len() {
                let p = camera.rotation * point(&state.position, i) + camera.translation;
                let (u, v) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
                assert!(p.z > 0.0 && (0.0..256.0).contains(&u) && (0.0..192.0).contains(&v), "{body:?} {u} {v}");
            }
        }
    }
    let buried = frame(&scene, Ids::Range(scene.body_ids(DemoBody::Buried)), 0);
    for camera in &rig.cameras {
        for i in 0..buried.len() {
            let (eye, at) = (camera.center(), point(&buried.position, i));
            let crossing = eye + (at - eye) * ((2.0 - eye.y) / (at.y - eye.y));
            let inside = crossing.x.abs() <= 2.0 && (0.0..=2.5).contains(&crossing.z);
            assert!(inside, "Gaussian {i} is seen past the back wall at {crossing}");
        }
    }
}

#[test]
fn only_wanted_columns_are_written() {
    let scene = DemoScene::new(100, 2);
    let mut out = Gaussians::zeros(100, SH_DEGREE);
    scene.open(Ids::Range(0..100)).unwrap().read(1, Attributes::OPACITY | Attributes::SH, &mut out).unwrap();
    let whole = frame(&scene, Ids::Range(0..100), 1);
    assert_eq!((&out.opacity_logit, &out.sh), (&whole.opacity_logit, &whole.sh));
    for column in [Attributes::POSITION, Attributes::ROTATION, Attributes::LOG_SCALE] {
        assert!(out.attribute_values(column).planes().iter().all(|&x| x == 0.0), "{}", column.name());
    }
}

#[test]
fn missing_gaussians_and_frames_are_refused() {
    let scene = DemoScene::new(10, 2);
    assert!(scene.open(Ids::Range(5..11)).err().unwrap().to_string().contains("no Gaussian 10"));
    assert!(scene.open(Ids::List(&[3, 99])).err().unwrap().to_string().contains("no Gaussian 99"));
    let mut out = Gaussians::zeros(0, SH_DEGREE);
    let error = scene.open(Ids::Range(0..10)).unwrap().read(2, Attributes::all(), &mut out).unwrap_err();
    assert!(error.to_string().contains("no frame 2"));
}

#[test]
fn open_block_takes_the_memory_it_declares() {
    assert!(size_of::<DemoGaussian>() <= 192, "{}", size_of::<DemoGaussian>());
}
