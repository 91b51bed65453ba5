"""Two tidy tables of all runs, and from them the paper's tables and figures beside the paper's own numbers.

    python sweeps/report.py runs
    python sweeps/report.py runs sweeps/results/benchmark --out-dir sweeps/results/benchmark

SOURCES are run folders, folders that hold run folders at any depth, and tables of an earlier report (a runs.csv with an
evaluations.csv beside it, or their folder), in any mixture; a run that two of them hold counts once. Written are

    runs.csv          one row a run that finished or failed (`failure` says why): task, method, depth, schedule, actor,
                      other flags that are not the defaults, seed, steps; the rest is named as in the run's result.json
    evaluations.csv   one row an evaluation of a run
    report.md         made from these two alone, with a folder of tables (CSV, LaTeX) and figures (PNG, PDF) for each
                      number of steps (1M/, 6M/), since runs of another length are another experiment

The rule for settings: of each task and method, the flags and layers that most of its runs have are its settings (if
several are as many: the fewest flags); any other run is a variant, whose name says what differs (PPO 256x256).

Table 1 and Fig. 2 hold PPO against RefinePPO of --depth and --schedule (where a task has no such run, the K and the
schedule that most of its runs have). Then come sample efficiency, schedules (Table 2), depths (Fig. 4), what few seeds
can carry, controls (K = 1 first), learning rates, other variants, the toy and hours, worded by report_template.md.
"""

import io
import math
import re
import shlex
import tempfile
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import jinja2
import numpy as np
import pandas as pd
import tyro
from common import palette_png, refuse, steps_text
from flags import words
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FixedLocator
from run_tables import Cell, Run, actor_cost, as_tables, merge, rate_ratio, read_source, sort_into_cells, typed
from scipy.stats import spearmanr, trim_mean

HERE = Path(__file__).resolve().parent
SEEDS, DEPTHS, SCHEDULES = 5, (1, 2, 4, 8), ("average", "uniform", "inverse")  # the paper's
CURVE_TASKS = ("HalfCheetah-v5", "Pusher-v5", "Hopper-v5", "HumanoidStandup-v5", "Humanoid-v5", "Swimmer-v5")  # Fig. 2
TOY, SOLVED = "sweeps.toy_env:Coordination-v0", -0.01  # its task, and the evaluation return from which it is solved
RESAMPLES = 10_000  # of each bootstrap
SELECTIONS = {"best_mean": "best", "last_mean": "last", "train_return_last10pct": "last 10 %"}  # column: header
CLEANRL = {  # its published training returns of the last 10 % of 1M steps, on version v4 of the tasks
    "HalfCheetah-v5": "1443 ± 46",
    "Hopper-v5": "2383 ± 272",
    "Walker2d-v5": "2288 ± 572",
    "Pusher-v5": "-40 ± 7",
    "Humanoid-v5": "716 ± 49",
}

MARK = "<!-- made by sweeps/report.py -->"
STYLE = {"font.size": 7, "axes.titlesize": 7.5, "axes.formatter.useoffset": False, "savefig.facecolor": "white"}
STYLE |= {"pdf.fonttype": 42}  # TrueType, since IEEE refuses Type 3
LOOKS = {"PPO": {"color": "#d9720a", "linestyle": "--"}, "RefinePPO": {"color": "#1f2f6f"}}


@dataclass
class Args:
    sources: tyro.conf.Positional[tuple[Path, ...]]
    """run folders, folders that hold run folders, and tables of an earlier report"""
    out_dir: Path | None = None
    """folder of the report; default the first source if it is a folder of tables, else its subfolder report"""
    depth: int = 4
    """refinement depth K that stands for RefinePPO"""
    schedule: Literal["average", "uniform", "inverse"] = "average"
    """refinement schedule that stands for RefinePPO"""
    curve_tasks: tuple[str, ...] = CURVE_TASKS
    """tasks in the figure training_curves, where one has no run another; training_curves_all has all"""


# --- Runs -------------------------------------------------------------------------------------------------------------


