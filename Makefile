# Everything happens in .venv, made from requirements.lock. Nothing is needed before: on Debian 12, python3, python3-venv and make.
PYTHON ?= python3

# Qt's wheels leave these to the system: to start at all, then to open a window under X11.
QT_LIBRARIES := libglib2.0-0 libgl1 libegl1 libxkbcommon0 libdbus-1-3 libfontconfig1 \
    libxcb-cursor0 libxcb-icccm4 libxcb-image0 libxcb-keysyms1 libxcb-randr0 libxcb-render-util0 libxcb-shape0 \
    libxcb-shm0 libxcb-sync1 libxcb-xfixes0 libxcb-xkb1 libxkbcommon-x11-0 libx11-xcb1

# What Numba compiles and Matplotlib remembers stays here: the home need not be writable.
export NUMBA_CACHE_DIR ?= $(CURDIR)/.venv/cache/numba
export MPLCONFIGDIR ?= $(CURDIR)/.venv/cache/matplotlib
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Else every program that a test starts compiles Python anew, half a second.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup run check test test-slow test-long mutants storms screenshots windows docs lint lock clean qt-libraries c-compiler

help:
	@sed -n 's/^\([a-z-]*\):.*## /make \1\t/p' Makefile

setup: qt-libraries .venv/ready ## make .venv; with root, install the system libraries of Qt

run: setup ## the live window on the simulated bench
	.venv/bin/svwfs live --overwrite

# Some tests wait for a clock, so one process more than a small computer has cores; each has one thread of linear
# algebra. The tests of a file stay together because they share fixtures.
PROCESSES ?= 3
PYTEST := QT_QPA_PLATFORM=offscreen OPENBLAS_NUM_THREADS=1 .venv/bin/python -m pytest -n $(PROCESSES) --dist loadfile

QUICK := tests/reconstruction tests/drivers tests/simulated_devices/test_detector.py tests/app/bench \
    --ignore tests/reconstruction/lattice/test_lattice_survey.py --ignore tests/drivers/genicam/test_genicam.py \
    --ignore tests/reconstruction/lattice/test_lattice_refusal.py

# One room or some tests, as `make test ROOM=app/gui ONLY=colour_bar`; what does not come fails soon.
ROOM ?=
ONLY ?=
CHOSEN = $(if $(ONLY),-k '$(ONLY)') $(if $(ROOM),tests/$(ROOM))
SOON = $(if $(ROOM)$(ONLY),SVWFS_HANG_S=20)

check: lint setup c-compiler ## lint and the quick tests of numerics, devices and settings, one to two minutes
	$(PYTEST) -q -m 'not slow' $(QUICK)

test: setup c-compiler $(NUMBA_CACHE_DIR) ## the quick tests, four minutes; ROOM=app/gui, ONLY=WORDS for some
	$(SOON) $(PYTEST) -m 'not slow' $(CHOSEN)

test-slow: setup c-compiler $(NUMBA_CACHE_DIR) ## the tests that take one to four seconds, eight minutes; ROOM, ONLY as above
	$(PYTEST) -m 'slow and not long' $(CHOSEN)

# CI runs a seventh of the long tests on each day of the week, 0 to 6: all in a week.
DAY ?=
OF_DAY = $(if $(DAY),$(shell grep -rl 'mark[.]long' tests --include='test_*.py' | LC_ALL=C sort | awk 'NR % 7 == $(DAY)'))

test-long: setup c-compiler $(NUMBA_CACHE_DIR) ## those that take four seconds or more, twenty minutes; ROOM, ONLY as above; DAY=0 to 6 for a part
	$(PYTEST) -m long $(CHOSEN) $(OF_DAY)

# Else every process of the tests would compile the same code at the same time; so would each the tests' own bytecode.
COMPILING := tests/reconstruction/test_round_trips.py tests/simulated_devices/test_detector.py \
    tests/app/results/test_frame_statistics.py tests/reconstruction/frame/test_spline.py

$(NUMBA_CACHE_DIR): | setup
	@echo 'compiling, half a minute'
	@mkdir -p $@; .venv/bin/python -m pytest -q --collect-only >/dev/null & \
	.venv/bin/python -m pytest -q $(COMPILING) >/dev/null && wait

