//! One row of statistics per Gaussian (method.md, section 1), as arrays over Gaussians.

use bitflags::bitflags;

bitflags! {
    /// What was odd about a Gaussian.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct Flags: u8 {
        /// Some value in some frame was NaN or infinite.
        const NON_FINITE = 1;
        /// The quaternion was zero in some frame; the identity was used.
        const ZERO_ROTATION = 2;
        /// D fell below the noise floor of its f32 positions and was set to 0.
        const SNAPPED_D = 4;
        /// κ fell below the noise floor of its f32 positions and was set to 0.
        const SNAPPED_KAPPA = 8;
    }
}

/// Statistics of N Gaussians; every array has N entries, but for a `w` that is empty.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Rows {
    /// D, trajectory magnitude: root mean square step, scene units per frame.
    pub d: Vec<f64>,
    /// κ, mean norm of the second difference, scene units per frame².
    pub kappa: Vec<f64>,
    /// V, variance of the opacity over the life span.
    pub v: Vec<f64>,
    /// Life span in frames.
    pub life: Vec<u32>,
    /// C, mean projected or visible coverage, pixels.
    pub c: Vec<f64>,
    /// W, largest alpha · transmittance of any pixel of any picture, in [0, 0.99]; empty where C is
    /// projected coverage.
    pub w: Vec<f64>,
    /// E, anisotropy: largest over smallest canonical scale.
    pub e: Vec<f64>,
    /// Fraction of (frame, view) pairs in which the Gaussian is alive and touches the image.
    pub vis: Vec<f64>,
    /// What was odd.
    pub flags: Vec<Flags>,
}

impl Rows {
    /// Memory of a row that has a W.
    pub const BYTES_PER_GAUSSIAN: usize = 7 * size_of::<f64>() + size_of::<u32>() + size_of::<Flags>();

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.d.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.d.is_empty()
    }

    /// Appends the rows of the next block.
    pub fn append(&mut self, next: &mut Rows) {
        self.d.append(&mut next.d);
        self.kappa.append(&mut next.kappa);
        self.v.append(&mut next.v);
        self.life.append(&mut next.life);
        self.c.append(&mut next.c);
        self.w.append(&mut next.w);
        self.e.append(&mut next.e);
        self.vis.append(&mut next.vis);
        self.flags.append(&mut next.flags);
    }
}
