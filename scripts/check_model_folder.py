#!/usr/bin/env python3
"""Checks that a compressed 4DGaussians model folder opens like the original in the original renderer.

    python3 scripts/check_model_folder.py ORIGINAL COMPRESSED

Example: python3 scripts/check_model_folder.py output/my_model small

Needs only the standard library. If PyTorch or plyfile is installed, the calls of the loader are tried as well;
otherwise the script says that they are not. The checks follow the original loader (`GaussianModel.load_ply`,
`load_model`):
  - cfg_args equals the original byte for byte, or except for a lower sh_degree
  - the point cloud has the properties of the original: names, order, types; as many f_rest as its SH degree needs, and
    in unchanged rows the original coefficients of every channel
  - a lower SH degree occurs only in a model without a head that deforms colors
  - every value is finite, and there are no more Gaussians than in the original
  - deformation.pth holds the tensors of the original: names and shapes, so that it loads strictly into a network made
    from cfg_args, which converts half precision to its own type; values are finite and equal those of the original,
    exactly or rounded to half precision, except in rows of time planes that no time from 0 on reads
  - with PyTorch: it opens with weights_only=True, and load_state_dict(strict=True) results in exactly these values
  - deformation_table.pth is absent or bool [N]; deformation_accum.pth is absent or float32 [N, 3]
Exits 1 at the first violation; otherwise prints the bytes of the folder by part.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import array
import ast
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


def require(condition, message):
    """Ends the script with `message` if `condition` is false."""
    if not condition:
        fail(message)
    print(f"ok: {message}")


def iteration_folder(model):
    folders = [f for f in (model / "point_cloud").iterdir() if re.fullmatch(r"iteration_\d+", f.name)]
    if not folders:
        fail(f"{model}/point_cloud has no iteration_K folder")
    # `searchForMaxIteration` of the original.
    return max(folders, key=lambda f: int(f.name.split("_")[1]))


def read_config(path):
    """Returns the arguments of the Namespace that the loader evaluates, by name, and the SH degree."""
    try:
        call = ast.parse(path.read_text().strip(), mode="eval").body
        keys = {key.arg: key.value for key in call.keywords}
        degree = ast.literal_eval(keys["sh_degree"]) if "sh_degree" in keys else 3
    except (SyntaxError, AttributeError, ValueError) as error:
        fail(f"{path}: the loader cannot evaluate it: {error}")
    return {name: ast.dump(value) for name, value in keys.items() if name != "sh_degree"}, degree


def check_config(before, after):
    """Checks the cfg_args at `after` against that at `before`. Returns the SH degrees of both."""
    (keys_before, degree_before), (keys, degree) = read_config(before), read_config(after)
    if degree == degree_before:
        require(after.read_bytes() == before.read_bytes(), "cfg_args is unchanged")
        return degree_before, degree
    require(keys == keys_before, "cfg_args is unchanged but for sh_degree")
    require(degree in range(degree_before), f"SH degree {degree} of {degree_before}")
    require(keys.get("no_dshs") in (None, ast.dump(ast.parse("True").body[0].value)), "no SH head deforms colours")
    return degree_before, degree


def rest_of(degree):
    """Returns the number of f_rest properties that `load_ply` asserts."""
    return 3 * (degree + 1) ** 2 - 3


def at_lower_degree(names, degree_before, degree):
    """Returns the properties that remain at a lower SH degree, as pairs of new name and old name."""
    had, left = rest_of(degree_before) // 3, rest_of(degree) // 3
    pairs = []
    for name in names:
        if not name.startswith("f_rest_"):
            pairs.append((name, name))
            continue
        # Coefficients are ordered channel by channel.
        channel, coefficient = divmod(int(name[len("f_rest_"):]), max(had, 1))
        if coefficient < left:
            pairs.append((f"f_rest_{channel * left + coefficient}", name))
    return pairs


def check_cloud(before, after, degree_before, degree):
    """Checks the point cloud at `after` against that at `before`. Returns its properties and rows."""
    properties_before, rows_before = read_ply(before)
    properties, rows = read_ply(after)
    names_before, names = ([name for _, name in of] for of in (properties_before, properties))
    pairs = at_lower_degree(names_before, degree_before, degree)
    kinds = dict((name, kind) for kind, name in properties_before)
    expected = [(kinds[was], name) for name, was in pairs]
    rest = [name for name in names if name.startswith("f_rest_")]
    require(len(rest) == rest_of(degree), f"{len(rest)} f_rest for SH degree {degree}")
    require(properties == expected, f"{len(properties)} properties with the original's names, order and types")
    require(0 < len(rows) <= len(rows_before), f"{len(rows)} of {len(rows_before)} Gaussians")
    require(all(math.isfinite(x) for row in rows for x in row), "every value is finite")
    own = [place for place, name in enumerate(names) if name not in rest]
    own_before = [names_before.index(names[place]) for place in own]
    kept = [names_before.index(was) for _, was in pairs]
    found = collections.defaultdict(list)
    for row in rows_before:
        found[tuple(row[place] for place in own_before)].append(tuple(row[place] for place in kept))
    same = [(row, found[key]) for row in rows for key in [tuple(row[place] for place in own)] if key in found]
    are_equal = all(row in of for row, of in same)
    require(are_equal, f"{len(same)} rows that nothing was changed of have the original's f_rest")
    return properties, rows


def read_ply(path):
    """Returns properties and rows."""
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
    return properties, list(row.iter_unpack(memoryview(data)[end:]))


class Tensor:
    """Tensor as stored in its file: the places of its elements in its storage."""

    def __init__(self, storage, offset, shape, stride):
        self.kind, self.key, self.stored = storage
        self.offset, self.shape, self.stride = offset, tuple(shape), tuple(stride)

    def places(self):
        """Returns the places of all elements in the storage, the last index fastest."""
        steps = [range(0, extent * step, step) if step else [0] * extent for extent, step in zip(self.shape, self.stride)]
        return (self.offset + sum(at) for at in itertools.product(*steps))


class Reader(pickle.Unpickler):
    """Unpickler that reads what torch.save writes for tensors and calls nothing else."""

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
    """Returns tensors by name, and the values of each in the order of its elements."""
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
    """Returns whether any time from 0 on reads an element of a tensor, by its index."""
    if not TIME_PLANE.fullmatch(name) or len(shape) != 4:
        return lambda at: True
    rows, columns = shape[2:]
    # Time is not mapped to [-1, 1]: 0 is in the middle of the rows.
    first = (rows - 1) // 2
    return lambda at: at // columns % rows >= first


def check_field(before, after):
    """Checks the state dict of the folder `after` against that of `before`."""
    tensors_before, values_before = read_pth(before)
    tensors, values = read_pth(after)
    require(set(tensors) == set(tensors_before), f"deformation.pth has the original's {len(tensors)} tensors")
    shapes = [(name, tensor.shape) for name, tensor in tensors.items() if tensor.shape != tensors_before[name].shape]
    require(not shapes, f"all of the original's shapes {shapes or ''}".rstrip())
    require(all(tensor.kind in ("FloatStorage", "HalfStorage") for tensor in tensors.values()), "all floating-point")
    require(all(math.isfinite(x) for of in values.values() for x in of), "every value is finite")
    for name, tensor in tensors.items():
        is_read, narrow = rows_read(name, tensor.shape), tensor.kind == "HalfStorage"
        for at, (old, new) in enumerate(zip(values_before[name], values[name])):
            if new != old and is_read(at) and not (narrow and new == half(old)):
                fail(f"{name}: element {at} was {old} and is {new}")
    halves = sum(tensor.kind == "HalfStorage" for tensor in tensors.values())
    print(f"ok: values are the original's, those of {halves} tensors in half precision")
    return tensors, values


def check_with_torch(torch, folder, tensors, values, count):
    """Runs what the original loader does with the `.pth` files."""
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
            require(tuple(table.shape) == shape and table.dtype == dtype, f"{name} is {dtype} {list(shape)}")
        else:
            print(f"ok: {name} is absent, as the loader accepts")


def check_features_with_torch(torch, properties, rows, degree):
    """Runs what `load_ply` does with colors."""
    names = [name for _, name in properties]

    def values(prefix):
        found = sorted((name for name in names if name.startswith(prefix)), key=lambda name: int(name.split("_")[-1]))
        return torch.tensor([[row[names.index(name)] for name in found] for row in rows])

    rest = values("f_rest_").reshape((len(rows), 3, (degree + 1) ** 2 - 1)).transpose(1, 2)
    features = torch.cat((values("f_dc_").reshape((len(rows), 1, 3)), rest), dim=1)
    shape = (len(rows), (degree + 1) ** 2, 3)
    require(tuple(features.shape) == shape, f"colours of PyTorch are {list(shape)}")


def parts(model, folder):
    """Returns the bytes of the files that the renderer opens, by part."""
    return [path.stat().st_size for path in (folder / "point_cloud.ply", folder / "deformation.pth", model / "cfg_args")]


def main():
    if len(sys.argv) != 3:
        print(__doc__)
        sys.exit(2)
    original, compressed = Path(sys.argv[1]), Path(sys.argv[2])
    degree_before, degree = check_config(original / "cfg_args", compressed / "cfg_args")
    before, after = iteration_folder(original), iteration_folder(compressed)
    require(before.name == after.name, f"{after.name} is the iteration the loader picks")
    properties, rows = check_cloud(before / "point_cloud.ply", after / "point_cloud.ply", degree_before, degree)
    tensors, values = check_field(before / "deformation.pth", after / "deformation.pth")
    try:
        import torch
    except ImportError:
        print("skipped: PyTorch is not installed, so its own loader was not tried")
        tables = ["deformation_table.pth", "deformation_accum.pth"]
        require(not any((after / name).exists() for name in tables), "no per-Gaussian tables to disagree with")
    else:
        check_with_torch(torch, after, tensors, values, len(rows))
        check_features_with_torch(torch, properties, rows, degree)
    try:
        from plyfile import PlyData
    except ImportError:
        print("skipped: plyfile is not installed, so the loader's own PLY reader was not tried")
    else:
        vertex = PlyData.read(str(after / "point_cloud.ply")).elements[0]
        names = [p.name for p in vertex.properties]
        require(names == [name for _, name in properties], "plyfile reads the same properties")
    was, now = parts(original, before), parts(compressed, after)
    for name, old, new in zip(["point cloud", "field", "cfg_args", "whole"], [*was, sum(was)], [*now, sum(now)]):
        print(f"{name}: {new} of {old} bytes ({100 * new / old:.1f}%)")
    print("the original loader can open it")


if __name__ == "__main__":
    main()
