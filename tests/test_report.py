"""sweeps/report.py on hand-made run folders, against tables computed by hand and statistics as plain loops."""

import itertools
import json
import re
import shutil
import sys
from pathlib import Path
from statistics import mean, quantiles, stdev

import gymnasium as gym
import numpy as np
import pytest
from conftest import ROOT, check_picture, files_of, read_csv, run

from sweeps import bounds, report

TOY = "sweeps.toy_env:Coordination-v0"
CURVE, STEPS = ((100, 0.0), (200, 1.0)), 6_000_000


def make_run(
    folder, task, seed, best=0, curve=CURVE, depth=None, schedule="average", steps=STEPS, late=5, failure=None, **flags
) -> Path:
    """A run folder with the fields that matter here, and others beside them; of an empty failure an unfinished one."""
    folder.mkdir(parents=True)
    args = {"env_id": task, "seed": seed, "total_timesteps": steps, "run_dir": folder.name, "actor_hidden": [128, 128]}
    args |= {} if depth is None else {"refinement_depth": depth, "refinement_schedule": schedule}
    config = {"args": args | flags, "versions": {"torch": "2", "numpy": "3"}, "git_commit": None, "cpu": "x"}
    (folder / "config.json").write_text(json.dumps(config))
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


def make_seeds(root: Path, bests: dict[str, list[float]], depth=None, schedule="average", prefix="", **more):
    """Runs of the seeds 1, 2, ... of each task, by their best returns."""
    for task, of_task in bests.items():
        for seed, best in enumerate(of_task, start=1):
            name = f"{prefix}{task}-{depth}-{schedule}-{seed}"
            make_run(root / name, task, seed, best, depth=depth, schedule=schedule, **more)


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


PAPER, BOUNDS = (read_csv(ROOT / "sweeps" / name) for name in ("paper_results.csv", "bounds.csv"))
LIMITS = {row["task"]: (float(row["random_return"]), float(row["reference_return"])) for row in BOUNDS}


# --- The paper's numbers and the bounds, against Gymnasium and the random policy run again ----------------------------


def test_the_papers_numbers():
    """Its improvements follow from its returns, and its two tables agree."""
    means = {(row["table"], row["task"], row["method"], row["schedule"]): float(row["mean"]) for row in PAPER}
    assert len(PAPER) == len(means) == 14 * 2 + 9 * 3
    assert means["2", "HumanoidStandup-v5", "RefinePPO", "inverse"] == 147769.1
    for row in PAPER:
        assert gym.make(row["task"]).action_space.shape == (int(row["action_dim"]),)
        if row["table"] == "1" and row["method"] == "RefinePPO":
            ppo, refined = means["1", row["task"], "PPO", ""], float(row["mean"])
            assert 100 * (refined - ppo) / abs(ppo) == pytest.approx(float(row["improvement_percent"]), abs=0.0501)
            average = means.get(("2", row["task"], "RefinePPO", "average"), refined)
            assert average == pytest.approx(refined, abs=0.81)  # Pusher: -37 there, -37.8 here


def test_the_bounds():
    """The tasks of Table 1, Gymnasium's thresholds where they count, and the random policy over 100 whole episodes."""
    assert [row["task"] for row in BOUNDS] == [row["task"] for row in PAPER if row["table"] == "1"][::2]
    rows = {row["task"]: row for row in BOUNDS}
    others = {"Walker2d-v5": 5810, "Humanoid-v5": 3060, "HumanoidStandup-v5": 165067, "Pusher-v5": -37}
    others["Pendulum-v1"] = -230.42
    for task, row in rows.items():
        assert gym.make(task).observation_space.shape == (int(row["obs_dim"]),)
        reference = others.get(task) or gym.spec(task).reward_threshold
        assert float(row["random_return"]) < float(row["reference_return"]) == reference
    returns, saved = bounds.random_returns("Reacher-v5", 100, seed=0), rows["Reacher-v5"]
    assert returns.mean() == pytest.approx(float(saved["random_return"]), rel=1e-5)
    assert returns.std(ddof=1) == pytest.approx(float(saved["random_std"]), rel=1e-5)
    env, others = gym.make("Reacher-v5"), []
    for seed in range(100):
        env.reset(seed=seed)
        others.append(sum(env.step(env.action_space.sample())[1] for _ in range(50)))
    assert mean(others) == pytest.approx(returns.mean(), abs=5 * stdev(others) * (2 / 100) ** 0.5)


# --- Tables by hand ---------------------------------------------------------------------------------------------------