class Experiment:
    """The runs of one number of steps: finished ones by cell, each seed once, and what they are held against."""

    def __init__(self, runs: pd.DataFrame, evaluations: pd.DataFrame, args: Args):
        self.args, self.steps = args, int(runs.steps.iloc[0])
        self.cells, self.base, self.again = sort_into_cells(runs)
        points = evaluations[evaluations.run.isin(runs.run)].groupby("run")[["global_step", "return_mean"]]
        self.curve_of_run = {run: of_run.to_numpy(float) for run, of_run in points}
        paper = pd.read_csv(HERE / "paper_results.csv", dtype=str, keep_default_na=False)
        self.dims = dict(zip(paper.task, paper.action_dim.astype(int)))
        self.paper = {(row.task, row.method, row.schedule): row for row in paper.itertuples()}
        self.bounds = pd.read_csv(HERE / "bounds.csv", index_col="task")
        self.paper_tasks = list(dict.fromkeys(paper.task))
        self.tasks = list(dict.fromkeys([*paper.task, *sorted({cell.task for cell in self.cells} - {TOY})]))
        self.pairs = {task: (Cell(task), self.refineppo(task)) for task in self.tasks}

    def refineppo(self, task: str) -> Cell:
        """The cell that stands for RefinePPO."""
        asked = Cell(task, self.args.depth, self.args.schedule)
        own = [x for x in self.cells if x.task == task and (x.depth or 0) > 1 and not x.variant]
        return asked if asked in self.cells or not own else max(sorted(own), key=lambda cell: len(self.cells[cell]))

    def curves(self, cell: Cell) -> list[np.ndarray]:
        """Global step and mean return of each seed's evaluations, (evaluations, 2) each."""
        return [self.curve_of_run[run.run] for run in self.cells.get(cell, ()) if run.run in self.curve_of_run]

    def scores(self, cell: Cell, selection: str = "best_mean") -> np.ndarray:
        """Return of each seed, (seeds,), without those in whose last 10 % no episode ended."""
        scores = np.array([getattr(run, selection) for run in self.cells.get(cell, ())], float)
        return scores[np.isfinite(scores)]

    def spreads(self, cell: Cell, prefix: str = "") -> dict[str, "Spread"]:
        """Table cells of all three selections."""
        return {prefix + header: Spread.of(self.scores(cell, column)) for column, header in SELECTIONS.items()}

    def seeds(self, *cells: Cell) -> dict[str, int | str]:
        """How many seeds the cells have; a table's row of them ends so."""
        counts = [len(self.cells.get(cell, ())) for cell in cells]
        return {"seeds": counts[0] if len({*counts}) == 1 else " / ".join(map(str, counts))}

    def normalise(self, task: str, returns: np.ndarray) -> np.ndarray:
        """0 is the random policy, 1 the reference of bounds.csv."""
        random, reference = self.bounds.loc[task, ["random_return", "reference_return"]]
        return (returns - random) / (reference - random)


# --- Statistics -------------------------------------------------------------------------------------------------------


def mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def improvement(refineppo: float, ppo: float) -> float:
    """(R - P) / |P| in percent, as in the paper."""
    return 100 * (refineppo - ppo) / abs(ppo) if ppo else math.nan


def area_under_curve(curve: np.ndarray, low: float, high: float) -> float:
    """Area under the line through the evaluations from step low to high, over its width: the mean return there."""
    steps = np.unique([low, *curve[:, 0].clip(low, high), high])
    returns = np.interp(steps, *curve.T)
    return float(np.trapezoid(returns, steps) / (high - low) if high > low else returns[0])


def first_step_at(curve: np.ndarray, level: float) -> float:
    """The first evaluated step whose mean return is at least the level; infinite if there is none."""
    return next((float(step) for step, value in curve if value >= level), math.inf)


def mean_curve(curves: list[np.ndarray]) -> pd.DataFrame:
    """`mean` and `std` (0 for one seed) at each step, over the seeds that were evaluated there."""
    points = pd.DataFrame(np.concatenate(curves), columns=["step", "value"])
    return points.groupby("step").value.agg(["mean", "std"]).fillna(0)


def iqm(scores: np.ndarray) -> np.ndarray:
    """Interquartile mean over the last axis: without the lowest and the highest quarter, rounded down."""
    return trim_mean(scores, 0.25, axis=-1)


