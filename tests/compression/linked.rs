//! Tests of frames without shared Gaussian ids: folders of PLY files whose Gaussians differ in number and order.

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::fs;
use std::path::PathBuf;
use std::process::Stdio;
use std::time::Instant;

use crate::frame_streams::unlinked_stream;
use crate::scene::{PlyRows, Workplace, bits, lasting_files, shared, state};
use splatsieve::model::Gaussians;
use splatsieve::model::hash_id;
use splatsieve::models::LinkMode;
use splatsieve::scene::{InputOptions, Scene, open_scene};

const FRAMES: usize = 37;

/// Returns a number evenly distributed in [0, 1) that depends only on `seed`.
fn uniform(seed: u64) -> f32 {
    (hash_id(seed) >> 40) as f32 / (1u64 << 24) as f32
}

/// Writes the state of Gaussian `i` at frame `frame` to row `at` of `out`. Each Gaussian moves on a circle of its own.
fn write_row(i: usize, frame: usize, out: &mut Gaussians, at: usize) {
    let value = |k: u64| uniform(64 * i as u64 + k);
    let angle = 0.05 * frame as f32 + 6.0 * value(0);
    let size = -4.5 + value(1);
    out.position.set_row(at, [value(2) + 0.1 * angle.cos(), value(3) + 0.1 * angle.sin(), value(4)]);
    out.rotation.set_row(at, [5, 6, 7, 8].map(|k| value(k) - 0.5));
    out.log_scale.set_row(at, [9, 10, 11].map(|k| size + value(k)));
    out.opacity_logit.set_row(at, [4.0 * value(12) - 1.0]);
    out.sh.set_row(at, [13, 14, 15].map(|k| 3.0 * value(k) - 1.5));
}

/// Returns the state at frame `frame` of the Gaussians that are alive, and their ids. Gaussian `i`, from 0 to `count` −
/// 1, is alive if `is_alive(i)` is true. The order of the Gaussians differs from frame to frame.
fn frame(count: usize, frame: usize, is_alive: impl Fn(usize) -> bool) -> (Gaussians, Vec<usize>) {
    let mut order: Vec<usize> = (0..count).filter(|&i| is_alive(i)).collect();
    order.sort_by_key(|&i| hash_id((i as u64) << 20 | frame as u64));
    let mut out = Gaussians::zeros(order.len(), 1);
    order.iter().enumerate().for_each(|(at, &i)| write_row(i, frame, &mut out, at));
    (out, order)
}

/// Returns whether Gaussian `i` is alive at frame `frame`. Each Gaussian has a first and a last frame of its own and is
/// absent for two frames in between.
fn is_alive(i: usize, frame: usize) -> bool {
    let begins = (hash_id(i as u64) % 60) as usize;
    let age = (frame + 30).wrapping_sub(begins);
    age < 25 && !(8..10).contains(&age)
}

fn write_frames(workplace: &Workplace, folder: &str, count: usize) -> Vec<Vec<usize>> {
    let write = |t: usize| {
        let (gaussians, order) = frame(count, t, |i| is_alive(i, t));
        workplace.ply(&format!("{folder}/f_{t}.ply"), &gaussians);
        order
    };
    (0..FRAMES).map(write).collect()
}

fn open(workplace: &Workplace, folder: &str, link: LinkMode) -> Scene {
    let options = InputOptions { path: workplace.path(folder), link, ..InputOptions::default() };
    open_scene(&options).unwrap()
}

#[test]
fn tracks_hold_every_row_of_unlinked_frames_to_the_bit() {
    let workplace = Workplace::new();
    // Several blocks of Gaussians, some of which begin late or end early.
    let orders = write_frames(&workplace, "frames", 4000);
    let scene = open(&workplace, "frames", LinkMode::Apart);
    let count = scene.source().info().count;
    let lived = (0..4000).filter(|&i| (0..FRAMES).any(|t| is_alive(i, t))).count();
    assert_eq!(count, lived, "one track per Gaussian, across gaps of two frames");
    let mut whose: BTreeMap<usize, usize> = BTreeMap::new();
    for (t, order) in orders.iter().enumerate() {
        let (given, found) = (frame(4000, t, |i| is_alive(i, t)).0, state(scene.source(), t));
        let rows: BTreeMap<Vec<u32>, usize> = (0..count).map(|track| (bits(&found, track), track)).collect();
        for (at, &i) in order.iter().enumerate() {
            let track = rows.get(&bits(&given, at)).unwrap_or_else(|| panic!("Gaussian {i} is not in frame {t}"));
            assert_eq!(*whose.entry(i).or_insert(*track), *track, "Gaussian {i} at frame {t}");
        }
        let there = found.opacity_logit.plane(0).iter().filter(|&&logit| logit > -40.0).count();
        assert_eq!(there, order.len(), "those of frame {t} alone are seen");
    }
    // Before its first and after its last frame, a track keeps the state of that frame, so that it does not move.
    for (&i, &track) in &whose {
        let alive: Vec<usize> = (0..FRAMES).filter(|&t| is_alive(i, t)).collect();
        for t in [0, FRAMES - 1] {
            let nearest = if t == 0 { alive[0] } else { *alive.last().unwrap() };
            let (there, held) = (state(scene.source(), nearest), state(scene.source(), t));
            assert_eq!(held.position.row::<3>(track), there.position.row::<3>(track), "Gaussian {i} at frame {t}");
        }
        if i > 40 {
            break;
        }
    }
    let notes = scene.input.description().notes.join("\n");
    assert!(notes.contains("frames were linked: ") && notes.contains(&format!("are {lived} tracks")), "{notes}");
}

