//! SC-GS as a model format: canonical Gaussians that follow a few control nodes, which a network of position and time
//! moves.
//!
//! At time t, the network's outputs for the nodes nearest to a Gaussian are summed with its node weights ([`Nodes`])
//! and multiplied by its motion mask, the logistic function σ of its last feature (1 without a mask). Then the position
//! is xyz + warp; the scale is exp(scale) + d_scaling, of which only the square matters; the rotation is rot +
//! d_rotation with the stored rot, normalized afterwards. If the network predicts them, the opacity is σ(opacity) +
//! d_opacity, and a color is added to the SH coefficients of degree 0. With `deform_type='mlp'` there are neither nodes
//! nor mask, and the network is evaluated at each Gaussian. Source: Huang et al., "SC-GS: Sparse-Controlled Gaussian
//! Splatting for Editable Dynamic Scenes", 2024, and its public code.

mod nodes;

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use super::cfg_args::Arguments;
use super::deform_folder::{
    DeformFolder, MIN_SCALE, ModelParts, NetworkMotionModel, has_network, network_tensor_names,
};
use crate::deform::{EncodedPositions, Network, PredictedMotion};
use crate::error::{Error, Result, quoted};
use crate::model::exp_log::{exp, ln};
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian, StoredParams, logit, opacity};
use crate::models::motion_model::{MotionModel, copy_stored};
use crate::models::opened::InputFormat;
use nodes::Nodes;

/// Model format of SC-GS: recognizes and opens a model folder. A key of its configuration, or control nodes among its
/// tensors, distinguish it from Deformable-3D-Gaussians.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| {
        let typed = || {
            let arguments = Arguments::read(&found.path.join("cfg_args")).ok();
            arguments.is_some_and(|arguments| arguments.get("deform_type").string().is_ok_and(|kind| kind.is_some()))
        };
        found.is_folder
            && has_network(found.path)
            && (typed() || network_tensor_names(found.path, found.memory).iter().any(|name| name == "nodes"))
    },
    open: |path, options| DeformFolder::open(path, options, &ENTRY, NodeMotion::new),
};

/// Maximum bytes of cached network outputs; each output is for all control nodes at one time.
const MAX_CACHE_BYTES: usize = 16 << 20;
/// Maximum absolute value of a log scale; Gaussians beyond it are too small or too large to be drawn.
const MAX_LOG_SCALE: f64 = 600.0;
/// Maximum absolute value of the logit of an opacity that the network changes.
const MAX_LOGIT: f64 = 40.0;

/// Motion model of SC-GS: a network that moves control nodes, or Gaussians directly.
#[derive(Debug)]
struct NodeMotion {
    network: Network,
    /// Control nodes; `None` if the network moves each Gaussian directly.
    nodes: Option<CachedNodes>,
}

/// Control nodes of a model, and network outputs for them that were computed before.
#[derive(Debug)]
struct CachedNodes {
    nodes: Nodes,
    /// Canonical positions of the control nodes, encoded as input of the network.
    encoded: EncodedPositions,
    /// Whether the last feature of a Gaussian is its motion mask (logit of a factor on its motion).
    has_mask: bool,
    /// Network outputs for all control nodes at the last requested times, oldest first. The key is the f32 bits of the
    /// time.
    cache: Mutex<VecDeque<(u32, Arc<PredictedMotion>)>>,
}

/// Time-independent values of a block of consecutive Gaussians, computed once and used for every frame.
enum PreparedNodes {
    /// For each Gaussian the K control nodes that move it: index of the node, and its weight multiplied by the motion
    /// mask (factor from 0 to 1 on the motion of the Gaussian).
    Shares(Vec<(u32, f64)>),
    /// Positions encoded as input of the network, for a model without control nodes.
    Encoded(EncodedPositions),
}

