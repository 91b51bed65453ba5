"""Whole runs: equal seeds give equal numbers, evaluation and saving follow the protocol, flags do what they say."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import files_of, run
from resume_helpers import differences, outcome
from test_commands import QUICK, call_main, read_events, read_json


def train(script, run_dir: Path, env_id: str, *flags) -> Path:
    call_main(script, *QUICK, "--run-dir", run_dir, "--env-id", env_id, *flags)
    return run_dir


def load(run_dir: Path, name: str = "last.pt") -> dict:
    return torch.load(run_dir / name, weights_only=True)


def params(run_dir: Path) -> dict[str, list]:
    return {name: tensor.tolist() for name, tensor in load(run_dir)["params"].items()}


def scalars(run_dir: Path, *prefixes: str) -> dict[str, list[tuple[int, float]]]:
    events = read_events(run_dir)
    tags = [tag for tag in events.Tags()["scalars"] if tag.startswith(prefixes) and tag != "charts/SPS"]
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in tags}


def evaluations(run_dir: Path) -> list[dict[str, float]]:
    rows = csv.DictReader((run_dir / "evaluations.csv").read_text().splitlines())
    return [{name: float(value) for name, value in row.items()} for row in rows]


# --- Seeds ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_same_numbers_in_another_process(script, tmp_path):
    """Of the training, and of a saved policy's evaluation, which leaves the disk as it was."""
    flags = "--env-id Hopper-v5 --num-envs 2 --num-steps 64 --update-epochs 2 --total-timesteps 384 --eval-interval 128"
    flags = (*QUICK, *flags.split(), "--eval-episodes", 2, "--final-eval-episodes", 4)
    call_main(script, *flags, "--run-dir", tmp_path / "here")
    done = run(f"{script.__name__}.py", *flags, "--run-dir", tmp_path / "there", PYTHONHASHSEED="7")
    assert done.returncode == 0, done.stderr
    one, other = outcome(tmp_path / "here"), outcome(tmp_path / "there")
    assert differences(one, other) == []
    assert {"last.pt/params/log_std", "evaluations.csv", "result.json/best/mean", "losses/approx_kl"} <= one.keys()

    before = files_of(tmp_path)
    for name in ("best", "last"):
        final = read_json(tmp_path / "here/result.json")[name]
        checkpoint = tmp_path / f"here/{name}.pt"
        done = run(f"{script.__name__}.py", "--evaluate", checkpoint, "--final-eval-episodes", 4)
        assert done.returncode == 0 and done.stderr == ""
        assert re.findall(r"return (\S+), length \d+\n", done.stdout) == [f"{x:.3f}" for x in final["returns"]]
        assert f"mean return {final['mean']:.3f}, std {final['std']:.3f}" in done.stdout
    assert before == files_of(tmp_path)


def test_another_seed_other_numbers(script, tmp_path):
    one, other = (train(script, tmp_path / str(seed), "Pendulum-v1", "--seed", seed) for seed in (1, 2))
    assert [name for name, value in params(one).items() if value == params(other)[name]] == []
    assert evaluations(one) != evaluations(other)
    assert read_json(one / "result.json")["last"]["returns"] != read_json(other / "result.json")["last"]["returns"]


def test_evaluation_changes_no_training_number(script, tmp_path):
    flags = ("Hopper-v5", "--num-envs", 2, "--total-timesteps", 320)
    often = train(script, tmp_path / "often", *flags, "--eval-interval", 1, "--eval-episodes", 3)
    rarely = train(script, tmp_path / "rarely", *flags, "--eval-interval", 10**9)
    assert (len(evaluations(often)), len(evaluations(rarely))) == (5, 1)
    assert params(often) == params(rarely)
    training = scalars(often, "charts/", "losses/", "refinement/")
    assert training == scalars(rarely, "charts/", "losses/", "refinement/")
    assert len(training["losses/policy_loss"]) == 5 and len(training["charts/episodic_return"]) > 2


# --- Evaluation -------------------------------------------------------------------------------------------------------

