//! Colours that make a smaller model's pictures as like the original's as colours can.
//!
//! In: what cameras see of the smaller model ([`ColorOperator`]) and what their pictures lack. Out: a change of
//! every Gaussian's base colour, the same at all times. A picture is linear in colour, so this is linear
//! least squares: minimise (1/P) Σ ‖A_p·δ − lack_p‖² + ridge·‖δ‖² over P pictures by conjugate gradients
//! with the diagonal as preconditioner (Hestenes and Stiefel, 1952; Saad, "Iterative Methods for Sparse
//! Linear Systems", section 9.2). Memory: [`BYTES_PER_GAUSSIAN`], the operators that are to be kept, and one for each
//! thread; every iteration makes those that are not kept again. Sums go by picture, so the bits depend neither on
//! the threads nor on what is kept.

use rayon::prelude::*;

use crate::model::{Camera, Gaussians};
use crate::render::{ColorOperator, Image};

/// Memory per Gaussian beside the operators: right-hand side, diagonal, five vectors of the iteration, one of them in f32
/// too, and whether its colour stays.
pub const BYTES_PER_GAUSSIAN: usize = 7 * size_of::<Rgb>() + size_of::<[f32; 3]>() + size_of::<bool>();

/// Red, green and blue: three systems of equations that share their weights.
type Rgb = [f64; 3];

/// The normal equations of all pictures seen so far.
#[derive(Debug)]
pub struct Refit {
    /// Of the first pictures.
    operators: Vec<ColorOperator>,
    most_operators: usize,
    pictures: usize,
    /// Σ Aᵀ·lack, `[N]`.
    wanted: Vec<Rgb>,
    /// Diagonal of Σ AᵀA, `[N]`.
    power: Vec<Rgb>,
    /// Whose colours stay, `[N]`.
    fixed: Vec<bool>,
}

impl Refit {
    /// Of as many Gaussians as `fixed` has entries; those set keep their colours. What the cameras of the first
    /// `most_operators` pictures see is kept.
    pub fn new(fixed: Vec<bool>, most_operators: usize) -> Self {
        let zeros = vec![[0.0; 3]; fixed.len()];
        Refit { operators: Vec::new(), most_operators, pictures: 0, wanted: zeros.clone(), power: zeros, fixed }
    }

    /// Adds pictures of `state`, the smaller model at one frame: each a camera, and the original's picture
    /// minus the smaller model's.
    ///
    /// # Panics
    /// If `state` has not N Gaussians, or a picture not its camera's size.
    pub fn add(&mut self, state: &Gaussians, lacks: &[(&Camera, Image)]) {
        assert_eq!(state.len(), self.fixed.len(), "pictures of another model");
        // By batches, so that no more operators and sums wait for their turn than threads make at a time.
        for batch in lacks.chunks(rayon::current_num_threads()) {
            let seen: Vec<_> = batch
                .par_iter()
                .map(|(camera, lack)| {
                    let operator = ColorOperator::new(state, camera);
                    let (sums, power) = (operator.transposed(lack), operator.diagonal());
                    (operator, sums, power)
                })
                .collect();
            for (operator, sums, power) in seen {
                operator.add(&sums, &mut self.wanted);
                operator.add(&power, &mut self.power);
                if self.operators.len() < self.most_operators {
                    self.operators.push(operator);
                }
            }
        }
        self.pictures += lacks.len();
    }

