# Everything runs in .venv, made with the tested versions; `make demo` and `make test` need nothing before them.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: setup demo test test-long check bench clean

setup: $(VENV)/.done

$(VENV)/.done: pyproject.toml constraints.txt hatch_build.py $(wildcard torchvts/accelerated/csrc/*.[ch])
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[pose,onnx,test]"
	touch $@

demo: setup
	$(BIN)/python scripts/demo.py --out out/demo

# Files in the order of their names: by number of tests the few long ones would come last, and one worker would wait.
test: setup
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

# Fuzzed files, drawn scenes and frames by the thousands, the largest graphs, compiled ones; some tens of minutes.
test-long: setup
	TORCHVTS_TEST_PROFILE=long $(BIN)/python -m pytest tests/test_properties.py tests/test_fuzz.py tests/test_export.py --no-cov -n auto

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: setup
	$(BIN)/python scripts/bench.py --out out/bench

clean:
	rm -rf $(VENV) out .mypy_cache .ruff_cache .pytest_cache
