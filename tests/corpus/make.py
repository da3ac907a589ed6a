#!/usr/bin/env python3
"""Makes the saved corpus in its own folder: complete files of a few Gaussians, and damaged versions of them.

    python3 tests/corpus/make.py target/release/splatsieve

Needs zstandard. PROGRAM packs the container, the stream and the archive; the script writes everything else from the
descriptions of the formats, so that no code under test makes its own test data.
"""

import gzip
import io
import json
import math
import pickle
import random
import struct
import subprocess
import sys
import tempfile
import types
import zipfile
from collections import OrderedDict
from pathlib import Path

import zstandard

HERE = Path(__file__).resolve().parent
COUNT, WIDTH, CHANNELS, SIZE = 6, 4, 2, 2
DICE = random.Random(15)
# Byte order mark and Latin-1 text of other programs.
BOM, LATIN = b"\xef\xbb\xbf", "é".encode("latin-1")


def normal(count, spread=1.0, middle=0.0):
    return [DICE.gauss(middle, spread) for _ in range(count)]


def floats(values):
    return struct.pack(f"<{len(values)}f", *values)


def write(target, name, data):
    folder = HERE / target
    folder.mkdir(exist_ok=True)
    data = data.encode() if isinstance(data, str) else data
    assert len(data) < 20_000, (target, name, len(data))
    (folder / name).write_bytes(data)


