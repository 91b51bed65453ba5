#!/usr/bin/env bash
# The paper's two-dimensional coordination example (toy_env.py): PPO against RefinePPO with K = 1, 2 and 4 under the
# uniform and the average schedule. How many steps until it is solved? `report.py` counts. Runs of seconds.
#
#     sweeps/toy.sh | sweeps/run_local.sh -j 2
#
# One command per run on standard output; STEPS is 50000 here. SEEDS, RUNS_DIR and SETTINGS are explained in common.sh.

set -euo pipefail
STEPS=${STEPS:-50000}
source "$(dirname "$0")/common.sh"
parse_tasks sweeps.toy_env:Coordination-v0 "$@"
extra=" --num-envs 16 --num-steps 64 --num-minibatches 8 --log-std-init -2"
extra+=" --eval-interval 1024 --eval-episodes 50"
[ $# = 0 ] || refuse "the toy is one task; there are no arguments"
for seed in $SEEDS; do
    job ppo "$tasks" "$seed"
    for depth in 1 2 4; do
        for schedule in uniform average; do
            job refineppo "$tasks" "$seed" $depth $schedule
        done
    done
done
