//! Tests of the command `demo` as a user runs it.

use std::fs;

use crate::scene::{Workplace, files};

const SMALL: &str = "demo --gaussians 1000 --frames 4 --refine-steps 8";

#[test]
fn the_demo_writes_pages_and_a_film_and_says_how_to_open_them() {
    let at = Workplace::new();
    let said = at.done(&format!("{SMALL} -o d"));
    let page = at.path("d/player.html");
    assert!(said.trim_end().ends_with("d/player.html") && said.contains("See it:"), "{said}");
    for name in
        ["compressed_10x.gseq", "compressed_20x.gseq", "pruned_10x.gseq", "comparison.gif", "report/report.html"]
    {
        assert!(at.path("d").join(name).is_file() && said.contains(name), "{name}: {said}");
    }
    let page = fs::read_to_string(page).unwrap();
    assert!(page.contains("\"role\":\"original\"") && page.contains("\"role\":\"compressed\""));
    let report = fs::read_to_string(at.path("d/report/report.html")).unwrap();
    for part in ["compressed_10x.gseq", "compressed_20x.gseq", "pruned_10x.gseq"] {
        assert!(report.contains(&format!("<th scope=\"row\">{part}</th>")), "{part} is not in the table");
    }
    let table: Vec<usize> = said
        .lines()
        .filter(|line| line.contains(".gseq") && line.contains(" MB"))
        .map(|line| line.split_whitespace().nth(1).unwrap().parse().unwrap())
        .collect();
    assert_eq!(table, [1000, 100, 50, 100], "{said}");
    let film = fs::read(at.path("d/comparison.gif")).unwrap();
    assert!(film.starts_with(b"GIF89a"));
    at.done("info d/compressed_10x.gseq --check");
    // What it wrote can be compressed and compared by hand.
    at.done("evaluate d/scene.gseq d/pruned_10x.gseq --cameras d/cameras.json");
    at.refused(2, &format!("{SMALL} -o d"), &["d exists already", "--overwrite"]);
    at.done(&format!("{SMALL} -o d --overwrite"));
}

#[test]
#[ignore = "needs time"]
fn demo_bytes_ignore_thread_count() {
    let at = Workplace::new();
    let of = |threads: u32| {
        at.done(&format!("{SMALL} -o d{threads} --threads {threads}"));
        // Times and memory of a run stand in its summary, and from there in the report.
        let differs = |name: &str| name.contains("summary") || name.contains("report");
        let mut found = files(&at.path(&format!("d{threads}")));
        found.retain(|name, _| !differs(&format!("{name:?}")));
        found
    };
    let (one, two) = (of(1), of(2));
    assert!(one.len() >= 7 && one == two, "the demo depends on the number of threads");
}
