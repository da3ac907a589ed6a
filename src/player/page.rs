//! Writes the page that plays a scene: a program for the browser, the description of the scene, and the chunks (encoded
//! groups of frames) of its models.
//!
//! Input: chunks, in the order in which they are encoded. Output: one HTML file, or a folder whose page loads the
//! chunks as scripts, because a page opened from a disk may not read files. Memory: one chunk. Names of files are
//! inserted as JSON without `<`, and the program shows them as text.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::DVec3;
use hashbrown::HashMap;
use serde::Serialize;

use super::track::PageSequence;
use crate::TOOL;
use crate::error::{Error, Result};
use crate::files::atomic::ScratchFolder;
use crate::files::page_policy::{policy_digest, policy_meta_element};
use crate::model::{Camera, Rig};
use crate::scene::views_outside::{MIN_ANGLE, RigCone, training_cameras};

/// File name of the player page in an output folder.
pub const INDEX_FILE: &str = "index.html";
/// Maximum number of cameras on the player page. If there are more cameras, an evenly spaced selection of them is
/// taken.
const CAMERAS: usize = 400;

const PAGE: &str = include_str!("page/page.html");
/// Placeholders in the HTML of the player page, each with the text that replaces it.
const PARTS: [(&str, &str); 3] = [
    ("/*page.css*/", include_str!("page/page.css")),
    ("/*sorter.js*/", include_str!("page/sorter.js")),
    ("/*player.js*/", concat!(include_str!("page/painter.js"), include_str!("page/player.js"))),
];
/// Names and sources of the shaders of the player page.
const SHADERS: [(&str, &str); 5] = [
    ("cover", include_str!("page/cover.vert")),
    ("project", include_str!("page/project.frag")),
    ("quad", include_str!("page/quad.vert")),
    ("splat", include_str!("page/splat.frag")),
    ("compose", include_str!("page/compose.frag")),
];

/// Description of one model on the player page.
#[derive(Debug, Serialize)]
pub struct PageModelInfo {
    /// Role of the model: `original` or `compressed`.
    pub role: &'static str,
    /// Name of the model's file or folder.
    pub name: String,
    /// Size of the model on disk in bytes.
    pub bytes: u64,
    /// Number of frames of the model; the page may show fewer.
    pub frames: usize,
    /// SH degree of the model.
    pub degree: usize,
    /// Description of the encoded frames of the model.
    pub track: PageSequence,
}

/// Description of the scene on the player page.
#[derive(Debug, Serialize)]
pub struct PageScene {
    /// Name and version of the program that wrote the page.
    pub tool: &'static str,
    /// One model, or the original and the compressed model.
    pub models: Vec<PageModelInfo>,
    /// Cameras of the scene.
    pub cameras: Vec<PageCamera>,
    /// Background color: red, green, blue in [0, 1].
    pub background: [f32; 3],
    /// Center of the scene, in scene units.
    #[serde(rename = "middle")]
    pub center: [f64; 3],
    /// Longest side of the scene in scene units, measured without stray Gaussians far away (floaters).
    pub extent: f64,
    /// Mean upward direction of the cameras.
    pub up: [f64; 3],
    /// Cone of the directions from which the training cameras see the scene; `None` if there are no training cameras,
    /// or if they are all around the scene.
    pub rig: Option<PageRig>,
    /// Names of the files of the chunks (encoded groups of frames) to load, in order; empty if the page itself contains
    /// the chunks.
    pub files: Vec<String>,
    /// Data URI of the image that the page shows until the scene is drawn. It becomes an `<img>` element, not a part of
    /// the JSON.
    #[serde(skip)]
    pub poster: Option<String>,
}

/// Cone of the directions from which the training cameras see the scene. The page tells the user when the shown view is
/// from outside this cone, because the model was not fitted to such views.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PageRig {
    /// Apex of the cone: the point where the optical axes of the cameras meet, in scene units.
    focus: [f64; 3],
    /// Inward unit normals of the faces of the cone, which contains the directions from its apex to the cameras.
    faces: Vec<[f64; 3]>,
    /// Sine of the angle by which a direction must lie beyond a face of the cone to count as outside the cone.
    tolerance: f64,
}

/// Maximum number of training cameras from which the cone of directions is computed. If there are more cameras, an
/// evenly spaced selection of them is used.
const RIG_CAMERAS: usize = 64;

