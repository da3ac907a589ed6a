#!/usr/bin/env python3
"""Checks that a compressed 4DGaussians model folder opens the way the original renderer opens it.

    python3 scripts/check_model_folder.py ORIGINAL COMPRESSED

Standard library only. Where PyTorch or plyfile is installed, the loader's own calls are tried as well; where not, that
is said. Checked, in the terms of the original loader (`GaussianModel.load_ply`, `load_model`):
  - cfg_args is the original's, byte for byte
  - the point cloud has the original's properties: names, order, types; as many f_rest as the SH degree asks
  - every value is finite and the count is not larger than the original's
  - deformation.pth holds the original's tensors: names and shapes, so that it loads strictly into a network made by
    cfg_args, which copies half precision into its own parameters; values are finite and, but for rows of time planes
    that no time from 0 on reads, the original's as half precision rounds them, or exactly
  - with PyTorch: it opens with weights_only=True, and load_state_dict(strict=True) leaves just these values
  - deformation_table.pth is absent or bool [N]; deformation_accum.pth is absent or float32 [N, 3]
Exits 1 at the first thing that does not hold; prints the bytes of the folder by part at the end.
"""

import array
import collections
import itertools
import math
import pickle
import re
import struct
import sys
import zipfile
from pathlib import Path

TYPES = {"FloatStorage": ("f", 4), "HalfStorage": ("e", 2), "BoolStorage": ("?", 1)}
# Axis pairs (x,t), (y,t), (z,t).
TIME_PLANE = re.compile(r"deformation_net\.grid\.grids\.\d+\.[245]")


def fail(message):
    print(f"FAILED: {message}")
    sys.exit(1)


def hold(condition, message):
    if not condition:
        fail(message)
    print(f"ok: {message}")


def iteration_folder(model):
    folders = [f for f in (model / "point_cloud").iterdir() if re.fullmatch(r"iteration_\d+", f.name)]
    if not folders:
        fail(f"{model}/point_cloud has no iteration_K folder")
    # `searchForMaxIteration` of the original.
    return max(folders, key=lambda f: int(f.name.split("_")[1]))


