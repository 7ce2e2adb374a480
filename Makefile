# SPDX-License-Identifier: Apache-2.0
# Everything that loopcal's own developers run. `make` alone lists the targets.
# Needs git, make and a Python >= 3.11 with venv; PYTHON=/path/to/python chooses one.

BIN := .venv/bin
ROBOT := src/loopcal/robots/hexapod-42.yaml
DATA := examples/hexapod-42/measurements.csv
N := 1000
WORKERS := 1
FUZZ := runs/fuzz.json
export PYTHON
# Python compiles loopcal and its tests once, not again in each process that a test starts.
unexport PYTHONDONTWRITEBYTECODE
# Tests of a file stay together, so that what they share is made once.
PARALLEL := -n 2 --dist worksteal
# Whatever the native engine is made of; a change of these files builds it again.
NATIVE := tools/native.sh $(shell find native -type f -not -path '*/build/*' -not -path '*.egg-info/*' \
  -not -path '*/__pycache__/*' -not -name 'libloopcal.*')

.NOTPARALLEL:
.PHONY: help demo test quick native evidence evidence-quick docs site fuzz bench bench-update viewer check format constraints clean

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 20

demo: .venv/core.stamp native  ## calibrate the shipped hexapod from its measurement file into runs/demo
	$(BIN)/loopcal calibrate $(ROBOT) $(DATA) -o runs/demo --hold-out 0.25 --force

test: .venv/dev.stamp native  ## every test except the full-size statistics
	$(BIN)/pytest $(PARALLEL) -m "not evidence"

quick: .venv/dev.stamp native  ## the tests that take less than a second each, about 2 min
	$(BIN)/pytest $(PARALLEL) -m "quick or not (slow or evidence)"

native: .venv/native.stamp  ## build the native engine into .venv; without a C++ compiler NumPy computes

evidence: .venv/dev.stamp native  ## statistics at full size: docs/evidence/*.json, the tables made from them, their tests
	$(BIN)/python -m tools.evidence
	$(BIN)/pytest $(PARALLEL) -m evidence

evidence-quick: .venv/dev.stamp native  ## the same scripts at a reduced size, with limits of its own; no file is written
	$(BIN)/python -m tools.evidence --quick

docs: .venv/dev.stamp  ## rewrite the tables in the documentation from docs/evidence/*.json and from the code
	$(BIN)/python -m tools.evidence --tables
	$(BIN)/python -m tools.speed_tables
	$(BIN)/python -m tools.file_reference
	$(BIN)/python -m tools.findings_reference
	$(BIN)/python -m tools.api_reference
	$(BIN)/python -m tools.readme_picture
	$(BIN)/python -m tools.robot_pictures

site: .venv/dev.stamp  ## build the documentation site, build/site/index.html; warnings and wrong links are errors
	rm -rf build/site
	$(BIN)/python -m sphinx -q -W --keep-going -c docs -d build/doctrees . build/site
	$(BIN)/python -m tools.check_site build/site --browser

fuzz: .venv/dev.stamp native  ## fuzz the command line with N random inputs (N=1000 WORKERS=1 FUZZ=runs/fuzz.json)
	@mkdir -p $(dir $(FUZZ))
	$(BIN)/python -m tools.fuzz --count $(N) --workers $(WORKERS) --add $(FUZZ)

bench: .venv/dev.stamp native  ## benchmarks against the committed baseline; fails when one got worse
	$(BIN)/python -m benchmarks.run --gate

bench-update: .venv/dev.stamp native  ## measure again and rewrite benchmarks/baseline.json (REASON="another machine")
	$(BIN)/python -m benchmarks.run --update --reason "$(REASON)"

viewer:  ## build the script of the 3-D view from tools/viewer (needs Node.js >= 18 and the npm registry)
	cd tools/viewer && npm ci --no-audit --no-fund && npm run build
	cd tools/viewer && sha256sum package.json package-lock.json build.js src/*.js \
	  ../../src/loopcal/report/scene/viewer.min.js ../../src/loopcal/report/scene/three.LICENSE.txt > SHA256SUMS

check: .venv/dev.stamp  ## lint, format, types, layers, wording
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright
	$(BIN)/python -m tools.check_types
	$(BIN)/lint-imports
	$(BIN)/python -m tools.wording

format: .venv/dev.stamp  ## let ruff sort imports and lay out the code
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

constraints: .venv/dev.stamp  ## regenerate constraints/python3.XX.txt for every Python found among 3.11 to 3.14
	$(BIN)/python -m tools.constraints

clean:  ## remove the environment and what the tools left behind
	rm -rf .venv runs build dist docs/generated .pytest_cache .ruff_cache .hypothesis .import_linter_cache

.venv/core.stamp: pyproject.toml $(wildcard constraints/*.txt)
	@tools/setup.sh core
	@touch $@

.venv/dev.stamp: pyproject.toml $(wildcard constraints/*.txt)
	@tools/setup.sh dev
	@touch .venv/core.stamp $@

# Without a compiler, or where the build fails, the stamp is not written and a line says so.
.venv/native.stamp: $(NATIVE) | .venv/core.stamp
	@tools/native.sh $@
