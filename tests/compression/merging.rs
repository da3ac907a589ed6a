//! Tests of merging. They compare clusters and proxies of complete models with a plain implementation of method.md,
//! section 5: neighbors by comparing all pairs, tests by their formulas, cluster leaders one after the other.

use std::path::{Path, PathBuf};

use crate::scene::{PlyRows, Workplace, by_formula, lasting_files, state, tiny};
use glam::{DMat3, DQuat, DVec3};
use splatsieve::limits::Limits;
use splatsieve::merging::proxy::{ProxyState, merge_member_states};
use splatsieve::model::{Attributes, Gaussians, SH_C0};
use splatsieve::pipeline::{CompressedScene, PruneOrMerge, Request, Target, compress_scene, score_scene};
use splatsieve::pruning::score::{Scored, UserOverrides};
use splatsieve::recipe::{
    MergeParams, MergePass, MotionParams, MotionSimilarity, ProxyHigherSh, ProxyOpacity, ProxyPosition, Recipe,
};
use splatsieve::scene::{InputOptions, Scene, open_scene};

/// Change of the merging parameters that makes one of the tests for a pair stricter.
type Tighten = fn(&mut MergeParams);

/// Model with the states of all its frames in memory, and for each frame whether each Gaussian is alive (opacity ≥
/// 0.01).
struct AllFrames {
    frames: Vec<Gaussians>,
    alive: Vec<Vec<bool>>,
    reference: usize,
    extent: f64,
}

impl AllFrames {
    fn read(scene: &Scene) -> AllFrames {
        let source = scene.source();
        let frames: Vec<Gaussians> = (0..source.info().times.len()).map(|frame| state(source, frame)).collect();
        let alive: Vec<Vec<bool>> = frames
            .iter()
            .map(|f| f.opacity_logit.plane(0).iter().map(|&x| 1.0 / (1.0 + (-f64::from(x)).exp()) >= 0.01).collect())
            .collect();
        let living = |frame: &[bool]| frame.iter().filter(|&&alive| alive).count();
        let most = alive.iter().map(|frame| living(frame)).max().unwrap();
        let reference = alive.iter().position(|frame| living(frame) == most).unwrap();
        let extent = (0..3)
            .map(|c| {
                let mut plane = frames[reference].position.plane(c).to_vec();
                plane.sort_by(f32::total_cmp);
                let rank = |percent: usize| f64::from(plane[(percent * plane.len()).div_ceil(100) - 1]);
                rank(99) - rank(1)
            })
            .fold(0.0, f64::max);
        AllFrames { frames, alive, reference, extent }
    }

    fn at(&self, frame: usize, i: usize) -> DVec3 {
        DVec3::from(self.frames[frame].position_f64(i))
    }
}

fn rotation(state: &Gaussians, i: usize) -> DQuat {
    let [w, x, y, z] = state.rotation_f64(i);
    DQuat::from_xyzw(x, y, z, w).normalize()
}

fn covariance(state: &Gaussians, i: usize) -> DMat3 {
    let axes = DMat3::from_quat(rotation(state, i));
    let scale = DVec3::from(state.scales_f64(i));
    axes * DMat3::from_diagonal(scale * scale) * axes.transpose()
}

