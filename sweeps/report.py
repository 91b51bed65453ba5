"""The paper's tables and figures from a folder of runs, beside the paper's own numbers.

    python sweeps/report.py runs

Reads config.json, evaluations.csv and result.json of every run folder below RUNS_DIR, but for searches (tune.py);
links are followed. Writes report.md with its figures (PNG, PDF), and each table also as CSV and LaTeX (booktabs). A
sweep that is not complete reports what is there and says what is missing; folders that cannot be used are named with
the reason.

All seeds of a setting (task, K, schedule) share all other flags. Of several variants of a setting the one with the
flags that --settings asks for counts, then that with the most finished seeds, then the most steps; the others are
named. RefinePPO has the K and schedule that --settings asks for, else those of --depth and --schedule.
"""

import ast
import csv
import io
import json
import math
import os
import re
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import tyro
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from scipy.stats import spearmanr, trim_mean

HERE = Path(__file__).resolve().parent
SEEDS, DEPTHS, SCHEDULES = 5, (1, 2, 4, 8), ("average", "uniform", "inverse")  # the paper's
CURVE_TASKS = ("HalfCheetah-v5", "Pusher-v5", "Hopper-v5", "HumanoidStandup-v5", "Humanoid-v5", "Swimmer-v5")  # Fig. 2
TOY, SOLVED = "sweeps.toy_env:Coordination-v0", -0.01  # its task, and the evaluation return from which it is solved
FIRST_SEARCH_SEED = 1001  # seeds from here on belong to hyperparameter searches
RESAMPLES = 10_000  # of each bootstrap
SELECTIONS = {"best": "best checkpoint", "last": "last checkpoint", "last10": "last 10 % of training"}

RUN_FILES = {"config.json", "evaluations.csv", "result.json", "last.pt", "best.pt"}
CURVE_HEADER = "global_step,return_mean,return_std,return_min,return_max,length_mean"
OWN_FLAGS = set(  # in which the seeds of a setting may differ
    "seed exp_name run_dir resume progress track wandb_project_name wandb_entity capture_video render evaluate compile"
    " cuda num_threads torch_deterministic checkpoint_interval save_every".split()
)
SWEPT_FLAGS = {"env_id", "total_timesteps", "refinement_depth", "refinement_schedule"}  # by the generators
MARK = "<!-- made by sweeps/report.py -->"
TABLES = "table1 table2 depth depth_normalised sample_efficiency selection seeds aggregate toy".split()
FIGURES = "training_curves depth action_dimension seeds".split()
OUTPUTS = {"report.md", *(f"{name}.{kind}" for name in TABLES for kind in ("csv", "tex"))}
OUTPUTS |= {f"{name}.{kind}" for name in FIGURES for kind in ("png", "pdf")}


@dataclass
class Args:
    runs_dir: tyro.conf.Positional[Path]
    """folder that holds the run folders, at any depth"""
    out_dir: Path | None = None
    """folder of the report; default RUNS_DIR/report"""
    depth: int = 4
    """refinement depth K that stands for RefinePPO"""
    schedule: Literal["average", "uniform", "inverse"] = "average"
    """refinement schedule that stands for RefinePPO"""
    settings: Path = field(default_factory=lambda: Path(os.environ.get("SETTINGS") or HERE / "settings"))
    """folder of the tasks' settings, {ppo,refineppo}/<task>.args, or `none`; default SETTINGS as in the generators"""


def refuse(sentence: str):
    """End the program with one sentence about its input."""
    print(f"report.py: error: {sentence}", file=sys.stderr)
    raise SystemExit(2)


def grouped(items: Iterable, key: Callable) -> dict:
    """Key -> its items, in the order of the first."""
    groups = defaultdict(list)
    for item in items:
        groups[key(item)].append(item)
    return dict(groups)


# --- Reading ----------------------------------------------------------------------------------------------------------


class Setting(NamedTuple):
    """What all seeds of a cell share; PPO has no depth and no schedule."""

    task: str
    depth: int | None = None
    schedule: str | None = None

    @property
    def method(self) -> str:
        return "PPO" if self.depth is None else f"RefinePPO, K = {self.depth}, {self.schedule}"


@dataclass
class Run:
    """A run folder that can be used; `name` is its path below RUNS_DIR, and an unfinished run has no scores."""

    name: str
    args: dict
    curve: np.ndarray  # (evaluations, 2): global step and mean return
    scores: dict[str, float] | None
    failed: bool  # for good: a number was not finite

    @property
    def setting(self) -> Setting:
        return Setting(self.args["env_id"], self.args.get("refinement_depth"), self.args.get("refinement_schedule"))

    @property
    def progress(self) -> str:
        step = int(self.curve[-1, 0]) if len(self.curve) else 0
        failure = ", ended by a number that is not finite" if self.failed else ""
        return f"evaluated up to step {step:,} of {self.args['total_timesteps']:,}{failure}"

    @property
    def is_search(self) -> bool:
        return self.args["seed"] >= FIRST_SEARCH_SEED

    @property
    def variant(self) -> tuple:
        """Equal for runs that differ in nothing but their seed."""
        flags = {name: json.dumps(value) for name, value in self.args.items() if name not in OWN_FLAGS}
        return self.is_search, *sorted(flags.items())


class Unusable(Exception):
    """Why a folder is skipped."""


def read_json(path: Path):
    try:
        return json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise Unusable(f"torn: {path.name} is not JSON") from error


def read_curve(path: Path) -> np.ndarray:
    """Global step and mean return of the evaluations, (evaluations, 2)."""
    try:
        header, *lines = path.read_text().splitlines()
        table = np.array([line.split(",") for line in lines], float) if lines else np.zeros((0, 6))
    except ValueError:
        header = None
    if header != CURVE_HEADER or table.shape[1:] != (6,) or not np.isfinite(table).all():
        raise Unusable(f"torn: {path.name} is not a table of finite numbers as the training scripts write it")
    if (np.diff(table[:, 0], prepend=0) <= 0).any():
        raise Unusable(f"torn: the steps in {path.name} do not rise")
    return table[:, :2]


