# Two commands on a fresh Debian 12 with python3-venv and make: `make demo` and `make test`. Each makes .venv when it is missing.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
KERNELS := $(shell grep -rlE --include='*.py' 'njit|^@(compiled|inlined)' fdhil studies)
# the tests marked socketcan stand in these folders; the machine in which they run has little memory for others
VCAN   := bash tests/integration/vcan-vm.sh -t 1800 -M 2048

# tests against LinuxCNC stand in these folders; of it a computer runs one at a time
LINUXCNC := tests/linuxcnc tests/program

# of make fuzz: inputs to each way in, and when to go on to the next one before that
N       ?= 2000
SECONDS ?= 100000

# a child process need not translate fdhil again
unexport PYTHONDONTWRITEBYTECODE

# folders that make test and make test-processes leave out, as .ci/run does for the guard's, which make guard tests
EXCEPT  ?=

# worker processes of make test-processes, as .ci/run sets them: its tests wait for other processes half of the time
WORKERS ?= 2

.PHONY: help environment setup foreign docs demo test test-system test-linuxcnc test-processes test-full test-vcan near nightly swarm faults fuzz guard proof mutants audit loaded dist lint bench study lock clean

help:            ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "  make %-14s %s\n", $$1, $$2}'

$(VENV)/.ok: pyproject.toml requirements.lock
	@$(PYTHON) -c 'import ensurepip, sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "fdhil needs Python 3.11 or newer with venv: on Debian 12, apt-get install python3-venv" >&2; exit 1; }
	@echo "setting up $(VENV) (once, under a minute)"
	@$(PYTHON) -m venv $(VENV)
	@if command -v uv >/dev/null 2>&1; then \
	  uv pip install -q --python $(BIN)/python --require-hashes -r requirements.lock && \
	  uv pip install -q --python $(BIN)/python --no-deps --no-build-isolation -e .; \
	else \
	  $(BIN)/python -m pip install -q --disable-pip-version-check --require-hashes -r requirements.lock && \
	  $(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .; \
	fi
	@touch $@

$(VENV)/.kernels: $(VENV)/.ok $(KERNELS)
	@echo "compiling the kernels (once, about a minute)"
	@find fdhil studies -name '*.nb[ic]' -delete # a kernel that was compiled into another one is not looked at again
	@$(BIN)/python -m fdhil.cli.kernel_compilation
	@$(BIN)/python -m studies.kernels
	@touch $@

environment: $(VENV)/.ok ## make .venv with everything in it

setup: $(VENV)/.kernels ## the same, kernels compiled

foreign: setup   ## the CANopen stack of node.js that some tests talk to
	@command -v npm >/dev/null || { echo "make test-system needs npm: apt-get install nodejs npm" >&2; exit 1; }
	@npm ci --prefix tests/foreign --ignore-scripts --no-audit --no-fund --silent

demo: setup      ## the whole loop on the simulated machine; the report is out/report.html
	@$(BIN)/fdhil demo --out out

test: setup      ## the fast tests: no processes, no Debian packages
	@$(BIN)/python -m pytest -q -m "not system" $(EXCEPT:%=--ignore %) -n 2 --dist loadfile

test-system: test-linuxcnc test-processes ## the tests with processes, terminals, browsers, brokers and other people's programs; needs Debian packages

test-linuxcnc: setup ## those against LinuxCNC, which wait for it most of the time
	@command -v rs274 >/dev/null || { echo "make test-system needs rs274: apt-get install linuxcnc-uspace" >&2; exit 1; }
	@$(BIN)/python -m pytest -q -m "system and not socketcan" $(LINUXCNC)

test-processes: foreign ## the other ones
	@command -v chromium >/dev/null || { echo "make test-system needs chromium: apt-get install chromium" >&2; exit 1; }
	@PATH="$$PATH:/usr/sbin"; command -v mosquitto >/dev/null || { echo "make test-system needs mosquitto: apt-get install mosquitto" >&2; exit 1; }
	@command -v promtool >/dev/null || { echo "make test-system needs promtool: apt-get install prometheus" >&2; exit 1; }
	@command -v strace >/dev/null && command -v faketime >/dev/null || { echo "make test-system needs strace and faketime: apt-get install strace faketime" >&2; exit 1; }
	@PATH="$$PATH:/usr/sbin"; command -v nats-server >/dev/null && ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1 || { echo "make test-system needs nats-server and PostgreSQL: apt-get install nats-server postgresql" >&2; exit 1; }
	@$(BIN)/python -m pytest -q -m "system and not socketcan" $(LINUXCNC:%=--ignore %) $(EXCEPT:%=--ignore %) -n $(WORKERS) --dist loadfile

test-full: test test-system ## both tiers

test-vcan: setup ## the integration suite and the socket tests on a real SocketCAN interface
	@$(VCAN) $(BIN)/python -m pytest -q -p no:cacheprovider -m socketcan tests/socketcan tests/integration tests/foreign

near: setup      ## the fast tests nearest to what was changed, as many as fit into half a minute
	@$(BIN)/python -m pytest -q -m "not system" -p tests.near -n 2 --dist loadfile

nightly: setup   ## what takes hours: fuzzing by the million, Monte-Carlo studies, mutants, the fault matrix (power cuts among it)
	@$(MAKE) fuzz N=1000000
	@$(MAKE) study
	@$(MAKE) mutants
	@$(MAKE) faults

faults: setup    ## the fault matrix, row by row, and the goals R1 to R20: to docs/studies/faults.md; needs what make test-system needs
	@$(BIN)/python -m pytest -q -p tests.fault_table --fault-table docs/studies/faults.md -m "(fault or goal) and not socketcan"
	@$(VCAN) -w docs/studies $(BIN)/python -m pytest -q -p no:cacheprovider -p tests.fault_table --fault-table docs/studies/faults.md --on-socketcan -m "fault and socketcan" tests/socketcan tests/integration tests/foreign

fuzz: setup      ## any bytes at every way in, N for each (make fuzz N=1000000); what hurts is kept in out/fuzz/found
	@mkdir -p out/fuzz
	@$(BIN)/python -m studies.fuzz --out out/fuzz --inputs $(N) --seconds $(SECONDS)

swarm: N = 200
swarm: SECONDS = 60
swarm: setup     ## N random machines, each from one seed and for SECONDS of virtual time; the page is out/swarm/swarm.md
	@$(BIN)/python -m studies.swarm --machines $(N) --seconds $(SECONDS) $(if $(SEED),--first-seed $(SEED)) --out out/swarm

guard: setup     ## the guard's own tests, in its processes too; a branch of it that none of them takes is an error
	@$(BIN)/python -m coverage erase
	@$(BIN)/python -m coverage run -m pytest -q -m "not socketcan and not debian" -n 2 --dist loadfile tests/guard
	@$(BIN)/python -m coverage combine -q
	@$(BIN)/python -m coverage report --include 'fdhil/guard/*' --show-missing --skip-covered --fail-under 100
	@$(BIN)/python -m coverage erase

proof: setup     ## the proof that the guard keeps its limits and comes to zero; docs/explanation/proof.md says what is proven
	@$(BIN)/python -m pytest -q tests/proof

mutants: setup   ## what the guard's tests notice of mistakes put into it, one at a time (hours); the page is docs/studies/mutants.md
	@$(BIN)/python -m studies mutants

audit: environment ## the bill of materials in out/sbom.json, and what is known against the packages of requirements.lock
	@$(BIN)/python .ci/audit out/sbom.json

loaded: setup    ## both tiers and the demonstration again and again, idle and next to four busy loops
	@.ci/loaded --run 15 5 "$(MAKE) -s test" --run 5 5 "$(MAKE) -s test-system" --run 0 5 "$(MAKE) -s demo"

dist: environment ## sdist and wheel, to out/dist; twine upload out/dist/* publishes them
	@$(BIN)/python -m hatchling build -d out/dist >/dev/null

lint: environment ## ruff, mypy, import-linter, deptry, codespell, and the house rules
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/deptry .
	@$(BIN)/codespell
	@! grep -n '://' requirements.lock || { echo "requirements.lock names an address" >&2; exit 1; }

docs: environment ## the site of the documents, in out/site; a broken link is an error
	@$(BIN)/python -m sphinx -W --keep-going -q -b html docs out/site

bench: setup     ## the benchmarks; results go to docs/benchmarks.md
	@$(BIN)/python -m benchmarks

study: setup     ## the Monte-Carlo studies; results go to docs/
	@$(BIN)/python -m studies

lock:            ## resolve requirements.lock again (needs uv)
	uv pip compile --universal --python-version 3.11 --generate-hashes --no-header --no-annotate --upgrade \
	  --group dev pyproject.toml -o requirements.lock >/dev/null

clean:           ## remove what the targets made
	rm -rf $(VENV) out .pytest_cache .mypy_cache .ruff_cache .hypothesis