# iterations end at 32, 64, ..., 320; for an interval of 50, due at the first end at or after 50, 100, ..., 300
DUE = {50: [64, 128, 160, 224, 256, 320], 160: [160, 320], 33: [*range(64, 321, 32)], 999: [320]}


@pytest.mark.parametrize("interval, due", DUE.items())
def test_when_evaluation_happens(script, tmp_path, interval, due):
    flags = ("--total-timesteps", 330, "--eval-interval", interval)
    run_dir = train(script, tmp_path, "probe_envs:Counter-v0", *flags)
    assert [row["global_step"] for row in evaluations(run_dir)] == due
    assert [step for step, _ in scalars(run_dir, "eval/")["eval/return_mean"]] == due


def test_evaluations_and_what_is_made_of_them(script, tmp_path, monkeypatch):
    """Statistics and the best checkpoint, against the returns of every evaluation; each has seeds of its own."""
    original, recorded = script.evaluate, []

    def evaluate(agent, seeds, *more):
        recorded.append((seeds, *original(agent, seeds, *more)))
        return recorded[-1][1:]

    monkeypatch.setattr(script, "evaluate", evaluate)
    flags = "--total-timesteps 256 --eval-interval 32 --eval-episodes 3 --final-eval-episodes 4 --seed 3"
    run_dir = train(script, tmp_path, "Pendulum-v1", *flags.split())
    rows, (*during, best_final, last_final) = evaluations(run_dir), recorded
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
    seeds, returns, _ = during[rows.index(best)]
    assert original(script.load_agent(run_dir / "best.pt"), seeds)[0].tolist() == returns.tolist()
    for name, (_, returns, _) in (("best", best_final), ("last", last_final)):
        assert result[name]["returns"] == list(returns) and len(returns) == 4
        assert result[name]["mean"] == pytest.approx(sum(returns) / 4)
        assert result[name]["std"] == pytest.approx(np.std(returns, ddof=1))

    used = [seed for seeds, _, _ in recorded for seed in seeds]
    training = {script.episode_seeds(3, 0, 0, episode)[0] for episode in range(2)}
    assert len(set(used)) == 8 * 3 + 2 * 4 and not training & set(used)


def test_tracked_policy_is_evaluated_without_wandb(script, tmp_path, monkeypatch, capsys):
    state = load(train(script, tmp_path / "run", "Pendulum-v1"))
    torch.save(state | {"args": state["args"] | {"track": True}}, tmp_path / "tracked.pt")
    monkeypatch.setattr(script, "find_spec", lambda name: None)
    call_main(script, "--evaluate", tmp_path / "tracked.pt")
    assert "mean return" in capsys.readouterr().out


# --- Results and flags ------------------------------------------------------------------------------------------------


def test_training_return_of_the_last_tenth(script, tmp_path):
    flags = ("--num-envs", 2, "--total-timesteps", 640)
    run_dir = train(script, tmp_path / "short", "probe_envs:MatchAction-v0", *flags)
    episodes = scalars(run_dir, "charts/")["charts/episodic_return"]
    late = [value for step, value in episodes if step > 576]
    assert (len(episodes), len(late)) == (640, 64)
    assert read_json(run_dir / "result.json")["train_return_last10pct"] == pytest.approx(sum(late) / 64, rel=1e-6)
    run_dir = train(script, tmp_path / "long", "Pendulum-v1", "--total-timesteps", 256)  # its one episode ends at 200
    assert read_json(run_dir / "result.json")["train_return_last10pct"] is None


def test_what_can_be_turned_off(script, tmp_path):
    """The annealing; and a minibatch may have a single step where advantages are not normalised."""
    flags = ("--num-minibatches", 32, "--no-norm-adv", "--no-anneal-lr", "--learning-rate", 0.01)
    run_dir = train(script, tmp_path, "probe_envs:Counter-v0", *flags)
    assert [rate for _, rate in scalars(run_dir, "charts/")["charts/learning_rate"]] == pytest.approx([0.01] * 2)
