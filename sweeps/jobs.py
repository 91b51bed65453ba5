"""Runs the jobs of a sweep: command lines, each in one thread, its output appended to <run folder>.log.

    python sweeps/jobs.py one 'python ppo_continuous.py --env-id Hopper-v5 --run-dir runs/x --resume'
    python sweeps/jobs.py task LIST         the lines of LIST that belong to this element of a Slurm job array
    python sweeps/jobs.py summary FOLDER    what `one` left in FOLDER, for run_local.sh

What becomes of a job follows from its exit code: 0 done, if its run folder holds a result.json, else failed; 2 (bad
arguments) and 3 (a number was not finite) failed for good; anything else (75, stopped from outside; a crash) is tried
again, three times in all. TERM, INT, HUP and USR1 are passed on to the training as TERM: it saves and ends with 75, and
so does this. Every attempt has a row in joblog.tsv, beside the log.
"""

import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
import zlib
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from common import EXIT_BAD_ARGUMENTS, EXIT_FAILURE, EXIT_STOPPED, duration, start

FOR_GOOD = (0, EXIT_BAD_ARGUMENTS, EXIT_FAILURE)
CRASHED, ATTEMPTS = 1, 3
RUNS_DIR = Path(os.environ.get("RUNS_DIR") or "runs").expanduser()

signals, child = [], None  # received by this process; the attempt that is running


def pass_on(signum, _):
    signals.append(signum)
    if child:
        with suppress(ProcessLookupError, PermissionError):  # it has just ended
            os.killpg(child.pid, signal.SIGTERM)


# --- One job ----------------------------------------------------------------------------------------------------------


def flag(line: str, name: str) -> str | None:
    """The value of a flag in a command line."""
    with suppress(ValueError):  # a quotation without end: the shell will say so
        words = shlex.split(line)
        for word, following in zip(words, [*words[1:], None]):
            if word == name or word.startswith(f"{name}="):
                return following if word == name else word.partition("=")[2]
    return None


def run_folder(line: str) -> Path | None:
    folder = flag(line, "--run-dir")
    return Path(folder).expanduser() if folder else None


def log_of(line: str) -> Path:
    """The log of a job: beside its run folder, or named after the line where that has no --run-dir."""
    folder = run_folder(line)
    return folder.with_name(f"{folder.name}.log") if folder else RUNS_DIR / f"job-{zlib.crc32(line.encode()):08x}.log"


def lacks_result(line: str) -> bool:
    """Whether the job trains a run that is not complete."""
    folder = run_folder(line)
    return folder is not None and not (folder / "result.json").exists()


def outcome(line: str, code: int) -> tuple[str, str]:
    """done, failed or left, and why."""
    if code == EXIT_STOPPED:
        return "left", f"exit {code}"
    if code:
        return "failed", f"exit {code}"
    return ("failed", "it ended without a result.json") if lacks_result(line) else ("done", "")


def append(path: Path, text: str):
    """Add a line in one write, so that lines of several processes do not mix."""
    with open(path, "a") as file:
        file.write(f"{text}\n")


def attempt(line: str, log: Path) -> int:
    """Run the line once; its exit code, 128 + n after signal n, 75 if another process has the run folder."""
    global child
    begun = time.time()
    with open(log, "ab") as out:
        before = out.tell()
        child = start(["bash", "-c", line], out)
        if signals:  # one came before `child` was known
            pass_on(signals[0], None)
        code = child.wait()
    child = None
    code = 128 - code if code < 0 else code
    if code == EXIT_BAD_ARGUMENTS and b"another process is at work" in log.read_bytes()[before:]:
        code = EXIT_STOPPED
    joblog = log.with_name("joblog.tsv")
    beginning = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND  # another job's row may be there before the header
    with suppress(FileExistsError), open(os.open(joblog, beginning), "w") as file:
        file.write("started\tseconds\texit\thost\tcommand\n")
    at = datetime.fromtimestamp(begun).isoformat(" ", "seconds")
    append(joblog, f"{at}\t{time.time() - begun:.1f}\t{code}\t{socket.gethostname()}\t{line}")
    return code


def run(line: str) -> tuple[int, Path]:
    """Run a job to its end or its last attempt: its exit code, 75 if this process was told to stop, and its log."""
    log = log_of(line)
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        for n in range(ATTEMPTS):
            time.sleep(2 * n)  # a killed executor's training may still be saving
            if signals:
                return EXIT_STOPPED, log
            code = attempt(line, log)
            if code in FOR_GOOD:
                return code, log
    except OSError as error:
        print(f"{error.filename}: {error.strerror}", file=sys.stderr)
        return CRASHED, log
    return EXIT_STOPPED if signals else code, log


def end_of(log: Path, lines: int) -> list[str]:
    return log.read_text(errors="replace").splitlines()[-lines:] if log.exists() else []


