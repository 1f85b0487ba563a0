# make run    set up, then learn, fly, verify and film the default segment
# make test   set up, then run the tests (make test-slow: the learning tests too)
# make lint   set up, then linters and type checker
# make docs   set up, then the documentation as a site, in site/index.html
# make package  set up, then build, install into an empty environment, and run there
# make reproduce-quick   set up, then every table and figure of the paper in small

PYTHON ?= python3
BIN := .venv/bin

.PHONY: run test test-slow lint docs package reproduce-quick setup

run: setup
	$(BIN)/python -m train.segment --resume

test: setup
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m "not slow"

test-slow: setup
	$(BIN)/python -m pytest -q -m slow

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: setup
	$(BIN)/python scripts/site/gallery.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	$(BIN)/python scripts/site/check.py site

package: setup
	$(BIN)/python scripts/check_package.py

reproduce-quick: setup
	$(BIN)/python -m train.reproduce --quick --resume

setup:
	@scripts/setup $(PYTHON)