#[test]
fn frames_are_linked_if_rows_differ_or_on_request() {
    let workplace = Workplace::new();
    for t in 0..9 {
        let (mixed, order) = frame(500, t, |_| true);
        let mut back = vec![0; 500];
        order.iter().enumerate().for_each(|(at, &i)| back[i] = at as u32);
        workplace.ply(&format!("mixed/{t}.ply"), &mixed);
        workplace.ply(&format!("kept/{t}.ply"), &mixed.pick(&back));
    }
    let kind = |folder: &str, link| open(&workplace, folder, link).input.description().kind;
    assert_eq!(kind("kept", LinkMode::Auto), "PLY frames");
    assert_eq!(kind("mixed", LinkMode::Auto), "linked PLY frames");
    assert_eq!(kind("mixed", LinkMode::Never), "PLY frames");
    assert_eq!(kind("kept", LinkMode::Always), "linked PLY frames");
    // Both have the same tracks in the order of the first frame.
    let (kept, linked) = (open(&workplace, "kept", LinkMode::Never), open(&workplace, "kept", LinkMode::Always));
    assert_eq!(state(kept.source(), 8), state(linked.source(), 8));
    let said = workplace.done("compress mixed -o out --ratio 0.5 --no-refine --verbose --link always");
    assert!(said.contains("frames were linked: as requested"), "{said}");
    assert!(fs::read_to_string(workplace.path("out/recipe.toml")).unwrap().contains("link = \"always\""));
    let said = workplace.done("compress kept -o in_order --ratio 0.5 --no-refine --verbose");
    assert!(
        said.contains("frames have a common order: Gaussians of the same index are nearer than unrelated ones"),
        "{said}"
    );
    // Cache entries of linked frames are not used for unlinked frames, and vice versa.
    let small = "compress mixed --ratio 0.5 --no-refine --cache work --link";
    workplace.done(&format!("{small} never -o never"));
    workplace.done(&format!("{small} always -o again"));
    let files = |name: &str| lasting_files(&workplace.path(name));
    assert!(files("again") == files("out"));
}

#[test]
fn frames_are_written_with_the_gaussians_alive_in_them() {
    let workplace = Workplace::new();
    write_frames(&workplace, "frames", 900);
    workplace.done("compress frames -o all --ratio 1 --no-refine --prune-only --set bands=all --link apart");
    let rows = |folder: &str, t: usize| PlyRows::read(&workplace.path(&format!("{folder}/f_{t}.ply"))).rows;
    for t in 0..FRAMES {
        let (mut given, mut left) = (rows("frames", t), rows("all", t));
        given.sort();
        left.sort();
        assert!(given == left, "frame {t}: all rows, in another order");
    }
    // Half of the tracks, with merging: every frame has fewer rows, and none is invisible.
    workplace.done("compress frames -o half --ratio 0.5");
    for t in 0..FRAMES {
        let (given, left) = (rows("frames", t).len(), rows("half", t).len());
        assert!(left > 0 && left < given, "frame {t}: {left} of {given}");
        let ply = PlyRows::read(&workplace.path(&format!("half/f_{t}.ply")));
        assert!((0..left).all(|i| ply.value(i, "opacity") > -30.0));
    }
    workplace.done("info half");
}