def damaged(target, whole, places=()):
    """Writes damaged copies: cut short, or with changed bytes as on a bad disk; `places` are offsets of bytes with a
    meaning.
    """
    write(target, "whole", whole)
    write(target, "empty", b"")
    for part in (1, 8, len(whole) // 3, len(whole) - 1):
        write(target, f"cut_{part}", whole[:part])
    write(target, "more", whole + b"\0" * 7)
    write(target, "as_text", whole.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"))
    write(target, "zeros", whole[: len(whole) // 2] + bytes(len(whole) - len(whole) // 2))
    for at in places:
        for name, value in (("ff", 0xFF), ("turned", whole[at] ^ 0x10)):
            write(target, f"byte_{at}_{name}", whole[:at] + bytes([value]) + whole[at + 1 :])


def texts(target, whole, replaced):
    """Writes a text file with replacements by name: the text to find, and the text to put in its place."""
    damaged(target, whole.encode())
    write(target, "bom", BOM + whole.encode())
    write(target, "latin_1", whole.encode() + LATIN)
    write(target, "utf_16", whole.encode("utf-16"))
    for name, (before, after) in replaced.items():
        assert before in whole, (target, name)
        write(target, name, whole.replace(before, after, 1))


# --- PLY ---------------------------------------------------------------------------------------------------------------

NAMES = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(9))]
NAMES += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def header(form="binary_little_endian", count=COUNT, names=NAMES):
    lines = ["ply", f"format {form} 1.0", f"element vertex {count}", *(f"property float {name}" for name in names)]
    return "\n".join([*lines, "end_header", ""]).encode()


def row():
    return [*normal(3, 0.5), 0, 0, 0, *normal(12, 0.3), DICE.uniform(-2, 4), *normal(3, 0.5, -3), *normal(4)]


def make_ply():
    rows = [row() for _ in range(COUNT)]
    body = b"".join(map(floats, rows))
    whole = header() + body
    damaged("ply", whole, [0, 4, len(header()) - 2, len(header()) + 3])
    text = "\n".join(" ".join(f"{value:.6g}" for value in values) for values in rows)
    write("ply", "ascii", header("ascii") + text.encode() + b"\n")
    write("ply", "ascii_short", header("ascii") + text.encode()[:-40])
    write("ply", "ascii_words", header("ascii") + text.replace("0", "zero").encode())
    big = b"".join(struct.pack(f">{len(values)}f", *values) for values in rows)
    write("ply", "big_endian", header("binary_big_endian") + big)
    for name, before, after in (
        ("none", b"vertex 6", b"vertex 0"),
        ("negative", b"vertex 6", b"vertex -6"),
        ("many", b"vertex 6", b"vertex 4294967296"),
        ("more_than_fit", b"vertex 6", b"vertex 18446744073709551615"),
        ("no_opacity", b"property float opacity", b"property float opaque"),
        ("doubles", b"property float", b"property double"),
        ("twice", b"property float y", b"property float x"),
        ("a_list", b"property float nx", b"property list uchar int nx"),
        ("no_rest", b"f_rest_8", b"f_rest_9"),
        ("no_format", b"format binary_little_endian 1.0\n", b""),
        ("version", b" 1.0", b" 2.0"),
        ("no_end", b"end_header", b"end"),
        ("before", b"element vertex", b"element camera 4294967295\nproperty double x\nelement vertex"),
        ("long_line", b"ply\n", b"ply\ncomment " + b"x" * 9000 + b"\n"),
        ("bytes", b"x\n", b"\xff\xfe\n"),
    ):
        write("ply", name, whole.replace(before, after, 1))
    write("ply_header", "whole", header())
    write("ply_header", "ascii", header("ascii"))
    write("ply_header", "big_endian_crlf", header("binary_big_endian").replace(b"\n", b"\r\n"))
    write("ply_header", "many_comments", header().replace(b"element", b"comment trained by a program\n" * 40 + b"element"))
    write("ply_header", "many_properties", header(names=[*NAMES, *(f"language_{k}" for k in range(300))]))
    write("ply_header", "more_elements", header().replace(b"element", b"element camera 3\nproperty uchar id\nelement", 1))
    write("ply_header", "largest_count", header(count=2**60))
    write("ply_header", "a_list", header(names=["x"]).replace(b"end_header", b"property list uchar int nx\nend_header"))
    write("ply_header", "no_end", header()[:-11])
    for name, value in (("nan", math.nan), ("infinite", math.inf), ("largest", 3.4e38)):
        write("ply", name, header() + floats([value] * len(NAMES) * COUNT))
    return whole


# --- state dicts -------------------------------------------------------------------------------------------------------


class Storage:
    """Replacement of a tensor's storage; the pickle refers to it by the result of `persistent_id`."""

    def __init__(self, key, values):
        self.key, self.values = key, values


def named(module, name):
    """Returns an object that is pickled as a call of `module.name`, although that module is not installed."""
    made = type(name, (), {})
    made.__module__, made.__qualname__ = module, name
    for part in (module[: at] for at, letter in enumerate(module + ".") if letter == "."):
        sys.modules.setdefault(part, types.ModuleType(part))
    setattr(sys.modules[module], name, made)
    return made


FLOATS, REBUILD = named("torch", "FloatStorage"), named("torch._utils", "_rebuild_tensor_v2")
PARAMETER = named("torch._utils", "_rebuild_parameter")


class Tensor:
    def __init__(self, storage, shape, offset=0, strides=None):
        self.storage, self.shape, self.offset = storage, shape, offset
        self.strides = strides or tuple(math.prod(shape[k + 1 :]) for k in range(len(shape)))

    def __reduce__(self):
        return Rebuilt(), (self.storage, self.offset, self.shape, self.strides, False, OrderedDict())


class Parameter:
    """Trained parameter: a tensor in its own wrapper."""

    def __init__(self, tensor):
        self.tensor = tensor

    def __reduce__(self):
        return Rebuilt(PARAMETER), (self.tensor, True, OrderedDict())


class Rebuilt:
    """Callable, as `__reduce__` requires, that is pickled under the name of PyTorch's function."""

    def __init__(self, called=REBUILD):
        self.called = called

    def __call__(self, *_):
        raise NotImplementedError


class Pickler(pickle._Pickler):
    dispatch = dict(pickle._Pickler.dispatch)

    def save(self, thing, **options):
        if isinstance(thing, Rebuilt):
            thing = thing.called
        return super().save(thing, **options)

    def persistent_id(self, thing):
        if isinstance(thing, Storage):
            return ("storage", FLOATS, thing.key, "cpu", len(thing.values))
        return None


def pickled(state):
    out = io.BytesIO()
    Pickler(out, protocol=2).dump(state)
    return out.getvalue()


def zipped(entries, method=zipfile.ZIP_STORED, folder="archive/"):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, data in entries.items():
            archive.writestr(zipfile.ZipInfo(folder + name, (1980, 1, 1, 0, 0, 0)), data, method)
    return out.getvalue()


def checkpoint(tensors, change=lambda data: data, method=zipfile.ZIP_STORED):
    """Returns a file like those of torch.save; `tensors` by name: shape and values."""
    state, data = OrderedDict(), {}
    for name, (shape, values) in tensors.items():
        storage = Storage(str(len(data)), values)
        state[name] = Tensor(storage, shape)
        data[f"data/{storage.key}"] = floats(values)
    entries = {"data.pkl": change(pickled(state)), "byteorder": b"little", **data, "version": b"3\n"}
    return zipped(entries, method)


def field():
    """Returns planes of one level, and heads for position and opacity."""
    tensors = {"deformation_net.grid.aabb": ((2, 3), [1.6] * 3 + [-1.6] * 3)}
    for plane in range(6):
        shape = (1, CHANNELS, SIZE, SIZE)
        tensors[f"deformation_net.grid.grids.0.{plane}"] = (shape, normal(math.prod(shape), 0.3, 1.0))
    layers = {"feature_out.0": (CHANNELS, WIDTH)}
    for head, outputs in {"pos_deform": 3, "opacity_deform": 1}.items():
        layers[f"{head}.1"], layers[f"{head}.3"] = (WIDTH, WIDTH), (WIDTH, outputs)
    for name, (fan_in, fan_out) in layers.items():
        tensors[f"deformation_net.{name}.weight"] = ((fan_out, fan_in), normal(fan_in * fan_out, 0.3))
        tensors[f"deformation_net.{name}.bias"] = ((fan_out,), normal(fan_out, 0.1))
    return tensors


def make_pickle():
    tensors = field()
    whole = checkpoint(tensors)
    start = whole.index(b"\x80\x02")
    damaged("pickle", whole, [0, 8, 26, start + 2, start + 60, len(whole) - 6, len(whole) - 12])
    write("pickle", "deflated", checkpoint(tensors, method=zipfile.ZIP_DEFLATED))
    first = next(iter(tensors))
    for name, change in {
        "missing": {first: None},
        "another_shape": {first: ((3, 2), tensors[first][1])},
        "no_values": {first: ((0, 3), [])},
        "more_than_stored": {first: ((2000, 3000), tensors[first][1])},
        "product_overflows": {first: ((1 << 31, 1 << 31, 1 << 31), tensors[first][1])},
        "negative": {first: ((-2, 3), tensors[first][1])},
        "not_finite": {first: ((2, 3), [math.nan] * 6)},
        "flat_box": {first: ((2, 3), [0.0] * 6)},
    }.items():
        state = {key: value for key, value in (tensors | change).items() if value}
        write("pickle", name, checkpoint(state))
    for name, data in {
        "nothing": pickled(OrderedDict()),
        "a_number": pickled(3),
        "a_list": pickled([1, 2]),
        "runs_a_command": b"cposix\nsystem\n(S'true'\ntR.",
        "empty": b"",
        "deep": b"\x80\x02" + b"(" * 4000 + b".",
        "nested": b"\x80\x02" + b"]" * 3000 + b"a" * 2999 + b".",
        "itself": b"\x80\x02}q\x00(h\x00h\x00u.",
        "long_text": b"\x80\x02X\xff\xff\xff\x7fabc.",
        "long_memo": b"\x80\x02Nr\xff\xff\xff\xff.",
        "long_integer": b"\x80\x02\x8b\xff\xff\xff\x7f.",
        "frame": b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7fN.",
        "stack_empty": b"\x80\x02R.",
        "mark_missing": b"\x80\x02t.",
    }.items():
        write("pickle", f"pickle_{name}", checkpoint(tensors, lambda _, data=data: data))
    write("pickle", "no_pickle", zipped({"data/0": floats([1.0])}))
    write("pickle", "legacy", pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1001, 2) + pickled(OrderedDict()))
    return whole


# --- configuration, recipes, cameras -----------------------------------------------------------------------------------


def make_cfg_args():
    planes = {
        "grid_dimensions": 2,
        "input_coordinate_dim": 4,
        "output_coordinate_dim": CHANNELS,
        "resolution": [SIZE] * 4,
    }
    whole = (
        "Namespace(sh_degree=1, source_path='data', model_path='output', white_background=False, eval=True, "
        f"net_width={WIDTH}, defor_depth=1, bounds=1.6, kplanes_config={planes}, multires=[1], no_dx=False, "
        "no_grid=False, no_ds=True, no_dr=True, no_do=False, no_dshs=True, empty_voxel=False, grid_pe=0, "
        "static_mlp=False, apply_rotation=False)"
    )
    texts("cfg_args", whole, {
        "another_name": ("Namespace", "Namespaces"),
        "no_end": ("False)", "False"),
        "text_for_a_number": ("net_width=4", "net_width='4'"),
        "negative": ("net_width=4", "net_width=-4"),
        "huge": ("net_width=4", "net_width=9223372036854775807"),
        "more_than_64_bits": ("net_width=4", "net_width=99999999999999999999999"),
        "depth": ("defor_depth=1", "defor_depth=1000000000"),
        "no_levels": ("multires=[1]", "multires=[]"),
        "many_levels": ("multires=[1]", f"multires={[1] * 2000}"),
        "levels_multiply": ("multires=[1]", "multires=[4294967296, 4294967296]"),
        "no_channels": ("'output_coordinate_dim': 2", "'output_coordinate_dim': 0"),
        "encoded": ("grid_pe=0", "grid_pe=2000000000"),
        "not_finite": ("bounds=1.6", "bounds=nan"),
        "exponent": ("bounds=1.6", "bounds=1e999999999"),
        "twice": ("eval=True", "sh_degree=3"),
        "escapes": ("'data'", r"'\x4\u00\U0011ffff\N{x}\777'"),
        "open_text": ("'data'", "'data"),
        "deep": ("[1]", "[" * 5000 + "]" * 5000),
        "calls": ("'data'", "PosixPath(" * 40 + "'x'" + ")" * 40),
        "degree": ("sh_degree=1", "sh_degree=-1"),
        "static": ("static_mlp=False", "static_mlp=True"),
        "a_voxel": ("empty_voxel=False", "empty_voxel=True"),
    })
    return whole


def make_recipe(program):
    whole = subprocess.run([program, "recipe", "--preset", "default"], check=True, capture_output=True, text=True).stdout
    lines = [line for line in whole.splitlines() if line and not line.startswith("#")]
    whole = "\n".join(lines) + "\n"
    first = next(line for line in lines if line.startswith("alpha_min"))
    texts("recipe", whole, {
        "unknown": (first, first + "\nunknown = 1"),
        "twice": (first, first + "\n" + first),
        "text": (first, "alpha_min = 'small'"),
        "negative": (first, "alpha_min = -1"),
        "not_a_number": (first, "alpha_min = nan"),
        "infinite": (first, "alpha_min = inf"),
        "too_large": (first, "alpha_min = 1e400"),
        "a_date": (first, "alpha_min = 1979-05-27T07:32:00Z"),
        "a_table": (first, "alpha_min = { a = 1 }"),
        "deep": (first, "alpha_min = " + "[" * 3000 + "]" * 3000),
        "dotted": (first, ".".join("a" * 2000) + " = 1"),
        "preset": (lines[0], "preset = 'no such'\n" + lines[0]),
        "of_another": (lines[0], "preset = 'paper'\n" + lines[0]),
        "escape": (first, 'alpha_min = "\\uD800"'),
    })


def camera(view, split="train"):
    angle = math.tau * view / 3
    c, s = math.cos(angle), math.sin(angle)
    pose = [[c, 0.0, -s, 0.0], [0.0, 1.0, 0.0, 0.0], [s, 0.0, c, 4.0], [0.0, 0.0, 0.0, 1.0]]
    own = {"v": view, "time": 0.5, "split": split, "image": f"{split}/{view}.png", "width": 32, "height": 24}
    return own | {"fx": 40.0, "fy": 40.0, "cx": 16.0, "cy": 12.0, "w2c": pose}


def make_cameras():
    document = {"background": [1, 1, 1], "frames": [camera(0), camera(1), camera(2, "test")]}
    whole = json.dumps(document)
    texts("cameras", whole, {
        "no_frames": (whole, '{"frames": []}'),
        "frames_of_numbers": (whole, '{"frames": [1, 2]}'),
        "null": (whole, "null"),
        "nan": ('"fx": 40.0', '"fx": NaN'),
        "huge_number": ('"fx": 40.0', '"fx": 1e999'),
        "zero_focal": ('"fx": 40.0', '"fx": 0'),
        "text_focal": ('"fx": 40.0', '"fx": "40"'),
        "no_focal": ('"fx"', '"gx"'),
        "huge_side": ('"width": 32', '"width": 4294967295'),
        "negative_side": ('"width": 32', '"width": -32'),
        "part_side": ('"width": 32', '"width": 32.5'),
        "no_rotation": ("[[1.0", "[[2.0"),
        "zero_rotation": ("[0.0, 1.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0]"),
        "three_rows": (", [0.0, 0.0, 0.0, 1.0]]", "]"),
        "long_row": ("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 0.0, 1.0, 2.0]"),
        "split": ('"train"', '"val"'),
        "view": ('"v": 0', '"v": 1'),
        "huge_view": ('"v": 0', '"v": 4294967296'),
        "background": ("[1, 1, 1]", "[1, 1, 2]"),
        "deep": ("[1, 1, 1]", "[" * 4000 + "]" * 4000),
        "twice": ('"frames"', '"frames": [], "frames"'),
        "surrogate": ("train/0.png", "\\ud800"),
    })
    nerf = {"camera_angle_x": 0.7, "w": 64, "h": 64}
    frames = [{"file_path": f"./r_{view}", "time": 0.0, "transform_matrix": camera(view)["w2c"]} for view in range(3)]
    whole = json.dumps(nerf | {"frames": frames})
    write("cameras", "transforms", whole)
    write("cameras", "transforms_angle", whole.replace("0.7", "3.2"))
    write("cameras", "transforms_no_angle", whole.replace('"camera_angle_x": 0.7, ', ""))
    write("cameras", "transforms_no_size", whole.replace('"w": 64, "h": 64, ', ""))
    write("cameras", "transforms_distorted", whole.replace('"w"', '"k1": 0.5, "w"'))
    static = [
        {"id": 0, "img_name": "a", "width": 32, "height": 24, "position": [0, 0, 4], "fx": 40, "fy": 40,
         "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
    ]
    write("cameras", "of_3dgs", json.dumps(static))
    write("cameras", "of_3dgs_twice", json.dumps(static * 2))
    write("cameras", "of_3dgs_empty", "[]")

    def poses(shape, values, kind="<f8"):
        text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
        text += " " * (-(len(text) + 11) % 64) + "\n"
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + values

    pose = [0.0, 1.0, 0.0, 0.0, 24.0, 1.0, 0.0, 0.0, 0.0, 32.0, 0.0, 0.0, -1.0, 4.0, 40.0, 0.1, 10.0]
    values = struct.pack("<17d", *pose)
    write("cameras", "poses", poses((1, 17), values))
    write("cameras", "poses_cut", poses((1, 17), values[:-3]))
    write("cameras", "poses_many", poses((1 << 60, 17), values))
    write("cameras", "poses_overflow", poses((1 << 63, 1 << 63), values))
    write("cameras", "poses_none", poses((0, 17), b""))
    write("cameras", "poses_wide", poses((1, 18), values + values[:8]))
    write("cameras", "poses_objects", poses((1, 17), values, "|O"))
    write("cameras", "poses_halves", poses((1, 17), values[:34], "<f2"))
    write("cameras", "poses_nan", poses((1, 17), struct.pack("<17d", *[math.nan] * 17)))


# --- frames ------------------------------------------------------------------------------------------------------------


TRACKS = 24


def make_colmap():
    """Writes COLMAP inputs (length of the camera part, cameras, images) in the binary and in the text format."""

    def both(cameras, images):
        return struct.pack("<I", len(cameras)) + cameras + images

    def lens(model, values, width=64):
        return struct.pack(f"<IIQQ{len(values)}d", 1, model, width, 48, *values)

    def image(name=b"cam00/0001.png", points=2, quaternion=(1, 0, 0, 0)):
        return struct.pack("<I7dI", 1, *quaternion, 0.5, 0, 3, 1) + name + b"\0" + struct.pack("<Q", points) + bytes(24 * points)

    one, pinhole = struct.pack("<Q", 1), (70.0, 71.0, 32.0, 24.0)
    whole = both(one + lens(1, pinhole), one + image())
    damaged("colmap", whole, (4, 12, 16, 20, 60, 68, 72, 132))
    for name, data in {
        "many": both(struct.pack("<Q", 1 << 60) + lens(1, pinhole), struct.pack("<Q", 1 << 60) + image()),
        "points": both(one + lens(1, pinhole), one + image()[:-56] + struct.pack("<Q", 1 << 61)),
        "distorted": both(one + lens(4, pinhole + (0.1, 0, 0, 0)), one + image()),
        "undistorted": both(one + lens(4, pinhole + (0, 0, 0, 0)), one + image()),
        "nan": both(one + lens(1, (math.nan,) * 4), one + image(quaternion=(math.nan,) * 4)),
        "wide": both(one + lens(1, pinhole, 1 << 63), one + image()),
        "unnamed": both(one + lens(1, pinhole), one + image(b"")),
        "name": both(one + lens(1, pinhole), one + image(b"a" * 5000, 0)),
        "twice": both(one + lens(1, pinhole), struct.pack("<Q", 2) + image() * 2),
    }.items():
        write("colmap", name, data)
    cameras = "# a comment\n1 PINHOLE 64 48 70 71 32 24\n"
    images = "1 1 0 0 0 0.5 0 3 1 cam 00/0001.png\n1 2 -1\n2 0 1 0 0 0 0 3 1 cam 00/0002.png\n\n"
    for name, (before, after) in {
        "text": ("", ""), "text_model": ("PINHOLE", "BOX"), "text_few": (" 24", ""), "text_number": ("70", "7e999"),
        "text_side": ("64", "-64"), "text_name": ("cam 00/0001.png", ""), "text_camera": ("3 1 cam", "3 9 cam"),
    }.items():
        write("colmap", name, both(*(text.replace(before, after, 1).encode() for text in (cameras, images))))


def stream(frames):
    """Returns a stream of frames whose positions move smoothly, so that their tiles are filtered (format/STREAM.md)."""
    out = struct.pack("<8sIIQII", b"\x89GSTR\r\n\x1a", 1, 0, TRACKS, 1, 0)
    # Similar rotations and colors, so that some constant tiles are compressed and some are not.
    out += floats([1.0] * TRACKS + [0.0] * 3 * TRACKS + normal(3 * TRACKS, 0.5, -3) + normal(TRACKS) + [0.5] * 3 * TRACKS)
    rest, phase = normal(3 * TRACKS), normal(3 * TRACKS)
    for frame in range(frames):
        payload = floats([at + 0.1 * math.sin(frame / 4 + turn) for at, turn in zip(rest, phase)])
        out += struct.pack("<4sIdQ", b"FRAM", frame, frame / 11, len(payload)) + payload
    return out + struct.pack("<4sI16x", b"DONE", frames)


def make_frames(program, ply):
    frames = stream(3)
    damaged("stream", frames, [0, 8, 12, 16, 23, 24, 28, frames.index(b"FRAM"), frames.index(b"FRAM") + 5])
    for name, at, value in (
        ("version", 8, struct.pack("<I", 2)),
        ("degree", 12, struct.pack("<I", 4)),
        ("many", 16, struct.pack("<Q", 0xFFFFFFFF)),
        ("more_than_fit", 16, struct.pack("<Q", 1 << 63)),
        ("none", 16, struct.pack("<Q", 0)),
        ("columns", 24, struct.pack("<I", 0xFFFFFFFF)),
        ("all_vary", 24, struct.pack("<I", 31)),
        ("none_varies", 24, struct.pack("<I", 0)),
    ):
        write("stream", name, frames[:at] + value + frames[at + len(value) :])
    mark = frames.index(b"FRAM")
    for name, at, value in (
        ("frame_number", mark + 4, struct.pack("<I", 7)),
        ("time_nan", mark + 8, struct.pack("<d", math.nan)),
        ("time_infinite", mark + 8, struct.pack("<d", math.inf)),
        ("time_back", mark + 8, struct.pack("<d", 9.0)),
        ("length", mark + 16, struct.pack("<Q", 1 << 62)),
    ):
        write("stream", name, frames[:at] + value + frames[at + len(value) :])
    write("stream", "no_end", frames[:-24])
    write("stream", "two", frames + frames)
    write("stream", "no_frames", frames[:mark] + struct.pack("<4sI16x", b"DONE", 0))

    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)

        def run(*arguments):
            subprocess.run([program, "--quiet", *arguments], check=True, cwd=folder, input=stream(8))

        run("convert", "-", "a.gseq")
        run("convert", "-", "b.gseq", "--max-error", "position=0.001,log_scale=0.01")
        whole = (folder / "a.gseq").read_bytes()
        bounded = (folder / "b.gseq").read_bytes()
        (folder / "a.ply").write_bytes(ply)
        model = folder / "model"
        iteration = model / "point_cloud" / "iteration_7"
        iteration.mkdir(parents=True)
        (model / "cfg_args").write_bytes((HERE / "cfg_args" / "whole").read_bytes())
        (iteration / "point_cloud.ply").write_bytes(ply)
        (iteration / "deformation.pth").write_bytes((HERE / "pickle" / "whole").read_bytes())
        keep = ["--count", str(COUNT - 1), "--no-refine", "--prune-only"]
        run("compress", "a.ply", "-o", "ply.gsz", *keep)
        run("compress", "model", "--frames", "3", "-o", "model.gsz", *keep)
        archives = [(folder / name).read_bytes() for name in ("model.gsz", "ply.gsz")]

    footer = struct.unpack_from("<Q", whole, len(whole) - 32)[0]
    places = [8, 12, 16, 24, 28, 32, 40, 44, footer + 8, footer + 16, footer + 64, len(whole) - 32]
    tile = whole.index(b"TILE")
    places += [tile + at for at in (4, 8, 12, 16, 18, 20, 24, 40)]
    damaged("container", whole, places)
    write("container", "bounded", bounded)
    write("container", "bounded_cut", bounded[: len(bounded) * 2 // 3])
    write("container", "no_footer", whole[:footer])
    for name, at, value in (
        ("many", 16, struct.pack("<Q", 1 << 32)),
        ("more_than_fit", 16, struct.pack("<Q", 1 << 63)),
        ("block_of_none", 24, struct.pack("<I", 0)),
        ("long_block", 28, struct.pack("<I", 1 << 24)),
        ("many_columns", 32, struct.pack("<I", 0xFFFFFFFF)),
        ("many_attributes", 36, struct.pack("<I", 0xFFFFFFFF)),
    ):
        write("container", name, whole[:at] + value + whole[at + len(value) :])
    whole, other = archives
    damaged("archive", whole, [8, 12, 18, 20, 36, 44, 60, 68, 84, 92, 116, 120, len(whole) - 20])
    write("archive", "of_a_ply", other)
    write("archive", "of_a_ply_cut", other[:-9])
    for name, at in (("table", 20), ("cloud", 44), ("field", 68), ("blobs", 92)):
        write("archive", f"long_{name}", whole[:at] + struct.pack("<Q", 1 << 40) + whole[at + 8 :])
    make_sections(whole)


def sections_of(archive):
    """Returns the stored sections of an archive, and its table and blobs before compression."""
    heads = [struct.unpack_from("<QQ", archive, 12 + 24 * k) for k in range(4)]
    at, stored = 116, []
    for length, _ in heads:
        stored.append(archive[at : at + length])
        at += length
    plain = zstandard.ZstdDecompressor()
    table, blobs = (plain.decompress(stored[k], max_output_size=heads[k][1]) for k in (0, 3))
    return stored, table, blobs


def joined(table, cloud, field, blobs):
    """Returns an input of the target archive_sections."""
    return struct.pack("<3I", len(table), len(cloud), len(field)) + table + cloud + field + blobs


def make_sections(archive):
    """Writes the sections of an archive before compression, and tables with wrong contents."""
    stored, table, blobs = sections_of(archive)

    def sections(table, cloud=stored[1], field=stored[2], blobs=blobs):
        return joined(table, cloud, field, blobs)

    write("archive_sections", "whole", sections(table))
    write("archive_sections", "no_cloud", sections(table, cloud=b""))
    write("archive_sections", "no_field", sections(table, field=b""))
    write("archive_sections", "no_blobs", sections(table, blobs=b""))
    write("archive_sections", "long_blobs", sections(table, blobs=blobs + b"x" * 100))
    write("archive_sections", "table_no_json", sections(b"table"))
    write("archive_sections", "table_nested", sections(b"[" * 5000))
    document = json.loads(table)

    def places(node, path=()):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            if isinstance(value, (dict, list)):
                yield from places(value, (*path, key))
            elif isinstance(value, (int, float)):
                yield (*path, key)

    numbers = list(places(document))
    for k, path in enumerate(DICE.sample(numbers, 8)):
        for name, value in (("huge", 2**62), ("negative", -1), ("none", 0)):
            changed = json.loads(table)
            node = changed
            for key in path[:-1]:
                node = node[key]
            node[path[-1]] = value
            write("archive_sections", f"number_{k}_{name}", sections(json.dumps(changed, separators=(",", ":")).encode()))


def make_layouts(program, ply):
    """Writes archives of models that are restored in their own layout, and damaged layouts."""
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        for name, path, source in (
            ("splatv", "a.splatv", "splatv"),
            ("windows", "a.ftgs.ply", "ftgs"),
            ("checkpoint", "splats/ckpt_7.pt", "checkpoint"),
            ("params", "params/params.npz", "params"),
            ("network", "network/deform/iteration_7/deform.pth", "deform"),
        ):
            file = folder / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes((HERE / source / "whole").read_bytes())
            if name == "network":
                cloud = folder / "network/point_cloud/iteration_7/point_cloud.ply"
                cloud.parent.mkdir(parents=True)
                cloud.write_bytes(ply)
                (folder / "network/cfg_args").write_text("Namespace(sh_degree=1, source_path='data')")
            model = path.split("/")[0]
            frames = [] if name == "params" else ["--frames", "3"]
            keep = ["--count", str(COUNT - 1), "--no-refine", "--prune-only", "--archive-psnr", "30"]
            command = [program, "--quiet", "compress", model, "-o", f"{name}.gsz", *frames, *keep]
            subprocess.run(command, check=True, cwd=folder)
            write("archive", f"of_{name}", (folder / f"{name}.gsz").read_bytes())
        archive = (folder / "windows.gsz").read_bytes()

    stored, table, blobs = sections_of(archive)
    document = json.loads(table)
    parts, at = {}, len(blobs) - sum(length for _, length in document["files"])
    before = blobs[:at]
    for name, length in document["files"]:
        parts[name], at = blobs[at : at + length], at + length

    def with_layout(layout):
        files = parts | {"layout": layout.encode()}
        table = document | {"files": [[name, len(files[name])] for name in parts]}
        text = json.dumps(table, separators=(",", ":")).encode()
        return joined(text, stored[1], stored[2], before + b"".join(files.values()))

    text = parts["layout"].decode()
    write("archive_sections", "layout", with_layout(text))
    for name, old, new in (
        ("up", "model.ftgs.ply", "../model.ftgs.ply"),
        ("root", "model.ftgs.ply", "/model.ftgs.ply"),
        ("device", "model.ftgs.ply", "nul"),
        ("folder", '"folder":false', '"folder":true'),
        ("far", '"at":', '"at":9'),
        ("huge", '"at":', '"at":9999999999999'),
        ("plane", '"f32":0', '"f32":999'),
        ("negative", '"f32":0', '"f32":-1'),
        ("bytes", '{"f32":0}', '{"bytes":4}'),
        ("zeros", '{"f32":0}', '{"zeros":9999999999999}'),
        ("tensor", '"rows":', '"tensor":"a","rows":'),
        ("unknown", '"f32":0', '"f64":0'),
    ):
        assert old in text, (name, text)
        write("archive_sections", f"layout_{name}", with_layout(text.replace(old, new, 1)))
    write("archive_sections", "layout_no_json", with_layout("layout"))
    write("archive_sections", "layout_nested", with_layout("[" * 5000))


# --- models of other families ------------------------------------------------------------------------------------------


def saved(make, change=lambda data: data):
    """Returns a file like those of torch.save with the result of `make`, which calls its argument to get a tensor of a shape and
    values.
    """
    storages = []

    def tensor(shape, values=None, **view):
        values = normal(math.prod(shape), 0.3) if values is None else values
        storages.append(Storage(str(len(storages)), values))
        return Tensor(storages[-1], shape, **view)

    thing = make(tensor)
    data = {f"data/{storage.key}": floats(storage.values) for storage in storages}
    return zipped({"data.pkl": change(pickled(thing)), "byteorder": b"little", **data, "version": b"3\n"})


def moments(tensor, shape):
    return {"step": tensor((), [7.0]), "exp_avg": tensor(shape, [0.0] * math.prod(shape)), "exp_avg_sq": tensor(shape)}


SPLATS = {
    "means": (COUNT, 3), "scales": (COUNT, 3), "quats": (COUNT, 4), "opacities": (COUNT,), "sh0": (COUNT, 1, 3),
    "shN": (COUNT, 3, 3), "times": (COUNT, 1), "durations": (COUNT, 1), "velocities": (COUNT, 3),
}


def splats(**change):
    """Returns a gsplat checkpoint of moving Gaussians; `change` by name: a shape, or None to leave it out."""

    def make(tensor):
        shapes = {name: shape for name, shape in (SPLATS | change).items() if shape}
        state = {name: {0: moments(tensor, SPLATS[name])} for name in ("means", "times")}
        optimizers = {name: {"state": of, "param_groups": [{"lr": 0.1}]} for name, of in state.items()}
        tensors = OrderedDict((name, tensor(shape)) for name, shape in shapes.items())
        return {"step": 7, "splats": tensors, "optimizers": optimizers}

    return make


CAPTURE = {1: (COUNT, 3), 2: (COUNT, 1, 3), 3: (COUNT, 47, 3), 4: (COUNT, 3), 5: (COUNT, 4), 6: (COUNT, 1)}
CAPTURE_4D = {13: (COUNT, 1), 14: (COUNT, 1), 15: (COUNT, 4)}


def capture(change={}, length=19):
    """Returns the `capture` of a 4D Gaussian model, or of a 3D one with a length of 12; `change` by index."""

    def make(tensor):
        shapes = CAPTURE | CAPTURE_4D if length == 19 else CAPTURE | {3: (COUNT, 3, 3)}
        parts = {at: Parameter(tensor(shape)) for at, shape in shapes.items()}
        parts |= {0: 1, 7: tensor((COUNT,)), 8: tensor((COUNT, 1)), 9: tensor((COUNT, 1)), 10: {}, 11: 1.5}
        if length == 19:
            state = {"state": {0: moments(tensor, (COUNT, 3))}, "param_groups": [{"name": "xyz", "params": [0]}]}
            parts |= {10: tensor((COUNT, 1)), 11: state, 12: 1.5, 16: True, 17: None, 18: 2}
        parts |= {at: tensor(what) if isinstance(what, tuple) else what for at, what in change.items()}
        return (tuple(parts[at] for at in range(length)), 7)

    return make


def make_checkpoints():
    whole = saved(splats())
    start = whole.index(b"\x80\x02")
    damaged("checkpoint", whole, [0, 8, 26, start + 2, start + 60, len(whole) - 6, len(whole) - 12])
    for name, make in {
        "static": splats(times=None, durations=None, velocities=None),
        "no_means": splats(means=None),
        "no_durations": splats(durations=None),
        "no_bands": splats(shN=(COUNT, 0, 3)),
        "other_bands": splats(shN=(COUNT, 4, 3)),
        "fewer": splats(velocities=(COUNT - 1, 3)),
        "flat": splats(quats=(COUNT * 4,)),
        "none": splats(**{name: (0, *shape[1:]) for name, shape in SPLATS.items()}),
        "accels": splats(accels=(COUNT, 3)),
        "features": splats(features=(COUNT, 32)),
        "a_number": lambda tensor: {"step": 7, "splats": 3},
        "a_list": lambda tensor: {"splats": [tensor((3,))]},
        "native": capture(),
        "native_static": capture(length=12),
        "native_apart": capture({16: False}),
        "native_sky": capture({17: (3, 2, 2)}),
        "native_bands": capture({3: (COUNT, 30, 3)}),
        "native_fewer": capture({13: (COUNT - 1, 1)}),
        "native_flat": capture({15: (COUNT,)}),
        "native_number": capture({4: 3}),
        "native_terms": capture({18: 1 << 40}),
        "native_negative": capture({18: -1}),
        "native_optimizer": capture({11: {"state": [1, 2]}}),
        "native_short": lambda tensor: (tuple([1] * 13), 7),
        "pair": lambda tensor: (OrderedDict(a=tensor((2,))), OrderedDict(a=tensor((2,)))),
    }.items():
        write("checkpoint", name, saved(make))
    for name, view in {
        "strides": {"strides": (1, COUNT)},
        "repeated": {"strides": (0, 0)},
        "far": {"offset": 1 << 62},
        "overflow": {"strides": (1 << 63, 1)},
        "huge": {"shape": (1 << 32, 3)},
    }.items():

        def make(tensor, view=view):
            thing = splats()(tensor)
            thing["splats"]["means"] = tensor(**({"shape": (COUNT, 3), "values": normal(3 * COUNT)} | view))
            return thing

        write("checkpoint", name, saved(make))
    filled = splats()
    not_finite = saved(lambda tensor: filled(lambda shape, _=None: tensor(shape, [math.nan] * math.prod(shape))))
    write("checkpoint", "not_finite", not_finite)
    for name, data in {
        "command": b"cposix\nsystem\n(S'true'\ntR.",
        "itself": b"\x80\x02}q\x00(h\x00h\x00u.",
        "deep": b"\x80\x02" + b"]" * 3000 + b"a" * 2999 + b".",
    }.items():
        write("checkpoint", f"pickle_{name}", saved(splats(), lambda _, data=data: data))


def network(heads=("gaussian_warp", "gaussian_rotation", "gaussian_scaling"), prefix="", time=True, **change):
    """Returns a network of two layers, of which the second reads the encodings too."""
    of_time = 5 if time else 13
    layers = {"timenet.0": (WIDTH, 13), "timenet.2": (of_time, WIDTH)} if time else {}
    layers |= {"linear.0": (WIDTH, 63 + of_time), "linear.1": (WIDTH, WIDTH + 63 + of_time)}
    outputs = {"gaussian_warp": 3, "gaussian_rotation": 4, "gaussian_scaling": 3, "gaussian_opacity": 1}
    outputs |= {"branch_w": 3, "branch_v": 3}
    layers |= {head: (outputs[head], WIDTH) for head in heads}
    shapes = {}
    for name, shape in layers.items():
        shapes |= {f"{prefix}{name}.weight": shape, f"{prefix}{name}.bias": shape[:1]}
    return {name: shape for name, shape in (shapes | change).items() if shape}


NODES = {"nodes": (5, 3), "_node_radius": (5,), "_node_weight": (5, 1)}


def make_networks():
    def state(shapes):
        return saved(lambda tensor: OrderedDict((name, tensor(shape)) for name, shape in shapes.items()))

    whole = state(network())
    start = whole.index(b"\x80\x02")
    damaged("deform", whole, [0, 8, 26, start + 2, start + 60, len(whole) - 6, len(whole) - 12])
    screws = ("branch_w", "branch_v", "gaussian_rotation", "gaussian_scaling")
    of_nodes = network(("gaussian_warp", "gaussian_rotation", "gaussian_scaling", "gaussian_opacity"), "network.") | NODES
    for name, shapes in {
        "no_time": network(time=False),
        "screws": network(screws),
        "nodes": of_nodes,
        "no_nodes": of_nodes | {"nodes": (0, 3)},
        "flat_nodes": of_nodes | {"nodes": (5, 2)},
        "one_node": of_nodes | {"nodes": (1, 3), "_node_radius": (1,), "_node_weight": (1, 1)},
        "features": of_nodes | {"nodes": (5, 5)},
        "fewer_weights": of_nodes | {"_node_weight": (4, 1)},
        "no_layers": {"gaussian_warp.weight": (3, WIDTH)},
        "no_head": network(("gaussian_warp",)),
        "half_a_screw": network(("branch_w", "gaussian_rotation", "gaussian_scaling")),
        "even_time": network(**{"timenet.0.weight": (WIDTH, 12)}),
        "no_time_left": network(time=False, **{"linear.0.weight": (WIDTH, 63)}),
        "narrow": network(**{"linear.1.weight": (WIDTH, WIDTH)}),
        "no_outputs": network(**{"linear.1.weight": (0, WIDTH), "linear.1.bias": (0,)}),
        "no_bias": network(**{"linear.0.bias": None}),
        "a_vector": network(**{"linear.0.weight": (WIDTH,)}),
    }.items():
        write("deform", name, state(shapes))
    write("deform", "pair", saved(lambda tensor: (OrderedDict(a=tensor((2,))), OrderedDict(a=tensor((2,))))))
    infinite = {name: (shape, [math.inf] * math.prod(shape)) for name, shape in network().items()}
    write("deform", "not_finite", checkpoint(infinite))


def make_params():
    def array(shape, kind="<f4", values=None, order=False):
        text = f"{{'descr': '{kind}', 'fortran_order': {order}, 'shape': {shape}, }}"
        text += " " * (-(len(text) + 11) % 64) + "\n"
        values = floats(normal(math.prod(shape), 0.3)) if values is None else values
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + values

    def params(method=zipfile.ZIP_STORED, **change):
        frames = 3
        shapes = {
            "means3D": (frames, COUNT, 3), "rgb_colors": (frames, COUNT, 3), "unnorm_rotations": (frames, COUNT, 4),
            "seg_colors": (COUNT, 3), "logit_opacities": (COUNT, 1), "log_scales": (COUNT, 3), "cam_m": (2, 3), "cam_c": (2, 3),
        }
        arrays = {name: array(shape) for name, shape in shapes.items()} | change
        return zipped({f"{name}.npy": data for name, data in arrays.items() if data}, method, "")

    whole = params()
    start = whole.index(b"\x93NUMPY")
    damaged("params", whole, [0, 8, 26, start + 6, start + 8, start + 60, len(whole) - 6, len(whole) - 12])
    means = (3, COUNT, 3)
    for name, data in {
        "deflated": params(zipfile.ZIP_DEFLATED),
        "halves": params(means3D=array(means, "<f2", bytes(2 * math.prod(means)))),
        "doubles": params(means3D=array(means, "<f8", bytes(8 * math.prod(means)))),
        "objects": params(means3D=array(means, "|O")),
        "columns": params(means3D=array(means, order=True)),
        "no_means": params(means3D=None),
        "no_scales": params(log_scales=None),
        "fewer": params(rgb_colors=array((3, COUNT - 1, 3))),
        "frames": params(unnorm_rotations=array((2, COUNT, 4))),
        "no_frames": params(means3D=array((0, COUNT, 3))),
        "static": params(means3D=array((COUNT, 3)), cam_unnorm_rots=array((1, 4))),
        "many": params(means3D=array((1 << 40, 1 << 40, 3), values=b"")),
        "short": params(means3D=array(means, values=bytes(8))),
        "nan": params(means3D=array(means, values=floats([math.nan] * math.prod(means)))),
    }.items():
        write("params", name, data)


def make_splatv():
    def row():
        words = struct.pack("<3f", *normal(3, 0.5))
        words += struct.pack("<8e", *normal(4), 0.1, 0.1, 0.1, 0) + bytes([200, 100, 50, 255])
        return words + struct.pack("<16e", *normal(9, 0.1), 0, *normal(4, 0.1), DICE.random(), 0.5)

    def file(text, texture):
        text = text if isinstance(text, bytes) else json.dumps(text, separators=(",", ":")).encode()
        return struct.pack("<II", 0x674B, len(text)) + text + texture

    camera = {"id": 0, "img_name": "a", "width": 32, "height": 24, "position": [0, 0, 4], "fy": 40, "fx": 40}
    camera["rotation"] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    # The texture of a viewer is 4096 texels wide; the file states its own size.
    texture = b"".join(row() for _ in range(COUNT)) + bytes(64 * 2)
    entry = {"type": "splat", "size": len(texture), "texwidth": 8, "texheight": len(texture) // 128, "cameras": [camera]}
    whole = file([entry], texture)
    start = whole.index(texture)
    damaged("splatv", whole, [0, 4, 6, 8, start - 1, start, start + 14, start + 60])
    for name, change in {
        "size": {"size": 64},
        "huge": {"size": 1 << 36, "texwidth": 1 << 16, "texheight": 1 << 16},
        "negative": {"texwidth": -8},
        "wide": {"texwidth": 1 << 63},
        "text": {"texheight": "4"},
        "part": {"texheight": 0.5},
        "type": {"type": "other"},
        "no_cameras": {"cameras": None},
        "camera_number": {"cameras": 3},
        "part_of_a_gaussian": {"size": 16, "texwidth": 1, "texheight": 1},
    }.items():
        write("splatv", name, file([entry | change], texture))
    write("splatv", "none", file([entry | {"size": 0, "texheight": 0}], b""))
    write("splatv", "second", file([{"type": "other"}, entry], texture))
    write("splatv", "two", file([entry, entry], texture))
    write("splatv", "no_list", file(entry, texture))
    write("splatv", "no_json", file(b"[{]", texture))
    write("splatv", "nested", file(b"[" * 5000, texture))
    write("splatv", "long_text", struct.pack("<II", 0x674B, 0xFFFFFFFF) + whole[8:])
    write("splatv", "nan", file([entry], b"\xff" * len(texture)))
    write("splatv", "zeros_only", file([entry], bytes(len(texture))))


def make_spz():
    degree = 1
    rows = {"positions": 9, "opacities": 1, "colors": 3, "scales": 3, "rotations": 4, "harmonics": 9}
    arrays = {name: bytes(DICE.randrange(256) for _ in range(COUNT * width)) for name, width in rows.items()}

    def header(version, count=COUNT, degree=degree, bits=12, flags=0, streams=0):
        return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, streams)

    def gzipped(version, data=None, **fields):
        data = b"".join(arrays.values()) if data is None else data
        return gzip.compress(header(version, **fields) + data, mtime=0)

    def streams(sizes=None, offset=32, extension=b"", **fields):
        frames = [zstandard.ZstdCompressor(level=3).compress(array) for array in arrays.values()]
        sizes = sizes or [(len(frame), len(array)) for frame, array in zip(frames, arrays.values())]
        table = b"".join(struct.pack("<QQ", *pair) for pair in sizes)
        head = header(4, **({"streams": len(frames)} | fields)) + struct.pack("<I12x", offset) + extension
        return head + table + b"".join(frames)

    whole = streams()
    damaged("spz", whole, [0, 4, 8, 12, 13, 14, 15, 16, 32, 40, 48, 32 + 96, 32 + 100, len(whole) - 3])
    cut_rotations = arrays["rotations"][: 3 * COUNT]
    for name, data in {
        "version_3": gzipped(3),
        "version_2": gzipped(2, b"".join((arrays | {"rotations": cut_rotations}).values())),
        "version_1": gzipped(1),
        "version_4_gzip": gzipped(4),
        "gzip_cut": gzipped(3)[:-20],
        "gzip_checksum": gzipped(3)[:-8] + bytes(8),
        "gzip_short": gzipped(3, b"\0" * 50),
        "gzip_more": gzipped(3, b"".join(arrays.values()) + bytes(5)),
        "gzip_extension": gzipped(3, b"".join(arrays.values()) + struct.pack("<III", 0xADBE0003, 4, 1), flags=2),
        "gzip_many": gzipped(3, count=0xFFFFFFFF),
        "gzip_none": gzipped(3, b"", count=0),
        "degree_5": gzipped(3, degree=5),
        "degree_4": gzipped(3, b"\x80" * COUNT * (20 + 72), degree=4),
        "bits_255": gzipped(3, bits=255),
        "many": streams(count=1 << 31),
        "streams_0": streams(streams=0),
        "offset_0": streams(offset=0),
        "offset_far": streams(offset=0xFFFFFFFF),
        "extension": streams(offset=44, extension=struct.pack("<III", 0xADBE0002, 4, 0), flags=2),
        "size_zero": streams(sizes=[(0, 54)] * 6),
        "size_huge": streams(sizes=[(1 << 63, 54)] * 6),
        "size_wrong": streams(sizes=[(60, 1 << 40)] * 6),
        "raw_version_3": header(3) + b"".join(arrays.values()),
    }.items():
        write("spz", name, data)


def make_splat():
    def row():
        return floats([*normal(3), *(math.exp(x) for x in normal(3, 0.5, -3))]) + bytes(DICE.randrange(256) for _ in range(8))

    whole = b"".join(row() for _ in range(COUNT))
    damaged("splat", whole, [0, 12, 24, 28])
    write("splat", "nan", floats([math.nan] * 6) + bytes(8))
    write("splat", "negative_scale", floats([0, 0, 0, -1, 0, 1e30]) + bytes(8))
    write("splat", "zero_quaternion", floats([0, 0, 0, 1, 1, 1]) + bytes([9, 9, 9, 9, 128, 128, 128, 128]))


def make_compressed_ply():
    bounds = [f"{end}_{name}" for group in (["x", "y", "z"], ["scale_x", "scale_y", "scale_z"], ["r", "g", "b"])
              for end in ("min", "max") for name in group]
    packed = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]

    def header(chunks=1, count=COUNT, rest=9, form="binary_little_endian", bounds=bounds, packed=packed, sh=COUNT):
        lines = ["ply", f"format {form} 1.0", f"element chunk {chunks}", *(f"property float {name}" for name in bounds)]
        lines += [f"element vertex {count}", *(f"property uint {name}" for name in packed)]
        if rest:
            lines += [f"element sh {sh}", *(f"property uchar f_rest_{k}" for k in range(rest))]
        return "\n".join([*lines, "end_header", ""]).encode()

    ranges = floats([-1, -2, -3, 1, 3, 5, -8, -7, -6, 0, 0, 1, 0, 0.5, -0.5, 1, 1, 1.5])
    words = struct.pack(f"<{4 * COUNT}I", *(DICE.randrange(1 << 32) for _ in range(4 * COUNT)))
    body = ranges + words + bytes(DICE.randrange(256) for _ in range(9 * COUNT))
    whole = header() + body
    damaged("compressed_ply", whole, [0, 4, 50, len(header()) - 3, len(header()) + 3, len(header()) + 75])
    for name, data in {
        "no_chunk": header(chunks=0) + body,
        "many_chunks": header(chunks=1 << 60) + body,
        "many": header(count=1 << 33) + body,
        "no_sh": header(rest=0) + ranges + words,
        "sh_10": header(rest=10) + body,
        "sh_rows": header(sh=2) + body,
        "no_colors": header(bounds=bounds[:12], rest=0) + ranges[:48] + words,
        "no_min_x": header(bounds=["low_x", *bounds[1:]]) + body,
        "no_scale": header(packed=[*packed[:2], "packed_size", packed[3]]) + body,
        "ascii": header(form="ascii") + body,
        "nan": header() + floats([math.nan] * 18) + words + bytes(9 * COUNT),
    }.items():
        write("compressed_ply", name, data)


def make_glb():
    extension = "KHR_gaussian_splatting"
    columns = {"POSITION": (3, normal(3 * COUNT)), f"{extension}:ROTATION": (4, normal(4 * COUNT)),
               f"{extension}:SCALE": (3, [math.exp(x) for x in normal(3 * COUNT, 0.5, -3)]),
               f"{extension}:OPACITY": (1, [DICE.random() for _ in range(COUNT)])}
    for degree in (0, 1):
        columns |= {f"{extension}:SH_DEGREE_{degree}_COEF_{k}": (3, normal(3 * COUNT, 0.3)) for k in range(2 * degree + 1)}
    binary, views, accessors = b"", [], []
    for index, (width, values) in enumerate(columns.values()):
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": 4 * len(values)})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[width]
        accessors.append({"bufferView": index, "componentType": 5126, "count": COUNT, "type": kind})
        binary += floats(values)
    primitive = {"attributes": {name: index for index, name in enumerate(columns)}, "mode": 0,
                 "extensions": {extension: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}}
    document = {"asset": {"version": "2.0"}, "extensionsUsed": [extension], "nodes": [{"mesh": 0}],
                "meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": views,
                "buffers": [{"byteLength": len(binary)}]}

    def packed(document, binary=binary):
        text = document if isinstance(document, bytes) else json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        whole = 28 + len(text) + len(binary)
        return (struct.pack("<4sIII4s", b"glTF", 2, whole, len(text), b"JSON") + text
                + struct.pack("<I4s", len(binary), b"BIN\0") + binary)

    def edited(*path, value):
        changed = json.loads(json.dumps(document))
        at = changed
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value
        return packed(changed)

    whole = packed(document)
    start = len(whole) - len(binary)
    damaged("glb", whole, [0, 4, 8, 12, 16, start - 8, start - 4, start + 3])
    for name, data in {
        "no_primitive": edited("meshes", 0, "primitives", value=[]),
        "two_primitives": edited("meshes", 0, "primitives", value=[primitive, primitive]),
        "kernel": edited("meshes", 0, "primitives", 0, "extensions", extension, value={"kernel": 3}),
        "compressed": edited("meshes", 0, "primitives", 0, "attributes", value={}),
        "turned": edited("nodes", 0, value={"mesh": 0, "rotation": [0, 0, 1, 0]}),
        "moved": edited("nodes", 0, value={"mesh": 0, "translation": [0, 0, 1]}),
        "child": edited("nodes", value=[{"mesh": 0}, {"children": [0, 9], "scale": [2, 2, 2]}]),
        "count_many": edited("accessors", 0, "count", value=1 << 62),
        "count_less": edited("accessors", 0, "count", value=2),
        "count_none": edited("accessors", 0, "count", value=0),
        "view_far": edited("bufferViews", 0, "byteOffset", value=(1 << 64) - 1),
        "stride_0": edited("bufferViews", 0, "byteStride", value=0),
        "stride_huge": edited("bufferViews", 0, "byteStride", value=1 << 63),
        "stride_equal": edited("bufferViews", 0, "byteStride", value=12),
        "rotation_bytes": edited("accessors", 1, "componentType", value=5120),
        "scale_shorts": edited("accessors", 2, "componentType", value=5123),
        "position_bytes": edited("accessors", 0, "componentType", value=5121),
        "type": edited("accessors", 3, "type", value="VEC2"),
        "no_view": edited("accessors", 0, "bufferView", value=-1),
        "no_json": packed(b"[" * 400),
        "no_text": packed(b""),
        "nan": packed(document, b"\xff" * len(binary)),
        "zeros_only": packed(document, bytes(len(binary))),
        "long_text": whole[:12] + b"\xff\xff\xff\xff" + whole[16:],
    }.items():
        write("glb", name, data)


def make_sog(program, ply):
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        (folder / "a.ply").write_bytes(ply)
        subprocess.run([program, "--quiet", "convert", "a.ply", "a.sog"], check=True, cwd=folder)
        whole = (folder / "a.sog").read_bytes()
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])

    def packed(changed, method=zipfile.ZIP_STORED, **extra):
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", method) as archive:
            for name, data in {**files, "meta.json": json.dumps(changed, separators=(",", ":")), **extra}.items():
                archive.writestr(zipfile.ZipInfo(name), data, method)
        return out.getvalue()

    def edited(*path, value):
        changed = json.loads(files["meta.json"])
        at = changed
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value
        return packed(changed)

    image = whole.index(b"RIFF")
    damaged("sog", whole, [0, 8, 26, image, image + 12, image + 21, image + 24, image + 30, len(whole) - 12, len(whole) - 6])
    huge = files["quats.webp"][:21] + b"\xff\xff\xff\x0f" + files["quats.webp"][25:]
    for name, data in {
        "deflated": packed(meta, zipfile.ZIP_DEFLATED),
        "version_1": edited("version", value=1),
        "version_text": edited("version", value="2"),
        "count_0": edited("count", value=0),
        "count_many": edited("count", value=1 << 40),
        "count_more": edited("count", value=1000),
        "count_text": edited("count", value="6"),
        "no_means": packed({key: value for key, value in meta.items() if key != "means"}),
        "mins_far": edited("means", "mins", value=[1e300] * 3),
        "mins_two": edited("means", "mins", value=[0, 0]),
        "path": edited("means", "files", value=["../../a.ply", "means_u.webp"]),
        "codebook_empty": edited("scales", "codebook", value=[]),
        "codebook_null": edited("scales", "codebook", value=[None] * 256),
        "codebook_long": edited("sh0", "codebook", value=[0.5] * 300),
        "codebook_short": edited("sh0", "codebook", value=[0.5]),
        "bands": edited("shN", "bands", value=3),
        "labels": edited("shN", "count", value=2),
        "centroids": edited("shN", "files", value=["quats.webp", "quats.webp"]),
        "no_image": edited("quats", "files", value=["none.webp"]),
        "no_json": packed(meta, **{"meta.json": b"{" * 3000}),
        "huge_image": packed(meta, **{"quats.webp": huge}),
        "text_image": packed(meta, **{"sh0.webp": b"no image"}),
        "empty_image": packed(meta, **{"means_u.webp": b""}),
    }.items():
        write("sog", name, data)


