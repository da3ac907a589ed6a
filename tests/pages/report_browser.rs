//! The report as a person meets it: opened in a real browser, its slider dragged, its pictures chosen.
#![cfg(unix)]

use std::fs;

use crate::browser::{self, Browser};
use crate::scene::Workplace;
use serde_json::json;

/// The line from the left picture to the right one, percent of the stage, as the page is drawn.
const CUT: &str = "(() => {
    const clip = getComputedStyle(document.querySelector('.picture.active img.right')).clipPath;
    return parseFloat(clip.match(/inset\\(.* ([\\d.]+)%\\)/)[1]);
})()";

#[test]
#[ignore = "needs a browser"]
fn the_page_asks_for_nothing_and_its_slider_and_choices_work() {
    let program = browser::installed();
    let at = Workplace::new();
    at.done("demo -o d --gaussians 1500 --frames 5");
    // A name that would run if it were not escaped.
    let name = "<img src=x onerror=window.ran=1>\"'&.gseq";
    fs::copy(at.path("d/compressed.gseq"), at.path(name)).unwrap();
    let photographs = "render d/scene.gseq --cameras d/cameras.json --all -o photographs";
    at.done(photographs);
    let report = |compressed: &str, folder: &str| {
        let words = ["report", "d/scene.gseq", compressed, "--cameras", "d/cameras.json"];
        let run = at.run_words(words.into_iter().chain(["--ground-truth", "photographs", "-o", folder]));
        assert_eq!(run.code, 0, "{}", run.stderr);
    };
    report("d/compressed.gseq", "report");
    report(name, "odd");

    for folder in ["report", "odd"] {
        let mut page = Browser::start(&program);
        page.open(&at.path(folder).join("report.html"));
        assert_eq!(page.complaints(), Vec::<String>::new(), "{folder}");
        let images = page.value("Promise.all([...document.images].map(i => i.decode().then(() => i.naturalWidth)))");
        let widths = images.as_array().unwrap();
        assert!(widths.len() > 8 && widths.iter().all(|width| width.as_u64() > Some(0)), "{widths:?}");
        assert_eq!(page.value("typeof window.ran"), json!("undefined"), "{folder}: a path ran");
        assert!(page.value("document.querySelector('.paths').textContent").as_str().unwrap().contains("→"));
    }

    let mut page = Browser::start(&program);
    page.open(&at.path("report/report.html"));
    assert_eq!(page.value(CUT).as_f64(), Some(50.0));
    page.value("document.getElementById('stage').scrollIntoView({ block: 'center' })");
    let stage = page
        .value("(b => [b.left, b.top, b.width, b.height])(document.getElementById('stage').getBoundingClientRect())");
    let [left, top, width, height]: [f64; 4] = serde_json::from_value(stage).unwrap();
    let point = |part: f64| [left + part * width, top + 0.5 * height];
    page.drag(&[point(0.5), point(0.4), point(0.2)]);
    let dragged = page.value(CUT).as_f64().unwrap();
    assert!((dragged - 20.0).abs() < 0.6, "dragged to 20%, the cut is at {dragged}%");
    assert_eq!(page.value("document.getElementById('handle').offsetLeft > 0"), json!(true));
    // Past the border it stops at it; let go, it stays.
    page.drag(&[point(0.2), point(1.0), [left + 1.2 * width, top + 5.0]]);
    assert_eq!(page.value(CUT).as_f64(), Some(100.0));

    page.value("document.getElementById('cut').focus()");
    for _ in 0..4 {
        page.key("ArrowLeft", 37);
    }
    assert_eq!(page.value(CUT).as_f64(), Some(98.0), "four steps of half a percent by key");
    page.key("Home", 36);
    assert_eq!(page.value(CUT).as_f64(), Some(0.0));

    let active = "[...document.querySelectorAll('.picture')].findIndex(p => p.classList.contains('active'))";
    assert_eq!(page.value(active), json!(0));
    let caption = page.value("document.getElementById('caption').textContent");
    let buttons = page.value("document.querySelectorAll('[data-show]').length").as_u64().unwrap();
    assert!(buttons >= 2, "a choice of {buttons} pictures is none");
    let button = page.value(
        "(b => { b.scrollIntoView({ block: 'center' }); const r = b.getBoundingClientRect(); return [r.x + 9, r.y + 9]; })\
         (document.querySelectorAll('[data-show]')[1])",
    );
    page.drag(&[serde_json::from_value(button).unwrap()]);
    assert_eq!(page.value(active), json!(1));
    assert_ne!(page.value("document.getElementById('caption').textContent"), caption);

    let shown = "[...document.querySelectorAll('.picture.active img')]\
                 .filter(i => getComputedStyle(i).visibility === 'visible').map(i => i.dataset.kind)";
    assert_eq!(page.value(shown), json!(["original", "compressed"]));
    let select = "(s => { s.value = 'difference'; s.dispatchEvent(new Event('change')); })\
                  (document.querySelector('[data-side=right]'))";
    page.value(select);
    assert_eq!(page.value(shown), json!(["original", "difference"]));
    page.value(&select.replace("right", "left").replace("difference", "photograph"));
    assert_eq!(page.value(shown), json!(["difference", "photograph"]));
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[test]
#[ignore = "needs a browser"]
fn the_films_play_and_go_by_key_and_the_page_fits_a_phone() {
    let program = browser::installed();
    let at = Workplace::new();
    at.done("demo -o d --gaussians 1500 --frames 5");
    at.done("report d/scene.gseq d/compressed.gseq --cameras d/cameras.json --flip -o report");
    let mut page = Browser::start(&program);
    page.open(&at.path("report/report.html"));
    let now = "[...document.querySelectorAll('.film.active .pile')]\
               .map(pile => [...pile.children].findIndex(image => getComputedStyle(image).visibility === 'visible'))";
    assert_eq!(page.value(now), json!([0, 0, 0]), "original, compressed, difference");
    let distinct = "[...document.querySelector('.pile').children].map(i => i.src).filter((s, k, all) => all.indexOf(s) === k).length";
    assert_eq!(page.value(distinct), json!(5), "every frame of five is another picture");
    page.value("document.querySelector('#reel input').focus()");
    page.key("ArrowRight", 39);
    page.key("ArrowRight", 39);
    assert_eq!(page.value(now), json!([2, 2, 2]));
    assert_eq!(
        page.value("document.querySelector('#reel input').getAttribute('aria-valuetext').split(':')[0]"),
        json!("frame 2")
    );
    page.key(" ", 32);
    assert_eq!(page.value("document.querySelector('#reel button').textContent"), json!("Pause"));
    let moved = format!(
        "new Promise(done => {{ const look = () => {now}[0] === 2 ? setTimeout(look, 20) : done(true); look(); }})"
    );
    assert_eq!(page.value(&moved), json!(true), "it does not play");
    page.key(" ", 32);
    assert_eq!(page.value("document.querySelector('#reel button').textContent"), json!("Play"));
    assert_eq!(page.value("document.querySelectorAll('[data-play]').length"), json!(2));
    page.value("document.querySelectorAll('[data-play]')[1].click()");
    assert_eq!(
        page.value("[...document.querySelectorAll('.film')].map(f => f.offsetHeight > 0)"),
        json!([false, true])
    );
    assert!(page.value("document.body.textContent").as_str().unwrap().contains("FLIP over frames"));

    for (width, scale) in [(375, 2), (1400, 1)] {
        let device = json!({ "width": width, "height": 800, "deviceScaleFactor": scale, "mobile": width < 1000 });
        page.ask("Emulation.setDeviceMetricsOverride", device);
        let wide = page
            .value("Math.max(...[...document.querySelectorAll('main *')].map(e => e.getBoundingClientRect().right))");
        assert!(wide.as_f64() <= Some(f64::from(width)), "something reaches to {wide} of {width} pixels");
        assert_eq!(page.value(UNREADABLE), json!([]), "{width}");
    }
    let smallest = "Math.min(...[...document.querySelectorAll('svg text')].map(t => t.getBoundingClientRect().height))";
    page.ask(
        "Emulation.setDeviceMetricsOverride",
        json!({ "width": 375, "height": 800, "deviceScaleFactor": 2, "mobile": true }),
    );
    assert!(page.value(smallest).as_f64() > Some(9.0), "letters of {} pixels", page.value(smallest));
    assert_eq!(page.complaints(), Vec::<String>::new());
}

/// Pairs of words of one chart that lie on one another, and words that reach beyond their chart.
const UNREADABLE: &str = "[...document.querySelectorAll('svg')].flatMap(svg => {
    const outer = svg.getBoundingClientRect();
    const words = [...svg.querySelectorAll('text')].map(text => [text.textContent, text.getBoundingClientRect()]);
    const apart = (a, b) => a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top;
    const inside = a => a.left >= outer.left && a.right <= outer.right && a.top >= outer.top && a.bottom <= outer.bottom;
    const on = words.flatMap(([a, at], k) => words.slice(k + 1).filter(b => !apart(at, b[1])).map(b => a + ' | ' + b[0]));
    return [...on, ...words.filter(word => !inside(word[1])).map(word => word[0])];
})";

