"""The quantities of analysis_refinement.py, against plain loops, linear algebra and dynamics known beforehand."""

from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pandas as pd
import pytest
import torch
from sklearn.metrics import r2_score
from sklearn.model_selection import GroupKFold, KFold

import analysis_refinement as analysis
import refineppo_continuous
import refineppo_continuous as refineppo
from analysis_refinement import Args, Figures, Policy

ARGS = Args(checkpoint=())
NAMES = ["a", "b", "c", "d"]


def box(size: int) -> gym.spaces.Box:
    return gym.spaces.Box(-1.0, 1.0, (size,))


def random_policy(action_dim=3, **flags) -> Policy:
    """One of five observations whose f is far from linear and depends on m."""
    agent = refineppo.Agent(box(5), box(action_dim), refineppo.Args(actor_hidden=(16, 16), **flags))
    generator = torch.Generator().manual_seed(3)
    for p in agent.params.values():
        p.copy_(0.5 * torch.randn(p.shape, generator=generator))
    return Policy(Path("best.pt"), agent, 2048, NAMES[:action_dim])


def linear_policy(from_obs: np.ndarray, from_m: np.ndarray, **flags) -> Policy:
    """One with f(s, m) = from_obs s + from_m m: tanh of small inputs, scaled back."""
    action_dim, obs_dim = from_obs.shape
    size, small = obs_dim + action_dim, 1e-4
    agent = refineppo.Agent(box(obs_dim), box(action_dim), refineppo.Args(actor_hidden=(size,), **flags))
    agent.params["actor.0.weight"].copy_(small * torch.eye(size))
    agent.params["actor.1.weight"].copy_(torch.from_numpy(np.hstack([from_obs, from_m])).T / small)
    return Policy(Path("best.pt"), agent, 2048, NAMES[:action_dim])


def task_policy(env_id: str, scale=1.0, reads=1.0, **flags) -> Policy:
    """An untrained one for a task, with corrections `scale` times as large as at initialisation, whose f reads `reads`
    times the proposal."""
    env = gym.make(env_id)
    agent = refineppo.Agent(env.observation_space, env.action_space, refineppo.Args(env_id=env_id, **flags))
    agent.params[f"actor.{len(agent.args.actor_hidden)}.weight"].mul_(scale)
    agent.params["actor.0.weight"][env.observation_space.shape[0] :] *= reads
    return Policy(Path("best.pt"), agent, 2048, analysis.component_names(env_id))


def f(policy: Policy, obs: np.ndarray, m: np.ndarray) -> np.ndarray:
    """f(s, m) of one or several states, in double precision."""
    *hidden, output = [[p.double().numpy() for p in layer] for layer in refineppo.layers(policy.agent.params, "actor")]
    x = np.concatenate([obs, m], axis=-1)
    for w, b in hidden:
        x = np.tanh(x @ w + b)
    return x @ output[0] + output[1]


def coefficients(policy: Policy) -> list[float]:
    depth = policy.args.refinement_depth
    of = {"average": lambda k: 1 / depth, "uniform": lambda k: 1.0, "inverse": lambda k: 1 / k}
    return [of[policy.args.refinement_schedule](k) for k in range(1, depth + 1)]


def proposals_of(policy: Policy, obs: np.ndarray) -> np.ndarray:
    """(K + 1, ..., action_dim), by the definition: m_{k+1} = m_k + c_{k+1} f(s, m_k)."""
    m = [np.zeros((*obs.shape[:-1], len(policy.names)))]
    for c in coefficients(policy):
        m.append(m[-1] + c * f(policy, obs, m[-1]))
    return np.array(m)


def play(policy: Policy, act, seeds: list[int]) -> list[float]:
    """Returns of plain episodes; act: one normalised observation -> action, which is clipped."""
    returns, env = [], gym.make(policy.args.env_id)
    for seed in seeds:
        obs, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            action = act(policy.agent.normalizer.normalize(obs[None])[0])
            low, high = env.action_space.low, env.action_space.high
            obs, reward, terminated, truncated, _ = env.step(np.clip(action, low, high).astype(np.float32))
            total, over = total + reward, terminated or truncated
        returns.append(total)
    return returns


def final_seeds(policy: Policy, count: int) -> list[int]:
    args = refineppo.Args(env_id=policy.args.env_id, final_eval_episodes=count)
    return refineppo.evaluation_seeds(args, policy.global_step, final=True)


# --- Settling error ---------------------------------------------------------------------------------------------------


