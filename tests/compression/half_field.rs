//! Tests of model folders whose deformation field is stored in half precision: they are smaller, keep the bound on
//! quality, and open in every program that opens the original.

use std::fs;
use std::path::Path;

use crate::scene::{Workplace, check_model_folder, field_file, lasting_files, reason_left_out, shared, tiny};
use serde_json::Value;

fn len(path: &Path) -> u64 {
    fs::metadata(path).unwrap().len()
}

/// Name of the conversion to half precision in the summary's list of omitted work. The list has this name, with a
/// reason, if the stage runs and keeps the field in full precision.
const HALF_PRECISION: &str = "half precision of the field";

const QUICKLY: &str = "{tiny} --cameras {tiny} --no-refine --prune-only --overwrite";

#[test]
fn half_precision_is_used_only_within_its_bound() {
    let workplace = Workplace::new();
    let own = field_file(&tiny());
    let exact = workplace.summary(&format!("{QUICKLY} -o exact --set field=exact"));
    assert_eq!(fs::read(field_file(&workplace.path("exact"))).unwrap(), fs::read(&own).unwrap());
    assert!(exact["field"].is_null() && reason_left_out(&exact, HALF_PRECISION).is_none());

    // A margin of 0 dB accepts any rounding error that is smaller than the error of pruning.
    let half = workplace.summary(&format!("{QUICKLY} -o half --ratio 0.3 --set field_margin=0"));
    let found = &half["field"];
    assert_eq!((&found["half"], reason_left_out(&half, HALF_PRECISION)), (&Value::Bool(true), None));
    assert!(found["rounding"].as_f64().unwrap() >= found["least"].as_f64().unwrap(), "{found}");
    assert!(len(&field_file(&workplace.path("half"))) < len(&own) * 9 / 10);

    // No render reaches 100 dB: after nearly lossless pruning a margin of 90 dB refuses the rounding.
    let refused = workplace.summary(&format!("{QUICKLY} -o refused --ratio 0.3 --set field_margin=90"));
    match refused["field"]["half"].as_bool().unwrap() {
        // A rounding PSNR of 60 dB is always accepted.
        true => assert!(refused["field"]["rounding"].as_f64().unwrap() >= 60.0, "{}", refused["field"]),
        false => {
            let rounding =
                format!("{:.1} dB from those with the exact", refused["field"]["rounding"].as_f64().unwrap());
            assert!(reason_left_out(&refused, HALF_PRECISION).unwrap().contains(&rounding), "{refused}");
            assert_eq!(fs::read(field_file(&workplace.path("refused"))).unwrap(), fs::read(&own).unwrap());
        }
    }
}

#[test]
fn half_field_result_compresses_again_to_the_same_bytes() {
    let workplace = Workplace::new();
    let how = "--no-refine --prune-only --set field_margin=0";
    workplace.done(&format!("compress {{tiny}} --cameras {{tiny}} {how} --ratio 0.5 -o once"));
    let evaluated = workplace.done("evaluate {tiny} once --cameras {tiny} --json");
    let evaluated: Value = serde_json::from_str(&evaluated).unwrap();
    assert!(evaluated["psnr"].as_f64().unwrap() > 15.0, "{evaluated}");
    for threads in [1, 3] {
        let name = format!("twice{threads}");
        workplace.done(&format!("compress once --cameras {{tiny}} {how} --ratio 0.5 --threads {threads} -o {name}"));
    }
    assert!(lasting_files(&workplace.path("twice1")) == lasting_files(&workplace.path("twice3")));
    // Rounding values that are rounded already does not change them.
    let fields = ["once", "twice1"].map(|name| fs::read(field_file(&workplace.path(name))).unwrap());
    assert!(fields[0] == fields[1], "a field in half precision changed when it was written once more");
}

#[test]
fn target_size_counts_the_field_as_written() {
    let workplace = Workplace::new();
    let most = 70_000;
    let counts = ["half", "exact"].map(|field| {
        let how = format!("--no-refine --size {most}B --set field={field} --set field_margin=0");
        let summary = workplace.summary(&format!("{{tiny}} --cameras {{tiny}} {how} -o {field}"));
        let written = summary["output_bytes"].as_u64().unwrap();
        assert!(written <= most, "{written} of {most}");
        summary["gaussians"].as_u64().unwrap()
    });
    let saved = len(&field_file(&workplace.path("exact"))) - len(&field_file(&workplace.path("half")));
    // One Gaussian takes 248 bytes; the size search is exact to 1%.
    assert!(counts[0] >= counts[1] + saved / 248 - 8, "{counts:?} Gaussians, {saved} bytes saved");
}

#[test]
#[ignore = "needs Python"]
fn original_loader_opens_a_half_precision_field() {
    let workplace = Workplace::new();
    workplace.done(&format!("compress {QUICKLY} --ratio 0.4 --set field_margin=0 -o small"));
    let (accepted, text) = check_model_folder(&tiny(), &workplace.path("small"));
    assert!(accepted && text.contains("tensors in half precision") && text.contains("can open it"), "{text}");
}

/// Compresses the trained model `name` to 10% of its Gaussians and checks that the whole folder has at most 40% of the
/// bytes of the original.
fn assert_tenth_is_small(name: &str) {
    let model = shared(name);
    let workplace = Workplace::new();
    let words = "--no-refine --prune-only --ratio 0.1 --preset paper --set field=half --json -o small";
    let model_text = model.to_str().unwrap();
    let words = ["compress", model_text, "--cameras", model_text].into_iter().chain(words.split_whitespace());
    let run = workplace.run_words(words);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let summary: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(summary["field"]["half"], true, "{}", summary["field"]);
    let [before, after] = [&model, &workplace.path("small")].map(|model| {
        let field = field_file(model);
        len(&field) + len(&field.with_file_name("point_cloud.ply")) + len(&model.join("cfg_args"))
    });
    assert!(5 * after <= 2 * before, "{name}: {after} of {before} bytes");
}

#[test]
#[ignore = "needs the trained models"]
fn a_tenth_of_deform2_is_at_most_two_fifths_of_its_bytes() {
    assert_tenth_is_small("deform2");
}

#[test]
#[ignore = "needs the trained models"]
fn a_tenth_of_room2_dynerf_is_at_most_two_fifths_of_its_bytes() {
    assert_tenth_is_small("room2_dynerf");
}
