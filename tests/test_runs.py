"""Whole runs: equal seeds give equal numbers, evaluation and saving follow the protocol, flags do what they say."""

import csv
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT, run
from resume_helpers import differences, outcome
from test_commands import QUICK, call_main, read_events, read_json

PENDULUM = (*QUICK, "--env-id", "Pendulum-v1")


def train(script, run_dir: Path, *flags) -> Path:
    call_main(script, *QUICK, "--run-dir", run_dir, *flags)
    return run_dir


def load(run_dir: Path, name: str = "last.pt") -> dict:
    return torch.load(run_dir / name, weights_only=True)


def params(run_dir: Path) -> dict[str, list]:
    return {name: tensor.tolist() for name, tensor in load(run_dir)["params"].items()}


def scalars(run_dir: Path, *prefixes: str) -> dict[str, list[tuple[int, float]]]:
    events = read_events(run_dir)
    tags = [tag for tag in events.Tags()["scalars"] if tag.startswith(prefixes) and tag != "charts/SPS"]
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in tags}


def values(run_dir: Path, tag: str) -> list[float]:
    return [value for _, value in scalars(run_dir, tag)[tag]]


def evaluations(run_dir: Path) -> list[dict[str, float]]:
    rows = csv.DictReader((run_dir / "evaluations.csv").read_text().splitlines())
    return [{name: float(value) for name, value in row.items()} for row in rows]


# --- Seeds ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_same_seed_same_numbers_in_another_process(script, tmp_path):
    flags = "--env-id Hopper-v5 --num-envs 2 --num-steps 64 --update-epochs 2 --total-timesteps 384 --eval-interval 128"
    flags = (*flags.split(), "--eval-episodes", 2)
    here = train(script, tmp_path / "here", *flags)
    done = run(f"{script.__name__}.py", *QUICK, *flags, "--run-dir", tmp_path / "there", PYTHONHASHSEED="7")
    assert done.returncode == 0, done.stderr
    one, other = outcome(here), outcome(tmp_path / "there")
    assert differences(one, other) == []
    assert {"last.pt/params/log_std", "evaluations.csv", "result.json/best/mean", "losses/approx_kl"} <= one.keys()


def test_another_seed_other_numbers(script, tmp_path):
    one, other = (train(script, tmp_path / str(seed), "--env-id", "Pendulum-v1", "--seed", seed) for seed in (1, 2))
    same = [name for name, value in params(one).items() if value == params(other)[name]]
    assert same == []
    assert evaluations(one) != evaluations(other)
    assert read_json(one / "result.json")["last"]["returns"] != read_json(other / "result.json")["last"]["returns"]


def test_evaluation_changes_no_training_number(script, tmp_path):
    flags = ("--env-id", "Hopper-v5", "--num-envs", 2, "--total-timesteps", 320)
    often = train(script, tmp_path / "often", *flags, "--eval-interval", 1, "--eval-episodes", 3)
    rarely = train(script, tmp_path / "rarely", *flags, "--eval-interval", 10**9)
    assert (len(evaluations(often)), len(evaluations(rarely))) == (5, 1)
    assert params(often) == params(rarely)
    training = scalars(often, "charts/", "losses/", "refinement/")
    assert training == scalars(rarely, "charts/", "losses/", "refinement/")
    assert len(training["losses/policy_loss"]) == 5 and len(training["charts/episodic_return"]) > 2


# --- Evaluation -------------------------------------------------------------------------------------------------------


# iterations end at 32, 64, ..., 320; for an interval of 50, due at the first end at or after 50, 100, ..., 300
DUE = {
    50: [64, 128, 160, 224, 256, 320],
    160: [160, 320],
    33: [*range(64, 321, 32)],
    1: [*range(32, 321, 32)],
    999: [320],
}


@pytest.mark.parametrize("interval, due", DUE.items())
def test_when_evaluation_happens(script, tmp_path, interval, due):
    flags = ("--env-id", "probe_envs:Counter-v0", "--total-timesteps", 330, "--eval-interval", interval)
    run_dir = train(script, tmp_path, *flags)
    assert [row["global_step"] for row in evaluations(run_dir)] == due
    assert [step for step, _ in scalars(run_dir, "eval/")["eval/return_mean"]] == due


@pytest.fixture
def recorded(script, monkeypatch):
    """The seeds and returns of every evaluation, in order."""
    original, calls = script.evaluate, []

    def evaluate(agent, seeds, *more):
        returns, lengths = original(agent, seeds, *more)
        calls.append((seeds, returns, lengths))
        return returns, lengths

    monkeypatch.setattr(script, "evaluate", evaluate)
    return calls


