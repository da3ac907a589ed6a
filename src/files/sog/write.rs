//! Writer of `.sog` files.

use std::borrow::Cow;
use std::io::Write;
use std::path::Path;

use serde::Serialize;

use super::codebook::Codebook;
use super::images::{
    ImageSize, decode_by_codebook, decode_opacity, decode_position, encode_by_codebook, encode_labels, encode_opacity,
    encode_palette, encode_positions, encode_rotation, morton_order, palette_entry,
};
use super::palette::Palette;
use super::{Asset, CodebookEntry, ImageEntry, META_FILE, MeansEntry, Meta, PaletteEntry, VERSION};
use crate::TOOL;
use crate::error::{Error, Result, ShowPath};
use crate::files::accuracy::{CodingErrors, RenderedAttributes, check_positions};
use crate::files::webp::RgbaImage;
use crate::files::zip_output::{create_zip, finish_zip, stored_file_options};
use crate::model::{Gaussians, color_from_sh, opacity};

/// Largest magnitude of ln s that is stored, where s is a scale in scene units. Gaussians with ln s below −20 are
/// smaller than any pixel, those with ln s above 20 larger than any scene.
const MAX_LOG_SCALE: f32 = 20.0;
/// Lower bound of the maximum number of palette entries of a file: files with fewer than 2048 Gaussians may have this
/// many. Larger files may have more (see [`palette_entries`]).
const MIN_PALETTE_LIMIT: usize = 1024;

/// Errors of a written file: differences between the Gaussians and the values in the file.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SogErrors {
    /// Largest error of a position, in scene units.
    pub position: f64,
    /// Root of the mean squared error of SH coefficients above degree 0; `None` if there are none.
    pub sh: Option<f64>,
}

impl SogErrors {
    /// Returns, for each kind of error, the larger one of `self` and `other`.
    pub fn max(self, other: SogErrors) -> SogErrors {
        let sh = self.sh.into_iter().chain(other.sh).reduce(f64::max);
        SogErrors { position: self.position.max(other.position), sh }
    }

    /// Returns a note for the user that states these errors of the written file.
    pub fn error_note(&self) -> String {
        let sh = self.sh.map_or_else(String::new, |sh| format!("; RMS error of SH coefficients: {sh:.1e}"));
        format!("maximum position error: {:.2e} scene units{sh}", self.position)
    }
}

/// Writes the Gaussians `state` to a `.sog` file at `path`, in Morton order. The bytes depend only on the Gaussians.
/// Returns the largest errors of the stored values.
///
/// # Errors
/// Fails if a position is not finite, if stored values would exceed the error bounds of
/// [`accuracy`](crate::files::accuracy), if there are more Gaussians than the images can hold, or if writing fails.
pub fn write_sog(state: &Gaussians, path: &Path) -> Result<SogErrors> {
    check_positions(state, path, "a .sog")?;
    let Some(size) = ImageSize::for_count(state.len()) else {
        return Err(Error::usage(format!("{}: {} Gaussians are too many for a .sog", path.shown(), state.len())));
    };
    let order = morton_order(&state.position);
    let (meta, images, errors) = encode(state, size, &order, "a .sog")?;
    write_archive(path, images, &meta)?;
    Ok(errors)
}

/// Writes the archive `path` with the files `images`, and with `meta`, which describes them, as its `meta.json`.
///
/// # Errors
/// Fails if an image is too large or writing fails.
pub(crate) fn write_archive(path: &Path, images: NamedImages, meta: &impl Serialize) -> Result<()> {
    let failed = |error| Error::io("write", path)(error);
    let mut archive = create_zip(path)?;
    let mut add = |name: &str, bytes: &[u8]| -> Result<()> {
        let options = stored_file_options(bytes.len() as u64);
        archive.start_file(name, options).map_err(|error| failed(error.into()))?;
        archive.write_all(bytes).map_err(failed)
    };
    for (name, image) in images {
        add(&name, &image.to_webp().map_err(failed)?)?;
    }
    let text = serde_json::to_vec(meta).map_err(|error| Error::internal(format!("{META_FILE}: {error}")))?;
    add(META_FILE, &text)?;
    finish_zip(archive, path)
}

/// Returns the Gaussians of `state` without those that a `.sog` file would store with the opacity byte 0, in the same
/// order.
pub fn visible_only(state: &Gaussians) -> Cow<'_, Gaussians> {
    let is_drawn = |row: u32| encode_opacity(opacity(state.opacity_logit.plane(0)[row as usize])) > 0;
    let rows: Vec<u32> = (0..state.len() as u32).filter(|&row| is_drawn(row)).collect();
    if rows.len() == state.len() { Cow::Borrowed(state) } else { Cow::Owned(state.pick(&rows)) }
}

/// Images of a file with their names in the archive.
pub(crate) type NamedImages = Vec<(String, RgbaImage)>;

