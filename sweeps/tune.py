"""Searches settings of PPO or RefinePPO for one task: the same space, sampler, budget and seeds for both methods.

    python sweeps/tune.py --algorithm refineppo --env-id Hopper-v5 --trials 30 --seeds 3 --steps 1000000 --workers 8

A worker trains one run at a time, in one thread. Any number of them, begun at any time and killed at any time, share
the trials of a study, on one machine by the study's journal file, on many by a database (--storage). Each ends when the
search is over. A trial whose worker stopped or died is put back, and goes on where its runs were.

A trial is one choice of settings, trained with the seeds 1001, 1002, ..., apart from those that report. Its value is
the mean over the seeds of the training return in the last 10 % of the steps, never the maximum. The first is the
scripts' default, the second what was published for the task (settings/published), exactly so; then Optuna's
multivariate TPE searches the space (space.py), and learns from those two by the points of it that are nearest to them.
So a search of two trials only asks which of the two is better:

    python sweeps/tune.py --algorithm ppo --env-id Swimmer-v5 --trials 2 --workers 2

RefinePPO's depth and schedule are searched within the same number of trials, or fixed by two flags. Trials that fail
(no episode ended, numbers not finite, two crashes) count too. Leaves in --out-dir the runs as
<study>/trial_<n>/seed_<seed>, every trial in <study>/trials.csv, and the winner as settings/<algorithm>/<task>.args
(settings-K4-average/... for a fixed depth, settings-<name>/... for a study with a name), for the job generators:

    SETTINGS=runs/tune/settings sweeps/benchmark.sh Hopper-v5 | sweeps/run_local.sh -j 8
"""

import json
import os
import random
import re
import shlex
import signal
import socket
import sys
import time
import warnings
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from multiprocessing import get_context
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Literal

import pandas as pd
import tyro
from common import (
    EXIT_BAD_ARGUMENTS,
    EXIT_FAILURE,
    EXIT_STOPPED,
    ROOT,
    duration,
    first_line,
    refuse,
    start,
    write_atomically,
)
from filelock import FileLock, Timeout
from flags import default_args, file_name, parse, sentence, settings_file, words

try:
    import optuna
    from optuna.exceptions import ExperimentalWarning, StorageInternalError, UpdateFinishedTrialError
    from optuna.trial import FrozenTrial, TrialState
    from space import FLAGS, REFINEMENT, SPACE, first_settings, nearest_point, suggest, to_flags
except ModuleNotFoundError:
    refuse("Optuna is missing: pip install -e '.[tune]'")

FIRST_SEED = 1001
QUICK = {"eval_interval": 10**12, "eval_episodes": 1, "final_eval_episodes": 1, "progress": False}  # of no use here


@dataclass
class Args:
    algorithm: Literal["ppo", "refineppo"]
    """the method whose settings are searched"""
    env_id: str
    """Gymnasium id of the task"""
    trials: int = 30
    """trials in the study, over all workers; a later call with more continues it"""
    seeds: int = 3
    """seeds of each trial: 1001, 1002, ..."""
    steps: int = 1_000_000
    """environment steps of each training, in whole rollouts"""
    refinement_depth: int | None = None
    """fix K instead of searching it (with --refinement-schedule)"""
    refinement_schedule: Literal["average", "uniform", "inverse"] | None = None
    """fix the schedule instead of searching it (with --refinement-depth)"""
    flags: str = ""
    """flags that every training gets as well, as in --flags="--no-compile --checkpoint-interval 20000" """
    workers: int = 1
    """workers of this call, each of which wants a core"""
    storage: str | None = None
    """database for workers on many machines, as in postgresql+psycopg://user@host/db; default a journal file"""
    study_name: str | None = None
    """name of the study; default <task>__<algorithm>, and -K4-average and the like where those are fixed"""
    out_dir: Path = Path("runs/tune")
    """folder for the runs, the tables and the winners"""
    sampler_seed: int = 0
    """seed of the sampler; every trial has its own, made of this one and its number"""
    heartbeat: int = 60
    """seconds between a worker's signs of life in the database; after three missing ones its trial is put back"""
    dry_run: bool = False
    """only say what the search will cost"""