EVALUATED = "--env-id Pendulum-v1 --total-timesteps 256 --eval-interval 32 --eval-episodes 3 --final-eval-episodes 4"


def test_best_checkpoint_and_statistics(script, tmp_path, recorded):
    run_dir = train(script, tmp_path, *EVALUATED.split(), "--seed", 3)
    rows = evaluations(run_dir)
    *during, best_final, last_final = recorded
    assert len(rows) == len(during) == 8
    for row, (_, returns, lengths) in zip(rows, during):
        assert row["return_mean"] == pytest.approx(sum(returns) / 3)
        assert row["return_std"] == pytest.approx((sum((x - sum(returns) / 3) ** 2 for x in returns) / 2) ** 0.5)
        assert (row["return_min"], row["return_max"]) == (min(returns), max(returns))
        assert row["length_mean"] == sum(lengths) / 3
    best = max(rows, key=lambda row: row["return_mean"])
    assert best is not rows[-1]  # with this seed an earlier policy is the best
    result, checkpoint = read_json(run_dir / "result.json"), load(run_dir, "best.pt")
    assert checkpoint["global_step"] == result["best"]["global_step"] == best["global_step"]
    assert checkpoint["selection_return"] == result["best"]["selection_return"] == best["return_mean"]
    for name, (_, returns, _) in (("best", best_final), ("last", last_final)):
        assert result[name]["returns"] == list(returns) and len(returns) == 4
        assert result[name]["mean"] == pytest.approx(sum(returns) / 4)
        assert result[name]["std"] == pytest.approx(np.std(returns, ddof=1))


def test_every_evaluation_has_seeds_of_its_own(script, tmp_path, recorded, monkeypatch):
    train(script, tmp_path, *EVALUATED.split(), "--seed", 3)
    *during, best_final, last_final = ([*map(int, seeds)] for seeds, _, _ in recorded)
    earlier = [seed for seeds in during for seed in seeds]
    assert len(set(earlier)) == len(earlier) == 24
    assert len(set(best_final + last_final)) == 8
    assert not set(earlier) & set(best_final + last_final)
    training = {script.episode_seeds(3, 0, 0, episode)[0] for episode in range(2)}
    assert not training & set(earlier + best_final + last_final)


@pytest.mark.slow
def test_saved_policy_evaluated_in_another_process(script, tmp_path):
    run_dir = train(script, tmp_path / "run", *EVALUATED.split(), "--seed", 3)
    result = read_json(run_dir / "result.json")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for name in ("best", "last"):
        done = run(f"{script.__name__}.py", "--evaluate", run_dir / f"{name}.pt", "--final-eval-episodes", 4)
        assert done.returncode == 0 and done.stderr == ""
        printed = re.findall(r"return (\S+), length 200\n", done.stdout)
        assert printed == [f"{value:.3f}" for value in result[name]["returns"]]
        assert f"mean return {result[name]['mean']:.3f}, std {result[name]['std']:.3f}" in done.stdout
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


def test_tracked_policy_is_evaluated_without_wandb(script, tmp_path, monkeypatch, capsys):
    state = load(train(script, tmp_path / "run", "--env-id", "Pendulum-v1"))
    state["args"]["track"] = True
    torch.save(state, tmp_path / "tracked.pt")
    monkeypatch.setattr(script, "find_spec", lambda name: None)
    call_main(script, *QUICK, "--evaluate", tmp_path / "tracked.pt")
    assert "mean return" in capsys.readouterr().out


@pytest.mark.slow
def test_actions_in_another_process(script, tmp_path, monkeypatch):
    """The actions of the live agent, before it was ever saved, against those of last.pt in a new process."""
    original, actions = script.evaluate, []
    obs = np.random.default_rng(0).normal(size=(50, 11)) * 3

    def evaluate(agent, *more):
        actions.append(agent.act(obs))
        return original(agent, *more)

    monkeypatch.setattr(script, "evaluate", evaluate)
    run_dir = train(script, tmp_path, "--env-id", "Hopper-v5", "--num-envs", 2)
    np.save(tmp_path / "obs.npy", obs)
    act = f"import numpy, {script.__name__} as s; numpy.save(OUT, s.load_agent(LAST).act(numpy.load(OBS)))"
    for name, file in (("OUT", "out.npy"), ("LAST", "last.pt"), ("OBS", "obs.npy")):
        act = act.replace(name, repr(str(run_dir / file)))
    subprocess.run([sys.executable, "-c", act], cwd=ROOT, check=True)
    assert np.array_equal(np.load(tmp_path / "out.npy"), actions[0])


# --- Files and names --------------------------------------------------------------------------------------------------


