"""Makes scripts end with a one-line message in place of a traceback. Import it first.

Wrong arguments print the usage lines of the script's docstring and exit with 2; other errors print one line that names
the file concerned and exit with 1; Ctrl-C exits with 130; a reader may close the output at any line. `python3 -X dev
SCRIPT` shows the traceback all the same.
"""

import linecache
import os
import signal
import subprocess
import sys
import traceback
from pathlib import Path


def usage(text):
    """Returns the indented lines of a script's docstring."""
    return "\n".join(line for line in (text or "").splitlines() if line.startswith("    "))


def one_line(error):
    """Returns a description of the error in one line."""
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


def report(kind, error, trace):
    """Reports an uncaught exception; replaces `sys.excepthook`."""
    main = sys.modules["__main__"]
    script = Path(getattr(main, "__file__", "script"))
    if isinstance(error, BrokenPipeError):
        # The reader has stopped reading; the rest of the output would be flushed at exit and fail again.
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
    print(f"{script.name}: {one_line(error)}", file=sys.stderr)


# Only for the scripts of these folders: a program that imports one of them keeps its own hook.
if Path(getattr(sys.modules["__main__"], "__file__", "")).resolve().parent in {
    Path(__file__).resolve().parent,
    Path(__file__).resolve().parent / "slurm",
    Path(__file__).resolve().parent / "benchmark",
}:
    sys.excepthook = report
