# Two commands do all the set-up: `make demo` runs the main job, `make test` the tests.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
RUNS   := $(VENV)/.runs
PIP    := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --editable # Modules are compiled when first imported.

.DEFAULT_GOAL := help
.PHONY: help demo test test-long quick nightly lint bench bench-large bench-events bench-sweeps study docs clean

# NSMODEL_SHORT=1 makes the long ones short: a scene or two, once. They write into results/ alone.
PAGES := hypotheses events hidden inputs $(if $(NSMODEL_SHORT),,codegen derivatives orders stability crowd study sweeps)
SCENES := cases/circuits/diode_bridge.py $(if $(NSMODEL_SHORT),,cases/crowds/crowd_room.py cases/mechanics/friction_oscillator.py)

SITE := $(if $(NSMODEL_SHORT),results/)

help: ## show this list
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1|/' | column -t -s '|'

$(RUNS): pyproject.toml # What runs models need.
	$(PYTHON) -m venv $(VENV)
	$(PIP) .
	touch $@

$(STAMP): $(RUNS) # And what tests, linters and pages need.
	$(PIP) '.[dev]'
	touch $@

demo: $(RUNS) ## set up what runs need, run a rectifier, a crowd and a friction oscillator, pictures into results/: a minute
	$(BIN)/nsmodel run $(SCENES) --plot --out results --force

test: $(STAMP) ## set up and run the tests, of random models one in twenty-five: nine minutes on two cores
	$(BIN)/python -m pytest -n auto --dist worksteal

test-long: $(STAMP) ## set up and run all tests, long ones and all random models: two hours on two cores
	NSMODEL_FUZZ=400 $(BIN)/python -m pytest -n auto --dist worksteal

quick: $(STAMP) ## set up and run the tests that take seconds: under a minute on two cores
	$(BIN)/python -m pytest -n auto --dist worksteal -m fast

nightly: $(STAMP) ## set up and search for refused steps, wrong answers and forged certificates: 2000 random models a class, hours
	mkdir -p results
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search --models $(if $(NSMODEL_SHORT),1,2000) --compiled 10 --json results/search.json
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search.oracle --models $(if $(NSMODEL_SHORT),1,300) --json results/oracle.json
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search.contacts --problems $(if $(NSMODEL_SHORT),2,1000)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search.files $(if $(NSMODEL_SHORT),--kinds run --count 2,--count 2000) --json results/files.json
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search.hidden --count $(if $(NSMODEL_SHORT),2,2000) --json results/hidden.json
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search.events --models $(if $(NSMODEL_SHORT),1 --t-end 1,300) --json results/events.jsonl
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search.forgeries --attempts $(if $(NSMODEL_SHORT),3,100000 --rounds 10)
	$(if $(NSMODEL_SHORT),,OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search.forgeries --mutants --attempts 10000)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search.constants nsmodel/$(if $(NSMODEL_SHORT),solvers/step_doubling.py,derivatives)
	$(if $(NSMODEL_SHORT),,OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search.constants nsmodel/solvers nsmodel/event_driven nsmodel/simulation)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.search.golden $(if $(NSMODEL_SHORT),--class lure)

lint: $(STAMP) ## ruff, types, which package imports which, and the limits of the structure
	$(BIN)/ruff check nsmodel cases tests docs/conf.py docs/_ext docs/_inventories docs/figures
	$(BIN)/ruff format --check nsmodel cases tests docs/conf.py docs/_ext docs/_inventories docs/figures
	$(BIN)/pyrefly check
	$(BIN)/lint-imports --no-cache --no-logo
	$(BIN)/python tests/house_check.py

bench: $(STAMP) ## time the steppers beside a plain Python loop (and the peers, where installed), and checks of long chains
	$(BIN)/python tests/bench/run.py
	$(BIN)/python tests/bench/checks.py

bench-large: $(STAMP) ## crowds of up to 20 000 and chains of up to 10 000 (with the peers, where installed); a quarter of an hour
	$(BIN)/python tests/bench/large.py

bench-events: $(STAMP) ## event-driven runs beside a prototype in C++, CVODE, heyoka and SciPy (where installed); an hour and a half
	$(BIN)/python tests/bench/event_driven.py
	$(BIN)/python tests/bench/overhead.py
	$(BIN)/python tests/bench/hidden.py

bench-sweeps: $(STAMP) ## sweeps beside plain C, NumPy, LSODA (and diffrax, where installed), a million cells; five minutes
	$(BIN)/python tests/bench/sweeps.py

study: $(STAMP) ## make the figures and tables of docs/ anew (with the peers, where installed)
	$(if $(NSMODEL_SHORT),mkdir -p results && rm -rf results/docs && cp -r docs results/docs)
	for page in $(PAGES); do $(BIN)/python $(if $(NSMODEL_SHORT),results/)docs/figures/$$page.py || exit 1; done

docs: $(STAMP) ## make the site into site/: pages, the gallery of all cases, the reference; minutes the first time
	$(if $(NSMODEL_SHORT),mkdir -p results && rm -rf results/docs && cp -r docs results/docs)
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --doctree-dir $(SITE)build/docs/doctrees $(SITE)docs $(SITE)site

clean: ## remove the environment, caches and results
	rm -rf $(VENV) results site docs/gallery build dist .pytest_cache .ruff_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
