# Three commands do everything: `make demo`, `make check` (a minute) and `make test`. They need Python >= 3.11, make and a C compiler.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= runs/demo

# Compiled modules are kept, also where a container's image switches that off: tests start some hundred processes.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo check test test-random suite quick lint rules types docs tables clean

TEST := $(BIN)/python -m pytest
# The installation goes before what then runs beside each other.
BESIDE = $(MAKE) --no-print-directory --jobs 2
# Two processes; each begins with one half of the tests in their order, so that what a file or a session shares is made about once.
TWO := -n 2 --dist worksteal
PACKAGES := raytac ipc examples experiments tests
SOURCES = $(shell find $(PACKAGES) -name '*.py' 2>/dev/null)
TYPED := $(shell find $(PACKAGES) -name '*.py' -o -name '*.pyi' 2>/dev/null | sort)
# Stamp of all types: named by the list of files, since a file that is removed changes no other.
ALL_TYPES := $(VENV)/.types-of-$(firstword $(shell echo '$(TYPED)' | cksum))

demo: $(VENV)/.installed
	$(BIN)/python experiments/press_sheet.py --out $(OUT)

check: $(VENV)/.installed-test
	+@$(BESIDE) $(VENV)/.types rules quick

test: $(VENV)/.installed-test
	+@$(BESIDE) types rules suite

suite: $(VENV)/.installed-test
	$(TEST) $(TWO) --durations=25

# Tests that need neither renderer nor solver and run no script (tests/marks.py), with those packages blocked.
quick: $(VENV)/.installed-test
	$(TEST) $(TWO) -q -m "not (slow or gpu or renderer or solver or script)"

# Every test in an order of its own, which the first lines name: repeat it by `make test-random SEED=...`.
SEED ?= $(shell $(BIN)/python -c 'import random; print(random.randrange(2**32))')
test-random: $(VENV)/.installed-test
	$(TEST) $(TWO) -p randomly --randomly-seed=$(SEED)

lint: rules types

rules: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache

types: $(ALL_TYPES)

# Types of everything, three minutes of one core, where anything has changed since they were right. What changes meanwhile is newer.
$(ALL_TYPES): $(TYPED) pyproject.toml $(VENV)/.installed-test
	@touch $(VENV)/.types-begun
	$(BIN)/pyright
	@rm -f $(VENV)/.types-of-* && cp -p $(VENV)/.types-begun $(VENV)/.types && mv $(VENV)/.types-begun $@

# Types of the files that changed since all of them were right; those that import them are seen by `make types`, a part of `make test`.
$(VENV)/.types: $(SOURCES) pyproject.toml
	$(BIN)/pyright $(filter %.py,$?)
	@touch $@

# The documents as a site, site/index.html; a warning is an error. Nothing is fetched while it builds.
docs: $(VENV)/.installed-docs
	$(BIN)/python docs/build/pages.py .site
	$(BIN)/zensical build --strict --clean --config-file mkdocs.yml

# Tables of the measurements, from docs/measurements/metrics.
tables: $(VENV)/.installed
	$(BIN)/python docs/build/tables.py

clean:
	rm -rf $(VENV) runs build dist site .site .pytest_cache .ruff_cache .hypothesis .import_linter_cache

# The stamps are written last, so an interrupted install is repeated and a finished one is not.
$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "raytac needs Python >= 3.11, and '$(PYTHON)' is $$($(PYTHON) --version 2>&1 | head -n 1);" \
	       "name another one: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV) || { \
	  echo "could not create $(VENV); on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(VENV)/.installed-test: $(VENV)/.installed pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed pyproject.toml
	@$(BIN)/python -m pip install --quiet --editable '.[docs]'
	@touch $@
