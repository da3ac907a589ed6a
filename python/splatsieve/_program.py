"""Finds the program, converts keyword arguments to its options, and runs it."""

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

# Value of an option. None omits the option. A list is joined by commas. A list of lists repeats the option for each
# inner list. Tuples count as lists.
Option = Union[None, bool, int, float, str, "os.PathLike[str]", Sequence[Any], Mapping[str, Any]]
# Function that is called with every progress line of the program.
Log = Callable[[str], object]

# Options that can be given without a value; the other boolean options take `=true` and `=false`.
SWITCHES = frozenset(
    "all allow_gaps check clean dry_run explain flip json merge_only no_refine overwrite path prune_only quiet raw "
    "render_time verbose view".split()
)


class Error(Exception):
    """Message of the program after a failure. `code` is its exit code: 1 for a failure, 2 for wrong usage."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


def program() -> str:
    """Returns the path of the program: the one installed with this module, or else the one on PATH."""
    name = "splatsieve" + (sysconfig.get_config_var("EXE") or "")
    folders = [sysconfig.get_path("scripts"), os.path.dirname(sys.executable)]
    # `pip install --user` and `--target` put programs beside the modules.
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
    """Converts options to command-line arguments: `dry_run=True` to `--dry-run`, `keep_box=(0, 1)` to
    `--keep-box=0,1`, `set={"mu": 2}` to `--set=mu=2`. A list of lists repeats the option, also as a value in `set`.
    """
    words = []
    for key, value in options.items():
        flag = "--" + key.rstrip("_").replace("_", "-")
        if value is None or (value is False and key in SWITCHES):
            continue
        if value is True and key in SWITCHES:
            words.append(flag)
        elif key == "set" and isinstance(value, Mapping):
            words += [f"{flag}={name}={one}" for name, parameter in value.items() for one in texts(parameter)]
        else:
            words += [f"{flag}={one}" for one in texts(value)]
    return words


def texts(value: Option) -> list[str]:
    """Returns the command-line texts of a value: one for each inner list of a list of lists, else one."""
    if isinstance(value, (list, tuple)) and value and all(isinstance(one, (list, tuple)) for one in value):
        return [text(one) for one in value]
    return [text(value)]


def text(value: Option) -> str:
    """Returns the command-line text of an option value."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return ",".join(f"{key}={text(one)}" for key, one in value.items())
    if isinstance(value, (list, tuple)):
        return ",".join(map(text, value))
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return str(value)


class RunningProgram:
    """Running program. Threads read its output as it comes, so that the program never waits for a reader."""

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
        readers = ((self.process.stderr, self.add_message), (self.process.stdout, self.printed.append))
        self.readers = [threading.Thread(target=self.read_lines, args=reader, daemon=True) for reader in readers]
        for reader in self.readers:
            reader.start()

    @staticmethod
    def read_lines(pipe: IO[bytes], take: Callable[[str], object]) -> None:
        for line in pipe:
            take(line.decode("utf-8", "replace"))

    def add_message(self, line: str) -> None:
        self.said.append(line)
        if self.log:
            self.log(line.rstrip("\n"))

    def finish(self) -> str:
        """Waits for the end of the program and returns its standard output. Raises Error with its message if it failed.
        """
        try:
            code = self.process.wait()
        except BaseException:
            # The program removes its unfinished files when it is terminated.
            self.process.terminate()
            self.process.wait()
            raise
        for reader in self.readers:
            reader.join()
        for pipe in (self.process.stdout, self.process.stderr):
            if pipe:
                pipe.close()
        if code != 0:
            raise Error(message("".join(self.said)) or f"splatsieve ended with code {code}", code)
        return "".join(self.printed)


def message(said: str) -> str:
    """Returns the error message in `said`, the standard error of the program.

    This is the text after the last line start `splatsieve: `, else after the last `error: ` of the argument parser,
    else all of `said`.
    """
    for name in ("splatsieve: ", "error: "):
        at = said.rfind("\n" + name)
        if at >= 0 or said.startswith(name):
            return said[at + 1 + len(name) :].strip()
    return said.strip()


def run(verb: str, *arguments: str | os.PathLike[str], log: Log | None = None, **options: Option) -> str:
    """Runs the command `verb` of the program with any of its options. Returns its standard output.

        splatsieve.run("convert", "frames/", "scene.gseq", max_error={"position": 1e-3})

    `log` is called with every progress line. Raises Error if the program fails.
    """
    words = [verb, *flags(options), "--", *(os.fspath(path) for path in arguments)]
    return RunningProgram(words, log).finish()


def parsed(printed: str) -> dict[str, Any]:
    """Returns the JSON object in the text `printed`. Raises Error if the text is not JSON."""
    try:
        found = json.loads(printed)
    except ValueError:
        # Some options, such as `--shard`, print a line in place of JSON.
        raise Error(f"no table came back (use splatsieve.run): {printed.strip()}", 0) from None
    return dict(found)


def compress(
    input: str | os.PathLike[str], output: str | os.PathLike[str], *, log: Log | None = None, **options: Option
) -> dict[str, Any]:
    """Writes a smaller model of `input` to `output`. Returns the summary of the run (format/SUMMARY.md).

    The summary is also written beside the output as JSON, with the list of the output files.

        splatsieve.compress("model", "small", cameras="data", ratio=0.3, preset="default")

    Options are those of `splatsieve compress --help`. Raises Error if the program fails.
    """
    return parsed(run("compress", input, output=output, json=True, log=log, **options))


def evaluate(
    original: str | os.PathLike[str], compressed: str | os.PathLike[str], *, log: Log | None = None, **options: Option
) -> dict[str, Any]:
    """Compares the renders of two models. Returns the JSON of `splatsieve evaluate --json`.

    Raises Error if the program fails.
    """
    return parsed(run("evaluate", original, compressed, json=True, log=log, **options))


def info(
    input: str | os.PathLike[str], *, log: Log | None = None, **options: Option
) -> dict[str, Any]:
    """Returns the description of an input, the JSON of `splatsieve info --json`. Raises Error if the program fails."""
    return parsed(run("info", input, json=True, log=log, **options))
