use std::collections::{BTreeMap, BTreeSet};

use super::oracle::{History, SlowLinker, rms_size, seen, slow_joined_tracks};
use super::*;
use crate::model::hash_id;
use crate::model::{Gaussians, opacity};

/// Source of uniform pseudo-random numbers in [0, 1) that follow from a seed.
struct UniformNumbers(u64);

impl UniformNumbers {
    fn unit(&mut self) -> f32 {
        self.0 += 1;
        (hash_id(self.0) >> 40) as f32 / (1u64 << 24) as f32
    }

    fn around(&mut self, middle: f32, width: f32) -> f32 {
        middle + width * (2.0 * self.unit() - 1.0)
    }

    fn order(&mut self, count: usize) -> Vec<u32> {
        let mut order: Vec<u32> = (0..count as u32).collect();
        (1..count).rev().for_each(|i| order.swap(i, (self.unit() * (i + 1) as f32) as usize % (i + 1)));
        order
    }
}

/// Returns `count` random Gaussians in a cube of side 1, with scales that vary around a common size. The size follows
/// from `crowd`: a cube with a side of twice this size holds about `crowd` Gaussians.
fn cloud(count: usize, crowd: f32, random: &mut UniformNumbers) -> Gaussians {
    let mut state = Gaussians::zeros(count, 1);
    let size = (crowd / count as f32).cbrt() * 0.5;
    for i in 0..count {
        state.position.set_row(i, [0; 3].map(|_| random.unit()));
        state.rotation.set_row(i, [0; 4].map(|_| random.around(0.0, 1.0)));
        state.log_scale.set_row(i, [0; 3].map(|_| random.around(size.ln(), 1.0)));
        state.opacity_logit.set_row(i, [random.around(0.0, 3.0)]);
        state.sh.set_row(i, [0; 3].map(|_| random.around(0.0, 1.5)));
    }
    state
}

/// Returns the Gaussians of `cloud` as they are `t` frames later. Gaussians with even and with odd indices move on
/// circles in opposite directions. Every coordinate jitters by up to `noise` times the size of the Gaussian.
fn later(cloud: &Gaussians, t: usize, noise: f32, random: &mut UniformNumbers) -> Gaussians {
    let mut state = cloud.clone();
    for i in 0..cloud.len() {
        let angle = 0.2 * t as f32 * if i % 2 == 0 { 1.0 } else { -1.0 };
        let size = rms_size(cloud, i) as f32;
        let [x, y, z] = cloud.position.row::<3>(i);
        let moved = [x + 0.05 * angle.cos(), y + 0.05 * angle.sin(), z];
        state.position.set_row(i, moved.map(|x| random.around(x, noise * size)));
    }
    state
}

/// Returns the Gaussians of `cloud` for which `is_present` holds, in random order, and their indices in `cloud`.
fn shuffled_part(
    cloud: &Gaussians,
    random: &mut UniformNumbers,
    is_present: impl Fn(u32) -> bool,
) -> (Gaussians, Vec<u32>) {
    let order: Vec<u32> = random.order(cloud.len()).into_iter().filter(|&i| is_present(i)).collect();
    (cloud.pick(&order), order)
}

#[test]
fn tracks_equal_those_of_the_slow_linker() {
    for (seed, crowd, alike) in [(1, 0.5, false), (2, 4.0, false), (3, 30.0, false), (4, 4.0, true)] {
        let mut random = UniformNumbers(seed * 1_000_000);
        let mut cloud = cloud(250, crowd, &mut random);
        // Some of these nearly identical Gaussians could be linked to several tracks.
        if alike {
            for i in 0..250 {
                let size = cloud.log_scale.plane(0)[0];
                cloud.rotation.set_row(i, [1.0, 0.0, 0.0, 0.0]);
                cloud.log_scale.set_row(i, [0; 3].map(|_| random.around(size, 0.05)));
                cloud.opacity_logit.set_row(i, [0.0]);
                cloud.sh.set_row(i, [0.0; 3]);
            }
        }
        let (mut linker, mut slow) = (Linker::default(), SlowLinker::default());
        let (mut linked, mut doubtful) = (0, 0);
        for t in 0..8 {
            let state = later(&cloud, t, 0.3, &mut random);
            // Every Gaussian is missing in some frames, different ones for each; a sixth of the Gaussians do not move.
            let is_away = |i: u32| (t as u32 + i).is_multiple_of(7) || (t as u32 + i) % 11 < 2;
            let mut state = state;
            (0..250).step_by(6).for_each(|i| state.position.set_row(i, cloud.position.row::<3>(i)));
            let (state, _) = shuffled_part(&state, &mut random, |i| !is_away(i));
            let found = linker.link(&state);
            assert_eq!(found.tracks, slow.link(&state), "frame {t}, crowd {crowd}");
            assert_eq!(linker.track_count(), slow.born);
            linked += found.linked;
            doubtful += found.doubtful;
        }
        assert!(linked > 300 && (doubtful > 0) == alike, "crowd {crowd}: {linked} links, {doubtful} in doubt");
    }
}

