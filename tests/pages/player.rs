//! Tests of the page that `view` writes: its bytes, and its images in a real browser compared with the program's own
//! rasterizer.
#![cfg(unix)]

use std::fs;
use std::path::{Path, PathBuf};

use crate::browser::{self, Browser};
use crate::models;
use crate::scene::{Workplace, state};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};
use splatsieve::metrics::psnr;
use splatsieve::render::render;
use splatsieve::scene::{InputOptions, Scene, open_scene};

/// Minimum PSNR of the page's images against renders of the rasterizer, dB. 35 dB are promised; 52 to 61 dB were
/// measured.
const LEAST_DB: f64 = 50.0;

fn opened(path: &Path, cameras: &Path) -> Scene {
    let options = InputOptions { path: path.to_owned(), cameras: Some(cameras.to_owned()), ..InputOptions::default() };
    open_scene(&options).unwrap()
}

/// Sets the fragment of the page's address to `hash`, which selects the image to show, and waits until the image is
/// drawn.
fn go(page: &mut Browser, hash: &str) {
    page.value(&format!(
        "new Promise(done => {{ addEventListener('hashchange', () => splatsieve.settled().then(done), {{ once: true }}); \
         location.hash = '{hash}'; }})"
    ));
    assert_eq!(page.value("document.getElementById('status').textContent"), json!(""));
}

/// Returns width, height and bytes of the image that the page has drawn.
fn pixels(page: &mut Browser) -> (u32, u32, Vec<u8>) {
    let found = page.value("splatsieve.pixels()");
    let number = |name: &str| found[name].as_u64().unwrap() as u32;
    (number("width"), number("height"), STANDARD.decode(found["rgb"].as_str().unwrap()).unwrap())
}

/// Returns the PSNR in dB of the page's image of the model `show` (`original` or `compressed`) in view `view` at frame
/// `frame`. It is compared with a render of `scene`, this model, by the rasterizer.
fn decibels(page: &mut Browser, scene: &Scene, show: &str, view: u32, frame: usize) -> f64 {
    go(page, &format!("show={show}&camera={view}&frame={frame}&paused&exact"));
    let (width, height, found) = pixels(page);
    let rig_view = scene.rig.views.iter().find(|rig_view| rig_view.view == view).unwrap();
    let expected =
        render(&state(scene.source(), frame), &scene.rig.cameras[rig_view.camera as usize], scene.background);
    assert!(expected.data.iter().any(|x| (x - expected.data[0]).abs() > 0.2), "an empty render tells nothing");
    psnr(&browser::image_from_bytes(width, height, &found), &expected)
}

/// Returns the faults of the page with three exceptions: its worker, files of its own folder, and messages of a
/// graphics driver about reading back pixels, which only tests do.
fn complaints(page: &Browser, folder: Option<&Path>) -> Vec<String> {
    let own = folder.map(|folder| format!("request: file://{}/frames_", fs::canonicalize(folder).unwrap().display()));
    let is_own = |text: &String| {
        text.starts_with("request: blob:")
            || text.contains("due to ReadPixels")
            || own.as_ref().is_some_and(|own| text.starts_with(own))
    };
    page.complaints().into_iter().filter(|text| !is_own(text)).collect()
}

/// Writes the test scene into the folder `d`, and the page that plays it. Returns the workplace and the path of the
/// page.
fn demo() -> (Workplace, PathBuf) {
    let at = Workplace::new();
    at.done("test-scene -o d --gaussians 1500 --frames 30");
    at.done("view d/scene.gseq d/compressed.gseq --cameras d/cameras.json -o scene.html");
    let page = at.path("scene.html");
    (at, page)
}