# --- On this machine: run_local.sh ------------------------------------------------------------------------------------
# In SWEEP_DIR lie the list `jobs`, a file per running process in `running`, and a line per ended job in `outcomes`.


def one(line: str):
    """One job, and a line about it and about the whole sweep."""
    folder = Path(os.environ["SWEEP_DIR"])
    running = folder / "running" / str(os.getpid())
    running.touch()
    if (folder / "stop").exists():
        signals.append(signal.SIGTERM)
    begun, trained = time.time(), run_folder(line)
    begun_before, finished_before = trained and trained.exists(), trained and not lacks_result(line)
    code, log = run(line)
    seconds = time.time() - begun
    word, why = outcome(line, code)
    whole = 0 if begun_before else seconds  # for all of the job's steps
    about = {"line": line, "log": str(log), "outcome": word, "why": why, "seconds": whole}
    append(folder / "outcomes", json.dumps(about))
    running.unlink()
    if signals and code == EXIT_STOPPED:
        return
    took = "before" if finished_before else f"after {duration(seconds)}"
    because = f" ({': '.join([why, *end_of(log, 1)])})" if word == "failed" else ""
    count, left = counts(folder), time_left(folder)
    about = f" (about {duration(left)})" if count["left"] and left is not None else ""
    print(f"{said(count)}{about} | {word} {took}{because}: {log}", flush=True)


def outcomes(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "outcomes").read_text().splitlines()]


def jobs(folder: Path) -> list[str]:
    return (folder / "jobs").read_text().splitlines()


def counts(folder: Path) -> dict[str, int]:
    """How many jobs are done, failed, and left."""
    words = [row["outcome"] for row in outcomes(folder)]
    done, failed = words.count("done"), words.count("failed")
    return {"done": done, "failed": failed, "left": len(jobs(folder)) - done - failed}


def said(count: dict[str, int]) -> str:
    return ", ".join(f"{number} {word}" for word, number in count.items())


def steps(line: str) -> int:
    """Environment steps of a job, as a measure of its length."""
    value = flag(line, "--total-timesteps") or ""
    return int(value) if value.isdigit() else 1


def time_left(folder: Path) -> float | None:
    """Seconds until the sweep ends, by the time that a step took in the jobs that were trained here so far."""
    rows = outcomes(folder)
    ended = {row["line"] for row in rows}
    trained = [row for row in rows if row["outcome"] == "done" and row["seconds"]]
    if not trained:
        return None
    per_step = sum(row["seconds"] for row in trained) / sum(steps(row["line"]) for row in trained)
    left = [line for line in jobs(folder) if line not in ended]
    seconds = per_step * sum(map(steps, left))
    for running in (folder / "running").iterdir():
        with suppress(FileNotFoundError):  # it has just ended
            seconds -= time.time() - running.stat().st_mtime
    return max(0, seconds) / max(1, min(int(os.environ["SWEEP_JOBS"]), len(left)))


def summary(folder: Path):
    """Print how many jobs are done, failed and left, each failure with its log's end, and exit 0, 1 or 75."""
    count = counts(folder)
    print(said(count))
    for row in outcomes(folder):
        if row["outcome"] == "failed":
            print(f"failed ({row['why']}): {row['log']}")
            print("".join(f"    {text}\n" for text in end_of(Path(row["log"]), 3)), end="")
    if count["left"]:
        print("the same command continues with what is left")
    raise SystemExit(1 if count["failed"] else EXIT_STOPPED if count["left"] else 0)


# --- On a cluster: run_slurm.sh ---------------------------------------------------------------------------------------


def task(path: Path):
    """One element of a Slurm job array. Stopped by USR1 (the time limit) it goes back to the queue by itself; after
    TERM it does not: Slurm does that for a job that it preempts, and a cancelled one is not wanted."""
    element = os.environ["SLURM_ARRAY_TASK_ID"]
    rows = [row.split("\t", 1) for row in path.read_text().splitlines()]
    words = []
    for line in [line for number, line in rows if number == element]:
        code, log = run(line)
        word, why = outcome(line, code)
        words.append(word)
        print(f"{word}{f' ({why})' if why else ''}: {log}", flush=True)
        if code == EXIT_STOPPED:
            if signal.SIGTERM not in signals:
                subprocess.run(["scontrol", "requeue", f"{os.environ['SLURM_ARRAY_JOB_ID']}_{element}"], check=True)
                end = time.time() + 60  # till Slurm ends it with TERM: one that ends before may be taken for failed
                while signal.SIGTERM not in signals and time.time() < end:
                    time.sleep(0.5)
            raise SystemExit(EXIT_STOPPED)
    raise SystemExit(1 if "failed" in words else 0)


if __name__ == "__main__":
    for signum in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1):
        signal.signal(signum, pass_on)
    command, argument = sys.argv[1:]
    {"one": one, "task": lambda a: task(Path(a)), "summary": lambda a: summary(Path(a))}[command](argument)
