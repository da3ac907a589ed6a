#!/usr/bin/env python3
"""Checks that a compressed model opens like a model of its trainer in the trainer's own renderer.

    python3 scripts/check_families.py FAMILY MODEL [ORIGINAL]

Example: python3 scripts/check_families.py stg small output/my_model

FAMILY is one of the names below, MODEL the written result, and ORIGINAL the model it was made from; if ORIGINAL is
given, the two are compared. Needs only the standard library. If PyTorch is installed, the calls of the loader are tried
as well; otherwise the script says that they are not.

stg: a SpacetimeGaussians folder (lite or full), its PLY, or a .splatv, checked as `load_ply` and splaTV's viewer read
it
  - the PLY is binary little-endian and all float32; the number of properties with each prefix is what the loader
    expects, with no f_rest; every value is finite
  - point_cloud.pt of the full model has mlp1.weight [6, 12, 1, 1] and mlp2.weight [3, 6, 1, 1]
  - compared: the same properties in the same order, no more Gaussians; cfg_args, cameras.json and point_cloud.pt byte
    for byte
  - a .splatv: magic number, lengths, a camera, zeros after the last Gaussian, no NaN or infinite half

yang4d: a native 4D Gaussian Splatting checkpoint, or its folder, checked as `GaussianModel.restore` reads it
ftgs: a gsplat checkpoint of FreeTimeGS, or its folder, checked as `splats.load_state_dict` reads it
  - a zip archive of uncompressed files with their checksums; its pickle creates only tensors and containers
  - all shapes have the same number of Gaussians, also in optimizer state and statistics; every value is finite
  - compared: the same tree, types, devices and gradients; everything without rows equals the original, value by value

d3g, scgs: a Deformable-3D-Gaussians or SC-GS folder
  - point_cloud/iteration_K/point_cloud.ply and deform/iteration_K/deform.pth have the same largest K
  - the number of f_rest follows from the SH degree in cfg_args; every value is finite
  - the state dict fits a network strictly: names and shapes of every layer and head of its variant
  - scgs: nodes, radii and weights have the same number; so many fea_* as nodes have, and one more with a motion mask
  - compared: the bytes of the network, cfg_args (except for a lower sh_degree), properties in order, and rows that did
    not change

Exits 1 at the first violation.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import array
import collections
import json
import math
import pickle
import re
import struct
import sys
import zipfile
from pathlib import Path

from network_families import deformable_3d_gaussians, sc_gs

try:
    import torch
except ImportError:
    torch = None


def fail(message):
    print(f"FAILED: {message}")
    sys.exit(1)


def require(condition, message):
    """Ends the script with `message` if `condition` is false."""
    if not condition:
        fail(message)
    print(f"ok: {message}")


def iteration_folder(model):
    """Returns the folder that loaders open: the one with the largest iteration."""
    folders = [f for f in (model / "point_cloud").iterdir() if re.fullmatch(r"iteration_\d+", f.name)]
    if not folders:
        fail(f"{model}/point_cloud has no iteration_K folder")
    return max(folders, key=lambda f: int(f.name.split("_")[1]))


def read_ply(path):
    """Returns the property names and the rows, as bytes, of a PLY of little-endian floats."""
    data = path.read_bytes()
    end = data.find(b"end_header\n")
    if not data.startswith(b"ply\n") or end < 0:
        fail(f"{path} is no PLY")
    header, names, count = data[:end].decode("ascii"), [], 0
    require("format binary_little_endian 1.0" in header, f"{path.name} is binary, little-endian")
    for line in header.splitlines():
        words = line.split()
        if words[:2] == ["element", "vertex"]:
            count = int(words[2])
        elif words[0] == "property":
            if words[1] not in ("float", "float32"):
                fail(f"{path}: property {words[-1]} is {words[1]}, no float")
            names.append(words[-1])
    body, size = data[end + 11:], 4 * len(names)
    require(len(body) == count * size, f"{path.name} has {count} rows of {len(names)} floats")
    return names, [body[i:i + size] for i in range(0, len(body), size)]


def finite(rows):
    values = array.array("f")
    values.frombytes(b"".join(rows))
    if sys.byteorder == "big":
        values.byteswap()
    return all(map(math.isfinite, values))


def same_file(name, of, original):
    if (original / name).exists():
        same = (of / name).exists() and (of / name).read_bytes() == (original / name).read_bytes()
        require(same, f"{name} is the original's")


# ---- SpacetimeGaussians


def stg(model, original):
    if model.is_file() and model.read_bytes()[:4] == struct.pack("<I", 0x674B):
        return stg_splatv(model, original)
    folder = iteration_folder(model) if model.is_dir() else model.parent
    names, rows = read_ply(folder / "point_cloud.ply" if model.is_dir() else model)

    def beginning(prefix):
        return [name for name in names if name.startswith(prefix)]

    is_full = len(beginning("f_dc")) > 3
    counts = {"f_dc": 6 if is_full else 3, "f_t": 3 if is_full else 0, "f_rest": 0, "motion": 9, "omega": 4, "rot": 4,
              "scale_": 3}
    for prefix, count in counts.items():
        found = beginning(prefix)
        require(len(found) == count, f"{count} properties begin with {prefix}")
        # The loader sorts them by the number after the last underscore.
        numbers = sorted(int(name.split("_")[-1]) for name in found)
        if numbers != list(range(count)):
            fail(f"properties that begin with {prefix} are numbered {numbers}")
    needed = {"x", "y", "z", "opacity", "trbf_center", "trbf_scale"}
    require(needed <= set(names), "x y z opacity trbf_center trbf_scale are there")
    require(finite(rows), "every value is finite")
    if is_full and model.is_dir():
        stg_network(folder / "point_cloud.pt")
    if original is None:
        return
    require(model.is_dir() == original.is_dir(), "a folder of a folder, a PLY of a PLY")
    of = iteration_folder(original) if original.is_dir() else original.parent
    their_names, their_rows = read_ply(of / "point_cloud.ply" if original.is_dir() else original)
    require(names == their_names, "the properties are the original's, in their order")
    require(len(rows) <= len(their_rows), f"{len(rows)} Gaussians of {len(their_rows)}")
    theirs = set(their_rows)
    print(f"{sum(row in theirs for row in rows)} rows are the original's, byte for byte")
    if model.is_dir():
        require(folder.name == of.name, f"{folder.name} is the original's iteration")
        same_file("point_cloud.pt", folder, of)
        for name in ("cfg_args", "cameras.json"):
            same_file(name, model, original)


def stg_network(path):
    require(path.exists() and zipfile.is_zipfile(path), "point_cloud.pt is there")
    with zipfile.ZipFile(path) as archive:
        sizes = sorted(entry.file_size for entry in archive.infolist() if re.search(r"/data/\d+$", entry.filename))
    require(sizes == [4 * 18, 4 * 72], "point_cloud.pt has 72 and 18 weights")
    try:
        import torch
    except ImportError:
        print("no PyTorch here: point_cloud.pt was not loaded")
        return

    class Sandwich(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.mlp1 = torch.nn.Conv2d(12, 6, kernel_size=1, bias=False)
            self.mlp2 = torch.nn.Conv2d(6, 3, kernel_size=1, bias=False)

    state = torch.load(path, map_location="cpu", weights_only=True)
    Sandwich().load_state_dict(state, strict=True)
    require(all(bool(torch.isfinite(tensor).all()) for tensor in state.values()), "it loads into the decoder, with finite weights")


def stg_splatv(model, original):
    count = len(splatv_rows(model))
    if original is not None and original.suffix == ".splatv":
        theirs = splatv_rows(original)
        require(count <= len(theirs), f"{count} Gaussians of {len(theirs)}")
    elif original is not None:
        of = iteration_folder(original) / "point_cloud.ply" if original.is_dir() else original
        require(count <= len(read_ply(of)[1]), f"{count} Gaussians, no more than the original's")


def splatv_rows(path):
    data = path.read_bytes()
    magic, length = struct.unpack("<II", data[:8])
    require(magic == 0x674B, f"{path.name} begins with 0x674b")
    entry = json.loads(data[8:8 + length])[0]
    texture = data[8 + length:]
    require(entry["type"] == "splat" and entry["size"] == len(texture) == 16 * entry["texwidth"] * entry["texheight"],
         f"a texture of {entry['texwidth']} x {entry['texheight']} texels")
    camera = entry["cameras"][0]
    require({"position", "rotation", "fx", "fy"} <= set(camera), "a camera to start at")
    rows = [texture[i:i + 64] for i in range(0, len(texture), 64)]
    while rows and not any(rows[-1]):
        rows.pop()
    for row in rows:
        numbers = struct.unpack("<3f", row[:12]) + struct.unpack("<8e", row[12:28]) + struct.unpack("<16e", row[32:64])
        if not all(map(math.isfinite, numbers)):
            fail(f"{path}: a row holds what is no number: {numbers}")
    print(f"ok: {len(rows)} Gaussians of finite numbers, then zeros")
    return rows


# ---- checkpoints

TYPES = {
    "FloatStorage": ("f", 4, "float32"), "DoubleStorage": ("d", 8, "float64"), "HalfStorage": ("e", 2, "float16"),
    "LongStorage": ("q", 8, "int64"), "IntStorage": ("i", 4, "int32"), "BoolStorage": ("?", 1, "bool"),
}


class Tensor:
    """Description of a tensor in a checkpoint, with its values in order."""

    def __init__(self, storage, offset, shape, stride, wants_gradient=False):
        self.kind, self.device, self.values = storage
        self.offset, self.shape, self.stride = offset, tuple(shape), tuple(stride)
        self.wants_gradient = wants_gradient

    def flat(self):
        places = [self.offset]
        for length, step in zip(self.shape, self.stride):
            places = [at + k * step for at in places for k in range(length)]
        return [self.values[at] for at in places]


class Reader(pickle.Unpickler):
    """Unpickler that creates tensors, parameters and ordered dictionaries, and refuses everything else."""

    def __init__(self, file, archive, stem):
        super().__init__(file)
        self.archive, self.stem = archive, stem

    def find_class(self, module, name):
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return lambda storage, offset, shape, stride, gradient, hooks, *rest: Tensor(
                storage, offset, shape, stride, gradient)
        if (module, name) == ("torch._utils", "_rebuild_parameter"):
            return lambda tensor, gradient, hooks: setattr(tensor, "wants_gradient", gradient) or tensor
        if module == "torch" and name in TYPES:
            return name
        raise pickle.UnpicklingError(f"{module}.{name} is not made here")

    def persistent_load(self, what):
        _, name, key, device, count = what
        code, size, kind = TYPES[name]
        data = self.archive.read(f"{self.stem}/data/{key}")
        require_quietly(len(data) >= count * size, f"data/{key} has the {count} values that the pickle says")
        return kind, device, struct.unpack(f"<{count}{code}", data[: count * size])


def require_quietly(condition, message):
    if not condition:
        require(False, message)


def load(path):
    archive = zipfile.ZipFile(path)
    names = archive.namelist()
    require(archive.testzip() is None, f"{path}: every file of the archive has its checksum")
    require(all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist()), "nothing is compressed")
    inner = next((name for name in names if name.endswith("/data.pkl")), None)
    require(inner is not None, "there is one data.pkl")
    root = Reader(archive.open(inner), archive, inner.rsplit("/", 1)[0]).load()
    if torch:
        torch.load(path, map_location="cpu", weights_only=True)
        print("ok: torch.load(weights_only=True) opens it")
    else:
        print("PyTorch is not installed: read by the standard library alone")
    return root


def leaves(node, place=""):
    """Yields every leaf of a tree with its path, in order."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield from leaves(value, f"{place}[{key!r}]")
    elif isinstance(node, (tuple, list)):
        for index, value in enumerate(node):
            yield from leaves(value, f"{place}[{index}]")
    else:
        yield place, node


