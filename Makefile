# Nothing is assumed but make and python3 (3.11 or newer). Everything lives in .venv beside this file.

PYTHON ?= python3
BIN := .venv/bin
USE := .venv/installed
DEVELOP := .venv/installed-for-tests
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --quiet --constraint constraints.txt

# Compiled files of the tests are kept, whatever the shell says: rewriting all their assertions takes
# each of the test processes ten seconds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install demo test quick test-all check format docs fuzz fuzz-quick wheels sbom locked clean

# The program with its live map and viewer: .venv/bin/skyquilt
install: $(USE)

# A simulated flight and its map, placed by control points. The simulator's truth shows how far the map is off.
demo: $(USE)
	@$(BIN)/skyquilt simulate demo/flight --preset demo --overwrite
	@$(BIN)/skyquilt mosaic demo/flight/photos --gcp demo/flight/gcp_list.txt -o demo/map --overwrite
	@$(BIN)/python examples/04_map_against_truth.py demo/map/mosaic.tif demo/flight/truth/truth_ortho.tif demo/map/metrics.json

# Lint, format, types and import contract, and the tests that take no more than a few seconds each, at the same time.
test: $(DEVELOP)
	@$(MAKE) --no-print-directory --jobs 2 check quick

quick: $(DEVELOP)
	@MAKEFLAGS= $(BIN)/pytest -m "not slow" --numprocesses auto --dist loadscope

# Every test, the slow ones included.
test-all: $(DEVELOP)
	@$(BIN)/pytest

check: $(DEVELOP)
	@$(BIN)/ruff check --no-cache .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

# The documentation as a site, site/index.html: every page of docs/, and the API from the docstrings.
docs: $(DEVELOP)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "site/index.html"

# Puts code into the form that `make check` asks for.
format: $(DEVELOP)
	@$(BIN)/ruff format --quiet .
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

# Fuzzes every reader, MINUTES in all, with other inputs every time. `fuzz-quick` is CI's part: every seed, and
# 45 s of all targets with the same inputs every time, so that it tells about a change and not about luck.
MINUTES ?= 5
FUZZ := .venv/installed-for-fuzz

fuzz: $(FUZZ)
	@$(BIN)/python -m fuzz.run --seeds
	@$(BIN)/python -m fuzz.run --minutes $(MINUTES)

fuzz-quick: $(FUZZ)
	@$(BIN)/python -m fuzz.run --seeds
	@$(BIN)/python -m fuzz.run --minutes 0.75 --seed 1

$(FUZZ): $(DEVELOP)
	@$(PIP) --no-build-isolation --editable '.[fuzz]'
	@touch $@

# The wheel in a fresh environment of every Python from 3.11 on that is here.
wheels: $(DEVELOP)
	@$(BIN)/python .ci/wheels.py $(WHICH)

# A bill of materials (CycloneDX) of the installed program: its packages, versions and licences.
sbom: $(USE)
	@$(BIN)/python .ci/sbom.py > sbom.cdx.json
	@echo "sbom.cdx.json"

# As CI installs: exactly the files whose hashes are known.
locked: .venv/pyvenv.cfg
	@$(BIN)/python -m pip --disable-pip-version-check install --quiet --require-hashes -r requirements-ci.txt
	@$(BIN)/python -m pip --disable-pip-version-check install --quiet --no-deps --no-build-isolation --editable .
	@touch $(USE) $(DEVELOP) $(FUZZ)

.venv/pyvenv.cfg:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "Skyquilt needs Python 3.11 or newer, and $(PYTHON) is: $$($(PYTHON) --version 2>&1)."; \
	    echo "Name another one: make PYTHON=python3.12 ..."; exit 1; }
	@$(PYTHON) -m venv .venv || { rm -rf .venv; \
	    echo "$(PYTHON) cannot make a virtual environment; on Debian and Ubuntu: apt install python3-venv"; exit 1; }

# Installed anew only when what is to be installed has changed.
$(USE): .venv/pyvenv.cfg pyproject.toml constraints.txt
	@echo "installing Skyquilt into .venv (a minute or two, the first time)"
	@$(PIP) setuptools
	@$(PIP) --no-build-isolation --editable '.[live]'
	@$(BIN)/python -m compileall -q src/skyquilt  # as pip does where it copies files
	@touch $@

$(DEVELOP): $(USE)
	@echo "installing what the tests need"
	@$(PIP) --no-build-isolation --editable '.[test]'
	@touch $@

clean:
	rm -rf .venv demo site build dist sbom.cdx.json fuzz/found .pytest_cache .hypothesis .mypy_cache .ruff_cache .import_linter_cache
	rm -rf src/*.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
