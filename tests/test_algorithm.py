"""The algorithm, part by part, against hand calculation, plain loops, torch's modules and gymnasium's wrappers."""

import io
import itertools
import math
import signal
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from sklearn.metrics import explained_variance_score
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

import ppo_continuous
import refineppo_continuous

SCHEDULES = ("average", "uniform", "inverse")
COEFFICIENTS = {
    ("average", 1): [1.0],
    ("uniform", 1): [1.0],
    ("inverse", 1): [1.0],
    ("average", 2): [0.5, 0.5],
    ("uniform", 2): [1.0, 1.0],
    ("inverse", 2): [1.0, 0.5],
    ("average", 4): [0.25, 0.25, 0.25, 0.25],
    ("uniform", 4): [1.0, 1.0, 1.0, 1.0],
    ("inverse", 4): [1.0, 0.5, 0.3333333333333333, 0.25],
}


def make_agent(script, obs_dim=3, action_dim=2, **flags):
    return script.Agent(Box(-1, 1, (obs_dim,)), Box(-1, 1, (action_dim,)), script.Args(**flags))


def agent_for(script, env_id, **flags):
    env = gym.make(env_id)
    return script.Agent(env.observation_space, env.action_space, script.Args(env_id=env_id, **flags))


def copies(agent):
    """Everything in an agent that training changes."""
    parts = agent.tensors()
    return {f"{part}.{name}": x.clone() for part, tensors in parts.items() for name, x in tensors.items()}


def assert_same(before, after):
    assert before.keys() == after.keys()
    for name in before:
        assert torch.equal(before[name], after[name]), name


# --- The refined mean -------------------------------------------------------------------------------------------------


def random_network(sizes):
    rng, shapes = np.random.default_rng(0), zip(sizes, sizes[1:])
    return [(rng.normal(size=shape) / math.sqrt(shape[0]), rng.normal(size=shape[1])) for shape in shapes]


def network(weights, x):
    for w, b in weights[:-1]:
        x = np.tanh(x @ w + b)
    return x @ weights[-1][0] + weights[-1][1]


def refine(weights, obs, coefficients):
    """m_1, ..., m_K as the paper writes them: f of the concatenated observation and proposal, from m_0 = 0."""
    m, proposals = np.zeros((len(obs), len(weights[-1][1]))), []
    for c in coefficients:
        m = m + c * network(weights, np.concatenate([obs, m], axis=1))
        proposals.append(m)
    return proposals


def refining_actor(schedule, depth, hidden=(8, 8), obs_dim=3, action_dim=2):
    args = refineppo_continuous.Args(refinement_depth=depth, refinement_schedule=schedule, actor_hidden=hidden)
    return refineppo_continuous.Actor(obs_dim, action_dim, args)


@pytest.mark.parametrize("schedule, depth", COEFFICIENTS)
def test_refinement_coefficients(schedule, depth):
    assert refineppo_continuous.refinement_coefficients(schedule, depth) == COEFFICIENTS[schedule, depth]


