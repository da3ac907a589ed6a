//! Reader of the attributes of all Gaussians of a source, for one frame after the other.

use super::frames::open_all;
use crate::error::Result;
use crate::model::{Attributes, Gaussians};
use crate::source::{BlockReader, FrameSource, ReadPlan};

/// Reader of all attributes of all Gaussians, for one frame after the other. Attributes that do not vary in time are
/// read only once.
///
/// Memory: the attributes at one frame, and the reader (see [`open_all`]).
pub struct FrameStates<'a> {
    reader: Box<dyn BlockReader + 'a>,
    varying: Attributes,
    /// Attributes that the next read must fill; those that do not vary in time are removed after the first read.
    unread: Attributes,
    current: Gaussians,
}

impl<'a> FrameStates<'a> {
    /// Opens a reader of `source` for the frames that `plan` names.
    ///
    /// # Errors
    /// Fails if the source cannot be opened.
    pub fn open(source: &'a dyn FrameSource, plan: &ReadPlan) -> Result<FrameStates<'a>> {
        let info = source.info();
        Ok(FrameStates {
            reader: open_all(source, Attributes::all(), plan)?,
            varying: info.varying,
            unread: Attributes::all(),
            current: Gaussians::zeros(0, info.sh_degree),
        })
    }

    /// Reads and returns the Gaussians at frame `frame`.
    pub fn read(&mut self, frame: usize) -> Result<&Gaussians> {
        self.reader.read(frame, self.unread, &mut self.current)?;
        self.unread = self.varying;
        Ok(&self.current)
    }

    /// Returns the Gaussians at the frame that was read last. Returns no Gaussians before the first read.
    pub fn current(&self) -> &Gaussians {
        &self.current
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::container::Container;
    use crate::outputs::container::write_container;
    use crate::passes::gather_all;

    #[test]
    fn states_equal_single_reads_with_constant_tiles_read_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.gseq");
        let scene = crate::diagnostics::demo_scene::DemoScene::new(1500, 40);
        write_container(&scene, &path, gseq::Compression::Zstd(1), Default::default(), |_| ()).unwrap();
        let container = Container::open(&path).unwrap();
        let constant = Attributes::all().difference(container.info().varying);
        assert!(!constant.is_empty(), "the scene has no constant column to tell by");
        let frames = [0, 3, 31, 32, 39];
        let mut states = FrameStates::open(&container, &ReadPlan::new(frames)).unwrap();
        assert!(states.current().is_empty());
        for frame in frames {
            let expected = gather_all(&scene, frame, Attributes::all()).unwrap();
            assert!(*states.read(frame).unwrap() == expected && *states.current() == expected, "frame {frame}");
        }
        // The file has two blocks of Gaussians. Each attribute that varies has one tile per block of Gaussians and
        // block of frames.
        let varying = container.info().varying.iter().count() as u64;
        assert_eq!(container.reads().tiles, 2 * (constant.iter().count() as u64 + 2 * varying));
    }
}
