//! Tests of containers whose values differ from the input by at most a declared bound: they are smaller, keep the
//! bound, and every container reader reads them.

use std::fs;

use crate::scene::{Workplace, files, state};
use gseq::Reader;
use serde_json::Value;
use splatsieve::files::container::Container;
use splatsieve::model::Attributes;
use splatsieve::source::FrameSource;

const BOUNDS: &str = "position=2e-3,rotation=5e-3,log_scale=1e-2,opacity_logit=2e-2,sh=1e-2";

/// Compares the attribute `column` in the containers `exact.gseq` and `within.gseq`. Returns the largest difference
/// between finite values, and whether all other values are equal.
fn largest_difference(workplace: &Workplace, column: Attributes) -> (f64, bool) {
    let [exact, within] = ["exact.gseq", "within.gseq"].map(|name| Container::open(&workplace.path(name)).unwrap());
    let (mut largest_difference, mut kept) = (0.0f64, true);
    for frame in 0..exact.info().times.len() {
        let [exact, within] = [&exact, &within].map(|source| state(source, frame));
        for (a, b) in exact.attribute_values(column).planes().iter().zip(within.attribute_values(column).planes()) {
            match a.is_finite() {
                true => largest_difference = largest_difference.max((f64::from(*a) - f64::from(*b)).abs()),
                false => kept &= a.to_bits() == b.to_bits(),
            }
        }
    }
    (largest_difference, kept)
}

#[test]
#[ignore = "needs time"]
fn every_attribute_keeps_its_bound_and_names_it() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 3000 --frames 48 -o demo");
    workplace.done("convert demo/scene.gseq exact.gseq");
    workplace.done(&format!("convert demo/scene.gseq within.gseq --max-error {BOUNDS}"));
    workplace.done("info within.gseq --check");
    let info: Value = serde_json::from_str(&workplace.done("info within.gseq --json")).unwrap();
    for bound in BOUNDS.split(',') {
        let (name, bound) = bound.split_once('=').unwrap();
        let bound: f64 = bound.parse().unwrap();
        let column = Attributes::all().iter().find(|column| column.name() == name).unwrap();
        let (largest_difference, kept) = largest_difference(&workplace, column);
        assert!(largest_difference <= bound && kept, "{name}: {largest_difference} off, {bound} promised");
        assert!(
            largest_difference > 0.3 * bound,
            "{name}: a bound of {bound} is not made use of, {largest_difference} off"
        );
        let column = info["columns"].as_array().unwrap().iter().find(|column| column["name"] == name).unwrap();
        assert_eq!(column["max_error"].as_f64(), Some(bound), "{info}");
    }
    assert!(workplace.done("info within.gseq").contains("at most 0.002 off"));
    let [exact, within] = ["exact.gseq", "within.gseq"].map(|name| fs::metadata(workplace.path(name)).unwrap().len());
    assert!(3 * within < exact, "{within} bytes of {exact}");

    let found =
        workplace.done("evaluate demo/scene.gseq within.gseq --cameras demo/cameras.json --max-frames 4 --json");
    let found: Value = serde_json::from_str(&found).unwrap();
    assert!(found["psnr"].as_f64().unwrap() > 40.0, "{found}");
    workplace.done("compress within.gseq --cameras demo/cameras.json --no-refine -o small.gseq");
}

#[test]
fn unbounded_attributes_are_exact_percent_is_of_extent() {
    let workplace = Workplace::new();
    workplace.done("convert {tiny} exact.gseq");
    workplace.done("convert {tiny} within.gseq --max-error position=0.1%");
    for column in Attributes::all().difference(Attributes::POSITION).iter() {
        assert_eq!(largest_difference(&workplace, column), (0.0, true), "{}", column.name());
    }
    let bound = Reader::open(workplace.path("within.gseq")).unwrap().layout().columns[0].max_error;
    let (largest_difference, _) = largest_difference(&workplace, Attributes::POSITION);
    assert!(
        largest_difference <= bound && largest_difference > 0.3 * bound,
        "{largest_difference} off, {bound} promised"
    );
    // The Gaussians of the tiny model lie in a box of a few units.
    assert!((1e-4..1e-1).contains(&bound), "{bound}");
}

#[test]
fn bounded_bytes_ignore_thread_count() {
    let workplace = Workplace::new();
    for (name, threads) in [("a", 1), ("b", 3)] {
        fs::create_dir(workplace.path(name)).unwrap();
        workplace.done(&format!("--threads {threads} convert {{tiny}} {name}/x.gseq --max-error {BOUNDS}"));
    }
    assert!(files(&workplace.path("a")) == files(&workplace.path("b")));
}

#[test]
fn invalid_bounds_are_refused_by_name() {
    let workplace = Workplace::new();
    for (bound, expected) in [
        ("color=1", "position, rotation, log_scale, opacity_logit, sh"),
        ("sh", "COLUMN=BOUND"),
        ("sh=-1", "above 0"),
        ("sh=1%", "only of positions"),
        ("sh=1e-3,sh=1e-2", "sh is named twice"),
    ] {
        workplace.refused(2, &format!("convert {{tiny}} x.gseq --max-error {bound}"), &["--max-error", expected]);
    }
    workplace.refused(2, "convert {tiny} x.gseq --raw --max-error sh=1", &["--raw", "--max-error"]);
    assert!(!workplace.path("x.gseq").exists());
}
