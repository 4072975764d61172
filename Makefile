# `make demo` and `make test` are all that a fresh machine needs; each makes its virtual environment first.

PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin
INSTALL = $(RUN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable

.PHONY: demo demo-short test test-slow test-hard lint results clean test-nerfstudio package test-pythons

# What running needs, and nothing for tests; the second adds that.
$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(RUN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(INSTALL) '.[dev]'
	touch $@

demo: $(VENV)/.installed
	$(RUN)/neilfpp demo

demo-short: $(VENV)/.installed
	$(RUN)/neilfpp demo --short --out build/demo-short

# The tensors of the tests are small: a second thread costs more than it brings, many times more on a busy machine.
# Two processes instead, each with whole modules, so that what a module prepares is prepared once.
test: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(RUN)/python -m pytest -m "not slow and not hard" -n 2 --dist loadscope

test-slow: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(RUN)/python -m pytest -m slow

# Thousands of damaged files, commands that are killed, planted faults: docs/stability.md. Ends with their counts.
test-hard: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(RUN)/python -m pytest tests/hard_cases -m hard -n 2 --dist load

# Nerfstudio pins another OpenCV, so it has an environment of its own.
NERFSTUDIO := .venv-nerfstudio
NERFSTUDIO_PINS := tests_nerfstudio/requirements.txt tests_nerfstudio/requirements-no-deps.txt

$(NERFSTUDIO)/.installed: pyproject.toml $(NERFSTUDIO_PINS)
	test -x $(NERFSTUDIO)/bin/python || $(PYTHON) -m venv $(NERFSTUDIO)
	$(NERFSTUDIO)/bin/python -m pip install --quiet --disable-pip-version-check -r tests_nerfstudio/requirements.txt
	$(NERFSTUDIO)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps \
		-r tests_nerfstudio/requirements-no-deps.txt --editable .
	touch $@

test-nerfstudio: $(NERFSTUDIO)/.installed
	OMP_NUM_THREADS=1 $(NERFSTUDIO)/bin/python -m pytest tests_nerfstudio -m "not slow"

# Wheel and source distribution, and the wheel's command in an empty environment.
package:
	$(PYTHON) scripts/check_package.py

# The pins of constraints.txt and the start of the command, on every Python from 3.10 that is on the machine.
test-pythons:
	$(PYTHON) scripts/check_pythons.py

lint: $(VENV)/.installed-dev
	$(RUN)/ruff check .

results: $(VENV)/.installed  ## make results CAPTURES="DIR DIR" [OPTIONS="--save NAME"]; none: only the tables
	$(if $(CAPTURES),$(RUN)/python -m benchmarks.results $(CAPTURES) $(OPTIONS))
	$(RUN)/python -m benchmarks.tables

clean:
	rm -rf $(VENV) $(NERFSTUDIO) build dist demo-run
