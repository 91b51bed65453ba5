"""The quantities of analysis_refinement.py, against plain loops, linear algebra and dynamics known beforehand."""

from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from sklearn.model_selection import GroupKFold, KFold

import analysis_refinement as analysis
import refineppo_continuous as refineppo
from analysis_refinement import Args, Policy


def box(size: int) -> gym.spaces.Box:
    return gym.spaces.Box(-1.0, 1.0, (size,))


def random_agent(obs_dim=5, action_dim=3, **flags) -> refineppo.Agent:
    """An agent whose f is far from linear and depends on m."""
    agent = refineppo.Agent(box(obs_dim), box(action_dim), refineppo.Args(actor_hidden=(16, 16), **flags))
    generator = torch.Generator().manual_seed(3)
    for p in agent.params.values():
        p.copy_(0.5 * torch.randn(p.shape, generator=generator))
    return agent


def linear_agent(from_obs: np.ndarray, from_m: np.ndarray, **flags) -> refineppo.Agent:
    """An agent with f(s, m) = from_obs s + from_m m: tanh of small inputs, scaled back."""
    action_dim, obs_dim = from_obs.shape
    size, small = obs_dim + action_dim, 1e-4
    agent = refineppo.Agent(box(obs_dim), box(action_dim), refineppo.Args(actor_hidden=(size,), **flags))
    agent.params["actor.0.weight"].copy_(small * torch.eye(size))
    agent.params["actor.1.weight"].copy_(torch.from_numpy(np.hstack([from_obs, from_m])).T / small)
    return agent


def proposals_of(agent: refineppo.Agent, obs: np.ndarray) -> np.ndarray:
    """(K + 1, S, action_dim), by the definition: m_{k+1} = m_k + c_{k+1} f(s, m_k)."""
    weights = refineppo.layers({name: p.double() for name, p in agent.params.items()}, "actor")
    m = [np.zeros((len(obs), len(agent.low)))]
    for c in agent.actor.coefficients:
        x = np.hstack([obs, m[-1]])
        for w, b in weights[:-1]:
            x = np.tanh(x @ w.numpy() + b.numpy())
        m.append(m[-1] + c * (x @ weights[-1][0].numpy() + weights[-1][1].numpy()))
    return np.array(m)


def policy(env_id: str, scale=1.0, **flags) -> Policy:
    """An untrained policy for a task, whose corrections are `scale` times as large as at initialisation."""
    args = refineppo.Args(env_id=env_id, **flags)
    agent = refineppo.Agent(*refineppo.check_args(args), args)
    agent.params[f"actor.{len(args.actor_hidden)}.weight"].mul_(scale)
    return Policy(Path("best.pt"), agent, 2048, analysis.component_names(env_id))


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
    """Two states, K = 2: component 0 is at its end after one step, component 1 half way, component 2 overshoots."""
    m_1 = [[1.0, 2.0, 4.0], [-1.0, 1.0, -4.0]]
    m_2 = [[1.0, 4.0, 2.0], [-1.0, 2.0, -2.0]]
    error = analysis.settling_error(np.array([np.zeros((2, 3)), m_1, m_2]))
    np.testing.assert_allclose(error, [[1, 1, 1], [0, 0.5, 1], [0, 0, 0]], atol=1e-8)


def test_a_component_that_never_moves_has_settled():
    assert (analysis.settling_error(np.zeros((3, 4, 2))) == 0).all()


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
    rows, error = analysis.settling_rows(proposals, ["hip", "knee", "foot"]), analysis.settling_error(proposals)
    assert len(rows) == 3 * 4
    assert [row["step"] for row in rows] == [0, 1, 2, 3] * 3
    assert [row["rank"] for row in rows] == [1] * 4 + [2] * 4 + [3] * 4
    first = [row["error"] for row in rows if row["step"] == 1]
    assert first == sorted(first)
    for row in rows:
        assert row["error"] == error[row["step"], ["hip", "knee", "foot"].index(row["component"])]


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
    agent, rng = random_agent(action_dim=4), np.random.default_rng(0)
    obs, episodes = rng.normal(size=(123, 5)), np.repeat(np.arange(41), 3)
    proposals, names = proposals_of(agent, obs), ["a", "b", "c", "d"]
    _, early, late = analysis.early_and_late(analysis.settling_error(proposals))
    shuffled = list(KFold(5, shuffle=True, random_state=0).split(obs))
    whole = list(GroupKFold(5).split(obs, groups=episodes))
    rows = {(row["component"], row["step_from"]): row for row in analysis.r2_rows(proposals, names)}
    checks = {(row["component"], row["step_from"]): row
              for row in analysis.r2_check_rows(proposals, names, obs, episodes, seed=0)}  # fmt: skip
    assert list(rows) == list(checks) == [(names[j], k) for j in late for k in (1, 2, 3)]
    for j in late:
        for k in (1, 2, 3):
            own, both = proposals[k][:, [j]], proposals[k][:, [j, *early]]
            target = proposals[k + 1][:, j] - proposals[k][:, j]
            row, check = rows[names[j], k], checks[names[j], k]
            assert row["step_to"] == check["step_to"] == k + 1
            baseline, augmented = plain_ridge_r2(own, target, shuffled), plain_ridge_r2(both, target, shuffled)
            assert row["r2_baseline"] == pytest.approx(baseline, abs=1e-9)
            assert row["r2_augmented"] == pytest.approx(augmented, abs=1e-9)
            assert row["delta_r2"] == pytest.approx(augmented - baseline, abs=1e-9)
            assert check["delta_r2"] == row["delta_r2"]
            by_episode = plain_ridge_r2(both, target, whole) - plain_ridge_r2(own, target, whole)
            assert check["by_episode"] == pytest.approx(by_episode, abs=1e-9)
            own, both = np.hstack([own, obs]), np.hstack([both, obs])
            given_obs = plain_ridge_r2(both, target, shuffled) - plain_ridge_r2(own, target, shuffled)
            assert check["given_observation"] == pytest.approx(given_obs, abs=1e-9)


