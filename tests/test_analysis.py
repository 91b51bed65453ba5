"""The quantities of analysis_refinement.py, against plain loops, linear algebra and dynamics known beforehand."""

import itertools
from dataclasses import asdict
from functools import partial
from pathlib import Path
from unittest import mock

import gymnasium as gym
import mujoco
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.spaces import Box
from matplotlib.figure import Figure
from sklearn.metrics import r2_score
from sklearn.model_selection import GroupKFold, KFold
from test_commands import call_main

import analysis_refinement as analysis
import refineppo_continuous as refineppo
from analysis_refinement import Args, Policy, load_policy


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Sections of seconds."""
    for name, value in {"SHUFFLES": 3, "FIT_STATES": 1000, "FEEDBACK_EPISODES": 3, "TRAINING_EPISODES": 2}.items():
        monkeypatch.setattr(analysis, name, value)


class Shown(gym.Env):
    """A hundred states, the same whatever one does; the reward is the action's first component."""

    observation_space, action_space = Box(0.5, 1, (2,)), Box(-2, 2, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation(), {}

    def observation(self) -> np.ndarray:
        return self.np_random.uniform(0.5, 1, size=2).astype(np.float32)

    def step(self, action):
        return self.observation(), float(action[0]), False, False, {}


gym.register("Shown-v0", Shown, max_episode_steps=100)


def save(path: Path, env_id="Reacher-v5", step=2048, scale=50.0, reads=1.0, **flags) -> Path:
    """A checkpoint as the training script writes it, of an untrained policy with corrections `scale` times as large,
    whose f reads `reads` times the proposal."""
    env, args = gym.make(env_id), refineppo.Args(env_id=env_id, actor_hidden=(16, 16), **flags)
    agent = refineppo.Agent(env.observation_space, env.action_space, args)
    agent.params["actor.2.weight"] *= scale
    agent.params["actor.0.weight"][env.observation_space.shape[0] :] *= reads
    path.parent.mkdir(parents=True, exist_ok=True)
    refineppo.save_checkpoint(path, {"args": asdict(args), "global_step": step, **agent.state()})
    return path


def linear_policy(path: Path, from_m, **flags) -> Policy:
    """One for Shown-v0 with f(s, m) = s + from_m m: tanh of small inputs, scaled back."""
    args = refineppo.Args(env_id="Shown-v0", actor_hidden=(4,), normalize_obs=False, **flags)
    agent = refineppo.Agent(Shown.observation_space, Shown.action_space, args)
    agent.params["actor.0.weight"].copy_(1e-4 * torch.eye(4))
    agent.params["actor.1.weight"].copy_(1e4 * torch.from_numpy(np.hstack([np.eye(2), from_m])).T)
    refineppo.save_checkpoint(path, {"args": asdict(args), "global_step": 2048, **agent.state()})
    return load_policy(path)


def states(policy: Policy, count: int, **flags) -> tuple[np.ndarray, np.ndarray]:
    """The recorded normalised observations, and each one's episode."""
    return analysis.record_states(policy, Args(checkpoint=(), num_states=count, **flags))


def analyse(*paths: Path, flags: str) -> tuple[dict[str, pd.DataFrame], list[Figure]]:
    """The tables and figures of `python analysis_refinement.py --checkpoint PATHS FLAGS`."""
    with mock.patch.object(Figure, "savefig", autospec=True, side_effect=Figure.savefig) as saved:
        call_main(analysis, "--checkpoint", *paths, *flags.split())
    tables = {path.stem: pd.read_csv(path) for path in (paths[0].parent / "analysis").glob("*.csv")}
    return tables, [call.args[0] for call in saved.call_args_list]


def network(layers: list, x: np.ndarray) -> np.ndarray:
    *hidden, (w_out, b_out) = layers
    for w, b in hidden:
        x = np.tanh(x @ w + b)
    return x @ w_out + b_out


def f(policy: Policy, obs: np.ndarray, m: np.ndarray) -> np.ndarray:
    """f(s, m), (n, action_dim), in double precision."""
    return network(refineppo.layers(policy.agent.arrays(), "actor"), np.hstack([obs, m]))


def proposals_of(policy: Policy, obs: np.ndarray, coefficients: list[float] | None = None) -> np.ndarray:
    """(K + 1, n, action_dim), by the definition: m_0 = 0, m_{k+1} = m_k + c_{k+1} f(s, m_k)."""
    m = [np.zeros((len(obs), len(policy.names)))]
    for c in coefficients or refineppo.refinement_coefficients(policy.args):
        m.append(m[-1] + c * f(policy, obs, m[-1]))
    return np.array(m)


def play(policy: Policy, act, seeds: list[int]) -> list[float]:
    """Returns of plain episodes; act: normalised observations (1, obs_dim) -> actions, which are clipped."""
    returns, env = [], gym.make(policy.args.env_id)
    for seed in seeds:
        obs, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            (action,) = act(policy.agent.normalizer.normalize(obs[None]))
            action = np.clip(action, env.action_space.low, env.action_space.high).astype(np.float32)
            obs, reward, terminated, truncated, _ = env.step(action)
            total, over = total + reward, terminated or truncated
        returns.append(total)
    return returns


def final_seeds(policy: Policy, count: int) -> list[int]:
    args = refineppo.Args(env_id=policy.args.env_id, final_eval_episodes=count)
    return refineppo.evaluation_seeds(args, policy.global_step, final=True)


# --- Settling error ---------------------------------------------------------------------------------------------------


def test_settling_error_by_hand():
    """Two states, K = 2: component 0 ends after one step, 1 is half way, 2 overshoots, 3 has the size of eps."""
    m_1 = [[1.0, 1.0, 4.0, 0.0], [-1.0, 2.0, -4.0, 0.0]]
    m_2 = [[1.0, 4.0, 2.0, 1e-8], [-1.0, 2.0, -2.0, -1e-8]]
    error = analysis.settling_error(np.array([np.zeros((2, 4)), m_1, m_2]))
    np.testing.assert_allclose(error, [[1, 1, 1, 0.5], [0, 0.5, 1, 0.5], [0, 0, 0, 0]], atol=2e-8)


@pytest.mark.parametrize("action_dim, count", [(1, 0), (2, 1), (3, 1), (9, 4), (10, 5), (17, 5)])
def test_which_components_are_early_and_late(action_dim, count):
    """Ascending e_1; components that tie keep their order in the action."""
    error = np.random.default_rng(1).random((3, action_dim)).round(1)
    expected = sorted(range(action_dim), key=error[1].tolist().__getitem__)
    order, early, late = analysis.early_and_late(error)
    assert order.tolist() == expected
    assert early.tolist() == expected[:count]
    assert late.tolist() == expected[action_dim - count :]


# --- delta R^2 --------------------------------------------------------------------------------------------------------


def plain_ridge_r2(target: np.ndarray, features: list[np.ndarray], folds: list) -> float:
    """Ridge regression in closed form: alpha 1, features standardised and the target centred on the training fold."""
    features, scores = np.hstack(features), []
    for train, test in folds:
        mean, std, centre = features[train].mean(0), features[train].std(0), target[train].mean()
        x = (features[train] - mean) / std
        beta = np.linalg.solve(x.T @ x + np.eye(x.shape[1]), x.T @ (target[train] - centre))
        residual = target[test] - centre - (features[test] - mean) / std @ beta
        scores.append(1 - (residual**2).sum() / ((target[test] - target[test].mean()) ** 2).sum())
    return np.mean(scores)


def test_delta_r2_and_its_checks_equal_closed_form_ridge(tmp_path):
    """Three early and three late joints. No number stands where the observation alone makes the prediction worse; small
    ones are readable in the figure."""
    policy = load_policy(save(tmp_path / "best.pt", "Walker2d-v5"))
    tables, figures = analyse(policy.path, flags="--sections r2 --num-states 60")
    obs, episodes = states(policy, 60)
    m, rng = policy.proposals(obs).astype(float), np.random.default_rng(0)
    _, early, late = analysis.early_and_late(analysis.settling_error(m))
    folds = list(KFold(5, shuffle=True, random_state=0).split(obs))
    whole = list(GroupKFold(5).split(obs, groups=episodes))
    rows, checks = tables["delta_r2"], tables["delta_r2_checks"]
    pairs = zip(rows.to_dict("records"), checks.to_dict("records"))
    for (j, k), (row, check) in zip(itertools.product(late, (1, 2, 3)), pairs, strict=True):
        own, others, target = m[k][:, [j]], m[k][:, early], m[k + 1][:, j] - m[k][:, j]
        r2 = partial(plain_ridge_r2, target)
        baseline, augmented, given = r2([own], folds), r2([own, others], folds), r2([own, obs], folds)
        delta_r2 = augmented - baseline
        key = {"component": policy.names[j], "step_from": k, "step_to": k + 1, "delta_r2": delta_r2}
        assert row == pytest.approx(key | {"r2_baseline": baseline, "r2_augmented": augmented}, abs=1e-9)
        shuffled = [r2([own, rng.permutation(others)], folds) - baseline for _ in range(3)]
        low, high = np.quantile(shuffled, (0.025, 0.975))
        key |= {"shuffled_low": low, "shuffled_high": high, "above_shuffled": int(delta_r2 > high)}
        key["by_episode"] = r2([own, others], whole) - r2([own], whole)
        key["given_observation"] = r2([own, others, obs], folds) - given if given > baseline else np.nan
        assert check == pytest.approx(key, abs=1e-9, nan_ok=True)
    assert set(checks.above_shuffled) == {0, 1} and set(checks.given_observation.isna()) == {False, True}
    assert "NaN" not in (tmp_path / "analysis/summary.json").read_text()  # which JSON does not have
    assert [float(text.get_text()) for text in figures[0].axes[0].texts] == pytest.approx([*rows.delta_r2], rel=0.05)


# --- Dynamics ---------------------------------------------------------------------------------------------------------


def test_jacobian_equals_finite_differences(tmp_path):
    """At m_{k-1} of the recorded states; its largest singular value is the table's."""
    policy, h = load_policy(save(tmp_path / "best.pt", "Hopper-v5")), 1e-6
    tables, _ = analyse(policy.path, flags="--sections dynamics --num-states 20")
    table = tables["dynamics"].set_index(["quantity", "step"]).value["largest_singular_value"]
    obs = states(policy, 20)[0].astype(float)
    weights = refineppo.layers({name: p.double() for name, p in policy.agent.params.items()}, "actor")
    for k, m in enumerate(proposals_of(policy, obs)[:-1], start=1):
        exact = analysis.step_jacobians(weights, torch.from_numpy(obs), torch.from_numpy(m), 1 / 4).numpy()
        for j in range(3):
            plus, minus = (x + f(policy, obs, x) / 4 for x in (m + h * np.eye(3)[j], m - h * np.eye(3)[j]))
            np.testing.assert_allclose(exact[:, :, j], (plus - minus) / (2 * h), rtol=1e-7, atol=1e-8)
        assert table[k] == pytest.approx(np.median(np.linalg.norm(exact, 2, axis=(1, 2))), rel=1e-5)


def test_dynamics_of_a_linear_field(tmp_path):
    """f = s + A m, so that the Jacobian of a step is I + c_k A in every state."""
    a = np.array([[-0.5, 1.5], [0.0, -0.2]])
    policy = linear_policy(tmp_path / "best.pt", a, refinement_schedule="inverse")
    tables, _ = analyse(policy.path, flags="--sections dynamics --num-states 50")
    rows = tables["dynamics"].set_index(["quantity", "step"]).to_dict("index")
    (obs, _), m, norms = states(policy, 50), np.zeros((50, 2)), [0]
    for k in (1, 2, 3, 4):
        correction = (obs + m @ a.T) / k
        m = m + correction
        norms.append(np.linalg.norm(correction, axis=1))
        values = {"largest_singular_value": np.linalg.norm(np.eye(2) + a / k, 2), "spectral_radius": 1 - 0.2 / k}
        values |= {"correction_norm": norms[k]}
        values |= {"correction_ratio": norms[k] / norms[k - 1]} if k > 1 else {}
        for quantity, x in values.items():
            row = rows.pop((quantity, k))
            assert [row["q10"], row["value"], row["q90"]] == pytest.approx(np.quantile(x, (0.1, 0.5, 0.9)), rel=1e-4)
        outside = m > 2
        assert rows.pop(("proposals_outside_bounds", k))["value"] == pytest.approx(outside.any(1).mean())
        assert rows.pop(("components_outside_bounds", k))["value"] == pytest.approx(outside.mean())
    assert 0 < outside.mean() < outside.any(1).mean() < 1
    assert list(rows) == [("spread_of_random_starts", k) for k in range(5)]


@pytest.mark.parametrize("decay, schedule", [(0.5, "uniform"), (1.0, "inverse"), (-0.4, "average")])
def test_settling_and_path_independence_known_beforehand(decay, schedule, tmp_path):
    """f = s - decay m, so that m_k = (1 - prod_{i<=k} (1 - c_i decay)) s / decay: of m_0 the product is left."""
    policy = linear_policy(tmp_path / "best.pt", -decay * np.eye(2), refinement_schedule=schedule)
    tables, _ = analyse(policy.path, flags="--sections settling dynamics --num-states 40")
    left = np.cumprod([1, *(1 - c * decay for c in policy.coefficients)])
    settling = (left - left[-1]) / (1 - left[-1])
    assert [*tables["settling_error"].error] == pytest.approx([*settling, *settling], abs=1e-5)
    spread = tables["dynamics"].query("quantity == 'spread_of_random_starts'").value
    assert [*spread] == pytest.approx(left, abs=1e-5)


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


def test_recorded_states_are_those_of_plain_episodes(tmp_path):
    policy, seen = load_policy(save(tmp_path / "best.pt", "Pendulum-v1")), []
    policy.agent.normalizer.observe(np.random.default_rng(0).normal(size=(10, 3)))

    def act(obs: np.ndarray) -> np.ndarray:
        seen.append(obs[0])
        return proposals_of(policy, obs)[-1]

    obs, episodes = states(policy, 20 * 200, seed=4)
    assert obs.shape == (4000, 3) and obs.dtype == np.float32
    assert episodes.tolist() == np.repeat(range(20), 200).tolist()
    play(policy, act, refineppo.episode_seeds(4, 2, 0, count=20))
    np.testing.assert_allclose(obs, seen, atol=1e-2)


def test_short_episodes_bring_more_episodes(tmp_path):
    """An untrained double pendulum falls within ten steps or so: twenty episodes do not hold 600 states."""
    obs, episodes = states(load_policy(save(tmp_path / "best.pt", "InvertedDoublePendulum-v5")), 600)
    assert len(obs) == len(episodes) == 600
    counts = np.bincount(episodes)
    assert len(counts) % 20 == 0 and len(counts) > 20 and counts.min() > 0


# --- Feedback ---------------------------------------------------------------------------------------------------------


def test_feedback_equals_plain_episodes(tmp_path):
    """Every f(s, .) written out: what it reads is replaced, the corrections add up as before."""
    policy = load_policy(save(tmp_path / "best.pt", reads=3, refinement_schedule="inverse"))
    tables, _ = analyse(policy.path, flags="--sections feedback --num-states 60 --seed 5")
    rows = tables["feedback"].set_index("reads")
    (obs, _), c, rng = states(policy, 60, seed=5), policy.coefficients, np.random.default_rng(5)
    proposals = proposals_of(policy, obs)

    def own(s: np.ndarray) -> np.ndarray:
        return proposals_of(policy, s)[-1]

    def reading_zero(s: np.ndarray) -> np.ndarray:
        return sum(c[k] * f(policy, s, np.zeros((len(s), 2))) for k in range(4))

    def another_state(s: np.ndarray) -> np.ndarray:
        i = rng.integers(60, size=1)
        return sum(c[k] * f(policy, s, proposals[k, i]) for k in range(4))

    own_returns = np.array(play(policy, own, final_seeds(policy, 3)))
    for reads, act in {"own": own, "zero": reading_zero, "another_state": another_state}.items():
        returns, row = np.array(play(policy, act, final_seeds(policy, 3))), rows.loc[reads]
        assert row.return_mean == pytest.approx(returns.mean(), rel=1e-3)
        assert row.return_std == pytest.approx(returns.std(ddof=1), rel=2e-3)
        assert row.lost_mean == pytest.approx((own_returns - returns).mean(), rel=1e-2, abs=1e-4)
        assert row.lost_std == pytest.approx((own_returns - returns).std(ddof=1), rel=2e-2, abs=1e-4)
        assert (row.episodes, row.length_mean) == (3, 50)
    assert [*rows.loc["own", ["lost_mean", "lost_std", "r2"]]] == [0, 0, 1]
    assert rows.r2["zero"] == pytest.approx(r2_score(own(obs), reading_zero(obs)), abs=1e-4)
    assert rows.r2["zero"] < 0.99 and rows.r2["another_state"] < 0.99


def test_a_policy_that_does_not_read_its_proposals_loses_nothing(tmp_path):
    policy = load_policy(save(tmp_path / "best.pt", reads=0))
    tables, _ = analyse(policy.path, flags="--sections feedback --num-states 60")
    rows = tables["feedback"].set_index("reads")
    assert [*rows.lost_mean[["zero", "another_state"]]] == pytest.approx([0, 0], abs=1e-3)
    assert [*rows.r2[["zero", "another_state"]]] == pytest.approx([1, 1], abs=1e-6)
    assert rows.r2["one_pass"] > 0.95
    assert rows.return_mean["one_pass"] == pytest.approx(rows.return_mean["own"], rel=0.05)


def test_the_fitted_network_is_128_by_128_and_reproduces_a_function_of_the_observation():
    """Components of very different size weigh the same, one that is constant is kept."""
    obs, held_out = np.random.default_rng(0).normal(size=(2, 4000, 3)).astype(np.float32)

    def target(obs: np.ndarray) -> np.ndarray:
        return np.stack([np.tanh(obs[:, 0] - obs[:, 1]), 1e3 * obs[:, 2] ** 2, np.full(len(obs), 0.5)], axis=1)

    weights = analysis.fit_one_pass(obs, target(obs).astype(np.float32), seed=0)
    assert [w.shape for w, _ in weights] == [(3, 128), (128, 128), (128, 3)]
    fitted = network(weights, held_out)
    assert min(r2_score(target(held_out)[:, :2], fitted[:, :2], multioutput="raw_values")) > 0.95
    np.testing.assert_allclose(fitted[:, 2], 0.5, atol=1e-6)
    weights = analysis.fit_one_pass(obs, target(obs)[:, :1], seed=0)
    assert weights[-1][0].shape == (128, 1)


# --- Anytime and adaptive ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "schedule, continued",
    [("uniform", [1, 1, 1, 1]), ("average", [1 / 2, 1 / 2, 1 / 2, 1 / 2]), ("inverse", [1, 1 / 2, 1 / 3, 1 / 4])],
)
def test_anytime_equals_plain_episodes(schedule, continued, tmp_path):
    """a = m_k and a = (K/k) m_k, K = 2, also past the depth."""
    policy = load_policy(save(tmp_path / "best.pt", refinement_depth=2, refinement_schedule=schedule))
    tables, _ = analyse(policy.path, flags="--sections anytime --episodes 2 --num-states 20")
    assert [*tables["anytime"].steps] == [0, 1, 2, 3, 4]
    assert [*tables["anytime_scaled"].steps] == [1, 2, 3, 4]
    for name, rows in tables.items():
        for row in rows.itertuples():

            def act(s: np.ndarray, k=row.steps, scaled=name == "anytime_scaled") -> np.ndarray:
                return proposals_of(policy, s, continued)[k] * (2 / k if scaled else 1)

            returns = play(policy, act, final_seeds(policy, 2))
            assert row.return_mean == pytest.approx(np.mean(returns), rel=1e-4)
            assert row.return_std == pytest.approx(np.std(returns, ddof=1), rel=1e-3)
            assert row.length_mean == 50


