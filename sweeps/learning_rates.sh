#!/usr/bin/env bash
# Is it the step size? The step sizes c_k add up to 4 (uniform) or 1 (average) at K = 4, so that one learning rate moves
# the action mean by different amounts. PPO, and K = 4 under both schedules, with a third and with three times the task's
# learning rate, on three tasks, or on those given, 3 seeds and 1M steps each.
#
#     FLAGS="--eval-interval 50000" sweeps/learning_rates.sh | sweeps/run_local.sh
#
# One command per run on standard output, seed by seed. --help explains SEEDS, STEPS, RUNS_DIR, SETTINGS, FLAGS, DONE.

set -euo pipefail
export STEPS=${STEPS:-1000000} SEEDS=${SEEDS:-1 2 3}
exec python "$(dirname "$0")/generate.py" "$0" "$@"
