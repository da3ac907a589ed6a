//! Tests of `compress`: the contents of every kind of output, and that its bytes depend only on the request and the
//! input.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use crate::scene::{PlyRows, Workplace, bits, files, index_map, lasting_files, point_cloud, shared, state, tiny};
use splatsieve::files::container::Container;
use splatsieve::files::ply_sequence::PlySequence;
use splatsieve::models::ModelFolder;
use splatsieve::source::FrameSource;

const COUNT: usize = 300;
/// Returns, for each Gaussian of the output, the indices of the input Gaussians that it stands for. `map` is the index
/// map.
fn members(map: &[i64]) -> Vec<Vec<usize>> {
    let count = map.iter().max().map_or(0, |&last| last + 1) as usize;
    let mut members = vec![Vec::new(); count];
    for (id, &place) in map.iter().enumerate().filter(|(_, place)| **place >= 0) {
        members[place as usize].push(id);
    }
    members
}

/// Compresses `model` and checks that the output folder is the input with fewer Gaussians: every Gaussian that was not
/// merged keeps its bytes in the PLY file, and its state at each of `frames` to the bit.
fn assert_kept_are_untouched(workplace: &Workplace, model: &Path, preset: &str, frames: &[usize]) {
    let name = format!("out_{preset}");
    let (input, output) = (model.display().to_string(), workplace.path(&name));
    let summary = workplace.summary(&format!(
        "{input} --cameras {input} --split test -o {name} --preset {preset} --set choose_by_views=false --no-refine \
         --set field=exact"
    ));
    let map = index_map(&output.join("index_map.npy"));
    let members = members(&map);
    let (before, after) = (PlyRows::read(&point_cloud(model)), PlyRows::read(&point_cloud(&output)));
    assert_eq!(map.len(), before.rows.len());
    assert_eq!(members.len(), after.rows.len());
    assert_eq!(summary["gaussians"], after.rows.len());
    assert_eq!(after.names, before.names);
    for (kind, path) in [("cfg_args", "cfg_args"), ("deformation.pth", "deformation.pth")] {
        let find = |root: &Path| {
            files(root).into_iter().find(|(name, _)| name.ends_with(path)).map(|(_, bytes)| bytes).unwrap()
        };
        assert!(find(model) == find(&output), "{kind} changed");
    }
    let times = crate::scene::scene(model).source().info().times.clone();
    let open = |root: &Path| ModelFolder::open(root, None).unwrap().with_times(times.clone()).unwrap();
    let (original, result) = (open(model), open(&output));
    let alone = || members.iter().enumerate().filter(|(_, ids)| ids.len() == 1).map(|(place, ids)| (place, ids[0]));
    assert!(alone().count() > 0 && alone().count() < members.len(), "nothing merged, or everything");
    for (place, id) in alone() {
        assert!(after.rows[place] == before.rows[id], "Gaussian {id}, now {place}: its row changed");
    }
    for &frame in frames {
        let (before, after) = (state(&original, frame), state(&result, frame));
        for (place, id) in alone() {
            assert_eq!(bits(&after, place), bits(&before, id), "Gaussian {id}, now {place}, at frame {frame}");
        }
    }
}

#[test]
fn kept_gaussians_of_the_tiny_model_are_untouched() {
    let workplace = Workplace::new();
    for preset in ["paper", "default"] {
        assert_kept_are_untouched(&workplace, &tiny(), preset, &(0..10).collect::<Vec<_>>());
    }
}

#[test]
#[ignore = "needs the trained models"]
fn kept_gaussians_of_deform2_are_untouched() {
    let model = shared("deform2");
    let workplace = Workplace::new();
    for preset in ["paper", "default"] {
        assert_kept_are_untouched(&workplace, &model, preset, &[0, 31, 59]);
    }
}

