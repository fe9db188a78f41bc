# Two commands matter: `make demo` shows everything, `make test` proves it. Both install what they need into .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
OUT ?= runs

.PHONY: demo test test-vcan fuzz coverage mutation lint bench messages supervisor-table clean

demo: .venv/installed-all ## everything in one process tree: 30 steps in the air with each guide shape
	$(BIN)/atalante demo --out $(OUT)/demo

# worksteal: the tests of a file stay together until the end, so what they share is made once and not by each worker.
test: .venv/installed-dev lint ## linters, types, layers and all tests but those that need SocketCAN
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-vcan: .venv/installed-vcan ## the tests on real SocketCAN, in a kernel of their own where this one has none
	PYTHON=$(BIN)/python tests/vcan/run.sh

fuzz: .venv/installed-dev ## 10 million random and mutated frames at the HAL and at every emulated node
	PYTHONPATH=tests/fuzz $(BIN)/python tests/fuzz/frame_fuzzer.py --frames 10000000

coverage: .venv/installed-dev ## every line and branch of the safety core is run by its own tests
	$(BIN)/python tests/mutation/cover.py

mutation: .venv/installed-mutation ## mutants of the safety core: 95 % are killed, the others are argued in tests/mutation/SURVIVORS.md
	$(BIN)/python tests/mutation/mutate.py $(if $(WITHOUT),--without $(WITHOUT))

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: .venv/installed-dev ## every benchmark beside its baseline
	$(BIN)/atalante bench

messages: .venv/installed-dev ## the descriptor set of the telemetry messages, after a change of messages.proto
	$(BIN)/python -m grpc_tools.protoc --proto_path=atalante_hal/telemetry --include_imports \
	  --descriptor_set_out=atalante_hal/telemetry/messages.binpb messages.proto

supervisor-table: .venv/installed-dev ## SUPERVISOR.md, after a change of the supervisor or of the diagnostics
	$(BIN)/python -m atalante_tools.supervisor_table SUPERVISOR.md

clean:
	rm -rf .venv $(OUT)

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

.venv/installed-mutation .venv/installed-vcan: .venv/installed-%: .venv/installed-dev
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[$*]'
	@touch $@