def two_components(late_correction: np.ndarray, early: np.ndarray, late: np.ndarray) -> np.ndarray:
    """m_0, m_1, m_2 of two components: the early one has settled after a step, the late one is corrected again."""
    m_1 = np.stack([early, late], axis=1)
    return np.stack([np.zeros_like(m_1), m_1, m_1 + np.stack([0 * early, late_correction], axis=1)])


def test_delta_r2_tells_dependence_from_independence():
    """Near 1, far above the shuffled band, where the late correction is a function of the early component; within
    the band, which lies at zero, where it is not."""
    rng, names = np.random.default_rng(0), ["early", "late"]
    early, late, noise = rng.normal(size=(3, 1000))
    obs, episodes = rng.normal(size=(1000, 2)), np.repeat(np.arange(20), 50)
    (row,) = analysis.r2_check_rows(two_components(3 * early, early, late), names, obs, episodes, seed=0)
    assert (row["component"], row["step_from"], row["step_to"]) == ("late", 1, 2)
    assert min(row["delta_r2"], row["by_episode"], row["given_observation"]) > 0.98
    assert row["shuffled_low"] <= row["shuffled_high"] < 0.02
    assert row["above_shuffled"] == 1
    (row,) = analysis.r2_check_rows(two_components(noise, early, late), names, obs, episodes, seed=0)
    assert abs(row["delta_r2"]) < 0.02
    assert -0.02 < row["shuffled_low"] < row["shuffled_high"] < 0.02
    assert row["shuffled_low"] - 0.005 < row["delta_r2"] < row["shuffled_high"] + 0.005


def test_the_observation_explains_away_what_early_components_only_repeat():
    """Both components are linear in the observation: the paper's number is large, the one given the observation 0."""
    rng = np.random.default_rng(0)
    obs, late = rng.normal(size=(1000, 2)), rng.normal(size=1000)
    proposals, episodes = two_components(obs[:, 0], 2 * obs[:, 0], late), np.repeat(np.arange(20), 50)
    (row,) = analysis.r2_check_rows(proposals, ["early", "late"], obs, episodes, seed=0)
    assert row["delta_r2"] > 0.98
    assert abs(row["given_observation"]) < 1e-3


# --- Dynamics ---------------------------------------------------------------------------------------------------------


def test_refinement_field_is_the_actors():
    """The trajectory of m_{k+1} = m_k + c_{k+1} f(s, m_k) by `refinement_field` is the actor's own."""
    agent, obs = random_agent(refinement_schedule="inverse"), np.random.default_rng(0).normal(size=(6, 5))
    weights = refineppo.layers({name: p.double() for name, p in agent.params.items()}, "actor")
    m = torch.zeros(6, 3, dtype=torch.float64)
    for c, expected in zip(agent.actor.coefficients, agent.actor.proposals(weights, torch.from_numpy(obs))):
        m = m + c * analysis.refinement_field(weights, torch.from_numpy(obs), m)
        torch.testing.assert_close(m, expected, rtol=1e-12, atol=1e-12)


def test_jacobian_equals_finite_differences():
    agent, rng = random_agent(), np.random.default_rng(0)
    obs, m, c, h = torch.from_numpy(rng.normal(size=(7, 5))), torch.from_numpy(rng.normal(size=(7, 3))), 0.7, 1e-6
    weights = refineppo.layers({name: p.double() for name, p in agent.params.items()}, "actor")
    exact = analysis.step_jacobians(weights, obs, m, c)
    assert exact.shape == (7, 3, 3)
    for j in range(3):
        ends = [m + sign * h * torch.eye(3, dtype=torch.float64)[j] for sign in (1, -1)]
        plus, minus = (x + c * analysis.refinement_field(weights, obs, x) for x in ends)
        torch.testing.assert_close(exact[:, :, j], (plus - minus) / (2 * h), rtol=1e-7, atol=1e-8)


