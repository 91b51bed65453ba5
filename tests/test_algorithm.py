"""The algorithm, part by part, against hand calculation, plain loops, torch's modules and gymnasium's wrappers."""

import io
import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import make_agent
from gymnasium.spaces import Box
from sklearn.metrics import explained_variance_score
from test_commands import QUICK, call_main, read_events

import ppo_continuous
import refineppo_continuous

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


def agent_and_envs(script, env_id, **flags):
    training = script.Training(script.Args(env_id=env_id, **flags))
    return training.agent, training.envs


def copies(agent):
    """Everything in an agent that training changes."""
    return {(part, name): x.clone() for part, tensors in agent.state().items() for name, x in tensors.items()}


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


@pytest.mark.parametrize("schedule, depth", COEFFICIENTS)
def test_refinement_coefficients(schedule, depth):
    args = refineppo_continuous.Args(refinement_depth=depth, refinement_schedule=schedule)
    assert refineppo_continuous.refinement_coefficients(args) == COEFFICIENTS[schedule, depth]


@pytest.mark.parametrize("hidden", [(8,), (8, 8), (16, 8, 4)])
@pytest.mark.parametrize("schedule, depth", COEFFICIENTS)
def test_proposals_against_plain_loop(schedule, depth, hidden):
    weights, obs = random_network([5, *hidden, 2]), np.random.default_rng(1).normal(size=(7, 3))
    coefficients, tensors = COEFFICIENTS[schedule, depth], [tuple(map(torch.tensor, layer)) for layer in weights]
    expected = refine(weights, obs, coefficients)
    in_tensors = refineppo_continuous.proposals(tensors, coefficients, torch.tensor(obs))
    for proposals in (refineppo_continuous.proposals(weights, coefficients, obs), [m.numpy() for m in in_tensors]):
        assert len(proposals) == depth
        np.testing.assert_allclose(proposals, expected, rtol=0, atol=1e-12)
    single = refineppo_continuous.proposals(weights, coefficients, obs[:1])
    np.testing.assert_allclose(single[-1], expected[-1][:1], rtol=0, atol=1e-12)


