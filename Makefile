# Everything starts here; the work is in scripts/setup.py, env.sh and the ps_* commands.
#   PYTHON=python3.12   Python for .venv (default: the first that fits)
#   INPUT=folder        real pictures for `make demo` instead of the rendered scene
#   OUT=folder          where `make demo` writes (default: build/demo)
OUT ?= build/demo
PACKAGES = ps_head_driver ps_reconstruction ps_calibration ps_inspection
BOOTSTRAP := $(if $(PYTHON),$(PYTHON),python3)
IN_ENV = . ./env.sh &&

.DEFAULT_GOAL := help
.PHONY: help setup demo test lint bench reference clean

help:  ## say what there is
	@sed -n 's/^\([a-z]*\):.*## /make \1\t/p' Makefile | expand -t 18
	@sed -n 's/^#   /  /p' Makefile

setup:  ## make .venv and build the workspace (the others do this by themselves)
	@$(BOOTSTRAP) -c 'import sys; sys.exit(sys.version_info < (3, 7))' 2>/dev/null || \
	  { echo 'setup: $(BOOTSTRAP) is missing or too old; Python 3.11 or newer is needed:' \
	    'sudo apt install python3 python3-venv python3-dev' >&2; exit 1; }
	@PYTHON='$(PYTHON)' $(BOOTSTRAP) scripts/setup.py

demo: setup  ## run the whole cell on fake hardware and write build/demo/report.html
	@$(IN_ENV) ps_demo --out '$(OUT)' $(if $(INPUT),--input '$(INPUT)')

test: lint  ## lint, then every test; those of the graph one by one, as they are in real time
	@$(IN_ENV) python -m pytest ros2_ws/src --numprocesses auto --maxprocesses 4 --dist loadfile
	@$(IN_ENV) python -m pytest tests

lint: setup  ## ruff everywhere, mypy over packages and scripts
	@$(IN_ENV) ruff check .
	@$(IN_ENV) mypy scripts $(foreach p,$(PACKAGES),ros2_ws/src/$(p)/$(p))

bench: setup  ## run the benchmarks in tests/bench and print their tables
	@$(IN_ENV) python -m tests.bench

reference: setup  ## write docs/reference.md from the code
	@$(IN_ENV) python scripts/reference.py

clean:  ## remove everything that was made, .venv too
	rm -rf .venv .cache build ros2_ws/build ros2_ws/install ros2_ws/log
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
