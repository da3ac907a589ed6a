//! Images of the report page: sliders that compare the original with compressed models, and animations.

use super::analysis::Analysis;
use super::film::{IMAGE_NAMES, JPEG_QUALITY};
use super::html::{db, escape, figure};
use super::shown_images::{MEDIAN, ShownImage, WORST};

/// Returns the HTML of two sliders for the compressed models `results`: one for the render with the median PSNR, and
/// one for the worst render. A slider shows two images of one view with a movable border between them. `names` has the
/// names of the compressed models.
pub(super) fn sliders(results: &[Analysis], names: &[String]) -> String {
    let first = &results[0].shown;
    let median = place_of(first, MEDIAN);
    let worst = place_of(first, WORST).filter(|&place| Some(place) != median);
    let titles = [(median, "A typical view"), (worst, "The worst view")];
    let mut out = String::from("<div class=\"sliders\">\n");
    for (place, title) in titles.into_iter().filter_map(|(place, title)| Some((place?, title))) {
        out += &slider(results, names, place, title);
    }
    out + "</div>\n<p class=\"note\">Drag the line, or use the arrow keys on the bar below an image. The difference is \
           made brighter until it can be seen.</p>\n"
}

/// Returns the HTML of the sliders of all renders chosen for the page, except the render with the median PSNR and the
/// worst one. A slider shows two images of one view with a movable border between them.
pub(super) fn other_sliders(results: &[Analysis], names: &[String]) -> String {
    let first = &results[0].shown;
    let median_and_worst = [MEDIAN, WORST].map(|why| place_of(first, why));
    let others: Vec<usize> = (0..first.len()).filter(|&place| !median_and_worst.contains(&Some(place))).collect();
    if others.is_empty() {
        return String::new();
    }
    let title = |place: usize| match first[place].choice.why.first().map(String::as_str) {
        Some("worst view") => "Worst render of the worst camera",
        _ => "Worst render of the worst frame",
    };
    let sliders: String = others.iter().map(|&place| slider(results, names, place, title(place))).collect();
    format!("<div class=\"sliders\">\n{sliders}</div>\n")
}

fn place_of(shown: &[ShownImage], why: &str) -> Option<usize> {
    shown.iter().position(|shown| shown.choice.why.iter().any(|reason| reason == why))
}

/// One of the images of a slider. A slider shows two images of one view at a time, with a movable border between them;
/// the user selects which two.
struct Layer<'a> {
    name: String,
    uri: &'a str,
    /// Text about the image, for the caption of the slider.
    note: String,
}

/// Returns all images that the user can select in one slider: original, compressed models, differences, and the
/// photograph if there is one. `place`: index of the shown render in [`Analysis::shown`]. `names`: names of the
/// compressed models.
fn layers<'a>(results: &'a [Analysis], names: &[String], place: usize) -> Vec<Layer<'a>> {
    let image = |result: &'a Analysis, kind: &str| {
        let found = result.shown.get(place)?.images.iter().find(|image| image.0 == kind)?;
        Some(found.1.as_str())
    };
    let layer = |name: &str, uri: Option<&'a str>, note: String| Some(Layer { name: name.to_owned(), uri: uri?, note });
    let is_alone = results.len() == 1;
    let mut layers = vec![layer("original", image(&results[0], "original"), String::new())];
    for (kind, each) in [("compressed", "{}"), ("difference", "difference of {}")] {
        layers.extend(results.iter().zip(names).map(|(result, name)| {
            let name = if is_alone { kind.to_owned() } else { each.replace("{}", name) };
            let shown = &result.shown[place];
            let note = match kind {
                "compressed" => scores(shown),
                _ => format!("the difference is {} times as bright as it is", shown.factor),
            };
            layer(&name, image(result, kind), note)
        }));
    }
    layers.push(layer("photograph", image(&results[0], "photograph"), String::new()));
    layers.into_iter().flatten().collect()
}

fn scores(shown: &ShownImage) -> String {
    let flip = shown.choice.flip.map_or(String::new(), |flip| format!(", FLIP {}", figure(flip)));
    format!("PSNR {}, SSIM {:.4}{flip}", db(shown.choice.psnr), shown.choice.ssim)
}

