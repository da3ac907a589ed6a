#!/usr/bin/env python3
"""Measures the cost of every shard of a run, one after the other, and estimates the time on many nodes.

    python3 scripts/scaling.py target/release/splatsieve MODEL --parts 1 2 7 --json room.json -- --no-refine
    python3 scripts/scaling.py --of large.json --gaussians 1000000 --frames 10000      # the same tables of what was measured

MODEL is a folder with its cameras; arguments after -- are further options of `compress`. Every shard runs as a separate
process on one thread. Measured for each: processor and wall seconds, bytes read and written by system calls (mapped
pages do not count), peak memory. The cost of a shard without work is measured by starting a finished one again. Prints
three tables: the stages, the longest chain, and the estimate. `--check` exits 1 if the shards of a stage take more than
1.15 times the same stage in one shard although each works 5 s or more (`--parts` must begin with 1). Needs only the
standard library; Linux.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import argparse
import json
import math
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MOST, FROM = 1.15, 5.0
MB = 1e6


def measured(command):
    """Runs a command. Returns its output and its cost."""
    begun = time.monotonic()
    child = subprocess.Popen([str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    # Both outputs are short and do not fill a pipe.
    printed, complaints = child.stdout.read(), child.stderr.read()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    # The process has ended but is not yet reaped, so the system still has its I/O counters.
    io = dict(line.split(": ") for line in Path(f"/proc/{child.pid}/io").read_text().splitlines())
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        sys.exit(f"failed: {' '.join(map(str, command))}\n{complaints}")
    cost = {"processor": usage.ru_utime + usage.ru_stime, "wall": time.monotonic() - begun, "peak": usage.ru_maxrss * 1024}
    return printed, cost | {"read": int(io["rchar"]), "written": int(io["wchar"])}


def units(command):
    """Returns the units of the divided stages (blocks of Gaussians, views); None if their number is not known in
    advance.
    """
    found = {}
    for line in measured([*command, "--dry-run=stages"])[0].splitlines():
        name, what = line.split(": ", 1)
        number = re.match(r"\d+", what)
        found[name] = int(number[0]) if number else None
    return found


def in_parts(command, of, work, program):
    """Returns, by stage, the cost of all `of` shards and of one without work, the bytes of their cache entries; and the
    rest of the run.
    """
    command = [*command, "--cache", work]
    stages = []
    while True:
        parts, again = [], None
        for index in range(1, of + 1):
            said, cost = measured([*command, "--shard", f"{index}/{of}"])
            if "nothing to do" in said:
                break
            parts.append(cost)
            if index == 1 < of:
                # The shard is done already: it opens the input and the results of earlier stages, and ends.
                again = measured([*command, "--shard", f"1/{of}"])[1]
            name = said.split(":")[0]
        if not parts:
            break
        stages.append({"stage": name, "parts": parts, "again": again})
        print(f"{of} parts, {name}: {sum(part['processor'] for part in parts):.1f} s", file=sys.stderr, flush=True)
    printed, cost = measured([*command, "--json"])
    pieces = json.loads(measured([program, "cache", work, "--json"])[0])
    for stage in stages:
        for kind, wanted in (("part_bytes", of), ("whole_bytes", 1)):
            stage[kind] = sum(piece["bytes"] for piece in pieces if (piece["stage"], piece["parts"]) == (stage["stage"], wanted))
    return {"of": of, "stages": stages, "rest": cost, "summary": json.loads(printed)}


def measure(args, options):
    command = [args.program, "compress", args.model, "--cameras", args.cameras or args.model, "--threads", 1, "--quiet", *options]
    with tempfile.TemporaryDirectory(dir=args.scratch) as folder:
        folder = Path(folder)
        found = {"options": options, "model": Path(args.model).name, "machine": machine()}
        found["units"] = units([*command, "-o", folder / "small"])
        printed, cost = measured([*command, "-o", folder / "small", "--json"])
        found["plain"] = cost | {"summary": json.loads(printed)}
        print(f"one run: {cost['processor']:.1f} s", file=sys.stderr, flush=True)
        found["runs"] = [
            in_parts([*command, "-o", folder / f"small{of}"], of, folder / f"work{of}", args.program) for of in args.parts
        ]
    return found


def machine():
    names = [line.split(": ")[1] for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} processors"


def family(name):
    """Returns the stage without its number: rounds-03 is one of the rounds."""
    return name.split("-")[0]


def plain_seconds(found):
    """Returns the processor seconds of the stages of a run without shards."""
    seconds = {}
    for stage in found["plain"]["summary"]["stages"]:
        seconds[stage["name"]] = seconds.get(stage["name"], 0) + (stage["processor_seconds"] or 0)
    return seconds


def stage_table(found):
    """Yields a table row for every stage and number of shards."""
    yield (
        "| stage | shards | processor s, all shards | of one run | longest shard, s | shard without work, s "
        "| read, MB | written, MB | cache entries, MB | peak, MiB |"
    )
    yield "|" + "---|" * 10
    plain = plain_seconds(found)
    for name in dict.fromkeys(family(stage["stage"]) for run in found["runs"] for stage in run["stages"]):
        # Merging begins with measuring pairs.
        whole = plain.get({"pairs": "merge", "targets": "refine"}.get(name, name), 0)
        for run in found["runs"]:
            stages = [stage for stage in run["stages"] if family(stage["stage"]) == name]
            parts = [part for stage in stages for part in stage["parts"]]
            total = sum(part["processor"] for part in parts)
            longest = sum(max(part["processor"] for part in stage["parts"]) for stage in stages)
            again = [stage["again"]["processor"] for stage in stages if stage["again"]]
            ratio = total / whole if whole and name not in ("pairs", "targets") else None
            cells = [f"{name} ({len(stages)})" if len(stages) > 1 else name, run["of"], f"{total:.2f}"]
            cells += [f"{ratio:.2f}" if ratio else "–", f"{longest:.2f}"]
            cells += [f"{sum(again) / len(again):.2f}" if again else "–"]
            cells += [f"{sum(part[way] for part in parts) / MB:.1f}" for way in ("read", "written")]
            cells += [f"{sum(stage['part_bytes'] for stage in stages) / MB:.1f}"]
            cells += [f"{max(part['peak'] for part in parts) / 2**20:.0f}"]
            yield f"| {' | '.join(map(str, cells))} |"


def over(found):
    """Yields the stages whose shards cost too much, each against the same stage in one shard."""
    whole = {stage["stage"]: stage["parts"][0]["processor"] for run in found["runs"] if run["of"] == 1 for stage in run["stages"]}
    for run in found["runs"]:
        for stage in run["stages"]:
            costs = [part["processor"] for part in stage["parts"]]
            if min(costs) >= FROM and sum(costs) > MOST * whole.get(stage["stage"], math.inf):
                yield f"{stage['stage']} in {run['of']}: {sum(costs) / whole[stage['stage']]:.2f}"


def split(found):
    """Yields work and start-up cost of every stage: work from the fewest shards, start-up cost from what each further
    shard adds.
    """
    few, many = found["runs"][0], found["runs"][-1]
    for one, cut in zip(few["stages"], many["stages"]):
        sums = [sum(part["processor"] for part in stage["parts"]) for stage in (one, cut)]
        start = max(sums[1] - sums[0], 0) / max(many["of"] - few["of"], 1)
        yield one["stage"], max(sums[0] - few["of"] * start, 0), start


def chain_table(found):
    """Yields rows with sum and longest chain of whole runs: the time on one node, and on one node per shard."""
    yield (
        "| shards | sum of all shards, s | rest, s | total, of one run | longest chain, s | of one run "
        "| predicted chain: work / shards + start, s |"
    )
    yield "|" + "---|" * 7
    plain = found["plain"]["processor"]
    for run in found["runs"]:
        total = sum(part["processor"] for stage in run["stages"] for part in stage["parts"])
        longest = sum(max(part["processor"] for part in stage["parts"]) for stage in run["stages"])
        rest = run["rest"]["processor"]
        told = sum(work / run["of"] + start for _, work, start in split(found))
        yield (
            f"| {run['of']} | {total:.1f} | {rest:.1f} | {(total + rest) / plain:.2f} | {longest + rest:.1f} "
            f"| {(longest + rest) / plain:.2f} | {told + rest:.1f} |"
        )
    yield f"\nA run without shards takes {plain:.1f} s of one processor."


def estimate(found, args):
    """Yields rows with the seconds on several nodes for a scene of another size, by stage: work + start of shards +
    shared files.

    Work is that of the fewest shards, divided by nodes and their processors; no node has less than one unit. A start
    costs what each further shard adds, and a barrier. Every node reads the model, all earlier stages, and the shards of
    the last one; that is an upper bound, because nodes have caches. Everything grows with the number of Gaussians, and
    the work of the scan also with frames; visible contribution and pruning rounds render a number of views that grows
    with neither.
    """
    source = found["plain"]["summary"]["input"]
    more, longer = args.gaussians / source["gaussians"], args.frames / source["frames"]
    many = found["runs"][-1]
    stages, before = {}, 0
    for (stage, work, start), cut in zip(split(found), many["stages"]):
        name = family(stage)
        units = found["units"].get(stage) or math.inf
        work *= more * (longer if name == "scan" else 1) / args.cores
        moved = more * (found["plain"]["summary"]["input"]["bytes"] + before) / args.bandwidth
        before += cut["whole_bytes"]
        costs = stages.setdefault(name, [0, 0.0, [[0.0] * 3 for _ in args.nodes]])
        costs[0] += 1
        costs[1] += work * args.cores
        for nodes, sums in zip(args.nodes, costs[2]):
            sums[0] += work / min(nodes, units * (more if name == "scan" else 1))
            sums[1] += start * more + args.barrier * (nodes > 1)
            # The joined shards are as large as the result of one shard.
            sums[2] += nodes * (moved + more * cut["part_bytes"] / args.bandwidth)
    heads = [f"{nodes} node{'s' * (nodes > 1)}" for nodes in args.nodes]
    yield f"| stage | processor s | {' | '.join(heads)} |"
    yield "|" + "---|" * (2 + len(args.nodes))
    for name, (count, work, costs) in stages.items():
        cells = [f"{sum(cost):.0f} ({cost[0]:.0f} + {cost[1]:.0f} + {cost[2]:.0f})" for cost in costs]
        yield f"| {name}{f' ({count} times)' if count > 1 else ''} | {work:.0f} | {' | '.join(cells)} |"
    rest = many["rest"]["processor"] * more
    yield f"| rest, on one node | {rest:.0f} | {' | '.join([f'{rest / args.cores:.0f}'] * len(args.nodes))} |"
    together = [rest / args.cores + sum(sum(costs[2][k]) for costs in stages.values()) for k in range(len(args.nodes))]
    yield f"| total, s | | {' | '.join(f'**{seconds:.0f}**' for seconds in together)} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", nargs="?", type=os.path.abspath)
    parser.add_argument("model", nargs="?", type=os.path.abspath)
    parser.add_argument("--cameras", type=os.path.abspath)
    parser.add_argument("--parts", nargs="+", type=int, default=[1, 2, 7])
    parser.add_argument("--json", type=Path, help="file to which all measurements are written")
    parser.add_argument("--of", type=Path, help="file with earlier measurements, in place of a program and a model")
    parser.add_argument("--scratch", help="folder for temporary results and caches")
    parser.add_argument("--check", action="store_true", help="exit 1 if shards cost more than 1.15 times one shard")
    parser.add_argument("--gaussians", type=float, default=1e6)
    parser.add_argument("--frames", type=float, default=1e4)
    parser.add_argument("--nodes", nargs="+", type=int, default=[1, 16, 256])
    parser.add_argument("--cores", type=int, default=16, help="processors of a node")
    parser.add_argument("--barrier", type=float, default=10, help="seconds of the scheduler between two arrays")
    parser.add_argument("--bandwidth", type=float, default=2e9, help="bytes per second of the shared file system, for all nodes together")
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    args = parser.parse_args(words[:cut])
    if not (args.of or args.model):
        parser.error("expected a program and a model, or --of")
    found = json.loads(args.of.read_text()) if args.of else measure(args, words[cut + 1 :])
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")
    source = found["plain"]["summary"]["input"]
    options = " ".join(found["options"])
    print(f"{found['model']}: {source['gaussians']:,} Gaussians x {source['frames']} frames, {options}; {found['machine']}\n")
    print(*stage_table(found), "", *chain_table(found), "", sep="\n")
    print(f"{args.gaussians:,.0f} Gaussians x {args.frames:,.0f} frames, nodes of {args.cores} processors:\n")
    print(*estimate(found, args), sep="\n")
    above = list(over(found))
    for line in above:
        print(f"FAILED: above {MOST}: {line}")
    sys.exit(args.check and bool(above))


if __name__ == "__main__":
    main()
