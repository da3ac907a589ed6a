//! Tests of merging from beginning to end.

use std::convert::Infallible;

use glam::{DQuat, DVec3};
use xxhash_rust::xxh3::xxh3_64_with_seed;

use super::motion::{MotionThresholds, PairMotionAccumulator};
use super::*;
use crate::model::AttributeValues;
use crate::recipe::{MergeParams, MotionParams, Recipe};

/// Returns a pseudorandom number in [0, 1) for Gaussian `i`; different for every `salt`.
fn uniform(i: usize, salt: u64) -> f64 {
    (xxh3_64_with_seed(&(i as u64).to_le_bytes(), salt) >> 11) as f64 / (1u64 << 53) as f64
}

/// Test scene of survivors (Gaussians to be merged), which owns the data that [`Survivors`] borrows.
struct MergeScene {
    states: Gaussians,
    ids: Vec<u32>,
    coverage: Vec<f64>,
    visibility: Vec<f64>,
    classes: Vec<Option<u8>>,
    extent: f64,
}

impl MergeScene {
    /// Creates a scene of `n` similar Gaussians, evenly distributed in the unit cube.
    fn uniform_cube(n: usize) -> Self {
        let mut states = Gaussians::zeros(n, 1);
        let size = 0.7 * (n.max(1) as f64).powf(-1.0 / 3.0);
        for i in 0..n {
            let value = |salt: u64| uniform(i, salt) as f32;
            states.position.set_row(i, [value(0), value(1), value(2)]);
            states.rotation.set_row(i, [value(3) - 0.5, value(4) - 0.5, value(5) - 0.5, 0.6]);
            states.log_scale.set_row(i, [6, 7, 8].map(|salt| size.ln() as f32 + 0.8 * (value(salt) - 0.5)));
            states.opacity_logit.set_row(i, [4.0 * value(9) - 2.0]);
            states.sh.set_row::<12>(i, std::array::from_fn(|k| 0.5 + 0.1 * value(10 + k as u64)));
        }
        MergeScene {
            states,
            ids: (0..n as u32).collect(),
            coverage: (0..n).map(|i| uniform(i, 30)).collect(),
            visibility: (0..n).map(|i| uniform(i, 31)).collect(),
            classes: vec![Some(0); n],
            extent: 1.0,
        }
    }

    /// Returns the default recipe with a merging radius ε of about twice the distance between Gaussians of this scene.
    fn recipe(&self) -> MergeParams {
        let mut merge = Recipe::preset("default").unwrap().merge;
        merge.passes[0].epsilon = 1.2 * (self.states.len() as f64).powf(-1.0 / 3.0);
        merge.passes[0].d0 = 2.0;
        merge
    }

    fn merge(&self, recipe: &MergeParams, limit: Option<usize>) -> MergeResult {
        self.merge_moving(recipe, limit, std::slice::from_ref(&self.states.position))
    }

    /// Merges all Gaussians of this scene, with at most `limit` joins. `frames`: positions at each frame, the first of
    /// which is the reference frame. All Gaussians are alive at all frames.
    fn merge_moving(&self, recipe: &MergeParams, limit: Option<usize>, frames: &[AttributeValues]) -> MergeResult {
        let rows: Vec<u32> = (0..self.states.len() as u32).collect();
        self.merge_rows(&rows, recipe, limit, frames)
    }

    /// Merges only the Gaussians in `rows`. All other arguments are those of [`MergeScene::merge_moving`].
    fn merge_rows(
        &self,
        rows: &[u32],
        recipe: &MergeParams,
        limit: Option<usize>,
        frames: &[AttributeValues],
    ) -> MergeResult {
        self.merge_in_batches(rows, recipe, limit, frames, usize::MAX).0
    }

