# Two commands on a fresh machine (Python 3.11, make):  make fleet   and   make test
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=
PYTHONS ?= $(PYTHON)
TOOLS := build/tools
ENGINE ?= $(firstword $(shell command -v docker podman) docker)
BASE ?= python:3.11-slim
# Tests run in three processes, also on two cores: those of the bus and of attacks wait for much of their time.
# Whole fleets run one after the other in one of them, hosts in another, shards that are killed too: they need the cores.
TESTERS ?= $(shell [ "$$(nproc)" -gt 1 ] && echo 3 || echo 0)
SIDE_BY_SIDE = -n $(TESTERS) --dist loadscope
export OPENBLAS_NUM_THREADS ?= 1
export NUMBA_NUM_THREADS ?= 1

.PHONY: help setup fleet test quick check docs extras bench studies schemas page kernels wheel dist installed wheels pictures image lock sbom audit clean

help:            ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

setup: $(VENV)/.ready  ## make .venv with the pinned versions

$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[all,dev]'
	@touch $@

fleet: setup     ## run the fleet: make fleet ARGS="--agents 4 --link 3g"
	$(BIN)/gnd fleet $(ARGS)

test: setup      ## run every test; a few that fail side by side run once more, alone
	$(BIN)/pytest $(SIDE_BY_SIDE) --cache-clear $(ARGS) || $(BIN)/python tests/suite_again.py $$? $(ARGS)

quick: setup     ## run the tests that take less than five seconds each
	$(BIN)/pytest $(SIDE_BY_SIDE) -m "not slow" $(ARGS)

check: setup     ## what CI runs beside the tests: style, types, layers, generated code, documents, and that all tests can be read together
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m gnd.schemas.generate --check
	$(BIN)/python -m gnd.deploy.configuration_page --check
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	$(BIN)/pytest --collect-only --quiet --quiet > /dev/null

docs: setup      ## build the documents as a site: build/site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

extras:          ## install each extra alone into an environment of its own, and run what it is for (some three minutes)
	rm -rf build/extras && mkdir -p build/extras
	set -e; for extra in sim vehicle cloud serve client; do $(PYTHON) -m venv build/extras/$$extra; \
	  build/extras/$$extra/bin/pip install --quiet --disable-pip-version-check -c constraints.txt $$(test $$extra = client && echo . || echo ".[$$extra]"); done
	cd build/extras && sim/bin/gnd sim world write street.json --seed 11 --length 100
	cd build/extras && sim/bin/gnd sim drive street.json drive.mcap --sensor vlp16 --cars 0
	cd build/extras && vehicle/bin/gnd map build -o map.sqlite drive.mcap
	cd build/extras && vehicle/bin/gnd localise drive.mcap --map map.sqlite --out poses
	cd build/extras && cloud/bin/gnd merger --help > merger.txt && cloud/bin/gnd map verify map.sqlite
	cd build/extras && serve/bin/gnd serve --help > serve.txt
	cd build/extras && client/bin/gnd map info map.sqlite && client/bin/python -c "import gnd; print(len(gnd.Map('map.sqlite').gaussians()))"

pictures: setup  ## draw the pictures of the documents anew, but for those of long studies: make pictures ARGS="world healing"
	$(BIN)/python -m tools.pictures $(ARGS)

dist: $(TOOLS)/.ready  ## build wheel and source archive into dist/, twice: the same bytes; checked, also against CHANGELOG.md
	rm -rf dist
	$(TOOLS)/bin/cffconvert --validate -i CITATION.cff
	$(TOOLS)/bin/python -m tools.dist --twice
	@rm -rf src/gnd_fleet.egg-info  # it would tell programs that run from src another version than what is installed

installed:       ## install what lies in dist/ into fresh environments and run a small fleet: make installed PYTHONS="python3.11 python3.13"
	$(TOOLS)/bin/python -m tools.installed $(foreach one,$(PYTHONS),--python $(one))

wheels: $(TOOLS)/.ready  ## ask the index which libraries have wheels for which Python and machine (needs a network)
	$(TOOLS)/bin/python -m tools.wheels $(ARGS)

image: $(TOOLS)/.ready  ## build the container image by docker or podman, with the version of this checkout: make image BASE=python:3.11-slim@sha256:...
	$(ENGINE) build -f deploy/Dockerfile --build-arg BASE=$(BASE) --build-arg VERSION=$$($(TOOLS)/bin/python -m tools.dist --version) -t gnd-fleet $(ARGS) .

bench: setup     ## measure speed beside others who do the same work, on this machine: docs/benchmarks.md
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[peers]'
	$(BIN)/python -m studies.speed --out docs/benchmarks.md $(ARGS)

studies: setup   ## print the studies' small benchmarks with their commands: make studies ARGS="codec --json"
	$(BIN)/python -m studies $(ARGS)

schemas: setup   ## generate Python from schemas/*.proto
	$(BIN)/python -m gnd.schemas.generate

page/node_modules/.ready: page/package-lock.json
	cd page && npm ci --ignore-scripts --no-audit --no-fund
	@touch $@

page: page/node_modules/.ready  ## build the page of gnd serve from page/ (needs node 20): deploy/serve/page
	cd page && npm run --silent check-types && npm run --silent build

kernels: setup   ## compile all kernels ahead of time, into this checkout: programs then start without numba (minutes; needs a C compiler)
	$(BIN)/gnd kernels build

wheel: kernels   ## a wheel with these kernels, for this version of Python and this kind of machine: build/wheel
	$(BIN)/pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir build/wheel .

$(TOOLS)/.ready: Makefile tools/constraints.txt
	$(PYTHON) -m venv $(TOOLS)
	$(TOOLS)/bin/pip install --quiet --disable-pip-version-check -c tools/constraints.txt build cffconvert cyclonedx-bom pip-audit pip-tools setuptools-scm twine
	@touch $@

LOCK = $(TOOLS)/bin/pip-compile --quiet --generate-hashes --allow-unsafe --strip-extras --no-header --no-annotate \
  --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --extra vehicle --extra cloud --extra sim --extra postgres --extra objects --extra lanes --build-deps-for wheel -c constraints.txt

lock: $(TOOLS)/.ready  ## pin what the image installs, by version and hash: deploy/requirements.lock
	$(LOCK) -o deploy/requirements.lock pyproject.toml

sbom: $(TOOLS)/.ready  ## list what the image installs as CycloneDX: build/sbom.cdx.json
	$(TOOLS)/bin/cyclonedx-py requirements deploy/requirements.lock --pyproject pyproject.toml --mc-type application \
	  --output-reproducible --of JSON -o build/sbom.cdx.json

audit: $(TOOLS)/.ready  ## ask the index for known weaknesses of what the image installs (needs a network)
	$(TOOLS)/bin/pip-audit --require-hashes --disable-pip -r deploy/requirements.lock

clean:           ## remove what was made
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache
