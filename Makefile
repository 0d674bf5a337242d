# `make demo` and `make test` need nothing but Python >= 3.11 and make: the virtual environment is made here.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test lint docs trials bench soak clean

demo: $(VENV)/.demo
	$(BIN)/dcon demo --out demo

# Most tests wait for sockets and clocks, so three run at a time, and what fails beside another is judged again by itself;
# then, one at a time and once, those that need the machine to themselves. Both parts run, whatever becomes of the first.
test: lint docs
	$(BIN)/python -m pytest -n 3 --dist loadscope --durations 40 --durations-min 5 -m "not alone"; beside=$$?; \
	if [ $$beside = 1 ]; then \
	  $(BIN)/python -m pytest --last-failed --last-failed-no-failures none -m "not alone"; beside=$$?; \
	fi; \
	$(BIN)/python -m pytest --durations 20 --durations-min 5 -m alone; alone=$$?; \
	exit $$((beside | alone))

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(VENV)/.dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# What becomes of a running controller when, as the tests see it now: the tables of the documentation. Two minutes.
trials: $(VENV)/.dev
	DCON_TRIALS=write $(BIN)/python -m pytest tests/platform/test_trials.py tests/platform/test_paper_live.py

bench: $(VENV)/.dev
	$(BIN)/python tests/bench/run.py

soak: $(VENV)/.dev
	PYTHONPATH=tests $(BIN)/python -m bench.pacing 600
	PYTHONPATH=tests $(BIN)/python -m bench.characterizing 600
	PYTHONPATH=tests $(BIN)/python -m bench.running 1800
	DCON_KILLS=50 $(BIN)/python -m pytest tests/platform/test_kills.py tests/platform/test_run_iio.py

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python >= 3.11 is needed; name one with make PYTHON=/path/to/python3"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[analysis]'
	@touch $@

$(VENV)/.dev: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $@ $(VENV)/.demo

clean:
	rm -rf $(VENV) demo site build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
