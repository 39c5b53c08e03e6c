# Everything runs in .venv, made here from nothing but Python with venv.

PYTHON ?= python3
# Small eigenvalue problems are slower on several BLAS threads, much slower beside other processes.
export OPENBLAS_NUM_THREADS ?= 1
# Nor without byte code: each command and each child of a test imports a thousand modules.
export PYTHONDONTWRITEBYTECODE :=
BIN := .venv/bin
# A test that kills its process ends the run: pytest-xdist may wait forever with a replacement.
PYTEST := $(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

.DEFAULT_GOAL := help
.PHONY: help install study explore docs docs-tests notebooks reference test campaigns budget gpu smoke lint check clean venv

help:  ## this list
	@sed -n 's/^\([a-z-]*\):.*## /make \1\t/p' Makefile | expand -t 16

install: .venv/installed  ## set up the environment .venv, nothing else

study: .venv/installed  ## run the study of the paper and a sweep of patch placements
	rm -rf results/paper results/placement
	$(BIN)/studies paper zhang_2016 --out results/paper
	$(BIN)/studies sweep placement --out results/placement --report
	$(BIN)/studies best results/placement --by residual_rms --subject-to "gain_margin > 2" --count 5
	$(BIN)/studies plot results/placement --out results/placement/best.png

explore: .venv/installed  ## coupling of the links, spillover of three designs, all notebooks
	rm -rf results/atlas results/certificate-*
	$(BIN)/studies atlas --out results/atlas
	for design in paper paper_gains difference; do \
	  $(BIN)/studies certify $$design --out results/certificate-$$design; [ $$? -lt 2 ] || exit 2; done
	$(PYTEST) -m "long or not long" docs/tests/test_notebooks.py

notebooks: .venv/with-notebook  ## open the notebooks in JupyterLab
	$(BIN)/jupyter lab --notebook-dir=notebooks

docs: .venv/with-docs docs-tests  ## test what documents say, and build the site, notebooks run, into docs/_build/html
	$(BIN)/python -m sphinx -W --keep-going -n -q -j 2 -c docs . docs/_build/html

reference: .venv/installed  ## write the reference of commands, fields, metrics and results into docs/reference
	$(BIN)/python docs/_ext/reference.py

docs-tests: .venv/installed  ## run the examples of documents, ready files and notebooks
	$(PYTEST) docs/tests

test: .venv/installed  ## run the tests
	$(PYTEST)

campaigns: .venv/installed  ## run the long campaigns: mutants, kills, fuzzing, scale, and all long tests
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[twin,robust]'
	$(PYTEST) campaigns
	$(PYTEST) -m long campaigns tests docs/tests

budget: .venv/installed  ## measure what each file of tests may cost, and write tests/budget.tsv
	$(BIN)/python -m tests.budget

gpu: .venv/installed  ## measure a GPU beside the cores, nine minutes at most, into docs/performance.md
	$(BIN)/python .ci/gpu.py

smoke: .venv/installed  ## run the wheel's main job on every supported Python here, core tests on the others
	$(BIN)/python .ci/smoke.py

lint: .venv/installed  ## lint, check format, types, the contract of imports, and what may not grow
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python .ci/limits.py

check: lint test  ## all of it, as continuous integration does

clean:  ## remove the environment, caches and build products; results stay
	rm -rf .venv .venv-* build docs/_build *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/installed: pyproject.toml constraints.txt
	@$(BIN)/python -c 'import pip, sys; sys.exit(sys.prefix == sys.base_prefix)' \
	  >/dev/null 2>&1 || $(MAKE) --no-print-directory venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile \
	  -c constraints.txt -e '.[test,dev]'
	@touch $@

.venv/with-%: .venv/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile \
	  -c constraints.txt -e '.[$*]'
	@touch $@

venv:
	@$(PYTHON) -c 'import sys, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' \
	  2>/dev/null || { echo "Python 3.11 to 3.13 with venv is needed (Debian: package python3-venv);" \
	  "$(PYTHON) is: $$($(PYTHON) --version 2>&1). Name another: make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv --clear .venv