#[test]
#[ignore = "needs a browser"]
fn page_draws_like_the_rasterizer_and_requests_no_url() {
    let program = browser::installed();
    let (at, whole) = demo();
    at.done("view d/scene.gseq d/compressed.gseq --cameras d/cameras.json -o scene --max-frames 30");
    let cameras = at.path("d/cameras.json");
    let [original, compressed] = ["d/scene.gseq", "d/compressed.gseq"].map(|name| opened(&at.path(name), &cameras));
    let mut of_forms = Vec::new();
    for (file, folder) in [(whole, None), (at.path("scene/index.html"), Some(at.path("scene")))] {
        let mut page = Browser::start_drawing(&program);
        page.open(&file);
        let mut images = Vec::new();
        for (view, frame) in [(0, 0), (2, 17), (1, 29)] {
            for (show, scene) in [("original", &original), ("compressed", &compressed)] {
                let found = decibels(&mut page, scene, show, view, frame);
                eprintln!("{show}, view {view}, frame {frame}: {found:.1} dB");
                assert!(found >= LEAST_DB, "{show}, view {view}, frame {frame}: {found} dB");
                images.push(pixels(&mut page));
            }
        }
        assert_eq!(complaints(&page, folder.as_deref()), Vec::<String>::new());
        of_forms.push(images);
    }
    assert!(of_forms[0] == of_forms[1], "a folder shows something else than a page");
}

#[test]
#[ignore = "needs a browser"]
fn times_are_interpolated_and_a_wipe_shows_both_models() {
    let program = browser::installed();
    let (_at, whole) = demo();
    let mut page = Browser::start_drawing(&program);
    page.open(&whole);
    let mut shown = |hash: &str| {
        go(&mut page, &format!("camera=1&paused&exact&{hash}"));
        pixels(&mut page)
    };
    let [left, right] = ["original", "compressed"].map(|show| shown(&format!("show={show}&frame=12")));
    let (width, height, wipe) = shown("show=wipe&cut=0.25&frame=12");
    let row = |of: &[u8], y: u32, x: std::ops::Range<u32>| {
        of[3 * (y * width + x.start) as usize..3 * (y * width + x.end) as usize].to_vec()
    };
    let cut = width / 4;
    for y in (0..height).step_by(7) {
        assert_eq!(row(&wipe, y, 0..cut), row(&left.2, y, 0..cut), "row {y}");
        assert_eq!(row(&wipe, y, cut + 1..width), row(&right.2, y, cut + 1..width), "row {y}");
    }
    let (beside_width, _, beside) = shown("show=beside&frame=12");
    assert_eq!(beside_width, 2 * width);
    let half = |y: u32| beside[6 * (y * width) as usize..][..3 * width as usize].to_vec();
    assert_eq!(half(height / 2), row(&left.2, height / 2, 0..width));
    let (_, _, difference) = shown("show=difference&frame=12");
    // Four times what differs, of images that are rounded to bytes.
    let expected = |k: usize| (4 * left.2[k].abs_diff(right.2[k]) as u32).min(255);
    assert!((0..difference.len()).all(|k| u32::from(difference[k]).abs_diff(expected(k)) <= 5));
    assert!(difference.iter().any(|&x| x > 20), "both models look the same");
    let off = |a: &[u8], b: &[u8]| a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>();
    let [before, after] = [12, 13].map(|frame| shown(&format!("show=original&frame={frame}")).2);
    let end = page.value("Number(document.getElementById('scrub').max)").as_f64().unwrap();
    // The frames of the test scene are evenly spaced.
    let middle = end * 12.5 / 29.0;
    go(&mut page, &format!("camera=1&paused&exact&show=original&time={middle}"));
    let between = pixels(&mut page).2;
    let [a, b, whole] = [off(&between, &before), off(&between, &after), off(&before, &after)];
    assert!(a > 0.0 && b > 0.0 && a < whole && b < whole, "{a} and {b} of {whole}");
    assert_eq!(complaints(&page, None), Vec::<String>::new());
}

