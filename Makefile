# make demo: set up and run the main job on the CPU; make test: set up and run lint, types and all tests;
# make unit, make slow, make validation: one tier of the tests;
# make sanitize: check the C++ engine with sanitizers; make fuzz: an hour of hostile input, MINUTES=10 for a part of it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: setup demo test lint types tests unit validation slow sanitize fuzz clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml $(shell find cpp -type f)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@$(BIN)/python -c 'import cortado.reference._engine' 2>/dev/null || \
		echo 'Installed without the reference engine (C++): CONTRIBUTING.md says how to see why.'
	touch $@

demo: setup
	$(BIN)/cortado optimise examples/latte_art_small.toml --out runs/demo --overwrite

test: lint types tests

lint: setup
	$(BIN)/ruff check .

types: setup
	$(BIN)/mypy

tests: setup
	$(BIN)/pytest

unit: setup
	$(BIN)/pytest -m 'not slow and not validation'

validation: setup
	$(BIN)/pytest -m validation

slow: setup
	$(BIN)/pytest -m slow

sanitize: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check cmeel-eigen
	cmake -S cpp -B build/sanitize -DCORTADO_SANITIZE=ON -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python
	cmake --build build/sanitize --parallel
	build/sanitize/check_engine

fuzz: setup
	$(BIN)/python -m fuzz $(if $(MINUTES),--minutes $(MINUTES)) $(ARGS)

clean:
	rm -rf $(VENV) runs build dist
