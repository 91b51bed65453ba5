"""Write the tables of sweeps/results/README.md anew from the CSVs beside it: python sweeps/results_page.py

The returns and the controls are those of benchmark/1M, what f reads of analysis/*/feedback.csv. A table is known by the
beginning of its first line.
"""

from itertools import groupby

import pandas as pd
import report
from common import ROOT
from report import Estimate, Spread, shown

RESULTS, TABLES = ROOT / "sweeps" / "results", ROOT / "sweeps" / "results" / "benchmark" / "1M"
METHODS, SELECTIONS = ("ppo", "refineppo"), ("best", "last", "last_10_percent")  # as in the names of columns


def returns() -> list[list[str]]:
    """A row for each task: best, last and last 10 % of PPO and of RefinePPO, and the paper's; then over all tasks."""
    columns = [f"{method}_{selection}" for method in METHODS for selection in SELECTIONS]
    columns += [f"paper_{method}" for method in METHODS]
    table = pd.read_csv(TABLES / "selection.csv").merge(pd.read_csv(TABLES / "table1.csv"), "left", "task")
    rows = [[row["task"], *(spread(row, column) for column in columns)] for _, row in table.iterrows()]
    over_all = pd.read_csv(TABLES / "aggregate.csv")
    iqm = [estimate(row, f"{method}_iqm") for method in METHODS for _, row in over_all.iterrows()]
    wins = [estimate(row, "p_improvement") for _, row in over_all.iterrows()]
    head = ["task", "PPO: best", "last", "last 10 %", "RefinePPO: best", "last", "last 10 %"]
    head += ["paper, 6M: PPO", "RefinePPO"]
    return [head, *rows, ["all: IQM, normalised", *iqm, "", ""], ["all: RefinePPO wins", "", "", "", *wins, "", ""]]


def spread(row: pd.Series, name: str) -> str:
    return str(Spread(float(row[f"{name}_mean"]), float(row[f"{name}_std"])))  # the paper's are integers


def estimate(row: pd.Series, name: str) -> str:
    return str(Estimate(*(row[f"{name}_{part}"] for part in Estimate._fields)))


def controls() -> list[list[str]]:
    """A column for each control: over its tasks, the share of the pairs of seeds in which it is better than PPO."""
    table = pd.read_csv(TABLES / "controls_differences.csv")
    table = table[table.difference.str.endswith(" - PPO") & table.task.str.endswith("normalised")]
    names = table.difference.str.removesuffix(" - PPO").str.removeprefix("RefinePPO ").str.removesuffix(" average")
    rows = [
        [name, *(estimate(row, f"{selection}_p_higher") for _, row in table.iterrows())]
        for selection, name in zip(SELECTIONS, report.SELECTIONS.values())
    ]
    return [["P(higher than PPO)", *names], *rows]


def feedback() -> list[list[str]]:
    """A row for each task and budget, of several seeds in one: the own return; what is lost, with its standard error
    and share of that return; R^2 of the network of one pass."""
    rows = []
    for path in sorted(RESULTS.glob("analysis/*/feedback.csv")):
        reads = {row.pop("reads"): row for row in pd.read_csv(path).to_dict("records")}
        own, task = reads["own"]["return_mean"], path.parent.name.partition("-seed")[0]
        losses = [lost(reads[x], own) for x in ("zero", "another_state", "one_pass")]
        rows.append([task, shown(own), *losses, f"{reads['one_pass']['r2']:.3f}"])
    rows = [[task, *map("; ".join, list(zip(*of_task))[1:])] for task, of_task in groupby(rows, lambda row: row[0])]
    head = ["task", "own return", "lost: reads zero", "lost: another state's", "lost: one pass", "its R^2"]
    return [head, *rows]


def lost(row: dict, own: float) -> str:
    """The loss, its standard error and its share of the own return."""
    error = row["lost_std"] / row["episodes"] ** 0.5
    share = row["lost_mean"] / abs(own) if own else 0
    return f"{Spread(row['lost_mean'], error)} ({round(share * 100)} %)"


def markdown(head: list[str], *rows: list[str]) -> str:
    align = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join([f"| {' | '.join(head)} |", f"|{'|'.join(align)}|", *(f"| {' | '.join(row)} |" for row in rows)])


def fill(page: str) -> str:
    """The page with these tables."""
    for table in (returns(), controls(), feedback()):
        start = page.index(f"| {table[0][0]} | {table[0][1]} |")
        end = page.index("\n\n", start)
        page = page[:start] + markdown(*table) + page[end:]
    return page


def main():
    page = RESULTS / "README.md"
    page.write_text(fill(page.read_text()))


if __name__ == "__main__":
    main()
