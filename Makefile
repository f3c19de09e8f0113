# Needs only make and a Python from 3.10 to 3.13; everything else goes into $(VENV).
#
#   make demo ARGS="seed=1 out=runs/one"
#   make test PYTEST_ARGS="-k packaging"        (JOBS=1 for one process instead of two)
#   make test VENV=/path/to/an/environment      (reuses it, and installs this checkout into it)
#   make demo PYTHON=/path/to/python3.12

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
MAKEFLAGS += --no-print-directory

VENV ?= .venv
ARGS ?=
PYTEST_ARGS ?=
JOBS ?= 2

# A name on the PATH may be a stub that does not run, or lack `venv`: ask each one.
PYTHON_FITS := import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for name in python3.13 python3.12 python3.11 python3.10 python3 python; do \
	if "$$name" -c '$(PYTHON_FITS)' >/dev/null 2>&1; then echo "$$name"; break; fi; done)

BIN := $(VENV)/bin
TRAIN_STAMP := $(VENV)/.torchrl_hmcts-train
DEV_STAMP := $(VENV)/.torchrl_hmcts-dev
DOCS_STAMP := $(VENV)/.torchrl_hmcts-docs
TYPES := build/types

# A stamp holds the checkout it was made from, so an environment shared by two is set up again.
HERE := $(shell pwd -P)
stale = $(if $(filter-out $(HERE),$(shell cat $(1) 2>/dev/null)),FORCE)

.PHONY: help demo test coverage docs lint format types clean FORCE

help: ## Show this list
	@awk 'BEGIN {FS = ":.*## "} /^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' Makefile

demo: $(TRAIN_STAMP) ## Set up, then learn skills and solve mazes: make demo ARGS="seed=0 out=runs/demo"
	$(BIN)/hmcts demo $(ARGS)

test: $(DEV_STAMP) ## Set up, then check the style and run the tests
	$(BIN)/python -m ruff check .
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile $(PYTEST_ARGS)

# Warnings are errors. The tutorials are run while the pages are built: a few minutes.
docs: $(DOCS_STAMP) ## Set up, then build the documentation site in docs/_build/html
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	$(BIN)/python docs/_extensions/check_site.py docs/_build/html
	@echo "The site: docs/_build/html/index.html"

# Compiled kernels are invisible to coverage. tests/test_kernels_in_python.py runs each of them as
# plain Python, and the trees worked out by hand are grown without compiling once more.
coverage: ## Run the tests and measure that they reach 92 % of the lines
	$(MAKE) test PYTEST_ARGS="$(PYTEST_ARGS) --cov --cov-report="
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest tests/test_planner_golden.py -q \
		-k "not approaches" --cov --cov-append --cov-report=
	$(BIN)/python -m coverage report --skip-covered --fail-under=92

lint: $(DEV_STAMP) ## Check the style
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .

format: $(DEV_STAMP) ## Put imports and layout in order
	$(BIN)/python -m ruff check --fix .
	$(BIN)/python -m ruff format .

# The wheel is built from the source archive, so nothing left over in build/lib can get into it.
# Its environment is fresh and takes the dependencies from $(VENV) by a .pth line. A line of a .pth
# adds a folder without running the .pth files in it, so the editable install stays invisible.
types: $(DEV_STAMP) ## Check the types of the built wheel
	rm -rf $(TYPES)/dist $(TYPES)/venv
	$(BIN)/python -m build --no-isolation --outdir $(TYPES)/dist . >/dev/null
	$(BIN)/python -m venv --without-pip $(TYPES)/venv
	$(BIN)/python -m pip --python $(TYPES)/venv/bin/python install --quiet --no-index --no-deps \
		$(TYPES)/dist/*.whl
	$(BIN)/python -c 'import sysconfig; print(sysconfig.get_paths()["purelib"])' \
		> "$$($(TYPES)/venv/bin/python -c 'import sysconfig; print(sysconfig.get_paths()["purelib"])')/dependencies.pth"
	mypy=$$(cd $(BIN) && pwd)/python && cd $(TYPES) && "$$mypy" -m mypy --config-file ../../pyproject.toml \
		--python-executable venv/bin/python --package torchrl_hmcts

clean: ## Remove the environment and everything that was built (runs/ stays)
	rm -rf .venv build dist torchrl_hmcts.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis \
		.benchmarks htmlcov .coverage docs/_build docs/auto_*
	find torchrl_hmcts envs trainers tests -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/pyvenv.cfg:
	@if [ -z "$(PYTHON)" ]; then \
		echo "No Python from 3.10 to 3.13 with the venv module was found on the PATH." >&2; \
		echo "Install one (a Debian or Ubuntu system Python needs its python3-venv package too)," >&2; \
		echo "or name it: make PYTHON=/path/to/python3.12" >&2; exit 1; fi
	@"$(PYTHON)" -c '$(PYTHON_FITS)' || { \
		echo "PYTHON=$(PYTHON) does not run, is not from 3.10 to 3.13 or lacks the venv module." >&2; \
		echo "Leave PYTHON out to have one looked for, or name another." >&2; exit 1; }
	"$(PYTHON)" -m venv $(VENV)

$(TRAIN_STAMP): pyproject.toml $(VENV)/pyvenv.cfg $(call stale,$(TRAIN_STAMP))
	$(BIN)/python -m pip install --disable-pip-version-check -e '.[train]'
	@echo '$(HERE)' > $@

$(DEV_STAMP): pyproject.toml $(VENV)/pyvenv.cfg $(call stale,$(DEV_STAMP))
	$(BIN)/python -m pip install --disable-pip-version-check -e '.[train,dev,gym]'
	@echo '$(HERE)' > $@
	@echo '$(HERE)' > $(TRAIN_STAMP)

$(DOCS_STAMP): pyproject.toml $(VENV)/pyvenv.cfg $(call stale,$(DOCS_STAMP))
	$(BIN)/python -m pip install --disable-pip-version-check -e '.[train,atari,gym,docs]'
	@echo '$(HERE)' > $@
