# Sets up `.venv` when it is missing or its dependencies changed, then runs one command in it.
PYTHON ?= python3
BIN := .venv/bin
comma := ,
# jax for CUDA on a machine with NVIDIA's driver.
CUDA := $(if $(shell command -v nvidia-smi),$(comma)cuda)

.PHONY: see run test quick release lint docs
.DEFAULT_GOAL := run

see: .venv/run.stamp
	$(BIN)/starjax evaluate --policy compact

run: .venv/run.stamp
	$(BIN)/python -m starjax.experiments.run --method stardiff

test: .venv/dev.stamp
	$(BIN)/pytest -n 2 --dist loadfile

quick: .venv/dev.stamp
	$(BIN)/pytest -m "not slow" -n 2 --dist loadfile

release: .venv/dev.stamp
	$(BIN)/pytest -m release -n 2 --dist loadfile

lint: .venv/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: .venv/dev.stamp
	$(BIN)/mkdocs build --strict

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/run.stamp: pyproject.toml weights/pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/pip install -q -e '.[train,report$(CUDA)]' -e ./weights -c constraints.txt
	touch $@

.venv/dev.stamp: pyproject.toml weights/pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/pip install -q -e '.[dev]' -e ./weights -c constraints.txt
	touch $@
