use std::path::Path;

use super::*;
use crate::oracle::{Oracle, Parameters};
use crate::synthetic::{Noise, plain_config, random_tensors};
use splat_core::{AttributeValues, Attributes, Gaussians, Gradients};

/// Returns random stored Gaussians, some of them outside the box that the feature planes cover.
fn random_gaussians(len: usize) -> Gaussians {
    let mut noise = Noise(99);
    let mut gaussians = Gaussians::zeros(len, 3);
    for column in Attributes::all().iter() {
        gaussians.attribute_values_mut(column).planes_mut().iter_mut().for_each(|x| *x = 2.0 * noise.next());
    }
    gaussians
}

/// Evaluates `field` for the stored Gaussians `raw` at `time`. Returns the attributes `want` of the Gaussians at this
/// time, and the deltas that were added to the stored attributes.
fn states(field: &Field, raw: &Gaussians, time: f64, want: Attributes) -> (Gaussians, Deltas) {
    let mut deltas = Deltas::new(3);
    field.deltas(&field.prepare(&raw.position), time, want, &mut LayerBuffers::default(), &mut deltas).unwrap();
    let mut state = Gaussians::zeros(0, 3);
    deltas.apply(raw, want, &mut state);
    (state, deltas)
}

/// Builds a deformation field with random weights and `depth` layers in its trunk (the MLP shared by all attributes).
fn build(config: &FieldConfig, depth: usize) -> Field {
    Field::new(&random_tensors(config, depth), config.clone(), 3, Path::new("synthetic.pth")).unwrap()
}

/// Returns all components of an attribute of Gaussian `i`.
fn values(column: &AttributeValues, i: usize) -> Vec<f64> {
    (0..column.width()).map(|c| f64::from(column.plane(c)[i])).collect()
}

/// Asserts that the attributes that a field computes for random Gaussians match the f64 reference (oracle). The field
/// has the options `config` and `depth` layers in its trunk. `what` names the tested case in failures.
fn assert_matches_oracle(what: &str, config: FieldConfig, depth: usize) {
    let tensors = random_tensors(&config, depth);
    let oracle = Oracle { tensors: &tensors, config: &config };
    let field = build(&config, depth);
    let raw = random_gaussians(40);
    for time in [0.0, 0.37, 1.0] {
        let (state, _) = states(&field, &raw, time, Attributes::all());
        for i in 0..raw.len() {
            let expected = oracle.state(&Parameters::from_row(&raw, i), time);
            for (column, expected) in [
                (&state.position, &expected.position),
                (&state.rotation, &expected.rotation),
                (&state.log_scale, &expected.log_scale),
                (&state.opacity_logit, &expected.opacity_logit),
                (&state.sh, &expected.sh),
            ] {
                for (got, expected) in values(column, i).into_iter().zip(expected) {
                    // Allows for about 60 f32 roundings of numbers of this size. A wrong axis or order causes an error
                    // of 0.1.
                    let tolerance = 2e-5 * (1.0 + expected.abs());
                    assert!(
                        (got - expected).abs() <= tolerance,
                        "{what}, time {time}, Gaussian {i}: got {got}, expected {expected}, tolerance {tolerance}"
                    );
                }
            }
        }
    }
}

#[test]
fn every_flag_matches_the_f64_oracle() {
    assert_matches_oracle("plain", plain_config(), 1);
    assert_matches_oracle("static_mlp", FieldConfig { static_mlp: true, ..plain_config() }, 1);
    assert_matches_oracle("empty_voxel", FieldConfig { empty_voxel: true, ..plain_config() }, 1);
    assert_matches_oracle(
        "static_mlp over empty_voxel",
        FieldConfig { static_mlp: true, empty_voxel: true, ..plain_config() },
        1,
    );
    assert_matches_oracle("grid_pe", FieldConfig { grid_pe: 3, ..plain_config() }, 1);
    assert_matches_oracle("grid_pe of 1 has no effect", FieldConfig { grid_pe: 1, ..plain_config() }, 1);
    assert_matches_oracle("no_grid", FieldConfig { no_grid: true, ..plain_config() }, 1);
    assert_matches_oracle(
        "apply_rotation",
        FieldConfig { apply_rotation: true, static_mlp: true, ..plain_config() },
        1,
    );
    assert_matches_oracle(
        "everything",
        FieldConfig { apply_rotation: true, static_mlp: true, grid_pe: 2, ..plain_config() },
        3,
    );
}