# --- Trials -----------------------------------------------------------------------------------------------------------
# The trials of the budget have the numbers 0, 1, ... An attempt at one is a trial of Optuna's: where a worker stops or
# dies it leaves a failed attempt, and another is queued. An attempt that is one too many, since workers look at the
# queue at the same moment, is given back as surplus.


def number(attempt: FrozenTrial) -> int | None:
    return None if attempt.user_attrs.get("surplus") else attempt.user_attrs.get("number")


def counts(attempt: FrozenTrial) -> bool:
    """Finished, or failed for a reason of its own and not of its worker's."""
    return attempt.state == TrialState.COMPLETE or attempt.state == TrialState.FAIL and "reason" in attempt.user_attrs


def ended(attempts: list[FrozenTrial]) -> dict[int, FrozenTrial]:
    """Of each trial the attempt that counts, where there is one."""
    return {number(attempt): attempt for attempt in reversed(attempts) if counts(attempt)}


def best(attempts: list[FrozenTrial]) -> FrozenTrial | None:
    complete = [attempt for attempt in ended(attempts).values() if attempt.state == TrialState.COMPLETE]
    return max(complete, key=lambda attempt: (attempt.value, -number(attempt)), default=None)


def result(attempt: FrozenTrial) -> str:
    return f"{attempt.value:.2f}" if attempt.state == TrialState.COMPLETE else f"failed: {attempt.user_attrs['reason']}"


def state(attempt: FrozenTrial) -> str:
    """A word for the table."""
    if attempt.state == TrialState.FAIL:
        return "failed" if counts(attempt) else "surplus" if number(attempt) is None else "put back"
    return "finished" if attempt.state == TrialState.COMPLETE else attempt.state.name.lower()


class Failed(Exception):
    """The trial fails, and counts."""


class PutBack(Exception):
    """The trial ends here for now, and does not count."""


