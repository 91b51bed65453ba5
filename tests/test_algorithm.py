"""The algorithm, part by part, against hand calculation, plain loops, torch's modules and gymnasium's wrappers."""

import itertools
import math
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import reference
import torch
from conftest import make_agent
from sklearn.metrics import explained_variance_score
from test_commands import QUICK, call_main, read_events
from test_update import eager_copy

import refineppo_continuous

# --- The policy -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "schedule, expected",
    [
        ("average", {1: [1.0], 2: [0.5, 0.5], 4: [0.25, 0.25, 0.25, 0.25]}),
        ("uniform", {1: [1.0], 2: [1.0, 1.0], 4: [1.0, 1.0, 1.0, 1.0]}),
        ("inverse", {1: [1.0], 2: [1.0, 0.5], 4: [1.0, 0.5, 0.3333333333333333, 0.25]}),
    ],
)
def test_refinement_coefficients(schedule, expected):
    for depth, coefficients in expected.items():
        args = refineppo_continuous.Args(refinement_depth=depth, refinement_schedule=schedule)
        assert refineppo_continuous.refinement_coefficients(args) == coefficients


def test_refinement_scalars_against_numpy():
    """Of a seventh of the rows, with bounds that cut some proposals."""
    agent = make_agent(refineppo_continuous, obs_dim=3, action_dim=2, refinement_depth=4)
    agent.low, agent.high = np.array([-0.2, -0.3], "f"), np.array([0.1, 0.2], "f")
    agent.params["actor.2.weight"] *= 100
    obs = torch.randn(350, 3, generator=torch.Generator().manual_seed(0))
    m = [np.zeros((50, 2)), *(m.detach().numpy() for m in eager_copy(agent).proposals(obs[::7]))]
    expected = {}
    for k in (1, 2, 3, 4):
        expected[f"correction_norm_{k}"] = np.sqrt(((m[k] - m[k - 1]) ** 2).sum(1)).mean()
        expected[f"settling_error_{k}"] = (np.abs(m[4] - m[k]).mean(0) / np.abs(m[4]).mean(0)).mean()
        expected[f"outside_bounds_{k}"] = ((m[k] < agent.low) | (m[k] > agent.high)).any(1).mean()
    assert 0 < expected["outside_bounds_1"] < expected["outside_bounds_4"] < 1
    scalars = refineppo_continuous.refinement_scalars(agent, obs)
    assert scalars == pytest.approx({f"refinement/{name}": x for name, x in expected.items()}, abs=1e-5)


def test_initial_parameters(script):
    agent, same, other = (make_agent(script, obs_dim=5, seed=seed, log_std_init=-0.5) for seed in (4, 4, 5))
    inputs = 5 + 2 if script is refineppo_continuous else 5
    for name, sizes, output_gain in (("actor", (inputs, 128, 128, 2), 0.01), ("critic", (5, 64, 64, 1), 1)):
        layers = script.layers(agent.params, name)
        assert [tuple(w.shape) for w, _ in layers] == [*zip(sizes, sizes[1:])]
        for (w, b), gain in zip(layers, (math.sqrt(2), math.sqrt(2), output_gain), strict=True):
            gram = w @ w.T if w.shape[0] < w.shape[1] else w.T @ w
            torch.testing.assert_close(gram, gain**2 * torch.eye(len(gram)), rtol=0, atol=1e-5 * gain**2)
            assert b.shape == w.shape[1:] and not b.any()
    assert agent.params["log_std"].tolist() == [-0.5] * 2
    for name, p in agent.params.items():
        assert p.equal(same.params[name])
        assert p.ne(other.params[name]).all() or not name.endswith("weight")