    /// Merges like [`MergeScene::merge_rows`] and measures the motion of at most `max_pairs` pairs in one call. Also
    /// returns the number of pairs in each of these calls.
    fn merge_in_batches(
        &self,
        rows: &[u32],
        recipe: &MergeParams,
        limit: Option<usize>,
        frames: &[AttributeValues],
        max_pairs: usize,
    ) -> (MergeResult, Vec<usize>) {
        let MergeScene { states, classes, extent, .. } = self;
        let survivors = Survivors { states, rows, importance: self.importance(), classes, extent: *extent };
        let gate = MotionThresholds::new(recipe, recipe.length_unit.in_scene_units(*extent));
        let mut batches = Vec::new();
        let measure = |request: RequestedPairs<'_>| {
            batches.push(request.pairs().len());
            let reference = (0..states.len()).map(|i| frames[0].row(i));
            let mut motion = PairMotionAccumulator::new(request.pairs(), reference, MotionParams::Runs);
            frames.iter().for_each(|frame| motion.add_frame(|i| (frame.row(i), true)));
            Ok::<_, Infallible>(motion.finish().map(|pair| gate.similarity(&pair)).collect())
        };
        match merge_survivors(&survivors, recipe, limit, max_pairs, measure) {
            Ok(merged) => (merged, batches),
            Err(never) => match never {},
        }
    }

    fn importance(&self) -> Importance<'_> {
        Importance { ids: &self.ids, coverage: &self.coverage, visibility: &self.visibility }
    }

    /// Returns this scene rotated, scaled and shifted as a whole.
    fn transformed(mut self, rotation: DQuat, scale: f64, shift: DVec3) -> Self {
        for i in 0..self.states.len() {
            let position = DVec3::from(self.states.position_f64(i));
            self.states.position.set_row(i, (rotation * position * scale + shift).to_array().map(|x| x as f32));
            let q = rotation * appearance::unit_rotation(self.states.rotation.row(i));
            self.states.rotation.set_row(i, [q.w, q.x, q.y, q.z].map(|x| x as f32));
            let log_scale = self.states.log_scale.row::<3>(i).map(|s| s + scale.ln() as f32);
            self.states.log_scale.set_row(i, log_scale);
        }
        self.extent *= scale;
        self
    }
}

fn joins(merged: &MergeResult) -> usize {
    merged.passes.iter().map(|pass| pass.joins).sum()
}

/// Returns the index of the group that contains the Gaussian `row`.
fn group_of(groups: &MergeGroups, row: u32) -> usize {
    (0..groups.group_count()).find(|&group| groups.members(group).contains(&row)).unwrap()
}

#[test]
fn batched_measurement_merges_to_the_same_bits() {
    let scene = MergeScene::uniform_cube(3000);
    let recipe = scene.recipe();
    let rows: Vec<u32> = (0..3000).collect();
    let frames = std::slice::from_ref(&scene.states.position);
    let (whole, batches) = scene.merge_in_batches(&rows, &recipe, None, frames, usize::MAX);
    let [pairs] = batches[..] else { panic!("{batches:?}") };
    assert!(joins(&whole) > 300);
    for (max_pairs, expected) in [(pairs, 1), (pairs.div_ceil(7), 7), (pairs.div_ceil(64), 64)] {
        let (merged, batches) = scene.merge_in_batches(&rows, &recipe, None, frames, max_pairs);
        assert!(
            batches.len() == expected && batches.iter().all(|&batch| batch <= max_pairs),
            "{max_pairs}: {batches:?}"
        );
        assert!(merged.groups == whole.groups && merged.proxies == whole.proxies && merged.passes == whole.passes);
    }
}

#[test]
fn static_neighbors_merge_diverging_ones_do_not() {
    let scene = MergeScene::uniform_cube(2000);
    let still = scene.merge(&scene.recipe(), None);
    assert!(joins(&still) > 300, "{:?}", still.passes);
    assert_eq!(still.groups.group_count(), 2000 - joins(&still));
    assert_eq!(still.proxies.len(), still.groups.clusters().count());
    // Every second Gaussian moves up, the others down.
    let mut later = scene.states.position.clone();
    for (i, y) in later.plane_mut(1).iter_mut().enumerate() {
        *y += if i % 2 == 0 { 0.5 } else { -0.5 };
    }
    let flying = scene.merge_moving(&scene.recipe(), None, &[scene.states.position.clone(), later]);
    assert!(joins(&flying) > 100);
    for group in 0..flying.groups.group_count() {
        let parity: Vec<u32> = flying.groups.members(group).iter().map(|row| row % 2).collect();
        assert!(parity.windows(2).all(|w| w[0] == w[1]), "group {group} flies both ways");
    }
}