def take_lock(folder: Path) -> FileLock | None:
    """A lock on the folder, until it is released or its process ends; None where another process has it."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / "worker.lock")
    try:
        lock.acquire(blocking=False)
        return lock
    except (Timeout, NotImplementedError):  # a file system without locks: no worker is ever taken for dead there
        return None


# --- A worker ---------------------------------------------------------------------------------------------------------


class Worker:
    """Takes trials of one study, one after the other, until the search is over."""

    def __init__(self, args: Args):
        self.args, self.id = args, f"{socket.gethostname()}:{os.getpid()}"
        self.signals, self.child, self.helpers, self.refusal = [], None, [], None
        self.seeds = range(FIRST_SEED, FIRST_SEED + args.seeds)
        self.measure = f"last 10 % of {args.steps} steps, seeds {' '.join(map(str, self.seeds))}"
        self.fixed = {name: getattr(args, name) for name in REFINEMENT} if args.refinement_depth else {}
        arm = f"-K{args.refinement_depth}-{args.refinement_schedule}" if self.fixed else ""
        self.default = default_args(args.algorithm)
        searched = args.algorithm == "refineppo" and not self.fixed
        self.space = SPACE | (REFINEMENT if searched else {})
        more = {name: getattr(self.default, name) for name in REFINEMENT} if searched else self.fixed
        self.first = [(source, flags | more) for source, flags in first_settings(args.env_id, self.default)]
        self.name = args.study_name or f"{file_name(args.env_id)}__{args.algorithm}{arm}"
        self.folder = args.out_dir.expanduser() / self.name
        self.winners = args.out_dir.expanduser() / f"settings{f'-{args.study_name}' if args.study_name else arm}"
        self.winner_file = settings_file(self.winners, args.algorithm, args.env_id)

    def check(self):
        """Refuse what cannot be searched before any work starts."""
        args = self.args
        for name in ("trials", "seeds", "steps", "refinement_depth", "workers", "heartbeat"):
            value = getattr(args, name)
            if value is not None and value < 1:
                refuse(f"--{name.replace('_', '-')} must be at least 1, not {value}")
        if (args.refinement_depth is None) != (args.refinement_schedule is None):
            refuse("--refinement-depth and --refinement-schedule are fixed together or not at all")
        if args.refinement_depth and args.algorithm == "ppo":
            refuse("ppo has no --refinement-depth to fix")
        if args.storage and "://" not in args.storage:
            refuse("--storage must be a database's URL, as in postgresql+psycopg://user@host/db; leave it out for none")
        longest = max(*SPACE["rollout"].choices, *(flags["num_envs"] * flags["num_steps"] for _, flags in self.first))
        if args.steps < longest:
            refuse(f"--steps must be at least {longest}, the longest rollout among the trials, not {args.steps}")
        try:
            given = parse(args.flags, self.default)
        except ValueError as error:
            refuse(f"--flags: {error}")
        for name in (*FLAGS, *REFINEMENT, "seed", "env_id", "total_timesteps", "run_dir", "resume"):
            if getattr(given, name, None) != getattr(self.default, name, None):
                refuse(f"--flags cannot hold --{name.replace('_', '-')}, which the search sets itself")

    def on_signal(self, signum, _):
        self.signals.append(signum)
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a second Ctrl-C stops at once
        for process in (self.child, *self.helpers):
            if process:
                process.terminate()

    # The study

    def open_storage(self) -> optuna.storages.BaseStorage:
        args, journal = self.args, self.folder / "journal.log"
        try:
            journal.parent.mkdir(parents=True, exist_ok=True)
            if not args.storage:
                if journal.exists() and journal.read_bytes()[-1:] not in (b"", b"\n"):
                    refuse(f"the journal {journal} ends in half a line; remove that line to continue")
                return optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(journal)))
        except OSError as error:
            refuse(f"cannot write to {journal.parent}: {error.strerror}")
        except Exception as error:  # whatever reading other things than its operations raises
            refuse(f"the journal {journal} is damaged: {first_line(error)}")
        beat = {"heartbeat_interval": args.heartbeat, "grace_period": 3 * args.heartbeat}
        for last in (False, False, False, True):
            try:
                database = optuna.storages.RDBStorage(args.storage, engine_kwargs={"pool_pre_ping": True}, **beat)
                return optuna.storages.get_storage(database)
            except ImportError as error:
                refuse(f"the database's driver is missing ({error}); for PostgreSQL: pip install -e '.[tune]'")
            except Exception as error:  # SQLAlchemy and the drivers have many
                if last:
                    refuse(f"cannot use the database: {first_line(error)}")
                time.sleep(random.uniform(0.2, 1))  # another worker may be making the same tables

    def open_study(self) -> list[FrozenTrial]:
        """Open the study, made if need be, and refuse to continue another search than the one that it holds."""
        names = "algorithm env_id seeds steps refinement_depth refinement_schedule flags sampler_seed"
        self.protocol = {name: getattr(self.args, name) for name in names.split()}
        kept = {"storage": self.open_storage(), "study_name": self.name, "load_if_exists": True}
        self.study = optuna.create_study(direction="maximize", **kept)
        begun = self.study.user_attrs.get("protocol", self.protocol)
        other = [f"--{name.replace('_', '-')} {begun[name]}" for name in begun if begun[name] != self.protocol[name]]
        if other:
            refuse(f"the study {self.name} was begun with other flags than these: {', '.join(other)}")
        return self.study.get_trials()

    def is_dead(self, attempt: FrozenTrial) -> bool:
        """Whether the worker of a running attempt is known to be gone."""
        if "worker" not in attempt.user_attrs:  # killed before it could sign
            return (datetime.now() - attempt.datetime_start).total_seconds() > 60
        if self.args.storage or attempt.user_attrs["worker"].split(":")[0] != socket.gethostname():
            return False  # a database has signs of life, see fill_queue; a journal shared by machines has none
        lock = take_lock(self.folder / f"trial_{number(attempt)}")
        if lock:
            lock.release()
        return lock is not None

    def fill_queue(self):
        """Fail the attempts of dead workers, and queue one at the first trial that has neither ended nor a worker."""
        if self.args.storage:
            optuna.storages.fail_stale_trials(self.study)
        for attempt in self.study.get_trials(states=[TrialState.RUNNING]):
            if self.is_dead(attempt):
                with suppress(UpdateFinishedTrialError):  # another worker was quicker
                    self.study.tell(attempt.number, state=TrialState.FAIL, skip_if_finished=True)
        attempts = self.study.get_trials()
        for n in range(self.args.trials):
            before = [attempt for attempt in attempts if number(attempt) == n]
            if all(attempt.state == TrialState.FAIL and not counts(attempt) for attempt in before):
                return self.queue(n, before[-1].params if before else {})
            if any(attempt.state == TrialState.WAITING for attempt in before):
                return

    def queue(self, n: int, point: dict):
        """Queue an attempt at trial n, with the point of the space that the one before had."""
        if n < len(self.first):
            point = nearest_point(self.first[n][1], self.space)
        about = {"params": point, "distributions": {name: self.space[name] for name in point}}
        self.study.add_trial(optuna.create_trial(state=TrialState.WAITING, user_attrs={"number": n}, **about))

    # One training

    def run(self, flags: dict, log: Path) -> tuple[int, str]:
        """Train with these flags and the user's; the exit code and what was said."""
        script = ROOT / f"{self.args.algorithm}_continuous.py"
        flags = [*words(QUICK), *shlex.split(self.args.flags), *words({"env_id": self.args.env_id} | flags)]
        with open(log, "ab") as file:
            begun = file.tell()
            self.child = start([sys.executable, script, *flags], file)
            if self.signals:  # one came before `child` was known
                self.child.terminate()
            return self.child.wait(), log.read_bytes()[begun:].decode(errors="replace").strip()

    def train(self, settings: dict, folder: Path, seed: int) -> float:
        """The training return of one seed in the last 10 % of its steps."""
        rollout = settings["num_envs"] * settings["num_steps"]
        steps = self.args.steps // rollout * rollout  # else the last 10 % could lie in the rollout that is left out
        run_dir, crashes = folder / f"seed_{seed}", 0
        flags = settings | {"seed": seed, "total_timesteps": steps, "run_dir": run_dir, "resume": True}
        while crashes < 2:
            if self.signals:
                raise PutBack
            code, said = self.run(flags, folder / f"seed_{seed}.log")
            if code == 0 and (run_dir / "result.json").exists():
                value = json.loads((run_dir / "result.json").read_text())["train_return_last10pct"]
                if value is None:
                    raise Failed(f"no episode ended in the last 10 % of seed {seed}")
                return value
            if code == EXIT_FAILURE:
                raise Failed(f"numerical failure with seed {seed}")
            if code == EXIT_BAD_ARGUMENTS and "another process is at work" in said:
                time.sleep(1)  # a dead worker's training, about to save and stop
            elif code == EXIT_BAD_ARGUMENTS:
                self.refusal = sentence(said)
                raise PutBack
            elif code != EXIT_STOPPED and not self.signals:
                crashes += 1
        raise Failed(f"seed {seed} crashed twice, with exit code {code}: {(said or '-').splitlines()[-1]}")

    # One trial

    def choose(self, trial: optuna.Trial, n: int) -> dict:
        """The settings of trial n. The sampler's randomness follows from n, whichever worker takes it."""
        seed = random.Random(f"{self.args.sampler_seed} {n}").getrandbits(32)
        self.study.sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)
        point, first = suggest(trial, self.space), self.first
        source, flags = first[n] if n < len(first) else ("sampled", to_flags(point, first[0][1]) | self.fixed)
        trial.set_user_attr("source", source)
        trial.set_user_attr("flags", flags)
        return flags

    def evaluate(self, trial: optuna.Trial) -> float:
        """The value of a trial: the mean over its seeds."""
        n = trial.user_attrs.get("number")
        same = [a for a in self.study.get_trials(deepcopy=False) if number(a) == n and a.number < trial.number]
        if n is None or any(counts(attempt) or not attempt.state.is_finished() for attempt in same):
            trial.set_user_attr("surplus", True)
            raise PutBack
        folder = self.folder / f"trial_{n}"
        self.lock = take_lock(folder)
        trial.set_user_attr("worker", self.id)
        flags, begun, returns = self.choose(trial, n), time.time(), []
        for seed in self.seeds:
            try:
                returns.append(self.train(flags, folder, seed))
            finally:
                trial.set_user_attr("seconds", round(time.time() - begun, 1))
                trial.set_user_attr("returns", returns)
        return mean(returns)

    def objective(self, trial: optuna.Trial) -> float | None:
        """`evaluate` for Optuna, which fails a trial whose value is None."""
        try:
            return self.evaluate(trial)
        except Failed as reason:
            trial.set_user_attr("reason", str(reason))
        except PutBack:
            pass
        except UpdateFinishedTrialError:
            self.lost = True
            raise

    def take_trial(self):
        self.lock, self.lost = None, False
        try:
            self.study.optimize(self.objective, n_trials=1, callbacks=[self.report])
        except ValueError:  # Optuna will not end a trial a second time
            if not self.lost:
                raise
            print("this trial's signs of life stayed away too long: another worker has taken it over", flush=True)
        finally:
            if self.lock:  # not before the trial has its result: whoever gets the lock takes its worker for dead
                self.lock.release()
        if self.refusal:
            self.fill_queue()
            refuse(self.refusal)

    def report(self, study: optuna.Study, attempt: FrozenTrial):
        """A line for the trial that this worker has ended, and the files."""
        attempts = study.get_trials()
        self.write_files(attempts)
        if not counts(attempt):
            return
        done, leader = ended(attempts), best(attempts)
        so_far = f"best {leader.value:.2f}, trial {number(leader)}; " if leader else ""
        workers = 1 + sum(other.state == TrialState.RUNNING for other in attempts)
        each = mean(other.user_attrs["seconds"] for other in done.values())
        left = duration(max(0, self.args.trials - len(done)) * each / workers)
        what = f"trial {number(attempt)}, {attempt.user_attrs['source']}: {result(attempt)}"
        print(f"{what}; {so_far}{len(done)} of {self.args.trials} done, about {left} left", flush=True)

    # The search

    def work(self):
        """Take trials until the search is over, then wait for those of other workers, which may be put back."""
        self.study.set_user_attr("protocol", self.protocol)
        waiting = False
        while not self.signals:
            self.fill_queue()
            attempts = self.study.get_trials()
            running = [attempt for attempt in attempts if attempt.state == TrialState.RUNNING]
            if len(ended(attempts)) >= self.args.trials:
                return
            if any(attempt.state == TrialState.WAITING for attempt in attempts):
                self.take_trial()
            else:
                if not waiting:
                    names = ", ".join(f"{number(a)} ({a.user_attrs.get('worker')})" for a in running)
                    print(f"waiting for the trials of other workers: {names}", flush=True)
                waiting = True
                time.sleep(1)
        self.fill_queue()

    def state_budget(self, done: int):
        """Say what the search costs, by a short training with the default settings; it also tries the user's flags."""
        args, begun, probe = self.args, time.time(), 4096
        size = f"{args.trials} trials x {args.seeds} seeds x {args.steps:,} steps"
        total = f"{args.trials * args.seeds * args.steps:,} environment steps"
        print(f"{args.algorithm} on {args.env_id}: {size} = {total}; {done} trials are done", flush=True)
        with TemporaryDirectory() as folder:
            run_dir = Path(folder) / "run"
            flags = self.first[0][1] | {"total_timesteps": probe, "run_dir": run_dir}
            code, said = self.run(flags, Path(folder) / "log")
            took, result = time.time() - begun, run_dir / "result.json"
            sps = json.loads(result.read_text())["sps"] if result.exists() else None
        if code == EXIT_BAD_ARGUMENTS:
            refuse(sentence(said))
        if sps:
            begin = max(0, took - probe / sps)  # start, compilation and the evaluations at the end
            left = (args.trials - done) * args.seeds * (begin + args.steps / sps)
            speed = f"{sps:,.0f} steps/s here, and take {begin:.0f} s besides"
            times = f"{duration(left)} with one worker, {duration(left / args.workers)} with {args.workers}"
            print(f"the default settings train at {speed}: about {times}", flush=True)
        elif not self.signals:
            print(f"no speed to tell: the default settings end with exit code {code} here", flush=True)

    # What it leaves

    def first_ended(self, attempts: list[FrozenTrial]) -> list[FrozenTrial]:
        """The default and the published settings, as far as they have ended."""
        return [attempt for n, attempt in sorted(ended(attempts).items()) if n < len(self.first)]

    def write_files(self, attempts: list[FrozenTrial]):
        """The table of all trials, and the best so far as a settings file, without what may hold a password."""
        rows = []
        for attempt in (a for a in attempts if number(a) is not None and a.state != TrialState.WAITING):
            about = attempt.user_attrs
            row = {"folder": f"trial_{number(attempt)}", "state": state(attempt), "value": attempt.value}
            row |= {name: about.get(name) for name in ("source", "reason", "seconds", "worker")}
            row |= {f"return_{seed}": x for seed, x in zip(self.seeds, about.get("returns", ()))}
            rows.append(row | about.get("flags", {}))
        write_atomically(self.folder / "trials.csv", pd.DataFrame(rows, dtype=object).to_csv(index=False))
        leader = best(attempts)
        if leader:
            flags = leader.user_attrs["flags"].items()
            changed = {name: x for name, x in flags if name in REFINEMENT or x != getattr(self.default, name)}
            others = "; ".join(f"{a.user_attrs['source']} {result(a)}" for a in self.first_ended(attempts))
            which = f"trial {number(leader)} ({leader.user_attrs['source']}), the best of {len(ended(attempts))}"
            command = re.sub(r" --storage[= ]\S+", "", shlex.join(["python", "sweeps/tune.py", *sys.argv[1:]]))
            lines = [
                f"# From {which}: mean training return {leader.value:.2f}",
                f"# in the {self.measure} ({others}).",
                f"#     {command}",
                *(" ".join(words({name: x})) for name, x in changed.items()),
            ]
            write_atomically(self.winner_file, "".join(f"{line}\n" for line in lines))

    def conclude(self, attempts: list[FrozenTrial]):
        """The winner, beside the default and what was published."""
        self.write_files(attempts)
        leader, table = best(attempts), self.folder / "trials.csv"
        if leader is None:
            raise SystemExit(f"the search is over: no trial succeeded, see {table}")
        print(f"the search is over; mean training return in the {self.measure}:")
        for attempt in self.first_ended(attempts):
            print(f"    {attempt.user_attrs['source']:<10}{result(attempt):>12}")
        which = f"trial {number(leader)} ({leader.user_attrs['source']}) of {len(ended(attempts))}"
        print(f"{which} is best with {leader.value:.2f}: {self.winner_file}; all trials are in {table}")
        if len(ended(attempts)) > len(self.first):
            print("the best of many looks better than it is on these seeds: report it with the seeds 1 to 5")
        command = f"SETTINGS={shlex.quote(str(self.winners))} sweeps/benchmark.sh {shlex.quote(self.args.env_id)}"
        print(f"    FLAGS={shlex.quote(self.args.flags)} {command}" if self.args.flags else f"    {command}")


