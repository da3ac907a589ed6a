//! Tests of what a run states about itself: a run with its recipe writes the same files, its summary can be read back,
//! its planned number of reads holds, and a dry run states the same as the run.

use crate::scene::{Run, Workplace, lasting_files, shared};
use serde_json::Value;
use splatsieve::files::text::json_text;
use splatsieve::pipeline::summary::{SCHEMA, Summary};

/// Runs a compression with `arguments`, and again with the recipe that the first run wrote. Checks that both write the
/// same files. Returns the second run. `name` is the start of the names of both outputs.
fn assert_recipe_repeats(workplace: &Workplace, name: &str, arguments: &str) -> Run {
    let first = workplace.run(&format!("compress {arguments} -o {name}_first"));
    assert_eq!(first.code, 0, "{}", first.stderr);
    let input = arguments.split_whitespace().next().unwrap();
    let recipe = match workplace.path(&format!("{name}_first")).is_dir() {
        true => format!("{name}_first/recipe.toml"),
        false => format!("{name}_first.recipe.toml"),
    };
    // A recipe does not name folders outside its own, so the cameras are given again.
    let cameras = if arguments.contains("--cameras {tiny}") { "--cameras {tiny}" } else { "" };
    let again = workplace.run(&format!("compress {input} --recipe {recipe} {cameras} -o {name}_again"));
    assert_eq!(again.code, 0, "{}", again.stderr);
    let [first, second] = ["first", "again"].map(|turn| lasting_files(&workplace.path(&format!("{name}_{turn}"))));
    assert!(first == second, "{arguments}: the recipe does not repeat the run");
    assert!(!first.is_empty());
    again
}

#[test]
fn recipe_beside_a_result_repeats_its_run() {
    let workplace = Workplace::new();
    for (k, options) in [
        "--cameras {tiny} --ratio 0.4",
        "--cameras {tiny} --count 77 --split test --preset paper",
        "--cameras {tiny} --prune-only --set mu=2",
        "--cameras {tiny} --merge-only --preset strong --split all",
        "--cameras {tiny} --keep-ids 3,10-20 --drop-ids 200-210",
        "--cameras {tiny} --keep-box -1,-1,-1,0,0,0.5",
        "--cameras {tiny} --as ply-sequence",
    ]
    .iter()
    .enumerate()
    {
        let run = assert_recipe_repeats(&workplace, &format!("run{k}"), &format!("{{tiny}} {options}"));
        assert!(!run.stdout.contains("another input"), "{}", run.stdout);
    }
}

#[test]
fn flags_override_recipes_and_foreign_recipes_are_noted() {
    let workplace = Workplace::new();
    workplace.done("compress {tiny} --cameras {tiny} --ratio 0.5 -o half");
    workplace.done("test-scene --gaussians 600 --frames 4 -o demo");
    let demo = "demo/scene.gseq --cameras demo/cameras.json --recipe half/recipe.toml";
    let summary = workplace.summary(&format!("{demo} -o other.gseq"));
    assert_eq!(summary["gaussians"], 300);
    let notes = summary["notes"].to_string();
    assert!(notes.contains("another input"), "{notes}");
    let summary = workplace.summary(&format!("{demo} --count 123 -o third.gseq"));
    assert_eq!(summary["gaussians"], 123);
}

#[test]
fn summary_reads_back_and_names_its_schema() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 900 --frames 6 -o demo");
    for (k, options) in ["", "--preset strong", "--preset paper", "--prune-only"].iter().enumerate() {
        workplace.done(&format!("compress demo/scene.gseq --cameras demo/cameras.json {options} -o out{k}.gseq"));
        let text = std::fs::read_to_string(workplace.path(&format!("out{k}.gseq.summary.json"))).unwrap();
        let summary: Summary = serde_json::from_str(&text).unwrap();
        assert_eq!(summary.schema, SCHEMA);
        let (before, after): (Value, Value) =
            (serde_json::from_str(&text).unwrap(), serde_json::from_str(&json_text(&summary)).unwrap());
        assert_eq!(after, before, "{options}");
    }
}

#[test]
fn every_field_of_a_summary_is_described() {
    let workplace = Workplace::new();
    let summaries = [
        workplace.summary("{tiny} --cameras {tiny} --preset strong -o out"),
        workplace.summary("{tiny} --cameras {tiny} --no-refine --min-psnr 25dB -o out.gsz"),
    ];
    let described = include_str!("../../format/SUMMARY.md");
    let mut pending: Vec<(String, &Value)> = summaries.iter().map(|summary| (String::new(), summary)).collect();
    while let Some((name, value)) = pending.pop() {
        // The counts inside `passes` are described in another place; `bits` has the names of attributes and tensors.
        let is_described = !["passes", "bits"].contains(&&*name);
        let inner: Vec<(String, &Value)> = match value {
            Value::Object(fields) if is_described => fields.iter().map(|(k, v)| (k.clone(), v)).collect(),
            Value::Array(values) => values.iter().map(|value| (name.clone(), value)).collect(),
            _ => Vec::new(),
        };
        for (field, value) in inner {
            assert!(described.contains(&format!("`{field}`")), "{field} is not described");
            pending.push((field, value));
        }
    }
}