def make_stills(program, ply):
    # Independent of the random numbers used before.
    DICE.seed(17)
    make_spz()
    make_splat()
    make_compressed_ply()
    make_sog(program, ply)
    make_glb()


def make_spacetime():
    """Writes point clouds of SpacetimeGaussians, whose loader counts properties by prefix."""
    lite = ["x", "y", "z", "trbf_center", "trbf_scale", "nx", "ny", "nz", *(f"motion_{k}" for k in range(9))]
    rest = ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)), *(f"omega_{k}" for k in range(4))]
    of_lite = [*lite, *(f"f_dc_{k}" for k in range(3)), *rest]
    of_full = [*lite, *(f"f_dc_{k}" for k in range(6)), *rest, *(f"f_t_{k}" for k in range(3))]
    for name, names in {
        "spacetime": of_lite, "spacetime_full": of_full, "spacetime_no_omega": of_lite[:-1], "spacetime_features": of_full[:-1],
        "spacetime_rest": [*of_lite, "f_rest_0"], "spacetime_no_scale": [name for name in of_lite if name != "trbf_scale"],
    }.items():
        write("ply", name, header(names=names) + floats(normal(len(names) * COUNT, 0.3)))
    write("ply", "spacetime_nan", header(names=of_lite) + floats([math.nan] * len(of_lite) * COUNT))
    write("ply", "spacetime_largest", header(names=of_lite) + floats([3.4e38] * len(of_lite) * COUNT))


