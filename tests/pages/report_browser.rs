//! Tests of the report page in a real browser: its sliders, animations, layout and accessibility.
#![cfg(unix)]

use std::fs;

use crate::browser::{self, Browser};
use crate::scene::Workplace;
use serde_json::json;

/// JavaScript expression for the position of the border between the two images of the first slider, in percent of its
/// width.
const CUT: &str = "(() => {
    const clip = getComputedStyle(document.querySelector('.slider img.right')).clipPath;
    return parseFloat(clip.match(/inset\\(.* ([\\d.]+)%\\)/)[1]);
})()";

/// Writes the test scene in `d`, and a report on it in `report`, with photographs.
fn reported() -> Workplace {
    let at = Workplace::new();
    at.done("test-scene -o d --gaussians 1500 --frames 5");
    at.done("render d/scene.gseq --cameras d/cameras.json --all -o photographs");
    at.done(
        "report d/scene.gseq d/compressed.gseq --cameras d/cameras.json --flip --ground-truth photographs -o report",
    );
    at
}

#[test]
#[ignore = "needs a browser"]
fn report_requests_no_url_and_its_sliders_work() {
    let program = browser::installed();
    let at = reported();
    // A name that would run if it were not escaped.
    let name = "<img src=x onerror=window.ran=1>\"'&.gseq";
    fs::copy(at.path("d/compressed.gseq"), at.path(name)).unwrap();
    let run = at.run_words(["report", "d/scene.gseq", name, "--cameras", "d/cameras.json", "-o", "odd"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
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
    page.value("document.querySelector('.stage').scrollIntoView({ block: 'center' })");
    // The images lie inside the frame around them.
    let stage = page.value(
        "(b => [b.left, b.top, b.width, b.height])(document.querySelector('.stage img').getBoundingClientRect())",
    );
    let [left, top, width, height]: [f64; 4] = serde_json::from_value(stage).unwrap();
    let point = |part: f64| [left + part * width, top + 0.5 * height];
    page.drag(&[point(0.5), point(0.4), point(0.2)]);
    let dragged = page.value(CUT).as_f64().unwrap();
    assert!((dragged - 20.0).abs() < 0.6, "dragged to 20%, the cut is at {dragged}%");
    assert_eq!(page.value("document.querySelector('.handle').offsetLeft > 0"), json!(true));
    // The slider stops at the border of the image, and stays there when the mouse button is released.
    page.drag(&[point(0.2), point(1.0), [left + 1.2 * width, top + 5.0]]);
    assert_eq!(page.value(CUT).as_f64(), Some(100.0));

    page.value("document.querySelector('.cut').focus()");
    for _ in 0..4 {
        page.key("ArrowLeft", 37);
    }
    assert_eq!(page.value(CUT).as_f64(), Some(98.0), "four steps of half a percent by key");
    page.key("Home", 36);
    assert_eq!(page.value(CUT).as_f64(), Some(0.0));

    let titles = "[...document.querySelectorAll('#compare .slider h3')].map(h => h.textContent)";
    assert_eq!(page.value(titles), json!(["A typical view", "The worst view"]));
    let shown = "[...document.querySelector('.slider').querySelectorAll('img')]\
                 .filter(i => getComputedStyle(i).visibility === 'visible').map(i => i.alt)";
    assert_eq!(page.value(shown), json!(["original", "compressed"]));
    let caption = "document.querySelector('.slider .caption').textContent";
    assert!(page.value(caption).as_str().unwrap().starts_with("PSNR "), "{}", page.value(caption));
    let select = "(s => { s.value = [...s.options].find(o => o.text === 'difference').value; \
                  s.dispatchEvent(new Event('change')); })(document.querySelector('[data-side=right]'))";
    page.value(select);
    assert_eq!(page.value(shown), json!(["original", "difference"]));
    assert!(page.value(caption).as_str().unwrap().contains("times as bright"), "{}", page.value(caption));
    page.value(&select.replace("right", "left").replace("difference", "photograph"));
    assert_eq!(page.value(shown), json!(["difference", "photograph"]));
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[test]
#[ignore = "needs a browser"]
fn the_animations_play_and_step_by_key() {
    let program = browser::installed();
    let at = reported();
    let mut page = Browser::start(&program);
    page.open(&at.path("report/report.html"));
    let now = "[...document.querySelectorAll('.film.active .pile')]\
               .map(pile => [...pile.children].findIndex(image => getComputedStyle(image).visibility === 'visible'))";
    assert_eq!(page.value(now), json!([0, 0, 0]), "original, compressed, difference");
    let distinct = "[...document.querySelector('.pile').children].map(i => i.src).filter((s, k, all) => all.indexOf(s) === k).length";
    assert_eq!(page.value(distinct), json!(5), "every frame of five is another render");
    page.value("document.querySelector('#reel input').focus()");
    page.key("ArrowRight", 39);
    page.key("ArrowRight", 39);
    assert_eq!(page.value(now), json!([2, 2, 2]));
    assert_eq!(
        page.value("document.querySelector('#reel input').getAttribute('aria-valuetext').split(':')[0]"),
        json!("frame 2")
    );
    page.key(" ", 32);
    assert_eq!(page.value("document.querySelector('#play').textContent"), json!("Pause"));
    let moved = format!(
        "new Promise(done => {{ const look = () => {now}[0] === 2 ? setTimeout(look, 20) : done(true); look(); }})"
    );
    assert_eq!(page.value(&moved), json!(true), "it does not play");
    page.key(" ", 32);
    assert_eq!(page.value("document.querySelector('#play').textContent"), json!("Play"));
    assert_eq!(page.value("document.querySelectorAll('[data-play]').length"), json!(2));
    page.value("document.querySelectorAll('[data-play]')[1].click()");
    assert_eq!(
        page.value("[...document.querySelectorAll('.film')].map(f => f.offsetHeight > 0)"),
        json!([false, true])
    );
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[test]
#[ignore = "needs a browser"]
fn the_page_fits_a_phone_and_the_overview_is_short() {
    let program = browser::installed();
    let at = reported();
    at.done("report d/scene.gseq d/compressed.gseq d/compressed.gseq --cameras d/cameras.json -o several");
    for folder in ["report", "several"] {
        let mut page = Browser::start(&program);
        page.open(&at.path(folder).join("report.html"));
        let above = "document.getElementById('details').getBoundingClientRect().top + scrollY";
        page.screen(1400, 900, "light");
        assert!(page.value(above).as_f64() <= Some(3500.0), "{folder}: {} pixels above the details", page.value(above));
        page.value("document.querySelectorAll('details').forEach(details => details.open = true)");
        for (width, scheme) in [(390, "light"), (390, "dark"), (1400, "dark")] {
            page.screen(width, 800, scheme);
            // A vertical scroll bar takes a part of the width.
            let fits = page.value("document.documentElement.scrollWidth <= innerWidth");
            assert_eq!(fits, json!(true), "{folder}, {width}");
            assert_eq!(page.value(UNREADABLE), json!([]), "{folder}, {width}");
            assert_eq!(page.value("document.body.textContent.includes('nothing to show')"), json!(false));
        }
        let smallest =
            "Math.min(...[...document.querySelectorAll('svg text')].map(t => t.getBoundingClientRect().height))";
        page.screen(390, 800, "light");
        assert!(page.value(smallest).as_f64() > Some(9.0), "letters of {} pixels", page.value(smallest));
        let paper = |page: &mut Browser| page.value("getComputedStyle(document.body).backgroundColor");
        let light = paper(&mut page);
        page.screen(390, 800, "dark");
        assert_ne!(paper(&mut page), light);
        assert_eq!(page.complaints(), Vec::<String>::new());
    }
}

#[test]
#[ignore = "needs axe-core and a browser"]
fn report_and_player_have_no_serious_accessibility_violation() {
    let program = browser::installed();
    let axe = std::env::var("SPLATSIEVE_AXE").expect("SPLATSIEVE_AXE: the file axe.min.js of the npm package axe-core");
    let axe = fs::read_to_string(axe).unwrap();
    let at = reported();
    at.done("report d/scene.gseq d/compressed.gseq d/compressed.gseq --cameras d/cameras.json -o several");
    at.done("view d/scene.gseq d/compressed.gseq --cameras d/cameras.json -o scene.html");
    let mut found: Vec<(String, Vec<String>)> = Vec::new();
    for file in ["report/report.html", "several/report.html", "scene.html"] {
        let mut page = Browser::start_drawing(&program);
        page.open(&at.path(file));
        page.value("document.querySelectorAll('details').forEach(details => details.open = true)");
        for (width, scheme) in [(1400, "light"), (1400, "dark"), (390, "light")] {
            page.screen(width, 900, scheme);
            found.push((format!("{file}, {width}, {scheme}"), page.serious_violations(&axe)));
        }
        if file == "scene.html" {
            page.value("document.getElementById('ask').click()");
            found.push((format!("{file}, help"), page.serious_violations(&axe)));
        }
    }
    found.retain(|(_, violations)| !violations.is_empty());
    assert!(found.is_empty(), "{found:#?}");
    // A page with a fault, to be sure that faults are found.
    fs::write(at.path("bad.html"), "<!doctype html><html lang=en><title>x</title><img src=x.png><p style=color:#eee>x")
        .unwrap();
    let mut page = Browser::start(&program);
    page.open(&at.path("bad.html"));
    let violations: Vec<String> = page.serious_violations(&axe);
    assert!(violations.iter().any(|rule| rule.starts_with("image-alt")), "{violations:?}");
}

/// JavaScript expression for unreadable words in charts: pairs of words of one chart that overlap, and words that reach
/// beyond their chart.
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
fn a_sweep_draws_every_chart_with_readable_text_and_no_request() {
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
    // The two curves of a pair have one color; the one without refinement is hollow.
    let color = |class: &str| format!("getComputedStyle(document.querySelector('svg .line.{class}')).stroke");
    assert_eq!(page.value(&color("s0.hollow")), page.value(&color("s0")));
    assert_ne!(page.value(&color("s1")), page.value(&color("s0")));
}

#[test]
#[ignore = "needs a browser"]
fn check_of_page_finds_requests_messages_and_exceptions() {
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
