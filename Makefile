# Nothing is assumed but make and python3 (3.11 or newer). Everything lives in .venv beside this file.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
DEMO := demo

.PHONY: demo test test-all check format clean

# A simulated flight, its map, and the map judged by the simulator's truth.
demo: $(STAMP)
	@$(BIN)/skyquilt simulate $(DEMO)/flight --preset demo --overwrite
	@$(BIN)/skyquilt mosaic $(DEMO)/flight/photos -o $(DEMO)/map --overwrite
	@$(BIN)/python examples/judge.py $(DEMO)/map/mosaic.tif $(DEMO)/flight/truth/orthophoto.tif

# Lint, format, types, import contract, then the tests that take less than a few seconds each.
test: check
	@$(BIN)/pytest -m "not slow"

# Every test, the slow ones included.
test-all: $(STAMP)
	@$(BIN)/pytest

check: $(STAMP)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

format: $(STAMP)
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

# Installed anew only when what is installed has changed.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else "Skyquilt needs Python 3.11 or newer; $(PYTHON) is %d.%d. Try: make PYTHON=python3.12 ..." % v[:2])'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	@touch $@

clean:
	rm -rf $(VENV) $(DEMO) build dist .pytest_cache .hypothesis .mypy_cache .ruff_cache .import_linter_cache
	rm -rf src/*.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