#[test]
fn shuffled_frames_with_noise_keep_their_tracks() {
    let mut random = UniformNumbers(77);
    let cloud = cloud(3000, 4.0, &mut random);
    let mut linker = Linker::default();
    let mut last: Option<Vec<u32>> = None;
    let (mut right, mut wrong) = (0, 0);
    for t in 0..20 {
        let (state, order) = shuffled_part(&later(&cloud, t, 0.02, &mut random), &mut random, |_| true);
        let tracks = linker.link(&state).tracks;
        let mut of_gaussian = vec![0; order.len()];
        order.iter().zip(&tracks).for_each(|(&i, &track)| of_gaussian[i as usize] = track);
        if let Some(last) = last.replace(of_gaussian.clone()) {
            let owners: BTreeSet<u32> = last.iter().copied().collect();
            for (before, now) in last.iter().zip(&of_gaussian) {
                right += usize::from(before == now);
                wrong += usize::from(before != now && owners.contains(now));
            }
        }
    }
    let all = 19 * 3000;
    assert!(right * 1000 >= 998 * all && wrong * 1000 <= all, "{right} right, {wrong} wrong of {all}");
}

#[test]
fn thread_count_does_not_change_links() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut random = UniformNumbers(5);
            let cloud = cloud(9000, 10.0, &mut random);
            let mut linker = Linker::default();
            let frames = (0..4)
                .map(|t| shuffled_part(&later(&cloud, t, 0.4, &mut random), &mut random, |i| i % 9 != t as u32).0);
            frames.map(|frame| linker.link(&frame)).collect::<Vec<_>>()
        })
    };
    let one = run(1);
    assert!(one[3].linked > 5000, "{}", one[3].linked);
    assert_eq!(run(2), one);
    assert_eq!(run(3), one);
}

#[test]
fn tracks_survive_a_gap_of_three_frames_but_not_four() {
    let mut random = UniformNumbers(9);
    let cloud = cloud(40, 0.1, &mut random);
    for (away, continues) in [(3, true), (4, false)] {
        let mut linker = Linker::default();
        for t in 0..3 + away + 1 {
            let mut state = cloud.clone();
            // Motion in a straight line by one size per frame: a Gaussian is only found at its expected position.
            let size = rms_size(&cloud, 0) as f32;
            let [x, y, z] = cloud.position.row::<3>(0);
            state.position.set_row(0, [x + t as f32 * size, y, z]);
            let is_away = (3..3 + away).contains(&t);
            let rows: Vec<u32> = (0..40).rev().filter(|&i| i > 0 || !is_away).collect();
            let tracks = linker.link(&state.pick(&rows)).tracks;
            if t == 3 + away {
                assert_eq!(tracks[39] == 39, continues, "{away} frames away");
                assert_eq!(linker.track_count(), if continues { 40 } else { 41 });
            }
        }
    }
}

#[test]
fn moving_everything_at_once_is_a_cut() {
    let mut random = UniformNumbers(11);
    let cloud = cloud(2000, 4.0, &mut random);
    let mut elsewhere = cloud.clone();
    elsewhere.position.planes_mut().iter_mut().for_each(|x| *x += 100.0);
    let other = self::cloud(2000, 4.0, &mut random);
    for next in [&elsewhere, &other] {
        let mut linker = Linker::default();
        linker.link(&cloud);
        assert!(!linker.link(&later(&cloud, 1, 0.02, &mut random)).is_cut);
        let found = linker.link(next);
        assert!(found.is_cut && found.linked == 0);
        assert_eq!(found.tracks, (2000..4000).collect::<Vec<u32>>());
        // No track from before the cut continues after it.
        assert!(linker.link(&cloud).is_cut);
    }
}

