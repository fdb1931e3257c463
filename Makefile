PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS_READY := $(VENV)/.docs_ready
PEERS_READY := $(VENV)/.peers_ready

.PHONY: demo test test-all check lint types docs picture package oldest workflows wheel recordings bench validation clean

demo: $(READY)            ## simulate, calibrate, track, evaluate, view
	$(BIN)/wepose demo -o demo --force

# Compiled once: without bytecode each worker, and each command that a test runs, compiles all files anew.
test test-all: export PYTHONDONTWRITEBYTECODE :=
WORKERS ?= $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1)   # some tests wait for something
test: $(READY)            ## what must pass before a commit: minutes
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

test-all: $(PEERS_READY)  ## with the second tier: Monte Carlo, fuzzing, kills, peers, robots, clusters
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m ""

check: lint types test    ## lint, types and tests

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell wepose_pin docs examples calibration urdf README.md CONTRIBUTING.md CHANGELOG.md

types: $(READY)
	$(BIN)/mypy

SEEDS ?= 0:1000
recordings: $(READY)      ## random recordings of ordinary behaviour, SEEDS=0:1000; goes on where it was stopped
	$(BIN)/python tests/random_recordings/run.py --seeds $(SEEDS) --jobs 2

BENCH ?= filters
bench: $(PEERS_READY)     ## speed and accuracy on this machine; BENCH="live" and others: python -m benchmarks --help
	$(BIN)/python -m benchmarks $(BENCH)

DATA ?= $(WEPOSE_DATA)
validation: $(PEERS_READY)  ## docs/validation.md anew, hours: the paper's experiments, and the real recordings in DATA
	$(BIN)/python -m benchmarks validation $(if $(DATA),--data $(DATA))

docs: $(DOCS_READY)       ## the site: docs/_build/html/index.html; runs examples/ and checks spelling and links, offline
	$(BIN)/python -m sphinx -E -W --keep-going -q -b html docs docs/_build/html
	$(BIN)/python docs/check_links.py docs/_build/html

picture: $(READY)         ## the moving picture of the README, docs/demo.webp; needs Chromium
	$(BIN)/python docs/picture.py

wheel: $(READY)
	$(BIN)/python -m build --wheel --outdir dist .

package: $(READY)         ## wheel and sdist in dist/, checked
	rm -rf build dist
	$(BIN)/python -m pip install --quiet twine check-wheel-contents
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*
	$(BIN)/check-wheel-contents dist/*.whl

OLDEST_TESTS ?= filters kinematics model readers calibration angles report tables export subject static writers evaluation
oldest:                   ## tests with the oldest versions that pyproject.toml allows, in .venv-oldest
	$(PYTHON) -m venv .venv-oldest
	.venv-oldest/bin/python -m pip install --quiet -c tests/oldest.txt . pytest pytest-xdist pillow
	.venv-oldest/bin/python -m pytest $(OLDEST_TESTS:%=tests/test_%.py)

workflows: $(READY)       ## the workflows against their schema
	$(BIN)/python -m pip install --quiet check-jsonschema
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "wepose-pin needs Python 3.11 or later, $(PYTHON) is " + sys.version.split()[0] + "; try: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -e '.[dev]'
	@touch $(READY)

$(DOCS_READY): $(READY)
	$(BIN)/python -m pip install --quiet -e '.[docs]'
	@touch $(DOCS_READY)

$(PEERS_READY): $(READY)
	$(BIN)/python -m pip install --quiet -e '.[peers]'
	@touch $(PEERS_READY)

clean:
	rm -rf $(VENV) .venv-oldest build dist demo docs/_build docs/generated .random_recordings *.egg-info .mypy_cache .ruff_cache .pytest_cache
