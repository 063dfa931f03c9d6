# The two commands of the README: `make demo` and `make test`. Both make a .venv by themselves.
PYTHON ?= python3
BIN := .venv/bin
KILLS ?= 50
SWITCHES ?= 2
CAMPAIGNS ?= 120

# Small dense algebra is faster on one thread.
export OMP_NUM_THREADS = 1
# What is imported is compiled then, and for all processes, rather than all 18,000 modules by pip.
unexport PYTHONDONTWRITEBYTECODE
PIP := -m pip install --quiet --disable-pip-version-check --no-compile

.PHONY: demo test suite quick thorough check docs reliability interleavings crash-states attack lowest bench bench-peers study study-refine frozen reproduce search global-search calibrate drawn-tests parts pictures posterior-ranks servo robots watch envelope friction safety simulated-robots causes dist clean

demo: .venv/.installed
	$(BIN)/ctxval run pendulum

test: .venv/.test
	$(MAKE) --jobs 2 check suite  # mypy has one thread

suite: .venv/.compiled
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal

quick: .venv/.test  ## everything that takes less than half a second, on all cores, for daily work
	$(BIN)/python -m pytest -q -m "not slow" --numprocesses auto --dist worksteal

thorough: .venv/.test lowest  ## `make test` with more seeds, sizes and examples; takes about an hour
	$(BIN)/python $(PIP) --editable '.[docs]' 'ray>=2.40'  # 240 MB
	$(BIN)/python -m pytest --thorough --numprocesses auto --dist worksteal

check: .venv/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python tests/page_blocks.py
	$(BIN)/mypy

reliability: .venv/.test  ## kill -9 and resume, KILLS times
	$(BIN)/python -m pytest tests/campaign/test_kill.py --kills $(KILLS)

interleavings: .venv/.test  ## two processes on one store, switched SWITCHES times at every statement
	$(BIN)/python -m pytest --thorough tests/campaign/test_interleavings.py --switches $(SWITCHES)

crash-states: .venv/.test  ## power cuts, thousands of them; needs strace; writes docs/reliability.md
	$(BIN)/python benchmarks/crash_states.py
	$(BIN)/python benchmarks/crash_states.py --synchronous FULL
	$(BIN)/python benchmarks/reliability.py

attack: .venv/.test  ## hostile input, thousands of command lines; better with strace; writes docs/reliability.md, and resumes
	$(BIN)/python benchmarks/attack.py
	$(BIN)/python benchmarks/reliability.py

# The lowest typer imports what the newest click warns of.
lowest: .venv/lowest/.installed  ## the page's security, with the lowest versions that pyproject.toml permits
	.venv/lowest/bin/python -m pytest -q -p no:cacheprovider -W "ignore:'click.utils:DeprecationWarning" \
	  tests/web/test_security.py tests/web/test_connections.py tests/web/test_app.py \
	  -k "test_security or three_hundred or send_much or nonsense or (refused and not wrong_file)"

bench: .venv/.test  ## speed, as ratios measured in one run
	failed=0; for script in benchmarks/bench_*.py; do $(BIN)/python $$script || failed=1; done; exit $$failed

bench-peers: .venv/peers/.installed .venv/peers-verifai/.installed  ## beside others; writes docs/benchmarks.md, and resumes
	cd benchmarks && for group in peers peers-verifai; do for part in run overhead; do \
	  ../.venv/$$group/bin/python -W ignore -m peers.$$part || exit 1; done; done
	cd benchmarks && ../.venv/peers/bin/python -m peers.page

study: .venv/.test  ## the running example over many seeds, from the runs of `make reproduce`; writes docs/main-job.md
	$(BIN)/python benchmarks/study_main_job.py

study-refine: .venv/.test  ## how much better refined models are; writes docs/refinement.md, and resumes
	$(BIN)/python benchmarks/study_refine.py

