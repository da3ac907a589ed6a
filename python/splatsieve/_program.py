"""Finds the program, turns keyword arguments into its options, and runs it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Union

# What an option may be: None leaves it out, a list or tuple is joined by commas, one of tuples repeats the option.
Option = Union[None, bool, int, float, str, "os.PathLike[str]", Sequence[Any], Mapping[str, Any]]
# Called with every line that the program says about its progress.
Log = Callable[[str], object]

# Options that take no value at all; the others that are True or False take `=true` and `=false`.
SWITCHES = frozenset(
    "all check clean dry_run explain flip json list_stages merge_only no_refine overwrite prune_only quiet raw".split()
)


class Error(Exception):
    """The program refused, or failed: its message; `code` is its exit code, 1 failed, 2 misused."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


def program() -> str:
    """The program that is run: the one installed with this module, else the one on PATH."""
    name = "splatsieve" + (sysconfig.get_config_var("EXE") or "")
    folders = [sysconfig.get_path("scripts"), os.path.dirname(sys.executable)]
    # `pip install --user`, and `--target`, whose programs lie beside the modules.
    folders += [sysconfig.get_path("scripts", f"{os.name}_user"), str(Path(__file__).resolve().parents[1] / "bin")]
    for folder in folders:
        path = os.path.join(folder, name)
        if os.path.isfile(path):
            return path
    found = shutil.which(name)
    if found is None:
        raise FileNotFoundError("the program splatsieve lies neither beside this module's Python nor on PATH")
    return found


def flags(options: Mapping[str, Option]) -> list[str]:
    """Returns options as words of a command line: `dry_run=True` is `--dry-run`, `keep_box=(0, 1)` is `--keep-box=0,1`,
    `set={"mu": 2}` is `--set=mu=2`."""
    words = []
    for key, value in options.items():
        flag = "--" + key.rstrip("_").replace("_", "-")
        if value is None or (value is False and key in SWITCHES):
            continue
        if value is True and key in SWITCHES:
            words.append(flag)
        elif key == "set" and isinstance(value, Mapping):
            words += [f"{flag}={name}={text(one)}" for name, one in value.items()]
        elif isinstance(value, (list, tuple)) and value and all(isinstance(one, (list, tuple)) for one in value):
            words += [f"{flag}={text(one)}" for one in value]
        else:
            words.append(f"{flag}={text(value)}")
    return words


def text(value: Option) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return ",".join(f"{key}={text(one)}" for key, one in value.items())
    if isinstance(value, (list, tuple)):
        return ",".join(map(text, value))
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return str(value)


class Running:
    """The program at work: what it says is taken from it as it comes, so that it never waits for us."""

    def __init__(self, words: Sequence[str], log: Log | None, stdin: int = subprocess.DEVNULL) -> None:
        quiet = [] if log else ["--quiet"]
        self.process = subprocess.Popen(
            [program(), *quiet, *words],
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self.said: list[str] = []
        self.printed: list[str] = []
        self.log = log
        ears = ((self.process.stderr, self.hear), (self.process.stdout, self.printed.append))
        self.ears = [threading.Thread(target=self.listen, args=ear, daemon=True) for ear in ears]
        for ear in self.ears:
            ear.start()

    @staticmethod
    def listen(pipe: IO[bytes], take: Callable[[str], object]) -> None:
        for line in pipe:
            take(line.decode("utf-8", "replace"))

    def hear(self, line: str) -> None:
        self.said.append(line)
        if self.log:
            self.log(line.rstrip("\n"))

    def finish(self) -> str:
        """Waits for its end; gives what it printed. Raises Error with what it said where it failed."""
        try:
            code = self.process.wait()
        except BaseException:
            # It takes away what it has begun.
            self.process.terminate()
            self.process.wait()
            raise
        for ear in self.ears:
            ear.join()
        for pipe in (self.process.stdout, self.process.stderr):
            if pipe:
                pipe.close()
        if code != 0:
            raise Error(message("".join(self.said)) or f"splatsieve ended with code {code}", code)
        return "".join(self.printed)


def message(said: str) -> str:
    """The program's own message, which is the last thing it says, behind its name; or the parser's, behind `error:`."""
    for name in ("splatsieve: ", "error: "):
        at = said.rfind("\n" + name)
        if at >= 0 or said.startswith(name):
            return said[at + 1 + len(name) :].strip()
    return said.strip()


def run(verb: str, *arguments: str | os.PathLike[str], log: Log | None = None, **options: Option) -> str:
    """Runs any command of the program with any of its options; gives what it printed to standard output.

        splatsieve.run("convert", "frames/", "scene.gseq", max_error={"position": 1e-3})

    `log` is called with every line about its progress. Raises Error.
    """
    words = [verb, *flags(options), "--", *(os.fspath(path) for path in arguments)]
    return Running(words, log).finish()


def parsed(printed: str) -> dict[str, Any]:
    try:
        found = json.loads(printed)
    except ValueError:
        # `--shard` and the like print a line instead.
        raise Error(f"no table came back (use splatsieve.run): {printed.strip()}", 0) from None
    return dict(found)


def compress(
    input: str | os.PathLike[str], output: str | os.PathLike[str], *, log: Log | None = None, **options: Option
) -> dict[str, Any]:
    """Writes a smaller model of `input` to `output`; gives its summary (format/SUMMARY.md),
    which lies beside it as JSON with the list of its files.

        splatsieve.compress("model", "small", cameras="data", ratio=0.3, preset="default")

    Options are those of `splatsieve compress --help`. Raises Error.
    """
    return parsed(run("compress", input, output=output, json=True, log=log, **options))


def evaluate(
    original: str | os.PathLike[str], compressed: str | os.PathLike[str], *, log: Log | None = None, **options: Option
) -> dict[str, Any]:
    """Compares the pictures of two models; gives what `splatsieve evaluate --json` prints. Raises Error."""
    return parsed(run("evaluate", original, compressed, json=True, log=log, **options))


def info(
    input: str | os.PathLike[str], *, log: Log | None = None, **options: Option
) -> dict[str, Any]:
    """Says what an input holds, as `splatsieve info --json` does. Raises Error."""
    return parsed(run("info", input, json=True, log=log, **options))