def test_settling_error_equals_a_plain_loop():
    proposals = np.random.default_rng(0).normal(size=(4, 7, 3))
    error = analysis.settling_error(proposals)
    assert error.shape == (4, 3)
    for k in range(4):
        for j in range(3):
            remaining = sum(abs(proposals[3, s, j] - proposals[k, s, j]) for s in range(7)) / 7
            final = sum(abs(proposals[3, s, j]) for s in range(7)) / 7
            assert error[k, j] == pytest.approx(remaining / (final + 1e-8), rel=1e-12)


def test_settling_error_by_hand():
    """Two states, K = 2: component 0 is at its end after one step, 1 half way, 2 overshoots, 3 never moves."""
    m_1 = [[1.0, 2.0, 4.0, 0.0], [-1.0, 1.0, -4.0, 0.0]]
    m_2 = [[1.0, 4.0, 2.0, 0.0], [-1.0, 2.0, -2.0, 0.0]]
    error = analysis.settling_error(np.array([np.zeros((2, 4)), m_1, m_2]))
    np.testing.assert_allclose(error, [[1, 1, 1, 0], [0, 0.5, 1, 0], [0, 0, 0, 0]], atol=1e-8)


def test_order_with_ties():
    """Ascending e_1; components that tie keep their order in the action."""
    order, early, late = analysis.early_and_late(np.array([[1, 1, 1, 1], [0.5, 0.2, 0.5, 0.2], [0, 0, 0, 0]]))
    assert order.tolist() == [1, 3, 0, 2]
    assert early.tolist() == [1, 3]
    assert late.tolist() == [0, 2]


@pytest.mark.parametrize("action_dim, count", [(1, 0), (2, 1), (3, 1), (9, 4), (10, 5), (17, 5)])
def test_how_many_are_early_and_late(action_dim, count):
    error = np.random.default_rng(1).random((3, action_dim))
    order, early, late = analysis.early_and_late(error)
    assert sorted(order) == list(range(action_dim))
    assert len(early) == len(late) == count
    assert early.tolist() == order[:count].tolist()
    assert late.tolist() == order[action_dim - count :].tolist()


def test_settling_rows():
    proposals = np.random.default_rng(0).normal(size=(4, 9, 3))
    rows, error = analysis.settling_rows(proposals, NAMES[:3]), analysis.settling_error(proposals)
    assert [row["step"] for row in rows] == [0, 1, 2, 3] * 3
    assert [row["rank"] for row in rows] == [1] * 4 + [2] * 4 + [3] * 4
    first = [row["error"] for row in rows if row["step"] == 1]
    assert first == sorted(first)
    for row in rows:
        assert row["error"] == error[row["step"], NAMES.index(row["component"])]


# --- delta R^2 --------------------------------------------------------------------------------------------------------


def plain_ridge_r2(features: np.ndarray, target: np.ndarray, folds) -> float:
    """Ridge regression in closed form: alpha 1, features standardised and the target centred on the training fold."""
    scores = []
    for train, test in folds:
        mean, std = features[train].mean(0), features[train].std(0)
        std = np.where(std == 0, 1, std)
        x, centre = (features[train] - mean) / std, target[train].mean()
        beta = np.linalg.solve(x.T @ x + np.eye(x.shape[1]), x.T @ (target[train] - centre))
        residual = target[test] - centre - (features[test] - mean) / std @ beta
        scores.append(1 - (residual**2).sum() / ((target[test] - target[test].mean()) ** 2).sum())
    assert len(scores) == 5
    return np.mean(scores)


def test_delta_r2_and_its_checks_equal_closed_form_ridge(monkeypatch):
    monkeypatch.setattr(analysis, "SHUFFLES", 2)
    policy, rng = random_policy(action_dim=4), np.random.default_rng(0)
    obs, episodes = rng.normal(size=(123, 5)), np.repeat(np.arange(41), 3)
    proposals = proposals_of(policy, obs)
    _, early, late = analysis.early_and_late(analysis.settling_error(proposals))
    shuffled = list(KFold(5, shuffle=True, random_state=0).split(obs))
    whole = list(GroupKFold(5).split(obs, groups=episodes))
    tables = analysis.r2_tables(proposals, NAMES, obs, episodes, seed=0)
    rows, checks = ({(row["component"], row["step_from"]): row for row in table} for table in tables.values())
    assert list(rows) == list(checks) == [(NAMES[j], k) for j in late for k in (1, 2, 3)]
    for j in late:
        for k in (1, 2, 3):
            own, both = proposals[k][:, [j]], proposals[k][:, [j, *early]]
            target = proposals[k + 1][:, j] - proposals[k][:, j]
            row, check = rows[NAMES[j], k], checks[NAMES[j], k]
            assert row["step_to"] == check["step_to"] == k + 1
            baseline, augmented = plain_ridge_r2(own, target, shuffled), plain_ridge_r2(both, target, shuffled)
            assert row["r2_baseline"] == pytest.approx(baseline, abs=1e-9)
            assert row["r2_augmented"] == pytest.approx(augmented, abs=1e-9)
            assert row["delta_r2"] == check["delta_r2"] == pytest.approx(augmented - baseline, abs=1e-9)
            by_episode = plain_ridge_r2(both, target, whole) - plain_ridge_r2(own, target, whole)
            assert check["by_episode"] == pytest.approx(by_episode, abs=1e-9)
            own, both = np.hstack([own, obs]), np.hstack([both, obs])
            given_obs = plain_ridge_r2(both, target, shuffled) - plain_ridge_r2(own, target, shuffled)
            assert check["given_observation"] == pytest.approx(given_obs, abs=1e-9)


