# Everything runs in .venv, which the first target that needs it creates.
PYTHON ?= python3
VENV ?= .venv
PYTEST_ARGS ?= -n auto
ARGS ?=
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help install fit smoke test test-slow test-all fuzz physics check lint types contracts format-page format bench notebooks docs links clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  %-12s %s\n", $$1, $$2}'

install: $(INSTALLED) ## create .venv with the tested versions (again when pyproject.toml or constraints.txt change)

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; name one with: make PYTHON=/path/to/python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev,docs]'
	@touch $@

fit: install ## momentum ablation of the paper: generates data, trains, evaluates, reports (ARGS="size=tiny" and the like)
	$(BIN)/python -m gpe_pl.fit experiment=ablation_momentum $(ARGS)

smoke: install ## a miniature model from data to report, in a folder that is deleted afterwards
	work=$$(mktemp -d) && trap 'rm -rf "$$work"' EXIT && \
		$(BIN)/python -m gpe_pl.fit experiment=smoke paths.data="$$work/data" paths.runs="$$work/runs" $(ARGS)

test: install ## fast tests on all cores (PYTEST_ARGS="-x" and the like for one)
	$(BIN)/python -m pytest $(PYTEST_ARGS)

test-slow: install ## slower tests: whole commands, analytic physics, notebooks
	$(BIN)/python -m pytest -m "(slow or notebook) and not long" $(PYTEST_ARGS)

test-all: install ## all tests, also those that take minutes each
	$(BIN)/python -m pytest -m "" $(PYTEST_ARGS)

fuzz: install ## random states, scenes, graphs and files, thousands of each and others every time
	$(BIN)/python -m pytest tests/fuzz tests/unit/test_integrators.py --hypothesis-profile=fuzz $(ARGS) $(PYTEST_ARGS)

physics: install ## solvers against formulas and experiments; writes docs/results/physics.md and convergence.md
	$(BIN)/python -m pytest tests/physics -m "not notebook" --physics-page docs/results/physics.md $(PYTEST_ARGS) -n 0

check: lint types contracts format-page ## everything that needs no run: style, types, import contracts, generated pages

lint: install ## style and formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install ## static types of gpe_pl and tests
	$(BIN)/mypy

contracts: install ## which module may import which
	$(BIN)/lint-imports --no-logo

format-page: install ## data/README.md describes the store as it is
	$(BIN)/python -m gpe_pl.data.validate --format-page | diff -u data/README.md - || \
		{ echo "run: python -m gpe_pl.data.validate --format-page > data/README.md"; exit 1; }

format: install ## rewrite the code in the project's style, and the generated pages
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/python -m gpe_pl.data.validate --format-page > data/README.md

bench: install ## speed of the message-passing layers and of the solvers
	$(BIN)/python -m gpe_pl.benchmark suite=speed $(ARGS)
	$(BIN)/python -m gpe_pl.benchmark suite=solvers $(ARGS)

notebooks: install ## execute every notebook from start to end
	$(BIN)/python -m pytest -m notebook $(PYTEST_ARGS)

docs: install ## user guide and reference in docs/_build/html; warnings and broken links within are errors
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going --jobs auto docs docs/_build/html
	$(BIN)/python docs/check_links.py docs/_build/html

links: install ## links of the documentation that lead elsewhere (needs the network)
	$(BIN)/sphinx-build --quiet -b linkcheck docs docs/_build/linkcheck

clean: ## remove caches and build products; data sets, runs and .venv stay
	rm -rf build dist docs/_build docs/reference/generated *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find gpe_pl tests -name __pycache__ -type d -prune -exec rm -rf {} +
