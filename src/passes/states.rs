//! The states of all Gaussians of a source, frame after frame.

use super::frames::open_all;
use crate::error::Result;
use crate::model::{Columns, Gaussians};
use crate::source::{BlockReader, FrameSource, ReadPlan};

/// All columns of all Gaussians at one frame after the other; what does not vary is read once.
///
/// Memory: one state, and what [`open_all`] takes.
pub struct States<'a> {
    reader: Box<dyn BlockReader + 'a>,
    varying: Columns,
    /// Columns to read next.
    unknown: Columns,
    now: Gaussians,
}

impl<'a> States<'a> {
    /// Opens `source` for the frames `wanted`.
    ///
    /// # Errors
    /// A source that cannot be opened.
    pub fn open(source: &'a dyn FrameSource, wanted: &ReadPlan) -> Result<States<'a>> {
        let info = source.info();
        Ok(States {
            reader: open_all(source, Columns::all(), wanted)?,
            varying: info.varying,
            unknown: Columns::all(),
            now: Gaussians::zeros(0, info.sh_degree),
        })
    }

    /// The state at `frame`.
    ///
    /// # Errors
    /// A frame that cannot be read.
    pub fn at(&mut self, frame: usize) -> Result<&Gaussians> {
        self.reader.read(frame, self.unknown, &mut self.now)?;
        self.unknown = self.varying;
        Ok(&self.now)
    }

    /// The state at the frame asked for last; of none no Gaussians.
    pub fn now(&self) -> &Gaussians {
        &self.now
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::container::Container;
    use crate::outputs::container::write_container;
    use crate::passes::gather_all;

    #[test]
    fn states_are_those_of_single_reads_and_constant_tiles_are_decoded_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.gseq");
        let scene = crate::diagnostics::demo_scene::Scene::new(1500, 40);
        write_container(&scene, &path, gseq::Compression::Zstd(1), Default::default(), |_| ()).unwrap();
        let container = Container::open(&path).unwrap();
        let constant = Columns::all().difference(container.info().varying);
        assert!(!constant.is_empty(), "the scene has no constant column to tell by");
        let frames = [0, 3, 31, 32, 39];
        let mut states = States::open(&container, &ReadPlan::new(frames)).unwrap();
        assert!(states.now().is_empty());
        for frame in frames {
            let expected = gather_all(&scene, frame, Columns::all()).unwrap();
            assert!(*states.at(frame).unwrap() == expected && *states.now() == expected, "frame {frame}");
        }
        // Two blocks of Gaussians; a tile of each varying column for both blocks of frames.
        let varying = container.info().varying.iter().count() as u64;
        assert_eq!(container.reads().tiles, 2 * (constant.iter().count() as u64 + 2 * varying));
    }
}
