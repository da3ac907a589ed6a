//! Tests of `precision`: exact settings have no error, the error of converging settings falls at the rate that theory
//! predicts, and the output folder has only the diagrams.

use std::fs;

use crate::scene::{Workplace, files};
use serde_json::{Value, json};

fn read(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

/// Converts cameras from the file format of 3DGS to `transforms.json`. The last camera becomes the test view.
fn held_out(cameras: &Value) -> Value {
    let cameras = cameras.as_array().unwrap();
    let frame = |(view, camera): (usize, &Value)| {
        let row = |axis: usize| -> [f64; 4] {
            let along = [0, 1, 2].map(|k| camera["rotation"][k][axis].as_f64().unwrap());
            let eye = [0, 1, 2].map(|k| camera["position"][k].as_f64().unwrap());
            let [x, y, z] = along;
            [x, y, z, -(x * eye[0] + y * eye[1] + z * eye[2])]
        };
        json!({"v": view, "split": if view + 1 == cameras.len() { "test" } else { "train" },
               "width": camera["width"], "height": camera["height"], "fx": camera["fx"], "fy": camera["fy"],
               "cx": 128.0, "cy": 96.0, "w2c": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]})
    };
    json!({"frames": cameras.iter().enumerate().map(frame).collect::<Vec<_>>()})
}

/// Returns the curves of the setting `knob` in `found`, the JSON that `precision` prints. A curve has the errors at all
/// measured values of the setting.
fn curves<'a>(found: &'a Value, knob: &str) -> &'a Vec<Value> {
    let knobs = found["knobs"].as_array().unwrap();
    knobs.iter().find(|entry| entry["name"] == knob).unwrap_or_else(|| panic!("no {knob}"))["curves"]
        .as_array()
        .unwrap()
}

/// Returns the errors of the kind `kind` in `curve` (JSON), one for each measured value of the varied setting.
fn errors(curve: &Value, kind: &str) -> Vec<f64> {
    curve["marks"].as_array().unwrap().iter().map(|mark| mark["errors"][kind].as_f64().unwrap()).collect()
}

fn observed(curve: &Value, kind: &str) -> f64 {
    let orders = curve["orders"].as_array().unwrap();
    orders.iter().find(|order| order["of"] == kind).unwrap()["observed"].as_f64().unwrap()
}

#[test]
fn exact_settings_have_no_error_and_others_converge() {
    let place = Workplace::new();
    let demo = "test-scene -o d --gaussians 1000 --frames 5";
    place.done(demo);
    let cameras = read(&fs::read_to_string(place.path("d/cameras.json")).unwrap());
    fs::write(place.path("d/cameras.json"), held_out(&cameras).to_string()).unwrap();
    let run = place.run(
        "precision d/scene.gseq --cameras d/cameras.json -o diagrams --knobs scoring,rounds,percentiles,sums --repeat 1 --json",
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let found = read(&run.stdout);
    assert_eq!(found, read(&fs::read_to_string(place.path("diagrams/precision.json")).unwrap()));
    assert_eq!(found["kept"], 300);
    // 5 frames of 6 cameras, of which one is a test camera.
    assert_eq!((&found["views_scored"], &found["judged"]), (&25.into(), &5.into()));

    for curve in curves(&found, "scoring") {
        for kind in ["C", "W", "kept", "staying", "added"] {
            assert_eq!(errors(curve, kind).last(), Some(&0.0), "{kind} of {}", curve["name"]);
        }
        let of_c = errors(curve, "C");
        assert!(of_c[0] > 0.0, "{}: nothing is sampled", curve["name"]);
        assert_ne!(of_c[0], of_c[of_c.len() - 2], "{}: nothing is turned", curve["name"]);
        assert!(curve["name"] != "scoring_views" || errors(curve, "staying")[0] > 0.0, "as many stay");
        let costs = curve["marks"].as_array().unwrap().iter().map(|mark| &mark["cost"]);
        for cost in costs {
            let seconds = ["least", "median", "most"].map(|name| cost["seconds"][name].as_f64().unwrap());
            assert!(seconds.is_sorted() && seconds[0] > 0.0 && cost["runs"] == 1, "{cost}");
        }
    }
    let rounds = curves(&found, "rounds");
    for curve in rounds {
        let values = errors(curve, "kept");
        assert!(
            values[0] > 0.0 && values[0] > values[values.len() - 2] && values.last() == Some(&0.0),
            "{}: {values:?}",
            curve["name"]
        );
    }

    let percentiles = &curves(&found, "percentiles")[0];
    // The scene has so few views that all are used. Exact percentiles therefore give the same PSNR as the finest
    // sampling of views.
    let [exact, finest] = [percentiles, &curves(&found, "scoring")[0]]
        .map(|curve| &curve["marks"].as_array().unwrap().last().unwrap()["psnr"]);
    assert!(exact.is_number() && exact == finest, "{exact} {finest}");
    let values = errors(percentiles, "percentiles");
    // At most half a bucket of 2⁻ᵇⁱᵗˢ; exact percentiles have no error.
    for (mark, error) in percentiles["marks"].as_array().unwrap().iter().zip(&values) {
        assert!(*error <= 0.51 * mark["step"].as_f64().unwrap(), "{mark}");
    }
    let order = observed(percentiles, "percentiles");
    assert!((0.6..1.4).contains(&order), "percentiles converge at order {order}, not 1");

    let [plain, compensated, scan] = &curves(&found, "sums")[..] else { panic!("three ways to sum") };
    for kind in ["D", "kappa"] {
        let last = |curve| *errors(curve, kind).last().unwrap();
        assert!(last(plain) > 1e-6, "{kind}: f32 loses nothing: {}", last(plain));
        assert!(last(compensated) < 1e-7 && last(scan) < 1e-11, "{kind}: {} {}", last(compensated), last(scan));
        assert!(errors(plain, kind).is_sorted(), "{kind}: errors of f32 do not grow with frames");
    }

    let page = fs::read_to_string(place.path("diagrams/precision.html")).unwrap();
    for words in ["scoring: error added", "order of percentiles", "relative L2 error of kappa", "peak memory"] {
        assert!(page.contains(words), "{words} is missing");
    }
    let csv = fs::read_to_string(place.path("diagrams/precision.csv")).unwrap();
    let marks = found["knobs"].as_array().unwrap().iter().flat_map(|knob| knob["curves"].as_array().unwrap());
    let lines: usize = marks
        .flat_map(|curve| curve["marks"].as_array().unwrap())
        .map(|mark| mark["errors"].as_object().unwrap().len())
        .sum();
    assert_eq!(csv.lines().count(), lines + 1);
    let mut left: Vec<_> =
        fs::read_dir(place.path("diagrams")).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["precision.csv", "precision.html", "precision.json", "summary.json"]);
}