/// Returns the state at frame `t` of `count` Gaussians, each of which is replaced by a copy every seven frames. The old
/// copy fades out over two frames while the new one fades in. Both together are as opaque as one Gaussian of
/// `write_row`.
fn fading_frame(count: usize, t: usize) -> Gaussians {
    let parts = |i: usize| match (t + (hash_id(i as u64) % 7) as usize) % 7 {
        phase @ (0 | 1) if t > phase => vec![(phase + 1) as f64 / 3.0, (2 - phase) as f64 / 3.0],
        _ => vec![1.0],
    };
    let mut rows: Vec<(usize, usize, f64)> = Vec::new();
    (0..count).for_each(|i| rows.extend(parts(i).into_iter().enumerate().map(|(k, part)| (i, k, part))));
    rows.sort_by_key(|&(i, k, _)| hash_id((i as u64) << 20 | (k as u64) << 40 | t as u64));
    let mut out = Gaussians::zeros(rows.len(), 1);
    for (at, (i, _, part)) in rows.into_iter().enumerate() {
        write_row(i, t, &mut out, at);
        let alpha = 1.0 - (1.0 + f64::from(out.opacity_logit.plane(0)[at]).exp()).powf(-part);
        out.opacity_logit.set_row(at, [(alpha / (1.0 - alpha)).ln() as f32]);
    }
    out
}

#[test]
fn lives_that_fade_into_one_another_become_one_track() {
    let workplace = Workplace::new();
    let (count, frames) = (600, 21);
    for t in 0..frames {
        workplace.ply(&format!("frames/{t}.ply"), &fading_frame(count, t));
    }
    let (apart, joined) = (open(&workplace, "frames", LinkMode::Apart), open(&workplace, "frames", LinkMode::Auto));
    let [apart_count, joined_count] = [&apart, &joined].map(|scene| scene.source().info().count);
    assert!(apart_count > 2 * count && joined_count <= count + count / 20, "{apart_count}, {joined_count}");
    let notes = joined.input.description().notes.join("\n");
    assert!(
        notes.contains(&format!("{apart_count} tracks with a median length of "))
            && notes.contains("dB PSNR, mean of renders"),
        "{notes}"
    );
    assert!(!apart.input.description().notes.join("\n").contains("were joined"));
    // One row has the opacity of both.
    workplace.done("compress frames -o all --ratio 1 --no-refine --prune-only --set bands=all");
    let mut one_row = 0;
    for t in 0..frames {
        let (mut whole, ply) = (Gaussians::zeros(count, 1), PlyRows::read(&workplace.path(&format!("all/{t}.ply"))));
        (0..count).for_each(|i| write_row(i, t, &mut whole, i));
        let there = joined.source();
        let found = state(there, t);
        let living: Vec<usize> = (0..found.len()).filter(|&i| found.opacity_logit.plane(0)[i] > -30.0).collect();
        assert_eq!(living.len(), ply.rows.len(), "frame {t}");
        for i in 0..count {
            let is_it = |&&track: &&usize| {
                let apart = |c: usize| (found.position.plane(c)[track] - whole.position.plane(c)[i]).abs();
                let logit = found.opacity_logit.plane(0)[track] - whole.opacity_logit.plane(0)[i];
                (0..3).all(|c| apart(c) < 1e-5) && logit.abs() < 1e-3
            };
            one_row += usize::from(living.iter().filter(is_it).count() == 1);
        }
    }
    assert!(one_row * 100 >= 97 * count * frames, "{one_row} of {} are in one row", count * frames);
    // They stay separate on request, and the recipe records it.
    workplace.done("compress frames -o apart --ratio 1 --no-refine --prune-only --set bands=all --link apart");
    let rows = |folder: &str| PlyRows::read(&workplace.path(&format!("{folder}/8.ply"))).rows.len();
    assert!(rows("apart") == rows("frames") && rows("all") < rows("apart"), "{} {}", rows("all"), rows("apart"));
    assert!(fs::read_to_string(workplace.path("apart/recipe.toml")).unwrap().contains("link = \"apart\""));
}

