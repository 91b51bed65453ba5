"""sweeps/report.py on hand-made run folders, against tables computed by hand and statistics as plain loops."""

import csv
import itertools
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from statistics import mean, stdev
from types import SimpleNamespace

import gymnasium as gym
import matplotlib.image
import numpy as np
import pandas as pd
import pytest
import scipy.stats
from conftest import ROOT, run

from sweeps import report

TOY = "sweeps.toy_env:Coordination-v0"
CURVE, STEPS = ((100, 0.0), (200, 1.0)), 6_000_000


def make_run(
    root,
    name,
    task,
    seed,
    best=0.0,
    curve=CURVE,
    depth=None,
    schedule="average",
    steps=STEPS,
    late=5.0,
    failure=None,
    **flags,
) -> Path:
    """A run folder with the fields that matter here, and others beside them; of an empty failure an unfinished one."""
    folder = root / name
    folder.mkdir(parents=True)
    refinement = {} if depth is None else {"refinement_depth": depth, "refinement_schedule": schedule}
    args = {"env_id": task, "seed": seed, "total_timesteps": steps, "run_dir": name, "resume": True}
    args |= {"learning_rate": 3e-4, "actor_hidden": [128, 128], "eval_interval": 100_000}
    config = {"args": args | refinement | flags, "versions": {"torch": "2", "numpy": "3"}, "git_commit": None}
    (folder / "config.json").write_text(json.dumps(config | {"cpu": "x", "gpu": None}))
    lines = [f"{step},{value},1.0,{value - 1},{value + 1},50.0" for step, value in curve]
    header = "global_step,return_mean,return_std,return_min,return_max,length_mean"
    (folder / "evaluations.csv").write_text("\n".join([header, *lines]) + "\n")
    if failure:
        (folder / "failure.json").write_text(json.dumps(failure))
    elif failure is None:
        last = {"global_step": 200, "returns": [best - 1], "mean": best - 1, "std": 1.0}
        result = {"best": last | {"selection_return": best, "returns": [best], "mean": best}, "last": last}
        result |= {"train_return_last10pct": late, "wall_time_s": 1.0, "sps": 1.0}
        (folder / "result.json").write_text(json.dumps(result))
    return folder


def make_seeds(root: Path, task: str, bests: list[float], depth=None, schedule="average", prefix="", **more):
    for seed, best in enumerate(bests, start=1):
        name = f"{prefix}{task}-{depth}-{schedule}-{seed}"
        make_run(root, name, task, seed, best, depth=depth, schedule=schedule, **more)


@pytest.fixture
def make_report(monkeypatch):
    """`python sweeps/report.py FLAGS` in this process, with no figure drawn; returns report.md."""

    def call(*flags) -> str:
        with monkeypatch.context() as patch:
            patch.setattr(report.Report, "figure", lambda self, name, _: self.blocks.update({f"{name}_figure": name}))
            patch.setattr(sys, "argv", ["report.py", *map(str, flags)])
            report.main()
        own = flags[0] if (flags[0] / "runs.csv").exists() else flags[0] / "report"
        out = Path(flags[flags.index("--out-dir") + 1]) if "--out-dir" in flags else own
        return (out / "report.md").read_text()

    return call


def section(text: str, header: str) -> str:
    return re.split(r"\n\n##? ", text[text.index(f"## {header}") :])[0]


