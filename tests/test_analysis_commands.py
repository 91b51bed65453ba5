"""analysis_refinement.py as a user runs it: its files, several checkpoints, every section, and what it refuses."""

import csv
import json
import pickle
import sys
from dataclasses import asdict
from pathlib import Path

import gymnasium as gym
import matplotlib.image
import numpy as np
import pytest
import torch
from conftest import run

import analysis_refinement as analysis
import ppo_continuous
import refineppo_continuous as refineppo

COLUMNS = {
    "settling_error": "component,rank,step,error",
    "delta_r2": "component,step_from,step_to,r2_baseline,r2_augmented,delta_r2",
    "delta_r2_checks": "component,step_from,step_to,delta_r2,shuffled_low,shuffled_high,above_shuffled,by_episode,"
    "given_observation",
    "feedback": "reads,episodes,return_mean,return_std,length_mean,lost_mean,lost_std,r2",
    "anytime": "steps,return_mean,return_std,length_mean",
    "anytime_scaled": "steps,return_mean,return_std,length_mean",
    "adaptive": "quantile,tolerance,steps_mean,return_mean,return_std,length_mean",
    "dynamics": "quantity,step,value,q10,q90",
    "training": "seed,global_step,quantity,step,value",
}
FIGURES = set(COLUMNS) - {"anytime_scaled"} | {"training_by_seed"}
FILES = {
    "settling": ["settling_error"],
    "r2": ["delta_r2", "delta_r2_checks"],
    "anytime": ["anytime", "anytime_scaled"],
}
SECTIONS = ("settling", "r2", "feedback", "anytime", "adaptive", "dynamics")


def save(path: Path, env_id="Reacher-v5", step=2048, **flags) -> Path:
    """A checkpoint as the training script writes it, of a policy whose f depends on m."""
    args = refineppo.Args(env_id=env_id, actor_hidden=(16, 16), **flags)
    env = gym.make(env_id)
    agent = refineppo.Agent(env.observation_space, env.action_space, args)
    agent.params["actor.2.weight"].mul_(50)
    path.parent.mkdir(parents=True, exist_ok=True)
    refineppo.save_checkpoint(path, {"args": asdict(args), "global_step": step, **agent.state()})
    return path


@pytest.fixture
def analyse(monkeypatch):
    """`python analysis_refinement.py FLAGS`, in this process; with few shuffles, fitted states and episodes."""
    small = {"SHUFFLES": 4, "FIT_STATES": 200, "FEEDBACK_EPISODES": 2, "TRAINING_EPISODES": 2, "TOLERANCES": 3}
    for name, value in small.items():
        monkeypatch.setattr(analysis, name, value)

    def call(*flags):
        monkeypatch.setattr(sys, "argv", ["analysis_refinement.py", *map(str, flags)])
        analysis.main()

    return call


def read(path: Path) -> list[dict]:
    with path.open() as file:
        return list(csv.DictReader(file))


def header(path: Path) -> str:
    return path.read_text().splitlines()[0]


