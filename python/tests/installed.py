#!/usr/bin/env python3
"""Builds the wheel, installs it into a new environment, and tests what the README of the package describes.

    python3 python/tests/installed.py [WHEEL]

Needs maturin, numpy and zstandard. If WHEEL is given, that file is tested and nothing is built. Nothing is downloaded:
numpy and zstandard come from the Python that runs this script.
"""

import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import unittest
import venv
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def wheel(folder):
    command = [sys.executable, "-m", "maturin", "build", "--release", "--out", folder]
    subprocess.run(command, cwd=PACKAGE, check=True)
    (built,) = Path(folder).glob("*.whl")
    return built


def main():
    """Runs this file again with the Python of an environment that contains the wheel."""
    with tempfile.TemporaryDirectory() as folder:
        built = Path(sys.argv[1]) if len(sys.argv) > 1 else wheel(folder)
        environment = Path(folder) / "environment"
        venv.create(environment, with_pip=True)
        python = environment / ("Scripts" if os.name == "nt" else "bin") / "python"
        subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", built], check=True)
        ask = "import sysconfig; print(sysconfig.get_path('purelib'))"
        own = subprocess.run([python, "-c", ask], check=True, capture_output=True, text=True).stdout.strip()
        (Path(own) / "of_the_tester.pth").write_text(sysconfig.get_path("purelib"))
        sys.exit(subprocess.run([python, __file__], env=os.environ | {"SPLATSIEVE_INSTALLED": own}, cwd=folder).returncode)