# --- The program ------------------------------------------------------------------------------------------------------


def prepare(args: Args) -> Worker:
    """A worker that hears signals."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.simplefilter("ignore", ExperimentalWarning)
    worker = Worker(args)
    for signum in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1):
        if signal.getsignal(signum) is not signal.SIG_IGN:  # as under nohup
            signal.signal(signum, worker.on_signal)
    return worker


@contextmanager
def database_failures():
    """What a search can be continued after."""
    try:
        yield
    except StorageInternalError as error:
        print(f"the database failed: {first_line(error)}; the same command continues the search", file=sys.stderr)
        raise SystemExit(EXIT_STOPPED) from None


@database_failures()
def help_out(args: Args):
    """A further worker of the same call."""
    os.setpgrp()  # the terminal's Ctrl-C reaches the first worker, which passes it on
    worker = prepare(args)
    worker.open_study()
    worker.work()


@database_failures()
def main(args: Args):
    worker = prepare(args)
    worker.check()
    if args.dry_run:
        worker.state_budget(done=0)
        raise SystemExit(EXIT_STOPPED if worker.signals else 0)
    done = len(ended(worker.open_study()))
    if done < args.trials:
        worker.state_budget(done)
        for _ in range(0 if worker.signals else args.workers - 1):
            helper = get_context("spawn").Process(target=help_out, args=(args,))  # a fork would share the connections
            helper.start()
            worker.helpers.append(helper)
        for helper in worker.helpers if worker.signals else ():  # it came while they began
            helper.terminate()
        worker.work()
        for helper in worker.helpers:
            helper.join()
    if worker.signals:
        print(f"stopped by {signal.Signals(worker.signals[0]).name}; the same command continues the search")
        raise SystemExit(EXIT_STOPPED)
    worker.conclude(worker.study.get_trials())


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