#[test]
#[ignore = "needs a browser"]
fn page_plays_seeks_turns_jumps_and_escapes_names() {
    let program = browser::installed();
    let (at, _) = demo();
    let odd = "<img src=x onerror=window.ran=1>\"'&.gseq";
    fs::copy(at.path("d/compressed.gseq"), at.path(odd)).unwrap();
    let words = [
        "view",
        "d/scene.gseq",
        odd,
        "--cameras",
        "d/cameras.json",
        "-o",
        "odd.html",
        "--original-frames",
        "5",
        "--original-degree",
        "0",
    ];
    let run = at.run_words(words);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let mut page = Browser::start_drawing(&program);
    page.open(&at.path("odd.html"));
    let text = |page: &mut Browser, id: &str| {
        page.value(&format!("document.getElementById('{id}').textContent")).as_str().unwrap().to_owned()
    };
    let value = |page: &mut Browser, id: &str| {
        page.value(&format!("Number(document.getElementById('{id}').value)")).as_f64().unwrap()
    };
    // The page begins to play by itself.
    let wait = "new Promise(done => setTimeout(done, 1500))";
    page.value(wait);
    let first = value(&mut page, "scrub");
    page.value(wait);
    assert!(first != value(&mut page, "scrub"), "it stands still");
    // As soon as some images were drawn, which takes its time without a graphics card.
    let rated = "new Promise(done => { const id = setInterval(() => { \
                 if (document.getElementById('rate').textContent) { clearInterval(id); done(); } }, 100); })";
    page.value(rated);
    assert!(text(&mut page, "rate").ends_with("fps"), "{}", text(&mut page, "rate"));
    page.value("document.getElementById('play').click()");
    let stopped = value(&mut page, "scrub");
    page.value(wait);
    assert_eq!(value(&mut page, "scrub"), stopped);

    go(&mut page, "show=compressed&camera=0&frame=7&paused");
    assert!(text(&mut page, "now").starts_with("8/30"), "{}", text(&mut page, "now"));
    let at_seven = pixels(&mut page);
    page.value("document.getElementById('canvas').focus()");
    page.key(".", 190);
    page.value("splatsieve.settled()");
    assert!(text(&mut page, "now").starts_with("9/30"), "{}", text(&mut page, "now"));
    assert!(pixels(&mut page) != at_seven);
    page.key(",", 188);
    page.value("splatsieve.settled()");
    assert!(pixels(&mut page) == at_seven, "back at the frame is another image");
    // A drag turns the camera; choosing the number of the camera restores it.
    page.drag(&[[500.0, 300.0], [560.0, 320.0], [600.0, 330.0]]);
    page.value("splatsieve.settled()");
    assert!(pixels(&mut page) != at_seven && value(&mut page, "camera") == 0.0);
    page.value("(s => { s.value = '0'; s.dispatchEvent(new Event('change')); })(document.getElementById('camera'))");
    page.value("splatsieve.settled()");
    assert!(pixels(&mut page) == at_seven, "the camera is not where it was");
    // Drags the handle of the wipe.
    go(&mut page, "show=wipe&camera=0&frame=7&paused&cut=0.5");
    let stage = page
        .value("(b => [b.left, b.top, b.width, b.height])(document.getElementById('stage').getBoundingClientRect())");
    let [left, top, width, height]: [f64; 4] = serde_json::from_value(stage).unwrap();
    page.drag(&[[left + 0.5 * width, top + 0.3 * height], [left + 0.3 * width, top + 0.3 * height]]);
    assert_eq!(page.value("document.getElementById('cut').getAttribute('aria-valuenow')"), json!("30"));
    let left_label = text(&mut page, "left");
    assert!(left_label.contains("5 of 30 frames") && left_label.contains("SH degree 0 of"), "{left_label}");
    assert!(text(&mut page, "facts").contains(odd));
    assert_eq!(page.value("typeof window.ran"), json!("undefined"), "a name ran");
    assert_eq!(complaints(&page, None), Vec::<String>::new());
}

/// JavaScript expression for height, width and name of each visible control (button or select) of the page.
const CONTROLS: &str = "[...document.querySelectorAll('#controls button, #controls select')].filter(e => e.offsetHeight)\
                        .map(e => [e.offsetHeight, e.offsetWidth, e.getAttribute('aria-label')])";

