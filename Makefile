# make demo: set up and run the main job on the CPU; make test: set up and run lint, types and tests;
# make test-all: with all combinations of what tests vary, and what takes longest;
# make unit, make slow, make validation: one tier of the tests;
# make docs: build the site, build/docs/index.html; make docs-links: ask whether what it links to elsewhere is there;
# make docs-browser: look at every page of it with Chromium;
# make sanitize: check the C++ engine with sanitizers; make fuzz: an hour of hostile input, MINUTES=10 for a part of it.
# All of it is in tasks.py, which runs without make too: python -m tasks test.
PYTHON ?= python3
TASKS := setup demo test test-all lint types tests tests-all unit validation slow docs docs-links docs-browser sanitize

.PHONY: $(TASKS) fuzz clean

$(TASKS):
	@$(PYTHON) -m tasks $@

fuzz:
	@$(PYTHON) -m tasks fuzz $(if $(MINUTES),--minutes $(MINUTES)) $(ARGS)

clean:
	rm -rf .venv runs build dist