/// Returns whether the nodes (Gaussians or merged groups) in rows `i` and `j` of `state` pass tests 1 (place and size)
/// and 2 (color) of merging.
fn passes_tests_1_and_2(state: &Gaussians, i: usize, j: usize, merge: &MergeParams, pass: &MergePass) -> bool {
    let sigma = (covariance(state, i) + covariance(state, j)) * 0.5;
    let trace = sigma.x_axis.x + sigma.y_axis.y + sigma.z_axis.z;
    let regular = sigma + DMat3::from_diagonal(DVec3::splat(1e-6 * trace));
    let position = |i: usize| DVec3::from(state.position_f64(i));
    let delta = position(i) - position(j);
    let mahalanobis = delta.dot(regular.inverse() * delta).sqrt();

    let sorted = |i: usize| {
        let mut log = state.log_scale.row::<3>(i).map(f64::from);
        log.sort_by(|a, b| b.partial_cmp(a).unwrap());
        // A smallest scale below a tenth of the middle scale counts as a tenth of it.
        log[2] = log[2].max(log[1] + 0.1f64.ln());
        log
    };
    let ratio = sorted(i).iter().zip(sorted(j)).map(|(a, b)| (a - b).abs().exp()).fold(0.0, f64::max);

    let dc = |i: usize| DVec3::from(state.sh.row::<3>(i).map(f64::from));
    let cosine = dc(i).dot(dc(j)) / (dc(i).length() * dc(j).length() + 1e-8);
    let color = |i: usize| (dc(i) * SH_C0 + DVec3::splat(0.5)).max(DVec3::ZERO);
    mahalanobis < pass.d0
        && cosine > pass.rho
        && ratio <= merge.max_scale_ratio
        && (color(i) - color(j)).length() <= merge.max_color_difference
}

/// Returns whether the Gaussians `i` and `j` pass test 3 (motion) of merging, with the thresholds of the merging pass
/// `pass`.
fn passes_test_3(all_frames: &AllFrames, i: usize, j: usize, recipe: &Recipe, pass: &MergePass) -> bool {
    let merge = &recipe.merge;
    let unit = merge.length_unit.in_scene_units(all_frames.extent);
    let both = |t: usize| all_frames.alive[t][i] && all_frames.alive[t][j];
    let common: Vec<usize> = (0..all_frames.frames.len()).filter(|&t| both(t)).collect();
    let either = (0..all_frames.frames.len()).filter(|&t| all_frames.alive[t][i] || all_frames.alive[t][j]).count();
    if common.is_empty() {
        return false;
    }
    let steps: Vec<(DVec3, DVec3)> = common
        .iter()
        .filter(|&&t| t > 0 && (recipe.scan.motion == MotionParams::Literal || both(t - 1)))
        .map(|&t| (all_frames.at(t, i) - all_frames.at(t - 1, i), all_frames.at(t, j) - all_frames.at(t - 1, j)))
        .collect();
    let similarity = match merge.trajectory {
        MotionSimilarity::Cosine => {
            let sum: f64 = steps.iter().map(|(a, b)| a.dot(*b) / (a.length() * b.length() + 1e-8)).sum();
            let terms = if recipe.scan.motion == MotionParams::Literal { common.len() } else { steps.len() };
            if terms == 0 { 0.0 } else { sum / terms as f64 }
        }
        MotionSimilarity::Alignment => {
            let noise = 2.0 * steps.len() as f64 * (merge.motion_noise * unit).powi(2);
            let dot: f64 = steps.iter().map(|(a, b)| a.dot(*b)).sum();
            let squares: f64 = steps.iter().map(|(a, b)| a.length_squared() + b.length_squared()).sum();
            if squares + noise == 0.0 { 1.0 } else { (2.0 * dot + noise) / (squares + noise) }
        }
    };
    let offset = |t: usize| all_frames.at(t, i) - all_frames.at(t, j);
    let drift = common.iter().map(|&t| (offset(t) - offset(all_frames.reference)).length()).fold(0.0, f64::max);
    let dead = (either - common.len()) as f64 / either as f64;
    similarity > pass.tau_m && drift <= merge.max_drift * unit && dead <= merge.max_dead_time
}

