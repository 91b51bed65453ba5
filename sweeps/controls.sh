#!/usr/bin/env bash
# Is it the refinement? K = 1, 2 and 8, the schedules uniform and inverse at K = 4, and two PPO actors with about as many
# multiplications as K = 4: five hidden layers of 128, and 256 x 256 (216 x 216 on HumanoidStandup, where the observation
# is long). On five tasks, or on those given, 5 seeds and 1M steps each; what they are compared with is benchmark.sh's.
#
#     FLAGS="--eval-interval 50000" sweeps/controls.sh | sweeps/run_local.sh
#
# One command per run on standard output, seed by seed. --help explains SEEDS, STEPS, RUNS_DIR, SETTINGS, FLAGS, DONE.

set -euo pipefail
export STEPS=${STEPS:-1000000}
exec python "$(dirname "$0")/generate.py" "$0" "$@"