#[test]
fn empty_and_single_frames_are_linked() {
    let mut random = UniformNumbers(13);
    let cloud = cloud(30, 1.0, &mut random);
    let mut linker = Linker::default();
    assert!(linker.link(&Gaussians::zeros(0, 1)).tracks.is_empty());
    let first = linker.link(&cloud);
    assert_eq!((first.tracks, first.linked, first.is_cut), ((0..30).collect(), 0, false));
    assert_eq!(linker.link(&Gaussians::zeros(0, 1)).linked, 0);
    assert_eq!(linker.link(&cloud).repeated, 30, "a gap of one frame");
}

#[test]
fn crowds_at_one_place_are_linked_in_linear_time() {
    let count = 100_000;
    let mut random = UniformNumbers(17);
    let mut cloud = Gaussians::zeros(count, 0);
    (0..count).for_each(|i| cloud.sh.set_row(i, [0; 3].map(|_| random.around(0.0, 1.7))));
    let mut linker = Linker::default();
    linker.link(&cloud);
    let mut next = cloud.clone();
    next.sh.planes_mut().iter_mut().for_each(|x| *x += 1e-6);
    // Comparing every pair would take 10¹⁰ comparisons, more than a minute.
    let start = std::time::Instant::now();
    let found = linker.link(&next);
    assert!(start.elapsed().as_secs() < 20, "{:?}", start.elapsed());
    let right = found.tracks.iter().enumerate().filter(|&(i, &track)| i as u32 == track).count();
    assert!(right * 100 > 95 * count, "{right} of {count}");
    // Gaussians that are equal bit by bit are linked in their order.
    let same = Gaussians::zeros(count, 0);
    let mut linker = Linker::default();
    linker.link(&same);
    assert_eq!(linker.link(&same).tracks, (0..count as u32).collect::<Vec<_>>());
}

#[test]
fn gaussians_with_nan_continue_only_as_exact_repeats() {
    let mut random = UniformNumbers(19);
    let mut cloud = cloud(40, 1.0, &mut random);
    cloud.position.set_row(3, [f32::NAN, 0.0, f32::INFINITY]);
    cloud.log_scale.set_row(4, [f32::NAN; 3]);
    cloud.log_scale.set_row(5, [f32::INFINITY; 3]);
    cloud.rotation.set_row(6, [0.0; 4]);
    cloud.opacity_logit.set_row(7, [f32::NEG_INFINITY]);
    let mut linker = Linker::default();
    linker.link(&cloud);
    assert_eq!(linker.link(&cloud).repeated, 40);
    let mut next = cloud.clone();
    (0..40).for_each(|i| next.sh.set_row(i, cloud.sh.row::<3>(i).map(|x| x + 1e-4)));
    let tracks = linker.link(&next).tracks;
    let gone: Vec<usize> = (0..40).filter(|&i| tracks[i] != i as u32).collect();
    assert_eq!(gone, [3, 4]);
}

#[test]
fn kept_order_is_told_from_shuffled_order() {
    let mut random = UniformNumbers(23);
    let cloud = cloud(5000, 4.0, &mut random);
    let next = later(&cloud, 1, 0.02, &mut random);
    let kept = compare_order(&cloud, &next);
    assert!(
        kept.is_common
            && kept.position_difference < 2.0
            && kept.unrelated_position_difference > 5.0
            && kept.appearance_difference < 1e-6,
        "{kept:?}"
    );
    let (mixed, _) = shuffled_part(&next, &mut random, |_| true);
    let lost = compare_order(&cloud, &mixed);
    assert!(!lost.is_common && lost.position_difference > 5.0, "{lost:?}");
    // Each frame is sorted by position on its own, so equal indices denote near but unrelated Gaussians.
    let sorted = |state: &Gaussians| {
        let mut order: Vec<u32> = (0..5000).collect();
        order.sort_by(|&a, &b| state.position.plane(1)[a as usize].total_cmp(&state.position.plane(1)[b as usize]));
        state.pick(&order)
    };
    let sorted = compare_order(&sorted(&cloud), &sorted(&next));
    assert!(!sorted.is_common, "{sorted:?}");
    // Equal Gaussians, Gaussians at rest and very few Gaussians: nothing speaks against the order.
    let alike = Gaussians::zeros(100, 0);
    assert!(compare_order(&alike, &alike).is_common && compare_order(&cloud, &cloud).is_common);
    let few: Vec<u32> = (0..9).collect();
    assert!(compare_order(&cloud.pick(&few), &mixed.pick(&few)).is_common);
    assert!(compare_order(&Gaussians::zeros(0, 0), &Gaussians::zeros(0, 0)).is_common);
}

/// Returns `frames` frames of `cloud`. Each frame is a pair: its Gaussians in random order, and their indices in
/// `cloud`.
///
/// Each Gaussian is visible in periods of `shortest` to `shortest` + 4 frames. After a period it fades out over
/// `overlap` frames, while the next period fades in. After one period in seven there is a gap. Colors vary by `tint`
/// between periods.
fn fading_frames(
    cloud: &Gaussians,
    frames: usize,
    shortest: usize,
    overlap: usize,
    tint: f32,
    random: &mut UniformNumbers,
) -> Vec<(Gaussians, Vec<u32>)> {
    let mut rows: Vec<Vec<(u32, f32, [f32; 3])>> = vec![Vec::new(); frames];
    for i in 0..cloud.len() as u32 {
        let mut begins = 0;
        while begins < frames {
            let (length, tint) = (shortest + (5.0 * random.unit()) as usize, [0; 3].map(|_| random.around(0.0, tint)));
            for age in 0..length + overlap {
                let frame = begins + age;
                let fades_in = if begins == 0 { 1.0 } else { (age + 1) as f32 / (overlap + 1) as f32 };
                let fades_out = (length + overlap - age) as f32 / (overlap + 1) as f32;
                if frame < frames {
                    rows[frame].push((i, fades_in.min(fades_out).min(1.0), tint));
                }
            }
            begins += if random.unit() < 1.0 / 7.0 { 3 * length } else { length };
        }
    }
    let of_frame = |(t, rows): (usize, Vec<(u32, f32, [f32; 3])>)| {
        let ids: Vec<u32> = rows.iter().map(|row| row.0).collect();
        let mut state = later(cloud, t, 0.02, random).pick(&ids);
        for (at, (_, part, tint)) in rows.into_iter().enumerate() {
            let alpha = 1.0 - (1.0 - opacity(state.opacity_logit.plane(0)[at])).powf(f64::from(part));
            state.opacity_logit.set_row(at, [(alpha / (1.0 - alpha)).ln() as f32]);
            let [r, g, b] = state.sh.row::<3>(at);
            state.sh.set_row(at, [r + tint[0], g + tint[1], b + tint[2]]);
        }
        let order = random.order(ids.len());
        (state.pick(&order), order.iter().map(|&at| ids[at as usize]).collect())
    };
    rows.into_iter().enumerate().map(of_frame).collect()
}

#[test]
fn joined_tracks_equal_those_of_the_slow_joiner() {
    for (seed, shortest, overlap, tint) in
        [(21, 6, 2, 0.05), (22, 6, 0, 0.8), (23, 6, 3, 0.5), (24, 6, 5, 0.05), (25, 4, 2, 0.05)]
    {
        let mut random = UniformNumbers(seed * 1_000_000);
        // Sparse, because the grid does not visit all Gaussians of a crowded cell, as the slow implementation does.
        let cloud = cloud(120, 0.03, &mut random);
        let frames = fading_frames(&cloud, 24, shortest, overlap, tint, &mut random);
        let (mut linker, mut joiner) = (Linker::default(), Joiner::default());
        let (mut history, mut in_doubt, mut succeeded) = (History::new(), BTreeSet::new(), BTreeSet::new());
        for (t, (state, _)) in frames.iter().enumerate() {
            let linked = linker.link(state);
            joiner.add_frame(&linker);
            let doubted = linker.open_tracks().iter().filter(|track| track.is_in_doubt);
            in_doubt.extend(doubted.map(|track| track.number));
            let over = linker.open_tracks().iter().filter(|track| track.is_succeeded);
            succeeded.extend(over.map(|track| (t, track.number)));
            history.resize(linker.track_count() as usize, BTreeMap::new());
            for (at, &track) in linked.tracks.iter().enumerate() {
                history[track as usize].insert(t, seen(state, at));
            }
        }
        let [alike, close] = joiner.finish(&linker);
        for ((joined_tracks, count), rule) in [(&alike, (4.0, 0.0625)), (&close, (1.0, 1.0))] {
            assert!(
                *joined_tracks == slow_joined_tracks(&history, &in_doubt, &succeeded, frames.len(), rule),
                "overlap {overlap}, {rule:?}"
            );
            assert_eq!(*count, 1 + *joined_tracks.iter().max().unwrap() as usize);
        }
        let joined = history.len() - alike.1;
        assert!(overlap > 4 || joined > 100, "overlap {overlap}: {joined} joined");
    }
}

