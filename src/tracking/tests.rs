use std::collections::{BTreeMap, BTreeSet};

use super::*;
use crate::model::hash_id;
use crate::model::{Gaussians, SH_C0, opacity};

/// Even numbers in [0, 1) that follow from a seed.
struct Dice(u64);

impl Dice {
    fn roll(&mut self) -> f32 {
        self.0 += 1;
        (hash_id(self.0) >> 40) as f32 / (1u64 << 24) as f32
    }

    fn around(&mut self, middle: f32, width: f32) -> f32 {
        middle + width * (2.0 * self.roll() - 1.0)
    }

    fn order(&mut self, count: usize) -> Vec<u32> {
        let mut order: Vec<u32> = (0..count as u32).collect();
        (1..count).rev().for_each(|i| order.swap(i, (self.roll() * (i + 1) as f32) as usize % (i + 1)));
        order
    }
}

/// A cloud in a cube of side 1 in which about `crowd` lie within the largest scale of each.
fn cloud(count: usize, crowd: f32, dice: &mut Dice) -> Gaussians {
    let mut state = Gaussians::zeros(count, 1);
    let size = (crowd / count as f32).cbrt() * 0.5;
    for i in 0..count {
        state.position.set_row(i, [0; 3].map(|_| dice.roll()));
        state.rotation.set_row(i, [0; 4].map(|_| dice.around(0.0, 1.0)));
        state.log_scale.set_row(i, [0; 3].map(|_| dice.around(size.ln(), 1.0)));
        state.opacity_logit.set_row(i, [dice.around(0.0, 3.0)]);
        state.sh.set_row(i, [0; 3].map(|_| dice.around(0.0, 1.5)));
    }
    state
}

fn rms_size(state: &Gaussians, i: usize) -> f64 {
    let squares = state.log_scale.row::<3>(i).map(|log| (2.0 * f64::from(log)).exp());
    (squares.iter().sum::<f64>() / 3.0).sqrt()
}

/// The cloud `t` frames later: each half of it moves on a circle, and all tremble by `noise` of their size.
fn later(cloud: &Gaussians, t: usize, noise: f32, dice: &mut Dice) -> Gaussians {
    let mut state = cloud.clone();
    for i in 0..cloud.len() {
        let angle = 0.2 * t as f32 * if i % 2 == 0 { 1.0 } else { -1.0 };
        let size = rms_size(cloud, i) as f32;
        let [x, y, z] = cloud.position.row::<3>(i);
        let moved = [x + 0.05 * angle.cos(), y + 0.05 * angle.sin(), z];
        state.position.set_row(i, moved.map(|x| dice.around(x, noise * size)));
    }
    state
}

/// What the documentation of the module says, pair by pair, in f64.
#[derive(Default)]
struct Slow {
    tracks: Vec<SlowTrack>,
    born: u32,
}

struct SlowTrack {
    number: u32,
    ago: f64,
    velocity: Option<[f64; 3]>,
    seen: Seen,
    is_succeeded: bool,
}

#[derive(Clone)]
struct Seen {
    at: [f64; 3],
    size: f64,
    shape: [[f64; 3]; 3],
    opacity: f64,
    color: [f64; 3],
    bits: Vec<u32>,
}

fn seen(state: &Gaussians, i: usize) -> Seen {
    let [w, x, y, z] = {
        let q = state.rotation.row::<4>(i).map(f64::from);
        let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
        q.map(|x| x / length)
    };
    // Columns: what the quaternion makes of the axes.
    let r = glam::DMat3::from_quat(glam::DQuat::from_xyzw(x, y, z, w));
    let variance = state.log_scale.row::<3>(i).map(|log| (2.0 * f64::from(log)).exp());
    let covariance = r * glam::DMat3::from_diagonal(variance.into()) * r.transpose();
    let trace: f64 = variance.iter().sum();
    let columns = (covariance * trace.recip()).to_cols_array_2d();
    let bits = |values: &[f32]| values.iter().map(|x| x.to_bits()).collect::<Vec<u32>>();
    Seen {
        at: state.position.row::<3>(i).map(f64::from),
        size: rms_size(state, i),
        shape: columns,
        opacity: opacity(state.opacity_logit.plane(0)[i]),
        color: state.sh.row::<3>(i).map(|dc| 0.5 + SH_C0 * f64::from(dc)),
        bits: [
            bits(&state.position.row::<3>(i)),
            bits(&state.rotation.row::<4>(i)),
            bits(&state.log_scale.row::<3>(i)),
            bits(&state.opacity_logit.row::<1>(i)),
            bits(&state.sh.row::<3>(i)),
        ]
        .concat(),
    }
}