    /// The change of every Gaussian's colour, `[N]` in units of colour, after at most `iterations`.
    ///
    /// `ridge` is in pixels per picture: a Gaussian that covers less hardly changes. What no picture
    /// shows, and what is fixed, does not change at all.
    ///
    /// `again` is asked once per iteration, if not every operator was kept: it hands on the states and cameras of the
    /// pictures beyond those kept, as they were added. Fails only if `again` does.
    pub fn solve<E>(
        &self,
        ridge: f64,
        iterations: usize,
        mut again: impl FnMut(&mut dyn FnMut(&Gaussians, &[&Camera])) -> Result<(), E>,
    ) -> Result<Vec<[f32; 3]>, E> {
        let count = self.fixed.len();
        let ridge = ridge * self.pictures as f64;
        // Without a ridge a Gaussian that is never seen would divide by 0.
        let inverse = |i: usize, c: usize| match self.power[i][c] + ridge {
            diagonal if diagonal > 0.0 && self.power[i][c] > 0.0 && !self.fixed[i] => 1.0 / diagonal,
            _ => 0.0,
        };
        let preconditioned = |residual: &[Rgb]| -> Vec<Rgb> {
            (0..count).map(|i| std::array::from_fn(|c| residual[i][c] * inverse(i, c))).collect()
        };
        let mut change = vec![[0.0; 3]; count];
        let mut residual = self.wanted.clone();
        let mut direction = preconditioned(&residual);
        let mut size = dot(&residual, &direction);
        for _ in 0..iterations {
            let image = self.apply(&direction, ridge, &mut again)?;
            let curvature = dot(&direction, &image);
            // A system that is solved has no direction left.
            let step: Rgb = std::array::from_fn(|c| if curvature[c] > 0.0 { size[c] / curvature[c] } else { 0.0 });
            if step == [0.0; 3] {
                break;
            }
            for i in 0..count {
                for c in 0..3 {
                    change[i][c] += step[c] * direction[i][c];
                    residual[i][c] -= step[c] * image[i][c];
                }
            }
            let next = preconditioned(&residual);
            let next_size = dot(&residual, &next);
            for c in 0..3 {
                let keep = if size[c] > 0.0 { next_size[c] / size[c] } else { 0.0 };
                direction
                    .iter_mut()
                    .zip(&next)
                    .for_each(|(direction, next)| direction[c] = next[c] + keep * direction[c]);
            }
            size = next_size;
        }
        Ok(change.into_iter().map(|change| change.map(|x| x as f32)).collect())
    }

    /// (Σ AᵀA + ridge)·`change`.
    fn apply<E>(
        &self,
        change: &[Rgb],
        ridge: f64,
        again: &mut impl FnMut(&mut dyn FnMut(&Gaussians, &[&Camera])) -> Result<(), E>,
    ) -> Result<Vec<Rgb>, E> {
        let narrow: Vec<[f32; 3]> = change.iter().map(|change| change.map(|x| x as f32)).collect();
        let mut total: Vec<Rgb> = change.iter().map(|change| change.map(|x| ridge * x)).collect();
        // By batches, so that no more sums wait for their turn than threads make at a time.
        for batch in self.operators.chunks(rayon::current_num_threads()) {
            let sums: Vec<_> = batch.par_iter().map(|operator| operator.normal(&narrow)).collect();
            batch.iter().zip(&sums).for_each(|(operator, sums)| operator.add(sums, &mut total));
        }
        if self.operators.len() < self.pictures {
            again(&mut |state, cameras| {
                for batch in cameras.chunks(rayon::current_num_threads()) {
                    let look = |camera: &&Camera| {
                        let operator = ColorOperator::new(state, camera);
                        let sums = operator.normal(&narrow);
                        (operator, sums)
                    };
                    let seen: Vec<_> = batch.par_iter().map(look).collect();
                    seen.iter().for_each(|(operator, sums)| operator.add(sums, &mut total));
                }
            })?;
        }
        Ok(total)
    }
}

