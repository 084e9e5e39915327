# make demo   the estimator live on a shipped bag, over DDS
# make test-ros  the nodes' tests alone; DISTRO=jazzy runs them on another ROS 2, in an environment of its own
# make test   format, lint, layers, types and tests; PYTEST_ARGS="-k robot" passes options on, WORKERS=4 uses more cores
# make lint   format, lint, layers and types alone
# make coverage lines of the package that the quick tests reach
# make format writes the format
# make clean  removes the environment and what was built
# Needs Python 3.10 to 3.14 with venv; PYTHON=/path/to/python chooses one.
# DISTRO=kilted (the default), jazzy, or none: without ROS 2 the demo replays its bag, and the nodes' tests are skipped.

DISTRO ?= kilted
VENV ?= .venv$(if $(filter-out kilted,$(DISTRO)),-$(DISTRO))
REQUIREMENTS := requirements.txt $(if $(filter-out none,$(DISTRO)),requirements-ros-$(DISTRO).txt)
PYTEST_ARGS ?=
WORKERS ?= 2
BIN := $(VENV)/bin
COVERAGE := --cov --cov-report=term:skip-covered

export NUMBA_CACHE_DIR := $(abspath $(VENV))/numba-cache
export MPLBACKEND := Agg
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# The environment brings its own ROS 2 libraries; those of a sourced ROS 2 belong to another Python.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH COLCON_PREFIX_PATH RMW_IMPLEMENTATION VIRTUAL_ENV
ifdef ROS_DISTRO
unexport LD_LIBRARY_PATH
endif

.PHONY: demo test test-ros lint coverage format clean install
.DELETE_ON_ERROR:

demo: install
	$(BIN)/ctr-dynamics demo

test-ros: install
	@# compiles what the node needs, so that the tests do not wait for it
	$(BIN)/ctr-dynamics replay ctr_dynamics/data/bags/clean_release.mcap --robot till2020_tissue
	$(BIN)/python -m pytest $(PYTEST_ARGS) test/ros

test: lint
	$(BIN)/ctr-dynamics warmup --robot till2020_tissue
	@# sys.monitoring (Python 3.12) counts lines for 3 % more time; the tracer before it takes twice the time
	@cov=; if $(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 12))'; then cov="$(COVERAGE)"; \
	else echo "no coverage before Python 3.12; make coverage measures that of the quick tests"; fi; \
	set -x; COVERAGE_CORE=sysmon $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $$cov $(PYTEST_ARGS)

lint: install
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/mypy

coverage: install
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile -m "not slow and not ros" $(COVERAGE) $(PYTEST_ARGS)

format: install
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	$(BIN)/python -m tools.tables --write

install: $(VENV)/.package

$(VENV)/.package: $(VENV)/.requirements setup.py setup.cfg pyproject.toml ctr_dynamics/__init__.py
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/.requirements: $(REQUIREMENTS)
	@set -e; \
	ok='import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 14))'; \
	if ! $(BIN)/python -c "$$ok" >/dev/null 2>&1; then \
	  found=; \
	  for candidate in $(PYTHON) python3.11 python3.12 python3.10 python3.13 python3.14 python3 python; do \
	    if "$$candidate" -c "$$ok" >/dev/null 2>&1; then found="$$candidate"; break; fi; \
	  done; \
	  if [ -z "$$found" ]; then \
	    echo "make: error: no Python 3.10 to 3.14 with venv was found; install one, or give PYTHON=/path/to/python" >&2; \
	    exit 1; \
	  fi; \
	  echo "creating $(VENV) with $$("$$found" --version)"; \
	  "$$found" -m venv --clear $(VENV); \
	fi; \
	echo "installing $(REQUIREMENTS) into $(VENV) (some minutes the first time)"; \
	$(BIN)/python -m pip install --quiet $(addprefix --requirement=,$(REQUIREMENTS))
	@touch $@

clean:
	rm -rf $(VENV) build dist install log ctr_dynamics.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .coverage*
