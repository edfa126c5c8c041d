# Two commands do all the set-up: `make demo` runs the main job, `make test` the tests.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help demo test lint bench bench-large study clean

help: ## show this list
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1|/' | column -t -s '|'

$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

demo: $(STAMP) ## set up, run a rectifier, a crowd and a friction oscillator, draw pictures into results/
	$(BIN)/nsmodel run cases/diode_bridge.py cases/crowd_room.py cases/friction_oscillator.py --plot --out results

test: $(STAMP) ## set up and run the tests
	$(BIN)/python -m pytest -n auto --dist loadfile

lint: $(STAMP) ## ruff and pyright
	$(BIN)/ruff check nsmodel cases tests docs/figures
	$(BIN)/ruff format --check nsmodel cases tests docs/figures
	$(BIN)/pyright

bench: $(STAMP) ## time the steppers beside a plain Python loop (and the peers, where installed)
	$(BIN)/python tests/bench/run.py

bench-large: $(STAMP) ## crowds of up to 20 000 and chains of up to 10 000 (with the peers, where installed); a quarter of an hour
	$(BIN)/python tests/bench/large.py

study: $(STAMP) ## make the figures and tables of docs/ anew (with the peers, where installed)
	for page in hypotheses codegen orders stability crowd study; do $(BIN)/python docs/figures/$$page.py || exit 1; done

clean: ## remove the environment, caches and results
	rm -rf $(VENV) results build dist .pytest_cache .ruff_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