/// Returns the clusters that merging must find among the Gaussians `kept`, by a plain implementation of the rules. A
/// cluster is a list of ids with the leader first. Clusters are in increasing order of their leaders.
fn clusters(all_frames: &AllFrames, scored: &Scored, kept: &[usize], recipe: &Recipe) -> Vec<Vec<usize>> {
    let merge = &recipe.merge;
    let unit = merge.length_unit.in_scene_units(all_frames.extent);
    let mut groups: Vec<Vec<usize>> = kept.iter().map(|&id| vec![id]).collect();
    for pass in &merge.passes {
        // State of a node: that of its Gaussian, or of its proxy so far.
        let mut nodes =
            all_frames.frames[all_frames.reference].pick(&groups.iter().map(|g| g[0] as u32).collect::<Vec<_>>());
        for (node, group) in groups.iter().enumerate().filter(|(_, group)| group.len() > 1) {
            let members = weighted(scored, group);
            merge_member_states(
                &members,
                &all_frames.frames[all_frames.reference],
                group[0] as u32,
                merge,
                Attributes::all(),
            )
            .write(Attributes::all(), node, &mut nodes);
        }
        let rows = scored.rows().unwrap();
        let size = |node: usize| groups[node].iter().map(|&id| rows.c[id]).sum::<f64>();
        let hash = |node: usize| splatsieve::model::hash_id(groups[node][0] as u64);
        let mut order: Vec<usize> = (0..groups.len()).collect();
        order.sort_by(|&a, &b| size(b).partial_cmp(&size(a)).unwrap().then(hash(a).cmp(&hash(b))));
        let position = |node: usize| DVec3::from(nodes.position_f64(node));
        let mut leader: Vec<Option<usize>> = vec![None; groups.len()];
        for &node in &order {
            if leader[node].is_some() {
                continue;
            }
            leader[node] = Some(node);
            let mut near: Vec<(f64, usize)> = (0..groups.len())
                .filter(|&other| other != node)
                .map(|other| ((position(other) - position(node)).length_squared(), other))
                .filter(|(squared, _)| *squared <= (pass.epsilon * unit).powi(2))
                .collect();
            near.sort_by(|a, b| a.partial_cmp(b).unwrap());
            for (_, other) in near.into_iter().take(merge.max_neighbors) {
                if leader[other].is_none()
                    && passes_tests_1_and_2(&nodes, node, other, merge, pass)
                    && passes_test_3(all_frames, groups[node][0], groups[other][0], recipe, pass)
                {
                    leader[other] = Some(node);
                }
            }
        }
        let joined = |node: usize| {
            let others = (0..groups.len()).filter(|&other| other != node && leader[other] == Some(node));
            groups[node].iter().copied().chain(others.flat_map(|other| groups[other].clone())).collect()
        };
        groups = (0..groups.len()).filter(|&node| leader[node] == Some(node)).map(joined).collect();
    }
    groups.sort_by_key(|group| group[0]);
    groups
}

/// Returns the ids of the cluster `group` in ascending order, each with its weight in the proxy. Weights are
/// proportional to C·Vis and sum to 1.
fn weighted(scored: &Scored, group: &[usize]) -> Vec<(u32, f64)> {
    let mut ids = group.to_vec();
    ids.sort_unstable();
    let rows = scored.rows().unwrap();
    let seen: Vec<f64> = ids.iter().map(|&id| rows.c[id] * rows.vis[id]).collect();
    let total: f64 = seen.iter().sum();
    assert!(total > 0.0, "a cluster that nobody saw");
    ids.iter().zip(seen).map(|(&id, weight)| (id as u32, weight / total)).collect()
}

fn options(output: &Path, recipe: &Recipe, only: PruneOrMerge) -> Request {
    let input = InputOptions { path: tiny(), ..InputOptions::default() };
    Request { only, ..Request::new(input, output.to_owned(), recipe.clone()) }
}