impl NodeMotion {
    /// Creates the motion model from the network and its nodes, and returns notes for the user. Fails for training
    /// options whose models are not supported.
    fn new(parts: &ModelParts<'_>) -> Result<(NodeMotion, Vec<String>)> {
        let arguments = parts.arguments;
        let refuse = |key: &'static str, found: &str| {
            Error::input(arguments.path(), format!("key {key}"), "the default setting of SC-GS", found).hint(
                "export the Gaussians of each frame as a PLY with the model's own code, and give the folder of \
                       these files",
            )
        };
        for key in ["skinning", "use_hash", "local_frame", "progressive_brand_time"] {
            if arguments.get(key).bool(false)? {
                return Err(refuse(key, "True, which is not supported"));
            }
        }
        if !arguments.get("d_rot_as_res").bool(true)? {
            return Err(refuse("d_rot_as_res", "False, which is not supported"));
        }
        let largest = arguments.get("max_d_scale").float(-1.0)?;
        if largest > 0.0 {
            return Err(refuse("max_d_scale", &format!("{largest}, a limit of scales, which is not supported")));
        }
        let kind = arguments.get("deform_type").string()?;
        let has_nodes = parts.tensors.contains_key("nodes");
        match kind.as_deref() {
            Some("node") | None if has_nodes => (),
            Some("mlp") if !has_nodes => (),
            Some(kind @ ("node" | "mlp")) => {
                let found = format!("deform_type = '{kind}'");
                let expected = match has_nodes {
                    true => "deform_type = 'node', since the file has nodes",
                    false => "deform_type = 'mlp', since the file has no nodes",
                };
                return Err(Error::input(parts.file, "tensor nodes", expected, found));
            }
            kind => {
                return Err(refuse(
                    "deform_type",
                    &format!("{}, which is not supported", quoted(kind.unwrap_or_default())),
                ));
            }
        }
        let prefix = if has_nodes { "network." } else { "" };
        // Other color heads have inner layers, and nodes with local frames have a rotation head; neither is supported.
        for inner in ["gaussian_color.0.weight", "gaussian_color.layers.0.weight", "local_rotation.weight"] {
            let name = format!("{prefix}{inner}");
            if parts.tensors.contains_key(&name) {
                return Err(Error::input(
                    parts.file,
                    format!("tensor {name}"),
                    "no such tensor, as in networks with default settings",
                    "a tensor",
                )
                .hint(
                    "export the Gaussians of each frame as a PLY with the model's own code, and give the folder of \
                       these files",
                ));
            }
        }
        let network = Network::new(parts.tensors, prefix, parts.file)?;
        let mut notes = Vec::new();
        if !has_nodes {
            return Ok((NodeMotion { network, nodes: None }, notes));
        }
        let nearest = arguments.get("K").int(3)?;
        let Some(nearest) = usize::try_from(nearest).ok().filter(|&nearest| nearest > 0) else {
            return Err(Error::input(arguments.path(), "key K", "at least 1", nearest.to_string()));
        };
        let nodes = Nodes::new(parts.tensors, nearest, parts.file)?;
        let has_mask = match parts.features.checked_sub(nodes.features()) {
            Some(more @ (0 | 1)) => more == 1,
            _ => {
                let expected =
                    format!("{} properties fea_* (as many as nodes have), or one more for a mask", nodes.features());
                return Err(Error::input(parts.cloud, "element vertex", expected, parts.features.to_string()));
            }
        };
        if arguments.get("gs_with_motion_mask").bool(has_mask)? != has_mask {
            let actual = if has_mask { "has one" } else { "has none" };
            notes.push(format!(
                "cfg_args contradicts the point cloud file about a motion mask: the file {actual} and is used"
            ));
        }
        let encoded = network.encode(&nodes.position());
        let nodes = CachedNodes { nodes, encoded, has_mask, cache: Mutex::default() };
        Ok((NodeMotion { network, nodes: Some(nodes) }, notes))
    }
}

impl CachedNodes {
    /// Returns the motion mask (factor on the motion) of the Gaussian in row `row`: σ (logistic function) of its last
    /// feature; 1 without a mask.
    fn mask(&self, raw: &StoredParams, row: usize) -> f64 {
        if self.has_mask { opacity(raw.format_specific.plane(self.nodes.features())[row]) } else { 1.0 }
    }

    /// Returns the network's output for all control nodes at `time`. All blocks of Gaussians use the same output, so it
    /// is cached. Two threads that compute the output for the same time get equal values.
    fn motion(&self, network: &Network, time: f64) -> Result<Arc<PredictedMotion>> {
        let key = (time as f32).to_bits();
        let cache = || self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, found)) = cache().iter().find(|(of, _)| *of == key) {
            return Ok(Arc::clone(found));
        }
        let mut motion = PredictedMotion::default();
        network.motion(&self.encoded, time, Attributes::all(), &mut motion)?;
        let motion = Arc::new(motion);
        let mut cache = cache();
        if !cache.iter().any(|(of, _)| *of == key) {
            if cache.len() >= self.max_cached() {
                cache.pop_front();
            }
            cache.push_back((key, Arc::clone(&motion)));
        }
        Ok(motion)
    }

    /// Returns the maximum number of times for which network outputs are cached.
    fn max_cached(&self) -> usize {
        (MAX_CACHE_BYTES / (4 * 14 * self.nodes.len())).max(2)
    }
}

