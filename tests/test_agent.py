"""What one loads and acts with, `load_agent`, `act` and `proposals`: an action depends on its observation alone."""

from dataclasses import FrozenInstanceError
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import make_agent, run
from test_algorithm import play
from test_commands import QUICK, call_main, read_json
from test_update import eager_copy
from threadpoolctl import threadpool_info

import ppo_continuous
import refineppo_continuous


def test_flags_are_frozen(script):
    with pytest.raises(FrozenInstanceError):
        script.Args().ent_coef = 0.01


def acting_agent(script, action_dim: int):
    """An agent whose actions depend visibly on the observation, and of which the bounds cut some; and observations."""
    agent, rng = make_agent(script, obs_dim=11, action_dim=action_dim), np.random.default_rng(0)
    agent.low, agent.high = np.full(action_dim, -0.4, "f"), np.full(action_dim, 0.9, "f")
    agent.params["actor.2.weight"] *= 300
    agent.normalizer.observe(rng.normal(3, 5, (100, 11)))
    return agent, rng.normal(3, 5, (33, 11))


@pytest.mark.parametrize("action_dim", [1, 2, 6, 17])
def test_act_and_proposals_against_the_reference(script, action_dim):
    agent, obs = acting_agent(script, action_dim)
    stats = agent.normalizer.obs
    normalised = np.clip((obs - stats.mean) / np.sqrt(stats.squares / stats.count + 1e-8), -10, 10)
    with torch.no_grad():
        proposals = torch.stack(eager_copy(agent).double().proposals(torch.tensor(normalised))).numpy()
    if script is refineppo_continuous:
        np.testing.assert_allclose(agent.proposals(obs), proposals, rtol=0, atol=1e-5)
        np.testing.assert_allclose(agent.proposals(obs[0]), proposals[:, 0], rtol=0, atol=1e-5)
    assert 0.1 < ((proposals[-1] < -0.4) | (proposals[-1] > 0.9)).mean() < 0.9
    np.testing.assert_allclose(agent.act(obs), np.clip(proposals[-1], -0.4, 0.9), rtol=0, atol=1e-5)
    assert agent.act(obs[0]).shape == (action_dim,) and agent.act(obs[0]).dtype == np.float32
    np.testing.assert_array_equal(agent.act(obs.tolist()[0]), agent.act(obs[0]))


def check_bits(script):
    """The same bits for every number of rows from 1 to 33, and at every position among them."""
    for action_dim in (1, 2, 6, 17):
        agent, obs = acting_agent(script, action_dim)
        for function in [agent.act] if script is ppo_continuous else [agent.act, agent.proposals]:
            alone = np.stack([function(row) for row in obs], axis=-2)
            for first in range(33):
                for n in range(1, 34):
                    rows = np.arange(first, first + n) % 33
                    assert np.array_equal(function(obs[rows]), alone[..., rows, :]), (action_dim, first, n)


def test_an_action_does_not_depend_on_its_neighbours(script):
    check_bits(script)


def kernels() -> set[str]:
    return {x["architecture"] for x in threadpool_info() if x["internal_api"] == "openblas"}


@pytest.mark.slow
@pytest.mark.parametrize("kernel, needs", [("Haswell", "avx2"), ("SkylakeX", "avx512f")])
def test_an_action_does_not_depend_on_its_neighbours_with_other_kernels(kernel, needs):
    if not kernels() or f" {needs} " not in Path("/proc/cpuinfo").read_text():
        pytest.skip(f"NumPy does not use OpenBLAS here, or the processor has no {needs}")
    done = run("tests/test_agent.py", OPENBLAS_CORETYPE=kernel)
    assert done.returncode == 0 and set(done.stdout.split()) == {kernel}, done.stdout + done.stderr


def test_a_loop_of_ones_own_gives_the_runs_returns(script, tmp_path, capsys):
    """Digit for digit, whether alone, as here, or beside others, as in the run; and so does --evaluate."""
    flags = ("--env-id", "Hopper-v5", "--learning-rate", 0.01, "--final-eval-episodes", 3, "--eval-interval", 32)
    call_main(script, *QUICK, *flags, "--run-dir", tmp_path)
    result = read_json(tmp_path / "result.json")
    for name in ("best", "last"):
        path, returns = tmp_path / f"{name}.pt", result[name]["returns"]
        agent = script.load_agent(path)
        env, seeds = script.make_env(agent.args), script.evaluation_seeds(agent.args, result[name]["global_step"], True)
        assert [play(env, agent, seed)[0] for seed in seeds] == returns
        capsys.readouterr()
        call_main(script, "--evaluate", path, "--final-eval-episodes", 1)
        first, _ = capsys.readouterr().out.splitlines()
        assert first.startswith(f"episode 1: return {returns[0]:.3f}, ")


if __name__ == "__main__":
    check_bits(ppo_continuous)
    check_bits(refineppo_continuous)
    print(*kernels())
