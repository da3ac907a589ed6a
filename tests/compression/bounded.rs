//! Containers whose values are off by a declared bound: as small as that makes them, as close as they say, and read by
//! whatever reads containers.

use std::fs;

use crate::scene::{Workplace, files, state};
use gseq::Reader;
use serde_json::Value;
use splatsieve::files::container::Container;
use splatsieve::model::Columns;
use splatsieve::source::FrameSource;

const BOUNDS: &str = "position=2e-3,rotation=5e-3,log_scale=1e-2,opacity_logit=2e-2,sh=1e-2";

/// Largest difference between the finite values of a column of two containers, and whether all others are the same.
fn furthest(workplace: &Workplace, column: Columns) -> (f64, bool) {
    let [exact, within] = ["exact.gseq", "within.gseq"].map(|name| Container::open(&workplace.path(name)).unwrap());
    let (mut furthest, mut kept) = (0.0f64, true);
    for frame in 0..exact.info().times.len() {
        let [exact, within] = [&exact, &within].map(|source| state(source, frame));
        for (a, b) in exact.column(column).planes().iter().zip(within.column(column).planes()) {
            match a.is_finite() {
                true => furthest = furthest.max((f64::from(*a) - f64::from(*b)).abs()),
                false => kept &= a.to_bits() == b.to_bits(),
            }
        }
    }
    (furthest, kept)
}

#[test]
#[ignore = "needs time"]
fn every_column_keeps_its_bound_and_the_file_says_it() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 3000 --frames 48 -o demo");
    workplace.done("pack demo/scene.gseq -o exact.gseq");
    workplace.done(&format!("pack demo/scene.gseq -o within.gseq --max-error {BOUNDS}"));
    workplace.done("verify within.gseq");
    let info: Value = serde_json::from_str(&workplace.done("info within.gseq --json")).unwrap();
    for bound in BOUNDS.split(',') {
        let (name, bound) = bound.split_once('=').unwrap();
        let bound: f64 = bound.parse().unwrap();
        let column = Columns::all().iter().find(|column| column.name() == name).unwrap();
        let (furthest, kept) = furthest(&workplace, column);
        assert!(furthest <= bound && kept, "{name}: {furthest} off, {bound} promised");
        assert!(furthest > 0.3 * bound, "{name}: a bound of {bound} is not made use of, {furthest} off");
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
fn columns_without_a_bound_keep_every_bit_and_a_percentage_is_of_the_extent() {
    let workplace = Workplace::new();
    workplace.done("pack {tiny} -o exact.gseq");
    workplace.done("pack {tiny} -o within.gseq --max-error position=0.1%");
    for column in Columns::all().difference(Columns::POSITION).iter() {
        assert_eq!(furthest(&workplace, column), (0.0, true), "{}", column.name());
    }
    let bound = Reader::open(workplace.path("within.gseq")).unwrap().layout().columns[0].max_error;
    let (furthest, _) = furthest(&workplace, Columns::POSITION);
    assert!(furthest <= bound && furthest > 0.3 * bound, "{furthest} off, {bound} promised");
    // The tiny model's Gaussians lie in a box of some units.
    assert!((1e-4..1e-1).contains(&bound), "{bound}");
}

#[test]
fn threads_change_no_byte() {
    let workplace = Workplace::new();
    for (name, threads) in [("a", 1), ("b", 3)] {
        fs::create_dir(workplace.path(name)).unwrap();
        workplace.done(&format!("--threads {threads} pack {{tiny}} -o {name}/x.gseq --max-error {BOUNDS}"));
    }
    assert!(files(&workplace.path("a")) == files(&workplace.path("b")));
}

#[test]
fn bounds_that_make_no_sense_are_refused_by_name() {
    let workplace = Workplace::new();
    for (bound, expected) in [
        ("colour=1", "position, rotation, log_scale, opacity_logit, sh"),
        ("sh", "COLUMN=BOUND"),
        ("sh=-1", "above 0"),
        ("sh=1%", "only of positions"),
        ("sh=1e-3,sh=1e-2", "sh is named twice"),
    ] {
        workplace.refused(2, &format!("pack {{tiny}} -o x.gseq --max-error {bound}"), &["--max-error", expected]);
    }
    workplace.refused(2, "pack {tiny} -o x.gseq --raw --max-error sh=1", &["--raw", "--max-error"]);
    assert!(!workplace.path("x.gseq").exists());
}
