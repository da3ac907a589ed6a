"""Records PSNR, SSIM and FLIP of small images for tests/rendering/metrics_recorded.rs.

    python scripts/record_metrics.py tests/fixtures/metrics

Writes a.npy and b.npy (float32 [images, 37, 53, 3], values partly outside [0, 1]) and expected.json with one PSNR and
SSIM per image, computed in float64 by 2-D convolution with PyTorch, one FLIP of the 8-bit images, computed by its
authors' package (flip-evaluator), and the versions of the packages. Needs numpy, PyTorch and flip-evaluator.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import importlib.metadata
import json
import pathlib
import sys

import flip_evaluator
import numpy as np
import torch
import torch.nn.functional as functional


def ssim(a, b):
    """Returns the SSIM of two [3, H, W] tensors: the 11x11 window in one convolution, with zeros beyond the border."""
    at = torch.arange(11, dtype=torch.float64) - 5
    line = torch.exp(-(at**2) / (2 * 1.5**2))
    window = torch.outer(line, line)
    window = (window / window.sum()).expand(3, 1, 11, 11)

    def mean(x):
        return functional.conv2d(x[None], window, padding=5, groups=3)[0]

    mean_a, mean_b = mean(a), mean(b)
    variance_a = mean(a * a) - mean_a**2
    variance_b = mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    score = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    score /= (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    return score.mean().item()


def psnr(a, b):
    return -10 * torch.log10(((a - b) ** 2).mean()).item()


def flip(a, b):
    """Returns the mean of the error map with `b` as reference, at the default distance of 67 pixels per degree."""
    a, b = (np.float32(np.round(p.clip(0, 1) * 255) / 255) for p in (a, b))
    return float(flip_evaluator.evaluate(b, a, "LDR", inputsRGB=True, applyMagma=False)[1])


def main():
    folder = pathlib.Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(7)
    y, x = np.mgrid[0:37, 0:53]
    waves = [np.sin(x * (0.1 + 0.07 * c) + y * (0.23 - 0.05 * c)) * 0.6 + 0.5 for c in range(3)]
    smooth = np.stack(waves, axis=-1)
    noise = random.normal(size=(4, 37, 53, 3))
    a = np.stack([smooth] * 4).astype(np.float32)
    b = (a + np.array([0.002, 0.02, 0.1, 0.6])[:, None, None, None] * noise).astype(np.float32)
    np.save(folder / "a.npy", a)
    np.save(folder / "b.npy", b)
    expected = {"numpy": np.__version__, "torch": torch.__version__}
    expected["flip-evaluator"] = importlib.metadata.version("flip-evaluator")
    expected |= {"psnr": [], "ssim": [], "flip": []}
    for one, other in zip(a, b):
        pair = [torch.from_numpy(p).double().clamp(0, 1).permute(2, 0, 1).contiguous() for p in (one, other)]
        expected["psnr"].append(psnr(*pair))
        expected["ssim"].append(ssim(*pair))
        expected["flip"].append(flip(one, other))
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