def probability(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Of improvement: share of the pairs of (..., n) and (..., m) in which x is higher, a tie counting half."""
    x, y = x[..., :, None], y[..., None, :]
    return ((x > y) + 0.5 * (x == y)).mean((-2, -1))


def resample(strata: list[np.ndarray], seed: int) -> list[np.ndarray]:
    """Seeds drawn with replacement within each stratum (task), (RESAMPLES, seeds) each."""
    rng = np.random.default_rng(seed)
    return [scores[rng.integers(len(scores), size=(RESAMPLES, len(scores)))] for scores in strata]


class Estimate(NamedTuple):
    """A value and its 95 % interval, of the percentile bootstrap over seeds, stratified by task; none of one seed."""

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan

    @classmethod
    def of(cls, value: float, resampled: np.ndarray, samples: list[np.ndarray]) -> "Estimate":
        bounds = np.quantile(resampled, (0.025, 0.975)) if min(map(len, samples)) > 1 else ()
        return cls(float(value), *map(float, bounds))

    @classmethod
    def iqm(cls, strata: list[np.ndarray]) -> "Estimate":
        """Of all scores together."""
        return cls.of(iqm(np.concatenate(strata)), iqm(np.concatenate(resample(strata, 0), axis=-1)), strata)

    @classmethod
    def pair(cls, statistic: Callable, first: list[np.ndarray], second: list[np.ndarray]) -> "Estimate":
        """Of a statistic of two samples, mean over the tasks."""
        resampled = map(statistic, resample(first, 1), resample(second, 2))
        return cls.of(np.mean([*map(statistic, first, second)]), np.mean([*resampled], axis=0), [*first, *second])

    def __str__(self) -> str:
        value, low, high = (shown(x, self.value) for x in self)
        return value if math.isnan(self.low) or self.low == self.high else f"{value} [{low}, {high}]"


class Spread(NamedTuple):
    """Mean and standard deviation (ddof 1), as text where the paper gives them."""

    mean: float | str = math.nan
    std: float | str = math.nan

    @classmethod
    def of(cls, values: np.ndarray) -> "Spread":
        return cls(mean(values), float(np.std(values, ddof=1)) if len(values) > 1 else math.nan)

    def __str__(self) -> str:
        spread = shown(self.std, self.mean)
        return shown(self.mean) + (f" ± {spread}" if spread != "-" else "")


class Median(NamedTuple):
    """Median and range, of steps or steps/s; infinite: never, which is later than any step."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: list[float]) -> "Median":
        return cls(float(np.median(values)), min(values), max(values))

    def __str__(self) -> str:
        median, low, high = ("never" if x == math.inf else f"{x:,.0f}" for x in self)
        return median if low == high else f"{median} ({low} to {high})"


class Percent(float):
    def __str__(self) -> str:
        return f"{self:+.1f}"


# --- Writing ----------------------------------------------------------------------------------------------------------


def shown(value, scale: float | None = None) -> str:
    """Text of a cell; a number has as many decimals as three digits of `scale`, by default itself, ask for."""
    if value is None or value != value:
        return "-"
    if type(value) is not float:
        return f"{value:,}" if type(value) is int else str(value)
    size = abs(value if scale is None else scale)
    return f"{value:z.{0 if size >= 100 else 1 if size >= 10 else 2}f}"


def csv_cells(row: dict) -> dict:
    """A row's numbers for the CSV, with a column for each of a cell of several."""
    fields = {}
    for header, cell in row.items():
        name = re.sub(r"\W+", "_", header.replace("%", "percent")).strip("_").lower()
        parts = {f"{name}_{part}": x for part, x in cell._asdict().items()} if isinstance(cell, tuple) else {name: cell}
        numbers = {part: float(x) if isinstance(x, Percent) else x for part, x in parts.items()}
        fields |= {part: "never" if x == math.inf else x for part, x in numbers.items()}
    return fields


def latex(frame: pd.DataFrame) -> str:
    text = frame.to_latex(index=False, escape=True, column_format="l" + "r" * (frame.shape[1] - 1))
    return "% needs \\usepackage{booktabs}\n" + re.sub(r"(?<![\w{])-(?=\d)", "$-$", text.replace("±", r"$\pm$"))


class Report:
    """The tables, figures and facts of an experiment by name, for the template; and their files, in `folder`."""

    def __init__(self, folder: str):
        self.folder, self.blocks, self.facts, self.files = folder, {}, {}, {}

    def add(self, name: str, content: bytes) -> str:
        """Add a file; a link to it."""
        self.files[f"{self.folder}/{name}"] = content
        return f"[{name}]({self.folder}/{name})"

    def table(self, name: str, rows: list[dict]):
        """Rows of header -> cell as Markdown, LaTeX and CSV; nothing without rows."""
        if rows:
            frame = pd.DataFrame(rows, dtype=object).map(shown)
            sides = "left", *["right"] * (frame.shape[1] - 1)
            text = frame.to_markdown(index=False, disable_numparse=True, colalign=sides)
            numbers = pd.DataFrame([*map(csv_cells, rows)], dtype=object).to_csv(index=False, lineterminator="\n")
            links = self.add(f"{name}.csv", numbers.encode()), self.add(f"{name}.tex", latex(frame).encode())
            self.blocks[name] = f"{text}\n\n{', '.join(links)}"

    def figure(self, name: str, figure: Figure):
        png, pdf = io.BytesIO(), io.BytesIO()
        figure.savefig(png, format="png")
        figure.savefig(pdf, format="pdf", metadata={"CreationDate": None})
        links = self.add(f"{name}.png", palette_png(png)), self.add(f"{name}.pdf", pdf.getvalue())
        self.blocks[f"{name}_figure"] = "!{}\n\n{}".format(*links)


def new_figure(rows: int, columns: int, width: float, height: float, **options) -> tuple[Figure, np.ndarray]:
    """A figure of width x height inches, and its axes, (rows, columns)."""
    figure = Figure((width, height), layout="constrained", dpi=200)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


# --- The paper's tables and figures -----------------------------------------------------------------------------------


def settings(e: Experiment, report: Report):
    """The flags that all runs share, and those of a task beside them."""
    shared = frozenset.intersection(*e.base.values())
    report.facts["flags"] = ", ".join(f"`{flag}`" for flag in sorted(shared))
    own = {key: ", ".join(sorted(base - shared)) for key, base in e.base.items()}
    report.table("settings", [{"task": t, "method": m, "flags": flags} for (t, m), flags in own.items() if flags])


def table_1(e: Experiment, report: Report) -> list[dict]:
    """PPO against RefinePPO; returns the rows."""
    pairs = {task: pair for task, pair in e.pairs.items() if any(cell in e.cells for cell in pair)}
    rows, usual = [], {refined[1:3] for _, refined in pairs.values()} <= {(e.args.depth, e.args.schedule)}
    for task, pair in pairs.items():
        ppo, refined = (Spread.of(e.scores(cell)) for cell in pair)
        row = {"task": task, "dim.": e.dims.get(task)} | ({} if usual else {"RefinePPO is": pair[1].method})
        row |= {"PPO": ppo, "RefinePPO": refined, "improv. %": Percent(improvement(refined.mean, ppo.mean))}
        if task in e.dims:
            paper = [e.paper[task, method, ""] for method in LOOKS]
            row |= {f"paper: {of.method}": Spread(of.mean, of.std) for of in paper}
            row["paper: improv. %"] = Percent(paper[1].improvement_percent)
        rows.append(row | e.seeds(*pair))
    report.facts["apart"] = [t for t in pairs if len({e.base[t, m] for m in LOOKS if (t, m) in e.base}) > 1]
    report.table("table1", rows)
    return rows


def baseline(e: Experiment, report: Report):
    rows = []
    for cell in (Cell(task) for task in CLEANRL if e.steps == 10**6 and Cell(task) in e.cells):
        row = {"task": cell.task, "PPO": Spread.of(e.scores(cell, "train_return_last10pct"))}
        rows.append(row | {"CleanRL, v4": CLEANRL[cell.task]} | e.seeds(cell))
    report.table("baseline", rows)


def training_curves(e: Experiment, report: Report):
    curves = {task: [e.curves(cell) for cell in pair] for task, pair in e.pairs.items()}
    curves = {task: pair for task, pair in curves.items() if any(pair)}
    if not curves:
        return
    tasks = [*dict.fromkeys(x for x in (*e.args.curve_tasks, *curves) if x in curves)][: len(e.args.curve_tasks)]
    report.facts["no_curve"] = [task for task in e.args.curve_tasks if task not in curves]
    report.figure("training_curves", curves_figure({task: curves[task] for task in tasks}))
    if curves.keys() - {*tasks}:
        report.figure("training_curves_all", curves_figure(curves))


def curves_figure(curves: dict[str, list[list[np.ndarray]]]) -> Figure:
    columns, lines, handles = min(3, len(curves)), math.ceil(len(curves) / 3), {}
    figure, axes = new_figure(lines, columns, max(2.3 * columns, 3.2), 1.7 * lines + 0.4)
    for axis in axes.flat[len(curves) :]:
        axis.remove()
    for axis, (task, pair) in zip(axes.flat, curves.items()):
        for (method, look), seeds in zip(LOOKS.items(), pair):
            for curve in seeds:
                axis.plot(*curve.T, color=look["color"], linewidth=0.5, alpha=0.45)
            if seeds:
                band = mean_curve(seeds)
                low, high = band["mean"] - band["std"], band["mean"] + band["std"]
                axis.fill_between(band.index, low, high, color=look["color"], alpha=0.15, linewidth=0)
                (handles[method],) = axis.plot(band.index, band["mean"], **look, linewidth=1.6, zorder=3)
        axis.set(title=f"{task}, n = {' / '.join({str(len(seeds)): 0 for seeds in pair})}", xlim=(0, None))
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.yaxis.set_major_formatter(EngFormatter(sep=""))
        axis.grid(color="0.9", linewidth=0.5)
    figure.supxlabel("environment steps", size=7)
    figure.supylabel("evaluation return", size=7)
    figure.legend(handles.values(), handles, loc="outside upper center", ncols=2, frameon=False)
    return figure


def sample_efficiency(e: Experiment, report: Report):
    rows = []
    for task, pair in e.pairs.items():
        curves = [*map(e.curves, pair)]
        starts, ends = ([curve[i, 0] for seeds in curves for curve in seeds] for i in (0, -1))
        if not all(curves) or max(starts) > min(ends):
            continue
        areas = [[area_under_curve(curve, max(starts), min(ends)) for curve in seeds] for seeds in curves]
        level, (ppo, refined) = mean([curve[-1, 1] for curve in curves[0]]), map(Spread.of, areas)
        row = {"task": task, "PPO: mean return": ppo, "RefinePPO: mean return": refined}
        row |= {"improv. %": Percent(improvement(refined.mean, ppo.mean)), "PPO's final level": level}
        for method, seeds in zip(LOOKS, curves):
            row |= when(f"{method}: seeds there", f"{method}: median step (range)", seeds, level)
        rows.append(row)
    report.table("sample_efficiency", rows)


def when(count_header: str, steps_header: str, curves: list[np.ndarray], level: float) -> dict:
    """Two table cells: how many of the curves reach the level, and when."""
    steps = [first_step_at(curve, level) for curve in curves]
    return {count_header: f"{sum(map(math.isfinite, steps))} of {len(steps)}", steps_header: Median.of(steps)}


def toy(e: Experiment, report: Report):
    cells = sorted((cell for cell in e.cells if cell.task == TOY), key=order)
    solved = [when("solved", "median step (range)", e.curves(cell), SOLVED) for cell in cells]
    report.table("toy", [{"method": cell.method, **of, **e.seeds(cell)} for cell, of in zip(cells, solved)])


def across(e: Experiment, report: Report, name: str, cells: dict[str, dict], paper: bool = False):
    """A table of the best checkpoint's returns: task by the labelled cells of `cells[task]`, beside the paper's."""
    rows = []
    for task, of_task in cells.items():
        row = {"task": task} | {label: Spread.of(e.scores(cell)) for label, cell in of_task.items()}
        if paper:
            published = {label: e.paper.get((task, "RefinePPO", label)) for label in of_task}
            row |= {f"paper: {label}": of and of.mean for label, of in published.items()}
        rows.append(row | e.seeds(*of_task.values()))
    report.table(name, rows)


def table_2(e: Experiment, report: Report):
    cells = {task: {name: of._replace(schedule=name) for name in SCHEDULES} for task, (_, of) in e.pairs.items()}
    several = {task: of_task for task, of_task in cells.items() if sum(x in e.cells for x in of_task.values()) > 1}
    across(e, report, "table2", several, paper=True)


def depth_figure(e: Experiment, report: Report):
    refined = {task: pair[1] for task, pair in e.pairs.items()}
    have = {task: {x.depth for x in e.cells if x == of._replace(depth=x.depth)} for task, of in refined.items()}
    depths = sorted(set().union(*(of_task for of_task in have.values() if len(of_task) > 1)))
    tasks = [task for task in e.tasks if depths and {*depths} <= have[task]]
    if not tasks:
        return
    cells = {task: {f"K = {depth}": refined[task]._replace(depth=depth) for depth in depths} for task in tasks}
    returns = {task: np.array([mean(e.scores(cell)) for cell in of.values()]) for task, of in cells.items()}
    panels = {"min-max": [(values - values.min()) / (np.ptp(values) or 1) for values in returns.values()]}
    if bounded := [e.normalise(task, returns[task]) for task in tasks if task in e.bounds.index]:
        panels["fixed bounds"] = bounded
    rows = [{"K": depth} for depth in depths]
    figure, axes = new_figure(1, len(panels), 2.6 * len(panels), 2.1)
    for axis, (name, values) in zip(axes.flat, panels.items()):
        for i, row in enumerate(rows):
            row |= {name: Spread.of([of_task[i] for of_task in values]), f"{name}: tasks": len(values)}
        centre, spread = np.array([row[name] for row in rows]).T
        axis.errorbar(range(len(depths)), centre, np.nan_to_num(spread), fmt="ko-", markersize=4, lw=1, capsize=3)
        axis.set_xticks(range(len(depths)), depths)
        axis.set(title=name, xlabel="refinement depth $K$", ylabel="normalised return", xlim=(-0.4, len(depths) - 0.6))
        axis.grid(axis="y", color="0.9", linewidth=0.5)
    report.facts["unbounded"] = [task for task in tasks if task not in e.bounds.index]
    report.facts["without_all_depths"] = [task for task in e.tasks if have[task] and task not in tasks]
    report.figure("depth", figure)
    report.table("depth_normalised", rows)
    across(e, report, "depth", cells)


def action_dimension(report: Report, table1: list[dict]):
    rows = [row for row in table1 if row["dim."] and math.isfinite(row["improv. %"])]
    rows.sort(key=lambda row: row["dim."])
    if not rows:
        return
    figure, ((axis,),) = new_figure(1, 1, 5.0, 0.19 * len(rows) + 1.0)
    axis.axvline(0, color="0.6", linewidth=0.7)
    facts, dims, largest = [], [row["dim."] for row in rows], 0
    for label, key, fill, size in (("here", "improv. %", "full", 3.5), ("the paper", "paper: improv. %", "none", 7)):
        x = [float(row[key]) for row in rows]
        axis.plot(x, range(len(x)), "ko", label=label, markersize=size, fillstyle=fill)
        varied, largest = len(x) > 2 and len({*x}) > 1 and len({*dims}) > 1, max(largest, *map(abs, x))
        facts.append(f"{label} {spearmanr(dims, x).statistic:+.2f} (n = {len(x)})" if varied else f"{label} undefined")
    if largest > 10:  # else matplotlib's own ticks, since all of these would lie outside
        axis.set_xscale("symlog", linthresh=10)
        sizes = [5, *(digit * 10**power for power in range(1, 9) for digit in (1, 3))]
        axis.xaxis.set_major_locator(FixedLocator([*(-size for size in sizes), 0, *sizes]))
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:+.7g}" if value else "0")
    axis.set_yticks(range(len(rows)), [f"{row['task']} ({row['dim.']})" for row in rows])
    axis.set(ylim=(len(rows) - 0.5, -0.5), xlabel="improvement of RefinePPO on PPO (%)")
    axis.grid(color="0.9", linewidth=0.5)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    report.facts["spearman"] = ", ".join(facts)
    report.figure("action_dimension", figure)


