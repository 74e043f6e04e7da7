# Every target that needs the environment makes it first; it is made anew only when the lock or pyproject.toml changes.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
# Two at a time: mypy uses one core and runs beside the tests.
MAKEFLAGS += --jobs=2
# Where it is set every process compiles every package anew: 1.3 s each for most of what starts here.
unexport PYTHONDONTWRITEBYTECODE

PYTHON ?= python3
# Package index of PyTorch's CPU builds, for machines where pip would otherwise choose a CUDA build (README, Set-up).
TORCH_INDEX ?=

BIN := .venv/bin
READY := .venv/.ready
PIP := $(BIN)/python -m pip --disable-pip-version-check
LOCK_VENV := build/lock-venv

.PHONY: help setup demo test tests test-flags test-vm lint types imports bench lock packages packages-core bounds conda reference docs gallery clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 16

# --no-compile: what is imported is compiled then, and most modules of the packages never are.
setup: $(READY) ## make .venv with the locked versions

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "chargetune needs Python 3.11 or newer: make PYTHON=...")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(if $(TORCH_INDEX),$(PIP) install --quiet --no-compile --no-deps --index-url $(TORCH_INDEX) "$$(grep '^torch==' requirements.lock)")
	$(PIP) install --quiet --no-compile --requirement requirements.lock
	$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	touch $@

demo: $(READY) ## five safe charges of an electrochemical cell in the cold, beside other ways to charge it; figures in out/demo
	$(BIN)/chargetune tune examples/demo.toml --out out/demo
	$(BIN)/chargetune compare examples/demo.toml --store out/demo/study.sqlite --figure out/demo/compare.png --overwrite \
	  --row 'CC-CV that keeps all limits' --row 'nominal MPC' --row tuned --row 'plant oracle'

test: lint types tests imports ## every check and every test

tests: $(READY) ## the tests alone
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-flags: export CHARGETUNE_CFLAGS := -O1
test-flags: $(READY) ## the tests, episodes compiled with -O1 for any processor of this kind
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-vm: export CHARGETUNE_CC := none
test-vm: $(READY) ## the tests without a C compiler
	$(BIN)/python -m pytest -n 2 --dist worksteal

lint: $(READY) ## ruff: rules and format
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: $(READY) ## mypy, strict
	$(BIN)/mypy

imports: $(READY) ## the directions of imports between the folders
	$(BIN)/lint-imports

bench: $(READY) ## speed of the closed loop, of the tuner and of the plants
	$(BIN)/python benchmarks/closed_loop.py
	$(BIN)/python benchmarks/plants.py
	$(BIN)/python benchmarks/tuner_overhead.py

# torch keeps the locked version: raise it by hand in requirements.lock, within the range of pyproject.toml.
# CUDA libraries are left out, so that the lock serves both kinds of wheel.
lock: ## renew requirements.lock from the ranges in pyproject.toml
	rm -rf $(LOCK_VENV)
	$(PYTHON) -m venv $(LOCK_VENV)
	$(LOCK_VENV)/bin/pip install --quiet "$$(grep '^torch==' requirements.lock)"
	$(LOCK_VENV)/bin/pip install --quiet "$$(grep '^torch==' requirements.lock)" --editable '.[dev,bench,dask,docs,excel,export,gym,notebook,postgres,pybamm,web]'
	{ grep '^#' requirements.lock; \
	  $(LOCK_VENV)/bin/pip freeze --all --exclude-editable --exclude pip \
	  | sed 's/+cpu$$//' | grep -Ev '^(cuda|nvidia|triton)'; } > build/requirements.lock
	mv build/requirements.lock requirements.lock

packages: $(READY) ## build sdist and wheel, and try the wheel where nothing else is: no compiler, each extra alone
	$(BIN)/python .ci/packages.py

packages-core: $(READY) ## the same without the extras and the type checker
	$(BIN)/python .ci/packages.py --core

# With PYTHON=python3.12 it is a test with that Python. Several minutes and a gigabyte of packages.
bounds: ## test with the lowest and with the newest versions of the dependencies, in environments of their own
	TORCH_INDEX=$(TORCH_INDEX) $(PYTHON) .ci/bounds.py lowest
	TORCH_INDEX=$(TORCH_INDEX) $(PYTHON) .ci/bounds.py newest

conda: $(READY) ## build and test the conda recipe, with the locked packages as its channel
	$(BIN)/python -m venv build/conda-venv
	build/conda-venv/bin/pip install --quiet packaging py-rattler-build pyyaml
	build/conda-venv/bin/python .ci/conda.py "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"

# -W: a warning, such as a link that leads nowhere, is an error.
docs: $(READY) ## build the site into build/site, without running the scripts of the gallery
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/site

# Half the time of compiling, as in the tests: what they compiled serves here too.
gallery: export CHARGETUNE_CFLAGS := -O1 -march=native
gallery: export CHARGETUNE_GALLERY := 1
gallery: $(READY) ## build the site with what the scripts of the gallery print and draw
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/site

reference: $(READY) ## write the pages and schemas of every key of a file, docs/reference
	$(BIN)/python docs/make_reference.py

clean: ## remove the environment, caches and outputs
	rm -rf .venv build dist out docs/gallery .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis src/*.egg-info
	find src tests benchmarks examples -name __pycache__ -type d -prune -exec rm -rf {} +
