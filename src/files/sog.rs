//! Reads and writes `.sog` files, version 2 of the format (PlayCanvas), which hold one frame of Gaussians as lossless
//! WebP images in a ZIP archive.
//!
//! Pixel i of every image belongs to Gaussian i. Source: `docs/user-manual/gaussian-splatting/formats/sog.md` of
//! playcanvas/developer-site, and the readers of splat-transform 3.7 and of the PlayCanvas engine 2.23.
//!
//! | file in the archive | value of the bytes R G B A |
//! |---|---|
//! | `means_l.webp`, `means_u.webp` | low and high byte of 16 bits per axis between `mins` and `maxs`, which is sign(x)·ln(\|x\| + 1) |
//! | `scales.webp` | index in a codebook of ln s per axis |
//! | `quats.webp` | A − 252: component of w, x, y, z that is left out; R G B: the others, from −1/√2 to 1/√2 |
//! | `sh0.webp` | R G B: index in a codebook of SH coefficients of degree 0; A: 255·opacity |
//! | `shN_labels.webp` | R + 256·G: entry of the palette of SH coefficients above degree 0 |
//! | `shN_centroids.webp` | palette: 64 entries per row, one pixel of indices in a codebook per coefficient |
//! | `meta.json` | ranges, codebooks and the names of the images |

pub mod codebook;
pub mod images;
pub mod palette;
pub mod read;
pub mod write;

use serde::{Deserialize, Serialize};

/// Version of the `.sog` format that is read and written.
pub const VERSION: u64 = 2;
/// Name of the file in a `.sog` archive that describes its images.
pub const META_FILE: &str = "meta.json";

/// Content of the file `meta.json` of a `.sog` archive.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Meta {
    pub(crate) version: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    asset: Option<Asset>,
    pub(crate) count: u64,
    means: MeansEntry,
    scales: CodebookEntry,
    quats: ImageEntry,
    sh0: CodebookEntry,
    #[serde(rename = "shN", skip_serializing_if = "Option::is_none")]
    sh_n: Option<PaletteEntry>,
}

/// Member `asset` of `meta.json`: the program that wrote the archive.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Asset {
    generator: String,
}

/// Member `means` of `meta.json`: names of the two images of positions, and the range of their logarithmic coordinates.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct MeansEntry {
    mins: [f64; 3],
    maxs: [f64; 3],
    files: [String; 2],
}

/// Members `scales` and `sh0` of `meta.json`: name of an image of three-component values, and the codebook in which the
/// bytes of the image are indices.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct CodebookEntry {
    codebook: Vec<Option<f32>>,
    files: [String; 1],
}

/// Member `quats` of `meta.json`: name of the image of rotations, whose bytes need no range and no codebook.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct ImageEntry {
    files: [String; 1],
}

/// Member `shN` of `meta.json`: names of the images of the palette of SH coefficients and of the labels, and the
/// codebook of the values in the palette.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct PaletteEntry {
    count: Option<u64>,
    bands: Option<u64>,
    codebook: Vec<Option<f32>>,
    files: [String; 2],
}

#[cfg(test)]
mod tests;
