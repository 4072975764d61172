# `make demo` and `make test` work on a fresh machine: each first creates the virtual environment .venv.

PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin
INSTALL = $(RUN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable

.PHONY: demo demo-short test test-slow test-hard lint results clean test-nerfstudio package test-pythons

# The first target installs what the package needs to run, the second adds what the tests need.
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

# The tensors of the tests are small, so a second thread slows them down, especially on a busy machine. Two
# processes are used instead. Each takes whole modules, so that the fixtures of a module are made once.
test: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(RUN)/python -m pytest -m "not slow and not hard" -n 2 --dist loadscope

test-slow: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(RUN)/python -m pytest -m slow

# Thousands of damaged files, killed commands and planted faults (docs/stability.md); prints their counts.
test-hard: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(RUN)/python -m pytest tests/hard_cases -m hard -n 2 --dist worksteal

# Nerfstudio pins a different OpenCV package, so its tests have a separate environment. The .pth file lets the
# ns-* commands start in it by hand (tests_nerfstudio/cpu_torchvision.py).
NERFSTUDIO := .venv-nerfstudio
NERFSTUDIO_PINS := tests_nerfstudio/requirements.txt tests_nerfstudio/requirements-no-deps.txt

$(NERFSTUDIO)/.installed: pyproject.toml $(NERFSTUDIO_PINS)
	test -x $(NERFSTUDIO)/bin/python || $(PYTHON) -m venv $(NERFSTUDIO)
	$(NERFSTUDIO)/bin/python -m pip install --quiet --disable-pip-version-check -r tests_nerfstudio/requirements.txt
	$(NERFSTUDIO)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps \
		-r tests_nerfstudio/requirements-no-deps.txt --editable .
	printf '%s\nimport tests_nerfstudio.cpu_torchvision\n' '$(CURDIR)' > "$$($(NERFSTUDIO)/bin/python -c \
		'import sysconfig; print(sysconfig.get_path("purelib"))')/neilfpp_tests.pth"
	touch $@

test-nerfstudio: $(NERFSTUDIO)/.installed
	OMP_NUM_THREADS=1 $(NERFSTUDIO)/bin/python -m pytest tests_nerfstudio -m "not slow" -n 2 --dist loadscope

# Builds the wheel and the source distribution, and runs the command of the wheel in an empty environment.
package:
	$(PYTHON) scripts/check_package.py

# Resolves the pins of constraints.txt and starts the command on every installed Python from 3.10.
test-pythons:
	$(PYTHON) scripts/check_pythons.py

lint: $(VENV)/.installed-dev
	$(RUN)/ruff check .

# make results CAPTURES="DIR DIR" [OPTIONS="--save NAME"]: measure the captures and write the tables of docs/.
# Without CAPTURES, only write the tables.
results: $(VENV)/.installed
	$(if $(CAPTURES),$(RUN)/python -m benchmarks.results $(CAPTURES) $(OPTIONS))
	$(RUN)/python -m benchmarks.tables

clean:
	rm -rf $(VENV) $(NERFSTUDIO) build dist demo-run
