//! Result of an evaluation as JSON, text and CSV: quality measures of every view and their means.
//!
//! Input: quality measures of every (frame, view) pair, sorted by frame, then view. Output: means over all views, per
//! view and per frame, as JSON and text, and the quality measures themselves as CSV. A mean is a sum, added in the order
//! of the input, divided by the number of values.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::error::ShowPath;
use crate::files::csv::{optional_field, table};
use crate::files::names::name_of;
use crate::journal::records::RenderTime;
use crate::models::ModelSize;
use crate::models::size::format_ratio;
use crate::pipeline::summary::CameraSummary;
use crate::progress::counted;

/// Pair of values: one for the original model and one for the compressed model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct OriginalAndCompressed<T> {
    /// Value of the original model.
    pub original: T,
    /// Value of the compressed model.
    pub compressed: T,
}

/// Quality measures (PSNR, SSIM, …) of one image compared with another image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ImageQuality {
    /// PSNR, dB ([`crate::metrics::psnr`]).
    pub psnr: f64,
    /// SSIM ([`crate::metrics::ssim`]).
    pub ssim: f64,
    /// Temporal error (flicker) since the previous image of the same view ([`crate::metrics::temporal_error`]); `None`
    /// for the first image of a view.
    pub temporal: Option<f64>,
    /// FLIP ([`crate::metrics::flip`]); `None` if it was not requested.
    pub flip: Option<f64>,
}

/// Quality measures of one view at one frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewQuality {
    /// Index of the frame in the sequence.
    pub frame: usize,
    /// Time stamp of the frame.
    pub time: f64,
    /// Number of the view in the data set.
    pub view: u32,
    /// Quality measures of the compressed model against the original.
    pub loss: ImageQuality,
    /// Quality measures of both models against the photograph; `None` without a photograph.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<OriginalAndCompressed<ImageQuality>>,
}

/// Mean quality measures over a set of views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct QualityMeans {
    /// Number of (frame, view) pairs over which quality measures are averaged.
    pub pairs: usize,
    /// Mean PSNR, dB.
    pub psnr: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Mean temporal error: flicker of a view between its previous evaluated frame and this one. The mean is over the
    /// (frame, view) pairs that have a temporal error; the first frame of a view has none. `None` if no pair has one.
    pub temporal: Option<f64>,
    /// Mean FLIP; `None` if it was not requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub flip: Option<f64>,
}

/// Mean quality measures over all frames of one view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ViewMeans {
    /// Number of the view in the data set.
    pub view: u32,
    /// Means of the quality measures over the frames of this view.
    #[serde(flatten)]
    pub means: QualityMeans,
}

/// Mean quality measures over all views of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FrameMeans {
    /// Index of the frame in the sequence.
    pub frame: usize,
    /// Time stamp of the frame.
    pub time: f64,
    /// Means of the quality measures over the views of this frame. The temporal error of a view (its flicker) is
    /// between the previous evaluated frame and this one.
    #[serde(flatten)]
    pub means: QualityMeans,
}

/// Mean quality measures of one set of images compared with another, such as renders with photographs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    /// Mean quality measures over all views.
    #[serde(flatten)]
    pub overall: QualityMeans,
    /// Mean quality measures over the frames of each view, by increasing view number.
    pub per_view: Vec<ViewMeans>,
    /// Mean quality measures over the views of each frame, by increasing frame.
    pub per_frame: Vec<FrameMeans>,
}

/// Comparison of both models with photographs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TruthComparison {
    /// Path of the folder of the photographs.
    pub folder: String,
    /// Number of views on which the models are compared. Only [`QualityMeans::pairs`] of them have a photograph.
    #[serde(rename = "of")]
    pub compared_views: usize,
    /// Mean quality measures of the compressed model against the photographs.
    #[serde(flatten)]
    pub compressed: Comparison,
    /// Mean quality measures of the original model against the photographs, for comparison with the quality measures of
    /// the compressed model.
    pub original: Comparison,
}

/// Mean quality measures of the compressed model against the original, separately for views whose cameras are inside
/// and outside the rig of the training cameras (the cone of their directions,
/// [`RigCone`](crate::scene::views_outside::RigCone)).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct InsideOutsideMeans {
    /// Mean quality measures over the views inside the rig: in the directions of the training cameras and between them.
    /// `None` if there are no such views.
    pub inside: Option<QualityMeans>,
    /// Mean quality measures over the views outside the rig of the training cameras.
    pub outside: QualityMeans,
}

