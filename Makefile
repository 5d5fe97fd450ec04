# All that a fresh machine needs: make, Python 3.11 or later and pip.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python
ARGS ?=

.PHONY: help install heads datasize test stress docs format lock
.DEFAULT_GOAL := help

help: ## this list
	@sed -n 's/^\([a-z]*\):.*## /\1	/p' Makefile

$(VENV)/.installed: requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet --requirement requirements.lock
	$(RUN) -m pip install --quiet --no-deps --editable .
	touch $@

install: $(VENV)/.installed ## install the program and its tools into .venv

heads: $(VENV)/.installed ## the main job: effect of different heads, ends in reports/heads.pdf
	$(RUN) -m study.sweep heads $(ARGS)

datasize: $(VENV)/.installed ## effect of dataset size, ends in reports/datasize.pdf
	$(RUN) -m study.sweep datasize $(ARGS)

test: $(VENV)/.installed ## lint, types and the tests
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports --no-logo
	$(RUN) -m pytest -m "not stress" -n 2 --dist loadscope --no-loadscope-reorder $(ARGS)

stress: $(VENV)/.installed ## the long tests: kills, clusters, a browser, other machines
	$(RUN) -m pytest -m stress $(ARGS)

docs: $(VENV)/.installed ## the documentation as a site, in site/
	$(VENV)/bin/mkdocs build --strict

format: $(VENV)/.installed ## put the code into its one form
	$(VENV)/bin/ruff format .
	$(VENV)/bin/ruff check --fix .

lock: $(VENV)/.installed ## resolve the dependencies anew; torch stays where the lock has it
	$(VENV)/bin/pip-compile --quiet --strip-extras --no-annotate --no-emit-index-url --no-emit-find-links \
		--no-emit-trusted-host --extra dev --upgrade --upgrade-package torch==2.13.0 \
		--output-file requirements.lock pyproject.toml
	sed -i 's/^\(torch==[0-9.]*\)+.*/\1/' requirements.lock  # the local build's tag is not on any index
