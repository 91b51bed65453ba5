"""Both scripts learn the probe environments, through their whole `main`, in seconds each."""

import numpy as np
import pytest
import torch
from test_commands import call_main, read_json

from sweeps.toy_env import phi, psi

FLAGS = """--total-timesteps 6144 --num-steps 512 --num-minibatches 4 --update-epochs 8 --learning-rate 5e-3
           --actor-hidden 32 32 --critic-hidden 32 32 --log-std-init -1 --eval-episodes 1 --final-eval-episodes 100
           --no-compile --no-progress"""


def train(script, folder, env_id: str, *flags):
    """The final policy's mean return over 100 episodes, and its agent."""
    call_main(script, "--env-id", env_id, "--run-dir", folder, *FLAGS.split(), *flags)
    return read_json(folder / "result.json")["last"]["mean"], script.load_agent(folder / "last.pt")


@pytest.mark.slow
def test_value_of_a_constant_reward(script, tmp_path):
    _, agent = train(script, tmp_path, "probe_envs:ConstantReward-v0", "--no-normalize-reward")
    obs = torch.linspace(-1.5, 1.5, 31)[:, None]  # normalised: uniform, of standard deviation 1
    values = script.network(script.layers(agent.params, "critic"), obs)
    torch.testing.assert_close(values, torch.ones(31, 1), rtol=0, atol=0.05)


def test_right_action_for_a_later_reward(script, tmp_path):
    """The best action that ignores the observation s, or what it leads to, loses E[s^2] = 1/3."""
    mean_return, _ = train(script, tmp_path, "probe_envs:TwoStepCredit-v0")
    assert mean_return > -1 / 3 / 10


@pytest.mark.slow
def test_coordination(script, tmp_path):
    """The paper's task: far better than the best linear policy, which leaves the second action uncoordinated."""
    s = np.linspace(-1, 1, 1001)
    right = np.stack([phi(s), psi(s, phi(s))], axis=1)
    inputs = np.stack([s, np.ones_like(s)], axis=1)
    linear = inputs @ np.linalg.lstsq(inputs, right)[0]
    mean_return, _ = train(script, tmp_path, "sweeps.toy_env:Coordination-v0")
    assert mean_return > -((right - linear) ** 2).sum(1).mean() / 10
