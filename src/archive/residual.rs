//! Codes prediction errors, in quantization steps. The expected size of an error, known from neighboring errors,
//! selects the entropy model.
//!
//! The magnitude of an error falls into one of sixteen classes, which is coded as a symbol. The position of the
//! magnitude within its class is stored as plain bits, because probabilities within a class hardly differ. The model of
//! the sign depends on how far the predicted value lies above or below the nearest multiple of the step.

use super::entropy::{BitModel, SYMBOLS, SymbolDecoder, SymbolEncoder, SymbolModel};
use super::step::{OFFSETS, PredictedMultiple};

/// Classes of error magnitudes, each with two numbers: the smallest magnitude of the class, and the number of plain
/// bits that store the position of a magnitude in the class. The last class has no upper limit.
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

/// Number of entropy models for the magnitude class of a prediction error (index in [`CLASSES`]). Each is used for one
/// range of expected error sizes. Two ranges make up an octave (a factor of 2); the first range begins at a quarter of
/// a quantization step.
const CONTEXTS: usize = 16;

/// Number of entropy models for the sign of a prediction error, for each offset of the predicted value from the nearest
/// grid value ([`PredictedMultiple::offset`]). Errors of magnitude 1, 2 and 3 have one model each, all larger errors
/// share one.
const SIGN_CONTEXTS: usize = 4;

/// Entropy models of prediction errors. Similar planes or tensors share them.
#[derive(Debug, Clone)]
pub(super) struct Residuals {
    /// Entropy models of the magnitude class of a prediction error (index in [`CLASSES`]), one for each range of the
    /// expected error size.
    classes: [SymbolModel; CONTEXTS],
    /// Entropy models of the sign of a prediction error. First index: offset of the predicted value from the nearest
    /// grid value ([`PredictedMultiple::offset`]). Second index: magnitude class of the error minus 1, at most 3.
    signs: [[BitModel; SIGN_CONTEXTS]; OFFSETS],
}

impl Residuals {
    /// Creates the entropy models of prediction errors. At first, all symbols are equally probable.
    pub(super) fn new() -> Residuals {
        Residuals { classes: [SymbolModel::NEW; CONTEXTS], signs: [const { [BitModel::NEW; SIGN_CONTEXTS] }; OFFSETS] }
    }

    /// Returns the entropy model for the expected error size `size`: the mean magnitude of neighboring errors, in
    /// quantization steps. The index of the model consists of the exponent of `size` and the first bit of its mantissa.
    #[inline(always)]
    fn model_for_size(&mut self, size: f32) -> &mut SymbolModel {
        let half_octaves = (size.abs().to_bits() >> 22) as i32 - ((127 - 2) << 1);
        &mut self.classes[half_octaves.clamp(0, CONTEXTS as i32 - 1) as usize]
    }

    /// Returns the entropy model of the sign of a prediction error that is not 0. `offset`: offset of the predicted
    /// value from the nearest grid value ([`PredictedMultiple::offset`]). `class`: class of the magnitude of the error
    /// (index in [`CLASSES`]), at least 1.
    fn sign_model(&mut self, offset: usize, class: usize) -> &mut BitModel {
        &mut self.signs[offset][(class - 1).min(SIGN_CONTEXTS - 1)]
    }

    /// Encodes the value `multiple`, an integer multiple of the quantization step, into `encoder`. `predicted` is its
    /// prediction. `size`, the expected magnitude of the prediction error in quantization steps, selects the entropy
    /// model. Returns the prediction error in quantization steps.
    pub(super) fn encode(
        &mut self,
        multiple: i64,
        predicted: PredictedMultiple,
        size: f32,
        encoder: &mut SymbolEncoder,
    ) -> i64 {
        let residual = multiple - predicted.multiple;
        let magnitude = residual.unsigned_abs();
        let class = CLASSES.iter().rposition(|&(first, _)| first <= magnitude).unwrap_or(0);
        encoder.symbol(self.model_for_size(size), class);
        let above = magnitude - CLASSES[class].0;
        if class == SYMBOLS - 1 {
            encoder.number(above);
        } else {
            encoder.bits(above, CLASSES[class].1);
        }
        if class > 0 {
            encoder.bit(self.sign_model(predicted.offset, class), residual < 0);
        }
        residual
    }

    /// Decodes a value, an integer multiple of the quantization step, from `decoder`. `predicted` is its prediction.
    /// `size`, the expected magnitude of the prediction error in quantization steps, selects the entropy model. Returns
    /// the multiple and the prediction error, both in quantization steps.
    #[inline(always)]
    pub(super) fn decode(
        &mut self,
        predicted: PredictedMultiple,
        size: f32,
        decoder: &mut SymbolDecoder<'_>,
    ) -> (i64, i64) {
        let class = decoder.symbol(self.model_for_size(size));
        if class == 0 {
            return (predicted.multiple, 0);
        }
        let (first, bits) = CLASSES[class];
        let above = if class == SYMBOLS - 1 { decoder.number() } else { decoder.bits(bits) };
        let magnitude = first.wrapping_add(above) as i64;
        let is_negative = decoder.bit(self.sign_model(predicted.offset, class));
        let residual = if is_negative { magnitude.wrapping_neg() } else { magnitude };
        (predicted.multiple.wrapping_add(residual), residual)
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
        let predicted = PredictedMultiple { multiple: -7, offset: 3 };
        for size in [0.0, 0.3, 1.0, 50.0, f32::INFINITY, f32::NAN] {
            let (mut models, mut encoder) = (Residuals::new(), SymbolEncoder::default());
            for &value in &values {
                assert_eq!(models.encode(value, predicted, size, &mut encoder), value + 7);
            }
            let bytes = encoder.finish();
            let (mut models, mut decoder) = (Residuals::new(), SymbolDecoder::new(&bytes).unwrap());
            for &value in &values {
                assert_eq!(models.decode(predicted, size, &mut decoder), (value, value + 7));
            }
            assert!(decoder.is_finished());
        }
    }
}
