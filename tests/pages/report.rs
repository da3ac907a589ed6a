//! Tests of the command `report` as a user runs it. `report_browser` tests the page in a browser.

use std::fs;
use std::path::Path;

use crate::scene::{Workplace, files};
use serde_json::{Value, json};

/// Writes the test scene with its cameras into `d`, and compresses it into `small.gseq`, with proxies and companion
/// files.
fn compressed() -> Workplace {
    let at = Workplace::new();
    at.done("test-scene -o d --gaussians 1200 --frames 5");
    at.done("compress d/scene.gseq --cameras d/cameras.json --set choose_by_views=false --no-refine -o small.gseq");
    at
}

const MODELS: &str = "d/scene.gseq small.gseq --cameras d/cameras.json";

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap()
}

fn data(at: &Workplace, folder: &str) -> Value {
    serde_json::from_str(&read(&at.path(folder).join("report.json"))).unwrap()
}

/// Returns the data of a sweep with two methods and one varied parameter, as in `sweep.json`.
fn sweep() -> Value {
    let point = |method: &str, count: usize, psnr: f64| {
        json!({
            "method": method, "asked": 0.5, "count": count, "bytes": 60 * count, "psnr": psnr, "ssim": 0.9,
            "temporal": null, "seconds": 1.5, "peak_memory_bytes": 1 << 26,
        })
    };
    let setting = |value: u32, psnr: f64| {
        let mut setting = point("default", 300, psnr);
        setting["value"] = json!(value);
        setting
    };
    json!({
        "tool": "splatsieve 0.1.0", "path": "d/scene.gseq", "digest": "00", "gaussians": 1200, "bytes": 72_000,
        "threads": 2, "views": 5, "cameras": "d/cameras.json",
        "points": [point("default", 600, 40.0), point("default", 300, 30.0), point("<i>odd</i>", 600, 20.0)],
        "runs": 3, "knobs": [{ "parameter": "<b>knob</b>", "settings": [setting(20, 31.0), setting(50, 33.0)] }],
        "notes": ["three <b>points</b>"],
    })
}

#[test]
fn report_data_equal_those_of_evaluate_and_of_the_run() {
    let at = compressed();
    at.done("render d/scene.gseq --cameras d/cameras.json --all -o photographs");
    let rest = format!("{MODELS} --ground-truth photographs --max-frames 3");
    let mut expected: Value = serde_json::from_str(&at.done(&format!("evaluate {rest} --json --csv all.csv"))).unwrap();
    // The files of a report name no folders.
    expected["path"]["original"] = "scene.gseq".into();
    // Times differ between runs.
    expected.as_object_mut().unwrap().remove("render_ms");
    fs::write(at.path("sweep.json"), sweep().to_string()).unwrap();
    let said = at.done(&format!("report {rest} --sweep sweep.json -o r"));
    let found = data(&at, "r");
    assert_eq!(found["evaluation"], expected);
    assert!(read(&at.path("r/views.csv")) == read(&at.path("all.csv")), "views.csv is not that of evaluate");
    let verdict = found["verdict"].as_str().unwrap();
    assert!(said.starts_with(verdict) && said.trim_end().ends_with("report.html"), "{said}");
    let run: Value = serde_json::from_str(&read(&at.path("small.gseq.summary.json"))).unwrap();
    assert_eq!(found["run"], run);
    assert_eq!(read(&at.path("r/stages.csv")).lines().count(), 1 + run["stages"].as_array().unwrap().len());
    assert_eq!(found["trade_off"], sweep());
    assert_eq!(read(&at.path("r/trade_off.csv")).lines().count(), 4);
    assert_eq!(read(&at.path("r/knobs.csv")).lines().count(), 3);
    assert_eq!(found["missing"], json!([]));
    // Scores computed anew equal those of the run; otherwise a note says so.
    assert_eq!(found["notes"], json!([]));
    let recipe = at.path("small.gseq.recipe.toml");
    fs::write(&recipe, read(&recipe).replace("view_stride = 1", "view_stride = 2")).unwrap();
    at.done(&format!("report {rest} -o other"));
    let note = data(&at, "other")["notes"][0].as_str().unwrap().to_owned();
    assert!(note.contains("differ from those of the run"), "{note}");
    assert_eq!(read(&at.path("r/failure_modes.csv")).lines().count(), 4);

    // Every histogram counts every Gaussian once: as kept, merged or dropped, in agreement with the index map.
    let map = crate::scene::index_map(&at.path("small.gseq.index_map.npy"));
    let dropped = map.iter().filter(|&&place| place == -1).count() as u64;
    for histogram in found["histograms"].as_array().unwrap() {
        let sum = |fate: &str| {
            let bins = histogram["bins"][fate].as_array().unwrap().iter();
            bins.map(|n| n.as_u64().unwrap()).sum::<u64>() + histogram["zero"][fate].as_u64().unwrap()
        };
        let (kept, merged) = (sum("kept"), sum("merged"));
        assert_eq!((sum("dropped"), kept + merged), (dropped, 1200 - dropped), "{}", histogram["name"]);
        assert!(merged > 0 && kept > 0, "{}", histogram["name"]);
    }
    // The first shown render is the worst of the list.
    let psnr = |view: &Value| view["loss"]["psnr"].as_f64().unwrap();
    let worst = found["view_scores"].as_array().unwrap().iter().map(psnr).fold(f64::INFINITY, f64::min);
    assert_eq!(found["shown"][0]["psnr"].as_f64(), Some(worst));
    assert!(found["shown"][0]["why"].as_array().unwrap().contains(&json!("worst render")));
}