/// Returns for each Gaussian the weighted sum of the network's outputs for the control nodes that move it. `output` has
/// one row per node. `shares` holds (node index, weight) pairs, Gaussian by Gaussian; each Gaussian has `each` pairs.
fn blend(output: &AttributeValues, shares: &[(u32, f64)], each: usize) -> AttributeValues {
    let mut out = AttributeValues::zeros(output.width(), shares.len() / each.max(1));
    for c in 0..output.width() {
        let plane = output.plane(c);
        for (out, shares) in out.plane_mut(c).iter_mut().zip(shares.chunks_exact(each)) {
            *out = shares.iter().map(|&(node, share)| share * f64::from(plane[node as usize])).sum::<f64>() as f32;
        }
    }
    out
}

impl NodeMotion {
    /// Returns the network's outputs at `time` for the block of Gaussians from which `prepared` was computed. Computes
    /// only the outputs on which the attributes `want` depend.
    fn motion(&self, time: f64, prepared: &PreparedNodes, want: Attributes) -> Result<PredictedMotion> {
        let (mut motion, want) = (PredictedMotion::default(), want & self.network.deformed_attributes());
        match (prepared, &self.nodes) {
            _ if want.is_empty() => (),
            (PreparedNodes::Encoded(encoded), _) => self.network.motion(encoded, time, want, &mut motion)?,
            (PreparedNodes::Shares(shares), Some(sparse)) => {
                let (of_nodes, each) = (sparse.motion(&self.network, time)?, sparse.nodes.nearest());
                let blended = |column: Attributes, output: &AttributeValues| match want.contains(column) {
                    true => blend(output, shares, each),
                    false => AttributeValues::default(),
                };
                motion = PredictedMotion {
                    warp: blended(Attributes::POSITION, &of_nodes.warp),
                    rotation: blended(Attributes::ROTATION, &of_nodes.rotation),
                    scaling: blended(Attributes::LOG_SCALE, &of_nodes.scaling),
                    opacity: blended(Attributes::OPACITY, &of_nodes.opacity),
                    color: blended(Attributes::SH, &of_nodes.color),
                };
            }
            (PreparedNodes::Shares(_), None) => {
                return Err(Error::internal("a block prepared by another motion model was given"));
            }
        }
        Ok(motion)
    }
}

impl MotionModel for NodeMotion {
    type Prepared = PreparedNodes;

    fn prepare(&self, raw: &StoredParams) -> PreparedNodes {
        let Some(sparse) = &self.nodes else {
            return PreparedNodes::Encoded(self.network.encode(&raw.gaussians.position));
        };
        let (mut all, mut found) = (Vec::with_capacity(raw.len() * sparse.nodes.nearest()), Vec::new());
        for row in 0..raw.len() {
            found.clear();
            sparse.nodes.shares(raw, row, &mut found);
            let mask = sparse.mask(raw, row);
            all.extend(found.iter().map(|share| (share.node, mask * share.weight)));
        }
        PreparedNodes::Shares(all)
    }

    fn varying(&self) -> Attributes {
        self.network.deformed_attributes()
    }

    fn movable(&self) -> Attributes {
        Attributes::all()
    }

    #[inline(always)]
    fn state(
        &self,
        time: f64,
        raw: &StoredParams,
        prepared: &PreparedNodes,
        want: Attributes,
        out: &mut Gaussians,
    ) -> Result<()> {
        let motion = self.motion(time, prepared, want)?;
        copy_stored(raw, want, out);
        for column in want.iter() {
            let to = out.attribute_values_mut(column);
            match column {
                Attributes::POSITION => add_planes(&motion.warp, to),
                Attributes::ROTATION => add_planes(&motion.rotation, to),
                Attributes::LOG_SCALE => update_each(&motion.scaling, to, |log, by| {
                    let log = f64::from(log);
                    let log = if log > MAX_LOG_SCALE { MAX_LOG_SCALE } else { log };
                    let log = if log < -MAX_LOG_SCALE { -MAX_LOG_SCALE } else { log };
                    ln((exp(log) + f64::from(by)).abs().max(MIN_SCALE)) as f32
                }),
                Attributes::OPACITY => update_each(&motion.opacity, to, |logit, by| add_to_opacity(logit, by) as f32),
                _ => add_planes(&motion.color, to),
            }
        }
        Ok(())
    }

