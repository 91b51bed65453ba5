"""Searches settings of PPO or RefinePPO for one task: the same space, sampler, budget and seeds for both methods.

    python sweeps/tune.py --algorithm refineppo --env-id Hopper-v5 --trials 30 --seeds 3 --steps 1000000

One call is one worker: one training at a time, in one thread. Any number of them, begun at any time and killed at any
time, share the trials of a study, on one machine by the study's journal file, on many by a database (--storage). Each
ends when the search is over. A trial whose worker stopped or died is put back, and goes on where its runs were.

A trial is one choice of settings, trained with the seeds 1001, 1002, ..., apart from those that report. Its value is
the mean over the seeds of the training return in the last 10 % of the steps, never the maximum. The first is the
scripts' default, the second what was published for the task, exactly so; then Optuna's multivariate TPE searches the
space below, and learns from those two by the points of the space that are nearest to them.
RefinePPO's depth and schedule are searched within the same number of trials, or fixed by two flags. Trials that fail
(no episode ended, numbers not finite, two crashes) count too.

Leaves in --out-dir the runs as <study>/trial_<number>/seed_<seed>, every trial in <study>/trials.csv, and the winner as
settings/<algorithm>/<task>.args (settings-K4-average/... if the depth was fixed so, settings-<study>/... if the study
has a name of its own), for the job generators and the report:

    SETTINGS=runs/tune/settings sweeps/benchmark.sh Hopper-v5 | sweeps/run_local.sh -j 8
"""

import csv
import fcntl
import io
import json
import os
import random
import shlex
import signal
import socket
import subprocess
import sys
import time
import warnings
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Literal

import tyro

try:
    import optuna
    from optuna.distributions import CategoricalDistribution, FloatDistribution
    from optuna.exceptions import ExperimentalWarning, StorageInternalError, UpdateFinishedTrialError
    from optuna.storages import RetryHeartbeatStaleTrialCallback
    from optuna.trial import FrozenTrial, TrialState
except ModuleNotFoundError:
    print("tune.py: error: Optuna is missing: pip install -e '.[tune]'", file=sys.stderr)
    raise SystemExit(2) from None

ROOT = Path(__file__).resolve().parent.parent
WORKER = f"{socket.gethostname()}:{os.getpid()}"
EXIT_BAD_ARGUMENTS, EXIT_STOPPED = 2, 75
FIRST_SEED = 1001
QUICK = {"eval_interval": 10**12, "eval_episodes": 1, "final_eval_episodes": 1, "progress": False}  # of no use here
COLUMNS = ("number", "folder", "source", "state", "reason", "value", "seconds", "worker")


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
    storage: str | None = None
    """database for workers on many machines, as in postgresql+psycopg://user@host/db; default a journal file"""
    study_name: str | None = None
    """name of the study; default <task>__<algorithm>, and -K4-average and the like where those are fixed"""
    out_dir: Path = Path("runs/tune")
    """folder for the runs, the tables and the winners"""
    sampler_seed: int = 0
    """seed of the sampler; every trial has its own, made of this one and its place in the study"""
    heartbeat: int = 60
    """seconds between a worker's signs of life in the database; after three missing ones its trial is put back"""
    dry_run: bool = False
    """only say what the search will cost"""


# --- The space --------------------------------------------------------------------------------------------------------