#[test]
fn moving_and_scaling_the_scene_changes_no_group() {
    let scene = MergeScene::uniform_cube(1500);
    let expected = scene.merge(&scene.recipe(), None).groups;
    let rotation = DQuat::from_xyzw(0.3, -0.5, 0.2, 0.7).normalize();
    for (rotation, scale, shift) in [
        (DQuat::IDENTITY, 1.0, DVec3::new(8.0, -4.0, 2.0)),
        (rotation, 1.0, DVec3::ZERO),
        (DQuat::IDENTITY, 1024.0, DVec3::ZERO),
        (rotation, 1e-3, DVec3::new(0.002, 0.0, -0.001)),
    ] {
        let transformed = MergeScene::uniform_cube(1500).transformed(rotation, scale, shift);
        assert_eq!(
            transformed.merge(&scene.recipe(), None).groups,
            expected,
            "rotation {rotation:?}, scale {scale}, shift {shift:?}"
        );
    }
}

#[test]
fn exact_duplicates_merge_to_one() {
    let mut scene = MergeScene::uniform_cube(60);
    for column in Attributes::all().iter() {
        for c in 0..scene.states.attribute_values(column).width() {
            let plane = scene.states.attribute_values_mut(column).plane_mut(c);
            (0..60).for_each(|i| plane[i] = plane[i % 20]);
        }
    }
    // With ε = 0 only duplicates are neighbors.
    let mut recipe = scene.recipe();
    recipe.passes[0].epsilon = 0.0;
    let merged = scene.merge(&recipe, None);
    assert_eq!(merged.groups.group_count(), 20);
    for group in 0..20 {
        let members = merged.groups.members(group);
        assert_eq!(members.iter().map(|row| row % 20).collect::<Vec<_>>(), [members[0] % 20; 3]);
        let leader = merged.groups.leaders()[group] as usize;
        assert_eq!(merged.proxies.position.row::<3>(group), scene.states.position.row(leader));
        assert_eq!(merged.proxies.log_scale.row::<3>(group), scene.states.log_scale.row(leader));
        assert_eq!(merged.proxies.sh.row::<12>(group), scene.states.sh.row(leader));
    }
}

#[test]
fn coincident_gaussians_merge_before_their_neighbors() {
    for count in [34, 100, 5000] {
        // Two sets of coincident Gaussians of different colors at one position, and one other Gaussian near them.
        let mut scene = MergeScene::uniform_cube(2 * count + 1);
        let places: Vec<u32> = (0..=2 * count as u32).map(|i| if i == 0 { 0 } else { 1 + i % 2 }).collect();
        scene.states = scene.states.pick(&places);
        for (i, &place) in places.iter().enumerate() {
            scene.states.position.set_row(i, [if i == 0 { 0.501 } else { 0.5 }, 0.5, 0.5]);
            scene.states.rotation.set_row(i, [1.0, 0.0, 0.0, 0.0]);
            scene.states.log_scale.set_row(i, [-3.0; 3]);
            scene.states.sh.set_row::<12>(i, [if place == 1 { 0.2 } else { -0.9 }; 12]);
        }
        let mut recipe = scene.recipe();
        recipe.passes[0].epsilon = 0.01;
        let merged = scene.merge(&recipe, None);
        let members = |row| merged.groups.members(group_of(&merged.groups, row)).len();
        assert_eq!((merged.groups.group_count(), members(1), members(2)), (2, count + 1, count), "{:?}", merged.passes);
        let limited = scene.merge(&recipe, Some(count));
        assert_eq!(limited.groups.group_count(), count + 1);
        let (rows, frame) = ((0..=2 * count as u32).collect::<Vec<u32>>(), [scene.states.position.clone()]);
        let (batches, _) = scene.merge_in_batches(&rows, &recipe, None, &frame, 7);
        assert!(batches.groups == merged.groups && batches.proxies == merged.proxies);
    }
}

#[test]
fn a_giant_background_gaussian_stays_single() {
    let mut scene = MergeScene::uniform_cube(500);
    scene.states.position.set_row(7, [0.5; 3]);
    scene.states.log_scale.set_row(7, [100f32.ln(); 3]);
    scene.coverage[7] = 1e9;
    let merged = scene.merge(&scene.recipe(), None);
    assert_eq!(merged.groups.members(group_of(&merged.groups, 7)), [7]);
}

#[test]
fn non_finite_or_unmergeable_gaussians_stay_single() {
    let mut scene = MergeScene::uniform_cube(400);
    scene.classes[11] = None;
    scene.states.opacity_logit.set_row(12, [f32::NAN]);
    scene.states.sh.plane_mut(11)[13] = f32::INFINITY;
    let merged = scene.merge(&scene.recipe(), None);
    assert!(joins(&merged) > 50);
    for row in [11, 12, 13] {
        assert_eq!(merged.groups.members(group_of(&merged.groups, row)), [row]);
    }
}

