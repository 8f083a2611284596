# Needs Python 3.11 or newer, with venv and pip. Everything else goes into a virtual environment of its own.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Files that mark what $(VENV) holds: what runs photonpano, or all that the tests need as well.
RUNS := $(VENV)/runs
COMPLETE := $(VENV)/complete
STEP := @printf '\n== %s\n'

# The tests start Python hundreds of times: each must find its modules compiled, whatever the environment says.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help install test check demo dist docs paper bench clean
.DELETE_ON_ERROR:

help:
	@echo 'make demo     simulate a small capture, make its panorama, and score it'
	@echo 'make test     run all checks, and the tests except those of documentation and benchmarks'
	@echo 'make check    run all checks and all tests, as continuous integration does'
	@echo 'make dist     build and check the wheel and the source distribution, in dist'
	@echo 'make docs     build the documentation as a site'
	@echo 'make paper    make the figures of the paper, which takes long'
	@echo 'make bench    run the benchmarks, which takes long'
	@echo 'make install  make the virtual environment $(VENV), with all that tests and benchmarks need'
	@echo 'make clean    remove the virtual environment, the demo, the site and caches'

install: $(COMPLETE)

$(COMPLETE): EXTRAS := [dev]
$(RUNS) $(COMPLETE): pyproject.toml constraints.txt
	$(STEP) 'installing into $(VENV)'
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "error: photonpano needs Python 3.11 or newer; try: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.$(EXTRAS)'
	@touch $(RUNS) $@

check: TESTS := -m '' tests tests/benchmarks/checks
check: test

test: $(COMPLETE)
	$(STEP) 'ruff check'
	@$(BIN)/ruff check .
	$(STEP) 'ruff format'
	@$(BIN)/ruff format --check .
	$(STEP) 'import-linter'
	@$(BIN)/lint-imports --no-logo
	$(STEP) 'mypy, and pytest as soon as the loops over pixels are compiled'
	@$(BIN)/mypy & types=$$!; $(BIN)/photonpano warm-up && $(BIN)/pytest -n auto --dist worksteal --durations 40 $(TESTS); status=$$?; \
	wait $$types || { echo 'error: mypy found what it printed before the results of pytest'; status=1; }; \
	$(if $(TESTS),,printf '\nmake check runs the code of the documentation, the examples and the checks of the benchmarks, too\n';) exit $$status

demo: $(RUNS)
	$(STEP) 'simulating a capture, making its panorama, and scoring it (a minute or two)'
	@$(BIN)/photonpano demo demo --overwrite

dist: $(COMPLETE)
	$(STEP) 'the source distribution, and the wheel from it'
	@rm -rf dist
	@$(BIN)/python -m build --no-isolation
	@$(BIN)/python -m twine check --strict dist/*

docs: $(COMPLETE)
	$(STEP) 'the site'
	@# fresh, as a page that was read before is not read again, and its dead links are not found
	@$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --jobs auto --fresh-env -c docs/site -d site/pages . site/html
	$(STEP) 'done; look at $(CURDIR)/site/html/index.html'

paper: $(COMPLETE)
	$(STEP) 'the figures of the paper, from simulated captures'
	@$(BIN)/python docs/make_paper.py
	$(STEP) 'done; look at docs/paper/README.md'

bench: $(COMPLETE)
	$(STEP) 'benchmarks'
	@$(BIN)/pytest tests/benchmarks -s --timeout 0

clean:
	rm -rf $(VENV) demo site dist .*_cache .benchmarks .hypothesis
	find framework plugins tests -name __pycache__ -prune -exec rm -rf {} +