/// Compresses the tiny model with merging, and checks the clusters and proxies of the result. `only` selects pruning,
/// merging or both. Returns the number of Gaussians that were merged into the leader of their cluster.
fn assert_merges_as_specified(recipe: &Recipe, only: PruneOrMerge) -> usize {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("out");
    let scene = crate::scene::scene(&tiny());
    let CompressedScene { summary, index_map: map } = compress_scene(&scene, &options(&output, recipe, only)).unwrap();
    let scored = score_scene(&scene, recipe, &UserOverrides::default()).unwrap();
    let all_frames = AllFrames::read(&scene);
    assert_eq!(summary.merge.unwrap().reference_frame, all_frames.reference);
    let keep = scored.selection.keep();
    let kept: Vec<usize> = (0..map.len()).filter(|&id| only == PruneOrMerge::Merge || keep[id]).collect();

    let expected = clusters(&all_frames, &scored, &kept, recipe);
    let mut expected_map = vec![None; map.len()];
    for (place, group) in expected.iter().enumerate() {
        group.iter().for_each(|&id| expected_map[id] = Some(place as u32));
    }
    assert_eq!(map, expected_map, "clusters differ from the sequential rule");

    assert_solved_at_leaders(&output, &scene, &all_frames, &scored, &expected, &recipe.merge);
    kept.len() - expected.len()
}

/// Checks the merged state of a cluster against its definition by the members with weights w. Position: μ = Σ w x, or
/// the position of the leader. Covariance: Σ w (Σᵢ + (xᵢ − μ)(xᵢ − μ)ᵀ). Colors: Σ w c. Opacity: by its rule, in which
/// the area is a quarter of the surface of the ellipsoid.
fn assert_is_mixture(
    merged: &ProxyState,
    members: &[(u32, f64)],
    states: &Gaussians,
    leader: usize,
    merge: &MergeParams,
) {
    let position = |i: usize| DVec3::from(states.position_f64(i));
    let mean = match merge.placement {
        ProxyPosition::Leader => position(leader),
        ProxyPosition::Mean => members.iter().map(|&(i, weight)| weight * position(i as usize)).sum(),
    };
    let spread: f64 = members.iter().map(|&(i, _)| (position(i as usize) - mean).length()).fold(0.0, f64::max);
    assert!((merged.position - mean).length() <= 1e-12 * (mean.length() + spread), "{}, {mean}", merged.position);

    let mut expected = DMat3::ZERO;
    for &(i, weight) in members {
        let off = position(i as usize) - mean;
        let outer = DMat3::from_cols(off * off.x, off * off.y, off * off.z);
        expected += (covariance(states, i as usize) + outer) * weight;
    }
    let [w, x, y, z] = merged.rotation;
    let (axes, scales) = (DMat3::from_quat(DQuat::from_xyzw(x, y, z, w)), DVec3::from(merged.log_scale).exp());
    let found = axes * DMat3::from_diagonal(scales * scales) * axes.transpose();
    let trace = expected.x_axis.x + expected.y_axis.y + expected.z_axis.z;
    let off = (found - expected).to_cols_array().iter().fold(0.0, |most: f64, x| most.max(x.abs()));
    assert!(off <= 1e-10 * trace, "covariance {found}, expected {expected}");

    // Formula by Knud Thomsen, p = 1.6075.
    let surface = |s: DVec3| {
        let sections = [s.x * s.y, s.y * s.z, s.z * s.x].map(|area| area.powf(1.6075));
        4.0 * std::f64::consts::PI * (sections.iter().sum::<f64>() / 3.0).powf(1.0 / 1.6075)
    };
    let opacity_and_area = |i: u32| {
        let scale = DVec3::from(states.scales_f64(i as usize));
        (1.0 / (1.0 + (-f64::from(states.opacity_logit.plane(0)[i as usize])).exp()), surface(scale))
    };
    let opacity = match merge.opacity {
        ProxyOpacity::Sum => members.iter().map(|&(i, _)| opacity_and_area(i).0).sum::<f64>(),
        ProxyOpacity::Union => 1.0 - members.iter().map(|&(i, _)| 1.0 - opacity_and_area(i).0).product::<f64>(),
        ProxyOpacity::Area => {
            members.iter().map(|&(i, _)| opacity_and_area(i).0 * opacity_and_area(i).1).sum::<f64>() / surface(scales)
        }
    };
    let found = 1.0 / (1.0 + (-merged.opacity_logit).exp());
    assert!((found - opacity.min(1.0)).abs() <= 1e-5, "opacity {found}, expected {opacity}");

    let heaviest = members.iter().rev().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap().0;
    for (k, &found) in merged.sh.iter().enumerate() {
        let coefficient = |i: u32| f64::from(states.sh.plane(k)[i as usize]);
        let expected = match merge.sh_high {
            ProxyHigherSh::Heaviest if k >= 3 => coefficient(heaviest),
            _ => members.iter().map(|&(i, weight)| weight * coefficient(i)).sum::<f64>(),
        };
        assert!(
            (found - expected).abs() <= 1e-12 * (1.0 + expected.abs()),
            "coefficient {k}: {found}, expected {expected}"
        );
    }
}

