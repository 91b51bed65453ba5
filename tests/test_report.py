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

import gymnasium as gym
import matplotlib.image
import numpy as np
import pytest
import scipy.stats
from conftest import ROOT, run

from sweeps import bounds, report

TOY = "sweeps.toy_env:Coordination-v0"


def make_run(root: Path, name: str, task: str, seed: int, best=0.0, curve=((100, 0.0), (200, 1.0)), depth=None,
             schedule="average", finished=True, steps=6_000_000, result=None, late=5.0, **flags) -> Path:  # fmt: skip
    """A run folder with the fields of the training scripts that matter here, and others beside them."""
    folder = root / name
    folder.mkdir(parents=True)
    refinement = {} if depth is None else {"refinement_depth": depth, "refinement_schedule": schedule}
    args = {"env_id": task, "seed": seed, "total_timesteps": steps, "run_dir": name, "resume": True,
            "learning_rate": 3e-4, "actor_hidden": [128, 128], "eval_interval": 100_000}  # fmt: skip
    config = {"args": args | refinement | flags, "versions": {"torch": "2"}, "git_commit": None, "cpu": "x"}
    (folder / "config.json").write_text(json.dumps(config))
    lines = [f"{step},{value},1.0,{value - 1},{value + 1},50.0" for step, value in curve]
    header = "global_step,return_mean,return_std,return_min,return_max,length_mean"
    (folder / "evaluations.csv").write_text("\n".join([header, *lines]) + "\n")
    (folder / "last.pt").write_bytes(b"")
    if finished:
        whole = {"env_id": task, "exp_name": "x", "seed": seed, "total_timesteps": steps, "refinement_depth": depth,
                 "refinement_schedule": None if depth is None else schedule,
                 "best": {"global_step": 200, "selection_return": best, "returns": [best], "mean": best, "std": 1.0},
                 "last": {"global_step": 200, "returns": [best - 1], "mean": best - 1, "std": 1.0}, "std_ddof": 1,
                 "train_return_last10pct": late, "wall_time_s": 1.0, "sps": 1.0}  # fmt: skip
        (folder / "result.json").write_text(json.dumps(whole | (result or {})))
    return folder


def make_seeds(root: Path, task: str, bests: list[float], depth=None, schedule="average", **more):
    for seed, best in enumerate(bests, start=1):
        make_run(root, f"{task}-{depth}-{schedule}-{seed}", task, seed, best, depth=depth, schedule=schedule, **more)


def make_settings(root: Path, algorithm: str, task: str, text: str) -> Path:
    """A settings folder with one more file."""
    file = root / "settings" / algorithm / f"{task}.args"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return root / "settings"


@pytest.fixture(autouse=True)
def no_settings(monkeypatch):
    """The scripts' defaults, whatever sweeps/settings holds and the shell sets."""
    monkeypatch.setenv("SETTINGS", "none")


@pytest.fixture
def make_report(monkeypatch):
    """`python sweeps/report.py FLAGS` in this process; returns report.md. Figures are drawn only if asked for."""

    def call(*flags, figures=False) -> str:
        with monkeypatch.context() as patch:
            if not figures:
                patch.setattr(report.Report, "figure", lambda self, name, _, caption: self.say(f"{name}: {caption}"))
            patch.setattr(sys, "argv", ["report.py", *map(str, flags)])
            report.main()
        out = Path(flags[flags.index("--out-dir") + 1]) if "--out-dir" in flags else flags[0] / "report"
        return (out / "report.md").read_text()

    return call


def section(text: str, header: str) -> str:
    return text[text.index(f"## {header}") :].split("\n\n## ")[0]