SPACE = {
    "learning_rate": FloatDistribution(1e-5, 3e-3, log=True),
    "one_minus_gamma": FloatDistribution(1e-4, 0.1, log=True),
    "one_minus_lambda": FloatDistribution(5e-3, 0.2, log=True),
    "num_envs": CategoricalDistribution((1, 4, 8, 16)),
    "rollout": CategoricalDistribution((512, 1024, 2048, 4096)),  # steps of all environments together
    "minibatch": CategoricalDistribution((64, 128, 256, 512)),
    "update_epochs": CategoricalDistribution((4, 10, 20)),
    "clip_coef": CategoricalDistribution((0.1, 0.2, 0.3)),
    "entropy": CategoricalDistribution((False, True)),
    "ent_coef": FloatDistribution(1e-6, 2e-2, log=True),  # only with entropy, 0 without
    "vf_coef": FloatDistribution(0.2, 1.0),
    "log_std_init": CategoricalDistribution((0.0, -0.5, -1.0, -2.0)),
}
REFINEMENT = {  # without K = 1, which is PPO's own policy: as the winner it would compare PPO with itself
    "refinement_depth": CategoricalDistribution((2, 4, 8)),
    "refinement_schedule": CategoricalDistribution(("average", "uniform", "inverse")),
}
# The scripts' default, and what was published: rl-zoo3 is github.com/DLR-RM/rl-baselines3-zoo, SLM-Lab is
# github.com/kengz/SLM-Lab, Baselines is github.com/openai/baselines. `lin` anneals the learning rate to zero; the
# clipping range, which BipedalWalkerHardcore's source anneals too, stays constant here.
FIRST = """
task                  source    envs steps batch epochs lr      lin gamma lambda clip ent    vf   norm log_std normalise
default               CleanRL      1  2048    64     10 3e-4    yes .99   .95    .2   0      .5   .5    0      yes
HalfCheetah           rl-zoo3      1   512    64     20 2.06e-5 no  .98   .92    .1   4e-4   .58  .8   -2      yes
Hopper                rl-zoo3      1   512    32      5 9.8e-5  no  .999  .99    .2   2.3e-3 .84  .7   -2      yes
Walker2d              rl-zoo3      1   512    32     20 5.05e-5 no  .99   .95    .1   5.9e-4 .87  1     0      yes
Swimmer               rl-zoo3      4  1024   256     10 6e-4    no  .9999 .98    .2   0      .5   .5    0      yes
Ant                   SLM-Lab     16  2048    64     10 1.5e-4  no  .988  .928   .2   0      .5   .5    0      yes
Reacher               SLM-Lab     16  2048    64     10 2e-4    no  .997  .97    .2   1e-3   .5   .5    0      yes
Pusher                SLM-Lab     16  2048    64     10 2e-4    no  .997  .97    .2   1e-3   .5   .5    0      yes
Humanoid              rl-zoo3      1   512   256      5 3.6e-5  no  .95   .9     .3   2.4e-3 .43  2    -2      yes
HumanoidStandup       rl-zoo3      1   512    32     20 2.6e-5  no  .99   .9     .3   3.6e-6 .43  .7   -2      yes
Pendulum              Baselines    8  2048   512     10 3e-4    no  .99   .95    .2   0      .5   .5    0      no
MountainCarContinuous Baselines   16   256   512      4 2.5e-4  no  .99   .94    .2   0      .5   .5    0      yes
LunarLanderContinuous rl-zoo3     16  1024    64      4 3e-4    no  .999  .98    .2   .01    .5   .5    0      no
BipedalWalker         rl-zoo3     32  2048    64     10 3e-4    no  .999  .95    .18  0      .5   .5    0      yes
BipedalWalkerHardcore rl-zoo3     16  2048    64     10 2.5e-4  yes .99   .95    .2   1e-3   .5   .5    0      yes
"""


def first_settings(env_id: str) -> list[tuple[str, dict]]:
    """(where they come from, flags) of the trials 0 and, where something was published for the task, 1."""
    names, *rows = (line.split() for line in FIRST.strip().splitlines())
    rows = {row[0]: dict(zip(names, row)) for row in rows}
    task, found = env_id.rsplit("-v", 1)[0], []
    for row in (rows["default"], *([rows[task]] if task in rows else [])):
        envs, steps, batch, epochs = (int(row[name]) for name in ("envs", "steps", "batch", "epochs"))
        normalise = row["normalise"] == "yes"
        flags = {
            "learning_rate": float(row["lr"]), "anneal_lr": row["lin"] == "yes", "num_envs": envs, "num_steps": steps,
            "num_minibatches": envs * steps // batch, "update_epochs": epochs, "gamma": float(row["gamma"]),
            "gae_lambda": float(row["lambda"]), "clip_coef": float(row["clip"]), "ent_coef": float(row["ent"]),
            "vf_coef": float(row["vf"]), "max_grad_norm": float(row["norm"]), "log_std_init": float(row["log_std"]),
            "normalize_obs": normalise, "normalize_reward": normalise,
        }  # fmt: skip
        found.append((f"published ({row['source']})" if found else "default", flags))
    return found


DEFAULT = first_settings("")[0][1]
DEFAULT_REFINEMENT = {"refinement_depth": 4, "refinement_schedule": "average"}