def table(text: str, header: str) -> dict[str, list[str]]:
    """First cell -> the others, of all rows in a section."""
    lines = [line for line in section(text, header).splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {first: cells for first, *cells in rows}


def read(path: Path) -> list[dict]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


PAPER, BOUNDS = (read(ROOT / "sweeps" / name) for name in ("paper_results.csv", "bounds.csv"))


# --- Tables by hand ---------------------------------------------------------------------------------------------------


def test_table_1(tmp_path, make_report):
    """Mean, std (ddof 1), improvement with |P|, the paper's own, seeds; the tasks' order is the paper's."""
    make_seeds(tmp_path, "Pusher-v5", [-40, -50])
    make_seeds(tmp_path, "Pusher-v5", [-30, -45], depth=4)
    make_seeds(tmp_path, "Hopper-v5", [1000, 2000, 3000])
    make_seeds(tmp_path, "Hopper-v5", [2500, 3500], depth=4)
    make_seeds(tmp_path, "Ant-v5", [100])
    make_seeds(tmp_path, "Other-v0", [1, 2])
    make_seeds(tmp_path, "Other-v0", [3, 3], depth=4)
    text = make_report(tmp_path)
    rows = table(text, "Table 1")
    assert [*rows] == ["task", "Ant-v5", "Hopper-v5", "Pusher-v5", "Other-v0"]
    header = "dim.|PPO|RefinePPO|improv. %|paper: PPO|paper: RefinePPO|paper: improv. %|seeds"
    assert rows["task"] == header.split("|")
    assert rows["Hopper-v5"] == "3|2000 ± 1000|3000 ± 707|+50.0|2720 ± 826|3120 ± 287|+14.7|3 / 2".split("|")
    assert rows["Pusher-v5"] == "7|-45.0 ± 7.1|-37.5 ± 10.6|+16.7|-44.0 ± 10|-37 ± 9|+15.9|2".split("|")
    assert rows["Ant-v5"][1:4] == ["100", "-", "-"] and rows["Ant-v5"][-1] == "1 / 0"
    assert rows["Other-v0"] == "-|1.50 ± 0.71|3.00 ± 0.00|+100.0|-|-|-|2".split("|")
    hopper = next(row for row in read(tmp_path / "report/6M/table1.csv") if row["task"] == "Hopper-v5")
    assert float(hopper["ppo_mean"]) == 2000 and float(hopper["ppo_std"]) == 1000
    assert float(hopper["refineppo_std"]) == pytest.approx(stdev([2500, 3500]))
    assert hopper["improv_percent"] == "50.0" and hopper["paper_ppo_std"] == "826"
    missing = section(text, "What is missing")
    assert "- no finished run of PPO: HalfCheetah-v5, Walker2d-v5, Swimmer-v5, Reacher-v5, " in missing
    assert "- only 1 of 5 seeds of PPO: Ant-v5\n- only 2 of 5 seeds of PPO: " in missing
    note = section(text, "Table 1").replace("\n", " ")
    assert "each method tuned by a search of its own. Here: 6,000,000 steps, not tuned per method" in note
    assert "first rollouts at or past each multiple of `--eval-interval`" in note and "states of 20 episodes" in note


def test_sample_efficiency(tmp_path, make_report):
    """Areas: (500 + 1500) / 200, (0 + 2000) / 200, (2500 + 4000) / 200, (1000 + 2250) / 200; PPO's level 30."""
    curves = {(None, 1): (0, 10, 20), (None, 2): (0, 0, 40), (4, 1): (20, 30, 50), (4, 2): (0, 20, 25)}
    for (depth, seed), returns in curves.items():
        make_run(tmp_path, f"{depth}-{seed}", "Hopper-v5", seed, depth=depth, curve=[*zip((100, 200, 300), returns)])
    row = table(make_report(tmp_path), "Sample efficiency")["Hopper-v5"]
    by_hand = "10.0 ± 0.0|24.4 ± 11.5|+143.8|30.0|1 of 2|never (300 to never)|1 of 2|never (200 to never)"
    assert row == by_hand.split("|")
    (row,) = read(tmp_path / "report/6M/sample_efficiency.csv")
    assert float(row["refineppo_mean_return_mean"]) == 24.375
    assert row["refineppo_median_step_range_median"] == "never"


def test_sample_efficiency_ends_at_the_last_step_of_all(tmp_path, make_report):
    """PPO was last evaluated at 200: RefinePPO's area ends there too, (10 + 15) / 2, and its late return is out."""
    make_run(tmp_path, "a", "Hopper-v5", 1, curve=[(100, 4), (200, 6)])
    make_run(tmp_path, "b", "Hopper-v5", 1, depth=4, curve=[(100, 10), (300, 20), (400, 900)])
    row = table(make_report(tmp_path), "Sample efficiency")["Hopper-v5"]
    assert row == ["5.00", "12.5", "+150.0", "6.00", "1 of 1", "200", "1 of 1", "100"]


def test_table_2(tmp_path, make_report):
    """The three schedules at K = 4 beside the paper's means; a task with one schedule compares nothing."""
    for schedule, bests in {"average": [3, 5], "uniform": [1, 2], "inverse": [2]}.items():
        make_seeds(tmp_path, "Reacher-v5", bests, depth=4, schedule=schedule)
    make_seeds(tmp_path, "Reacher-v5", [9, 9], depth=2, schedule="uniform")
    make_seeds(tmp_path, "Swimmer-v5", [9, 9], depth=4)
    text = make_report(tmp_path)
    rows = table(text, "Table 2")
    assert rows["task"] == "average|uniform|inverse|paper: average|paper: uniform|paper: inverse|seeds".split("|")
    assert rows["Reacher-v5"] == "4.00 ± 1.41|1.50 ± 0.71|2.00|-3.0|-3.5|-3.3|2 / 2 / 1".split("|")
    assert "Swimmer-v5" not in rows
    assert "the uniform schedule, the inverse schedule: Ant-v5, HalfCheetah-v5," in section(text, "What is missing")


def test_depth(tmp_path, make_report):
    """Min-max over K by hand (Hopper 0, 1/2, 1, 1/2, Reacher 0, 1, 1, 0.8), and with the bounds of bounds.csv."""
    hopper, reacher = (1000, 2000, 3000, 2000), (-10, -5, -5, -6)
    for task, means in (("Hopper-v5", hopper), ("Reacher-v5", reacher)):
        for depth, centre in zip((1, 2, 4, 8), means):
            make_seeds(tmp_path, task, [centre - 1, centre + 1], depth=depth)
    make_seeds(tmp_path, "Swimmer-v5", [50], depth=4)  # lacks the other K
    make_seeds(tmp_path, "Swimmer-v5", [50], depth=1, schedule="uniform")  # another schedule
    text = make_report(tmp_path)
    rows = table(text, "Fig. 4")
    assert [rows[k][0] for k in "1248"] == ["0.00 ± 0.00", "0.75 ± 0.35", "1.00 ± 0.00", "0.65 ± 0.21"]
    assert [rows[k][1] for k in "1248"] == ["2"] * 4
    limits = {row["task"]: (float(row["random_return"]), float(row["reference_return"])) for row in BOUNDS}
    for row, *means in zip(read(tmp_path / "report/6M/depth_normalised.csv"), hopper, reacher):
        pairs = [(x, *limits[task]) for task, x in zip(("Hopper-v5", "Reacher-v5"), means)]
        scores = [(x - low) / (high - low) for x, low, high in pairs]
        assert float(row["fixed_bounds_mean"]) == pytest.approx(mean(scores))
        assert float(row["fixed_bounds_std"]) == pytest.approx(stdev(scores))
    assert rows["Reacher-v5"][:4] == ["-10.0 ± 1.4", "-5.00 ± 1.41", "-5.00 ± 1.41", "-6.00 ± 1.41"]
    assert "Left out, without finished runs of all these K: Swimmer-v5." in text
    assert (
        "K = 8: Ant-v5, HalfCheetah-v5, Walker2d-v5" in text
        and "2 of 5 seeds of RefinePPO K=8 average: Hopper-v5" in text
    )


def test_depths_that_are_not_there(tmp_path, make_report):
    """Two of the paper's four K make a figure of two; without a task that has all, there is no section."""
    make_seeds(tmp_path, "Hopper-v5", [1, 2], depth=2)
    make_seeds(tmp_path, "Hopper-v5", [3, 4], depth=4)
    make_seeds(tmp_path, "Other-v0", [3, 4], depth=2)
    make_seeds(tmp_path, "Other-v0", [3, 3], depth=4)  # without bounds
    text = make_report(tmp_path)
    rows = table(text, "Fig. 4")
    assert rows["2"] == ["0.50 ± 0.71", "2", rows["2"][2], "1"] and rows["4"][:2] == ["0.50 ± 0.71", "2"]
    assert "no bounds for Other-v0." in text
    make_seeds(tmp_path, "Ant-v5", [3], depth=1)
    make_seeds(tmp_path, "Ant-v5", [3], depth=8)
    assert "## Fig. 4" not in make_report(tmp_path)


def test_toy(tmp_path, make_report):
    """The first evaluation at or above -0.01; the median is over all seeds, never being later than any step."""
    curves = {1: [(10, -1), (20, -0.01), (30, -0.5)], 2: [(10, -1), (20, -0.02), (30, 0)], 3: [(10, -1), (20, -0.02)]}
    for seed, curve in curves.items():
        make_run(tmp_path, f"k4-{seed}", TOY, seed, depth=4, schedule="uniform", curve=curve, steps=50_000)
        make_run(tmp_path, f"ppo-{seed}", TOY, seed, curve=[(10, -1), (20, -0.02)], steps=50_000)
    text = make_report(tmp_path)
    rows = table(text, "Toy")
    assert rows["PPO"] == ["0 of 3", "never", "3"]
    assert rows["RefinePPO K=4 uniform"] == ["2 of 3", "30 (20 to never)", "3"]
    assert "# 50k steps" in text and "## Table 1" not in text and "## Fig. 2" not in text


def test_few_seeds(tmp_path, make_report):
    """IQM of 5 seeds: the middle three; 2, 2.5 and 3 of 3 pairs won; beside the best the last (one less) and late."""
    make_seeds(tmp_path, "Hopper-v5", [1000, 2000, 3000])
    make_seeds(tmp_path, "Hopper-v5", [2500, 3000, 3500], depth=4, late=None)
    make_seeds(tmp_path, "Ant-v5", [0, 100, 200, 300, 10_000])
    make_seeds(tmp_path, "Ant-v5", [0, 100, 200, 300, 10_000], depth=4)
    make_seeds(tmp_path, "Other-v0", [3])
    make_seeds(tmp_path, "Other-v0", [4], depth=4)
    text, out = make_report(tmp_path), tmp_path / "report/6M"
    rows = {row["task"]: row for row in read(out / "seeds.csv")}
    assert [float(rows["Ant-v5"][f"{method}_iqm_value"]) for method in ("ppo", "refineppo")] == [200, 200]
    assert float(rows["Ant-v5"]["p_improvement_value"]) == 0.5
    assert float(rows["Hopper-v5"]["p_improvement_value"]) == pytest.approx(7.5 / 9)
    assert 0 <= float(rows["Hopper-v5"]["p_improvement_low"]) < 7.5 / 9 < float(rows["Hopper-v5"]["p_improvement_high"])
    assert str(report.Estimate.iqm([np.array([3.0])])) == "3.00"  # no interval of one seed
    best, last, late = read(out / "aggregate.csv")
    assert float(best["p_improvement_value"]) == pytest.approx((7.5 / 9 + 0.5) / 2)
    assert best["tasks"] == last["tasks"] == "2" and late["tasks"] == "1"  # no episode ended in Hopper's last 10 %
    assert float(late["ppo_iqm_value"]) == pytest.approx((5 + 63.644) / (6000 + 63.644))
    row = read(out / "selection.csv")[1]
    assert (row["task"], row["ppo_best_mean"], row["ppo_last_mean"]) == ("Hopper-v5", "2000.0", "1999.0")
    assert row["ppo_last_10_percent_mean"] == "5.0" and row["refineppo_last_10_percent_mean"] == ""
    assert "no episode ended in the last 10 % of 3 seeds of RefinePPO K=4 average: Hopper-v5" in text
    assert "2/252 = 0.0079" in text and "Left out, without bounds: Other-v0." in text
    assert 2 / len([*itertools.combinations(range(10), 5)]) == pytest.approx(0.0079, abs=5e-5)


def test_improvement_against_action_dimension(tmp_path, make_report):
    """Dimensions 1, 3, 8, improvements 10 %, 30 %, 20 %: Spearman's rho is 1 - 6 (0 + 1 + 1) / (3 (9 - 1)) = 0.5."""
    for task, refined in (("Pendulum-v1", 110), ("Hopper-v5", 130), ("Ant-v5", 120)):
        make_seeds(tmp_path, task, [100])
        make_seeds(tmp_path, task, [refined], depth=4)
    assert "action dimension: here +0.50 (n = 3), the paper +0.50 (n = 3)." in make_report(tmp_path)


@pytest.mark.parametrize("improvement", [0.2, 6.0, 900.0])
def test_the_improvement_axis_has_ticks(improvement, monkeypatch):
    """Several different ones in view, also where all improvements are within 10 %."""
    figures = []
    monkeypatch.setattr(report.Report, "figure", lambda self, name, figure: figures.append(figure))
    rows = [{"task": "a", "dim.": 1, "improv. %": report.Percent(improvement), "paper: improv. %": 0.1}]
    report.action_dimension(report.Report("6M"), rows)
    (axis,) = figures[0].axes
    figures[0].canvas.draw()
    low, high = axis.get_xlim()
    shown = [label.get_text() for x, label in zip(axis.get_xticks(), axis.get_xticklabels()) if low <= x <= high]
    assert len(shown) == len({*shown}) >= 4


def test_the_baseline_beside_cleanrls(tmp_path, make_report):
    """The last 10 % of training, at 1M steps only."""
    make_seeds(tmp_path, "Hopper-v5", [1, 1], steps=10**6, late=2000.0)
    make_seeds(tmp_path, "Hopper-v5", [1, 1], prefix="6M-", late=9.0)
    text = make_report(tmp_path)
    assert text.count("Is the baseline a good PPO?") == 1
    assert table(text, "Is the baseline")["Hopper-v5"] == ["2000 ± 0", "2383 ± 272", "2"]


def test_another_depth_stands_for_refineppo(tmp_path, make_report):
    """--depth and --schedule; where a task has no such run, what most of its runs have, which Table 1 names."""
    make_seeds(tmp_path / "runs", "Hopper-v5", [100, 100])
    make_seeds(tmp_path / "runs", "Hopper-v5", [150, 150], depth=8, schedule="inverse")
    make_seeds(tmp_path / "runs", "Ant-v5", [100, 100])
    make_seeds(tmp_path / "runs", "Ant-v5", [170, 170], depth=2)
    make_seeds(tmp_path / "runs", "Ant-v5", [180, 180], depth=4)
    out = "--out-dir", tmp_path / "out"
    rows = table(make_report(tmp_path / "runs", *out), "Table 1")
    assert rows["task"][1] == "RefinePPO is"
    assert rows["Hopper-v5"][1:5] == ["RefinePPO K=8 inverse", "100 ± 0", "150 ± 0", "+50.0"]
    assert rows["Ant-v5"][1:5] == ["RefinePPO K=4 average", "100 ± 0", "180 ± 0", "+80.0"]
    text = make_report(tmp_path / "runs", *out, "--depth", 2)
    assert table(text, "Table 1")["Ant-v5"][4] == "+70.0"
    assert 'python "$(git rev-parse --show-toplevel)/sweeps/report.py" . --depth 2\n' in text


def test_controls(tmp_path, make_report):
    """K = 1 against PPO first; differences by hand, of several tasks of normalised returns; actors by their layers."""
    make_seeds(tmp_path, "Hopper-v5", [1000, 2000], late=None)
    make_seeds(tmp_path, "Hopper-v5", [1500, 2500], depth=1)
    make_seeds(tmp_path, "Hopper-v5", [4000, 5000], depth=4)
    make_seeds(tmp_path, "Hopper-v5", [3000, 1000], prefix="w", actor_hidden=[256, 256])
    make_seeds(tmp_path, "Ant-v5", [0, 100])
    make_seeds(tmp_path, "Ant-v5", [100, 200], depth=1)
    make_seeds(tmp_path, "Ant-v5", [0, 0], prefix="w", actor_hidden=[216, 216])
    make_seeds(tmp_path, "Swimmer-v5", [0, 100])  # no control
    make_seeds(tmp_path, "Swimmer-v5", [0, 100], depth=4)
    text, out = make_report(tmp_path), tmp_path / "report/6M"
    rows, wide = read(out / "controls_differences.csv"), "PPO 216x216 / PPO 256x256"
    assert [*dict.fromkeys(row["difference"] for row in rows)] == [
        "RefinePPO K=1 average - PPO",
        "RefinePPO K=4 average - PPO",
        f"{wide} - PPO",
        "RefinePPO K=4 average - RefinePPO K=1 average",
        f"RefinePPO K=4 average - {wide}",
    ]
    assert [row["task"] for row in rows[:3]] == ["Ant-v5", "Hopper-v5", "2 tasks, normalised"]
    assert [float(row["best_difference_value"]) for row in rows[:2]] == [100, 500]
    sizes = {row["task"]: float(row["reference_return"]) - float(row["random_return"]) for row in BOUNDS}
    both = mean([100 / sizes["Ant-v5"], 500 / sizes["Hopper-v5"]])
    assert float(rows[2]["best_difference_value"]) == pytest.approx(both)
    assert float(rows[2]["best_difference_low"]) < both < float(rows[2]["best_difference_high"])
    assert [float(row["best_p_higher_value"]) for row in rows[:3]] == [0.875, 0.75, 0.8125]
    assert float(rows[1]["last_difference_value"]) == 500
    assert rows[1]["last_10_percent_difference_value"] == "" == rows[2]["last_10_percent_difference_value"]
    cells = {(row["task"], row["method"]): row for row in read(out / "controls.csv")}
    assert {task for task, _ in cells} == {"Ant-v5", "Hopper-v5"}
    assert cells["Ant-v5", wide]["best_mean"] == "0.0" and cells["Hopper-v5", wide]["last_mean"] == "1999.0"
    assert table(text, "Table 1")["Hopper-v5"][1] == "1500 ± 707" and "what so\nfew seeds call noise" in text


@pytest.mark.parametrize("hidden", [(128, 128), (256, 256), (128,) * 5], ids=str)
def test_parameters_of_an_actor(hidden, script):
    """Against the script's own."""
    observations, actions = gym.spaces.Box(-1, 1, (17,)), gym.spaces.Box(-1, 1, (6,))
    agent = script.Agent(observations, actions, script.Args(actor_hidden=hidden))
    size = sum(weight.size + bias.size for weight, bias in script.layers(agent.arrays(), "actor"))
    method = "RefinePPO" if "refine" in script.__name__ else "PPO"
    row = SimpleNamespace(actor="x".join(map(str, hidden)), method=method, depth=4)
    assert report.actor_cost(row, 17, 6)["parameters"] == size


def test_multiplications_of_an_actor():
    """Three observations, layers of 8 and 4, two actions: the observation is read once, and m_0 = 0 not at all."""
    for method, depth, by_hand in (
        ("PPO", np.nan, 3 * 8 + 8 * 4 + 4 * 2),
        ("RefinePPO", 1, 3 * 8 + 8 * 4 + 4 * 2),
        ("RefinePPO", 2, 3 * 8 + 8 * 4 + 4 * 2 + 2 * 8 + 8 * 4 + 4 * 2),
    ):
        row = SimpleNamespace(actor="8x4", method=method, depth=depth)
        assert report.actor_cost(row, 3, 2)["multiplications"] == by_hand


def test_learning_rates(tmp_path, make_report):
    """Each method at a third and three times the task's learning rate, compared at the same one."""
    for (depth, schedule), shift in {(None, "average"): 0, (4, "average"): 10, (4, "uniform"): 30}.items():
        for i, rate in enumerate((6e-4, 2e-4, 18e-4)):
            bests = [shift + i, shift + i + 2] if i == 0 else [shift + i]
            flags = {"prefix": f"{i}-", "num_envs": 4, "learning_rate": rate}
            make_seeds(tmp_path, "Swimmer-v5", bests, depth, schedule, **flags)
    text = make_report(tmp_path)
    rows = {row["method"]: row["best_mean"] for row in read(tmp_path / "report/6M/learning_rates.csv")}
    assert rows["PPO, lr x 1/3"] == "1.0" and rows["PPO, lr x 3"] == "2.0" and rows["PPO, lr x 1"] == "1.0"
    assert rows["RefinePPO K=4 uniform, lr x 3"] == "32.0"
    differences = {row["difference"]: row for row in read(tmp_path / "report/6M/learning_rates_differences.csv")}
    for rate in ("1/3", "1", "3"):
        pair = f"RefinePPO K=4 average, lr x {rate} - PPO, lr x {rate}"
        assert float(differences[pair]["best_difference_value"]) == 10 and len(differences) == 9
    assert "## Other variants" not in text and table(text, "Table 1")["Swimmer-v5"][1:3] == [
        "1.00 ± 1.41",
        "11.0 ± 1.4",
    ]
    assert "1 of 5 seeds of PPO lr 2e-4: Swimmer-v5" in text and "1 of 5 seeds of PPO lr 1.8e-3: Swimmer-v5" in text
    assert "All runs have `learning-rate 0.0006`, `num-envs 4`." in text


def test_what_it_cost(tmp_path, make_report):
    make_seeds(tmp_path, "Hopper-v5", [1, 2])
    make_report(tmp_path)
    (row,) = read(tmp_path / "report/6M/cost.csv")
    assert (row["method"], row["runs"]) == ("PPO", "2") and float(row["hours"]) == pytest.approx(2 / 3600)


# --- The two tables ---------------------------------------------------------------------------------------------------


def test_a_row_of_each_table(tmp_path, make_report):
    """All that is written of a run; flags that say nothing about its numbers are left out, and only they."""
    flags = {"gamma": 0.999, "anneal_lr": False, "critic_hidden": [32, 16], "save_every": 5, "progress": False}
    make_run(tmp_path, "a run", "Hopper-v5", 3, 0.1 + 0.2, depth=2, schedule="inverse", compile=False, **flags)
    make_report(tmp_path)
    header, row = (tmp_path / "report/runs.csv").read_text().splitlines()
    assert header == (
        "run,failure,task,method,depth,schedule,actor,flags,seed,steps,best_selection_return,best_global_step,"
        "best_mean,best_std,best_returns,last_global_step,last_mean,last_std,last_returns,train_return_last10pct,"
        "sps,wall_time_s,git_commit,versions,cpu,gpu"
    )
    assert row == (
        "a run,,Hopper-v5,RefinePPO,2,inverse,128x128,--no-anneal-lr --no-compile --critic-hidden 32 16 --gamma 0.999,"
        "3,6000000,0.30000000000000004,200,0.30000000000000004,1.0,0.30000000000000004,200,-0.7,1.0,-0.7,5.0,1.0,1.0,,"
        '"torch 2, numpy 3",x,'
    )
    header, row, _ = (tmp_path / "report/evaluations.csv").read_text().splitlines()
    assert header == "run,global_step,return_mean,return_std,return_min,return_max,length_mean"
    assert row == "a run,100,0.0,1.0,-1.0,1.0,50.0"


@pytest.mark.slow
def test_the_tables_alone_make_the_same_report(whole):
    """Byte for byte: from runs.csv, and in its own folder mixed with the folders of half the runs, in another order."""
    for folder in sorted((whole / "runs").iterdir())[::2]:
        if (folder / "config.json").exists():
            shutil.copytree(folder, whole / "half" / folder.name)
    first = files_of(whole / "runs/report")
    for sources in (["runs/report/runs.csv"], ["half", "second", "runs/failed"]):
        done = run("sweeps/report.py", *sources, "--out-dir", "second", cwd=whole)
        assert done.returncode == 0, done.stderr
        assert files_of(whole / "second") == first
    assert len(first) > 20


def test_the_same_run_with_other_numbers(tmp_path, make_report, capsys):
    """An error that names both places, whichever table and source it is in; nothing is written."""
    make_run(tmp_path / "a", "x", "Hopper-v5", 1, 5)
    make_report(tmp_path / "a")
    make_run(tmp_path / "b", "x", "Hopper-v5", 1, 6)
    make_run(tmp_path / "c", "x", "Hopper-v5", 1, 5, curve=[(100, 0.0), (200, 2.0)])
    for first, second, what in (("a", "b", "best_selection_return"), ("a/report", "c", "evaluation")):
        with pytest.raises(SystemExit):
            make_report(tmp_path / first, tmp_path / second, "--out-dir", tmp_path / "out")
        said = capsys.readouterr().err
        assert f"the run x has another {what} in {tmp_path / second}/x than in {tmp_path / first}/" in said
    assert not (tmp_path / "out").exists()


def test_failed_runs_are_listed(tmp_path, make_report):
    """With what was not finite, where and when; in no table of returns, but in runs.csv."""
    make_seeds(tmp_path, "Hopper-v5", [10, 20])
    facts = {"what": "a reward", "global_step": 4096, "env": 1, "reward": "nan", "mujoco_warnings": []}
    make_run(tmp_path, "failed", "Hopper-v5", 3, failure=facts)
    (make_run(tmp_path, "at once", "Hopper-v5", 4, failure=facts) / "evaluations.csv").unlink()
    text = make_report(tmp_path)
    assert "- `failed`: a reward, global_step 4096, env 1\n" in text
    assert table(text, "Table 1")["Hopper-v5"][1] == "15.0 ± 7.1" and "2 of 5 seeds of PPO: Hopper-v5" in text
    assert [row["run"] for row in read(tmp_path / "report/runs.csv") if row["failure"]] == ["failed", "at once"]


def test_what_cannot_be_read_is_named(tmp_path, make_report, capsys):
    """One line each, beside what is not finished and searches; the rest counts."""
    make_seeds(tmp_path, "Hopper-v5", [10, 20])
    (make_run(tmp_path, "deep/er/torn", "Hopper-v5", 3) / "result.json").write_text("{")
    (make_run(tmp_path, "no config", "Hopper-v5", 3) / "config.json").unlink()
    (make_run(tmp_path, "foreign", "Hopper-v5", 3) / "config.json").write_text('{"model_type": "bert"}')
    (make_run(tmp_path, "other columns", "Hopper-v5", 3) / "evaluations.csv").write_text("a,b\n1,2\n")
    make_run(tmp_path, "going", "Hopper-v5", 4, failure={})
    make_run(tmp_path / "tune/study/trial_0", "seed_1001", "Hopper-v5", 1001)
    (tmp_path / "tune/study/trials.csv").touch()
    (tmp_path / "notes").mkdir()
    assert table(make_report(tmp_path), "Table 1")["Hopper-v5"][1] == "15.0 ± 7.1"
    said = capsys.readouterr().out.splitlines()
    for name, reason in {
        "deep/er/torn": "JSONDecodeError",
        "no config": "FileNotFoundError",
        "foreign": "KeyError: 'args'",
        "other columns": "ValueError: .*evaluations.csv has no column global_step",
    }.items():
        assert len([line for line in said if re.match(f"cannot read {tmp_path / name}: {reason}", line)]) == 1
    assert f"left out, not finished: {tmp_path}/going" in said
    assert f"left out: {tmp_path}/tune/study, a search by tune.py" in said
    assert len(said) == 7 and said[-1].startswith("2 runs; the report is in ")


def test_another_number_of_steps_is_another_experiment(tmp_path, make_report):
    """Tables and curves of its own, the one with most runs first, in a folder that is named after it."""
    make_seeds(tmp_path, "Hopper-v5", [1, 3, 5], steps=1_000_000)
    make_seeds(tmp_path, "Hopper-v5", [10, 30], prefix="6M-")
    make_seeds(tmp_path, "Hopper-v5", [7], prefix="short-", steps=8192)
    text = make_report(tmp_path)
    assert re.findall("^# (.*) steps$", text, re.MULTILINE) == ["1M", "6M", "8192"]
    means = [read(tmp_path / f"report/{name}/table1.csv")[0]["ppo_mean"] for name in ("1M", "6M", "8192")]
    assert means == ["3.0", "20.0", "7.0"] and text.count("## Fig. 2") == 3


def test_variants(tmp_path, make_report):
    """The settings are the flags that most runs of a task and method have; a variant's name says what differs."""
    make_seeds(tmp_path, "Hopper-v5", [10, 20], gamma=0.9, eval_interval=50_000)
    make_seeds(tmp_path, "Hopper-v5", [1, 2], prefix="d", eval_interval=50_000)
    make_seeds(tmp_path, "Hopper-v5", [5], prefix="more", gamma=0.9, eval_interval=50_000, actor_hidden=[64, 64])
    make_run(tmp_path, "third", "Hopper-v5", 3, 30, gamma=0.9, eval_interval=50_000, compile=False, num_threads=2)
    make_seeds(tmp_path, "Hopper-v5", [40, 50], depth=4, eval_interval=50_000, anneal_lr=False)
    make_seeds(tmp_path, "Ant-v5", [1, 2], eval_interval=50_000, depth=4)
    make_run(tmp_path, "search", "Ant-v5", 1001, 9, eval_interval=50_000, depth=4)
    text = make_report(tmp_path)
    assert table(text, "Table 1")["Hopper-v5"][1:3] == ["20.0 ± 10.0", "45.0 ± 7.1"]  # --no-compile is of the machine
    assert "All runs have `eval-interval 50000`." in text
    assert "settings are those of\nboth, but not on Hopper-v5." in text
    assert [(row["task"], row["method"], row["flags"]) for row in read(tmp_path / "report/6M/settings.csv")] == [
        ("Hopper-v5", "PPO", "gamma 0.9"),
        ("Hopper-v5", "RefinePPO", "no-anneal-lr"),
    ]
    rows = {row["method"]: row["best_mean"] for row in read(tmp_path / "report/6M/variants.csv")}
    refined = {"RefinePPO K=4 average": "1.5", "RefinePPO K=4 average seeds from 1001 on": "9.0"}
    assert rows == {"PPO": "20.0", "PPO default gamma": "1.5", **refined}
    assert "PPO 64x64 - PPO" in table(text, "Controls")


def test_the_fewest_flags_are_the_settings_where_counts_are_equal(tmp_path, make_report):
    make_seeds(tmp_path, "Hopper-v5", [10, 20], gamma=0.9)
    make_seeds(tmp_path, "Hopper-v5", [1, 2], prefix="d")
    text = make_report(tmp_path)
    assert table(text, "Table 1")["Hopper-v5"][1] == "1.50 ± 0.71" and "PPO gamma 0.9 - PPO" in text


def test_a_failed_run_counts_for_the_settings(tmp_path, make_report):
    """Of two PPO runs one has failed; two of another actor do not become PPO."""
    make_seeds(tmp_path, "Hopper-v5", [10])
    make_run(tmp_path, "failed", "Hopper-v5", 2, failure={"what": "a loss"})
    make_seeds(tmp_path, "Hopper-v5", [1, 2], prefix="w", actor_hidden=[256, 256])
    text = make_report(tmp_path)
    assert table(text, "Table 1")["Hopper-v5"][1] == "10.0" and "PPO 256x256" in text


def test_new_runs_beside_the_tables_are_read(tmp_path, make_report):
    """A report may lie in the folder of its runs, which go on."""
    make_seeds(tmp_path, "Hopper-v5", [10, 20])
    make_report(tmp_path, "--out-dir", tmp_path)
    make_run(tmp_path, "third", "Hopper-v5", 3, 30)
    make_report(tmp_path)
    assert len(read(tmp_path / "runs.csv")) == 3


def test_a_seed_counts_once(tmp_path, make_report):
    """The first by name; another folder with the same seed of the same cell is named."""
    make_seeds(tmp_path, "Hopper-v5", [10, 20])
    make_run(tmp_path, "x", "Hopper-v5", 2, 999)
    text = make_report(tmp_path)
    assert table(text, "Table 1")["Hopper-v5"][1] == "15.0 ± 7.1"
    assert "- `x`: seed 2 again, beside `Hopper-v5-None-average-2`\n" in text


def test_links(tmp_path, make_report):
    """Linked runs count, once each; a loop of links ends."""
    make_seeds(tmp_path / "elsewhere", "Hopper-v5", [10, 20])
    runs = tmp_path / "runs"
    runs.mkdir()
    (runs / "one").symlink_to(tmp_path / "elsewhere")
    (runs / "two").symlink_to(tmp_path / "elsewhere")
    (runs / "loop").symlink_to(runs)
    (tmp_path / "elsewhere/up").symlink_to(tmp_path)
    text = make_report(runs)
    assert table(text, "Table 1")["Hopper-v5"][1] == "15.0 ± 7.1" and "seed 1 again" not in text


def test_the_scripts_defaults_are_no_flags(tmp_path, script, make_report):
    """Every default of both scripts, as they write them into config.json."""
    args = json.loads(json.dumps(vars(script.Args())))
    own = {"seed", "total_timesteps", "refinement_depth", "refinement_schedule", "env_id"}  # arguments of make_run
    refinement = {"depth": args.get("refinement_depth"), "schedule": args.get("refinement_schedule")}
    make_run(tmp_path, "x", "Hopper-v5", 1, **refinement, **{name: args[name] for name in args.keys() - own})
    make_report(tmp_path)
    assert read(tmp_path / "report/runs.csv")[0]["flags"] == ""


# --- Statistics against plain loops -----------------------------------------------------------------------------------


def plain_iqm(scores) -> float:
    cut = int(0.25 * len(scores))
    return mean(sorted(scores)[cut : len(scores) - cut])


def plain_quantile(values, q) -> float:
    values, position = sorted(values), q * (len(values) - 1)
    low = int(position)
    high = min(low + 1, len(values) - 1)
    return values[low] + (position - low) * (values[high] - values[low])


def plain_probability(xs, ys) -> float:
    return mean(1 if x > y else 0.5 if x == y else 0 for x in xs for y in ys)


@pytest.fixture
def strata():
    rng = np.random.default_rng(3)
    return [rng.normal(i, 1 + i, n).round(1) for i, n in enumerate((5, 3, 8, 1))]


@pytest.mark.parametrize("n", range(1, 13))
def test_iqm(n):
    scores = np.random.default_rng(n).normal(size=(2, n))
    assert report.iqm(scores) == pytest.approx([*map(plain_iqm, scores)])


def test_bootstrap_of_the_iqm(strata, monkeypatch):
    """Resampled within each task, all tasks' scores trimmed together, quantiles of 2.5 and 97.5 %."""
    monkeypatch.setattr(report, "RESAMPLES", 300)
    rng = np.random.default_rng(0)
    draws = [rng.integers(len(scores), size=(300, len(scores))) for scores in strata]
    values = [plain_iqm([scores[j] for scores, draw in zip(strata, draws) for j in draw[i]]) for i in range(300)]
    value, low, high = report.Estimate.iqm(strata)
    assert value == pytest.approx(plain_iqm(np.concatenate(strata)))
    assert (low, high) == pytest.approx([plain_quantile(values, q) for q in (0.025, 0.975)])


@pytest.mark.slow
def test_bootstrap_agrees_with_scipy(strata):
    scores = strata[2]
    options = {"method": "percentile", "n_resamples": 20_000, "rng": 1}
    other = scipy.stats.bootstrap((scores,), report.iqm, **options).confidence_interval
    _, low, high = report.Estimate.iqm([scores])
    assert (low, high) == pytest.approx((other.low, other.high), abs=0.1 * scores.std())


def test_probability_of_improvement(strata, monkeypatch):
    monkeypatch.setattr(report, "RESAMPLES", 300)
    others = [scores[:3].round() for scores in strata]
    value, low, high = report.Estimate.pair(report.probability, strata, others)
    assert value == pytest.approx(mean(map(plain_probability, strata, others)))
    resampled = [
        [plain_probability(x[i], y[i]) for i in range(300)]
        for x, y in zip(report.resample(strata, 1), report.resample(others, 2))
    ]
    means = [mean(of_tasks) for of_tasks in zip(*resampled)]
    assert (low, high) == pytest.approx([plain_quantile(means, q) for q in (0.025, 0.975)])


def test_the_mean_curve_is_of_the_seeds_that_were_evaluated_there():
    curves = [np.array([[1, 10.0], [2, 20]]), np.array([[1, 30.0], [2, 40], [3, 70]])]
    band = report.mean_curve(curves)
    assert band.index.tolist() == [1, 2, 3] and band["mean"].tolist() == [20, 30, 70]
    assert band["std"].tolist() == pytest.approx([stdev([10, 30]), stdev([20, 40]), 0])


@pytest.mark.slow
@pytest.mark.parametrize("seeds, said", [(2, 0.50), (3, 0.75), (5, 0.90)])
def test_how_often_an_interval_holds_the_truth(seeds, said, monkeypatch):
    """The report says so of one task's returns, where they are normal."""
    monkeypatch.setattr(report, "RESAMPLES", 500)
    samples = np.random.default_rng(0).standard_normal((600, seeds))
    held = [low <= 0 <= high for _, low, high in (report.Estimate.iqm([sample]) for sample in samples)]
    assert np.mean(held) == pytest.approx(said, abs=0.06)


def test_resampling_stays_within_a_task(strata):
    for scores, drawn in zip(strata, report.resample(strata, 0)):
        assert drawn.shape == (report.RESAMPLES, len(scores)) and set(drawn.ravel()) <= {*scores}
        assert drawn.mean() == pytest.approx(scores.mean(), abs=0.05 * (scores.std() or 1))


# --- Files ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Runs for every section (schedules, depths, controls, learning rates, variants, the toy), and their report."""
    root = tmp_path_factory.mktemp("whole")
    rng = np.random.default_rng(0)
    tasks, flags = ("Hopper-v5", "Ant-v5", TOY), [{}, {"actor_hidden": [256, 256]}, {"gamma": 0.9}]
    methods = [(None, "average", more) for more in (*flags, {"learning_rate": 1e-4})]
    methods += [(depth, schedule, {}) for depth, schedule in ((1, "average"), (4, "uniform"), (4, "inverse"))]
    methods += [(4, "average", {}), (4, "average", {"learning_rate": 1e-4})]
    for task, (i, (depth, schedule, more)), seed in itertools.product(tasks, enumerate(methods), (1, 2)):
        curve = [(100 * step, float(rng.normal(10 * step, 5))) for step in range(1, 6)]
        more = more | {"depth": depth, "schedule": schedule, "steps": 10**6}
        make_run(root / "runs", f"{task}-{i}-{seed}", task, seed, rng.normal(50, 5), curve, **more)
    make_run(root / "runs", "failed", "Ant-v5", 9, failure={"what": "a loss", "global_step": 7})
    done = run("sweeps/report.py", "runs", cwd=root)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "55 runs; the report is in runs/report/report.md\n"
    return root


def assert_shows_something(path: Path):
    """The picture opens, and neither is of one colour nor a dot on an empty page; its paper is white."""
    pixels = matplotlib.image.imread(path)
    assert min(pixels.shape[:2]) > 200 and (pixels[0, 0] == 1).all()
    assert (pixels[..., :3].min(-1) < 0.9).mean() > 0.01
    assert len(np.unique(pixels[..., :3].reshape(-1, 3), axis=0)) > 20


@pytest.mark.slow
def test_every_file_of_a_report(whole):
    """Markdown, CSV and LaTeX of each table, PNG and PDF of each figure, all linked."""
    out = whole / "runs/report"
    files, text = files_of(out).keys(), (out / "report.md").read_text()
    assert {*re.findall(r"\]\(([\w./]+)\)", text)} == files - {"report.md"}
    assert not re.search(r"\b(nan|inf|None)\b", text)
    tables = {Path(name).stem for name in files if name.endswith(".tex")}
    assert tables == {Path(name).stem for name in files if name.startswith("1M/") and name.endswith(".csv")}
    expected = "table1 table2 depth depth_normalised sample_efficiency seeds aggregate selection baseline toy cost"
    expected += " controls controls_differences learning_rates learning_rates_differences variants variants_differences"
    assert tables == {*expected.split()}
    figures = {Path(name).stem for name in files if name.endswith(".png")}
    expected = "training_curves training_curves_all depth seeds action_dimension controls learning_rates variants"
    assert figures == {*expected.split()} == {Path(name).stem for name in files if name.endswith(".pdf")}
    for name in figures:
        assert_shows_something(out / f"1M/{name}.png")
        pdf = (out / f"1M/{name}.pdf").read_bytes()
        assert pdf.startswith(b"%PDF") and b"/CIDFontType2" in pdf and b"/Type3" not in pdf  # IEEE refuses Type 3
    markdown = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    for name, lines in zip(re.findall(r"\[(\w+)\.csv\]\(1M", text), markdown):
        columns = lines[0].count("|") - 1
        assert {line.count("|") - 1 for line in lines} == {columns}
        assert len(read(out / f"1M/{name}.csv")) == len(lines) - 2
        tex = (out / f"1M/{name}.tex").read_text().splitlines()
        assert tex[1] == rf"\begin{{tabular}}{{l{'r' * (columns - 1)}}}" and tex[-1] == r"\end{tabular}"
        rows = [line for line in tex if line.endswith(r" \\")]
        assert len(rows) == len(lines) - 1 and {len(re.split(r"(?<!\\)&", row)) for row in rows} == {columns}
        assert not re.search(r"(?<!\\)[%_#]|±", "\n".join(rows))


def test_latex_escapes():
    frame = pd.DataFrame({"50 % of a_b & c#1": ["-1.5 ± 2 [-3, 4]", "Ant-v5"]})
    text = report.latex(frame)
    assert r"50 \% of a\_b \& c\#1 \\" in text and r"$-$1.5 $\pm$ 2 [$-$3, 4] \\" in text and r"Ant-v5 \\" in text


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(whole, tmp_path):
    inputs = "".join(rf"\input{{{path}}}\par " for path in whole.rglob("*.tex"))
    document = rf"\documentclass{{article}}\usepackage{{booktabs}}\begin{{document}}{inputs}\end{{document}}"
    (tmp_path / "all.tex").write_text(document)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "all.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_what_an_earlier_report_left_is_removed(tmp_path, make_report):
    """A table that this report has not; other people's files stay."""
    out = "--out-dir", tmp_path / "out"
    make_run(tmp_path / "more", "toy", TOY, 1)
    make_seeds(tmp_path / "runs", "Hopper-v5", [1, 2, 3])
    make_report(tmp_path / "runs", tmp_path / "more", *out)
    (tmp_path / "out/notes.md").write_text("mine")
    (tmp_path / "out/6M/.DS_Store").write_text("x")
    assert (tmp_path / "out/6M/toy.csv").exists()
    (tmp_path / "out/runs.csv").unlink()
    (tmp_path / "out/evaluations.csv").unlink()
    make_report(tmp_path / "runs", *out)
    assert not (tmp_path / "out/6M/toy.csv").exists() and (tmp_path / "out/6M/table1.csv").exists()
    assert (tmp_path / "out/notes.md").read_text() == "mine"


def test_chosen_curves(tmp_path, make_report, monkeypatch):
    """The paper's six tasks by default, else the first six that are there, or those that were asked for."""
    for i in range(8):
        make_seeds(tmp_path, f"Task{i}-v0", [1])
    drawn, draw = [], report.curves_figure
    monkeypatch.setattr(report, "curves_figure", lambda curves: drawn.append([*curves]) or draw(curves))
    assert "There is no run of HalfCheetah-v5, Pusher-v5," in make_report(tmp_path)
    make_report(tmp_path, "--curve-tasks", "Task7-v0", "Task2-v0")
    tasks = [f"Task{i}-v0" for i in range(8)]
    assert drawn == [tasks[:6], tasks, ["Task7-v0", "Task2-v0"], tasks]


# --- Bad input --------------------------------------------------------------------------------------------------------


BAD_INPUT = {
    "missing": ("nothing", "there is no nothing"),
    "no source": ("--depth 2", "name run folders or a runs.csv"),
    "empty table": ("empty/runs.csv", "has no column run"),
    "another table": ("runs other", "has no column failure"),
    "no runs": ("mine", "there is no finished run in mine"),
    "only torn runs": ("torn", "cannot read torn: JSONDecodeError"),
    "depth": ("runs --depth 0", "--depth must be at least 1"),
    "foreign report": ("runs --out-dir mine", "mine/report.md was made by no report"),
    "foreign table": ("runs --out-dir foreign", "foreign/6M/table1.tex was made by no report"),
    "a run's folder": ("runs --out-dir runs/one", "runs/one/evaluations.csv was made by no report"),
    "runs that would be lost": ("runs --out-dir earlier", "earlier has runs that no source has (two)"),
    "out-dir a file": ("runs --out-dir mine/report.md", "cannot write to"),
    "out-dir below a file": ("runs --out-dir mine/report.md/x", "cannot write to"),
    "out-dir not writable": ("runs --out-dir /proc/no/such", "cannot write to"),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_refused(case, tmp_path, make_report, capsys, monkeypatch):
    """One sentence, exit 2, and nothing is written or changed."""
    for name, content in {
        "empty/runs.csv": "",
        "other/runs.csv": "run,task\n",
        "mine/report.md": "mine",
        "torn/config.json": "{",
        "torn/result.json": "{}",
        "foreign/6M/table1.tex": "",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    make_run(tmp_path / "more", "two", "Hopper-v5", 2)
    make_report(tmp_path / "more", "--out-dir", tmp_path / "earlier")
    make_run(tmp_path / "runs", "one", "Hopper-v5", 1)
    monkeypatch.chdir(tmp_path)
    before, (flags, expected) = files_of(tmp_path), BAD_INPUT[case]
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit:
        make_report(*flags.split())
    assert exit.value.code == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("report.py: error: ") and printed.err.count("\n") == 1 and expected in printed.err
    assert printed.out == "" and files_of(tmp_path) == before