# --- What few seeds can carry, controls and variants ------------------------------------------------------------------


def few_seeds(e: Experiment, report: Report):
    """Intervals and probabilities instead of a test per task."""
    pairs = {task: pair for task, pair in e.pairs.items() if all(cell in e.cells for cell in pair)}
    scores = {task: [e.scores(cell) for cell in pair] for task, pair in pairs.items()}
    rows = [{"task": task, **iqms([of_task]), **e.seeds(*pairs[task])} for task, of_task in scores.items()]
    report.table("seeds", rows)
    bounded, totals = [task for task in pairs if task in e.bounds.index], []
    for selection, label in SELECTIONS.items():
        of_tasks = [[e.normalise(task, e.scores(cell, selection)) for cell in pairs[task]] for task in bounded]
        of_tasks = [pair for pair in of_tasks if all(map(len, pair))]  # no episode may have ended in the last 10 %
        if of_tasks:
            totals.append({"return of": label, **iqms(of_tasks), "tasks": len(of_tasks)})
    report.facts["no_bounds"] = [task for task in pairs if task not in bounded]
    report.table("aggregate", totals)
    if totals:
        shown_rows = [row for row in rows if row["task"] in bounded] + totals[:1]
        report.figure("seeds", seeds_figure(e, {task: scores[task] for task in bounded}, shown_rows))
    report.table(
        "selection",
        [
            {"task": task, **e.spreads(ppo, "PPO: "), **e.spreads(refined, "RefinePPO: ")}
            for task, (ppo, refined) in pairs.items()
        ],
    )


