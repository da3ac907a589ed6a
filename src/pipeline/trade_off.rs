//! What a sweep found, for people and for programs: quality, size, time and memory of every method at
//! every kept fraction.

use serde::{Deserialize, Serialize};

/// Every point of a sweep, and what they share.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TradeOff {
    /// Program and version.
    pub tool: String,
    /// Input, as given.
    pub path: String,
    /// Hash over the input's bytes.
    pub digest: String,
    /// Gaussians of the input.
    pub gaussians: usize,
    /// Bytes of its files that grow with the Gaussians.
    pub bytes: u64,
    /// Threads at work.
    pub threads: usize,
    /// Pictures that every point is compared on: (frame, view) pairs, and where their cameras come from.
    pub pictures: usize,
    /// File of the cameras, or the recipe of a virtual rig.
    pub cameras: String,
    /// By method, as listed in `--methods`, then by the fraction asked for, falling.
    pub points: Vec<Point>,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// One method at one size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// Name of the method, as `--methods` takes it.
    pub method: String,
    /// Kept fraction that was asked for; none: the method's own choice.
    pub asked: Option<f64>,
    /// Gaussians in the result.
    pub count: usize,
    /// Bytes of the result's files that grow with the Gaussians.
    pub bytes: u64,
    /// Mean PSNR against the original's own pictures, dB.
    pub psnr: f64,
    /// Mean SSIM against them.
    pub ssim: f64,
    /// Mean temporal error against them; none if no view is seen twice.
    pub temporal: Option<f64>,
    /// Wall-clock time of compressing, from opening the input to the result on the disk.
    pub seconds: f64,
    /// Largest resident memory while compressing; none where the system does not tell.
    pub peak_memory_bytes: Option<u64>,
}