def check_of_two(late_correction: np.ndarray, early: np.ndarray, late: np.ndarray, obs: np.ndarray) -> dict:
    """The checks of an early component that has settled after a step, and a late one that is corrected again."""
    m_1 = np.stack([early, late], axis=1)
    proposals = np.stack([np.zeros_like(m_1), m_1, m_1 + np.stack([0 * early, late_correction], axis=1)])
    episodes = np.repeat(np.arange(20), len(early) // 20)
    (check,) = analysis.r2_tables(proposals, ["early", "late"], obs, episodes, seed=0)["delta_r2_checks"]
    assert (check["component"], check["step_from"], check["step_to"]) == ("late", 1, 2)
    return check


def test_delta_r2_tells_dependence_from_independence():
    """Near 1, far above the shuffled band, where the late correction is a function of the early component; within
    the band, which lies at zero, where it is not."""
    rng = np.random.default_rng(0)
    early, late, noise = rng.normal(size=(3, 1000))
    obs = rng.normal(size=(1000, 2))
    check = check_of_two(3 * early, early, late, obs)
    assert min(check["delta_r2"], check["by_episode"], check["given_observation"]) > 0.98
    assert check["shuffled_low"] <= check["shuffled_high"] < 0.02
    assert check["above_shuffled"] == 1
    check = check_of_two(noise, early, late, obs)
    assert abs(check["delta_r2"]) < 0.02
    assert -0.02 < check["shuffled_low"] < check["shuffled_high"] < 0.02
    assert check["shuffled_low"] - 0.005 < check["delta_r2"] < check["shuffled_high"] + 0.005


def test_the_observation_explains_away_what_early_components_only_repeat():
    """Both components are linear in the observation: the paper's number is large, the one given the observation 0."""
    rng = np.random.default_rng(0)
    obs, late = rng.normal(size=(1000, 2)), rng.normal(size=1000)
    check = check_of_two(obs[:, 0], 2 * obs[:, 0], late, obs)
    assert check["delta_r2"] > 0.98
    assert abs(check["given_observation"]) < 1e-3


# --- Dynamics ---------------------------------------------------------------------------------------------------------


def test_jacobian_equals_finite_differences():
    policy, rng = random_policy(), np.random.default_rng(0)
    obs, m, c, h = rng.normal(size=(7, 5)), rng.normal(size=(7, 3)), 0.7, 1e-6
    weights = refineppo.layers({name: p.double() for name, p in policy.agent.params.items()}, "actor")
    exact = analysis.step_jacobians(weights, torch.from_numpy(obs), torch.from_numpy(m), c)
    assert exact.shape == (7, 3, 3)
    for j in range(3):
        plus, minus = (x + c * f(policy, obs, x) for x in (m + h * np.eye(3)[j], m - h * np.eye(3)[j]))
        np.testing.assert_allclose(exact[:, :, j], (plus - minus) / (2 * h), rtol=1e-7, atol=1e-8)


def test_dynamics_of_a_linear_field():
    """f = s + A m: the Jacobian of a step is I + A everywhere."""
    a = np.array([[-0.5, 0.8, 0.0], [0.0, -0.2, 0.1], [0.0, 0.0, -0.9]])
    policy = linear_policy(np.eye(3), a, refinement_depth=3, refinement_schedule="uniform")
    obs = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    values = analysis.dynamics(policy, obs, proposals_of(policy, obs), seed=0)
    step = np.eye(3) + a
    for k in (1, 2, 3):
        np.testing.assert_allclose(values["largest_singular_value"][k], np.linalg.norm(step, 2), rtol=1e-5)
        np.testing.assert_allclose(values["spectral_radius"][k], 0.8, rtol=1e-5)
        correction = obs @ np.linalg.matrix_power(step, k - 1).T  # m_k - m_{k-1} = (I + A)^{k-1} s
        np.testing.assert_allclose(values["correction_norm"][k], np.linalg.norm(correction, axis=1), rtol=1e-4)
    ratio = values["correction_norm"][3] / values["correction_norm"][2]
    np.testing.assert_allclose(values["correction_ratio"][3], ratio, rtol=1e-12)
    assert list(values["correction_ratio"]) == [2, 3]


@pytest.mark.parametrize("decay, schedule", [(0.5, "uniform"), (1.0, "inverse"), (-0.4, "average")])
def test_settling_and_path_independence_known_beforehand(decay, schedule):
    """f = s - decay m, so that m_k = (1 - prod_{i<=k} (1 - c_i decay)) s / decay: of m_0 the product is left."""
    policy = linear_policy(np.eye(2), -decay * np.eye(2), refinement_depth=4, refinement_schedule=schedule)
    obs = np.random.default_rng(0).normal(size=(40, 2)).astype(np.float32)
    proposals = policy.proposals(obs).astype(float)
    left = np.cumprod([1, *(1 - c * decay for c in coefficients(policy))])
    expected = (left - left[-1]) / (1 - left[-1])
    np.testing.assert_allclose(analysis.settling_error(proposals), np.stack([expected] * 2, axis=1), atol=1e-5)
    values = analysis.dynamics(policy, obs, proposals, seed=0)
    for k in range(5):
        np.testing.assert_allclose(values["spread_of_random_starts"][k], left[k], atol=1e-5)


def test_fraction_outside_the_bounds():
    """Bounds +-1: none of four states is outside at k = 1, one component of two states at k = 2."""
    policy = random_policy(action_dim=2, refinement_depth=2)
    m_1, m_2 = np.zeros((4, 2)), np.array([[0.5, -2.0], [0.9, 0.9], [1.5, 0.0], [-1.0, 1.0]])
    values = analysis.dynamics(policy, np.zeros((4, 5), np.float32), np.stack([m_1, m_1, m_2]), seed=0)
    rows = {(row["quantity"], row["step"]): row["value"] for row in analysis.dynamics_rows(values)}
    assert rows["proposals_outside_bounds", 1] == rows["components_outside_bounds", 1] == 0
    assert rows["proposals_outside_bounds", 2] == 2 / 4
    assert rows["components_outside_bounds", 2] == 2 / 8


def test_dynamics_rows_are_medians_and_percentiles():
    x = np.random.default_rng(0).random(101)
    (row,) = analysis.dynamics_rows({"correction_norm": {1: x}})
    assert (row["q10"], row["value"], row["q90"]) == tuple(np.sort(x)[[10, 50, 90]])


# --- States -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lengths", [[1000] * 20, [3, 500, 20, 1, 70, 999], [5, 5, 5], [1] * 30, [2, 40] * 10])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 1.0])
def test_states_are_spread_evenly(lengths, share):
    total = int(share * sum(lengths))
    chosen = analysis.spread_evenly(np.array(lengths), total)
    counts = [len(steps) for steps in chosen]
    assert sum(counts) == total
    for steps, length in zip(chosen, lengths):
        assert len(set(steps.tolist())) == len(steps)
        assert len(steps) < 2 or (steps[0], steps[-1]) == (0, length - 1)
        assert len(steps) < 3 or np.ptp(np.diff(steps)) <= 1
        if len(steps) < length:  # only an episode that has no more gives fewer than another, but for rounding
            assert len(steps) >= max(counts) - 1


def test_recorded_states_are_those_of_plain_episodes():
    pendulum, seen = task_policy("Pendulum-v1", scale=20), []
    pendulum.agent.normalizer.observe(np.random.default_rng(0).normal(size=(10, 3)))

    def act(obs: np.ndarray) -> np.ndarray:
        seen.append(obs)
        return proposals_of(pendulum, obs)[-1]

    obs, episodes = analysis.record_states(pendulum, Args(checkpoint=(), num_states=20 * 200, seed=4))
    assert obs.shape == (4000, 3) and obs.dtype == np.float32
    assert episodes.tolist() == np.repeat(range(20), 200).tolist()
    play(pendulum, act, refineppo.episode_seeds(4, 2, 0, count=20))
    np.testing.assert_allclose(obs, seen, atol=1e-2)


def test_short_episodes_bring_more_episodes():
    """An untrained double pendulum falls within ten steps or so: twenty episodes do not hold 600 states."""
    falling = task_policy("InvertedDoublePendulum-v5")
    obs, episodes = analysis.record_states(falling, Args(checkpoint=(), num_states=600))
    assert len(obs) == len(episodes) == 600
    counts = np.bincount(episodes)
    assert len(counts) % 20 == 0 and len(counts) > 20 and counts.min() > 0


def test_sampled_actions_lead_to_other_states():
    args = [Args(checkpoint=(), num_states=40, sample_actions=sampled) for sampled in (False, True, True)]
    states = [analysis.record_states(task_policy("Reacher-v5"), x)[0] for x in args]
    np.testing.assert_array_equal(states[1], states[2])
    np.testing.assert_array_equal(states[0][::2], states[1][::2])  # the first state of each episode
    assert not np.isclose(states[0][1::2], states[1][1::2]).all()


# --- Feedback ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def small(monkeypatch):
    """A feedback section of seconds."""
    monkeypatch.setattr(analysis, "FIT_STATES", 1000)
    monkeypatch.setattr(analysis, "FEEDBACK_EPISODES", 3)


def feedback(policy: Policy, seed=0) -> tuple[np.ndarray, np.ndarray, dict[str, dict]]:
    """Recorded states, their m_0, ..., m_K, and the section's rows by what f reads."""
    args = Args(checkpoint=(), num_states=60, seed=seed)
    obs, _ = analysis.record_states(policy, args)
    proposals = proposals_of(policy, obs)
    rows = analysis.feedback_rows(policy, obs, proposals, args)
    return obs, proposals, {row["reads"]: row for row in rows}


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["average", "uniform", "inverse"])
def test_feedback_equals_plain_episodes(schedule, small):
    """Every f(s, .) written out: what it reads is replaced, the corrections add up as before."""
    policy = task_policy("Reacher-v5", scale=30, reads=10, refinement_depth=3, refinement_schedule=schedule)
    obs, proposals, rows = feedback(policy, seed=5)
    c, rng, seeds = coefficients(policy), np.random.default_rng(5), final_seeds(policy, 3)
    zero = np.zeros(2)

    def own(s: np.ndarray) -> np.ndarray:
        return proposals_of(policy, s)[-1]

    def reading_zero(s: np.ndarray) -> np.ndarray:
        return c[0] * f(policy, s, zero) + c[1] * f(policy, s, zero) + c[2] * f(policy, s, zero)

    def another_state(s: np.ndarray) -> np.ndarray:
        i = rng.integers(60, size=1)[0]
        return sum(c[k] * f(policy, s, proposals[k, i]) for k in range(3))

    own_returns = np.array(play(policy, own, seeds))
    for reads, act in {"own": own, "zero": reading_zero, "another_state": another_state}.items():
        returns, row = np.array(play(policy, act, seeds)), rows[reads]
        assert row["return_mean"] == pytest.approx(returns.mean(), rel=1e-3)
        assert row["return_std"] == pytest.approx(returns.std(ddof=1), rel=2e-3)
        assert row["lost_mean"] == pytest.approx((own_returns - returns).mean(), rel=1e-2, abs=1e-4)
        assert row["lost_std"] == pytest.approx((own_returns - returns).std(ddof=1), rel=2e-2, abs=1e-4)
        assert row["length_mean"] == 50
    zero_actions = [reading_zero(s) for s in obs]
    assert rows["zero"]["r2"] == pytest.approx(r2_score([own(s) for s in obs], zero_actions), abs=1e-4)
    assert (rows["own"]["lost_mean"], rows["own"]["lost_std"], rows["own"]["r2"]) == (0, 0, 1)
    assert rows["zero"]["r2"] < 0.99 and rows["another_state"]["r2"] < 0.99


