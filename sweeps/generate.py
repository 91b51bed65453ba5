"""From the environment:

    SEEDS      "1 2 3 4 5"
    STEPS      environment steps of a run, 6000000
    RUNS_DIR   where the run folders go, runs
    SETTINGS   folder of the tasks' settings, {ppo,refineppo}/<task>.args; `none` for the scripts' defaults
    FLAGS      flags of all runs, on top of the settings, as in FLAGS="--eval-interval 50000"
    DONE       table of runs made by report.py, runs.csv: a run that stands there, finished or failed, is left out

A run's folder is <task>__<method>__<actor>__<other flags>__<steps>__<seed>, without what is as the scripts have it
(HalfCheetah-v5__ppo__256x256__1M__1). So the same run has the same folder, and the same command, in every sweep, and
is trained once. Flags of more than 150 characters are there as their checksum, and those that change no number not at
all.
"""

import csv
import os
import re
import shlex
import signal
import sys
import zlib
from collections.abc import Iterable
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

from common import ROOT, refuse, steps_text
from flags import default_args, file_name, parse, settings_file, words

HERE = ROOT / "sweeps"
MUJOCO = "Ant HalfCheetah Hopper Walker2d Swimmer Pusher Reacher HumanoidStandup Humanoid"
MUJOCO = [f"{name}-v5" for name in MUJOCO.split()]
OTHERS = "Pendulum-v1 MountainCarContinuous-v0 LunarLanderContinuous-v3 BipedalWalker-v3 BipedalWalkerHardcore-v3"
ALL = [*MUJOCO, *OTHERS.split()]
TOY = "sweeps.toy_env:Coordination-v0"
# Flags that a sweep sets itself, with values that no run has; that have places of their own in a name; that have none
OF_THE_SWEEP = dict(env_id="", seed=-1, total_timesteps=-1, run_dir="", resume=False, evaluate="", render=False)
IN_THE_NAME = {"refinement_depth", "refinement_schedule", "actor_hidden"}
CHANGE_NO_NUMBER = {"save_every", "checkpoint_interval", "progress", "track", "capture_video"}


# --- The sweeps: the methods that a task is trained with, as (algorithm, flags) ---------------------------------------


def benchmark(task: str):
    return [("ppo", {}), ("refineppo", {})]


def depth(task: str):
    return [("refineppo", {"refinement_depth": depth}) for depth in (1, 2, 4, 8)]


def schedule(task: str):
    return [("refineppo", {"refinement_schedule": schedule}) for schedule in ("average", "uniform", "inverse")]


def refinement(depth: int, schedule: str) -> tuple[str, dict]:
    return "refineppo", {"refinement_depth": depth, "refinement_schedule": schedule}


def controls(task: str):
    wide = 216 if task.startswith("HumanoidStandup") else 256
    return [
        *(refinement(depth, "average") for depth in (1, 2, 8)),
        *(refinement(4, schedule) for schedule in ("uniform", "inverse")),
        *(("ppo", {"actor_hidden": hidden}) for hidden in ((128,) * 5, (wide,) * 2)),
    ]


def learning_rates(task: str):
    for algorithm, flags in (("ppo", {}), refinement(4, "average"), refinement(4, "uniform")):
        rate = settings(algorithm, task).learning_rate
        yield from ((algorithm, flags | {"learning_rate": float(f"{x:.4g}")}) for x in (rate / 3, rate * 3))


def toy(task: str):
    return [("ppo", {}), *(refinement(depth, schedule) for depth in (1, 2, 4) for schedule in ("uniform", "average"))]


SWEEPS = {  # name: tasks, methods
    "benchmark": (ALL, benchmark),
    "depth": (ALL, depth),
    "schedule": (MUJOCO, schedule),
    "controls": ("HalfCheetah-v5 Pusher-v5 Hopper-v5 HumanoidStandup-v5 Swimmer-v5".split(), controls),
    "learning_rates": ("HalfCheetah-v5 Hopper-v5 Swimmer-v5".split(), learning_rates),
    "toy": ([TOY], toy),
}


# --- A run ------------------------------------------------------------------------------------------------------------


def given(name: str, default: str = "") -> str:
    """An environment variable; an empty one is as none."""
    return os.environ.get(name) or default


def parse_or_refuse(text: str, args, where: str):
    """Flags on top of `args`; refused with their place if the script does not know them, or the sweep sets them."""
    before = replace(args, **OF_THE_SWEEP)
    try:
        parsed = parse(text, before)
    except ValueError as error:
        refuse(f"{where}: {error}")
    refuse_changes(OF_THE_SWEEP, parsed, before, where)
    return parsed


def refuse_changes(names: Iterable[str], parsed, args, where: str):
    for name in names:
        if getattr(parsed, name) != getattr(args, name):
            refuse(f"{where}: --{name.replace('_', '-')} is the sweep's own")


def folder_of_settings() -> Path:
    return Path(given("SETTINGS", str(HERE / "settings"))).expanduser()


@cache
def settings(algorithm: str, task: str):
    """The script's flags for a task: its defaults, and what the task's settings file changes."""
    args = default_args(algorithm)
    file = HERE / "toy.args" if task == TOY else settings_file(folder_of_settings(), algorithm, task)
    return parse_or_refuse(file.read_text(), args, file) if file.exists() else args