/// How different both look, opacities aside.
fn unlike(a: &Seen, b: &Seen) -> f64 {
    let shape: f64 = (0..9).map(|k| (b.shape[k / 3][k % 3] - a.shape[k / 3][k % 3]).powi(2)).sum();
    let color: f64 = (0..3).map(|c| (b.color[c] - a.color[c]).powi(2)).sum();
    let size = (b.size / a.size).ln() / 2f64.sqrt().ln();
    size * size + shape / 0.25f64.powi(2) + color / 0.1f64.powi(2)
}

fn is_near_duplicate(a: &Seen, b: &Seen) -> bool {
    let distance: f64 = (0..3).map(|c| (b.at[c] - a.at[c]).powi(2)).sum();
    distance / (0.25 * a.size.min(b.size)).powi(2) + 4.0 * unlike(a, b) <= 1.0
}

impl SlowTrack {
    fn cost(&self, b: &Seen, r: f64, q: f64) -> f64 {
        let v = self.velocity.unwrap_or_default();
        let speed = v.iter().map(|v| v * v).sum::<f64>().sqrt();
        let u = self.seen.size + (0.5 * self.ago * speed).min(3.0 * self.seen.size);
        let distance: f64 = (0..3).map(|c| (b.at[c] - self.seen.at[c] - self.ago * v[c]).powi(2)).sum();
        distance / (r * u).powi(2) + q * (unlike(&self.seen, b) + ((b.opacity - self.seen.opacity) / 0.5).powi(2))
    }
}

impl Slow {
    /// Of every track that a round has linked the chance that it is wrong.
    fn chances(
        by_track: &[(f64, usize, usize)],
        of_track: &BTreeMap<usize, usize>,
        taken: &BTreeMap<usize, usize>,
        cost: impl Fn(usize, usize) -> f64,
        are_twins: impl Fn(usize, usize, Option<usize>, Option<usize>) -> bool,
    ) -> Vec<(f64, usize)> {
        let linked: BTreeMap<usize, usize> =
            by_track.iter().filter_map(|&(_, a, _)| of_track.get(&a).map(|&b| (a, b))).collect();
        let rivals: Vec<_> = by_track.iter().filter(|(_, a, b)| of_track.get(a) != Some(b)).collect();
        let strangers = rivals.iter().filter(|(_, a, _)| linked.contains_key(a)).count();
        let crowd = strangers as f64 / linked.len().max(1) as f64;
        let chance = |(&a, &b): (&usize, &usize)| {
            let mut most = 0f64;
            for &&(named, c, d) in rivals.iter().filter(|(_, c, d)| *c == a || *d == b) {
                if are_twins(c, d, linked.get(&c).copied(), taken.get(&d).copied()) {
                    continue;
                }
                let (now, swapped) = match (linked.get(&c), taken.get(&d)) {
                    (Some(&own), Some(&other)) => (cost(c, own) + cost(other, d), named + cost(other, own).min(1.0)),
                    (Some(&own), None) => (cost(c, own), named),
                    (None, Some(&other)) => (cost(other, d), named),
                    (None, None) => continue,
                };
                most = most.max((now + 1e-6) / (swapped + 1e-6));
            }
            let by_rivals = most.powi(5) / (1.0 + most.powi(5));
            ((0.25 * crowd * cost(a, b).powf(1.5)).min(0.5).max(by_rivals), a)
        };
        linked.iter().map(chance).collect()
    }

