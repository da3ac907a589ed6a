#!/usr/bin/env python3
"""Makes tests/data/tiny_model: a 4DGaussians model folder small enough for the repository.

    python3 scripts/make_fixture.py [FOLDER]          (default: tests/data/tiny_model)

Needs numpy and PyTorch; README.md in the folder names the versions that made the present files. Nothing is trained: a
seeded field with all five heads moves a seeded point cloud with the features that compression examines: tight groups
that move together, isolated Gaussians, needles, dead and fading Gaussians.

Besides the files of a model folder and its cameras, the script writes:
  states.npz          states at FRAMES_KEPT as PyTorch evaluates them in float64, SH at the last of these frames
  statistics_f64.npz  life, V, D and kappa over all frames, by the definitions of tests/compression/trained_models.rs
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import json
import math
import platform
import sys
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

SEED = 20260
FRAMES = 10
FRAMES_KEPT = [0, 4, 9]
WIDTH, CHANNELS, RESOLUTION, MULTIRES = 16, 4, [8, 8, 8, 6], [1, 2]
HEADS = {"pos_deform": 3, "scales_deform": 3, "rotations_deform": 4, "opacity_deform": 1, "shs_deform": 48}
# Typical size of the delta of each head: a scene about 2 units wide, opacities that fade, colors that shift.
REACH = {"pos_deform": 0.15, "scales_deform": 0.1, "rotations_deform": 0.1, "opacity_deform": 1.5, "shs_deform": 0.05}
AXES = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
ALPHA_MIN = 0.01


def make_cloud(rng):
    """Returns raw parameters [N, ...]: 60 groups of four near-copies, 50 isolated Gaussians, 6 dead, 4 needles."""

    def draw(n):
        return {
            "position": rng.uniform(-0.8, 0.8, (n, 3)),
            "log_scale": rng.normal(math.log(0.05), 0.5, (n, 3)),
            "rotation": rng.normal(0, 1, (n, 4)),
            "opacity": rng.uniform(-5, 4, (n, 1)),
            "sh": np.concatenate([rng.normal(0.3, 0.6, (n, 1, 3)), rng.normal(0, 0.08, (n, 15, 3))], axis=1),
        }

    leaders = draw(60)
    groups = {key: np.repeat(value, 4, axis=0) for key, value in leaders.items()}
    noise = {"position": 0.004, "log_scale": 0.05, "rotation": 0.02, "opacity": 0.2, "sh": 0.01}
    for key, size in noise.items():
        groups[key] = groups[key] + rng.normal(0, size, groups[key].shape)
    loners, dead, needles = draw(50), draw(6), draw(4)
    dead["opacity"][:] = -12
    needles["log_scale"][:, 0] = math.log(0.4)
    needles["log_scale"][:, 1:] = math.log(0.002)
    cloud = {key: np.concatenate([part[key] for part in (groups, loners, dead, needles)]) for key in groups}
    order = rng.permutation(len(cloud["position"]))
    return {key: value[order].astype(np.float32) for key, value in cloud.items()}


def make_field(generator):
    """Returns a state dict with the names, shapes and types of the original."""

    def normal(*shape, std):
        return torch.randn(*shape, generator=generator) * std

    state = {"deformation_net.grid.aabb": torch.tensor([[1.6] * 3, [-1.6] * 3])}
    for level, times in enumerate(MULTIRES):
        size = [r * times for r in RESOLUTION[:3]] + RESOLUTION[3:]
        for plane, (a, b) in enumerate(AXES):
            # Around 1, so that products of six stay of order 1.
            state[f"deformation_net.grid.grids.{level}.{plane}"] = 1 + normal(1, CHANNELS, size[b], size[a], std=0.3)
    inputs = CHANNELS * len(MULTIRES)
    layers = {"feature_out.0": (inputs, WIDTH)}
    for head, outputs in HEADS.items():
        layers[f"{head}.1"], layers[f"{head}.3"] = (WIDTH, WIDTH), (WIDTH, outputs)
    for name, (fan_in, fan_out) in layers.items():
        reach = REACH[name[:-2]] if name.endswith(".3") else 1.4
        state[f"deformation_net.{name}.weight"] = normal(fan_out, fan_in, std=reach / math.sqrt(fan_in))
        state[f"deformation_net.{name}.bias"] = normal(fan_out, std=0.1 * reach)
    # Stored by the original, but never read.
    state["deformation_net.timenet.0.weight"] = normal(4, 9, std=1.0)
    state["time_poc"] = torch.tensor([1.0, 2.0, 4.0, 8.0])
    return state


def evaluate(cloud, state, time):
    """Returns the activated state at `time` in float64, by the description of the 4DGaussians format."""
    w = {key: value.double() for key, value in state.items()}
    raw = {key: torch.from_numpy(value).double() for key, value in cloud.items()}
    high, low = w["deformation_net.grid.aabb"]
    u = (raw["position"] - high) * 2 / (low - high) - 1
    # The time is used as a coordinate directly, not mapped to [-1, 1]; the field receives it as float32.
    t = float(np.float32(time))
    u = torch.cat([u, torch.full_like(u[:, :1], t)], dim=1)
    levels = []
    for level in range(len(MULTIRES)):
        product = 1
        for plane, (a, b) in enumerate(AXES):
            at = u[:, [a, b]].view(1, 1, -1, 2)
            grid = w[f"deformation_net.grid.grids.{level}.{plane}"]
            sample = F.grid_sample(grid, at, mode="bilinear", padding_mode="border", align_corners=True)
            product = product * sample[0, :, 0].T
        levels.append(product)

    def linear(x, name):
        return x @ w[f"deformation_net.{name}.weight"].T + w[f"deformation_net.{name}.bias"]

    hidden = linear(torch.cat(levels, dim=1), "feature_out.0")
    delta = {name: linear(linear(hidden.relu(), f"{name}.1").relu(), f"{name}.3") for name in HEADS}
    return {
        "xyz": (raw["position"] + delta["pos_deform"]).numpy(),
        "scales": (raw["log_scale"] + delta["scales_deform"]).exp().numpy(),
        "rotation": F.normalize(raw["rotation"] + delta["rotations_deform"]).numpy(),
        "opacity": (raw["opacity"] + delta["opacity_deform"]).sigmoid().numpy(),
        "sh": (raw["sh"] + delta["shs_deform"].view(-1, 16, 3)).numpy(),
    }


def statistics(xyz, opacity):
    """Returns statistics per Gaussian from positions [T, N, 3] and opacities [T, N]; all steps have one frame."""
    frames, count = opacity.shape
    life = opacity >= ALPHA_MIN
    step = ((xyz[1:] - xyz[:-1]) ** 2).sum(axis=2)
    bend = np.sqrt(((xyz[2:] - 2 * xyz[1:-1] + xyz[:-2]) ** 2).sum(axis=2))
    out = {key: np.zeros(count) for key in ("V", "D_literal", "kappa_literal", "D_runs", "kappa_runs")}
    for i in range(count):
        alive = np.flatnonzero(life[:, i])
        if len(alive) == 0:
            continue
        out["V"][i] = opacity[alive, i].var()
        out["D_literal"][i] = math.sqrt(sum(step[t - 1, i] for t in alive if t > 0) / len(alive))
        inner = alive[1:-1]
        out["kappa_literal"][i] = sum(bend[t - 1, i] for t in inner) / max(len(inner), 1)
        steps = [step[t - 1, i] for t in alive if t > 0 and life[t - 1, i]]
        bends = [bend[t - 1, i] for t in inner if life[t - 1, i] and life[t + 1, i]]
        out["D_runs"][i] = math.sqrt(np.mean(steps)) if steps else 0
        out["kappa_runs"][i] = np.mean(bends) if bends else 0
    return {"life_frames": life.sum(axis=0).astype(np.int32), **out}


def write_ply(cloud, path):
    count = len(cloud["position"])
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rest = cloud["sh"][:, 1:].transpose(0, 2, 1).reshape(count, 45)
    columns = [cloud["position"], np.zeros((count, 3)), cloud["sh"][:, 0], rest]
    columns += [cloud["opacity"], cloud["log_scale"], cloud["rotation"]]
    rows = np.concatenate(columns, axis=1).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())


def write_cameras(folder):
    """Writes a ring of cameras at radius 4; every third is a test camera."""
    shots = {"train": [], "test": []}
    for frame in range(FRAMES):
        for view in range(6):
            angle = 2 * math.pi * view / 6
            back = np.array([math.cos(angle), math.sin(angle), 0.25])
            back /= np.linalg.norm(back)
            right = np.cross([0, 0, 1], back)
            right /= np.linalg.norm(right)
            matrix = np.eye(4)
            matrix[:3] = np.column_stack([right, np.cross(back, right), back, 4 * back])
            split = "test" if view % 3 == 2 else "train"
            shots[split].append({
                "file_path": f"./{split}/t{frame:03}_v{view:02}",
                "time": frame / (FRAMES - 1),
                "transform_matrix": matrix.tolist(),
            })
    for split, frames in shots.items():
        data = {"camera_angle_x": 0.7, "w": 64, "h": 64, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(data) + "\n")


def main():
    default = Path(__file__).resolve().parent.parent / "tests" / "data" / "tiny_model"
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    iteration = folder / "point_cloud" / "iteration_7"
    iteration.mkdir(parents=True, exist_ok=True)
    cloud = make_cloud(np.random.default_rng(SEED))
    state = make_field(torch.Generator().manual_seed(SEED))
    count = len(cloud["position"])
    write_ply(cloud, iteration / "point_cloud.ply")
    torch.save(state, iteration / "deformation.pth")
    torch.save(torch.ones(count, dtype=torch.bool), iteration / "deformation_table.pth")
    torch.save(torch.zeros(count, 3), iteration / "deformation_accum.pth")
    planes = {
        "grid_dimensions": 2,
        "input_coordinate_dim": 4,
        "output_coordinate_dim": CHANNELS,
        "resolution": RESOLUTION,
    }
    # `source_path` is the folder itself, relative to its parent: cameras are found without being named.
    (folder / "cfg_args").write_text(
        f"Namespace(sh_degree=3, source_path={folder.name!r}, model_path='output/tiny', white_background=False, "
        f"eval=True, net_width={WIDTH}, defor_depth=1, bounds=1.6, kplanes_config={planes}, multires={MULTIRES}, "
        "no_dx=False, no_grid=False, no_ds=False, no_dr=False, no_do=False, no_dshs=False, empty_voxel=False, "
        "grid_pe=0, static_mlp=False, apply_rotation=False)"
    )
    write_cameras(folder)

    times = np.array([frame / (FRAMES - 1) for frame in range(FRAMES)])
    states = [evaluate(cloud, state, time) for time in times]
    kept = {key: np.stack([states[frame][key] for frame in FRAMES_KEPT]) for key in states[0] if key != "sh"}
    sh = {f"sh_t{FRAMES_KEPT[-1]}": states[FRAMES_KEPT[-1]]["sh"].astype(np.float32)}
    np.savez_compressed(folder / "states.npz", frames=np.array(FRAMES_KEPT), times=times[FRAMES_KEPT], **kept, **sh)
    found = statistics(np.stack([s["xyz"] for s in states]), np.stack([s["opacity"][:, 0] for s in states]))
    np.savez_compressed(folder / "statistics_f64.npz", **found)
    versions = f"Python {platform.python_version()}, numpy {np.__version__}, PyTorch {torch.__version__}"
    (folder / "README.md").write_text(
        f"Made by scripts/make_fixture.py with {versions}. Its header says what the files are.\n"
    )
    life = found["life_frames"]
    print(f"{count} Gaussians; life {np.bincount(life, minlength=FRAMES + 1)}; D up to {found['D_runs'].max():.3f}")


if __name__ == "__main__":
    main()