#[test]
#[ignore = "needs a browser"]
fn controls_have_equal_height_and_names_and_fit_a_phone() {
    let program = browser::installed();
    let (_at, whole) = demo();
    let mut page = Browser::start_drawing(&program);
    page.open(&whole);
    for (width, height) in [(1400, 900), (390, 844)] {
        page.screen(width, height, "light");
        page.value("splatsieve.settled && new Promise(done => setTimeout(done, 300))");
        let controls: Vec<(u32, u32, Option<String>)> = serde_json::from_value(page.value(CONTROLS)).unwrap();
        assert!(controls.len() >= 6, "{controls:?}");
        for (tall, wide, name) in &controls {
            assert!(*tall == 40 && *wide >= 40 && name.as_ref().is_some_and(|name| !name.is_empty()), "{controls:?}");
        }
        assert_eq!(page.value("document.documentElement.scrollWidth"), json!(width));
        let bar = page.value("document.getElementById('controls').offsetHeight").as_u64().unwrap();
        assert!(bar * 6 <= u64::from(height), "the controls take {bar} of {height} pixels");
    }
    // The help dialog opens over the page, and the numbers in its text are short.
    page.value("document.getElementById('canvas').focus()");
    page.key("?", 191);
    assert_eq!(page.value("document.getElementById('help').open"), json!(true));
    let help = page.value("document.getElementById('help').textContent");
    let help = help.as_str().unwrap();
    assert!(help.contains("full screen") && help.contains("% of the scene's size"), "{help}");
    let long = help.split(|c: char| !c.is_ascii_digit() && c != '.').find(|number| number.len() > 8);
    assert_eq!(long, None, "{help}");
    page.value("document.getElementById('close').click()");
    assert_eq!(page.value("document.getElementById('help').open"), json!(false));
    // Presses the button with the mouse, because browsers allow full screen only after an action of the user.
    let button = "(b => [b.left + 20, b.top + 20])(document.getElementById('full').getBoundingClientRect())";
    let at: [f64; 2] = serde_json::from_value(page.value(button)).unwrap();
    page.drag(&[at]);
    page.value("new Promise(done => setTimeout(done, 500))");
    assert_eq!(page.value("document.fullscreenElement !== null"), json!(true));
    assert_eq!(complaints(&page, None), Vec::<String>::new());
}

#[test]
#[ignore = "needs a browser"]
fn poster_stays_until_first_render_and_embed_hides_controls() {
    let program = browser::installed();
    let (at, whole) = demo();
    let text = fs::read_to_string(&whole).unwrap();
    assert!(text.contains("<img id=\"poster\" alt=\"First frame of the scene\" src=\"data:image/jpeg;base64,"));
    let mut page = Browser::start_drawing(&program);
    page.open(&whole);
    go(&mut page, "paused&frame=3");
    assert_eq!(page.value("document.getElementById('poster')"), Value::Null, "the poster is still there");
    // Without WebGL the poster stays.
    let mut plain = Browser::start(&program);
    fs::write(at.path("plain.html"), text.replace("getContext(", "lost(")).unwrap();
    plain.open(&at.path("plain.html"));
    assert_eq!(plain.value("document.getElementById('poster').naturalWidth > 0"), json!(true));
    let visible = "[...document.querySelectorAll('#controls, .label, #cut')].filter(e => e.offsetHeight > 0).length";
    assert!(page.value(visible).as_u64() > Some(1));
    go(&mut page, "embed&paused");
    assert_eq!(page.value(visible), json!(0));
    page.ask("Page.navigate", json!({ "url": format!("file://{}?embed", whole.display()) }));
    page.value("new Promise(done => addEventListener('load', done))");
    page.value("splatsieve.settled && new Promise(done => setTimeout(done, 300))");
    assert_eq!(page.value(visible), json!(0), "?embed");
    assert_eq!(page.value("document.getElementById('stage').offsetHeight === innerHeight"), json!(true));
}

#[test]
#[ignore = "needs a browser"]
fn one_finger_turns_and_two_fingers_zoom() {
    let program = browser::installed();
    let (_at, whole) = demo();
    let mut page = Browser::start_drawing(&program);
    page.open(&whole);
    page.screen(390, 844, "light");
    page.ask("Emulation.setTouchEmulationEnabled", json!({ "enabled": true, "maxTouchPoints": 2 }));
    let start = "show=original&camera=0&frame=7&paused&x=";
    go(&mut page, &format!("{start}1"));
    let first = pixels(&mut page);
    page.touch(&[vec![[150.0, 300.0]], vec![[190.0, 310.0]], vec![[220.0, 320.0]]]);
    page.value("splatsieve.settled()");
    assert!(pixels(&mut page) != first, "one finger turns nothing");
    go(&mut page, &format!("{start}2"));
    assert!(pixels(&mut page) == first, "the camera is not back");
    let apart = |by: f64| vec![[195.0 - by, 300.0], [195.0 + by, 300.0]];
    page.touch(&[apart(40.0), apart(80.0), apart(120.0)]);
    page.value("splatsieve.settled()");
    assert!(pixels(&mut page) != first, "two fingers change nothing");
    assert_eq!(complaints(&page, None), Vec::<String>::new());
}