#[test]
fn fading_tracks_are_joined_and_others_are_not() {
    // In the second case, periods are so short that a Gaussian that fades out is linked to the one that fades in two
    // periods later.
    for (shortest, most) in [(6, 300), (4, 395)] {
        let mut random = UniformNumbers(31);
        let cloud = cloud(200, 1.0, &mut random);
        let frames = fading_frames(&cloud, 30, shortest, 2, 0.05, &mut random);
        let (mut linker, mut joiner) = (Linker::default(), Joiner::default());
        let mut owners: Vec<BTreeSet<u32>> = Vec::new();
        for (state, ids) in &frames {
            let linked = linker.link(state);
            joiner.add_frame(&linker);
            owners.resize(linker.track_count() as usize, BTreeSet::new());
            for (&track, &i) in linked.tracks.iter().zip(ids) {
                owners[track as usize].insert(i);
            }
        }
        let [(joined_tracks, count), _] = joiner.finish(&linker);
        let mut owners_of_joined = vec![BTreeSet::<u32>::new(); count];
        joined_tracks.iter().zip(&owners).for_each(|(&joined, who)| owners_of_joined[joined as usize].extend(who));
        let mixed = owners_of_joined.iter().filter(|who| who.len() > 1).count();
        println!("{} tracks are {count} joined tracks, {mixed} mixed", owners.len());
        assert!(owners.len() > 2 * count && count < most, "{} tracks are {count} joined tracks", owners.len());
        assert!(mixed * 20 < count, "{mixed} of {count} joined tracks are of several Gaussians");
    }
}

#[test]
fn blend_follows_its_formula() {
    let mut random = UniformNumbers(41);
    let state = cloud(6, 1.0, &mut random);
    let rows = [4, 1, 3];
    let mut blended = state.clone();
    blend_rows(&mut blended, &rows);
    let alphas = rows.map(|i| opacity(state.opacity_logit.plane(0)[i]));
    let near = |found: f32, expected: f64| assert!((f64::from(found) - expected).abs() < 1e-5, "{found}, {expected}");
    near(opacity(blended.opacity_logit.plane(0)[4]) as f32, 1.0 - alphas.iter().map(|a| 1.0 - a).product::<f64>());
    let mean = |values: [f64; 3]| (0..3).map(|k| alphas[k] * values[k]).sum::<f64>() / alphas.iter().sum::<f64>();
    for c in 0..3 {
        near(blended.position.plane(c)[4], mean(rows.map(|i| f64::from(state.position.plane(c)[i]))));
        near(blended.log_scale.plane(c)[4], mean(rows.map(|i| f64::from(state.log_scale.plane(c)[i]))));
    }
    let turned = |i: usize| {
        let (own, other) = (state.rotation.row::<4>(4), state.rotation.row::<4>(i));
        let dot: f32 = (0..4).map(|c| own[c] * other[c]).sum();
        other.map(|x| f64::from(x * dot.signum()))
    };
    let rotations = rows.map(turned);
    (0..4).for_each(|c| near(blended.rotation.plane(c)[4], mean([0, 1, 2].map(|k| rotations[k][c]))));
    for c in 0..state.sh.width() {
        near(blended.sh.plane(c)[4], mean(rows.map(|i| f64::from(state.sh.plane(c)[i]))));
    }
    let others: Vec<u32> = vec![0, 1, 2, 3, 5];
    assert!(blended.pick(&others) == state.pick(&others));
    // Nearly opaque, nearly transparent, and invisible Gaussians.
    for (logits, expected) in [([30.0, 30.0], 60.0), ([-30.0, -30.0], -30.0 + 2f32.ln()), ([50.0, -50.0], 50.0)] {
        let mut pair = state.pick(&[0, 1]);
        logits.iter().enumerate().for_each(|(i, &logit)| pair.opacity_logit.set_row(i, [logit]));
        blend_rows(&mut pair, &[0, 1]);
        near(pair.opacity_logit.plane(0)[0], f64::from(expected));
    }
    let mut gone = state.pick(&[0, 1]);
    (0..2).for_each(|i| gone.opacity_logit.set_row(i, [f32::NEG_INFINITY]));
    let before = gone.clone();
    blend_rows(&mut gone, &[0, 1]);
    assert!(gone == before, "invisible Gaussians must not change");
}