#[test]
fn report_page_is_well_formed_self_contained_and_small() {
    let at = compressed();
    fs::write(at.path("sweep.json"), sweep().to_string()).unwrap();
    at.done(&format!("report {MODELS} --sweep sweep.json -o r"));
    let page = read(&at.path("r/report.html"));
    balanced(&page);
    for outside in ["http:", "https:", "url(", "@import", "<link", "<iframe", "fetch(", "XMLHttpRequest"] {
        assert!(!page.contains(outside), "the page holds {outside:?}");
    }
    assert!(page.contains("default-src 'none'"));
    for part in [
        "Error by run time",
        "Error by memory",
        "S_static",
        "powers of ten",
        "peak memory so far",
        "left out",
        "Thin structures",
    ] {
        assert!(page.contains(part), "{part} is missing");
    }
    assert!(!page.contains("<i>odd") && !page.contains("<b>points"), "text of a file became elements");
    assert!(page.len() < 5_000_000, "{} bytes", page.len());
    // Each of five frames has three images, with the figures of evaluate.
    let films = data(&at, "r")["films"].as_array().unwrap().clone();
    assert_eq!(page.matches("data:image/jpeg;base64,").count(), films.len() * 5 * 3);
    assert_eq!(films[0]["frames"], json!([0, 1, 2, 3, 4]));
    let shown = &data(&at, "r")["shown"][0];
    assert_eq!(films[0]["psnr"][shown["frame"].as_u64().unwrap() as usize], shown["psnr"]);
    // The base64 of an image may contain any letters.
    let written = |part: &str| part.split_once('"').map_or(part, |(_, after)| after).to_owned();
    let words: String = page.split(";base64,").map(written).collect();
    for none in ["NaN", "inf<", "inf,", ">-0<"] {
        assert!(!words.contains(none), "{none} is no number");
    }
}

/// Returns the part of the page before the collapsed details.
fn overview(page: &str) -> &str {
    page.split_once("<section id=\"details\">").expect("a page with details").0
}

