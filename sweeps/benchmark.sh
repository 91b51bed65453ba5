#!/usr/bin/env bash
# Table 1 and Fig. 2: PPO and RefinePPO on the paper's 14 tasks, or on those given, 5 seeds each.
#
#     sweeps/benchmark.sh | sweeps/run_local.sh -j 16
#     SEEDS="1 2 3" STEPS=1000000 sweeps/benchmark.sh Hopper-v5 Ant-v5
#
# One command per run on standard output, seed by seed. --help explains SEEDS, STEPS, RUNS_DIR, SETTINGS, FLAGS, DONE.

set -euo pipefail
exec python "$(dirname "$0")/generate.py" "$0" "$@"