def test_a_policy_that_does_not_read_its_proposals_loses_nothing(small):
    _, _, rows = feedback(task_policy("Reacher-v5", scale=30, reads=0))
    for reads in ("zero", "another_state"):
        assert rows[reads]["lost_mean"] == pytest.approx(0, abs=1e-3)
        assert rows[reads]["r2"] == pytest.approx(1, abs=1e-6)
    assert rows["one_pass"]["r2"] > 0.95
    assert rows["one_pass"]["return_mean"] == pytest.approx(rows["own"]["return_mean"], rel=0.05)


@pytest.mark.slow
def test_feedback_repeats_itself_and_depends_on_the_seed(small):
    policy = task_policy("Pendulum-v1", scale=30, reads=3)
    (_, _, first), (_, _, again), (_, _, other) = (feedback(policy, seed) for seed in (0, 0, 1))
    assert first == again
    assert first["own"]["return_mean"] == other["own"]["return_mean"]
    assert first["another_state"]["return_mean"] != other["another_state"]["return_mean"]
    assert first["one_pass"]["r2"] != other["one_pass"]["r2"]


def test_the_fitted_network_is_128_by_128_and_reproduces_a_function_of_the_observation():
    """Components of very different size weigh the same, one that is constant is kept."""
    rng = np.random.default_rng(0)

    def target(obs: np.ndarray) -> np.ndarray:
        return np.stack([np.tanh(obs[:, 0] - obs[:, 1]), 1e3 * obs[:, 2] ** 2, np.full(len(obs), 0.5)], axis=1)

    obs, held_out = rng.normal(size=(2, 4000, 3)).astype(np.float32)
    network = analysis.fit_one_pass(obs, target(obs).astype(np.float32), seed=0)
    assert [w.shape for w, _ in network] == [(3, 128), (128, 128), (128, 3)]
    x = held_out
    for w, b in network[:-1]:
        x = np.tanh(x @ w + b)
    fitted = x @ network[-1][0] + network[-1][1]
    assert min(r2_score(target(held_out)[:, :2], fitted[:, :2], multioutput="raw_values")) > 0.95
    np.testing.assert_allclose(fitted[:, 2], 0.5, atol=1e-6)
    network = analysis.fit_one_pass(obs, target(obs)[:, :1], seed=0)
    assert network[-1][0].shape == (128, 1)


