"""analysis_refinement.py as a user runs it: its files, several checkpoints, every section, and what it refuses."""

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from unittest import mock

import gymnasium as gym
import matplotlib.image
import numpy as np
import pandas as pd
import pytest
import torch
from conftest import check_picture, run
from test_analysis import save
from test_commands import call_main
from test_failures import Malicious

import analysis_refinement as analysis
import ppo_continuous
import refineppo_continuous as refineppo

analyse = partial(call_main, analysis)  # `python analysis_refinement.py FLAGS`, in this process
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
SECTIONS = {  # and their tables
    "settling": ["settling_error"],
    "r2": ["delta_r2", "delta_r2_checks"],
    "feedback": ["feedback"],
    "anytime": ["anytime", "anytime_scaled"],
    "adaptive": ["adaptive"],
    "dynamics": ["dynamics"],
}


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Few shuffles, fitted states, episodes and tolerances."""
    for name, value in {"SHUFFLES": 4, "FIT_STATES": 200, "FEEDBACK_EPISODES": 2, "TOLERANCES": 3}.items():
        monkeypatch.setattr(analysis, name, value)


def assert_complete(folder: Path, *tables: str, first=(), across=()):
    """These tables and a figure of each, if it has one of its own, and no others; the tables have their columns."""
    pictures = {f"{name}.png" for name in tables} - {"anytime_scaled.png", "delta_r2_checks.png"}
    names = {f"{name}.csv" for name in tables} | {f"{name}_across_seeds.csv" for name in across} | {"summary.json"}
    assert {path.name for path in folder.iterdir()} == names | pictures
    for name in tables:
        assert [*pd.read_csv(folder / f"{name}.csv")] == [*first, *COLUMNS[name].split(",")]
    for path in folder.glob("*.png"):
        check_picture(path)


def test_the_papers_two_analyses_are_the_default(tmp_path, capsys):
    path, out = save(tmp_path / "best.pt"), tmp_path / "analysis"
    analyse("--checkpoint", path, "--num-states", 40)
    assert_complete(out, "settling_error", "delta_r2", "delta_r2_checks")
    policy = analysis.load_policy(path)
    states, _ = analysis.record_states(policy, analysis.Args(checkpoint=(), num_states=40))
    error = analysis.settling_error(policy.proposals(states).astype(float))
    early, late = np.argsort(error[1])
    rows = pd.read_csv(out / "settling_error.csv")
    expected = [[f"joint{j}", rank, k] for rank, j in ((1, early), (2, late)) for k in range(5)]
    assert rows[["component", "rank", "step"]].to_numpy().tolist() == expected
    assert rows.error.tolist() == pytest.approx([*error[:, early], *error[:, late]], rel=1e-12)
    summary = json.loads((out / "summary.json").read_text())
    facts = {"global_step": 2048, "env_id": "Reacher-v5", "seed": 1, "refinement_depth": 4}
    assert summary["checkpoints"][str(path)].items() >= facts.items()
    assert summary["settling_error"][str(path)][f"joint{late}"]["4"] == 0
    printed = capsys.readouterr().out
    assert f"joint{late}" in printed and "delta_r2_checks" in printed and str(out) in printed


def test_seventeen_actions(tmp_path):
    """HumanoidStandup-v5 with short episodes: five early and five late components, all named after their joints."""
    gym.register("ShortStandup-v0", "gymnasium.envs.mujoco.humanoidstandup_v5:HumanoidStandupEnv", max_episode_steps=8)
    path = save(tmp_path / "best.pt", "ShortStandup-v0", refinement_schedule="inverse", refinement_depth=3)
    analyse("--checkpoint", path, "--num-states", 80, "--out-dir", tmp_path / "out")
    ordered = pd.read_csv(tmp_path / "out/settling_error.csv").query("step == 1").component.tolist()
    assert len(set(ordered)) == 17 and {"abdomen_y", "right_knee", "left_elbow"} < set(ordered)
    assert pd.read_csv(tmp_path / "out/delta_r2.csv").component.tolist() == np.repeat(ordered[-5:], 2).tolist()


@pytest.mark.parametrize("section", SECTIONS)
def test_a_section_alone(section, tmp_path, capsys):
    path, tables = save(tmp_path / "best.pt"), SECTIONS[section]
    analyse("--checkpoint", path, "--sections", section, "--num-states", 20, "--episodes", 2)
    assert_complete(tmp_path / "analysis", *tables)
    summary = json.loads((tmp_path / "analysis/summary.json").read_text())
    assert set(summary) == {"flags", "checkpoints", *tables}
    printed = capsys.readouterr().out
    assert all(f"\n{name}\n" in printed for name in tables)


@pytest.mark.slow
def test_seeds_of_one_setting(tmp_path):
    """Each seed's own rows as if analysed alone, and beside them the mean and standard deviation across the seeds, of
    delta R^2 also where a component is late in some of them only."""
    paths = [save(tmp_path / f"seed-{seed}/best.pt", "Hopper-v5", seed=seed) for seed in (1, 2, 3)]
    flags = "--num-states", 30, "--episodes", 2, "--sections", *SECTIONS
    analyse("--checkpoint", *paths, *flags)
    analyse("--checkpoint", paths[1], *flags)
    out, alone = tmp_path / "seed-1/analysis", tmp_path / "seed-2/analysis"
    names = [name for tables in SECTIONS.values() for name in tables]
    assert_complete(out, *names, first=["checkpoint"], across=names)
    assert_complete(alone, *names)
    for name in names:
        rows = pd.read_csv(out / f"{name}.csv")
        own = rows[rows.checkpoint == str(paths[1])].drop(columns="checkpoint").reset_index(drop=True)
        pd.testing.assert_frame_equal(own, pd.read_csv(alone / f"{name}.csv"), check_exact=True)
    for name, value in (("settling_error", "error"), ("delta_r2", "delta_r2")):
        keys = ["component", "step" if name == "settling_error" else "step_from"]
        groups = pd.read_csv(out / f"{name}.csv").groupby(keys)[value]
        across = pd.read_csv(out / f"{name}_across_seeds.csv").set_index(keys)
        assert across.seeds.to_dict() == groups.size().to_dict()
        assert across[f"{value}_mean"].to_dict() == pytest.approx(groups.mean().to_dict())
        assert across[f"{value}_std"].to_dict() == pytest.approx(groups.std(ddof=1).fillna(0).to_dict())
    assert set(across.seeds) == {1, 2}


def test_checkpoints_that_look_alike_keep_their_own_panels(tmp_path):
    """best.pt and last.pt of one step: no mean across seeds, and the picture is as wide as two panels."""
    paths = [save(tmp_path / name) for name in ("best.pt", "last.pt")]
    analyse("--checkpoint", *paths, "--num-states", 20, "--sections", "settling")
    analyse("--checkpoint", paths[0], "--num-states", 20, "--sections", "settling", "--out-dir", tmp_path / "one")
    assert_complete(tmp_path / "analysis", "settling_error", first=["checkpoint"])
    widths = [matplotlib.image.imread(tmp_path / name / "settling_error.png").shape[1] for name in ("analysis", "one")]
    assert widths[0] > widths[1]


def test_tolerances_that_do_not_exist_are_named(tmp_path, capsys):
    """All corrections of all states have the same size: a tolerance stops every state after one step, or none."""
    path = change(save(tmp_path / "best.pt", scale=0), params={"actor.2.bias": torch.full((2,), 0.1)})
    analyse("--checkpoint", path, "--num-states", 20, "--sections", "adaptive")
    assert set(pd.read_csv(tmp_path / "analysis/adaptive.csv").steps_mean) == {1, 4}
    assert "no tolerance was found that takes between 1.00 and 4.00 steps" in capsys.readouterr().out


def test_a_one_dimensional_action_has_no_delta_r2(tmp_path, capsys):
    analyse("--checkpoint", save(tmp_path / "best.pt", "Pendulum-v1"), "--num-states", 20)
    assert_complete(tmp_path / "analysis", "settling_error")
    assert "no delta R^2" in capsys.readouterr().out


# --- Bad input --------------------------------------------------------------------------------------------------------


def change(path: Path, **parts) -> Path:
    """The checkpoint with some values of its parts replaced."""
    state = torch.load(path, weights_only=True)
    refineppo.save_checkpoint(path, state | {name: state[name] | part for name, part in parts.items()})
    return path


def of_ppo(path: Path) -> Path:
    state = torch.load(path, weights_only=True)
    refineppo.save_checkpoint(path, state | {"args": asdict(ppo_continuous.Args(env_id="Reacher-v5"))})
    return path


def other(path: Path, env_id="Reacher-v5", **flags) -> list[Path]:
    """The checkpoint and a second one."""
    return [path, save(path.with_name("other.pt"), env_id, **flags)]


NAN = torch.tensor(float("nan"))
BAD_INPUT = {  # what is done with a checkpoint -> what the refusal says
    "missing file": (lambda path: [path.with_name("no.pt")], "there is no checkpoint"),
    "malicious": (lambda path: [torch.save({"args": Malicious()}, path) or path], "damaged"),
    "other shapes": (lambda path: [change(path, params={"log_std": torch.zeros(3)})], "does not fit"),
    "nan": (lambda path: [change(path, params={"log_std": NAN.expand(2)})], "not finite"),
    "nan in the statistics": (lambda path: [change(path, normalizer={"obs.mean": NAN.expand(10)})], "not finite"),
    "ppo": (lambda path: [of_ppo(path)], "not written by"),
    "one step, the second": (lambda path: other(path, refinement_depth=1), "K = 1"),
    "missing package": (lambda path: [change(path, args={"env_id": "no_such_module:Task-v0"})], "no_such_module"),
    "twice": (lambda path: [path, path.parent / "." / path.name], "twice"),
    "two tasks": (lambda path: other(path, "Pendulum-v1"), "same task"),
    "two depths": (lambda path: other(path, refinement_depth=3), "depth"),
    "two schedules": (lambda path: other(path, refinement_schedule="uniform"), "schedule"),
    "no checkpoint": (lambda path: [], "at least one"),
    "no section": (lambda path: [path, "--sections"], "at least one"),
    "seeds for training": (lambda path: [*other(path, seed=2, step=4), "--sections", "training"], "two or more"),
    "one state in a fold": (lambda path: [path, "--num-states", 9], "at least 10"),
    "one episode": (lambda path: [path, "--episodes", 1], "--episodes"),
    "negative seed": (lambda path: [path, "--seed", -1], "--seed"),
}


def refusal(capsys, *flags) -> tuple[str, str]:
    """stdout and stderr of a command that must end with exit code 2 and one sentence."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit:
        analyse(*flags)
    assert exit.value.code == 2
    out, err = capsys.readouterr()
    assert err.startswith("analysis_refinement.py: error: ") and err.count("\n") == 1
    return out, err


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_refused(case, tmp_path, capsys, monkeypatch):
    """Before any work, without an output folder, and nothing in the file is executed."""
    monkeypatch.chdir(tmp_path)
    make_flags, expected = BAD_INPUT[case]
    flags = make_flags(save(tmp_path / "in/best.pt"))
    out, err = refusal(capsys, "--out-dir", tmp_path / "out", "--checkpoint", *flags)
    assert out == "" and expected in err
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize("out", ["file/folder", "/proc"])
def test_a_folder_that_cannot_be_written(out, tmp_path, capsys, monkeypatch):
    """Refused before any work: no episode is run."""
    (tmp_path / "file").touch()
    monkeypatch.setattr(refineppo, "evaluate", None)
    flags = "--checkpoint", save(tmp_path / "best.pt"), "--out-dir", tmp_path / out
    assert "cannot write to the output folder" in refusal(capsys, *flags)[1]