/// Result of the evaluation of a compressed model.
#[derive(Debug, Clone, Serialize)]
pub struct Evaluation {
    /// Name and version of the program.
    pub tool: String,
    /// Paths of both models, as given.
    pub path: OriginalAndCompressed<String>,
    /// Numbers of Gaussians of both models.
    pub count: OriginalAndCompressed<usize>,
    /// Total size of each model in bytes.
    pub bytes: OriginalAndCompressed<u64>,
    /// Size of each model in bytes, divided into parts, such as canonical Gaussians and deformation field.
    pub size: OriginalAndCompressed<ModelSize>,
    /// Origin and number of the cameras, and number of the views on which the models are compared.
    pub cameras: CameraSummary,
    /// Split to which these views belong: `train`, `val` or `test`; `all` for views of all splits.
    pub split: String,
    /// Background color: red, green, blue in [0, 1].
    pub background: [f32; 3],
    /// Mean quality measures of the compressed model against the original.
    #[serde(flatten)]
    pub loss: Comparison,
    /// Mean quality measures of the views inside the rig of the training cameras (in their directions and between
    /// them), and of the views outside it; `None` if no view is outside, or if the cameras have no training views.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rig_sides: Option<InsideOutsideMeans>,
    /// Mean quality measures of both models against photographs; `None` without `--ground-truth` or without any
    /// photograph.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ground_truth: Option<TruthComparison>,
    /// Time of rendering one view with each model, milliseconds; `None` if it was not measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub render_ms: Option<RenderTime>,
    /// Notes for the user.
    pub notes: Vec<String>,
    /// Notes for the user about the cache folder, which are not part of the result.
    #[serde(skip)]
    pub work_notes: Vec<String>,
    /// Quality measures of every view, for the CSV file.
    #[serde(skip)]
    pub views: Vec<ViewQuality>,
}

impl QualityMeans {
    /// Computes the means of `qualities`, the quality measures of views. If `qualities` is empty, `pairs` is 0, and
    /// PSNR and SSIM are NaN, which JSON writes as null.
    fn from_image_qualities(qualities: &[ImageQuality]) -> QualityMeans {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let all = |value: fn(&ImageQuality) -> f64| mean(&qualities.iter().map(value).collect::<Vec<_>>());
        let given = |value: fn(&ImageQuality) -> Option<f64>| {
            let values: Vec<f64> = qualities.iter().filter_map(value).collect();
            (!values.is_empty()).then(|| mean(&values))
        };
        QualityMeans {
            pairs: qualities.len(),
            psnr: all(|score| score.psnr),
            ssim: all(|score| score.ssim),
            temporal: given(|score| score.temporal),
            flip: given(|score| score.flip),
        }
    }
}

impl Comparison {
    /// Averages quality measures over all `views`, over the frames of each view, and over the views of each frame.
    /// `views` must be sorted by frame. `quality` returns the measures of an element of `views`, or `None` to leave the
    /// element out. Returns `None` if all elements are left out.
    pub fn from_views(
        views: &[ViewQuality],
        quality: impl Fn(&ViewQuality) -> Option<ImageQuality>,
    ) -> Option<Comparison> {
        let (views, qualities): (Vec<&ViewQuality>, Vec<ImageQuality>) =
            views.iter().filter_map(|view| Some((view, quality(view)?))).unzip();
        if qualities.is_empty() {
            return None;
        }
        let mut qualities_by_view: BTreeMap<u32, Vec<ImageQuality>> = BTreeMap::new();
        for (view, &quality) in views.iter().zip(&qualities) {
            qualities_by_view.entry(view.view).or_default().push(quality);
        }
        let mut per_frame = Vec::new();
        let mut rest = &qualities[..];
        for frame in views.chunk_by(|a, b| a.frame == b.frame) {
            let (frame_qualities, after) = rest.split_at(frame.len());
            per_frame.push(FrameMeans {
                frame: frame[0].frame,
                time: frame[0].time,
                means: QualityMeans::from_image_qualities(frame_qualities),
            });
            rest = after;
        }
        Some(Comparison {
            overall: QualityMeans::from_image_qualities(&qualities),
            per_view: qualities_by_view
                .iter()
                .map(|(&view, qualities)| ViewMeans { view, means: QualityMeans::from_image_qualities(qualities) })
                .collect(),
            per_frame,
        })
    }
}

