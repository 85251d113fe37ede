# The commands of this project. PYTHON may name another interpreter (3.11 or newer).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# A processor without AVX-512, as numba is told of it.
NARROW := +sse,+sse2,+sse3,+ssse3,+sse4.1,+sse4.2,+avx,+avx2,+fma,+bmi,+bmi2,+popcnt,+lzcnt,+cmov,+cx8,+cx16,+f16c,+fxsr,+mmx,+movbe,+sahf,+xsave

# The oldest numba that pyproject.toml allows.
OLDEST := $(shell sed -n 's/.*"numba>=\([0-9.]*\),.*/\1/p' pyproject.toml | head -1)

# Fails unless the bundled page lies in the installed package.
HAS_PAGE := from importlib.resources import files; files('ringdic_controller').joinpath('web/static/index.html').read_text()

.PHONY: install demo test fuzz test-narrow test-numba test-dist lint audit bench dist clean

$(VENV)/.installed: pyproject.toml
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -e ".[pc]"
	touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet -e ".[pc,test]"
	touch $@

$(VENV)/.installed-dist: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet -e ".[pc,dist]"
	touch $@

install: $(VENV)/.installed            ## the command .venv/bin/ringdic, and its kernels compiled
	$(BIN)/python -m ringdic.jobs.compiling

demo: install                          ## a simulated 12-node rig, captured, processed, shown
	$(BIN)/ringdic demo $(DEMO)

lint: $(VENV)/.installed-test          ## style, types and the walls between the packages
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: $(VENV)/.installed-test          ## style, types and the whole suite; the kernels are compiled meanwhile
	$(BIN)/python -m ringdic.jobs.compiling & $(MAKE) --no-print-directory lint && wait && \
	  $(BIN)/python -m pytest -n 2 --dist loadfile $(PYTEST)

fuzz: $(VENV)/.installed-test          ## 100 times as many hostile requests, messages and files as in the suite
	RINGDIC_FUZZ=$${RINGDIC_FUZZ-100} $(BIN)/python -m pytest tests/fuzz

test-narrow: $(VENV)/.installed-test   ## the kernels compiled for an x86-64 processor without AVX-512
	NUMBA_CPU_NAME=haswell NUMBA_CPU_FEATURES="$(NARROW)" NUMBA_CACHE_DIR=build/narrow \
	  $(BIN)/python -m pytest tests/processing/correlation/test_single_precision_kernel.py

test-numba:                            ## the kernels as compiled by the oldest numba that is allowed
	test -d build/numba || $(PYTHON) -m venv build/numba
	RINGDIC_SKIP_PAGE=1 build/numba/bin/python -m pip install --quiet ".[processing]" "numba==$(OLDEST).*" pytest
	cd build && numba/bin/python -P -m pytest --noconftest ../tests/processing/correlation/test_single_precision_kernel.py

audit: $(VENV)/.installed              ## known weaknesses of the packages that are installed; asks PyPI
	test -d build/audit || $(PYTHON) -m venv build/audit
	build/audit/bin/python -m pip install --quiet pip-audit
	$(BIN)/python -m pip freeze --exclude-editable > build/audit/installed.txt
	build/audit/bin/pip-audit --no-deps --disable-pip --strict -r build/audit/installed.txt

bench: install                         ## speed and memory
	$(BIN)/ringdic bench

dist: $(VENV)/.installed-dist          ## sdist, and from it the wheel with the page, checked as an index would
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*

test-dist: dist                        ## the wheel alone, away from the tree, has the page and runs the demo
	rm -rf build/away && $(PYTHON) -m venv build/away
	build/away/bin/python -m pip install --quiet "$$(echo dist/*.whl)[pc]"
	cd build/away && bin/python -P -c "$(HAS_PAGE)" && \
	  bin/ringdic demo --cameras 6 --scale 0.2 --steps 1 --no-serve --out demo

clean:
	rm -rf $(VENV) build dist controller/ringdic_controller/web/static

.PHONY: docs
$(VENV)/.installed-docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet -e ".[pc,docs]"
	touch $@

docs: $(VENV)/.installed-docs          ## the documentation as a site under build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --config-file docs/mkdocs.yml
