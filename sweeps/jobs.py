"""Runs the jobs of a sweep: command lines, each in one thread, its output appended to <run folder>.log.

    python sweeps/jobs.py one 'python ppo_continuous.py --env-id Hopper-v5 --run-dir runs/x --resume'
    python sweeps/jobs.py task LIST         the lines of LIST that belong to this element of a Slurm job array
    python sweeps/jobs.py summary FOLDER    what `one` left in FOLDER, for run_local.sh

What becomes of a job follows from its exit code: 0 done; 2 (bad arguments) and 3 (a number was not finite) failed for
good; anything else (75, stopped from outside; a crash) is tried again, three times in all. TERM, INT, HUP and USR1 are
passed on to the training as TERM: it saves and ends with 75, and so does this. Every attempt has a row in joblog.tsv,
beside the log.
"""

import ctypes
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
import zlib
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path

FOR_GOOD = {0: "done", 2: "failed", 3: "failed"}
STOPPED, CRASHED, ATTEMPTS = 75, 1, 3
RUNS_DIR = Path(os.environ.get("RUNS_DIR") or "runs")
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}

signals, child = [], None  # received by this process; the attempt that is running


def pass_on(signum, _):
    signals.append(signum)
    if child:
        with suppress(ProcessLookupError, PermissionError):  # it has just ended
            os.killpg(child.pid, signal.SIGTERM)


def die_with_parent():
    """Have the kernel stop the training, which then saves, if this process is killed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def log_of(line: str) -> Path:
    """The log of a job: beside its run folder, or named after the line where that has no --run-dir."""
    try:
        words = shlex.split(line)
        run_dir = Path(words[words.index("--run-dir") + 1])
        return run_dir.with_name(run_dir.name + ".log")
    except (ValueError, IndexError):
        return RUNS_DIR / f"job-{zlib.crc32(line.encode()):08x}.log"


def attempt(line: str, log: Path) -> int:
    """Run the line once; its exit code, 128 + n after signal n, 75 if another process has the run folder."""
    global child
    start = time.time()
    with open(log, "ab") as out:  # a process group of its own: the terminal's Ctrl-C must not reach it twice
        before = out.tell()
        child = subprocess.Popen(["bash", "-c", line], stdin=subprocess.DEVNULL, stdout=out, stderr=out,
                                 env=os.environ | ONE_THREAD, process_group=0, preexec_fn=die_with_parent)  # fmt: skip
        if signals:  # one came before `child` was known
            pass_on(signals[0], None)
        code = child.wait()
    child = None
    code = 128 - code if code < 0 else code
    if code == 2 and b"another process is at work" in log.read_bytes()[before:]:
        code = STOPPED
    row = datetime.fromtimestamp(start).isoformat(" ", "seconds"), f"{time.time() - start:.1f}", code
    append(log.with_name("joblog.tsv"), *row, socket.gethostname(), line, header="started seconds exit host command")
    return code


def append(path: Path, *row, header: str = ""):
    """Add a row of tab-separated values in one write, so that rows of several processes do not mix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if header:
        with suppress(FileExistsError), open(path, "x") as file:
            file.write("\t".join(header.split()) + "\n")
    with open(path, "a") as file:
        file.write("\t".join(map(str, row)) + "\n")


def run(line: str) -> tuple[int, Path]:
    """Run a job to its end or its last attempt: its exit code, 75 if this process was told to stop, and its log."""
    log = log_of(line)
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        for n in range(ATTEMPTS):
            time.sleep(2 * n)  # a killed executor's training may still be saving
            if signals:
                return STOPPED, log
            code = attempt(line, log)
            if code in FOR_GOOD:
                break
    except OSError as error:
        print(f"{error.filename}: {error.strerror}", file=sys.stderr)
        return CRASHED, log
    return STOPPED if signals and code not in FOR_GOOD else code, log


def outcome(code: int) -> str:
    return FOR_GOOD.get(code, "left" if code == STOPPED else "failed")


def duration(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))


def one(line: str):
    """A job of run_local.sh; in SWEEP_DIR lie the list `jobs`, a file per running process, and everyone's outcomes."""
    folder = Path(os.environ["SWEEP_DIR"])
    running = folder / "running" / str(os.getpid())
    running.touch()
    if (folder / "stop").exists():
        signals.append(signal.SIGTERM)
    start = time.time()
    code, log = run(line)
    append(folder / "outcomes", code, log, line)
    running.unlink()
    if signals and code == STOPPED:
        return
    total, ended = (len((folder / name).read_text().splitlines()) for name in ("jobs", "outcomes"))
    elapsed = time.time() - (folder / "jobs").stat().st_mtime
    what = outcome(code) + (f" (exit {code})" if code else "")
    left = f", about {duration(elapsed / ended * (total - ended))} left" if ended < total else ""
    print(f"[{ended}/{total}] {what} after {duration(time.time() - start)}{left}: {log}", flush=True)


def summary(folder: Path):
    """Print how many jobs are done, failed and left, each failure with its log's end, and exit 0, 1 or 75."""
    rows = [row.split("\t", 2) for row in (folder / "outcomes").read_text().splitlines()]
    outcomes = [outcome(int(code)) for code, *_ in rows]
    failed, done = outcomes.count("failed"), outcomes.count("done")
    left = len((folder / "jobs").read_text().splitlines()) - done - failed
    print(f"{done} done, {failed} failed, {left} left")
    for (code, log, _), what in zip(rows, outcomes):
        if what == "failed":
            print(f"failed (exit {code}): {log}")
            lines = Path(log).read_text(errors="replace").splitlines() if Path(log).exists() else []
            print("".join(f"    {text}\n" for text in lines[-3:]), end="")
    if left:
        print("the same command continues with what is left")
    raise SystemExit(1 if failed else STOPPED if left else 0)


def task(path: Path):
    """One element of a Slurm job array. Stopped by USR1 (the time limit) it goes back to the queue by itself; after
    TERM it does not: Slurm does that for a job that it preempts, and a cancelled one is not wanted."""
    element = os.environ["SLURM_ARRAY_TASK_ID"]
    rows = [row.split("\t", 1) for row in path.read_text().splitlines()]
    codes = []
    for line in [line for number, line in rows if number == element]:
        code, log = run(line)
        print(f"{outcome(code)} (exit {code}): {log}", flush=True)
        codes.append(code)
        if code == STOPPED:
            if signal.SIGTERM not in signals:
                subprocess.run(["scontrol", "requeue", f"{os.environ['SLURM_ARRAY_JOB_ID']}_{element}"], check=True)
            raise SystemExit(STOPPED)
    raise SystemExit(CRASHED if any(codes) else 0)


if __name__ == "__main__":
    for signum in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1):
        signal.signal(signum, pass_on)
    command, argument = sys.argv[1:]
    {"one": one, "task": lambda a: task(Path(a)), "summary": lambda a: summary(Path(a))}[command](argument)