# --- Anytime and adaptive ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "schedule, expected",
    [("uniform", [1] * 6), ("average", [1 / 3] * 6), ("inverse", [1, 1 / 2, 1 / 3, 1 / 4, 1 / 5, 1 / 6])],
)
def test_coefficients_past_the_depth(schedule, expected):
    args = refineppo_continuous.Args(refinement_schedule=schedule, refinement_depth=3)
    assert analysis.continued_coefficients(args) == pytest.approx(expected)


def test_anytime_at_the_depth_is_the_checkpoints_own_evaluation():
    reacher = task_policy("Reacher-v5", scale=50, refinement_depth=2, refinement_schedule="uniform")
    tables = analysis.anytime_tables(reacher, episodes=3)
    rows, scaled = tables["anytime"], tables["anytime_scaled"]
    assert [row["steps"] for row in rows] == [0, 1, 2, 3, 4]
    assert [row["steps"] for row in scaled] == [1, 2, 3, 4]
    returns, lengths = refineppo.evaluate(reacher.agent, final_seeds(reacher, 3))
    assert (rows[2]["return_mean"], rows[2]["return_std"]) == (returns.mean(), returns.std(ddof=1))
    assert rows[2]["length_mean"] == lengths.mean()
    assert scaled[1] == rows[2]
    assert len({row["return_mean"] for row in rows}) == 5
    assert reacher.coefficients == [1, 1]


