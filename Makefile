# Everything runs from .venv, which the first target that needs it creates.
# The only requirements are Python >= 3.11 with its venv module, and a package index for pip.

VENV := .venv
BIN := $(VENV)/bin
RUN := runs/demo
# Small enough to finish within minutes on two cores.
DEMO := "simulated:tabletop?width=240&height=180"

.DEFAULT_GOAL := help
.PHONY: help demo test test-thorough test-all test-floors bench gallery notebooks docs lint dist clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/installed ## track the built-in scene and write a report
	@rm -rf $(RUN)
	$(BIN)/gsjax track $(DEMO) --out $(RUN) --frames 0:30 --cameras 0 1 --mask-camera 1 --eval-cameras 2 \
	  --track.start.iterations 60

# At most two workers, because XLA itself compiles on several threads. All tests of a file run in one worker,
# so that they share compiled programs.
PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses=2 --dist=loadfile --durations=30 --durations-min=5

test: $(VENV)/installed-test ## the quick tests, within ten minutes
	$(PYTEST) -m "not thorough and not slow"

test-thorough: $(VENV)/installed-test ## tests that take seconds each; every change must pass these and the quick ones
	$(PYTEST) -m "thorough and not slow"

test-all: $(VENV)/installed-test ## all tests, including those that take minutes, with XLA's optimisations on
	XLA_FLAGS= $(PYTEST) --timeout=2700 -m "slow or not slow" --cov=gsjax --cov-report=term

# Quick tests that together use every dependency. Some of the lowest versions have no wheel for a newer Python.
FLOORS := build/floors
QUICK := geometry rasterize losses scene optim io viz data/test_files.py cli/test_main.py
test-floors: pyproject.toml ## tests of some folders with the lowest dependency versions that pyproject.toml allows, on Python 3.11
	rm -rf $(FLOORS) && mkdir -p build
	python3.11 -m venv $(FLOORS)
	$(FLOORS)/bin/python tests/floors.py test > build/floors.txt
	$(FLOORS)/bin/python -m pip install --quiet --disable-pip-version-check -e ".[test]" -c build/floors.txt
	$(FLOORS)/bin/python -m pip check
	$(FLOORS)/bin/python -m pytest $(addprefix tests/,$(QUICK))

bench: $(VENV)/installed-test ## run the whole benchmark suite; needs an otherwise idle machine
	$(BIN)/gsjax bench

gallery: $(VENV)/installed ## make docs/gallery.md and its pictures from small runs and the experiments' figures
	$(BIN)/python docs/make_gallery.py

notebooks: $(VENV)/installed-dev ## run docs/notebooks and store their output
	$(BIN)/python docs/make_notebooks.py

docs: $(VENV)/installed-dev ## build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

lint: $(VENV)/installed-dev ## ruff and pyright
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

# The wheel is tried as users will install it: in an empty environment and outside the source folder.
EMPTY := $(CURDIR)/build/empty
dist: $(VENV)/installed-dev ## build the wheel and the sdist, check them, and track a few frames with only the wheel installed
	rm -rf dist $(EMPTY) build/tried && mkdir -p build/tried
	$(BIN)/python -m build
	$(BIN)/twine check --strict dist/*
	$(BIN)/python -m venv $(EMPTY)
	$(EMPTY)/bin/python -m pip install --quiet --disable-pip-version-check dist/*.whl
	$(EMPTY)/bin/python -m pip check
	cd build/tried && $(EMPTY)/bin/gsjax --help && $(EMPTY)/bin/gsjax info simulated:tabletop
	cd build/tried && $(EMPTY)/bin/gsjax track "simulated:tabletop?width=160&height=120" --out run --frames 0:5 \
	  --cameras 0 1 --mask-camera 1 --eval-cameras 2 --track.start.iterations 20
	cd build/tried && test -s run/report.html && $(EMPTY)/bin/gsjax query run can

clean: ## remove .venv and all build outputs
	rm -rf $(VENV) site dist build .pytest_cache .ruff_cache .hypothesis .coverage*

# Use the first interpreter that is new enough and can create environments (Debian ships one that cannot).
$(BIN)/python:
	@for python in python3 python3.13 python3.12 python3.11 python3.14 python; do \
	  if $$python -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then \
	    echo "$$python -m venv $(VENV)"; exec $$python -m venv $(VENV); \
	  fi; \
	done; \
	echo "No Python >= 3.11 with venv was found. Install one (Debian: apt install python3 python3-venv)." >&2; exit 1

# Stamp files: pip runs again only after pyproject.toml has changed.
$(VENV)/installed: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e .
	@touch $@

$(VENV)/installed-test: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[test]"
	@touch $@ $(VENV)/installed

$(VENV)/installed-dev: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[dev]"
	@touch $@ $(VENV)/installed $(VENV)/installed-test