/// Encodes the Gaussians `state` as images of size `size`, in which pixel i belongs to the Gaussian `order[i]`. Returns
/// the content of `meta.json`, the images with their file names, and the errors of the stored values. `kind` names the
/// file in messages, for example "a .sog".
///
/// # Errors
/// Fails if stored values would exceed the error bounds of [`accuracy`](crate::files::accuracy).
pub(crate) fn encode(
    state: &Gaussians,
    size: ImageSize,
    order: &[u32],
    kind: &str,
) -> Result<(Meta, NamedImages, SogErrors)> {
    let mut log_scale = state.log_scale.clone();
    log_scale.planes_mut().iter_mut().for_each(|x| *x = x.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE));
    let scale_book = Codebook::fit(|| log_scale.planes().iter().copied());
    // The planes of the three channels of degree 0 come first.
    let dc_book = Codebook::fit(|| state.sh.planes()[..3 * state.len()].iter().copied());
    let (range, [low, high]) = encode_positions(&state.position, size, order);
    let scales = encode_by_codebook(&log_scale, &scale_book, size, order, |_| 255);
    drop(log_scale);
    let quats = size.image(order, |row| encode_rotation(state.rotation.row(row)));
    let alpha = |row: usize| encode_opacity(opacity(state.opacity_logit.row::<1>(row)[0]));
    let sh0 = encode_by_codebook(&state.sh, &dc_book, size, order, alpha);
    let mut accuracy = CodingErrors::new(&state.position);
    for (place, &row) in order.iter().enumerate() {
        let row = row as usize;
        let values =
            |book: &Codebook, image: &RgbaImage| decode_by_codebook(book, image.pixels[place]).unwrap_or_default();
        let found = RenderedAttributes {
            position: decode_position(&range, low.pixels[place], high.pixels[place]).map(f64::from),
            scale: values(&scale_book, &scales).map(|log| f64::from(log).exp()),
            opacity: opacity(decode_opacity(sh0.pixels[place][3])),
            color: values(&dc_book, &sh0).map(color_from_sh),
        };
        accuracy.add(row, &RenderedAttributes::from_state(state, row), &found);
        if let Some(plane) = (0..state.sh.width()).find(|&plane| !state.sh.plane(plane)[row].is_finite()) {
            accuracy.add_sh(row, f64::from(state.sh.plane(plane)[row]));
        }
    }
    accuracy.check(kind)?;
    let files = |name: &str| [format!("{name}.webp")];
    let [means_l, means_u, of_scales, of_quats, of_sh0] = ["means_l", "means_u", "scales", "quats", "sh0"].map(files);
    let mut images = vec![
        (means_l[0].clone(), low),
        (means_u[0].clone(), high),
        (of_scales[0].clone(), scales),
        (of_quats[0].clone(), quats),
        (of_sh0[0].clone(), sh0),
    ];
    let (sh_n, sh) = encode_sh(state, size, order, &mut images).unzip();
    let meta = Meta {
        version: VERSION,
        asset: Some(Asset { generator: TOOL.to_owned() }),
        count: state.len() as u64,
        means: MeansEntry { mins: range.mins, maxs: range.maxs, files: [means_l, means_u].map(|[name]| name) },
        scales: CodebookEntry { codebook: scale_book.entries().iter().copied().map(Some).collect(), files: of_scales },
        quats: ImageEntry { files: of_quats },
        sh0: CodebookEntry { codebook: dc_book.entries().iter().copied().map(Some).collect(), files: of_sh0 },
        sh_n,
    };
    Ok((meta, images, SogErrors { position: accuracy.position_error(), sh }))
}

/// Encodes the SH coefficients of `state` above degree 0 as two images and adds them to `images`: the palette, and the
/// palette label of each Gaussian. The image of the labels has the size `size`, and its pixel i belongs to the Gaussian
/// `order[i]`. Returns the member `shN` of `meta.json`, and the root of the mean squared error of the coefficients;
/// `None` if there are no such coefficients.
fn encode_sh(
    state: &Gaussians,
    size: ImageSize,
    order: &[u32],
    images: &mut NamedImages,
) -> Option<(PaletteEntry, f64)> {
    let width = state.sh.width() - 3;
    if width == 0 || state.is_empty() {
        return None;
    }
    let palette = Palette::fit(state.len(), width, palette_entries(state.len()), |place, vector| {
        let row = order[place] as usize;
        vector.extend((0..width).map(|plane| state.sh.plane(3 + plane)[row]));
    });
    let (codebook, centroids) = encode_palette(&palette);
    // The labels belong to places in the file already.
    let places: Vec<u32> = (0..state.len() as u32).collect();
    let labels = encode_labels(&palette.labels, size, &places);
    let mut sum = 0.0;
    for (&row, &label) in order.iter().zip(&palette.labels) {
        let entry = palette_entry(&centroids, label as usize).unwrap_or_default();
        for (k, &pixel) in entry.iter().enumerate() {
            let found = decode_by_codebook(&codebook, pixel).unwrap_or_default();
            for (c, found) in found.into_iter().enumerate() {
                sum += f64::from(found - state.sh.plane(3 * (k + 1) + c)[row as usize]).powi(2);
            }
        }
    }
    let files = ["shN_centroids.webp", "shN_labels.webp"].map(str::to_owned);
    images.extend(files.iter().cloned().zip([centroids, labels]));
    let entry = PaletteEntry {
        count: Some(palette.len() as u64),
        bands: Some(state.sh_degree() as u64),
        codebook: codebook.entries().iter().copied().map(Some).collect(),
        files,
    };
    Some((entry, (sum / (state.len() * width) as f64).sqrt()))
}

/// Returns the maximum number of palette entries for a file of `count` Gaussians: the largest power of two that is at
/// most `count`, but at least 1024 and at most 65536.
fn palette_entries(count: usize) -> usize {
    let doublings = (count / MIN_PALETTE_LIMIT).max(1).ilog2().min(6);
    MIN_PALETTE_LIMIT << doublings
}