#[test]
#[ignore = "needs a browser"]
fn trained_models_look_as_in_the_rasterizer() {
    let program = browser::installed();
    let Some(folder) = models::found() else { return };
    let at = Workplace::new();
    for name in models::NAMES {
        let model = folder.join(name);
        let words = [
            "view".as_ref(),
            model.as_os_str(),
            "--cameras".as_ref(),
            model.as_os_str(),
            "-o".as_ref(),
            "scene.html".as_ref(),
        ];
        let run = at.run_words(words.into_iter().chain(["--max-frames", "4", "--overwrite"].map(str::as_ref)));
        assert_eq!(run.code, 0, "{}", run.stderr);
        let scene = opened(&model, &model);
        let mut page = Browser::start_drawing(&program);
        page.open(&at.path("scene.html"));
        for (view, shown, frame) in [(0, 0, 0), (1, 2, 39), (8, 3, 59)] {
            go(&mut page, &format!("camera={view}&frame={shown}&paused&exact&x={name}"));
            let (width, height, found) = pixels(&mut page);
            let rig_view = scene.rig.views.iter().find(|rig_view| rig_view.view == view).unwrap();
            let expected =
                render(&state(scene.source(), frame), &scene.rig.cameras[rig_view.camera as usize], scene.background);
            let decibels = psnr(&browser::image_from_bytes(width, height, &found), &expected);
            eprintln!("{name}, view {view}, frame {frame}: {decibels:.1} dB");
            assert!(decibels >= LEAST_DB, "{name}, view {view}, frame {frame}: {decibels} dB");
        }
        assert_eq!(complaints(&page, None), Vec::<String>::new());
    }
}

#[test]
#[ignore = "needs time"]
fn page_bytes_ignore_thread_count() {
    let at = Workplace::new();
    at.done("test-scene -o d --gaussians 800 --frames 24");
    let pages = [1, 4].map(|threads| {
        at.done(&format!(
            "view d/scene.gseq d/compressed.gseq --cameras d/cameras.json -o {threads}.html --threads {threads}"
        ));
        fs::read(at.path(&format!("{threads}.html"))).unwrap()
    });
    assert!(pages[0] == pages[1]);
    // Bytes of the values as f32, per Gaussian: 44 of position, rotation, scale and opacity at every frame, and 192 of
    // SH coefficients at the first frame.
    let f32s = 800 * (24 * 44 + 192);
    assert!(pages[0].len() < f32s / 3, "{} bytes, of {f32s} as f32", pages[0].len());
}

#[test]
fn a_page_that_is_too_large_becomes_a_folder() {
    let at = Workplace::new();
    at.done("test-scene -o d --gaussians 300 --frames 24");
    let said = at.run("view d/scene.gseq -o scene.html --page-limit 10kB");
    assert_eq!(said.code, 0, "{}", said.stderr);
    assert!(
        said.stderr.contains("--page-limit") && said.stdout.starts_with("scene_page/index.html: 24 frames"),
        "{}",
        said.stdout
    );
    assert!(!at.path("scene.html").exists());
    let index = fs::read_to_string(at.path("scene_page/index.html")).unwrap();
    let chunks: Vec<String> = fs::read_dir(at.path("scene_page"))
        .unwrap()
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.starts_with("frames_"))
        .collect();
    assert!(chunks.len() > 1 && chunks.iter().all(|name| index.contains(name.as_str())), "{chunks:?}");
    let again = at.run("view d/scene.gseq -o scene_page");
    assert_eq!(again.code, 2);
    assert!(again.stderr.contains("exists already"), "{}", again.stderr);
    at.done("view d/scene.gseq -o scene_page --overwrite");
    // The folder must not replace a model that the page shows.
    at.done("convert d/scene.gseq model_page --as ply-sequence");
    let refused = at.run("view d/scene.gseq model_page -o model.html --page-limit 10kB --overwrite");
    assert_eq!(refused.code, 2, "{}", refused.stderr);
    assert!(refused.stderr.contains("is the input itself"), "{}", refused.stderr);
    fs::write(at.path("mine.html"), "precious").unwrap();
    assert_eq!(at.run("view d/scene.gseq -o mine.html").code, 2);
    assert_eq!(fs::read_to_string(at.path("mine.html")).unwrap(), "precious");
    let gone = at.run("view nowhere -o other.html");
    assert!(gone.code == 1 && gone.stderr.contains("nowhere") && !at.path("other.html").exists(), "{}", gone.stderr);
}

