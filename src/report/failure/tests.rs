//! Tests that damage to one kind of Gaussian flags the failure mode of this kind, and no other failure mode.

use glam::DVec3;

use super::*;
use crate::diagnostics::demo_scene::{DemoBody, DemoScene};
use crate::evaluation::RenderedViews;
use crate::files::container::Container;
use crate::model::Split;
use crate::outputs::container::write_container;
use crate::passes::gather;
use crate::pipeline::score_scene;
use crate::pruning::score::{Scored, UserOverrides};
use crate::recipe::Recipe;
use crate::report::gaussian_kinds::{contribution_shares, kind_flags};
use crate::source::FrameSource;

/// Test scene with its scores and the kinds of its Gaussians.
struct ScoredScene {
    made: DemoScene,
    scored: Scored,
    kinds: Vec<KindFlags>,
    _folder: tempfile::TempDir,
}

fn scored_scene() -> ScoredScene {
    let folder = tempfile::tempdir().unwrap();
    let made = DemoScene::new(3000, 12);
    let path = folder.path().join("scene.gseq");
    write_container(&made, &path, gseq::Compression::Raw, Default::default(), |_| ()).unwrap();
    let input = Box::new(Container::open(&path).unwrap());
    let rig = made.rig();
    let scene = crate::scene::Scene::new(path, input, rig, Some(Split::Train)).unwrap();
    let recipe = Recipe::preset("default").unwrap();
    let scored = score_scene(&scene, &recipe, &UserOverrides::default()).unwrap();
    let kinds = kind_flags(scene.source(), &scored, recipe.scan.alpha_min).unwrap();
    ScoredScene { made, scored, kinds, _folder: folder }
}

impl ScoredScene {
    /// Returns the fraction of the visible Gaussians of the object `body` of the test scene that belong to `kind`.
    fn part(&self, body: DemoBody, kind: GaussianKind) -> f64 {
        let rows = self.scored.rows().unwrap();
        let members: Vec<usize> = self.made.body_ids(body).filter(|&i| rows.c[i] > 0.0).collect();
        let with = members.iter().filter(|&&i| self.kinds[i][kind as usize]).count();
        with as f64 / members.len().max(1) as f64
    }

    /// Returns the failure modes of a compressed model that lacks the Gaussians for which `lost` is true.
    fn without(&self, lost: impl Fn(usize) -> bool) -> [FailureMode; 3] {
        let rig = self.made.rig();
        let all: Vec<u32> = (0..self.kinds.len() as u32).collect();
        let left: Vec<u32> = all.iter().copied().filter(|&i| !lost(i as usize)).collect();
        let (mut seen, mut names) = (Vec::new(), Vec::new());
        for frame in (0..self.made.info().times.len()).step_by(3) {
            let state = gather(&self.made, &all, frame, crate::model::Attributes::all()).unwrap();
            for view in [1usize, 2, 4] {
                let camera = &rig.cameras[view];
                let taken = RenderedViews {
                    original: render(&state, camera, [0.0; 3]),
                    compressed: render(&state.pick(&left), camera, [0.0; 3]),
                    truth: None,
                };
                seen.push(sum_errors(&state, &self.kinds, camera, &taken));
                names.push((frame, view as u32));
            }
        }
        let shares = contribution_shares(&self.scored.rows().unwrap(), &self.kinds, &lost);
        GaussianKind::ALL.map(|kind| {
            let of = |wanted: bool| {
                (0..self.kinds.len()).filter(|&i| self.kinds[i][kind as usize] && (!wanted || lost(i))).count()
            };
            let members = KindTotals { count: of(false), fates: Some((of(true), 0)), shares: shares[kind as usize] };
            assess_failure_mode(kind, members, &seen, &names)
        })
    }
}

#[test]
fn kinds_are_found_where_the_scene_has_them_and_nowhere_else() {
    let scene = scored_scene();
    assert!(
        scene.part(DemoBody::Cloth, GaussianKind::Motion) > 0.3,
        "got {}",
        scene.part(DemoBody::Cloth, GaussianKind::Motion)
    );
    assert!(
        scene.part(DemoBody::Egg, GaussianKind::Motion) < 0.15,
        "a rigid motion: {}",
        scene.part(DemoBody::Egg, GaussianKind::Motion)
    );
    assert_eq!(scene.part(DemoBody::Wire, GaussianKind::Thin), 1.0);
    assert!(scene.part(DemoBody::Fading, GaussianKind::Appearance) > 0.9);
    for body in [DemoBody::Wall, DemoBody::Double] {
        for kind in GaussianKind::ALL {
            assert_eq!(scene.part(body, kind), 0.0, "{} {kind:?}", body.name());
        }
    }
    let buried = scene.made.body_ids(DemoBody::Buried);
    assert!(scene.kinds[buried].iter().all(|of| *of == [false; 3]), "what is never seen is of no kind");
}

#[test]
fn each_failure_mode_is_flagged_only_where_its_kind_is_lost() {
    let scene = scored_scene();
    for (number, kind) in GaussianKind::ALL.into_iter().enumerate() {
        let found = scene.without(|i| scene.kinds[i][number]);
        let at = &found[number];
        assert_eq!(at.verdict, Verdict::Flagged, "{kind:?}: {at:?}");
        assert_eq!(at.dropped, Some(at.gaussians));
        assert!(at.worst.unwrap().psnr <= at.psnr_on_kind.unwrap(), "{kind:?}: the worst is not better than the mean");
        assert!(at.detail_lost.unwrap() > 0.1, "{kind:?}: {at:?}");
        for (other, of) in found.iter().enumerate().filter(|(other, _)| *other != number) {
            assert_ne!(of.verdict, Verdict::Flagged, "{kind:?} lost: {:?} {of:?}", GaussianKind::ALL[other]);
        }
    }
}

