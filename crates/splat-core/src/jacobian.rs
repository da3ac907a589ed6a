//! How the state of Gaussians changes with what is stored of them.

use super::{Column, Columns, Gaussians, Gradients};

/// ∂ state / ∂ stored of N Gaussians at one frame. What is stored of a Gaussian in one column changes its state in that
/// column alone.
///
/// A column of width w has no values where the state changes as what is stored does, one factor per Gaussian, or
/// `[w, w]`: plane `i·w + j` is ∂ component i of the state / ∂ component j of what is stored.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Jacobian {
    columns: [Column; 5],
}

fn place(column: Columns) -> usize {
    column.bits().trailing_zeros() as usize
}

impl Jacobian {
    /// Bytes that one takes at most: positions and rotations in full, a factor for each other column.
    pub const BYTES_PER_GAUSSIAN: usize = 4 * (9 + 16 + 3);

    /// The values of a single column; of width 0 where there are none.
    pub fn column(&self, which: Columns) -> &Column {
        &self.columns[place(which)]
    }

    /// The values of a single column, to write.
    pub fn column_mut(&mut self, which: Columns) -> &mut Column {
        &mut self.columns[place(which)]
    }

    /// All columns, in the order of [`Columns::all`].
    pub fn columns(&self) -> &[Column; 5] {
        &self.columns
    }

    /// All columns, to write.
    pub fn columns_mut(&mut self) -> &mut [Column; 5] {
        &mut self.columns
    }

    /// The Gaussians at `rows`, in that order.
    pub fn pick(&self, rows: &[u32]) -> Jacobian {
        let of = |column: &Column| if column.width() > 0 { column.pick(rows) } else { Column::default() };
        Jacobian { columns: self.columns.each_ref().map(of) }
    }

    /// Of `len` Gaussians, cut into `blocks` in order, all with values in the same columns.
    pub fn joined(blocks: &[Jacobian], len: usize) -> Jacobian {
        let mut whole = Jacobian::default();
        for (place, to) in whole.columns.iter_mut().enumerate() {
            let width = blocks.first().map_or(0, |block| block.columns[place].width());
            if width == 0 {
                continue;
            }
            *to = Column::zeros(width, len);
            for c in 0..width {
                let mut rest = to.plane_mut(c);
                for part in blocks.iter().map(|block| &block.columns[place]) {
                    let (here, after) = rest.split_at_mut(part.len());
                    here.copy_from_slice(part.plane(c));
                    rest = after;
                }
            }
        }
        whole
    }

    /// Adds what the state changes by to first order when what is stored changes by `change`, in the columns that this
    /// has rows of; harmonics of a lower degree than the state's leave those above as they are.
    pub fn add_to(&self, change: &Gaussians, state: &mut Gaussians) {
        for which in Columns::all().iter() {
            let (by, of, to) = (self.column(which), change.column(which), state.column_mut(which));
            if of.is_empty() {
                continue;
            }
            let (len, width) = (of.len(), of.width().min(to.width()));
            for i in 0..width {
                let to = &mut to.plane_mut(i)[..len];
                match by.width() {
                    0 => to.iter_mut().zip(of.plane(i)).for_each(|(to, of)| *to += of),
                    1 => to.iter_mut().zip(of.plane(i)).zip(by.plane(0)).for_each(|((to, of), by)| *to += by * of),
                    _ => (0..width).for_each(|j| {
                        let terms = of.plane(j).iter().zip(by.plane(i * width + j));
                        to.iter_mut().zip(terms).for_each(|(to, (of, by))| *to += by * of);
                    }),
                }
            }
        }
    }

