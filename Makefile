# `make demo` and `make test` are all that a fresh machine needs; each makes its own virtual environment first.

PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin

.PHONY: demo demo-short test test-slow lint results clean

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(RUN)/python || $(PYTHON) -m venv $(VENV)
	$(RUN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: $(VENV)/.installed
	$(RUN)/neilfpp demo

demo-short: $(VENV)/.installed
	$(RUN)/neilfpp demo --short --out build/demo-short

test: $(VENV)/.installed
	$(RUN)/python -m pytest -m "not slow"

test-slow: $(VENV)/.installed
	$(RUN)/python -m pytest -m slow

lint: $(VENV)/.installed
	$(RUN)/ruff check .

clean:
	rm -rf $(VENV) build demo-run