def compare(root, original, count, before):
    """Checks that everything except rows equals the original."""
    new, old = list(leaves(root)), list(leaves(original))
    require([place for place, _ in new] == [place for place, _ in old], "the tree is the original's: names and order")
    fewer = 0
    for (place, a), (_, b) in zip(new, old):
        if not isinstance(b, Tensor):
            same = a == b or (a != a and b != b)
            require_quietly(same, f"{place} is the original's {b!r}, not {a!r}")
            continue
        same = (a.kind, a.device, a.wants_gradient) == (b.kind, b.device, b.wants_gradient)
        require_quietly(same, f"{place} has the type, device and gradient of the original's")
        if b.shape[:1] == (before,) and a.shape != b.shape:
            fewer += 1
            wanted = (count,) + b.shape[1:]
            require_quietly(a.shape == wanted, f"{place} has shape {wanted}, not {a.shape}")
        else:
            require_quietly(a.shape == b.shape and a.flat() == b.flat(), f"{place} is the original's, value by value")
    require(True, f"{fewer} tensors have {count} rows of {before}; everything else is the original's")


def check_rows(tensors, count):
    for name, (tensor, row) in tensors.items():
        require_quietly(isinstance(tensor, Tensor), f"{name} is a tensor")
        require_quietly(tensor.shape == (count,) + row, f"{name} has shape {(count,) + row}, not {tensor.shape}")
        require_quietly(all(math.isfinite(x) for x in tensor.flat()), f"every value of {name} is finite")
    require(True, f"{', '.join(tensors)}: shapes of {count} Gaussians, finite values")