def digits(x: float) -> float:
    """Four significant digits, so that settings can be read and typed."""
    return float(f"{x:.4g}")


def to_flags(point: dict) -> dict:
    """The flags of a point of the space; whatever is not in the space keeps its default."""
    flags = DEFAULT | {name: value for name, value in point.items() if name in (*DEFAULT, *REFINEMENT)}
    return flags | {
        "learning_rate": digits(point["learning_rate"]),
        "gamma": round(1 - digits(point["one_minus_gamma"]), 8),
        "gae_lambda": round(1 - digits(point["one_minus_lambda"]), 8),
        "num_steps": point["rollout"] // point["num_envs"],
        "num_minibatches": point["rollout"] // point["minibatch"],
        "ent_coef": digits(point["ent_coef"]) if point["entropy"] else 0.0,
        "vf_coef": digits(point["vf_coef"]),
    }


def nearest_point(flags: dict, space: dict) -> dict:
    """The point of the space that is nearest to some flags, from which the sampler learns what they were worth."""
    rollout = flags["num_envs"] * flags["num_steps"]
    exact = flags | {
        "one_minus_gamma": 1 - flags["gamma"], "one_minus_lambda": 1 - flags["gae_lambda"], "rollout": rollout,
        "minibatch": rollout // flags["num_minibatches"], "entropy": flags["ent_coef"] > 0,
    }  # fmt: skip

    def nearest(value, domain):
        if isinstance(domain, FloatDistribution):
            return min(max(value, domain.low), domain.high)
        return value if value in domain.choices else min(domain.choices, key=lambda choice: abs(choice - value))

    return {name: nearest(exact[name], domain) for name, domain in space.items()}


def suggest(trial: optuna.Trial, space: dict) -> dict:
    """Ask the sampler for a point."""
    point = {}
    for name, domain in space.items():
        if name == "ent_coef" and not point["entropy"]:
            continue
        if isinstance(domain, FloatDistribution):
            point[name] = trial.suggest_float(name, domain.low, domain.high, log=domain.log)
        else:
            point[name] = trial.suggest_categorical(name, domain.choices)
    return point


def words(flags: dict) -> list[str]:
    """{"num_envs": 2, "anneal_lr": False} as --num-envs 2 --no-anneal-lr."""
    words = []
    for name, value in flags.items():
        name = name.replace("_", "-")
        words += [f"--{name}" if value else f"--no-{name}"] if isinstance(value, bool) else [f"--{name}", str(value)]
    return words


# --- Trials -----------------------------------------------------------------------------------------------------------
# One setting can take several of Optuna's trials: a worker that stops or dies leaves a failed one, and a waiting copy
# takes its place. The first of them is their origin, which names the folder; all together they count once.


def origin(trial: FrozenTrial) -> int:
    first = RetryHeartbeatStaleTrialCallback.retried_trial_number(trial)
    return trial.number if first is None else first


def counts(trial: FrozenTrial) -> bool:
    """Finished, or failed for a reason of its own and not of its worker's."""
    return trial.state == TrialState.COMPLETE or (trial.state == TrialState.FAIL and "reason" in trial.user_attrs)


def by_origin(trials: list[FrozenTrial]) -> dict[int, list[FrozenTrial]]:
    """The trials of each setting in the budget; surplus ones, of workers that asked at the same moment, are not."""
    groups = {}
    for trial in trials:
        if not trial.user_attrs.get("surplus"):
            groups.setdefault(origin(trial), []).append(trial)
    return groups


def finished(trials: list[FrozenTrial]) -> list[FrozenTrial]:
    """Of each setting the trial that counts, where there is one."""
    return [next(filter(counts, group)) for group in by_origin(trials).values() if any(map(counts, group))]


def best(trials: list[FrozenTrial]) -> FrozenTrial | None:
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    return max(complete, key=lambda trial: trial.value, default=None)


def state(trial: FrozenTrial) -> str:
    """A word for the table."""
    if trial.state == TrialState.FAIL:
        return "failed" if counts(trial) else "surplus" if trial.user_attrs.get("surplus") else "put back"
    return "finished" if trial.state == TrialState.COMPLETE else trial.state.name.lower()


# --- Files, processes, words ------------------------------------------------------------------------------------------