#[test]
fn every_format_can_be_viewed_and_compress_writes_the_page() {
    let at = Workplace::new();
    at.done("compress {tiny} --cameras {tiny} -o small --ratio 0.5 --view");
    let told = fs::read_to_string(at.path("small.html")).unwrap();
    assert!(told.contains("\"role\":\"original\"") && told.contains("\"role\":\"compressed\""));
    at.done("compress {tiny} --cameras {tiny} -o small.gsz --ratio 0.5 --view=both.html");
    assert!(at.path("both.html").exists());
    at.done("convert small frames --cameras {tiny} --as ply-sequence");
    at.done("convert small small.gseq --cameras {tiny}");
    fs::copy(at.path("frames/frame_00000.ply"), at.path("one.ply")).unwrap();
    for (k, input) in ["small.gsz", "frames", "small.gseq", "one.ply"].iter().enumerate() {
        at.done(&format!("view {input} -o {k}.html"));
        let page = fs::read_to_string(at.path(&format!("{k}.html"))).unwrap();
        assert!(page.contains("splatsieve.chunk(0,0,"), "{input}");
    }
    let refused = at.run("compress {tiny} --cameras {tiny} -o other --view=small.html");
    assert!(refused.code == 2 && !at.path("other").exists(), "{}", refused.stderr);
    let stream = at.run("compress - -o other.gseq --view");
    assert!(stream.code == 2 && stream.stderr.contains("--view"), "{}", stream.stderr);
}

#[test]
#[ignore = "needs a browser"]
fn hostile_names_run_no_script_in_any_page() {
    let program = browser::installed();
    let at = Workplace::new();
    at.done("convert {tiny} frames --cameras {tiny} --as ply-sequence --frames 2");
    let name = "<script>window.ran=1<img src=x onerror=window.ran=2>'\"&";
    fs::rename(at.path("frames"), at.path(name)).unwrap();
    for output in ["page.html", "pages"] {
        let run = at.run_words(["view", name, "-o", output]);
        assert_eq!(run.code, 0, "{}", run.stderr);
    }
    let run = at.run_words(["report", name, name, "--max-frames", "1", "-o", "report"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    for file in ["page.html", "pages/index.html", "report/report.html"] {
        let mut page = Browser::start_drawing(&program);
        page.open(&at.path(file));
        if !file.starts_with("report") {
            go(&mut page, "frame=1&paused");
        }
        assert_eq!(page.value("typeof window.ran"), json!("undefined"), "{file}: a name ran");
        assert_eq!(complaints(&page, Some(&at.path("pages"))), Vec::<String>::new(), "{file}");
        // If a text were not escaped, the content security policy would still keep its scripts from running.
        let text = fs::read_to_string(at.path(file)).unwrap();
        let broken = text.replace("</main>", "<script>window.ran=1</script><img src=x onerror=window.ran=2></main>");
        let beside = at.path(file).with_file_name("broken.html");
        fs::write(&beside, broken).unwrap();
        let mut page = Browser::start_drawing(&program);
        page.open(&beside);
        assert_eq!(page.value("typeof window.ran"), json!("undefined"), "{file}: the policy lets scripts run");
        let refused = complaints(&page, None).iter().any(|text| text.contains("Content Security Policy"));
        assert!(refused, "{file}: nothing was refused");
    }
}