#[test]
fn every_trunk_depth_matches_the_f64_oracle() {
    for depth in [1, 2, 4] {
        assert_matches_oracle(&format!("depth {depth}"), plain_config(), depth);
    }
}

#[test]
fn attributes_without_a_head_are_raw_and_unmasked() {
    for column in Attributes::all().iter() {
        let config = FieldConfig {
            deformed_attributes: Attributes::all().difference(column),
            static_mlp: true,
            ..plain_config()
        };
        assert_matches_oracle(&format!("without {}", column.name()), config, 1);
    }
    assert_matches_oracle(
        "no head at all",
        FieldConfig { deformed_attributes: Attributes::empty(), ..plain_config() },
        1,
    );
}

#[test]
fn states_do_not_depend_on_block_or_requested_attributes() {
    let config = FieldConfig { static_mlp: true, ..plain_config() };
    let field = build(&config, 2);
    let raw = random_gaussians(1100);
    let (all, _) = states(&field, &raw, 0.6, Attributes::all());
    for (start, len) in [(0, 1), (3, 7), (255, 2), (250, 513), (1099, 1)] {
        let mut part = Gaussians::zeros(len, 3);
        for column in Attributes::all().iter() {
            for c in 0..raw.attribute_values(column).width() {
                part.attribute_values_mut(column)
                    .plane_mut(c)
                    .copy_from_slice(&raw.attribute_values(column).plane(c)[start..start + len]);
            }
        }
        for want in
            [Attributes::all(), Attributes::POSITION, Attributes::OPACITY | Attributes::SH, Attributes::ROTATION]
        {
            let (state, _) = states(&field, &part, 0.6, want);
            for column in want.iter() {
                for c in 0..state.attribute_values(column).width() {
                    for i in 0..len {
                        let (got, expected) = (
                            state.attribute_values(column).plane(c)[i],
                            all.attribute_values(column).plane(c)[start + i],
                        );
                        assert_eq!(
                            got.to_bits(),
                            expected.to_bits(),
                            "{} component {c} of Gaussian {} in a block of {len}: got {got}, expected {expected}",
                            column.name(),
                            start + i
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn invert_is_the_inverse_of_apply() {
    for apply_rotation in [false, true] {
        let field = build(&FieldConfig { static_mlp: true, apply_rotation, ..plain_config() }, 1);
        let raw = random_gaussians(50);
        let (state, deltas) = states(&field, &raw, 0.4, Attributes::all());
        let mask = deltas.mask.as_ref().unwrap();
        let mut solved = Gaussians::zeros(0, 3);
        deltas.invert(&state, Attributes::all(), &mut solved);
        let mut again = Gaussians::zeros(0, 3);
        deltas.apply(&solved, Attributes::all(), &mut again);
        for column in Attributes::all().iter() {
            for (i, mask) in mask.iter().enumerate() {
                let (got, expected) =
                    (values(again.attribute_values(column), i), values(state.attribute_values(column), i));
                for (got, expected) in got.into_iter().zip(expected) {
                    let tolerance = 1e-5 * (1.0 + expected.abs());
                    assert!(
                        (got - expected).abs() <= tolerance,
                        "{} of Gaussian {i}, mask {}: got {got}, expected {expected}, tolerance {tolerance}",
                        column.name(),
                        mask
                    );
                }
            }
        }
    }
}

#[test]
fn nan_position_affects_no_other_gaussian() {
    let field = build(&FieldConfig { empty_voxel: true, ..plain_config() }, 1);
    let raw = random_gaussians(20);
    let (clean, _) = states(&field, &raw, 0.5, Attributes::all());
    let mut broken = raw.clone();
    for (i, value) in [(4, f32::NAN), (5, f32::INFINITY), (6, f32::NEG_INFINITY), (7, f32::MAX)] {
        broken.position.set_row(i, [value; 3]);
    }
    let (state, _) = states(&field, &broken, 0.5, Attributes::all());
    assert!(state.position.row::<3>(4).iter().all(|x| x.is_nan()) && state.opacity_logit.row::<1>(4)[0].is_nan());
    for i in (0..20).filter(|i| !(4..8).contains(i)) {
        assert_eq!(state.position.row::<3>(i), clean.position.row::<3>(i), "Gaussian {i}");
    }
}

#[test]
fn a_zero_quaternion_product_stays_zero() {
    let field = build(&FieldConfig { apply_rotation: true, ..plain_config() }, 1);
    let mut raw = random_gaussians(3);
    raw.rotation.set_row(1, [0.0; 4]);
    assert_eq!(states(&field, &raw, 0.5, Attributes::all()).0.rotation.row::<4>(1), [0.0; 4]);
}

#[test]
fn an_empty_block_is_empty() {
    let field = build(&plain_config(), 1);
    assert!(states(&field, &Gaussians::zeros(0, 3), 0.5, Attributes::all()).0.is_empty());
    let none = Gaussians::zeros(0, 3);
    let empty = field.jacobian(&none, &field.prepare_with_slopes(&none.position), 0.5, Attributes::POSITION).unwrap();
    assert!(empty.derivative(Attributes::POSITION).is_empty());
}

#[test]
fn jacobian_of_a_block_without_slopes_is_an_error() {
    let (field, some) = (build(&plain_config(), 1), random_gaussians(3));
    assert!(field.jacobian(&some, &field.prepare(&some.position), 0.5, Attributes::POSITION).is_err());
}

/// Returns the error message of building a field from tensors that `change` has altered.
fn field_error(config: FieldConfig, change: impl FnOnce(&mut Tensors)) -> String {
    let mut tensors = random_tensors(&config, 1);
    change(&mut tensors);
    Field::new(&tensors, config, 3, Path::new("synthetic.pth")).expect_err("must be refused").to_string()
}

/// Asserts that `message` contains all texts in `parts`.
fn assert_contains(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "expected {part:?} in: {message}");
    }
}

#[test]
fn missing_tensor_is_named_with_its_flag() {
    let name = "deformation_net.opacity_deform.3.bias";
    let message = field_error(plain_config(), |tensors| drop(tensors.remove(name)));
    assert_contains(&message, &["synthetic.pth", name, "no_do=False", "none"]);
    let message = field_error(FieldConfig { empty_voxel: true, ..plain_config() }, |tensors| {
        drop(tensors.remove("deformation_net.empty_voxel.grid"));
    });
    assert_contains(&message, &["empty_voxel.grid", "empty_voxel=True"]);
    assert_contains(&field_error(plain_config(), Tensors::clear), &["deformation_net.grid.aabb"]);
}

#[test]
fn wrong_tensor_shape_is_named_with_both_shapes() {
    let reshape = |name: &'static str, shape: Vec<usize>| {
        field_error(plain_config(), move |tensors| {
            let data = vec![0.0; shape.iter().product()];
            tensors.insert(format!("deformation_net.{name}"), Tensor { shape, data });
        })
    };
    assert_contains(&reshape("pos_deform.3.weight", vec![4, 22]), &["pos_deform.3.weight", "[3, 22]", "[4, 22]"]);
    assert_contains(&reshape("feature_out.0.weight", vec![22, 11]), &["feature_out.0.weight", "[any, 10]", "[22, 11]"]);
    assert_contains(&reshape("feature_out.2.weight", vec![22, 25]), &["feature_out.2.weight", "[22, 22]", "[22, 25]"]);
    assert_contains(
        &reshape("grid.grids.1.3", vec![1, 6, 4, 4]),
        &["grid.grids.1.3", "[1, 5, any, any]", "[1, 6, 4, 4]"],
    );
    assert_contains(&reshape("grid.grids.0.0", vec![1, 5, 0, 4]), &["grid.grids.0.0", "[1, 5, 0, 4]"]);
    assert_contains(&reshape("grid.aabb", vec![2, 3]), &["grid.aabb", "corners that differ"]);
}

#[test]
fn weights_that_are_not_finite_are_refused() {
    let message = field_error(plain_config(), |tensors| {
        tensors.get_mut("deformation_net.feature_out.0.weight").unwrap().data[17] = f32::NAN;
    });
    assert_contains(&message, &["feature_out.0.weight", "finite", "NaN at element 17"]);
}

#[test]
fn unused_tensors_may_have_any_content() {
    let config = FieldConfig { deformed_attributes: Attributes::POSITION, ..plain_config() };
    let mut tensors = random_tensors(&config, 1);
    tensors.insert("timenet.0.weight".into(), Tensor { shape: vec![1], data: vec![f32::NAN] });
    tensors.insert("deformation_net.shs_deform.1.weight".into(), Tensor { shape: vec![], data: vec![f32::NAN] });
    Field::new(&tensors, config, 3, Path::new("synthetic.pth")).unwrap();
}

#[test]
fn times_that_are_not_finite_are_refused() {
    let field = build(&plain_config(), 1);
    let prepared = field.prepare(&random_gaussians(1).position);
    let error = field
        .deltas(&prepared, f64::NAN, Attributes::all(), &mut LayerBuffers::default(), &mut Deltas::new(3))
        .expect_err("must be refused");
    assert_contains(&error.to_string(), &["NaN"]);
}

/// Returns the values of the attribute `column` for writing.
fn column_mut(parameters: &mut Parameters, column: Attributes) -> &mut Vec<f64> {
    match column {
        Attributes::POSITION => &mut parameters.position,
        Attributes::ROTATION => &mut parameters.rotation,
        Attributes::LOG_SCALE => &mut parameters.log_scale,
        Attributes::OPACITY => &mut parameters.opacity_logit,
        _ => &mut parameters.sh,
    }
}

/// Returns derivatives ∂L/∂state of a loss for `len` Gaussians, random for the attributes `columns` and 0 for the
/// others.
fn noisy_gradients(len: usize, columns: Attributes) -> Gradients {
    let mut noise = Noise(5);
    let mut gradients = Gradients::new(len, Attributes::all(), 3);
    for column in columns.iter() {
        gradients.derivatives_mut(column).planes_mut().iter_mut().for_each(|x| *x = noise.next());
    }
    gradients
}

/// Converts `gradients` by the chain rule: from derivatives with respect to the attributes at `time` to derivatives
/// with respect to the stored attributes `raw`.
fn pulled_back(field: &Field, raw: &Gaussians, time: f64, gradients: &Gradients) -> Gradients {
    let mut pulled = gradients.clone();
    field
        .jacobian(raw, &field.prepare_with_slopes(&raw.position), time, gradients.attributes())
        .unwrap()
        .pull_back(&mut pulled);
    pulled
}

/// Asserts, for each of the attributes `columns`, that derivatives with respect to its stored values match finite
/// differences of the f64 reference (oracle). The field has the options `config` and `depth` layers in its trunk.
/// `what` names the tested case in failures.
fn assert_derivatives_match_oracle(what: &str, config: FieldConfig, depth: usize, columns: Attributes) {
    let tensors = random_tensors(&config, depth);
    let oracle = Oracle { tensors: &tensors, config: &config };
    let (field, raw) = (build(&config, depth), random_gaussians(40));
    let mut clipped = 0;
    for (column, time) in columns.iter().flat_map(|column| [(column, 0.0), (column, 0.37)]) {
        let by_state = noisy_gradients(raw.len(), column);
        let by_raw = pulled_back(&field, &raw, time, &by_state);
        for i in 0..raw.len() {
            let weights = values(by_state.derivatives(column), i);
            for c in 0..raw.attribute_values(column).width() {
                let value = |step: f64| -> f64 {
                    let mut nudged = Parameters::from_row(&raw, i);
                    column_mut(&mut nudged, column)[c] += step;
                    let mut state = oracle.state(&nudged, time);
                    column_mut(&mut state, column).iter().zip(&weights).map(|(x, w)| x * w).sum()
                };
                let step = 1e-7;
                let expected = (value(step) - value(-step)) / (2.0 * step);
                let got = f64::from(by_raw.derivatives(column).plane(c)[i]);
                // Allows for f32 rounding in about a hundred sums. A wrong axis, mask or order causes an error of 0.1.
                // A kink of a ReLU or of a plane within the step of the finite difference would also fail; the fixed
                // random data has none.
                let tolerance = 1e-4 * (1.0 + expected.abs());
                assert!(
                    (got - expected).abs() <= tolerance,
                    "{what}, {} {c} of Gaussian {i} at {time}: got {got}, expected {expected} ± {tolerance}",
                    column.name()
                );
                clipped += usize::from(column == Attributes::POSITION && got == weights[c] && got != 0.0);
            }
        }
    }
    let planes = columns.contains(Attributes::POSITION)
        && !config.no_grid
        && config.deformed_attributes.contains(Attributes::POSITION);
    assert!(!planes || clipped > 10, "{what}: only {clipped} coordinates lie outside the box");
}

#[test]
fn derivatives_match_finite_differences_for_every_flag() {
    let all = Attributes::all();
    assert_derivatives_match_oracle("plain", plain_config(), 1, all);
    assert_derivatives_match_oracle("depth 3", plain_config(), 3, Attributes::POSITION);
    assert_derivatives_match_oracle("grid_pe", FieldConfig { grid_pe: 3, ..plain_config() }, 2, Attributes::POSITION);
    assert_derivatives_match_oracle(
        "no_grid",
        FieldConfig { no_grid: true, ..plain_config() },
        2,
        Attributes::POSITION,
    );
    assert_derivatives_match_oracle("apply_rotation", FieldConfig { apply_rotation: true, ..plain_config() }, 1, all);
    let fixed =
        FieldConfig { deformed_attributes: all.difference(Attributes::POSITION | Attributes::SH), ..plain_config() };
    assert_derivatives_match_oracle("without two heads", fixed, 1, all);
    // If the field has a mask, the Jacobian of positions neglects the derivative of the deltas, so positions are not
    // tested.
    let masked = all.difference(Attributes::POSITION);
    assert_derivatives_match_oracle(
        "static_mlp",
        FieldConfig { static_mlp: true, apply_rotation: true, ..plain_config() },
        1,
        masked,
    );
    assert_derivatives_match_oracle("empty_voxel", FieldConfig { empty_voxel: true, ..plain_config() }, 1, masked);
}

#[test]
fn derivative_of_masked_positions_is_the_mask() {
    let field = build(&FieldConfig { empty_voxel: true, ..plain_config() }, 1);
    let raw = random_gaussians(40);
    let (_, deltas) = states(&field, &raw, 0.3, Attributes::all());
    let by_state = noisy_gradients(raw.len(), Attributes::POSITION);
    let by_raw = pulled_back(&field, &raw, 0.3, &by_state);
    for (i, mask) in deltas.mask.unwrap().into_iter().enumerate() {
        let expected = by_state.derivatives(Attributes::POSITION).row::<3>(i).map(|x| mask * x);
        assert_eq!(by_raw.derivatives(Attributes::POSITION).row(i), expected, "Gaussian {i}");
    }
}

#[test]
fn derivatives_do_not_depend_on_blocks() {
    let field = build(&FieldConfig { apply_rotation: true, ..plain_config() }, 2);
    let raw = random_gaussians(300);
    let whole = field.jacobian(&raw, &field.prepare_with_slopes(&raw.position), 0.6, Attributes::all()).unwrap();
    for block in [1, 16, 37] {
        let rows: Vec<u32> = (0..300).collect();
        for ids in rows.chunks(block) {
            let raw = raw.pick(ids);
            let found =
                field.jacobian(&raw, &field.prepare_with_slopes(&raw.position), 0.6, Attributes::all()).unwrap();
            assert!(found == whole.pick(ids), "blocks of {block}");
        }
    }
    assert!(
        field.jacobian(&raw, &field.prepare_with_slopes(&raw.position), 0.6, Attributes::SH).unwrap()
            == Default::default()
    );
}

#[test]
fn derivatives_at_extreme_positions_are_finite() {
    for config in [plain_config(), FieldConfig { apply_rotation: true, static_mlp: true, ..plain_config() }] {
        let field = build(&config, 1);
        let mut raw = random_gaussians(8);
        for (i, value) in [f32::NAN, f32::INFINITY, f32::MAX, 0.0].into_iter().enumerate() {
            raw.position.set_row(i, [value; 3]);
            raw.rotation.set_row(i, [0.0; 4]);
        }
        let by_raw = pulled_back(&field, &raw, 0.6, &noisy_gradients(8, Attributes::all()));
        for column in Attributes::all().iter() {
            assert!(by_raw.derivatives(column).planes().iter().all(|x| x.is_finite()), "{}", column.name());
        }
    }
}