/// Returns the state at frame `t` of `count` Gaussians whose attributes vary by different amounts, so that each
/// attribute is steady in some Gaussians and not in others. The order of the Gaussians differs from frame to frame.
fn varying_frame(count: usize, t: usize) -> Gaussians {
    let mut out = Gaussians::zeros(count, 1);
    for i in 0..count {
        write_row(i, t, &mut out, i);
        let tremble = |k: u64, most: f32| {
            let part = |seed: u64| uniform(hash_id((i as u64) << 20 | k << 12 | seed));
            2.0 * most * part(4000) * (part(t as u64) - 0.5) * 3f32.sqrt()
        };
        for (c, value) in (0..).zip(out.sh.row::<12>(i)) {
            out.sh.plane_mut(c as usize)[i] = value + tremble(c, 0.06 * 3.5 / 2.0);
        }
        let [scales, turn] = [(20, 0.03), (30, 0.01)].map(|(k, most)| [0, 1, 2].map(|c| tremble(k + c, most)));
        (0..3).for_each(|c| out.log_scale.plane_mut(c)[i] += scales[c]);
        let [w, x, y, z] = out.rotation.row(i);
        // Half of the quaternions have the opposite sign.
        let sign = if uniform((i as u64) << 20 | t as u64) < 0.5 { -1.0 } else { 1.0 };
        out.rotation.set_row(i, [w + turn[0], x + turn[1], y + turn[2], z].map(|q| sign * q));
        out.opacity_logit.set_row(i, [out.opacity_logit.plane(0)[i] + tremble(40, 0.25)]);
    }
    let mut order: Vec<u32> = (0..count as u32).collect();
    order.sort_by_key(|&i| hash_id(u64::from(i) << 20 | t as u64));
    out.pick(&order)
}

/// Computes the numbers that decide whether the attributes of Gaussian `track` in all `frames` count as constant
/// (`src/models/linked/steady.rs`), in f64. Returns for rotation, scales, opacity logit and colors the mean, and the
/// variation divided by its bound.
fn mean_and_variation(frames: &[Gaussians], track: usize) -> [(Vec<f64>, f64); 4] {
    let values = |column: &dyn Fn(&Gaussians) -> Vec<f32>| -> Vec<Vec<f64>> {
        frames.iter().map(|frame| column(frame).into_iter().map(f64::from).collect()).collect()
    };
    let alphas: Vec<f64> =
        frames.iter().map(|frame| 1.0 / (1.0 + (-f64::from(frame.opacity_logit.plane(0)[track])).exp())).collect();
    let weight: f64 = alphas.iter().sum();
    let mean = |rows: &[Vec<f64>]| -> Vec<f64> {
        (0..rows[0].len()).map(|c| rows.iter().zip(&alphas).map(|(row, a)| a * row[c]).sum::<f64>() / weight).collect()
    };
    let rms = |rows: &[Vec<f64>], length: &dyn Fn(Vec<f64>) -> f64| {
        let mean = mean(rows);
        let differ = |row: &Vec<f64>| row.iter().zip(&mean).map(|(a, b)| a - b).collect();
        (rows.iter().zip(&alphas).map(|(row, a)| a * length(differ(row))).sum::<f64>() / weight).sqrt()
    };
    let mut turns = values(&|frame| frame.rotation.row::<4>(track).to_vec());
    let first = turns[0].clone();
    for turn in &mut turns {
        let along: f64 = turn.iter().zip(&first).map(|(a, b)| a * b).sum();
        turn.iter_mut().for_each(|q| *q *= along.signum());
    }
    let length = |turn: &Vec<f64>| turn.iter().map(|q| q * q).sum::<f64>().sqrt();
    let units: Vec<Vec<f64>> = turns.iter().map(|turn| turn.iter().map(|q| q / length(turn)).collect()).collect();
    let scales = values(&|frame| frame.log_scale.row::<3>(track).to_vec());
    let colors = values(&|frame| frame.sh.row::<12>(track).to_vec());
    let logits = values(&|frame| vec![frame.opacity_logit.plane(0)[track]]);
    let mean_alpha = weight / frames.len() as f64;
    let of_alpha = alphas.iter().map(|a| (a - mean_alpha).powi(2)).sum::<f64>() / frames.len() as f64;
    let most = |parts: [f64; 3]| parts.into_iter().fold(0.0, f64::max);
    let of_scales = most([0, 1, 2].map(|c| rms(&scales, &|by| by[c] * by[c])));
    let of_colors = most([0, 1, 2].map(|channel| {
        rms(&colors, &|by| by.iter().skip(channel).step_by(3).map(|v| v * v).sum::<f64>() / (4.0 * PI))
    }));
    let of_turns = 2.0 * rms(&units, &|by| by.iter().map(|q| q * q).sum());
    [
        (mean(&turns), of_turns / 0.02),
        (mean(&scales), of_scales / 0.02),
        (mean(&logits), of_alpha.sqrt() / 0.02),
        (mean(&colors), of_colors / 0.04),
    ]
}

