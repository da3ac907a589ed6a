//! Reads and writes `.glb` files (glTF 2.0) with the extension `KHR_gaussian_splatting`, which hold one frame of
//! Gaussians without compression.
//!
//! The primitive of mode 0 (points) has these attributes; glTF's x axis points left and its y axis up.
//!
//! | attribute | type | value |
//! |---|---|---|
//! | `POSITION` | VEC3 | −x, −y, z in scene units |
//! | `KHR_gaussian_splatting:ROTATION` | VEC4 | unit quaternion −x, −y, z, w |
//! | `KHR_gaussian_splatting:SCALE` | VEC3 | standard deviations |
//! | `KHR_gaussian_splatting:OPACITY` | SCALAR | opacity in [0, 1] |
//! | `KHR_gaussian_splatting:SH_DEGREE_d_COEF_n` | VEC3 | SH coefficient n = 0 … 2d of degree d: red, green, blue |
//! | `COLOR_0` | VEC4 | linear color and opacity for programs without the extension |
//!
//! Source: KhronosGroup/glTF, `extensions/2.0/Khronos/KHR_gaussian_splatting`.

pub mod read;
pub mod write;

/// First word of a `.glb` file, "glTF".
pub const MAGIC: u32 = 0x4654_6c67;
/// Version of glTF that is read and written.
const VERSION: u32 = 2;
/// Chunk type of the JSON text in a `.glb` file.
const JSON: u32 = 0x4e4f_534a;
/// Chunk type of the values of the attributes in a `.glb` file.
const BINARY: u32 = 0x004e_4942;
/// Name of the glTF extension for Gaussians, and prefix of the names of its attributes.
const EXTENSION: &str = "KHR_gaussian_splatting";
/// Sign by which each SH coefficient above degree 0 is multiplied when the x and y axes are reversed.
const AXIS_SIGNS: [f32; 15] = [-1., 1., -1., 1., -1., 1., -1., 1., -1., 1., -1., 1., -1., 1., -1.];

/// Returns the name of the attribute that holds the SH coefficient with index `k`, counted over all degrees from 0.
fn sh_attribute(k: usize) -> String {
    let degree = k.isqrt();
    format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{}", k - degree * degree)
}

#[cfg(test)]
mod tests;
