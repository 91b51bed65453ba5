"""The two tidy tables of all runs, runs.csv and evaluations.csv, and the cells of tables that the runs fall into.

The tables are read from run folders and from such tables, and merged. All values stay text on the way, so that no
digit changes, and a table that is read and written again is the same.
"""

import csv
import io
import json
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from common import first_line, refuse
from flags import default_args, words

# Flags that have columns of their own, and those that change no number
OWN_COLUMNS = {"env_id", "total_timesteps", "seed", "actor_hidden", "refinement_depth", "refinement_schedule"}
NO_NUMBER = {"exp_name", "run_dir", "resume", "progress", "track", "wandb_project_name", "wandb_entity"}
NO_NUMBER |= {"capture_video", "render", "evaluate", "checkpoint_interval", "save_every"}

KEY = "task method depth schedule actor flags seed steps".split()
FINAL = "global_step mean std returns".split()  # of the best and of the last checkpoint
RESULT = "train_return_last10pct sps wall_time_s".split()
RUN_COLUMNS = ["run", "failure", *KEY, "best_selection_return", *(f"best_{name}" for name in FINAL)]
RUN_COLUMNS += [*(f"last_{name}" for name in FINAL), *RESULT, "git_commit", "versions", "cpu", "gpu"]
EVALUATION_COLUMNS = "run global_step return_mean return_std return_min return_max length_mean".split()
FIRST_SEARCH_SEED = 1001  # seeds from here on belong to hyperparameter searches
DEFAULT_ACTOR, DEFAULT_LR = "128x128", 3e-4
MACHINE = {"compile", "cuda", "num-threads", "torch-deterministic"}  # flags in which the seeds of a cell may differ
TEXT = "run failure task method schedule actor flags best_returns last_returns git_commit versions cpu gpu".split()


class Run(NamedTuple):
    """A run's row of runs.csv and its rows of evaluations.csv, as text, so that no digit changes; and from where."""

    source: Path
    row: dict[str, str]
    evaluations: list[dict[str, str]]


def read_csv(path: Path, columns: list[str]) -> list[dict[str, str]]:
    """Rows of a table as text; ValueError if it lacks one of the columns."""
    with open(path, newline="") as file:
        rows = csv.DictReader(file)
        if missing := [name for name in columns if name not in (rows.fieldnames or ())]:
            raise ValueError(f"{path} has no column {missing[0]}")
        return [{name: row[name] for name in columns} for row in rows]


def read_tables(path: Path) -> Iterator[Run]:
    """The runs of a runs.csv, which has its evaluations.csv beside it."""
    try:
        rows, evaluations = read_csv(path, RUN_COLUMNS), defaultdict(list)
        for row in read_csv(path.with_name("evaluations.csv"), EVALUATION_COLUMNS):
            evaluations[row["run"]].append(row)
    except (OSError, ValueError) as error:
        refuse(f"cannot read the tables of {path}: {first_line(error)}")
    for row in rows:
        yield Run(path, row, evaluations[row["run"]])


def read_run(folder: Path, defaults: dict) -> Run:
    """A finished or failed run's folder."""
    config = json.loads((folder / "config.json").read_text())
    args, others = config["args"], config["args"].keys() - OWN_COLUMNS - NO_NUMBER
    flags = {name: args[name] for name in sorted(others) if args[name] != defaults.get(name)}
    row = {
        "run": folder.resolve().name,
        "task": args["env_id"],
        "method": "PPO" if args.get("refinement_depth") is None else "RefinePPO",
        "depth": args.get("refinement_depth"),
        "schedule": args.get("refinement_schedule"),
        "actor": "x".join(map(str, args["actor_hidden"])),
        "flags": " ".join(words({name: tuple(x) if isinstance(x, list) else x for name, x in flags.items()})),
        "seed": args["seed"],
        "steps": args["total_timesteps"],
        "versions": ", ".join(f"{name} {version}" for name, version in config["versions"].items()),
        "git_commit": config["git_commit"],
        "cpu": config["cpu"],
        "gpu": config.get("gpu"),
    }
    if (folder / "result.json").exists():
        result = json.loads((folder / "result.json").read_text())
        row |= {name: result[name] for name in RESULT}
        for which in ("best", "last"):
            row |= {f"{which}_{name}": x for name, x in result[which].items()}
            row[f"{which}_returns"] = " ".join(map(str, result[which]["returns"]))
    else:  # what was not finite, and the whole numbers that say where and when
        facts = json.loads((folder / "failure.json").read_text())
        row["failure"] = ", ".join([facts["what"], *(f"{name} {x}" for name, x in facts.items() if type(x) is int)])
    row = {name: "" if row.get(name) is None else str(row[name]) for name in RUN_COLUMNS}
    table = folder / "evaluations.csv"
    evaluations = read_csv(table, EVALUATION_COLUMNS[1:]) if table.exists() else []  # it may fail before the first
    return Run(folder, row, [{"run": row["run"], **point} for point in evaluations])