#[test]
fn steady_attributes_of_a_track_become_their_mean() {
    let workplace = Workplace::new();
    let (count, frames) = (400, 12);
    for t in 0..frames {
        workplace.ply(&format!("frames/{t}.ply"), &varying_frame(count, t));
    }
    let (apart, held) = (open(&workplace, "frames", LinkMode::Apart), open(&workplace, "frames", LinkMode::Always));
    let [given, found] = [&apart, &held].map(|scene| {
        let states: Vec<Gaussians> = (0..frames).map(|t| state(scene.source(), t)).collect();
        states
    });
    let mut parts = [[0, 0]; 4];
    // Tracks of a single life that are alive in all frames.
    let whole = |states: &[Gaussians], track: usize| {
        let is_there = states.iter().all(|frame| frame.opacity_logit.plane(0)[track] > -39.0);
        is_there.then(|| {
            states.iter().flat_map(|frame| frame.position.row::<3>(track).map(f32::to_bits)).collect::<Vec<u32>>()
        })
    };
    let places: BTreeMap<Vec<u32>, usize> =
        (0..found[0].len()).filter_map(|track| Some((whole(&found, track)?, track))).collect();
    for given_as in 0..given[0].len() {
        let Some(&found_as) = whole(&given, given_as).and_then(|place| places.get(&place)) else { continue };
        for (kind, (mean, change)) in mean_and_variation(&given, given_as).into_iter().enumerate() {
            let columns = |frame: &Gaussians, track: usize| match kind {
                0 => frame.rotation.row::<4>(track).to_vec(),
                1 => frame.log_scale.row::<3>(track).to_vec(),
                2 => frame.opacity_logit.row::<1>(track).to_vec(),
                _ => frame.sh.row::<12>(track).to_vec(),
            };
            assert!((change - 1.0).abs() > 1e-6, "nothing is at the bound");
            parts[kind][usize::from(change < 1.0)] += 1;
            for (given, found) in given.iter().zip(&found) {
                let (given, found) = (columns(given, given_as), columns(found, found_as));
                if change > 1.0 {
                    assert_eq!(given, found, "track {found_as}, column {kind}: {change}");
                } else {
                    let near = |(a, b): (&f32, &f64)| (f64::from(*a) - b).abs() <= 1e-6 * b.abs().max(1.0);
                    assert!(found.iter().zip(&mean).all(near), "track {found_as}, column {kind}: {change}");
                }
            }
        }
    }
    assert!(parts.iter().flatten().all(|&part| part > 20), "{parts:?}");
    let notes = held.input.description().notes.join("\n");
    assert!(notes.contains("% of the colors (within 0.04)") && notes.contains("dB PSNR, mean of renders"), "{notes}");
    // The written files have the same values, to the bit.
    workplace.done("compress frames -o all --ratio 1 --no-refine --prune-only --set bands=all");
    for (t, found) in found.iter().enumerate() {
        let ply = PlyRows::read(&workplace.path(&format!("all/{t}.ply")));
        let rows: BTreeMap<u32, usize> = (0..ply.rows.len()).map(|i| (ply.value(i, "x").to_bits(), i)).collect();
        let living: Vec<usize> = (0..found.len()).filter(|&i| found.opacity_logit.plane(0)[i] > -39.0).collect();
        assert_eq!(living.len(), ply.rows.len());
        for track in living {
            let at = rows[&found.position.plane(0)[track].to_bits()];
            let all = [("rot_0", &found.rotation), ("scale_0", &found.log_scale), ("f_dc_0", &found.sh)];
            for (name, column) in all.into_iter().chain([("opacity", &found.opacity_logit)]) {
                assert_eq!(ply.value(at, name).to_bits(), column.plane(0)[track].to_bits(), "{name} at frame {t}");
            }
        }
    }
}

#[test]
#[ignore = "needs time"]
fn linking_ignores_thread_count_and_memory() {
    let workplace = Workplace::new();
    for t in 0..20 {
        workplace.ply(&format!("frames/{t}.ply"), &fading_frame(1500, t));
    }
    let run = |name: &str, more: &str| {
        workplace.done(&format!("compress frames -o {name} --ratio 0.4 --set refine_steps=20 {more}"));
        lasting_files(&workplace.path(name))
    };
    let one = run("one", "--threads 1");
    assert!(run("two", "--threads 2") == one);
    assert!(run("three", "--threads 3 --memory 200MiB") == one);
}

