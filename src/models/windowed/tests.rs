use std::fs;
use std::path::Path;

use super::*;
use crate::compressed_model::ParamDelta;
use crate::files::ftgs::{
    ClipTimes, FtgsFile, LOG_TIME_DEVIATION, PARAMS_PER_GAUSSIAN, TIME_CENTER, VELOCITY, write_ftgs,
};
use crate::files::ply::PlyOptions;
use crate::files::splatv::rows::ZeroRotation;
use crate::files::tsog::read::read_tsog;
use crate::files::tsog::write::write_tsog;
use crate::files::tsog::{TimedGaussians, Timeline};
use crate::limits::ReadLimit;
use crate::model::Attributes;
use crate::model::{AttributeValues, Gaussians, StoredParams, opacity};
use crate::models;
use crate::models::OpenOptions;
use crate::models::archive::checks::check_round_trip;
use crate::models::input_model::TimeOrigin;
use crate::passes::gather_all;
use crate::recipe::Recipe;

const COUNT: usize = 12;
const TIMES: [f64; 4] = [0.0, 0.25, 0.5, 1.0];

/// Returns Gaussians with linear motion in windows of time. Gaussian 3 is visible for less than the minimum duration.
fn params() -> StoredParams {
    let noise = |seed: usize, i: usize| ((i * 37 + seed * 101) % 97) as f32 / 97.0 - 0.5;
    let mut made = StoredParams {
        gaussians: Gaussians::zeros(COUNT, 1),
        format_specific: AttributeValues::zeros(PARAMS_PER_GAUSSIAN, COUNT),
    };
    for i in 0..COUNT {
        let g = &mut made.gaussians;
        g.position.set_row(i, [0, 1, 2].map(|c| 4.0 * noise(c, i)));
        g.rotation.set_row(i, [1.0, noise(3, i), noise(4, i), 0.0]);
        g.log_scale.set_row(i, [0, 1, 2].map(|c| noise(5 + c, i) - 2.0));
        g.opacity_logit.set_row(i, [2.0 * noise(8, i)]);
        (0..12).for_each(|c| g.sh.plane_mut(c)[i] = noise(9 + c, i));
        made.format_specific.plane_mut(TIME_CENTER)[i] = noise(21, i) + 0.5;
        made.format_specific.plane_mut(LOG_TIME_DEVIATION)[i] = if i == 3 { -9.0 } else { noise(22, i) - 1.5 };
        (0..3).for_each(|c| made.format_specific.plane_mut(VELOCITY + c)[i] = 2.0 * noise(23 + c, i));
    }
    made
}

fn open_at(path: &Path, times: &[f64]) -> Box<dyn InputModel> {
    models::open(path, &OpenOptions::default()).unwrap().into_linked().unwrap().with_times(times.to_vec()).unwrap()
}

fn states(model: &dyn InputModel) -> Vec<Gaussians> {
    let frames = 0..model.source().info().times.len();
    frames.map(|frame| gather_all(model.source(), frame, Attributes::all()).unwrap()).collect()
}

fn write(model: &dyn InputModel, compressed: &CompressedModel, kind: OutputKind, path: &Path) -> Vec<String> {
    model.write(compressed, kind, path, &Limits::NONE, &Events::IGNORED).unwrap()
}

fn pruned(kept: Vec<u32>) -> CompressedModel {
    CompressedModel::pruned(kept, &Recipe::preset("default").unwrap().merge)
}

#[test]
fn ftgs_states_follow_the_formulas_of_the_player() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ftgs.ply");
    let stored = params();
    for (first, last) in [(0.0, 1.0), (-1.0, 3.0)] {
        write_ftgs(&stored, &ClipTimes { first, last, ..ClipTimes::UNIT_INTERVAL }, &path).unwrap();
        let times = TIMES.map(|time| first + (last - first) * time);
        let model = open_at(&path, &times);
        assert_eq!(
            (model.description().kind, model.description().default_output_kind),
            ("ftgs-player model", OutputKind::Ftgs)
        );
        for (state, time) in states(&*model).iter().zip(TIMES) {
            for i in 0..COUNT {
                let own = |plane: usize| f64::from(stored.format_specific.plane(plane)[i]);
                let dt = time - own(TIME_CENTER);
                for c in 0..3 {
                    let expected = f64::from(stored.gaussians.position.plane(c)[i]) + own(VELOCITY + c) * dt;
                    assert!((f64::from(state.position.plane(c)[i]) - expected).abs() < 1e-6);
                }
                let deviation = own(LOG_TIME_DEVIATION).exp().max(0.02);
                let alpha = opacity(stored.gaussians.opacity_logit.plane(0)[i]);
                let expected = (alpha * (-0.5 * (dt / deviation).powi(2)).exp()).max(1e-4);
                assert!((opacity(state.opacity_logit.plane(0)[i]) - expected).abs() < 1e-6, "Gaussian {i} at {time}");
            }
            assert_eq!((&state.sh, &state.log_scale), (&stored.gaussians.sh, &stored.gaussians.log_scale));
        }
    }
}

