# The main targets are `demo` and `test`. Each target installs the packages that it needs into .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
OUT ?= runs
# The demo and the tests start many processes, so modules must be compiled only once.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo demo-air test test-long compile compile-air compile-ground test-vcan lowest fuzz coverage mutation lint docs bench messages supervisor-table clean

help: ## list all targets (default)
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "%-18s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

# The first run compiles the numeric functions. It compiles those of the walk on the ground on a second core meanwhile.
demo: .venv/installed-all ## walk in the air inside each guide shape, then on the ground, on the emulated robot
	@$(MAKE) --no-print-directory -j 2 demo-air compile-ground
	$(BIN)/atalante walk --steps 4 --xi 0.5 --wearer passive --out $(OUT)/walk

demo-air: .venv/installed-all ## run the part of `demo` in the air
	$(BIN)/atalante demo --steps 6 --out $(OUT)/demo

# Two short runs compile the numeric functions while `lint` runs, so the tests do not compile them in every process.
# With worksteal, the tests of a file mostly run in one worker, so their shared fixtures are created only once.
test: .venv/installed-dev ## run `lint` and all tests except the long ones and those that need SocketCAN
	$(MAKE) --no-print-directory -j 2 lint compile-air compile-ground
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not (long or exhaustive)"

test-long: .venv/installed-dev ## run the long tests: all cases of the fault matrix, exhaustive searches, walks of many steps, the commands of all pages
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "long or exhaustive"

compile: compile-air compile-ground ## compile the numeric functions, which the first run of a command does otherwise

compile-air: .venv/installed-all ## run the part of `compile` for walks in the air
	@$(call quiet,demo --shape pinched --steps 1)

compile-ground: .venv/installed-all ## run the part of `compile` for walks on the ground
	@$(call quiet,walk --steps 1)

# Run a command of `atalante` whose output only matters if the command fails.
quiet = folder=$$(mktemp -d); trap 'rm -rf "$$folder"' EXIT; \
  $(BIN)/atalante $(1) --out "$$folder/run" >"$$folder/log" 2>&1 || { cat "$$folder/log"; exit 1; }

test-vcan: .venv/installed-vcan ## run the tests that need SocketCAN, in a virtual machine if this kernel has no SocketCAN
	PYTHON=$(BIN)/python tests/vcan/run.sh

lowest: ## install the lowest package versions that pyproject.toml allows into .venv-lowest, and run a command per extra
	rm -rf .venv-lowest
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/pip install --quiet --disable-pip-version-check uv
	.venv-lowest/bin/uv pip install --quiet --python .venv-lowest/bin/python --resolution lowest-direct --editable '.[all,decode,dask]'
	.venv-lowest/bin/python tests/lowest/try_lowest.py

fuzz: .venv/installed-dev ## send 10 million random and mutated frames to the HAL and to every emulated node
	PYTHONPATH=tests/fuzz $(BIN)/python tests/fuzz/frame_fuzzer.py --frames 10000000

coverage: .venv/installed-dev ## check that the tests of the safety core cover all its lines and branches
	$(BIN)/python tests/mutation/cover.py

mutation: .venv/installed-mutation ## mutation testing of the safety core: tests must detect 95 % of the mutants (THIRD=1, 2 or 3: of one third)
	$(BIN)/python tests/mutation/mutate.py $(if $(WITHOUT),--without $(WITHOUT)) $(if $(THIRD),--third $(THIRD))

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

bench: .venv/installed-dev ## run all benchmarks and their baselines
	$(BIN)/atalante bench

messages: .venv/installed-dev ## compile atalante_hal/telemetry/messages.proto to messages.binpb
	$(BIN)/python -m grpc_tools.protoc --proto_path=atalante_hal/telemetry --include_imports \
	  --descriptor_set_out=atalante_hal/telemetry/messages.binpb messages.proto

supervisor-table: .venv/installed-dev ## write SUPERVISOR.md from the state machine and the diagnostics
	$(BIN)/python -m atalante_tools.supervisor_table SUPERVISOR.md

clean: ## remove the virtual environments, runs and site
	rm -rf .venv .venv-lowest $(OUT) site

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python must be 3.11 or newer: call make PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	-$(BIN)/pip install --quiet --disable-pip-version-check uv

# Install an extra with uv, which needs a third of the time of pip. If there is no uv, or if uv fails, pip installs it: uv does not read
# the configuration of pip, for example a private package index. The modules are compiled on all cores afterwards, because pip compiles
# on one core. The tests of the packages are left out, because they take half of the time. Some packages contain files that are not
# valid Python; pip ignores them, too.
define install
$(BIN)/uv pip install --quiet --python $(BIN)/python --editable '.[$(1)]' || \
  $(BIN)/pip install --quiet --disable-pip-version-check --no-compile --editable '.[$(1)]'
@$(BIN)/python -W ignore -m compileall -qq -j 0 -x '/tests/' .venv/lib || true
endef

# An empty file marks each installed set of packages. The packages are installed again only after a change of pyproject.toml.
.venv/installed-all: pyproject.toml | .venv/bin/python
	$(call install,all)
	@touch $@

.venv/installed-dev: pyproject.toml | .venv/bin/python
	$(call install,dev)
	@touch $@ .venv/installed-all

.venv/installed-docs .venv/installed-mutation .venv/installed-vcan: .venv/installed-%: .venv/installed-dev
	$(call install,$*)
	@touch $@
