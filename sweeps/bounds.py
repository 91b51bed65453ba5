"""Fixed bounds to normalise returns by, so that tasks can be averaged: 0 is the random policy, 1 a named reference.

    python sweeps/bounds.py

Measures the uniform random policy on every task of the paper, in two minutes, and writes sweeps/bounds.csv, which
sweeps/report.py reads. The reference is Gymnasium's reward threshold. Where there is none (or, for Pusher, one that no
policy can reach) it is the better method of the paper's Table 1; for Pendulum, which neither method solves there, the
PPO of RL Baselines3 Zoo.
"""

import csv
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro

HERE = Path(__file__).resolve().parent
EPISODES, SEED = 100, 0  # of the random policy on each task
UNREACHABLE = ("Pusher-v5",)  # its threshold is 0, and every reward is negative
PUBLISHED = {"Pendulum-v1": (-230.42, "sb3/ppo-Pendulum-v1, RL Baselines3 Zoo")}


def random_returns(task: str, episodes: int, seed: int) -> np.ndarray:
    """Returns of episodes with actions drawn uniformly from the action space, (episodes,)."""
    env, returns = gym.make(task, disable_env_checker=True), np.zeros(episodes)
    env.action_space.seed(seed)
    for i in range(episodes):
        env.reset(seed=seed if i == 0 else None)
        done = False
        while not done:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            returns[i] += reward
            done = terminated or truncated
    env.close()
    return returns


def obs_dim(task: str) -> int:
    """Numbers in an observation; the report counts an actor's parameters by it."""
    env = gym.make(task, disable_env_checker=True)
    env.close()
    return gym.spaces.flatdim(env.observation_space)


def reference(task: str, paper: list[dict]) -> tuple[float, str]:
    """The return that counts as 1, and where it comes from."""
    threshold = gym.spec(task).reward_threshold
    if threshold is not None and task not in UNREACHABLE:
        return threshold, "Gymnasium's reward threshold"
    if task in PUBLISHED:
        return PUBLISHED[task]
    best = max((row for row in paper if row["task"] == task), key=lambda row: float(row["mean"]))
    return float(best["mean"]), f"{best['method']} in the paper's Table 1"


def main():
    with open(HERE / "paper_results.csv", newline="") as file:
        paper = [row for row in csv.DictReader(file) if row["table"] == "1"]
    rows = []
    for task in dict.fromkeys(row["task"] for row in paper):
        returns, (best, source) = random_returns(task, EPISODES, SEED), reference(task, paper)
        rows.append(
            [task, obs_dim(task), f"{returns.mean():.6g}", f"{returns.std(ddof=1):.6g}", EPISODES, f"{best:g}", source]
        )
        print(*rows[-1], sep=", ", flush=True)
    with open(HERE / "bounds.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(
            ["task", "obs_dim", "random_return", "random_std", "random_episodes", "reference_return", "reference"]
        )
        writer.writerows(rows)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
