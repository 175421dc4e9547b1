# Everything runs from .venv, which is made by the first target that needs it.
# Needs Python >= 3.11 with its venv module, and a package index for pip; nothing else.

VENV := .venv
BIN := $(VENV)/bin
RUN := runs/demo
# Small, so that two cores are done within minutes.
DEMO := "simulated:tabletop?width=240&height=180"

.DEFAULT_GOAL := help
.PHONY: help demo test test-all bench gallery docs lint clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/installed ## track the built-in scene from nothing to a report
	@rm -rf $(RUN)
	$(BIN)/gsjax track $(DEMO) --out $(RUN) --frames 0:30 --cameras 0 1 --mask-camera 1 --eval-cameras 2 \
	  --tracker.start.iterations 60

# Two workers at most: XLA compiles on several threads by itself. A file stays with one worker, so what one
# of its tests compiled serves the next.
PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses=2 --dist=loadfile --durations=30 --durations-min=5

test: $(VENV)/installed-test ## the tests; slow ones left out
	$(PYTEST)

test-all: $(VENV)/installed-test ## every test, the slow ones too
	XLA_FLAGS= $(PYTEST) -m "slow or not slow" --cov=gsjax --cov-report=term

bench: $(VENV)/installed-test ## the whole benchmark suite, on a machine that does nothing else
	$(BIN)/gsjax bench

gallery: $(VENV)/installed ## small runs and the experiments' figures into docs/gallery.md
	$(BIN)/python docs/make_gallery.py

docs: $(VENV)/installed-dev ## build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

lint: $(VENV)/installed-dev ## ruff and pyright
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

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
