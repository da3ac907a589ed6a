#!/usr/bin/env python3
"""Tests scripts/slurm with a real Slurm, which it starts and stops: same bytes, requeued tasks, reported failures.

    python3 tests/slurm/check.py target/release/splatsieve [MODEL] [--only NAME ...]

MODEL is room2_big; without it, scenes of `splatsieve demo` are used. Needs Slurm and MUNGE (Debian: slurm-wlm, munge)
and the Python standard library. Exits 1 if a test fails. `--start` only checks whether a private Slurm can be started
here.
"""

import argparse
import csv
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from cluster import Cluster, end, missing, wait

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts/slurm"


class Bench:
    """Folder with scenes, a program, and a Slurm that runs them."""

    def __init__(self, folder, program, model, cluster):
        self.folder, self.program, self.cluster = folder, program, cluster
        self.demo = folder / "demo scene"
        self.here("test-scene", "-o", self.demo, "--gaussians", 2000, "--frames", 24, "--quiet")
        self.scene = [model, "--cameras", model, "--no-refine"]
        if model is None:
            self.here("test-scene", "-o", folder / "large", "--gaussians", 20000, "--frames", 100, "--quiet")
            self.scene = [folder / "large/scene.gseq", "--cameras", folder / "large/cameras.json", "--no-refine"]
        self.plain = {}

    def here(self, *words):
        done = subprocess.run([str(word) for word in (self.program, *words)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr

    def one_process(self, name, words):
        """Returns what one process writes."""
        if name not in self.plain:
            self.here("compress", *words, "-o", self.folder / name, "--threads", 1, "--quiet")
            self.plain[name] = contents(self.folder / name)
        return self.plain[name]

    def submit(self, script, *words):
        """Submits from a separate folder. Returns the number of the last job."""
        return self.cluster.run(SCRIPTS / script, "--submit", *words, cwd=self.folder).split()[-1]

    def long(self, work, output, words, *options):
        options = ["--cache", work, "--program", self.program, *options]
        return self.submit("long_scene.py", *options, "--", *words, "-o", output)

    def meet(self, job_name, act, which=lambda _: True, once=False):
        """Acts on a running task of an array until one of them has been requeued."""
        for _ in range(12):
            found = []

            def works():
                for pid, name, variables in self.cluster.processes():
                    if name == "splatsieve" and variables.get("SLURM_JOB_NAME") == job_name and which(variables):
                        found[:] = [pid, variables["SLURM_JOB_ID"], variables["SLURMD_NODENAME"]]
                        # The stopped process cannot end before the action, however fast the machine is.
                        end(pid, signal.SIGSTOP)
                        return True
                return False

            wait(f"a task of {job_name}", 150, works, every=0.02)
            pid, number, node = found
            before = int(self.one(number)["Restarts"])
            try:
                act(number, node)
                wait(f"SIGTERM to {number}", 60, lambda: told(pid))
                end(pid, signal.SIGCONT)
                wait(f"the end of {number}", 60, lambda: self.one(number)["JobState"] != "RUNNING")
            except RuntimeError as error:
                # Messages of Slurm for a job that has just ended.
                assert "now" in str(error) or "completing" in str(error) or "Invalid job" in str(error), error
                end(pid, signal.SIGCONT)
            if int(self.one(number)["Restarts"]) > before or once:
                return number
        raise AssertionError(f"no task of {job_name} was met at work")

    def one(self, number):
        """Returns a task by its own job number, which may equal that of its array."""
        return next(task for task in self.cluster.state(number) if task["JobId"] == number)

    def logs(self, folder):
        return "".join(f"--- {path.name}\n{path.read_text()}" for path in sorted(folder.iterdir()))


def told(pid):
    """Returns whether a stopped process has a pending SIGTERM, or has ended."""
    try:
        status = dict(line.split(":\t") for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    except OSError:
        return True
    return status["State"][0] == "Z" or int(status["ShdPnd"], 16) >> signal.SIGTERM - 1 & 1


def contents(path):
    """Returns the bytes of a result by name, without files that contain times."""
    files = path.rglob("*") if path.is_dir() else path.parent.glob(path.name + "*")
    names = {file.relative_to(path) if path.is_dir() else file.name[len(path.name) :]: file for file in files if file.is_file()}
    return {str(name): file.read_bytes() for name, file in names.items() if not str(name).endswith("summary.json")}


def same(bench, output, name, words, job):
    found, expected = contents(output), bench.one_process(name, words)
    assert expected and found == expected, f"{job}: other bytes, or other files: {sorted(found)} and {sorted(expected)}"


def arrays_of_eight_give_the_bytes_of_one_process(bench):
    work, output = bench.folder / "work of 8", bench.folder / "small of 8"
    # Stages to divide: scan, visible, four rounds, pairs; the further listed rounds would find nothing to do.
    job = bench.long(work, output, bench.scene, "--parts", 8, "--arrays", 7)
    states = bench.cluster.ended(job, 240)
    logs = bench.logs(Path(f"{work}.logs"))
    assert states[0]["JobState"] == "COMPLETED", logs
    same(bench, output, "plain", bench.scene, job)
    assert "scan: part 8/8 is done" in logs and "visible: part 1/8 is done" in logs, logs


def a_lost_node_is_replaced(bench):
    work, output = bench.folder / "work of lost", bench.folder / "small of lost"
    job = bench.long(work, output, bench.scene, "--parts", 4, "--arrays", 2, "--name", "lost")
    lost = []

    def lose(number, node):
        bench.cluster.lose(node)
        lost.append(node)

    number = bench.meet("lost-visible", lose)
    states = bench.cluster.ended(job, 120)
    assert states[0]["JobState"] == "COMPLETED", bench.logs(Path(f"{work}.logs"))
    for node in lost:
        bench.cluster.node(node)
    assert bench.one(number)["Restarts"] == "1"
    same(bench, output, "plain", bench.scene, job)


def terminated_tasks_are_requeued(bench):
    work, output = bench.folder / "work of told", bench.folder / "small of told"
    job = bench.long(work, output, bench.scene, "--parts", 4, "--arrays", 2, "--name", "told")
    run = bench.cluster.run
    # Three ways to requeue: a time limit, an administrator, preemption. The first is applied to the task that has the
    # number of the array, by which Slurm's commands mean all tasks.
    tell = lambda number, node: run("scancel", "--signal=TERM", "--batch", f"{number}_4")  # noqa: E731
    bench.meet("told-visible", tell, which=lambda variables: variables["SLURM_JOB_ID"] == variables["SLURM_ARRAY_JOB_ID"])
    bench.meet("told-visible", lambda number, node: run("scontrol", "requeue", number))
    urgent = ["sbatch", "-p", "urgent", "-o", "/dev/null", "--wrap", "sleep 1"]
    bench.meet("told-visible", lambda number, node: run(*urgent, "-w", node))
    states = bench.cluster.ended(job, 120)
    logs = bench.logs(Path(f"{work}.logs"))
    assert states[0]["JobState"] == "COMPLETED", logs
    assert "told to end; back into the queue" in logs, logs
    same(bench, output, "plain", bench.scene, job)


def cancelled_jobs_are_not_requeued(bench):
    work, output = bench.folder / "work of cancelled", bench.folder / "small of cancelled"
    job = bench.long(work, output, bench.scene, "--parts", 1, "--arrays", 1, "--name", "cancelled")
    number = bench.meet("cancelled-scan", lambda number, node: bench.cluster.run("scancel", number), once=True)
    time.sleep(2)
    states = bench.cluster.ended(number, 30) + bench.cluster.ended(job, 30)
    assert [one["JobState"] for one in states] == ["CANCELLED"] * 2, states
    assert not output.exists()


def one_broken_scene_of_four_is_reported(bench):
    broken = bench.folder / "broken scene.gseq"
    broken.write_bytes((bench.demo / "scene.gseq").read_bytes()[:5000])
    listed = bench.folder / "list of four"
    listed.write_text(
        "# What there is\n\n"
        '"demo scene/scene.gseq" "demo scene/cameras.json" "small 1.gseq" --no-refine\n'
        "demo\\ scene/scene.gseq - small2.gseq --no-refine --ratio 0.3\n"
        '"broken scene.gseq" - small3.gseq\n'
        "  'demo scene/scene.gseq' 'demo scene/cameras.json' small4.gseq --no-refine --count 500\n"
    )
    run = Path(f"{listed}.run")

    def submitted():
        job = bench.submit("many_scenes.py", listed, "--program", bench.program, "--at-once", 3)
        states = bench.cluster.ended(job, 120)
        return states[0], list(csv.DictReader(open(run / "summary.csv")))

    state, rows = submitted()
    logs = bench.logs(run / "logs")
    assert (state["JobState"], state["ExitCode"]) == ("FAILED", "1:0"), logs
    assert [row["state"] for row in rows] == ["done", "done", "failed", "done"], logs
    assert rows[1]["gaussians_out"] == "600" and rows[3]["gaussians_out"] == "500", rows
    failed = rows[2]
    assert "broken scene.gseq" in failed["message"] and failed["message"] in logs, failed
    assert failed["message"].splitlines()[0][:40] in (run / "summary.html").read_text()
    words = ["demo scene/scene.gseq", "--cameras", "demo scene/cameras.json", "--no-refine"]
    one = bench.folder / "one.gseq"
    bench.here("compress", *(bench.folder / word if "/" in word else word for word in words), "-o", one, "--quiet")
    assert (bench.folder / "small 1.gseq").read_bytes() == one.read_bytes()
    # The command that repeats the scene gives the same message; after the repair only this scene is computed.
    again = subprocess.run(failed["command"], shell=True, capture_output=True, text=True, check=False)
    assert again.returncode == 1 and failed["message"] in again.stderr, again.stderr
    shutil.copy(bench.demo / "scene.gseq", broken)
    state, rows = submitted()
    assert state["JobState"] == "COMPLETED", bench.logs(run / "logs")
    assert [(row["state"], row["starts"]) for row in rows] == [("done", "1")] * 2 + [("done", "2"), ("done", "1")], rows


CASES = [
    arrays_of_eight_give_the_bytes_of_one_process,
    a_lost_node_is_replaced,
    terminated_tasks_are_requeued,
    cancelled_jobs_are_not_requeued,
    one_broken_scene_of_four_is_reported,
]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("model", nargs="?", type=Path)
    parser.add_argument("--start", action="store_true", help="only start and stop a Slurm")
    parser.add_argument("--only", nargs="+", choices=[case.__name__ for case in CASES])
    args = parser.parse_args()
    if lacks := missing():
        sys.exit(f"no {', '.join(lacks)}: Debian has them in slurm-wlm and munge")
    if args.start:
        with Cluster(1):
            return
    failed = 0
    with tempfile.TemporaryDirectory() as folder, Cluster(4) as cluster:
        model = args.model and args.model.resolve()
        bench = Bench(Path(folder), os.path.abspath(args.program), model, cluster)
        for case in CASES:
            if args.only and case.__name__ not in args.only:
                continue
            begun = time.monotonic()
            try:
                case(bench)
                print(f"holds: {case.__name__} ({time.monotonic() - begun:.0f} s)", flush=True)
            except (AssertionError, TimeoutError, RuntimeError) as error:
                failed += 1
                print(f"FAILED: {case.__name__}: {error}", flush=True)
            cluster.clear()
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