/// Checks the proxies that a run wrote to `output`, at the reference frame (the frame in which a group is merged):
///
/// - The stored parameters of a proxy are its merged state minus the deformation that the field adds to its leader.
/// - The quaternion of a proxy has the length of the leader's quaternion.
/// - If proxies are placed at their leaders, the state of a proxy is its merged state up to rounding, and its position
///   is exactly that of the leader at every frame.
fn assert_solved_at_leaders(
    output: &Path,
    scene: &Scene,
    all_frames: &AllFrames,
    scored: &Scored,
    clusters: &[Vec<usize>],
    merge: &MergeParams,
) {
    let cloud = "point_cloud/iteration_7/point_cloud.ply";
    let (before, after) = (PlyRows::read(&tiny().join(cloud)), PlyRows::read(&output.join(cloud)));
    let result = splatsieve::models::ModelFolder::open(output, None).unwrap();
    let result = result.with_times(scene.source().info().times.clone()).unwrap();
    let frames: Vec<Gaussians> = (0..all_frames.frames.len()).map(|frame| state(&result, frame)).collect();
    let at_reference = &all_frames.frames[all_frames.reference];
    for (place, group) in clusters.iter().enumerate().filter(|(_, group)| group.len() > 1) {
        let leader = group[0];
        let members = weighted(scored, group);
        let merged = merge_member_states(&members, at_reference, leader as u32, merge, Attributes::all());
        assert_is_mixture(&merged, &members, at_reference, leader, merge);
        let length = at_reference.rotation.row::<4>(leader).iter().map(|x| f64::from(x * x)).sum::<f64>().sqrt();
        // (property, merged state, state of the leader, state of the proxy in the result)
        let mut columns: Vec<(String, f64, f32, f32)> = Vec::new();
        let found = &frames[all_frames.reference];
        for c in 0..3 {
            let value = |state: &Gaussians, i: usize| state.position.plane(c)[i];
            columns.push((
                ["x", "y", "z"][c].into(),
                merged.position[c],
                value(at_reference, leader),
                value(found, place),
            ));
            let value = |state: &Gaussians, i: usize| state.log_scale.plane(c)[i];
            columns.push((format!("scale_{c}"), merged.log_scale[c], value(at_reference, leader), value(found, place)));
        }
        for c in 0..4 {
            let value = |state: &Gaussians, i: usize| state.rotation.plane(c)[i];
            let rotation = merged.rotation[c] * length;
            columns.push((format!("rot_{c}"), rotation, value(at_reference, leader), value(found, place)));
        }
        let value = |state: &Gaussians, i: usize| state.opacity_logit.plane(0)[i];
        columns.push(("opacity".into(), merged.opacity_logit, value(at_reference, leader), value(found, place)));
        for k in 0..16 {
            for channel in 0..3 {
                let name = if k == 0 { format!("f_dc_{channel}") } else { format!("f_rest_{}", 15 * channel + k - 1) };
                let value = |state: &Gaussians, i: usize| state.sh.plane(3 * k + channel)[i];
                columns.push((name, merged.sh[3 * k + channel], value(at_reference, leader), value(found, place)));
            }
        }
        assert_eq!(columns.len(), 59);
        for (name, merged, of_leader, found) in columns {
            let (raw, raw_leader) = (after.value(place, &name), before.value(leader, &name));
            let expected = merged - (f64::from(of_leader) - f64::from(raw_leader));
            // Four f32 numbers of this size are rounded during the computation.
            let size = merged.abs().max(of_leader.abs().into()).max(raw_leader.abs().into()).max(1e-3);
            let tolerance = 4.0 * f64::from(f32::EPSILON) * size;
            let at = format!("{name} of the proxy at {place}, led by {leader}");
            assert!((f64::from(raw) - expected).abs() <= tolerance, "raw {at}: got {raw}, expected {expected}");
            if merge.placement == ProxyPosition::Leader {
                assert!((f64::from(found) - merged).abs() <= tolerance, "{at}: got {found}, expected {merged}");
            }
        }
        if merge.placement == ProxyPosition::Leader {
            for (now, then) in frames.iter().zip(&all_frames.frames) {
                assert_eq!(now.position.row::<3>(place), then.position.row::<3>(leader), "path of {place}");
            }
        }
    }
}

