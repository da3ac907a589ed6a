use super::*;
use crate::synthetic::Noise;
use crate::synthetic::deep::{ALL_VARIANTS, DeepVariant, random_tensors};

const FILE: &str = "deform.pth";

/// Builds a network with random weights of the architecture `kind`.
fn network(kind: DeepVariant) -> Network {
    Network::new(&random_tensors(kind), "network.", Path::new(FILE)).unwrap()
}

/// Returns random positions of `rows` Gaussians, from −1.5 to 1.5.
fn positions(rows: usize) -> AttributeValues {
    let mut noise = Noise(11);
    let mut values = AttributeValues::zeros(3, rows);
    values.planes_mut().iter_mut().for_each(|x| *x = 1.5 * noise.next());
    values
}

/// Slow reference evaluation (oracle) of the network in f64, layer by layer as defined. Holds the state dict.
struct NetworkOracle(Tensors);

impl NetworkOracle {
    /// Returns the output W·x + b of the fully connected layer `name` for the input `x`.
    fn linear(&self, name: &str, x: &[f64]) -> Vec<f64> {
        let [weight, bias] = ["weight", "bias"].map(|part| &self.0[&format!("network.{name}.{part}")]);
        let row = |(row, &bias): (&[f32], &f32)| -> f64 {
            f64::from(bias) + row.iter().zip(x).map(|(&w, x)| f64::from(w) * x).sum::<f64>()
        };
        assert_eq!(weight.shape[1], x.len(), "{name}");
        weight.data.chunks(x.len()).zip(&bias.data).map(row).collect()
    }

    /// Returns the encoding of the vector `v`: `v`, then the sine and cosine of 2ᵏ·`v` for each octave k.
    fn encoding(v: &[f64], octaves: i32) -> Vec<f64> {
        let waves = (0..octaves).flat_map(|k| {
            let wave = move |f: fn(f64) -> f64| v.iter().map(move |x| f(2f64.powi(k) * x));
            wave(f64::sin).chain(wave(f64::cos)).collect::<Vec<f64>>()
        });
        v.iter().copied().chain(waves).collect()
    }

    /// Returns the outputs of all heads (output layers) for one Gaussian, one head after the other. `kind` is the
    /// variant of the architecture, `position` the stored position.
    fn motion(&self, kind: DeepVariant, position: [f64; 3], time: f64) -> Vec<f64> {
        let relu = |x: Vec<f64>| x.into_iter().map(|x| x.max(0.0)).collect::<Vec<f64>>();
        let encoded_time = match kind.time_network {
            true => self.linear("timenet.2", &relu(self.linear("timenet.0", &Self::encoding(&[time], 6)))),
            false => Self::encoding(&[time], 10),
        };
        let encodings = [Self::encoding(&position, 10), encoded_time].concat();
        let mut h = encodings.clone();
        for k in 0..5 {
            h = relu(self.linear(&format!("linear.{k}"), &h));
            if k == 2 {
                h = [encodings.clone(), h].concat();
            }
        }
        let mut heads = if kind.screws { vec!["branch_w", "branch_v"] } else { vec!["gaussian_warp"] };
        heads.extend(["gaussian_rotation", "gaussian_scaling"]);
        heads.extend(["gaussian_opacity", "gaussian_color"].iter().filter(|_| kind.all_heads));
        heads.into_iter().flat_map(|head| self.linear(head, &h)).collect()
    }
}

/// Returns all outputs of the network for Gaussian `i`, in the order of the fields of [`PredictedMotion`].
fn row(motion: &PredictedMotion, i: usize) -> Vec<f64> {
    let PredictedMotion { warp, rotation, scaling, opacity, color } = motion;
    let columns = [warp, rotation, scaling, opacity, color];
    columns.into_iter().flat_map(|column| (0..column.width()).map(|c| f64::from(column.plane(c)[i]))).collect()
}

#[test]
fn every_variant_matches_the_f64_oracle() {
    for kind in ALL_VARIANTS {
        let (network, oracle, positions) = (network(kind), NetworkOracle(random_tensors(kind)), positions(37));
        assert_eq!(
            (network.predicts_screw_motion(), network.deformed_attributes().contains(Attributes::SH)),
            (kind.screws, kind.all_heads)
        );
        let encoded = network.encode(&positions);
        let mut motion = PredictedMotion::default();
        for time in [0.0f32, 0.37, 1.0] {
            network.motion(&encoded, f64::from(time), Attributes::all(), &mut motion).unwrap();
            for i in 0..positions.len() {
                let expected = oracle.motion(kind, positions.row::<3>(i).map(f64::from), f64::from(time));
                let found = row(&motion, i);
                assert_eq!(found.len(), expected.len());
                for (o, (got, expected)) in found.iter().zip(&expected).enumerate() {
                    // The limit allows for some hundred f32 roundings of numbers of this size.
                    let off = (got - expected).abs();
                    assert!(
                        off < 4e-6,
                        "{kind:?}, Gaussian {i}, output {o}: got {got}, expected {expected}, off {off:e}"
                    );
                }
            }
        }
    }
}