def test_dynamics_of_a_linear_field():
    """f = s + A m: the Jacobian of a step is I + c A everywhere, and starts spread as its powers do."""
    a = np.array([[-0.5, 0.8, 0.0], [0.0, -0.2, 0.1], [0.0, 0.0, -0.9]])
    agent = linear_agent(np.eye(3), a, refinement_depth=3, refinement_schedule="uniform")
    obs = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    values = analysis.dynamics(agent, obs, proposals_of(agent, obs), seed=0)
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
    agent = linear_agent(np.eye(2), -decay * np.eye(2), refinement_depth=4, refinement_schedule=schedule)
    obs = np.random.default_rng(0).normal(size=(40, 2)).astype(np.float32)
    proposals = proposals_of(agent, obs)
    left = np.cumprod([1, *(1 - c * decay for c in refineppo.refinement_coefficients(schedule, 4))])
    expected = (left - left[-1]) / (1 - left[-1])
    np.testing.assert_allclose(analysis.settling_error(proposals), np.stack([expected] * 2, axis=1), atol=1e-5)
    values = analysis.dynamics(agent, obs, proposals, seed=0)
    for k in range(5):
        np.testing.assert_allclose(values["spread_of_random_starts"][k], left[k], atol=1e-5)


def test_fraction_outside_the_bounds():
    """Bounds +-1: none of four states is outside at k = 1, one component of two states at k = 2."""
    agent = random_agent(action_dim=2, refinement_depth=2)
    m_1, m_2 = np.zeros((4, 2)), np.array([[0.5, -2.0], [0.9, 0.9], [1.5, 0.0], [-1.0, 1.0]])
    values = analysis.dynamics(agent, np.zeros((4, 5), np.float32), np.stack([m_1, m_1, m_2]), seed=0)
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
    pendulum, args = policy("Pendulum-v1", scale=20), Args(checkpoint=(), num_states=20 * 200, seed=4)
    pendulum.agent.normalizer.observe(np.random.default_rng(0).normal(size=(10, 3)))
    obs, episodes = analysis.record_states(pendulum, args)
    assert obs.shape == (4000, 3) and obs.dtype == np.float32
    assert np.bincount(episodes).tolist() == [200] * 20
    weights = refineppo.layers(pendulum.agent.arrays(), "actor")
    env = gym.make("Pendulum-v1")
    for i, seed in enumerate(refineppo.episode_seeds(4, 2, 0, count=20)):
        seen, raw = [], env.reset(seed=seed)[0]
        for _ in range(200):
            seen.append(pendulum.agent.normalizer.normalize(raw[None])[0])
            raw = env.step(np.clip(pendulum.agent.actor.mean(weights, seen[-1][None])[0], -2, 2))[0]
        np.testing.assert_allclose(obs[episodes == i], seen, atol=1e-2)


def test_short_episodes_bring_more_episodes():
    """An untrained double pendulum falls within ten steps or so: twenty episodes do not hold 600 states."""
    obs, episodes = analysis.record_states(policy("InvertedDoublePendulum-v5"), Args(checkpoint=(), num_states=600))
    assert len(obs) == len(episodes) == 600
    counts = np.bincount(episodes)
    assert len(counts) % 20 == 0 and len(counts) > 20 and counts.min() > 0


def test_sampled_actions_lead_to_other_states():
    reacher = policy("Reacher-v5")
    states = [analysis.record_states(reacher, Args(checkpoint=(), num_states=40, sample_actions=sampled))[0]
              for sampled in (False, True, True)]  # fmt: skip
    np.testing.assert_array_equal(states[1], states[2])
    np.testing.assert_array_equal(states[0][::2], states[1][::2])  # the first state of each episode
    assert not np.isclose(states[0][1::2], states[1][1::2]).all()


# --- Anytime and adaptive ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("schedule, expected", [
    ("uniform", [1, 1, 1, 1, 1, 1]),
    ("average", [1 / 3] * 6),
    ("inverse", [1, 1 / 2, 1 / 3, 1 / 4, 1 / 5, 1 / 6]),
])  # fmt: skip
def test_coefficients_past_the_depth(schedule, expected):
    assert analysis.continued_coefficients(schedule, 3) == pytest.approx(expected)