/// Inner product of each channel, in index order.
fn dot(a: &[Rgb], b: &[Rgb]) -> Rgb {
    a.iter().zip(b).fold([0.0; 3], |sum, (a, b)| std::array::from_fn(|c| sum[c] + a[c] * b[c]))
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::model::SH_C0;
    use crate::render::render;

    const BLACK: [f32; 3] = [0.0; 3];

    /// Overlapping Gaussians of degree 0 in a box, with colours well above 0.
    fn cloud(count: usize) -> Gaussians {
        let mut scene = Gaussians::zeros(count, 0);
        for i in 0..count {
            let step = |k: f64| (i as f64 * k).fract() as f32;
            scene.position.set_row(i, [step(0.618_034) - 0.5, step(0.754_878) - 0.5, step(0.569_84) - 0.5]);
            scene.rotation.set_row(i, [1.0, step(0.819_173), step(0.671_044), step(0.549_701)]);
            scene.log_scale.set_row(i, [-2.0 - step(0.380_2), -1.8, -2.4]);
            scene.opacity_logit.set_row(i, [4.0 * step(0.856_675) - 1.0]);
            scene.sh.set_row(i, [step(0.733_892), step(0.628_71), step(0.538_6)]);
        }
        scene
    }

    fn cameras(count: usize) -> Vec<Camera> {
        let eye = |k: usize| DVec3::new(3.0 * (k as f64).cos(), 3.0 * (k as f64).sin(), 0.7 * k as f64 - 1.0);
        (0..count).map(|k| Camera::look_at(eye(k), DVec3::ZERO, 0.6, (37, 29))).collect()
    }

    fn minus(a: &Image, b: &Image) -> Image {
        Image { data: a.data.iter().zip(&b.data).map(|(a, b)| a - b).collect(), ..*a }
    }

    fn recoloured(scene: &Gaussians, change: &[[f32; 3]]) -> Gaussians {
        let mut out = scene.clone();
        for (i, change) in change.iter().enumerate() {
            let old = scene.sh.row::<3>(i);
            out.sh.set_row::<3>(i, std::array::from_fn(|c| old[c] + change[c] / SH_C0 as f32));
        }
        out
    }

    /// The refit of `now` towards the pictures of `wanted`.
    fn refit(now: &Gaussians, wanted: &Gaussians, cameras: &[Camera], fixed: Vec<bool>) -> Refit {
        refit_with(usize::MAX, now, wanted, cameras, fixed)
    }

    fn refit_with(
        most_operators: usize,
        now: &Gaussians,
        wanted: &Gaussians,
        cameras: &[Camera],
        fixed: Vec<bool>,
    ) -> Refit {
        let mut refit = Refit::new(fixed, most_operators);
        for camera in cameras {
            let lack = minus(&render(wanted, camera, BLACK), &render(now, camera, BLACK));
            refit.add(now, &[(camera, lack)]);
        }
        refit
    }

    /// [`Refit::solve`] with every operator kept.
    fn solve(refit: &Refit, ridge: f64, iterations: usize) -> Vec<[f32; 3]> {
        refit.solve(ridge, iterations, |_| Err("every operator is kept")).unwrap()
    }

    /// Σ AᵀA + ridge and Σ Aᵀ·lack of one channel, A from pictures in which one Gaussian is 1 and all
    /// others are 0.
    fn dense(
        now: &Gaussians,
        wanted: &Gaussians,
        cameras: &[Camera],
        ridge: f64,
        c: usize,
    ) -> (Vec<Vec<f64>>, Vec<f64>) {
        let n = now.len();
        let (mut matrix, mut right) = (vec![vec![0.0; n]; n], vec![0.0; n]);
        for camera in cameras {
            let columns: Vec<Vec<f64>> = (0..n)
                .map(|lit| {
                    let mut one = now.clone();
                    let value = |i| if i == lit { 0.5 / SH_C0 as f32 } else { -2.0 };
                    (0..n).for_each(|i| one.sh.set_row(i, [value(i); 3]));
                    render(&one, camera, BLACK).data.chunks(3).map(|pixel| f64::from(pixel[0])).collect()
                })
                .collect();
            let lack = minus(&render(wanted, camera, BLACK), &render(now, camera, BLACK));
            for i in 0..n {
                right[i] += columns[i].iter().zip(lack.data.chunks(3)).map(|(w, px)| w * f64::from(px[c])).sum::<f64>();
                for j in 0..n {
                    matrix[i][j] += columns[i].iter().zip(&columns[j]).map(|(a, b)| a * b).sum::<f64>();
                }
            }
        }
        (0..n).for_each(|i| matrix[i][i] += ridge * cameras.len() as f64);
        (matrix, right)
    }

    /// Gaussian elimination; the matrices here are positive definite.
    fn solved(mut matrix: Vec<Vec<f64>>, mut right: Vec<f64>) -> Vec<f64> {
        let n = right.len();
        for k in 0..n {
            let pivot = matrix[k].clone();
            for i in k + 1..n {
                let factor = matrix[i][k] / pivot[k];
                (k..n).for_each(|j| matrix[i][j] -= factor * pivot[j]);
                right[i] -= factor * right[k];
            }
        }
        for i in (0..n).rev() {
            let known: f64 = (i + 1..n).map(|j| matrix[i][j] * right[j]).sum();
            right[i] = (right[i] - known) / matrix[i][i];
        }
        right
    }

    #[test]
    fn the_change_solves_the_normal_equations_written_out() {
        let (now, cameras) = (cloud(14), cameras(4));
        let mut wanted = now.clone();
        (0..14).for_each(|i| wanted.sh.set_row(i, [0.3, -0.4 + 0.05 * i as f32, 0.9]));
        let ridge = 0.7;
        let got = solve(&refit(&now, &wanted, &cameras, vec![false; 14]), ridge, 60);
        for c in 0..3 {
            let (matrix, right) = dense(&now, &wanted, &cameras, ridge, c);
            let expected = solved(matrix, right);
            for i in 0..14 {
                let (got, expected) = (f64::from(got[i][c]), expected[i]);
                // Renders are f32: 1e-6 of a pixel over thousands of them.
                assert!((got - expected).abs() < 2e-4, "channel {c} of {i}: got {got}, expected {expected}");
            }
        }
    }

    #[test]
    fn colours_that_were_perturbed_come_back() {
        let (original, cameras) = (cloud(300), cameras(6));
        let tint = |i: usize| [0.2, -0.15, 0.1].map(|x: f32| x * (i as f32 * 0.7).sin());
        let perturbed = recoloured(&original, &(0..300).map(tint).collect::<Vec<_>>());
        let change = solve(&refit(&perturbed, &original, &cameras, vec![false; 300]), 1e-6, 200);
        let restored = recoloured(&perturbed, &change);
        for camera in &cameras {
            let rms = |state| {
                let lack = minus(&render(&original, camera, BLACK), &render(state, camera, BLACK)).data;
                (lack.iter().map(|x| f64::from(x * x)).sum::<f64>() / lack.len() as f64).sqrt()
            };
            let (before, after) = (rms(&perturbed), rms(&restored));
            assert!(after < 1e-3 * before, "got {after}, before {before}");
        }
    }

    #[test]
    fn what_is_fixed_hidden_or_cut_off_at_black_keeps_its_colour() {
        let cameras = cameras(3);
        let mut now = cloud(40);
        // Behind every camera's back; and black from everywhere.
        now.position.set_row(7, [0.0, 0.0, 50.0]);
        now.sh.set_row(9, [-5.0; 3]);
        let mut wanted = now.clone();
        (0..40).for_each(|i| wanted.sh.set_row(i, [1.0; 3]));
        let fixed: Vec<bool> = (0..40).map(|i| i % 5 == 0).collect();
        for (i, change) in solve(&refit(&now, &wanted, &cameras, fixed.clone()), 0.0, 30).iter().enumerate() {
            let stays = fixed[i] || i == 7 || i == 9;
            assert_eq!(*change == [0.0; 3], stays, "{i}: {change:?}");
        }
    }

    #[test]
    fn threads_do_not_change_a_bit() {
        let (now, cameras) = (cloud(200), cameras(5));
        let mut wanted = now.clone();
        (0..200).for_each(|i| wanted.sh.set_row(i, [0.1, 0.6, 1.1]));
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| solve(&refit(&now, &wanted, &cameras, vec![false; 200]), 0.01, 8))
        };
        let one = on(1);
        assert!(one.iter().any(|change| *change != [0.0; 3]));
        assert!(one == on(2) && one == on(7));
    }

    #[test]
    fn sights_that_are_made_again_do_not_change_a_bit() {
        let (now, cameras) = (cloud(200), cameras(5));
        let mut wanted = now.clone();
        (0..200).for_each(|i| wanted.sh.set_row(i, [0.1, 0.6, 1.1]));
        let kept = solve(&refit(&now, &wanted, &cameras, vec![false; 200]), 0.01, 8);
        for most in [0, 2, 4] {
            let fresh = refit_with(most, &now, &wanted, &cameras, vec![false; 200]);
            let mut asked = 0;
            let change = fresh.solve(0.01, 8, |see| {
                asked += 1;
                see(&now, &cameras[most..].iter().collect::<Vec<_>>());
                Ok::<_, ()>(())
            });
            assert!(change.unwrap() == kept && asked == 8, "{most} kept, asked {asked} times");
        }
    }

    #[test]
    fn no_gaussians_and_no_pictures_give_no_change() {
        assert!(solve(&Refit::new(Vec::new(), 9), 0.1, 5).is_empty());
        assert_eq!(solve(&Refit::new(vec![false; 2], 9), 0.0, 5), [[0.0; 3]; 2]);
    }
}