#[test]
fn presets_merge_as_specified() {
    // The preset `strong` prunes most of the tiny model first, so few Gaussians are left to merge.
    for (preset, least) in [("paper", 100), ("default", 30), ("strong", 20)] {
        let joined = assert_merges_as_specified(&by_formula(preset), PruneOrMerge::Both);
        assert!(joined >= least, "{preset}: only {joined} joined");
    }
}

#[test]
fn merging_without_pruning_merges_as_specified() {
    for preset in ["paper", "default"] {
        assert!(assert_merges_as_specified(&by_formula(preset), PruneOrMerge::Merge) > 30);
    }
}

#[test]
fn later_passes_merge_groups_as_specified() {
    let mut recipe = by_formula("paper");
    let one = assert_merges_as_specified(&recipe, PruneOrMerge::Both);
    recipe.merge.passes.push(MergePass { epsilon: 0.3, d0: 4.0, rho: 0.5, tau_m: 0.3 });
    let two = assert_merges_as_specified(&recipe, PruneOrMerge::Both);
    assert!(two > one, "{two} joined in two passes, {one} in one");
}

#[test]
fn every_stricter_merging_test_rejects_pairs_as_specified() {
    let base = || {
        let mut recipe = by_formula("default");
        recipe.merge.passes = vec![MergePass { epsilon: 0.2, d0: 3.0, rho: 0.3, tau_m: 0.2 }];
        (recipe.merge.max_drift, recipe.merge.max_dead_time) = (0.05, 0.5);
        recipe
    };
    let all = assert_merges_as_specified(&base(), PruneOrMerge::Merge);
    let edits: [(&str, Tighten); 9] = [
        ("epsilon", |m| m.passes[0].epsilon = 0.004),
        ("d0", |m| m.passes[0].d0 = 0.2),
        ("rho", |m| m.passes[0].rho = 0.9999),
        ("tau_m", |m| m.passes[0].tau_m = 0.999),
        ("max_neighbors", |m| m.max_neighbors = 2),
        ("max_scale_ratio", |m| m.max_scale_ratio = 1.1),
        ("max_color_difference", |m| m.max_color_difference = 0.01),
        ("max_drift", |m| m.max_drift = 0.001),
        ("max_dead_time", |m| m.max_dead_time = 0.0),
    ];
    for (gate, edit) in edits {
        let mut recipe = base();
        edit(&mut recipe.merge);
        let joined = assert_merges_as_specified(&recipe, PruneOrMerge::Merge);
        assert!(joined < all, "{gate} binds nothing: {joined} joined, {all} without");
    }
}