def read_scores(path: Path, args: dict) -> dict[str, float]:
    """A finished run's mean return of each of SELECTIONS; NaN for the last 10 % if no episode ended there."""
    result = read_json(path)
    try:
        for name in ("env_id", "seed", "total_timesteps", "refinement_depth", "refinement_schedule"):
            if result[name] != args.get(name):
                raise Unusable(f"{name} is {result[name]} in result.json, but {args.get(name)} in config.json")
        late = result["train_return_last10pct"]
        scores = {"best": result["best"]["mean"], "last": result["last"]["mean"], "last10": 0 if late is None else late}
        if not all(math.isfinite(score) for score in scores.values()):
            raise Unusable("a return in result.json is not finite")
    except (KeyError, TypeError, OverflowError) as error:
        raise Unusable("torn: result.json lacks a field or has one of another type") from error
    return scores | ({"last10": math.nan} if late is None else {})


def read_run(folder: Path, name: str) -> Run:
    if not (folder / "config.json").exists():
        raise Unusable("torn or foreign: there is no config.json")
    config = read_json(folder / "config.json")
    args = config.get("args") if isinstance(config, dict) else None
    types = {"env_id": str, "seed": int, "total_timesteps": int}
    if not isinstance(args, dict) or not args.keys() >= types.keys():
        raise Unusable("foreign: config.json is not of a training script")
    types |= {"refinement_depth": int, "refinement_schedule": str} if args.get("refinement_depth") is not None else {}
    if not all(type(args.get(flag)) is kind for flag, kind in types.items()):
        raise Unusable("torn: a flag in config.json is of another type")
    curve = read_curve(folder / "evaluations.csv") if (folder / "evaluations.csv").exists() else np.zeros((0, 2))
    scores = read_scores(folder / "result.json", args) if (folder / "result.json").exists() else None
    return Run(name, args, curve, scores, (folder / "failure.json").exists())


def find_runs(root: Path) -> tuple[list[Run], dict[str, str]]:
    """All usable runs below `root` by path, and why other folders are not; each folder once, whatever links to it."""
    runs, skipped, seen = [], {}, set()

    def unreadable(error: OSError):
        skipped[os.path.relpath(error.filename, root)] = f"unreadable: {error.strerror}"

    for path, subfolders, files in os.walk(root, onerror=unreadable, followlinks=True):
        status = os.stat(path)
        if (status.st_dev, status.st_ino) in seen:
            subfolders.clear()
            continue
        seen.add((status.st_dev, status.st_ino))
        name = os.path.relpath(path, root)
        if {"trials.csv", "journal.log"} & {*files}:
            skipped[name] = "a search by tune.py, which does not report"
            subfolders.clear()
        subfolders.sort()
        logged = any(file.startswith("events.out.tfevents.") for file in files)
        if RUN_FILES & {*files} or logged and not any(Path(name).is_relative_to(run.name) for run in runs):
            try:
                runs.append(read_run(Path(path), name))
            except Unusable as reason:
                skipped[name] = str(reason)
            except OSError as error:
                unreadable(error)
    return runs, skipped


def naming(sentence: str, names: Iterable[str]) -> str:
    """The sentence ended by the names, if there are any."""
    names = ", ".join(names)
    return f"{sentence}{names}." if names else ""


def quoted(run: Run) -> str:
    return f"`{run.name}`"


@cache
def defaults(algorithm: str) -> dict:
    """The defaults of a training script's flags, but for OWN_FLAGS; read, since an import would need torch."""
    classes = ast.parse((HERE.parent / f"{algorithm}_continuous.py").read_text()).body
    (body,) = (node.body for node in classes if isinstance(node, ast.ClassDef) and node.name == "Args")
    flags = {}
    for node in body:
        if isinstance(node, ast.AnnAssign) and node.target.id not in OWN_FLAGS:
            with suppress(ValueError):  # no literal
                flags[node.target.id] = json.loads(json.dumps(ast.literal_eval(node.value)))
    return flags


def asked_flags(settings: Path, algorithm: str, task: str) -> dict:
    """The flags of `defaults` that a task's settings file sets, and for the toy its generator."""
    file, flags, text = settings / algorithm / f"{task.replace('/', '_')}.args", {}, ""
    if task == TOY:
        text = "".join(re.findall(r'^extra\+?="(.*)"$', (HERE / "toy.sh").read_text(), re.MULTILINE))
    try:
        if str(settings) != "none" and file.is_file():
            text += "\n" + re.sub("#.*", "", file.read_text())
        for part in re.split(r"(?<!\S)--", text)[1:]:
            flag, *words = re.split(r"[\s=]+", part.strip())
            name, value = flag.replace("-", "_"), " ".join(words)
            default = defaults(algorithm).get(name.removeprefix("no_"), ...)
            if isinstance(default, bool):
                flags[name.removeprefix("no_")] = not name.startswith("no_")
            elif isinstance(default, list):
                flags[name] = [*map(type(default[0]), words)]
            elif default is not ...:
                kind = float if default is None else type(default)
                flags[name] = None if value == "None" else kind(value)
    except (OSError, ValueError) as error:
        refuse(f"cannot use the settings in {file}: {error}")
    return flags


def named_flags(names: Iterable[str], flags: dict, label: str, others: dict) -> str:
    return ", ".join(f"--{n.replace('_', '-')} {flags.get(n)} ({label}: {others.get(n)})" for n in sorted(names))


def unasked(run: Run, settings: Path) -> str:
    """The flags of a run that the settings ask to be others; one that its config.json lacks is as asked."""
    algorithm = "ppo" if run.setting.depth is None else "refineppo"
    asked = defaults(algorithm) | asked_flags(settings, algorithm, run.setting.task)
    names = {name for name in asked.keys() & run.args.keys() - SWEPT_FLAGS if run.args[name] != asked[name]}
    return named_flags(names, run.args, "asked for", asked)