#[test]
fn overview_has_verdict_and_changes_without_symbols() {
    let at = compressed();
    at.done("render d/scene.gseq --cameras d/cameras.json --all -o photographs");
    at.done(&format!("report {MODELS} --ground-truth photographs -o r"));
    at.done(&format!("report {MODELS} --render-time -o timed"));
    let page = read(&at.path("r/report.html"));
    let (top, timed) = (overview(&page), read(&at.path("timed/report.html")));
    assert_eq!(top.matches("<th scope=\"row\">").count(), 2, "the original and the result");
    for part in ["Gaussians</th>", "Size</th>", "PSNR</th>", "Photographs</th>", "class=\"verdict\"", "A typical view"]
    {
        assert!(top.contains(part), "{part} is missing");
    }
    assert!(overview(&timed).contains("Render time</th>"), "no render time");
    let found = data(&at, "timed");
    assert!(found["render_time"]["before"].as_f64() > Some(0.0), "{}", found["render_time"]);
    for symbol in ["S_static", "κ", "temporal error"] {
        assert!(!top.contains(symbol), "{symbol} is in the overview");
        assert!(page.contains(symbol), "{symbol} is nowhere");
    }
    let details = page.matches("<details ").count();
    assert!(details >= 6 && page.matches("<summary><b>").count() == details, "{details} details");
}

#[test]
fn charts_without_differences_are_left_out() {
    let at = compressed();
    at.done(&format!("report {MODELS} --max-frames 1 -o r"));
    let page = read(&at.path("r/report.html"));
    assert!(page.contains("PSNR by view") && !page.contains("PSNR by frame"), "charts of one frame");
    assert!(!page.contains("nothing to show"), "an empty chart");
    at.done(&format!("report {MODELS} -o more"));
    assert!(read(&at.path("more/report.html")).contains("PSNR by frame"));
}

#[test]
fn several_results_stand_side_by_side() {
    let at = compressed();
    at.done("compress d/scene.gseq --cameras d/cameras.json --ratio 0.1 --no-refine -o tiny.gseq");
    let models = "d/scene.gseq small.gseq tiny.gseq --cameras d/cameras.json";
    let said = at.done(&format!("report {models} -o r"));
    let (page, found) = (read(&at.path("r/report.html")), data(&at, "r"));
    balanced(&page);
    let other = &found["others"][0];
    assert_eq!(other["evaluation"]["count"]["compressed"], json!(120));
    // Pruning rounds removed the Gaussians of this result, so its scores are not compared with those of the report.
    assert_eq!(other["notes"], json!([]));
    let alone = at.done("evaluate d/scene.gseq tiny.gseq --cameras d/cameras.json --json");
    let alone: Value = serde_json::from_str(&alone).unwrap();
    assert_eq!(other["evaluation"]["psnr"], alone["psnr"]);
    // The first row of the table is that of the original.
    let rows: Vec<&str> = page.split("data-label=\"Worst render\">").skip(2).collect();
    assert_eq!(rows.len(), 2);
    for (result, row) in [&found, other].into_iter().zip(rows) {
        let verdict = result["verdict"].as_str().unwrap();
        assert!(said.contains(verdict), "{said}");
        let decibels = |text: &str| text.split(" dB").next().unwrap().parse::<f64>().unwrap();
        let sentence = verdict.split("renders, ").nth(1).expect("the worst render");
        assert!((decibels(row) - decibels(sentence)).abs() < 0.06, "{verdict} {}", &row[..20]);
    }
    assert_eq!(overview(&page).matches("<th scope=\"row\">").count(), 3, "the original and two results");
    for name in ["small.gseq", "tiny.gseq", "difference of tiny.gseq"] {
        assert!(overview(&page).contains(&format!(">{name}</option>")), "{name} is on no slider");
    }
    at.refused(2, &format!("report {models} --cache w -o other"), &["--cache"]);
    at.refused(2, "report - small.gseq tiny.gseq --cameras d/cameras.json -o other", &["standard input"]);
}

#[test]
#[ignore = "needs time"]
fn report_bytes_ignore_thread_count() {
    let at = compressed();
    let of = |threads: u32| {
        at.done(&format!("report {MODELS} -o r{threads} --threads {threads}"));
        files(&at.path(&format!("r{threads}")))
    };
    assert!(of(1) == of(2), "the report depends on the number of threads");
}