# --- Advantages and the batch -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("gamma", [0, 0.97, 1])
@pytest.mark.parametrize("gae_lambda", [0, 0.9, 1])
def test_gae_against_the_sum_that_defines_it(script, gae_lambda, gamma):
    """A_t = sum_l (gamma lambda)^l delta_{t+l} up to the episode's end."""
    rng = np.random.default_rng(0)
    rewards, values, ends = rng.normal(size=(40, 3)), rng.normal(size=(41, 3)), rng.random((40, 3)) < 0.2
    expected = np.zeros((40, 3))
    for t, i in np.ndindex(40, 3):
        for later in range(t, 40):
            next_value = 0 if ends[later, i] else values[later + 1, i]
            delta = rewards[later, i] + gamma * next_value - values[later, i]
            expected[t, i] += (gamma * gae_lambda) ** (later - t) * delta
            if ends[later, i]:
                break
    np.testing.assert_allclose(script.gae(rewards, values, ends, gamma, gae_lambda), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("bootstrap", [False, True])
def test_batch(script, bootstrap):
    """Rows keep together, step by step; rewards are scaled first and bootstrapped then, if that is asked for; a
    termination at the time limit is a termination."""
    flags = dict(num_envs=3, num_steps=4, bootstrap_truncated=bootstrap, critic_hidden=(1,), gamma=0.9)
    agent = make_agent(script, obs_dim=1, action_dim=2, **flags)
    for name, value in {"0.weight": 0.5, "1.weight": 3.0, "1.bias": 1.0}.items():
        agent.params[f"critic.{name}"].fill_(value)  # V(s) = 3 tanh(s / 2) + 1
    rng = np.random.default_rng(0)
    obs, actions, logprobs = (rng.normal(size=s).astype("f") for s in ((5, 3, 1), (4, 3, 2), (4, 3)))
    rewards, (terminated, truncated) = rng.normal(size=(4, 3)), np.zeros((2, 4, 3), bool)
    terminated[1, 0] = terminated[2, 1] = truncated[2, 1] = truncated[1, 2] = True
    last = {end: np.array([0.7], "f") for end in ((1, 0), (2, 1), (1, 2))}
    scaled = script.Normalizer(3, 1, agent.args).scale_rewards(rewards, terminated)
    scaled[1, 2] += 0.9 * (3 * math.tanh(0.7 / 2) + 1) if bootstrap else 0
    values = 3 * np.tanh(obs[..., 0] / 2) + 1
    advantages = script.gae(scaled, values, terminated | truncated, 0.9, 0.95)
    returns = advantages + values[:-1]

    roll = script.Rollout(obs, actions, logprobs, rewards, terminated, truncated, last, episodes=[])
    batch, explained_variance = script.prepare_batch(agent, roll)
    assert explained_variance == pytest.approx(explained_variance_score(returns.ravel(), values[:-1].ravel()))
    assert batch._fields == ("obs", "actions", "logprobs", "advantages", "returns", "values")
    for tensor, expected in zip(batch, (obs[:-1], actions, logprobs, advantages, returns, values[:-1]), strict=True):
        assert tensor.dtype == torch.float32 and tensor.shape == (12, *expected.shape[2:])
        for row, at in zip(tensor, np.ndindex(4, 3)):
            np.testing.assert_allclose(row, expected[at], rtol=1e-5, atol=1e-6)


# --- Normalizer -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "env_id, steps, tolerance",
    [
        ("Hopper-v5", 2000, 1e-5),  # many terminations; float64 observations
        # Truncations; observations in float32, in which gymnasium then keeps its statistics: an update rounds by 6e-8
        # of an observation, and early on an observation's distance from the mean is a hundredth of it.
        ("Pendulum-v1", 900, 1e-3),
    ],
)
def test_rollout_against_gymnasiums_wrappers(script, env_id, steps, tolerance):
    """An episode's last observation is counted, then the next one's first; a termination resets the discounted return,
    a truncation does not; only the environment's actions are clipped."""
    training = script.Training(script.Args(env_id, seed=3, gamma=0.97))
    agent, roll = training.agent, script.collect(training.agent, training.envs, steps, training.rng)
    assert len(roll.episodes) >= 4 and (roll.actions > agent.high).any()
    scaled = [agent.normalizer.scale_rewards(roll.rewards[:9], roll.terminated[:9])]
    scaled += [agent.normalizer.scale_rewards(roll.rewards[9:], roll.terminated[9:])]

    env = reference.make_env(env_id, gamma=0.97)
    seeds = (script.episode_seeds(3, 0, 0, episode)[0] for episode in itertools.count())
    observations, final_obs, rewards = [env.reset(seed=next(seeds))[0]], {}, []
    for t, action in enumerate(roll.actions[:, 0]):
        obs, reward, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            final_obs[t, 0] = obs
            obs, _ = env.reset(seed=next(seeds))
        observations.append(obs)
        rewards.append(reward)
    np.testing.assert_allclose(roll.obs[:, 0], observations, rtol=0, atol=tolerance)
    assert roll.final_obs.keys() == final_obs.keys()
    np.testing.assert_allclose([*roll.final_obs.values()], [*final_obs.values()], rtol=0, atol=tolerance)
    np.testing.assert_allclose(np.concatenate(scaled)[:, 0], rewards, rtol=1e-9)
    assert np.abs(rewards).max() == 10


