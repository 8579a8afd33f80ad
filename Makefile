# The first interpreter that runs and is 3.11 or 3.12.
SUITABLE := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 13))
PYTHON ?= $(shell for p in python3.11 python3.12 python3; do $$p -c '$(SUITABLE)' 2>/dev/null && echo $$p && break; done)
BIN := .venv/bin
RUN := $(BIN)/python -m repdib_lightning
DEMO := runs/demo

.PHONY: install demo demo-control demo-atari robot-arm mazes control urlb atari bench bench-gpu test lint clean

install: .venv/installed

# Runs again only when what it installs has changed.
.venv/installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" && $(PYTHON) -c '$(SUITABLE)' \
		|| { echo "error: needs Python 3.11 or 3.12; run: make PYTHON=/path/to/python3.12 $(MAKECMDGOALS)"; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[dev]'
	@touch $@

# The same encoder without a bottleneck and with RepDIB, on a small recording; what each kept, side by side.
demo: install
	rm -rf $(DEMO)
	test -f data/robot_arm_demo.h5 || $(RUN) collect robot_arm data/robot_arm_demo.h5 --samples 4000 --episode_length 100
	for kind in none repdib; do \
		$(RUN) fit --config robot_arm --config bottleneck/$$kind --config demo --run $(DEMO)/$$kind && \
		$(RUN) export $(DEMO)/$$kind || exit 1; \
	done
	$(RUN) compare data/robot_arm_demo.h5 $(DEMO)/report.html $(DEMO)/none $(DEMO)/repdib

# Pixels to a walking policy amid videos: data, two trainings, probes, TD3+BC on each frozen encoder, films.
demo-control: install
	rm -rf runs/demo_control
	$(RUN) fit --config control --config bottleneck/none --config demo_control --run runs/demo_control/none
	$(RUN) fit --config control --config demo_control --run runs/demo_control/repdib
	for kind in none repdib; do $(RUN) export runs/demo_control/$$kind || exit 1; done
	$(RUN) compare data/walker_walk_demo.h5 runs/demo_control/report.html runs/demo_control/none runs/demo_control/repdib
	for kind in none repdib; do \
		$(RUN) finetune td3bc --data data/walker_walk_demo.h5 --encoder runs/demo_control/$$kind \
			--run runs/demo_control/$$kind/td3bc --hidden 256 --steps 3000 --evaluate_every 1500 || exit 1; \
	done

# A game's cartridge to a policy, amid a picture on the side: data, an encoder, probes, a Decision Transformer, a film.
demo-atari: install
	rm -rf runs/demo_atari
	$(RUN) fit --config atari --config demo_atari --run runs/demo_atari/repdib
	$(RUN) export runs/demo_atari/repdib
	$(RUN) probe runs/demo_atari/repdib/bundle data/breakout_demo.h5 --probes linear
	$(RUN) finetune dt --data data/breakout_demo.h5 --encoder runs/demo_atari/repdib --run runs/demo_atari/repdib/dt \
		--layers 3 --heads 4 --width 64 --stride 10 --batch_size 64 --epochs 8 --evaluate_every 4

# The paper's robot-arm table, five seeds, full size: 35 runs, about 100 minutes on 2 cores; goes on where it stopped.
robot-arm: install
	$(RUN) suite run robot_arm
	$(RUN) suite report robot_arm

# The paper's mazes, five seeds: pre-training, DQN in three mazes, the same amid noise: about 90 minutes on 2 cores.
mazes: install
	$(RUN) suite run mazes
	$(RUN) suite report mazes

# The paper's offline visual control on walker-walk, three to five seeds; goes on where it stopped.
control: install
	$(RUN) suite run control
	$(RUN) suite report control

# The paper's reward-free exploration on the walker, three seeds: about 3.7 hours on 2 cores; goes on where it stopped.
urlb: install
	$(RUN) suite run urlb
	$(RUN) suite report urlb

# The paper's offline Atari, three to five seeds: 47 runs; goes on where it stopped.
atari: install
	$(RUN) suite run atari
	$(RUN) suite report atari

# Speed against peers and limits, about 20 minutes; writes results/benchmarks.md. Close other programs first.
bench bench-gpu: install
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	$(BIN)/python -m benchmarks $(if $(filter bench-gpu,$@),--device cuda)

# Two processes of one thread each; files stay whole.
test: install lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses 2 --dist loadfile

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy repdib_lightning

clean:
	rm -rf runs .pytest_cache .mypy_cache .ruff_cache