#[test]
#[ignore = "needs time"]
fn precision_runs_equal_compress_at_any_thread_count() {
    let place = Workplace::new();
    place.done("test-scene -o d --gaussians 1500 --frames 4");
    let found = read(&place.done(
        "precision d/scene.gseq --cameras d/cameras.json -o diagrams --knobs machine,merging --ratio 0.4 --repeat 1 --json",
    ));
    for curve in curves(&found, "machine") {
        let values = errors(curve, "bytes");
        assert!(!values.is_empty() && values.iter().all(|&error| error == 0.0), "{curve}");
    }
    let marks = curves(&found, "merging")[0]["marks"].as_array().unwrap();
    let ran = |options: &str| {
        place.done(&format!(
            "compress d/scene.gseq --cameras d/cameras.json -o small.gseq --overwrite --ratio 0.4 --no-refine {options}"
        ));
        let evaluated =
            read(&place.done("evaluate d/scene.gseq small.gseq --cameras d/cameras.json --max-frames 12 --json"));
        evaluated["psnr"].as_f64().unwrap()
    };
    // Merge radius 0: pruning only. The largest radius is four times that of the recipe, without choosing by renders.
    let [alone, widest] = [&marks[0], &marks[4]];
    assert_eq!((&alone["value"], &widest["value"]), (&0.0.into(), &0.02.into()));
    for (mark, options) in
        [(alone, "--prune-only"), (widest, "--set choose_by_views=false --set passes=0.02,1,0.95,0.9")]
    {
        let (got, expected) = (mark["psnr"].as_f64().unwrap(), ran(options));
        assert!((got - expected).abs() < 1e-9, "{options}: {got} {expected}");
    }
    assert_ne!(alone["psnr"], widest["psnr"], "nothing merges");
}

#[test]
fn impossible_settings_are_refused_before_writing() {
    let place = Workplace::new();
    place.done("test-scene -o d --gaussians 300 --frames 3");
    let before = files(&place.path(""));
    for (words, expected) in [
        ("precision d/scene.gseq -o diagrams", "give --cameras"),
        ("precision d/scene.gseq --cameras d/cameras.json -o diagrams --ratio 0", "--ratio"),
        ("precision d/scene.gseq --cameras d/cameras.json -o diagrams --knobs luck", "luck"),
        ("precision - --cameras d/cameras.json -o diagrams", "pack the stream first"),
    ] {
        let run = place.run(words);
        assert!(run.code == 2 && run.stderr.contains(expected), "{words}: {} {}", run.code, run.stderr);
        assert_eq!(files(&place.path("")), before, "{words}");
    }
}

#[test]
fn unused_settings_of_a_recipe_are_left_out_by_name() {
    let place = Workplace::new();
    place.done("test-scene -o d --gaussians 300 --frames 3");
    let found = read(&place.done(
        "precision d/scene.gseq --cameras d/cameras.json -o diagrams --preset paper --knobs scoring,rounds,percentiles,refining \
         --repeat 1 --json",
    ));
    let names: Vec<&Value> = found["knobs"].as_array().unwrap().iter().map(|knob| &knob["name"]).collect();
    assert_eq!(names, ["percentiles"]);
    let notes = found["notes"].to_string();
    for words in ["scoring: not run", "rounds: not run", "refining: not run"] {
        assert!(notes.contains(words), "{notes}");
    }
}