#[test]
fn target_counts_are_met_exactly() {
    let workplace = Workplace::new();
    for (arguments, counts) in [
        ("--preset paper", &[1, 2, 17, 150, 299, 300][..]),
        ("--preset default", &[1, 100, 231, 232, 233, 300]),
        ("--preset paper --prune-only", &[1, 50, 240, 241, 300]),
        ("--preset default --prune-only --set low_priority=drop", &[1, 299]),
        ("--preset paper --merge-only", &[200, 299, 300]),
    ] {
        for &count in counts {
            let name = format!("{}_{count}.ply", arguments.replace([' ', '-'], ""));
            workplace.done(&format!("compress {{tiny}} {arguments} --count {count} -o {name}"));
            let rows = PlyRows::read(&workplace.path(&name)).rows.len();
            assert_eq!(rows, count, "{arguments} --count {count}");
            assert_eq!(members(&index_map(&workplace.path(&format!("{name}.index_map.npy")))).len(), count);
        }
    }
    for (ratio, count) in [("1", 300), ("0.5", 150), ("0.333", 100), ("0.001", 1)] {
        let summary = workplace.summary(&format!("{{tiny}} --ratio {ratio} -o x --dry-run"));
        assert_eq!(summary["gaussians"], count, "--ratio {ratio}");
    }
}

#[test]
fn targets_out_of_reach_are_refused() {
    let workplace = Workplace::new();
    let refused = |arguments: &str, parts: &[&str]| {
        workplace.refused(2, &format!("compress {{tiny}} -o out {arguments}"), parts);
    };
    refused("--merge-only --count 3", &["a target of 3", "merging alone leaves"]);
    refused("--count 0", &["1 to 300", "found 0"]);
    refused("--count 301", &["1 to 300", "found 301"]);
    refused("--ratio 0", &["--ratio"]);
    refused("--ratio 1.5", &["--ratio"]);
    refused("--ratio nan", &["--ratio"]);
    refused("--count 5 --keep-ids 0-9", &["a target of 5", "10 are to be kept"]);
    refused("--count 295 --drop-ids 0-9", &["a target of 295", "290 are left"]);
    refused("--count 5 --ratio 0.5", &["cannot be used with"]);
    refused("--prune-only --merge-only", &["cannot be used with"]);
}

#[test]
fn prune_only_and_merge_only_leave_out_a_stage() {
    let workplace = Workplace::new();
    let pruned = workplace.summary("{tiny} -o pruned --preset paper --prune-only");
    assert_eq!(pruned["gaussians"], 240, "stage 1 keeps 80% of 300");
    assert!(pruned["merge"].is_null());
    let map = index_map(&workplace.path("pruned/index_map.npy"));
    let kept: Vec<i64> = map.into_iter().filter(|&place| place >= 0).collect();
    assert_eq!(kept, (0..240).collect::<Vec<i64>>(), "kept rows stay in order");

    let merged = workplace.summary("{tiny} -o merged --preset paper --merge-only");
    assert!(merged["gaussians"].as_u64().unwrap() < 300);
    let map = index_map(&workplace.path("merged/index_map.npy"));
    assert!(map.iter().all(|&place| place >= 0), "merging drops nobody");
}

#[test]
fn kept_ids_stay_unmerged_and_dropped_ids_go() {
    let workplace = Workplace::new();
    fs::write(workplace.path("drop.txt"), "# seen in a viewer\n20-29\n250\n").unwrap();
    workplace.done("compress {tiny} -o out --preset paper --keep-ids 0-9,299 --drop-ids drop.txt --count 40");
    let map = index_map(&workplace.path("out/index_map.npy"));
    let (before, after) = (PlyRows::read(&point_cloud(&tiny())), PlyRows::read(&point_cloud(&workplace.path("out"))));
    assert_eq!(after.rows.len(), 40);
    for id in (0..10).chain([299]) {
        assert!(map[id] >= 0 && after.rows[map[id] as usize] == before.rows[id], "Gaussian {id} is to be kept");
        assert_eq!(map.iter().filter(|&&place| place == map[id]).count(), 1, "Gaussian {id} is not to be merged");
    }
    assert!((20..30).chain([250]).all(|id| map[id] == -1));
}