#[test]
fn a_smaller_ftgs_keeps_the_values_of_its_rows() {
    let folder = tempfile::tempdir().unwrap();
    let [path, small] = ["a.ftgs.ply", "small.ftgs.ply"].map(|name| folder.path().join(name));
    let clip = ClipTimes { first: 1.0, last: 2.0, frames: Some(7), ..ClipTimes::UNIT_INTERVAL };
    write_ftgs(&params(), &clip, &path).unwrap();
    let model = open_at(&path, &[1.0, 1.5, 2.0]);
    assert!(write(&*model, &pruned(vec![2, 7, 9]), OutputKind::Ftgs, &small).is_empty());
    let found = FtgsFile::open(&small, &PlyOptions::default(), ZeroRotation::Drop).unwrap();
    assert_eq!((found.params, found.header.clip), (params().pick(&[2, 7, 9]), clip));
    assert_eq!(model.size_written(OutputKind::Ftgs, &small).unwrap().cloud, fs::metadata(&small).unwrap().len());
}

#[test]
fn deltas_of_refinement_are_written_into_the_rows() {
    let folder = tempfile::tempdir().unwrap();
    let [path, small] = ["a.ftgs.ply", "small.ftgs.ply"].map(|name| folder.path().join(name));
    write_ftgs(&params(), &ClipTimes::UNIT_INTERVAL, &path).unwrap();
    let model = open_at(&path, &TIMES);
    let mut by = Gaussians { position: AttributeValues::zeros(3, 2), ..Gaussians::default() };
    by.position.set_row(1, [1.0, 0.0, 0.0]);
    let compressed = CompressedModel { delta: ParamDelta(by), ..pruned(vec![2, 5]) };
    write(&*model, &compressed, OutputKind::Ftgs, &small);
    assert_eq!(states(&*open_at(&small, &TIMES)), states_of(&*model.compressed_frames(&compressed).unwrap()));
}

fn states_of(source: &dyn FrameSource) -> Vec<Gaussians> {
    (0..source.info().times.len()).map(|frame| gather_all(source, frame, Attributes::all()).unwrap()).collect()
}

#[test]
fn proxies_of_copies_move_like_their_members() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ftgs.ply");
    let mut made = params();
    let copy = made.clone();
    made.set_row(1, &copy, 0);
    made.format_specific.plane_mut(LOG_TIME_DEVIATION).fill(0.0);
    made.gaussians.opacity_logit.plane_mut(0).fill(-3.0);
    write_ftgs(&made, &ClipTimes { first: 2.0, last: 6.0, ..ClipTimes::UNIT_INTERVAL }, &path).unwrap();
    let model = open_at(&path, &[2.0, 3.0, 4.0, 6.0]);
    let rule = Recipe::preset("default").unwrap().merge;
    let cluster = Cluster { output: 0, leader: 0, members: vec![(0, 0.5), (1, 0.5)] };
    let proxies =
        model.compute_proxies(std::slice::from_ref(&cluster), ReferenceFrame { frame: 0, extent: 1.0 }, &rule).unwrap();
    assert!(proxies.deviation.is_some_and(|deviation| deviation < 1e-5), "{proxies:?}");
    let compressed = CompressedModel { clusters: vec![cluster], proxies, ..pruned(vec![0, 4]) };
    for (merged, all) in states_of(&*model.compressed_frames(&compressed).unwrap()).iter().zip(states(&*model)) {
        (0..3).for_each(|c| assert!((merged.position.plane(c)[0] - all.position.plane(c)[0]).abs() < 1e-5));
    }
}

#[test]
fn player_files_are_no_trained_models() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ftgs.ply");
    write_ftgs(&params(), &ClipTimes::UNIT_INTERVAL, &path).unwrap();
    let model = open_at(&path, &TIMES);
    for kind in [OutputKind::Model, OutputKind::Ply] {
        assert!(model.check_output(kind, Path::new("x")).is_err(), "{kind:?}");
    }
    for kind in [OutputKind::Ftgs, OutputKind::Splatv, OutputKind::Gseq] {
        assert!(model.check_output(kind, Path::new("x")).is_ok(), "{kind:?}");
    }
}

