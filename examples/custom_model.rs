//! Adds a model format that the library does not know: implements [`FrameSource`] for a model that computes its frames,
//! and writes it to a container, which every command of the program reads.
//!
//! ```sh
//! cargo run --release --example custom_model -- swing.gseq
//! cargo run --release -- compress swing.gseq -o small.gseq --ratio 50%
//! ```

use std::collections::BTreeMap;
use std::error::Error;
use std::path::PathBuf;

use splatsieve::error::Result;
use splatsieve::model::{Attributes, Gaussians, SequenceInfo, opacity};
use splatsieve::outputs::container::write_container;
use splatsieve::source::{BlockReader, FrameSource, Ids};

/// Model that is a row of Gaussians and swings like a pendulum: position = (x, 0, -cos(a)), a = sin(2 pi t).
struct Pendulum {
    info: SequenceInfo,
}

impl Pendulum {
    fn new(count: usize, frames: usize) -> Pendulum {
        let times = (0..frames).map(|frame| frame as f64 / (frames - 1).max(1) as f64).collect();
        Pendulum { info: SequenceInfo { count, times, sh_degree: 0, varying: Attributes::POSITION } }
    }
}

impl FrameSource for Pendulum {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(Reader { model: self, ids: ids.iter().collect() }))
    }
}

/// Reader of the Gaussians `ids`.
struct Reader<'a> {
    model: &'a Pendulum,
    ids: Vec<usize>,
}

impl BlockReader for Reader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        out.resize(self.ids.len());
        let angle = (std::f64::consts::TAU * self.model.info.times[frame]).sin();
        for (row, &id) in self.ids.iter().enumerate() {
            let along = id as f64 / self.model.info.count as f64;
            if want.contains(Attributes::POSITION) {
                out.position.set_row(row, [(along * angle.sin()) as f32, 0.0, (-along * angle.cos()) as f32]);
            }
            if want.contains(Attributes::ROTATION) {
                out.rotation.set_row(row, [1.0, 0.0, 0.0, 0.0]);
            }
            if want.contains(Attributes::LOG_SCALE) {
                out.log_scale.set_row(row, [0.02f32.ln(); 3]);
            }
            if want.contains(Attributes::OPACITY) {
                out.opacity_logit.set_row(row, [2.0]);
            }
            if want.contains(Attributes::SH) {
                out.sh.set_row(row, [1.0, 0.5, 0.0]);
            }
        }
        Ok(())
    }
}

fn main() -> std::result::Result<(), Box<dyn Error>> {
    let path = PathBuf::from(std::env::args_os().nth(1).ok_or("expected one argument: NAME.gseq")?);
    let model = Pendulum::new(1000, 24);
    write_container(&model, &path, gseq::Compression::Zstd(1), BTreeMap::new(), |_| ())?;
    println!("{}: 1000 Gaussians of opacity {:.2}, 24 frames", path.display(), opacity(2.0));
    Ok(())
}