#[test]
fn losing_gaussians_of_no_kind_flags_no_failure_mode() {
    let scene = scored_scene();
    // Every third wall Gaussian: a large and visible loss.
    let found = scene.without(|i| scene.kinds[i] == [false; 3] && i % 3 == 0);
    assert!(found.iter().all(|of| of.verdict == Verdict::Untouched), "{found:?}");
    assert!(found[1].psnr_elsewhere.unwrap() < VISIBLE_ERROR_PSNR_DB, "the loss is not visible: {found:?}");
    let nothing = scene.without(|_| false);
    assert!(nothing.iter().all(|of| of.verdict == Verdict::Untouched && of.psnr_on_kind == Some(PSNR_CAP_DB)));
}

fn sums(weight: f64, error: f64) -> ViewErrorSums {
    let one = FailureSums { weight, error, kept_detail: weight, detail: weight };
    ViewErrorSums { kinds: [one, FailureSums::default(), FailureSums::default()], error: 2.0 * error, pixels: 1e4 }
}

#[test]
fn verdicts_follow_the_stated_thresholds() {
    let verdict = |members: KindTotals, observed: ViewErrorSums| {
        assess_failure_mode(GaussianKind::Motion, members, &[observed], &[(3, 7)]).verdict
    };
    let lost = KindTotals { count: 5, fates: Some((5, 0)), shares: (0.1, 0.5) };
    // 100 pixels of 10,000 with a squared error of 0.01 each: 20 dB; elsewhere 40 dB.
    assert_eq!(verdict(lost, sums(100.0, 1.0)), Verdict::Flagged);
    assert_eq!(verdict(KindTotals { count: 0, ..lost }, sums(0.0, 0.0)), Verdict::Absent);
    assert_eq!(verdict(lost, sums(9.9, 0.1)), Verdict::Unseen, "under a thousandth of the pixels");
    assert_eq!(verdict(KindTotals { shares: (0.1, 0.009), ..lost }, sums(100.0, 1.0)), Verdict::Untouched);
    assert_eq!(verdict(lost, sums(100.0, 0.009)), Verdict::Passed, "40.5 dB cannot be seen");
    assert_eq!(verdict(lost, sums(4000.0, 40.0)), Verdict::Passed, "20 dB against 21.8 is not apart");
    // Without an index map the renders alone decide.
    assert_eq!(verdict(KindTotals { fates: None, shares: (0.1, 0.0), ..lost }, sums(100.0, 1.0)), Verdict::Flagged);
    let found = assess_failure_mode(GaussianKind::Motion, lost, &[sums(100.0, 1.0)], &[(3, 7)]);
    assert_eq!(found.psnr_on_kind, Some(20.0));
    assert_eq!(found.worst.map(|worst| (worst.frame, worst.view)), Some((3, 7)));
    assert_eq!(assess_failure_mode(GaussianKind::Thin, KindTotals::default(), &[], &[]).verdict, Verdict::Absent);
}

#[test]
fn pixel_shares_are_those_of_the_gaussians_visible_there() {
    let mut state = Gaussians::zeros(2, 0);
    for (i, y) in [0.0f32, 2.0].into_iter().enumerate() {
        state.position.set_row(i, [0.0, y, 0.0]);
        state.rotation.set_row(i, [1.0, 0.0, 0.0, 0.0]);
        state.log_scale.set_row(i, [0.0; 3]);
    }
    // The nearer one lets half through.
    state.opacity_logit.set_row(1, [12.0]);
    let camera = Camera::look_at(DVec3::new(0.0, -6.0, 0.0), DVec3::ZERO, 0.6, (33, 33));
    let shares = render_kind_shares(&state, &[[true, false, false], [false, true, false]], &camera);
    let middle = &shares.data[3 * (16 * 33 + 16)..][..3];
    for (got, expected) in middle.iter().zip([0.5, 0.5 * 0.99, 0.0]) {
        assert!((got - expected).abs() < 0.02, "got {middle:?}");
    }
}

#[test]
fn worst_square_has_the_largest_error_of_the_kind() {
    let image = |value: f32| Image { width: 100, height: 90, data: vec![value; 27_000] };
    let mut taken = RenderedViews { original: image(0.5), compressed: image(0.5), truth: None };
    let mut shares = image(0.0);
    let mut mark = |x: usize, y: usize, error: f32, share: f32| {
        let at = 3 * (y * 100 + x);
        taken.compressed.data[at] += error;
        shares.data[at + GaussianKind::Thin as usize] = share;
    };
    // A larger error that is not the kind's, and the kind's own, at the lower right border.
    mark(2, 3, 0.5, 0.0);
    mark(99, 89, 0.2, 1.0);
    let (left, top) = worst_corner(&taken, &shares, GaussianKind::Thin);
    assert_eq!((left, top), (36, 26), "the first square that holds the last pixel");
    let part = crop_square(&taken.compressed, (left, top));
    assert_eq!((part.width, part.height), (CROP_SIDE_PX, CROP_SIDE_PX));
    assert!((part.data[3 * (63 * 64 + 63)] - 0.7).abs() < 1e-6);
    let small = Image { width: 5, height: 4, data: vec![0.0; 60] };
    assert_eq!((crop_square(&small, (0, 0)).width, crop_square(&small, (0, 0)).height), (5, 4));
}