mutants: setup c-compiler ## put known faults into a copy of the source: a test must find each; ROOMS="drivers window" for some
	.venv/bin/python tests/support/run_mutants.py $(ROOMS)

storms: setup c-compiler ## 1,000 random sequences of commands and faults for every driver; ONLY=dcam for some
	SVWFS_SEQUENCES=$${SVWFS_SEQUENCES:-1000} $(PYTEST) --timeout=0 -k 'storm$(if $(ONLY), and ($(ONLY)))' tests

# About 4 GB, kept outside: what all checkouts of a computer share.
WINDOWS_CACHE ?= $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/svwfs-windows

windows: setup ## every command and every death on a Windows Python under Wine, half an hour; ONLY=light for some lines; TESTS=1: the tests
	tests/windows/make_root.sh $(WINDOWS_CACHE)
	.venv/bin/pip install -qq uv pefile
	PYTHONPATH=tests .venv/bin/python -m windows.run $(WINDOWS_CACHE)

screenshots: setup ## pictures of every panel and state into build/screenshots, some of them into docs; some minutes
	PYTHONPATH=tests .venv/bin/python -m support.screenshots build/screenshots

docs: .venv/ready ## the documentation as web pages in build/docs; warnings and broken links are errors
	.venv/bin/sphinx-build -q -W --keep-going -d build/docs.cache docs build/docs

lint: .venv/ready ## style, types, and who may import whom
	.venv/bin/ruff check
	.venv/bin/ruff format --check
	.venv/bin/mypy
	.venv/bin/lint-imports

# hatchling and editables install the project itself; uv sees to the lock and is not in it.
lock: .venv/bin/pip ## pin the dependencies again after pyproject.toml has changed
	.venv/bin/pip install -qq uv
	printf 'hatchling\neditables\n' | .venv/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
	    --no-emit-index-url --custom-compile-command 'make lock' --group dev --output-file requirements.lock pyproject.toml -

clean: ## remove .venv and every cache
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +

# svwfs.py is copied into .venv, because it is a package there.
.venv/ready: requirements.lock pyproject.toml svwfs.py | .venv/bin/pip
	@echo 'filling .venv, about a minute the first time'
	@.venv/bin/pip install -qq --require-hashes --requirement requirements.lock
	@.venv/bin/pip install -qq --no-deps --no-build-isolation --editable .
	@missing=$$(.venv/bin/pip --no-cache-dir check) || \
	    { printf '%s\nrequirements.lock does not follow pyproject.toml: make lock\n' "$$missing" >&2; exit 1; }
	@touch $@

.venv/bin/pip:
	@$(PYTHON) -m venv .venv

# The tests talk to a camera's library that they compile; nothing else needs a compiler.
c-compiler:
	@if command -v cc >/dev/null; then exit 0; fi; \
	install='apt-get install --no-install-recommends --yes gcc libc6-dev'; \
	if [ "$$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then \
	    echo "the tests need a C compiler: sudo $$install" >&2; exit 1; fi; \
	echo 'installing a C compiler for the tests'; \
	export DEBIAN_FRONTEND=noninteractive DEBCONF_NOWARNINGS=yes; apt-get update -qq; $$install >/dev/null

# Silent and quick when all are there, or where there is no apt.
qt-libraries:
	@command -v apt-get >/dev/null || exit 0; \
	installed=" $$(dpkg-query -Wf '$${db:Status-Abbrev} $${Package} $${Provides}\n' | sed -n 's/^.i//p' | tr ',\n' '  ') "; \
	missing=; for name in $(QT_LIBRARIES); do case "$$installed" in *" $$name "*) ;; *) missing="$$missing $$name" ;; esac; done; \
	if [ -z "$$missing" ]; then exit 0; fi; \
	install="apt-get install --no-install-recommends --yes$$missing"; \
	if [ "$$(id -u)" != 0 ]; then echo "Qt needs system libraries: sudo apt-get update && sudo $$install" >&2; exit 1; fi; \
	echo "installing the system libraries of Qt:$$missing"; \
	export DEBIAN_FRONTEND=noninteractive DEBCONF_NOWARNINGS=yes; apt-get update -qq; $$install >/dev/null
