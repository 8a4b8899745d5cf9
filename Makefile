# make install | demo | test | check | fuzz | bench | cuda-check (docs/cuda.md)
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: install demo test check fuzz bench cuda-check wheels clean

install: $(STAMP)

$(STAMP): setup.py setup.cfg constraints.txt $(wildcard src/*.cpp src/*.hpp)
	@test -x $(BIN)/python3 || $(PYTHON) -m venv $(VENV)
	$(BIN)/python3 -m pip install -q -c constraints.txt setuptools wheel pybind11
	$(BIN)/python3 -m pip install -q -c constraints.txt --no-build-isolation -e '.[ros,test]'
	@touch $@

demo: install
	$(BIN)/bdgs demo demo

test: install
	$(BIN)/python3 -m pytest

check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# ten minutes of strange input, other than the last time
fuzz: install
	BDGS_FUZZ=long $(BIN)/python3 -m pytest -q --hypothesis-show-statistics test/unit/test_fuzz.py

bench: install
	$(BIN)/bdgs bench slam
	$(BIN)/bdgs bench belief
	$(BIN)/bdgs bench rasterizer
	$(BIN)/bdgs bench mapping

# WHEELS=folder where there is no network: what is not installed comes from there, torch from the
# Python that makes the environment
cuda-check: $(if $(WHEELS),wheels,install)
	BDGS_REQUIRE_CUDA=1 $(BIN)/python3 -m pytest test/unit/test_rasterize_cuda.py \
		test/unit/test_cuda_steps.py test/unit/test_rasterize.py test/unit/test_detection_onnx.py
	$(BIN)/bdgs bench rasterizer
	$(BIN)/bdgs bench card

wheels:
	test -x $(BIN)/python3 || $(PYTHON) -m venv --system-site-packages $(VENV)
	$(BIN)/python3 -m pip install -q --no-index --find-links $(WHEELS) --no-build-isolation -e .

clean:
	rm -rf build demo *.egg-info bdgs_ros/*.so
