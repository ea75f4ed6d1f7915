# Two commands on a fresh machine with python3 >= 3.11, make and git:
#   make run     runs the default scenario and prints where the report is
#   make test    checks format, lint and types, then runs the tests
# More commands:
#   make test-long       runs the tests that `make test` leaves out
#   make bench   measures speed
#   make false-alarms    simulates an hour without a fault and counts alarms
#   make hardware-demo   runs the hardware command on a simulated robot
#   make fault-table     measures how fast each fault stops that robot
#   make endurance       watches memory and open files for an hour of each
#   make fuzz    feeds 100 000 broken inputs to every parser
#   make audit   looks for known faults in the pinned versions, on the Internet
#   make images          makes the pictures in docs/images again
# With another Python, in an environment of its own:
#   make PYTHON=python3.12 VENV=.venv312 test

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= out/default

# The exact versions for the environment's Python, if they are listed. Expanded
# only when something is installed: by then the environment exists.
CONSTRAINTS = $(wildcard constraints-$(shell $(BIN)/python -c \
	'import sys; print("%d.%d" % sys.version_info[:2])').txt)
PIP_INSTALL = $(BIN)/python -m pip install --quiet \
	--disable-pip-version-check $(addprefix --constraint ,$(CONSTRAINTS))
TELL_UNPINNED = @$(if $(CONSTRAINTS),:,echo "No constraints file for" \
	"$$($(BIN)/python --version): the newest versions are installed")

# Drake's wheel needs three common libraries from the system.
CHECK_DRAKE := @$(BIN)/python -c 'import pydrake.common' 2> /dev/null || \
	scripts/install_system_packages.sh \
	  "Drake lacks libraries" libglib2.0-0 libsm6 libx11-6

# A file's tests share their runs; files that take longest come first.
PYTEST := $(BIN)/python -m pytest --numprocesses auto --dist loadfile \
	--no-loadscope-reorder

.PHONY: run hardware-demo fault-table false-alarms images test test-long \
	bench endurance format fuzz audit clean

run: $(VENV)/.installed
	$(BIN)/tofssm simulate --out $(OUT)

hardware-demo: $(VENV)/.installed
	$(BIN)/tofssm hardware-demo --out out/hardware

test: $(VENV)/.installed-test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/python tests/check_types.py
	$(PYTEST) -m "not long"

test-long: $(VENV)/.installed-test
	$(PYTEST) -m long

bench: $(VENV)/.installed-test
	$(BIN)/python -m pytest benchmarks --benchmark-columns=min,median,max,rounds

fault-table: $(VENV)/.installed-test
	$(BIN)/python tests/hardware/fault_table.py

endurance: $(VENV)/.installed-test
	$(BIN)/python benchmarks/endurance.py

false-alarms: $(VENV)/.installed-test
	$(BIN)/python benchmarks/false_alarms.py

fuzz: $(VENV)/.installed-test
	$(PIP_INSTALL) --editable '.[fuzz]'
	$(BIN)/python tests/fuzz/fuzz.py

audit: $(VENV)/.installed
	$(PIP_INSTALL) --editable '.[audit]'
	$(BIN)/python tests/packaging/audit.py

images: $(VENV)/.installed-test
	$(BIN)/python -m tofssm_drake.scripts.draw_docs docs/images

format: $(VENV)/.installed-test
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) build out *.egg-info

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "$(PYTHON) is older than 3.11: give another one," \
	    "e.g. make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2> /dev/null || \
	  scripts/install_system_packages.sh \
	    "$(PYTHON) cannot make a virtual environment" python3-venv
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml $(wildcard constraints-*.txt) | $(BIN)/python
	$(TELL_UNPINNED)
	$(PIP_INSTALL) --editable .
	$(CHECK_DRAKE)
	@touch $@

$(VENV)/.installed-test: pyproject.toml $(wildcard constraints-*.txt) | $(BIN)/python
	$(TELL_UNPINNED)
	$(PIP_INSTALL) --editable '.[meshes,test]'
	$(PIP_INSTALL) --only-binary mujoco,pybullet,ur_rtde --editable '.[peers]' || \
	  echo "MuJoCo, PyBullet and ur_rtde cannot be installed:" \
	    "nothing is compared"
	$(CHECK_DRAKE)
	@touch $@ $(VENV)/.installed