# Done in the new process, since Python's own hook for it is not safe beside the thread that shows signs of life
LAUNCHER = """
import ctypes, os, signal, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG: a killed worker's training saves and stops
if os.getppid() == int(sys.argv[1]):
    os.execv(sys.executable, [sys.executable, *sys.argv[2:]])
"""


def take_lock(folder: Path) -> int | None:
    """An open file that locks the folder until it is closed or its process ends; None where another one holds it."""
    folder.mkdir(parents=True, exist_ok=True)
    file = os.open(folder / "worker.lock", os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return file
    except OSError:  # held, or a file system without locks, on which no worker is ever taken for dead
        os.close(file)
        return None


def write_atomically(path: Path, text: str):
    """Replace a file in one step, whatever other workers write at the same time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{WORKER}")
    temporary.write_text(text)
    os.replace(temporary, path)


def duration(seconds: float) -> str:
    return f"{seconds / 3600:,.1f} h" if seconds >= 3600 else f"{seconds / 60:.1f} min"


def first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def refusal(said: str) -> str:
    """The sentence with which a training refused its flags: its own, or the first in the box that tyro draws."""
    sentences = [line.split(": error: ")[1] for line in said.splitlines() if ": error: " in line]
    boxed = [line.strip("│ ") for line in said.splitlines() if line.startswith("│")]
    return [*sentences, *boxed, said][0]


def refuse(sentence: str):
    """End the program with one sentence about its input."""
    print(f"tune.py: error: {sentence}", file=sys.stderr)
    raise SystemExit(EXIT_BAD_ARGUMENTS)


class Failed(Exception):
    """The trial fails, and counts."""


class PutBack(Exception):
    """The trial ends here for now, and does not count."""


# --- A worker ---------------------------------------------------------------------------------------------------------


class Worker:
    """Takes trials of one study, one after the other, until the search is over."""

    def __init__(self, args: Args):
        self.args, self.signals, self.child, self.refusal = args, [], None, None
        self.seeds = range(FIRST_SEED, FIRST_SEED + args.seeds)
        self.fixed, arm = {}, ""
        if args.refinement_depth:
            self.fixed = {name: getattr(args, name) for name in REFINEMENT}
            arm = f"-K{args.refinement_depth}-{args.refinement_schedule}"
        searched = args.algorithm == "refineppo" and not self.fixed
        self.space = SPACE | (REFINEMENT if searched else {})
        more = DEFAULT_REFINEMENT if searched else self.fixed
        self.first = [(source, flags | more) for source, flags in first_settings(args.env_id)]
        task = args.env_id.replace("/", "_")
        self.name = args.study_name or f"{task}__{args.algorithm}{arm}"
        self.folder = args.out_dir / self.name
        of = f"-{args.study_name}" if args.study_name else arm
        self.winner_file = args.out_dir / f"settings{of}" / args.algorithm / f"{task}.args"

    def check(self):
        """Refuse what cannot be searched before any work starts."""
        args = self.args
        for name in ("trials", "seeds", "steps", "refinement_depth", "heartbeat"):
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
            given = [word.split("=")[0].removeprefix("--") for word in shlex.split(args.flags)]
        except ValueError as error:
            refuse(f"--flags cannot be read: {error}")
        ours = {*DEFAULT, *REFINEMENT, "seed", "env_id", "total_timesteps", "run_dir", "resume"}
        for name in given:
            if name.removeprefix("no-").replace("-", "_") in ours:
                refuse(f"--flags cannot hold --{name}, which the search sets itself")

    # The study

    def open_storage(self) -> optuna.storages.BaseStorage:
        args, journal = self.args, self.folder / "journal.log"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not args.storage:
                if journal.exists() and journal.read_bytes()[-1:] not in (b"", b"\n"):
                    refuse(f"the journal {journal} ends in half a line; remove that line to continue")
                return optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(journal)))
        except OSError as error:
            refuse(f"cannot write to {self.folder}: {error.strerror}")
        except Exception as error:  # whatever reading other things than its operations raises
            refuse(f"the journal {journal} is damaged: {first_line(error)}")
        for last in (False, False, False, True):
            try:
                return optuna.storages.get_storage(optuna.storages.RDBStorage(
                    args.storage, engine_kwargs={"pool_pre_ping": True},
                    heartbeat_interval=args.heartbeat, grace_period=3 * args.heartbeat,
                ))  # fmt: skip
            except ImportError as error:
                refuse(f"the database's driver is missing ({error}); for PostgreSQL: pip install -e '.[tune]'")
            except Exception as error:  # SQLAlchemy and the drivers have many
                if last:
                    refuse(f"cannot use the database: {first_line(error)}")
                time.sleep(random.uniform(0.2, 1))  # another worker may be making the same tables

    def open_study(self, storage: optuna.storages.BaseStorage):
        """Open the study, made if need be, and refuse to continue another search than the one that it holds."""
        self.study = optuna.create_study(
            storage=storage, study_name=self.name, direction="maximize", load_if_exists=True
        )
        names = "algorithm env_id seeds steps refinement_depth refinement_schedule flags sampler_seed"
        ours = {name: getattr(self.args, name) for name in names.split()}
        if "protocol" not in self.study.user_attrs:
            self.study.set_user_attr("protocol", ours)
        theirs = self.study.user_attrs["protocol"]
        other = [f"--{name.replace('_', '-')} {theirs.get(name)}" for name in ours if ours[name] != theirs.get(name)]
        if other:
            refuse(f"the study {self.name} was begun with other flags than these: {', '.join(other)}")

    def is_dead(self, trial: FrozenTrial) -> bool | None:
        """Whether the worker of a running trial is gone; None where that cannot be told."""
        if "worker" not in trial.user_attrs:  # killed before it could sign
            return (datetime.now() - trial.datetime_start).total_seconds() > 60
        if self.args.storage:
            return False  # its signs of life tell, see put_back
        if trial.user_attrs["worker"].split(":")[0] != WORKER.split(":")[0]:
            return None
        lock = take_lock(self.folder / f"trial_{origin(trial)}")
        if lock:
            os.close(lock)
        return lock is not None

    def put_back(self):
        """Fail the trials of dead workers, and queue a copy of every trial that ended without counting."""
        if self.args.storage:
            optuna.storages.fail_stale_trials(self.study)
        for trial in self.study.get_trials(states=[TrialState.RUNNING]):
            if self.is_dead(trial):
                with suppress(UpdateFinishedTrialError):  # another worker was quicker
                    self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)
        for group in by_origin(self.study.get_trials()).values():
            if all(trial.state == TrialState.FAIL and not counts(trial) for trial in group):
                group[-1].user_attrs.pop("worker", None)
                RetryHeartbeatStaleTrialCallback()(self.study, group[-1])

    # One training

    def on_signal(self, signum, _):
        self.signals.append(signum)
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a second Ctrl-C stops at once
        if self.child:
            self.child.terminate()

    def run(self, flags: dict, log: Path) -> tuple[int, str]:
        """Train with these flags and the user's; the exit code and what was said."""
        script = ROOT / f"{self.args.algorithm}_continuous.py"
        flags = [*words(QUICK), *shlex.split(self.args.flags), *words({"env_id": self.args.env_id} | flags)]
        one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        command = [sys.executable, "-IS", "-c", LAUNCHER, str(os.getpid()), str(script), *flags]
        with open(log, "ab") as file:
            start = file.tell()
            self.child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=file,
                                          env=os.environ | one_thread, process_group=0)  # fmt: skip
            if self.signals:  # one came before `child` was known
                self.child.terminate()
            code = self.child.wait()
        return code, log.read_bytes()[start:].decode(errors="replace").strip()

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
            if code == 0:
                value = json.loads((run_dir / "result.json").read_text())["train_return_last10pct"]
                if value is None:
                    raise Failed(f"no episode ended in the last 10 % of seed {seed}")
                return value
            if code == 3:
                raise Failed(f"numerical failure with seed {seed}")
            if code == 2 and "another process is at work" in said:  # a dead worker's training, about to save and stop
                time.sleep(1)
            elif code == 2:
                self.refusal = refusal(said)
                raise PutBack
            elif code != EXIT_STOPPED and not self.signals:
                crashes += 1
        raise Failed(f"seed {seed} crashed twice, with exit code {code}: {(said or '-').splitlines()[-1]}")

    # One trial

    def choose(self, trial: optuna.Trial, rank: int) -> dict:
        """The settings of a new trial. The sampler's randomness follows from its rank, whichever worker takes it."""
        seed = random.Random(f"{self.args.sampler_seed} {rank}").getrandbits(32)
        sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)
        if rank < len(self.first):
            source, flags = self.first[rank]
            self.study.sampler = optuna.samplers.PartialFixedSampler(nearest_point(flags, self.space), sampler)
            suggest(trial, self.space)
        else:
            self.study.sampler = sampler
            source, flags = "sampled", to_flags(suggest(trial, self.space)) | self.fixed
        trial.set_user_attr("source", source)
        trial.set_user_attr("flags", flags)
        return flags

    def evaluate(self, trial: optuna.Trial) -> float:
        """The value of a trial: the mean over its seeds."""
        groups = by_origin(self.study.get_trials(deepcopy=False))
        number = next(n for n, group in groups.items() if trial.number in [t.number for t in group])
        rank = sum(n < number for n in groups)
        earlier = [t for t in groups[number] if t.number < trial.number]
        if rank >= self.args.trials or any(counts(t) or not t.state.is_finished() for t in earlier):
            trial.set_user_attr("surplus", True)
            raise PutBack
        folder = self.folder / f"trial_{number}"
        self.lock = take_lock(folder)
        trial.set_user_attr("worker", WORKER)
        flags = trial.user_attrs.get("flags") or self.choose(trial, rank)
        returns, seconds = [], trial.user_attrs.get("seconds", 0)
        for seed in self.seeds:
            start = time.time()
            try:
                returns.append(self.train(flags, folder, seed))
            finally:
                trial.set_user_attr("seconds", seconds := seconds + time.time() - start)
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
                os.close(self.lock)
        if self.refusal:
            self.put_back()
            refuse(self.refusal)

    # The search

    def search(self):
        """Take trials until the search is over, then wait for those of other workers, which may be put back."""
        waiting = False
        while not self.signals:
            self.put_back()
            trials = self.study.get_trials()
            running = [trial for trial in trials if trial.state == TrialState.RUNNING]
            names = ", ".join(f"{t.number} ({t.user_attrs.get('worker')})" for t in running)
            if len(finished(trials)) >= self.args.trials:
                return
            if len(by_origin(trials)) < self.args.trials or any(t.state == TrialState.WAITING for t in trials):
                self.take_trial()
            elif running and all(self.is_dead(trial) is None for trial in running):
                print(f"what is left runs on other machines, or died there: {names}. The last worker there ends the "
                      "search; if none is left, start one there, which puts the trial back")  # fmt: skip
                raise SystemExit(0)
            else:
                if not waiting:
                    print(f"waiting for the trials of other workers: {names}", flush=True)
                waiting = True
                time.sleep(1)

    def state_budget(self, done: int):
        """Say what the search costs, by a short training with the default settings; it also tries the user's flags."""
        args, trainings, start, probe = self.args, self.args.trials * self.args.seeds, time.time(), 4096
        print(f"{args.algorithm} on {args.env_id}: {args.trials} trials x {args.seeds} seeds x {args.steps:,} steps = "
              f"{trainings * args.steps:,} environment steps; {done} trials are done", flush=True)  # fmt: skip
        with TemporaryDirectory() as folder:
            run_dir = Path(folder) / "run"
            flags = self.first[0][1] | {"total_timesteps": probe, "run_dir": run_dir}
            code, said = self.run(flags, Path(folder) / "log")
            if code == 2:
                refuse(refusal(said))
            if code == 0:
                sps = json.loads((run_dir / "result.json").read_text())["sps"]
                begin = max(0, time.time() - start - probe / sps)  # start, compilation and the evaluations at the end
                left = (args.trials - done) * args.seeds * (begin + args.steps / sps)
                speed = f"{sps:,.0f} steps/s here, and take {begin:.0f} s besides"
                print(f"the default settings train at {speed}: about {duration(left)} with one worker, "
                      f"{duration(left / 8)} with eight on a core each", flush=True)  # fmt: skip
            elif not self.signals:
                print(f"no speed to tell: the default settings end with exit code {code} here", flush=True)

    def report(self, study: optuna.Study, trial: FrozenTrial):
        """A line for the trial that this worker has ended, and the files."""
        trials = study.get_trials()
        self.write_files(trials)
        if not counts(trial):
            return
        done, leader = finished(trials), best(trials)
        result = f"failed: {trial.user_attrs['reason']}" if trial.value is None else f"{trial.value:.2f}"
        so_far = f"best {leader.value:.2f}, trial {origin(leader)}; " if leader else ""
        workers = 1 + sum(t.state == TrialState.RUNNING for t in trials)
        left = max(0, self.args.trials - len(done)) * mean(t.user_attrs["seconds"] for t in done) / workers
        print(f"trial {origin(trial)}, {trial.user_attrs['source']}: {result}; {so_far}"
              f"{len(done)} of {self.args.trials} done, about {duration(left)} left", flush=True)  # fmt: skip

    def write_files(self, trials: list[FrozenTrial]):
        """The table of all trials, and the best so far as a settings file."""
        flags = [*DEFAULT, *(REFINEMENT if self.args.algorithm == "refineppo" else ())]
        returns = [f"return_{seed}" for seed in self.seeds]
        table = io.StringIO()
        writer = csv.DictWriter(table, [*COLUMNS, *returns, *flags], lineterminator="\n")
        writer.writeheader()
        for trial in trials:
            about = trial.user_attrs
            row = {name: about.get(name) for name in COLUMNS} | {"number": trial.number, "value": trial.value}
            row |= {"folder": f"trial_{origin(trial)}", "state": state(trial)}
            writer.writerow(row | dict(zip(returns, about.get("returns", ()))) | about.get("flags", {}))
        write_atomically(self.folder / "trials.csv", table.getvalue())
        leader = best(trials)
        if leader:
            changed = {k: v for k, v in leader.user_attrs["flags"].items() if k in REFINEMENT or v != DEFAULT[k]}
            lines = [
                f"# Study {self.name}, trial {origin(leader)}, best of {len(finished(trials))}: mean training return "
                f"{leader.value:.2f} in the last 10 %",
                f"# of {self.args.steps} steps, seeds {' '.join(map(str, self.seeds))}; all other flags as the scripts "
                f"have them{self.args.flags and ', but for ' + self.args.flags}",
                *(" ".join(words({name: value})) for name, value in changed.items()),
            ]
            write_atomically(self.winner_file, "".join(f"{line}\n" for line in lines))

    def conclude(self):
        """The winner, beside the default."""
        trials = self.study.get_trials()
        self.write_files(trials)
        leader, default = best(trials), next(t for t in finished(trials) if t.user_attrs["source"] == "default")
        if leader is None:
            raise SystemExit(f"the search is over: no trial succeeded, see {self.folder / 'trials.csv'}")
        print(f"the search is over: trial {origin(leader)} of {len(finished(trials))} is best with {leader.value:.2f}; "
              f"the default {'failed' if default.value is None else f'reached {default.value:.2f}'}\n"
              f"its settings are in {self.winner_file}, all trials in {self.folder / 'trials.csv'}\n"
              "the best of many looks better than it is on the seeds that chose it: report it with the seeds 1 to 5\n"
              f"    SETTINGS={self.winner_file.parent.parent} sweeps/benchmark.sh {self.args.env_id}")  # fmt: skip


def main(args: Args):
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.simplefilter("ignore", ExperimentalWarning)
    worker = Worker(args)
    worker.check()
    for signum in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1):
        signal.signal(signum, worker.on_signal)
    if args.dry_run:
        worker.state_budget(done=0)
        raise SystemExit(EXIT_STOPPED if worker.signals else 0)
    try:
        storage = worker.open_storage()
        known = worker.name in optuna.get_all_study_names(storage)
        if known:
            worker.open_study(storage)
        done = len(finished(worker.study.get_trials())) if known else 0
        if done < args.trials:
            worker.state_budget(done)
            worker.open_study(storage)
            worker.write_files(worker.study.get_trials())
            worker.search()
            if worker.signals:
                worker.put_back()
                print(f"stopped by {signal.Signals(worker.signals[0]).name}; the same command continues the search")
                raise SystemExit(EXIT_STOPPED)
        worker.conclude()
    except StorageInternalError as error:
        print(f"the database failed: {first_line(error)}; the same command continues the search", file=sys.stderr)
        raise SystemExit(EXIT_STOPPED) from None


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
