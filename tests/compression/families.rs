//! What every family promises: the frames of a reduction are those of what is written of it, whatever a refinement
//! changed.

use std::path::Path;

use crate::scene::{Workplace, state, tiny, without_sh_head};
use splatsieve::compressed_model::{Cluster, CompressedModel, ParamDelta, Reference};
use splatsieve::limits::Limits;
use splatsieve::model::{ALL_HARMONICS, Columns, Gaussians};
use splatsieve::models;
use splatsieve::models::{InputModel, OpenOptions};
use splatsieve::outputs::kind::OutputKind;
use splatsieve::progress::Events;
use splatsieve::recipe::{Precision, Recipe};

/// Opens `path`, at three times where it leaves them open.
fn open(path: &Path) -> Box<dyn InputModel> {
    let input = models::open(path, &OpenOptions::default()).unwrap();
    if input.source().info().times.is_empty() { input.with_times(vec![0.0, 0.25, 1.0]).unwrap() } else { input }
}

/// Every third Gaussian of `input`, two of them merged with a neighbor.
fn reduction(input: &dyn InputModel) -> CompressedModel {
    let rule = Recipe::preset("default").unwrap().merge;
    let kept: Vec<u32> = (0..input.source().info().count as u32).step_by(3).collect();
    let mut reduction = CompressedModel::pruned(kept, &rule);
    for output in [1, 4] {
        let leader = reduction.kept[output as usize];
        reduction.clusters.push(Cluster { output, leader, members: vec![(leader, 0.625), (leader + 1, 0.375)] });
    }
    let reference = Reference { frame: 0, extent: 1.0 };
    reduction.proxies = input.solve(&reduction.clusters, reference, &rule).unwrap();
    reduction
}

/// Something else for every third Gaussian, in the columns `of`.
fn change(count: usize, of: Columns) -> ParamDelta {
    let mut by = Gaussians::default();
    for column in of.iter() {
        *by.column_mut(column) = Gaussians::zeros(count, 0).column(column).clone();
        for c in 0..by.column(column).width() {
            let plane = by.column_mut(column).plane_mut(c);
            (0..count).step_by(3).for_each(|i| plane[i] = 0.01 * (c + 1) as f32 * (i as f32 - 7.0));
        }
    }
    ParamDelta(by)
}

/// States of what `reduction` leaves of `input`, and of what is written of it as `kind` and read again.
fn both(
    workplace: &Workplace,
    input: &dyn InputModel,
    reduction: &CompressedModel,
    kind: OutputKind,
) -> [Vec<Gaussians>; 2] {
    let path = workplace.path(if kind.is_folder() { "written" } else { "written.gseq" });
    if kind.is_folder() {
        std::fs::create_dir(&path).unwrap();
    }
    input.write(reduction, kind, &path, &Limits::NONE, &Events::IGNORED).unwrap();
    let frames = input.source().info().times.len();
    let reduced = input.reduced(reduction).unwrap();
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
fn frames_of_a_reduction_are_those_of_what_is_written_whatever_column_was_changed() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 300 --frames 3 -o demo");
    workplace.done("unpack demo/scene.gseq -o frames");
    without_sh_head(&tiny(), &workplace.path("free"));
    for (path, kinds) in [
        (tiny(), [OutputKind::Model, OutputKind::Gseq]),
        (workplace.path("free"), [OutputKind::Model, OutputKind::Gseq]),
        (workplace.path("frames"), [OutputKind::PlySequence, OutputKind::Gseq]),
        (workplace.path("demo/scene.gseq"), [OutputKind::PlySequence, OutputKind::Gseq]),
    ] {
        let input = open(&path);
        let mut reduction = reduction(&*input);
        for kind in kinds {
            reduction.change = ParamDelta::default();
            let [plain, _] = both(&workplace, &*input, &reduction, kind);
            for column in Columns::all().iter().chain([Columns::all()]) {
                reduction.change = change(reduction.len(), column);
                let [reduced, written] = both(&workplace, &*input, &reduction, kind);
                let of = format!("{}, {}, {kind:?}", path.display(), column.name());
                assert!(reduced == written, "{of}: what is written differs from what was promised");
                assert!(reduced != plain, "{of}: nothing changed");
                let moved = |k: &usize| plain[0].position.row::<3>(*k) != reduced[0].position.row(*k);
                assert_eq!((0..reduction.len()).find(|k| k % 3 != 0 && moved(k)), None, "{of}: a zero moved it");
            }
            if kind == OutputKind::Model {
                let [exact, _] = both(&workplace, &*input, &reduction, kind);
                reduction.field = Precision::Half;
                let [reduced, written] = both(&workplace, &*input, &reduction, kind);
                assert!(input.can_round_field().unwrap() && reduced != exact, "nothing was rounded");
                assert!(reduced == written, "a field in half precision differs from what was promised");
                reduction.field = Precision::Exact;
            }
            if input.needs_all_bands().is_none() {
                for sh_degree in 0..input.source().info().sh_degree {
                    reduction.sh_degree = sh_degree;
                    let [reduced, written] = both(&workplace, &*input, &reduction, kind);
                    assert!(reduced == written, "{}, {kind:?}: degree {sh_degree}", path.display());
                    assert_eq!(written[0].sh_degree(), sh_degree);
                }
                reduction.sh_degree = ALL_HARMONICS;
            }
        }
    }
}

#[test]
fn frames_of_a_model_are_asked_for_at_even_times_that_leave_out_the_end() {
    let workplace = Workplace::new();
    for (frames, expected) in [(1, &[0.0][..]), (4, &[0.0, 0.25, 0.5, 0.75])] {
        workplace.done(&format!("pack {{tiny}} --frames {frames} -o {frames}.gseq"));
        assert_eq!(open(&workplace.path(&format!("{frames}.gseq"))).source().info().times, expected);
    }
}