def test_anytime_equals_plain_episodes():
    """m_0 is the zero action; K m_1 and (K/3) m_3 of an inverse schedule."""
    policy = task_policy("Reacher-v5", scale=50, refinement_schedule="inverse")
    tables, seeds = analysis.anytime_tables(policy, episodes=2), final_seeds(policy, 2)
    for k, scale, row in ((0, 1, tables["anytime"][0]), (3, 1, tables["anytime"][3])):
        returns = play(policy, lambda s, k=k, scale=scale: scale * proposals_of(policy, s)[k], seeds)
        assert row["return_mean"] == pytest.approx(np.mean(returns), rel=1e-4)
    for k, scale, row in ((1, 4, tables["anytime_scaled"][0]), (3, 4 / 3, tables["anytime_scaled"][2])):
        returns = play(policy, lambda s, k=k, scale=scale: scale * proposals_of(policy, s)[k], seeds)
        assert (row["steps"], row["return_mean"]) == (k, pytest.approx(np.mean(returns), rel=1e-4))


def test_scaled_proposals_of_constant_corrections_are_all_the_same_action():
    tables = analysis.anytime_tables(task_policy("Reacher-v5", scale=30, reads=0), episodes=2)
    own = tables["anytime"][4]["return_mean"]
    assert [row["return_mean"] for row in tables["anytime_scaled"]] == pytest.approx([own] * 8, rel=1e-4)
    assert tables["anytime"][1]["return_mean"] != pytest.approx(own, rel=1e-2)