def make_ftgs():
    names = [*NAMES, "time", "log_duration", *(f"velocity_{k}" for k in range(3))]
    comments = ["ftgs_version 1", "time_units normalized", "sh_degree 1", "use_velocity 1", "min_duration 0.02"]
    comments = [*comments, "opacity_floor 0.0001", "n_frames 30", "splatsieve_times 0.5 2.5"]
    text = header(names=names).replace(b"element", "".join(f"comment {line}\n" for line in comments).encode() + b"element")
    rows = [[*row(), DICE.random(), *normal(4, 0.5, -1)] for _ in range(COUNT)]
    whole = text + b"".join(map(floats, rows))
    damaged("ftgs", whole, [0, 60, len(text) - 2, len(text) + 3, len(whole) - 1])
    for name, before, after in (
        ("version", b"ftgs_version 1", b"ftgs_version 2"),
        ("no_version", b"comment ftgs_version 1\n", b""),
        ("seconds", b"normalized", b"seconds"),
        ("degree", b"sh_degree 1", b"sh_degree 9"),
        ("not_used", b"use_velocity 1", b"use_velocity 0"),
        ("no_duration", b"min_duration 0.02", b"min_duration 0"),
        ("infinite_duration", b"min_duration 0.02", b"min_duration inf"),
        ("floor", b"0.0001", b"1e400"),
        ("many_frames", b"n_frames 30", b"n_frames 99999999999999999999"),
        ("times_back", b"0.5 2.5", b"2.5 0.5"),
        ("times_equal", b"0.5 2.5", b"1e300 1e300"),
        ("one_time", b"0.5 2.5", b"0.5"),
        ("no_velocity", b"velocity_1", b"velocity_x"),
        ("none", b"vertex 6", b"vertex 0"),
    ):
        write("ftgs", name, whole.replace(before, after, 1))
    for name, value in (("nan", math.nan), ("infinite", math.inf), ("largest", 3.4e38), ("zeros_only", 0.0)):
        write("ftgs", name, text + floats([value] * len(names) * COUNT))