    fn link(&mut self, state: &Gaussians) -> Vec<u32> {
        let all: Vec<Seen> = (0..state.len()).map(|i| seen(state, i)).collect();
        let mut of_track: BTreeMap<usize, usize> = BTreeMap::new();
        let mut taken: BTreeMap<usize, usize> = BTreeMap::new();
        for (a, track) in self.tracks.iter().enumerate() {
            let free = |b: &usize| !taken.contains_key(b) && all[*b].bits == track.seen.bits;
            if let Some(b) = (0..all.len()).find(free) {
                of_track.insert(a, b);
                taken.insert(b, a);
            }
        }
        let mut chances: Vec<(f64, usize)> = Vec::new();
        for (r, q, missing) in [(0.25, 4.0, false), (1.0, 1.0, true), (4.0, 4.0, true)] {
            let cost = |a: usize, b: usize| self.tracks[a].cost(&all[b], r, q);
            let mut offers: Vec<(f64, usize, usize)> = Vec::new();
            for (a, track) in self.tracks.iter().enumerate() {
                if of_track.contains_key(&a) || (track.ago > 1.0 && (!missing || track.is_succeeded)) {
                    continue;
                }
                let free = (0..all.len()).filter(|b| !taken.contains_key(b));
                let mut own: Vec<(f64, usize, usize)> = free.map(|b| (cost(a, b), a, b)).collect();
                own.retain(|offer| offer.0 <= 1.0);
                own.sort_by(|x, y| x.partial_cmp(y).unwrap());
                offers.extend(own.into_iter().take(4));
            }
            let by_track = offers.clone();
            offers.sort_by(|x, y| x.partial_cmp(y).unwrap());
            for (_, a, b) in offers {
                if !of_track.contains_key(&a) && !taken.contains_key(&b) {
                    of_track.insert(a, b);
                    taken.insert(b, a);
                }
            }
            for _ in 0..4 {
                for &(named, a, b) in &by_track {
                    let (Some(&own), Some(&other)) = (of_track.get(&a), taken.get(&b)) else { continue };
                    let theirs = cost(other, own);
                    if other != a && theirs <= 1.0 && named + theirs < cost(a, own) + cost(other, b) {
                        of_track.extend([(a, b), (other, own)]);
                        taken.extend([(b, a), (own, other)]);
                    }
                }
            }
            let twins = |a: usize, b: usize| is_near_duplicate(&self.tracks[a].seen, &self.tracks[b].seen);
            let are_twins = |c, d, own: Option<usize>, other: Option<usize>| {
                other.is_some_and(|e| twins(c, e)) || own.is_some_and(|b: usize| is_near_duplicate(&all[b], &all[d]))
            };
            chances.extend(Self::chances(&by_track, &of_track, &taken, cost, are_twins));
        }
        // Until no more than one in two hundred is expected to be wrong.
        chances.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.1.cmp(&y.1)));
        let mut wrong: f64 = chances.iter().map(|(chance, _)| chance).sum();
        for (chance, a) in chances {
            if wrong <= 0.005 * of_track.len() as f64 {
                break;
            }
            of_track.remove(&a);
            wrong -= chance;
        }
        let mut numbers = vec![u32::MAX; all.len()];
        for (a, track) in self.tracks.iter_mut().enumerate() {
            let Some(&b) = of_track.get(&a) else {
                if track.ago == 1.0 {
                    let v = track.velocity.unwrap_or_default();
                    let expected = Seen { at: [0, 1, 2].map(|c| track.seen.at[c] + v[c]), ..track.seen.clone() };
                    track.is_succeeded = all.iter().any(|other| {
                        let distance: f64 = (0..3).map(|c| (other.at[c] - expected.at[c]).powi(2)).sum();
                        let unit = 0.25 * other.size.min(expected.size);
                        distance / unit.powi(2) + unlike(&expected, other) <= 1.0
                    });
                }
                track.ago += 1.0;
                continue;
            };
            numbers[b] = track.number;
            let step: [f64; 3] = std::array::from_fn(|c| (all[b].at[c] - track.seen.at[c]) / track.ago);
            let velocity = track.velocity.map(|v| std::array::from_fn(|c| 0.5 * (v[c] + step[c])));
            (track.velocity, track.seen, track.ago) = (velocity.or(Some(step)), all[b].clone(), 1.0);
            track.is_succeeded = false;
        }
        self.tracks.retain(|track| track.ago <= 4.0);
        for b in 0..all.len() {
            if numbers[b] == u32::MAX {
                numbers[b] = self.born;
                let seen = all[b].clone();
                let (number, ago, velocity) = (self.born, 1.0, None);
                self.tracks.push(SlowTrack { number, ago, velocity, seen, is_succeeded: false });
                self.born += 1;
            }
        }
        numbers
    }
}

/// A frame of `cloud`, of those that `lives` lets live, in any order; gives the order too.
fn shuffled(cloud: &Gaussians, dice: &mut Dice, lives: impl Fn(u32) -> bool) -> (Gaussians, Vec<u32>) {
    let order: Vec<u32> = dice.order(cloud.len()).into_iter().filter(|&i| lives(i)).collect();
    (cloud.pick(&order), order)
}