@pytest.mark.parametrize("hidden", [(8,), (8, 8), (16, 8, 4)])
@pytest.mark.parametrize("schedule, depth", COEFFICIENTS)
def test_proposals_against_plain_loop(schedule, depth, hidden):
    actor = refining_actor(schedule, depth, hidden)
    weights, obs = random_network([5, *hidden, 2]), np.random.default_rng(1).normal(size=(7, 3))
    expected = refine(weights, obs, COEFFICIENTS[schedule, depth])
    in_tensors = actor.proposals([tuple(map(torch.tensor, layer)) for layer in weights], torch.tensor(obs))
    for proposals in (actor.proposals(weights, obs), [m.numpy() for m in in_tensors]):
        assert len(proposals) == depth
        np.testing.assert_allclose(proposals, expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(actor.mean(weights, obs), actor.proposals(weights, obs)[-1])
    np.testing.assert_allclose(actor.mean(weights, obs[:1]), expected[-1][:1], rtol=0, atol=1e-12)


def test_one_step_is_f_of_s_and_0():
    """Proposition 1: for K = 1 every schedule is the same direct mapping."""
    weights, obs = random_network([5, 8, 8, 2]), np.random.default_rng(1).normal(size=(7, 3))
    means = [refining_actor(schedule, 1).mean(weights, obs) for schedule in SCHEDULES]
    np.testing.assert_array_equal(means[0], means[1])
    np.testing.assert_array_equal(means[0], means[2])
    np.testing.assert_allclose(means[0], network(weights, np.c_[obs, np.zeros((7, 2))]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("schedule, depth", [key for key in COEFFICIENTS if key[1] > 1] + [("average", 1)])
def test_gradient_of_the_chain_against_finite_differences(schedule, depth):
    """Central differences of the plain loop, for every parameter: the gradient flows through all K steps."""
    weights, rng = random_network([5, 4, 4, 2]), np.random.default_rng(1)
    obs, direction = rng.normal(size=(6, 3)), rng.normal(size=(6, 2))
    parameters = [x for layer in weights for x in layer]

    def objective():
        return (direction * refine(weights, obs, COEFFICIENTS[schedule, depth])[-1]).sum()

    def in_tensors(*tensors):
        mean = refining_actor(schedule, depth, (4, 4)).mean(list(zip(tensors[::2], tensors[1::2])), torch.tensor(obs))
        return (torch.tensor(direction) * mean).sum()

    tensors = [torch.tensor(x, requires_grad=True) for x in parameters]
    gradients = torch.autograd.grad(in_tensors(*tensors), tensors)
    h = 1e-6
    for parameter, gradient in zip(parameters, gradients):
        for i in np.ndindex(parameter.shape):
            value = parameter[i]
            parameter[i] = value + h
            above = objective()
            parameter[i] = value - h
            below = objective()
            parameter[i] = value
            assert gradient[i].item() == pytest.approx((above - below) / (2 * h), rel=1e-6, abs=1e-8)
    assert torch.autograd.gradcheck(in_tensors, tensors)


def test_refinement_scalars_by_hand():
    m_1 = torch.tensor([[3.0, 4.0], [1.0, 0.0]])
    m_2 = torch.tensor([[3.0, 4.0], [5.0, -3.0]])
    low, high = torch.tensor([-2.0, -2.0]), torch.tensor([4.0, 3.5])
    scalars = refineppo_continuous.refinement_scalars([m_1, m_2], low, high)
    assert scalars == pytest.approx(
        {
            "refinement/correction_norm_1": (5 + 1) / 2,
            "refinement/correction_norm_2": (0 + 5) / 2,
            "refinement/settling_error_1": ((4 / 2) / (8 / 2) + (3 / 2) / (7 / 2)) / 2,
            "refinement/settling_error_2": 0,
            "refinement/outside_bounds_1": 1 / 2,
            "refinement/outside_bounds_2": 1,
        }
    )


# --- Networks and their initial values --------------------------------------------------------------------------------


def sequential(weights):
    """The same network in torch's modules, which store (out, in)."""
    modules = []
    for w, b in weights:
        linear = nn.Linear(*w.shape, dtype=w.dtype)
        linear.weight.data, linear.bias.data = w.T.clone(), b.clone()
        modules += [linear, nn.Tanh()]
    return nn.Sequential(*modules[:-1])


@pytest.mark.parametrize("hidden", [(8,), (8, 8), (16, 8, 4)])
def test_ppo_actor_against_torch_modules(hidden):
    weights, obs = random_network([3, *hidden, 2]), np.random.default_rng(1).normal(size=(7, 3))
    actor = ppo_continuous.Actor(3, 2, ppo_continuous.Args(actor_hidden=hidden))
    in_tensors = [tuple(map(torch.tensor, layer)) for layer in weights]
    expected = sequential(in_tensors)(torch.tensor(obs))
    torch.testing.assert_close(actor.mean(in_tensors, torch.tensor(obs)), expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.tensor(actor.mean(weights, obs)), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("hidden", [(8,), (8, 8), (16, 8, 4)])
def test_critic_against_torch_modules(script, hidden):
    weights = [tuple(map(torch.tensor, layer)) for layer in random_network([3, *hidden, 1])]
    obs = torch.tensor(np.random.default_rng(1).normal(size=(7, 3)))
    values = script.critic_value(weights, obs)
    assert values.shape == (7,)
    torch.testing.assert_close(values, sequential(weights)(obs)[:, 0], rtol=0, atol=1e-12)


def test_initial_parameters(script):
    agent = make_agent(script, obs_dim=5, action_dim=3, seed=4, log_std_init=-0.5)
    inputs = {"actor": 5 + 3 if script is refineppo_continuous else 5, "critic": 5}
    sizes = {"actor": (128, 128, 3), "critic": (64, 64, 1)}
    gains = {"actor": (math.sqrt(2), math.sqrt(2), 0.01), "critic": (math.sqrt(2), math.sqrt(2), 1)}
    for name in sizes:
        layers = script.layers(agent.params, name)
        assert [tuple(w.shape) for w, _ in layers] == list(zip((inputs[name], *sizes[name]), sizes[name]))
        for (w, b), gain in zip(layers, gains[name], strict=True):
            gram = w @ w.T if w.shape[0] < w.shape[1] else w.T @ w
            torch.testing.assert_close(gram, gain**2 * torch.eye(len(gram)), rtol=0, atol=1e-5 * gain**2)
            assert b.shape == w.shape[1:] and not b.any()
    assert agent.params["log_std"].tolist() == [-0.5] * 3

    same, other = (make_agent(script, obs_dim=5, action_dim=3, seed=seed, log_std_init=-0.5) for seed in (4, 5))
    assert_same(agent.params, same.params)
    assert all(agent.params[name].ne(other.params[name]).all() for name in agent.params if name.endswith("weight"))


def test_actor_is_the_same_in_arrays_and_tensors(script):
    agent, rng = make_agent(script, obs_dim=17, action_dim=6), np.random.default_rng(0)
    for p in agent.params.values():
        p += torch.tensor(0.1 * rng.normal(size=p.shape))
    for dtype, tolerance in ((torch.float32, 1e-5), (torch.float64, 1e-6)):
        agent.params = {name: p.to(dtype) for name, p in agent.params.items()}
        for batch_size in (1, 64):
            obs = torch.tensor(rng.normal(size=(batch_size, 17)), dtype=dtype)
            in_arrays = agent.actor.mean(script.layers(agent.arrays(), "actor"), obs.numpy())
            in_tensors = agent.actor.mean(script.layers(agent.params, "actor"), obs)
            scale = in_tensors.abs().max().item()
            np.testing.assert_allclose(in_arrays, in_tensors.numpy(), rtol=0, atol=tolerance * scale)


# --- Advantages and the batch -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("gamma", [0, 0.97, 1])
@pytest.mark.parametrize("gae_lambda", [0, 0.9, 1])
@pytest.mark.parametrize("num_envs", [1, 3])
def test_gae_against_the_sum_that_defines_it(script, num_envs, gae_lambda, gamma):
    """A_t = sum_l (gamma lambda)^l delta_{t+l} up to the episode's end, whether it terminates or is truncated."""
    rng, steps = np.random.default_rng(0), 40
    rewards, values = rng.normal(size=(steps, num_envs)), rng.normal(size=(steps + 1, num_envs))
    terminated, truncated = rng.random((2, steps, num_envs)) < 0.1
    assert terminated.any() and truncated.any()
    ends = terminated | truncated
    expected = np.zeros_like(rewards)
    for i in range(num_envs):
        for t in range(steps):
            for later in range(t, steps):
                next_value = 0 if ends[later, i] else values[later + 1, i]
                delta = rewards[later, i] + gamma * next_value - values[later, i]
                expected[t, i] += (gamma * gae_lambda) ** (later - t) * delta
                if ends[later, i]:
                    break
    advantages = script.gae(rewards, values, ends, gamma, gae_lambda)
    np.testing.assert_allclose(advantages, expected, rtol=0, atol=1e-12)


def test_discounted_sums_against_plain_loop(script):
    rng = np.random.default_rng(0)
    x, decay, initial = rng.normal(size=(20, 3)), rng.random((20, 3)), rng.normal(size=3)
    sums, y = script.discounted_sums(x, decay, initial), initial
    for t in range(20):
        y = x[t] + decay[t] * y
        np.testing.assert_allclose(sums[t], y, rtol=1e-12)


def set_critic(agent):
    """V(s) = 3 tanh(s / 2) + 1 for a one-dimensional observation."""
    values = {"0.weight": 0.5, "0.bias": 0.0, "1.weight": 3.0, "1.bias": 1.0}
    for name, value in values.items():
        agent.params[f"critic.{name}"].fill_(value)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("bootstrap", [False, True])
@pytest.mark.parametrize("env, last_step", [("Counter", 7), ("Terminator", 5)])
def test_batch_by_hand(script, env, last_step, bootstrap):
    """A truncation bootstraps gamma V(final observation) if asked to, a termination never."""
    gamma, decay, steps = 0.9, 0.9 * 0.8, 12
    flags = dict(gamma=0.9, gae_lambda=0.8, normalize_obs=False, normalize_reward=False, critic_hidden=(1,))
    agent = agent_for(script, f"probe_envs:{env}-v0", num_steps=steps, bootstrap_truncated=bootstrap, **flags)
    set_critic(agent)
    envs = script.Environments(agent.args.env_id, 1, seed=1)
    roll = script.collect(agent, envs, agent.normalizer.observe(envs.obs), steps, np.random.default_rng(0))

    counts = [t % last_step for t in range(steps + 1)]  # the observations
    value = [3 * math.tanh(n / 2) + 1 for n in range(last_step + 1)]
    advantages = [0.0] * (steps + 1)
    for t in reversed(range(steps)):
        n, reward = counts[t], counts[t] + 1
        if n + 1 < last_step:
            advantages[t] = reward + gamma * value[n + 1] - value[n] + decay * advantages[t + 1]
        else:
            bootstrapped = gamma * value[last_step] if bootstrap and env == "Counter" else 0
            advantages[t] = reward + bootstrapped - value[n]

    values = [value[n] for n in counts[:-1]]
    expected_returns = np.add(advantages[:-1], values)
    (obs, actions, logprobs, *rest), explained_variance = script.prepare_batch(agent, roll)
    np.testing.assert_array_equal(obs[:, 0], counts[:-1])
    np.testing.assert_array_equal(actions, roll.actions[:, 0])
    np.testing.assert_array_equal(logprobs, roll.logprobs[:, 0])
    for tensor, expected in zip(rest, (advantages[:-1], expected_returns, values), strict=True):
        np.testing.assert_allclose(tensor, expected, rtol=1e-5)
    assert explained_variance == pytest.approx(explained_variance_score(expected_returns, values), rel=1e-5)


def test_batch_of_several_environments(script):
    """Rows keep together, step by step; rewards are scaled first and bootstrapped then; a termination at the time
    limit is a termination."""
    agent = make_agent(script, obs_dim=1, action_dim=2, num_envs=3, num_steps=4, bootstrap_truncated=True,
                       critic_hidden=(1,), gamma=0.9)  # fmt: skip
    set_critic(agent)
    rng = np.random.default_rng(0)
    obs, actions, logprobs = (rng.normal(size=s).astype("f") for s in ((5, 3, 1), (4, 3, 2), (4, 3)))
    rewards, terminated, truncated = rng.normal(size=(4, 3)), np.zeros((4, 3), bool), np.zeros((4, 3), bool)
    terminated[1, 0] = terminated[2, 1] = truncated[2, 1] = truncated[1, 2] = True
    last = {end: np.array([0.7], "f") for end in ((1, 0), (2, 1), (1, 2))}
    roll = script.Rollout(obs=obs, next_obs=obs[1:], actions=actions, logprobs=logprobs, rewards=rewards.copy(),
                          terminated=terminated, truncated=truncated, final_obs=last, first_obs={},
                          episodes=[])  # fmt: skip
    expected_rewards = script.Normalizer(3, 1, agent.args).scale_rewards(rewards, terminated)
    expected_rewards[1, 2] += 0.9 * (3 * math.tanh(0.7 / 2) + 1)
    values = 3 * np.tanh(obs[..., 0] / 2) + 1
    advantages = script.gae(expected_rewards, values, terminated | truncated, 0.9, 0.95)

    batch, _ = script.prepare_batch(agent, roll)
    columns = (obs[:-1], actions, logprobs, advantages, advantages + values[:-1], values[:-1])
    for tensor, expected in zip(batch, columns, strict=True):
        assert tensor.dtype == torch.float32
        for t in range(4):
            for i in range(3):
                np.testing.assert_allclose(tensor[3 * t + i], expected[t, i], rtol=1e-5, atol=1e-6)


# --- Normaliser -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "env_id, steps, tolerance",
    [
        ("Hopper-v5", 2000, 1e-5),  # many terminations; float64 observations
        # Observations in float32, in which gymnasium then keeps its statistics: an update rounds by 6e-8 of an
        # observation, and early on an observation's distance from the mean is a hundredth of it.
        ("Pendulum-v1", 900, 1e-3),
    ],
)
def test_observations_against_gymnasiums_wrapper(script, env_id, steps, tolerance):
    """Statistics and order of counting: an episode's last observation, then the next one's first."""
    agent = agent_for(script, env_id)
    envs = script.Environments(env_id, 1, seed=3)
    roll = script.collect(agent, envs, agent.normalizer.observe(envs.obs), steps, np.random.default_rng(0))
    assert len(roll.episodes) >= 4

    env = gym.wrappers.NormalizeObservation(gym.make(env_id))
    env = gym.wrappers.TransformObservation(env, lambda obs: np.clip(obs, -10, 10), None)
    actions = np.clip(roll.actions[:, 0], env.action_space.low, env.action_space.high)
    seeds = (script.episode_seeds(3, 0, 0, episode)[0] for episode in itertools.count())
    expected, expected_final = [env.reset(seed=next(seeds))[0]], {}
    for t in range(steps):
        obs, _, terminated, truncated, _ = env.step(actions[t])
        if terminated or truncated:
            expected_final[t, 0] = obs
            obs, _ = env.reset(seed=next(seeds))
        expected.append(obs)
    np.testing.assert_allclose(roll.obs[:, 0], expected, rtol=0, atol=tolerance)
    assert roll.final_obs.keys() == expected_final.keys()
    for end, obs in expected_final.items():
        np.testing.assert_allclose(roll.final_obs[end], obs, rtol=0, atol=tolerance)


def test_observations_of_several_environments_against_numpy(script):
    """One mean and variance over all data, with the prior observations' weight of 1e-4, mean 0 and variance 1."""
    normalizer = script.Normalizer(4, 3, script.Args())
    batches = [np.random.default_rng(i).normal(5, 3, (4, 3)) for i in range(50)]
    for batch in batches:
        last = normalizer.observe(batch)
    data = np.concatenate(batches)
    count = len(data) + 1e-4
    mean = data.sum(0) / count
    variance = (((data - mean) ** 2).sum(0) + 1e-4 * (1 + mean**2)) / count
    np.testing.assert_allclose(normalizer.obs.mean, mean, rtol=1e-10)
    np.testing.assert_allclose(normalizer.obs.squares / normalizer.obs.count, variance, rtol=1e-10)
    np.testing.assert_allclose(last, (batches[-1] - mean) / np.sqrt(variance + 1e-8), rtol=1e-6)
    np.testing.assert_array_equal(normalizer.normalize(np.full((1, 3), 1e6)), np.full((1, 3), 10))
    np.testing.assert_array_equal(normalizer.normalize(np.full((1, 3), -1e6)), np.full((1, 3), -10))


class Scripted(gym.Env):
    """Gives the rewards and ends it was made with."""

    observation_space = action_space = Box(-1, 1, (1,))

    def __init__(self, *columns):
        self.outcomes = iter(zip(*(column.tolist() for column in columns)))

    def reset(self, seed=None, options=None):
        return np.zeros(1, "f"), {}

    def step(self, action):
        return np.zeros(1, "f"), *next(self.outcomes), {}


def test_rewards_against_gymnasiums_wrapper(script):
    """A termination resets the discounted return, a truncation does not; in rollouts of any length."""
    rng, steps = np.random.default_rng(0), 1500
    rewards = rng.normal(1, 2, steps)
    rewards[700] = 1000.0  # beyond the clip
    terminated, truncated = rng.random((2, steps)) < 0.02
    env = gym.wrappers.NormalizeReward(Scripted(rewards, terminated, truncated), gamma=0.97)
    env = gym.wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))
    env.reset()
    expected = [float(env.step(None)[1]) for _ in range(steps)]
    assert expected[700] == 10

    normalizer = script.Normalizer(1, 1, script.Args(gamma=0.97))
    scaled = [
        normalizer.scale_rewards(rewards[start:end, None], terminated[start:end, None])
        for start, end in ((0, 1), (1, 300), (300, 310), (310, 1500))
    ]
    np.testing.assert_allclose(np.concatenate(scaled)[:, 0], expected, rtol=1e-9)


def test_update_each_is_one_update_after_the_other(script):
    rng = np.random.default_rng(0)
    chunks, each, single = (
        [rng.normal(-20, 3, (steps, 3)) for steps in (1, 7, 200)],
        *(script.RunningMeanStd() for _ in range(2)),
    )
    for x in chunks:
        variances = each.update_each(x)
        for row, variance in zip(x, variances, strict=True):
            single.update(row)
            assert variance == pytest.approx(single.squares / single.count, rel=1e-9)
    for name in ("count", "mean", "squares"):
        np.testing.assert_allclose(getattr(each, name), getattr(single, name), rtol=1e-9)


def test_normalize_is_frozen(script):
    agent = make_agent(script)
    agent.normalizer.observe(np.random.default_rng(0).normal(size=(5, 3)))
    before = copies(agent)
    agent.normalizer.normalize(np.full((4, 3), 7.0))
    assert_same(before, copies(agent))


def test_normalisation_off(script):
    agent = make_agent(script, num_envs=1, normalize_obs=False, normalize_reward=False)
    before = copies(agent)
    obs, rewards = np.array([[100.0, -1000.0, 0.5]]), np.array([[1000.0], [-3.0]])
    for normalise in (agent.normalizer.observe, agent.normalizer.normalize):
        np.testing.assert_array_equal(normalise(obs), obs)
    np.testing.assert_array_equal(agent.normalizer.scale_rewards(rewards, np.zeros((2, 1), bool)), rewards)
    assert_same(before, copies(agent))


def test_normalizer_tensors_share_its_memory(script):
    """A checkpoint's tensors are the normaliser's own numbers, in both directions."""
    normalizer = script.Normalizer(2, 3, script.Args())
    tensors = normalizer.tensors()
    before = {name: x.clone() for name, x in tensors.items()}
    normalizer.observe(np.random.default_rng(0).normal(size=(2, 3)))
    normalizer.scale_rewards(np.ones((3, 2)), np.zeros((3, 2), bool))
    assert all((tensors[name] != before[name]).all() for name in tensors)
    for x in tensors.values():
        x.fill_(2.5)
    for array in (*vars(normalizer.obs).values(), *vars(normalizer.returns).values(), normalizer.discounted):
        assert (array == 2.5).all()


# --- Environments and rollouts ----------------------------------------------------------------------------------------


def random_actions(env_id, steps, num_envs):
    space = gym.make(env_id).action_space
    return np.random.default_rng(0).uniform(space.low, space.high, (steps, num_envs, *space.shape)).astype("f")


@pytest.mark.parametrize(
    "env_id, steps",
    [("Hopper-v5", 200), ("Pendulum-v1", 450), ("BipedalWalker-v3", 300), ("probe_envs:Counter-v0", 30)],
)
def test_environments_against_plain_loop(script, env_id, steps):
    """Every episode as if played alone, in an environment of its own with the episode's seed."""
    envs, actions = script.Environments(env_id, 2, seed=5), random_actions(env_id, steps, 2)
    first_obs = envs.obs.copy()
    outcomes = []
    for t in range(steps):
        obs, *outcome = envs.step(actions[t])
        outcomes.append((obs.copy(), *outcome))
    episodes = 0
    for i in range(2):
        episode, before = -1, None
        for t in range(steps):
            if before is None:
                episode, rewards, env = episode + 1, [], gym.make(env_id)
                before, _ = env.reset(seed=script.episode_seeds(5, 0, i, episode)[0])
                np.testing.assert_array_equal(outcomes[t - 1][0][i] if t else first_obs[i], before)
            obs, reward, terminated, truncated, _ = env.step(actions[t, i])
            rewards.append(reward)
            assert [column[i] for column in outcomes[t][1:4]] == [reward, terminated, truncated]
            ended = outcomes[t][4]
            if terminated or truncated:
                last_obs, episode_return, length = ended[i]
                np.testing.assert_array_equal(last_obs, obs)
                assert (episode_return, length) == (pytest.approx(sum(rewards)), len(rewards))
                episodes, before = episodes + 1, None
            else:
                assert i not in ended
                np.testing.assert_array_equal(outcomes[t][0][i], obs)
    assert episodes >= 2


@pytest.mark.parametrize(
    "env_id, steps",
    [
        ("BipedalWalker-v3", 300),
        ("HalfCheetah-v5", 1040),
        ("LunarLanderContinuous-v3", 150),
        ("Pendulum-v1", 230),
        ("Pendulum-v1", 200),  # an episode has just begun
    ],
)
def test_environments_replay_exactly(script, env_id, steps):
    """Loaded into new environments, a saved state goes on bit for bit, over the episodes' ends."""
    actions, seed = random_actions(env_id, steps + 250, 2), 9
    envs = script.Environments(env_id, 2, seed)
    assert any(envs.step(actions[t])[4] for t in range(steps))
    buffer = io.BytesIO()
    torch.save(envs.state(), buffer)
    again = script.Environments(env_id, 2, seed)
    again.load(torch.load(io.BytesIO(buffer.getvalue()), weights_only=True))
    np.testing.assert_array_equal(again.obs, envs.obs)
    for t in range(steps, steps + 250):
        obs, *outcome, ended = envs.step(actions[t])
        obs_again, *outcome_again, ended_again = again.step(actions[t])
        np.testing.assert_array_equal(obs_again, obs)
        assert outcome_again == outcome
        assert ended_again.keys() == ended.keys()
        for i in ended:
            np.testing.assert_array_equal(ended_again[i][0], ended[i][0])
            assert ended_again[i][1:] == ended[i][1:]


@pytest.mark.parametrize("num_envs", [1, 3])
def test_rollouts_of_a_counter_by_hand(script, num_envs):
    """Two rollouts of 11 steps through episodes of 7: one episode ends in each, the second begins in the first."""
    agent = agent_for(script, "probe_envs:Counter-v0", num_envs=num_envs, normalize_obs=False)
    envs, rng = script.Environments("probe_envs:Counter-v0", num_envs, seed=1), np.random.default_rng(0)
    first = script.collect(agent, envs, agent.normalizer.observe(envs.obs), 11, rng)
    second = script.collect(agent, envs, first.obs[-1], 11, rng)
    for roll, counts, rewards, ends in (
        (first, [0, 1, 2, 3, 4, 5, 6, 0, 1, 2, 3, 4], [1, 2, 3, 4, 5, 6, 7, 1, 2, 3, 4], [6]),
        (second, [4, 5, 6, 0, 1, 2, 3, 4, 5, 6, 0, 1], [5, 6, 7, 1, 2, 3, 4, 5, 6, 7, 1], [2, 9]),
    ):
        for i in range(num_envs):
            assert roll.obs[:, i, 0].tolist() == counts
            assert roll.rewards[:, i].tolist() == roll.next_obs[:, i, 0].tolist() == rewards
            assert np.flatnonzero(roll.truncated[:, i]).tolist() == ends
        assert not roll.terminated.any()
        assert {key: obs.tolist() for key, obs in roll.final_obs.items()} == {
            (t, i): [7.0] for t in ends for i in range(num_envs)
        }
        assert roll.episodes == [((t + 1) * num_envs, 28.0, 7) for t in ends for _ in range(num_envs)]


def test_actions_are_clipped_for_the_environment_only(script, monkeypatch):
    agent = agent_for(script, "Pendulum-v1", num_envs=2, log_std_init=1.0)
    agent.params["actor.2.weight"] *= 100  # a mean that depends visibly on the observation
    envs, executed, obs_seen = script.Environments("Pendulum-v1", 2, seed=1), [], []

    def step(actions, original=envs.step):
        executed.append(actions.copy())
        obs, *rest = original(actions)
        obs_seen.append(obs.copy())
        return obs, *rest

    monkeypatch.setattr(envs, "step", step)
    first = agent.normalizer.observe(envs.obs)
    roll = script.collect(agent, envs, first, 50, np.random.default_rng(0))
    assert (np.abs(roll.actions) > 2).mean() > 0.2
    np.testing.assert_array_equal(executed, np.clip(roll.actions, -2, 2))

    replayed = script.Normalizer(2, 3, agent.args)
    np.testing.assert_array_equal(roll.obs[0], replayed.observe(script.Environments("Pendulum-v1", 2, seed=1).obs))
    for t in range(50):
        np.testing.assert_array_equal(roll.obs[t + 1], replayed.observe(obs_seen[t]))

    mean = agent.actor.mean(script.layers(agent.params, "actor"), torch.tensor(roll.obs[:-1].reshape(100, 3)))
    policy = torch.distributions.Normal(mean, agent.params["log_std"].exp())
    logprobs = policy.log_prob(torch.tensor(roll.actions.reshape(100, 1))).sum(1)
    np.testing.assert_allclose(roll.logprobs.reshape(100), logprobs, rtol=0, atol=1e-4)


# --- Learning rate ----------------------------------------------------------------------------------------------------


def test_adam_step_sizes_by_hand(script):
    sizes = script.adam_step_sizes(0.1, first=1, count=3)
    expected = [[1.0, 31.6227766], [0.526315789, 22.3662720], [0.369003690, 18.2665511]]
    np.testing.assert_allclose(sizes, expected, rtol=1e-8)
    np.testing.assert_array_equal(script.adam_step_sizes(0.1, first=3, count=1)[0], sizes[2])


def test_learning_rate_is_annealed_as_in_cleanrl(script, tmp_path, monkeypatch):
    """(1 - (iteration - 1) / num_iterations) lr, where an incomplete last rollout is no iteration."""
    flags = "--env-id probe_envs:Counter-v0 --num-steps 8 --num-minibatches 2 --update-epochs 1 --total-timesteps 35"
    flags += " --learning-rate 0.004 --eval-episodes 1 --final-eval-episodes 1 --no-compile --no-progress"
    monkeypatch.setattr(sys, "argv", [script.__file__, *flags.split(), "--run-dir", str(tmp_path / "run")])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    script.main()
    events = EventAccumulator(str(tmp_path / "run")).Reload().Scalars("charts/learning_rate")
    assert [event.step for event in events] == [8, 16, 24, 32]
    assert [event.value for event in events] == pytest.approx([0.004, 0.003, 0.002, 0.001])


# --- Evaluation -------------------------------------------------------------------------------------------------------


class Watched(gym.Wrapper):
    """Notes every reset's seed, and refuses to be stepped beyond its episode's end."""

    resets = []

    def reset(self, seed=None, options=None):
        self.resets.append(seed)
        self.running = True
        return self.env.reset(seed=seed)

    def step(self, action):
        assert self.running
        outcome = self.env.step(action)
        self.running = not (outcome[2] or outcome[3])
        return outcome


@pytest.mark.parametrize("env_id", ["Hopper-v5", "LunarLanderContinuous-v3", "probe_envs:Terminator-v0"])
def test_evaluation_against_plain_loop(script, monkeypatch, env_id):
    """One deterministic episode per seed, and nothing of the training is touched."""
    agent = agent_for(script, env_id, num_envs=2)
    agent.params = {name: p.double() for name, p in agent.params.items()}  # so that rounding cannot grow visible
    agent.params["actor.2.weight"] *= 50
    envs = script.Environments(env_id, 2, seed=1)
    script.collect(agent, envs, agent.normalizer.observe(envs.obs), 100, np.random.default_rng(0))
    seeds, make_env = [11, 7, 11, 13], script.make_env
    monkeypatch.setattr(Watched, "resets", [])
    monkeypatch.setattr(script, "make_env", lambda *args: Watched(make_env(*args)))
    before, generators = copies(agent), (torch.get_rng_state(), np.random.get_state())
    returns, lengths = script.evaluate(agent, seeds)
    assert Watched.resets == seeds
    assert_same(before, copies(agent))
    assert torch.equal(torch.get_rng_state(), generators[0])
    assert str(np.random.get_state()) == str(generators[1])

    mean, std = agent.normalizer.obs.mean, np.sqrt(agent.normalizer.obs.squares / agent.normalizer.obs.count + 1e-8)
    for seed, episode_return, length in zip(seeds, returns, lengths, strict=True):
        env, rewards, ended = gym.make(env_id), [], False
        obs, _ = env.reset(seed=seed)
        while not ended:
            normalised = np.clip((obs - mean) / std, -10, 10).astype("f").astype(float)[None]
            action = agent.actor.mean(script.layers(agent.params, "actor"), torch.tensor(normalised))[0].numpy()
            action = np.clip(action, env.action_space.low, env.action_space.high)
            obs, reward, terminated, truncated, _ = env.step(action)
            rewards.append(reward)
            ended = terminated or truncated
        assert length == len(rewards)
        assert episode_return == pytest.approx(sum(rewards), rel=1e-6)
    assert returns[0] == returns[2]


def test_evaluation_seeds():
    used = {}
    for seed in (1, 2):
        for step in range(100_000, 2_000_001, 100_000):
            for final in (False, True):
                seeds = refineppo_continuous.evaluation_seeds(
                    refineppo_continuous.Args(seed=seed, eval_episodes=10, final_eval_episodes=7), step, final
                )
                same = ppo_continuous.evaluation_seeds(
                    ppo_continuous.Args(seed=seed, eval_episodes=10, final_eval_episodes=7), step, final
                )
                assert seeds == same
                assert len(seeds) == (7 if final else 10)
                assert all(s % 2 == final for s in seeds)
                used[seed, step, final] = set(seeds)
    assert sum(map(len, used.values())) == len(set.union(*used.values())) == 2 * 20 * 17
