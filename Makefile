# Start with `make run` and `make test`. Each target sets up .venv first if it is outdated.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.up-to-date

.PHONY: setup franka-sim run up test test-all campaign grasping two-arms conveyor force-motions force-payload containers check audit bench bench-check chaos fuzz soak docs docs-site deploy clean

setup: $(STAMP)

# Optional extras, as in `make setup EXTRAS=ur,franka`; later calls remember them.
EXTRAS := $(if $(EXTRAS),$(EXTRAS),$(shell cat $(VENV)/.extras 2>/dev/null))
COMMA := ,
$(shell mkdir -p $(VENV); [ "$$(cat $(VENV)/.extras 2>/dev/null)" = "$(EXTRAS)" ] || echo "$(EXTRAS)" > $(VENV)/.extras)

# Sources of the planning kernel: it is compiled again when they change.
KERNEL := setup.py common/planning/kernel/build.py $(wildcard common/planning/kernel/src/*)

$(STAMP): pyproject.toml constraints.txt $(KERNEL) $(wildcard $(VENV)/.extras)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "zencell needs Python 3.11 or newer: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev$(addprefix $(COMMA),$(EXTRAS))]'
	@touch $@

# A protocol double for tests/drivers/test_franka.py and tests/cells/test_real_arms.py, with another numpy than ours.
franka-sim: .venv-franka-sim/.up-to-date
.venv-franka-sim/.up-to-date:
	$(PYTHON) -m venv .venv-franka-sim
	.venv-franka-sim/bin/python -m pip install --quiet --disable-pip-version-check franka-sim==1.1.7
	@touch $@

run: setup  ## clear the table into the box, print a summary
	$(BIN)/zencell run panda

up: setup  ## start the cell and stay until Ctrl-C
	$(BIN)/zencell up panda

# Tests start hundreds of processes, which would all compile the sources again without a bytecode cache.
test test-all campaign: export PYTHONDONTWRITEBYTECODE =

# Four workers also on two cores: a third of the time, tests wait for processes.
WORKERS := -n 4 --dist loadfile --no-loadscope-reorder

test: setup
	$(BIN)/python -m pytest -q $(WORKERS)

test-all: setup  ## `make test`, and what takes long
	$(BIN)/python -m pytest -q $(WORKERS) -m "not container and not alone and not browser and not campaign"
	$(BIN)/python -m pytest -q -m "browser and not container and not alone and not campaign"  # cells with Chromium: one at a time
	$(BIN)/python -m pytest -q -m "alone and not campaign" || [ $$? = 5 ]  # exit code 5: no driver is installed

campaign: setup  ## tests that repeat over hundreds of seeds, or for minutes
	$(BIN)/python -m pytest -q $(WORKERS) -m "campaign and not alone"
	$(BIN)/python -m pytest -q -m "campaign and alone"

two-arms: setup  ## two arms cross over one table: contacts by an independent judge, makespan, time of proofs; half an hour
	$(BIN)/python -m benchmarks.two_arms tasks --count 200 --jobs 2
	$(BIN)/python -m benchmarks.two_arms cell --count 3
	$(BIN)/python -m benchmarks.two_arms proofs --count 100
	$(BIN)/python -m benchmarks.two_arms tasks --simulator mujoco --count 20 --jobs 2  # extra `physics`

# Resumable: seeds that are in build/grasping.jsonl are not run again. Needs the extra: make setup EXTRAS=physics.
grasping: setup  ## grasps of unseen objects by the complete sorting cell, hours; seeds as published in docs/grasping.md
	@mkdir -p build
	$(BIN)/python -m benchmarks.grasping --singles 300 --force 20 --jobs 2 --json build/grasping.jsonl
	$(BIN)/python -m benchmarks.grasping --singles 300 --force 40 --jobs 2 --json build/grasping.jsonl
	$(BIN)/python -m benchmarks.grasping --heaps 30 --force 40 --jobs 2 --json build/grasping.jsonl
	$(BIN)/python -m benchmarks.grasping --latency 10 --force 40 --json build/grasping.jsonl

conveyor: setup  ## picks from a moving belt by images, kinematic and with physics, half an hour; needs EXTRAS=physics
	$(BIN)/python -m benchmarks.conveyor --picks 50 --jobs 2
	$(BIN)/python -m benchmarks.conveyor --picks 50 --jobs 2 --simulator mujoco

force-motions: setup  ## 100 contacts and 100 insertions in physics, half an hour; resumable. Needs the extra: make setup EXTRAS=physics
	@mkdir -p build
	$(BIN)/python -m benchmarks.force_motions --contacts 100 --insertions 100 --json build/force_motions.jsonl

force-payload: setup  ## identification of payloads in physics, minutes; needs the extra: make setup EXTRAS=physics
	$(BIN)/python -m benchmarks.force_payload

containers: setup  ## build the image and run a cell in containers; needs a container engine
	$(BIN)/python -m pytest -q -m container tests/deploy

check: setup
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	.ci/dialect

audit: setup  ## known vulnerabilities of the dependencies, where the database can be reached
	.ci/audit $(BIN)

bench: setup  ## every published figure, one module each
	@for script in $$(grep -l __main__ benchmarks/*.py); do module=benchmarks.$$(basename $$script .py); \
	  echo "== $$module"; $(BIN)/python -m $$module || exit 1; done

bench-check: setup  ## fail if planning lost more than a fifth of its lead; compares ratios, independent of the machine
	$(BIN)/python -m benchmarks.ratios

chaos: setup  ## fifty runs with injected faults: all must end DONE
	$(BIN)/python -m benchmarks.chaos

fuzz: setup  ## a million mutated payloads through every message class, and thousands into both cells
	$(BIN)/python -m benchmarks.fuzz $(ARGS)

soak: setup  ## thirty minutes with a slow and a stuck subscriber: nothing may grow or get lost
	$(BIN)/python -m benchmarks.soak

docs: setup  ## regenerate tables and pages of docs/
	$(BIN)/python -m docs.generate

# The site needs an extra.
WITH_SITE := $(if $(filter site,$(subst $(COMMA), ,$(EXTRAS))),$(EXTRAS),$(EXTRAS:%=%$(COMMA))site)

docs-site:  ## build docs/ as a site with search in build/site; broken links are errors
	@$(MAKE) --no-print-directory setup EXTRAS=$(WITH_SITE)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict  # --quiet would hide warnings
	@echo "to read it: $(PYTHON) -m http.server --bind 127.0.0.1 -d build/site"

deploy: setup  ## regenerate the compose files and Kubernetes manifests
	$(BIN)/python -m deploy.generate

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis common/planning/kernel/*.so
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