#[test]
#[ignore = "needs time"]
fn killed_run_leaves_nothing_under_the_final_name() {
    let workplace = Workplace::new();
    for t in 0..12 {
        workplace.ply(&format!("frames/{t}.ply"), &fading_frame(800, t));
    }
    let arguments = "compress frames -o small --ratio 0.4 --set refine_steps=20";
    let start = Instant::now();
    workplace.done(arguments);
    let whole = start.elapsed();
    let expected = lasting_files(&workplace.path("small"));
    fs::remove_dir_all(workplace.path("small")).unwrap();
    let mut early = 0;
    for kill in 1..=5 {
        let mut child = workplace.command(arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        std::thread::sleep(whole * kill / 6);
        child.kill().unwrap();
        child.wait().unwrap();
        if workplace.path("small").exists() {
            assert!(
                lasting_files(&workplace.path("small")) == expected,
                "kill {kill}: it has its name, and is not whole"
            );
            fs::remove_dir_all(workplace.path("small")).unwrap();
        } else {
            early += 1;
        }
    }
    assert!(early > 0, "every kill came too late");
    workplace.done(arguments);
    assert!(lasting_files(&workplace.path("small")) == expected);
    let mut left: Vec<_> = fs::read_dir(workplace.path("")).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["frames", "small"], "what killed runs left is still there");
}

#[test]
fn cut_begins_new_tracks_and_is_noted() {
    let workplace = Workplace::new();
    for t in 0..8 {
        let (mut gaussians, _) = frame(300, t, |i| i % 7 != t % 7);
        if t >= 5 {
            gaussians.position.planes_mut().iter_mut().for_each(|x| *x += 50.0);
        }
        workplace.ply(&format!("frames/{t}.ply"), &gaussians);
    }
    let scene = open(&workplace, "frames", LinkMode::Apart);
    assert_eq!(scene.source().info().count, 600);
    let notes = scene.input.description().notes.join("\n");
    assert!(notes.contains("a cut at 5.ply"), "{notes}");
}

#[test]
fn unlinkable_frames_are_refused_by_name() {
    let workplace = Workplace::new();
    let put = |name: &str, gaussians: &Gaussians| workplace.ply(&format!("frames/{name}"), gaussians);
    for t in 0..4 {
        put(&format!("{t}.ply"), &frame(60, t, |i| i % 5 != t).0);
    }
    let good = fs::read(workplace.path("frames/2.ply")).unwrap();
    let refused = |parts: &[&str]| workplace.refused(1, "compress frames -o out", &[&["2.ply"], parts].concat());
    let spoil = |bytes: &[u8]| fs::write(workplace.path("frames/2.ply"), bytes).unwrap();
    spoil(&[]);
    refused(&[]);
    spoil(&good[..good.len() - 5]);
    refused(&["cut short"]);
    // Another SH degree, and other properties.
    put("2.ply", &Gaussians::zeros(60, 0));
    refused(&["as in"]);
    let text = String::from_utf8_lossy(&good[..600]).into_owned();
    let other = text.find("property float nx").unwrap();
    spoil(&[&good[..other], b"property float mx", &good[other + 17..]].concat());
    refused(&["mx", "nx"]);
    fs::remove_file(workplace.path("frames/2.ply")).unwrap();
    refused(&["--allow-gaps"]);
    let gaps = workplace.done("info frames --allow-gaps");
    assert!(gaps.contains("3 frames") || gaps.contains('3'), "{gaps}");
    // A frame without Gaussians is valid.
    put("2.ply", &Gaussians::zeros(0, 1));
    workplace.done("compress frames -o out --ratio 1 --no-refine");
    assert_eq!(PlyRows::read(&workplace.path("out/2.ply")).rows.len(), 0);
    // Frames with equal numbers of Gaussians that are not to be linked are read by row as before.
    workplace.refused(1, "compress frames -o other --link never", &["element vertex", "--link"]);
    // A single frame has nothing to link.
    fs::create_dir(workplace.path("alone")).unwrap();
    fs::write(workplace.path("alone/0.ply"), &good).unwrap();
    workplace.done("info alone --link always");
}