#[test]
fn keep_box_keeps_gaussians_in_it_at_the_reference_frame() {
    let workplace = Workplace::new();
    let summary = workplace.summary(
        "{tiny} -o out --preset paper --keep-box -0.4,-0.4,-0.4,0.4,0.4,0.4 --set keep_fraction=0.1 --drop-ids 0",
    );
    let frame = summary["merge"]["reference_frame"].as_u64().unwrap() as usize;
    let scene = crate::scene::scene(&tiny());
    let state = state(scene.source(), frame);
    let map = index_map(&workplace.path("out/index_map.npy"));
    let inside: Vec<usize> = (1..COUNT)
        .filter(|&i| state.position.row::<3>(i).iter().all(|x| (-0.4..=0.4).contains(&f64::from(*x))))
        .collect();
    assert!(inside.len() > 30, "{} inside", inside.len());
    for id in inside {
        assert!(map[id] >= 0, "Gaussian {id} is in the box");
        assert_eq!(map.iter().filter(|&&place| place == map[id]).count(), 1, "Gaussian {id} is not to be merged");
    }
}

#[test]
fn dry_run_writes_nothing_and_predicts_the_count() {
    let workplace = Workplace::new();
    let planned = workplace.summary("{tiny} -o out --ratio 0.37 --dry-run");
    assert!(files(&workplace.path("")).is_empty());
    let done = workplace.summary("{tiny} -o out --ratio 0.37");
    assert_eq!(planned["gaussians"], done["gaussians"]);
    assert!(planned["output_bytes"].is_null());
    // Size of the model itself, without the files beside it.
    let beside = ["recipe.toml", "index_map.npy", "summary.json"];
    let files = files(&workplace.path("out"));
    let own = files.iter().filter(|(name, _)| !beside.contains(&name.to_str().unwrap()));
    assert_eq!(done["output_bytes"], own.map(|(_, bytes)| bytes.len()).sum::<usize>());
}

#[test]
fn all_kinds_of_output_hold_the_same_gaussians() {
    let workplace = Workplace::new();
    for preset in ["paper", "default"] {
        for output in ["folder", "one.gseq", "one.ply", "frames --as ply-sequence"] {
            workplace.done(&format!("compress {{tiny}} --preset {preset} --set field=exact --overwrite -o {output}"));
        }
        let folder = workplace.path("folder");
        assert_eq!(fs::read(workplace.path("one.ply")).unwrap(), fs::read(point_cloud(&folder)).unwrap());
        let map = fs::read(folder.join("index_map.npy")).unwrap();
        for other in ["one.gseq.index_map.npy", "one.ply.index_map.npy", "frames/index_map.npy"] {
            assert!(fs::read(workplace.path(other)).unwrap() == map, "{other}");
        }
        let times = crate::scene::scene(&tiny()).source().info().times.clone();
        let model = ModelFolder::open(&folder, None).unwrap().with_times(times.clone()).unwrap();
        let container = Container::open(&workplace.path("one.gseq")).unwrap();
        let frames = PlySequence::open(&workplace.path("frames")).unwrap();
        assert_eq!(container.info().times, times);
        for frame in 0..times.len() {
            let expected = state(&model, frame);
            for other in [&container as &dyn FrameSource, &frames] {
                let found = state(other, frame);
                assert_eq!(found.len(), expected.len());
                for i in 0..found.len() {
                    assert_eq!(bits(&found, i), bits(&expected, i), "Gaussian {i} at frame {frame}");
                }
            }
        }
    }
}

#[test]
fn explicit_trajectories_keep_the_bits_of_survivors() {
    let workplace = Workplace::new();
    workplace.done("convert {tiny} scene.gseq");
    workplace.done("convert scene.gseq frames --as ply-sequence");
    let cameras = tiny().display().to_string();
    workplace.done(&format!("compress scene.gseq --cameras {cameras} --preset paper -o a.gseq"));
    workplace.done(&format!("compress frames --cameras {cameras} --preset paper -o b"));
    let map = index_map(&workplace.path("a.gseq.index_map.npy"));
    assert!(map == index_map(&workplace.path("b/index_map.npy")), "the container and its frames differ");
    let members = members(&map);
    assert!(members.iter().any(|ids| ids.len() > 1), "nothing merged");
    let original = Container::open(&workplace.path("scene.gseq")).unwrap();
    let container = Container::open(&workplace.path("a.gseq")).unwrap();
    let frames = PlySequence::open(&workplace.path("b")).unwrap();
    for frame in 0..10 {
        let [original, a, b] = [&original as &dyn FrameSource, &container, &frames].map(|source| state(source, frame));
        for (place, ids) in members.iter().enumerate() {
            assert_eq!(bits(&a, place), bits(&b, place), "place {place} at frame {frame}");
            if let [id] = ids[..] {
                assert_eq!(bits(&a, place), bits(&original, id), "Gaussian {id} at frame {frame}");
            }
        }
    }
}