/// Returns the cone of the directions from which the training cameras of `rig` see the scene. Returns `None` if there
/// are no such cameras, or if they are all around the scene.
pub fn training_rig(rig: &Rig) -> Option<PageRig> {
    let all = training_cameras(rig);
    let step = all.len().div_ceil(RIG_CAMERAS).max(1);
    let cone = RigCone::new(&all.into_iter().step_by(step).collect::<Vec<Camera>>());
    let faces: Vec<[f64; 3]> = cone.inward_face_normals().iter().map(|face| face.to_array()).collect();
    (!faces.is_empty()).then(|| PageRig { focus: cone.focus().to_array(), faces, tolerance: MIN_ANGLE.sin() })
}

/// Camera on the player page.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PageCamera {
    view: u32,
    /// Split of the camera (train, val or test), or "virtual" if the program placed it.
    split: &'static str,
    /// Time of the camera's only view. `None` if the camera has several views or if its view has no time.
    time: Option<f64>,
    size: [u32; 2],
    focal: [f64; 2],
    principal: [f64; 2],
    near: f64,
    /// Rotation matrix from world to camera coordinates, row by row.
    rotation: [[f64; 3]; 3],
    eye: [f64; 3],
}

/// Returns a description, for the page, of each camera that takes a view of `rig`. A camera with several view numbers
/// gets one entry per view number. Of more than 400 entries, returns an evenly spaced selection of at most 400.
/// `is_virtual`: whether the program placed the cameras.
pub fn cameras(rig: &Rig, is_virtual: bool) -> Vec<PageCamera> {
    let mut places: HashMap<(u32, u32), usize> = HashMap::new();
    let mut found: Vec<(PageCamera, usize)> = Vec::new();
    for rig_view in &rig.views {
        let place = *places.entry((rig_view.view, rig_view.camera)).or_insert(found.len());
        if let Some((look, rig_views)) = found.get_mut(place) {
            *rig_views += 1;
            look.time = None;
            continue;
        }
        let camera = &rig.cameras[rig_view.camera as usize];
        let look = PageCamera {
            view: rig_view.view,
            split: if is_virtual { "virtual" } else { rig_view.split.name() },
            time: rig_view.time,
            size: [camera.width, camera.height],
            focal: [camera.fx, camera.fy],
            principal: [camera.cx, camera.cy],
            near: camera.near,
            rotation: [0, 1, 2].map(|row| camera.rotation.row(row).to_array()),
            eye: camera.center().to_array(),
        };
        found.push((look, 1));
    }
    let step = found.len().div_ceil(CAMERAS).max(1);
    found.into_iter().step_by(step).map(|(look, _)| look).collect()
}

/// Returns the mean upward direction of the cameras of `rig` as a unit vector; z if the directions cancel.
pub fn mean_up(rig: &Rig) -> DVec3 {
    let sum: DVec3 = rig.cameras.iter().map(|camera| -camera.rotation.row(1)).sum();
    let is_known = sum.is_finite() && sum.length() > 1e-3 * rig.cameras.len() as f64;
    if is_known { sum.normalize() } else { DVec3::Z }
}

/// Collection of encoded chunks (groups of frames), stored as scripts in scratch files until the page is written.
pub struct ChunkFiles {
    folder: ScratchFolder,
    /// Entry of each chunk: position of its first frame as a fraction of the frames shown, index of its model, index of
    /// the chunk in the model, number of bytes of its script.
    made: Vec<(f64, usize, usize, u64)>,
    /// Digests of the scripts of the chunks, which the content security policy of the page lists.
    digests: Vec<String>,
}

impl ChunkFiles {
    /// Creates an empty collection of chunks, with a temporary folder in `scratch`.
    ///
    /// # Errors
    /// Fails if the folder cannot be created.
    pub fn new(scratch: &Path) -> Result<ChunkFiles> {
        Ok(ChunkFiles { folder: ScratchFolder::new(scratch)?, made: Vec::new(), digests: Vec::new() })
    }