def test_table_1(tmp_path, make_report):
    """Mean, std (ddof 1), improvement with |P|, the paper's own, seeds; the tasks' order is the paper's."""
    ppo = {"Pusher-v5": [-40, -50], "Hopper-v5": [1000, 2000, 3000], "Ant-v5": [100], "Other-v0": [1, 2]}
    make_seeds(tmp_path, ppo)
    make_seeds(tmp_path, {"Pusher-v5": [-30, -45], "Hopper-v5": [2500, 3500], "Other-v0": [3, 3]}, depth=4)
    text = make_report(tmp_path)
    rows = table(text, "Table 1")
    assert [*rows] == ["task", "Ant-v5", "Hopper-v5", "Pusher-v5", "Other-v0"]
    assert rows["Hopper-v5"] == "3|2000 ± 1000|3000 ± 707|+50.0|2720 ± 826|3120 ± 287|+14.7|3 / 2".split("|")
    assert rows["Pusher-v5"] == "7|-45.0 ± 7.1|-37.5 ± 10.6|+16.7|-44.0 ± 10|-37 ± 9|+15.9|2".split("|")
    assert rows["Ant-v5"][1:4] == ["100", "-", "-"] and rows["Ant-v5"][-1] == "1 / 0"
    assert rows["Other-v0"] == "-|1.50 ± 0.71|3.00 ± 0.00|+100.0|-|-|-|2".split("|")
    hopper = read_csv(tmp_path / "report/6M/table1.csv")[1]
    assert float(hopper["refineppo_std"]) == pytest.approx(stdev([2500, 3500])) and hopper["paper_ppo_std"] == "826"
    missing = section(text, "What is missing")
    assert "- no finished run of PPO: HalfCheetah-v5, Walker2d-v5, Swimmer-v5, Reacher-v5, " in missing
    assert "- only 1 of 5 seeds of PPO: Ant-v5\n- only 2 of 5 seeds of PPO: " in missing


def test_sample_efficiency(tmp_path, make_report):
    """Hopper's areas: (500 + 1500) / 200, (0 + 2000) / 200, (2500 + 4000) / 200, (1000 + 2250) / 200; PPO's level 30.

    On Ant, PPO was last evaluated at 200: RefinePPO's area ends there too, (10 + 15) / 2, and its late return is out.
    """
    curves = {(None, 1): (0, 10, 20), (None, 2): (0, 0, 40), (4, 1): (20, 30, 50), (4, 2): (0, 20, 25)}
    for (depth, seed), returns in curves.items():
        make_run(tmp_path / f"{depth}-{seed}", "Hopper-v5", seed, depth=depth, curve=[*zip((100, 200, 300), returns)])
    make_run(tmp_path / "a", "Ant-v5", 1, curve=[(100, 4), (200, 6)])
    make_run(tmp_path / "b", "Ant-v5", 1, depth=4, curve=[(100, 10), (300, 20), (400, 900)])
    rows = table(make_report(tmp_path), "Sample efficiency")
    by_hand = "10.0 ± 0.0|24.4 ± 11.5|+143.8|30.0|1 of 2|never (300 to never)|1 of 2|never (200 to never)"
    assert rows["Hopper-v5"] == by_hand.split("|")
    assert rows["Ant-v5"] == ["5.00", "12.5", "+150.0", "6.00", "1 of 1", "200", "1 of 1", "100"]
    assert read_csv(tmp_path / "report/6M/sample_efficiency.csv")[1]["refineppo_mean_return_mean"] == "24.375"


def test_table_2(tmp_path, make_report):
    """The three schedules at K = 4 beside the paper's means; a task with one schedule compares nothing."""
    for schedule, bests in {"average": [3, 5], "uniform": [1, 2], "inverse": [2]}.items():
        make_seeds(tmp_path, {"Reacher-v5": bests}, depth=4, schedule=schedule)
    make_seeds(tmp_path, {"Reacher-v5": [9, 9]}, depth=2, schedule="uniform")
    make_seeds(tmp_path, {"Swimmer-v5": [9, 9]}, depth=4)
    text = make_report(tmp_path)
    rows = table(text, "Table 2")
    assert rows["task"] == "average|uniform|inverse|paper: average|paper: uniform|paper: inverse|seeds".split("|")
    assert rows["Reacher-v5"] == "4.00 ± 1.41|1.50 ± 0.71|2.00|-3.0|-3.5|-3.3|2 / 2 / 1".split("|")
    assert "Swimmer-v5" not in rows
    assert "the uniform schedule, the inverse schedule: Ant-v5, HalfCheetah-v5," in section(text, "What is missing")


def test_depth(tmp_path, make_report):
    """Min-max over K by hand (Hopper 0, 1/2, 1, Reacher 0, 0.8, 1, Other 0, 0, 1), and with bounds.csv's bounds."""
    returns = {1: (1000, -10, 0), 2: (2000, -6, 0), 4: (3000, -5, 2)}
    for depth, means in returns.items():
        of_tasks = zip(("Hopper-v5", "Reacher-v5", "Other-v0"), means)  # Other has no bounds
        make_seeds(tmp_path, {task: [centre - 1, centre + 1] for task, centre in of_tasks}, depth=depth)
    make_seeds(tmp_path, {"Swimmer-v5": [50]}, depth=4)  # lacks the other K
    make_seeds(tmp_path, {"Swimmer-v5": [50]}, depth=1, schedule="uniform")  # another schedule
    text = make_report(tmp_path)
    rows = table(text, "Fig. 4")
    assert [rows[k][0] for k in "124"] == ["0.00 ± 0.00", "0.43 ± 0.40", "1.00 ± 0.00"]
    assert [(rows[k][1], rows[k][3]) for k in "124"] == [("3", "2")] * 3  # tasks
    for row, means in zip(read_csv(tmp_path / "report/6M/depth_normalised.csv"), returns.values()):
        limits = LIMITS["Hopper-v5"], LIMITS["Reacher-v5"]
        scores = [(x - low) / (high - low) for x, (low, high) in zip(means, limits)]
        assert float(row["fixed_bounds_mean"]) == pytest.approx(mean(scores))
        assert float(row["fixed_bounds_std"]) == pytest.approx(stdev(scores))
    assert rows["Reacher-v5"][:3] == ["-10.0 ± 1.4", "-6.00 ± 1.41", "-5.00 ± 1.41"]
    assert "Left out, without finished runs of all these K: Swimmer-v5." in text and "no bounds for Other-v0." in text
    assert "K = 1, K = 2: Ant-v5, HalfCheetah-v5, Walker2d-v5, Swimmer-v5" in text