def test_a_full_disk_is_one_sentence(tmp_path, capsys, monkeypatch):
    path, full = save(tmp_path / "best.pt"), OSError(28, "No space left on device")
    monkeypatch.setattr(refineppo, "write_atomically", mock.Mock(side_effect=full))
    flags = "--checkpoint", path, "--num-states", 20, "--sections", "settling"
    assert "No space left on device" in refusal(capsys, *flags)[1]


# --- The commands -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_training_and_then_its_analysis_as_a_user_types_them(tmp_path):
    """A run of two iterations with --save-every; anytime at k = K is the mean of the run's own result.json."""
    run_dir = tmp_path / "run"
    flags = "--env-id Reacher-v5 --total-timesteps 512 --num-steps 256 --num-minibatches 4 --update-epochs 2"
    flags += " --save-every 256 --eval-episodes 2 --final-eval-episodes 4 --no-compile --no-progress --run-dir"
    training = run("refineppo_continuous.py", *flags.split(), run_dir)
    assert training.returncode == 0, training.stderr
    flags = "--num-states 40 --episodes 4 --sections settling r2 anytime training --checkpoint"
    done = run("analysis_refinement.py", *flags.split(), run_dir / "step_256.pt", run_dir / "step_512.pt")
    assert (done.returncode, done.stderr) == (0, "")
    tables = "settling_error", "delta_r2", "delta_r2_checks", "anytime", "anytime_scaled", "training"
    assert_complete(run_dir / "analysis", *tables, first=["checkpoint"])
    assert all(name in done.stdout for name in tables)
    rows = pd.read_csv(run_dir / "analysis/anytime.csv", dtype=str).set_index(["checkpoint", "steps"])
    own, last = rows.loc[str(run_dir / "step_512.pt"), "4"], json.loads((run_dir / "result.json").read_text())["last"]
    assert (float(own.return_mean), float(own.return_std)) == (last["mean"], last["std"])
