# One command runs the loop, one passes the tests: `make sim-loop`, `make test`. `make help` lists the rest.
PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$p; break; }; done)
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
# Tests that only compute run side by side; those with processes and a clock in them run alone, after them.
COMPUTING := tests/control tests/design tests/fuzz tests/optics tests/sim tests/view tests/adapters/test_access.py \
	tests/adapters/test_extras.py tests/adapters/test_gaps.py tests/adapters/test_log_files.py \
	tests/adapters/test_log_mutations.py tests/e2e/test_acceptance_loop.py tests/e2e/test_dark_hole.py \
	tests/e2e/test_lockstep.py tests/e2e/test_mistakes.py tests/e2e/test_report_browser.py tests/e2e/test_sensors.py \
	tests/test_acceptance.py tests/test_agreement.py tests/test_calibrate.py tests/test_calibrate_at.py \
	tests/test_calibrate_commands.py tests/test_calibrate_promise.py tests/test_calibration_file.py \
	tests/test_certificates.py tests/test_chaos.py tests/test_commission.py tests/test_configuration.py \
	tests/test_conformance.py tests/test_controller_memory.py tests/test_docs_computing.py tests/test_export.py \
	tests/test_history.py tests/test_hosts_commands.py tests/test_layers.py tests/test_layout_files.py \
	tests/test_log_info.py tests/test_log_parts.py tests/test_loop.py \
	tests/test_messages.py tests/test_mirror_maps.py tests/test_recover.py tests/test_rehearsal.py tests/test_replay.py \
	tests/test_report.py tests/test_state_codec.py tests/test_step.py tests/test_tune.py tests/test_validate.py \
	tests/test_validate_figures.py tests/test_what_if.py tests/test_what_if_options.py tests/test_wheel.py

.PHONY: help sim-loop test test-all bench lint types format proto node clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "lowfc needs Python 3.11 or newer; none was found. Debian: apt install python3" >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { v=$$($(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])'); \
		echo "$(PYTHON) has no venv module. Debian: apt install python$$v-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) --editable .
	@touch $@

$(VENV)/.tests: $(VENV)/.installed
	$(INSTALL) --editable '.[test]'
	@touch $@

sim-loop: $(VENV)/.installed  ## install, then run the simulated loop for 20 s
	$(BIN)/lowfc sim-loop --duration 20

test: $(VENV)/.tests lint types  ## install, then lint, types and tests
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m 'not slow' -n auto --dist loadfile $(COMPUTING)
	$(BIN)/python -m pytest -m 'not slow' $(COMPUTING:%=--ignore=%)

test-all: $(VENV)/.tests node lint types  ## everything, the slow tests and those that need node, chromium and a graphics driver too
	@ls /usr/share/vulkan/icd.d/*.json >/dev/null 2>&1 || { test "$$(id -u)" = 0 && apt-get install --yes mesa-vulkan-drivers libvulkan1; } || \
		echo "no Vulkan driver: the viewer tests will skip. Debian: apt install mesa-vulkan-drivers libvulkan1" >&2
	@command -v chromium >/dev/null || { test "$$(id -u)" = 0 && apt-get install --yes chromium; } || \
		echo "no chromium: the browser tests will skip. Debian: apt install chromium" >&2
	$(BIN)/python -m pytest

bench: $(VENV)/.installed  ## time the loop beside the last release's figures; STORE=--store keeps them
	@figures=$$($(BIN)/lowfc latency --json) && printf '%s' "$$figures" | $(BIN)/python -m benchmarks.releases $(STORE)

lint: $(VENV)/.tests  ## ruff
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.tests  ## mypy, strict
	$(BIN)/mypy

format: $(VENV)/.tests  ## rewrite the sources as ruff likes them
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

proto: $(VENV)/.tests  ## compile the messages' declaration (development only)
	$(BIN)/python -m lowfc.contract.compile_proto

node: tests/node/node_modules  ## the independent MCAP reader

tests/node/node_modules: tests/node/package.json
	npm install --prefix tests/node --no-audit --no-fund --no-package-lock
	@touch $@

clean:  ## remove what was installed and built
	rm -rf $(VENV) tests/node/node_modules *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
