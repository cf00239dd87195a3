# make demo: set up and run the main job on the CPU; make test: set up and run lint, types and all tests;
# make unit, make slow, make validation: one tier of the tests;
# make docs: build the site, build/docs/index.html; make docs-links: ask whether what it links to elsewhere is there;
# make docs-browser: look at every page of it with Chromium;
# make sanitize: check the C++ engine with sanitizers; make fuzz: an hour of hostile input, MINUTES=10 for a part of it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: setup demo test lint types tests unit validation slow docs docs-links docs-browser sanitize fuzz clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml $(shell find cpp -type f)
	@echo 'Installing Cortado and what its tests need in $(VENV), once: some minutes.'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@$(BIN)/python -c 'import cortado.reference._engine' 2>/dev/null || \
		echo 'Installed without the reference engine (C++): CONTRIBUTING.md says how to see why.'
	touch $@

$(VENV)/.demo: pyproject.toml $(shell find cpp -type f)
	@test -e $(VENV)/.ready || echo 'Installing Cortado, its pictures and its viewer in $(VENV), once: a minute or two.'
	@test -e $(VENV)/.ready || $(PYTHON) -m venv $(VENV)
	@test -e $(VENV)/.ready || $(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[pictures,view]'
	touch $@

demo: $(VENV)/.demo
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

$(VENV)/.docs: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	touch $@

docs: $(VENV)/.docs
	$(BIN)/sphinx-build --fresh-env --write-all --fail-on-warning --keep-going --quiet docs build/docs
	@echo 'build/docs/index.html'

docs-links: $(VENV)/.docs
	$(BIN)/sphinx-build --builder linkcheck --quiet docs build/docs-links

docs-browser: docs
	$(BIN)/python docs/site/look.py build/docs

sanitize: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check cmeel-eigen
	cmake -S cpp -B build/sanitize -DCORTADO_SANITIZE=ON -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python
	cmake --build build/sanitize --parallel
	build/sanitize/check_engine

fuzz: setup
	$(BIN)/python -m fuzz $(if $(MINUTES),--minutes $(MINUTES)) $(ARGS)

clean:
	rm -rf $(VENV) runs build dist
