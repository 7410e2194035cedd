# `make` or `make help` lists the targets.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help env race test test-long test-faults check bench clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 14

env: $(STAMP)  ## make .venv with everything the project needs

$(STAMP): pyproject.toml constraints.txt
	@test -x $(BIN)/python || { echo "making $(VENV)"; $(PYTHON) -m venv $(VENV); }
	@echo "installing deepracer_exp and what it stands on (a few minutes the first time)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

race: $(STAMP)  ## train the default experiment until the car drives reliably
	@$(BIN)/deepracer-exp train stopping=reliable

# One process a core, and a file's tests together: they share what the file trains.
test: $(STAMP)  ## the tests
	@$(BIN)/python -m pytest -q -m "not slow" -n 2 --dist loadfile

test-long: $(STAMP)  ## the tests that take longer than ten seconds each
	@$(BIN)/python -m pytest -q -m slow

test-faults: $(STAMP)  ## sweeps whose processes are killed and stopped, twenty times each
	@FAULT_TIMES=20 $(BIN)/python -m pytest -q tests/faults/test_killed_sweeps.py

check: $(STAMP)  ## style, types and import rules
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-cache

bench: $(STAMP)  ## re-measure what the README claims
	@$(BIN)/python -m benchmarks.throughput
	@$(BIN)/python -m benchmarks.time_to_lap --seeds 3

clean:  ## remove the environment and what was built
	rm -rf $(VENV) build dist *.egg-info