#[test]
fn tracks_are_those_of_every_pair_compared() {
    for (seed, crowd, alike) in [(1, 0.5, false), (2, 4.0, false), (3, 30.0, false), (4, 4.0, true)] {
        let mut dice = Dice(seed * 1_000_000);
        let mut cloud = cloud(250, crowd, &mut dice);
        // Of those that look nearly alike, some could be any.
        if alike {
            for i in 0..250 {
                let size = cloud.log_scale.plane(0)[0];
                cloud.rotation.set_row(i, [1.0, 0.0, 0.0, 0.0]);
                cloud.log_scale.set_row(i, [0; 3].map(|_| dice.around(size, 0.05)));
                cloud.opacity_logit.set_row(i, [0.0]);
                cloud.sh.set_row(i, [0.0; 3]);
            }
        }
        let (mut linker, mut slow) = (Linker::default(), Slow::default());
        let (mut linked, mut doubtful) = (0, 0);
        for t in 0..8 {
            let state = later(&cloud, t, 0.3, &mut dice);
            // Every Gaussian is away for some frames of its own; a sixth does not move at all.
            let is_away = |i: u32| (t as u32 + i).is_multiple_of(7) || (t as u32 + i) % 11 < 2;
            let mut state = state;
            (0..250).step_by(6).for_each(|i| state.position.set_row(i, cloud.position.row::<3>(i)));
            let (state, _) = shuffled(&state, &mut dice, |i| !is_away(i));
            let found = linker.link(&state);
            assert_eq!(found.tracks, slow.link(&state), "frame {t}, crowd {crowd}");
            assert_eq!(linker.tracks(), slow.born);
            linked += found.linked;
            doubtful += found.doubtful;
        }
        assert!(linked > 300 && (doubtful > 0) == alike, "crowd {crowd}: {linked} links, {doubtful} in doubt");
    }
}

#[test]
fn permuted_frames_with_noise_keep_their_tracks() {
    let mut dice = Dice(77);
    let cloud = cloud(3000, 4.0, &mut dice);
    let mut linker = Linker::default();
    let mut last: Option<Vec<u32>> = None;
    let (mut right, mut wrong) = (0, 0);
    for t in 0..20 {
        let (state, order) = shuffled(&later(&cloud, t, 0.02, &mut dice), &mut dice, |_| true);
        let tracks = linker.link(&state).tracks;
        let mut of_gaussian = vec![0; order.len()];
        order.iter().zip(&tracks).for_each(|(&i, &track)| of_gaussian[i as usize] = track);
        if let Some(last) = last.replace(of_gaussian.clone()) {
            let whose: BTreeSet<u32> = last.iter().copied().collect();
            for (before, now) in last.iter().zip(&of_gaussian) {
                right += usize::from(before == now);
                wrong += usize::from(before != now && whose.contains(now));
            }
        }
    }
    let all = 19 * 3000;
    assert!(right * 1000 >= 998 * all && wrong * 1000 <= all, "{right} right, {wrong} wrong of {all}");
}

#[test]
fn threads_change_nothing() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut dice = Dice(5);
            let cloud = cloud(9000, 10.0, &mut dice);
            let mut linker = Linker::default();
            let frames =
                (0..4).map(|t| shuffled(&later(&cloud, t, 0.4, &mut dice), &mut dice, |i| i % 9 != t as u32).0);
            frames.map(|frame| linker.link(&frame)).collect::<Vec<_>>()
        })
    };
    let one = run(1);
    assert!(one[3].linked > 5000, "{}", one[3].linked);
    assert_eq!(run(2), one);
    assert_eq!(run(3), one);
}

#[test]
fn a_track_goes_on_after_three_frames_and_ends_after_four() {
    let mut dice = Dice(9);
    let cloud = cloud(40, 0.1, &mut dice);
    for (away, goes_on) in [(3, true), (4, false)] {
        let mut linker = Linker::default();
        for t in 0..3 + away + 1 {
            let mut state = cloud.clone();
            // In a straight line, by its size in each frame: only where it is expected it is found again.
            let size = rms_size(&cloud, 0) as f32;
            let [x, y, z] = cloud.position.row::<3>(0);
            state.position.set_row(0, [x + t as f32 * size, y, z]);
            let is_away = (3..3 + away).contains(&t);
            let rows: Vec<u32> = (0..40).rev().filter(|&i| i > 0 || !is_away).collect();
            let tracks = linker.link(&state.pick(&rows)).tracks;
            if t == 3 + away {
                assert_eq!(tracks[39] == 39, goes_on, "{away} frames away");
                assert_eq!(linker.tracks(), if goes_on { 40 } else { 41 });
            }
        }
    }
}