def mean_and_variance(data: np.ndarray):
    """Of all data (n, ...) and the prior observations, of weight 1e-4, mean 0 and variance 1."""
    count = len(data) + 1e-4
    mean = data.sum(0) / count
    return mean, (((data - mean) ** 2).sum(0) + 1e-4 * (1 + mean**2)) / count


def test_observations_of_several_environments_against_numpy(script):
    normalizer = script.Normalizer(4, 3, script.Args())
    data = np.random.default_rng(0).normal(5, 3, (50, 4, 3))
    for t in range(50):
        mean, variance = mean_and_variance(data[: t + 1].reshape(-1, 3))
        expected = np.clip((data[t] - mean) / np.sqrt(variance + 1e-8), -10, 10)
        np.testing.assert_allclose(normalizer.observe(data[t]), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(normalizer.obs.mean, mean, rtol=1e-10)
    np.testing.assert_allclose(normalizer.obs.squares / normalizer.obs.count, variance, rtol=1e-10)
    for sign in (1, -1):
        np.testing.assert_array_equal(normalizer.normalize(np.full((1, 3), sign * 1e6)), np.full((1, 3), sign * 10))


def test_rewards_of_several_environments_against_numpy(script):
    """One variance, of the discounted returns of all environments; in rollouts of any length."""
    rng = np.random.default_rng(0)
    rewards, terminated = rng.normal(-20, 3, (208, 3)), rng.random((208, 3)) < 0.1
    normalizer = script.Normalizer(3, 1, script.Args(gamma=0.97))
    rollouts = [slice(0, 1), slice(1, 8), slice(8, 208)]
    scaled = np.concatenate([normalizer.scale_rewards(rewards[steps], terminated[steps]) for steps in rollouts])
    discounted = np.zeros((209, 3))
    for t in range(208):
        discounted[t + 1] = rewards[t] + 0.97 * (1 - terminated[t]) * discounted[t]
        _, variance = mean_and_variance(discounted[1 : t + 2].ravel())
        np.testing.assert_allclose(scaled[t], np.clip(rewards[t] / np.sqrt(variance + 1e-8), -10, 10), rtol=1e-9)


def test_normalisation_off(script):
    normalizer = script.Normalizer(1, 3, script.Args(normalize_obs=False, normalize_reward=False))
    obs, rewards = np.array([[100.0, -1000.0, 0.5]]), np.array([[1000.0], [-3.0]])
    np.testing.assert_array_equal(normalizer.observe(obs), obs)
    np.testing.assert_array_equal(normalizer.scale_rewards(rewards, np.zeros((2, 1), bool)), rewards)


# --- Environments and rollouts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "env_id, steps",
    [("Hopper-v5", 200), ("Pendulum-v1", 450), ("BipedalWalker-v3", 300), ("probe_envs:Counter-v0", 30)],
)
def test_environments_against_plain_loop(script, env_id, steps):
    """Every episode as if played alone, in an environment of its own with the episode's seed."""
    space = gym.make(env_id).action_space
    actions = np.random.default_rng(0).uniform(space.low, space.high, (steps, 2, *space.shape)).astype("f")
    envs = script.Environments(script.Args(env_id, num_envs=2, seed=5))
    observations, outcomes = [envs.obs.copy()], []
    for t in range(steps):
        obs, *outcome = envs.step(actions[t])
        observations.append(obs.copy())
        outcomes.append(outcome)
    for i in range(2):
        t, episode = 0, 0
        while t < steps:
            env, rewards, end = gym.make(env_id), [], False
            obs, _ = env.reset(seed=script.episode_seeds(5, 0, i, episode)[0])
            while t < steps and not end:
                np.testing.assert_array_equal(observations[t][i], obs)
                obs, reward, terminated, truncated, _ = env.step(actions[t, i])
                *columns, ended = outcomes[t]
                assert [column[i] for column in columns] == [reward, terminated, truncated]
                rewards.append(reward)
                end = terminated or truncated
                assert (i in ended) == end
                t += 1
            if end:
                last_obs, *totals = ended[i]
                np.testing.assert_array_equal(last_obs, obs)
                assert totals == [pytest.approx(sum(rewards)), len(rewards)]
                episode += 1
        assert episode >= 1


