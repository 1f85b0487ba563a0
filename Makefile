# make run    set up, then learn, fly, verify and film the default segment
# make test   set up, then run the tests (make test-slow: the learning tests too)
# make lint   set up, then linters and type checker

PYTHON ?= python3
BIN := .venv/bin

.PHONY: run test test-slow lint setup

run: setup
	$(BIN)/python -m train.segment --resume

test: setup
	$(BIN)/python -m pytest -q -m "not slow"

test-slow: setup
	$(BIN)/python -m pytest -q -m slow

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

setup:
	@scripts/setup $(PYTHON)