/// Shuffles the Gaussians in the frames of a model, adds noise to their positions, and links the frames. `noise` is the
/// standard deviation of the noise, relative to the size of a Gaussian. Returns the fractions of links that are right,
/// wrong and missing.
fn link_fractions(model: PathBuf, noise: f32) -> [f64; 3] {
    let options = InputOptions { path: model.clone(), cameras: Some(model.clone()), ..InputOptions::default() };
    let scene = open_scene(&options).unwrap();
    let (count, frames) = (scene.source().info().count, scene.source().info().times.len());
    let mut linker = splatsieve::tracking::Linker::default();
    let (mut last, mut right, mut wrong, mut doubtful): (Option<Vec<u32>>, _, _, _) = (None, 0, 0, 0);
    for t in 0..frames {
        let given = state(scene.source(), t);
        let mut order: Vec<u32> = (0..count as u32).collect();
        order.sort_by_key(|&i| hash_id(u64::from(i) << 20 | t as u64));
        let mut mixed = given.pick(&order);
        for (at, &i) in order.iter().enumerate() {
            let squares = mixed.log_scale.row::<3>(at).map(|log| (2.0 * log).exp());
            let size = (squares.iter().sum::<f32>() / 3.0).sqrt();
            // Sum of three uniform numbers, of variance 1.
            let normal = |c: u64| {
                let uniform_part = |k: u64| uniform((u64::from(i) << 20 | t as u64) << 8 | c << 4 | k) - 0.5;
                2.0 * (uniform_part(0) + uniform_part(1) + uniform_part(2))
            };
            let moved: [f32; 3] =
                std::array::from_fn(|c| mixed.position.plane(c)[at] + noise * size * normal(c as u64));
            mixed.position.set_row(at, moved);
        }
        let linked = linker.link(&mixed);
        doubtful += linked.doubtful;
        let mut of_gaussian = vec![0; count];
        order.iter().zip(&linked.tracks).for_each(|(&i, &track)| of_gaussian[i as usize] = track);
        if let Some(last) = last.replace(of_gaussian.clone()) {
            let mut before = last.clone();
            before.sort_unstable();
            for (before_i, now) in last.iter().zip(&of_gaussian) {
                right += usize::from(before_i == now);
                wrong += usize::from(before_i != now && before.binary_search(now).is_ok());
            }
        }
    }
    let all = (count * (frames - 1)) as f64;
    let parts = [right, wrong, doubtful].map(|part| part as f64 / all);
    let [found, not, given_up] = parts.map(|part| 100.0 * part);
    println!("{}: {found:.3}% found, {not:.3}% wrong, {given_up:.3}% given up", model.display());
    parts
}

#[test]
#[ignore = "needs the trained models"]
fn shuffled_frames_of_trained_models_are_relinked() {
    for name in ["deform2", "room2_dynerf"] {
        let [right, wrong, _] = link_fractions(shared(name), 0.02);
        assert!(right >= 0.98 && wrong <= 0.005, "{name}: {right} found, {wrong} wrong");
    }
}