def test_rollouts_of_a_counter_by_hand(script):
    """Two rollouts of 11 steps through episodes of 7: one episode ends in each, the second begins in the first."""
    training = script.Training(script.Args("probe_envs:Counter-v0", num_envs=3, normalize_obs=False))
    for counts, rewards, ends in (
        ([0, 1, 2, 3, 4, 5, 6, 0, 1, 2, 3, 4], [1, 2, 3, 4, 5, 6, 7, 1, 2, 3, 4], [6]),
        ([4, 5, 6, 0, 1, 2, 3, 4, 5, 6, 0, 1], [5, 6, 7, 1, 2, 3, 4, 5, 6, 7, 1], [2, 9]),
    ):
        roll = script.collect(training.agent, training.envs, 11, training.rng)
        for i in range(3):
            assert roll.obs[:, i, 0].tolist() == counts
            assert roll.rewards[:, i].tolist() == rewards
            assert np.flatnonzero(roll.truncated[:, i]).tolist() == ends
        assert not roll.terminated.any()
        assert roll.final_obs == {(t, i): [7.0] for t in ends for i in range(3)}
        assert roll.episodes == [((t + 1) * 3, 28.0, 7) for t in ends for _ in range(3)]


def test_learning_rate_is_annealed_as_in_cleanrl(script, tmp_path):
    """(1 - (iteration - 1) / num_iterations) lr, where an incomplete last rollout is no iteration."""
    flags = "--env-id probe_envs:Counter-v0 --num-steps 8 --total-timesteps 35 --learning-rate 0.004 --no-progress"
    call_main(script, *QUICK, *flags.split(), "--run-dir", tmp_path)
    events = read_events(tmp_path).Scalars("charts/learning_rate")
    assert [event.step for event in events] == [8, 16, 24, 32]
    assert [event.value for event in events] == pytest.approx([0.004, 0.003, 0.002, 0.001])


# --- Evaluation -------------------------------------------------------------------------------------------------------


def play(env: gym.Env, agent, seed: int) -> tuple[float, int]:
    """An episode's return and length, in a loop of one's own over `act`, which test_agent.py tests."""
    (obs, _), rewards, ended = env.reset(seed=seed), [], False
    while not ended:
        obs, reward, terminated, truncated, _ = env.step(agent.act(obs))
        rewards.append(reward)
        ended = terminated or truncated
    return sum(rewards), len(rewards)


@pytest.mark.parametrize("env_id", ["Hopper-v5", "LunarLanderContinuous-v3", "probe_envs:Terminator-v0"])
def test_evaluation_against_plain_loop(script, env_id):
    """One deterministic episode per seed, and nothing of the training is touched."""
    training = script.Training(script.Args(env_id, num_envs=2))
    agent, seeds = training.agent, [11, 7, 11, 13]
    agent.params["actor.2.weight"] *= 50
    script.collect(agent, training.envs, 100, training.rng)
    before = deepcopy(agent.state())
    returns, lengths = script.evaluate(agent, seeds)
    torch.testing.assert_close(agent.state(), before, rtol=0, atol=0)
    assert [*zip(returns, lengths)] == [play(gym.make(env_id), agent, seed) for seed in seeds]
