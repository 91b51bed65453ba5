#!/usr/bin/env bash
# Submits a sweep's jobs as one Slurm job array.
#
#     sweeps/benchmark.sh | sweeps/run_slurm.sh [--max-running N] [--steps-per-task N] [--dry-run] [FILE] [-- SBATCH FLAGS]
#     sweeps/benchmark.sh | sweeps/run_slurm.sh --max-running 64 -- --time=4:00:00 --partition=cpu
#
# Jobs come from standard input or from FILE, a command a line; one that stands there twice is run once. Short ones share
# a task of the array, until it has --steps-per-task environment steps (1000000). At most --max-running tasks run at once.
# Five minutes before the time limit, which must be well above that, a task's training saves, and the task goes back to the
# queue; so does a preempted one. Flags after -- go to sbatch and win over ours. Output: <run folder>.log of each job, $RUNS_DIR/slurm/ for the tasks.

set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
RUNS_DIR=${RUNS_DIR:-runs}
export RUNS_DIR=${RUNS_DIR/#~\//$HOME/} # ~/ is the home folder, as in the generators

refuse() {
    echo "run_slurm.sh: error: $1" >&2
    exit 2
}

max_running='' steps_per_task=1000000 dry_run='' file=-
while [ $# -gt 0 ]; do
    case $1 in
        -h | --help) sed -nE '2,/^$/s/^#( |$)//p' "$0"; exit 0 ;;
        --max-running) max_running=${2:-none}; shift ;;
        --steps-per-task) steps_per_task=${2:-none}; shift ;;
        --dry-run) dry_run=1 ;;
        --) shift; break ;;
        -?*) refuse "there is no option $1; flags for sbatch stand after --" ;;
        *) [ "$file" = - ] || refuse "more than one file of jobs"; file=$1 ;;
    esac
    shift || true
done
case $max_running in *[!0-9]* | 0*) refuse "--max-running must be a whole number of at least 1, not '$max_running'" ;; esac
case $steps_per_task in *[!0-9]*) refuse "--steps-per-task must be a whole number, not '$steps_per_task'" ;; esac
[ "$file" = - ] || [ -f "$file" ] || refuse "there is no file $file"
[ "$file" != - ] || [ ! -t 0 ] || refuse "no jobs: pipe a generator's output into this, or name a file"
[ "$file" = - ] || exec <"$file"
[ "$dry_run" ] || command -v sbatch >/dev/null || refuse "there is no sbatch on this machine"

# "<task of the array> <tab> <command>"; a job without --total-timesteps has a task of its own
list=$(awk -v most="$steps_per_task" '
    !NF || $1 ~ /^#/ || seen[$0]++ { next }
    {
        steps = match($0, /--total-timesteps +[0-9]+/) ? substr($0, RSTART + 18, RLENGTH - 18) + 0 : most
        if (!task || sum + steps > most) { task++; sum = 0 }
        sum += steps
        print task "\t" $0
    }')
[ "$list" ] || refuse "no jobs"
tasks=$(tail -n 1 <<<"$list" | cut -f 1)
path=$RUNS_DIR/slurm/$(date +%Y%m%d-%H%M%S)-$$.tsv
quoted() { printf "'%s'" "${1//\'/\'\\\'\'}"; } # not by %q: sbatch's shell need not know $'...'
command="exec python $(quoted "$here/jobs.py") task $(quoted "$path")"
submit=(sbatch --parsable --job-name=refineppo "--array=1-$tasks${max_running:+%$max_running}" --requeue
    --signal=B:USR1@300 --open-mode=append "--output=$RUNS_DIR/slurm/%A_%a.log" --cpus-per-task=1 --mem=2G
    "$@" "--wrap=$command") # exec: the signal must reach jobs.py, not a shell around it
if [ "$dry_run" ]; then
    printf '%q ' "${submit[@]}"
    printf '\n%s\n' "$list"
    exit 0
fi
mkdir -p "$RUNS_DIR/slurm" || refuse "cannot write to $RUNS_DIR"
printf '%s\n' "$list" >"$path"
job=$("${submit[@]}") || { rm "$path"; exit 1; } # sbatch has said why
echo "submitted job $job: $(wc -l <"$path") jobs in $tasks tasks; see: squeue -j ${job%%;*}; output: $RUNS_DIR/slurm/${job%%;*}_*.log"