/// Writes a folder of eight PLY frames with twelve pairs of Gaussians. Neighboring pairs are 0.1 apart. `offset`
/// returns the displacement of a Gaussian, given the frame and whether it is the second of its pair.
fn pairs(workplace: &Workplace, offset: impl Fn(usize, bool) -> [f32; 3]) -> PathBuf {
    for frame in 0..8 {
        let mut cloud = Gaussians::zeros(24, 0);
        for i in 0..24 {
            let [x, y, z] = offset(frame, i % 2 == 1);
            cloud.position.set_row(i, [x + 0.1 * (i / 2) as f32, y + 0.1 * (i / 2 % 5) as f32, z]);
            cloud.rotation.set_row(i, [1.0, 0.0, 0.0, 0.0]);
            cloud.log_scale.set_row(i, [-3.0; 3]);
            cloud.opacity_logit.set_row(i, [0.3 * (i % 5) as f32]);
        }
        workplace.ply(&format!("frames/frame_{frame}.ply"), &cloud);
    }
    workplace.path("frames")
}

/// Merges the Gaussians of the frames of [`pairs`] without pruning. Returns the index map and the number of proxies.
fn merged(workplace: &Workplace, scene: &Scene, recipe: &Recipe) -> (Vec<Option<u32>>, usize) {
    let (input, output) =
        (InputOptions { path: workplace.path("frames"), ..InputOptions::default() }, workplace.path("out"));
    let request = Request { only: PruneOrMerge::Merge, ..Request::new(input, output, recipe.clone()) };
    let CompressedScene { summary, index_map: map } = compress_scene(scene, &request).unwrap();
    (map, summary.merge.unwrap().proxies)
}

fn open(path: PathBuf) -> Scene {
    open_scene(&InputOptions { path, ..InputOptions::default() }).unwrap()
}

#[test]
fn proxy_trajectory_is_the_weighted_mean_of_its_members() {
    let workplace = Workplace::new();
    // The first of a pair flies along a line; the second circles around it.
    let flying = |frame: usize, second: bool| {
        let (radius, (sin, cos)) = (if second { 0.003 } else { 0.0 }, (0.5 * frame as f32).sin_cos());
        [0.025 * frame as f32 + radius * cos, 0.0, radius * sin]
    };
    let scene = open(pairs(&workplace, flying));
    let mut recipe = by_formula("default");
    recipe.merge.max_drift = 0.05;
    let (map, proxies) = merged(&workplace, &scene, &recipe);
    assert_eq!(proxies, 12);
    let scored = score_scene(&scene, &recipe, &UserOverrides::default()).unwrap();
    let all_frames = AllFrames::read(&scene);
    for frame in 0..8 {
        let rows = PlyRows::read(&workplace.path(&format!("out/frame_{frame}.ply")));
        for pair in 0..12 {
            let members = weighted(&scored, &[2 * pair, 2 * pair + 1]);
            let mean: DVec3 = members.iter().map(|&(id, weight)| weight * all_frames.at(frame, id as usize)).sum();
            let place = map[2 * pair].unwrap() as usize;
            let found = DVec3::from(["x", "y", "z"].map(|axis| f64::from(rows.value(place, axis))));
            // Coordinates up to 1.3, rounded to f32.
            assert!((found - mean).length() < 2e-7, "pair {pair}, frame {frame}: {found}, expected {mean}");
        }
    }
}

#[test]
fn jitter_below_the_noise_floor_is_not_motion() {
    let mut recipe = by_formula("default");
    // (position, jitter of the second of a pair, noise floor in extents, proxies): a jitter of a third of the floor;
    // the same without a floor; and a jitter of the size of rounding at this position, for which there always is a
    // floor.
    for (at, jitter, floor, expected) in [(0.0, 3e-5, 1e-4, 12), (0.0, 3e-5, 0.0, 0), (1024.0, 1.0 / 8192.0, 0.0, 12)] {
        let workplace = Workplace::new();
        let jittering = |frame: usize, second: bool| {
            let moved = second && frame / 2 % 2 == 1;
            [at + if moved { jitter } else { 0.0 }, if second { 0.003 } else { 0.0 }, 0.0]
        };
        let scene = open(pairs(&workplace, jittering));
        recipe.merge.motion_noise = floor;
        assert_eq!(merged(&workplace, &scene, &recipe).1, expected, "at {at}, floor {floor}");
    }
}