def written(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def files(*tables: str) -> set[str]:
    """What a command writes of these tables: each its CSV and its figure, if it has one of its own."""
    return {f"{name}.csv" for name in tables} | {f"{name}.png" for name in FIGURES & set(tables)} | {"summary.json"}


def assert_shows_something(path: Path):
    """The picture opens, and neither is of one colour nor a dot on an empty page."""
    pixels = matplotlib.image.imread(path)[..., :3]
    assert min(pixels.shape[:2]) > 200
    assert (pixels.min(-1) < 0.9).mean() > 0.01
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20


def test_the_papers_two_analyses_are_the_default(tmp_path, analyse, capsys):
    analyse("--checkpoint", save(tmp_path / "best.pt"), "--num-states", 40)
    out = tmp_path / "analysis"
    assert written(out) == files("settling_error", "delta_r2", "delta_r2_checks")
    for name in ("settling_error", "delta_r2", "delta_r2_checks"):
        assert header(out / f"{name}.csv") == COLUMNS[name]
        assert_shows_something(out / f"{name}.png")
    rows = read(out / "settling_error.csv")
    assert {row["component"] for row in rows} == {"joint0", "joint1"}
    assert [row["step"] for row in rows] == ["0", "1", "2", "3", "4"] * 2
    assert [row["rank"] for row in rows] == ["1"] * 5 + ["2"] * 5
    late = rows[-1]["component"]
    rows = read(out / "delta_r2.csv")
    assert [(row["component"], row["step_from"], row["step_to"]) for row in rows] == [
        (late, "1", "2"),
        (late, "2", "3"),
        (late, "3", "4"),
    ]
    for row in rows:
        assert float(row["delta_r2"]) == float(row["r2_augmented"]) - float(row["r2_baseline"])
    summary = json.loads((out / "summary.json").read_text())
    path = str(tmp_path / "best.pt")
    assert summary["checkpoints"][path] == {
        "global_step": 2048,
        "env_id": "Reacher-v5",
        "seed": 1,
        "refinement_depth": 4,
        "refinement_schedule": "average",
    }
    assert summary["settling"][path]["settling_error"][late]["4"] == 0
    mean = np.mean([float(row["delta_r2"]) for row in rows])
    assert summary["r2"][path]["delta_r2"]["delta_r2"] == pytest.approx(mean)
    printed = capsys.readouterr().out
    assert late in printed and str(out) in printed


@pytest.mark.slow
def test_every_section_of_seventeen_actions(tmp_path, analyse, capsys):
    """HumanoidStandup-v5 with short episodes: five early and five late components, all named after their joints."""
    gym.register("ShortStandup-v0", "gymnasium.envs.mujoco.humanoidstandup_v5:HumanoidStandupEnv", max_episode_steps=8)
    path = save(tmp_path / "best.pt", "ShortStandup-v0", refinement_schedule="inverse", refinement_depth=3)
    flags = "--num-states", 80, "--episodes", 2, "--out-dir", tmp_path / "out"
    analyse("--checkpoint", path, *flags, "--sections", *SECTIONS)
    for name in set(COLUMNS) - {"training"}:
        assert header(tmp_path / f"out/{name}.csv") == COLUMNS[name]
    for name in FIGURES - {"training", "training_by_seed"}:
        assert_shows_something(tmp_path / f"out/{name}.png")
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert set(summary) == {"flags", "checkpoints", *SECTIONS}
    written = summary["feedback"][str(path)]["feedback"]
    assert [row["reads"] for row in written] == ["own", "zero", "another_state", "one_pass"]
    assert [str(row["lost_mean"]) for row in written] == [r["lost_mean"] for r in read(tmp_path / "out/feedback.csv")]
    printed = capsys.readouterr().out
    assert "another_state" in printed and "anytime_scaled" in printed
    rows = read(tmp_path / "out/settling_error.csv")
    assert len(rows) == 17 * 4
    ordered = list(dict.fromkeys(row["component"] for row in rows))
    assert len(ordered) == 17 and {"abdomen_y", "right_knee", "left_elbow"} < set(ordered)
    rows = read(tmp_path / "out/delta_r2.csv")
    assert list(dict.fromkeys(row["component"] for row in rows)) == ordered[-5:]
    assert [row["steps"] for row in read(tmp_path / "out/anytime.csv")] == [str(k) for k in range(7)]


@pytest.mark.parametrize("section", SECTIONS)
def test_a_section_alone(section, tmp_path, analyse):
    flags = "--sections", section, "--num-states", 20, "--episodes", 2
    analyse("--checkpoint", save(tmp_path / "best.pt"), *flags)
    assert written(tmp_path / "analysis") == files(*FILES.get(section, [section]))
    assert set(json.loads((tmp_path / "analysis/summary.json").read_text())) == {"flags", "checkpoints", section}


@pytest.mark.slow
def test_the_same_command_gives_the_same_tables(tmp_path, analyse):
    path = save(tmp_path / "best.pt")
    for out in ("a", "b"):
        analyse(
            "--checkpoint",
            path,
            "--num-states",
            30,
            "--out-dir",
            tmp_path / out,
            "--sections",
            "r2",
            "dynamics",
            "feedback",
        )
    for name in ("delta_r2", "delta_r2_checks", "dynamics", "feedback"):
        assert (tmp_path / f"a/{name}.csv").read_bytes() == (tmp_path / f"b/{name}.csv").read_bytes()


@pytest.mark.slow
def test_seeds_of_one_setting(tmp_path, analyse):
    """Each seed's own rows as if analysed alone, and beside them the mean and standard deviation across seeds."""
    paths = [save(tmp_path / f"seed-{seed}/best.pt", seed=seed) for seed in (1, 2, 3)]
    sections = "--num-states", 30, "--episodes", 2, "--sections", *SECTIONS
    analyse("--checkpoint", *paths, *sections)
    analyse("--checkpoint", paths[1], *sections)
    out, alone = tmp_path / "seed-1/analysis", tmp_path / "seed-2/analysis"
    for name in set(COLUMNS) - {"training"}:
        assert header(out / f"{name}.csv") == "checkpoint," + COLUMNS[name]
        own = [row for row in read(out / f"{name}.csv") if row.pop("checkpoint") == str(paths[1])]
        assert own == read(alone / f"{name}.csv")
        assert not (alone / f"{name}_across_seeds.csv").exists()
    for name in FIGURES - {"training", "training_by_seed"}:
        assert_shows_something(out / f"{name}.png")
    rows = read(out / "settling_error.csv")
    across = read(out / "settling_error_across_seeds.csv")
    assert len(across) == 2 * 5
    for row in across:
        errors = [float(r["error"]) for r in rows if (r["component"], r["step"]) == (row["component"], row["step"])]
        assert int(row["seeds"]) == len(errors) == 3
        assert float(row["error_mean"]) == pytest.approx(np.mean(errors))
        assert float(row["error_std"]) == pytest.approx(np.std(errors, ddof=1), abs=1e-12)
    assert list(json.loads((out / "summary.json").read_text())["settling"]) == list(map(str, paths))


@pytest.mark.slow
def test_a_run_through_training(tmp_path, analyse):
    """Two seeds at two steps each: their own rows, and mean and std over the seeds at every training step. The return
    lost is that of the section `feedback`."""
    paths = [save(tmp_path / f"{seed}/step_{step}.pt", seed=seed, step=step) for seed in (1, 2) for step in (100, 200)]
    analyse("--checkpoint", *paths, "--num-states", 20, "--sections", "training", "settling", "feedback")
    out = tmp_path / "1/analysis"
    across = {"training_by_seed.png", "training_across_seeds.csv"}
    assert written(out) == files("feedback", "settling_error", "training") | across
    for name in ("training", "training_by_seed"):
        assert_shows_something(out / f"{name}.png")
    lost = {r["checkpoint"]: r["lost_mean"] for r in read(out / "feedback.csv") if r["reads"] == "zero"}
    rows = read(out / "training.csv")
    assert header(out / "training.csv") == "checkpoint," + COLUMNS["training"]
    for path, (seed, step) in zip(paths, [("1", "100"), ("1", "200"), ("2", "100"), ("2", "200")]):
        own = {(r["quantity"], r["step"]): float(r["value"]) for r in rows if r["checkpoint"] == str(path)}
        assert {(r["seed"], r["global_step"]) for r in rows if r["checkpoint"] == str(path)} == {(seed, step)}
        errors = [r for r in read(out / "settling_error.csv") if r["checkpoint"] == str(path)]
        for k in range(5):
            mean = np.mean([float(r["error"]) for r in errors if int(r["step"]) == k])
            assert own["settling_error", str(k)] == pytest.approx(mean)
        assert {step for quantity, step in own if quantity == "delta_r2"} == {"2", "3", "4"}
        assert own["return_lost_reading_zero", "4"] == float(lost[str(path)])
        assert ("spectral_radius", "1") in own and ("spread_of_random_starts", "4") in own
    across = read(out / "training_across_seeds.csv")
    assert {row["seeds"] for row in across} == {"2"} and len(across) == len(rows) / 2


def test_checkpoints_that_look_alike_keep_their_own_panels(tmp_path, analyse):
    """best.pt and last.pt of one step: no mean across seeds, and the picture is as wide as two panels."""
    paths = [save(tmp_path / name) for name in ("best.pt", "last.pt")]
    analyse("--checkpoint", *paths, "--num-states", 20, "--sections", "settling")
    analyse("--checkpoint", paths[0], "--num-states", 20, "--sections", "settling", "--out-dir", tmp_path / "one")
    assert not (tmp_path / "analysis/settling_error_across_seeds.csv").exists()
    widths = [matplotlib.image.imread(tmp_path / name / "settling_error.png").shape[1] for name in ("analysis", "one")]
    assert widths[0] > widths[1]


def test_tolerances_that_do_not_exist_are_named(tmp_path, analyse, capsys):
    """All corrections of all states have the same size: a tolerance stops every state after one step, or none."""
    path = save(tmp_path / "best.pt")
    params = torch.load(path, weights_only=True)["params"]
    params["actor.2.weight"].zero_()
    params["actor.2.bias"].fill_(0.1)
    analyse("--checkpoint", change(path, params=params), "--num-states", 20, "--sections", "adaptive")
    assert {row["steps_mean"] for row in read(tmp_path / "analysis/adaptive.csv")} == {"1.0", "4.0"}
    assert "no tolerance was found that takes between 1.00 and 4.00 steps" in capsys.readouterr().out


def test_a_one_dimensional_action_has_no_delta_r2(tmp_path, analyse, capsys):
    analyse("--checkpoint", save(tmp_path / "best.pt", "Pendulum-v1"), "--num-states", 20)
    assert written(tmp_path / "analysis") == files("settling_error")
    assert "no delta R^2" in capsys.readouterr().out


# --- Bad input --------------------------------------------------------------------------------------------------------


class Malicious:
    def __reduce__(self):
        return Path.touch, (Path("executed"),)


def change(path: Path, **parts) -> Path:
    """The checkpoint with some of its parts replaced, or with None removed."""
    state = torch.load(path, weights_only=True) | parts
    refineppo.save_checkpoint(path, {name: part for name, part in state.items() if part is not None})
    return path


def torn(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def with_arg(path: Path, **args) -> Path:
    return change(path, args=torch.load(path, weights_only=True)["args"] | args)


def with_log_std(path: Path, value: torch.Tensor) -> Path:
    return change(path, params=torch.load(path, weights_only=True)["params"] | {"log_std": value})


def with_nan_statistics(path: Path) -> Path:
    statistics = torch.load(path, weights_only=True)["normalizer"]
    statistics["obs.mean"].fill_(float("nan"))
    return change(path, normalizer=statistics)


def other(path: Path, env_id="Reacher-v5", **flags) -> list[Path]:
    """The checkpoint and a second one."""
    return [path, save(path.with_name("other.pt"), env_id, **flags)]


BAD_INPUT = {  # what is done with a checkpoint -> what the refusal says
    "missing file": (lambda path: [path.with_name("no.pt")], "there is no checkpoint"),
    "folder": (lambda path: [path.parent], "there is no checkpoint"),
    "torn": (lambda path: [torn(path)], "damaged"),
    "malicious": (lambda path: [torch.save({"args": Malicious()}, path) or path], "damaged"),
    "foreign": (lambda path: [path.write_bytes(pickle.dumps({"args": {}})) and path], "damaged"),
    "part missing": (lambda path: [change(path, params=None)], "damaged"),
    "other shapes": (lambda path: [with_log_std(path, torch.zeros(3))], "does not fit"),
    "nan": (lambda path: [with_log_std(path, torch.full((2,), float("nan")))], "not finite"),
    "nan in the statistics": (lambda path: [with_nan_statistics(path)], "not finite"),
    "ppo": (lambda path: [change(path, args=asdict(ppo_continuous.Args()))], "PPO"),
    "one step": (lambda path: [save(path, refinement_depth=1)], "K = 1"),
    "missing package": (lambda path: [with_arg(path, env_id="no_such_module:Task-v0")], "no_such_module"),
    "second one bad": (lambda path: [path, torn(save(path.with_name("last.pt")))], "damaged"),
    "twice": (lambda path: [path, path.parent / "." / path.name], "twice"),
    "two tasks": (lambda path: other(path, "Pendulum-v1"), "same task"),
    "two depths": (lambda path: other(path, refinement_depth=3), "depth"),
    "two schedules": (lambda path: other(path, refinement_schedule="uniform"), "schedule"),
    "no checkpoint": (lambda path: [], "at least one"),
    "no section": (lambda path: [path, "--sections"], "at least one"),
    "only r2 of one component": (lambda path: [save(path, "Pendulum-v1"), "--sections", "r2"], "delta R^2"),
    "one training step": (lambda path: [path, "--sections", "training"], "two or more"),
    "seeds for training": (lambda path: [*other(path, seed=2, step=4), "--sections", "training"], "two or more"),
    "fewer states than folds": (lambda path: [path, "--num-states", 4], "at least 10"),
    "one state in a fold": (lambda path: [path, "--num-states", 9], "at least 10"),
    "one episode": (lambda path: [path, "--episodes", 1], "--episodes"),
    "negative seed": (lambda path: [path, "--seed", -1], "--seed"),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_refused(case, tmp_path, analyse, capsys, monkeypatch):
    """One sentence, exit 2, no output folder, and nothing in the file is executed."""
    monkeypatch.chdir(tmp_path)
    make_flags, expected = BAD_INPUT[case]
    flags = make_flags(save(tmp_path / "in/best.pt"))
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit:
        analyse("--out-dir", tmp_path / "out", "--checkpoint", *flags)
    assert exit.value.code == 2
    printed = capsys.readouterr()
    assert expected in printed.err
    assert printed.err.startswith("analysis_refinement.py: error: ") and printed.err.count("\n") == 1
    assert printed.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize("out", ["file", "file/folder", "/proc/no/such"])
def test_a_folder_that_cannot_be_written(out, tmp_path, analyse, capsys, monkeypatch):
    """Refused before any work: no episode is run."""
    (tmp_path / "file").touch()
    monkeypatch.setattr(refineppo, "evaluate", None)
    with pytest.raises(SystemExit) as exit:
        analyse("--checkpoint", save(tmp_path / "best.pt"), "--out-dir", tmp_path / out)
    assert exit.value.code == 2
    assert "cannot write to the output folder" in capsys.readouterr().err


def test_a_full_disk_is_one_sentence(tmp_path, analyse, capsys, monkeypatch):
    def full(path, data):
        raise OSError(28, "No space left on device")

    path = save(tmp_path / "best.pt")
    monkeypatch.setattr(refineppo, "write_atomically", full)
    with pytest.raises(SystemExit) as exit:
        analyse("--checkpoint", path, "--num-states", 20, "--sections", "settling")
    assert exit.value.code == 2
    assert "No space left on device" in capsys.readouterr().err
    assert not any((tmp_path / "analysis").iterdir())


# --- The commands -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_training_and_then_its_analysis_as_a_user_types_them(tmp_path):
    """A run of two iterations with --save-every; anytime at k = K is the mean of the run's own result.json."""
    run_dir = tmp_path / "run"
    training = run(
        "refineppo_continuous.py",
        "--env-id",
        "Reacher-v5",
        "--total-timesteps",
        512,
        "--num-steps",
        256,
        "--num-minibatches",
        4,
        "--update-epochs",
        2,
        "--eval-episodes",
        2,
        "--final-eval-episodes",
        4,
        "--save-every",
        256,
        "--no-compile",
        "--no-progress",
        "--run-dir",
        run_dir,
    )
    assert training.returncode == 0, training.stderr
    done = run(
        "analysis_refinement.py",
        "--checkpoint",
        run_dir / "step_256.pt",
        run_dir / "step_512.pt",
        "--num-states",
        40,
        "--episodes",
        4,
        "--sections",
        "settling",
        "r2",
        "anytime",
        "training",
    )
    assert (done.returncode, done.stderr) == (0, "")
    for name in ("settling_error", "delta_r2", "delta_r2_checks", "anytime", "anytime_scaled", "training"):
        assert header(run_dir / f"analysis/{name}.csv") == "checkpoint," + COLUMNS[name]
        assert name in done.stdout
    rows = [row for row in read(run_dir / "analysis/anytime.csv") if row["checkpoint"].endswith("step_512.pt")]
    result = json.loads((run_dir / "result.json").read_text())
    assert float(rows[4]["return_mean"]) == result["last"]["mean"]
    assert float(rows[4]["return_std"]) == result["last"]["std"]
