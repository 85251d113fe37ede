# The commands of this project. PYTHON may name another interpreter (3.11 or newer).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# A processor without AVX-512, as numba is told of it.
NARROW := +sse,+sse2,+sse3,+ssse3,+sse4.1,+sse4.2,+avx,+avx2,+fma,+bmi,+bmi2,+popcnt,+lzcnt,+cmov,+cx8,+cx16,+f16c,+fxsr,+mmx,+movbe,+sahf,+xsave

.PHONY: install demo test test-narrow lint bench clean

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

test: lint                             ## style, types and the whole suite
	$(BIN)/python -m pytest $(PYTEST)

test-narrow: $(VENV)/.installed-test   ## the kernels compiled for an x86-64 processor without AVX-512
	NUMBA_CPU_NAME=haswell NUMBA_CPU_FEATURES="$(NARROW)" NUMBA_CACHE_DIR=build/narrow \
	  $(BIN)/python -m pytest tests/processing/correlation/test_single_precision_kernel.py

bench: install                         ## speed and memory
	$(BIN)/ringdic bench

clean:
	rm -rf $(VENV) build dist controller/ringdic_controller/web/static

.PHONY: docs
$(VENV)/.installed-docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet -e ".[pc,docs]"
	touch $@

docs: $(VENV)/.installed-docs          ## the documentation as a site under build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --config-file docs/mkdocs.yml