#[test]
fn everything_moving_at_once_is_a_cut_and_begins_new_tracks() {
    let mut dice = Dice(11);
    let cloud = cloud(2000, 4.0, &mut dice);
    let mut elsewhere = cloud.clone();
    elsewhere.position.planes_mut().iter_mut().for_each(|x| *x += 100.0);
    let other = self::cloud(2000, 4.0, &mut dice);
    for next in [&elsewhere, &other] {
        let mut linker = Linker::default();
        linker.link(&cloud);
        assert!(!linker.link(&later(&cloud, 1, 0.02, &mut dice)).is_cut);
        let found = linker.link(next);
        assert!(found.is_cut && found.linked == 0);
        assert_eq!(found.tracks, (2000..4000).collect::<Vec<u32>>());
        // Nothing of before the cut goes on after it.
        assert!(linker.link(&cloud).is_cut);
    }
}

#[test]
fn frames_without_gaussians_and_alone_are_linked() {
    let mut dice = Dice(13);
    let cloud = cloud(30, 1.0, &mut dice);
    let mut linker = Linker::default();
    assert!(linker.link(&Gaussians::zeros(0, 1)).tracks.is_empty());
    let first = linker.link(&cloud);
    assert_eq!((first.tracks, first.linked, first.is_cut), ((0..30).collect(), 0, false));
    assert_eq!(linker.link(&Gaussians::zeros(0, 1)).linked, 0);
    assert_eq!(linker.link(&cloud).repeated, 30, "a gap of one frame");
}

#[test]
fn thousands_at_one_place_are_linked_without_comparing_all() {
    let count = 100_000;
    let mut dice = Dice(17);
    let mut cloud = Gaussians::zeros(count, 0);
    (0..count).for_each(|i| cloud.sh.set_row(i, [0; 3].map(|_| dice.around(0.0, 1.7))));
    let mut linker = Linker::default();
    linker.link(&cloud);
    let mut next = cloud.clone();
    next.sh.planes_mut().iter_mut().for_each(|x| *x += 1e-6);
    // Every pair: 10¹⁰ comparisons, a minute and more.
    let start = std::time::Instant::now();
    let found = linker.link(&next);
    assert!(start.elapsed().as_secs() < 20, "{:?}", start.elapsed());
    let right = found.tracks.iter().enumerate().filter(|&(i, &track)| i as u32 == track).count();
    assert!(right * 100 > 95 * count, "{right} of {count}");
    // All the same to the bit: by their order.
    let same = Gaussians::zeros(count, 0);
    let mut linker = Linker::default();
    linker.link(&same);
    assert_eq!(linker.link(&same).tracks, (0..count as u32).collect::<Vec<_>>());
}

