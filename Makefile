# Every target sets up what it needs: on a fresh machine `make demo` and `make test` work by themselves.
# Variables: PYTHON (a CPython 3.11), ROBOT, SCENARIO, VARIANT, SEED, DELAY, OUT (demo), PYTEST_ARGS (tests).

SHELL := /bin/bash
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready

ROBOT ?= sdm_b
SCENARIO ?= rock_field
VARIANT ?= integrated
SEED ?= 0
DELAY ?= 5
OUT ?= demo_out
PYTEST_ARGS ?=

PACKAGES := athlete_twin planner envs
# Two processes share the quick tests, so every library inside them gets one thread: same sums, no fight for cores.
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
PYTEST := $(ONE_THREAD) $(BIN)/python -m pytest --jaxtyping-packages=athlete_twin,planner,envs,beartype.beartype
BENCHES := $(sort $(wildcard scripts/bench_*.py) $(wildcard scripts/validate_twin.py))

.PHONY: help setup check format test test-slow test-slow-ci demo bench assets clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(STAMP)  ## make .venv from constraints.txt (runs once, and again when the requirements change)

$(STAMP): pyproject.toml constraints.txt scripts/bootstrap.sh
	@PYTHON="$(PYTHON)" scripts/bootstrap.sh
	@touch $@

check: $(STAMP)  ## lint, types and import contracts
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)  ## put imports in order and mend what ruff can mend by itself
	$(BIN)/ruff check --fix .

test: $(STAMP)  ## the quick tests, under 5 minutes; array shapes are enforced while they run
	$(PYTEST) -n 2 -m "not slow" $(PYTEST_ARGS)

test-slow: $(STAMP)  ## whole trials and long physics
	$(PYTEST) -m slow $(PYTEST_ARGS)

# Exit status 5 says that no test carries both marks: an answer, not a failure.
test-slow-ci: $(STAMP)  ## the slow tests that are also marked ci
	$(PYTEST) -n 2 -m "slow and ci" $(PYTEST_ARGS) || [ $$? -eq 5 ]

demo: $(STAMP)  ## a robot walks around rocks that it sees in stereo, commanded with 5 s of delay each way
	$(BIN)/python scripts/rock_field_trial.py --robot $(ROBOT) --scenario $(SCENARIO) --variant $(VARIANT) \
	    --seed $(SEED) --delay $(DELAY) --out $(OUT) --film
	@echo "report: $(OUT)/report.html   film: $(OUT)/film.webm   figures: $(OUT)/trial.json"

bench: $(STAMP)  ## print the performance tables
	@[ -n "$(BENCHES)" ] || echo "no scripts/bench_*.py here"
	@for script in $(BENCHES); do echo "== $$script"; $(BIN)/python $$script || exit 1; done

assets: $(STAMP)  ## generate URDF and meshes again from the drawings
	$(BIN)/python scripts/build_assets.py

clean:  ## remove what the tools left; .venv and out/ stay
	rm -rf demo_out build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis *.egg-info
	find $(PACKAGES) tests scripts -name __pycache__ -type d -prune -exec rm -rf {} +
