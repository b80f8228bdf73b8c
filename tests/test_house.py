"""What no committed file may hold, and files that must say the same as others."""

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
OURS = ("src", "tests", "docs", "examples", "benchmarks", ".ci")
TEXT = {
    ".py",
    ".md",
    ".toml",
    ".txt",
    ".json",
    ".js",
    ".css",
    ".j2",
    ".html",
    ".csv",
    ".yaml",
    ".yml",
    ".cfg",
    "",
}
SLASH = "/"
HOMES = [SLASH + name + SLASH for name in ("work", "home", "root", "Users", "opt", "mnt")]
REGISTRIES = ["index-" + "url", "find-" + "links", "pypi" + ".", "trusted-" + "host"]


def committed():
    top = [p for p in ROOT.iterdir() if p.is_file() and p.name != ".git"]
    below = [p for name in OURS for p in (ROOT / name).rglob("*") if p.is_file()]
    return [p for p in top + below if p.suffix in TEXT and not {"__pycache__"} & set(p.parts)]


def test_the_whole_house_is_looked_at():
    names = {p.relative_to(ROOT).as_posix() for p in committed()}
    assert {"README.md", "Makefile", "pyproject.toml", "constraints.txt", ".ci/run"} <= names
    assert len(names) > 150


def test_no_file_names_a_place_on_a_machine_or_an_address_of_a_registry():
    found = []
    for path in committed():
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            for word in HOMES + REGISTRIES:
                at = line.find(word)
                # a path that goes on from something (docs/work/..., a/home/b) is relative, not a
                # machine's
                if at >= 0 and (
                    word in REGISTRIES or at == 0 or not re.match(r"[\w.}\]-]", line[at - 1])
                ):
                    found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert not found, "\n".join(found)


@pytest.mark.parametrize("line", (ROOT / "constraints.txt").read_text().split())
def test_constraints_are_names_with_versions(line):
    assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*==[0-9][0-9A-Za-z.+]*", line)


def test_everything_asked_for_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["test"], "setuptools"]
    pinned = {plain(line.split("==")[0]) for line in (ROOT / "constraints.txt").read_text().split()}
    assert {plain(re.split(r"[<>=~! ;\[]", name)[0]) for name in wanted} <= pinned


def test_one_version():
    import skyquilt

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == skyquilt.__version__
    assert f"## {skyquilt.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_links_between_documents_lead_somewhere():
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.relative_to(ROOT)} -> {target}"


def test_the_documents_name_every_file_of_a_run_and_every_option():
    from typer.main import get_command

    from skyquilt.cli.app import app
    from skyquilt.engine.folder import CONTRACT

    readme = (ROOT / "README.md").read_text()
    assert [name for name in CONTRACT if f"`{name}`" not in readme] == []
    listed = (ROOT / "docs" / "options.md").read_text()
    options = [
        o for p in get_command(app).commands["mosaic"].params for o in p.opts if o.startswith("--")
    ]
    assert [o for o in options if f"`{o}" not in listed and f"{o}`" not in listed] == []
    first = [o for o in re.findall(r"^\| `(--[\w-]+)`", readme, re.M) if o in options]
    assert first == ["--output", "--gsd", "--gcp", "--crs", "--thermal", "--overwrite"]


def test_the_options_page_states_the_defaults():
    import inspect

    from skyquilt.cli.mosaic import command

    readme = (ROOT / "docs" / "options.md").read_text()
    rows = dict(re.findall(r"^\| `(--[\w-]+)`[^|]*\|.*\| *([^|]*?) *\|$", readme, re.M))
    for name, parameter in inspect.signature(command).parameters.items():
        if isinstance(parameter.default, (int, float, str)) and not isinstance(
            parameter.default, bool
        ):
            stated = rows["--" + name.replace("_", "-")].strip("`")
            assert stated == (
                "all processors" if name == "jobs" else str(parameter.default).removesuffix(".0")
            ), name


def test_files_are_put_in_place_in_one_place():
    """`outside.put_in_place` and its like wait for other programs, as Windows needs; `simulate`
    shares no code with the rest, and writes only into folders of its own.
    """
    moved = re.compile(r"\.(?:replace|rename)\([^,=()\"']*\)|os\.(?:replace|rename)\(|rmtree\(")
    found = {
        p.relative_to(ROOT / "src" / "skyquilt").as_posix()
        for p in (ROOT / "src").rglob("*.py")
        if moved.search(p.read_text(encoding="utf-8"))
    }
    assert found == {"outside.py", "simulate/run.py"}


