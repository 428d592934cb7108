# Nothing is assumed but make and a Python >= 3.11; everything else goes into .venv.
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help setup demo docs test test-long fuzz faults nights restarts check paper bench registration-benchmark soak load wheel lint lock sbom audit clean FORCE

PYTHON ?= python3
PY := .venv/bin/python
STAMP := .venv/.installed-for
MANUAL := service/web/manual/index.html
# What makes lock files, bills of materials and audits: of nobody who runs pyrcal.
TOOLS := build/tools/bin
LOCKED := --quiet -c constraints.txt --generate-hashes --universal --python-version 3.11 --no-header --no-annotate
# A hundred processes that each compile the service anew cost a minute.
PYTEST := PYTHONDONTWRITEBYTECODE= $(PY) -m pytest
# A test that hangs where no signal reaches it says where, ends its worker and is tried again.
HUNG = -o faulthandler_exit_on_timeout=true -o faulthandler_timeout

# The stamp names the folder it was made in: a copied or moved checkout gets an environment of its own.
ifneq ($(wildcard $(PY)),)
INSTALLED_FOR := $(shell cat $(STAMP) 2>/dev/null)
endif
ifneq ($(INSTALLED_FOR),$(CURDIR))
$(STAMP): FORCE
endif

help:
	@grep -E '^[a-z-]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/:.*## /:\t/' | expand -t 11

setup: $(STAMP) $(MANUAL) ## install pyrcal and its tools into .venv, build the manual

demo: $(STAMP) $(MANUAL) ## service and simulated RTC together; ARGS="--seconds 120" and the like
	@.venv/bin/pyrcal demo $(ARGS)

docs: $(MANUAL) ## build the manual, which the service shows at /manual/

test: $(STAMP) ## all that a change needs, what is known soonest first; ARGS go to pytest
	@$(PYTEST) -n 3 $(HUNG)=240 -m 'not long and not slow' $(ARGS)  # for two cores: one may wait

test-long: $(STAMP) ## the other tests: what takes minutes of real time
	@$(PYTEST) -n 4 $(HUNG)=480 -m 'long and not slow' $(ARGS)  # they wait more than they work

fuzz: $(STAMP) ## a million malformed inputs of every kind; ARGS="--inputs 50000" and the like
	@$(PY) -m tests.malformed $(ARGS)

faults: $(STAMP) ## every fault that a night may bring, on real processes; a quarter of an hour, ARGS=--quick two minutes
	@$(PY) -m pyrcal_studies.faults $(ARGS)

nights: $(STAMP) ## random sequences of faults in simulated time; takes hours, ARGS="--seeds 0:6 --seconds 100" minutes
	@$(PY) -m pyrcal_studies.campaign.fault_nights $(ARGS)

restarts: $(STAMP) ## the service killed two hundred times, and what it had acknowledged; takes half an hour
	@$(PY) -m pyrcal_studies.restarts $(ARGS)

lint: $(STAMP) ## lint and formatting, in a second: what .pre-commit-config.yaml calls
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .

check: lint ## lint, formatting, types, import contracts and unused code
	@$(PY) -m mypy
	@.venv/bin/lint-imports --no-logo
	@$(PY) -m tests.unused_code

paper: $(STAMP) ## the seed paper beside pyrcal: docs/results/heritier2018.md and its figures; ten minutes on two cores, ARGS=--quick three
	@$(PY) -m pyrcal_studies.heritier2018 $(ARGS)

bench: $(STAMP) ## pyrcal beside OOPAO, HCIPy and SPECULA, each from its package: docs/results/speed.md; a quarter of an hour
	@$(PY) -m benchmarks.bench $(ARGS)

registration-benchmark: $(STAMP) ## twenty matrices of three codes with a known registration, fitted; a minute, ARGS=--make measures them anew
	@$(PY) -m benchmarks.registration $(ARGS)

soak: $(STAMP) ## the service at 1 kHz with company, for what grows or is lost; takes an hour, ARGS="--minutes 5" rehearses
	@$(PY) -m benchmarks.soak $(ARGS)

load: $(STAMP) ## 50 clients of REST at 1 kHz, then beside 1400 who only wait; ARGS="--seconds 20" and the like
	@$(PY) -m benchmarks.load $(ARGS)

wheel: ## dist/pyrcal-*.whl, the manual inside, built of locked packages
	@$(PYTHON) -m venv build/wheel
	@build/wheel/bin/pip install --quiet --require-hashes -r deploy/build.lock
	@build/wheel/bin/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist .

lock: $(TOOLS) ## deploy/*.lock anew, of pyproject.toml and constraints.txt: each package with its hashes
	@$(TOOLS)/uv pip compile $(LOCKED) pyproject.toml -o deploy/requirements.lock
	@printf 'setuptools\n' | $(TOOLS)/uv pip compile $(LOCKED) --extra docs pyproject.toml - -o deploy/build.lock

sbom: $(TOOLS) ## build/sbom.json: what the service runs on, as CycloneDX
	@$(TOOLS)/cyclonedx-py requirements deploy/requirements.lock --pyproject pyproject.toml \
	    --output-reproducible --of JSON -o build/sbom.json

audit: $(TOOLS) ## known weaknesses of what the service runs on; it asks pypi.org
	@$(TOOLS)/pip-audit --strict --disable-pip --require-hashes -r deploy/requirements.lock

$(TOOLS):
	@$(PYTHON) -m venv build/tools
	@$(TOOLS)/pip install --quiet uv==0.13.9 cyclonedx-bom==7.5.0 pip-audit==2.10.1 || { rm -r build/tools; exit 1; }

clean: ## remove what make made; never var/, which holds calibration products
	rm -rf .venv build dist service/web/manual *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis \
	    .import_linter_cache .coverage
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(MANUAL): $(STAMP) docs/conf.py $(wildcard docs/static/* docs/templates/* docs/templates/*/* examples/reference/*.py examples/notebooks/* docs/*.md docs/*/*.md docs/*/*.png docs/*/*/*.png docs/*/*.svg)
	@$(PY) -m sphinx -q -W --keep-going -d build/manual docs $(@D) && touch $@

# A working environment is brought up to date in place; one made elsewhere or broken is made anew.
$(STAMP): pyproject.toml constraints.txt
	@if [ -e $@ ] && [ "$$(cat $@)" != "$(CURDIR)" ] || \
	    ! $(PY) -c 'import pip, sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	    for python in $(PYTHON) python3.14 python3.13 python3.12 python3.11 none; do \
	        "$$python" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' \
	            2>/dev/null && break; \
	    done; \
	    if [ "$$python" = none ]; then \
	        echo "setup: found no Python >= 3.11 with the venv module ($(PYTHON) is" \
	            "$$($(PYTHON) --version 2>&1)); install one or name it: make PYTHON=/path/to/python3" >&2; \
	        exit 1; \
	    fi; \
	    echo "setup: making .venv with $$("$$python" --version)"; \
	    "$$python" -m venv --clear .venv || exit 1; \
	fi
	@echo "setup: installing pyrcal and its tools (the first time takes a minute or two)"
	@$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,test,plots,aot,docs,cluster,array]'
	@printf '%s\n' '$(CURDIR)' > $@
