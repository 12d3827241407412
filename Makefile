# The one way in: `make help`.

SHELL := /bin/bash
.SHELLFLAGS := -eo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory
export PYTHON PIP_ARGS ROS2_SOURCES

ENTER := . scripts/environment.bash
# A domain of its own, so that other ROS nodes on this machine neither hear nor disturb a run.
DOMAIN := export ROS_DOMAIN_ID=$${ROS_DOMAIN_ID:-$$((1 + $$$$ % 100))}

WHEELS := requirements.txt requirements-dev.txt requirements-experiments.txt requirements-extras.txt \
  requirements-worlds.txt requirements-ros.txt constraints.txt scripts/setup.bash scripts/mend_wheels.py
SOURCES := package.xml setup.py setup.cfg tap_ros/base/contract.py resource/tap_ros $(wildcard config/*.yaml config/layouts/* launch/*.py) \
  tap_msgs/CMakeLists.txt tap_msgs/package.xml $(wildcard tap_msgs/*/*.msg tap_msgs/*/*.srv \
  tap_msgs/*/*.action)

# An environment that was copied or moved here from elsewhere names the old place everywhere.
$(shell PYTHON='$(PYTHON)' scripts/setup.bash check)

.PHONY: help demo explore test test-all docs paper worlds faults build lint bench ros2 ros2.missing clean

help:
	@echo 'make demo    push objects to a goal picture, directly and via the predicted subgoal'
	@echo '             SCENES=20: that many of order2; ARGS=...: more options of the demo'
	@echo 'make explore a page in the browser: move objects of the goal picture, see what is predicted'
	@echo '             and planned, push; ARGS="--task push3"'
	@echo 'make test    the tests, in two processes; JOBS=4: in four; ARGS="-k warp": only those'
	@echo 'make test-all also the tests that take minutes each'
	@echo 'make docs    these pages as a site, in build/site, with search and an API reference'
	@echo "make paper   make the paper's prediction results again, in docs/results: hours; can be"
	@echo '             interrupted, goes on; JOBS=4, ARGS=--list'
	@echo 'make worlds  demonstrations of other simulators, and who finds their bottlenecks; goes on'
	@echo 'make faults  inject every fault into real nodes and disks, in runs/faults; takes long;'
	@echo '             ARGS="-k silent": only those; ARGS="--share 0.1": a tenth of the trials;'
	@echo '             REPORT=docs/results: make its page anew'
	@echo 'make bench   measure the speed of what this version has not measured; ARGS=...'
	@echo 'make lint    check the style of the code and its types'
	@echo 'make build   only the set-up: .venv, install/; then, to work in it:'
	@echo '             . scripts/environment.bash'
	@echo 'make ros2    the ros2 command, launch and tf2_msgs, which have no wheels, from the official'
	@echo '             sources; ROS2_SOURCES=FOLDER: from repositories there'
	@echo 'make clean   remove what the set-up made'
	@echo 'Each sets up what it needs first. PYTHON=python3.12 chooses the interpreter,'
	@echo 'PIP_ARGS=... adds options to pip install.'

demo: build
	@$(ENTER); $(DOMAIN); python -m tap_ros demo $(if $(SCENES),--scenes $(SCENES)) $(ARGS)

explore: build
	@$(ENTER); python -m tap_ros explore $(ARGS)

test: build
	@$(ENTER); $(DOMAIN); python -m pytest -n $(or $(JOBS),2) -m 'not minutes' $(ARGS)

test-all: build
	@$(ENTER); $(DOMAIN); python -m pytest -n $(or $(JOBS),2) $(ARGS)

# Warnings are errors: a link that leads nowhere, a docstring that cannot be read.
docs: build .venv/docs.done
	@$(ENTER); python -m sphinx -W --keep-going -q -c docs/site . build/site
	@echo 'build/site/index.html'

paper: build
	@$(ENTER); python -m experiments paper --jobs $(or $(JOBS),2) --results docs/results $(ARGS)

worlds: build
	@$(ENTER); python -m experiments worlds --jobs $(or $(JOBS),2) --out docs/results $(ARGS)

faults: build
	@$(ENTER); $(DOMAIN); python -m pytest -m fault --share 1 --report $(or $(REPORT),runs/faults) test/faults $(ARGS)

bench: build
	@$(ENTER); $(DOMAIN); python -m experiments bench $(or $(ARGS),all)

lint: build
	@$(ENTER); ruff check . && mypy

build: .venv/build.done
	@:

.venv/wheels.done: $(WHEELS)
	@scripts/setup.bash wheels
	@touch $@

.venv/build.done: .venv/wheels.done $(SOURCES)
	@scripts/setup.bash build
	@touch $@

.venv/docs.done: requirements-docs.txt constraints.txt | .venv/wheels.done
	@.venv/bin/python -m pip install -q --disable-pip-version-check --no-input -c constraints.txt \
	  $(PIP_ARGS) -r requirements-docs.txt
	@touch $@

# In the environment of `make build`; apart from it, so that nothing else depends on it.
ros2: build .venv/ros2.done
	@:

.venv/ros2.done: scripts/ros2.bash requirements-ros2.txt \
  $(if $(wildcard ros2/install/local_setup.bash),,ros2.missing) | build
	@scripts/ros2.bash
	@touch $@

ros2.missing:

clean:
	rm -rf .venv build install log ros2
