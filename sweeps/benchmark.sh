#!/usr/bin/env bash
# Table 1 and Fig. 2: PPO and RefinePPO on the paper's 14 tasks, or on those given, 5 seeds each.
#
#     sweeps/benchmark.sh | sweeps/run_local.sh -j 16
#     SEEDS="1 2 3" STEPS=1000000 sweeps/benchmark.sh Hopper-v5 Ant-v5
#
# One command per run on standard output. SEEDS, STEPS, RUNS_DIR and SETTINGS are explained in common.sh.

set -euo pipefail
source "$(dirname "$0")/common.sh"
parse_tasks "$all_tasks" "$@"
for task in $tasks; do
    for seed in $SEEDS; do
        job ppo "$task" "$seed"
        job refineppo "$task" "$seed"
    done
done
