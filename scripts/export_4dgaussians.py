#!/usr/bin/env python3
"""Streams a trained 4DGaussians model to standard output, evaluated by the code of its repository on its own GPU.

Run it with the Python of the repository (https://github.com/hustvl/4DGaussians), in its folder:

    python path/to/export_4dgaussians.py -m output/my_model --cameras data/transforms_train.json \\
        | splatsieve compress - --cameras data -o small.gseq

splatsieve reads these models itself; this script is for forks with a deformation that splatsieve does not know: the
frames are the results of `gaussians._deformation`. Frames are at the distinct times of the camera files, or with
`--frames N` at evenly spaced times (i/N). `--device cpu` works if the classes of the fork support it.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import json
import os
import sys
from argparse import ArgumentParser
from pathlib import Path

# The classes of the repository print. The stream goes to the present standard output; prints go to standard error.
STREAM = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)
sys.path.insert(0, os.getcwd())

import torch  # noqa: E402
from arguments import ModelHiddenParams, ModelParams, get_combined_args  # noqa: E402
from scene.gaussian_model import GaussianModel  # noqa: E402

from stream_writer import StreamWriter  # noqa: E402


def frame_times(files, frames):
    if frames:
        return [i / frames for i in range(frames)]
    times = {shot["time"] for file in files for shot in json.loads(Path(file).read_text())["frames"]}
    return sorted(times)


def newest(point_clouds):
    return max(point_clouds.glob("iteration_*"), key=lambda folder: int(folder.name.split("_")[1]))


def array(tensor):
    return tensor.detach().cpu().numpy()


def main():
    parser = ArgumentParser(description=__doc__)
    model, hidden = ModelParams(parser, sentinel=True), ModelHiddenParams(parser)
    parser.add_argument("--iteration", type=int)
    parser.add_argument("--cameras", nargs="*", default=[], help="transforms*.json with the times")
    parser.add_argument("--frames", type=int, help="evenly spaced frames instead")
    parser.add_argument("--device", default="cuda")
    # Reads cfg_args of the model folder; options of the command line take precedence.
    args = get_combined_args(parser)
    times = frame_times(getattr(args, "cameras", []), getattr(args, "frames", None))
    if not times:
        sys.exit("no times: give --cameras or --frames")

    gaussians = GaussianModel(model.extract(args).sh_degree, hidden.extract(args))
    point_clouds = Path(args.model_path) / "point_cloud"
    iteration = getattr(args, "iteration", None)
    folder = point_clouds / f"iteration_{iteration}" if iteration else newest(point_clouds)
    gaussians.load_ply(str(folder / "point_cloud.ply"))
    gaussians.load_model(str(folder))

    with torch.no_grad(), StreamWriter(STREAM, len(gaussians.get_xyz), gaussians.max_sh_degree) as stream:
        # Raw parameters: the deltas are added to these before the activations.
        raw = (gaussians.get_xyz, gaussians._scaling, gaussians._rotation, gaussians._opacity, gaussians.get_features)
        raw = [parameter.to(args.device) for parameter in raw]
        for time in times:
            at = torch.full((len(raw[0]), 1), time, dtype=raw[0].dtype, device=args.device)
            position, log_scale, rotation, opacity_logit, sh = map(array, gaussians._deformation(*raw, at))
            stream.frame(
                time,
                {
                    "position": position,
                    "rotation": rotation,
                    "log_scale": log_scale,
                    "opacity_logit": opacity_logit,
                    "sh": sh,
                },
            )


if __name__ == "__main__":
    main()