docs: .venv/.test  ## the manual, with its gallery; writes docs/_build/html, and looks for broken links
	$(BIN)/python $(PIP) --editable '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html
	$(BIN)/python -m pytest -q --thorough --manual=docs/_build/html tests/test_manual_pages.py tests/test_how_to.py -k "manual_is_built or accessible or blocks"

frozen: .venv/.test  ## do stored campaigns still end and choose as they did? Nothing is executed
	$(BIN)/python benchmarks/frozen_replay.py --workers 2

pictures: .venv/.test  ## those of the README and of the manual; needs Chromium and EGL
	$(BIN)/ctxval run pendulum --search gp-ucb --seed 1 --store docs/pictures/pendulum.sqlite --no-report
	rm docs/pictures/pendulum.sqlite
	$(BIN)/python benchmarks/report_picture.py
	$(BIN)/python benchmarks/robot_picture.py

calibrate: .venv/.test  ## do the bounds hold as often as they say? Writes docs/calibration.md, and resumes
	$(BIN)/python benchmarks/calibrate.py --campaigns $(CAMPAIGNS)
	$(BIN)/python benchmarks/calibrate_verdicts.py
	$(BIN)/python benchmarks/dynamics_truths.py
	$(BIN)/python benchmarks/strangers_truths.py
	$(BIN)/python benchmarks/calibrate_dynamics.py
	$(BIN)/python benchmarks/calibrate_strangers.py development
	$(BIN)/python benchmarks/calibrate_strangers.py reporting
	$(BIN)/python benchmarks/calibrate_noise.py development
	$(BIN)/python benchmarks/calibrate_noise.py misleading
	$(BIN)/python benchmarks/calibrate_noise.py reporting
	$(BIN)/python benchmarks/calibrate_outputs.py
	$(BIN)/python benchmarks/study_interval.py
	$(BIN)/python benchmarks/study_time_varying.py
	$(BIN)/python benchmarks/study_retrain.py
	$(BIN)/python benchmarks/calibration_page.py

compare-study: .venv/.test  ## how many executions comparisons need; writes docs/comparison.md, and resumes
	$(BIN)/python benchmarks/study_compare.py
	$(BIN)/python benchmarks/compare_page.py

servo: .venv/.test  ## campaigns on the recordings of a real servo; writes docs/servo.md, and resumes
	$(BIN)/python benchmarks/study_servo.py
	$(BIN)/python benchmarks/servo_page.py

robots: .venv/.test  ## verdicts on models of real robots; writes docs/robots.md and its cards, and resumes
	cd benchmarks && ../$(BIN)/python -m robots.study && ../$(BIN)/python -m robots.page

safety: .venv/.test  ## which environments are safe: certified beside true ones? Writes docs/how-to/safety.md, and resumes
	$(BIN)/python benchmarks/study_safety.py
	$(BIN)/python benchmarks/safety_page.py

watch: .venv/.test  ## does a watch notice that a system has changed? Writes docs/how-to/watch.md, and resumes
	$(BIN)/python benchmarks/study_watch.py development --tasks 300
	$(BIN)/python benchmarks/study_watch.py reporting --tasks 300
	$(BIN)/python benchmarks/watch_page.py

envelope: .venv/.test  ## which part of the true set envelopes find; writes docs/envelope.md, and resumes
	$(BIN)/python benchmarks/study_envelope.py

friction: .venv/.test  ## how campaigns on systems with dry friction end; writes docs/dry-friction.md, and resumes
	$(BIN)/python benchmarks/study_friction.py

simulated-robots: .venv/.test  ## verdicts and causes of robots in simulators; writes docs/simulated-robots.md, and resumes
	$(BIN)/python benchmarks/study_simulated_robots.py

causes: .venv/.test  ## does `ctxval why` name the fault of a robot? Writes docs/how-to/causes.md, and resumes
	$(BIN)/python benchmarks/study_causes.py development
	$(BIN)/python benchmarks/study_causes.py reporting
	$(BIN)/python benchmarks/study_causes.py servo
	$(BIN)/python benchmarks/causes_page.py