    /// Turns derivatives by the state into derivatives by what is stored, in the columns that are differentiated; 0
    /// where one would not be finite.
    pub fn pull_back(&self, gradients: &mut Gradients) {
        for which in gradients.columns().iter() {
            let (by, of) = (self.column(which), gradients.column_mut(which));
            let finite = |x: f32| if x.is_finite() { x } else { 0.0 };
            match (by.width(), of.width()) {
                (0, _) => (),
                (1, width) => (0..width).for_each(|c| {
                    of.plane_mut(c).iter_mut().zip(by.plane(0)).for_each(|(of, by)| *of = finite(*of * by));
                }),
                (_, width) => {
                    let by_state = of.clone();
                    for j in 0..width {
                        let to = of.plane_mut(j);
                        to.fill(0.0);
                        for i in 0..width {
                            let terms = by_state.plane(i).iter().zip(by.plane(i * width + j));
                            to.iter_mut().zip(terms).for_each(|(to, (of, by))| *to += by * of);
                        }
                        to.iter_mut().for_each(|x| *x = finite(*x));
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Low-discrepancy steps, as good as noise.
    fn noise(of: &mut Column, step: f32) {
        of.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = (k as f32 * step).fract() - 0.5);
    }

    fn noisy(len: usize, step: f32) -> Gaussians {
        let mut made = Gaussians::zeros(len, 1);
        made.columns_mut(Columns::all()).for_each(|column| noise(column, step));
        made
    }

    /// Positions and rotations in full, a factor for opacities; the others change as what is stored does.
    fn jacobian(len: usize) -> Jacobian {
        let mut made = Jacobian::default();
        for (which, width) in [(Columns::POSITION, 9), (Columns::ROTATION, 16), (Columns::OPACITY, 1)] {
            *made.column_mut(which) = Column::zeros(width, len);
            noise(made.column_mut(which), 0.618_034);
        }
        made
    }

    #[test]
    fn derivatives_pulled_back_say_what_a_change_of_what_is_stored_does() {
        let (jacobian, change) = (jacobian(11), noisy(11, 0.754_878));
        let mut state = Gaussians::zeros(11, 1);
        jacobian.add_to(&change, &mut state);
        let mut gradients = Gradients::new(11, Columns::all(), 1);
        Columns::all().iter().for_each(|which| noise(gradients.column_mut(which), 0.569_84));
        let of = |a: &Column, b: &Column| -> f64 {
            a.planes().iter().zip(b.planes()).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
        };
        let expected = Columns::all().iter().map(|which| of(gradients.column(which), state.column(which)));
        let expected: Vec<f64> = expected.collect();
        jacobian.pull_back(&mut gradients);
        for (which, expected) in Columns::all().iter().zip(expected) {
            let got = of(gradients.column(which), change.column(which));
            assert!((got - expected).abs() < 1e-5, "{}: got {got}, expected {expected}", which.name());
        }
    }

    #[test]
    fn a_change_of_fewer_columns_and_bands_leaves_the_others_as_they_are() {
        let (mut change, mut state) = (Gaussians::zeros(0, 0), noisy(5, 0.3));
        change.sh = Column::from_planes(3, vec![1.0; 15]);
        let before = state.clone();
        jacobian(5).add_to(&change, &mut state);
        assert_eq!(state.sh.plane(2)[4], before.sh.plane(2)[4] + 1.0);
        assert_eq!(state.sh.plane(3), before.sh.plane(3));
        assert_eq!((state.position, state.opacity_logit), (before.position, before.opacity_logit));
    }

    #[test]
    fn what_would_not_be_finite_is_zero() {
        let mut jacobian = jacobian(2);
        jacobian.column_mut(Columns::POSITION).planes_mut()[0] = f32::MAX;
        jacobian.column_mut(Columns::OPACITY).planes_mut()[0] = f32::MAX;
        let mut gradients = Gradients::new(2, Columns::all(), 0);
        Columns::all().iter().for_each(|which| gradients.column_mut(which).planes_mut().fill(3.0));
        jacobian.pull_back(&mut gradients);
        assert_eq!(gradients.column(Columns::POSITION).plane(0)[0], 0.0);
        assert_eq!(gradients.column(Columns::OPACITY).plane(0)[0], 0.0);
        assert_ne!(gradients.column(Columns::OPACITY).plane(0)[1], 0.0);
    }
}