def test_anytime_at_the_depth_is_the_checkpoints_own_evaluation():
    reacher = policy("Reacher-v5", scale=50, refinement_depth=2, refinement_schedule="uniform")
    rows = analysis.anytime_rows(reacher, episodes=3)
    assert [row["steps"] for row in rows] == [0, 1, 2, 3, 4]
    args = refineppo.Args(env_id="Reacher-v5", final_eval_episodes=3)
    returns, lengths = refineppo.evaluate(reacher.agent, refineppo.evaluation_seeds(args, 2048, final=True))
    assert (rows[2]["return_mean"], rows[2]["return_std"]) == (returns.mean(), returns.std(ddof=1))
    assert rows[2]["length_mean"] == lengths.mean()
    assert len({row["return_mean"] for row in rows}) == 5
    assert reacher.agent.actor.coefficients == [1, 1]


def test_anytime_at_zero_is_the_zero_action():
    reacher, env, returns = policy("Reacher-v5", scale=50), gym.make("Reacher-v5"), []
    args = refineppo.Args(env_id="Reacher-v5", final_eval_episodes=2)
    for seed in refineppo.evaluation_seeds(args, 2048, final=True):
        env.reset(seed=seed)
        returns.append(sum(env.step(np.zeros(2))[1] for _ in range(50)))
    assert analysis.anytime_rows(reacher, episodes=2)[0]["return_mean"] == pytest.approx(np.mean(returns), rel=1e-6)


def test_steps_used_equals_a_plain_loop():
    proposals = analysis.with_start([*np.random.default_rng(0).normal(size=(4, 30, 2))])
    for tolerance in (0.0, 0.5, 1.5, 3.0, 100.0):
        used = analysis.steps_used(proposals, tolerance)
        for s in range(30):
            expected = 4
            for k in (1, 2, 3, 4):
                if np.sqrt(((proposals[k, s] - proposals[k - 1, s]) ** 2).sum()) < tolerance:
                    expected = k
                    break
            assert used[s] == expected


def test_adaptive_actor_takes_each_states_own_proposal():
    agent, obs = random_agent(), np.random.default_rng(0).normal(size=(20, 5)).astype(np.float32)
    weights = refineppo.layers(agent.arrays(), "actor")
    proposals = analysis.with_start(agent.actor.proposals(weights, obs))
    tolerance = float(np.median(analysis.correction_norms(proposals)))
    actor = analysis.AdaptiveActor(agent.actor, tolerance)
    used = analysis.steps_used(proposals, tolerance)
    np.testing.assert_array_equal(actor.mean(weights, obs), [proposals[k, s] for s, k in enumerate(used)])
    assert len(set(used)) > 1
    np.testing.assert_array_equal(actor.steps, [used])


def test_adaptive_at_its_ends():
    """Tolerance 0 takes all K steps; one above every correction takes one."""
    reacher = policy("Reacher-v5", scale=50)
    rows = analysis.adaptive_rows(reacher, np.full((4, 9), 1e3), episodes=2)
    anytime = analysis.anytime_rows(reacher, episodes=2)
    assert (rows[0]["tolerance"], rows[0]["steps_mean"]) == (0, 4)
    assert rows[0]["return_mean"] == anytime[4]["return_mean"]
    assert (rows[-1]["tolerance"], rows[-1]["steps_mean"]) == (1e3, 1)
    assert rows[-1]["return_mean"] == anytime[1]["return_mean"]


def test_tolerances_are_quantiles_of_all_corrections_but_the_last():
    norms = np.random.default_rng(0).random((4, 25)) * 1e-9
    rows = analysis.adaptive_rows(policy("Reacher-v5"), norms, episodes=2)
    assert [row["tolerance"] for row in rows[1:]] == [np.quantile(norms[:3], row["quantile"]) for row in rows[1:]]


# --- Names and tables -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id, names", [
    ("HalfCheetah-v5", ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]),
    ("Reacher-v5", ["joint0", "joint1"]),
    ("InvertedPendulum-v5", ["slider"]),  # the joint's name, not the actuator's
    ("Pendulum-v1", ["a0"]),
    ("BipedalWalker-v3", ["a0", "a1", "a2", "a3"]),
])  # fmt: skip
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
    monkeypatch.setattr(refineppo, "make_env", lambda _: env)
    assert analysis.component_names("Reacher-v5") == ["hip (a0)", "hip (a1)", "pull"]


def test_across_seeds():
    rows = [{"checkpoint": c, "seed": c, "step": k, "value": v}
            for c, k, v in ((1, 0, 2.0), (1, 1, 3.0), (2, 0, 4.0), (2, 1, 9.0), (3, 0, 9.0))]  # fmt: skip
    first, second = analysis.across_seeds(rows, ("step",))
    assert first == {"step": 0, "seeds": 3, "value_mean": 5, "value_std": pytest.approx(13**0.5)}
    assert second == {"step": 1, "seeds": 2, "value_mean": 6, "value_std": pytest.approx(18**0.5)}
