# shellcheck shell=bash
# What the job generators share; they print commands and do nothing else. From the environment:
#
#     SEEDS      "1 2 3 4 5"
#     STEPS      environment steps of a run, 6000000
#     RUNS_DIR   where the run folders go, runs
#     SETTINGS   folder of the tasks' settings, {ppo,refineppo}/<task>.args; `none` for the scripts' defaults
#
# A run's folder is <task>__<method>__<settings>__<seed>: the same run has the same folder, and the same command, in
# every sweep, so that it is trained once.

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
root=$(dirname "$here")
SEEDS=${SEEDS:-1 2 3 4 5}
STEPS=${STEPS:-6000000}
RUNS_DIR=${RUNS_DIR:-runs}
RUNS_DIR=${RUNS_DIR%/}
SETTINGS=${SETTINGS:-$here/settings}

mujoco="Ant-v5 HalfCheetah-v5 Hopper-v5 Walker2d-v5 Swimmer-v5 Pusher-v5 Reacher-v5 HumanoidStandup-v5 Humanoid-v5"
# shellcheck disable=SC2034  # used by the generators
all_tasks="$mujoco Pendulum-v1 MountainCarContinuous-v0 LunarLanderContinuous-v3 BipedalWalker-v3 BipedalWalkerHardcore-v3"

refuse() {
    echo "$(basename "$0"): error: $1" >&2
    exit 2
}

# parse_tasks DEFAULT [ARGUMENT...]: sets `tasks` to a generator's arguments, or to the default, and checks all input
parse_tasks() {
    local word algorithm
    tasks=${*:2}
    tasks=${tasks:-$1}
    for word in "${@:2}"; do
        case $word in
            -h | --help) sed -nE '2,/^$/s/^#( |$)//p' "$0"; exit 0 ;;
            -* | '' | *[[:space:]]*) refuse "$word is no task; the arguments are tasks, such as Hopper-v5" ;;
        esac
    done
    for word in $SEEDS; do
        case $word in *[!0-9]* | 0?*) refuse "SEEDS must be whole numbers with spaces between, not '$SEEDS'" ;; esac
    done
    [ -n "${SEEDS// /}" ] || refuse "SEEDS is empty"
    case $STEPS in *[!0-9]* | 0*) refuse "STEPS must be a whole number, not '$STEPS'" ;; esac
    [ "$SETTINGS" = none ] || [ -d "$SETTINGS" ] || refuse "there is no settings folder $SETTINGS"
    for word in $tasks; do
        for algorithm in ppo refineppo; do
            read_settings "$algorithm" "$word" # refuses before the first command is printed
        done
    done
}

# read_settings ALGORITHM TASK: sets `flags`, and `depth` and `schedule`, which stand apart since sweeps vary them
read_settings() {
    local file=$SETTINGS/$1/${2//\//_}.args words=() i
    flags='' depth=4 schedule=average
    [ "$SETTINGS" != none ] && [ -f "$file" ] || return 0
    IFS=$' \t\r\n' read -r -d '' -a words < <(sed 's/#.*//' "$file") || true
    for ((i = 0; i < ${#words[@]}; i++)); do
        case ${words[i]} in
            --*[=_]*) refuse "$file: write ${words[i]} with dashes and a blank, as in --num-envs 4" ;;
            --env-id | --seed | --total-timesteps | --run-dir) refuse "$file: ${words[i]} is the sweep's own" ;;
            --refinement-depth) depth=${words[++i]-} ;;
            --refinement-schedule) schedule=${words[++i]-} ;;
            *) flags+=" ${words[i]}" ;;
        esac
    done
    [ "$depth" ] && [ "$schedule" ] || refuse "$file: --refinement-depth or --refinement-schedule lacks its value"
}

# job ALGORITHM TASK SEED [DEPTH [SCHEDULE]]: one run's command. DEPTH and SCHEDULE come from the settings where left
# out, and from the scripts' defaults where those are silent; `extra` holds flags that a whole sweep has in common.
job() {
    local algorithm=$1 task=$2 seed=$3 flags depth schedule method=$1 refinement='' settings=default folder script
    read_settings "$algorithm" "$task"
    depth=${4:-$depth} schedule=${5:-$schedule}
    if [ "$algorithm" = refineppo ]; then
        method=refineppo-K$depth-$schedule
        refinement=" --refinement-depth $depth --refinement-schedule $schedule"
    fi
    [ -z "$flags" ] || settings=s$(printf %s "$flags" | cksum | cut -d ' ' -f 1)
    folder=$RUNS_DIR/${task//\//_}__${method}__${settings}__$seed
    script=${algorithm}_continuous.py
    [ "$PWD" = "$root" ] || script=$root/$script
    printf 'python %q --env-id %q --seed %s --total-timesteps %s%s --run-dir %q --resume\n' \
        "$script" "$task" "$seed" "$STEPS" "$refinement${extra:-}$flags" "$folder"
}
