# One command from a fresh clone: `make demo` or `make test`. Everything goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEPS := $(VENV)/.deps
BUILT := $(VENV)/.built
NATIVE := $(wildcard igaussian_core/render/native/*.cpp igaussian_core/render/native/*.h)
# Fast DDS's default shared memory is too small for camera images
export FASTRTPS_DEFAULT_PROFILES_FILE ?= $(CURDIR)/msg_configs/fastdds_large_images.xml

.PHONY: help venv demo eval test lint format clean

help:
	@echo "make demo     localize the bundled drive through the real ROS 2 node, with a report"
	@echo "make eval     accuracy in the bundled room by the paper's protocol, with a report"
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

eval: venv
	test -d out/room.igmap || $(BIN)/igaussian map compile bags/demo/room.ply -o out/room.igmap \
		--cameras bags/demo/mapping_cameras.json
	$(BIN)/igaussian eval rendered --map out/room.igmap --json out/evaluation.json \
		--report out/evaluation.html $(ARGS)

test: venv
	$(BIN)/python -m pytest $(ARGS)

lint: venv
	$(BIN)/ruff check .
	$(BIN)/mypy

format: venv
	$(BIN)/ruff check --fix .

clean:
	rm -rf build dist install log out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