def find_runs(root: Path, say: Callable) -> list[Path]:
    """Folders of finished and failed runs at and below `root`, through links; says what else is left out."""
    found, unfinished, seen = [], [], set()
    for path, subfolders, files in os.walk(root, followlinks=True, onerror=lambda e: say(f"cannot read {e}")):
        if os.path.realpath(path) in seen or "runs.csv" in files and Path(path) != root:  # a loop of links; a report
            subfolders.clear()
        elif {"trials.csv", "journal.log"} & {*files}:
            say(f"left out: {path}, a search by tune.py")
            subfolders.clear()
        elif {"config.json", "result.json"} & {*files}:
            (found if {"result.json", "failure.json"} & {*files} else unfinished).append(Path(path))
            subfolders.clear()
        seen.add(os.path.realpath(path))
        subfolders.sort()
    if unfinished:
        say(f"left out, not finished: {', '.join(map(str, unfinished))}")
    return found


def read_source(source: Path, say: Callable) -> Iterator[Run]:
    """The runs of a source: of its tables, and of the run folders in it."""
    path = source if source.is_file() else source / "runs.csv"
    if not source.exists():
        refuse(f"there is no {source}")
    if path.is_file():
        yield from read_tables(path)
    if source.is_dir() and (folders := find_runs(source, say)):
        defaults = json.loads(json.dumps(asdict(default_args("refineppo"))))  # PPO's are among them
        for folder in folders:
            try:
                yield read_run(folder, defaults)
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                say(f"cannot read {folder}: {type(error).__name__}: {first_line(error)}")


def merge(runs: Iterable[Run]) -> dict[str, Run]:
    """Each run once, by name; refused if two sources differ in it."""
    merged = {}
    for run in runs:
        first = merged.setdefault(run.row["run"], run)
        if first[1:] != run[1:]:
            differ = [name for name in RUN_COLUMNS if first.row[name] != run.row[name]] or ["evaluation"]
            refuse(f"the run {run.row['run']} has another {differ[0]} in {run.source} than in {first.source}")
    return merged


def as_tables(runs: dict[str, Run]) -> tuple[str, str]:
    """The text of runs.csv and of evaluations.csv, in an order that depends on no source."""
    frame = pd.DataFrame([run.row for run in runs.values()], columns=RUN_COLUMNS)
    order = ["steps", *KEY[:-1], "run"]
    frame = frame.sort_values(order, key=lambda x: pd.to_numeric(x) if x.name in ("steps", "depth", "seed") else x)
    evaluations = [row for name in frame.run for row in runs[name].evaluations]
    frames = frame, pd.DataFrame(evaluations, columns=EVALUATION_COLUMNS)
    return tuple(frame.to_csv(index=False, lineterminator="\n") for frame in frames)


def typed(table: str) -> pd.DataFrame:
    """A table's text as text and numbers, an empty one as NaN."""
    frame = pd.read_csv(io.StringIO(table), dtype=str, keep_default_na=False)
    for name in frame.columns.difference(TEXT):
        kind = int if name in ("seed", "steps", "global_step") else float
        frame[name] = [kind(x or "nan") for x in frame[name]]
    return frame


# --- Settings, variants and cells -------------------------------------------------------------------------------------


