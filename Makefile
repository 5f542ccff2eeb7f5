# Everything sets itself up: a machine with Python >= 3.11 and make is enough.
PYTHON ?= python3
# The CPU build of torch. On a machine with CUDA: make TORCH_INDEX=
TORCH ?= torch==2.13.0
TORCH_INDEX ?= --index-url https://download.pytorch.org/whl/cpu
VENV ?= .venv
PACKAGE ?= -e ".[dev,video]"
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

# torch comes first and alone: as a dependency of the package, it would be the build with gigabytes of CUDA libraries.
# What torch itself needs comes with the package.
$(VENV)/.ready: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install -qq --retries 1 --no-deps $(TORCH_INDEX) "$(TORCH)"
	$(VENV)/bin/python -m pip install -q $(PACKAGE)
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info $(DEMO)
