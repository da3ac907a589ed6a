//! Network that computes pixel colors from the nine blended features of the full SpacetimeGaussians model.
//!
//! With features F of a pixel, camera center o and unit ray d, the color is act(F₀₋₂ + W₂·relu(W₁·[F₃₋₅, F₆₋₈, o, d])),
//! where act is the last function ([`ColorActivation`]). W₁ is `mlp1.weight` [6, 12, 1, 1] and W₂ is `mlp2.weight` [3,
//! 6, 1, 1] of `point_cloud.pt`; neither has a bias. Source: `helper_model.py` of the authors' code.

use std::path::Path;

use crate::deform::Tensors;
use crate::error::{Error, Result, quoted};

/// Number of features of a Gaussian, which the renderer blends for each pixel.
pub(super) const FEATURE_COUNT: usize = 9;
/// Number of network inputs: features 3 to 8, camera center (3 values) and ray (3 values).
const INPUTS: usize = 12;
/// Number of units in the hidden layer of the network.
const HIDDEN: usize = 6;

/// Last step of the computation of a pixel color: the function that is applied to each of its three channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ColorActivation {
    /// Logistic function, 1/(1 + exp(−x)).
    Sigmoid,
    /// Clamp to the range from 0 to 1.
    Clamp,
    /// Identity: the color stays unchanged.
    None,
}

impl ColorActivation {
    /// Returns the function that `cfg_args` selects by the value `name` of its key `rgbfunction`; `None` for unknown
    /// names.
    pub(super) fn from_name(name: &str) -> Option<ColorActivation> {
        match name {
            "sandwich" => Some(ColorActivation::Sigmoid),
            "sandwichnoact" => Some(ColorActivation::Clamp),
            "sandwichnoactss" => Some(ColorActivation::None),
            _ => None,
        }
    }

    /// Returns the color value that results from applying the function to `x`.
    pub(super) fn apply(self, x: f64) -> f64 {
        match self {
            ColorActivation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
            ColorActivation::Clamp => x.clamp(0.0, 1.0),
            ColorActivation::None => x,
        }
    }
}

/// Network that computes the color of a pixel from features: its weights, and the function applied to its result.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ColorDecoder {
    first: [[f64; INPUTS]; HIDDEN],
    second: [[f64; HIDDEN]; 3],
    activation: ColorActivation,
}

impl ColorDecoder {
    /// Reads the network from the state dict `tensors` of the file `path`. `activation` is the function applied last.
    ///
    /// # Errors
    /// Fails if weights are missing, have other shapes or are not finite.
    pub(super) fn new(tensors: &Tensors, activation: ColorActivation, path: &Path) -> Result<ColorDecoder> {
        let weights = |name: &str, shape: [usize; 4]| {
            let place = || format!("tensor {name}");
            let expected = format!("shape {shape:?}");
            let Some(tensor) = tensors.get(name) else {
                let names: Vec<String> = tensors.keys().map(|name| quoted(name).to_string()).collect();
                let found =
                    if names.is_empty() { "no tensors".to_owned() } else { format!("only {}", names.join(", ")) };
                return Err(Error::input(path, place(), expected, found));
            };
            if tensor.shape != shape {
                return Err(Error::input(path, place(), expected, format!("shape {:?}", tensor.shape)));
            }
            match tensor.data.iter().position(|x| !x.is_finite()) {
                Some(at) => Err(Error::input(
                    path,
                    format!("{}, value {at}", place()),
                    "a finite number",
                    tensor.data[at].to_string(),
                )),
                None => Ok(&tensor.data),
            }
        };
        let first = weights("mlp1.weight", [HIDDEN, INPUTS, 1, 1])?;
        let second = weights("mlp2.weight", [3, HIDDEN, 1, 1])?;
        Ok(ColorDecoder {
            first: std::array::from_fn(|i| std::array::from_fn(|j| first[i * INPUTS + j].into())),
            second: std::array::from_fn(|i| std::array::from_fn(|j| second[i * HIDDEN + j].into())),
            activation,
        })
    }