#[test]
fn what_is_not_a_number_goes_on_only_if_it_repeats() {
    let mut dice = Dice(19);
    let mut cloud = cloud(40, 1.0, &mut dice);
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
fn order_is_believed_where_it_holds_and_not_where_it_was_shuffled() {
    let mut dice = Dice(23);
    let cloud = cloud(5000, 4.0, &mut dice);
    let next = later(&cloud, 1, 0.02, &mut dice);
    let kept = identity(&cloud, &next);
    assert!(kept.holds && kept.moved < 2.0 && kept.apart > 5.0 && kept.unlike < 1e-6, "{kept:?}");
    let (mixed, _) = shuffled(&next, &mut dice, |_| true);
    let lost = identity(&cloud, &mixed);
    assert!(!lost.holds && lost.moved > 5.0, "{lost:?}");
    // Sorted by where they lie, each frame by itself: near, but strangers.
    let sorted = |state: &Gaussians| {
        let mut order: Vec<u32> = (0..5000).collect();
        order.sort_by(|&a, &b| state.position.plane(1)[a as usize].total_cmp(&state.position.plane(1)[b as usize]));
        state.pick(&order)
    };
    let sorted = identity(&sorted(&cloud), &sorted(&next));
    assert!(!sorted.holds, "{sorted:?}");
    // All alike, all still, a few: nothing speaks against the order.
    let alike = Gaussians::zeros(100, 0);
    assert!(identity(&alike, &alike).holds && identity(&cloud, &cloud).holds);
    let few: Vec<u32> = (0..9).collect();
    assert!(identity(&cloud.pick(&few), &mixed.pick(&few)).holds);
    assert!(identity(&Gaussians::zeros(0, 0), &Gaussians::zeros(0, 0)).holds);
}

/// Where each track was, frame by frame.
type History = Vec<BTreeMap<usize, Seen>>;

/// Where a track is, seen or not, at a frame after its first.
fn place(track: &BTreeMap<usize, Seen>, frame: usize) -> ([f64; 3], usize) {
    let seen: Vec<(&usize, &Seen)> = track.range(..=frame).collect();
    let mut velocity: Option<[f64; 3]> = None;
    for pair in seen.windows(2) {
        let step: [f64; 3] =
            std::array::from_fn(|c| (pair[1].1.at[c] - pair[0].1.at[c]) / (pair[1].0 - pair[0].0) as f64);
        velocity = Some(velocity.map_or(step, |v| std::array::from_fn(|c| 0.5 * (v[c] + step[c]))));
    }
    let (&last, at) = seen[seen.len() - 1];
    let v = velocity.unwrap_or_default();
    (std::array::from_fn(|c| at.at[c] + (frame - last) as f64 * v[c]), frame - last)
}

/// What the documentation of the module says of lives, pair by pair, in f64.
fn slow_lives(
    tracks: &History,
    in_doubt: &BTreeSet<u32>,
    succeeded: &BTreeSet<(usize, u32)>,
    frames: usize,
    (r, q): (f64, f64),
) -> Vec<u32> {
    let cost = |a: &Seen, at: [f64; 3], b: &Seen, (r, q): (f64, f64)| {
        let distance: f64 = (0..3).map(|c| (at[c] - b.at[c]).powi(2)).sum();
        let is_of_its_size = a.size.max(b.size) <= 2f64.sqrt() * a.size.min(b.size);
        let cost = distance / (r * a.size.min(b.size)).powi(2) + q * unlike(a, b);
        if is_of_its_size { cost } else { f64::INFINITY }
    };
    let first = |track: usize| *tracks[track].keys().next().unwrap();
    let is_gone = |track: usize, frame: usize| frame > tracks[track].keys().last().unwrap() + GAP as usize;
    let looked = |track: usize, frame: usize| tracks[track].range(..=frame).last().unwrap().1;
    let mut from: Vec<Option<usize>> = vec![None; tracks.len()];
    let mut goes_on = vec![false; tracks.len()];
    // By track and cost: the other, frames together, whether they are twins, whether the other has ended.
    let mut pairs: BTreeMap<(usize, u64), (usize, usize, bool, bool)> = BTreeMap::new();
    let settle = |pairs: &mut BTreeMap<(usize, u64), (usize, usize, bool, bool)>,
                  from: &mut Vec<Option<usize>>,
                  goes_on: &mut Vec<bool>| loop {
        let mut firsts: BTreeMap<usize, (u64, usize, bool)> = BTreeMap::new();
        for (&(b, cost), &(a, _, _, ended)) in pairs.iter() {
            firsts.entry(b).or_insert((cost, a, ended));
        }
        let mut ended: Vec<(u64, usize, usize)> =
            firsts.into_iter().filter(|(_, (_, _, ended))| *ended).map(|(b, (cost, a, _))| (cost, b, a)).collect();
        ended.sort_unstable();
        for &(_, b, a) in &ended {
            if !goes_on[a] {
                (from[b], goes_on[a]) = (Some(a), true);
            }
        }
        pairs.retain(|&(b, _), (a, _, _, has_ended)| from[b].is_none() && !(*has_ended && goes_on[*a]));
        if ended.is_empty() {
            return;
        }
    };
    for frame in 0..frames {
        let mut within = Vec::new();
        pairs.retain(|&(b, _), (a, together, twins, ended)| {
            if is_gone(*a, frame) {
                *ended = true;
                return true;
            }
            if is_gone(b, frame) {
                if *twins {
                    within.push((b, *a));
                }
                return false;
            }
            let (Some(seen_a), Some(seen_b)) = (tracks[*a].get(&frame), tracks[b].get(&frame)) else {
                *together = together.saturating_sub(1);
                return true;
            };
            *together += 1;
            *twins &= cost(seen_a, seen_a.at, seen_b, (1.0, 1.0)) <= 1.0;
            *together <= 4 && cost(seen_a, seen_a.at, seen_b, (r, q)) <= 1.0
        });
        for (b, a) in within {
            from[b] = from[b].or(Some(a));
        }
        pairs.retain(|&(b, _), _| from[b].is_none());
        settle(&mut pairs, &mut from, &mut goes_on);
        for b in (0..tracks.len()).filter(|&b| first(b) == frame) {
            let own = &tracks[b][&frame];
            let mut named = Vec::new();
            let may_be = |&a: &usize| first(a) < frame && !succeeded.contains(&(frame, a as u32));
            for a in (0..tracks.len()).filter(may_be) {
                let (at, missing) = place(&tracks[a], frame);
                let look = looked(a, frame);
                let all = cost(look, at, own, (r, q));
                if missing <= GAP as usize && all <= 1.0 {
                    let twins = cost(look, at, own, (1.0, 1.0)) <= 1.0;
                    named.push((all.to_bits(), (a, usize::from(missing == 0), twins, false)));
                }
            }
            named.sort_unstable();
            named.truncate(4);
            named.retain(|&(_, (_, _, twins, _))| twins || !in_doubt.contains(&(b as u32)));
            pairs.extend(named.into_iter().map(|(cost, pair)| ((b, cost), pair)));
        }
    }
    pairs.retain(|_, (a, _, twins, ended)| {
        *ended = *twins || is_gone(*a, frames - 1) || !tracks[*a].contains_key(&(frames - 1));
        *ended
    });
    settle(&mut pairs, &mut from, &mut goes_on);
    let (mut lives, mut count) = (Vec::<u32>::new(), 0);
    for from in from {
        lives.push(from.map_or(count, |a| lives[a]));
        count += u32::from(from.is_none());
    }
    lives
}

/// Frames of a cloud whose Gaussians live for `shortest` to `shortest` + 4 frames at a time, and fade over `overlap` of them;
/// every life has colors of its own, and there is a seventh that nothing follows on.
fn fading(
    cloud: &Gaussians,
    frames: usize,
    shortest: usize,
    overlap: usize,
    tint: f32,
    dice: &mut Dice,
) -> Vec<(Gaussians, Vec<u32>)> {
    let mut rows: Vec<Vec<(u32, f32, [f32; 3])>> = vec![Vec::new(); frames];
    for i in 0..cloud.len() as u32 {
        let mut begins = 0;
        while begins < frames {
            let (length, tint) = (shortest + (5.0 * dice.roll()) as usize, [0; 3].map(|_| dice.around(0.0, tint)));
            for age in 0..length + overlap {
                let frame = begins + age;
                let fades_in = if begins == 0 { 1.0 } else { (age + 1) as f32 / (overlap + 1) as f32 };
                let fades_out = (length + overlap - age) as f32 / (overlap + 1) as f32;
                if frame < frames {
                    rows[frame].push((i, fades_in.min(fades_out).min(1.0), tint));
                }
            }
            begins += if dice.roll() < 1.0 / 7.0 { 3 * length } else { length };
        }
    }
    let of_frame = |(t, rows): (usize, Vec<(u32, f32, [f32; 3])>)| {
        let ids: Vec<u32> = rows.iter().map(|row| row.0).collect();
        let mut state = later(cloud, t, 0.02, dice).pick(&ids);
        for (at, (_, part, tint)) in rows.into_iter().enumerate() {
            let alpha = 1.0 - (1.0 - opacity(state.opacity_logit.plane(0)[at])).powf(f64::from(part));
            state.opacity_logit.set_row(at, [(alpha / (1.0 - alpha)).ln() as f32]);
            let [r, g, b] = state.sh.row::<3>(at);
            state.sh.set_row(at, [r + tint[0], g + tint[1], b + tint[2]]);
        }
        let order = dice.order(ids.len());
        (state.pick(&order), order.iter().map(|&at| ids[at as usize]).collect())
    };
    rows.into_iter().enumerate().map(of_frame).collect()
}

#[test]
fn lives_are_those_of_every_pair_compared() {
    for (seed, shortest, overlap, tint) in
        [(21, 6, 2, 0.05), (22, 6, 0, 0.8), (23, 6, 3, 0.5), (24, 6, 5, 0.05), (25, 4, 2, 0.05)]
    {
        let mut dice = Dice(seed * 1_000_000);
        // Sparse: in a crowd not all are looked at.
        let cloud = cloud(120, 0.03, &mut dice);
        let frames = fading(&cloud, 24, shortest, overlap, tint, &mut dice);
        let (mut linker, mut joiner) = (Linker::default(), Joiner::default());
        let (mut history, mut in_doubt, mut succeeded) = (History::new(), BTreeSet::new(), BTreeSet::new());
        for (t, (state, _)) in frames.iter().enumerate() {
            let linked = linker.link(state);
            joiner.see(&linker);
            let doubted = linker.living().iter().filter(|track| track.is_in_doubt);
            in_doubt.extend(doubted.map(|track| track.number));
            let over = linker.living().iter().filter(|track| track.is_succeeded);
            succeeded.extend(over.map(|track| (t, track.number)));
            history.resize(linker.tracks() as usize, BTreeMap::new());
            for (at, &track) in linked.tracks.iter().enumerate() {
                history[track as usize].insert(t, seen(state, at));
            }
        }
        let [alike, twins] = joiner.finish(&linker);
        for ((lives, count), rule) in [(&alike, (4.0, 0.0625)), (&twins, (1.0, 1.0))] {
            assert!(
                *lives == slow_lives(&history, &in_doubt, &succeeded, frames.len(), rule),
                "overlap {overlap}, {rule:?}"
            );
            assert_eq!(*count, 1 + *lives.iter().max().unwrap() as usize);
        }
        let joined = history.len() - alike.1;
        assert!(overlap > 4 || joined > 100, "overlap {overlap}: {joined} joined");
    }
}

#[test]
fn lives_that_fade_into_one_another_are_one_and_strangers_stay_apart() {
    // Of the second lives are so short that what fades out is linked with what fades in two lives later.
    for (shortest, most) in [(6, 300), (4, 395)] {
        let mut dice = Dice(31);
        let cloud = cloud(200, 1.0, &mut dice);
        let frames = fading(&cloud, 30, shortest, 2, 0.05, &mut dice);
        let (mut linker, mut joiner) = (Linker::default(), Joiner::default());
        let mut whose: Vec<BTreeSet<u32>> = Vec::new();
        for (state, ids) in &frames {
            let linked = linker.link(state);
            joiner.see(&linker);
            whose.resize(linker.tracks() as usize, BTreeSet::new());
            for (&track, &i) in linked.tracks.iter().zip(ids) {
                whose[track as usize].insert(i);
            }
        }
        let [(lives, count), _] = joiner.finish(&linker);
        let mut of_lives = vec![BTreeSet::<u32>::new(); count];
        lives.iter().zip(&whose).for_each(|(&life, who)| of_lives[life as usize].extend(who));
        let mixed = of_lives.iter().filter(|who| who.len() > 1).count();
        println!("{} tracks are {count} lives, {mixed} mixed", whose.len());
        assert!(whose.len() > 2 * count && count < most, "{} tracks are {count} lives", whose.len());
        assert!(mixed * 20 < count, "{mixed} of {count} lives are of several Gaussians");
    }
}

#[test]
fn what_is_together_is_blended_as_its_formula_says() {
    let mut dice = Dice(41);
    let state = cloud(6, 1.0, &mut dice);
    let rows = [4, 1, 3];
    let mut blended = state.clone();
    blend(&mut blended, &rows);
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
    // Nearly opaque, nearly clear, and nothing at all.
    for (logits, expected) in [([30.0, 30.0], 60.0), ([-30.0, -30.0], -30.0 + 2f32.ln()), ([50.0, -50.0], 50.0)] {
        let mut pair = state.pick(&[0, 1]);
        logits.iter().enumerate().for_each(|(i, &logit)| pair.opacity_logit.set_row(i, [logit]));
        blend(&mut pair, &[0, 1]);
        near(pair.opacity_logit.plane(0)[0], f64::from(expected));
    }
    let mut gone = state.pick(&[0, 1]);
    (0..2).for_each(|i| gone.opacity_logit.set_row(i, [f32::NEG_INFINITY]));
    let before = gone.clone();
    blend(&mut gone, &[0, 1]);
    assert!(gone == before, "what nobody sees stays as it is");
}