def test_toy(tmp_path, make_report):
    """The first evaluation at or above -0.01; the median is over all seeds, never being later than any step."""
    curves = {1: [(10, -1), (20, -0.01), (30, -0.5)], 2: [(10, -1), (20, -0.02), (30, 0)], 3: [(10, -1), (20, -0.02)]}
    for seed, curve in curves.items():
        make_run(tmp_path / f"k4-{seed}", TOY, seed, depth=4, schedule="uniform", curve=curve, steps=50_000)
        make_run(tmp_path / f"ppo-{seed}", TOY, seed, curve=curves[3], steps=50_000)
    text = make_report(tmp_path)
    rows = table(text, "Toy")
    assert rows["PPO"] == ["0 of 3", "never", "3"]
    assert rows["RefinePPO K=4 uniform"] == ["2 of 3", "30 (20 to never)", "3"]
    assert "# 50k steps" in text and "## Table 1" not in text and "## Fig. 2" not in text


def test_few_seeds(tmp_path, make_report):
    """IQM of 5 seeds: the middle three; 2, 2.5 and 3 of 3 pairs won; beside the best the last (one less) and late."""
    ant = {"Ant-v5": [0, 100, 200, 300, 10_000]}
    make_seeds(tmp_path, ant | {"Hopper-v5": [1000, 2000, 3000], "Other-v0": [3]})
    make_seeds(tmp_path, ant | {"Other-v0": [4]}, depth=4)
    make_seeds(tmp_path, {"Hopper-v5": [2500, 3000, 3500]}, depth=4, late=None)
    text, out = make_report(tmp_path), tmp_path / "report/6M"
    ant, hopper, _ = read_csv(out / "seeds.csv")
    assert ant["ppo_iqm_value"] == ant["refineppo_iqm_value"] == "200.0" and ant["p_improvement_value"] == "0.5"
    value, low, high = (float(hopper[f"p_improvement_{part}"]) for part in ("value", "low", "high"))
    assert value == pytest.approx(7.5 / 9) and 0 <= low < value < high
    assert table(text, "What few seeds")["Other-v0"][0] == "3.00"  # no interval of one seed
    best, last, late = read_csv(out / "aggregate.csv")
    assert float(best["p_improvement_value"]) == pytest.approx((7.5 / 9 + 0.5) / 2)
    assert best["tasks"] == last["tasks"] == "2" and late["tasks"] == "1"  # no episode ended in Hopper's last 10 %
    low, high = LIMITS["Ant-v5"]
    assert float(late["ppo_iqm_value"]) == pytest.approx((5 - low) / (high - low))
    row = read_csv(out / "selection.csv")[1]
    assert (row["ppo_best_mean"], row["ppo_last_mean"]) == ("2000.0", "1999.0")
    assert row["refineppo_last_10_percent_mean"] == ""
    assert "no episode ended in the last 10 % of 3 seeds of RefinePPO K=4 average: Hopper-v5" in text
    assert "Left out, without bounds: Other-v0." in text


@pytest.mark.parametrize("largest", [0.3, 9, 900])
def test_improvement_against_action_dimension(largest, monkeypatch):
    """Ranks 1, 3, 2: Spearman's rho is 1 - 6 (0 + 1 + 1) / (3 (9 - 1)) = 0.5. The axis has several ticks in view."""
    monkeypatch.setattr(report.Report, "figure", lambda self, name, figure: self.blocks.update({name: figure}))
    rows = [
        {"task": "a", "dim.": dim, "improv. %": report.Percent(largest * share), "paper: improv. %": share}
        for dim, share in ((1, 1 / 3), (3, 1), (8, 2 / 3))
    ]
    made = report.Report("6M")
    report.action_dimension(made, rows)
    assert made.facts["spearman"] == "here +0.50 (n = 3), the paper +0.50 (n = 3)"
    figure = made.blocks["action_dimension"]
    figure.canvas.draw()
    (axis,) = figure.axes
    low, high = axis.get_xlim()
    shown = [label.get_text() for x, label in zip(axis.get_xticks(), axis.get_xticklabels()) if low <= x <= high]
    assert len(shown) == len({*shown}) >= 4