#[test]
#[ignore = "needs a browser"]
fn a_sweep_draws_every_chart_with_words_that_can_be_read_and_asks_for_nothing() {
    let program = browser::installed();
    let at = Workplace::new();
    let steps = "--fractions 0.8,0.5,0.3 --steps 0,5,10,20 --steps-at 0.3";
    let methods = "--methods default,no-refine,visible,random";
    at.done(&format!("sweep {{tiny}} --cameras {{tiny}} -o curves {methods} {steps} --max-frames 1"));
    let mut page = Browser::start(&program);
    page.open(&at.path("curves/sweep.html"));
    assert_eq!(page.complaints(), Vec::<String>::new());
    assert_eq!(page.value("document.querySelectorAll('figure svg').length"), json!(8));
    assert_eq!(page.value(UNREADABLE), json!([]));
    // The pair: one color, and the one that is not refined hollow.
    let color = |class: &str| format!("getComputedStyle(document.querySelector('svg .line.{class}')).stroke");
    assert_eq!(page.value(&color("s0.hollow")), page.value(&color("s0")));
    assert_ne!(page.value(&color("s1")), page.value(&color("s0")));
}

#[test]
#[ignore = "needs a browser"]
fn a_page_that_fails_or_asks_for_something_would_be_seen() {
    let program = browser::installed();
    let at = Workplace::new();
    let bad = "<!doctype html><img src=\"http://127.0.0.1:9/x.png\"><script>console.log(1); nothing.there;</script>";
    fs::write(at.path("bad.html"), bad).unwrap();
    let mut page = Browser::start(&program);
    page.open(&at.path("bad.html"));
    let complaints = page.complaints().join("\n");
    for part in ["request: http://127.0.0.1:9/x.png", "console: ", "exception: "] {
        assert!(complaints.contains(part), "{part} is not in {complaints}");
    }
}
