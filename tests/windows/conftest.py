"""Commands as on Windows: processes that `sitecustomize.py` changes."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
SOURCE = HERE.parents[1] / "src"


class Windows:
    """Starts programs; `refused` tells what they were refused."""

    def __init__(self, folder):
        self.notes = folder / "refused"
        self.environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join((str(HERE), str(SOURCE))),
            "SKYQUILT_REFUSED": str(self.notes),
            "PYTHONWARNDEFAULTENCODING": "1",
            "PYTHONIOENCODING": "cp1252",  # as where output goes into a file
            "OPENBLAS_NUM_THREADS": "1",
        }
        self.started = []

    def start(self, *words):
        program = subprocess.Popen(
            [sys.executable, *map(str, words)],
            env=self.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="cp1252",
        )
        self.started.append(program)
        return program

    def run(self, *words):
        """What a program prints; it ends without an error."""
        program = self.start(*words)
        said = program.communicate(timeout=120)[0]
        assert program.returncode == 0, said
        return said

    def skyquilt(self, *words):
        return self.run("-m", "skyquilt", *words)

    def served(self, *words):
        """A server and its address."""
        program = self.start("-m", "skyquilt", *words, "--port", "0")
        for line in program.stdout:
            if found := re.search(r"http://\S+", line):
                return program, found.group()
        raise AssertionError(f"no address: exit code {program.wait()}")

    def ours(self, text):
        """Runs text as code of the package, which alone finds what Windows has."""
        return self.run("-c", f"exec({text!r}, {{'__name__': 'skyquilt.tried'}})")

    def refused(self):
        """Numbers of errors and names of files since the last call."""
        if not self.notes.exists():
            return []
        lines = self.notes.read_text("utf-8").splitlines()
        self.notes.unlink()
        return sorted({(int(n), Path(p).name) for n, p in (s.split(" ", 1) for s in lines)})


@pytest.fixture
def windows(tmp_path):
    """Programs that are ended after the test."""
    made = Windows(tmp_path)
    yield made
    for program in made.started:
        program.kill()
        program.communicate()
