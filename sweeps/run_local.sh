#!/usr/bin/env bash
# Runs a sweep's jobs on this machine, N at a time: with GNU parallel where it is installed, else with xargs.
#
#     sweeps/depth.sh HalfCheetah-v5 | sweeps/run_local.sh [-j N] [--dry-run] [FILE]
#
# Jobs come from standard input or from FILE, a command a line; one that stands there twice is run once. N is the number
# of cores if not given. Each job's output goes to <run folder>.log, a row per attempt to joblog.tsv beside it. Jobs that
# were stopped or crashed are tried again, those that failed for good are not (see jobs.py). Ctrl-C lets every training
# save; the same command continues. Exit code: 0 all done, 1 some failed, 75 some left, 2 bad arguments.

set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)

refuse() {
    echo "run_local.sh: error: $1" >&2
    exit 2
}

n=$(nproc 2>/dev/null || getconf _NPROCESSORS_ONLN) dry_run='' file=-
while [ $# -gt 0 ]; do
    case $1 in
        -h | --help) sed -nE '2,/^$/s/^#( |$)//p' "$0"; exit 0 ;;
        -j) n=${2:-}; shift ;;
        -j*) n=${1#-j} ;;
        --dry-run) dry_run=1 ;;
        -?*) refuse "there is no option $1" ;;
        *) [ "$file" = - ] || refuse "more than one file of jobs"; file=$1 ;;
    esac
    shift || true
done
case $n in '' | *[!0-9]* | 0*) refuse "-j must be a whole number of at least 1, not '$n'" ;; esac
[ "$file" = - ] || [ -f "$file" ] || refuse "there is no file $file"
[ "$file" != - ] || [ ! -t 0 ] || refuse "no jobs: pipe a generator's output into this, or name a file"
[ "$file" = - ] || exec <"$file"

SWEEP_DIR=$(mktemp -d)
export SWEEP_DIR SWEEP_JOBS=$n # for jobs.py
trap 'rm -rf "$SWEEP_DIR"' EXIT
awk 'NF && $1 !~ /^#/ && !seen[$0]++' >"$SWEEP_DIR/jobs"
[ -s "$SWEEP_DIR/jobs" ] || refuse "no jobs"
if [ "$dry_run" ]; then
    cat "$SWEEP_DIR/jobs"
    exit 0
fi
mkdir "$SWEEP_DIR/running"
: >"$SWEEP_DIR/outcomes"

# Whoever runs the jobs need not know of a stop: those that run are told to save, and those that follow end at once
stop() {
    touch "$SWEEP_DIR/stop"
    for process in "$SWEEP_DIR"/running/*; do
        kill -TERM "${process##*/}" 2>/dev/null || true
    done
    echo "stopping; every running job saves first ..." >&2 || true # the terminal may be gone
}
trap stop INT TERM HUP USR1

echo "$(wc -l <"$SWEEP_DIR/jobs") jobs, $n at a time" >&2
set -m # the jobs get a process group of their own, which the terminal's Ctrl-C does not reach
if parallel --version 2>/dev/null | grep -q '^GNU parallel'; then # moreutils has a command of this name too
    parallel --will-cite --quote --ungroup -j "$n" -a "$SWEEP_DIR/jobs" python "$here/jobs.py" one </dev/null &
else
    # shellcheck disable=SC2016  # for the inner shell; a job that is killed must not end the others
    tr '\n' '\0' <"$SWEEP_DIR/jobs" | xargs -0 -n 1 -P "$n" sh -c 'python "$0" one "$1" || true' "$here/jobs.py" &
fi
until wait $!; do # a signal interrupts `wait`
    kill -0 $! 2>/dev/null || break
done
python "$here/jobs.py" summary "$SWEEP_DIR"
