# One command from a fresh clone: `make demo` or `make test`. Everything goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEPS := $(VENV)/.deps
BUILT := $(VENV)/.built
NATIVE := $(wildcard igaussian_core/render/native/*.cpp igaussian_core/render/native/*.h)
# Fast DDS's default shared memory is too small for camera images
export FASTRTPS_DEFAULT_PROFILES_FILE ?= $(CURDIR)/msg_configs/fastdds_large_images.xml

.PHONY: help venv demo test lint format clean

help:
	@echo "make demo     localize the bundled drive through the real ROS 2 node, with a report"
	@echo "make test     all tests"
	@echo "make lint     ruff and mypy"
	@echo "make venv     only the environment: .venv with CPU torch and ROS 2 Jazzy from PyPI"
	@echo "make clean    remove builds and results, keep .venv"

venv: $(DEPS) $(BUILT)

# the dependencies; again only when setup.py or the torch pin changes
$(DEPS): setup.py scripts/install_torch.sh
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q --upgrade "pip>=23.1" "setuptools>=64" wheel
	scripts/install_torch.sh $(BIN)/python
	$(BIN)/python -m pip install -q -e ".[ros,test]"
	touch $(DEPS) $(BUILT)

# the native renderer; again only when its sources change
$(BUILT): $(DEPS) $(NATIVE) pyproject.toml
	$(BIN)/python -m pip install -q --no-deps --no-build-isolation -e .
	touch $(BUILT)

demo: venv
	$(BIN)/igaussian demo $(ARGS)

test: venv
	$(BIN)/python -m pytest $(ARGS)

lint: venv
	$(BIN)/ruff check .
	$(BIN)/mypy

format: venv
	$(BIN)/ruff check --fix .

clean:
	rm -rf build dist install log out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
