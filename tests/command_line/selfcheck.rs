//! Tests of `splatsieve selfcheck` as users and scripts run it. The conditions under which a case fails are tested
//! beside the cases.

use crate::scene::Workplace;

/// Names of the cases of the self-check, in the order of the pipeline.
const CASES: [&str; 28] = [
    "motion and life",
    "motion far away",
    "motion of any size",
    "uneven frames",
    "short lives",
    "steady opacity",
    "projected area",
    "needle on screen",
    "percentiles",
    "extent of a scene",
    "mixture",
    "needle and its twin",
    "proxy of five",
    "duplicates",
    "deformation field",
    "field's derivative",
    "one Gaussian",
    "many Gaussians",
    "contributions",
    "removal errors",
    "harmonics",
    "backward pass",
    "PSNR and SSIM",
    "container",
    "container in bounds",
    "archive's grid",
    "archive's codes",
    "1 and 2 threads",
];

#[test]
fn table_has_bound_error_and_verdict_of_every_case() {
    let workplace = Workplace::new();
    assert!(workplace.done("--help").contains("selfcheck"));
    let table = workplace.done("selfcheck");
    let lines: Vec<&str> = table.lines().collect();
    assert_eq!(lines.len(), 1 + CASES.len() + 1, "{table}");
    for (line, name) in lines[1..].iter().zip(CASES) {
        let columns: Vec<&str> = line.strip_prefix(name).expect(line).split_whitespace().take(3).collect();
        let [bound, error, pass] = columns[..] else { panic!("{line}") };
        let [bound, error] = [bound, error].map(|number| number.parse::<f64>().expect(line));
        assert!(error <= bound && pass == "pass" && line.chars().count() <= 80, "{line}");
    }
    assert!(lines.last().unwrap().starts_with("28 of 28 pass in "), "{table}");
    assert!(std::fs::read_dir(workplace.path("")).unwrap().next().is_none(), "it left something behind");
}

#[test]
fn json_holds_every_case_as_numbers() {
    let found: serde_json::Value = serde_json::from_str(&Workplace::new().done("selfcheck --json")).unwrap();
    assert_eq!(found["pass"], true);
    assert!(found["seconds"].as_f64().unwrap() > 0.0 && found["tool"].as_str().unwrap().starts_with("splatsieve "));
    let cases = found["cases"].as_array().unwrap();
    let names: Vec<&str> = cases.iter().map(|case| case["name"].as_str().unwrap()).collect();
    assert_eq!(names, CASES);
    for case in cases {
        assert!(case["error"].as_f64().unwrap() <= case["bound"].as_f64().unwrap(), "{case}");
        assert!(case["pass"] == true && !case["what"].as_str().unwrap().is_empty(), "{case}");
    }
}
