#!/usr/bin/env python3
"""Measures how fast PyTorch evaluates the states of other model formats with their own code, for comparison with
benches/families.rs.

    pip install torch
    python3 scripts/torch_speed.py [GAUSSIANS]           (100000 unless given)

Prints microseconds of one processor per Gaussian and frame, the median of several runs; other load on the machine does
not count. Weights and parameters are random: only their shapes matter. Networks are evaluated in blocks of 1024
Gaussians as in the benchmark, and of 16384; everything else at once.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import statistics
import sys
import time

import torch
from torch import nn

WIDTH, DEPTH, OCTAVES, OCTAVES_OF_TIME, OF_TIME = 256, 8, 10, 6, 30
NODES, NEAREST, HYPER = 256, 3, 2
SECONDS = 3.0


def sines(x, octaves):
    """Encodes `x` like `Embedder.embed`."""
    parts = [x]
    for k in range(octaves):
        parts += [torch.sin(x * 2.0**k), torch.cos(x * 2.0**k)]
    return torch.cat(parts, -1)


class Network(nn.Module):
    """Network like `DeformNetwork` of Deformable-3D-Gaussians with a time network, which SC-GS uses for its nodes."""

    def __init__(self):
        super().__init__()
        place, of_time = 3 + 6 * OCTAVES, 1 + 2 * OCTAVES_OF_TIME
        self.timenet = nn.Sequential(nn.Linear(of_time, WIDTH), nn.ReLU(inplace=True), nn.Linear(WIDTH, OF_TIME))
        inputs = place + OF_TIME
        widths = [inputs, *([WIDTH] * (DEPTH - 1))]
        widths[DEPTH // 2 + 1] += inputs
        self.linear = nn.ModuleList(nn.Linear(width, WIDTH) for width in widths)
        self.heads = nn.ModuleList(nn.Linear(WIDTH, outputs) for outputs in (3, 4, 3))

    def forward(self, x, time):
        encoded = torch.cat([sines(x, OCTAVES), self.timenet(sines(time, OCTAVES_OF_TIME))], -1)
        h = encoded
        for k, layer in enumerate(self.linear):
            h = torch.relu(layer(h))
            if k == DEPTH // 2:
                h = torch.cat([encoded, h], -1)
        return [head(h) for head in self.heads]


def microseconds(count, run):
    """Returns the median time per Gaussian of `run`, which evaluates `count` Gaussians at a frame."""
    run(0)
    taken, start = [], time.perf_counter()
    while time.perf_counter() - start < SECONDS or len(taken) < 3:
        before = time.process_time()
        run(len(taken))
        taken.append(time.process_time() - before)
    return 1e6 * statistics.median(taken) / count


def networks():
    network = Network()
    for block in (1024, 16384):
        x = torch.randn(block, 3)
        yield f"network, blocks of {block}", microseconds(block, lambda k: network(x, torch.full((block, 1), k / 60)))
    # The same matrix products alone.
    inputs = [torch.randn(1024, layer.in_features) for layer in network.linear]
    weights = [layer.weight.T.contiguous() for layer in network.linear]
    yield "bare product, blocks of 1024", microseconds(1024, lambda _: [x @ w for x, w in zip(inputs, weights)])


def nodes(count):
    """Measures `ControlNodeWarp.forward` with neighbors and weights computed in every frame, as in the original, or
    once.
    """
    network, x, rotation, scale = Network(), torch.randn(count, 3 + HYPER), torch.randn(count, 4), torch.randn(count, 3)
    mask, at, radius, weight = torch.rand(count, 1), torch.randn(NODES, 3 + HYPER), torch.rand(NODES), torch.randn(NODES)

    def shares():
        found = [torch.cdist(part, at).square().topk(NEAREST, largest=False) for part in x.split(16384)]
        distance, index = (torch.cat([part[k] for part in found]) for k in (0, 1))
        u = torch.exp(-distance / (2 * radius[index].exp() ** 2)) * torch.sigmoid(weight[index]) + 1e-7
        return u / u.sum(-1, keepdim=True), index

    def state(k, held=None):
        u, index = held or shares()
        moved = network(at[:, :3], torch.full((NODES, 1), k / 60))
        warp, turn, scaling = ((of[index] * u[..., None]).sum(1) * mask for of in moved)
        return x[:, :3] + warp, nn.functional.normalize(rotation + turn), torch.exp(scale) + scaling

    yield "SC-GS, weights in every frame", microseconds(count, state)
    held = shares()
    yield "SC-GS, weights once", microseconds(count, lambda k: state(k, held))


def polynomials(count):
    """Measures `train_ours_lite` up to the rasterizer."""
    x, motion, rotation, omega = (torch.randn(count, width) for width in (3, 9, 4, 4))
    scale, opacity, centre, width = torch.randn(count, 3), torch.randn(count, 1), torch.rand(count, 1), torch.randn(count, 1)

    def state(k):
        dt = k / 60 - centre
        window = torch.exp(-((dt / torch.exp(width)) ** 2))
        at = x + motion[:, :3] * dt + motion[:, 3:6] * dt * dt + motion[:, 6:] * dt * dt * dt
        return at, nn.functional.normalize(rotation + dt * omega), torch.exp(scale), torch.sigmoid(opacity) * window

    yield "SpacetimeGaussians", microseconds(count, state)


def slices(count):
    """Measures `get_current_covariance_and_mean_offset` and `get_marginal_t`, computed in every frame as in the
    original.
    """
    x, scale, opacity, centre = torch.randn(count, 3), torch.randn(count, 4), torch.randn(count, 1), torch.rand(count, 1)
    left, right = torch.randn(count, 4), torch.randn(count, 4)

    def rotation():
        a, b, c, d = nn.functional.normalize(left).unbind(-1)
        p, q, r, s = nn.functional.normalize(right).unbind(-1)
        by_left = torch.stack([a, -b, -c, -d, b, a, -d, c, c, d, a, -b, d, -c, b, a], -1).view(-1, 4, 4)
        by_right = torch.stack([p, q, r, s, -q, p, -s, r, -r, s, p, -q, -s, -r, q, p], -1).view(-1, 4, 4)
        return (by_left @ by_right).flip(1, 2)

    def state(k):
        axes = rotation() * torch.exp(scale)[:, None]
        whole = axes @ axes.transpose(1, 2)
        variance, beside = whole[:, 3, 3, None], whole[:, :3, 3]
        dt = k / 30 - centre
        sigma = whole[:, :3, :3] - beside[:, :, None] * beside[:, None] / variance[..., None]
        return x + beside / variance * dt, sigma, torch.sigmoid(opacity) * torch.exp(-0.5 * dt**2 / variance)

    yield "native 4D Gaussians", microseconds(count, state)


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    torch.set_num_threads(1)
    torch.manual_seed(0)
    print(f"PyTorch {torch.__version__}, one thread, {count} Gaussians\n")
    print("| what | µs per Gaussian and frame | million states a second |\n|---|---|---|")
    with torch.inference_mode():
        parts = [networks(), *(part(count) for part in (nodes, polynomials, slices))]
        for part in parts:
            for name, taken in part:
                print(f"| {name} | {taken:.3f} | {1 / taken:.2f} |", flush=True)


if __name__ == "__main__":
    main()
