# `make sim-loop` runs the simulated loop, `make test` the tests; `make help` lists all targets.
PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$p; break; }; done)
VENV := .venv
BIN := $(VENV)/bin
# --no-compile: a module is compiled when it is first imported.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
export PYTHONDONTWRITEBYTECODE :=  # cleared: without cached bytecode each interpreter that collects the tests needs 5 s more
.PHONY: help sim-loop test test-all bench lint types format proto node docs release clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

# --upgrade-deps: the newest pip finds the packages in half the time of the one that comes with Python.
$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "lowfc needs Python 3.11 or newer; none was found. Debian: apt install python3" >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { v=$$($(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])'); \
		echo "$(PYTHON) has no venv module. Debian: apt install python$$v-venv" >&2; exit 1; }
	$(PYTHON) -m venv --upgrade-deps $(VENV)

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) --editable .
	@touch $@

$(VENV)/.tests: $(VENV)/.installed
	$(INSTALL) --editable '.[test]'
	@touch $@

sim-loop: $(VENV)/.installed  ## install, then run the simulated loop for 20 s
	$(BIN)/lowfc sim-loop --duration 20

test: $(VENV)/.tests lint  ## install, then lint, types and tests
	nice -n 19 $(BIN)/mypy & types=$$!; \
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m 'not slow and not basler and not aravis' -n auto --dist loadfile --no-loadscope-reorder && \
	wait $$types

test-all: $(VENV)/.tests node lint types  ## lint, types and all tests, also slow ones and those that need node, chromium or a graphics driver
	@ls /usr/share/vulkan/icd.d/*.json >/dev/null 2>&1 || { test "$$(id -u)" = 0 && apt-get install --yes mesa-vulkan-drivers libvulkan1; } || \
		echo "no Vulkan driver: the viewer tests will skip. Debian: apt install mesa-vulkan-drivers libvulkan1" >&2
	@command -v chromium >/dev/null || { test "$$(id -u)" = 0 && apt-get install --yes chromium; } || \
		echo "no chromium: the browser tests will skip. Debian: apt install chromium" >&2
	@command -v arv-fake-gv-camera-0.8 >/dev/null || { test "$$(id -u)" = 0 && apt-get install --yes aravis-tools gir1.2-aravis-0.8 python3-gi; } || \
		echo "no aravis: its tests will skip. Debian: apt install aravis-tools gir1.2-aravis-0.8 python3-gi" >&2
	$(INSTALL) --editable '.[test,epics-test,basler]'
	$(BIN)/python -m pytest

bench: $(VENV)/.installed  ## time the loop and compare with the last release; STORE=1 stores the results as this release's
	@today=$$(mktemp); stored=benchmarks/history/$$($(BIN)/lowfc --version).json; \
	test -z "$(STORE)" -o ! -e $$stored || { echo "$$stored is there already: remove it first" >&2; exit 1; }; \
	$(BIN)/lowfc latency --json >$$today && \
	$(BIN)/lowfc latency --compare $$(ls benchmarks/history/*.json | sort -V | tail -1) $$today && \
	{ test -z "$(STORE)" || cp $$today $$stored; }; status=$$?; rm $$today; exit $$status

lint: $(VENV)/.tests  ## ruff
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.tests  ## mypy, strict
	$(BIN)/mypy

format: $(VENV)/.tests  ## format the sources with ruff
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

proto: $(VENV)/.tests  ## compile the messages' declaration (development only)
	$(BIN)/python -m lowfc.contract.compile_proto

node: tests/node/node_modules  ## the independent MCAP reader

tests/node/node_modules: tests/node/package.json
	npm install --prefix tests/node --no-audit --no-fund --no-package-lock
	@touch $@

release: $(VENV)/.installed  ## build sdist and wheel, check them, run the wheel in an empty environment
	$(INSTALL) build twine
	rm -rf build/dist build/empty && mkdir -p build/dist build/empty
	$(BIN)/python -m build --outdir build/dist .
	$(BIN)/twine check --strict build/dist/*
	$(BIN)/python -m venv build/empty/venv
	env -u PYTHONPATH build/empty/venv/bin/pip install --quiet --disable-pip-version-check --constraint constraints.txt build/dist/*.whl
	cd build/empty && env -u PYTHONPATH venv/bin/lowfc sim-loop --duration 5
	ls -l build/dist

docs: $(VENV)/.installed  ## build the site: build/docs/index.html
	$(INSTALL) --editable '.[docs]'
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet docs build/docs

clean:  ## remove what was installed and built
	rm -rf $(VENV) tests/node/node_modules build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
