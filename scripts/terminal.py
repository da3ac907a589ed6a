#!/usr/bin/env python3
"""Runs a command in terminals of given sizes and reports what remains on the screen, to check progress bars.

    python3 scripts/terminal.py [--columns 80,100,120] [--show] COMMAND ...

Every drawn line must fit, no line of a bar may remain, and no bar may say that no time is left. --show prints the
screen half-way and at the end. Needs only the standard library; Linux and macOS.
"""

import argparse
import fcntl
import os
import pty
import re
import struct
import sys
import termios
import unicodedata

ROWS = 500
# Line of a progress bar, in contrast to other output of a run.
BAR = re.compile(r"\d+%.* (views|states|steps|points|frames|settings|Gaussians)\b")


class Screen:
    """Model of the parts of a terminal that bars use: wrapping, moving up, clearing."""

    def __init__(self, columns):
        self.columns, self.row, self.column = columns, 0, 0
        self.lines = [""]

    def put(self, text):
        if unicodedata.category(text) == "Cc":
            return
        if self.column >= self.columns:
            # A line may be filled with blanks up to the last column.
            self.newline()
            self.column = 0
        line = self.lines[self.row].ljust(self.column)
        self.lines[self.row] = line[: self.column] + text + line[self.column + 1 :]
        self.column += 1

    def newline(self):
        self.row += 1
        while len(self.lines) <= self.row:
            self.lines.append("")

    def control(self, numbers, letter):
        number = int(numbers.split(";")[0]) if numbers.split(";")[0].isdigit() else None
        if letter == "A":
            self.row = max(0, self.row - (number or 1))
        elif letter == "B":
            for _ in range(number or 1):
                self.newline()
        elif letter in "CD":
            self.column = max(0, self.column + (number or 1) * (1 if letter == "C" else -1))
        elif letter == "G":
            self.column = (number or 1) - 1
        elif letter == "K":
            line = self.lines[self.row]
            self.lines[self.row] = {0: line[: self.column], 1: " " * self.column + line[self.column :], 2: ""}[number or 0]
        elif letter == "J":
            self.lines[self.row] = self.lines[self.row][: self.column]
            del self.lines[self.row + 1 :]

    def feed(self, text):
        for found in re.finditer(r"\x1b\[([0-9;?]*)([A-Za-z])|(\r)|(\n)|(.)", text, re.S):
            numbers, letter, back, down, other = found.groups()
            if letter:
                self.control(numbers, letter)
            elif back:
                self.column = 0
            elif down:
                self.newline()
            elif other:
                self.put(other)


def run(command, columns):
    """Runs a command. Returns the screen at the end, the screens before, and the exit code."""
    child, terminal = pty.fork()
    if child == 0:
        os.environ["TERM"] = "xterm"
        try:
            os.execvp(command[0], command)
        except OSError as error:
            print(f"{command[0]}: {error.strerror}", file=sys.stderr)
            os._exit(127)
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, columns, 0, 0))
    screen, between, rest = Screen(columns), [], b""
    while True:
        try:
            read = os.read(terminal, 65536)
        except OSError:
            break
        if not read:
            break
        # A piece of output that ends within a character or an escape sequence waits for the rest.
        rest += read
        text = rest.decode(errors="ignore")
        if re.search(r"\x1b(\[[0-9;?]*)?$", text):
            continue
        rest = b""
        screen.feed(text)
        between.append("\n".join(screen.lines))
    return screen, between, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--columns", default="80,100,120")
    parser.add_argument("--show", action="store_true")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    arguments = parser.parse_args()
    if not arguments.command:
        parser.error("expected a command")
    failed = []
    for columns in map(int, arguments.columns.split(",")):
        screen, between, code = run(arguments.command, columns)
        drawn = [line for text in between for line in text.splitlines() if BAR.search(line)]
        left = [line for line in screen.lines if BAR.search(line)]
        checks = {
            f"ended with {code}": code != 0,
            "a line was too long": any(len(line.rstrip()) >= columns for line in drawn),
            f"stayed behind: {left}": left,
            "says that no time is left": any(re.search(r"(?<![\d.])0(\.0)? ?s left", line) for line in drawn),
            "no bar was drawn": not drawn,
        }
        found = [what for what, bad in checks.items() if bad]
        failed += found
        print(f"{columns} columns: {len(drawn)} lines of bars drawn; {'; '.join(found) or 'all fit'}")
        if arguments.show:
            middle = between[len(between) // 2] if between else ""
            print("--- half-way\n" + middle + "\n--- at the end\n" + "\n".join(screen.lines).rstrip() + "\n---")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
