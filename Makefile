# The commands people and CI use. Everything lives in .venv; nothing is installed outside, except what apt brings
# when run as root (python3-venv, gcc, curl, systemd, chromium-headless-shell, mosquitto, pgbouncer; haproxy for bench).
BIN := .venv/bin
# ROS 2 would write its logs into the home directory, and not start without one.
export ROS_LOG_DIR ?= $(CURDIR)/build/ros-log
# Kept bytecode, whatever the machine's default is: tests start hundreds of interpreters.
export PYTHONDONTWRITEBYTECODE :=
NPM := scripts/with-node.sh npm --silent --prefix web_client

.DEFAULT_GOAL := help
.PHONY: help setup demo test quick conformance robot-conformance bench stills screenshots docs reference house lint types api-types web wheel release clean

help: ## list these commands
	@echo 'make <command>:'
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1\t\2/p' $(MAKEFILE_LIST)

setup: ## prepare .venv, build the portal, find a browser for the tests (again: instant)
	@scripts/setup.sh

demo: ## run a relay with two simulated robots and print how to log in (options: DEMO='--http 127.0.0.1:9090 --home', DEMO=--cluster)
	@scripts/setup.sh python web interfaces
	@exec $(BIN)/switchboard demo $(DEMO)

test: setup ## all tests: Python, ROS 2, browser, portal (options: PYTEST='-k drive')
	$(BIN)/python scripts/run_tests.py -n 4 --dist loadfile --no-loadscope-reorder $(PYTEST)
	$(NPM) run test

quick: setup ## the tests that need no ROS, browser or process, in two minutes (options: PYTEST='-k drive')
	$(BIN)/python -m pytest -n 2 --dist loadfile --quick $(PYTEST)

CASES := $(BIN)/python -m pytest -q --no-header -r N --tb=short --table
LISTEN ?= 0.0.0.0:9091

conformance: ## check a rosbridge server: URL=ws://host:9090 TOKEN=…, without URL our own (docs/reference/conformance.md)
	@scripts/setup.sh python $(if $(URL),,web fixtures)
	@CONFORMANCE_TOKEN='$(TOKEN)' $(CASES) tests/conformance/clients --url='$(URL)' --target='$(TARGET)' --restart='$(RESTART)'

robot-conformance: ## check a robot that dials LISTEN=0.0.0.0:9091 (docs/reference/conformance.md)
	@scripts/setup.sh python
	@$(CASES) tests/conformance/robot_link --listen='$(LISTEN)'

bench: ## measure beside alternatives, all of it in two hours (options: BENCH='hop fanout', BENCH='--quick', BENCH='modules --strict', BASE=<commit>)
	@scripts/setup.sh python web interfaces browser bench
	$(BIN)/python -m bench $(BENCH) $(BASE:%=--base %)

stills: setup ## draw a still of every encoding of pictures as a viewer gets it: build/stills.png, to be looked at
	@mkdir -p build
	$(BIN)/python -m tests.robot_client.camera.contact_sheet build/stills.png

screenshots: setup ## take the pictures of the documents from the demo: drive.webp, map.png, processes.png, top.svg in docs/images
	$(BIN)/python scripts/screenshots.py

docs: setup ## build the site of the documents into build/site; links and anchors are checked
	$(BIN)/python -m sphinx -q -E -W --keep-going -c docs -b html . build/site
	@echo '<meta http-equiv="refresh" content="0; url=docs/index.html">' >build/site/index.html

reference: setup ## write the pages of docs/reference that follow from the code
	$(BIN)/python scripts/reference.py

house: setup ## count what makes the code hard to find one's way in (options: HOUSE=--all)
	$(BIN)/python scripts/house.py $(HOUSE)

lint: setup ## style and import rules
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(NPM) run check

types: setup ## mypy, strict; the robot's side also as Python 3.10 sees it
	$(BIN)/mypy
	$(BIN)/mypy --python-version 3.10 -p relay_protocol -p robot_client

api-types: ## generate the portal's types of HTTP bodies from the relay's own
	@scripts/setup.sh python web
	$(BIN)/python scripts/openapi.py --types >build/openapi.json
	$(NPM) run api-types

web: ## build the portal into relay_server/portal, and what the simulated robot needs
	@scripts/setup.sh python web interfaces

wheel: ## build the wheel with the portal inside, and the source archive, into dist
	@scripts/setup.sh python web
	@rm -rf dist
	@$(BIN)/python -m build --no-isolation --outdir dist >build/logs/wheel.log 2>&1 || { tail -n 40 build/logs/wheel.log; exit 1; }
	@ls dist/*

RELAYS ?= $(BIN)/python
ROBOTS ?= $(BIN)/python

release: wheel ## wheel, and try it in new environments (options: RELAYS='python3.11 python3.14' ROBOTS=python3.10)
	$(BIN)/python scripts/check_wheel.py dist/*.whl $(RELAYS:%=--relay %) $(ROBOTS:%=--robot %)

clean: ## remove what was built: .venv, packages of the portal, caches
	rm -rf .venv build dist relay_server/portal web_client/node_modules *.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
