"""The documentation: a site without a broken link, and tutorials that do what they say."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```", re.M | re.S)


def test_there_are_six():
    assert len(TUTORIALS) == 6


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda p: p.stem)
def test_a_tutorial_does_what_it_says(page, tmp_path):
    """Its commands in a shell and its Python, one block after the other, in an empty folder."""
    blocks = BLOCK.findall(page.read_text())
    assert len(blocks) >= 2
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    script, number = ["set -euo pipefail"], 0
    for kind, text in blocks:
        if kind == "python":  # later blocks know the names of earlier ones
            number += 1
            (tmp_path / f"block{number}.py").write_text(text)
            files = ", ".join(f"'block{k}.py'" for k in range(1, number + 1))
            if number > 1:
                last = f"import runpy\nnames = {{}}\nfor f in ({files}):\n"
                last += "    exec(compile(open(f).read(), f, 'exec'), names)\n"
            if (kind, text) == [b for b in blocks if b[0] == "python"][-1]:
                program = "last.py" if number > 1 else "block1.py"
                if number > 1:
                    (tmp_path / program).write_text(last)
                script.append(f"python {program}")
        else:
            script.append(text)
    done = subprocess.run(
        ["bash", "-c", "\n".join(script)], cwd=tmp_path, capture_output=True, text=True,
        check=False, timeout=600, env=os.environ | {"PATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def test_the_site_is_built_and_asks_no_other_host(tmp_path):
    pytest.importorskip("mkdocs")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(tmp_path)]
    done = subprocess.run(
        words, cwd=ROOT, capture_output=True, text=True, check=False,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > 25
    api = (tmp_path / "api.html").read_text()
    for name in ("open_run", "MosaicSettings", "Observations", "read_survey", "gsd_cm"):
        assert name in api
    for page in pages:
        loaded = re.findall(
            r"<(?:script|link|img)[^>]+(?:src|href)=\"(https?://[^\"]+)", page.read_text()
        )
        assert [u for u in loaded if "canonical" not in u] == [], page
