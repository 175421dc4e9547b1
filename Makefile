# Everything runs from .venv, which is made by the first target that needs it.
# Needs Python >= 3.11 with its venv module, and a package index for pip; nothing else.

VENV := .venv
BIN := $(VENV)/bin
RUN := runs/demo
# Small, so that two cores are done within minutes.
DEMO := "simulated:tabletop?width=240&height=180"

.DEFAULT_GOAL := help
.PHONY: help demo test test-thorough test-all test-floors bench gallery notebooks docs lint dist clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/installed ## track the built-in scene from nothing to a report
	@rm -rf $(RUN)
	$(BIN)/gsjax track $(DEMO) --out $(RUN) --frames 0:30 --cameras 0 1 --mask-camera 1 --eval-cameras 2 \
	  --track.start.iterations 60

# Two workers at most: XLA compiles on several threads by itself. A file stays with one worker, so what one
# of its tests compiled serves the next.
PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses=2 --dist=loadfile --durations=30 --durations-min=5

test: $(VENV)/installed-test ## the quick tests, within ten minutes
	$(PYTEST) -m "not thorough and not slow"

test-thorough: $(VENV)/installed-test ## what takes seconds a test; with the quick ones, what every change must pass
	$(PYTEST) -m "thorough and not slow"

test-all: $(VENV)/installed-test ## every test, those of minutes too, on programs that XLA optimises
	XLA_FLAGS= $(PYTEST) --timeout=2700 -m "slow or not slow" --cov=gsjax --cov-report=term

# Of the tests those that touch every dependency and are quick. Some floors have no wheel for a newer Python.
FLOORS := build/floors
QUICK := geometry rasterize losses scene optim io viz data/test_files.py cli/test_main.py
test-floors: pyproject.toml ## tests of some folders with the lowest versions that pyproject.toml allows, on Python 3.11
	rm -rf $(FLOORS) && mkdir -p build
	python3.11 -m venv $(FLOORS)
	$(FLOORS)/bin/python tests/floors.py test > build/floors.txt
	$(FLOORS)/bin/python -m pip install --quiet --disable-pip-version-check -e ".[test]" -c build/floors.txt
	$(FLOORS)/bin/python -m pip check
	$(FLOORS)/bin/python -m pytest $(addprefix tests/,$(QUICK))

bench: $(VENV)/installed-test ## the whole benchmark suite, on a machine that does nothing else
	$(BIN)/gsjax bench

gallery: $(VENV)/installed ## small runs and the experiments' figures into docs/gallery.md
	$(BIN)/python docs/make_gallery.py

notebooks: $(VENV)/installed-dev ## run docs/notebooks and keep what they show
	$(BIN)/python docs/make_notebooks.py

docs: $(VENV)/installed-dev ## build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

lint: $(VENV)/installed-dev ## ruff and pyright
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

# What others will install is tried where there is nothing else, and away from these files.
EMPTY := $(CURDIR)/build/empty
dist: $(VENV)/installed-dev ## build the wheel and the sdist, check them, and track a few frames by the wheel alone
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

clean: ## remove .venv and everything that was built
	rm -rf $(VENV) site dist build .pytest_cache .ruff_cache .hypothesis .coverage*

# The first interpreter that is new enough and can make environments (Debian ships one that cannot).
$(BIN)/python:
	@for python in python3 python3.13 python3.12 python3.11 python3.14 python; do \
	  if $$python -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then \
	    echo "$$python -m venv $(VENV)"; exec $$python -m venv $(VENV); \
	  fi; \
	done; \
	echo "No Python >= 3.11 with venv was found. Install one (Debian: apt install python3 python3-venv)." >&2; exit 1

# Stamps: pip runs again only after pyproject.toml has changed.
$(VENV)/installed: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e .
	@touch $@

$(VENV)/installed-test: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[test]"
	@touch $@ $(VENV)/installed

$(VENV)/installed-dev: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[dev]"
	@touch $@ $(VENV)/installed $(VENV)/installed-test