def test_adaptive_equals_plain_episodes(tmp_path):
    policy = load_policy(save(tmp_path / "best.pt"))
    tables, _ = analyse(policy.path, flags="--sections adaptive --episodes 2 --num-states 100")
    drops, widths = -np.diff(tables["adaptive"].steps_mean), np.diff(tables["adaptive"]["quantile"])
    assert widths[drops.argmax()] < np.median(widths)  # it looks closer where the mean steps lie far apart
    for row in tables["adaptive"].itertuples():
        used = []

        def act(s: np.ndarray, used=used, tolerance=row.tolerance) -> np.ndarray:
            m = proposals_of(policy, s)
            for k in range(1, 5):
                if k == 4 or np.linalg.norm(m[k] - m[k - 1]) < tolerance:
                    used.append(k)
                    return m[k]

        returns = play(policy, act, final_seeds(policy, 2))
        assert row.steps_mean == pytest.approx(np.mean(used), abs=0.02)
        assert row.return_mean == pytest.approx(np.mean(returns), rel=2e-2)


# --- Training ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_through_training(tmp_path, monkeypatch):
    """Two seeds at two steps each, as a shell sorts the names: each checkpoint's own numbers, those of the other
    sections; mean and standard deviation over the seeds; and a line per seed beside the learning curve."""
    monkeypatch.setattr(analysis, "FEEDBACK_EPISODES", 2)
    runs = [(1, 100), (1, 200), (2, 200), (2, 100)]
    paths = [save(tmp_path / f"{seed}/step_{step}.pt", seed=seed, step=step, scale=step / 4) for seed, step in runs]
    (tmp_path / "1/evaluations.csv").write_text("global_step,return_mean,return_std\n50,-3.5,1\n250,8.0,1\n")
    tables, figures = analyse(*paths, flags="--num-states 20 --sections settling r2 feedback dynamics training")
    across, training = tables.pop("training_across_seeds"), tables["training"]
    assert not [name for name in tables if "across" in name]
    for path, (seed, step) in zip(paths, runs):
        own = {name: table[table.checkpoint == str(path)] for name, table in tables.items()}
        assert set(zip(own["training"].seed, own["training"].global_step)) == {(seed, step)}
        expected = own["dynamics"].set_index(["quantity", "step"]).value.to_dict()
        expected |= {("settling_error", k): x for k, x in own["settling_error"].groupby("step").error.mean().items()}
        expected |= {("delta_r2", k): x for k, x in own["delta_r2"].groupby("step_to").delta_r2.mean().items()}
        expected["return_lost_reading_zero", 4] = own["feedback"].set_index("reads").lost_mean["zero"]
        assert own["training"].set_index(["quantity", "step"]).value.to_dict() == pytest.approx(expected)

    keys = ["quantity", "step", "global_step"]
    across, groups = across.set_index(keys), training.groupby(keys).value
    assert set(across.seeds) == {2}
    assert across.value_mean.to_dict() == pytest.approx(groups.mean().to_dict())
    assert across.value_std.to_dict() == pytest.approx(groups.std().to_dict())

    (axes,) = [figure.axes for figure in figures if "evaluation return" in [axis.get_title() for axis in figure.axes]]
    lines = {
        axis.get_title(): {bars.get_label(): bars.lines[0].get_xydata().tolist() for bars in axis.containers}
        for axis in axes
    }
    assert lines.pop("evaluation return") == {"seed 1": [[50, -3.5], [250, 8]]}
    assert set(lines) == set(analysis.BY_SEED.values())
    for quantity, title in analysis.BY_SEED.items():
        chosen = training[(training.quantity == quantity) & ((training.step == 1) | (quantity != "settling_error"))]
        for seed in (1, 2):
            means = chosen[chosen.seed == seed].groupby("global_step").value.mean()
            np.testing.assert_allclose(lines[title][f"seed {seed}"], means.reset_index())


# --- Names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "env_id, names",
    [
        ("HalfCheetah-v5", ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]),
        ("InvertedPendulum-v5", ["slider"]),  # the joint's name, not the actuator's
        ("BipedalWalker-v3", ["a0", "a1", "a2", "a3"]),
    ],
)
def test_component_names(env_id, names):
    assert analysis.component_names(env_id) == names


def test_component_names_are_unique(monkeypatch):
    """Two motors on one joint, and one on a tendon."""
    env = gym.make("Hopper-v5")
    env.unwrapped.model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
        <body><geom size="1"/><joint name="hip" type="hinge"/></body>
        </worldbody><tendon><fixed name="t"><joint joint="hip" coef="1"/></fixed></tendon><actuator>
        <motor joint="hip"/><motor name="m" joint="hip"/><motor name="pull" tendon="t"/></actuator></mujoco>""")
    monkeypatch.setattr(gym, "make", lambda *_, **__: env)
    assert analysis.component_names("Hopper-v5") == ["hip (a0)", "hip (a1)", "pull"]