def check_adam(state, shapes, name):
    for key in ("exp_avg", "exp_avg_sq"):
        if key in state:
            found = state[key].shape
            require_quietly(found in shapes, f"{name}: {key} has the shape of its parameter, not {found}")


def one_of(folder, *patterns):
    folder = Path(folder)
    if folder.is_file():
        return folder
    found = [path for pattern in patterns for path in sorted(folder.glob(pattern))]
    require(bool(found), f"{folder} has a checkpoint")
    return found[-1]


def yang4d(folder, original):
    """Checks the 19 entries that GaussianModel.restore of the repository reads."""
    root = load(one_of(folder, "chkpnt*.pth"))
    capture, iteration = root
    require(len(capture) == 19 and isinstance(iteration, int), "the checkpoint is (capture of 19, iteration)")
    count, rest = capture[1].shape[0], capture[3].shape[1]
    names = {1: ("xyz", (3,)), 2: ("features_dc", (1, 3)), 3: ("features_rest", (rest, 3)), 4: ("scaling", (3,)),
             5: ("rotation", (4,)), 6: ("opacity", (1,)), 13: ("t", (1,)), 14: ("scaling_t", (1,))}
    if capture[16]:
        names[15] = ("rotation_r", (4,))
    check_rows({name: (capture[i], row) for i, (name, row) in names.items()}, count)
    require(all(capture[i].wants_gradient for i in names), "the parameters want gradients")
    require(all(capture[i].shape[0] == count for i in range(7, 11)), "statistics of densifying have as many rows")
    groups = capture[11]["param_groups"]
    require(len(groups) == len(names), f"the optimiser has {len(names)} groups, as restore expects")
    shapes = {capture[i].shape for i in names}
    for key, state in capture[11]["state"].items():
        check_adam(state, shapes, f"optimiser state {key}")
    if original:
        before = load(one_of(original, "chkpnt*.pth"))
        compare(root, before, count, before[0][1].shape[0])


