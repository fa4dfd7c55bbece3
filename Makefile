# Entry points of the project; `make` without a target lists them. Variables:
#   PYTHON       interpreter for .venv (3.11 or newer)
#   TORCH_INDEX  package index of torch: a URL, or `pypi`; see .ci/setup.py for the default
#   SEQUENCE     sequence of `make view`, by default the shipped sample; `make view SEQUENCE=` shows the start page
#   ARGS         further arguments of `carts view` or pytest

PYTHON ?= python3
SEQUENCE ?= sample_data/sequence/sequence.toml
BIN := .venv/bin
# Disable pyright's check for updates.
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
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder -m "not slow and not gpu" $(ARGS) || \
	{ echo "Repeating failed tests one at a time:"; \
	$(BIN)/python -m pytest --last-failed --last-failed-no-failures none -m "not slow and not gpu" $(ARGS); }; }

lint: setup-dev ## Check style, formatting and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

docs: setup-dev ## Build the documentation into docs/_build/html, with warnings as errors
	$(BIN)/python -m sphinx -b html -W --keep-going -q docs docs/_build/html
	@echo "open docs/_build/html/index.html"

format: setup-dev ## Format the code and apply automatic fixes
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

bench: setup-dev ## Print the measurements, then run the slow tests and the benchmark
	chromium=$$($(BIN)/python .ci/chromium.py) && export CARTS_CHROMIUM=$$chromium && failed=0 && \
	for measured in core recordings viewer; do $(BIN)/python -m tools.bench_$$measured || failed=1; done && \
	{ $(BIN)/python -m pytest -m slow $(ARGS) || failed=1; } && \
	{ $(BIN)/carts bench --quick || failed=1; } && exit $$failed

pictures: setup-dev ## Regenerate the pictures of the README, the tutorial and the examples
	chromium=$$($(BIN)/python .ci/chromium.py) && CARTS_CHROMIUM=$$chromium $(BIN)/python docs/pictures.py
	$(BIN)/python docs/run_pictures.py
	$(BIN)/python docs/example_pictures.py

wheel: setup-dev ## Build the sdist and the wheel into dist/
	$(BIN)/python -m hatchling build -t sdist -t wheel

lock: ## Pin all packages except PyTorch by hash, after a change of constraints.txt (needs a network)
	$(PYTHON) -m venv .lock && .lock/bin/pip install -q uv
	$(call locked,requirements.lock,)
	$(call locked,requirements-dev.lock,--all-extras)
	rm -rf .lock

# Lock for all systems and Python versions, including the build backend; existing pins are kept if possible. PyTorch and
# the packages of its CUDA build are omitted, since their hashes depend on the index; see .ci/setup.py.
define locked
	printf 'hatchling\neditables\n' | .lock/bin/uv pip compile -q --universal --python-version 3.11.0 --generate-hashes \
	--no-annotate --no-header -c constraints.txt $(2) pyproject.toml - -o $(1)
	awk '/^[^ ]/ { kept = !/^(torch=|triton=|nvidia-|cuda-)/ } kept' $(1) > $(1).new && mv $(1).new $(1)
endef

setup: ## Install into .venv, unless already installed
	@$(PYTHON) .ci/setup.py

setup-dev: ## Install into .venv with the development tools
	@$(PYTHON) .ci/setup.py --dev

clean: ## Remove built packages and tool caches (.venv stays)
	rm -rf dist docs/_build .pytest_cache .ruff_cache .hypothesis