def test_another_depth_stands_for_refineppo(tmp_path, make_report):
    """--depth and --schedule; where a task has no such run, what most of its runs have, which Table 1 names."""
    make_seeds(tmp_path, {"Hopper-v5": [100, 100], "Ant-v5": [100, 100]})
    make_seeds(tmp_path, {"Hopper-v5": [150, 150]}, depth=8, schedule="inverse")
    make_seeds(tmp_path, {"Hopper-v5": [999]}, depth=16)  # a seed less
    make_seeds(tmp_path, {"Ant-v5": [170, 170]}, depth=2)
    make_seeds(tmp_path, {"Ant-v5": [180, 180]}, depth=4)
    rows = table(make_report(tmp_path), "Table 1")
    assert rows["task"][1] == "RefinePPO is"
    assert rows["Hopper-v5"][1:5] == ["RefinePPO K=8 inverse", "100 ± 0", "150 ± 0", "+50.0"]
    assert rows["Ant-v5"][1:5] == ["RefinePPO K=4 average", "100 ± 0", "180 ± 0", "+80.0"]
    text = make_report(tmp_path, "--depth", 2)
    assert table(text, "Table 1")["Ant-v5"][4] == "+70.0"
    assert 'python "$(git rev-parse --show-toplevel)/sweeps/report.py" . --depth 2\n' in text


def test_controls(tmp_path, make_report):
    """K = 1 against PPO first; differences by hand, of several tasks of normalised returns; actors by their layers."""
    make_seeds(tmp_path, {"Hopper-v5": [1000, 2000]}, late=None)
    make_seeds(tmp_path, {"Ant-v5": [0, 100], "Swimmer-v5": [0, 100]})  # Swimmer has no control
    make_seeds(tmp_path, {"Hopper-v5": [1500, 2500], "Ant-v5": [100, 200]}, depth=1)
    make_seeds(tmp_path, {"Hopper-v5": [4000, 5000], "Swimmer-v5": [0, 100]}, depth=4)
    make_seeds(tmp_path, {"Hopper-v5": [3000, 1000]}, prefix="w", actor_hidden=[256, 256])
    make_seeds(tmp_path, {"Ant-v5": [0, 0]}, prefix="w", actor_hidden=[216, 216])
    make_report(tmp_path)
    out, wide = tmp_path / "report/6M", "PPO 216x216 / PPO 256x256"
    rows = read_csv(out / "controls_differences.csv")
    assert [*dict.fromkeys(row["difference"] for row in rows)] == [
        "RefinePPO K=1 average - PPO",
        "RefinePPO K=4 average - PPO",
        f"{wide} - PPO",
        "RefinePPO K=4 average - RefinePPO K=1 average",
        f"RefinePPO K=4 average - {wide}",
    ]
    ant, hopper, both = rows[:3]
    assert both["task"] == "2 tasks, normalised"
    value, low, high = (float(both[f"best_difference_{part}"]) for part in ("value", "low", "high"))
    sizes = {task: high - low for task, (low, high) in LIMITS.items()}
    assert value == pytest.approx(mean([100 / sizes["Ant-v5"], 500 / sizes["Hopper-v5"]])) and low < value < high
    assert (ant["best_difference_value"], hopper["best_difference_value"]) == ("100.0", "500.0")
    assert [float(row["best_p_higher_value"]) for row in rows[:3]] == [0.875, 0.75, 0.8125]
    assert hopper["last_difference_value"] == "500.0"
    assert hopper["last_10_percent_difference_value"] == both["last_10_percent_difference_value"] == ""
    methods = {row["method"]: row for row in read_csv(out / "controls.csv") if row["task"] == "Hopper-v5"}
    assert methods[wide]["best_mean"] == "2000.0"
    after = 128 * 128 + 128 * 3  # multiplications after the first layer, which reads 11 numbers once, and m_k, not m_0
    costs = {name: (int(row["multiplications"]), int(row["parameters"])) for name, row in methods.items()}
    assert costs["PPO"] == (11 * 128 + after, 12 * 128 + 129 * 128 + 129 * 3)
    assert costs["RefinePPO K=1 average"][0] == costs["PPO"][0]
    refined = 11 * 128 + 3 * 3 * 128 + 4 * after, (12 + 3) * 128 + 129 * 128 + 129 * 3
    assert costs["RefinePPO K=4 average"] == refined


def test_learning_rates(tmp_path, make_report):
    """Each method at a third and three times the task's learning rate, compared at the same one."""
    for depth, schedule, shift in ((None, "average", 0), (4, "average", 10), (4, "uniform", 30)):
        for rate, bests in {6e-4: [0, 2], 2e-4: [1], 18e-4: [2]}.items():
            bests = {"Swimmer-v5": [shift + best for best in bests]}
            make_seeds(tmp_path, bests, depth, schedule, prefix=f"{rate}-", num_envs=4, learning_rate=rate)
    text, out = make_report(tmp_path), tmp_path / "report/6M"
    rows = {row["method"]: row["best_mean"] for row in read_csv(out / "learning_rates.csv")}
    assert (rows["PPO, lr x 1/3"], rows["PPO, lr x 1"], rows["PPO, lr x 3"]) == ("1.0", "1.0", "2.0")
    assert rows["RefinePPO K=4 uniform, lr x 3"] == "32.0"
    rows = read_csv(out / "learning_rates_differences.csv")
    differences = {row["difference"]: row["best_difference_value"] for row in rows}
    assert len(differences) == 9
    for rate in ("1/3", "1", "3"):
        assert differences[f"RefinePPO K=4 average, lr x {rate} - PPO, lr x {rate}"] == "10.0"
    assert "## Other variants" not in text and "1 of 5 seeds of PPO lr 1.8e-3: Swimmer-v5" in text
    assert table(text, "Table 1")["Swimmer-v5"][1:3] == ["1.00 ± 1.41", "11.0 ± 1.4"]


