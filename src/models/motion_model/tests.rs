use super::*;
use crate::compressed_model::{Cluster, ParamDelta, ReferenceFrame};
use crate::model::Gaussians;
use crate::passes::{gather, gather_all};
use crate::recipe::Recipe;

/// Motion model x(t) = x + v·t with velocities in format-specific parameters 0–2 and a fading rate in parameter 3.
#[derive(Debug)]
struct Straight;

impl MotionModel for Straight {
    type Prepared = Vec<f32>;

    fn prepare(&self, raw: &StoredParams) -> Vec<f32> {
        raw.format_specific.plane(3).to_vec()
    }

    fn varying(&self) -> Attributes {
        Attributes::POSITION | Attributes::OPACITY
    }

    fn movable(&self) -> Attributes {
        Attributes::POSITION
    }

    fn state(
        &self,
        time: f64,
        raw: &StoredParams,
        fading: &Vec<f32>,
        want: Attributes,
        out: &mut Gaussians,
    ) -> Result<()> {
        for column in want.iter() {
            *out.attribute_values_mut(column) = raw.gaussians.attribute_values(column).clone();
        }
        if want.contains(Attributes::POSITION) {
            for c in 0..3 {
                let velocity = raw.format_specific.plane(c);
                out.position.plane_mut(c).iter_mut().zip(velocity).for_each(|(x, v)| *x += v * time as f32);
            }
        }
        if want.contains(Attributes::OPACITY) {
            out.opacity_logit.plane_mut(0).iter_mut().zip(fading).for_each(|(o, f)| *o -= f * time as f32);
        }
        Ok(())
    }
}

/// Builds a model of more than two blocks of Gaussians, each with different values.
fn model() -> MotionModelFrames<Straight> {
    let count = 2 * GAUSSIANS_PER_BLOCK + 77;
    let mut raw =
        StoredParams { gaussians: Gaussians::zeros(count, 0), format_specific: AttributeValues::zeros(4, count) };
    let noise = |column: &mut AttributeValues, step: f32| {
        column.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = (k as f32 * step).fract());
    };
    raw.gaussians.selected_attribute_values_mut(Attributes::all()).for_each(|column| noise(column, 0.618_034));
    noise(&mut raw.format_specific, 0.754_878);
    MotionModelFrames::new(Straight, raw, 0).with_times(vec![0.0, 0.5, 2.0]).unwrap()
}

#[test]
fn every_reader_returns_the_same_bits() {
    let model = model();
    let all = gather_all(&model, 2, Attributes::all()).unwrap();
    let ids: Vec<u32> = (0..model.info().count as u32).rev().step_by(2).collect();
    let mut some = Gaussians::zeros(0, 0);
    model.open(Ids::List(&ids)).unwrap().read(2, Attributes::all(), &mut some).unwrap();
    assert_eq!(some, all.pick(&ids));
    assert_eq!(gather(&model, &ids, 2, Attributes::all()).unwrap(), some);
    let mut stored = Gaussians::zeros(0, 0);
    model.with_params(model.stored()).state(2, Attributes::all(), &mut stored).unwrap();
    assert_eq!(stored, all);
    let id = GAUSSIANS_PER_BLOCK + 5;
    let [x, v] = [model.raw().gaussians.position.row::<3>(id), model.raw().format_specific.row::<3>(id)];
    assert_eq!(all.position.row(id), [x[0] + 2.0 * v[0], x[1] + 2.0 * v[1], x[2] + 2.0 * v[2]]);
    assert!(
        model.open(Ids::Range(0..model.info().count + 1)).is_err() && gather_all(&model, 3, Attributes::SH).is_err()
    );
}

#[test]
fn compressed_model_has_survivors_proxies_and_deltas() {
    let (model, rule) = (model(), Recipe::preset("default").unwrap().merge);
    let mut compressed = CompressedModel::pruned(vec![3, 8, 11], &rule);
    compressed.clusters.push(Cluster { output: 1, leader: 8, members: vec![(8, 0.5), (9, 0.5)] });
    compressed.proxies.raw = Some(model.raw().pick(&[20]));
    let mut by = Gaussians { position: AttributeValues::zeros(3, 3), ..Gaussians::default() };
    by.position.set_row(2, [1.0, 0.0, 0.0]);
    compressed.delta = ParamDelta(by);
    let reduced = model.compressed_frames(&compressed);
    let mut expected = model.raw().pick(&[3, 20, 11]);
    expected.gaussians.position.plane_mut(0)[2] += 1.0;
    assert_eq!(reduced.raw(), &expected);
    assert_eq!((reduced.info().count, &reduced.info().times), (3, &model.info().times));
}

#[test]
fn proxies_that_drift_at_any_frame_are_refused() {
    let (model, mut rule) = (model(), Recipe::preset("default").unwrap().merge);
    rule.max_drift = 0.1;
    let reference = ReferenceFrame { frame: 0, extent: 1.0 };
    let drift = 0.1 * rule.length_unit.in_scene_units(1.0);
    // Each cluster has a single member, so the expected result is known.
    let cluster = |output: u32, id: u32| Cluster { output, leader: id, members: vec![(id, 1.0)] };
    let clusters: Vec<Cluster> = (0..4).map(|k| cluster(k, 10 * k + 1)).collect();
    let ids: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
    let proposed = |change: fn(&mut StoredParams, f64)| {
        let mut raw = model.raw().pick(&ids);
        change(&mut raw, drift);
        propose_proxies(&model, &clusters, reference, &rule, |_| Ok(raw)).unwrap()
    };
    let as_is = proposed(|_, _| ());
    assert!(as_is.refused.is_empty() && as_is.notes.is_empty() && as_is.deviation.unwrap() < 1e-5);
    // Proxy 0 is too fast and drifts too far at the last frame only; 1 drifts within the limit; 2 has no finite
    // position; 3 fades too fast.
    let off = proposed(|raw, drift| {
        raw.format_specific.plane_mut(0)[0] += 0.6 * drift as f32;
        raw.format_specific.plane_mut(0)[1] += 0.4 * drift as f32;
        raw.gaussians.position.plane_mut(1)[2] = f32::NAN;
        raw.format_specific.plane_mut(3)[3] += 1.0;
    });
    assert_eq!(off.refused, [0, 2, 3]);
    assert!((off.deviation.unwrap() / drift - 0.8).abs() < 1e-3, "{:?} of {drift}", off.deviation);
    assert_eq!(off.notes.len(), 1);
}