class Shown(gym.Env):
    """A hundred states of two numbers, the same whatever one does; the reward is the action's first component."""

    observation_space, action_space = box(2), gym.spaces.Box(-100.0, 100.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation(), {}

    def observation(self) -> np.ndarray:
        return (self.np_random.uniform(0.5, 1) * np.array([1.0, 0.0])).astype(np.float32)

    def step(self, action):
        return self.observation(), float(action[0]), False, False, {}


gym.register("Shown-v0", Shown, max_episode_steps=100)


def growing() -> Policy:
    """f = s + m and c_k = 1, for Shown-v0: corrections of 1, 2, 4, 8 times |s|."""
    flags = {"refinement_schedule": "uniform", "normalize_obs": False, "env_id": "Shown-v0"}
    policy = linear_policy(np.eye(2), np.eye(2), **flags)
    policy.agent.low, policy.agent.high = Shown.action_space.low, Shown.action_space.high
    return policy


def test_adaptive_tolerances_spread_the_mean_steps_where_corrections_grow():
    """A state stops after its first step or not at all; yet from all four steps to one the means leave no gap."""
    policy = growing()
    obs, _ = analysis.record_states(policy, Args(checkpoint=(), num_states=500))
    norms = analysis.correction_norms(proposals_of(policy, obs))
    assert (np.diff(norms, axis=0) > 0).all()
    rows = analysis.adaptive_rows(policy, norms, episodes=3)
    steps = [row["steps_mean"] for row in rows]
    assert (steps[0], steps[-1], len(steps)) == (4, 1, 8)
    assert sorted(steps, reverse=True) == steps and max(-np.diff(steps)) < 0.8
    assert [row["quantile"] for row in rows] == sorted(row["quantile"] for row in rows)
    for row in rows[1:-1]:
        assert row["tolerance"] == np.quantile([norms[0]] * 3, row["quantile"])  # the smallest of k = 1, 2, 3
        assert row["steps_mean"] == pytest.approx(4 - 3 * row["quantile"], abs=0.3)


@pytest.mark.parametrize("policy", [growing(), task_policy("Reacher-v5", scale=50)], ids=["growing", "reacher"])
def test_adaptive_equals_plain_episodes(policy):
    obs, _ = analysis.record_states(policy, Args(checkpoint=(), num_states=100))
    rows = analysis.adaptive_rows(policy, analysis.correction_norms(proposals_of(policy, obs)), episodes=2)
    for row in (rows[0], rows[3], rows[-1]):
        used = []

        def act(s: np.ndarray, used=used, tolerance=row["tolerance"]) -> np.ndarray:
            m = proposals_of(policy, s)
            for k in range(1, 5):
                if k == 4 or np.linalg.norm(m[k] - m[k - 1]) < tolerance:
                    used.append(k)
                    return m[k]

        returns = play(policy, act, final_seeds(policy, 2))
        assert row["steps_mean"] == pytest.approx(np.mean(used), abs=0.02)
        assert row["return_mean"] == pytest.approx(np.mean(returns), rel=2e-2)
    assert (rows[0]["tolerance"], rows[0]["steps_mean"], rows[-1]["steps_mean"]) == (0, 4, 1)


# --- Names, tables and figures ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "env_id, names",
    [
        ("HalfCheetah-v5", ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]),
        ("Reacher-v5", ["joint0", "joint1"]),
        ("InvertedPendulum-v5", ["slider"]),  # the joint's name, not the actuator's
        ("Pendulum-v1", ["a0"]),
        ("BipedalWalker-v3", ["a0", "a1", "a2", "a3"]),
    ],
)
def test_component_names(env_id, names):
    assert analysis.component_names(env_id) == names


def test_component_names_are_unique(monkeypatch):
    """Two motors on one joint, and one on a tendon."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
        <body><geom size="1"/><joint name="hip" type="hinge"/></body>
        </worldbody><tendon><fixed name="t"><joint joint="hip" coef="1"/></fixed></tendon><actuator>
        <motor joint="hip"/><motor name="m" joint="hip"/><motor name="pull" tendon="t"/></actuator></mujoco>""")
    env = gym.make("Reacher-v5")
    env.unwrapped.model = model
    env.action_space = box(3)
    monkeypatch.setattr(gym, "make", lambda *_, **__: env)
    assert analysis.component_names("Reacher-v5") == ["hip (a0)", "hip (a1)", "pull"]


def test_across_seeds():
    columns = ["checkpoint", "seed", "step", "value"]
    rows = [[1, 1, 0, 2.0], [1, 1, 1, 3.0], [2, 2, 0, 4.0], [2, 2, 1, 9.0], [3, 3, 0, 9.0], [3, 3, 2, 7.0]]
    first, second, third = analysis.across_seeds(pd.DataFrame(rows, columns=columns), ["step"]).to_dict("records")
    assert first == {"step": 0, "seeds": 3, "value_mean": 5, "value_std": pytest.approx(13**0.5)}
    assert second == {"step": 1, "seeds": 2, "value_mean": 6, "value_std": pytest.approx(18**0.5)}
    assert third == {"step": 2, "seeds": 1, "value_mean": 7, "value_std": 0}