    /// Stores `bytes` as chunk (encoded group of frames) number `chunk` of model number `model`. `since` is the
    /// position in time of the first frame of the chunk: the index of the frame divided by the number of frames shown.
    ///
    /// # Errors
    /// Fails if the scratch file cannot be written.
    pub fn add_chunk(&mut self, model: usize, chunk: usize, since: f64, bytes: &[u8]) -> Result<()> {
        let path = self.path(model, chunk);
        let script = format!("splatsieve.chunk({model},{chunk},\"{}\");\n", STANDARD.encode(bytes));
        fs::write(&path, &script).map_err(Error::io("write", &path))?;
        self.made.push((since, model, chunk, script.len() as u64));
        self.digests.push(policy_digest(&script));
        Ok(())
    }

    /// Returns the size in bytes of the scripts of all chunks.
    pub fn bytes(&self) -> u64 {
        self.made.iter().map(|made| made.3).sum()
    }

    fn path(&self, model: usize, chunk: usize) -> PathBuf {
        self.folder.path().join(name(model, chunk))
    }

    /// Returns the pairs (model, chunk number) of all chunks (encoded groups of frames) in the order in which the page
    /// loads them. Chunks are sorted by the position in time of their first frames, so that the chunks with the first
    /// frames of both models load first.
    fn ordered(&self) -> Vec<(usize, usize)> {
        let mut made = self.made.clone();
        made.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.2, a.1).cmp(&(b.2, b.1))));
        made.into_iter().map(|(_, model, chunk, _)| (model, chunk)).collect()
    }

    /// Writes the page as one HTML file to `path`, which contains all chunks (encoded groups of frames). `stage`
    /// describes the scene. Returns the size of the file in bytes.
    ///
    /// # Errors
    /// Fails if a file cannot be read or written.
    pub fn write_page(&self, stage: &PageScene, path: &Path) -> Result<u64> {
        let failed = || Error::io("write", path);
        let mut to = BufWriter::new(File::create(path).map_err(failed())?);
        to.write_all(head(stage, &self.digests).as_bytes()).map_err(failed())?;
        for (model, chunk) in self.ordered() {
            let from = self.path(model, chunk);
            let script = fs::read(&from).map_err(Error::io("read", &from))?;
            to.write_all(b"<script>").and_then(|()| to.write_all(&script)).map_err(failed())?;
            to.write_all(b"</script>\n").map_err(failed())?;
        }
        to.write_all(b"</body>\n</html>\n").and_then(|()| to.flush()).map_err(failed())?;
        Ok(fs::metadata(path).map_err(failed())?.len())
    }

    /// Writes the page into `folder`, and its chunks as separate files beside it. Stores the names of the chunk files
    /// in `stage`, the description of the scene. Returns the names of all written files, and their total size in bytes.
    ///
    /// # Errors
    /// Fails if a file cannot be read or written.
    pub fn write_folder(&self, stage: &mut PageScene, folder: &Path) -> Result<(Vec<String>, u64)> {
        stage.files = self.ordered().into_iter().map(|(model, chunk)| name(model, chunk)).collect();
        for file in &stage.files {
            let (from, to) = (self.folder.path().join(file), folder.join(file));
            fs::copy(&from, &to).map_err(Error::io("write", &to))?;
        }
        // A chunk file on a disk has no origin that the policy could name. So the policy allows the scripts that the
        // page itself adds.
        let page = head(stage, &["'strict-dynamic'".to_owned()]) + "</body>\n</html>\n";
        let path = folder.join(INDEX_FILE);
        fs::write(&path, &page).map_err(Error::io("write", &path))?;
        let names = stage.files.iter().cloned().chain([INDEX_FILE.to_owned()]).collect();
        Ok((names, self.bytes() + page.len() as u64))
    }
}

fn name(model: usize, chunk: usize) -> String {
    format!("frames_{model}_{chunk:05}.js")
}