def webp(pixels, width):
    """Returns a lossless WebP of pixels (red, green, blue, alpha), with codes of eight bits for every byte."""
    bits = []

    def put(value, count):
        bits.extend(value >> k & 1 for k in range(count))

    height = len(pixels) // width
    put(0x2F, 8), put(width - 1, 14), put(height - 1, 14), put(1, 1), put(0, 3)
    # Neither a transform, nor a color cache, nor several groups of codes.
    put(0, 3)
    for symbols in (280, 256, 256, 256):
        # The lengths of codes are 0 or 8; in the order of the format these are the third and the twelfth length.
        put(0, 1), put(12 - 4, 4)
        for k in range(12):
            put(1 if k in (2, 11) else 0, 3)
        put(0, 1)
        for symbol in range(symbols):
            put(1 if symbol < 256 else 0, 1)
    # A code of distances with one symbol, 0.
    put(1, 1), put(0, 1), put(0, 1), put(0, 1)
    for red, green, blue, alpha in pixels:
        for value in (green, red, blue, alpha):
            bits.extend(value >> k & 1 for k in range(7, -1, -1))
    bits += [0] * (-len(bits) % 16)
    data = bytes(sum(bit << k for k, bit in enumerate(bits[at : at + 8])) for at in range(0, len(bits), 8))
    chunk = b"WEBPVP8L" + struct.pack("<I", len(data)) + data
    return b"RIFF" + struct.pack("<I", len(chunk)) + chunk