#[test]
fn encoded_values_are_correctly_rounded() {
    let mut noise = Noise(3);
    let mut off = 0.0f64;
    for k in 0..2000 {
        let value = noise.next() * [1.0, 30.0, 3000.0][k % 3];
        for (octave, pair) in encode_scalar(value, POSITION_OCTAVES)[1..].chunks(2).enumerate() {
            let (sine, cosine) = (f64::from(value) * 2f64.powi(octave as i32)).sin_cos();
            for (got, expected) in pair.iter().zip([sine, cosine]) {
                // Subtracts half a unit in the last place of f32; the rest is the error of the double-angle formulas.
                let unit = f64::from(f32::EPSILON) * expected.abs().log2().floor().exp2() / 2.0;
                off = off.max(((f64::from(*got) - expected).abs() - unit) / 1e-13);
            }
        }
    }
    assert!(off < 1.0, "off by {off:e} times 1e-13 more than rounding");
}

#[test]
fn slopes_match_finite_differences() {
    for kind in &ALL_VARIANTS[..2] {
        let (network, oracle, positions) = (network(*kind), NetworkOracle(random_tensors(*kind)), positions(19));
        let slopes = network.warp_jacobian(&positions, 0.25).unwrap();
        let outputs = if kind.screws { 6 } else { 3 };
        assert_eq!(slopes.width(), 3 * outputs);
        for i in 0..positions.len() {
            for axis in 0..3 {
                let at = |by: f64| {
                    let mut moved = positions.row::<3>(i).map(f64::from);
                    moved[axis] += by;
                    oracle.motion(*kind, moved, 0.25)
                };
                // The step of the finite difference is small beside the shortest wavelength, 1/512. ReLUs that switch
                // within the step are rare.
                let (above, below) = (at(1e-7), at(-1e-7));
                for o in 0..outputs {
                    let (got, expected) = (f64::from(slopes.plane(3 * o + axis)[i]), (above[o] - below[o]) / 2e-7);
                    let off = (got - expected).abs() / (1.0 + expected.abs());
                    assert!(off < 2e-4, "{kind:?}, Gaussian {i}, {o} along {axis}: got {got}, expected {expected}");
                }
            }
        }
    }
}

#[test]
fn motion_does_not_depend_on_block_or_requested_heads() {
    let network = network(ALL_VARIANTS[0]);
    let all = positions(70);
    let mut whole = PredictedMotion::default();
    network.motion(&network.encode(&all), 0.6, Attributes::all(), &mut whole).unwrap();
    for ids in [vec![0], vec![3, 69, 4], (20..55).collect()] {
        let mut part = PredictedMotion::default();
        let encoded = network.encode(&all.pick(&ids));
        network.motion(&encoded, 0.6, Attributes::LOG_SCALE, &mut part).unwrap();
        assert!(part.warp.is_empty());
        network.motion(&encoded, 0.6, Attributes::POSITION, &mut part).unwrap();
        assert_eq!((&part.scaling, &part.warp), (&whole.scaling.pick(&ids), &whole.warp.pick(&ids)));
    }
}

#[test]
fn tensors_that_do_not_fit_are_named_in_the_error() {
    type Break = fn(&mut Tensors);
    let cases: [(DeepVariant, Break, &[&str]); 7] = [
        (ALL_VARIANTS[0], |t| drop(t.remove("network.linear.0.weight")), &["network.linear.0.weight", "none"]),
        (ALL_VARIANTS[0], |t| drop(t.remove("network.linear.3.bias")), &["network.linear.3.bias", "none"]),
        (ALL_VARIANTS[0], |t| drop(t.remove("network.gaussian_scaling.weight")), &["network.gaussian_scaling.weight"]),
        (
            ALL_VARIANTS[0],
            |t| t.get_mut("network.linear.1.weight").unwrap().data[3] = f32::NAN,
            &["network.linear.1.weight", "finite", "element 3"],
        ),
        (
            ALL_VARIANTS[0],
            |t| t.get_mut("network.linear.4.weight").unwrap().shape = vec![11, 44],
            &["network.linear.4.weight", "[11, 44]"],
        ),
        (
            ALL_VARIANTS[1],
            |t| {
                let tensor = t.get_mut("network.linear.0.weight").unwrap();
                tensor.shape[1] -= 1;
                tensor.data.truncate(tensor.shape.iter().product());
            },
            &["network.linear.0.weight", "odd", "83"],
        ),
        (
            ALL_VARIANTS[0],
            |t| drop(t.insert("network.timenet.2.weight".into(), t["network.linear.1.weight"].clone())),
            &["network.timenet.2.weight"],
        ),
    ];
    for (kind, damage, parts) in cases {
        let mut damaged = random_tensors(kind);
        damage(&mut damaged);
        let message = Network::new(&damaged, "network.", Path::new(FILE)).unwrap_err().to_string();
        for part in parts.iter().chain(&[FILE]) {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
    }
    assert!(
        network(ALL_VARIANTS[0])
            .motion(&EncodedPositions::default(), f64::NAN, Attributes::all(), &mut PredictedMotion::default())
            .is_err()
    );
}
