//! Quantization of the content of an archive, with the quality of its renders.

use super::archive_grids::Grids;
use crate::archive::{self, ArchiveContent, EncodedArchive, QuantizationSteps};
use crate::error::{Error, ErrorKind, Result};
use crate::limits::ReadLimit;
use crate::pipeline::stages::reference_views::{
    BYTES_OCTAVE_HALVINGS, BYTES_OCTAVE_RANGE, OCTAVE_HALVINGS, OCTAVE_RANGE, QualityTarget, ReferenceViews, bisect,
};
use crate::progress::Progress;
use crate::scene::Scene;

/// Encoded archive with its quality.
pub(super) struct MeasuredArchive {
    pub(super) encoded: EncodedArchive,
    /// Quantization steps of the archive.
    pub(super) steps: QuantizationSteps,
    /// PSNR of its renders against renders of the result before quantization, dB.
    pub(super) psnr: f64,
    /// Amount by which its PSNR against the original is below that of the result before quantization, dB.
    pub(super) loss: f64,
}

/// Quantization of the content of an archive, with everything that is needed to measure its effect on renders.
pub(super) struct Quantizer<'a> {
    pub(super) scene: &'a Scene,
    /// Content of the archive before quantization.
    pub(super) content: &'a ArchiveContent,
    pub(super) grids: Grids,
    /// Renders of the result before quantization.
    pub(super) reference_views: ReferenceViews<'a>,
    /// Renders of the original from the same cameras.
    pub(super) original: ReferenceViews<'a>,
    /// PSNR of the result before quantization against the original, dB.
    pub(super) level: f64,
    pub(super) progress: Progress,
}

impl Quantizer<'_> {
    /// Encodes the content with all quantization steps made coarser by `added` octaves (doublings).
    fn encode(&self, added: f64) -> Result<(QuantizationSteps, EncodedArchive)> {
        self.progress.advance(1);
        let steps = self.grids.steps(added);
        let encoded = archive::encode(self.content, &steps)?;
        Ok((steps, encoded))
    }

    /// Decodes the archive `encoded`, whose quantization steps are `steps`, and measures the quality of its renders.
    ///
    /// # Errors
    /// Fails if the model format refuses the decoded values (an input error), or if frames cannot be read.
    pub(super) fn measure(&self, (steps, encoded): (QuantizationSteps, EncodedArchive)) -> Result<MeasuredArchive> {
        let (decoded, _) = archive::decode(&encoded.bytes, &self.scene.path, ReadLimit::NONE)?;
        let shown = self.scene.input.decode_frames(&decoded)?;
        let (psnr, loss) = (self.reference_views.psnr(&*shown)?, self.level - self.original.psnr(&*shown)?);
        Ok(MeasuredArchive { encoded, steps, psnr, loss })
    }

    /// Returns the archive with the coarsest quantization steps that meets `target`, or, if it is a number of bytes,
    /// the one with the finest steps. If no tried archive meets a quality, returns the one with the finest steps.
    ///
    /// # Errors
    /// Fails if even the coarsest archive exceeds a byte limit, or if frames cannot be read.
    pub(super) fn archive(&self, target: QualityTarget) -> Result<MeasuredArchive> {
        if let QualityTarget::Bytes(most) = target {
            return self.measure(match self.finest_within(most)? {
                Some(best) => best,
                None => {
                    let (steps, encoded) = self.encode(BYTES_OCTAVE_RANGE[0])?;
                    (steps, check_coarsest(encoded, most, self.content.cloud.len())?)
                }
            });
        }
        let required_psnr = target.required_psnr(self.level);
        let best = bisect(OCTAVE_RANGE, OCTAVE_HALVINGS, |added| match self.measure(self.encode(added)?) {
            // The reader of a model format may refuse values that coarse steps have made zero.
            Err(error) if error.kind() == ErrorKind::Input => Ok(None),
            Err(error) => Err(error),
            Ok(found) => Ok(Some(found).filter(|found| target.is_met_by([found.psnr, found.loss], required_psnr))),
        })?;
        best.map_or_else(|| self.measure(self.encode(OCTAVE_RANGE[0])?), Ok)
    }

    /// Returns the archive with the finest quantization steps that has at most `most` bytes; `None` if no tried one has
    /// so few.
    pub(super) fn finest_within(&self, most: u64) -> Result<Option<(QuantizationSteps, EncodedArchive)>> {
        bisect(BYTES_OCTAVE_RANGE.map(|added| -added), BYTES_OCTAVE_HALVINGS, |finer| {
            Ok(Some(self.encode(-finer)?).filter(|(_, encoded)| encoded.bytes.len() as u64 <= most))
        })
    }
}

/// Checks that `encoded`, the archive of `gaussians` Gaussians with the coarsest quantization steps, has at most `most`
/// bytes, and returns it. Fails if it has more.
fn check_coarsest(encoded: EncodedArchive, most: u64, gaussians: usize) -> Result<EncodedArchive> {
    let least = encoded.bytes.len();
    if least as u64 > most {
        return Err(Error::usage(format!(
            "--size: expected at least {least} bytes, the size of an archive of {gaussians} Gaussians with the \
             coarsest quantization, found {most}"
        )));
    }
    Ok(encoded)
}