def read_ply(path):
    """Properties, number of rows, and whether every value is finite."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode("ascii").splitlines()
    if lines[1] != "format binary_little_endian 1.0":
        fail(f"{path}: {lines[1]}")
    count = int(next(line.split()[2] for line in lines if line.startswith("element vertex")))
    properties = [tuple(line.split()[1:]) for line in lines if line.startswith("property")]
    codes = {"float": "f", "double": "d", "uchar": "B", "int": "i"}
    row = struct.Struct("<" + "".join(codes[kind] for kind, _ in properties))
    if len(data) - end != count * row.size:
        fail(f"{path}: header says {count} vertices, the body has {(len(data) - end) / row.size}")
    finite = all(all(map(math.isfinite, values)) for values in row.iter_unpack(memoryview(data)[end:]))
    return properties, count, finite


class Tensor:
    """A tensor as its file has it: where its elements lie in its storage."""

    def __init__(self, storage, offset, shape, stride):
        self.kind, self.key, self.stored = storage
        self.offset, self.shape, self.stride = offset, tuple(shape), tuple(stride)

    def places(self):
        """Of every element, the last index fastest."""
        steps = [range(0, extent * step, step) if step else [0] * extent for extent, step in zip(self.shape, self.stride)]
        return (self.offset + sum(at) for at in itertools.product(*steps))


class Reader(pickle.Unpickler):
    """Reads what torch.save writes of tensors and calls nothing else."""

    def find_class(self, module, name):
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return lambda storage, offset, shape, stride, *_: Tensor(storage, offset, shape, stride)
        if module == "torch" and name in TYPES:
            return name
        raise pickle.UnpicklingError(f"{module}.{name} is no part of a state dict")

    def persistent_load(self, pid):
        _, kind, key, _, count = pid
        return kind, key, count


def read_pth(path):
    """Tensors by name, and of each its values in the order of its elements."""
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        pickled = next(name for name in names if name.endswith("/data.pkl"))
        root = pickled[: -len("data.pkl")]
        if root + "version" not in names or archive.testzip() is not None:
            fail(f"{path}: damaged, or without a version")
        with archive.open(pickled) as file:
            tensors = Reader(file).load()
        values = {}
        for name, tensor in tensors.items():
            code, width = TYPES[tensor.kind]
            data = archive.read(f"{root}data/{tensor.key}")
            if len(data) != width * tensor.stored:
                fail(f"{path}: {name} is to have {tensor.stored} values, its storage has {len(data)} bytes")
            stored = array.array("f", struct.unpack(f"<{tensor.stored}{code}", data))
            values[name] = array.array("f", (stored[at] for at in tensor.places()))
    return tensors, values


def half(value):
    return struct.unpack("<e", struct.pack("<e", value))[0]


def rows_read(name, shape):
    """Whether an element of a tensor is read at some time from 0 on, by its index."""
    if not TIME_PLANE.fullmatch(name) or len(shape) != 4:
        return lambda at: True
    rows, columns = shape[2:]
    # Time is not mapped to [-1, 1]: 0 falls in the middle of the rows.
    first = (rows - 1) // 2
    return lambda at: at // columns % rows >= first


def check_field(before, after):
    """The state dict of the folder `after`, against that of `before`."""
    tensors_before, values_before = read_pth(before)
    tensors, values = read_pth(after)
    hold(set(tensors) == set(tensors_before), f"deformation.pth has the original's {len(tensors)} tensors")
    shapes = [(name, tensor.shape) for name, tensor in tensors.items() if tensor.shape != tensors_before[name].shape]
    hold(not shapes, f"all of the original's shapes {shapes or ''}".rstrip())
    hold(all(tensor.kind in ("FloatStorage", "HalfStorage") for tensor in tensors.values()), "all floating-point")
    hold(all(math.isfinite(x) for of in values.values() for x in of), "every value is finite")
    for name, tensor in tensors.items():
        is_read, narrow = rows_read(name, tensor.shape), tensor.kind == "HalfStorage"
        for at, (old, new) in enumerate(zip(values_before[name], values[name])):
            if new != old and is_read(at) and not (narrow and new == half(old)):
                fail(f"{name}: element {at} was {old} and is {new}")
    halves = sum(tensor.kind == "HalfStorage" for tensor in tensors.values())
    print(f"ok: values are the original's, those of {halves} tensors in half precision")
    return tensors, values


def check_with_torch(torch, folder, tensors, values, count):
    """What the original loader does with the `.pth` files."""
    network = torch.nn.Module()
    for name, tensor in tensors.items():
        *path, leaf = name.split(".")
        module = network
        for part in path:
            if part not in module._modules:
                module.add_module(part, torch.nn.Module())
            module = module._modules[part]
        module.register_parameter(leaf, torch.nn.Parameter(torch.zeros(tensor.shape)))
    state = torch.load(folder / "deformation.pth", map_location="cpu")
    network.load_state_dict(state, strict=True)
    for name, parameter in network.named_parameters():
        found = parameter.detach().reshape(-1).tolist()
        if parameter.dtype != torch.float32 or found != list(values[name]):
            fail(f"{name}: load_state_dict leaves other values")
    print(f"ok: load_state_dict(strict=True) of PyTorch {torch.__version__} leaves these values in single precision")
    if tuple(map(int, torch.__version__.split(".")[:2])) >= (1, 13):
        torch.load(folder / "deformation.pth", map_location="cpu", weights_only=True)
        print("ok: it opens with weights_only=True")
    for name, shape, dtype in [
        ("deformation_table.pth", (count,), torch.bool),
        ("deformation_accum.pth", (count, 3), torch.float32),
    ]:
        if (folder / name).exists():
            table = torch.load(folder / name, map_location="cpu")
            hold(tuple(table.shape) == shape and table.dtype == dtype, f"{name} is {dtype} {list(shape)}")
        else:
            print(f"ok: {name} is absent, as the loader accepts")


def parts(model, folder):
    """Bytes of what the renderer opens, by part."""
    return [path.stat().st_size for path in (folder / "point_cloud.ply", folder / "deformation.pth", model / "cfg_args")]


def main():
    if len(sys.argv) != 3:
        print(__doc__)
        sys.exit(2)
    original, compressed = Path(sys.argv[1]), Path(sys.argv[2])
    config = (original / "cfg_args").read_text()
    hold((compressed / "cfg_args").read_text() == config, "cfg_args is unchanged")
    degree = int(re.search(r"sh_degree=(\d+)", config).group(1)) if "sh_degree=" in config else 3

    before, after = iteration_folder(original), iteration_folder(compressed)
    hold(before.name == after.name, f"{after.name} is the iteration the loader picks")
    properties, count_before, _ = read_ply(before / "point_cloud.ply")
    properties_after, count, finite = read_ply(after / "point_cloud.ply")
    hold(properties_after == properties, f"{len(properties)} properties with the original's names, order and types")
    rest = [name for _, name in properties if name.startswith("f_rest_")]
    hold(len(rest) == 3 * (degree + 1) ** 2 - 3, f"{len(rest)} f_rest for SH degree {degree}")
    hold(0 < count <= count_before, f"{count} of {count_before} Gaussians")
    hold(finite, "every value is finite")

    tensors, values = check_field(before / "deformation.pth", after / "deformation.pth")
    try:
        import torch
    except ImportError:
        print("skipped: PyTorch is not installed, so its own loader was not tried")
        tables = ["deformation_table.pth", "deformation_accum.pth"]
        hold(not any((after / name).exists() for name in tables), "no per-Gaussian tables to disagree with")
    else:
        check_with_torch(torch, after, tensors, values, count)
    try:
        from plyfile import PlyData
    except ImportError:
        print("skipped: plyfile is not installed, so the loader's own PLY reader was not tried")
    else:
        vertex = PlyData.read(str(after / "point_cloud.ply")).elements[0]
        names = [p.name for p in vertex.properties]
        hold(names == [name for _, name in properties], "plyfile reads the same properties")
    was, now = parts(original, before), parts(compressed, after)
    for name, old, new in zip(["point cloud", "field", "cfg_args", "whole"], [*was, sum(was)], [*now, sum(now)]):
        print(f"{name}: {new} of {old} bytes ({100 * new / old:.1f}%)")
    print("the original loader can open it")


if __name__ == "__main__":
    main()