# --- The two tables ---------------------------------------------------------------------------------------------------


def test_a_row_of_each_table(tmp_path, make_report):
    """All that is written of a run; flags that say nothing about its numbers are left out, and only they."""
    flags = {"gamma": 0.999, "anneal_lr": False, "critic_hidden": [32, 16], "save_every": 5, "progress": False}
    make_run(tmp_path / "a run", "Hopper-v5", 3, 0.1 + 0.2, depth=2, schedule="inverse", compile=False, **flags)
    make_report(tmp_path)
    header, row = (tmp_path / "report/runs.csv").read_text().splitlines()
    assert header == (
        "run,failure,task,method,depth,schedule,actor,flags,seed,steps,best_selection_return,best_global_step,"
        "best_mean,best_std,best_returns,last_global_step,last_mean,last_std,last_returns,train_return_last10pct,"
        "sps,wall_time_s,git_commit,versions,cpu,gpu"
    )
    assert row == (
        "a run,,Hopper-v5,RefinePPO,2,inverse,128x128,--no-anneal-lr --no-compile --critic-hidden 32 16 --gamma 0.999,"
        "3,6000000,0.30000000000000004,200,0.30000000000000004,1.0,0.30000000000000004,200,-0.7,1.0,-0.7,5,1.0,1.0,,"
        '"torch 2, numpy 3",x,'
    )
    header, row, _ = (tmp_path / "report/evaluations.csv").read_text().splitlines()
    assert header == "run,global_step,return_mean,return_std,return_min,return_max,length_mean"
    assert row == "a run,100,0.0,1.0,-1.0,1.0,50.0"


def test_the_scripts_defaults_are_no_flags(tmp_path, script, make_report):
    """Every default of both scripts, as they write them into config.json."""
    folder = make_run(tmp_path / "x", "Hopper-v5", 1)
    args = vars(script.Args(env_id="Hopper-v5"))
    config = json.loads((folder / "config.json").read_text()) | {"args": args}
    (folder / "config.json").write_text(json.dumps(config))
    make_report(tmp_path)
    assert read_csv(tmp_path / "report/runs.csv")[0]["flags"] == ""


def test_the_same_run_with_other_numbers(tmp_path, make_report, capsys):
    """An error that names both places, whichever table and source it is in; nothing is written."""
    make_run(tmp_path / "a/x", "Hopper-v5", 1, 5)
    make_report(tmp_path / "a")
    make_run(tmp_path / "b/x", "Hopper-v5", 1, 6)
    make_run(tmp_path / "c/x", "Hopper-v5", 1, 5, curve=[(100, 0.0), (200, 2.0)])
    for first, second, what in (("a", "b", "best_selection_return"), ("a/report", "c", "evaluation")):
        with pytest.raises(SystemExit):
            make_report(tmp_path / first, tmp_path / second, "--out-dir", tmp_path / "out")
        said = capsys.readouterr().err
        assert f"the run x has another {what} in {tmp_path / second}/x than in {tmp_path / first}/" in said
    assert not (tmp_path / "out").exists()


def test_runs_that_do_not_count_are_named(tmp_path, make_report, capsys):
    """Failed ones with what, where and when, in runs.csv alone; unreadable, unfinished ones and searches in a line."""
    make_seeds(tmp_path, {"Hopper-v5": [10, 20]})
    facts = {"what": "a reward", "global_step": 4096, "env": 1, "reward": "nan", "mujoco_warnings": []}
    make_run(tmp_path / "failed", "Hopper-v5", 3, failure=facts)
    (make_run(tmp_path / "at once", "Hopper-v5", 4, failure=facts) / "evaluations.csv").unlink()
    (make_run(tmp_path / "deep/er/torn", "Hopper-v5", 3) / "result.json").write_text("{")
    (make_run(tmp_path / "no config", "Hopper-v5", 3) / "config.json").unlink()
    (make_run(tmp_path / "foreign", "Hopper-v5", 3) / "config.json").write_text('{"model_type": "bert"}')
    (make_run(tmp_path / "other columns", "Hopper-v5", 3) / "evaluations.csv").write_text("a,b\n1,2\n")
    make_run(tmp_path / "going", "Hopper-v5", 4, failure={})
    make_run(tmp_path / "tune/study/trial_0/seed_1001", "Hopper-v5", 1001)
    (tmp_path / "tune/study/trials.csv").touch()
    text = make_report(tmp_path)
    assert "- `failed`: a reward, global_step 4096, env 1\n" in text and "2 of 5 seeds of PPO: Hopper-v5" in text
    assert table(text, "Table 1")["Hopper-v5"][1] == "15.0 ± 7.1"
    assert [row["run"] for row in read_csv(tmp_path / "report/runs.csv") if row["failure"]] == ["failed", "at once"]
    (row,) = read_csv(tmp_path / "report/6M/cost.csv")
    assert (row["method"], row["runs"]) == ("PPO", "2") and float(row["hours"]) == pytest.approx(2 / 3600)
    said = capsys.readouterr().out.replace(f"{tmp_path}/", "").splitlines()
    assert sorted(":".join(line.split(":")[:2]) for line in said) == [
        "4 runs; the report is in report/report.md",
        "cannot read deep/er/torn: JSONDecodeError",
        "cannot read foreign: KeyError",
        "cannot read no config: FileNotFoundError",
        "cannot read other columns: ValueError",
        "left out, not finished: going",
        "left out: tune/study, a search by tune.py",
    ]


