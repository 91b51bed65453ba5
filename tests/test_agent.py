"""What one loads and acts with, `load_agent`, `act` and `proposals`: an action depends on its observation alone."""

from dataclasses import FrozenInstanceError
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from conftest import make_agent, run
from test_algorithm import COEFFICIENTS, network, refine, rewards_of_an_episode
from test_commands import QUICK, call_main, read_json
from threadpoolctl import threadpool_info

import ppo_continuous
import refineppo_continuous


def test_flags_are_frozen(script):
    args = script.Args()
    with pytest.raises(FrozenInstanceError):
        args.ent_coef = 0.01


def acting_agent(script, action_dim: int, **flags):
    """An agent whose actions depend visibly on the observation, and of which the bounds cut some."""
    agent, rng = (
        make_agent(script, obs_dim=11, action_dim=action_dim, actor_hidden=(64, 64), **flags),
        np.random.default_rng(0),
    )
    agent.low, agent.high = np.full(action_dim, -0.4, "f"), np.full(action_dim, 0.9, "f")
    agent.params["actor.2.weight"] *= 100
    agent.normalizer.observe(rng.normal(3, 5, (100, 11)))
    return agent, rng.normal(3, 5, (33, 11))


@pytest.mark.parametrize("action_dim", [1, 2, 6, 17])
def test_act_and_proposals_against_plain_loop(script, action_dim):
    agent, obs = acting_agent(script, action_dim)
    stats = agent.normalizer.obs
    normalised = np.clip((obs - stats.mean) / np.sqrt(stats.squares / stats.count + 1e-8), -10, 10)
    weights = script.layers(agent.arrays(), "actor")
    if script is ppo_continuous:
        expected = network(weights, normalised)
    else:
        all_m = np.array(refine(weights, normalised, COEFFICIENTS["average", 4]))
        np.testing.assert_allclose(agent.proposals(obs), all_m, rtol=0, atol=1e-5)
        np.testing.assert_allclose(agent.proposals(obs[0]), all_m[:, 0], rtol=0, atol=1e-5)
        expected = all_m[-1]
    outside = (expected < -0.4) | (expected > 0.9)
    assert 0.1 < outside.mean() < 0.9
    np.testing.assert_allclose(agent.act(obs), np.clip(expected, -0.4, 0.9), rtol=0, atol=1e-5)
    assert agent.act(obs[0]).shape == (action_dim,)
    np.testing.assert_array_equal(agent.act(obs.tolist()[0]), agent.act(obs[0]))


def check_bits(script):
    """The same bits for every number of rows from 1 to 33, and at every position among them."""
    for action_dim in (1, 2, 6, 17):
        agent, obs = acting_agent(script, action_dim)
        functions = [agent.act] if script is ppo_continuous else [agent.act, agent.proposals]
        for function in functions:
            alone = np.stack([function(row) for row in obs], axis=-2)
            for first in range(33):
                for n in range(1, 34):
                    rows = np.arange(first, first + n) % 33
                    assert np.array_equal(function(obs[rows]), alone[..., rows, :]), (action_dim, first, n)


def test_an_action_does_not_depend_on_its_neighbours(script):
    check_bits(script)


def kernels() -> set[str]:
    return {x["architecture"] for x in threadpool_info() if x["internal_api"] == "openblas"}


KERNELS = {"Haswell": "avx2", "SkylakeX": "avx512f"}  # of OpenBLAS, and what they need


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
def test_an_action_does_not_depend_on_its_neighbours_with_other_kernels(kernel):
    if not kernels():
        pytest.skip("NumPy does not use OpenBLAS here")
    if f" {KERNELS[kernel]} " not in Path("/proc/cpuinfo").read_text():
        pytest.skip(f"this processor has no {KERNELS[kernel]}")
    done = run("tests/test_agent.py", OPENBLAS_CORETYPE=kernel)
    assert done.returncode == 0 and set(done.stdout.split()) == {kernel}, done.stdout + done.stderr


# --- A loop of one's own ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["Pendulum-v1", pytest.param("HalfCheetah-v5", marks=pytest.mark.slow)])
def test_a_loop_of_ones_own_gives_the_runs_returns(script, tmp_path, capsys, env_id):
    """Digit for digit, whether alone, as here, or beside others, as in the run."""
    flags = ("--env-id", env_id, "--learning-rate", 0.01, "--final-eval-episodes", 3, "--eval-interval", 32)
    call_main(script, *QUICK, *flags, "--run-dir", tmp_path)
    result = read_json(tmp_path / "result.json")
    for name in ("best", "last"):
        agent, path = script.load_agent(tmp_path / f"{name}.pt"), tmp_path / f"{name}.pt"
        seeds = script.evaluation_seeds(agent.args, result[name]["global_step"], final=True)
        env, plain = script.make_env(agent.args), gym.make(env_id)
        assert [sum(rewards_of_an_episode(env, agent, seed)) for seed in seeds] == result[name]["returns"]
        assert sum(rewards_of_an_episode(plain, agent, seeds[-1])) == result[name]["returns"][-1]
        capsys.readouterr()
        call_main(script, "--evaluate", path, "--final-eval-episodes", 1)
        printed = capsys.readouterr().out.splitlines()
        assert printed[0].startswith(f"episode 1: return {result[name]['returns'][0]:.3f}, ") and len(printed) == 2


if __name__ == "__main__":
    check_bits(ppo_continuous)
    check_bits(refineppo_continuous)
    print(*kernels())