def test_one_step_is_f_of_s_and_0():
    """Proposition 1: for K = 1 every schedule, each of c_1 = 1, is the same direct mapping."""
    weights, obs = random_network([5, 8, 8, 2]), np.random.default_rng(1).normal(size=(7, 3))
    (m_1,) = refineppo_continuous.proposals(weights, [1.0], obs)
    np.testing.assert_allclose(m_1, network(weights, np.c_[obs, np.zeros((7, 2))]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("schedule, depth", [key for key in COEFFICIENTS if key[1] > 1] + [("average", 1)])
def test_gradient_of_the_chain_against_finite_differences(schedule, depth):
    """Central differences of the plain loop, for every parameter: the gradient flows through all K steps."""
    shapes, rng, h = ((5, 4), (4,), (4, 4), (4,), (4, 2), (2,)), np.random.default_rng(1), 1e-6
    starts = np.cumsum([0, *map(math.prod, shapes)])
    x, obs, direction = (rng.normal(size=size) for size in (starts[-1], (6, 3), (6, 2)))

    def m_K(function, x, obs):
        parts = [x[a:b].reshape(shape) for a, b, shape in zip(starts, starts[1:], shapes)]
        return function(list(zip(parts[::2], parts[1::2])), obs, COEFFICIENTS[schedule, depth])[-1]

    tensor = torch.tensor(x, requires_grad=True)
    mean = m_K(lambda weights, obs, c: refineppo_continuous.proposals(weights, c, obs), tensor, torch.tensor(obs))
    (torch.tensor(direction) * mean).sum().backward()
    slopes = [(m_K(refine, x + step, obs) - m_K(refine, x - step, obs)) / (2 * h) for step in h * np.eye(len(x))]
    np.testing.assert_allclose(tensor.grad, (direction * slopes).sum((1, 2)), rtol=1e-6, atol=1e-8)


def test_refinement_scalars_by_hand():
    """A saturated layer tells (s, m) = (1, m_0), (1, m_1), (-1, m_0) and (-1, m_1) apart; a seventh of the rows counts.

    For s = 1: m_1 = m_2 = (3, 4); for s = -1: m_1 = (1, 0), m_2 = (5, -3).
    """
    flags = {"refinement_depth": 2, "refinement_schedule": "uniform", "actor_hidden": (3,)}
    agent = make_agent(refineppo_continuous, obs_dim=1, action_dim=2, **flags)
    agent.low, agent.high = np.array([-2.0, -2.0], "f"), np.array([4.0, 3.5], "f")
    signs = torch.tensor([[1.0, -1, -1, 1], [1, 1, 1, 1], [-1, -1, -1, 1], [-1, 1, -1, 1]])  # of s, m_x - 0.5, m_x - 2
    corrections = torch.linalg.solve(signs, torch.tensor([[3.0, 4], [0, 0], [1, 0], [4, -3]]))
    agent.params["actor.0.weight"][:] = 100 * torch.tensor([[1.0, 0, 0], [0, 1, 1], [0, 0, 0]])
    agent.params["actor.0.bias"][:] = 100 * torch.tensor([0, -0.5, -2])
    agent.params["actor.1.weight"][:], agent.params["actor.1.bias"][:] = corrections[:3], corrections[3]
    obs = torch.full((14, 1), 9.0)
    obs[0], obs[7] = 1, -1
    assert refineppo_continuous.refinement_scalars(agent, obs) == pytest.approx(
        {
            "refinement/correction_norm_1": (5 + 1) / 2,
            "refinement/correction_norm_2": (0 + 5) / 2,
            "refinement/settling_error_1": ((4 / 2) / (8 / 2) + (3 / 2) / (7 / 2)) / 2,
            "refinement/settling_error_2": 0,
            "refinement/outside_bounds_1": 1 / 2,
            "refinement/outside_bounds_2": 1,
        },
        abs=1e-5,
    )


# --- Networks and their initial values --------------------------------------------------------------------------------


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
    flags |= dict(num_steps=steps, bootstrap_truncated=bootstrap)
    agent, envs = agent_and_envs(script, f"probe_envs:{env}-v0", **flags)
    set_critic(agent)
    roll = script.collect(agent, envs, steps, np.random.default_rng(0))

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
    batch, explained_variance = script.prepare_batch(agent, roll)
    np.testing.assert_array_equal(batch.obs[:, 0], counts[:-1])
    np.testing.assert_array_equal(batch.actions, roll.actions[:, 0])
    np.testing.assert_array_equal(batch.logprobs, roll.logprobs[:, 0])
    for tensor, expected in zip(batch[3:], (advantages[:-1], expected_returns, values), strict=True):
        np.testing.assert_allclose(tensor, expected, rtol=1e-5)
    assert explained_variance == pytest.approx(explained_variance_score(expected_returns, values), rel=1e-5)


def test_batch_of_several_environments(script):
    """Rows keep together, step by step; rewards are scaled first and bootstrapped then; a termination at the time
    limit is a termination."""
    flags = dict(num_envs=3, num_steps=4, bootstrap_truncated=True, critic_hidden=(1,), gamma=0.9)
    agent = make_agent(script, obs_dim=1, action_dim=2, **flags)
    set_critic(agent)
    rng = np.random.default_rng(0)
    obs, actions, logprobs = (rng.normal(size=s).astype("f") for s in ((5, 3, 1), (4, 3, 2), (4, 3)))
    rewards, terminated, truncated = rng.normal(size=(4, 3)), np.zeros((4, 3), bool), np.zeros((4, 3), bool)
    terminated[1, 0] = terminated[2, 1] = truncated[2, 1] = truncated[1, 2] = True
    last = {end: np.array([0.7], "f") for end in ((1, 0), (2, 1), (1, 2))}
    roll = script.Rollout(obs, actions, logprobs, rewards.copy(), terminated, truncated, last, episodes=[])
    expected_rewards = script.Normalizer(3, 1, agent.args).scale_rewards(rewards, terminated)
    expected_rewards[1, 2] += 0.9 * (3 * math.tanh(0.7 / 2) + 1)
    values = 3 * np.tanh(obs[..., 0] / 2) + 1
    advantages = script.gae(expected_rewards, values, terminated | truncated, 0.9, 0.95)

    batch, _ = script.prepare_batch(agent, roll)
    assert isinstance(batch, script.Batch)
    columns = dict(obs=obs[:-1], actions=actions, logprobs=logprobs, advantages=advantages)
    columns |= dict(returns=advantages + values[:-1], values=values[:-1])
    assert batch._fields == tuple(columns)
    for name, expected in columns.items():
        tensor = getattr(batch, name)
        assert tensor.dtype == torch.float32 and tensor.shape == (12, *expected.shape[2:])
        for row, (t, i) in zip(tensor, np.ndindex(4, 3)):
            np.testing.assert_allclose(row, expected[t, i], rtol=1e-5, atol=1e-6)


# --- Normalizer -------------------------------------------------------------------------------------------------------


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
    agent, envs = agent_and_envs(script, env_id, seed=3)
    roll = script.collect(agent, envs, steps, np.random.default_rng(0))
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
    """A checkpoint's tensors are the normalizer's own numbers, in both directions."""
    normalizer = script.Normalizer(2, 3, script.Args())
    tensors = normalizer.state()
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
    envs, actions = script.Environments(script.Args(env_id, num_envs=2, seed=5)), random_actions(env_id, steps, 2)
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
    actions, args = random_actions(env_id, steps + 250, 2), script.Args(env_id, num_envs=2, seed=9)
    envs = script.Environments(args)
    assert any(envs.step(actions[t])[4] for t in range(steps))
    buffer = io.BytesIO()
    torch.save(envs.state(), buffer)
    again = script.Environments(args)
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
    agent, envs = agent_and_envs(script, "probe_envs:Counter-v0", num_envs=num_envs, normalize_obs=False)
    rng = np.random.default_rng(0)
    first, second = script.collect(agent, envs, 11, rng), script.collect(agent, envs, 11, rng)
    for roll, counts, rewards, ends in (
        (first, [0, 1, 2, 3, 4, 5, 6, 0, 1, 2, 3, 4], [1, 2, 3, 4, 5, 6, 7, 1, 2, 3, 4], [6]),
        (second, [4, 5, 6, 0, 1, 2, 3, 4, 5, 6, 0, 1], [5, 6, 7, 1, 2, 3, 4, 5, 6, 7, 1], [2, 9]),
    ):
        for i in range(num_envs):
            assert roll.obs[:, i, 0].tolist() == counts
            assert roll.rewards[:, i].tolist() == rewards
            assert np.flatnonzero(roll.truncated[:, i]).tolist() == ends
        assert not roll.terminated.any()
        assert {key: obs.tolist() for key, obs in roll.final_obs.items()} == {
            (t, i): [7.0] for t in ends for i in range(num_envs)
        }
        assert roll.episodes == [((t + 1) * num_envs, 28.0, 7) for t in ends for _ in range(num_envs)]


def test_actions_are_clipped_for_the_environment_only(script, monkeypatch):
    agent, envs = agent_and_envs(script, "Pendulum-v1", num_envs=2, log_std_init=1.0)
    executed, obs_seen = [], [envs.obs.copy()]

    def step(actions, original=envs.step):
        executed.append(actions.copy())
        obs, *rest = original(actions)
        obs_seen.append(obs.copy())
        return obs, *rest

    monkeypatch.setattr(envs, "step", step)
    roll = script.collect(agent, envs, 50, np.random.default_rng(0))
    assert (np.abs(roll.actions) > 2).mean() > 0.2
    np.testing.assert_array_equal(executed, np.clip(roll.actions, -2, 2))
    replayed = script.Normalizer(2, 3, agent.args)
    for seen, raw in zip(roll.obs, obs_seen, strict=True):
        np.testing.assert_array_equal(seen, replayed.observe(raw))


# --- Learning rate ----------------------------------------------------------------------------------------------------


def test_adam_step_sizes_by_hand(script):
    adam = script.Adam({})
    sizes = adam.step_sizes(0.1, count=3)
    expected = [[1.0, 31.6227766], [0.526315789, 22.3662720], [0.369003690, 18.2665511]]
    np.testing.assert_allclose(sizes, expected, rtol=1e-7)
    adam.steps = 2
    np.testing.assert_array_equal(adam.step_sizes(0.1, count=1)[0], sizes[2])


def test_learning_rate_is_annealed_as_in_cleanrl(script, tmp_path):
    """(1 - (iteration - 1) / num_iterations) lr, where an incomplete last rollout is no iteration."""
    flags = "--env-id probe_envs:Counter-v0 --num-steps 8 --total-timesteps 35 --learning-rate 0.004 --no-progress"
    call_main(script, *QUICK, *flags.split(), "--run-dir", tmp_path)
    events = read_events(tmp_path).Scalars("charts/learning_rate")
    assert [event.step for event in events] == [8, 16, 24, 32]
    assert [event.value for event in events] == pytest.approx([0.004, 0.003, 0.002, 0.001])


# --- Evaluation -------------------------------------------------------------------------------------------------------


def rewards_of_an_episode(env: gym.Env, agent, seed: int) -> list[float]:
    """A loop of one's own over `act`, which test_agent.py compares with a plain loop over the network."""
    (obs, _), rewards, ended = env.reset(seed=seed), [], False
    while not ended:
        obs, reward, terminated, truncated, _ = env.step(agent.act(obs))
        rewards.append(reward)
        ended = terminated or truncated
    return rewards


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
    agent, envs = agent_and_envs(script, env_id, num_envs=2)
    agent.params["actor.2.weight"] *= 50
    script.collect(agent, envs, 100, np.random.default_rng(0))
    seeds, make_env, before = [11, 7, 11, 13], script.make_env, copies(agent)
    monkeypatch.setattr(Watched, "resets", [])
    monkeypatch.setattr(script, "make_env", lambda *args, **facts: Watched(make_env(*args, **facts)))
    returns, lengths = script.evaluate(agent, seeds)
    assert Watched.resets == seeds
    assert_same(before, copies(agent))
    for seed, episode_return, length in zip(seeds, returns, lengths, strict=True):
        rewards = rewards_of_an_episode(gym.make(env_id), agent, seed)
        assert (episode_return, length) == (sum(rewards), len(rewards))
    assert returns[0] == returns[2]


def test_evaluation_seeds():
    """The same of both scripts; no two evaluations share one; a C int holds them."""
    used = {}
    for seed, step, final in itertools.product((1, 2), range(100_000, 2_000_001, 100_000), (False, True)):
        flags = {"seed": seed, "eval_episodes": 10, "final_eval_episodes": 7}
        seeds, same = (m.evaluation_seeds(m.Args(**flags), step, final) for m in (ppo_continuous, refineppo_continuous))
        assert seeds == same and len(seeds) == (7 if final else 10)
        assert all(s % 2 == final and 0 <= s < 2**31 for s in seeds)
        used[seed, step, final] = set(seeds)
    assert sum(map(len, used.values())) == len(set.union(*used.values())) == 2 * 20 * 17
