# The commands of the project; `make demo` and `make test` are all that a newcomer needs.
PYTHON ?= python3
VIDEO ?=
# Test processes at a time; each takes about a gigabyte.
WORKERS ?= 2
BIN := .venv/bin
# OpenMP's threads spin while they wait, which stalls everything where other programs run too.
export OMP_WAIT_POLICY ?= PASSIVE
# NumPy's matrices here are small, and its threads wait for each other beside another process.
test test-fast test-nightly: export OPENBLAS_NUM_THREADS ?= 1
STARTED := $(shell date +%s)

# Bytecode is kept, also where Python is told to write none: of each run's start it is the half.
PYTEST := PYTHONDONTWRITEBYTECODE= PATH="$(CURDIR)/$(BIN):$$PATH" \
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

.PHONY: help setup demo test test-fast test-nightly lint style format reference docs clean

help:  ## Show this list
	@grep -hE '^[a-z-]+:.*##' Makefile | sed -E 's/:.*## /\t/' | expand -t 14

setup:  ## Make or update the virtual environment .venv
	@$(PYTHON) scripts/setup_env.py

demo: setup  ## Make a head, train its avatar, evaluate, film it (VIDEO=me.mp4 for your own)
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/rgbavatar demo --started-at $(STARTED) \
		$(if $(VIDEO),--video "$(VIDEO)")

test: setup style  ## Linters, type check and the tests, but those of the night
	@mkdir -p build; $(BIN)/basedpyright >build/types.txt 2>&1 & types=$$!; \
		trap "kill $$types 2>/dev/null" INT TERM; \
		$(PYTEST) -m "not nightly"; tests=$$?; \
		wait $$types || { cat build/types.txt; echo "ERROR types: see above"; exit 1; }; exit $$tests

test-fast: setup  ## The tests that take seconds
	@$(PYTEST) -m "not (slow or nightly)"

test-nightly: setup  ## The tests of the night: sanitizers, a Ray cluster, many trainings, formats
	@$(BIN)/python -m uv pip install -q --python $(BIN)/python -c requirements/constraints.txt ray
	@status=0; $(PYTEST) -m "nightly and not browser" || status=$$?; \
		$(PYTEST) -n 0 -m "nightly and browser" || status=$$?; exit $$status

lint: style  ## Format check, lint, import rules, types
	@$(BIN)/basedpyright

style: setup  ## The part of `lint` that takes seconds
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/lint-imports

format: setup  ## Format the code and mend what the linter can
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

reference:  ## Write docs/commands.md and docs/errors.md anew, after a change of options or errors
	@$(BIN)/python -m scripts.write_reference

docs: setup  ## The documentation as a site in build/site, strictly (Python 3.11 or newer)
	@$(BIN)/sphinx-build -q -a -E -W --keep-going -c docs/site -d build/site-trees . build/site
	@echo "build/site/index.html"

clean:  ## Remove the environment and builds; avatars (outputs) and data stay
	rm -rf .venv build