/// Returns the start of the HTML of the page for the scene `stage`, up to the place where the chunks (scripts with
/// encoded frames) begin. `chunks` lists the scripts that the content security policy of the page allows besides its
/// own: the digests of the chunks, or the keyword `'strict-dynamic'`.
fn head(stage: &PageScene, chunks: &[String]) -> String {
    let shaders: serde_json::Map<String, serde_json::Value> =
        SHADERS.iter().map(|&(name, text)| (name.to_owned(), text.into())).collect();
    let json = serde_json::to_value(stage).expect("plain data");
    let mut page = PARTS.iter().fold(PAGE.to_owned(), |page, (mark, text)| page.replace(mark, text));
    page = page.replace("/*tool*/", TOOL).replace("/*shaders*/", &inline(&shaders.into()));
    let image = |uri: &String| format!("<img id=\"poster\" alt=\"First frame of the scene\" src=\"{uri}\">");
    page = page.replace("<!--poster-->", &stage.poster.as_ref().map_or(String::new(), image));
    // Names may contain any text, even a placeholder, so they are inserted after all replacements.
    let begin = format!("splatsieve.begin({});", inline(&json));
    let own = [between(&page, "<script>", "</script>"), &begin].map(policy_digest);
    let scripts: Vec<String> = own.into_iter().chain(chunks.iter().cloned()).collect();
    let policy = policy_meta_element(&[
        ("style-src", &[policy_digest(between(&page, "<style>", "</style>"))]),
        ("img-src", &["data:".to_owned()]),
        ("worker-src", &["blob:".to_owned()]),
        ("script-src", &scripts),
    ]);
    page.replace("<!--policy-->", &policy) + "<script>" + &begin + "</script>\n"
}

/// Returns the text in `page` between the first occurrence of `start` and the next occurrence of `end`. Returns an
/// empty text if `start` does not occur, and the rest of `page` if `end` does not occur after it.
fn between<'a>(page: &'a str, start: &str, end: &str) -> &'a str {
    let rest = page.split_once(start).map_or("", |(_, rest)| rest);
    rest.split_once(end).map_or(rest, |(content, _)| content)
}

/// Returns `json` as text that can stand in an HTML script element: `<` is escaped.
fn inline(json: &serde_json::Value) -> String {
    json.to_string().replace('<', "\\u003c")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::player::quantization::PlayerSteps;

    fn stage(name: &str) -> PageScene {
        let track = PageSequence {
            count: 0,
            sh_degree: 0,
            times: vec![0.0],
            steps: PlayerSteps::from_extent(1.0),
            varying: Vec::new(),
            groups: vec![1],
            unseen: 0,
        };
        PageScene {
            tool: TOOL,
            models: vec![PageModelInfo {
                role: "original",
                name: name.to_owned(),
                bytes: 0,
                frames: 1,
                degree: 0,
                track,
            }],
            cameras: Vec::new(),
            background: [0.0; 3],
            center: [0.0; 3],
            extent: 1.0,
            up: [0.0, 0.0, 1.0],
            rig: None,
            files: Vec::new(),
            poster: None,
        }
    }

    #[test]
    fn every_placeholder_is_replaced_once_and_names_stay_text() {
        let page = head(&stage("</script><script>alert(1)//*page.css*/"), &[]);
        assert!(!page.contains("<script>alert") && page.contains("\\u003c/script>\\u003cscript>alert(1)//*page.css*/"));
        for (mark, _) in PARTS.iter().chain(&[("/*shaders*/", ""), ("/*tool*/", "")]) {
            assert_eq!(PAGE.matches(mark).count(), 1, "{mark}");
        }
        assert!(!page.contains("http://") && !page.contains("https://"), "the page names an address");
    }

    #[test]
    fn chunks_are_in_the_order_of_time() {
        let scratch = tempfile::tempdir().unwrap();
        let mut chunks = ChunkFiles::new(scratch.path()).unwrap();
        for (model, chunk, since) in [(0, 0, 0.0), (0, 1, 0.0), (0, 2, 0.5), (1, 0, 0.0), (1, 1, 0.0), (1, 2, 0.4)] {
            chunks.add_chunk(model, chunk, since, &[7; 10]).unwrap();
        }
        assert_eq!(chunks.ordered(), [(0, 0), (1, 0), (0, 1), (1, 1), (1, 2), (0, 2)]);
        let page = scratch.path().join("page.html");
        let bytes = chunks.write_page(&stage("a"), &page).unwrap();
        let text = fs::read_to_string(&page).unwrap();
        assert_eq!((bytes, text.matches("splatsieve.chunk(").count()), (text.len() as u64, 6));
        let folder = scratch.path().join("folder");
        fs::create_dir(&folder).unwrap();
        let (names, bytes) = chunks.write_folder(&mut stage("a"), &folder).unwrap();
        let on_disk: u64 = names.iter().map(|name| fs::metadata(folder.join(name)).unwrap().len()).sum();
        assert_eq!((names.len(), bytes), (7, on_disk));
    }
}