def test_another_number_of_steps_is_another_experiment(tmp_path, make_report):
    """Tables and curves of its own, the one with most runs first; at 1M steps, CleanRL's last 10 % of training too."""
    make_seeds(tmp_path, {"Hopper-v5": [1, 3, 5]}, steps=1_000_000, late=2000)
    make_seeds(tmp_path, {"Hopper-v5": [10, 30]}, prefix="6M-")
    make_seeds(tmp_path, {"Hopper-v5": [7]}, prefix="short-", steps=8192)
    text = make_report(tmp_path)
    assert re.findall("^# (.*) steps$", text, re.MULTILINE) == ["1M", "6M", "8192"]
    means = [read_csv(tmp_path / f"report/{name}/table1.csv")[0]["ppo_mean"] for name in ("1M", "6M", "8192")]
    assert means == ["3.0", "20.0", "7.0"] and text.count("## Fig. 2") == 3
    assert table(text, "Is the baseline")["Hopper-v5"] == ["2000 ± 0", "2383 ± 272", "3"]
    assert text.count("Is the baseline a good PPO?") == 1


def test_variants(tmp_path, make_report):
    """The settings are the flags that most runs of a task and method have; a variant's name says what differs."""
    make_seeds(tmp_path, {"Hopper-v5": [10, 20]}, gamma=0.9, eval_interval=50_000)
    make_seeds(tmp_path, {"Hopper-v5": [1, 2]}, prefix="d", eval_interval=50_000)
    make_run(tmp_path / "third", "Hopper-v5", 3, 30, gamma=0.9, eval_interval=50_000, compile=False, num_threads=2)
    make_seeds(tmp_path, {"Hopper-v5": [40, 50]}, depth=4, eval_interval=50_000, anneal_lr=False)
    make_seeds(tmp_path, {"Ant-v5": [1, 2]}, eval_interval=50_000, depth=4)
    make_run(tmp_path / "search", "Ant-v5", 1001, 9, eval_interval=50_000, depth=4)
    text = make_report(tmp_path)
    assert table(text, "Table 1")["Hopper-v5"][1:3] == ["20.0 ± 10.0", "45.0 ± 7.1"]  # --no-compile is of the machine
    assert "All runs have `eval-interval 50000`." in text
    assert "settings are those of\nboth, but not on Hopper-v5." in text
    ppo, refined = read_csv(tmp_path / "report/6M/settings.csv")
    assert (ppo["flags"], refined["flags"]) == ("gamma 0.9", "no-anneal-lr")
    rows = {row["method"]: row["best_mean"] for row in read_csv(tmp_path / "report/6M/variants.csv")}
    refined = {"RefinePPO K=4 average": "1.5", "RefinePPO K=4 average seeds from 1001 on": "9.0"}
    assert rows == {"PPO": "20.0", "PPO default gamma": "1.5", **refined}


def test_settings_where_counts_are_equal(tmp_path, make_report):
    """The fewest flags; a failed run counts, so that the runs of another actor are no more."""
    make_seeds(tmp_path, {"Ant-v5": [10, 20]}, gamma=0.9)
    make_seeds(tmp_path, {"Ant-v5": [1, 2]}, prefix="d")
    make_seeds(tmp_path, {"Hopper-v5": [10]})
    make_run(tmp_path / "failed", "Hopper-v5", 2, failure={"what": "a loss"})
    make_seeds(tmp_path, {"Hopper-v5": [1, 2]}, prefix="w", actor_hidden=[256, 256])
    text = make_report(tmp_path)
    rows = table(text, "Table 1")
    assert (rows["Ant-v5"][1], rows["Hopper-v5"][1]) == ("1.50 ± 0.71", "10.0")
    assert "PPO gamma 0.9 - PPO" in text and "PPO 256x256" in text


def test_a_run_and_a_seed_count_once(tmp_path, make_report):
    """Through links too, of which a loop ends; another folder with the same seed of the same cell is named."""
    make_seeds(tmp_path / "elsewhere", {"Hopper-v5": [10, 20]})
    make_run(tmp_path / "elsewhere/x", "Hopper-v5", 2, 999)
    runs = tmp_path / "runs"
    runs.mkdir()
    (runs / "one").symlink_to(tmp_path / "elsewhere")
    (runs / "two").symlink_to(tmp_path / "elsewhere")
    (runs / "loop").symlink_to(runs)
    (tmp_path / "elsewhere/up").symlink_to(tmp_path)
    text = make_report(runs)
    assert table(text, "Table 1")["Hopper-v5"][1] == "15.0 ± 7.1"
    assert re.findall("- .* again, .*", text) == ["- `x`: seed 2 again, beside `Hopper-v5-None-average-2`"]


