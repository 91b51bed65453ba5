"""sweeps/bounds.csv and sweeps/paper_results.csv: what they hold, against Gymnasium and the random policy run again."""

from statistics import mean, stdev

import gymnasium as gym
import pytest
from test_report import BOUNDS, PAPER

from sweeps import bounds


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
