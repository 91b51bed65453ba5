"""Write the tables of sweeps/results/README.md anew from the CSVs beside it: python sweeps/results_page.py

The returns are those of benchmark/1M, what f reads of analysis/*/feedback.csv. A table is known by its first line.
"""

import pandas as pd
from common import ROOT
from report import Estimate, Spread, shown

RESULTS, TABLES = ROOT / "sweeps" / "results", ROOT / "sweeps" / "results" / "benchmark" / "1M"
SELECTIONS, METHODS = ("best", "last", "last_10_percent"), ("ppo", "refineppo")


def returns() -> list[list[str]]:
    """A row for each task: best, last and last 10 % of PPO and of RefinePPO; then both over all tasks."""
    columns = [f"{method}_{selection}" for method in METHODS for selection in SELECTIONS]
    rows = [
        [row["task"], *(str(Spread(row[f"{column}_mean"], row[f"{column}_std"])) for column in columns)]
        for _, row in pd.read_csv(TABLES / "selection.csv").iterrows()
    ]
    over_all = pd.read_csv(TABLES / "aggregate.csv")
    iqm = [estimate(row, f"{method}_iqm") for method in METHODS for _, row in over_all.iterrows()]
    wins = [estimate(row, "p_improvement") for _, row in over_all.iterrows()]
    return [*rows, ["all: IQM, normalised", *iqm], ["all: RefinePPO wins", "", "", "", *wins]]


def estimate(row: pd.Series, name: str) -> str:
    return str(Estimate(*(row[f"{name}_{part}"] for part in Estimate._fields)))


def feedback() -> list[list[str]]:
    """A row for each task: the own return; what is lost, with its standard error; R^2 of the network of one pass."""
    rows = []
    for path in sorted(RESULTS.glob("analysis/*/feedback.csv")):
        reads = {row.pop("reads"): row for row in pd.read_csv(path).to_dict("records")}
        lost = [reads[x] for x in ("zero", "another_state", "one_pass")]
        lost = [str(Spread(x["lost_mean"], x["lost_std"] / x["episodes"] ** 0.5)) for x in lost]
        rows.append([path.parent.name, shown(reads["own"]["return_mean"]), *lost, f"{reads['one_pass']['r2']:.3f}"])
    return rows


def fill(page: str) -> str:
    """The page with these tables."""
    for header, rows in (("| task | PPO: best |", returns()), ("| task | own return |", feedback())):
        start = page.index(header)
        end = page.index("\n\n", start)
        head = page[start:end].splitlines()[:2]
        page = page[:start] + "\n".join([*head, *(f"| {' | '.join(row)} |" for row in rows)]) + page[end:]
    return page


def main():
    page = RESULTS / "README.md"
    page.write_text(fill(page.read_text()))


if __name__ == "__main__":
    main()
