"""Reads gseq containers (format/SPEC.md) in numpy.

Tiles are found through the index in the footer; one frame block of one column is in memory at a time. Checksums are not
verified (`splatsieve info --check` does that). Needs numpy and zstandard.
"""

from __future__ import annotations

import mmap
import struct
import sys
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

Array = NDArray[Any]
RECORD = 64


class Gseq:
    """Open container: `count` Gaussians, `times` [T], and `widths`, the number of components of each column by name."""

    def __init__(self, path: str) -> None:
        with open(path, "rb") as file:
            self.bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if self.bytes[:8] != b"\x89GSEQ\r\n\x1a" or self.bytes[-8:] != b"\x1aGSEQEND":
            raise ValueError(f"{path}: no complete gseq container")
        version, _, self.count, self.gaussian_block, self.frame_block, columns, _ = struct.unpack_from(
            "<IIQIIII", self.bytes, 8
        )
        if version not in (1, 2):
            raise ValueError(f"{path}: version {version}, not 1 or 2")
        self.widths: dict[str, int] = {}
        at = 40
        for _ in range(columns):
            width, length = struct.unpack_from("<IH", self.bytes, at)
            self.widths[self.bytes[at + 6 : at + 6 + length].decode()] = width
            # Version 2 continues with the bound of the column, which decoding does not need.
            at += 6 + length + (8 if version == 2 else 0)
        (footer,) = struct.unpack_from("<Q", self.bytes, len(self.bytes) - 32)
        frames, _ = struct.unpack_from("<QQ", self.bytes, footer + 8)
        self.times = np.frombuffer(self.bytes, "<f8", frames, footer + RECORD)
        self.index = footer + RECORD + 8 * frames
        self.blocks = -(-self.count // self.gaussian_block)
        self.kept: dict[str, tuple[int, list[Array]]] = {}

    def column(self, name: str, frame: int) -> Array:
        """Returns the values of the column `name` at frame number `frame`, from 0, shape [N, width].

        Raises IndexError if the container has no such frame.
        """
        if not 0 <= frame < len(self.times):
            raise IndexError(f"no frame {frame}: the container has {len(self.times)} frames, counted from 0")
        block = frame // self.frame_block
        if self.kept.get(name, (None,))[0] != block:
            self.kept[name] = (block, [self.tile(name, i, block) for i in range(self.blocks)])
        parts = [tile[min(frame % self.frame_block, len(tile) - 1)] for tile in self.kept[name][1]]
        return np.concatenate(parts, 1).T if parts else np.empty((0, self.widths[name]), "<f4")

    def tile(self, name: str, gaussian_block: int, frame_block: int) -> Array:
        """Returns the values of the column `name` for a block of Gaussians and a block of frames (a tile).

        The shape is [stored frames, width, Gaussians]. A constant tile (all frames equal) stores one frame.
        """
        place = (frame_block * self.blocks + gaussian_block) * len(self.widths) + list(self.widths).index(name)
        record = self.index + RECORD * place
        encoding, order, constant = struct.unpack_from("<BBB", self.bytes, record + 16)
        frames, offset = struct.unpack_from("<IQ", self.bytes, record + 20)
        (length,) = struct.unpack_from("<I", self.bytes, record + 40)
        gaussians = min(self.gaussian_block, self.count - gaussian_block * self.gaussian_block)
        shape = (1 if constant else frames, self.widths[name], gaussians)
        stored = self.bytes[offset : offset + length]
        if encoding == 0:
            return np.frombuffer(stored, "<f4").reshape(shape)
        if encoding == 2:
            return within_bound(stored, shape, order)
        plain = zstandard.ZstdDecompressor().decompress(stored, max_output_size=4 * int(np.prod(shape)))
        planes = np.frombuffer(plain, np.uint8).reshape(4, -1)
        return unpredict(np.ascontiguousarray(planes.T).view("<u4").reshape(shape), order)


def unpredict(residuals: Array, order: int) -> Array:
    """Converts the prediction residuals of a lossless tile, shape [frames, width, Gaussians], back to floats.

    `order` is the number of earlier frames that predict a value. All arithmetic is modulo 2^32.
    """
    ranks = np.empty_like(residuals)
    for t, residual in enumerate(residuals):
        k = min(order, t)
        if k == 0:
            ranks[t] = residual ^ np.where(residual >> 31, np.uint32(0xFFFFFFFF), np.uint32(0x80000000))
            continue
        difference = (residual >> 1) ^ (-(residual & 1).astype(np.int32)).view(np.uint32)
        predicted = ranks[t - 1] if k == 1 else 2 * ranks[t - 1] - ranks[t - 2]
        ranks[t] = predicted + difference
    return (ranks ^ np.where(ranks >> 31, np.uint32(0x80000000), np.uint32(0xFFFFFFFF))).view("<f4")


def within_bound(stored: bytes, shape: tuple[int, int, int], order: int) -> Array:
    """Returns the values, of shape `shape`, of a lossy tile (with an error bound) from its bytes `stored`.

    They are stored as multiples of a step, with prediction residuals over time for components of Gaussians that move.
    `order` is the number of earlier frames that predict a value.
    """
    step, exceptions, halvings = struct.unpack_from("<dII", stored)
    frames, tracks = shape[0], shape[1] * shape[2]
    most = -(-tracks // 8) + 4 * frames * tracks
    plain = zstandard.ZstdDecompressor().decompress(stored[16 + 8 * exceptions :], max_output_size=most)
    body = np.frombuffer(plain, np.uint8)
    mask, body = np.split(body, [-(-tracks // 8)])
    moves = np.unpackbits(mask, bitorder="little")[:tracks].astype(bool)
    multiples = np.empty((frames, tracks), "<i4")
    first, rest = np.split(body, [4 * tracks])
    multiples[:] = unzigzag(unshuffle(first))
    residuals = unzigzag(unshuffle(rest)).reshape(moves.sum(), frames - 1)
    for t in range(1, frames):
        before, before_that = multiples[t - 1, moves], multiples[t - min(order, t), moves]
        predicted = before if min(order, t) == 1 else 2 * before - before_that
        multiples[t, moves] = predicted + residuals[:, t - 1]
    steps = np.where(moves, step, step / 2**halvings)
    values: Array = (multiples * steps).astype("<f4")
    places, bits = np.frombuffer(stored, "<u4", 2 * exceptions, 16).reshape(-1, 2).T
    values.view("<u4").reshape(-1)[places] = bits
    return values.reshape(shape)


def unshuffle(planes: Array) -> Array:
    """Returns 32-bit numbers from bytes in shuffled order: the lowest bytes of all numbers first, the highest last."""
    return np.ascontiguousarray(planes.reshape(4, -1).T).view("<u4").reshape(-1)


def unzigzag(codes: Array) -> Array:
    """Converts zigzag codes to signed numbers."""
    return ((codes >> 1) ^ (-(codes & 1).astype(np.int32)).view(np.uint32)).view("<i4")


def main(about: str) -> None:
    if len(sys.argv) not in (2, 3):
        sys.exit(about)
    scene = Gseq(sys.argv[1])
    print(f"{sys.argv[1]}: {scene.count} Gaussians x {len(scene.times)} frames", file=sys.stderr)
    for name, width in scene.widths.items():
        print(f"  {name} x{width}", file=sys.stderr)
    if len(sys.argv) == 3:
        frames = range(len(scene.times))
        arrays: dict[str, Any] = {name: np.array([scene.column(name, t) for t in frames]) for name in scene.widths}
        np.savez(sys.argv[2], times=scene.times, **arrays)