class Cell(NamedTuple):
    """What the seeds behind a number share, beside the number of steps; PPO has no depth and no schedule."""

    task: str
    depth: int | None = None
    schedule: str | None = None
    variant: tuple[str, ...] = ()  # what differs from the task's settings

    @property
    def method(self) -> str:
        name = "PPO" if self.depth is None else f"RefinePPO K={self.depth} {self.schedule}"
        return " ".join([name, *self.variant])

    @property
    def kind(self) -> str:
        """Which section compares it: a control may have another actor; `rate` another learning rate."""
        if all(re.fullmatch(r"\d+(x\d+)*", part) for part in self.variant):
            return "control"
        return "rate" if len(self.variant) == 1 and self.variant[0].startswith("lr ") else "variant"


def settings_of(run) -> frozenset[str]:
    """What decides a run's variant: its flags but for the machine's, its layers, and whether it is of a search."""
    flags = [flag for flag in re.split(r"(?:^| )--", run.flags) if flag]
    settings = {flag for flag in flags if flag.split()[0].removeprefix("no-") not in MACHINE}
    settings |= {f"actor {run.actor}"} if run.actor != DEFAULT_ACTOR else set()
    return frozenset(settings | ({f"seeds from {FIRST_SEARCH_SEED} on"} if run.seed >= FIRST_SEARCH_SEED else set()))


def learning_rate(settings: Iterable[str]) -> float:
    return next((float(part.split()[1]) for part in settings if part.startswith("learning-rate ")), DEFAULT_LR)


def rate_ratio(run, base: frozenset[str]) -> Fraction:
    """A run's learning rate by that of its task's settings."""
    return Fraction(learning_rate(settings_of(run)) / learning_rate(base)).limit_denominator(100)


def difference(settings: frozenset[str], base: frozenset[str]) -> tuple[str, ...]:
    """What a run has in place of its task's settings, the actor first."""
    parts = {part.split()[0]: part for part in settings}
    differing = {part.split()[0] for part in settings ^ base}
    texts = {name: parts.get(name, f"default {name}") for name in sorted(differing)}
    if "learning-rate" in texts:
        rate = np.format_float_scientific(learning_rate(settings), trim="-", exp_digits=1)
        texts["learning-rate"] = f"lr {rate}"
    actor = [parts.get("actor", f"actor {DEFAULT_ACTOR}").split()[1]] if texts.pop("actor", None) else []
    return *actor, *texts.values()


def actor_cost(run, obs_dim: int, action_dim: int) -> dict[str, int]:
    """Weights and biases of an actor, and its multiplications for one action.

    The refinement's first layer reads the observation once, and the proposal in every step but the first (m_0 = 0).
    """
    hidden = [*map(int, run.actor.split("x"))]
    inside = sum(a * b for a, b in zip(hidden, [*hidden[1:], action_dim]))
    depth, feedback = (1, 0) if run.method == "PPO" else (int(run.depth), action_dim * hidden[0])
    return {
        "parameters": obs_dim * hidden[0] + feedback + inside + sum(hidden) + action_dim,
        "multiplications": obs_dim * hidden[0] + (depth - 1) * feedback + depth * inside,
    }


def sort_into_cells(runs: pd.DataFrame) -> tuple[dict[Cell, list], dict[tuple[str, str], frozenset[str]], list[str]]:
    """Finished runs of one number of steps as {cell: rows, a seed each}; {(task, method): settings}; seeds again.

    The settings of a task and method are what most of its runs have, failed ones too, and if several are as many, the
    fewest flags.
    """
    settings, counts = [*map(settings_of, runs.itertuples())], defaultdict(Counter)
    for run, of_run in zip(runs.itertuples(), settings):
        counts[run.task, run.method][of_run] += 1
    base = {key: min(of, key=lambda x: (-of[x], len(x), sorted(x))) for key, of in counts.items()}
    cells, again = defaultdict(dict), []
    for run, of_run in zip(runs.itertuples(), settings):
        if run.failure:
            continue
        refinement = (None, None) if run.method == "PPO" else (int(run.depth), run.schedule)
        cell = Cell(run.task, *refinement, difference(of_run, base[run.task, run.method]))
        first = cells[cell].setdefault(run.seed, run)
        if first is not run:
            again.append(f"`{run.run}`: seed {run.seed} again, beside `{first.run}`")
    return {cell: [*seeds.values()] for cell, seeds in cells.items()}, base, again
