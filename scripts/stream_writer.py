"""Writes a frame stream (format/STREAM.md): what `splatsieve compress -` reads from standard input.

    with StreamWriter(sys.stdout.buffer, count, sh_degree, {"sh": features, ...}) as stream:
        for time, position, rotation in frames:
            stream.frame(time, {"position": position, "rotation": rotation})

Columns are arrays [N, ...], in stored encoding: position [N, 3]; rotation [N, 4], wxyz; log_scale [N, 3], natural
logs; opacity_logit [N] or [N, 1]; sh [N, (d+1)^2, 3]. Those that hold for every frame are given once, the others with
every frame. Needs numpy.
"""

import struct

import numpy as np

COLUMNS = ["position", "rotation", "log_scale", "opacity_logit", "sh"]


class StreamWriter:
    def __init__(self, out, count, sh_degree, constant=()):
        self.out, self.frames = out, 0
        constant = dict(constant)
        self.varying = [name for name in COLUMNS if name not in constant]
        bits = sum(1 << COLUMNS.index(name) for name in self.varying)
        out.write(struct.pack("<8sIIQII", b"\x89GSTR\r\n\x1a", 1, sh_degree, count, bits, 0))
        out.writelines(self.planes(constant[name]) for name in COLUMNS if name in constant)

    def planes(self, column):
        return np.ascontiguousarray(np.moveaxis(np.asarray(column), 0, -1), "<f4").tobytes()

    def frame(self, time, columns):
        payload = b"".join(self.planes(columns[name]) for name in self.varying)
        self.out.write(struct.pack("<4sIdQ", b"FRAM", self.frames, time, len(payload)) + payload)
        self.frames += 1

    def __enter__(self):
        return self

    def __exit__(self, failure, *_):
        # Without the end mark the reader knows that an exporter has failed.
        if failure is None:
            self.out.write(struct.pack("<4sI16x", b"DONE", self.frames))
        self.out.flush()