def ftgs(folder, original):
    """Checks a gsplat checkpoint with velocities: splats.load_state_dict and one optimizer per name."""
    root = load(one_of(folder, "ckpts/ckpt_*.pt", "ckpt_*.pt"))
    splats = root["splats"]
    count = splats["means"].shape[0]
    rows = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": splats["shN"].shape[1:],
            "times": (1,), "durations": (1,), "velocities": (3,)}
    check_rows({name: (splats[name], row) for name, row in rows.items()}, count)
    for name, optimizer in root.get("optimizers", {}).items():
        for state in optimizer["state"].values():
            check_adam(state, {splats[name].shape}, name)
    if original:
        before = load(one_of(original, "ckpts/ckpt_*.pt", "ckpt_*.pt"))
        compare(root, before, count, before["splats"]["means"].shape[0])


FAMILIES = {"stg": stg, "d3g": deformable_3d_gaussians, "scgs": sc_gs, "yang4d": yang4d, "ftgs": ftgs}


def main():
    if len(sys.argv) not in (3, 4) or sys.argv[1] not in FAMILIES:
        print(f"usage: check_families.py {'|'.join(FAMILIES)} MODEL [ORIGINAL]", file=sys.stderr)
        sys.exit(2)
    model, *original = map(Path, sys.argv[2:])
    FAMILIES[sys.argv[1]](model, original[0] if original else None)
    print("all holds")


main()