def make_tsog():
    def image(alpha=255):
        tag = DICE.randrange(252, 256) if alpha == "tag" else alpha
        return webp([tuple([*(DICE.randrange(256) for _ in range(3)), tag]) for _ in range(16)], 4)

    def labels():
        return webp([(DICE.randrange(3), 0, 0, 255) for _ in range(16)], 4)

    book = sorted(round(value, 4) for value in normal(256))
    files = {"means_l.webp": image(), "means_u.webp": image(), "scales.webp": image(), "quats.webp": image("tag")}
    files |= {"sh0.webp": image(200), "timeline_l.webp": image(), "timeline_u.webp": image(), "motion.webp": image()}
    of_sh = {"centroids.webp": webp([(1, 2, 3, 255)] * 192, 192), "labels.webp": labels()}
    meta = {
        "version": 4,
        "count": COUNT,
        "means": {"mins": [-1, -1, -1], "maxs": [1, 1, 1], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": book, "files": ["sh0.webp"]},
        "profile": {"id": "org.opsiclear.tsog-playback", "version": 1},
        "timeline": {"type": 1, "mins": [0, 0.1], "maxs": [1, 2], "files": ["timeline_l.webp", "timeline_u.webp"]},
        "temporal": {"means": {"mins": [[-1, -1, -1]], "maxs": [[1, 1, 1]], "files": ["motion.webp"]}},
        "fps": 30,
        "playback": {"duration": 1.0, "fps": 30},
    }
    sh_n = {"bands": 1, "count": 3, "codebook": book, "files": ["centroids.webp", "labels.webp"]}

    def file(meta, files=files, method=zipfile.ZIP_STORED):
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", method) as archive:
            for name, data in [*files.items(), ("meta.json", meta if isinstance(meta, bytes) else json.dumps(meta))]:
                archive.writestr(zipfile.ZipInfo(name), data, method)
        return out.getvalue()

    whole = file(meta)
    list_of_files = whole.index(b"PK\x01\x02")
    damaged("tsog", whole, [0, 26, 30, 60, list_of_files, list_of_files + 20, len(whole) - 22, len(whole) - 12])
    write("tsog", "deflated", file(meta, method=zipfile.ZIP_DEFLATED))
    write("tsog", "harmonics", file(meta | {"shN": sh_n}, files | of_sh))
    write("tsog", "label_beyond", file(meta | {"shN": sh_n | {"count": 1}}, files | of_sh))
    write("tsog", "bands", file(meta | {"shN": sh_n | {"bands": 3}}, files | of_sh))
    frames = {"type": 0, "N": 5, "delta": 13107, "files": meta["timeline"]["files"]}
    single = {key: value for key, value in meta.items() if key != "temporal"}
    write("tsog", "frames", file(single | {"timeline": frames}))
    write("tsog", "still", file({key: value for key, value in single.items() if key != "timeline"}))
    write("tsog", "motion_of_frames", file(meta | {"timeline": frames}))
    for name, change in {
        "version": {"version": 2},
        "none": {"count": 0},
        "more_than_pixels": {"count": 17},
        "many": {"count": 1 << 62},
        "negative": {"count": -1},
        "no_means": {"means": {}},
        "range_back": {"means": meta["means"] | {"mins": [2, 2, 2]}},
        "range_wide": {"means": meta["means"] | {"maxs": [1e9, 1e9, 1e9]}},
        "short_book": {"scales": {"codebook": [1.0], "files": ["scales.webp"]}},
        "empty_book": {"sh0": {"codebook": [], "files": ["sh0.webp"]}},
        "null_book": {"sh0": {"codebook": [None] * 256, "files": ["sh0.webp"]}},
        "no_tag": {"quats": {"files": ["sh0.webp"]}},
        "null_timeline": {"timeline": None},
        "no_width": {"timeline": meta["timeline"] | {"mins": [0, 0]}},
        "type": {"timeline": meta["timeline"] | {"type": 7}},
        "many_frames": {"timeline": frames | {"N": 1 << 40}},
        "delta": {"timeline": frames | {"delta": 0}},
        "fast": {"temporal": {"means": {"mins": [[-3e38] * 3], "maxs": [[3e38] * 3], "files": ["motion.webp"]}}},
        "turning": {"temporal": meta["temporal"] | {"rotation": {}}},
        "three_images": {"temporal": {"means": meta["temporal"]["means"] | {"files": ["motion.webp"] * 3}}},
        "duration": {"playback": {"duration": 1e300}},
        "rate": {"fps": 0},
        "missing_image": {"quats": {"files": ["other.webp"]}},
        "path": {"quats": {"files": ["../meta.json"]}},
        "meta_as_image": {"quats": {"files": ["meta.json"]}},
    }.items():
        write("tsog", name, file(meta | change))
    write("tsog", "no_json", file(b"{"))
    write("tsog", "nested", file(b"[" * 5000))
    write("tsog", "no_meta", file(meta).replace(b"meta.json", b"mate.json"))
    write("tsog", "large_image", file(meta, files | {"motion.webp": webp([(0, 0, 0, 255)] * 16, 16)[:21] + b"\xff" * 200}))


def make_families():
    # Independent of the random numbers used before.
    DICE.seed(16)
    make_checkpoints()
    make_networks()
    make_params()
    make_splatv()
    make_spacetime()
    make_ftgs()
    make_tsog()


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    program = Path(sys.argv[1]).resolve()
    ply = make_ply()
    write("cfg_args", "whole", make_cfg_args())
    make_pickle()
    make_recipe(program)
    make_cameras()
    make_colmap()
    make_frames(program, ply)
    make_families()
    make_layouts(program, ply)
    make_stills(program, ply)


if __name__ == "__main__":
    main()
