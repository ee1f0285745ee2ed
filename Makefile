# All set-up happens here: python3 (3.10 or later), git and make are enough.
#
#   make demo    convert the recording in fixtures/two_lidars and draw a scan of it
#   make test    formatting, lint, types, all tests
#   make coverage   all tests with branch coverage, at least 95 %
#   make test-quick   the fast tests, without whole suites of cases
#   make test-lowest   these and all of readers, writers and ros, with the oldest dependencies
#                allowed, by Python 3.10 or 3.11
#   make lint    the first three of them
#   make docs    the documentation as a site, build/site/index.html
#   make bench   how fast it is here (BENCH="--case dual-4 --peer-python PYTHON")
#   make test-consumers   third-party programs read our outputs, each in its own environment
#   make odometry   KISS-ICP on windows and on fused sweeps, on simulated rigs (docs/does-it-help.md)
#   make casestudy   lidar-inertial odometry of one and two lidars (docs/does-it-help.md)
#   make fuzz    a million mutated inputs on all cores (INPUTS=..., SEED=..., MINUTES=...)
#   make fuzz-sanitized   its targets of compiled loops, with sanitizers in the C code
#   make mutants   how many small changes of the package its tests notice (MUTANTS="--count 60 --seed 1")
#   make clean   remove what the others made

