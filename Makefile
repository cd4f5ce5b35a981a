# Everything runs from a virtual environment in this folder; `make clean` removes it.
PYTHON ?= python3
# What `make test` and `make lint` install; without `learn`, its tests are skipped.
EXTRAS ?= dev,learn,cluster
# How many tests run at a time: many only wait.
JOBS ?= $(shell expr $$(nproc) + 6)
VENV ?= .venv
BIN := $(VENV)/bin
# Each of the hundreds of processes that tests start would compile fishd again.
unexport PYTHONDONTWRITEBYTECODE
AHEAD := $(shell [ "$$(nice -n -20 nice 2>/dev/null)" = -20 ] && echo nice -n -20)

.PHONY: help run test test-realtime test-fast lint docs figures vendor bench clean

help:  ## List what there is to make
	@grep -E '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 15

run: $(VENV)/installed  ## Swim a simulated fish until Ctrl-C
	$(BIN)/fishd --config config/simulated.yaml --print-status

# Signals as in a terminal, also below nohup or in the background of a script.
PYTEST := env --default-signal=HUP,INT,QUIT $(BIN)/python -m pytest

test: $(VENV)/installed-dev  ## Run all tests but those that judge real time
	$(PYTEST) -n $(JOBS) --dist worksteal -m "not realtime"

test-realtime: $(VENV)/installed-dev  ## Run the tests that judge real time, alone, on a machine with nothing else to do
	$(AHEAD) $(PYTEST) --realtime

test-fast: $(VENV)/installed-dev  ## Run what is on the virtual clock: no processes, no torch
	@# These compute and hardly ever wait.
	$(BIN)/python -m pytest -n $$(nproc) --dist worksteal --fast

# A warning is an error; both formats are made of the same parsed pages.
SPHINX := $(BIN)/python -m sphinx --quiet --fail-on-warning --conf-dir docs/sphinx --doctree-dir build/docs/parsed

lint: $(VENV)/installed-dev  ## Check style, types and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(VENV)/installed-docs  ## Write the generated parts of docs/, and build build/docs/html and build/docs/man
	$(BIN)/python tools/config_reference.py --write
	$(BIN)/python tools/protocol_reference.py --write
	$(BIN)/python tools/verb_reference.py --write
	$(BIN)/python tools/rooms.py --write
	$(BIN)/python tools/boards.py --write
	$(SPHINX) -b html docs build/docs/html
	$(SPHINX) -b man docs build/docs/man
	@echo "Open build/docs/html/README.html, or: man build/docs/man/fishctl.1"

figures: $(VENV)/installed-dev  ## Compute the paper's figures and numbers again, into docs/
	$(BIN)/python tools/paper

vendor: $(VENV)/bin/python  ## Fetch the libraries of the window's page again, with npm, and verify them
	$(BIN)/python tools/vendor.py

bench: $(VENV)/installed-dev  ## Measure lateness, load and start-up on this machine
	$(BIN)/python tools/bench tick

clean:  ## Remove the virtual environment and caches
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "fishd needs Python 3.11 or later; name one with: make PYTHON=python3.11 ..."; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
	  { echo "no virtual environment could be made; on Debian: sudo apt install python3-venv"; \
	    rm -rf $(VENV); exit 1; }
	@$(BIN)/python -m pip install --quiet --upgrade pip

$(VENV)/installed: pyproject.toml $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(VENV)/installed-dev: pyproject.toml $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --constraint tools/constraints.txt --editable '.[$(EXTRAS)]'
	@# Tests run it on a stand-in for lgpio, which has no wheel for every Python.
	$(BIN)/python -m pip install --quiet --no-deps 'rpi-lgpio>=0.6,<1'
	@# Compiled here once, tests and the swimmer's kernels need not be compiled by each of those that run at a time.
	@$(BIN)/python -m pytest -qq -k test_a_view_shows_the_water >/dev/null 2>&1 || true
	@touch $@ $(VENV)/installed $(VENV)/installed-docs

$(VENV)/installed-docs: pyproject.toml $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --constraint tools/constraints.txt --editable '.[docs]'
	@touch $@

.PHONY: release packages lock

# Extras of which a robot may have all; both packages named RPi are locked, one of them is installed.
LOCKED := pi record policy camera window lab rpi-gpio rpi-lgpio
# UPGRADE=--upgrade takes the newest versions; without it, only what must change changes.
lock: $(VENV)/installed-dev  ## Write tools/locks: versions and hashes of the packages of a robot
	@for python in 3.11 3.13; do for machine in x86_64 aarch64; do \
	  $(BIN)/uv pip compile --quiet --no-config --generate-hashes --no-annotate $(UPGRADE) \
	    --custom-compile-command "make lock" --python-version $$python \
	    --python-platform $$machine-manylinux_2_36 $(LOCKED:%=--extra %) pyproject.toml \
	    --output-file tools/locks/python$$python.txt || exit 1; \
	done; done   # the second finds the first; their hashes are those of all machines


release: $(VENV)/installed-dev  ## Build, check and try the packages of a version, and name the next steps
	$(BIN)/python tools/release.py

packages: $(VENV)/installed-dev  ## The same for the checkout as it is, without a version of its own
	$(BIN)/python tools/release.py --rehearse

.PHONY: deb trial-deb

# DEB_MACHINE=arm64 DEB_PYTHON=3.13 is for a Raspberry Pi with Trixie.
DEB_MACHINE ?= $(shell dpkg --print-architecture 2>/dev/null || echo amd64)
DEB_PYTHON ?= 3.11
deb: docs $(VENV)/installed-dev  ## Build the Debian package: DEB_MACHINE=amd64|arm64 DEB_PYTHON=3.11|3.13
	$(BIN)/python tools/deb --machine $(DEB_MACHINE) --python $(DEB_PYTHON)
	@command -v lintian >/dev/null || { echo "not run here: lintian is missing: sudo apt install lintian"; exit 1; }
	lintian --fail-on error,warning,info --display-info --tag-display-limit 0 dist/fishd_*_$(DEB_MACHINE).deb

trial-deb: docs $(VENV)/installed-dev  ## Install, upgrade, remove and purge it under a real systemd; needs root
	$(BIN)/python tools/reliability deb --write

.PHONY: install-pi trial-systemd trial-arm64 release-check

install-pi:  ## Install the package in dist/ on this Raspberry Pi, with its bus and pigpiod; needs sudo
	tools/install_pi.sh

trial-systemd: docs $(VENV)/installed-dev  ## Start, hang and kill fishd under a real systemd; needs root
	$(BIN)/python tools/reliability systemd --write

trial-arm64: docs $(VENV)/installed-dev  ## Install on arm64 Debian 12 and 13 under qemu; needs root
	BIN=$(CURDIR)/$(BIN) tools/arm64_trial.sh

release-check: $(VENV)/installed-dev  ## Run every check once before a release, and print one table; needs root
	$(BIN)/python tools/release_check.py