#[test]
fn thread_count_changes_no_byte() {
    let scene = MergeScene::uniform_cube(5000);
    let recipe = scene.recipe();
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let merged = pool.install(|| scene.merge(&recipe, None));
        (merged.groups, merged.proxies, merged.passes)
    };
    let one = with(1);
    assert!(one == with(2) && one == with(16));
}

#[test]
fn order_of_rows_changes_no_cluster() {
    let n = 1500;
    let (scene, mut shuffled) = (MergeScene::uniform_cube(n), MergeScene::uniform_cube(n));
    let new_row = |row: usize| (row * 7 + 3) % n;
    for row in 0..n {
        for column in Attributes::all().iter() {
            for c in 0..scene.states.attribute_values(column).width() {
                shuffled.states.attribute_values_mut(column).plane_mut(c)[new_row(row)] =
                    scene.states.attribute_values(column).plane(c)[row];
            }
        }
        shuffled.ids[new_row(row)] = scene.ids[row];
    }
    let leaders = |groups: &MergeGroups, place: &dyn Fn(usize) -> usize| -> Vec<u32> {
        (0..n).map(|row| groups.leaders()[group_of(groups, place(row) as u32)]).collect()
    };
    let straight = leaders(&scene.merge(&scene.recipe(), None).groups, &|row| row);
    let shuffled = leaders(&shuffled.merge(&scene.recipe(), None).groups, &new_row);
    assert_eq!(straight.iter().map(|&row| new_row(row as usize) as u32).collect::<Vec<_>>(), shuffled);
}

#[test]
fn the_limit_counts_joins_over_all_passes_exactly() {
    let scene = MergeScene::uniform_cube(2000);
    let mut recipe = scene.recipe();
    recipe.passes.push(recipe::MergePass { epsilon: 1.5 * recipe.passes[0].epsilon, ..recipe.passes[0] });
    let all = scene.merge(&recipe, None);
    let (first, both) = (all.passes[0].joins, joins(&all));
    assert!(both > first, "the second pass joins nothing: {:?}", all.passes);
    for limit in [0, 1, first, first + 1, both, both + 5] {
        let merged = scene.merge(&recipe, Some(limit));
        assert_eq!(merged.groups.group_count(), 2000 - limit.min(both), "limit {limit}");
    }
}

#[test]
fn two_pass_proxies_come_from_original_members() {
    let scene = MergeScene::uniform_cube(2000);
    let mut recipe = scene.recipe();
    recipe.passes.push(recipe::MergePass { epsilon: 2.0 * recipe.passes[0].epsilon, d0: 3.0, ..recipe.passes[0] });
    let merged = scene.merge(&recipe, None);
    let direct = proxy::merge_groups(&merged.groups, &scene.importance(), &scene.states, &recipe);
    assert!(direct == merged.proxies);
}

#[test]
fn no_survivors_and_one_survivor_pass_through() {
    for n in [0, 1] {
        let scene = MergeScene::uniform_cube(n);
        let merged = scene.merge(&Recipe::preset("default").unwrap().merge, None);
        assert_eq!((merged.groups.group_count(), merged.proxies.len()), (n, 0));
    }
}

#[test]
fn unselected_rows_have_no_effect() {
    let scene = MergeScene::uniform_cube(1500);
    let recipe = scene.recipe();
    let rows: Vec<u32> = (0..1500).filter(|row| row % 3 != 0).collect();
    let part = MergeScene {
        states: scene.states.pick(&rows),
        ids: rows.clone(),
        coverage: scene.coverage.clone(),
        visibility: scene.visibility.clone(),
        classes: vec![Some(0); rows.len()],
        extent: scene.extent,
    };
    let got = scene.merge_rows(&rows, &recipe, None, std::slice::from_ref(&scene.states.position));
    let expected = part.merge(&recipe, None);
    assert!(joins(&got) > 100 && got.proxies == expected.proxies);
    let named = |groups: &MergeGroups, id: &dyn Fn(u32) -> u32| -> Vec<Vec<u32>> {
        (0..groups.group_count()).map(|g| groups.members(g).iter().map(|&row| id(row)).collect()).collect()
    };
    assert_eq!(named(&got.groups, &|row| row), named(&expected.groups, &|row| rows[row as usize]));
}
