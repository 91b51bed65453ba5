"""Both scripts learn the probe environments, through their whole `main`, in seconds each."""

import json
import signal
import sys

import numpy as np
import probe_envs
import pytest
import torch

import ppo_continuous
import refineppo_continuous

FLAGS = """--total-timesteps 6144 --num-steps 512 --num-minibatches 4 --update-epochs 8 --learning-rate 5e-3
           --actor-hidden 32 32 --critic-hidden 32 32 --log-std-init -1 --eval-episodes 1 --final-eval-episodes 100
           --no-compile --no-progress"""


@pytest.fixture
def train(tmp_path, monkeypatch):
    """Train as the command line would; the final policy's mean return over 100 episodes, and its checkpoint."""

    def train(script, env, *flags):
        command = f"{script.__file__} --env-id probe_envs:{env}-v0 --run-dir {tmp_path / 'run'} {FLAGS}"
        monkeypatch.setattr(sys, "argv", [*command.split(), *flags])
        monkeypatch.setattr(signal, "signal", lambda *_: None)
        script.main()
        result = json.loads((tmp_path / "run" / "result.json").read_text())
        return result["last"]["mean"], torch.load(tmp_path / "run" / "last.pt", weights_only=True)

    return train


def test_value_of_a_constant_reward(script, train):
    _, checkpoint = train(script, "ConstantReward", "--no-normalize-reward")
    obs = torch.linspace(-1.5, 1.5, 31)[:, None]  # normalised: uniform, of standard deviation 1
    values = script.critic_value(script.layers(checkpoint["params"], "critic"), obs)
    torch.testing.assert_close(values, torch.ones(31), rtol=0, atol=0.05)


@pytest.mark.parametrize("env", ["MatchAction", "TwoStepCredit"])
def test_right_action_for_the_observation(script, train, env):
    """The best action that ignores the observation s, or what it leads to, loses E[s^2] = 1/3."""
    mean_return, _ = train(script, env)
    assert mean_return > -1 / 3 / 10


@pytest.mark.parametrize(
    "script, flags",
    [
        (ppo_continuous, ()),
        (refineppo_continuous, ("--refinement-depth", "4")),
        (refineppo_continuous, ("--refinement-depth", "2", "--refinement-schedule", "uniform")),
    ],
    ids=["ppo", "depth 4", "depth 2"],
)
def test_coordination(script, flags, train):
    """Far better than the best linear policy, which must leave the second action uncoordinated with the first."""
    s = np.linspace(-1, 1, 1001)
    right = np.stack([probe_envs.phi(s), probe_envs.psi(s, probe_envs.phi(s))], axis=1)
    inputs = np.stack([s, np.ones_like(s)], axis=1)
    linear = inputs @ np.linalg.lstsq(inputs, right)[0]
    mean_return, _ = train(script, "Coordination", *flags)
    assert mean_return > -((right - linear) ** 2).sum(1).mean() / 10