# --- Statistics against plain loops -----------------------------------------------------------------------------------


def plain_iqm(scores) -> float:
    cut = int(0.25 * len(scores))
    return mean(sorted(scores)[cut : len(scores) - cut])


def plain_probability(xs, ys) -> float:
    return mean(1 if x > y else 0.5 if x == y else 0 for x in xs for y in ys)


def interval(values) -> list[float]:
    """Quantiles of 2.5 and 97.5 %."""
    fortieths = quantiles(values, n=40, method="inclusive")
    return [fortieths[0], fortieths[-1]]


@pytest.fixture
def strata(monkeypatch):
    monkeypatch.setattr(report, "RESAMPLES", 300)
    rng = np.random.default_rng(3)
    return [rng.normal(i, 1 + i, n).round(1) for i, n in enumerate((5, 3, 8, 2))]


def test_bootstrap_of_the_iqm(strata):
    """Resampled within each task, all tasks' scores trimmed together."""
    for n in range(1, 13):
        assert report.iqm(np.arange(n) ** 2.0) == pytest.approx(plain_iqm(np.arange(n) ** 2.0))
    rng = np.random.default_rng(0)
    draws = [scores[rng.integers(len(scores), size=(300, len(scores)))] for scores in strata]
    value, *bounds = report.Estimate.iqm(strata)
    assert value == pytest.approx(plain_iqm(np.concatenate(strata)))
    assert bounds == pytest.approx(interval([plain_iqm(np.concatenate(drawn)) for drawn in zip(*draws)]))


def test_probability_of_improvement(strata):
    others = [scores[:3].round() for scores in strata]
    value, *bounds = report.Estimate.pair(report.probability, strata, others)
    assert value == pytest.approx(mean(map(plain_probability, strata, others)))
    for lone in ([scores[:1] for scores in strata], [*strata[1:], strata[0][:1]]):  # what it would vary by is unknown
        estimates = report.Estimate.iqm(lone), report.Estimate.pair(report.probability, strata, lone)
        assert np.isnan([x[1:] for x in estimates]).all()
    first, second = zip(*report.resample(strata, 1)), zip(*report.resample(others, 2))
    assert bounds == pytest.approx(interval([mean(map(plain_probability, x, y)) for x, y in zip(first, second)]))


def test_the_mean_curve_is_of_the_seeds_that_were_evaluated_there():
    curves = [np.array([[1, 10.0], [2, 20]]), np.array([[1, 30.0], [2, 40], [3, 70]])]
    band = report.mean_curve(curves)
    assert band.index.tolist() == [1, 2, 3] and band["mean"].tolist() == [20, 30, 70]
    assert band["std"].tolist() == pytest.approx([stdev([10, 30]), stdev([20, 40]), 0])


# --- Files ------------------------------------------------------------------------------------------------------------


def make_runs_for_every_section(root: Path):
    """Schedules, depths, controls, learning rates, variants, the toy; and a failed run."""
    rng = np.random.default_rng(0)
    ppo = {}, {"actor_hidden": [256, 256]}, {"gamma": 0.9}, {"learning_rate": 1e-4}
    refined = {}, {"depth": 1}, {"schedule": "uniform"}, {"schedule": "inverse"}, {"learning_rate": 1e-4}
    methods = [*ppo, *({"depth": 4} | flags for flags in refined)]
    for task, (i, flags), seed in itertools.product(("Hopper-v5", "Ant-v5", TOY), enumerate(methods), (1, 2)):
        curve = [(100 * step, float(rng.normal(10 * step, 5))) for step in range(1, 6)]
        make_run(root / f"{task}-{i}-{seed}", task, seed, rng.normal(50, 5), curve, steps=10**6, **flags)
    make_run(root / "failed", "Ant-v5", 9, failure={"what": "a loss", "global_step": 7})


