#!/usr/bin/env bash
# Table 2: RefinePPO under its three schedules on the paper's nine MuJoCo tasks, or on those given, 5 seeds each.
#
#     sweeps/schedule.sh | sweeps/run_slurm.sh --max-running 64 -- --time=4:00:00
#
# One command per run on standard output. SEEDS, STEPS, RUNS_DIR and SETTINGS are explained in common.sh.

set -euo pipefail
source "$(dirname "$0")/common.sh"
parse_tasks "$mujoco" "$@"
for task in $tasks; do
    for seed in $SEEDS; do
        for schedule in average uniform inverse; do
            job refineppo "$task" "$seed" "" "$schedule"
        done
    done
done
