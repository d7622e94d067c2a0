# Two commands on a bare machine with python3 >= 3.11, python3-venv and make: `make solve` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# One BLAS thread per process: the matrices are small and the work is spread over processes.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
# Modules are kept as bytecode, also where the environment says otherwise: see setup.
export PYTHONDONTWRITEBYTECODE :=
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --only-binary :all:

.PHONY: solve test tests studies test-fast test-room test-pythons test-processors lint docs pictures bench peers setup setup-test clean

solve: setup
	$(BIN)/python -m ccd_casadi.solve runs/two_mass.toml

# Types and pages are checked beside the tests, whose processes wait for each other now and then.
test: setup-test
	$(MAKE) --no-print-directory -j 2 tests lint docs

tests: setup-test
	$(BIN)/python -m pytest -n 2 --dist worksteal
	$(BIN)/python benchmarks/processors.py --other

# The heavier studies that `make test` leaves out: half an hour on two cores.
studies: setup-test
	$(BIN)/python -m pytest -n 2 --dist worksteal -m slow

# The room that one works in, a folder of tests/: `make test-fast ROOM=kernels`, under a minute each.
ROOM ?= kernels
test-fast test-room: setup-test
	$(BIN)/python -m pytest -n 2 --dist worksteal tests/$(ROOM)

# The same with each Python that the package claims and that is found, in an environment of its own.
VERSIONS ?= 3.11 3.12 3.13 3.14
test-pythons:
	@for version in $(VERSIONS); do \
	  python=; \
	  for place in python$$version $$HOME/.pyenv/versions/$$version.*/bin/python; do \
	    $$place -c "import ensurepip" 2>/dev/null && python=$$place; \
	  done; \
	  echo "Python $$version: $${python:-not found}"; \
	  [ -z "$$python" ] || $(MAKE) --no-print-directory test-fast VENV=.venv-$$version \
	    PYTHON=$$python || exit 1; \
	done

# The suite under the kernels that OpenBLAS has for other processors, three times each, with
# examples drawn anew: an hour or more on two cores.
test-processors: setup-test
	$(BIN)/python benchmarks/processors.py

lint: setup-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check ccd_casadi surrogates
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

# The documentation site, in site/: a broken link or reference is an error.
docs: setup-test
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

# The screenshots of the documentation, where a page has changed since (a test says which): needs a
# Chromium, and ten minutes.
pictures: setup-test
	$(BIN)/python docs/pictures.py

# `make bench LONG="--long --compile"` adds the rows that take minutes.
bench: setup-test
	$(BIN)/python benchmarks/commands.py $(LONG)
	$(BIN)/python benchmarks/synthesis.py

# What runs offline beside other people's tools and designs; see docs/development/peers.md.
# DRIVE and MIRROR are checkouts of the two repositories that are read, if there are any.
peers: setup-test
	$(BIN)/python benchmarks/synthesis.py
	$(BIN)/python benchmarks/back_ends.py 10 10
	$(BIN)/python benchmarks/disk_drive.py
	$(BIN)/python benchmarks/oracle.py guided_beam
	$(BIN)/python benchmarks/mathworks.py
	$(BIN)/python benchmarks/stage_judge.py
	$(BIN)/python benchmarks/mirror_held_out.py
	test -z "$(DRIVE)" || $(BIN)/python benchmarks/drive_error.py --theirs $(DRIVE)
	test -z "$(MIRROR)" || $(BIN)/python benchmarks/mirror_held_out.py --theirs $(MIRROR)
	$(BIN)/python benchmarks/peer_table.py

setup: $(VENV)/.ready
setup-test: $(VENV)/.ready-test

# The kernels that `make solve` needs are compiled once here, so that it does not wait for them (the
# others by the first job that needs them); what they need is installed first, as bytecode only where
# it is imported, the other wheels meanwhile.
$(VENV)/.ready: requirements.lock pyproject.toml
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(PIP) --no-compile -c requirements.lock numba scipy
	$(BIN)/python -c "from ccd_casadi.kernels import compilation; compilation.ensure_compiled('synthesis')" & \
	kernels=$$!; \
	$(PIP) -r requirements.lock && \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e . \
	|| { kill $$kernels; exit 1; }; \
	wait $$kernels
	touch $@

# Tests need every kernel: those that are left are compiled while the wheels come.
$(VENV)/.ready-test: $(VENV)/.ready requirements-test.lock
	$(BIN)/python -m ccd_casadi.kernels & \
	kernels=$$!; \
	$(PIP) -r requirements-test.lock && \
	wait $$kernels
	touch $@

clean:
	rm -rf .venv .venv-* site *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
