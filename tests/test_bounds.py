"""sweeps/bounds.csv and sweeps/paper_results.csv: what they hold, against Gymnasium and the random policy run again."""

from statistics import mean, stdev

import gymnasium as gym
import pytest
from test_report import BOUNDS, PAPER

from sweeps import bounds


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
        assert gym.make(row["task"]).observation_space.shape == (int(row["obs_dim"]),)
        assert float(row["random_return"]) < float(row["reference_return"]) and row["random_episodes"] == "100"
        if row["reference"] == "Gymnasium's reward threshold":
            assert float(row["reference_return"]) == gym.spec(row["task"]).reward_threshold != 0
    others = {row["task"]: row["reference_return"] for row in BOUNDS if not row["reference"].startswith("Gymnasium")}
    of_the_paper = {"Walker2d-v5": "5810", "Humanoid-v5": "3060", "HumanoidStandup-v5": "165067", "Pusher-v5": "-37"}
    assert others == of_the_paper | {"Pendulum-v1": "-230.42"}
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