def iqms(pairs: list[list[np.ndarray]]) -> dict[str, Estimate]:
    """Table cells of PPO's and RefinePPO's scores on some tasks."""
    ppo, refined = zip(*pairs)
    row = {"PPO: IQM": Estimate.iqm(ppo), "RefinePPO: IQM": Estimate.iqm(refined)}
    return row | {"P(improvement)": Estimate.pair(probability, refined, ppo)}


def seeds_figure(e: Experiment, scores: dict[str, list[np.ndarray]], rows: list[dict]) -> Figure:
    """Every seed's normalised return, and the probability of improvement; the last row is the mean over tasks."""
    figure, ((left, right),) = new_figure(1, 2, 7.2, 0.24 * len(rows) + 1, sharey=True, width_ratios=(3, 2))
    for y, (task, of_task) in enumerate(scores.items()):
        for (method, look), shift, of_method in zip(LOOKS.items(), (-0.17, 0.17), of_task):
            dots(left, e.normalise(task, of_method), y + shift, look["color"], None if y else method)
    for y, row in enumerate(rows):
        p, low, high = row["P(improvement)"]
        style, color = ("o", LOOKS["RefinePPO"]["color"]) if "task" in row else ("D", "black")
        right.errorbar(p, y, xerr=[[p - low], [high - p]], fmt=style, color=color, markersize=3.5, capsize=2, lw=1)
    for axis, x in ((left, 0), (left, 1), (right, 0.5)):
        axis.axvline(x, color="0.6", linestyle=":", linewidth=0.8)
    left.set_yticks(range(len(rows)), [*scores, "mean over tasks"])
    left.set(ylim=(len(rows) - 0.5, -0.5), xlabel="normalised return of the best checkpoint (0 random, 1 reference)")
    right.set(xlabel="P(improvement)", xlim=(-0.03, 1.03))
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    return figure


