# Every target sets up what it needs in .venv: a fresh machine needs make and a Python 3.11 to 3.13 with venv, nothing more.

SHELL := /bin/sh
IS_USABLE := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do \
  $$p -c '$(IS_USABLE)' >/dev/null 2>&1 && { echo $$p; break; }; done)

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
DOCS_READY := $(VENV)/docs-ready
DEMO_OUT := out/hanging_beam

NO_WINDOW := import sys; from taisoft.view.window.ggui import display_missing, vulkan_missing; m = display_missing() or vulkan_missing(); \
  sys.exit(f'No window here, since {m}; make demo writes pictures instead.' if m else 0)

.PHONY: demo window test test-long figures docs wheel lint clean

demo: $(READY)
	$(BIN)/taisoft run hanging_beam --headless --out $(DEMO_OUT) --overwrite
	@echo "Written to $(DEMO_OUT): report.json (what happened), steps.csv (every step), frames/ (pictures), scene.usdc (USD)."

# A sheet falls on a box in the live window. The first time, kernels are compiled before: with a window it would take twice as long.
window: $(READY)
	@$(BIN)/python -c "$(NO_WINDOW)"
	@[ -f $(VENV)/window-ready ] || { echo "Compiling kernels, once, for about half a minute."; \
	  $(BIN)/taisoft run sheet_on_box --headless --seconds 0.3 >/dev/null 2>&1 && touch $(VENV)/window-ready; }
	$(BIN)/taisoft run sheet_on_box

# One thread for the dense algebra of each worker: more only spin on cores that the others need.
test test-long: export OPENBLAS_NUM_THREADS := 1

test: $(READY)
	$(BIN)/python -m pytest -q -n auto --maxprocesses 8

test-long: $(READY)
	$(BIN)/python -m pytest -q -n auto --maxprocesses 8 --long

# about three hours; the comparison needs the other programs
figures: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,peers]'
	$(BIN)/taisoft bench figures

# Runs every example of the manual, then builds it, which runs its notebooks; any warning is an error.
docs: $(DOCS_READY)
	$(BIN)/python -m pytest -q -n auto --maxprocesses 8 --dist loadfile -p no:cacheprovider -p no:warnings docs
	$(BIN)/sphinx-build -q -n -W --keep-going -d out/doctrees docs out/docs
	@echo "Written to out/docs: open out/docs/index.html."

# Builds the sdist, and the wheel from it, checks both, installs the wheel in an environment of its own, and runs a demo from there.
wheel: $(READY)
	rm -rf out/wheel
	@[ -f out/docs/index.html ] || echo "The wheel will lack the manual: make docs builds it."
	@[ -z "$$(find docs -name '*.md' -newer out/docs/index.html 2>/dev/null)" ] || echo "The manual in out/docs is older than its pages: make docs."
	$(BIN)/python -m build --outdir out/wheel . >/dev/null
	$(BIN)/twine check --strict out/wheel/taisoft-*
	$(BIN)/python -m venv out/wheel/venv
	out/wheel/venv/bin/python -m pip install --quiet --disable-pip-version-check out/wheel/*.whl
	cd out/wheel && venv/bin/taisoft run hanging_beam --headless --seconds 0.1 --out run && venv/bin/taisoft doctor
	@echo "Written to out/wheel: sdist and wheel, which installs and runs."

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet . || { echo "Run $(BIN)/ruff format ." >&2; exit 1; }

# pip and venv build into $(VENV); the stamp is written last, so that an installation cut short is done again.
$(READY): pyproject.toml
	@[ -n "$(PYTHON)" ] || { echo "No Python 3.11 to 3.13 with venv was found: install one" \
	  "(Debian: apt install python3-venv) or name it: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $(READY)

$(DOCS_READY): $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@touch $(DOCS_READY)

clean:
	rm -rf $(VENV) out build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
