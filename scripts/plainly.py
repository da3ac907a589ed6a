"""Lets a script end with a sentence where Python would print a traceback: import it first.

Wrong arguments give the usage of the script's own text and 2, whatever else fails a line with the file it was about and 1,
Ctrl-C 130; whoever reads the output may stop at any line. `python3 -X dev SCRIPT` shows the traceback all the same.
"""

import linecache
import os
import signal
import subprocess
import sys
import traceback
from pathlib import Path


def usage(text):
    """The indented lines that a script's text begins with."""
    return "\n".join(line for line in (text or "").splitlines() if line.startswith("    "))


def sentence(error):
    """What went wrong, in one line."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, ModuleNotFoundError):
        return f"needs the Python package {error.name}: pip install {error.name}"
    if isinstance(error, subprocess.CalledProcessError):
        told = error.stderr or b""
        told = (told.decode(errors="replace") if isinstance(told, bytes) else told).strip().splitlines()
        command = error.cmd if isinstance(error.cmd, str) else " ".join(map(str, error.cmd))
        return f"`{command}` ended with {error.returncode}" + (f": {told[0]}" if told else "")
    if isinstance(error, KeyError):
        return f"expected an entry {error}, found none"
    return " ".join(str(error).split()) or type(error).__name__


def tell(kind, error, trace):
    """Python's `sys.excepthook`."""
    main = sys.modules["__main__"]
    script = Path(getattr(main, "__file__", "script"))
    if isinstance(error, BrokenPipeError):
        # Whoever read our output has seen enough; what is left would be flushed at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        os._exit(0)
    if isinstance(error, KeyboardInterrupt):
        sys.stderr.flush()
        os._exit(128 + signal.SIGINT)
    if sys.flags.dev_mode:
        traceback.print_exception(kind, error, trace)
        return
    last = traceback.extract_tb(trace)[-1] if trace else None
    line = linecache.getline(last.filename, last.lineno) if last else ""
    if "sys.argv" in line and isinstance(error, (ValueError, IndexError)):
        print(f"{script.name}: wrong arguments; expected\n{usage(main.__doc__)}", file=sys.stderr)
        sys.stderr.flush()
        os._exit(2)
    print(f"{script.name}: {sentence(error)}", file=sys.stderr)


# Only of the scripts here: a program that imports one of them keeps its own.
if Path(getattr(sys.modules["__main__"], "__file__", "")).resolve().parent in {
    Path(__file__).resolve().parent,
    Path(__file__).resolve().parent / "slurm",
}:
    sys.excepthook = tell
