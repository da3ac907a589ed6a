//! Tests of a property of every model format: a compressed model in memory has the same frame states as the model that
//! is written from it and read again, whichever attributes refinement changed.

use std::path::Path;

use crate::scene::{Workplace, state, tiny, without_sh_head};
use splatsieve::compressed_model::{Cluster, CompressedModel, ParamDelta, ReferenceFrame};
use splatsieve::limits::Limits;
use splatsieve::model::{Attributes, Gaussians, NO_SH_LIMIT};
use splatsieve::models;
use splatsieve::models::{InputModel, OpenOptions};
use splatsieve::outputs::kind::OutputKind;
use splatsieve::progress::Events;
use splatsieve::recipe::{FieldPrecision, Recipe};

/// Opens the model at `path`. If the model has no times of its own, gives it three times.
fn open(path: &Path) -> Box<dyn InputModel> {
    let input = models::open(path, &OpenOptions::default()).unwrap().into_linked().unwrap();
    if input.source().info().times.is_empty() { input.with_times(vec![0.0, 0.25, 1.0]).unwrap() } else { input }
}

/// Returns a compressed model with every third Gaussian of `input`, two of which were merged with a neighbor.
fn compress_by_three(input: &dyn InputModel) -> CompressedModel {
    let rule = Recipe::preset("default").unwrap().merge;
    let kept: Vec<u32> = (0..input.source().info().count as u32).step_by(3).collect();
    let mut compressed = CompressedModel::pruned(kept, &rule);
    for output in [1, 4] {
        let leader = compressed.kept[output as usize];
        compressed.clusters.push(Cluster { output, leader, members: vec![(leader, 0.625), (leader + 1, 0.375)] });
    }
    let reference = ReferenceFrame { frame: 0, extent: 1.0 };
    compressed.proxies = input.compute_proxies(&compressed.clusters, reference, &rule).unwrap();
    compressed
}

/// Returns a parameter delta that changes the attributes `columns` of every third Gaussian.
fn delta_of_every_third(count: usize, columns: Attributes) -> ParamDelta {
    let mut delta = Gaussians::default();
    for column in columns.iter() {
        *delta.attribute_values_mut(column) = Gaussians::zeros(count, 0).attribute_values(column).clone();
        for c in 0..delta.attribute_values(column).width() {
            let plane = delta.attribute_values_mut(column).plane_mut(c);
            (0..count).step_by(3).for_each(|i| plane[i] = 0.01 * (c + 1) as f32 * (i as f32 - 7.0));
        }
    }
    ParamDelta(delta)
}

/// Returns two lists of frame states: those of `compressed`, and those of the model that is written from it as `kind`
/// and read again.
fn states_before_and_after_writing(
    workplace: &Workplace,
    input: &dyn InputModel,
    compressed: &CompressedModel,
    kind: OutputKind,
) -> [Vec<Gaussians>; 2] {
    let path = workplace.path(if kind.is_folder() { "written" } else { "written.gseq" });
    if kind.is_folder() {
        std::fs::create_dir(&path).unwrap();
    }
    input.write(compressed, kind, &path, &Limits::NONE, &Events::IGNORED).unwrap();
    let frames = input.source().info().times.len();
    let reduced = input.compressed_frames(compressed).unwrap();
    let written = open(&path);
    let found = [&*reduced, written.source()].map(|source| (0..frames).map(|frame| state(source, frame)).collect());
    if kind.is_folder() {
        std::fs::remove_dir_all(&path).unwrap()
    } else {
        std::fs::remove_file(&path).unwrap()
    }
    found
}

#[test]
fn compressed_states_equal_written_states_after_any_delta() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 300 --frames 3 -o demo");
    workplace.done("convert demo/scene.gseq frames --as ply-sequence");
    without_sh_head(&tiny(), &workplace.path("free"));
    for (path, kinds) in [
        (tiny(), [OutputKind::Model, OutputKind::Gseq]),
        (workplace.path("free"), [OutputKind::Model, OutputKind::Gseq]),
        (workplace.path("frames"), [OutputKind::PlySequence, OutputKind::Gseq]),
        (workplace.path("demo/scene.gseq"), [OutputKind::PlySequence, OutputKind::Gseq]),
    ] {
        let input = open(&path);
        let mut compressed = compress_by_three(&*input);
        for kind in kinds {
            compressed.delta = ParamDelta::default();
            let [plain, _] = states_before_and_after_writing(&workplace, &*input, &compressed, kind);
            for column in Attributes::all().iter().chain([Attributes::all()]) {
                compressed.delta = delta_of_every_third(compressed.len(), column);
                let [reduced, written] = states_before_and_after_writing(&workplace, &*input, &compressed, kind);
                let case = format!("{}, {}, {kind:?}", path.display(), column.name());
                assert!(reduced == written, "{case}: what is written differs from what was promised");
                assert!(reduced != plain, "{case}: nothing changed");
                let moved = |k: &usize| plain[0].position.row::<3>(*k) != reduced[0].position.row(*k);
                assert_eq!((0..compressed.len()).find(|k| k % 3 != 0 && moved(k)), None, "{case}: a zero moved it");
            }
            if kind == OutputKind::Model {
                let [exact, _] = states_before_and_after_writing(&workplace, &*input, &compressed, kind);
                compressed.field = FieldPrecision::Half;
                let [reduced, written] = states_before_and_after_writing(&workplace, &*input, &compressed, kind);
                assert!(input.can_round_field().unwrap() && reduced != exact, "nothing was rounded");
                assert!(reduced == written, "a field in half precision differs from what was promised");
                compressed.field = FieldPrecision::Exact;
            }
            if input.description().reason_to_keep_sh_degree.is_none() {
                for sh_degree in 0..input.source().info().sh_degree {
                    compressed.sh_degree = sh_degree;
                    let [reduced, written] = states_before_and_after_writing(&workplace, &*input, &compressed, kind);
                    assert!(reduced == written, "{}, {kind:?}: degree {sh_degree}", path.display());
                    assert_eq!(written[0].sh_degree(), sh_degree);
                }
                compressed.sh_degree = NO_SH_LIMIT;
            }
        }
    }
}

#[test]
fn frames_option_samples_even_times_without_the_end() {
    let workplace = Workplace::new();
    for (frames, expected) in [(1, &[0.0][..]), (4, &[0.0, 0.25, 0.5, 0.75])] {
        workplace.done(&format!("convert {{tiny}} {frames}.gseq --frames {frames}"));
        assert_eq!(open(&workplace.path(&format!("{frames}.gseq"))).source().info().times, expected);
    }
}
