# `make` or `make help` lists the targets.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RACER := $(VENV)/.installed-racer
STAMP := $(VENV)/.installed
DOCS := $(VENV)/.installed-docs

# uv does not read pip's settings: where packages come from, and whose certificates are trusted.
ifdef PIP_INDEX_URL
export UV_DEFAULT_INDEX ?= $(PIP_INDEX_URL)
endif
ifdef PIP_EXTRA_INDEX_URL
export UV_INDEX ?= $(PIP_EXTRA_INDEX_URL)
endif
ifdef PIP_FIND_LINKS
export UV_FIND_LINKS ?= $(PIP_FIND_LINKS)
endif
ifdef PIP_CERT
export SSL_CERT_FILE ?= $(PIP_CERT)
endif
# Compiled once here and not by every process: importing PyTorch and MLflow from sources takes three times as long.
INSTALL = $(BIN)/uv pip install --compile-bytecode --python $(BIN)/python --constraint constraints.txt
# A busy machine needs longer than the minute that uv gives each file.
export UV_COMPILE_BYTECODE_TIMEOUT ?= 900
# Numba compiles the cars in the first process that drives: half a minute on one core. `tiny` alone has no cars that differ.
WARM = runs=$$(mktemp -d) && { $(BIN)/deepracer-exp train experiment=tiny randomization=mixed tracking=off runs_dir=$$runs >$$runs/log 2>&1 || \
	{ cat $$runs/log; exit 1; }; } && rm -r $$runs

.DEFAULT_GOAL := help
.PHONY: help env race test test-long test-faults test-busy check extras bench docs clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 14

env: $(STAMP)  ## make .venv with everything the project needs

$(RACER): pyproject.toml constraints.txt
	@test -x $(BIN)/python || { echo "making $(VENV)"; $(PYTHON) -m venv $(VENV); }
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt uv
	@echo "installing deepracer_exp and what it needs to race, in the versions of constraints.txt"
	@$(INSTALL) --editable .
	@echo "compiling the cars once, for the first training and the tests"
	@$(WARM)
	@touch $@

$(STAMP): $(RACER)
	@echo "installing the tools for tests and development"
	@$(INSTALL) --editable '.[dev]'
	@touch $@

race: $(RACER)  ## train the default experiment until the car drives reliably
	@echo "training: $(BIN)/deepracer-exp train stopping=reliable"
	@$(BIN)/deepracer-exp train stopping=reliable

# Two processes, each with a half in the order of the files, which share what a folder trains, imports and starts; the
# first that is done takes half of what is left of the other's. ORDER=N shuffles files, and the tests in them.
test: $(STAMP)  ## the tests, without the long ones and most of those of killed processes
	@$(BIN)/python -m pytest -q -m "not slow and not faults" -n 2 --dist worksteal --junitxml=test_times.xml \
		$(if $(ORDER),--random-order-seed=$(ORDER))

test-long: $(STAMP)  ## the tests that take longer than ten seconds each, and those of drawn examples with new ones
	@$(BIN)/python -m pytest -q -m "slow or hypothesis" --hypothesis-profile=new -n 2

test-faults: $(STAMP)  ## processes that are killed, stopped or hang, those of sweeps twenty times each; kill_loops.jsonl
	@FAULT_TIMES=20 KILL_LOOPS=kill_loops.jsonl $(BIN)/python -m pytest -q -m faults -n 2

test-busy: $(STAMP)  ## the tests that start processes, wait or read a clock, twenty times beside twelve busy processes
	@$(BIN)/python -m tests.busy_machine

check: $(STAMP)  ## style, types and import rules
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-cache

extras: $(RACER)  ## whether every extra can be installed in the versions of constraints.txt
	@$(BIN)/uv pip compile --quiet --python $(BIN)/python --constraint constraints.txt --all-extras pyproject.toml -o /dev/null

bench: $(STAMP)  ## re-measure what the README claims
	@$(BIN)/python -m benchmarks.throughput
	@$(BIN)/python -m benchmarks.time_to_lap --seeds 3

$(DOCS): $(RACER)
	@echo "installing the generator of the documentation site"
	@$(INSTALL) --editable '.[docs]'
	@touch $@

docs: $(DOCS)  ## build the documentation site in site/ and check its links
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "site/index.html"

clean:  ## remove the environment and what was built
	rm -rf $(VENV) build dist site *.egg-info