impl InsideOutsideMeans {
    /// Averages the quality measures of the compressed model against the original, separately for views inside and
    /// outside the rig of the training cameras. `is_outside[i]` states whether the view `views[i]` is outside. Returns
    /// `None` if no view is outside.
    pub fn from_views(views: &[ViewQuality], is_outside: &[bool]) -> Option<InsideOutsideMeans> {
        let side = |outside: bool| -> Option<QualityMeans> {
            let chosen = views.iter().zip(is_outside).filter(|&(_, &is)| is == outside);
            let qualities: Vec<ImageQuality> = chosen.map(|(view, _)| view.loss).collect();
            (!qualities.is_empty()).then(|| QualityMeans::from_image_qualities(&qualities))
        };
        Some(InsideOutsideMeans { inside: side(false), outside: side(true)? })
    }
}

impl Evaluation {
    /// Returns the evaluation with every path reduced to its last component, for writing to a file.
    pub fn without_folder_paths(mut self) -> Evaluation {
        let truth = self.ground_truth.as_mut().map(|truth| &mut truth.folder);
        for path in [&mut self.path.original, &mut self.path.compressed].into_iter().chain(truth) {
            *path = name_of(Path::new(path));
        }
        self
    }

    /// Returns the render with the lowest PSNR against the original; `None` if there are no views.
    pub fn worst_render(&self) -> Option<&ViewQuality> {
        self.views.iter().min_by(|a, b| a.loss.psnr.total_cmp(&b.loss.psnr))
    }

    /// Returns the largest number of frames between an evaluated image of a view and the previous evaluated image of the
    /// same view; 0 if no view has two images.
    fn max_frame_step(&self) -> usize {
        let mut last = BTreeMap::new();
        let steps = self.views.iter().filter_map(|view| Some(view.frame - last.insert(view.view, view.frame)?));
        steps.max().unwrap_or(0)
    }

    /// Returns the evaluation as text for the terminal: both models, a table of mean quality measures, the worst view
    /// and the worst frame, and the notes.
    pub fn text(&self) -> String {
        let mut out = String::new();
        let OriginalAndCompressed { original, compressed } = self.count;
        let percent = 100.0 * compressed as f64 / original.max(1) as f64;
        // Writing to a String cannot fail.
        let (before, after) = (self.size.original, self.size.compressed);
        let _ = writeln!(
            out,
            "{}: {original} Gaussians; {} bytes: {}",
            Path::new(&self.path.original).shown(),
            before.total(),
            before.parts_text()
        );
        let _ = writeln!(
            out,
            "{}: {compressed} Gaussians ({percent:.1}%); bytes: {}: {}",
            Path::new(&self.path.compressed).shown(),
            format_ratio(after.total(), before.total()),
            after.format_relative_to(&before)
        );
        let frames = self.loss.per_frame.len();
        let kind = match self.split.as_str() {
            "train" => "training view",
            "val" => "validation view",
            "test" => "test view",
            _ => "view",
        };
        let views = counted(self.cameras.pairs, kind);
        let _ = writeln!(out, "{views} of {}: {}", counted(frames, "frame"), self.cameras.origin);
        let with_flip = self.loss.overall.flip.is_some();
        let flip = if with_flip { "     FLIP" } else { "" };
        let _ = writeln!(out, "  {:<38} {:>8} {:>8} {:>10}{flip}", "", "PSNR dB", "SSIM", "temporal");
        let mut line = |label: &str, means: &QualityMeans| {
            let temporal = means.temporal.map_or("-".to_owned(), |error| format!("{error:.6}"));
            let flip = means.flip.map_or(String::new(), |error| format!(" {error:>8.5}"));
            let _ = writeln!(out, "  {label:<38} {:>8.3} {:>8.5} {temporal:>10}{flip}", means.psnr, means.ssim);
        };
        line("compressed against original", &self.loss.overall);
        if let Some(InsideOutsideMeans { inside, outside }) = self.rig_sides {
            if let Some(inside) = inside {
                line(&format!("{} views inside the training rig", inside.pairs), &inside);
            }
            line(&format!("{} views outside the training rig", outside.pairs), &outside);
        }
        if let Some(truth) = &self.ground_truth {
            line("compressed against ground truth", &truth.compressed.overall);
            line("original against ground truth", &truth.original.overall);
        }
        let worst_view = self.loss.per_view.iter().min_by(|a, b| a.means.psnr.total_cmp(&b.means.psnr));
        let worst_frame = self.loss.per_frame.iter().min_by(|a, b| a.means.psnr.total_cmp(&b.means.psnr));
        if let (Some(view), Some(frame)) = (worst_view, worst_frame) {
            line(&format!("worst view: {}", view.view), &view.means);
            line(&format!("worst frame: {}", frame.frame), &frame.means);
        }
        if let Some(truth) = &self.ground_truth {
            let pairs = truth.compressed.overall.pairs;
            if pairs < truth.compared_views {
                let _ = writeln!(
                    out,
                    "  ground truth: {pairs} of {} views have a photograph in {}",
                    truth.compared_views, truth.folder
                );
            }
        }
        let step = self.max_frame_step();
        if step > 1 && self.loss.overall.temporal.is_some() {
            let _ = writeln!(
                out,
                "  temporal error: between evaluated images of a view, which are up to {step} frames apart"
            );
        }
        if let Some(RenderTime { before, after }) = self.render_ms {
            let _ =
                writeln!(out, "  render time per view, one thread: {before:.1} ms original, {after:.1} ms compressed");
        }
        for note in &self.notes {
            let _ = writeln!(out, "  note: {note}");
        }
        out
    }