class Installed(unittest.TestCase):
    """Tests of the module and the program of the wheel, in an empty folder."""

    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.at = Path(cls.folder.name)
        splatsieve.run("test-scene", output=cls.at / "demo")

    @classmethod
    def tearDownClass(cls):
        cls.folder.cleanup()

    def test_module_and_program_are_the_installed_ones(self):
        own = Path(os.environ["SPLATSIEVE_INSTALLED"])
        self.assertEqual(Path(splatsieve.__file__).parent, own / "splatsieve")
        self.assertTrue((own / "splatsieve" / "py.typed").is_file())
        self.assertEqual(Path(splatsieve.program()).parent, Path(sysconfig.get_path("scripts")))

    def test_compress_returns_the_summary_beside_the_result(self):
        lines = []
        summary = splatsieve.compress(
            self.at / "demo" / "scene.gseq", self.at / "half.gseq", ratio=0.5, set={"refine_steps": 2}, log=lines.append
        )
        written = json.loads((self.at / "half.gseq.summary.json").read_text())
        self.assertIn("half.gseq", written.pop("files"))
        # The file names input and output without their folders.
        summary["output"], summary["input"]["path"] = "half.gseq", "scene.gseq"
        self.assertEqual(summary, written)
        self.assertTrue(any("scan" in line for line in lines), lines)
        before, after = (splatsieve.info(self.at / name)["gaussians"] for name in ("demo/scene.gseq", "half.gseq"))
        self.assertEqual(after, -(-before // 2))

    def test_a_dry_run_writes_nothing(self):
        splatsieve.run("compress", self.at / "demo" / "scene.gseq", output=self.at / "no.gseq", dry_run=True)
        self.assertFalse((self.at / "no.gseq").exists())

    def test_a_refusal_raises_the_message_of_the_program(self):
        with self.assertRaisesRegex(splatsieve.Error, "no_such_model") as refused:
            splatsieve.compress(self.at / "no_such_model", self.at / "x.gseq")
        self.assertEqual(refused.exception.code, 1)
        self.assertNotIn("splatsieve:", str(refused.exception))
        with self.assertRaisesRegex(splatsieve.Error, "--no-such-option") as misused:
            splatsieve.compress("a", "b", no_such_option=1)
        self.assertEqual(misused.exception.code, 2)

    def columns(self, count):
        dice = np.random.default_rng(3)
        return {
            "position": dice.normal(size=(count, 3)).astype("<f4"),
            "rotation": np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
            "log_scale": np.full((count, 3), -3, "<f4"),
            "opacity_logit": np.full(count, 2, "<f4"),
            "sh": dice.normal(size=(count, 1, 3)).astype("<f4"),
        }

    def test_streamed_frames_are_read_back_to_the_bit(self):
        columns = self.columns(300)
        position = columns.pop("position")
        with splatsieve.stream(self.at / "s.gseq", 300, 0, columns, command="convert") as out:
            for frame in range(5):
                out.frame(frame / 4, {"position": position + np.float32(frame)})
        scene = splatsieve.read_gseq(str(self.at / "s.gseq"))
        self.assertEqual(scene.times.tolist(), [0, 0.25, 0.5, 0.75, 1])
        for frame in range(5):
            self.assertTrue(np.array_equal(scene.column("position", frame), position + np.float32(frame)))
        self.assertTrue(np.array_equal(scene.column("sh", 3), columns["sh"].reshape(300, 3)))

    def test_a_compressed_stream_has_a_summary(self):
        columns = self.columns(200)
        with splatsieve.stream(self.at / "c.gseq", 200, 0, columns, count_=50, no_refine=True) as out:
            out.frame(0.0, {})
            out.frame(1.0, {})
        self.assertEqual(splatsieve.info(self.at / "c.gseq")["gaussians"], 50)
        self.assertEqual(out.summary["gaussians"], 50)

    def test_a_failing_exporter_leaves_no_file(self):
        with self.assertRaisesRegex(ZeroDivisionError, "exporter"):
            with splatsieve.stream(self.at / "f.gseq", 200, 0, self.columns(200), command="convert") as out:
                out.frame(0.0, {})
                raise ZeroDivisionError("exporter")
        self.assertFalse((self.at / "f.gseq").exists())

    def test_a_wrong_shape_is_refused_before_the_program_starts(self):
        columns = self.columns(200)
        columns["position"] = columns["position"].T
        with self.assertRaisesRegex(ValueError, r"position has shape \[3, 200\], expected \[200, 3\]"):
            splatsieve.stream(self.at / "w.gseq", 200, 0, columns)

    def test_a_refused_stream_raises_the_message(self):
        with self.assertRaisesRegex(splatsieve.Error, "frame 1.*above 1"):
            with splatsieve.stream(self.at / "t.gseq", 200, 0, self.columns(200), command="convert") as out:
                out.frame(1.0, {})
                for _ in range(1000):
                    out.frame(0.5, {})

    def test_switches_match_the_help_of_the_program(self):
        def help(*words):
            return subprocess.run([splatsieve.program(), *words, "--help"], check=True, capture_output=True, text=True).stdout

        # A line of a command: its name after two blanks, then two blanks or more before its description.
        verbs = re.findall(r"^  ([\w-]+) {2,}", help().partition("\nOptions:")[0], re.M)
        self.assertIn("compress", verbs)
        options = "".join(help(verb) for verb in verbs if verb != "help")
        # A name is followed by its value, by an optional value in brackets, or after two blanks by its description.
        found = set(re.findall(r"^ {2,6}(?:-\w, )?--([\w-]+)(?:$| ?\[| {2,}\S)", options, re.M))
        self.assertEqual({name.replace("-", "_") for name in found} - {"help", "version"}, set(_program.SWITCHES))

    def test_options_become_command_line_words(self):
        words = _program.flags({"as_": "ply", "overwrite": False, "dry_run": True, "cameras": None})
        self.assertEqual(words, ["--as=ply", "--dry-run"])
        words = _program.flags({"keep_box": (-1, 0, 1.5), "max_error": {"position": 1e-3}})
        self.assertEqual(words, ["--keep-box=-1,0,1.5", "--max-error=position=0.001"])
        words = _program.flags({"set": {"choose_by_views": False, "refine_steps": 9}})
        self.assertEqual(words, ["--set=choose_by_views=false", "--set=refine_steps=9"])
        words = _program.flags({"set": {"passes": [(0.005, 1, 0.95, 0.9), (0.01, 2, 0.9, 0.8)], "mu": 2}})
        self.assertEqual(words, ["--set=passes=0.005,1,0.95,0.9", "--set=passes=0.01,2,0.9,0.8", "--set=mu=2"])
        self.assertEqual(_program.flags({"path": True}), ["--path"])
        self.assertEqual(_program.flags({"path": (0, 3)}), ["--path=0,3"])
        words = _program.flags({"set": [("passes=1", 2), ("passes=3", 4)]})
        self.assertEqual(words, ["--set=passes=1,2", "--set=passes=3,4"])


if __name__ == "__main__":
    if "SPLATSIEVE_INSTALLED" not in os.environ:
        main()
    import json

    import numpy as np

    import splatsieve
    from splatsieve import _program

    unittest.main()
