# Two commands matter: `make demo` shows everything, `make test` proves it. Both install what they need into .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
OUT ?= runs

.PHONY: help demo test test-vcan lowest fuzz coverage mutation lint docs bench messages supervisor-table clean

help: ## list the targets (the default)
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "%-18s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

demo: .venv/installed-all ## walk 30 steps in the air inside each guide shape, on the emulated robot
	$(BIN)/atalante demo --out $(OUT)/demo

# worksteal: the tests of a file stay together until the end, so what they share is made once and not by each worker.
test: .venv/installed-dev lint ## run linters, type checks and all tests except those that need SocketCAN
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-vcan: .venv/installed-vcan ## run the tests on real SocketCAN, in a virtual machine if this kernel has none
	PYTHON=$(BIN)/python tests/vcan/run.sh

lowest: ## install the lowest versions that pyproject.toml allows into .venv-lowest and try a command for each extra
	rm -rf .venv-lowest
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/pip install --quiet --disable-pip-version-check uv
	.venv-lowest/bin/uv pip install --quiet --python .venv-lowest/bin/python --resolution lowest-direct --editable '.[all,decode,dask]'
	.venv-lowest/bin/python tests/lowest/try_lowest.py

fuzz: .venv/installed-dev ## send 10 million random and mutated frames to the HAL and to every emulated node
	PYTHONPATH=tests/fuzz $(BIN)/python tests/fuzz/frame_fuzzer.py --frames 10000000

coverage: .venv/installed-dev ## check that the tests of the safety core reach each of its lines and branches
	$(BIN)/python tests/mutation/cover.py

mutation: .venv/installed-mutation ## mutate the safety core: 95 % of the mutants must fail a test, see tests/mutation/SURVIVORS.md
	$(BIN)/python tests/mutation/mutate.py $(if $(WITHOUT),--without $(WITHOUT))

lint: .venv/installed-dev ## check style, formatting, types, import layers and spelling
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell

docs: .venv/installed-docs ## build the documentation site in site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	@! grep -rnoE --include='*.html' '<(script|link|img|iframe|source)[^>]* (src|href)="?(https?:)?//[^ >]*' site \
	  || { echo "site/ must load nothing from other hosts" >&2; exit 1; }

bench: .venv/installed-dev ## run every benchmark beside its baseline
	$(BIN)/atalante bench

messages: .venv/installed-dev ## write messages.binpb after a change of atalante_hal/telemetry/messages.proto
	$(BIN)/python -m grpc_tools.protoc --proto_path=atalante_hal/telemetry --include_imports \
	  --descriptor_set_out=atalante_hal/telemetry/messages.binpb messages.proto

supervisor-table: .venv/installed-dev ## write SUPERVISOR.md after a change of the supervisor or of the diagnostics
	$(BIN)/python -m atalante_tools.supervisor_table SUPERVISOR.md

clean: ## remove the environments, runs and site
	rm -rf .venv .venv-lowest $(OUT) site

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed; call make PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv .venv

# Installed again when the dependencies change; otherwise a second call starts at once.
.venv/installed-all: pyproject.toml | .venv/bin/python
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[all]'
	@touch $@

.venv/installed-dev: pyproject.toml | .venv/bin/python
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@ .venv/installed-all

.venv/installed-docs .venv/installed-mutation .venv/installed-vcan: .venv/installed-%: .venv/installed-dev
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[$*]'
	@touch $@