    /// Returns the quality measures as a CSV table with one row per (frame, view) pair. A missing value is an empty
    /// field.
    pub fn csv(&self) -> String {
        let with_flip = self.loss.overall.flip.is_some();
        let compared = if self.ground_truth.is_some() { &["", "_gt", "_gt_original"][..] } else { &[""] };
        let mut names = ["frame", "view", "time"].map(str::to_owned).to_vec();
        for suffix in compared {
            names.extend(["psnr", "ssim", "temporal"].map(|score| format!("{score}{suffix}")));
            names.extend(with_flip.then(|| format!("flip{suffix}")));
        }
        let row = |view: &ViewQuality| {
            let mut row = vec![view.frame.to_string(), view.view.to_string(), view.time.to_string()];
            let truth = view.truth.map(|truth| [truth.compressed, truth.original]);
            for score in std::iter::once(view.loss).chain(truth.into_iter().flatten()) {
                row.extend([score.psnr.to_string(), score.ssim.to_string(), optional_field(score.temporal)]);
                row.extend(with_flip.then(|| optional_field(score.flip)));
            }
            row.resize(names.len(), String::new());
            row
        };
        table(&names, self.views.iter().map(row))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view_quality(frame: usize, view: u32, psnr: f64, temporal: Option<f64>) -> ViewQuality {
        let loss = ImageQuality { psnr, ssim: psnr / 100.0, temporal, flip: None };
        ViewQuality { frame, time: frame as f64 / 4.0, view, loss, truth: None }
    }

    #[test]
    fn means_weigh_views_alike_and_skip_missing_temporal_errors() {
        let scores = [
            view_quality(0, 1, 30.0, None),
            view_quality(0, 2, 40.0, None),
            view_quality(2, 1, 50.0, Some(0.25)),
            view_quality(2, 7, 20.0, None),
            view_quality(3, 1, 10.0, Some(0.75)),
        ];
        let found = Comparison::from_views(&scores, |view| Some(view.loss)).unwrap();
        assert_eq!(found.overall, QualityMeans { pairs: 5, psnr: 30.0, ssim: 0.3, temporal: Some(0.5), flip: None });
        let views: Vec<_> = found.per_view.iter().map(|v| (v.view, v.means.pairs, v.means.psnr)).collect();
        assert_eq!(views, [(1, 3, 30.0), (2, 1, 40.0), (7, 1, 20.0)]);
        let frames: Vec<_> = found.per_frame.iter().map(|f| (f.frame, f.means.psnr, f.means.temporal)).collect();
        assert_eq!(frames, [(0, 35.0, None), (2, 35.0, Some(0.25)), (3, 10.0, Some(0.75))]);
        assert!(Comparison::from_views(&scores, |view| view.truth.map(|truth| truth.original)).is_none());
    }

    fn evaluation(views: Vec<ViewQuality>) -> Evaluation {
        let truth = Comparison::from_views(&views, |view| view.truth.map(|truth| truth.compressed));
        Evaluation {
            tool: String::new(),
            path: OriginalAndCompressed { original: String::new(), compressed: String::new() },
            count: OriginalAndCompressed { original: 0, compressed: 0 },
            bytes: OriginalAndCompressed { original: 0, compressed: 0 },
            size: OriginalAndCompressed { original: ModelSize::default(), compressed: ModelSize::default() },
            cameras: CameraSummary { origin: String::new(), cameras: 1, pairs: 2 },
            split: "test".to_owned(),
            background: [0.0; 3],
            loss: Comparison::from_views(&views, |view| Some(view.loss)).unwrap(),
            rig_sides: None,
            ground_truth: truth.map(|comparison| TruthComparison {
                folder: String::new(),
                compared_views: 2,
                compressed: comparison.clone(),
                original: comparison,
            }),
            render_ms: None,
            notes: Vec::new(),
            work_notes: Vec::new(),
            views,
        }
    }

    #[test]
    fn views_inside_and_outside_the_rig_are_averaged_separately() {
        let views = [view_quality(0, 1, 30.0, None), view_quality(0, 2, 20.0, None), view_quality(1, 1, 40.0, None)];
        let sides = InsideOutsideMeans::from_views(&views, &[false, true, false]).unwrap();
        assert_eq!((sides.inside.unwrap().psnr, sides.outside.psnr, sides.outside.pairs), (35.0, 20.0, 1));
        assert!(InsideOutsideMeans::from_views(&views, &[true; 3]).unwrap().inside.is_none());
        assert!(InsideOutsideMeans::from_views(&views, &[false; 3]).is_none());
        let mut found = evaluation(views.to_vec());
        found.rig_sides = Some(sides);
        let text = found.text();
        assert!(text.contains("2 views inside the training rig"), "{text}");
        assert!(text.contains("1 views outside the training rig"), "{text}");
    }

    #[test]
    fn text_names_the_split_and_the_distance_of_compared_frames() {
        let images = |last| {
            vec![view_quality(0, 1, 30.0, None), view_quality(0, 2, 30.0, None), view_quality(last, 1, 30.0, Some(0.1))]
        };
        let (next, apart) = (evaluation(images(1)).text(), evaluation(images(4)).text());
        assert!(next.contains("\n2 test views of 2 frames: ") && !next.contains("apart"), "{next}");
        assert!(apart.contains("images of a view, which are up to 4 frames apart\n"), "{apart}");
        let all = Evaluation { split: "all".to_owned(), ..evaluation(images(1)) }.text();
        assert!(all.contains("\n2 views of 2 frames: "), "{all}");
    }

    #[test]
    fn csv_matches_the_expected_text() {
        let mut views = vec![view_quality(0, 1, 30.0, None), view_quality(3, 2, 3e-5, Some(0.25))];
        assert_eq!(
            evaluation(views.clone()).csv(),
            "frame,view,time,psnr,ssim,temporal\n0,1,0,30,0.3,\n3,2,0.75,0.00003,0.0000003,0.25\n"
        );
        for view in &mut views {
            view.loss.flip = Some(0.5);
            view.truth = Some(OriginalAndCompressed {
                original: ImageQuality { flip: None, ..view.loss },
                compressed: view.loss,
            });
        }
        assert_eq!(
            evaluation(views).csv(),
            "frame,view,time,psnr,ssim,temporal,flip,psnr_gt,ssim_gt,temporal_gt,flip_gt,\
             psnr_gt_original,ssim_gt_original,temporal_gt_original,flip_gt_original\n\
             0,1,0,30,0.3,,0.5,30,0.3,,0.5,30,0.3,,\n\
             3,2,0.75,0.00003,0.0000003,0.25,0.5,0.00003,0.0000003,0.25,0.5,0.00003,0.0000003,0.25,\n"
        );
    }
}
