#!/usr/bin/env python3
"""Prints or submits the Slurm jobs that compress many scenes: a job array with one task per scene, and a job that
writes summary.csv and summary.html when all have ended, and fails if a scene has failed.

    scripts/slurm/many_scenes.py LIST                                   # prints the commands
    scripts/slurm/many_scenes.py LIST --submit --at-once 20 --partition=short --time=4:00:00 --cpus-per-task=8 --mem=16G

LIST has one line per scene: INPUT CAMERAS OUTPUT [OPTION ...]; CAMERAS is - if there are none to name. Words are split
and quoted as in a shell ("my scene", my\\ scene), but nothing is expanded. Blank lines and lines that begin with # are
skipped. Relative paths are relative to the folder of the list, which all nodes must share.

The state of all scenes is in a folder (LIST.run): scenes.json, a cache folder of each unfinished scene, logs,
summary.csv, summary.html. The same command a second time does what is not done; a task that is preempted or loses its
node resumes from its cache. Options that the script does not know are passed to every sbatch.

    scripts/slurm/many_scenes.py LIST.run --task 3      # what the third task does: for another engine, or by hand
    scripts/slurm/many_scenes.py LIST.run --summary     # what the last job does
"""

import argparse
import csv
import hashlib
import html
import json
import os
import resource
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

from long_scene import OPTIONS, TASK, found, quoted

COLUMNS = ["scene", "state", "input", "output", "gaussians_in", "gaussians_out", "ratio", "bytes_in", "bytes_out"]
COLUMNS += ["seconds", "peak_mib", "starts", "quality", "message", "command"]

PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'">
<title>{title}</title>
<style>
:root {{ color-scheme: light dark }}
body {{ font: 15px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 80em; padding: 0 1em }}
table {{ border-collapse: collapse; width: 100% }}
th, td {{ border-bottom: 1px solid #8886; padding: .3em .7em; text-align: right; font-variant-numeric: tabular-nums }}
th:first-child, td:first-child, .words {{ text-align: left }}
.failed {{ color: #c33 }}
pre {{ background: #8882; padding: .7em; white-space: pre-wrap; overflow-wrap: anywhere }}
</style>
<h1>{title}</h1>
{failures}
<table><tr><th>scene<th>Gaussians<th>kept<th>bytes<th>of it<th>seconds<th>peak MiB<th>starts<th class="words">quality</tr>
{rows}
</table>
</html>
"""


def scenes(path):
    """Returns the checked words of every scene of a list."""
    outputs, listed = {}, []
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        sys.exit(f"cannot read the list of scenes {path}: {getattr(error, 'strerror', None) or error}")
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            words = shlex.split(line)
        except ValueError as error:
            sys.exit(f"{path}, line {number}: {error}")
        if len(words) < 3:
            sys.exit(f"{path}, line {number}: expected INPUT CAMERAS OUTPUT [OPTION ...], found {len(words)} words")
        # The script sets the cache; the other two write no result.
        if taken := [word for word in words[3:] if word.split("=")[0] in ("--cache", "--shard", "--dry-run")]:
            sys.exit(f"{path}, line {number}: {taken[0].split('=')[0]} cannot be an option of a scene here; remove it")
        output = os.path.normpath(path.parent / words[2])
        if output in outputs:
            sys.exit(f"{path}, lines {outputs[output]} and {number}: both write {output}")
        outputs[output] = number
        # Named by its words, so that a list that has grown still finds what is done.
        digest = hashlib.sha256("\0".join(words).encode()).hexdigest()[:8]
        listed.append({"name": f"{Path(output).name}-{digest}", "words": words})
    if not listed:
        sys.exit(f"{path}: no scene in it")
    return listed


def submission(args, sbatch):
    """Yields a script that submits all jobs and prints the number of the last one."""
    path = Path(os.path.abspath(args.list))
    folder = Path(os.path.abspath(args.folder or f"{path}.run"))
    run = {"folder": str(path.parent), "program": found(args.program), "keep_work": args.keep_work, "scenes": scenes(path)}
    for name in ("tasks", "logs", "work"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    write(folder / "scenes.json", run)
    common = ["sbatch", *OPTIONS, f"--chdir={folder}", *sbatch]
    array = f"1-{len(run['scenes'])}" + (f"%{args.at_once}" if args.at_once else "")
    script = Path(__file__).resolve()
    task = [*common, f"--job-name={args.name}", f"--output={folder}/logs/%x.%A_%a.log", f"--array={array}"]
    task += [TASK, script, folder, "--task", "@TASK@", "--threads=@THREADS@", "--memory=@MEMORY@"]
    last = [*common, f"--job-name={args.name}-summary", f"--output={folder}/logs/%x.%j.log"]
    yield "set -euo pipefail"
    yield f"scenes=$({quoted(task)})"
    # --parsable prints JOB or JOB;CLUSTER. The summary reports failed scenes.
    yield f'{quoted(last)} "--dependency=afterany:${{scenes%%;*}}" {quoted([TASK, script, folder, "--summary"])}'


def write(path, value):
    """Writes JSON so that the file appears whole or not at all."""
    begun = path.with_name(f"{path.name}.{os.uname().nodename}.{os.getpid()}")
    begun.write_text(json.dumps(value, indent=1) + "\n")
    begun.replace(path)


def read(path):
    return json.loads(path.read_text()) if path.exists() else {}


def compress(folder, run, scene):
    """Returns the command of a scene."""
    source, cameras, output, *options = scene["words"]
    cameras = [] if cameras == "-" else ["--cameras", cameras]
    return [run["program"], "compress", source, *cameras, "-o", output, *options, "--cache", str(folder / "work" / scene["name"])]


def scenes_of(folder):
    """Returns the content of scenes.json of a folder."""
    run = read(folder / "scenes.json")
    if not run:
        sys.exit(f"{folder}: expected a folder made from a list (LIST.run), found no scenes.json in it")
    return run


def task(folder, number, threads, memory):
    """Compresses a scene. Returns the exit status."""
    run = scenes_of(folder)
    if not 1 <= number <= len(run["scenes"]):
        sys.exit(f"{folder} has scenes 1 to {len(run['scenes'])}, and no {number}")
    scene = run["scenes"][number - 1]
    record_path = folder / "tasks" / f"{scene['name']}.json"
    output = Path(run["folder"]) / scene["words"][2]
    record = read(record_path)
    if record.get("state") == "done" and output.exists():
        print(f"{scene['name']} is done already", file=sys.stderr)
        return 0
    # A result from before the first start belongs to someone else; one that appeared later belongs to this task.
    ours = record.get("ours", not output.exists())
    record = {"state": "running", "ours": ours, "starts": record.get("starts", 0) + 1, "seconds": record.get("seconds", 0)}
    write(record_path, record)
    command = compress(folder, run, scene)
    options = scene["words"][3:]
    for option, value in (("--threads", threads), ("--memory", memory)):
        if value and not any(word.split("=")[0] == option for word in options):
            command += [option, value]
    command += ["--json"] if "--json" not in options else []
    if ours and record["starts"] > 1 and "--overwrite" not in options:
        command.append("--overwrite")

    begun, heard = time.monotonic(), []
    printed = folder / "tasks" / f"{scene['name']}.out"
    with open(printed, "wb") as out:
        child = subprocess.Popen(command, cwd=run["folder"], stdout=out, stderr=subprocess.PIPE, text=True, errors="replace")
        signal.signal(signal.SIGTERM, lambda *_: child.terminate())
        for line in child.stderr:
            sys.stderr.write(line)
            sys.stderr.flush()
            heard = [*heard[-49:], line]
        status = child.wait()
    status = 128 - status if status < 0 else status
    record["seconds"] += time.monotonic() - begun
    record["peak_bytes"] = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    if status == 0:
        record |= {"state": "done", "summary": json.loads(printed.read_text())}
    elif status == 143:
        record["state"] = "stopped"
    else:
        errors = [k for k, line in enumerate(heard) if line.startswith(("splatsieve: ", "error: "))]
        message = "".join(heard[errors[-1] :] if errors else heard[-5:]).removeprefix("splatsieve: ").strip()
        record |= {"state": "failed", "message": message or f"ended with {status}"}
    printed.unlink()
    write(record_path, record)
    if status == 0 and not run["keep_work"]:
        clean = [run["program"], "cache", folder / "work" / scene["name"], "--clean", "--quiet"]
        subprocess.run(clean, check=False, stdout=subprocess.DEVNULL)
    return status


def quality(summary):
    """Returns in words how close the renders are to those of the original, and what a search for a quality reached."""
    goal, measured, archive = (summary.get(key) or {} for key in ("goal", "quality", "archive"))
    said = []
    if measured:
        ssim = f", {measured['ssim']:.3f} SSIM" if measured.get("ssim") is not None else ""
        views = f"{measured['views']} {measured['kind']} views"
        views += ", before conversion" if measured.get("before_conversion") else ""
        said.append(f"{decibels(measured['psnr'])} PSNR{ssim} vs. original ({views})")
    elif archive:
        # An archive of frames, which was measured when its error bounds were chosen.
        psnr = archive["level"] - archive["loss"]
        said.append(f"{decibels(psnr)} PSNR vs. original (views that chose its precision)")
    if goal:
        what = {"max_loss": "loss against photographs"}.get(goal["name"], "PSNR vs. original")
        said.append(f"{decibels(goal['searched'])} {what} on the views of the search, {goal['asked']:g} dB asked for")
    return "; ".join(said)


def decibels(value):
    """Returns a number of a summary, null if it is not finite, with its unit."""
    return "unknown" if value is None else f"{value:.2f} dB"


def write_summary(folder):
    """Writes the summary of all scenes. Returns whether all are done."""
    run = scenes_of(folder)
    rows = []
    for scene in run["scenes"]:
        record = read(folder / "tasks" / f"{scene['name']}.json")
        summary = record.get("summary") or {}
        state = record.get("state", "")
        lost = {
            "running": "it ended without a word: too little memory, or cancelled (its log says more)",
            "stopped": "it was told to end and has not been started again",
            "": "it was never started",
        }
        source = summary.get("input", {})
        known = {"gaussians_in": source.get("gaussians"), "gaussians_out": summary.get("gaussians")}
        known |= {"bytes_in": source.get("bytes"), "bytes_out": summary.get("output_bytes")}
        if summary:
            known |= {"ratio": round(known["gaussians_out"] / max(known["gaussians_in"], 1), 4), "quality": quality(summary)}
        known |= {"scene": scene["name"], "input": scene["words"][0], "output": scene["words"][2]}
        known["state"] = "done" if state == "done" else "failed"
        known["message"] = "" if state == "done" else record.get("message") or lost.get(state, state)
        known |= {"starts": record.get("starts", 0), "seconds": round(record.get("seconds", 0), 1)}
        known["peak_mib"] = round(record["peak_bytes"] / 2**20) if "peak_bytes" in record else None
        known["command"] = f"cd {shlex.quote(run['folder'])} && {quoted(compress(folder, run, scene))}"
        rows.append(known)
    with open(folder / "summary.csv", "w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows({key: without_formula(value) for key, value in row.items()} for row in rows)
    failed = [row for row in rows if row["state"] == "failed"]
    title = f"{len(rows) - len(failed)} of {len(rows)} scenes done"
    (folder / "summary.html").write_text(page(title, rows, failed))
    print(f"{title}: {folder / 'summary.html'}")
    for row in failed:
        print(f"\n{row['scene']} failed: {row['message']}\n  {row['command']}")
    return not failed


def without_formula(value):
    """Returns `value` so that no spreadsheet evaluates it: texts that begin like formulas get an apostrophe in front.
    """
    is_formula = isinstance(value, str) and value.lstrip(" ").startswith(tuple("=+-@\t\r\n＝＋－＠"))
    return f"'{value}" if is_formula else value


def page(title, rows, failed):
    """Returns the summary as an HTML page."""
    def escaped(value, form="{}"):
        return "–" if value in (None, "") else html.escape(form.format(value))

    failures = "".join(
        f"<h2 class=failed>{escaped(row['scene'])} failed</h2>"
        f"<p>{escaped(row['message'])}</p><pre>{escaped(row['command'])}</pre>\n"
        for row in failed
    )
    lines = []
    for row in rows:
        size = None if not row["bytes_out"] else row["bytes_out"] / max(row["bytes_in"] or 0, 1)
        cells = [escaped(row["gaussians_out"], "{:,}"), escaped(row.get("ratio"), "{:.1%}"), escaped(row["bytes_out"], "{:,}")]
        cells += [escaped(size, "{:.1%}"), escaped(row["seconds"]), escaped(row["peak_mib"]), escaped(row["starts"])]
        kind = " class=failed" if row["state"] == "failed" else ""
        quality = row.get("quality") if row["state"] == "done" else "failed"
        lines.append(f"<tr{kind}><td>{escaped(row['scene'])}<td>{'<td>'.join(cells)}<td class=words>{escaped(quality)}</tr>")
    return PAGE.format(title=html.escape(title), failures=failures, rows="\n".join(lines))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("list", help="list of scenes; with --task and --summary the folder made from it")
    parser.add_argument("--submit", action="store_true", help="submit the jobs; print the number of the last one")
    parser.add_argument("--at-once", type=int, help="maximum number of scenes at a time")
    parser.add_argument("--folder", help="folder of caches, logs and summary [default: LIST.run]")
    parser.add_argument("--keep-work", action="store_true", help="keep the cache of a finished scene")
    parser.add_argument("--name", default="splatsieve", help="name of the array [default: splatsieve]")
    parser.add_argument("--program", default="splatsieve", help="splatsieve [default: the one on the PATH]")
    parser.add_argument("--task", type=int, metavar="N", help="compress scene N of a folder now, in this process")
    parser.add_argument("--threads", help="of --task")
    parser.add_argument("--memory", help="of --task")
    parser.add_argument("--summary", action="store_true", help="write the summary of a folder; exits with 1 if a scene failed")
    args, sbatch = parser.parse_known_args()
    if args.task is not None or args.summary:
        if sbatch:
            parser.error(f"unknown: {' '.join(sbatch)}")
        folder = Path(os.path.abspath(args.list))
        sys.exit(not write_summary(folder) if args.summary else task(folder, args.task, args.threads, args.memory))
    script = "\n".join(submission(args, sbatch)) + "\n"
    if not args.submit:
        print(script, end="")
        return
    sys.exit(subprocess.run(["bash", "-c", script], check=False).returncode)


if __name__ == "__main__":
    main()