@pytest.mark.slow
def test_every_file_of_a_report(tmp_path):
    """Markdown, CSV and LaTeX of each table, PNG and PDF of each figure, all linked; the two tables make them again."""
    make_runs_for_every_section(tmp_path / "runs")
    done = run("sweeps/report.py", "runs", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "55 runs; the report is in runs/report/report.md\n"), done.stderr
    out = tmp_path / "runs/report"
    files, text = files_of(out), (out / "report.md").read_text()
    assert {*re.findall(r"\]\(([\w./]+)\)", text)} == files.keys() - {"report.md", "1M"}
    assert not re.search(r"\b(nan|inf|None)\b", text)
    tables = "table1 table2 depth depth_normalised sample_efficiency seeds aggregate selection baseline toy cost"
    tables += " controls controls_differences learning_rates learning_rates_differences variants variants_differences"
    figures = "training_curves depth seeds action_dimension controls learning_rates variants"
    expected = {f"1M/{name}.{kind}" for name in tables.split() for kind in ("csv", "tex")}
    expected |= {f"1M/{name}.{kind}" for name in figures.split() for kind in ("png", "pdf")}
    assert files.keys() == expected | {"1M", "report.md", "runs.csv", "evaluations.csv"}
    for name in figures.split():
        check_picture(out / f"1M/{name}.png")
        pdf = files[f"1M/{name}.pdf"]
        assert pdf.startswith(b"%PDF") and b"/CIDFontType2" in pdf and b"/Type3" not in pdf  # IEEE refuses Type 3
    markdown = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    for name, lines in zip(re.findall(r"\[(\w+)\.csv\]\(1M", text), markdown):
        latex = [line for line in (out / f"1M/{name}.tex").read_text().splitlines() if line.endswith(r" \\")]
        assert len(read_csv(out / f"1M/{name}.csv")) == len(lines) - 2 == len(latex) - 1
        (bars,) = {line.count("|") for line in lines}
        assert {len(re.findall(r"(?<!\\)&", row)) for row in latex} == {bars - 2}
        assert not re.search(r"(?<!\\)[%_#]|±|(?<![\w{$])-\d", "".join(latex))

    for folder in sorted((tmp_path / "runs").glob("*-1")):
        shutil.copytree(folder, tmp_path / "half" / folder.name)
    for sources in (["runs/report/runs.csv"], ["half", "second", "runs/failed"]):  # the folder's own runs among them
        done = run("sweeps/report.py", *sources, "--out-dir", "second", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert files_of(tmp_path / "second") == files


def test_a_report_in_the_folder_of_its_runs(tmp_path, make_report):
    """New runs beside its tables are read, a table that it no longer has is removed; other people's files stay."""
    out = "--out-dir", tmp_path
    make_seeds(tmp_path, {"Hopper-v5": [10, 20]})
    make_run(tmp_path / "toy", TOY, 1)
    make_report(tmp_path, *out)
    (tmp_path / "notes.md").write_text("mine")
    (tmp_path / "6M/.DS_Store").touch()
    make_run(tmp_path / "third", "Hopper-v5", 3, 30)
    make_report(tmp_path)
    assert len(read_csv(tmp_path / "runs.csv")) == 4 and (tmp_path / "6M/toy.csv").exists()
    for name in ("runs.csv", "evaluations.csv", "toy/result.json"):
        (tmp_path / name).unlink()
    make_report(tmp_path, *out)
    assert len(read_csv(tmp_path / "runs.csv")) == 3 and not (tmp_path / "6M/toy.csv").exists()
    assert (tmp_path / "notes.md").read_text() == "mine"


def test_chosen_curves(tmp_path, make_report, monkeypatch):
    """The paper's six tasks by default, and where there is no run of one another; or those that were asked for."""
    tasks = ["Swimmer-v5", *(f"Task{i}-v0" for i in range(1, 8))]
    make_seeds(tmp_path, dict.fromkeys(tasks, [1]))
    drawn = []
    monkeypatch.setattr(report, "curves_figure", lambda curves: drawn.append([*curves]))
    assert "There is no run of HalfCheetah-v5, Pusher-v5," in make_report(tmp_path)
    make_report(tmp_path, "--curve-tasks", "Task7-v0", "Task2-v0")
    assert drawn == [tasks[:6], tasks, ["Task7-v0", "Task2-v0"], tasks]


BAD_INPUT = {
    "nothing": "there is no nothing",
    "--depth 2": "name run folders or a runs.csv",
    "empty/runs.csv": "has no column run",
    "mine": "there is no finished run in mine",
    "torn": "cannot read torn: JSONDecodeError",
    "runs --depth 0": "--depth must be at least 1",
    "runs --out-dir mine": "mine/report.md was made by no report",
    "runs --out-dir runs/one": "runs/one/evaluations.csv was made by no report",
    "runs --out-dir earlier": "earlier has runs that no source has, as two; name it",
    "runs --out-dir mine/report.md": "cannot write to",
}


@pytest.mark.parametrize("flags, sentence", BAD_INPUT.items(), ids=BAD_INPUT)
def test_bad_input_is_refused(flags, sentence, tmp_path, make_report, capsys, monkeypatch):
    """One sentence, exit 2, and nothing is written or changed."""
    for folder in ("empty", "mine", "torn"):
        (tmp_path / folder).mkdir()
    (tmp_path / "empty/runs.csv").touch()
    (tmp_path / "mine/report.md").write_text("mine")
    (tmp_path / "torn/config.json").write_text("{")
    (tmp_path / "torn/result.json").touch()
    make_run(tmp_path / "more/two", "Hopper-v5", 2)
    make_run(tmp_path / "more/zwei", "Hopper-v5", 2)
    make_report(tmp_path / "more", "--out-dir", tmp_path / "earlier")
    make_run(tmp_path / "runs/one", "Hopper-v5", 1)
    monkeypatch.chdir(tmp_path)
    before = files_of(tmp_path)
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit:
        make_report(*flags.split())
    assert exit.value.code == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("report.py: error: ") and printed.err.count("\n") == 1 and sentence in printed.err
    assert printed.out == "" and files_of(tmp_path) == before