fn timed(timeline: Timeline) -> TimedGaussians {
    let StoredParams { gaussians, format_specific: own } = params();
    let own = match timeline {
        Timeline::Windows => own,
        Timeline::Frames(frames) => AttributeValues::from_planes(1, (0..COUNT).map(|i| (i % frames) as f32).collect()),
        Timeline::Still => AttributeValues::zeros(0, COUNT),
    };
    let clip = ClipTimes { frames: Some(4), ..ClipTimes::UNIT_INTERVAL };
    TimedGaussians { params: StoredParams { gaussians, format_specific: own }, timeline, clip }
}

#[test]
fn tsog_states_follow_the_formulas_of_the_player() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tsog");
    write_tsog(&timed(Timeline::Windows), &path).unwrap();
    let stored = read_tsog(&path, ReadLimit::NONE).unwrap().params;
    let model = open_at(&path, &TIMES);
    assert_eq!((model.description().kind, model.description().default_output_kind), ("TSOG model", OutputKind::Tsog));
    for (state, time) in states(&*model).iter().zip(TIMES) {
        for i in 0..COUNT {
            let own = |plane: usize| f64::from(stored.format_specific.plane(plane)[i]);
            let dt = time - own(TIME_CENTER);
            let x = f64::from(stored.gaussians.position.plane(0)[i]) + own(VELOCITY) * dt;
            assert!((f64::from(state.position.plane(0)[i]) - x).abs() < 1e-6);
            let window = (-0.5 * (dt / own(LOG_TIME_DEVIATION).exp()).powi(2)).exp();
            let expected = opacity(stored.gaussians.opacity_logit.plane(0)[i]) * window;
            assert!((opacity(state.opacity_logit.plane(0)[i]) - expected).abs() < 1e-6, "Gaussian {i} at {time}");
        }
    }
}

#[test]
fn a_tsog_of_single_frames_shows_each_gaussian_once() {
    let folder = tempfile::tempdir().unwrap();
    let [path, small] = ["a.tsog", "small.tsog"].map(|name| folder.path().join(name));
    write_tsog(&timed(Timeline::Frames(5)), &path).unwrap();
    let stored = read_tsog(&path, ReadLimit::NONE).unwrap().params;
    let model = models::open(&path, &OpenOptions::default()).unwrap().into_linked().unwrap();
    assert_eq!((model.description().timing, model.source().info().times.len()), (TimeOrigin::Numbered, 5));
    for (frame, state) in states(&*model).iter().enumerate() {
        for i in 0..COUNT {
            let is_seen = stored.format_specific.plane(0)[i] as usize == frame;
            assert_eq!(opacity(state.opacity_logit.plane(0)[i]) > 1e-9, is_seen, "Gaussian {i} in frame {frame}");
        }
    }
    write(&*model, &pruned(vec![1, 4, 6]), OutputKind::Tsog, &small);
    let found = read_tsog(&small, ReadLimit::NONE).unwrap();
    assert_eq!((found.timeline, found.params.len()), (Timeline::Frames(5), 3));
    assert!(model.with_times(vec![0.0; 4]).is_err());
}

#[test]
fn a_still_tsog_is_one_frame() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("still.zip");
    write_tsog(&timed(Timeline::Still), &path).unwrap();
    let model = models::open(&path, &OpenOptions::default()).unwrap().into_linked().unwrap();
    assert_eq!((model.source().info().times.len(), model.source().info().varying), (1, Attributes::empty()));
    assert_eq!(states(&*model)[0].len(), COUNT);
}

#[test]
fn archives_hold_windows_as_ftgs_and_single_frames_as_frames() {
    let folder = tempfile::tempdir().unwrap();
    let [ftgs, tsog] = ["a.ftgs.ply", "a.tsog"].map(|name| folder.path().join(name));
    write_ftgs(&params(), &ClipTimes::UNIT_INTERVAL, &ftgs).unwrap();
    write_tsog(&timed(Timeline::Windows), &tsog).unwrap();
    for path in [&ftgs, &tsog] {
        let model = open_at(path, &TIMES);
        assert!(!model.description().archives_as_frames);
        let kind = check_round_trip(&*model, &pruned(vec![2, 3, 9]), &OpenOptions::default(), 1e-3);
        assert_eq!(kind, OutputKind::Ftgs);
    }
    for timeline in [Timeline::Frames(4), Timeline::Still] {
        write_tsog(&timed(timeline), &tsog).unwrap();
        let model = models::open(&tsog, &OpenOptions::default()).unwrap().into_linked().unwrap();
        assert!(
            model.description().archives_as_frames
                && model.check_output(OutputKind::Archive, Path::new("a.gsz")).is_ok()
        );
    }
}