def figures(*policies: Policy, **tables: list[dict]) -> Figures:
    """Of tables written by hand; their `checkpoint` is the number of the policy."""
    tables = {name: pd.DataFrame(rows) for name, rows in tables.items()}
    tables = {
        name: rows.assign(checkpoint=rows["checkpoint"].map(lambda i: str(policies[i].path)))
        for name, rows in tables.items()
    }
    return Figures(list(policies), ARGS, tables)


def test_small_delta_r2_are_readable_in_the_figure():
    values = [0.1234, 0.00034, -0.00012, 5.61e-05, 0.0, 1.2e-10]
    key = {"checkpoint": 0, "step_from": 1, "step_to": 2}
    rows = [key | {"component": f"joint{i}", "delta_r2": x} for i, x in enumerate(values)]
    band = {"shuffled_low": 0, "shuffled_high": 0, "by_episode": 0, "given_observation": 0}
    drawn = figures(random_policy(), delta_r2=rows, delta_r2_checks=[row | band for row in rows]).r2()["delta_r2"]
    assert [float(text.get_text()) for text in drawn.axes[0].texts] == pytest.approx(values, rel=0.05)


def test_adaptive_draws_points_only():
    """No line through a range that was not measured."""
    rows = [
        {"checkpoint": 0, "tolerance": t, "steps_mean": k, "return_mean": 5.0 * k, "return_std": 1.0}
        for t, k in ((0.0, 4.0), (0.2, 3.7), (0.5, 1.0))
    ]
    fixed = [{"checkpoint": 0, "steps": k, "return_mean": k, "return_std": 1.0} for k in range(9)]
    (axis,) = figures(random_policy(), adaptive=rows, anytime=fixed).adaptive()["adaptive"].axes
    points, same = axis.lines[0], axis.lines[-1]
    assert points.get_xydata().tolist() == [[4, 20], [3.7, 18.5], [1, 5]]
    assert same.get_xydata().tolist() == [[1, 1], [2, 2], [3, 3], [4, 4]]
    assert {line.get_linestyle() for line in axis.lines} == {"None"}


def test_training_draws_a_line_per_seed_beside_the_learning_curve(tmp_path):
    """Mean over k of the spectral radius and of delta R^2, e_1 alone, the return lost, and evaluations.csv; by step,
    also where the checkpoints come as a shell sorts their names."""
    policies, rows = [], []
    for i, (seed, step) in enumerate(((1, 100), (1, 200), (2, 200), (2, 100))):
        policy = random_policy(seed=seed)
        policy.path, policy.global_step = tmp_path / str(seed) / f"step_{step}.pt", step
        policy.path.parent.mkdir(exist_ok=True)
        policies.append(policy)
        values = {("settling_error", 0): 1, ("settling_error", 1): seed + step, ("spectral_radius", 1): 1}
        values |= {("spectral_radius", 2): 2 * seed, ("delta_r2", 2): 0.5, ("delta_r2", 3): step}
        values |= {("return_lost_reading_zero", 4): -seed}
        run = {"checkpoint": i, "seed": seed, "global_step": step}
        rows += [run | {"quantity": quantity, "step": k, "value": x} for (quantity, k), x in values.items()]
    (tmp_path / "1/evaluations.csv").write_text("global_step,return_mean,return_std\n50,-3.5,1\n250,8.0,1\n")
    drawn = figures(*policies, training=rows).training()
    data = {
        axis.get_title(): {bars.get_label(): bars.lines[0].get_xydata().tolist() for bars in axis.containers}
        for axis in drawn["training_by_seed"].axes
    }
    titles = analysis.BY_SEED
    assert data.pop("evaluation return") == {"seed 1": [[50, -3.5], [250, 8]]}
    assert data == {
        titles["settling_error"]: {"seed 1": [[100, 101], [200, 201]], "seed 2": [[100, 102], [200, 202]]},
        titles["spectral_radius"]: {"seed 1": [[100, 1.5], [200, 1.5]], "seed 2": [[100, 2.5], [200, 2.5]]},
        titles["delta_r2"]: {seed: [[100, 50.25], [200, 100.25]] for seed in ("seed 1", "seed 2")},
        titles["return_lost_reading_zero"]: {"seed 1": [[100, -1], [200, -1]], "seed 2": [[100, -2], [200, -2]]},
    }
    assert {axis.get_title() for axis in drawn["training"].axes} == {name.replace("_", " ") for name in titles}
