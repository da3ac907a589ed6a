#!/usr/bin/env python3
"""Prints or submits the Slurm jobs that compress one long scene: a job array for every stage that can be divided, each
after the previous one, and a job for the rest.

    scripts/slurm/long_scene.py --parts 8 --cache CACHE -- MODEL --cameras DATA -o SMALL            # prints the commands
    scripts/slurm/long_scene.py --parts 8 --cache CACHE --submit --partition=short --time=1:00:00 --cpus-per-task=4 \\
        --mem=8G -- MODEL --cameras DATA -o SMALL --ratio 0.3

Options that the script does not know are passed to every sbatch; arguments after -- are those of `splatsieve compress`.
Paths are relative to the current folder, which must be the same folder with the same files on all nodes. A task that is
preempted or loses its node starts again and loses at most its current shard; the same command a second time resumes
from WORK. Only an upper bound of the number of stages is known in advance (mainly of pruning rounds): an array for a
stage that does not take place works on the next one, or finds nothing to do. `--arrays` submits fewer arrays; the last
job does the rest.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

TASK = Path(__file__).resolve().with_name("task.sh")
OPTIONS = ["--parsable", "--requeue", "--signal=B:TERM@60", "--open-mode=append", "--kill-on-invalid-dep=yes"]


def found(program):
    """Returns the absolute path of the program."""
    path = shutil.which(program)
    if path is None:
        sys.exit(f"no program {program} (--program names another)")
    return os.path.abspath(path)


def quoted(words):
    return shlex.join(map(str, words))


def stages(compress):
    """Returns the stages that --shard divides."""
    listed = subprocess.run([*compress, "--dry-run=stages"], stdout=subprocess.PIPE, text=True, check=False)
    if listed.returncode != 0:
        sys.exit(listed.returncode)
    return [line.split(":")[0] for line in listed.stdout.splitlines()]


def lines(args, sbatch, compress):
    """Yields a script that submits all jobs and prints the number of the last one."""
    common = ["sbatch", *OPTIONS, f"--chdir={os.getcwd()}", *sbatch]
    names = stages(compress)[: args.arrays]
    compress = [*compress, "--cache", args.cache]
    # Resources of the job, unless the user gives other values.
    for option, value in (("--threads", "@THREADS@"), ("--memory", "@MEMORY@")):
        if not any(word.split("=")[0] == option for word in compress):
            compress.append(f"{option}={value}")
    yield "set -euo pipefail"
    yield f"mkdir -p {quoted([args.logs])}"
    after = ""
    for number, name in enumerate(names):
        words = [*common, f"--job-name={args.name}-{name}", f"--output={args.logs}/%x.%A_%a.log", f"--array=1-{args.parts}"]
        part = [TASK, *compress, "--shard", f"@TASK@/{args.parts}"]
        yield f"job{number}=$({quoted(words)}{after} {quoted(part)})"
        # --parsable prints JOB or JOB;CLUSTER.
        after = f' "--dependency=afterok:${{job{number}%%;*}}"'
    words = [*common, f"--job-name={args.name}", f"--output={args.logs}/%x.%j.log"]
    yield f"{quoted(words)}{after} {quoted([TASK, *compress, '@AGAIN@'])}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--parts", type=int, required=True, help="number of tasks of every array")
    parser.add_argument("--cache", required=True, help="cache folder on a file system that all nodes share")
    parser.add_argument("--submit", action="store_true", help="submit the jobs; print the number of the last one")
    parser.add_argument("--arrays", type=int, help="maximum number of arrays before the last job [default: one per stage]")
    parser.add_argument("--name", default="splatsieve", help="prefix of the job names [default: splatsieve]")
    parser.add_argument("--logs", help="folder of the logs [default: WORK.logs]")
    parser.add_argument("--program", default="splatsieve", help="splatsieve [default: the one on the PATH]")
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    args, sbatch = parser.parse_known_args(words[:cut])
    compress = words[cut + 1 :]
    if not compress or args.parts < 1:
        parser.error("expected at least one part and, behind --, what splatsieve compress takes")
    if taken := [word for word in compress if word.split("=")[0] in ("--cache", "--shard", "--dry-run")]:
        parser.error(f"{taken[0]} is this script's own")
    args.cache, args.logs = os.path.abspath(args.cache), os.path.abspath(args.logs or args.cache.rstrip("/") + ".logs")
    script = "\n".join(lines(args, sbatch, [found(args.program), "compress", *compress])) + "\n"
    if not args.submit:
        print(script, end="")
        return
    sys.exit(subprocess.run(["bash", "-c", script], check=False).returncode)


if __name__ == "__main__":
    main()
