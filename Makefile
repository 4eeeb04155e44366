# Each target works alone on a machine with git, make and a Python >= 3.12: the first one makes .venv.
# Another Python: make PYTHON=/path/to/python3.13 test

UV_VERSION := 0.13.8
BIN := .venv/bin
READY := .venv/.ready-$(shell cksum < uv.lock | cut -d ' ' -f 1)

.PHONY: help env test test-long test-browser browser vendor notebooks docs lint format demo bench real stripped amortized \
	tuning compare compare-sbi ik clean
NAMES := pendulum_multiarm servo_xl330 ball_drops
STUDIES ?= ../shared/studies
BENCHMARKS := bad_input sysid_silence transitions
.DELETE_ON_ERROR:

help:
	@echo "make env     .venv, with every version pinned by uv.lock"
	@echo "make test    lint, types and tests"
	@echo "make test-long  the tests that take a minute each, which make test leaves out"
	@echo "make browser  install a Chromium for the tests of pages, where apt-get can"
	@echo "make test-browser  the tests of pages in a Chromium alone"
	@echo "make vendor  bundle the pages' three.js anew, by npm"
	@echo "make notebooks  run the teaching notebooks, check their figures; executed copies in out/notebooks"
	@echo "make docs    build the documentation site in out/site, its links checked"
	@echo "make demo    conceal an effect, diagnose it, compare"
	@echo "make lint    ruff and pyright alone"
	@echo "make format  let ruff put the files in shape, and notebooks follow their scripts"
	@echo "make bench   the benchmarks"
	@echo "make real    diagnose real recordings: STUDIES=folder NAMES=\"one two\""
	@echo "make stripped  the same without a documented piece of their models"
	@echo "make amortized  det2stoc and a CVAE of recordings alone on them: held-out log densities"
	@echo "make tuning  Windy Slope's models over the same grid of widths and learning rates"
	@echo "make compare  amortized beside exact posteriors of the problems by name"
	@echo "make compare-sbi  npe on problems of the SBI benchmark, by the benchmark's own measure"
	@echo "make ik      one robot pushes YuMi Pusher's box by mink's inverse kinematics"
	@echo "make clean   remove .venv and caches; results in out/ stay"

env: $(READY)

test: lint
	$(BIN)/python -m pytest

test-long: $(READY)
	$(BIN)/python -m pytest -m long

# Pages are looked at by a Chromium; where none can be had their tests are skipped, and say so.
browser:
	@command -v chromium chromium-browser google-chrome >/dev/null || { \
		command -v apt-get >/dev/null && [ "$$(id -u)" = 0 ] && \
		{ timeout 50 apt-get install -qq -y --no-install-recommends chromium >/dev/null 2>&1 || \
		{ timeout 20 apt-get update -qq && timeout 50 apt-get install -qq -y --no-install-recommends chromium; } >/dev/null 2>&1; }; } || \
		echo "make browser: no Chromium, and none that apt-get could install here as root; tests of pages will be skipped"

test-browser: $(READY) browser
	$(BIN)/python -m pytest -m browser

vendor:
	cd det2stoc_bayes/report/vendor && npm ci --no-audit --no-fund && npm run build && rm -rf node_modules

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/jupytext --quiet --update --to ipynb notebooks/*.py

notebooks: $(READY)
	$(BIN)/python -m pytest -m notebooks --dist=load tests/notebooks

docs: $(READY)
	@UV_PYTHON_DOWNLOADS=never $(BIN)/uv sync --frozen --quiet --group docs --python $(BIN)/python
	$(BIN)/python -m pytest -m docs tests/docs

demo: $(READY)
	@$(BIN)/python -m det2stoc_bayes.blind.demo

bench: $(READY)
	@UV_PYTHON_DOWNLOADS=never $(BIN)/uv sync --frozen --quiet --group bench --python $(BIN)/python
	@$(BIN)/det2stoc blind --effects 10 --pairs 3 --controls 5 --out out/blind --log benchmarks/results/concealed.jsonl
	@for file in $(BENCHMARKS:%=benchmarks/%.py); do echo "== $$file"; $(BIN)/python "$$file" || exit 1; done

real: $(READY)
	@$(BIN)/python benchmarks/real.py --studies $(STUDIES) $(NAMES)

stripped: $(READY)
	@$(BIN)/python benchmarks/stripped.py --studies $(STUDIES) $(NAMES)

amortized: $(READY)
	@$(BIN)/python benchmarks/amortized.py --studies $(STUDIES)

tuning: $(READY)
	@$(BIN)/python benchmarks/tuning.py

compare: $(READY)
	@$(BIN)/python benchmarks/compare.py

compare-sbi: $(READY)
	@$(BIN)/python benchmarks/compare_sbi.py

ik: $(READY)
	@UV_PYTHON_DOWNLOADS=never $(BIN)/uv sync --frozen --quiet --group ik --python $(BIN)/python
	@$(BIN)/python benchmarks/yumi_ik.py

clean:
	rm -rf .venv .pytest_cache .ruff_cache .hypothesis build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The environment is built anew from nothing but uv.lock; the stamp bears the lock's checksum, so a changed lock
# brings it up to date, and an unchanged one costs nothing. A Python is believed only if it runs: a shim may not.
$(READY):
	@set -e; \
	if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
		found=; \
		for python in $(PYTHON) python3.12 python3.13 python3.14 python3 python \
				"$${PYENV_ROOT:-$$HOME/.pyenv}"/versions/3.1[2-9]*/bin/python; do \
			if "$$python" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 12))' >/dev/null 2>&1; \
			then found=$$python; break; fi; \
		done; \
		if [ -z "$$found" ]; then \
			echo "error: no Python >= 3.12 that runs and has venv: looked for python3.12, python3.13, python3.14, python3," >&2; \
			echo "       python on PATH and under ~/.pyenv/versions; install one, or: make PYTHON=/path/to/python test" >&2; \
			exit 1; \
		fi; \
		echo "Making .venv with $$("$$found" --version), $$found"; \
		rm -rf .venv; \
		"$$found" -m venv .venv; \
	fi; \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION); \
	UV_PYTHON_DOWNLOADS=never VIRTUAL_ENV= $(BIN)/uv sync --frozen --quiet --compile-bytecode --python $(BIN)/python; \
	rm -f .venv/.ready-*; \
	touch $@
