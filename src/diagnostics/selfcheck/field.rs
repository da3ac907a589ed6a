//! Self-check cases for the deformation field of a 4DGaussians model.

use std::path::Path;

use super::case::LargestError;
use crate::deform::oracle::{Oracle, Parameters};
use crate::deform::synthetic::{Noise, plain_config, random_tensors};
use crate::deform::{Deltas, Field, FieldConfig, LayerBuffers};
use crate::error::Result;
use crate::model::{Attributes, Gaussians};

/// Compares the frame states that the program computes by a deformation field with the f64 definition of this field,
/// for several configurations of the field. The error of a value is relative to 1 + |value|; the bound allows about 60
/// roundings in f32.
pub(super) fn states(worst: &mut LargestError) -> Result<()> {
    let raw = random_gaussians(40);
    for (config, depth) in [
        (plain_config(), 1),
        (FieldConfig { empty_voxel: true, ..plain_config() }, 2),
        (FieldConfig { no_grid: true, ..plain_config() }, 1),
        (FieldConfig { apply_rotation: true, static_mlp: true, grid_pe: 2, ..plain_config() }, 3),
    ] {
        let tensors = random_tensors(&config, depth);
        let field = Field::new(&tensors, config.clone(), 3, Path::new("made up"))?;
        let prepared = field.prepare(&raw.position);
        for time in [0.0, 0.37, 1.0] {
            let mut deltas = Deltas::new(3);
            field.deltas(&prepared, time, Attributes::all(), &mut LayerBuffers::default(), &mut deltas)?;
            let mut state = Gaussians::zeros(0, 3);
            deltas.apply(&raw, Attributes::all(), &mut state);
            for i in 0..raw.len() {
                let got = Parameters::from_row(&state, i).values();
                let oracle = Oracle { tensors: &tensors, config: &config };
                let expected = oracle.state(&Parameters::from_row(&raw, i), time).values();
                got.iter().zip(&expected).for_each(|(&got, &x)| worst.near(got, x, 1.0 + x.abs()));
            }
        }
    }
    Ok(())
}

/// Compares the Jacobian (derivative of deformed positions with respect to stored positions) of the deformation field
/// with finite differences of the field's f64 definition, taken over a distance of 2e-6. Errors are relative to 1 +
/// |value|; the bound allows for rounding in f32 of derivatives of products of six samples, one from each feature
/// plane.
pub(super) fn derivative(worst: &mut LargestError) -> Result<()> {
    let (config, time, step) = (plain_config(), 0.37, 1e-6);
    let tensors = random_tensors(&config, 2);
    let field = Field::new(&tensors, config.clone(), 3, Path::new("made up"))?;
    let oracle = Oracle { tensors: &tensors, config: &config };
    let raw = random_gaussians(40);
    let found = field.jacobian(&raw, &field.prepare_with_slopes(&raw.position), time, Attributes::POSITION)?;
    worst.same(&found.derivative(Attributes::POSITION).width(), &9);
    for i in 0..raw.len() {
        for input in 0..3 {
            let [low, high] = [-step, step].map(|step| {
                let mut moved = Parameters::from_row(&raw, i);
                moved.position[input] += step;
                oracle.state(&moved, time).position
            });
            for output in 0..3 {
                let expected = (high[output] - low[output]) / (2.0 * step);
                let got = f64::from(found.derivative(Attributes::POSITION).plane(3 * output + input)[i]);
                worst.near(got, expected, 1.0 + expected.abs());
            }
        }
    }
    Ok(())
}

/// Returns `count` random Gaussians of SH degree 3, some of them outside the bounding box of the field.
fn random_gaussians(count: usize) -> Gaussians {
    let mut noise = Noise(99);
    let mut random_gaussians = Gaussians::zeros(count, 3);
    for column in random_gaussians.selected_attribute_values_mut(Attributes::all()) {
        column.planes_mut().iter_mut().for_each(|x| *x = 2.0 * noise.next());
    }
    random_gaussians
}
