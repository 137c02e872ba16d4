# Only Python (3.11 to 3.13) with venv and pip is assumed; every target that needs the environment makes it first.
#
#   make setup     the environment in $(VENV), from the hash-checked lock; again only when the lock or pyproject.toml change
#   make compare   the main job: comparison tables, figures and report in results/compare
#   make test      the tests (13 minutes on 2 quiet cores, three times that on slow ones);  make test PYTEST_ARGS="-k spectrum -x"
#   make lint      ruff, pyright, import-linter
#   make validate  the tests that are too long for `make test`; writes validation.json
#   make fuzz      hostile files, documents and arguments, $(FUZZ) of them (100000; `make test` has a fixed thousand)
#   make mutants   which changes of the code its tests would not notice, by mutmut (hours; FILES="oed/criteria.py" for some)
#   make campaign  the published campaign, from which README's table and pictures and docs/results are made again
#   make speed, make report    the speed benchmarks, the HTML report again
#   make peers     other people's tools beside ours on the records in $(OED_DATA), in results/peers (PEERS_ARGS="--only emps")
#   make docs      the documentation site in build/docs, warnings as errors
#   make lock      requirements.lock again from pyproject.toml (asks the package index)
#
# Another Python beside the first: make test PYTHON=python3.12 VENV=.venv-3.12

PYTHON      ?= python3
VENV        ?= .venv
# As many as there are cores, and no more than four: each takes up to a gigabyte, and the longest tests set the end.
JOBS        ?= $(shell n=$$(nproc 2>/dev/null || echo 2); [ $$n -gt 4 ] && echo 4 || echo $$n)
FUZZ        ?= 100000
PYTEST_ARGS ?=
PEERS_ARGS  ?=

BIN   := $(VENV)/bin
STAMP := $(VENV)/.installed
HERE  := $(dir $(abspath $(lastword $(MAKEFILE_LIST))))

# Processes are the parallelism here; BLAS threads inside them would only fight, and would change the last bits.
export OMP_NUM_THREADS      := 1
export OPENBLAS_NUM_THREADS := 1
export MKL_NUM_THREADS      := 1
export NUMBA_NUM_THREADS    := 1
# Nothing is written to the user's home: caches live and die with the environment.
export MPLBACKEND           := Agg
export MPLCONFIGDIR         := $(abspath $(VENV))/cache/matplotlib
export XDG_CACHE_HOME       := $(abspath $(VENV))/cache
export PYRIGHT_PYTHON_CACHE_DIR := $(abspath $(VENV))/cache/pyright
export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1
# The shared records and cases, where they lie beside the checkout.
OED_DATA  ?= $(realpath $(HERE)../shared/data)
OED_CASES ?= $(realpath $(HERE)../shared/cases)
ifneq ($(OED_DATA),)
export OED_DATA
endif
ifneq ($(OED_CASES),)
export OED_CASES
endif

PYTHON_OK = $(shell $(PYTHON) -c 'import sys; print(int((3, 11) <= sys.version_info[:2] <= (3, 13)))' 2>/dev/null)
PYTHON_IS = $(or $(shell $(PYTHON) -V 2>/dev/null),nothing that runs here)

.DEFAULT_GOAL := help

.PHONY: help map setup compare test lint validate fuzz mutants campaign speed report peers docs lock clean

help:
	@sed -n 's/^# \{0,1\}//p;/^$$/q' $(firstword $(MAKEFILE_LIST))

setup: $(STAMP)

# hatchling and editables are in the lock too: pip refuses an editable install in one command with hashes.
$(STAMP): requirements.lock pyproject.toml
	$(if $(filter 1,$(PYTHON_OK)),,$(error Python 3.11, 3.12 or 3.13 is needed, and $(PYTHON) is $(PYTHON_IS): name another, as in `make setup PYTHON=python3.12`))
	@rm -f $@
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@mkdir -p $(MPLCONFIGDIR) $(PYRIGHT_PYTHON_CACHE_DIR)
	$(BIN)/python -m estimators.compiled
	@touch $@

compare: $(STAMP)
	$(BIN)/oed compare --out results/compare

test: $(STAMP)
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal $(PYTEST_ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports --no-cache

validate: $(STAMP)
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m validate --validation-json validation.json $(PYTEST_ARGS)

fuzz: $(STAMP)
	OED_FUZZ=$(FUZZ) $(BIN)/python -m pytest -n $(JOBS) tests/fuzz $(PYTEST_ARGS)

mutants: $(STAMP)
	$(BIN)/python tests/mutants.py $(FILES)

# Killed, it resumes. docs/results says which campaign made it: CAMPAIGN=small takes minutes.
CAMPAIGN ?= published
campaign: $(STAMP)
	$(BIN)/oed compare --config benchmarks/campaigns/$(CAMPAIGN).toml --out results/$(CAMPAIGN)
	$(BIN)/python -m benchmarks.readme results/$(CAMPAIGN) README.md --publish docs/results --name $(CAMPAIGN) --commit "$$(git rev-parse HEAD)"

speed: $(STAMP)
	$(BIN)/oed speed

report: $(STAMP)
	$(BIN)/oed report results/compare

# The tools live beside ours, never among ours.
$(VENV)-peers/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)-peers
	$(VENV)-peers/bin/python -m pip install --quiet uv
	$(VENV)-peers/bin/uv pip install --quiet --python $(VENV)-peers/bin/python --group peers
	@touch $@

peers: $(STAMP) $(VENV)-peers/.installed
	$(BIN)/python -m benchmarks.peers --data "$(OED_DATA)" --out results/peers --python $(VENV)-peers/bin/python $(PEERS_ARGS)

# The versions already locked are kept where pyproject.toml still allows them; delete requirements.lock first to renew all.
lock:
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/python -m pip install --quiet uv
	$(VENV)-lock/bin/uv pip compile pyproject.toml --extra dask --extra all --group lock --universal --python-version 3.11 \
	  --generate-hashes --no-emit-index-url --no-header --no-annotate --quiet --output-file requirements.lock

clean:
	rm -rf results build dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache

docs: $(STAMP)
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs
	@echo "open build/docs/index.html"

map:
	$(BIN)/python -m tests.architecture_map
