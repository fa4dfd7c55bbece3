# Everything starts here; `make` alone lists it. Settings:
#   PYTHON       the interpreter that .venv is created with (3.11 or newer)
#   TORCH_INDEX  where torch comes from: an index URL, or `pypi`; see .ci/setup.py for the default
#   SEQUENCE     what `make view` opens, the shipped sample by default; `make view SEQUENCE=` shows the start page
#   ARGS         further arguments of `carts view` or pytest

PYTHON ?= python3
SEQUENCE ?= sample_data/sequence/sequence.toml
BIN := .venv/bin
# pyright asks the network for a newer version of itself, unless told not to.
export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1

.DEFAULT_GOAL := help
.PHONY: help view test lint docs format bench pictures wheel lock setup setup-dev clean

help: ## List these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

view: setup ## Open the shipped sample in the viewer (or SEQUENCE=path/to/sequence.toml)
	@$(BIN)/carts view $(SEQUENCE) $(ARGS)

test: lint docs ## Check style and types, build the documentation, and run the tests, browser included
	chromium=$$($(BIN)/python .ci/chromium.py) && \
	export CARTS_CHROMIUM=$$chromium && { \
	$(BIN)/python -m pytest -n 3 --dist loadfile -m "not slow and not gpu" $(ARGS) || \
	{ echo "Once more, one at a time, what failed beside other tests:"; \
	$(BIN)/python -m pytest --last-failed --last-failed-no-failures none -m "not slow and not gpu" $(ARGS); }; }

lint: setup-dev ## Check style, formatting and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

docs: setup-dev ## Build the documentation into docs/_build/html, with warnings as errors
	$(BIN)/python -m sphinx -b html -W --keep-going -q docs docs/_build/html
	@echo "open docs/_build/html/index.html"

format: setup-dev ## Format the code and fix what can be fixed
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

bench: setup-dev ## Print the measurements, then run the slow tests and the benchmark
	chromium=$$($(BIN)/python .ci/chromium.py) && export CARTS_CHROMIUM=$$chromium && failed=0 && \
	for measured in core recordings viewer; do $(BIN)/python -m tools.bench_$$measured || failed=1; done && \
	{ $(BIN)/python -m pytest -m slow $(ARGS) || failed=1; } && \
	{ $(BIN)/carts bench --quick || failed=1; } && exit $$failed

pictures: setup-dev ## Take the pictures of the README, the tutorial and the examples again
	chromium=$$($(BIN)/python .ci/chromium.py) && CARTS_CHROMIUM=$$chromium $(BIN)/python docs/pictures.py
	$(BIN)/python docs/run_pictures.py
	$(BIN)/python docs/example_pictures.py

wheel: setup-dev ## Build the sdist and the wheel into dist/
	$(BIN)/python -m hatchling build -t sdist -t wheel

lock: ## Pin all packages but PyTorch by their hashes, after a change of constraints.txt (needs a network)
	$(PYTHON) -m venv .lock && .lock/bin/pip install -q uv
	$(call locked,requirements.lock,)
	$(call locked,requirements-dev.lock,--all-extras)
	rm -rf .lock

# For every system and Python; what is in the file already stays as it is where it can. The build backend is among it.
# PyTorch, and what its build for CUDA brings, is left out: its hashes depend on the index, see .ci/setup.py.
define locked
	printf 'hatchling\neditables\n' | .lock/bin/uv pip compile -q --universal --python-version 3.11.5 --generate-hashes \
	--no-annotate --no-header -c constraints.txt $(2) pyproject.toml - -o $(1)
	awk '/^[^ ]/ { kept = !/^(torch=|triton=|nvidia-|cuda-)/ } kept' $(1) > $(1).new && mv $(1).new $(1)
endef

setup: ## Install into .venv, if that was not done yet
	@$(PYTHON) .ci/setup.py

setup-dev: ## The same with the development tools
	@$(PYTHON) .ci/setup.py --dev

clean: ## Remove built packages and tool caches (.venv stays)
	rm -rf dist docs/_build .pytest_cache .ruff_cache .hypothesis
