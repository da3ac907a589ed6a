#!/usr/bin/env python3
"""Computes LPIPS between two folders of images with the same names, as JSON: per image, and the mean.

    splatsieve render model --cameras data --all -o before/
    splatsieve render small --cameras data --all -o after/
    python3 scripts/lpips.py before after [--net alex|vgg|squeeze]

Needs the packages lpips, torchvision and pillow (pip install lpips torchvision pillow) and once the weights of the
network, which torchvision downloads; without internet access put them where the message says. Images are used
unchanged, 8 bits per channel, scaled to [-1, 1]. Lower is closer; 0 is equal. Zhang et al., "The Unreasonable
Effectiveness of Deep Features as a Perceptual Metric", 2018.
"""

# The folder of this script is on the module path, and this script has the name of the package it needs.
import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import sys

if sys.path and not getattr(sys.flags, "safe_path", False):
    sys.path.pop(0)

import argparse
import json
import os
import warnings
from pathlib import Path


def stop(message):
    sys.exit(f"lpips.py: {message}")


def metric(net):
    """Returns the LPIPS network `net`, or ends with a message that names what is missing."""
    try:
        import torch
        import torchvision  # noqa: F401, the package lpips takes its networks from it
        import lpips
    except ImportError as error:
        stop(f"cannot import {error.name}\n  pip install lpips torchvision pillow")
    # The package uses an older interface of torchvision, which prints warnings.
    warnings.filterwarnings("ignore", module="torchvision")
    try:
        return lpips.LPIPS(net=net, verbose=False).eval()
    except OSError as error:
        folder = os.path.join(torch.hub.get_dir(), "checkpoints")
        stop(
            f"no weights of the network {net}: {error}\n"
            f"  torchvision looks for its file in {folder} and downloads it otherwise; fetch it elsewhere and put it there"
        )


def pairs(before, after):
    """Returns the names of the images, which must be the same in both folders."""
    names = []
    for folder in (before, after):
        if not folder.is_dir():
            stop(f"{folder}: expected a folder of PNG images")
        names.append({path.name for path in folder.glob("*.png")})
    if not names[0]:
        stop(f"{before}: expected PNG images, found none")
    odd = sorted(names[0] ^ names[1])
    if odd:
        stop(f"{before} and {after}: expected images of the same names, found {odd[0]} in one only ({len(odd)} such)")
    return sorted(names[0])


def read(path):
    """Returns the image as a tensor [1, 3, height, width] in [-1, 1]."""
    import numpy
    import torch
    from PIL import Image

    pixels = numpy.asarray(Image.open(path).convert("RGB"), dtype=numpy.float32)
    return torch.from_numpy(pixels / 127.5 - 1.0).permute(2, 0, 1)[None]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--net", choices=["alex", "vgg", "squeeze"], default="alex")
    arguments = parser.parse_args()
    names = pairs(arguments.before, arguments.after)
    network = metric(arguments.net)
    import torch

    found = {}
    with torch.no_grad():
        for name in names:
            a, b = read(arguments.before / name), read(arguments.after / name)
            if a.shape != b.shape:
                stop(f"{name}: expected images of one size, found {tuple(a.shape[2:])} and {tuple(b.shape[2:])}")
            found[name] = network(a, b).item()
    mean = sum(found.values()) / len(found)
    print(json.dumps({"metric": "lpips", "net": arguments.net, "mean": mean, "views": found}, indent=2))


if __name__ == "__main__":
    main()