#[test]
fn absent_files_are_named_and_any_two_models_can_be_compared() {
    let at = compressed();
    fs::copy(at.path("small.gseq"), at.path("alone.gseq")).unwrap();
    at.done("report d/scene.gseq alone.gseq --cameras d/cameras.json -o r");
    let (page, found) = (read(&at.path("r/report.html")), data(&at, "r"));
    balanced(&page);
    for part in ["There is no summary", "no index map", "splatsieve sweep scene.gseq"] {
        assert!(page.contains(part), "{part} is missing");
    }
    assert_eq!((&found["run"], &found["histograms"]), (&Value::Null, &Value::Null));
    assert_eq!(found["missing"].as_array().unwrap().len(), 3);
    assert!(!at.path("r/stages.csv").exists() && !at.path("r/histograms.csv").exists());
    // A model compared with itself has no loss and no flags.
    at.done("report d/scene.gseq d/scene.gseq --cameras d/cameras.json --max-frames 1 -o same");
    let same = data(&at, "same");
    assert_eq!(same["evaluation"]["psnr"].as_f64(), Some(100.0));
    let flagged = same["failure_modes"].as_array().unwrap().iter().any(|mode| mode["verdict"] == "flagged");
    assert!(!flagged, "{}", same["failure_modes"]);
    balanced(&read(&at.path("same/report.html")));
}

#[test]
fn a_report_replaces_only_results_and_errors_leave_nothing() {
    let at = compressed();
    let report = format!("report {MODELS} --max-frames 1");
    fs::create_dir(at.path("mine")).unwrap();
    fs::write(at.path("mine/notes.txt"), "mine").unwrap();
    fs::write(at.path("bad.json"), "{\"tool\": \"x\"}").unwrap();
    at.refused(2, &format!("{report} -o mine --overwrite"), &["mine", "not a result of splatsieve"]);
    at.refused(2, &format!("{report} -o nowhere/r"), &["nowhere"]);
    at.refused(2, &report, &["--output"]);
    at.refused(1, &format!("{report} --sweep bad.json -o r"), &["bad.json", "path", "splatsieve sweep"]);
    at.refused(1, &format!("{report} --sweep none.json -o r"), &["none.json"]);
    at.done(&format!("{report} -o r"));
    at.refused(2, &format!("{report} -o r"), &["r exists already", "--overwrite"]);
    fs::write(at.path("r/left.txt"), "another's").unwrap();
    at.done(&format!("{report} -o r --overwrite"));
    assert!(at.path("r/left.txt").exists(), "another's file in an earlier report stays");
}

/// Checks that every HTML element of a page is closed, in the right order.
fn balanced(page: &str) {
    const VOID: [&str; 5] = ["!doctype", "meta", "img", "input", "br"];
    let mut open: Vec<&str> = Vec::new();
    let mut rest = page;
    while let Some(start) = rest.find('<') {
        let tag = &rest[start + 1..];
        // A quoted attribute may contain `>`, which elsewhere ends a tag. Escaped text never contains it.
        let mut quote = false;
        let end = tag.find(|c: char| {
            quote ^= c == '"';
            c == '>' && !quote
        });
        let end = end.unwrap_or_else(|| panic!("a tag without end: {:.80}", tag));
        let (inside, after) = (&tag[..end], &tag[end + 1..]);
        rest = after;
        let name = inside.trim_start_matches('/').split([' ', '/', '\n']).next().unwrap();
        if let Some(closed) = inside.strip_prefix('/') {
            assert_eq!(open.pop(), Some(closed), "closed is {closed}");
        } else if !inside.ends_with('/') && !VOID.contains(&name) {
            open.push(name);
            if ["script", "style"].contains(&name) {
                rest = &after[after.find(&format!("</{name}>")).expect("a script that ends")..];
            }
        }
    }
    assert_eq!(open, Vec::<&str>::new());
}

#[test]
fn check_of_page_finds_unclosed_elements() {
    for page in ["<p><b></p></b>", "<p>", "<p", "</p>"] {
        let seen = std::panic::catch_unwind(|| balanced(page)).is_err();
        assert!(seen, "{page} passed");
    }
    balanced("<!doctype html><p title=\"a > b\"><img src=\"x\"><path d=\"M0 0\"/></p>");
}
