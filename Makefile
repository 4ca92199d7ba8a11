# Two commands: `make demo` flies, `make test` tests. Each sets up what it needs; nothing but Python 3.11 and make is assumed.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
# what pip builds with is pinned by the same file; the name of the setting depends on pip's version
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
export PIP_BUILD_CONSTRAINT := $(CURDIR)/constraints.txt

# `python3.11` where it exists, else whatever python3 is (pyproject.toml refuses an older one)
ifeq ($(shell command -v $(PYTHON) 2>/dev/null),)
PYTHON := python3
endif

SAFETY_TESTS := tests/unit/test_safety_*.py tests/property/test_safety_properties.py
PILOT_TESTS := tests/unit/test_pilot.py tests/unit/test_disturbance.py tests/unit/test_retune.py

.DEFAULT_GOAL := help
.PHONY: help demo docs test test-slow coverage mutants logs check format images clean

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' Makefile

$(VENV)/sim.stamp: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) -e '.[sim]'
	touch $@

$(VENV)/dev.stamp: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) torch==2.13.0
	$(PIP) -e '.[dev]'
	touch $@

demo: $(VENV)/sim.stamp  ## fly the simulated vehicle through three crossing obstacles
	$(BIN)/companion demo

# what needs no socket runs on every core, what listens to the clock runs alone
test: $(VENV)/dev.stamp coverage  ## run the tests (without those marked slow)
	$(BIN)/python -m pytest -n auto --dist loadfile -m 'not slow and not integration' $(addprefix --ignore-glob=*/,$(notdir $(SAFETY_TESTS) $(PILOT_TESTS)))
	$(BIN)/python -m pytest -m 'not slow and integration'

test-slow: $(VENV)/dev.stamp  ## run every test
	$(BIN)/python -m pytest

coverage: $(VENV)/dev.stamp  ## every branch of the safety layer and the pilot is covered by their own tests
	$(BIN)/coverage run --branch --include='companion/safety/*,companion/pilot.py' -m pytest $(SAFETY_TESTS) $(PILOT_TESTS)
	$(BIN)/coverage report --fail-under=100 -m

# one thread each: two mutants run beside one another, and a result must not depend on the number of cores
mutants: export OMP_NUM_THREADS = 1
mutants: export OPENBLAS_NUM_THREADS = 1
mutants: $(VENV)/dev.stamp  ## mutation tests of the safety layer: at least 90 % must be killed
	rm -rf mutants
	$(BIN)/mutmut run --max-children 2
	$(BIN)/python tests/mutation/report.py

logs: export OMP_NUM_THREADS = 1
logs: export OPENBLAS_NUM_THREADS = 1
logs: $(VENV)/dev.stamp  ## fly the logs of tests/logs again, after a change that is meant to answer otherwise
	$(BIN)/python tests/logs/make.py

check: $(VENV)/dev.stamp  ## lint, format check, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	MYPYPATH=docs $(BIN)/mypy -p docgen

docs: $(VENV)/dev.stamp  ## make the reference pages from the code
	PYTHONPATH=docs $(BIN)/python -m docgen

format: $(VENV)/dev.stamp  ## format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# docker 23 or newer, podman or buildah; podman and buildah keep the health check only with BUILD_FLAGS='--format docker'
ENGINE ?= docker
BUILD_FLAGS ?=
VERSION := $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
REVISION = $(shell git rev-parse HEAD 2>/dev/null || echo unknown)
BUILD = $(ENGINE) build $(BUILD_FLAGS) --build-arg REVISION=$(REVISION)

images:  ## build the container images of docker/ (needs docker, or ENGINE=podman or buildah)
	@command -v $(ENGINE) >/dev/null || { echo "make images: $(ENGINE) is not installed: expected docker, or ENGINE=podman or ENGINE=buildah" >&2; exit 1; }
	$(BUILD) --file docker/companion.Dockerfile --tag companion:$(VERSION) .
	$(BUILD) --file docker/simulator.Dockerfile --tag companion-simulator:$(VERSION) .

clean:  ## remove the virtual environment and caches
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage mutants