def table(text: str, header: str) -> dict[str, list[str]]:
    """First cell -> the others, of all rows in a section."""
    lines = [line for line in section(text, header).splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {first: cells for first, *cells in rows}


def read(path: Path) -> list[dict]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


# --- Tables by hand ---------------------------------------------------------------------------------------------------


def test_table_1(tmp_path, make_report):
    """Mean, std (ddof 1), improvement with |P|, the paper's own, seeds and steps; the task's order is the paper's."""
    make_seeds(tmp_path, "Pusher-v5", [-40, -50])
    make_seeds(tmp_path, "Pusher-v5", [-30, -45], depth=4)
    make_seeds(tmp_path, "Hopper-v5", [1000, 2000, 3000])
    make_seeds(tmp_path, "Hopper-v5", [2500, 3500], depth=4, steps=100_000)
    make_seeds(tmp_path, "Ant-v5", [100])
    make_seeds(tmp_path, "Other-v0", [1, 2])
    make_seeds(tmp_path, "Other-v0", [3, 3], depth=4)
    text = make_report(tmp_path)
    rows = table(text, "Table 1")
    assert [*rows] == ["task", "-", "Ant-v5", "Hopper-v5", "Pusher-v5", "Other-v0"]
    assert rows["task"] == ["dim.", "PPO", "RefinePPO", "improv. %", "paper: PPO", "paper: RefinePPO",
                            "paper: improv. %", "seeds", "steps"]  # fmt: skip
    assert rows["Hopper-v5"] == ["3", "2000 ± 1000", "3000 ± 707", "+50.0", "2720 ± 826", "3120 ± 287", "+14.7",
                                 "3 / 2", "6,000,000 / 100,000"]  # fmt: skip
    assert rows["Pusher-v5"] == ["7", "-45.0 ± 7.1", "-37.5 ± 10.6", "+16.7", "-44.0 ± 10", "-37 ± 9", "+15.9", "2",
                                 "6,000,000"]  # fmt: skip
    assert rows["Ant-v5"][1:4] == ["100", "-", "-"] and rows["Ant-v5"][-2:] == ["1 / 0", "6,000,000"]
    assert rows["Other-v0"] == ["-", "1.50 ± 0.71", "3.00 ± 0.00", "+100.0", "-", "-", "-", "2", "6,000,000"]
    hopper = next(row for row in read(tmp_path / "report/table1.csv") if row["task"] == "Hopper-v5")
    assert float(hopper["ppo_mean"]) == 2000 and float(hopper["ppo_std"]) == 1000
    assert float(hopper["refineppo_std"]) == pytest.approx(stdev([2500, 3500]))
    assert float(hopper["improv_percent"]) == 50 and hopper["paper_ppo_std"] == "826"
    missing = section(text, "What is missing")
    few = "Ant-v5: 1 of 5 seeds; Hopper-v5: 3 of 5 seeds; Pusher-v5: 2 of 5 seeds"
    assert f"- Table 1, PPO: {few}; no finished run of HalfCheetah-v5, Walker2d-v5, Swimmer-v5," in missing
    assert re.search("Table 1, RefinePPO: .*no finished run of Ant-v5, HalfCheetah-v5, Walker2d-v5", missing)


def test_sample_efficiency(tmp_path, make_report):
    """Areas: (500 + 1500) / 200, (0 + 2000) / 200, (2500 + 4000) / 200, (1000 + 2250) / 200; PPO's level 30."""
    curves = {(None, 1): (0, 10, 20), (None, 2): (0, 0, 40), (4, 1): (20, 30, 50), (4, 2): (0, 20, 25)}
    for (depth, seed), returns in curves.items():
        make_run(tmp_path, f"{depth}-{seed}", "Hopper-v5", seed, depth=depth, curve=[*zip((100, 200, 300), returns)])
    row = table(make_report(tmp_path), "Sample efficiency")["Hopper-v5"]
    assert row == ["10.0 ± 0.0", "24.4 ± 11.5", "+143.8", "30.0", "1 of 2", "never (300 to never)", "1 of 2",
                   "never (200 to never)"]  # fmt: skip
    (row,) = read(tmp_path / "report/sample_efficiency.csv")
    assert float(row["refineppo_mean_return_mean"]) == 24.375
    assert row["refineppo_median_step_range_median"] == "never"


def test_sample_efficiency_ends_at_the_last_step_of_all(tmp_path, make_report):
    """PPO stopped at 200: RefinePPO's area ends there too, (10 + 15) / 2, and its late return does not count."""
    make_run(tmp_path, "a", "Hopper-v5", 1, curve=[(100, 4), (200, 6)], steps=200)
    make_run(tmp_path, "b", "Hopper-v5", 1, depth=4, curve=[(100, 10), (300, 20), (400, 900)], steps=400)
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
    assert rows["task"] == ["average", "uniform", "inverse", "paper: average", "paper: uniform", "paper: inverse",
                            "seeds", "steps"]  # fmt: skip
    assert rows["Reacher-v5"] == ["4.00 ± 1.41", "1.50 ± 0.71", "2.00", "-3.0", "-3.5", "-3.3", "2 / 2 / 1",
                                  "6,000,000"]  # fmt: skip
    assert "Swimmer-v5" not in rows and "K = 4; the paper's is 4" in section(text, "Table 2")
    missing = section(text, "What is missing")
    names = "`Reacher-v5-2-uniform-1`, `Reacher-v5-2-uniform-2`"
    assert f"Finished runs in no table:\n\n- Reacher-v5, RefinePPO, K = 2, uniform: {names}.\n\n" in missing
    assert re.search("Table 2, inverse: Reacher-v5: 1 of 5 seeds; no finished run of Ant-v5, HalfCheetah-v5,", missing)


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
    for row, h, r in zip(read(tmp_path / "report/depth_normalised.csv"), hopper, reacher):
        scores = [(x - limits[task][0]) / (limits[task][1] - limits[task][0])
                  for task, x in (("Hopper-v5", h), ("Reacher-v5", r))]  # fmt: skip
        assert float(row["fixed_bounds_mean"]) == pytest.approx(mean(scores))
        assert float(row["fixed_bounds_std"]) == pytest.approx(stdev(scores))
    assert rows["Reacher-v5"][:4] == ["-10.0 ± 1.4", "-5.00 ± 1.41", "-5.00 ± 1.41", "-6.00 ± 1.41"]
    assert "Left out, without finished runs of all these K: Swimmer-v5." in text
    assert "Fig. 4, K = 8: Hopper-v5: 2 of 5 seeds; Reacher-v5: 2 of 5 seeds; no finished run of Ant-v5" in text


def test_depths_that_are_not_there(tmp_path, make_report):
    """Two of the paper's four K make a figure of two; no task with all of them says so."""
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
    assert "No task with finished runs of all depths, [1, 2, 4, 8]." in make_report(tmp_path)


def test_toy(tmp_path, make_report):
    """The first evaluation at or above -0.01; the median is over all seeds, never being later than any step."""
    curves = {1: [(10, -1), (20, -0.01), (30, -0.5)], 2: [(10, -1), (20, -0.02), (30, 0)], 3: [(10, -1), (20, -0.02)]}
    for seed, curve in curves.items():
        make_run(tmp_path, f"k4-{seed}", TOY, seed, depth=4, schedule="uniform", curve=curve)
        make_run(tmp_path, f"ppo-{seed}", TOY, seed, curve=[(10, -1), (20, -0.02)])
    make_run(tmp_path, "k4-4", TOY, 4, depth=4, schedule="uniform", curve=[(10, 0)], finished=False)
    text = make_report(tmp_path)
    rows = table(text, "Toy")
    assert rows["PPO"] == ["0 of 3", "never", "3", "6,000,000"]
    assert rows["RefinePPO, K = 4, uniform"] == ["2 of 3", "30 (20 to never)", "3", "6,000,000"]
    assert "No finished run of PPO or RefinePPO." in section(text, "Table 1")
    assert "Coordination" not in section(text, "Fig. 2")


def test_few_seeds(tmp_path, make_report):
    """IQM of 5 seeds: the middle three; 2, 2.5 and 3 of 3 pairs won; beside the best the last (one less) and late."""
    make_seeds(tmp_path, "Hopper-v5", [1000, 2000, 3000])
    make_seeds(tmp_path, "Hopper-v5", [2500, 3000, 3500], depth=4, late=None)
    make_seeds(tmp_path, "Ant-v5", [0, 100, 200, 300, 10_000])
    make_seeds(tmp_path, "Ant-v5", [0, 100, 200, 300, 10_000], depth=4)
    make_seeds(tmp_path, "Other-v0", [3])
    make_seeds(tmp_path, "Other-v0", [4], depth=4)
    text = make_report(tmp_path)
    rows = {row["task"]: row for row in read(tmp_path / "report/seeds.csv")}
    assert [float(rows["Ant-v5"][f"{method}_iqm_value"]) for method in ("ppo", "refineppo")] == [200, 200]
    assert float(rows["Ant-v5"]["p_improvement_value"]) == 0.5
    assert float(rows["Hopper-v5"]["p_improvement_value"]) == pytest.approx(7.5 / 9)
    assert 0 <= float(rows["Hopper-v5"]["p_improvement_low"]) < 7.5 / 9 < float(rows["Hopper-v5"]["p_improvement_high"])
    best, last, late = read(tmp_path / "report/aggregate.csv")
    assert float(best["p_improvement_value"]) == pytest.approx((7.5 / 9 + 0.5) / 2)
    assert best["tasks"] == last["tasks"] == "2" and late["tasks"] == "1"  # no episode ended in Hopper's last 10 %
    assert float(late["ppo_iqm_value"]) == pytest.approx((5 + 63.644) / (6000 + 63.644))
    row = read(tmp_path / "report/selection.csv")[1]
    assert (row["task"], row["ppo_best_mean"], row["ppo_last_mean"]) == ("Hopper-v5", "2000.0", "1999.0")
    assert row["ppo_last_10_percent_mean"] == "5.0" and row["refineppo_last_10_percent_mean"] == ""
    assert "2/252 = 0.0079" in text and "Left out, without bounds: Other-v0." in text
    assert 2 / len([*itertools.combinations(range(10), 5)]) == pytest.approx(0.0079, abs=5e-5)


def test_improvement_against_action_dimension(tmp_path, make_report):
    """Dimensions 1, 3, 8, improvements 10 %, 30 %, 20 %: Spearman's rho is 1 - 6 (0 + 1 + 1) / (3 (9 - 1)) = 0.5."""
    for task, refined in (("Pendulum-v1", 110), ("Hopper-v5", 130), ("Ant-v5", 120)):
        make_seeds(tmp_path, task, [100])
        make_seeds(tmp_path, task, [refined], depth=4)
    assert "action dimension: here +0.50 (n = 3), the paper +0.50 (n = 3)." in make_report(tmp_path)


def test_another_depth_stands_for_refineppo(tmp_path, make_report):
    """--depth and --schedule, and per task what its settings file asks for; a comment asks for nothing."""
    make_seeds(tmp_path / "runs", "Hopper-v5", [100, 100])
    make_seeds(tmp_path / "runs", "Hopper-v5", [150, 150], depth=8, schedule="inverse")
    make_seeds(tmp_path / "runs", "Ant-v5", [100, 100])
    make_seeds(tmp_path / "runs", "Ant-v5", [170, 170], depth=2)
    make_seeds(tmp_path / "runs", "Ant-v5", [180, 180], depth=4)
    out = "--out-dir", tmp_path / "out"
    rows = table(make_report(tmp_path / "runs", *out), "Table 1")
    assert [rows[task][3] for task in ("Hopper-v5", "Ant-v5")] == ["-", "+80.0"]
    rows = table(make_report(tmp_path / "runs", *out, "--depth", 2), "Table 1")
    assert [rows[task][3] for task in ("Hopper-v5", "Ant-v5")] == ["-", "+70.0"]
    settings = make_settings(tmp_path, "refineppo", "Hopper-v5", "--ent-coef 0.1 # --refinement-depth 3\n"
                             "--refinement-depth 8\n--refinement-schedule=inverse")  # fmt: skip
    rows = table(make_report(tmp_path / "runs", *out, "--settings", settings), "Table 1")
    assert rows["task"][1] == "RefinePPO is"
    assert rows["Hopper-v5"][1:5] == ["RefinePPO, K = 8, inverse", "100 ± 0", "150 ± 0", "+50.0"]
    assert rows["Ant-v5"][1:5] == ["RefinePPO, K = 4, average", "100 ± 0", "180 ± 0", "+80.0"]


def test_table_2_and_the_depth_figure_follow_the_settings(tmp_path, make_report):
    """Each task's depth in Table 2 and schedule in Fig. 4 are those of its settings file; "/" is "_" in its name."""
    runs, tasks = tmp_path / "runs", ("Hopper-v5", "my/Task-v0")
    depths, schedules = dict(zip(tasks, (4, 8))), dict(zip(tasks, ("average", "inverse")))
    for task, folder in zip(tasks, "ab"):
        for i, schedule in enumerate(("average", "uniform", "inverse")):
            make_run(runs, f"{folder}/{schedule}", task, 1, i, depth=depths[task], schedule=schedule)
        for depth in {1, 2, 4, 8} - {depths[task]}:
            make_run(runs, f"{folder}/{depth}", task, 1, 10 * depth, depth=depth, schedule=schedules[task])
    make_run(runs, "other", "my/Task-v0", 1, 999, depth=4, schedule="average")
    make_run(runs, "going", "my/Task-v0", 1, 999, depth=4, schedule="uniform", finished=False)
    settings = make_settings(tmp_path, "refineppo", "my_Task-v0", "--refinement-depth 8 --refinement-schedule inverse")
    text = make_report(runs, "--settings", settings)
    rows = table(text, "Table 2")
    assert rows["Hopper-v5"][:3] == ["0.00", "1.00", "2.00"] == rows["my/Task-v0"][:3]
    assert "K = 4 (Hopper-v5), 8 (my/Task-v0); the paper's is 4" in section(text, "Table 2")
    rows = table(text, "Fig. 4")
    assert rows["Hopper-v5"][:4] == ["10.0", "20.0", "0.00", "80.0"]
    assert rows["my/Task-v0"][:4] == ["10.0", "20.0", "40.0", "2.00"]
    assert "Schedule: average (Hopper-v5), inverse (my/Task-v0). " in section(text, "Fig. 4")
    missing = section(text, "What is missing")
    assert "in no table:\n\n- my/Task-v0, RefinePPO, K = 4, average: `other`.\n\n" in missing
    assert "Fig. 4, K = 2: Hopper-v5: 1 of 5 seeds; no finished run of Ant-v5" in missing


# --- Folders ----------------------------------------------------------------------------------------------------------


def truncate(path: Path):
    path.write_text(path.read_text()[: path.stat().st_size // 2])


def change_result(folder: Path, **fields):
    path = folder / "result.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def append(folder: Path, line: str):
    with (folder / "evaluations.csv").open("a") as file:
        file.write(line + "\n")


BAD_FOLDERS = {
    "torn config": (lambda folder: truncate(folder / "config.json"), "torn: config.json is not JSON"),
    "no config": (lambda folder: (folder / "config.json").unlink(), "torn or foreign: there is no config"),
    "foreign config": (lambda folder: (folder / "config.json").write_text('{"model_type": "bert"}'), "foreign: "),
    "list as config": (lambda folder: (folder / "config.json").write_text("[1]"), "foreign: "),
    "binary config": (lambda folder: (folder / "config.json").write_bytes(b"\xff\xfe\x00"), "torn: config.json"),
    "seed of another type": (
        lambda folder: (folder / "config.json").write_text(
            (folder / "config.json").read_text().replace('"seed": 9', '"seed": "9"')
        ),
        "torn: a flag in config.json is of another type",
    ),
    "torn result": (lambda folder: truncate(folder / "result.json"), "torn: result.json is not JSON"),
    "list as result": (lambda folder: (folder / "result.json").write_text("[]"), "torn: result.json lacks"),
    "result without best": (lambda folder: change_result(folder, best={}), "torn: result.json lacks"),
    "text as return": (lambda folder: change_result(folder, best={"mean": "3"}), "torn: result.json lacks"),
    "NaN": (lambda folder: change_result(folder, last={"mean": float("nan")}), "not finite"),
    "infinite": (lambda folder: change_result(folder, train_return_last10pct=float("inf")), "not finite"),
    "another task": (lambda folder: change_result(folder, env_id="Ant-v5"), "env_id is Ant-v5 in result.json"),
    "another seed": (lambda folder: change_result(folder, seed=1), "seed is 1 in result.json, but 9 in config.json"),
    "another depth": (lambda folder: change_result(folder, refinement_depth=2), "refinement_depth is 2"),
    "torn evaluations": (lambda folder: append(folder, "300,1.0,1"), "torn: evaluations.csv"),
    "NaN in evaluations": (lambda folder: append(folder, "300,nan,1,1,1,1"), "torn: evaluations.csv"),
    "step twice": (lambda folder: append(folder, "200,1,1,1,1,1"), "torn: the steps in evaluations.csv do not rise"),
    "other columns": (lambda folder: (folder / "evaluations.csv").write_text("a,b\n1,2\n"), "torn: evaluations.csv"),
    "empty evaluations": (lambda folder: (folder / "evaluations.csv").write_text(""), "torn: evaluations.csv"),
}  # fmt: skip


def test_folders_that_cannot_be_used_are_named_with_the_reason(tmp_path, make_report, capsys):
    make_seeds(tmp_path, "Hopper-v5", [10, 20])
    for name, (spoil, _) in BAD_FOLDERS.items():
        spoil(make_run(tmp_path / "deep/er", name, "Hopper-v5", 9, best=999))
    (tmp_path / "notes").mkdir()  # no run and none of its files
    (tmp_path / "notes/x.txt").touch()
    make_run(tmp_path / "tune/study/trial_0", "seed_1001", "Hopper-v5", 1001, best=999)
    (tmp_path / "tune/study/trials.csv").touch()
    make_run(tmp_path / "tune/begun/trial_0", "seed_1001", "Hopper-v5", 1001, best=999)
    (tmp_path / "tune/begun/journal.log").touch()
    lines = section(make_report(tmp_path), "What is missing").splitlines()
    for name, (_, reason) in BAD_FOLDERS.items():
        (line,) = [line for line in lines if line.startswith(f"- `deep/er/{name}`: ")]
        assert reason in line
    assert table((tmp_path / "report/report.md").read_text(), "Table 1")["Hopper-v5"][1] == "15.0 ± 7.1"
    assert f"2 finished, 0 unfinished, {len(BAD_FOLDERS) + 2} skipped" in capsys.readouterr().out
    assert all(any(line.startswith(f"- `tune/{study}`: a search") for line in lines) for study in ("study", "begun"))
    assert not any("notes" in line for line in lines)


def test_runs_of_other_programs_are_named(tmp_path, make_report, capsys):
    """A lone checkpoint or TensorBoard log is no run of ours; TensorBoard's files below a run belong to it."""
    make_seeds(tmp_path, "Hopper-v5", [10, 20])
    for name in ("cleanrl/events.out.tfevents.1.host", "lone/best.pt", "Hopper-v5-None-average-1/events.out.tfevents.2",
                 "Hopper-v5-None-average-1/hparams/deep/events.out.tfevents.3"):  # fmt: skip
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    missing = section(make_report(tmp_path), "What is missing")
    reason = "torn or foreign: there is no config.json"
    assert f"(skipped):\n\n- `cleanrl`: {reason}\n- `lone`: {reason}\n\n" in missing
    assert "2 finished, 0 unfinished, 2 skipped" in capsys.readouterr().out


def test_unfinished_runs_count_in_the_curves_alone(tmp_path, make_report):
    make_seeds(tmp_path, "Hopper-v5", [10, 20])
    make_run(tmp_path, "going", "Hopper-v5", 3, finished=False, curve=[(100, 1), (200_000, 900)])
    make_run(tmp_path, "begun", "Hopper-v5", 4, finished=False, curve=[])
    (make_run(tmp_path, "failed", "Hopper-v5", 5, finished=False) / "failure.json").write_text("{}")
    (make_run(tmp_path, "no file", "Hopper-v5", 6, finished=False) / "evaluations.csv").unlink()
    (make_run(tmp_path, "no curve", "Hopper-v5", 7, 30) / "evaluations.csv").unlink()
    text = make_report(tmp_path)
    assert table(text, "Table 1")["Hopper-v5"][1] == "20.0 ± 10.0"
    missing = section(text, "What is missing")
    assert "- `going`: evaluated up to step 200,000 of 6,000,000\n" in missing
    assert "- `begun`: evaluated up to step 0 of 6,000,000\n" in missing
    assert "- `failed`: evaluated up to step 200 of 6,000,000, ended by a number that is not finite" in missing
    assert "- `no file`: evaluated up to step 0 of 6,000,000" in missing
    assert "Finished runs without evaluations (in tables of final returns alone):\n\n- `no curve`" in missing
    assert "Table 1, PPO: Hopper-v5: 3 of 5 seeds" in missing


def test_the_mean_curve_is_of_the_seeds_that_have_got_so_far():
    curves = [np.array([[1, 10.0], [2, 20]]), np.array([[1, 30.0], [2, 40], [3, 70]])]
    steps, centre, spread = report.mean_curve(curves)
    assert steps.tolist() == [1, 2, 3] and centre.tolist() == [20, 30, 70]
    assert spread == pytest.approx([stdev([10, 30]), stdev([20, 40]), 0])


def test_variants_and_duplicates_are_named(tmp_path, make_report):
    """The variant with the most finished seeds counts, then that with the most steps; the first of two equal seeds."""
    make_seeds(tmp_path / "a", "Hopper-v5", [1, 2], learning_rate=1e-3)
    make_seeds(tmp_path / "b", "Hopper-v5", [10, 20, 30], run_dir="elsewhere", num_threads=2, wandb_entity="me")
    make_run(tmp_path / "c", "again", "Hopper-v5", 2, 999)
    make_seeds(tmp_path / "d", "Ant-v5", [1, 2], steps=1000)
    make_seeds(tmp_path / "e", "Ant-v5", [5, 6], steps=2000)
    for seed in (1001, 1002, 1003):
        make_run(tmp_path / "f", f"search-{seed}", "Ant-v5", seed, 999, steps=2000)
    make_run(tmp_path / "g", "first", "Reacher-v5", 1, 999, finished=False)
    make_run(tmp_path / "g", "second", "Reacher-v5", 1, 7)
    text = make_report(tmp_path)
    rows = table(text, "Table 1")
    assert [rows[task][1] for task in ("Hopper-v5", "Ant-v5", "Reacher-v5")] == ["20.0 ± 10.0", "5.50 ± 0.71", "7.00"]
    lines = [line for line in section(text, "What is missing").splitlines() if line.startswith("- ")]
    for expected in (
        "- Hopper-v5, PPO, --learning-rate 0.001 (reported: 0.0003): `a/Hopper-v5-None-average-1`, "
        "`a/Hopper-v5-None-average-2`.",
        "- seed 2 again, beside `b/Hopper-v5-None-average-2`: `c/again`.",
        "- Ant-v5, PPO, --total-timesteps 1000 (reported: 2000): `d/Ant-v5-None-average-1`, `d/Ant-v5-None-average-2`.",
        "- Ant-v5, PPO, seeds from 1001 on, of a search: `f/search-1001`, `f/search-1002`, `f/search-1003`.",
        "- seed 1 again, beside `g/second`: `g/first`.",
    ):
        assert expected in lines


def top(text: str) -> list[str]:
    """The paragraphs between the report's title and its first words."""
    return text.split("\n\n")[1 : text[: text.index("RefinePPO is K = ")].count("\n\n")]


def test_the_flags_that_the_settings_ask_for_go_before_seeds_and_steps(tmp_path, make_report, monkeypatch):
    """Tuned against tuned, though the default has more seeds and steps; SETTINGS is the default of --settings."""
    runs, out = tmp_path / "runs", ("--out-dir", tmp_path / "out")
    make_seeds(runs / "default", "Hopper-v5", [1, 2, 3], gamma=0.99, steps=10_000_000)
    make_seeds(runs / "tuned", "Hopper-v5", [10], gamma=0.999, actor_hidden=[64, 32], anneal_lr=False, target_kl=0.02)
    make_seeds(runs / "tuned", "Hopper-v5", [20], gamma=0.999, depth=4)
    make_seeds(runs / "default", "Hopper-v5", [4, 5], gamma=0.99, depth=4)
    settings = make_settings(tmp_path, "ppo", "Hopper-v5", "--gamma=0.999 # --gamma 0.9\n--actor-hidden 64 32\n"
                             "--no-anneal-lr --target-kl 2e-2 --wandb-entity me --num_threads 2")  # fmt: skip
    make_settings(tmp_path, "refineppo", "Hopper-v5", "--gamma 0.9 --gamma 0.999")
    text = make_report(runs, *out, "--settings", settings)
    assert table(text, "Table 1")["Hopper-v5"][1:3] == ["10.0", "20.0"] and top(text) == []
    left_out = section(text, "What is missing").split("Duplicates and other variants (left out):")[1]
    assert "- Hopper-v5, RefinePPO, K = 4, average, --gamma 0.99 (reported: 0.999): `default/Hopper-v5-4" in left_out
    monkeypatch.setenv("SETTINGS", str(settings))
    assert make_report(runs, *out) == text
    text = make_report(runs, *out, "--settings", "none")
    assert table(text, "Table 1")["Hopper-v5"][1:3] == ["2.00 ± 1.00", "4.50 ± 0.71"] and top(text) == []
    monkeypatch.setenv("SETTINGS", "none")
    assert make_report(runs, *out) == text
    monkeypatch.setenv("SETTINGS", "")
    assert report.Args(runs).settings == ROOT / "sweeps/settings"


def test_other_flags_than_the_settings_ask_for_are_said_first(tmp_path, make_report):
    """In every table: PPO, RefinePPO, other depths, the toy, which its generator gives flags; not what is not shown."""
    runs = tmp_path / "runs"
    make_seeds(runs, "Hopper-v5", [1, 2], gamma=0.999, num_envs=2, target_kl=None)
    make_seeds(runs, "Hopper-v5", [3, 4], depth=4, anneal_lr=True)
    make_seeds(runs, "Hopper-v5", [5, 6], depth=2, actor_hidden=[64, 64])
    make_seeds(runs, "Hopper-v5", [7, 8], depth=2, schedule="uniform", gamma=0.9)
    make_run(runs, "search", "Ant-v5", 1001)
    make_run(runs, "toy", TOY, 1, num_envs=16, num_steps=64, num_minibatches=8, log_std_init=-2.0, eval_interval=1024,
             eval_episodes=50)  # fmt: skip
    make_run(runs, "toy 4", TOY, 1, depth=4, num_envs=1, eval_interval=1024)
    settings = make_settings(tmp_path, "refineppo", "Hopper-v5", "--no-anneal-lr")
    text = make_report(runs, "--settings", settings)
    lines = "**Other flags than the settings ask for:** "
    assert sorted(top(text)) == [
        f"{lines}Hopper-v5, PPO: --gamma 0.999 (asked for: 0.99), --num-envs 2 (asked for: 1)",
        f"{lines}Hopper-v5, RefinePPO, K = 2, average: --actor-hidden [64, 64] (asked for: [128, 128])",
        f"{lines}Hopper-v5, RefinePPO, K = 4, average: --anneal-lr True (asked for: False)",
        f"{lines}{TOY}, RefinePPO, K = 4, average: --num-envs 1 (asked for: 16)",
        "**Seeds from 1001 on, of a search:** Ant-v5, PPO",
    ]


def test_the_scripts_defaults_are_read_as_they_are(script):
    """Against the dataclass itself; only flags of a seed's own are left out."""
    read = report.defaults(script.__name__.split("_")[0])
    whole = json.loads(json.dumps(vars(script.Args())))
    assert read == {name: value for name, value in whole.items() if name not in report.OWN_FLAGS}
    assert {"gamma", "actor_hidden", "target_kl", "anneal_lr"} <= read.keys()


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


def test_sections_with_nothing_to_show_say_so(tmp_path, make_report):
    make_run(tmp_path, "a", "Hopper-v5", 1, finished=False, curve=[])
    text = make_report(tmp_path)
    for header, sentence in {
        "Table 1": "No finished run of PPO or RefinePPO.", "Fig. 2": "No evaluation of PPO or RefinePPO.",
        "Sample efficiency": "No task with finished runs of PPO and of RefinePPO.",
        "Table 2": "No task with finished runs of at least two schedules.",
        "Fig. 4": "No task with finished runs of two depths.", "Improvement against": "No task with finished runs",
        "What five seeds": "No task with finished runs", "Toy": f"No finished run of `{TOY}`.",
    }.items():  # fmt: skip
        assert section(text, header).split("\n\n", 1)[1].startswith(sentence)
    assert "Fig. 4, K = 8: no finished run\n" in text


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
    value, low, high = report.estimate_iqm(strata)
    assert value == pytest.approx(plain_iqm(np.concatenate(strata)))
    assert (low, high) == pytest.approx([plain_quantile(values, q) for q in (0.025, 0.975)])


def test_bootstrap_agrees_with_scipy(strata):
    scores = strata[2]
    options = {"method": "percentile", "n_resamples": 20_000, "rng": 1}
    other = scipy.stats.bootstrap((scores,), report.iqm, **options).confidence_interval
    _, low, high = report.estimate_iqm([scores])
    assert (low, high) == pytest.approx((other.low, other.high), abs=0.1 * scores.std())


def test_probability_of_improvement(strata, monkeypatch):
    monkeypatch.setattr(report, "RESAMPLES", 300)
    others = [scores[:3].round() for scores in strata]
    value, low, high = report.estimate_probability(strata, others)
    assert value == pytest.approx(mean(map(plain_probability, strata, others)))
    resampled = [
        [plain_probability(x[i], y[i]) for i in range(300)]
        for x, y in zip(report.resample(strata, 1), report.resample(others, 2))
    ]
    means = [mean(of_tasks) for of_tasks in zip(*resampled)]
    assert (low, high) == pytest.approx([plain_quantile(means, q) for q in (0.025, 0.975)])


def test_resampling_stays_within_a_task(strata):
    for scores, drawn in zip(strata, report.resample(strata, 0)):
        assert drawn.shape == (report.RESAMPLES, len(scores)) and set(drawn.ravel()) <= {*scores}
        assert drawn.mean() == pytest.approx(scores.mean(), abs=0.05 * (scores.std() or 1))


# --- The data beside the runs -----------------------------------------------------------------------------------------

PAPER, BOUNDS = (read(ROOT / "sweeps" / name) for name in ("paper_results.csv", "bounds.csv"))


def test_the_papers_numbers():
    cells = {(row["table"], row["task"], row["method"], row["schedule"]): (row["mean"], row["std"]) for row in PAPER}
    assert len(PAPER) == len(cells) == 14 * 2 + 9 * 3
    assert cells["1", "HalfCheetah-v5", "RefinePPO", ""] == ("5686", "2640")
    assert cells["1", "MountainCarContinuous-v0", "PPO", ""] == ("93", "0.2")
    assert cells["1", "BipedalWalkerHardcore-v3", "PPO", ""] == ("-28", "47")
    assert cells["1", "Reacher-v5", "RefinePPO", ""] == ("-3", "0.1")
    assert cells["2", "HumanoidStandup-v5", "RefinePPO", "inverse"] == ("147769.1", "")
    assert cells["2", "Pusher-v5", "RefinePPO", "uniform"] == ("-58.4", "")
    rows = [row for row in PAPER if row["table"] == "1"]
    for ppo, refineppo in zip(rows[::2], rows[1::2]):
        assert (ppo["method"], refineppo["method"]) == ("PPO", "RefinePPO") and ppo["task"] == refineppo["task"]
        p, r = float(ppo["mean"]), float(refineppo["mean"])
        assert 100 * (r - p) / abs(p) == pytest.approx(float(refineppo["improvement_percent"]), abs=0.0501)
        average = cells.get(("2", ppo["task"], "RefinePPO", "average"))
        assert average is None or float(average[0]) == pytest.approx(r, abs=0.81)  # Pusher: -37 there, -37.8 here
    for task, dim in {(row["task"], row["action_dim"]) for row in PAPER}:
        assert gym.make(task).action_space.shape == (int(dim),)


def test_the_bounds():
    """The tasks of Table 1, Gymnasium's thresholds where they count, and the random policy measured again."""
    assert [row["task"] for row in BOUNDS] == [row["task"] for row in PAPER if row["table"] == "1"][::2]
    for row in BOUNDS:
        assert float(row["random_return"]) < float(row["reference_return"]) and row["random_episodes"] == "100"
        if row["reference"] == "Gymnasium's reward threshold":
            assert float(row["reference_return"]) == gym.spec(row["task"]).reward_threshold != 0
    others = {row["task"]: row["reference_return"] for row in BOUNDS if not row["reference"].startswith("Gymnasium")}
    assert others == {"Walker2d-v5": "5810", "Humanoid-v5": "3060", "HumanoidStandup-v5": "165067", "Pusher-v5": "-37",
                      "Pendulum-v1": "-230.42"}  # fmt: skip
    saved = next(row for row in BOUNDS if row["task"] == "Pendulum-v1")
    returns = bounds.random_returns("Pendulum-v1", 100, seed=0)
    assert returns.mean() == pytest.approx(float(saved["random_return"]), rel=1e-5)
    assert returns.std(ddof=1) == pytest.approx(float(saved["random_std"]), rel=1e-5)


def test_the_random_policy_runs_whole_episodes():
    """Independent of how the seeds are spent: the mean of another 100 episodes lies within its standard error."""
    env, returns = gym.make("Reacher-v5"), []
    env.reset(seed=7)
    for _ in range(100):
        env.reset()
        returns.append(sum(env.step(env.action_space.sample())[1] for _ in range(50)))
    saved = next(row for row in BOUNDS if row["task"] == "Reacher-v5")
    assert mean(returns) == pytest.approx(float(saved["random_return"]), abs=5 * stdev(returns) * (2 / 100) ** 0.5)


# --- Files ------------------------------------------------------------------------------------------------------------


def make_whole_sweep(root: Path):
    rng = np.random.default_rng(0)
    tasks = "Hopper-v5", "Ant-v5", "Pendulum-v1", TOY
    settings = (None, "average"), (1, "average"), (4, "average"), (4, "uniform"), (4, "inverse")
    for task, (depth, schedule), seed in itertools.product(tasks, settings, (1, 2, 3)):
        curve = [(100 * i, float(rng.normal(10 * i, 5))) for i in range(1, 6)]
        name = f"{task}-{depth}-{schedule}-{seed}"
        make_run(root, name, task, seed, rng.normal(50, 5), curve, depth=depth, schedule=schedule)


def assert_shows_something(path: Path):
    """The picture opens, and neither is of one colour nor a dot on an empty page."""
    pixels = matplotlib.image.imread(path)[..., :3]
    assert min(pixels.shape[:2]) > 200
    assert (pixels.min(-1) < 0.9).mean() > 0.01
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20


def test_every_file_of_a_report(tmp_path):
    """The command itself: Markdown, CSV and LaTeX of each table, PNG and PDF of each figure, all linked."""
    make_whole_sweep(tmp_path)
    done = run("sweeps/report.py", tmp_path, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "report"
    assert done.stdout == f"run folders: 60 finished, 0 unfinished, 0 skipped\nthe report is in {out / 'report.md'}\n"
    files = {path.name for path in out.iterdir()}
    assert files == report.OUTPUTS
    text = (out / "report.md").read_text()
    assert {*re.findall(r"\]\(([\w.]+)\)", text)} == files - {"report.md"}
    assert "nan" not in text and "inf" not in text.lower().split("## what is missing")[1]
    for name in report.FIGURES:
        assert_shows_something(out / f"{name}.png")
        assert (out / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    markdown = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    for name, lines in zip(re.findall(r"\[(\w+)\.csv\]", text), markdown):
        columns = lines[0].count("|") - 1
        assert {line.count("|") - 1 for line in lines} == {columns}
        assert len(read(out / f"{name}.csv")) == len(lines) - 2
        tex = (out / f"{name}.tex").read_text().splitlines()
        assert tex[1] == rf"\begin{{tabular}}{{l{'r' * (columns - 1)}}}" and tex[-1] == r"\end{tabular}"
        rows = [line for line in tex if line.endswith(r" \\")]
        assert len(rows) == len(lines) - 1 and {len(re.split(r"(?<!\\)&", row)) for row in rows} == {columns}
        assert not re.search(r"(?<!\\)[%_#]|±", "\n".join(rows))


def test_latex_escapes():
    assert report.latex("50 % of a_b & c#1: -1.5 ± 2 [-3, 4], Ant-v5") == (
        r"50 \% of a\_b \& c\#1: $-$1.5 $\pm$ 2 [$-$3, 4], Ant-v5")  # fmt: skip


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(tmp_path, make_report):
    make_whole_sweep(tmp_path)
    make_report(tmp_path)
    inputs = "".join(rf"\input{{report/{name}.tex}}\par " for name in report.TABLES)
    document = rf"\documentclass{{article}}\usepackage{{booktabs}}\begin{{document}}{inputs}\end{{document}}"
    (tmp_path / "all.tex").write_text(document)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "all.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_the_same_runs_give_the_same_files(tmp_path, make_report):
    """Byte for byte, wherever the report goes; what an earlier report left and this one has not is removed."""
    make_seeds(tmp_path / "runs", "Hopper-v5", [1, 2, 3])
    make_seeds(tmp_path / "runs", "Hopper-v5", [2, 3, 4], depth=4)
    make_report(tmp_path / "runs", "--out-dir", tmp_path / "a/b", figures=True)
    make_run(tmp_path / "runs", "toy", TOY, 1)
    make_report(tmp_path / "runs", figures=True)
    assert (tmp_path / "runs/report/toy.csv").exists()
    shutil.rmtree(tmp_path / "runs/toy")
    make_report(tmp_path / "runs", figures=True)
    first, second = ({path.name: path.read_bytes() for path in folder.iterdir()}
                     for folder in (tmp_path / "a/b", tmp_path / "runs/report"))  # fmt: skip
    assert first == second and "toy.csv" not in first


def test_curves_of_other_tasks(tmp_path, make_report):
    """None of the paper's six: the tasks that are there, six at most, on one page."""
    for i in range(8):
        make_seeds(tmp_path, f"Task{i}-v0", [1])
    text = make_report(tmp_path, figures=True)
    assert "there is no run of HalfCheetah-v5, Pusher-v5," in text
    assert_shows_something(tmp_path / "report/training_curves.png")
    height, width = matplotlib.image.imread(tmp_path / "report/training_curves.png").shape[:2]
    assert width > height


# --- Bad input --------------------------------------------------------------------------------------------------------


def occupied(folder: Path, name: str, content: str = "") -> Path:
    folder.mkdir()
    (folder / name).write_text(content)
    return folder


def runs_in(folder: Path) -> Path:
    make_seeds(folder, "Hopper-v5", [1, 2])
    return folder


BAD_INPUT = {
    "missing": (lambda tmp: [tmp / "nothing"], "there is no"),
    "a file": (lambda tmp: [occupied(tmp / "runs", "x") / "x"], "is not a folder of runs"),
    "no runs": (lambda tmp: [occupied(tmp / "runs", "x")], "there is no run to report"),
    "only torn runs": (lambda tmp: [occupied(tmp / "runs", "config.json", "{")], "torn: config.json is not JSON"),
    "depth": (lambda tmp: [runs_in(tmp / "runs"), "--depth", 0], "--depth must be at least 1"),
    "settings": (lambda tmp: [runs_in(tmp / "runs"), "--settings", tmp / "nothing"], "--settings must be a folder"),
    "settings that are none": (
        lambda tmp: [runs_in(tmp / "runs"), "--settings", make_settings(tmp, "ppo", "Hopper-v5", "--gamma high")],
        "Hopper-v5.args: could not convert string to float: 'high'",
    ),
    "foreign file": (lambda tmp: [runs_in(tmp / "runs"), "--out-dir", occupied(tmp / "out", "x")], "no report has"),
    "foreign report": (
        lambda tmp: [runs_in(tmp / "runs"), "--out-dir", occupied(tmp / "out", "report.md", "mine")], "no report has"),
    "foreign table": (
        lambda tmp: [runs_in(tmp / "runs"), "--out-dir", occupied(tmp / "out", "table1.tex")], "no report has made"),
    "the runs themselves": (lambda tmp: [runs_in(tmp / "runs"), "--out-dir", tmp / "runs"], "no report has made"),
    "out-dir a file": (
        lambda tmp: [runs_in(tmp / "runs"), "--out-dir", occupied(tmp / "out", "x") / "x"], "cannot write to"),
    "out-dir below a file": (
        lambda tmp: [runs_in(tmp / "runs"), "--out-dir", occupied(tmp / "out", "x") / "x/y"], "cannot write to"),
    "out-dir not writable": (lambda tmp: [runs_in(tmp / "runs"), "--out-dir", "/proc/no/such"], "cannot write to"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_refused(case, tmp_path, make_report, capsys):
    """One sentence, exit 2, and nothing is written or changed."""
    make_flags, expected = BAD_INPUT[case]
    flags = make_flags(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(SystemExit) as exit:
        make_report(*flags)
    assert exit.value.code == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("report.py: error: ") and printed.err.count("\n") == 1 and expected in printed.err
    assert printed.out == ""
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_hidden_files_are_no_matter(tmp_path, make_report):
    """Those that a file browser leaves, in a new folder or in one with a report."""
    out = occupied(tmp_path / "out", ".DS_Store", "x")
    make_report(runs_in(tmp_path / "runs"), "--out-dir", out)
    make_report(tmp_path / "runs", "--out-dir", out)
    assert (out / ".DS_Store").read_text() == "x"


def test_a_report_with_an_added_file_is_refused(tmp_path, make_report):
    make_report(runs_in(tmp_path / "runs"))
    (tmp_path / "runs/report/notes.md").write_text("mine")
    with pytest.raises(SystemExit):
        make_report(tmp_path / "runs")
    assert (tmp_path / "runs/report/notes.md").read_text() == "mine"
