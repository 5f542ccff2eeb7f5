# Everything sets itself up: a machine with Python >= 3.11 and make is enough.
PYTHON ?= python3
# The CPU build; on a CUDA machine: make TORCH=torch
TORCH ?= torch==2.13.0
TORCH_INDEX ?=
VENV ?= .venv
DEMO ?= demo_out

.PHONY: demo test venv lint clean

demo: venv
	rm -rf $(DEMO)
	$(VENV)/bin/mgavatar demo --out $(DEMO)

test: venv
	$(VENV)/bin/python -m pytest -n auto --dist loadfile tests

lint: venv
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

venv: $(VENV)/.ready

# torch first: otherwise a dependency pulls in a build with gigabytes of CUDA libraries.
$(VENV)/.ready: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install -q $(TORCH_INDEX) "$(TORCH)"
	$(VENV)/bin/python -m pip install -q -e ".[dev,video]"
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info $(DEMO)