def test_default_folder(script, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = int(time.time())
    call_main(script, *PENDULUM, "--seed", 7)
    call_main(script, *PENDULUM, "--seed", 8, "--exp-name", "mine")
    names = sorted(path.name for path in (tmp_path / "runs").iterdir())
    patterns = (rf"Pendulum-v1__{script.__name__}__7__(\d+)", r"Pendulum-v1__mine__8__(\d+)")
    for name, pattern in zip(sorted(names, key=lambda name: "mine" in name), patterns):
        assert before <= int(re.fullmatch(pattern, name)[1]) <= time.time()
    assert len(names) == 2


def test_training_return_of_the_last_tenth(script, tmp_path):
    flags = ("--env-id", "probe_envs:MatchAction-v0", "--num-envs", 2, "--total-timesteps", 640)
    run_dir = train(script, tmp_path, *flags)
    episodes = scalars(run_dir, "charts/")["charts/episodic_return"]
    assert len(episodes) == 640
    late = [value for step, value in episodes if step > 576]
    assert len(late) == 64
    assert read_json(run_dir / "result.json")["train_return_last10pct"] == pytest.approx(sum(late) / 64, rel=1e-6)


def test_no_training_return_where_no_episode_ended(script, tmp_path):
    run_dir = train(script, tmp_path, "--env-id", "Pendulum-v1", "--total-timesteps", 256)
    assert [step for step, _ in scalars(run_dir, "charts/")["charts/episodic_return"]] == [200]
    assert read_json(run_dir / "result.json")["train_return_last10pct"] is None


# --- Flags of the training --------------------------------------------------------------------------------------------


def test_bootstrap_truncated_changes_truncated_episodes_only(script, tmp_path):
    for env, changes in (("Counter", True), ("Terminator", False)):
        flags = ("--env-id", f"probe_envs:{env}-v0", "--num-envs", 2, "--total-timesteps", 128)
        off = train(script, tmp_path / f"{env}-off", *flags)
        on = train(script, tmp_path / f"{env}-on", *flags, "--bootstrap-truncated")
        assert (params(on) != params(off)) == changes


@pytest.mark.parametrize("which, statistics", [("obs", "obs"), ("reward", "returns")])
def test_normalisation_can_be_turned_off(script, which, statistics, tmp_path):
    flags = ("--env-id", "probe_envs:Counter-v0", "--num-envs", 2, "--total-timesteps", 128)
    on = load(train(script, tmp_path / "on", *flags))["normalizer"]
    off = load(train(script, tmp_path / "off", *flags, f"--no-normalize-{which}"))["normalizer"]
    # 128 steps and the two first observations, and the last ones of the 9 episodes of 7 steps that each has ended
    assert on["obs.count"].item() == pytest.approx(128 + 2 + 2 * 9)
    assert on["returns.count"].item() == pytest.approx(128)
    assert off[f"{statistics}.count"].item() == 1e-4
    assert not off[f"{statistics}.mean"].any()


def test_learning_rate_is_annealed(script, tmp_path):
    flags = ("--env-id", "Pendulum-v1", "--total-timesteps", 128, "--learning-rate", 0.01)
    for flag, rates in (("--anneal-lr", [0.01, 0.0075, 0.005, 0.0025]), ("--no-anneal-lr", [0.01] * 4)):
        run_dir = train(script, tmp_path / flag, *flags, flag)
        assert values(run_dir, "charts/learning_rate") == pytest.approx(rates)


def test_advantages_need_not_be_normalised(script, tmp_path):
    """In the first minibatch the ratio is 1, and the policy loss minus the mean advantage: 0 once it is normalised."""
    flags = ("--env-id", "probe_envs:Counter-v0", "--num-minibatches", 1)
    on, off = (train(script, tmp_path / flag, *flags, flag) for flag in ("--norm-adv", "--no-norm-adv"))
    train(script, tmp_path / "minibatches of one step", *flags[:-1], 32, "--no-norm-adv")
    assert abs(values(on, "losses/policy_loss")[0]) < 1e-6
    assert values(off, "losses/policy_loss")[0] < -0.1


@pytest.mark.parametrize("epochs", [1, 4])
def test_value_loss_need_not_be_clipped(script, epochs, tmp_path):
    """The clip matters from the second epoch on: in the first the value has not moved."""
    flags = ("--env-id", "probe_envs:Counter-v0", "--total-timesteps", 32, "--learning-rate", 0.1)
    flags = (*flags, "--num-minibatches", 1, "--update-epochs", epochs)
    on, off = (train(script, tmp_path / flag, *flags, flag) for flag in ("--clip-vloss", "--no-clip-vloss"))
    (clipped,), (unclipped,) = values(on, "losses/value_loss"), values(off, "losses/value_loss")
    assert clipped == unclipped if epochs == 1 else clipped > unclipped