def dots(axis, scores: np.ndarray, y: float, color: str, label: str | None = None):
    """Every seed's score as a point on the line y, and their IQM as a tick."""
    look = {"color": color, "alpha": 0.7, "markersize": 3.5, "markeredgewidth": 0}
    axis.plot(scores, np.full(len(scores), y), "o", **look, label=label)
    if len(scores):
        axis.plot([iqm(scores)] * 2, [y - 0.15, y + 0.15], color="black", linewidth=1.2)


def differences(e: Experiment, pairs: list[tuple[Cell, Cell]]) -> dict[str, Estimate]:
    """Table cells: first minus second cell, and how often the first wins; of several tasks the normalised mean."""
    row = {}
    for selection, header in SELECTIONS.items():
        scores = [[e.scores(cell, selection) for cell in pair] for pair in pairs]
        if len(pairs) > 1:
            scores = [[e.normalise(pair[0].task, x) for x in of] for pair, of in zip(pairs, scores)]
        whole = all(len(x) for of_pair in scores for x in of_pair)  # no episode may have ended in the last 10 %
        for name, statistic in (("difference", lambda x, y: x.mean(-1) - y.mean(-1)), ("P(higher)", probability)):
            row[f"{header}: {name}"] = Estimate.pair(statistic, *zip(*scores)) if whole else Estimate()
    return row


def compare(e: Experiment, report: Report, name: str, groups: dict[str, dict[str, Cell]], against: list[tuple]):
    """Returns of every labelled group of cells by task, their differences, and a figure of all seeds."""
    tasks = [task for task in e.tasks if any(task in group for group in groups.values())]
    rows = []
    for task in tasks:
        for label, cell in ((label, group[task]) for label, group in groups.items() if task in group):
            size = (int(e.bounds.obs_dim[task]), e.dims[task]) if task in e.bounds.index else None
            cost = actor_cost(e.cells[cell][0], *size) if size else {}
            rows.append({"task": task, "method": label} | cost | e.spreads(cell) | e.seeds(cell))
    report.table(name, rows)
    rows = []
    for first, second in against:
        pairs = {task: (groups[first][task], groups[second][task]) for task in groups[first] if task in groups[second]}
        for task, pair in pairs.items():
            row = {"difference": f"{first} - {second}", "task": task}
            rows.append(row | differences(e, [pair]) | e.seeds(*pair))
        if len(bounded := [pair for task, pair in pairs.items() if task in e.bounds.index]) > 1:
            row = {"difference": f"{first} - {second}", "task": f"{len(bounded)} tasks, normalised"}
            rows.append(row | differences(e, bounded))
    report.table(f"{name}_differences", rows)
    if tasks:
        report.figure(name, every_seed(e, tasks, groups))