#[test]
fn dry_run_reports_what_the_run_reports() {
    let workplace = Workplace::new();
    let options = "{tiny} --cameras {tiny} --ratio 0.5 -o out";
    let dry = workplace.summary(&format!("{options} --dry-run"));
    assert!(lasting_files(&workplace.path("")).is_empty(), "a dry run makes nothing");
    let wet = workplace.summary(options);
    for field in ["gaussians", "cameras", "output"] {
        assert_eq!(dry[field], wet[field], "{field}");
    }
    // Stages that are left out are predicted; the measured reasons may differ.
    let said = |summary: &Value| -> Vec<String> {
        let left_out = summary["left_out"].as_array().unwrap().iter().map(|left| left["what"].to_string());
        left_out.chain(summary["notes"].as_array().unwrap().iter().map(Value::to_string)).collect()
    };
    let said_by_run = said(&wet);
    assert!(said(&dry).iter().all(|said| said_by_run.contains(said)), "{:?} {said_by_run:?}", said(&dry));
    for written in dry["would_write"].as_array().unwrap() {
        assert!(workplace.path(written.as_str().unwrap()).exists(), "{written}");
    }
    let names = |stages: &Value| -> Vec<String> {
        stages.as_array().unwrap().iter().map(|stage| stage["name"].as_str().unwrap().to_owned()).collect()
    };
    let (foreseen, done) = (names(&dry["forecast"]["stages"]), names(&wet["stages"]));
    assert!(done.iter().all(|stage| foreseen.contains(stage) || stage == "read" || stage == "prune"), "{done:?}");
    let described = include_str!("../../format/SUMMARY.md");
    for field in dry.as_object().unwrap().keys() {
        assert!(described.contains(&format!("`{field}`")), "{field} is not described");
    }
}

/// Runs a compression of a container and checks that it read no more than its plan states. Returns the number of full
/// reads (every frame of the input once).
fn reads_as_planned(workplace: &Workplace, arguments: &str) -> f64 {
    let summary = workplace.summary(arguments);
    let planned = summary["planned_reads"].as_f64().unwrap();
    let read: f64 =
        summary["stages"].as_array().unwrap().iter().map(|stage| stage["full_reads"].as_f64().unwrap()).sum();
    // Tiles that are still in memory from the timing measurement are not read again.
    assert!(read > 0.2 && read <= 1.1 * planned, "{arguments}: read {read} times, planned at most {planned}");
    read
}

#[test]
#[ignore = "needs time"]
fn presets_read_no_more_than_planned_in_any_memory() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 3000 --frames 64 -o demo");
    for preset in ["default", "paper", "gentle", "strong"] {
        for (k, options) in
            ["", "--memory 48MiB", "--merge-only --memory 48MiB", "--ratio 0.2 --memory 48MiB"].iter().enumerate()
        {
            if preset == "gentle" && options.contains("merge-only") {
                continue;
            }
            let output = format!("{preset}{k}.gseq");
            let arguments = format!(
                "demo/scene.gseq --cameras demo/cameras.json --preset {preset} {options} --set refine_steps=60 --set refine_steps_per_prune=10 -o {output}"
            );
            let read = reads_as_planned(&workplace, &arguments);
            // An input that fits into memory is read once; two threads may start to read the same tile at the same
            // time.
            assert!(k > 0 || read <= 1.1, "{preset}: {read}");
        }
    }
}

#[test]
#[ignore = "needs the trained models"]
fn default_run_reads_a_container_at_most_2_5_times() {
    let model = shared("deform2");
    let workplace = Workplace::new();
    let model = model.display();
    workplace.done(&format!("convert {model} packed.gseq --cameras {model}"));
    let read = reads_as_planned(&workplace, &format!("packed.gseq --cameras {model} -o small.gseq"));
    assert!(read <= 2.5, "{read}");
}

#[test]
fn reported_quality_equals_evaluate_on_the_same_views() {
    let workplace = Workplace::new();
    for output in ["out", "out.gsz", "out.splatv", "out.ftgs.ply", "out.tsog"] {
        let summary =
            workplace.summary(&format!("{{tiny}} --cameras {{tiny}} --ratio 0.4 --set refine_steps=40 -o {output}"));
        assert!(summary["quality"]["before_conversion"].is_null(), "{output} was not read back");
        let quality = &summary["quality"];
        assert_eq!(quality["kind"], "test", "{quality}");
        let views = quality["views"].as_u64().unwrap();
        let line = format!("evaluate {{tiny}} {output} --cameras {{tiny}} --max-views {views} --json");
        let found: Value = serde_json::from_str(&workplace.done(&line)).unwrap();
        for score in ["psnr", "ssim"] {
            let [reported, evaluated] = [quality, &found].map(|scores| scores[score].as_f64().unwrap());
            assert!((reported - evaluated).abs() < 0.01, "{output}: {score} {reported}, evaluate says {evaluated}");
        }
    }
}

#[test]
fn commands_that_write_files_also_print_json() {
    let workplace = Workplace::new();
    workplace.done("compress {tiny} --cameras {tiny} -o small --ratio 0.5 --no-refine --quiet");
    for (line, keys) in [
        ("score {tiny} --cameras {tiny} -o rows.csv", &["output", "gaussians", "kept", "notes"][..]),
        ("render {tiny} --cameras {tiny} --frame 0 --view 0 -o a.png", &["output", "views", "notes"]),
        (
            "render {tiny} --cameras {tiny} --video a.gif --view 0",
            &["output", "frames", "width", "height", "fps", "notes"],
        ),
        ("view {tiny} small --cameras {tiny} --max-frames 2 -o a.html", &["page", "frames", "bytes", "files", "notes"]),
        ("report {tiny} small --cameras {tiny} -o page", &["page", "results", "notes"]),
    ] {
        let printed = workplace.done(&format!("{line} --json --quiet"));
        let value: Value = serde_json::from_str(&printed).unwrap_or_else(|error| panic!("{line}: {error}: {printed}"));
        let mut found: Vec<&str> = value.as_object().unwrap().keys().map(String::as_str).collect();
        let mut expected = keys.to_vec();
        found.sort_unstable();
        expected.sort_unstable();
        assert_eq!(found, expected, "{line}");
    }
}
