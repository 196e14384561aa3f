# Everything runs in .venv, made with the tested versions; `make demo` and `make test` need nothing before them.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: setup demo test test-coverage test-long test-wheel check bench docs release wasm web wheels clean

setup: $(VENV)/.done

# All that is imported is compiled at once, by all cores: else each process does it, where PYTHONDONTWRITEBYTECODE is set.
# A file that cannot be compiled is none that is imported.
$(VENV)/.done: pyproject.toml constraints.txt hatch_build.py $(wildcard torchvts/compiled/csrc/*.[ch])
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt --editable ".[pose,onnx,view,containers,test,docs]"
	$(BIN)/python -m compileall -qq -j 0 -x 'testing/_internal|/tests/|/plotly/' $(VENV)/lib/python3*/site-packages torchvts || true
	touch $@

# Needs the package alone: in .venv where it is there, else in an environment of its own.
DEMO := $(if $(wildcard $(VENV)/.done),$(VENV),out/venv)

demo: $(DEMO)/.done
	$(DEMO)/bin/python scripts/demo.py --out out/demo

out/venv/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv out/venv
	out/venv/bin/pip install --quiet --disable-pip-version-check --constraint constraints.txt .
	touch $@

WASM := web/torchvts.wasm
CSRC := torchvts/compiled/csrc

# A few minutes on two cores. A worker that has no tests left takes some of another's, so that none waits. Tests are compiled once, not by
# each worker each time, also where PYTHONDONTWRITEBYTECODE is set.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto --dist worksteal

# The tests of the page need its library, where there is Node to run it.
test test-coverage test-long: $(if $(shell command -v node),$(WASM))

test: setup
	$(PYTEST) -m "not long"

# What CI runs: the same tests, with coverage.
test-coverage: setup
	$(PYTEST) -m "not long" --cov=torchvts --cov-report=term --cov-fail-under=90

# The tests marked long: the rest of each grid of cases; fuzzed files, drawn scenes and frames by the thousands; the largest graphs. Some twenty
# minutes on two cores.
test-long: setup
	TORCHVTS_TEST_PROFILE=long $(PYTEST) -m long

# The same tests on the wheel, with nothing of this folder but tests, examples, scripts and sensor files. PYTHON=python3.13 takes another Python,
# CONSTRAINTS=constraints-oldest.txt the oldest versions that pyproject.toml allows.
CONSTRAINTS ?= constraints.txt
WHEEL := out/wheel

test-wheel:
	rm -rf $(WHEEL)
	$(PYTHON) -m venv $(WHEEL)/venv
	$(WHEEL)/venv/bin/pip install --quiet --disable-pip-version-check build
	$(WHEEL)/venv/bin/python -m build --wheel --outdir $(WHEEL) .
	$(WHEEL)/venv/bin/pip install --quiet --disable-pip-version-check --constraint $(CONSTRAINTS) "$$(ls $(WHEEL)/*.whl)[pose,onnx,test]"
	mkdir $(WHEEL)/tree
	cp -r tests examples scripts configs docs pyproject.toml README.md CHANGELOG.md LICENSE $(WHEEL)/tree
	cd $(WHEEL)/tree && ../venv/bin/python -m pytest -n auto --dist worksteal -m "not long" --ignore tests/pages tests

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: setup
	$(BIN)/python scripts/speed.py --out out/bench

# The documentation as HTML in out/docs, from docs/ and the docstrings; a warning is an error.
docs: setup
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet docs out/docs

# What is to be published, in out/release/dist: source and wheel, README rendered as the index does, and the wheel tried in an environment
# that has nothing else. Nothing is tagged or uploaded.
RELEASE := out/release

release:
	rm -rf $(RELEASE)
	$(PYTHON) -m venv $(RELEASE)/tools
	$(RELEASE)/tools/bin/pip install --quiet --disable-pip-version-check build twine
	$(RELEASE)/tools/bin/python -m build --outdir $(RELEASE)/dist .
	$(RELEASE)/tools/bin/twine check --strict $(RELEASE)/dist/*
	$(PYTHON) -m venv $(RELEASE)/empty
	$(RELEASE)/empty/bin/pip install --quiet --disable-pip-version-check --constraint $(CONSTRAINTS) $(RELEASE)/dist/*.whl
	cd $(RELEASE) && empty/bin/torchvts --version && empty/bin/python -c "import torchvts; print(*torchvts.shipped_sensors())"

# The compiled frame for browsers and Node, web/torchvts.wasm, by zig of PyPI in an environment of its own; ZIG=zig takes another.
ZIG ?= $(CURDIR)/out/zig/bin/python -m ziglang

wasm: $(WASM)

out/zig:
	$(PYTHON) -m venv $@
	$@/bin/pip install --quiet --disable-pip-version-check "ziglang>=0.15" build "hatchling>=1.26" || (rm -rf $@; exit 1)

$(WASM): $(wildcard $(CSRC)/*.[ch]) $(if $(filter $(CURDIR)/out/zig%,$(ZIG)),| out/zig)
	$(ZIG) cc -target wasm32-wasi -msimd128 -mexec-model=reactor -std=c11 -O3 -fno-math-errno -fno-strict-aliasing -ffp-contract=off \
		-fvisibility=hidden $(filter-out %/sources.c %/track.c %/grids.c,$(wildcard $(CSRC)/*.c)) -o $@ \
		-Wl,--export=malloc -Wl,--export=free -Wl,--export-dynamic -Wl,--strip-all

# The page, in out/web: the folder web/, the library, a drawn press, and a plan of each shipped prior. Any server of files shows it.
web: setup $(WASM)
	$(BIN)/python scripts/web_page.py --out out/web

# A wheel with compiled code and the page for each of four platforms, in out/wheels, all by zig on this machine. The script says what each holds, and
# runs those of this machine.
WHEELS := x86_64-linux-gnu.2.17=manylinux_2_17_x86_64 aarch64-linux-gnu.2.17=manylinux_2_17_aarch64 aarch64-macos.11.0=macosx_11_0_arm64 \
	x86_64-windows-gnu=win_amd64

wheels: setup $(WASM) | out/zig
	rm -rf out/wheels
	out/zig/bin/python -m build --sdist --no-isolation --outdir out/wheels .
	for one in $(WHEELS); do CC="$(ZIG) cc -target $${one%=*} -s" WHEEL_PLATFORM=$${one#*=} out/zig/bin/python -m pip wheel --quiet --no-deps --no-build-isolation \
		--wheel-dir out/wheels out/wheels/torchvts-*.tar.gz || exit 1; done
	$(BIN)/python scripts/check_wheels.py out/wheels

clean:
	rm -rf $(VENV) $(WASM) out .mypy_cache .ruff_cache .pytest_cache
