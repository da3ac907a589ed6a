"""Checks of models that a network moves, as `Scene`, `GaussianModel.load_ply` and `DeformModel.load_weights` open them;
part of check_families.py.
"""

import ast
import math
import re
from pathlib import Path

from check_model_folder import fail, require, read_ply, read_pth, rest_of, at_lower_degree

WIDTH, DEPTH, PLACE = 256, 8, 63


def last_iteration(folder):
    """Returns the largest iteration, as `searchForMaxIteration` of the original does."""
    found = [int(f.name.split("_")[1]) for f in folder.iterdir() if re.fullmatch(r"iteration_\d+", f.name)]
    if not found:
        fail(f"{folder} has no iteration_K folder")
    return max(found)


def read_arguments(path):
    """Returns the arguments of the Namespace by name."""
    call = ast.parse(path.read_text().strip(), mode="eval").body
    return {key.arg: ast.literal_eval(key.value) for key in call.keywords}


def network_shapes(names, prefix, heads):
    """Returns names and shapes of a network; `names` tells whether it has a time network."""
    has_time_network = f"{prefix}timenet.0.weight" in names
    of_time = 30 if has_time_network else 21
    layers = {"timenet.0": (WIDTH, 13), "timenet.2": (30, WIDTH)} if has_time_network else {}
    for k in range(DEPTH):
        reads = PLACE + of_time if k == 0 else WIDTH + (PLACE + of_time if k == DEPTH // 2 + 1 else 0)
        layers[f"linear.{k}"] = (WIDTH, reads)
    layers.update({head: (outputs, WIDTH) for head, outputs in heads.items()})
    shapes = {}
    for name, shape in layers.items():
        shapes[f"{prefix}{name}.weight"], shapes[f"{prefix}{name}.bias"] = shape, shape[:1]
    return shapes


def check_network(model, prefix, heads, others):
    """Checks the state dict at `model` against its expected network. Returns the shapes of its tensors."""
    tensors, values = read_pth(model)
    shapes = {name: tensor.shape for name, tensor in tensors.items()}
    expected = network_shapes(shapes, prefix, heads(shapes))
    found = {name: shape for name, shape in shapes.items() if name not in others}
    require(found == expected, f"{len(found)} tensors of the network load strictly")
    require(all(math.isfinite(x) for of in values.values() for x in of), "every weight is finite")
    return shapes


def check_cloud(path, degree):
    """Checks the point cloud at `path`. Returns its properties and rows."""
    properties, rows = read_ply(path)
    names = [name for _, name in properties]
    rest = [name for name in names if name.startswith("f_rest_")]
    require(len(rest) == rest_of(degree), f"{len(rest)} f_rest for SH degree {degree}")
    needed = ["x", "y", "z", "opacity"] + [f"f_dc_{k}" for k in range(3)]
    needed += [f"scale_{k}" for k in range(3)] + [f"rot_{k}" for k in range(4)]
    require(all(name in names for name in needed), "every property that the loader reads")
    require(all(math.isfinite(x) for row in rows for x in row), f"{len(rows)} Gaussians, every value finite")
    return properties, rows


def check_against(original, arguments, network, properties, rows, k):
    """Checks everything that must equal the model at `original`."""
    before = read_arguments(original / "cfg_args")
    degree_before, degree = before.pop("sh_degree", 3), arguments.get("sh_degree", 3)
    same = {key: value for key, value in arguments.items() if key != "sh_degree"}
    require(same == before and degree <= degree_before, "cfg_args is unchanged but for a lower sh_degree")
    own = original / "deform" / f"iteration_{k}" / "deform.pth"
    require(own.read_bytes() == network.read_bytes(), "the network has the original's bytes")
    properties_before, rows_before = read_ply(original / "point_cloud" / f"iteration_{k}" / "point_cloud.ply")
    names_before = [name for _, name in properties_before]
    pairs = at_lower_degree(names_before, degree_before, degree)
    kinds = {name: kind for kind, name in properties_before}
    expected = [(kinds[was], name) for name, was in pairs]
    require(properties == expected, "properties with the original's names, order and types")
    require(len(rows) <= len(rows_before), f"{len(rows)} of {len(rows_before)} Gaussians")
    places = [names_before.index(was) for _, was in pairs]
    kept = {tuple(row[place] for place in places) for row in rows_before}
    print(f"{sum(row in kept for row in rows)} of {len(rows)} rows are the original's")


def open_folder(model):
    """Returns K, the arguments, and the paths of point cloud and network."""
    arguments = read_arguments(model / "cfg_args")
    k = last_iteration(model / "point_cloud")
    require(k == last_iteration(model / "deform"), f"cloud and network are of iteration {k}")
    cloud = model / "point_cloud" / f"iteration_{k}" / "point_cloud.ply"
    return k, arguments, cloud, model / "deform" / f"iteration_{k}" / "deform.pth"


def deformable_3d_gaussians(model, original):
    k, arguments, cloud, network = open_folder(model)

    def heads(names):
        position = {"branch_w": 3, "branch_v": 3} if "branch_w.weight" in names else {"gaussian_warp": 3}
        return {**position, "gaussian_rotation": 4, "gaussian_scaling": 3}

    shapes = check_network(network, "", heads, ())
    for key, name in (("is_blender", "timenet.0.weight"), ("is_6dof", "branch_w.weight")):
        require(arguments.get(key, False) == (name in shapes), f"{key} of cfg_args is that of the weights")
    properties, rows = check_cloud(cloud, arguments.get("sh_degree", 3))
    if original:
        check_against(original, arguments, network, properties, rows, k)


def sc_gs(model, original):
    k, arguments, cloud, network = open_folder(model)
    has_nodes = arguments.get("deform_type", "node") == "node"

    def heads(_):
        optional = {"gaussian_opacity": 1} if arguments.get("pred_opacity") else {}
        optional.update({"gaussian_color": 3} if arguments.get("pred_color") else {})
        return {"gaussian_warp": 3, "gaussian_scaling": 3, "gaussian_rotation": 4, **optional}

    others = ("nodes", "_node_radius", "_node_weight", "inited") if has_nodes else ()
    shapes = check_network(network, "network." if has_nodes else "", heads, others)
    properties, rows = check_cloud(cloud, arguments.get("sh_degree", 3))
    if has_nodes:
        count, width = shapes["nodes"]
        require(shapes["_node_radius"] == (count,) and shapes["_node_weight"] == (count, 1), f"{count} nodes")
        features = [name for _, name in properties if name.startswith("fea")]
        mask = 1 if arguments.get("gs_with_motion_mask") else 0
        told = f"{len(features)} fea_* for {width - 3} hyper dimensions, mask {mask}"
        require(len(features) == width - 3 + mask, told)
    if original:
        check_against(original, arguments, network, properties, rows, k)