def every_seed(e: Experiment, tasks: list[str], groups: dict[str, dict[str, Cell]]) -> Figure:
    """A panel for each task and selection: every seed of every group."""
    figure, axes = new_figure(3, len(tasks), 1.4 * len(tasks) + 1.8, 0.5 * len(groups) + 1.2, sharey=True, sharex="col")
    for panels, (selection, header) in zip(axes, SELECTIONS.items()):
        for axis, task in zip(panels, tasks):
            for y, group in enumerate(groups.values()):
                if task in group:
                    look = LOOKS["PPO" if group[task].depth is None else "RefinePPO"]
                    dots(axis, e.scores(group[task], selection), y, look["color"])
            axis.grid(color="0.9", linewidth=0.5)
            axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        panels[0].set_yticks(range(len(groups)), groups)
        panels[0].set(ylim=(len(groups) - 0.5, -0.5), ylabel=header)
    for axis, task in zip(axes[0], tasks):
        axis.set_title(task)
    return figure


def order(cell: Cell) -> tuple:
    """PPO, K = 1, 2, ...; their schedules; variants of the actor last."""
    return bool(cell.variant), cell.depth or 0, SCHEDULES.index(cell.schedule) if cell.schedule else 0, cell.variant


def controls(e: Experiment, report: Report):
    """Is it the refinement? K = 1 against PPO first: the same class of policies with another initialisation."""
    groups = defaultdict(dict)
    for task, (ppo, _) in e.pairs.items():
        cells = sorted((cell for cell in e.cells if cell.task == task and cell.kind == "control"), key=order)
        if ppo in cells and any(cell.depth == 1 or cell.variant for cell in cells):
            for cell in cells:  # actors of as many layers are one control, whose width may differ by task
                key = cell._replace(task="", variant=tuple("x" * part.count("x") for part in cell.variant))
                key = cell._replace(task="") if task in groups[key] else key
                groups[key][task] = cell
    groups = sorted(groups.values(), key=lambda group: order(next(iter(group.values()))))
    labels = [" / ".join(dict.fromkeys(cell.method for cell in group.values())) for group in groups]
    refined = Cell("", e.args.depth, e.args.schedule).method
    simple = [x for x, of in zip(labels, groups) if any(cell.depth == 1 or cell.variant for cell in of.values())]
    against = [(label, "PPO") for label in labels if label != "PPO"]
    against += [(refined, label) for label in simple if refined in labels and label != refined]
    compare(e, report, "controls", dict(zip(labels, groups)), against)


def learning_rates(e: Experiment, report: Report):
    """Is it the step size? Each method at fractions and multiples of the task's learning rate."""
    plain, groups = {cell._replace(variant=()) for cell in e.cells if cell.kind == "rate"}, defaultdict(dict)
    for cell in (cell for cell in e.cells if cell in plain or cell.kind == "rate"):
        ratio = rate_ratio(e.cells[cell][0], e.base[cell.task, "RefinePPO" if cell.depth else "PPO"])
        groups[Cell("", cell.depth, cell.schedule), ratio][cell.task] = cell
    labels = {key: f"{key[0].method}, lr x {key[1]}" for key in sorted(groups, key=lambda key: (order(key[0]), key[1]))}
    against = [(labels[a], labels[b]) for b in labels for a in labels if a[1] == b[1] and order(a[0]) > order(b[0])]
    compare(e, report, "learning_rates", {label: groups[key] for key, label in labels.items()}, against)


def variants(e: Experiment, report: Report):
    """Runs that differ from the task's settings in anything else, each against the same method with the settings."""
    groups, against = defaultdict(dict), {}
    for cell in sorted((cell for cell in e.cells if cell.kind == "variant"), key=order):
        groups[cell.method][cell.task] = cell
        if (plain := cell._replace(variant=())) in e.cells:
            groups[plain.method][cell.task] = plain
            against[cell.method] = plain.method
    compare(e, report, "variants", groups, [*against.items()])


def cost(e: Experiment, report: Report):
    methods = defaultdict(list)
    for cell in sorted(e.cells, key=order):
        methods[cell.method] += e.cells[cell]
    rows = []
    for method, runs in methods.items():
        row = {"method": method, "runs": len(runs), "steps/s: median (range)": Median.of([run.sps for run in runs])}
        rows.append(row | {"hours": sum(run.wall_time_s for run in runs) / 3600})
    report.table("cost", rows)
    for name in ("task", "cpu", "gpu", "git_commit", "versions"):
        report.facts[name] = sorted({getattr(run, name) for runs in methods.values() for run in runs} - {""})