posterior-ranks: .venv/.test  ## are draws of the learned dynamics as uncertain as they should be? Resumes
	$(BIN)/python benchmarks/study_posterior_ranks.py

search: .venv/.test  ## how many executions the searches need; writes docs/searches.md, and resumes
	$(BIN)/python benchmarks/study_auto.py
	$(BIN)/python benchmarks/study_scalar.py linear-10 --search scalar --seeds 60
	$(BIN)/python benchmarks/study_scalar.py dubins-basin
	$(BIN)/python benchmarks/study_scalar.py dubins-basin --search scalar --seeds 30
	$(BIN)/python benchmarks/misleading.py
	$(BIN)/python benchmarks/study_plants.py
	$(BIN)/python benchmarks/study_ablations.py
	$(BIN)/python benchmarks/study_global_search.py
	$(BIN)/python benchmarks/search_page.py

global-search: .venv/.test  ## what a global search of the true systems finds; writes docs/searches.md, and resumes
	$(BIN)/python benchmarks/study_global_search.py
	$(BIN)/python benchmarks/search_page.py

drawn-tests: .venv/.test  ## do tests at drawn tasks keep verdicts from lifts and posts? Resumes
	$(BIN)/python benchmarks/study_drawn_tests.py

parts: .venv/.test  ## the parts and the commands; writes docs/parts.md and docs/reference/command-line.md
	$(BIN)/python benchmarks/checks_page.py
	$(BIN)/python benchmarks/parts_page.py
	$(BIN)/python benchmarks/command_line_page.py

dist: .venv/.test  ## the wheel and the source distribution, each at most 1.5 MB and tried in an empty environment
	rm -rf dist && $(BIN)/python -m hatchling build
	for file in dist/*; do \
	  test $$(wc -c < $$file) -le 1500000 || { echo "$$file is too large"; exit 1; }; \
	  rm -rf .venv/dist && $(PYTHON) -m venv .venv/dist && .venv/dist/bin/python $(PIP) $$file && \
	  .venv/dist/bin/ctxval run pendulum --search random --budget 2 --store .venv/dist/try.sqlite || exit 1; \
	done

clean:
	rm -rf .venv build dist docs/_build docs/auto_examples docs/reference/api

.venv/bin/python:
	$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("ctxval needs Python 3.11 or later; say: make PYTHON=python3.11")'
	$(PYTHON) -m venv .venv

.venv/.installed: pyproject.toml | .venv/bin/python
	$(BIN)/python $(PIP) --editable .
	touch $@

.venv/.test: pyproject.toml | .venv/bin/python
	$(BIN)/python $(PIP) --editable '.[test]'
	touch $@ .venv/.installed

.venv/.compiled: .venv/.test  # by one process, because those of the suite would each compile all of it
	$(BIN)/python -m pytest -qq --collect-only > /dev/null || true  # the suite says what is wrong
	touch $@

.venv/lowest/.installed: pyproject.toml | .venv/bin/python
	$(BIN)/python -m venv $(@D)
	$(BIN)/python -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
	  print(*(r.replace(">=", "==") for r in p["dependencies"] + p["optional-dependencies"]["web"]), sep="\n")' > $(@D)/lowest.txt
	$(@D)/bin/python $(PIP) -c $(@D)/lowest.txt --editable '.[web]' pytest hypothesis
	touch $@

.venv/peers/.installed .venv/peers-verifai/.installed: .venv/%/.installed: pyproject.toml | .venv/bin/python
	$(BIN)/python -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check --upgrade 'pip>=25.1'  # knows groups
	$(@D)/bin/python -m pip install --quiet --editable '.[searches,cases,mujoco]' --group $*
	touch $@

reproduce: .venv/.test  ## the paper's experiments in full; writes docs/reproduction.md, and resumes
	$(BIN)/python benchmarks/reproduce_paper.py all --results benchmarks/results/reproduce