def difference(run: Run, other: Run) -> str:
    """The flags in which a run differs from the variant that is reported."""
    if run.is_search and not other.is_search:
        return f"seeds from {FIRST_SEARCH_SEED} on, of a search"
    names = {name for name, _ in set(run.variant[1:]) ^ set(other.variant[1:])}
    return named_flags(names, run.args, "reported", other.args)


def choose(runs: list[Run], settings: Path) -> tuple[dict[Setting, list[Run]], list[str]]:
    """One variant of each setting, each of its seeds once, by seed; and what that leaves out."""
    chosen, left_out = {}, []

    def rank(variant: list[Run]) -> tuple:
        first, finished = variant[0], {run.args["seed"] for run in variant if run.scores}
        order = not first.is_search, not unasked(first, settings), len(finished)
        return *order, first.args["total_timesteps"], len(variant)

    for setting, group in grouped(runs, lambda run: run.setting).items():
        variants = [*grouped(group, lambda run: run.variant).values()]
        best = max(variants, key=rank)
        for variant in variants:
            if variant is not best:
                why = difference(variant[0], best[0])
                left_out.append(naming(f"{setting.task}, {setting.method}, {why}: ", map(quoted, variant)))
        chosen[setting] = []
        for seed, (first, *again) in sorted(grouped(best, lambda run: run.args["seed"]).items()):
            if again:  # a finished run goes before an unfinished one, else the first by path
                first, *again = sorted((first, *again), key=lambda run: run.scores is None)
                left_out.append(naming(f"seed {seed} again, beside {quoted(first)}: ", map(quoted, again)))
            chosen[setting].append(first)
    return chosen, left_out


def read_csv(name: str) -> list[dict]:
    with open(HERE / name, newline="") as file:
        return [*csv.DictReader(file)]


class Sweep:
    """The chosen runs, and what they are held against."""

    def __init__(self, runs: dict[Setting, list[Run]], args: Args):
        self.runs, self.args = runs, args
        paper = read_csv("paper_results.csv")
        self.dims = {row["task"]: int(row["action_dim"]) for row in paper}
        self.table1 = {(row["task"], row["method"]): row for row in paper if row["table"] == "1"}
        self.table2 = {(row["task"], row["schedule"]): row["mean"] for row in paper if row["table"] == "2"}
        bounds = ((row["task"], row["random_return"], row["reference_return"]) for row in read_csv("bounds.csv"))
        self.bounds = {task: (float(random), float(reference)) for task, random, reference in bounds}
        self.paper_tasks = [*dict.fromkeys(task for task, _ in self.table1)]
        others = {setting.task for setting in runs} - {*self.paper_tasks, TOY}
        self.tasks = [*self.paper_tasks, *sorted(others)]
        self.pairs = {task: (Setting(task), self.refineppo(task)) for task in self.tasks}
        self.reported = {setting for pair in self.pairs.values() for setting in pair}  # in any table or in Fig. 2

    def refineppo(self, task: str) -> Setting:
        """The setting that stands for RefinePPO."""
        flags = {"refinement_depth": self.args.depth, "refinement_schedule": self.args.schedule}
        flags |= asked_flags(self.args.settings, "refineppo", task)
        return Setting(task, flags["refinement_depth"], flags["refinement_schedule"])

    def standing(self, tasks: Iterable[str], part: str) -> str:
        """The depth or the schedule that stands for RefinePPO, with the tasks of each if they differ."""
        groups = grouped(tasks, lambda task: getattr(self.pairs[task][1], part))
        return ", ".join(f"{value}" + f" ({', '.join(of)})" * (len(groups) > 1) for value, of in groups.items())

    def finished(self, setting: Setting) -> list[Run]:
        return [run for run in self.runs.get(setting, []) if run.scores]

    def curves(self, setting: Setting) -> list[np.ndarray]:
        return [run.curve for run in self.finished(setting) if len(run.curve)]

    def scores(self, setting: Setting, selection: str = "best") -> np.ndarray:
        """Mean return of each finished seed, (seeds,)."""
        scores = np.array([run.scores[selection] for run in self.finished(setting)], float)
        return scores[np.isfinite(scores)]

    def seeds_and_steps(self, *settings: Setting) -> dict[str, int | str]:
        """How many finished seeds the settings have, and of how many steps; a table's row of them ends so."""
        self.reported |= {*settings}
        runs = [*map(self.finished, settings)]
        steps = [seeds[0].args["total_timesteps"] for seeds in runs if seeds]
        return {"seeds": together([*map(len, runs)]), "steps": together(steps)}

    def normalise(self, task: str, returns: np.ndarray) -> np.ndarray:
        """0 is the random policy, 1 the reference of bounds.csv."""
        random, reference = self.bounds[task]
        return (returns - random) / (reference - random)


def together(numbers: list[int]) -> int | str:
    """The one number, or all if they differ."""
    return numbers[0] if len({*numbers}) == 1 else " / ".join(map(shown, numbers))


# --- Statistics -------------------------------------------------------------------------------------------------------


def mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def std(values: np.ndarray) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def improvement(refineppo: float, ppo: float) -> float:
    """(R - P) / |P| in percent, as in the paper."""
    return 100 * (refineppo - ppo) / abs(ppo) if ppo else math.nan


def min_max(values: np.ndarray) -> np.ndarray:
    """Scaled so that the lowest is 0 and the highest 1; all 0 if they are equal."""
    return (values - values.min()) / (np.ptp(values) or 1)


def area_under_curve(curve: np.ndarray, low: float, high: float) -> float:
    """Area under the line through the evaluations from step low to high, over its width: the mean return there."""
    steps = np.unique([low, *curve[:, 0].clip(low, high), high])
    returns = np.interp(steps, *curve.T)
    return float(np.trapezoid(returns, steps) / (high - low) if high > low else returns[0])


def first_step_at(curve: np.ndarray, level: float) -> float:
    """The first evaluated step whose mean return is at least the level; infinite if there is none."""
    return next((float(step) for step, value in curve if value >= level), math.inf)


