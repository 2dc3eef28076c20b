# Everything runs inside .venv, which the targets below make and keep up to date.
#
# Variables: PYTHON (interpreter for the environment), SEED and DEMO_DIR (make demo),
# PYTEST_ARGS (make test), BENCH_ARGS (make bench).

SHELL := /bin/bash
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
SEED ?= 0
DEMO_DIR ?= runs/demo
PYTEST_ARGS ?= -n auto --dist worksteal
BENCH_ARGS ?=
# Scripts of docs/results that write tables and figures from data that are committed there.
STUDIES := acting any_task fit_quality hopper in_the_loop learned_rewards mbrl_cartpole offline \
    planners precision questions record robust suite trained_twice

export MPLBACKEND ?= Agg
export PIP_DISABLE_PIP_VERSION_CHECK ?= 1

.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help demo hopper test lint format docs studies bench bench-smoke wheel lock clean

help: ## Show this list
	@awk 'BEGIN {FS = ":.*## "} /^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' Makefile

demo: $(VENV)/.installed-base ## Train METRPO on the pendulum, then plot returns against actuator bias
	$(BIN)/torchrl-l1 run metrpo/inverted_pendulum l1=off outer_iterations=5 seed=$(SEED) \
	    run_dir=$(DEMO_DIR) --resume
	$(BIN)/torchrl-l1 evaluate $(DEMO_DIR) --l1 off paper robust --bias 0 0.5 1 1.5 --filmstrip

hopper: $(VENV)/.installed-base ## Train METRPO on Hopper, then deploy it with a bias, four ways (a quarter of an hour)
	$(BIN)/torchrl-l1 run metrpo/hopper l1=off threads=1 seed=$(SEED) \
	    run_dir=runs/hopper --resume
	$(BIN)/python docs/results/hopper.py runs/hopper

test: $(VENV)/.installed-test ## Run the tests and the examples in the docstrings
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PYTEST_ARGS)

lint: $(VENV)/.installed-lint ## ruff (rules and format) and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.installed-lint ## Rewrite the sources as ruff formats them
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.installed-docs ## Build the documentation, warnings are errors
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

studies: $(VENV)/.installed-test ## Write the studies' tables and figures anew from committed data, check their pages
	set -e; for script in $(STUDIES); do $(BIN)/python docs/results/$$script.py; done
	$(BIN)/python -m pytest -q tests/test_studies.py tests/test_study_numbers.py

bench: $(VENV)/.installed-bench ## Run all speed tables (some minutes on an otherwise idle machine)
	$(BIN)/python -m benchmarks $(BENCH_ARGS)

bench-smoke: $(VENV)/.installed-bench ## Whether the benchmarks run: some of them, once each
	folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && \
	    $(BIN)/python -m benchmarks env_stepping imagination trpo --quick --output "$$folder"

wheel: $(VENV)/.installed-base ## Build the wheel into dist/ and check what is in it
	rm -rf dist
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	$(BIN)/python .ci/check_wheel.py dist/*.whl

lock: ## Resolve constraints.txt anew (takes some minutes)
	.ci/lock $(PYTHON)

clean: ## Remove the environment and everything built
	rm -rf $(VENV) build dist docs/_build docs/_generated
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' \
	    2>/dev/null || { \
	    echo "error: torchrl_l1 needs Python 3.11 to 3.13; '$(PYTHON)' is" \
	        "$$($(PYTHON) --version 2>/dev/null || echo 'not found')." \
	        "Name another one: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

# One stamp for each set of extras: a second call installs nothing.
$(VENV)/.installed-%: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install --quiet -c constraints.txt \
	    -e '.$(if $(filter base,$*),,[$*])'
	@touch $@