    /// Returns the color of a pixel with blended `features` ([`FEATURE_COUNT`] values), seen from the camera center
    /// `center` along the unit vector `ray`.
    pub(super) fn color(&self, features: &[f32], center: [f32; 3], ray: [f32; 3]) -> [f32; 3] {
        let mut inputs = [0.0; INPUTS];
        let all = features[3..].iter().chain(&center).chain(&ray);
        inputs.iter_mut().zip(all).for_each(|(to, &of)| *to = of.into());
        let sum = |weights: &[f64], values: &[f64]| weights.iter().zip(values).map(|(w, x)| w * x).sum::<f64>();
        let hidden = self.first.map(|row| sum(&row, &inputs).max(0.0));
        std::array::from_fn(|c| self.activation.apply(f64::from(features[c]) + sum(&self.second[c], &hidden)) as f32)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::deform::Tensor;
    use crate::model::opacity;

    /// Returns the weights of a small network in the form of a state dict.
    pub(in super::super) fn weights() -> Tensors {
        let ramp = |n: usize, by: f32| (0..n).map(|i| by * ((i * 7 % 11) as f32 - 5.0)).collect::<Vec<f32>>();
        [
            ("mlp1.weight".to_owned(), Tensor { shape: vec![6, 12, 1, 1], data: ramp(72, 0.05) }),
            ("mlp2.weight".to_owned(), Tensor { shape: vec![3, 6, 1, 1], data: ramp(18, 0.1) }),
        ]
        .into()
    }

    #[test]
    fn network_with_zero_output_returns_the_first_features() {
        let mut tensors = weights();
        tensors.get_mut("mlp2.weight").unwrap().data.fill(0.0);
        let features = [0.5, -1.0, 2.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0];
        let color = |activation| {
            ColorDecoder::new(&tensors, activation, Path::new("x.pt")).unwrap().color(&features, [1.0; 3], [1.0; 3])
        };
        assert_eq!(color(ColorActivation::None), [0.5, -1.0, 2.0]);
        assert_eq!(color(ColorActivation::Clamp), [0.5, 0.0, 1.0]);
        let sigmoid = color(ColorActivation::Sigmoid);
        assert!((0..3).all(|c| (f64::from(sigmoid[c]) - opacity(features[c])).abs() < 1e-7), "{sigmoid:?}");
    }

    #[test]
    fn hidden_units_are_clamped_at_zero() {
        let mut tensors = weights();
        let first = &mut tensors.get_mut("mlp1.weight").unwrap().data;
        first.fill(0.0);
        // Hidden unit 0 reads feature 3; hidden unit 1 reads z of the ray.
        (first[0], first[12 + 11]) = (2.0, 3.0);
        let second = &mut tensors.get_mut("mlp2.weight").unwrap().data;
        second.fill(0.0);
        (second[0], second[1], second[6 + 1]) = (1.0, 10.0, -1.0);
        let decoder = ColorDecoder::new(&tensors, ColorActivation::None, Path::new("x.pt")).unwrap();
        let mut features = [0.0; 9];
        features[3] = 0.25;
        assert_eq!(decoder.color(&features, [0.0; 3], [0.0, 0.0, 1.0]), [0.5 + 30.0, -3.0, 0.0]);
        assert_eq!(decoder.color(&features, [0.0; 3], [0.0, 0.0, -1.0]), [0.5, 0.0, 0.0]);
    }

    #[test]
    fn missing_or_wrong_weights_are_named() {
        let error_message = |change: &dyn Fn(&mut Tensors)| {
            let mut tensors = weights();
            change(&mut tensors);
            ColorDecoder::new(&tensors, ColorActivation::None, Path::new("some/point_cloud.pt"))
                .unwrap_err()
                .to_string()
        };
        let missing = error_message(&|tensors| drop(tensors.remove("mlp2.weight")));
        for part in ["some/point_cloud.pt", "mlp2.weight", "[3, 6, 1, 1]", "mlp1.weight"] {
            assert!(missing.contains(part), "{missing}");
        }
        let wide = error_message(&|tensors| tensors.get_mut("mlp1.weight").unwrap().shape = vec![6, 6, 2, 1]);
        assert!(wide.contains("[6, 12, 1, 1]") && wide.contains("[6, 6, 2, 1]"), "{wide}");
        let nan = error_message(&|tensors| tensors.get_mut("mlp1.weight").unwrap().data[5] = f32::NAN);
        assert!(nan.contains("mlp1.weight") && nan.contains("value 5") && nan.contains("NaN"), "{nan}");
    }
}
