//! Codes prediction errors, in quantization steps. The expected size of an error, known from neighboring errors,
//! selects the entropy model.
//!
//! The magnitude of an error falls into one of sixteen classes, which is coded as a symbol. Its position within the
//! class and its sign are plain bits, because probabilities within a class hardly differ.

use super::entropy::{SYMBOLS, SymbolDecoder, SymbolEncoder, SymbolModel};

/// Classes of error magnitudes: the smallest magnitude of each class, and the number of plain bits for the position of
/// a magnitude in the class. The last class has no upper limit.
const CLASSES: [(u64, u32); SYMBOLS] = [
    (0, 0),
    (1, 0),
    (2, 0),
    (3, 0),
    (4, 0),
    (5, 0),
    (6, 0),
    (7, 0),
    (8, 1),
    (10, 1),
    (12, 2),
    (16, 3),
    (24, 3),
    (32, 5),
    (64, 6),
    (128, 0),
];

/// Number of entropy models. Each model is for half an octave of expected error sizes; the first begins at a quarter of
/// a quantization step.
const CONTEXTS: usize = 16;

/// Entropy models of prediction errors, one for each range of the expected error size. Similar planes or tensors share
/// them.
#[derive(Debug, Clone)]
pub(super) struct Residuals([SymbolModel; CONTEXTS]);

impl Residuals {
    /// Returns models that have seen no error yet.
    pub(super) fn new() -> Residuals {
        Residuals([SymbolModel::NEW; CONTEXTS])
    }

    /// Returns the entropy model for the expected error size `size`: the mean magnitude of neighboring errors, in
    /// quantization steps. The index of the model consists of the exponent of `size` and the first bit of its mantissa.
    #[inline(always)]
    fn model_for_size(&mut self, size: f32) -> &mut SymbolModel {
        let half_octaves = (size.abs().to_bits() >> 22) as i32 - ((127 - 2) << 1);
        &mut self.0[half_octaves.clamp(0, CONTEXTS as i32 - 1) as usize]
    }

    /// Writes the prediction error `residual`, in quantization steps, to `to`. `size` is its expected magnitude, which
    /// selects the entropy model.
    pub(super) fn encode(&mut self, residual: i64, size: f32, to: &mut SymbolEncoder) {
        let magnitude = residual.unsigned_abs();
        let class = CLASSES.iter().rposition(|&(first, _)| first <= magnitude).unwrap_or(0);
        to.symbol(self.model_for_size(size), class);
        let above = magnitude - CLASSES[class].0;
        if class == SYMBOLS - 1 {
            to.number(above);
        } else {
            to.bits(above, CLASSES[class].1);
        }
        if magnitude > 0 {
            to.bits(u64::from(residual < 0), 1);
        }
    }

    /// Reads a prediction error, in quantization steps. `size` is its expected magnitude, which selects the entropy
    /// model.
    #[inline(always)]
    pub(super) fn decode(&mut self, size: f32, from: &mut SymbolDecoder<'_>) -> i64 {
        let class = from.symbol(self.model_for_size(size));
        if class == 0 {
            return 0;
        }
        let (first, bits) = CLASSES[class];
        let above = if class == SYMBOLS - 1 { from.number() } else { from.bits(bits) };
        let magnitude = first.wrapping_add(above) as i64;
        if from.bits(1) == 1 { magnitude.wrapping_neg() } else { magnitude }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_magnitude_has_one_class() {
        for pair in CLASSES.windows(2) {
            assert_eq!(pair[0].0 + (1 << pair[0].1), pair[1].0);
        }
    }

    #[test]
    fn errors_are_read_back_for_every_expected_size() {
        let values: Vec<i64> = (-300..300).chain([1 << 40, -(1 << 50), i64::from(i32::MAX)]).collect();
        for size in [0.0, 0.3, 1.0, 50.0, f32::INFINITY, f32::NAN] {
            let (mut models, mut encoder) = (Residuals::new(), SymbolEncoder::default());
            values.iter().for_each(|&value| models.encode(value, size, &mut encoder));
            let bytes = encoder.finish();
            let (mut models, mut decoder) = (Residuals::new(), SymbolDecoder::new(&bytes).unwrap());
            for &value in &values {
                assert_eq!(models.decode(size, &mut decoder), value);
            }
            assert!(decoder.is_finished());
        }
    }
}
