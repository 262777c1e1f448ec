# Everything a person does with this repository. `make help` lists it.

SECONDS ?= 0
# `SECONDS` is also a variable of bash, which must not leak in from the environment.
ifeq ($(origin SECONDS),environment)
SECONDS := 0
endif
PYTHON ?= python3
PORT ?= 8080
VENV := .venv
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help demo test quick check soak rig install uninstall wheels lock proto clean

help: ## list these
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python >= 3.11 is needed; name one with: make PYTHON=python3.12 ..." >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { echo "on Debian and Ubuntu: apt install python3-venv" >&2; rm -rf $(VENV); exit 1; }

$(VENV)/run.stamp: requirements/run.txt pyproject.toml | $(BIN)/python
	@echo "installing vdms-rt into $(VENV)"
	@$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements/run.txt
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/dev.stamp: requirements/dev.txt $(VENV)/run.stamp
	@echo "installing what the tests need"
	@$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements/dev.txt
	@touch $@

$(VENV)/replay.stamp: requirements/replay.txt tools/replay/pyproject.toml $(VENV)/dev.stamp
	@echo "installing vdms-replay"
	@$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements/replay.txt
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable tools/replay
	@touch $@

demo: $(VENV)/run.stamp ## measure the virtual shaking table, with its page (SECONDS=10 ends by itself; PORT=8080)
	@echo "the page: http://127.0.0.1:$(PORT)/"
	@$(BIN)/vdms-rt view --port $(PORT) >/dev/null & view=$$!; \
	trap 'kill $$view 2>/dev/null; wait $$view' EXIT; trap : INT TERM; \
	$(BIN)/vdms-rt run --config config/demo.toml --seconds $(SECONDS)

check: $(VENV)/replay.stamp ## format, lint, types, layers
	@$(BIN)/ruff format --check --quiet . || { $(BIN)/ruff format --diff --quiet .; exit 1; }
	@$(BIN)/ruff check --quiet .
	@$(BIN)/mypy --no-error-summary
	@$(BIN)/lint-imports --no-logo >.lint-imports.log 2>&1 || { cat .lint-imports.log; exit 1; }
	@echo "check: clean"

test: check ## everything that runs without a kernel of its own
	@$(BIN)/pytest -m "not rig and not soak"

quick: $(VENV)/replay.stamp ## the fast tests alone
	@$(BIN)/pytest -q -m "not rig and not slow and not soak"

soak: $(VENV)/replay.stamp ## the long tests, also in the virtual machine: faults many times over (as root)
	@$(BIN)/pytest -m "soak and not rig"
	@tests/rig/run --soak

rig: $(VENV)/dev.stamp ## the tests on real kernel drivers, in a virtual machine (DEVICE=...: on that grabber)
	@$(if $(DEVICE),$(BIN)/pytest -s -m hardware --deselect "tests/rig/test_plug.py::test_pulled_and_plugged_in_while_it_measures[20 times]" --device $(DEVICE) tests/rig,tests/rig/run)

install: ## the service, with sudo (WHEELS=DIR: without internet, see docs/guide.md)
	@systemd/install.sh

uninstall: ## remove the service again; recordings and configuration stay
	@systemd/uninstall.sh

wheels: ## fetch what an installation without internet needs, into WHEELS=DIR
	@WHEELS=$(or $(WHEELS),wheels) systemd/install.sh wheels

lock: $(VENV)/dev.stamp ## write requirements/*.txt anew
	@$(BIN)/pip install --quiet uv
	@cd requirements && for f in run dev; do \
	  extra=; [ $$f = run ] || extra=dev.in; \
	  ../$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header ../pyproject.toml build.in $$extra -o $$f.txt; done; \
	  ../$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --no-emit-package vdms-rt --constraint dev.txt --all-extras ../tools/replay/pyproject.toml build.in -o replay.txt

proto: $(VENV)/dev.stamp ## compile wire/*.proto
	@PATH=$(BIN):$$PATH $(BIN)/python -m grpc_tools.protoc -I src --python_out=src --mypy_out=src src/vdms_rt/wire/vdms.proto src/vdms_rt/wire/control.proto src/vdms_rt/wire/picture.proto

clean: ## remove what was built and installed
	@rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .lint-imports.log
