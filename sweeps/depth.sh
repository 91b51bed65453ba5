#!/usr/bin/env bash
# Fig. 4: RefinePPO with K = 1, 2, 4 and 8 on the paper's 14 tasks, or on those given, 5 seeds each.
#
#     sweeps/depth.sh HalfCheetah-v5 | sweeps/run_local.sh -j 8
#
# One command per run on standard output, seed by seed. --help explains SEEDS, STEPS, RUNS_DIR, SETTINGS, FLAGS, DONE.

set -euo pipefail
exec python "$(dirname "$0")/generate.py" "$0" "$@"
