# Each target does its own set-up: a virtual environment in .venv with the versions of constraints.txt.
# Needs python3 >= 3.10 with venv. `make PYTHON=python3.12 test` takes another interpreter.

PYTHON ?= python3
OUTPUT ?= demo-output
VENV := .venv
BIN := $(VENV)/bin
# Set-up is done once, and again when a file that it reads changes.
INSTALLED := $(VENV)/.installed
INSTALLED_DEV := $(VENV)/.installed-dev

# -qq leaves errors only.
PIP_INSTALL = $(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt

# Threads of torch that wait should sleep, not spin: tests then also end on a busy machine.
export OMP_WAIT_POLICY ?= PASSIVE

# Two processes, each with whole files: fixtures of a file are made once.
PYTEST_ARGS ?= -n 2 --dist loadfile

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test lint types docs clean

help:  ## Show this list.
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 16

demo: $(INSTALLED)  ## Simulate a room, hide it in a line cloud, recover it, draw the picture (OUTPUT=demo-output).
	@$(BIN)/l2p demo -o "$(OUTPUT)" --force

test: $(INSTALLED_DEV)  ## Run all tests.
	@$(BIN)/python -m pytest -q $(PYTEST_ARGS)

lint: $(INSTALLED_DEV)  ## Check style (ruff).
	@$(BIN)/ruff check .

types: $(INSTALLED_DEV)  ## Check types (pyright).
	@$(BIN)/pyright

docs: $(INSTALLED_DEV)  ## Build the documentation into build/site; a warning, such as a dead link, is an error.
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "The documentation is build/site/index.html."

clean:  ## Remove the virtual environment, caches and the demo's output.
	rm -rf $(VENV) demo-output dist build .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	  { echo "l2p needs Python 3.10 or newer; name one with: make PYTHON=python3.12 ..." >&2; exit 2; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
	  { echo "$(PYTHON) cannot make virtual environments; on Debian: apt-get install python3-venv" >&2; exit 2; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

$(INSTALLED): pyproject.toml constraints.txt l2p/version.py | $(BIN)/python
	@echo "Installing l2p and what it needs into $(VENV); the first time takes a few minutes." >&2
	@$(PIP_INSTALL) -e .
	@touch $@

$(INSTALLED_DEV): pyproject.toml constraints.txt l2p/version.py | $(BIN)/python
	@echo "Installing l2p and its tools into $(VENV); the first time takes a few minutes." >&2
	@$(PIP_INSTALL) -e '.[dev]'
	@touch $(INSTALLED) $@
