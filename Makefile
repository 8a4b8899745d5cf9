# make install | demo | test | check | bench
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: install demo test check bench clean

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

bench: install
	$(BIN)/bdgs bench slam
	$(BIN)/bdgs bench rasterizer

clean:
	rm -rf build demo *.egg-info bdgs_ros/*.so
