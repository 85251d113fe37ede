# The commands of this project. PYTHON may name another interpreter (3.11 or newer).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install demo test lint bench clean

$(VENV)/.installed: pyproject.toml
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -e ".[pc]"
	touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet -e ".[pc,test]"
	touch $@

install: $(VENV)/.installed            ## the command .venv/bin/ringdic

demo: install                          ## a simulated 12-node rig, captured, processed, shown
	$(BIN)/ringdic demo $(DEMO)

lint: $(VENV)/.installed-test          ## style, types and the walls between the packages
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: lint                             ## everything that CI runs
	$(BIN)/python -m pytest $(PYTEST)

bench: install                         ## speed and memory
	$(BIN)/ringdic bench

clean:
	rm -rf $(VENV) build dist controller/web/static