PYTHON ?= python3
# The oldest dependencies have no wheels for later versions.
LOWEST_PYTHON ?= $(PYTHON)
VENV := .venv
LOWEST := .venv-lowest
CONSUMERS := .venv-consumers
ODOMETRY := .venv-odometry
BIN := $(VENV)/bin
# Types by the oldest Python, where the installed numpy has types for it: up to 3.11.
OLDEST = $(shell $(BIN)/python -c 'import sys; print("--python-version 3.10" * (sys.version_info < (3, 12)))')
# Modules are compiled when they are imported; of most tools few are.
INSTALL := install --quiet --disable-pip-version-check --no-compile
RIG := fixtures/two_lidars
# Of the compiled engine, which an installation builds.
SOURCES := $(wildcard mlbatch/native/*.[ch])
CONVERT := $(BIN)/mlbatch convert $(RIG)/two_lidars.pcap --rig $(RIG)/rig.yaml --overwrite

.DEFAULT_GOAL := help
.PHONY: help demo test suite coverage test-quick test-lowest test-consumers lint docs bench odometry odometry-quick \
	casestudy casestudy-quick fuzz fuzz-sanitized mutants clean

help:
	@sed -n 's/^#   //p' Makefile

demo: $(VENV)/dev.stamp
	@mkdir -p demo
	$(CONVERT) -o demo/two_lidars.mcap
	$(CONVERT) -o demo/scans
	$(BIN)/python docs/picture.py demo/scans demo/two_lidars.png
	@$(BIN)/python docs/demo.py demo

test: lint suite

suite: $(VENV)/dev.stamp
	$(BIN)/python -m pytest -n 2 --dist worksteal

coverage: $(VENV)/dev.stamp
	$(BIN)/python -m pytest -n 2 --dist worksteal --cov --cov-branch --cov-report=term:skip-covered --cov-fail-under=95

test-quick: $(VENV)/dev.stamp
	$(BIN)/python -m pytest -n 2 --dist worksteal -m 'not slow and not long and not seconds'

test-lowest: $(LOWEST)/dev.stamp
	$(LOWEST)/bin/python -m pytest -n 2 --dist worksteal -m lowest

# PCL, CloudCompare, Open3D: apt-get install pcl-tools cloudcompare libusb-1.0-0; JavaScript: node, npm.
test-consumers: $(VENV)/dev.stamp
	$(BIN)/python -m pytest tests/consumers/check_consumers.py -v -rs

lint: $(VENV)/dev.stamp
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy $(OLDEST)

# The variable removes a notice about the next version of mkdocs.
docs: $(VENV)/docs.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

bench: $(VENV)/dev.stamp
	$(BIN)/python -m pytest -m slow
	$(BIN)/python -m tests.bench $(BENCH)

odometry: $(ODOMETRY)/odometry.stamp
	$(ODOMETRY)/bin/python examples/odometry/odometry.py $(STUDY)

# A minute: one short recording, two variants.
odometry-quick: $(ODOMETRY)/odometry.stamp
	$(ODOMETRY)/bin/python examples/odometry/odometry.py -o build/odometry-quick --seeds 1 \
		--duration 5 --variants windows "approximate time, times as they come"

casestudy: $(ODOMETRY)/casestudy.stamp
	PYTHONPATH=examples/odometry $(ODOMETRY)/bin/python examples/casestudy/casestudy.py $(STUDY)

# Half a minute: one run of a short drive, whose drift evo confirms.
casestudy-quick: $(ODOMETRY)/casestudy.stamp
	PYTHONPATH=examples/odometry $(ODOMETRY)/bin/python examples/casestudy/casestudy.py -o build/casestudy-quick \
		--seeds 1 --duration 10 --lidar OS0-32 --scenes harvester-hard --runs both-5-0-window --evo

INPUTS ?= 1000000
SEED ?= 1
MINUTES ?= 0

fuzz: $(VENV)/dev.stamp
	$(BIN)/python -m tests.fuzz.run --inputs $(INPUTS) --seed $(SEED) --minutes $(MINUTES)

# The fuzzer with the C code under AddressSanitizer and UndefinedBehaviorSanitizer.
fuzz-sanitized: $(VENV)/dev.stamp
	mkdir -p build
	$(CC) -std=c11 -g -O1 -fno-omit-frame-pointer -ffp-contract=off -fsanitize=address,undefined \
		-fno-sanitize-recover=all -fPIC -shared -o build/native-sanitized.so mlbatch/native/*.c
	LD_PRELOAD="$$($(CC) -print-file-name=libasan.so) $$($(CC) -print-file-name=libubsan.so)" \
		ASAN_OPTIONS=detect_leaks=0:quarantine_size_mb=16 MLBATCH_NATIVE=$(CURDIR)/build/native-sanitized.so \
		$(BIN)/python -m tests.fuzz.run --target compiled --inputs $(INPUTS) --seed $(SEED) --minutes $(MINUTES)

mutants: $(VENV)/dev.stamp
	$(BIN)/python -m tests.mutants $(MUTANTS)

clean:
	rm -rf $(VENV) $(LOWEST) $(CONSUMERS) $(ODOMETRY) demo build mlbatch*.egg-info .coverage .*_cache .hypothesis

# The environment is updated when pyproject.toml or a C source changes.
$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
		echo "make: expected Python 3.10 or later, found $$($(PYTHON) --version 2>&1);" \
			"choose another: make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "make: $(PYTHON) cannot make a virtual environment;" \
			"on Debian and Ubuntu: apt-get install python3-venv"; exit 1; }

$(VENV)/core.stamp: pyproject.toml $(SOURCES) | $(VENV)/bin/python
	@echo "installing mlbatch into $(VENV)"
	@$(BIN)/python -m pip $(INSTALL) --editable .
	@touch $@

$(VENV)/dev.stamp: pyproject.toml $(SOURCES) | $(VENV)/bin/python
	@echo "installing mlbatch and its tools into $(VENV)"
	@$(BIN)/python -m pip $(INSTALL) --editable '.[dev]'
	@touch $@ $(VENV)/core.stamp

$(VENV)/docs.stamp: $(VENV)/dev.stamp
	@echo "installing the tools of the site into $(VENV)"
	@$(BIN)/python -m pip $(INSTALL) --editable '.[docs]'
	@touch $@

$(VENV)/integrations.stamp: $(VENV)/dev.stamp
	@echo "installing an S3 server and Snakemake for tests into $(VENV)"
	@$(BIN)/python -m pip $(INSTALL) --editable '.[dev-integrations]'
	@touch $@

$(ODOMETRY)/odometry.stamp: examples/odometry/requirements.txt pyproject.toml $(SOURCES)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "make: expected Python 3.11 or later, which evo needs, found" \
			"$$($(PYTHON) --version 2>&1); choose another: make PYTHON=python3.12 odometry"; exit 1; }
	@echo "installing mlbatch, KISS-ICP and evo into $(ODOMETRY)"
	@$(PYTHON) -m venv $(ODOMETRY)
	@$(ODOMETRY)/bin/python -m pip $(INSTALL) \
		--requirement examples/odometry/requirements.txt --editable .
	@touch $@

$(ODOMETRY)/casestudy.stamp: examples/casestudy/requirements.txt $(ODOMETRY)/odometry.stamp
	@$(ODOMETRY)/bin/python -m pip $(INSTALL) \
		--requirement examples/casestudy/requirements.txt
	@touch $@

$(LOWEST)/dev.stamp: pyproject.toml .ci/lowest.txt
	@$(LOWEST_PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 12))' || { \
		echo "make: expected Python 3.10 or 3.11, found $$($(LOWEST_PYTHON) --version 2>&1);" \
			"choose another: make LOWEST_PYTHON=python3.11 test-lowest"; exit 1; }
	@echo "installing the oldest dependencies into $(LOWEST)"
	@$(LOWEST_PYTHON) -m venv --clear $(LOWEST)
	@$(LOWEST)/bin/python -m pip $(INSTALL) \
		--constraint .ci/lowest.txt --editable '.[dev]'
	@touch $@