#[test]
fn proxies_that_drift_from_members_return_to_leaders() {
    let mut recipe = by_formula("default");
    recipe.merge.placement = ProxyPosition::Mean;
    recipe.merge.passes = vec![MergePass { epsilon: 0.2, d0: 3.0, rho: 0.3, tau_m: 0.2 }];
    recipe.merge.max_drift = 0.004;
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("out");
    let scene = crate::scene::scene(&tiny());
    let map = compress_scene(&scene, &options(&output, &recipe, PruneOrMerge::Merge)).unwrap().index_map;
    let (scored, all_frames) =
        (score_scene(&scene, &recipe, &UserOverrides::default()).unwrap(), AllFrames::read(&scene));
    let cloud = "point_cloud/iteration_7/point_cloud.ply";
    let (before, after) = (PlyRows::read(&tiny().join(cloud)), PlyRows::read(&output.join(cloud)));
    let result = splatsieve::models::ModelFolder::open(&output, None).unwrap();
    let result = result.with_times(scene.source().info().times.clone()).unwrap();
    let frames: Vec<Gaussians> = (0..all_frames.frames.len()).map(|frame| state(&result, frame)).collect();
    let limit = recipe.merge.max_drift * all_frames.extent;
    let (mut at_leaders, mut at_means) = (0, 0);
    for place in 0..after.rows.len() {
        let group: Vec<usize> = (0..map.len()).filter(|&id| map[id] == Some(place as u32)).collect();
        let members = if group.len() > 1 { weighted(&scored, &group) } else { continue };
        let raw = |rows: &PlyRows, i: usize| ["x", "y", "z"].map(|axis| rows.value(i, axis));
        if group.iter().any(|&id| raw(&before, id) == raw(&after, place)) {
            at_leaders += 1;
            continue;
        }
        at_means += 1;
        for (t, frame) in frames.iter().enumerate() {
            let mean: DVec3 = members.iter().map(|&(id, weight)| weight * all_frames.at(t, id as usize)).sum();
            let off = (DVec3::from(frame.position_f64(place)) - mean).length();
            assert!(off <= limit * 1.001, "proxy {place} is {off} off at frame {t}, at most {limit} expected");
        }
    }
    assert!(at_leaders > 0 && at_means > 0, "{at_leaders} at their leaders, {at_means} at their means");
}

#[test]
fn number_of_pair_partitions_changes_no_byte() {
    // Two passes, so that the second asks for pairs of which some are measured already; and a target, so that many sets
    // of survivors are tried.
    let mut recipe = by_formula("default");
    recipe.merge.passes.push(MergePass { epsilon: 0.2, d0: 4.0, rho: 0.5, tau_m: 0.3 });
    for target in [None, Some(Target::Count(180))] {
        let folder = tempfile::tempdir().unwrap();
        let merge = |pairs_together: usize| {
            let (output, scratch) = (folder.path().join(format!("out{pairs_together}")), tempfile::tempdir().unwrap());
            let mut scene = crate::scene::scene(&tiny());
            scene.limits = Limits { pairs_together, max_kept_frames: 3, ..Limits::NONE };
            scene.scratch = scratch.path().to_owned();
            let options = Request { target, ..options(&output, &recipe, PruneOrMerge::Both) };
            let CompressedScene { summary, index_map: map } = compress_scene(&scene, &options).unwrap();
            assert_eq!(std::fs::read_dir(scratch.path()).unwrap().count(), 0, "scratch files are left");
            (lasting_files(&output), map, summary.merge.unwrap().passes)
        };
        let unpartitioned = merge(usize::MAX);
        let pairs = unpartitioned.2[0].candidates;
        assert!(pairs > 64 && unpartitioned.2.iter().all(|pass| pass.joins > 0), "{:?}", unpartitioned.2);
        for partitions in [1, 7, 64] {
            assert!(merge(pairs.div_ceil(partitions)) == unpartitioned, "{partitions} partitions, target {target:?}");
        }
    }
}
