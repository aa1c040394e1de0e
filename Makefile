# From nothing but python3 (3.11 or newer) and make: every target first builds .venv if needed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NOTEBOOKS := $(wildcard notebooks/*.ipynb)
SEED ?= 0
BENCHES := $(wildcard tests/benchmarks/bench_*.py)
TWO := -n 2 --dist loadfile --no-loadscope-reorder
QUICK = $(BIN)/python -m pytest -q $(TWO) -m "not slow and not nightly"
# The newest Python named in pyproject.toml, of another version than the default one, on the PATH or kept by pyenv.
NEWEST = $(shell \
  default=$$($(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])'); \
  for v in 3.13 3.12 3.11; do \
    test "$$v" != "$$default" || continue; \
    for p in python$$v "$${PYENV_ROOT:-$$HOME/.pyenv}"/versions/$$v.*/bin/python$$v; do \
      "$$p" -c 'import sys, venv, ensurepip; print(sys.executable)' 2>/dev/null && exit; \
    done; \
  done)

.DEFAULT_GOAL := help
.PHONY: help demo docs test quick newest every nightly check bench mutants fuzz format clean

help: ## this list
	@sed -n 's/^\([a-z]*\):[^#]*## /\1\t/p' $(MAKEFILE_LIST) | awk -F '\t' '{printf "make %-8s %s\n", $$1, $$2}'
	@echo "Another interpreter: make demo PYTHON=python3.12 (after make clean)"

demo: $(VENV)/.run-stamp ## the main job on logs of the virtual test site, pictures in demo_out
	$(BIN)/slipid demo --out demo_out

docs: $(VENV)/.dev-stamp ## the documentation site in docs/_build/html, without a warning and without a network
	$(BIN)/python -m sphinx -b html docs docs/_build/html -W --keep-going -q
	@echo "look at docs/_build/html/index.html"

# Types are checked at run time by `check` and `nightly`: with it Python code takes twice as long.
test: $(VENV)/.dev-stamp ## the test suite but for what is nightly, a file at a time on two cores
	SLIPID_CHECK_TYPES=0 $(BIN)/python -m pytest $(TWO)

quick: $(VENV)/.dev-stamp ## the quick tests alone
	$(QUICK)

newest: ## the quick tests on the newest other Python, which brings the newest libraries
	$(call on_newest,quick)

# every test of one Python
every: $(VENV)/.dev-stamp
	JAX_DISABLE_MOST_OPTIMIZATIONS=0 JAX_COMPILATION_CACHE_DIR=$(CURDIR)/.cache/jax-optimised $(BIN)/python -m pytest $(TWO) -m ""

nightly: every ## every test, the long statistical ones too, compiled with XLA's optimisations, as users run it, on both Pythons
	$(call on_newest,every)

check: $(VENV)/.dev-stamp ## format, lint, types, import rules, quick tests: before every push
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
ifneq ($(NOTEBOOKS),)
	$(BIN)/nbstripout --verify $(NOTEBOOKS)
endif
	$(QUICK)

bench: $(VENV)/.dev-stamp ## speed, left-out errors, load shares, known truth, posteriors (hours; SLIPID_BENCH_QUICK=1: minutes, tries them)
ifneq ($(BENCHES),)
	$(BIN)/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks
else
	@echo "no benchmark yet: they are files tests/benchmarks/bench_*.py"
endif

mutants: $(VENV)/.dev-stamp ## faults planted in the package one by one, which tests must notice (hours; goes on where it was stopped)
	$(BIN)/python tests/mutants/run.py

fuzz: $(VENV)/.dev-stamp ## damaged files at every door, 100 000 of them (goes on where it was stopped; others with SEED=1)
	$(BIN)/python -m tests.fuzz.run --seed $(SEED) --results .cache/fuzz/results-$(SEED).jsonl

format: $(VENV)/.dev-stamp ## rewrite the sources in the project's format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean: ## remove the environment, the caches and demo_out (never out/)
	rm -rf $(VENV) $(VENV)-newest .cache .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	rm -rf demo_out build dist docs/_build *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The demo needs the library with all of its extras; tests and checks need the tools too.
$(VENV)/.run-stamp: pyproject.toml
	$(call install,.[all])
	@touch $@

$(VENV)/.dev-stamp: pyproject.toml
	$(call install,.[dev])
	@touch $@ $(VENV)/.run-stamp

define install
	@command -v $(PYTHON) >/dev/null || { \
	  echo "slipid: no '$(PYTHON)' on the PATH; install Python 3.11 or newer, or name one: make PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "slipid: needs Python 3.11 or newer, '$(PYTHON)' is $$($(PYTHON) --version 2>&1); name a newer one: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { \
	  echo "slipid: '$(PYTHON)' lacks venv or ensurepip; on Debian and Ubuntu: apt-get install python3-venv" >&2; exit 1; }
	@test -x $(BIN)/pip || { echo "slipid: creating $(VENV) with $(PYTHON)"; $(PYTHON) -m venv $(VENV); }
	@echo "slipid: installing $(1) into $(VENV) (about a minute the first time)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '$(1)'
endef

define on_newest
	@newest='$(NEWEST)'; \
	if [ -z "$$newest" ]; then echo "slipid: no other Python than '$(PYTHON)' here, so none for 'make $(1)' with the newest libraries"; \
	else echo "slipid: make $(1) with $$newest"; $(MAKE) --no-print-directory $(1) VENV=$(VENV)-newest PYTHON="$$newest"; fi
endef
