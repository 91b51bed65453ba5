#!/usr/bin/env bash
# The paper's two-dimensional coordination example (toy_env.py): PPO against RefinePPO with K = 1, 2 and 4 under the
# uniform and the average schedule. How many steps until it is solved? `report.py` counts. Runs of seconds.
#
#     sweeps/toy.sh | sweeps/run_local.sh -j 2
#
# One command per run on standard output, seed by seed; STEPS is 50000 here, and toy.args the settings. --help explains
# SEEDS, STEPS, RUNS_DIR, FLAGS, DONE.

set -euo pipefail
export STEPS=${STEPS:-50000}
exec python "$(dirname "$0")/generate.py" "$0" "$@"
