//! Frame streams (format/STREAM.md) made from Gaussians.

use splatsieve::model::Gaussians;

/// Returns the header of a stream of `count` Gaussians (0 if the frames are unlinked) in which all attributes come with
/// every frame.
pub(crate) fn stream_header(version: u32, sh_degree: u32, count: u32) -> Vec<u8> {
    let mut bytes = b"\x89GSTR\r\n\x1a".to_vec();
    for field in [version, sh_degree, count, 0, 31, 0] {
        bytes.extend(u32::to_le_bytes(field));
    }
    bytes
}

/// Returns a stream of version 2, whose frames are unlinked, with the frames `frames` at evenly spaced times.
pub(crate) fn unlinked_stream(sh_degree: u32, frames: &[Gaussians]) -> Vec<u8> {
    let mut bytes = stream_header(2, sh_degree, 0);
    for (number, frame) in (0u32..).zip(frames) {
        let columns = [&frame.position, &frame.rotation, &frame.log_scale, &frame.opacity_logit, &frame.sh];
        let values: Vec<u8> =
            columns.iter().flat_map(|column| column.planes()).flat_map(|value| value.to_le_bytes()).collect();
        bytes.extend(b"FRAM");
        bytes.extend(number.to_le_bytes());
        bytes.extend((f64::from(number) / frames.len() as f64).to_le_bytes());
        bytes.extend((values.len() as u64).to_le_bytes());
        bytes.extend(values);
    }
    bytes.extend(b"DONE");
    bytes.extend((frames.len() as u32).to_le_bytes());
    bytes.extend([0; 16]);
    bytes
}