#[test]
#[ignore = "needs time"]
fn compressed_bytes_ignore_thread_count() {
    let workplace = Workplace::new();
    // More Gaussians than one block.
    workplace.done("test-scene --gaussians 3000 --frames 6 -o demo");
    let mut seen = BTreeSet::new();
    for request in [
        "{tiny} --preset paper -o out",
        "{tiny} --preset default -o out",
        "{tiny} --preset default --count 77 -o out.gseq",
        "demo/scene.gseq --cameras demo/cameras.json --preset paper -o out",
        "demo/scene.gseq --cameras demo/cameras.json --preset default -o out.gseq",
        "demo/scene.gseq --cameras demo/cameras.json --preset default --ratio 0.4 -o out",
    ] {
        let [one, two, three] = ["1", "2", "3"].map(|threads| {
            workplace.done(&format!("compress {request} --threads {threads} --overwrite"));
            let mut files = lasting_files(&workplace.path(""));
            files.retain(|name, _| name.to_str().unwrap().starts_with("out"));
            for name in files.keys().filter(|name| workplace.path("").join(name).is_file()) {
                fs::remove_file(workplace.path("").join(name)).unwrap();
            }
            files
        });
        assert!(one.len() >= 3 && one == two && one == three, "{request}");
        seen.insert(one);
        let _ = fs::remove_dir_all(workplace.path("out"));
    }
    assert_eq!(seen.len(), 6, "the requests do not differ in what they ask for");
}

#[test]
#[ignore = "needs the trained models"]
fn bytes_of_deform2_ignore_thread_count() {
    let model = shared("deform2");
    let workplace = Workplace::new();
    let input = model.display();
    let [one, two] = ["1", "2"].map(|threads| {
        workplace.done(&format!(
            "compress {input} --cameras {input} --split test --ratio 0.3 --no-refine \
             --threads {threads} --overwrite -o out"
        ));
        lasting_files(&workplace.path("out"))
    });
    assert!(one == two);
}

#[test]
fn recipe_beside_a_result_repeats_it() {
    let workplace = Workplace::new();
    workplace.done(
        "compress {tiny} -o first --preset paper --set mu=2 --set tau_static=0.2 --set clip_norm=true --set passes=0.05,3,0.8,0.7",
    );
    workplace.done("compress {tiny} -o second --recipe first/recipe.toml");
    assert!(lasting_files(&workplace.path("first")) == lasting_files(&workplace.path("second")));
    workplace.done("compress {tiny} -o third --preset paper");
    assert!(lasting_files(&workplace.path("first")) != lasting_files(&workplace.path("third")));
}

#[test]
fn results_can_be_compressed_again() {
    let workplace = Workplace::new();
    let cameras = tiny().display().to_string();
    workplace.done(&format!("compress {{tiny}} --cameras {cameras} -o first --count 120"));
    workplace.done(&format!("compress first --cameras {cameras} -o second --count 60"));
    assert_eq!(PlyRows::read(&point_cloud(&workplace.path("second"))).rows.len(), 60);
}

#[test]
fn overwrite_replaces_an_earlier_result_completely() {
    let workplace = Workplace::new();
    workplace.done("compress {tiny} -o out --preset paper");
    workplace.done("compress {tiny} -o fresh --preset default");
    workplace.done("compress {tiny} -o out --preset default --overwrite");
    assert!(lasting_files(&workplace.path("out")) == lasting_files(&workplace.path("fresh")));
    assert_eq!(fs::read_dir(workplace.path("")).unwrap().count(), 2);
}