#[test]
fn stream_of_unlinked_frames_gives_the_bytes_of_files() {
    let workplace = Workplace::new();
    let frames: Vec<Gaussians> = (0..FRAMES).map(|t| frame(900, t, |i| is_alive(i, t)).0).collect();
    for (t, frame) in frames.iter().enumerate() {
        workplace.ply(&format!("frames/frame_{t:05}.ply"), frame);
    }
    let bytes = unlinked_stream(1, &frames);
    let run = |arguments: &str| {
        let output = workplace.piped(arguments, &bytes);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let same = |a: &str, b: &str| fs::read(workplace.path(a)).unwrap() == fs::read(workplace.path(b)).unwrap();
    workplace.done("convert frames files.gseq");
    run("convert - stream.gseq");
    assert!(same("files.gseq", "stream.gseq"));
    workplace.done("compress frames -o small_files.gseq --ratio 0.4 --no-refine");
    let said = run("compress - -o small_stream.gseq --ratio 0.4 --no-refine --verbose");
    assert!(said.contains("linked frame stream") && said.contains("does not say which"), "{said}");
    assert!(same("small_files.gseq", "small_stream.gseq"));
    // The result written as PLY frames: each has only the Gaussians that are alive in it.
    run("compress - -o half --as ply-sequence --ratio 0.5 --no-refine");
    let rows = |t: usize| PlyRows::read(&workplace.path(&format!("half/frame_{t:05}.ply"))).rows.len();
    assert!((0..FRAMES).all(|t| (1..frames[t].len()).contains(&rows(t))));
}

#[test]
fn lives_in_containers_and_streams_join_on_request() {
    let workplace = Workplace::new();
    let (count, frames) = (300, 40);
    for t in 0..frames {
        workplace.ply(&format!("frames/{t}.ply"), &fading_frame(count, t));
    }
    workplace.done("convert frames lives.gseq --link apart");
    // The container has ids of its own, which are used; a note says that lives are short.
    let [auto, apart, joined] =
        [LinkMode::Auto, LinkMode::Apart, LinkMode::Always].map(|link| open(&workplace, "lives.gseq", link));
    let [auto_count, apart_count, joined_count] = [&auto, &apart, &joined].map(|scene| scene.source().info().count);
    assert_eq!(
        (auto.input.description().kind, joined.input.description().kind),
        ("gseq container", "linked gseq container")
    );
    assert!(auto_count > 4 * count && apart_count > 4 * count, "{auto_count}, {apart_count}");
    assert!((count..=count + count / 20).contains(&joined_count), "{joined_count}");
    assert_eq!(joined.source().info().times, auto.source().info().times);
    assert_eq!(joined.input.bytes().unwrap(), auto.input.bytes().unwrap());
    let compress = |to: &str, link: &str| {
        workplace.done(&format!("compress lives.gseq -o {to} --count 200 --no-refine --verbose --link {link}"))
    };
    let said = compress("apart.gseq", "auto");
    assert!(said.contains(" of 40 frames (median): --link always joins Gaussians that continue one another"), "{said}");
    let said = compress("joined.gseq", "always");
    assert!(said.contains("were joined to ") && !said.contains("--link always joins"), "{said}");
    // Every Gaussian that is alive in a frame is in exactly one row of it.
    for t in (0..frames).step_by(13) {
        let mut whole = Gaussians::zeros(count, 1);
        (0..count).for_each(|i| write_row(i, t, &mut whole, i));
        let found = state(joined.source(), t);
        let is_one_row = |&i: &usize| {
            let is_it = |&track: &usize| {
                let apart = |c: usize| (found.position.plane(c)[track] - whole.position.plane(c)[i]).abs();
                (0..3).all(|c| apart(c) < 1e-5) && found.opacity_logit.plane(0)[track] > -30.0
            };
            (0..found.len()).filter(is_it).count() == 1
        };
        let one_row = (0..count).filter(is_one_row).count();
        assert!(one_row * 100 >= 97 * count, "frame {t}: {one_row}");
    }
    // The stream of the container is linked like the container.
    let stream = workplace.piped("convert lives.gseq - --quiet", b"").stdout;
    assert!(workplace.piped("convert - of_stream.gseq --link always", &stream).status.success());
    workplace.done("convert lives.gseq of_container.gseq --link always");
    let bytes = |name: &str| fs::read(workplace.path(name)).unwrap();
    assert!(bytes("of_stream.gseq") == bytes("of_container.gseq"));
    let output = workplace.piped("compress - -o of_stream_joined.gseq --count 200 --no-refine --link always", &stream);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(bytes("of_stream_joined.gseq") == bytes("joined.gseq"));
}

#[test]
fn cut_or_empty_stream_leaves_no_files() {
    let workplace = Workplace::new();
    let frames: Vec<Gaussians> = (0..3).map(|t| frame(50, t, |_| true).0).collect();
    let whole = unlinked_stream(1, &frames);
    let mut odd = whole.clone();
    odd[32 + 16..][..8].copy_from_slice(&(4u64 * 24 + 1).to_le_bytes());
    for (bytes, part) in [
        (&whole[..whole.len() - 30], "the rest of frame 2 (column sh)"),
        (&whole[..whole.len() - 24], "after 3 complete frames"),
        (&unlinked_stream(1, &[])[..], "at least one frame"),
        (&odd[..], "frame 0, byte 48"),
    ] {
        for verb in ["convert - out.gseq --scratch-dir .", "compress - -o out.gseq --scratch-dir . --ratio 0.5"] {
            let output = workplace.piped(verb, bytes);
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(output.status.code() == Some(1) && said.contains(part), "{part}: {said}");
            assert!(lasting_files(&workplace.path("")).is_empty(), "{part}");
        }
    }
}

#[test]
fn doubtful_links_begin_new_tracks_and_are_noted() {
    // The 300 Gaussians of this model jump from frame to frame; a quarter of the links were wrong before links were
    // weighed.
    let tiny = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/tiny_model"));
    let [right, wrong, doubtful] = link_fractions(tiny.clone(), 0.0);
    assert!(wrong <= 0.005 && doubtful >= 0.2, "{right} found, {wrong} wrong, {doubtful} given up");
    let workplace = Workplace::new();
    let scene = open_scene(&InputOptions { path: tiny, ..InputOptions::default() }).unwrap();
    for t in 0..scene.source().info().times.len() {
        let mut order: Vec<u32> = (0..300).collect();
        order.sort_by_key(|&i| hash_id(u64::from(i) << 20 | t as u64));
        workplace.ply(&format!("tiny/{t}.ply"), &state(scene.source(), t).pick(&order));
    }
    let notes = open(&workplace, "tiny", LinkMode::Auto).input.description().notes.join("\n");
    assert!(notes.contains("links were ambiguous"), "{notes}");
}
