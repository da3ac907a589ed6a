//! Reads the attributes of many Gaussians at one frame, in blocks of Gaussians on all threads. For several frames, use
//! readers that stay open ([`super::FrameReaders`], [`super::FrameStates`]): they decode each tile of a container
//! (consecutive Gaussians × frames) only once.

use rayon::prelude::*;

use super::GAUSSIANS_PER_BLOCK;
use super::frames::open_all;
use super::parts::BlockSlices;
use crate::error::{Error, Result};
use crate::model::{AttributeValues, Attributes, Gaussians};
use crate::render::MIN_LOGIT;
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan};

/// Returns the attributes `want` of the Gaussians `ids` at frame `frame`, in the order of `ids`; all other attributes
/// are empty.
///
/// Memory: the result; on each thread a reader of one block of Gaussians, and the attributes of that block.
///
/// # Errors
/// Fails if the frame cannot be read.
pub fn gather(source: &dyn FrameSource, ids: &[u32], frame: usize, want: Attributes) -> Result<Gaussians> {
    let sh_degree = source.info().sh_degree;
    let mut all = Gaussians::zeros(0, sh_degree);
    let parts = BlockSlices::split(&mut all, want, ids.len());
    let wanted = ReadPlan::new([frame]);
    ids.par_chunks(GAUSSIANS_PER_BLOCK).zip(parts).try_for_each_init(
        || Gaussians::zeros(0, sh_degree),
        |block, (ids, parts)| {
            let mut reader = source.open(Ids::List(ids))?;
            reader.expect(&wanted);
            reader.read(frame, want, block)?;
            parts.write(block, want);
            Ok::<_, Error>(())
        },
    )?;
    Ok(all)
}

/// Returns the attributes `want` of all Gaussians at frame `frame`; all other attributes are empty.
///
/// # Errors
/// Fails if the frame cannot be read.
pub fn gather_all(source: &dyn FrameSource, frame: usize, want: Attributes) -> Result<Gaussians> {
    let mut all = Gaussians::zeros(0, source.info().sh_degree);
    open_all(source, want, &ReadPlan::new([frame]))?.read(frame, want, &mut all)?;
    Ok(all)
}

/// Maximum fraction of visible Gaussians at which [`visible_ids`] lists them. If more are visible, a pass over all
/// Gaussians takes about the same time.
const MAX_VISIBLE_FRACTION: f64 = 0.9;

/// Returns the ids of the Gaussians whose opacity lets them be visible in renders of `source`, in increasing order, if
/// renders of these alone are faster (the time to decode files is not considered). Renders of these Gaussians are equal
/// to the bit to renders of all Gaussians. Returns `None` if the opacity varies in time, if pixel colors are decoded
/// from features, or if more than [`MAX_VISIBLE_FRACTION`] of the Gaussians are visible. `frame` is any frame.
///
/// # Errors
/// Fails if the frame cannot be read.
pub fn visible_ids(source: &dyn FrameSource, frame: usize) -> Result<Option<Vec<u32>>> {
    if source.info().varying.contains(Attributes::OPACITY) || source.decoder().is_some() {
        return Ok(None);
    }
    let logits = gather_all(source, frame, Attributes::OPACITY)?.opacity_logit;
    let is_visible = |(_, logit): &(usize, &f32)| **logit >= MIN_LOGIT;
    let ids: Vec<u32> = logits.plane(0).iter().enumerate().filter(is_visible).map(|(id, _)| id as u32).collect();
    Ok(Some(ids).filter(|ids| ids.len() as f64 <= MAX_VISIBLE_FRACTION * logits.len() as f64))
}

/// Reader of all Gaussians, for a source that decodes every frame independently of the others. It opens a new reader
/// for each block of Gaussians at each frame. This suits sources whose readers would take memory and save little work if
/// they stayed open.
pub struct BlockwiseReader<'a> {
    source: &'a dyn FrameSource,
    ids: Vec<u32>,
}

impl<'a> BlockwiseReader<'a> {
    /// Creates a reader of all Gaussians of `source`. Memory: 4 bytes per Gaussian.
    pub fn new(source: &'a dyn FrameSource) -> BlockwiseReader<'a> {
        BlockwiseReader { source, ids: (0..source.info().count as u32).collect() }
    }
}

impl BlockReader for BlockwiseReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        // Free the memory of the old attributes before the new ones are read.
        out.selected_attribute_values_mut(want).for_each(|column| *column = AttributeValues::default());
        let mut found = gather(self.source, &self.ids, frame, want)?;
        out.selected_attribute_values_mut(want)
            .zip(found.selected_attribute_values_mut(want))
            .for_each(|(old, new)| std::mem::swap(old, new));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::SequenceInfo;
    use crate::render::render;

    /// Source with the Gaussians of a demo scene, of which every `nth` is invisible in all frames.
    struct PartlyInvisible {
        scene: DemoScene,
        info: SequenceInfo,
        nth: usize,
    }

    impl PartlyInvisible {
        fn new(nth: usize, varying: Attributes) -> PartlyInvisible {
            let scene = DemoScene::new(500, 4);
            let info = SequenceInfo { varying, ..scene.info().clone() };
            PartlyInvisible { scene, info, nth }
        }
    }

    /// Reader of some Gaussians of a [`PartlyInvisible`] source.
    struct FadedReader<'a> {
        reader: Box<dyn BlockReader + 'a>,
        ids: Vec<usize>,
        nth: usize,
    }

    impl FrameSource for PartlyInvisible {
        fn info(&self) -> &SequenceInfo {
            &self.info
        }

        fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
            let reader = self.scene.open(ids.clone())?;
            Ok(Box::new(FadedReader { reader, ids: ids.iter().collect(), nth: self.nth }))
        }
    }

    impl BlockReader for FadedReader<'_> {
        fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
            self.reader.read(frame, want, out)?;
            if want.contains(Attributes::OPACITY) {
                for (logit, id) in out.opacity_logit.plane_mut(0).iter_mut().zip(&self.ids) {
                    *logit = if id % self.nth == 0 { MIN_LOGIT - 1e-5 } else { MIN_LOGIT };
                }
            }
            Ok(())
        }
    }

    #[test]
    fn visible_gaussians_alone_give_the_same_image() {
        let source = PartlyInvisible::new(3, Attributes::POSITION);
        let ids = visible_ids(&source, 1).unwrap().unwrap();
        assert!(ids.iter().copied().eq((0..500).filter(|id| id % 3 != 0)));
        let camera = source.scene.rig().cameras[0].clone();
        let visible = |state: Gaussians| {
            let mut state = state;
            // At `MIN_LOGIT` the opacity is still below 1/255, so it is raised to make the listed Gaussians visible.
            state
                .opacity_logit
                .plane_mut(0)
                .iter_mut()
                .for_each(|logit| *logit += 9.0 * f32::from(*logit >= MIN_LOGIT));
            render(&state, &camera, [0.2; 3])
        };
        let all = visible(gather_all(&source, 2, Attributes::all()).unwrap());
        assert!(all == visible(gather(&source, &ids, 2, Attributes::all()).unwrap()));
        assert!(all.data.iter().any(|value| *value != 0.2));
    }

    #[test]
    fn visible_gaussians_are_listed_only_if_it_saves_time() {
        let few_invisible = PartlyInvisible::new(11, Attributes::POSITION);
        assert_eq!(visible_ids(&few_invisible, 0).unwrap(), None);
        let opacity_varies = PartlyInvisible::new(2, Attributes::OPACITY);
        assert_eq!(visible_ids(&opacity_varies, 0).unwrap(), None);
    }
}
