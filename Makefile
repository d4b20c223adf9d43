# Everything runs in .venv, which `make` sets up from pyproject.toml alone.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PLANNER ?= checkpoints/highlevel/lift-box
OUTPUT ?= reports/demo
# A box of 1.7 kg on the floor; any other number is another box
EPISODE ?= 4

.PHONY: setup demo test format clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	# torch first and by exact version, so that a local CPU build of it is used where there is one
	$(BIN)/python -m pip install --quiet torch==2.13.0
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

demo: setup
	$(BIN)/run-demo --task lift_box --planner $(PLANNER) --episode $(EPISODE) --output $(OUTPUT)

test: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy
	$(BIN)/pytest

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV)