def mean_curve(curves: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps, and there mean and std (0 for one seed) of the seeds that have got so far."""
    returns = grouped(np.concatenate(curves).tolist(), lambda point: point[0])
    steps = sorted(returns)
    values = [np.array(returns[step])[:, 1] for step in steps]
    return np.array(steps), np.array([*map(mean, values)]), np.nan_to_num([*map(std, values)])


def iqm(scores: np.ndarray) -> np.ndarray:
    """Interquartile mean over the last axis: without the lowest and the highest quarter, rounded down."""
    return trim_mean(scores, 0.25, axis=-1)


def improvement_probability(refineppo: np.ndarray, ppo: np.ndarray) -> np.ndarray:
    """Share of the pairs (..., n) x (..., m) that RefinePPO wins, a tie counting half."""
    x, y = refineppo[..., :, None], ppo[..., None, :]
    return ((x > y) + 0.5 * (x == y)).mean((-2, -1))


def resample(strata: list[np.ndarray], seed: int) -> list[np.ndarray]:
    """Seeds drawn with replacement within each stratum (task), (RESAMPLES, seeds) each."""
    rng = np.random.default_rng(seed)
    return [scores[rng.integers(len(scores), size=(RESAMPLES, len(scores)))] for scores in strata]


class Estimate(NamedTuple):
    """A value and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        value, low, high = (shown(x, self.value) for x in self)
        return f"{value} [{low}, {high}]"


def estimate(value: float, resampled: np.ndarray) -> Estimate:
    """The value with the percentile bootstrap's 95 % interval."""
    return Estimate(float(value), *map(float, np.quantile(resampled, (0.025, 0.975))))


def estimate_iqm(strata: list[np.ndarray]) -> Estimate:
    """IQM of all scores together, with the interval of a bootstrap stratified by task."""
    return estimate(iqm(np.concatenate(strata)), iqm(np.concatenate(resample(strata, 0), axis=-1)))


def estimate_probability(refineppo: list[np.ndarray], ppo: list[np.ndarray]) -> Estimate:
    """Probability of improvement, mean over the tasks, with its stratified bootstrap interval."""
    value = np.mean([*map(improvement_probability, refineppo, ppo)])
    resampled = map(improvement_probability, resample(refineppo, 1), resample(ppo, 2))
    return estimate(value, np.mean([*resampled], axis=0))


# --- Writing ----------------------------------------------------------------------------------------------------------


def shown(value, scale: float | None = None) -> str:
    """Text of a cell; a number has as many decimals as three digits of `scale`, by default itself, ask for."""
    if value is None or value != value:
        return "-"
    if type(value) is not float:
        return f"{value:,}" if type(value) is int else str(value)
    size = abs(value if scale is None else scale)
    return f"{value:.{0 if size >= 100 else 1 if size >= 10 else 2}f}"


def shown_step(step: float) -> str:
    return "never" if step == math.inf else f"{step:,.0f}"


class Spread(NamedTuple):
    """Mean and standard deviation (ddof 1), as text where the paper gives them."""

    mean: float | str
    std: float | str

    @classmethod
    def of(cls, values: np.ndarray) -> "Spread":
        return cls(mean(values), std(values))

    def __str__(self) -> str:
        spread = shown(self.std, self.mean)
        return shown(self.mean) + (f" ± {spread}" if spread != "-" else "")


class Steps(NamedTuple):
    """When the seeds got somewhere; infinite: never, which is later than any step."""

    median: float
    first: float
    last: float

    @classmethod
    def of(cls, steps: list[float]) -> "Steps":
        return cls(float(np.median(steps)), min(steps), max(steps))

    def __str__(self) -> str:
        median, first, last = map(shown_step, self)
        return median if first == last else f"{median} ({first} to {last})"


class Percent(float):
    def __str__(self) -> str:
        return f"{self:+.1f}"


def csv_cells(header: str, cell) -> dict:
    """A cell's numbers for the CSV, with a column for each of several."""
    name = re.sub(r"\W+", "_", header.replace("%", "percent")).strip("_").lower()
    fields = {f"{name}_{key}": x for key, x in cell._asdict().items()} if isinstance(cell, tuple) else {name: cell}
    return {key: "" if x != x else "never" if x == math.inf else repr(float(x)) if isinstance(x, float) else x
            for key, x in fields.items()}  # fmt: skip


def latex(text: str) -> str:
    for character in "&%$#_{}":
        text = text.replace(character, f"\\{character}")
    return re.sub(r"(?<!\w)-(?=\d)", "$-$", text.replace("±", r"$\pm$"))


class Report:
    """The text of report.md as it grows, and the files beside it."""

    def __init__(self, title: str):
        self.text, self.files, self.missing = [f"{MARK}\n# {title}"], {}, []

    def say(self, *paragraphs: str):
        self.text += paragraphs

    def table(self, name: str, rows: list[dict]):
        """Rows of header -> cell as Markdown, LaTeX and CSV."""
        lines = [[*rows[0]], *([*map(shown, row.values())] for row in rows)]
        head, *body = ("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
        self.say("\n".join([head, "| - |" + " -: |" * (len(rows[0]) - 1), *body]),
                 f"[{name}.csv]({name}.csv), [{name}.tex]({name}.tex)")  # fmt: skip
        head, *body = (" & ".join(map(latex, line)) + r" \\" for line in lines)
        begin = f"% needs \\usepackage{{booktabs}}\n\\begin{{tabular}}{{l{'r' * (len(rows[0]) - 1)}}}"
        tex = [begin, r"\toprule", head, r"\midrule", *body, r"\bottomrule", r"\end{tabular}", ""]
        text = io.StringIO()
        cells = [{name: x for item in row.items() for name, x in csv_cells(*item).items()} for row in rows]
        writer = csv.DictWriter(text, cells[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(cells)
        self.files |= {f"{name}.tex": "\n".join(tex).encode(), f"{name}.csv": text.getvalue().encode()}

    def figure(self, name: str, figure: Figure, caption: str):
        for kind, options in (("png", {}), ("pdf", {"metadata": {"CreationDate": None}})):
            file = io.BytesIO()
            figure.savefig(file, format=kind, **options)
            self.files[f"{name}.{kind}"] = file.getvalue()
        self.say(f"![{name}]({name}.png)", f"{caption} [{name}.pdf]({name}.pdf)")

    def expect(self, item: str, sweep: Sweep, settings: list[Setting]):
        """Note which of the settings lack seeds."""
        seeds = {setting.task: len(sweep.finished(setting)) for setting in settings}
        none = [task for task, count in seeds.items() if not count]
        lacks = [f"{task}: {count} of {SEEDS} seeds" for task, count in seeds.items() if 0 < count < SEEDS]
        if none:
            lacks.append("no finished run" + f" of {', '.join(none)}" * (len(none) < len(seeds)))
        if lacks:
            self.missing.append(f"{item}: {'; '.join(lacks)}")


# --- Sections ---------------------------------------------------------------------------------------------------------

STYLE = {"font.size": 7, "axes.titlesize": 7.5, "axes.formatter.useoffset": False}
LOOKS = {"PPO": {"color": "#d9720a", "linestyle": "--"}, "RefinePPO": {"color": "#1f2f6f", "linestyle": "-"}}
NO_PAIR = "No task with finished runs of PPO and of RefinePPO."


def new_figure(rows: int, columns: int, width: float, height: float, **options) -> tuple[Figure, list]:
    """A figure of width x height inches, and its axes."""
    figure = Figure((width, height), layout="constrained", dpi=200)
    return figure, figure.subplots(rows, columns, squeeze=False, **options).ravel().tolist()


def table_1(sweep: Sweep, report: Report) -> list[dict]:
    """PPO against RefinePPO; returns the rows."""
    report.say("## Table 1: PPO and RefinePPO")
    for i, method in enumerate(LOOKS):
        report.expect(f"Table 1, {method}", sweep, [sweep.pairs[task][i] for task in sweep.paper_tasks])
    pairs, rows = {task: pair for task, pair in sweep.pairs.items() if any(map(sweep.finished, pair))}, []
    tuned = {refineppo[1:] for _, refineppo in pairs.values()} - {(sweep.args.depth, sweep.args.schedule)}
    for task, pair in pairs.items():
        ppo, refineppo = (Spread.of(sweep.scores(setting)) for setting in pair)
        paper = [sweep.table1.get((task, method), {}) for method in LOOKS]
        row = {"task": task, "dim.": sweep.dims.get(task)} | ({"RefinePPO is": pair[1].method} if tuned else {})
        row |= {"PPO": ppo, "RefinePPO": refineppo, "improv. %": Percent(improvement(refineppo.mean, ppo.mean))}
        row |= {f"paper: {name}": Spread(of.get("mean"), of.get("std")) for name, of in zip(LOOKS, paper)}
        row["paper: improv. %"] = Percent(paper[1].get("improvement_percent", "nan"))
        rows.append(row | sweep.seeds_and_steps(*pair))
    if rows:
        report.say("Return of the best checkpoint's final evaluation, mean ± standard deviation (ddof 1) over seeds; "
                   "improvement (R - P) / |P|; seeds and steps as PPO / RefinePPO where they differ. The paper: 5 "
                   "seeds, 6,000,000 steps.")  # fmt: skip
        report.table("table1", rows)
    else:
        report.say("No finished run of PPO or RefinePPO.")
    return rows


def training_curves(sweep: Sweep, report: Report):
    report.say("## Fig. 2: evaluation return through training")
    curves = {task: [[run.curve for run in sweep.runs.get(setting, []) if len(run.curve)] for setting in pair]
              for task, pair in sweep.pairs.items()}  # fmt: skip
    curves = {task: pair for task, pair in curves.items() if any(pair)}
    tasks = [task for task in CURVE_TASKS if task in curves] or [*curves][:6]
    if not tasks:
        return report.say("No evaluation of PPO or RefinePPO.")
    columns, lines = min(3, len(tasks)), -(-len(tasks) // 3)
    figure, axes = new_figure(lines, columns, max(2.3 * columns, 3.2), 1.7 * lines + 0.4)
    for axis in axes[len(tasks) :]:
        axis.remove()
    for axis, task in zip(axes, tasks):
        for (method, look), seeds in zip(LOOKS.items(), curves[task]):
            for curve in seeds:
                axis.plot(*curve.T, color=look["color"], linewidth=0.4, alpha=0.4)
            steps, centre, spread = mean_curve(seeds) if seeds else [np.zeros(0)] * 3
            axis.fill_between(steps, centre - spread, centre + spread, color=look["color"], alpha=0.18, linewidth=0)
            axis.plot(steps, centre, **look, linewidth=1.4, zorder=3, label=method)
        axis.set(title=task, xlim=(0, None))
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.yaxis.set_major_formatter(EngFormatter(sep=""))
        axis.grid(color="0.9", linewidth=0.5)
    figure.supxlabel("environment steps", size=7)
    figure.supylabel("evaluation return", size=7)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    caption = "Mean (thick) and ± 1 standard deviation (shaded), at each step of the seeds that have got so far; thin: "
    caption += "every seed, unfinished ones too."
    caption += naming(" Of the paper's six tasks there is no run of ", (t for t in CURVE_TASKS if t not in curves))
    report.figure("training_curves", figure, caption)


def sample_efficiency(sweep: Sweep, report: Report):
    report.say("## Sample efficiency")
    rows = []
    for task, pair in sweep.pairs.items():
        curves = [*map(sweep.curves, pair)]
        starts, ends = ([curve[i, 0] for seeds in curves for curve in seeds] for i in (0, -1))
        if not all(curves) or max(starts) > min(ends):
            continue
        low, high = max(starts), min(ends)
        ppo, refineppo = (Spread.of([area_under_curve(curve, low, high) for curve in seeds]) for seeds in curves)
        level = mean([curve[-1, 1] for curve in curves[0]])
        row = {"task": task, "PPO: mean return": ppo, "RefinePPO: mean return": refineppo,
               "improv. %": Percent(improvement(refineppo.mean, ppo.mean)), "PPO's final level": level}  # fmt: skip
        for method, seeds in zip(LOOKS, curves):
            row |= when(f"{method}: seeds there", f"{method}: median step (range)", seeds, level)
        rows.append(row)
    if not rows:
        return report.say(NO_PAIR)
    report.say(
        "Left: area under the evaluation curve, given as the mean return over steps from the first evaluation to the "
        "last step that all seeds of both methods have; mean ± standard deviation over seeds. Right: PPO's final level "
        "is the mean over its seeds of the last evaluation; a seed gets there at its first evaluation at or above it. "
        "The median is over all seeds, `never` counting as later than any step. An evaluation is of few episodes and "
        "may be lucky, for PPO's seeds too."
    )
    report.table("sample_efficiency", rows)


def when(count_header: str, steps_header: str, curves: list[np.ndarray], level: float) -> dict:
    """Two cells: how many of the curves reach the level, and when."""
    steps = [first_step_at(curve, level) for curve in curves]
    return {count_header: f"{sum(map(math.isfinite, steps))} of {len(steps)}", steps_header: Steps.of(steps)}


def across_settings(sweep: Sweep, report: Report, name: str, settings: dict[str, dict[str, Setting]], paper: dict):
    """A table of the best checkpoint's returns: task by the settings of `settings[task]`, beside the paper's."""
    rows = []
    for task, of_task in settings.items():
        row = {"task": task} | {label: Spread.of(sweep.scores(setting)) for label, setting in of_task.items()}
        row |= {f"paper: {label}": paper.get((task, label)) for label in of_task if paper}
        rows.append(row | sweep.seeds_and_steps(*of_task.values()))
    report.table(name, rows)


def table_2(sweep: Sweep, report: Report):
    report.say("## Table 2: refinement schedules")
    settings = {task: {schedule: refineppo._replace(schedule=schedule) for schedule in SCHEDULES}
                for task, (_, refineppo) in sweep.pairs.items()}  # fmt: skip
    tasks = dict.fromkeys(task for task, _ in sweep.table2)
    for schedule in SCHEDULES:
        report.expect(f"Table 2, {schedule}", sweep, [settings[task][schedule] for task in tasks])
    several = {task: of_task for task, of_task in settings.items()
               if sum(len(sweep.finished(setting)) > 0 for setting in of_task.values()) > 1}  # fmt: skip
    if not several:
        return report.say("No task with finished runs of at least two schedules.")
    report.say("Return of the best checkpoint's final evaluation, mean ± standard deviation over seeds; tasks with at "
               f"least two schedules. K = {sweep.standing(several, 'depth')}; the paper's is 4, and it gives means "
               "alone.")  # fmt: skip
    across_settings(sweep, report, "table2", several, sweep.table2)


def depth_figure(sweep: Sweep, report: Report):
    report.say("## Fig. 4: refinement depth")
    refineppo = {task: pair[1] for task, pair in sweep.pairs.items()}
    for depth in DEPTHS:
        settings = [refineppo[task]._replace(depth=depth) for task in sweep.paper_tasks]
        report.expect(f"Fig. 4, K = {depth}", sweep, settings)
    have = {task: {s.depth for s in sweep.runs if s == of._replace(depth=s.depth) and sweep.finished(s)}
            for task, of in refineppo.items()}  # fmt: skip
    depths = sorted(set().union(*(of_task for of_task in have.values() if len(of_task) > 1)))
    tasks = [task for task in sweep.tasks if depths and {*depths} <= have[task]]
    if not tasks:
        return report.say("No task with finished runs of " + (f"all depths, {depths}." if depths else "two depths."))
    settings = {task: {f"K = {depth}": refineppo[task]._replace(depth=depth) for depth in depths} for task in tasks}
    returns = {task: np.array([mean(sweep.scores(setting)) for setting in settings[task].values()]) for task in tasks}
    panels = {"min-max": [min_max(values) for values in returns.values()]}
    if bounded := [sweep.normalise(task, returns[task]) for task in tasks if task in sweep.bounds]:
        panels["fixed bounds"] = bounded
    rows = [{"K": depth} for depth in depths]
    figure, axes = new_figure(1, len(panels), 2.6 * len(panels), 2.1)
    for axis, (name, values) in zip(axes, panels.items()):
        for i, row in enumerate(rows):
            row |= {name: Spread.of([of_task[i] for of_task in values]), f"{name}: tasks": len(values)}
        centre, spread = np.array([row[name] for row in rows]).T
        axis.errorbar(range(len(depths)), centre, np.nan_to_num(spread), color="black", marker="o", markersize=4,
                      linewidth=1, capsize=3)  # fmt: skip
        axis.set_xticks(range(len(depths)), depths)
        axis.set(title=name, xlabel="refinement depth $K$", ylabel="normalised return", xlim=(-0.4, len(depths) - 0.6))
        axis.grid(axis="y", color="0.9", linewidth=0.5)
    caption = f"Schedule: {sweep.standing(tasks, 'schedule')}. "
    caption += "Normalised mean returns: mean ± 1 standard deviation (ddof 1) over tasks. Left, as in the paper: "
    caption += "0 is the worst K of a task and 1 the best, however little they differ. Right: 0 is the random policy "
    caption += "and 1 the task's reference in `sweeps/bounds.csv`."
    caption += naming(" That has no bounds for ", (task for task in tasks if task not in sweep.bounds))
    partly = (task for task in sweep.tasks if have[task] and task not in tasks)
    caption += naming(" Left out, without finished runs of all these K: ", partly)
    report.figure("depth", figure, caption)
    report.table("depth_normalised", rows)
    report.say("The returns behind it, mean ± standard deviation over seeds:")
    across_settings(sweep, report, "depth", settings, {})


def action_dimension(sweep: Sweep, report: Report, table1: list[dict]):
    report.say("## Improvement against action dimension")
    rows = [row for row in table1 if row["dim."] and math.isfinite(row["improv. %"])]
    rows.sort(key=lambda row: row["dim."])
    if not rows:
        return report.say(NO_PAIR)
    facts, y = [], range(len(rows))
    figure, (axis,) = new_figure(1, 1, 5.0, 0.19 * len(rows) + 1.0)
    axis.axvline(0, color="0.6", linewidth=0.7)
    for label, key, fill, size in (("here", "improv. %", "full", 3.5), ("the paper", "paper: improv. %", "none", 7)):
        x, dims = [float(row[key]) for row in rows], [row["dim."] for row in rows]
        axis.plot(x, y, "ko", label=label, markersize=size, fillstyle=fill)
        varied = len(x) > 2 and len({*x}) > 1 and len({*dims}) > 1
        facts.append(f"{label} {spearmanr(dims, x).statistic:+.2f} (n = {len(x)})" if varied else f"{label} undefined")
    axis.set_xscale("symlog", linthresh=10)
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:+.0f} %" if value else "0 %")
    axis.set_yticks(y, [f"{row['task']} ({row['dim.']})" for row in rows])
    axis.set(ylim=(len(rows) - 0.5, -0.5), xlabel="improvement of RefinePPO on PPO")
    axis.grid(color="0.9", linewidth=0.5)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    report.figure("action_dimension", figure, "Improvement of Table 1, tasks by action dimension (in brackets); the "
                  "axis is linear from -10 % to 10 % and logarithmic outside. Spearman's rank correlation with the "
                  f"action dimension: {', '.join(facts)}.")  # fmt: skip


def few_seeds(sweep: Sweep, report: Report):
    """What five seeds can carry: intervals and probabilities instead of a test per task."""
    report.say("## What five seeds can carry")
    pairs = {task: pair for task, pair in sweep.pairs.items() if all(map(sweep.finished, pair))}
    if not pairs:
        return report.say(NO_PAIR)
    report.say(
        "No single task is tested. With 5 against 5 seeds the smallest two-sided p of a rank test is 2/252 = 0.0079, "
        "above 0.05/14 = 0.0036 where Holm's correction over 14 tasks begins: no single task can be significant, "
        "whatever the returns. Below are interquartile means (IQM: without the lowest and the highest quarter, of 5 "
        "seeds the mean of the middle three), the probability of improvement (share of the pairs of a seed of each "
        "method that RefinePPO wins, a tie counting half), and 95 % intervals of the percentile bootstrap over seeds "
        f"({RESAMPLES:,} resamples, stratified by task). Of so few seeds these intervals are rather too narrow."
    )
    rows = []
    for task, pair in pairs.items():
        ppo, refineppo = ([sweep.scores(setting)] for setting in pair)
        row = {"task": task, "PPO: IQM": estimate_iqm(ppo), "RefinePPO: IQM": estimate_iqm(refineppo)}
        row["P(improvement)"] = estimate_probability(refineppo, ppo)
        rows.append(row | sweep.seeds_and_steps(*pair))
    report.table("seeds", rows)

    bounded, totals = {task: pair for task, pair in pairs.items() if task in sweep.bounds}, []
    for selection, label in SELECTIONS.items():
        scores = [[sweep.normalise(task, sweep.scores(s, selection)) for s in pair] for task, pair in bounded.items()]
        scores = [pair for pair in scores if all(map(len, pair))]  # no episode may have ended in the last 10 %
        if scores:
            ppo, refineppo = map(list, zip(*scores))
            row = {"return of": label, "PPO: IQM": estimate_iqm(ppo), "RefinePPO: IQM": estimate_iqm(refineppo)}
            totals.append(row | {"P(improvement)": estimate_probability(refineppo, ppo), "tasks": len(scores)})
    if totals:
        left_out = naming(" Left out, without bounds: ", (task for task in pairs if task not in bounded))
        report.say("All tasks together, returns normalised to 0 for the random policy and 1 for the task's reference "
                   f"in `sweeps/bounds.csv`; the probability is the mean over tasks.{left_out}")  # fmt: skip
        report.table("aggregate", totals)
        seeds_figure(sweep, report, bounded, [row for row in rows if row["task"] in bounded] + totals[:1])

    report.say("The best checkpoint is the best early-stopped policy: it hides collapse and gains from frequent "
               "evaluation. Beside it the last checkpoint, and the training episodes (with exploration noise) of the "
               "last 10 % of steps; mean ± standard deviation over seeds:")  # fmt: skip
    rows = [{"task": task} for task in pairs]
    for row, pair in zip(rows, pairs.values()):
        for selection in SELECTIONS:
            for method, setting in zip(LOOKS, pair):
                row[f"{method}: {selection.replace('10', ' 10 %')}"] = Spread.of(sweep.scores(setting, selection))
    report.table("selection", rows)


def seeds_figure(sweep: Sweep, report: Report, pairs: dict[str, tuple[Setting, Setting]], rows: list[dict]):
    """Every seed's normalised return, and the probability of improvement; the last row is the mean over tasks."""
    figure, (left, right) = new_figure(1, 2, 7.2, 0.24 * len(rows) + 1, sharey=True, width_ratios=(3, 2))
    for y, (task, pair) in enumerate(pairs.items()):
        for setting, (method, look), shift, fill in zip(pair, LOOKS.items(), (-0.17, 0.17), ("none", "full")):
            scores = sweep.normalise(task, sweep.scores(setting))
            left.plot(scores, np.full(len(scores), y + shift), "o", color=look["color"], fillstyle=fill, markersize=3,
                      markeredgewidth=0.8, label=method if y == 0 else None)  # fmt: skip
            left.plot([iqm(scores)] * 2, [y + shift - 0.15, y + shift + 0.15], color="black", linewidth=1.2)
    for y, row in enumerate(rows):
        p, low, high = row["P(improvement)"]
        style, color = ("o", LOOKS["RefinePPO"]["color"]) if "task" in row else ("D", "black")
        right.errorbar(p, y, xerr=[[p - low], [high - p]], fmt=style, color=color, markersize=3.5, capsize=2, lw=1)
    for axis, neutral in ((left, (0, 1)), (right, (0.5,))):
        for x in neutral:
            axis.axvline(x, color="0.6", linestyle=":", linewidth=0.8)
    left.set_yticks(range(len(rows)), [*pairs, "mean over tasks"])
    left.set(ylim=(len(rows) - 0.5, -0.5), xlabel="normalised return of the best checkpoint (0 random, 1 reference)")
    right.set(xlabel="P(improvement)", xlim=(-0.03, 1.03))
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    report.figure("seeds", figure, "Left: every seed, and the IQM (tick). Right: probability of improvement and its "
                  "95 % interval, which has no width where one method wins all pairs of seeds.")  # fmt: skip


def toy(sweep: Sweep, report: Report):
    report.say("## Toy: steps until the two-dimensional coordination task is solved")
    settings = [setting for setting in sweep.runs if setting.task == TOY and sweep.curves(setting)]
    if not settings:
        return report.say(f"No finished run of `{TOY}`.")
    report.say(f"Solved: the first evaluation with a mean return of at least {SOLVED}. The median is over all seeds, "
               "`never` counting as later than any step.")  # fmt: skip
    rows = []
    for setting in sorted(settings, key=lambda setting: (setting.depth or 0, setting.schedule)):
        row = {"method": setting.method} | when("solved", "median step (range)", sweep.curves(setting), SOLVED)
        rows.append(row | sweep.seeds_and_steps(setting))
    report.table("toy", rows)


# --- Main -------------------------------------------------------------------------------------------------------------


def check_folder(folder: Path):
    """Refuse an output folder that cannot be written, or that holds anything that a report did not make."""
    try:
        present = {path.name for path in folder.iterdir() if path.name[0] != "."} if folder.exists() else set()
        ours = "report.md" in present and (folder / "report.md").read_bytes().startswith(MARK.encode())
        if present and not (ours and present <= OUTPUTS):
            refuse(f"{folder} holds files that no report has made; name another --out-dir")
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        refuse(f"cannot write to the output folder {folder}: {error.strerror}")


def main():
    args = tyro.cli(Args, description=__doc__)
    folder = args.out_dir or args.runs_dir / "report"
    if args.depth < 1:
        refuse(f"--depth must be at least 1, not {args.depth}")
    if str(args.settings) != "none" and not args.settings.is_dir():
        refuse(f"--settings must be a folder, and {args.settings} is not one")
    if not args.runs_dir.is_dir():
        refuse(f"{args.runs_dir} is not a folder of runs" if args.runs_dir.exists() else f"there is no {args.runs_dir}")
    runs, skipped = find_runs(args.runs_dir)
    if not runs:
        reasons = "".join(f"; {name}: {reason}" for name, reason in skipped.items())
        refuse(f"there is no run to report in {args.runs_dir}{reasons}")
    chosen, left_out = choose(runs, args.settings)
    sweep, report = Sweep(chosen, args), Report(f"Report of {args.runs_dir}")
    check_folder(folder)
    unfinished = [run for run in runs if not run.scores]
    counts = f"{len(runs) - len(unfinished)} finished, {len(unfinished)} unfinished, {len(skipped)} skipped"
    report.say(f"RefinePPO is K = {args.depth} with the {args.schedule} schedule, unless Table 1 says otherwise. "
               f"Run folders: {counts}; see [what is missing or left out](#what-is-missing-or-left-out).")  # fmt: skip
    with rc_context(STYLE):
        rows = table_1(sweep, report)
        training_curves(sweep, report)
        sample_efficiency(sweep, report)
        table_2(sweep, report)
        depth_figure(sweep, report)
        action_dimension(sweep, report, rows)
        few_seeds(sweep, report)
        toy(sweep, report)
    warnings, unshown = [], []
    for setting, (run, *_) in chosen.items():
        name = f"{setting.task}, {setting.method}"
        if setting not in sweep.reported:
            unshown.append(naming(f"{name}: ", map(quoted, sweep.finished(setting))))
            continue
        if flags := unasked(run, args.settings):
            warnings.append(f"**Other flags than the settings ask for:** {name}: {flags}")
        if run.is_search:
            warnings.append(f"**Seeds from {FIRST_SEARCH_SEED} on, of a search:** {name}")
    report.text[1:1] = warnings
    report.say("## What is missing or left out")
    for title, lines in {
        f"Fewer finished seeds than the paper's {SEEDS}": report.missing,
        "Unfinished runs (in Fig. 2 alone)": [f"{quoted(run)}: {run.progress}" for run in unfinished],
        "Finished runs without evaluations (in tables of final returns alone)": [
            quoted(run) for run in runs if run.scores and not len(run.curve)
        ],
        "Finished runs in no table": [*filter(None, unshown)],
        "Torn, foreign or unreadable folders, and searches (skipped)": [
            f"`{name}`: {why}" for name, why in skipped.items()
        ],
        "Duplicates and other variants (left out)": left_out,
    }.items():
        report.say(f"{title}: none." if not lines else f"{title}:\n\n" + "\n".join(f"- {line}" for line in lines))
    files = {"report.md": "\n\n".join([*report.text, ""]).encode(), **report.files}
    try:  # report.md first, since it marks the folder as a report's
        for name in OUTPUTS - files.keys():
            (folder / name).unlink(missing_ok=True)  # of an earlier report
        for name, data in files.items():
            (folder / name).write_bytes(data)
    except OSError as error:
        refuse(f"cannot write to the output folder {folder}: {error.strerror}")
    print(f"run folders: {counts}\nthe report is in {folder / 'report.md'}")


if __name__ == "__main__":
    main()