def plain(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_no_file_holds_both_sides_of_a_merge():
    marks = re.compile(r"^(<{7} |={7}$|>{7} )", re.M)
    kinds = ("*.py", "*.md", "*.toml", "*.txt", "*.j2", "*.css", "*.js", "Makefile")
    folders = ("src", "tests", "docs", "benchmarks", "examples")
    found = [p for k in kinds for f in folders for p in (ROOT / f).rglob(k)] + [
        p for k in kinds for p in ROOT.glob(k)
    ]
    assert [
        str(p.relative_to(ROOT)) for p in found if marks.search(p.read_text(errors="replace"))
    ] == []


@pytest.mark.slow
def test_benchmarks_call_what_is_there(tmp_path):
    """Benchmarks are run by hand and rarely: a function that changed its arguments is found
    here.
    """
    known = ROOT / ".mypy_cache"  # of `make check`, whose own is not to be changed
    if known.is_dir():
        shutil.copytree(known, tmp_path, dirs_exist_ok=True)
    programs = sorted(str(p) for p in (ROOT / "benchmarks").glob("*.py"))
    words = [
        sys.executable,
        "-m",
        "mypy",
        "--check-untyped-defs",
        "--config-file",
        str(ROOT / "pyproject.toml"),
        "--cache-dir",
        str(tmp_path),
    ]
    said = subprocess.run(
        [*words, *programs], cwd=ROOT / "benchmarks", capture_output=True, text=True, check=False
    )
    assert "Found" in said.stdout or "Success" in said.stdout, said.stderr
    broken = [
        line
        for line in said.stdout.splitlines()
        if "[call-arg]" in line or "[name-defined]" in line
    ]
    assert len(programs) > 10 and not broken, broken


def test_the_table_of_methods_and_options_is_that_of_the_code():
    from skyquilt import registry

    text = (ROOT / "docs" / "methods.md").read_text().split("## Which method takes which option")[1]
    head, _, *rows = re.findall(r"^\|.*\|$", text.split("\n\n")[2], re.M)
    columns = [c.strip().split(", ") for c in head.strip("|").split("|")][1:]
    told = {}
    for row in rows:
        option, *cells = (c.strip() for c in row.strip("|").split("|"))
        for name in re.findall(r"--([\w-]+)", option):
            for methods, cell in zip(columns, cells, strict=True):
                words = cells[0] if cell == "the same" else cell
                for method in methods:
                    only = words.removesuffix(" only") if words.endswith(" only") else method
                    if words and method in only.split(", "):
                        told.setdefault(method, {})[name] = words.split(", ")
    for method in registry.names("alignment"):
        takes = registry.row("alignment", method).takes
        assert told[method].keys() == takes.keys(), method
        for name in ("detector", "matcher", "estimator", "transform"):
            assert told[method].get(name, []) == list(takes.get(name, ())), (method, name)


def test_what_the_documents_name_is_there():
    """`package.module.Name` in the pages on methods and on the house can be imported."""
    from importlib import import_module

    lost = []
    packages = {p.name for p in (ROOT / "src" / "skyquilt").iterdir() if p.is_dir()}
    names = ("methods", "architecture", "spectral", "estimators", "conventions")
    pages = [ROOT / "docs" / f"{name}.md" for name in names]
    decisions = sorted((ROOT / "docs" / "decisions").glob("*.md"))
    assert len(decisions) > 5
    for page in (*pages, *decisions):
        text = page.read_text()
        for name in re.findall(r"`((?:\w+\.)+\w+)(?:\(\))?`", text):
            parts = name.split(".")
            if parts[0] not in packages or name.endswith((".py", ".csv", ".html")):
                continue
            try:
                found = import_module(f"skyquilt.{parts[0]}")
                for k, part in enumerate(parts[1:], 2):
                    if part in getattr(found, "__dataclass_fields__", {}):
                        break
                    try:
                        found = getattr(found, part)
                    except AttributeError:
                        found = import_module("skyquilt." + ".".join(parts[:k]))
            except ImportError:
                lost.append(f"{page.name}: {name}")
    assert lost == []


def test_what_the_scripts_import_is_there():
    """No test runs every benchmark: a module that moved is found by name at least."""
    from importlib import import_module

    lost = []
    for folder in ("benchmarks", "examples", "fuzz"):
        for script in sorted((ROOT / folder).glob("*.py")):
            for node in ast.walk(ast.parse(script.read_text())):
                if not isinstance(node, ast.ImportFrom) or node.level:
                    continue
                if not (node.module or "").startswith("skyquilt"):
                    continue
                for name in node.names:
                    try:
                        module = import_module(node.module)
                        if not hasattr(module, name.name):
                            import_module(f"{node.module}.{name.name}")
                    except ImportError:
                        lost.append(f"{script.name}: {node.module}.{name.name}")
    assert lost == []


@pytest.mark.slow
def test_few_files_lie_on_the_way_of_a_photo_and_of_an_upload():
    words = [sys.executable, "-W", "ignore", str(ROOT / "benchmarks" / "stops.py")]
    said = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    photo, upload = (int(n) for n in re.findall(r"^\w+: (\d+) files", said, re.M))
    assert 10 < photo <= 24 and 6 < upload <= 14, said
    # six files have outgrown 300 lines and wait to be divided; none may grow beyond this
    long = [int(n) for n in re.findall(r"\((\d+)\)", said)]
    assert max(long, default=0) <= 430, said


def test_the_page_on_the_papers_names_tests_and_commands_that_there_are():
    """docs/papers.md: every test that it says holds a claim, and every command that remakes one."""
    text = (ROOT / "docs" / "papers.md").read_text()
    named = re.findall(r"`(?:tests/)?([a-z]+/test_\w+\.py)?(?:::)?(test_\w+)?`", text)
    named = [(file, test) for file, test in named if file or test]
    assert len(named) > 40
    for file, test in named:
        files = [ROOT / "tests" / file] if file else list((ROOT / "tests").rglob("test_*.py"))
        assert any(f"def {test}" in f.read_text() for f in files), (file, test)
    rows = re.search(r"## Every table and figure(.*?)\n## ", text, re.S)
    listed = re.search(r"^NAMES.*?^}", (ROOT / "benchmarks" / "papers.py").read_text(), re.S | re.M)
    assert rows is not None and listed is not None
    commands = set(re.findall(r"`((?:table|fig|eq)-[0-9a-z.]+|depth-maps|models|mse)`", rows[1]))
    assert len(commands) >= 12
    assert commands <= set(re.findall(r'^    "([^"]+)":', listed[0], re.M))