    fn jacobian(&self, time: f64, raw: &StoredParams, prepared: &PreparedNodes, want: Attributes) -> Result<Jacobian> {
        let mut found = Jacobian::default();
        let motion = self.motion(time, prepared, want.difference(Attributes::POSITION))?;
        if want.contains(Attributes::POSITION) {
            *found.derivative_mut(Attributes::POSITION) = match &self.nodes {
                Some(sparse) => position_slopes(sparse, &self.network, raw, time)?,
                None => {
                    let mut slopes = self.network.warp_jacobian(&raw.gaussians.position, time)?;
                    (0..3).for_each(|c| slopes.plane_mut(4 * c).iter_mut().for_each(|slope| *slope += 1.0));
                    slopes
                }
            };
        }
        if want.contains(Attributes::LOG_SCALE) {
            // Each scale depends only on its own stored value.
            let mut out = AttributeValues::zeros(9, raw.len());
            for c in 0..3 {
                let pairs = raw.gaussians.log_scale.plane(c).iter().zip(motion.scaling.plane(c));
                for (out, (&log, &by)) in out.plane_mut(4 * c).iter_mut().zip(pairs) {
                    let (own, by) = (f64::from(log).exp(), f64::from(by));
                    *out = if (own + by).abs() > MIN_SCALE { (own / (own + by)) as f32 } else { 0.0 };
                }
            }
            *found.derivative_mut(Attributes::LOG_SCALE) = out;
        }
        if want.contains(Attributes::OPACITY) && !motion.opacity.is_empty() {
            let mut out = raw.gaussians.opacity_logit.clone();
            update_each(&motion.opacity, &mut out, |logit, by| {
                let (own, state) = (opacity(logit), add_to_opacity(logit, by));
                let whole = opacity(state as f32);
                if state.abs() < MAX_LOGIT { (own * (1.0 - own) / (whole * (1.0 - whole))) as f32 } else { 0.0 }
            });
            *found.derivative_mut(Attributes::OPACITY) = out;
        }
        Ok(found)
    }
}

/// Adds each plane of `by` (one component of all Gaussians) to the same plane of `to`. Does nothing if `by` is empty.
fn add_planes(by: &AttributeValues, to: &mut AttributeValues) {
    update_each(by, to, |value, by| value + by);
}

/// Replaces each value v of `to` by `f(v, b)`, where b is the value of `by` for the same component and Gaussian.
/// Components that `by` lacks stay unchanged.
#[inline(always)]
fn update_each(by: &AttributeValues, to: &mut AttributeValues, f: impl Fn(f32, f32) -> f32) {
    for c in 0..by.width().min(to.width()) {
        to.plane_mut(c).iter_mut().zip(by.plane(c)).for_each(|(value, &by)| *value = f(*value, by));
    }
}

/// Adds `by` to an opacity and returns the logit of the result. `stored` is the logit of the opacity before.
fn add_to_opacity(stored: f32, by: f32) -> f64 {
    let alpha = opacity(stored) + f64::from(by);
    logit(alpha.clamp(0.0, 1.0)).clamp(-MAX_LOGIT, MAX_LOGIT)
}

/// Returns the derivatives of the positions of the Gaussians `raw` at `time` with respect to their stored positions,
/// for a model whose Gaussians follow the control nodes `sparse`. The derivatives include the change of the node
/// weights with the position. Component 3i + k of a row is the derivative of coordinate i with respect to stored
/// coordinate k.
fn position_slopes(sparse: &CachedNodes, network: &Network, raw: &StoredParams, time: f64) -> Result<AttributeValues> {
    let motion = sparse.motion(network, time)?;
    let (mut out, mut shares) = (AttributeValues::zeros(9, raw.len()), Vec::new());
    for row in 0..raw.len() {
        shares.clear();
        sparse.nodes.shares(raw, row, &mut shares);
        let slopes = sparse.nodes.slopes(raw.gaussians.position.row::<3>(row), &shares);
        let mask = sparse.mask(raw, row);
        for i in 0..3 {
            for axis in 0..3 {
                let by = shares
                    .iter()
                    .zip(&slopes)
                    .map(|(share, slope)| slope[axis] * f64::from(motion.warp.plane(i)[share.node as usize]));
                let own = if i == axis { 1.0 } else { 0.0 };
                out.plane_mut(3 * i + axis)[row] = (own + mask * by.sum::<f64>()) as f32;
            }
        }
    }
    Ok(out)
}

impl NetworkMotionModel for NodeMotion {
    const KIND: &'static str = "SC-GS model";
    const NORMALIZES_ROTATION: bool = false;

    fn bytes_per_gaussian(&self) -> usize {
        match &self.nodes {
            Some(sparse) => size_of::<(u32, f64)>() * sparse.nodes.nearest(),
            None => Network::BYTES_PER_GAUSSIAN,
        }
    }

    fn bytes(&self) -> usize {
        self.nodes.as_ref().map_or(0, |sparse| MAX_CACHE_BYTES + Network::BYTES_PER_GAUSSIAN * sparse.nodes.len())
    }

    /// Returns the CPU seconds per state (one Gaussian at one frame), measured by `benches/families.rs`.
    fn seconds_per_state(&self) -> f64 {
        match &self.nodes {
            Some(_) => 2e-7,
            None => 1e-6 + 2e-11 * self.network.multiplications() as f64,
        }
    }
}