/// Returns the HTML of one slider, with the heading `title`. `place`: index of its render in [`Analysis::shown`]. The
/// images of a slider lie on top of one another; CSS classes select the two that are visible.
fn slider(results: &[Analysis], names: &[String], place: usize, title: &str) -> String {
    let shown = &results[0].shown[place];
    let layers = layers(results, names, place);
    let (width, height) = shown.size;
    let mut out = format!(
        "<figure class=\"slider\" style=\"--ratio: {width} / {height}\">\n<figcaption><h3>{title}</h3>\
         <span>frame {}, view {}</span></figcaption>\n<div class=\"stage\" style=\"--cut: 50%\">\n",
        shown.choice.frame, shown.choice.view
    );
    for (number, Layer { name, uri, note }) in layers.iter().enumerate() {
        let side = ["left", "right"].get(number).map_or(String::new(), |side| format!(" class=\"{side}\""));
        let name = escape(name);
        out += &format!(
            "<img data-layer=\"{number}\" data-note=\"{}\"{side} alt=\"{name}\" draggable=\"false\" src=\"{uri}\">\n",
            escape(note)
        );
    }
    out += "<i class=\"handle\"></i>\n</div>\n";
    out += &format!(
        "<input class=\"cut\" type=\"range\" min=\"0\" max=\"100\" step=\"0.5\" value=\"50\" \
         aria-label=\"{title}: part of the left image that is visible, percent\">\n<div class=\"sides\">\n"
    );
    for (side, selected) in [("left", 0), ("right", 1)] {
        out += &format!("<select data-side=\"{side}\" aria-label=\"{title}: {side} image\">");
        for (number, layer) in layers.iter().enumerate() {
            let mark = if number == selected { " selected" } else { "" };
            out += &format!("<option value=\"{number}\"{mark}>{}</option>", escape(&layer.name));
        }
        out += "</select>\n";
    }
    let shrunk = at_size(shown.shrunk);
    out + &format!("</div>\n<p class=\"caption\">{}{shrunk}</p>\n</figure>\n", scores(shown))
}

/// Returns a remark for the caption of scaled-down images, in which each pixel stands for `shrunk` × `shrunk` pixels of
/// the render. Returns an empty text if `shrunk` is 1.
fn at_size(shrunk: u32) -> String {
    match shrunk {
        1 => String::new(),
        by => format!("; shown at 1/{by} of its size"),
    }
}

/// Returns the HTML of the animations with their controls. If scripts are disabled, only the first frame of each
/// animation is visible.
pub(super) fn films(results: &[Analysis], names: &[String]) -> String {
    let films = &results[0].films;
    let Some(first) = films.first() else { return String::new() };
    let mut out = String::from("<div id=\"reel\" class=\"bar\" hidden>");
    if films.len() > 1 {
        for (number, film) in films.iter().enumerate() {
            let title = if film.why.iter().any(|why| why == MEDIAN) { "Typical view" } else { "Worst view" };
            out += &format!(
                "<button type=\"button\" data-play=\"{number}\" aria-pressed=\"{}\">{title}</button>\n",
                number == 0
            );
        }
    }
    out += &format!(
        "<button type=\"button\" id=\"play\">Play</button><input type=\"range\" min=\"0\" max=\"{}\" step=\"1\" value=\"0\" \
         aria-label=\"Frame\"><output></output></div>\n",
        first.frames.len() - 1
    );
    // Each column: its name, the index of its compressed model in `results`, and the index of its image in
    // `IMAGE_NAMES`.
    let columns: Vec<(String, usize, usize)> = match results.len() {
        1 => IMAGE_NAMES.iter().enumerate().map(|(kind, name)| ((*name).to_owned(), 0, kind)).collect(),
        _ => std::iter::once((IMAGE_NAMES[0].to_owned(), 0, 0))
            .chain(names.iter().enumerate().map(|(result, name)| (name.clone(), result, 1)))
            .collect(),
    };
    for (number, film) in films.iter().enumerate() {
        let join = |values: Vec<String>| values.join(" ");
        let active = if number == 0 { " active" } else { "" };
        out += &format!(
            "<div class=\"film{active}\" data-film=\"{number}\" data-frames=\"{}\" data-psnr=\"{}\" style=\"--ratio: {} / {}\">\n",
            join(film.frames.iter().map(usize::to_string).collect()),
            join(film.psnr.iter().map(|psnr| format!("{psnr:.2}")).collect()),
            film.size.0,
            film.size.1
        );
        for (name, result, kind) in &columns {
            let Some(of) = results[*result].films.get(number) else { continue };
            let name = escape(name);
            out += &format!("<figure><figcaption>{name}</figcaption><div class=\"pile\">");
            for (place, (images, frame)) in of.images.iter().zip(&of.frames).enumerate() {
                let now = if place == 0 { " class=\"now\"" } else { "" };
                out +=
                    &format!("<img{now} alt=\"{name}, frame {frame}\" draggable=\"false\" src=\"{}\">", images[*kind]);
            }
            out += "</div></figure>\n";
        }
        let difference = match results.len() {
            1 => format!("the difference is {} times as bright as it is; ", film.factor),
            _ => String::new(),
        };
        out += &format!(
            "<p class=\"note\">View {}, by its camera at frame {}: {} frames, evenly from first to last; {difference}JPEG of \
             quality {JPEG_QUALITY}, the figures are those of the renders themselves{}.</p>\n</div>\n",
            film.view,
            film.camera_of_frame,
            film.frames.len(),
            at_size(film.shrunk)
        );
    }
    out
}