def missing(e: Experiment) -> list[str]:
    """Tasks of the paper that a table or figure lacks, and cells with fewer seeds than the paper's."""
    refined = [e.pairs[task][1] for task in e.paper_tasks]
    expected = {"PPO": [Cell(cell.task) for cell in refined], "RefinePPO": refined}
    expected |= {f"the {name} schedule": [cell._replace(schedule=name) for cell in refined] for name in SCHEDULES}
    expected |= {f"K = {depth}": [cell._replace(depth=depth) for cell in refined] for depth in DEPTHS}
    lacking, few = defaultdict(list), defaultdict(list)
    for item, cells in expected.items():
        lacking[", ".join(cell.task for cell in cells if cell not in e.cells)].append(item)
    some = {tasks: items for tasks, items in lacking.items() if tasks and tasks != ", ".join(e.paper_tasks)}
    lines = [f"no finished run of {', '.join(items)}: {tasks}" for tasks, items in some.items()]
    for cell, runs in e.cells.items():
        few[len(runs), cell.method].append(cell.task)
        if silent := len(runs) - len(e.scores(cell, "train_return_last10pct")):
            lines.append(f"no episode ended in the last 10 % of {silent} seeds of {cell.method}: {cell.task}")
    return lines + [f"only {n} of {SEEDS} seeds of {m}: {', '.join(few[n, m])}" for n, m in sorted(few) if n < SEEDS]


# --- The report -------------------------------------------------------------------------------------------------------


def make_report(runs: pd.DataFrame, evaluations: pd.DataFrame, args: Args) -> dict[str, bytes]:
    """The files of a report, report.md first."""
    experiments, finished = [], runs[runs.failure == ""]
    sections = settings, baseline, training_curves, sample_efficiency, table_2, depth_figure, few_seeds, controls
    with rc_context(STYLE):
        for steps in sorted({*finished.steps}, key=lambda steps: (-(finished.steps == steps).sum(), steps)):
            e, report = Experiment(runs[runs.steps == steps], evaluations, args), Report(steps_text(steps))
            action_dimension(report, table_1(e, report))
            for section in (*sections, learning_rates, variants, toy, cost):
                section(e, report)
            experiments.append((e, report, missing(e)))
    changed = [name for name in ("depth", "schedule", "curve_tasks") if getattr(args, name) != getattr(Args, name)]
    flags = shlex.join(words({name: getattr(args, name) for name in changed}))
    failed = [*runs[runs.failure != ""].itertuples()]
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(HERE), trim_blocks=True, keep_trailing_newline=True)
    template = environment.get_template("report_template.md", globals={"resamples": RESAMPLES, "solved": SOLVED})
    text = template.render(mark=MARK, flags=flags, args=args, runs=runs, failed=failed, experiments=experiments)
    files = {"report.md": re.sub(r"\n{3,}", "\n\n", text).encode()}
    return files | {name: content for _, report, _ in experiments for name, content in report.files.items()}


def earlier_files(folder: Path) -> set[str]:
    """Files that an earlier report has left in a folder."""
    text = (folder / "report.md").read_text() if (folder / "report.md").is_file() else ""
    tables = {"runs.csv", "evaluations.csv"} if (folder / "runs.csv").exists() else set()
    return tables | {"report.md", *re.findall(r"\]\((\w+/\w+\.\w+)\)", text)} if text.startswith(MARK) else tables


def check_folder(folder: Path, found: dict[str, Run]):
    """Make the output folder; refuse to overwrite what no report has made, and to lose an earlier one's runs."""
    of_steps = {steps_text(int(run.row["steps"])) for run in found.values()}
    ours = [folder / name for name in ("report.md", "runs.csv", "evaluations.csv")]
    ours += [path for name in of_steps for path in (folder / name).glob("[!.]*")]
    earlier = earlier_files(folder)
    for path in ours:
        if path.exists() and path.relative_to(folder).as_posix() not in earlier:
            refuse(f"{path} was made by no report; name another --out-dir")
    if (folder / "runs.csv").exists():
        before = merge([*found.values(), *read_source(folder / "runs.csv", print)])
        if lost := [name for name in before if name not in found]:
            refuse(f"{folder} has runs that no source has, as {lost[0]}; name it as a source too to keep them")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        refuse(f"cannot write to the output folder {folder}: {error.strerror}")


def main():
    args = tyro.cli(Args, description=__doc__)
    if args.depth < 1 or not args.sources:
        refuse(f"--depth must be at least 1, not {args.depth}" if args.sources else "name run folders or a runs.csv")
    first, said = args.sources[0], []
    found = merge(run for source in args.sources for run in read_source(source, said.append))
    if not found:
        refuse("; ".join([f"there is no finished run in {', '.join(map(str, args.sources))}", *said]))
    table = first if first.is_file() else first / "runs.csv"
    folder = args.out_dir or (table.parent if table.is_file() else first / "report")
    check_folder(folder, found)
    print(*said, sep="\n", end="\n" if said else "")
    runs, evaluations = as_tables(found)
    files = make_report(typed(runs), typed(evaluations), args)
    files |= {"runs.csv": runs.encode(), "evaluations.csv": evaluations.encode()}
    for name in earlier_files(folder) - files.keys():
        (folder / name).unlink(missing_ok=True)
    for name, content in files.items():  # report.md first, since it marks the folder as a report's
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / f"{name}.tmp").write_bytes(content)
        (folder / f"{name}.tmp").replace(folder / name)
    print(f"{len(found)} runs; the report is in {folder / 'report.md'}")


if __name__ == "__main__":
    main()