@cache
def with_flags(algorithm: str, task: str):
    """And what FLAGS changes."""
    args = settings(algorithm, task)
    return parse_or_refuse(given("FLAGS"), args, "FLAGS") if given("FLAGS") else args


def args_of_run(algorithm: str, task: str, seed: int, varied: dict):
    """All flags of a run but its folder; FLAGS must leave alone what the sweep varies."""
    args = with_flags(algorithm, task)
    refuse_changes(varied, args, settings(algorithm, task), "FLAGS")
    return replace(args, env_id=task, seed=seed, total_timesteps=int(given("STEPS", "6000000")), **varied)


def flag_text(name: str, value) -> str:
    flag, *values = words({name: value})
    return flag.removeprefix("--") + ("=" + "x".join(values) if values else "")


def folder_name(algorithm: str, args, changed: dict) -> str:
    """What the head of this file says; `changed` are the flags that are not as the script has them."""
    method, actor = algorithm, ""
    if algorithm == "refineppo":
        method += f"-K{args.refinement_depth}-{args.refinement_schedule}"
    if "actor_hidden" in changed:
        actor = "x".join(map(str, args.actor_hidden))
    others = changed.keys() - OF_THE_SWEEP.keys() - IN_THE_NAME - CHANGE_NO_NUMBER
    flags = ",".join(flag_text(name, value) for name, value in sorted(changed.items()) if name in others)
    if len(flags) > 150:
        flags = f"{len(others)}-flags-{zlib.crc32(flags.encode()):08x}"
    parts = file_name(args.env_id), method, actor, flags, steps_text(args.total_timesteps), str(args.seed)
    return "__".join(filter(None, parts))


def command(algorithm: str, task: str, seed: int, varied: dict) -> tuple[str, str]:
    """A run's folder below RUNS_DIR, and the command that trains it."""
    args, default = args_of_run(algorithm, task, seed, varied), asdict(default_args(algorithm))
    changed = {name: value for name, value in asdict(args).items() if value != default[name]}
    folder = folder_name(algorithm, args, changed)
    always = ["env_id", "seed", "total_timesteps"]
    if algorithm == "refineppo":
        always += ["refinement_depth", "refinement_schedule"]
    said = {name: getattr(args, name) for name in always}
    said |= {name: value for name, value in changed.items() if name not in OF_THE_SWEEP}
    said |= {"run_dir": Path(given("RUNS_DIR", "runs")).expanduser() / folder, "resume": True}
    script = Path(f"{algorithm}_continuous.py")
    return folder, shlex.join(["python", str(script if Path.cwd() == ROOT else ROOT / script), *words(said)])


# --- The program ------------------------------------------------------------------------------------------------------


def show_help(entry: Path):
    comment = entry.read_text().split("\n\n")[0].splitlines()[1:]
    print("\n".join(line.removeprefix("#").removeprefix(" ") for line in comment), f"\n\n{__doc__}")
    raise SystemExit


def check_input(tasks: list[str]) -> list[int]:
    """Refuse what needs no look at the scripts; return the seeds."""
    for task in tasks:
        if task.startswith("-") or not re.fullmatch(r"\S+", task):
            refuse(f"{task} is no task; the arguments are tasks, such as Hopper-v5")
    seeds, steps = given("SEEDS", "1 2 3 4 5"), given("STEPS", "1")
    if not seeds.split():
        refuse("SEEDS is empty")
    if not all(re.fullmatch("0|[1-9][0-9]*", seed) for seed in seeds.split()):
        refuse(f"SEEDS must be whole numbers with spaces between, not '{seeds}'")
    if not re.fullmatch("[1-9][0-9]*", steps):
        refuse(f"STEPS must be a whole number, not '{steps}'")
    if given("SETTINGS", "none") != "none" and not folder_of_settings().is_dir():
        refuse(f"there is no settings folder {folder_of_settings()}")
    return [int(seed) for seed in seeds.split()]


def runs_done() -> set[str]:
    """The names of the runs in DONE, none without it."""
    if not given("DONE"):
        return set()
    table = Path(given("DONE")).expanduser()
    if not table.is_file():
        refuse(f"DONE: there is no file {table}")
    with open(table, newline="") as file:
        rows = csv.DictReader(file)
        if "run" not in (rows.fieldnames or ()):
            refuse(f"DONE: {table} has no column `run`; it is the file runs.csv that report.py writes")
        return {row["run"] for row in rows}


def main():
    entry, *tasks = sys.argv[1:]
    sys.argv[0] = entry  # refusals name what was called
    if {"-h", "--help"} & set(tasks):
        show_help(Path(entry))
    seeds, done = check_input(tasks), runs_done()
    default_tasks, methods = SWEEPS[Path(entry).stem]
    if default_tasks == [TOY] and tasks:
        refuse("the toy is one task; there are no arguments")
    jobs = [
        command(algorithm, task, seed, varied)
        for seed in seeds
        for task in tasks or default_tasks
        for algorithm, varied in methods(task)
    ]
    for folder, line in jobs:
        if folder not in done:
            print(line)


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `| head` ends this without a word
    main()
