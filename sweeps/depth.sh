#!/usr/bin/env bash
# Fig. 4: RefinePPO with K = 1, 2, 4 and 8 on the paper's 14 tasks, or on those given, 5 seeds each.
#
#     sweeps/depth.sh HalfCheetah-v5 | sweeps/run_local.sh -j 8
#
# One command per run on standard output. SEEDS, STEPS, RUNS_DIR and SETTINGS are explained in common.sh.

set -euo pipefail
source "$(dirname "$0")/common.sh"
parse_tasks "$all_tasks" "$@"
for task in $tasks; do
    for seed in $SEEDS; do
        for depth in 1 2 4 8; do
            job refineppo "$task" "$seed" "$depth"
        done
    done
done
