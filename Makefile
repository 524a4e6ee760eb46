# Two commands on a fresh machine with Python 3.11 or 3.12 and make: `make demo` and `make test`. Each does its own set-up in .venv.

VENV := .venv
BIN := $(VENV)/bin
# The first interpreter that fits; override with: make PYTHON=/path/to/python3.12
FITS := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 13))
PYTHON ?= $(shell for p in python3 python3.12 python3.11; do $$p -c '$(FITS)' 2>/dev/null && echo $$p && break; done)
DEMO := $(CURDIR)/demo
KILLS ?= 200
# Tests also wait: for processes that they started, and for the disk. One more than there are cores keeps all of these busy.
TESTERS ?= $(shell $(PYTHON) -c 'import os; print(1 + (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()))')

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-fast test-lowest test-newest slow lint format screenshots bench gpu-bundle torture mutants docs wheel-check clean

help:  ## Show the targets.
	@grep -E '^[a-z-]+:.*##' Makefile | sed -E 's/:.*## /: /'

$(VENV)/.installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "cudc-bench needs Python 3.11 or 3.12 (labmaze, which dm_control requires, has no newer wheel)"; exit 1; }
	@echo "installing into $(VENV) (PyTorch, MuJoCo and the rest; a few minutes the first time)"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

setup: $(VENV)/.installed  ## Install everything into .venv.

demo: setup  ## The main job in a few minutes: collect, relabel, train TD3, print the table.
	@MINARI_DATASETS_PATH=$(DEMO)/datasets $(BIN)/cudc-bench evaluate --algo td3 --method cudc,random --profile demo --output $(DEMO)/results > /dev/null
	@$(BIN)/cudc-bench leaderboard $(DEMO)/results --output $(DEMO)/report
	@echo
	@echo "datasets   $(DEMO)/datasets   (MINARI_DATASETS_PATH=$(DEMO)/datasets, then minari.load_dataset('walker/cudc-demo-v0'))"
	@echo "records    $(DEMO)/results"
	@echo "table      $(DEMO)/report/demo.td3.walker/table.md"
	@echo "curves     $(DEMO)/report/demo.td3.walker/index.html"
	@echo "site       $(DEMO)/report/index.html"

test: setup  ## Run the tests.
	$(BIN)/pytest -n $(TESTERS) --dist worksteal

test-fast: setup  ## Run the tests that take less than half a second each.
	$(BIN)/pytest -n $(TESTERS) --dist worksteal -m "not slow"

# Each in an environment of its own. With the lowest versions comes a PyTorch from PyPI with all of CUDA, 3 GB.
test-lowest: setup  ## Run the fast tests with the lowest versions that pyproject.toml allows, in build/lowest.
	$(BIN)/python -m tests.floors > $(VENV)/floors.txt
	$(call with_versions,lowest,-c $(VENV)/floors.txt)

test-newest: setup  ## Run the fast tests with the newest versions that pyproject.toml allows, in build/newest.
	$(call with_versions,newest,--upgrade)

define with_versions
	$(PYTHON) -m venv --clear build/$(1)
	build/$(1)/bin/pip install --quiet --disable-pip-version-check $(2) -e '.[dev]'
	build/$(1)/bin/pip check
	build/$(1)/bin/pytest -n $(TESTERS) --dist worksteal -m "not slow"
endef

slow: setup  ## Run all tests and note which of them take long, for test-fast.
	$(BIN)/pytest -n $(TESTERS) --dist worksteal --durations=0 --durations-min=0.05 | tee build/durations.txt | tail -1
	$(BIN)/python -m tests.slow < build/durations.txt

lint: setup  ## Check style and types.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup  ## Put the code into the project's format.
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

RECORDS ?= results
screenshots: setup  ## Take pictures of the site over RECORDS, for the README: build/screenshots/*.png. Needs chromium.
	$(BIN)/python docs/screenshots.py $(RECORDS) build/screenshots

bench: setup  ## Measure speed as ratios and print a table; see benchmarks/README.md.
	$(BIN)/python -m benchmarks

PYTHON_VERSION ?= $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])')
gpu-bundle: setup  ## Put all that a machine with a GPU and without a network needs into one archive: build/gpu-bundle. PYTHON_VERSION=3.12 is there.
	$(BIN)/python -m benchmarks.gpu.bundle --python $(PYTHON_VERSION)

torture: setup  ## Kill real runs 200 times each and compare what comes out; start one twice at the same moment, 50 times.
	@for what in collect "collect with skills" evaluate relabel pilot; do \
		echo "$$what"; OMP_NUM_THREADS=1 $(BIN)/python -m tests.faults.killing "$$what" $(KILLS) 2> /dev/null || exit 1; done
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.faults.racing collect 50 relabel 50 evaluate 10

mutants: setup  ## Change formulas in copies of the package, and say which changes their tests notice.
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.mutants

$(VENV)/.docs: $(VENV)/.installed
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,docs]'
	@touch $@

docs: $(VENV)/.docs  ## Build the documentation: build/docs/index.html. Warnings are errors; nothing is asked of the network.
	$(BIN)/sphinx-build --quiet --fresh-env --fail-on-warning --keep-going -d build/doctrees docs build/docs
	@echo "documentation   build/docs/index.html"

wheel-check: setup  ## Build the wheel, install it into an empty environment elsewhere, run the three calls there.
	BIN=$(CURDIR)/$(BIN) ./.ci/wheel-check

clean:  ## Remove the environment and what the demo made.
	rm -rf $(VENV) demo build dist *.egg-info
