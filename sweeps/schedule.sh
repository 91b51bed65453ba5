#!/usr/bin/env bash
# Table 2: RefinePPO under its three schedules on the paper's nine MuJoCo tasks, or on those given, 5 seeds each.
#
#     sweeps/schedule.sh | sweeps/run_slurm.sh --max-running 64 -- --time=4:00:00
#
# One command per run on standard output, seed by seed. --help explains SEEDS, STEPS, RUNS_DIR, SETTINGS, FLAGS, DONE.

set -euo pipefail
exec python "$(dirname "$0")/generate.py" "$0" "$@"
