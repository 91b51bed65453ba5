"""What refinement does in a trained policy, from its checkpoints: the paper's two analyses, and what follows from them.

    python analysis_refinement.py --checkpoint runs/.../best.pt
    python analysis_refinement.py --checkpoint runs/.../step_*.pt --sections training

    settling  how far each action component still is from its end after k steps: e_{k,j}, figure 3a of the paper
    r2        whether early components predict the next correction of late ones: delta R^2, figure 3b, beside three
              checks: early components shuffled across states, folds of whole episodes, the observation in both models
    feedback  whether f uses what it reads: the return if it reads, in place of m_k, zero or the m_k of another state;
              and how well a network of one pass reproduces m_K
    anytime   return of the policy stopped after k = 0..2K steps, m_k and (K/k) m_k
    adaptive  return and mean number of steps if a state's refinement stops once a correction is small
    dynamics  corrections, Jacobians of one step, spread left of random starts, proposals outside the action bounds
    training  settling, r2, dynamics and the return lost if f reads zero against the training step, from several
              checkpoints of a run (--save-every), and beside them the run's learning curve

Every policy here is deterministic, and its actions are clipped to their bounds. Each section writes CSVs, a figure and
its part of summary.json into --out-dir, all at the end. With several checkpoints the CSVs gain a `checkpoint` column;
if these are seeds of one setting, `*_across_seeds.csv` has the mean and standard deviation (ddof 1).
"""

import io
import json
import tempfile
import warnings
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal

import gymnasium as gym
import mujoco
import numpy as np
import pandas as pd
import sklearn
import torch
import tyro
from matplotlib import colormaps, colors, rc_context
from matplotlib.figure import Figure
from PIL import Image
from sklearn import linear_model, metrics, model_selection, pipeline, preprocessing
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor
from threadpoolctl import threadpool_limits
from tqdm import tqdm

import refineppo_continuous as refineppo
from refineppo_continuous import Agent, layers, mean_and_std, refuse

FOLDS, MIN_EPISODES, SHUFFLES, STARTS = 5, 20, 50, 8  # of a regression, recorded, of early components, per state
SHUFFLED_FOLDS = model_selection.KFold(FOLDS, shuffle=True, random_state=0)
FEEDBACK_EPISODES, TRAINING_EPISODES = 100, 10  # behind each return of `feedback`, and of it in `training`
FIT_STATES, TOLERANCES = 20_000, 8  # to which the network of one pass is fitted; that `adaptive` tries

Section = Literal["settling", "r2", "feedback", "anytime", "adaptive", "dynamics", "training"]
Mean = Callable[[np.ndarray], np.ndarray]  # normalised observations (n, obs_dim) -> action means (n, action_dim)
progress = partial(tqdm, disable=None, leave=False)  # on a terminal only


@dataclass
class Args:
    checkpoint: tuple[Path, ...]
    """checkpoints of refineppo_continuous.py: one, several seeds of one setting, or several steps of one run"""
    sections: tuple[Section, ...] = ("settling", "r2")
    """what to analyse"""
    num_states: int = 1000
    """states whose refinement is recorded, spread evenly over at least 20 episodes"""
    episodes: int = 5
    """episodes behind each return of `anytime` and `adaptive`"""
    seed: int = 0
    """seed of the recorded episodes, the shuffles, the random starts, the fit and the states drawn for `feedback`"""
    out_dir: Path | None = None
    """folder of the results; default analysis/ beside the first checkpoint"""

    @property
    def folder(self) -> Path:
        """Where the results go."""
        return self.out_dir or self.checkpoint[0].parent / "analysis"


@dataclass
class Policy:
    """A saved policy, and the names of its action components."""

    path: Path
    agent: Agent
    global_step: int
    names: list[str]

    def __post_init__(self):
        self.args, self.weights = self.agent.args, layers(self.agent.arrays(), "actor")
        self.coefficients = refineppo.refinement_coefficients(self.args)
        self.label = f"seed {self.args.seed}, step {self.global_step:,}"

    def proposals(self, obs: np.ndarray, coefficients: list[float] | None = None) -> np.ndarray:
        """m_0 = 0, m_1, ..., m_K, (K + 1, n, action_dim), or with other coefficients; rounded as where it acts."""
        coefficients = coefficients or self.coefficients
        m = refineppo.in_rows_of_8(lambda rows: np.stack(refineppo.proposals(self.weights, coefficients, rows)), obs)
        return np.concatenate([np.zeros_like(m[:1]), m])

    def mean(self, coefficients: list[float] | None = None, scale: float = 1.0) -> Mean:
        """Acting with m_K, or with `scale` times where the refinement ends with other coefficients."""
        return lambda obs: scale * self.proposals(obs, coefficients)[-1]

    def reading_zero(self) -> Mean:
        """Acting with (c_1 + ... + c_K) f(s, 0), where the refinement ends if f reads zero at every step."""
        return self.mean([1.0], scale=sum(self.coefficients))


# --- Input ------------------------------------------------------------------------------------------------------------


def load_policy(path: Path) -> Policy:
    """A checkpoint's policy on the CPU, or a refusal."""
    agent, checkpoint = refineppo.load_agent(path), refineppo.load_checkpoint(path)
    if not all(x.isfinite().all() for part in ("params", "normalizer") for x in checkpoint[part].values()):
        refuse(f"{path} holds parameters that are not finite")
    if agent.args.refinement_depth == 1:
        refuse(f"{path} has refinement depth K = 1: one step, so that there is no refinement to analyse")
    return Policy(path, agent, checkpoint["global_step"], component_names(agent.args.env_id))


def component_names(env_id: str) -> list[str]:
    """Of each action component: the joint that its actuator drives, else the actuator's name, else a0, ...; unique."""
    env = gym.make(env_id, disable_env_checker=True)
    model, names = getattr(env.unwrapped, "model", None), [""] * env.action_space.shape[0]
    if isinstance(model, mujoco.MjModel) and model.nu == len(names):
        joints = np.where(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, model.actuator_trnid[:, 0], -1)
        names = [joint >= 0 and model.joint(joint).name or model.actuator(i).name for i, joint in enumerate(joints)]
    env.close()
    names = [name or f"a{i}" for i, name in enumerate(names)]
    return [name if names.count(name) == 1 else f"{name} (a{i})" for i, name in enumerate(names)]


def check(args: Args) -> list[Policy]:
    """Refuse what cannot be analysed before any work starts; make the output folder and return the policies."""
    if not args.checkpoint or not args.sections:
        refuse("--checkpoint and --sections need at least one value each")
    for name, least in (("num_states", 2 * FOLDS), ("episodes", 2), ("seed", 0)):
        if getattr(args, name) < least:
            refuse(f"{refineppo.flag(name)} must be at least {least}, not {getattr(args, name)}")
    if len({path.resolve() for path in args.checkpoint}) < len(args.checkpoint):
        refuse("--checkpoint names a file twice")
    policies = [load_policy(path) for path in args.checkpoint]
    settings = [(p.args.env_id, p.args.refinement_depth, p.args.refinement_schedule) for p in policies]
    if len(set(settings)) > 1:
        each = ", ".join(f"{path} has {setting}" for path, setting in zip(args.checkpoint, settings))
        refuse(f"the checkpoints must have the same task, depth and schedule: {each}")
    if "training" in args.sections:
        seeds = [seed for seed, _ in {(p.args.seed, p.global_step) for p in policies}]
        if any(seeds.count(seed) == 1 for seed in seeds):
            refuse("--sections training needs checkpoints of each run at two or more training steps (see --save-every)")
    try:
        args.folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=args.folder).close()
    except OSError as error:
        refuse(f"cannot write to the output folder {args.folder}: {error.strerror}")
    return policies


def correction_norms(proposals: np.ndarray) -> np.ndarray:
    """||m_k - m_{k-1}|| for k = 1..K, (K, batch), of proposals (K + 1, batch, action_dim)."""
    return np.linalg.norm(np.diff(proposals, axis=0), axis=-1)


def run_episodes(policy: Policy, mean: Mean, seeds: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns and lengths of one episode per seed, acting with `mean` clipped to the action bounds. They run one after
    the other, so that `mean` sees the states of an episode once each and in order."""
    acting = copy(policy.agent)
    acting.act = lambda obs: np.clip(mean(acting.normalizer.normalize(obs)), acting.low, acting.high)
    returns, lengths = zip(*(refineppo.evaluate(acting, [seed]) for seed in seeds))
    return np.concatenate(returns), np.concatenate(lengths)


def final_returns(policy: Policy, mean: Mean, episodes: int) -> tuple[np.ndarray, dict]:
    """Returns in the episodes of --evaluate, the same for every mean; and a table's columns of them."""
    args = replace(policy.args, final_eval_episodes=episodes)
    seeds = refineppo.evaluation_seeds(args, policy.global_step, final=True)
    returns, lengths = run_episodes(policy, mean, seeds)
    average, std = mean_and_std(returns)
    return returns, {"return_mean": average, "return_std": std, "length_mean": lengths.mean()}


def spread_evenly(lengths: np.ndarray, total: int) -> list[np.ndarray]:
    """Steps to take of each episode, evenly spaced: `total` altogether, as equal in number as the lengths allow."""
    chosen, left = [np.array([], int)] * len(lengths), total
    for rank, i in enumerate(np.argsort(lengths, kind="stable")):  # a short episode leaves its share to longer ones
        count = min(lengths[i], left // (len(lengths) - rank))
        chosen[i] = np.linspace(0, lengths[i] - 1, count).round().astype(int)
        left -= count
    return chosen


def record_states(policy: Policy, args: Args, stream: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Normalised observations (S, obs_dim) of 20 or more episodes of a stream; and each one's episode, (S,)."""
    own, episodes = policy.mean(), []

    def mean(obs: np.ndarray) -> np.ndarray:
        episodes[-1].append(obs)
        return own(obs)

    while sum(map(len, episodes)) < args.num_states:
        for seed in refineppo.episode_seeds(args.seed, stream, len(episodes), count=MIN_EPISODES):
            episodes.append([])
            run_episodes(policy, mean, [seed])
    chosen = spread_evenly(np.array([len(obs) for obs in episodes]), args.num_states)
    obs = np.concatenate([np.concatenate(obs)[steps] for obs, steps in zip(episodes, chosen)])
    return obs, np.repeat(np.arange(len(chosen)), [len(steps) for steps in chosen])


# --- Quantities -------------------------------------------------------------------------------------------------------


def settling_error(proposals: np.ndarray) -> np.ndarray:
    """e_{k,j} = E|m_K,j - m_k,j| / (E|m_K,j| + eps), (K + 1, action_dim), of proposals (K + 1, S, action_dim)."""
    last = proposals[-1]
    return np.abs(last - proposals).mean(1) / (np.abs(last).mean(0) + 1e-8)


def early_and_late(error: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Components in the order of e_{1,j}; the first and the last of them: five each, or half of fewer than ten."""
    order = np.argsort(error[1], kind="stable")
    count = min(5, len(order) // 2)
    return order, order[:count], order[len(order) - count :]


def ridge_r2(features: np.ndarray, target: np.ndarray, folds=SHUFFLED_FOLDS, groups=None) -> float:
    """Cross-validated R^2, mean over folds, of ridge regression (alpha 1) of target (S,) on scaled features (S, n)."""
    model = pipeline.make_pipeline(preprocessing.StandardScaler(), linear_model.Ridge(alpha=1.0))
    data = {"X": features, "y": target, "cv": folds, "groups": groups}
    with sklearn.config_context(assume_finite=True, skip_parameter_validation=True):  # a quarter of the time
        return model_selection.cross_val_score(model, **data, scoring="r2").mean()


def refinement_field(weights: list, obs, m):
    """f(s, m), (..., action_dim), of obs (..., obs_dim) and any m (..., action_dim); all arrays or all tensors."""
    library = np if isinstance(obs, np.ndarray) else torch
    *hidden, (w_out, b_out) = weights
    x = library.concatenate([obs, m], -1)
    for w, b in hidden:
        x = library.tanh(x @ w + b)
    return x @ w_out + b_out


def fit_one_pass(obs: np.ndarray, target: np.ndarray, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """(weight, bias) pairs of a network obs -> 128 tanh -> 128 tanh -> target, fitted by least squares on components
    of equal weight. A tenth of the states says when to stop."""
    centre, scale = target.mean(0), np.maximum(target.std(0), 1e-8)
    network = MLPRegressor(hidden_layer_sizes=(128, 128), activation="tanh", early_stopping=True, random_state=seed)
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):  # 200 epochs are enough
        network.fit(obs, ((target - centre) / scale).squeeze())
    *hidden, (w_out, b_out) = zip(network.coefs_, network.intercepts_)
    return [*hidden, (w_out * scale, b_out * scale + centre)]


def step_jacobians(weights: list, obs: torch.Tensor, m: torch.Tensor, c: float) -> torch.Tensor:
    """d(m + c f(s, m)) / dm, exact, (S, action_dim, action_dim), of obs (S, obs_dim) and m (S, action_dim)."""
    jacobian = torch.func.vmap(torch.func.jacfwd(refinement_field, argnums=2), (None, 0, 0), chunk_size=1000)
    return torch.eye(m.shape[1], dtype=m.dtype) + c * jacobian(weights, obs, m)


# --- Sections: their tables -------------------------------------------------------------------------------------------


def settling_rows(proposals: np.ndarray, names: list[str]) -> list[dict]:
    """Every e_{k,j}, in the order of e_{1,j}."""
    error = settling_error(proposals)
    ranked = list(enumerate(early_and_late(error)[0], start=1))
    return [dict(component=names[j], rank=r, step=k, error=error[k, j]) for r, j in ranked for k in range(len(error))]


def r2_rows(proposals: np.ndarray, names: list[str]) -> Iterator[tuple[dict, np.ndarray, np.ndarray, np.ndarray]]:
    """The paper's delta R^2 of every late component and transition; and what it was computed from: the component's own
    value (S, 1), that and the early components' values (S, 1 + n), and the next correction (S,)."""
    _, early, late = early_and_late(settling_error(proposals))
    for j in late:
        for k in range(1, len(proposals) - 1):  # at k = 0 every input is zero
            own, both = proposals[k][:, [j]], proposals[k][:, [j, *early]]
            target = proposals[k + 1][:, j] - proposals[k][:, j]
            row = {"component": names[j], "step_from": k, "step_to": k + 1}
            row |= {"r2_baseline": ridge_r2(own, target), "r2_augmented": ridge_r2(both, target)}
            yield row | {"delta_r2": row["r2_augmented"] - row["r2_baseline"]}, own, both, target


def r2_tables(proposals: np.ndarray, names: list[str], obs: np.ndarray, episodes: np.ndarray, seed: int):
    """delta R^2; and beside it the middle 95 % of what early components shuffled across states give, folds of whole
    episodes (states of one episode resemble each other), and the observation as a feature of both models (none, where
    that alone makes the prediction worse)."""
    tables, rng = {"delta_r2": [], "delta_r2_checks": []}, np.random.default_rng(seed)
    whole = {"folds": model_selection.GroupKFold(FOLDS), "groups": episodes}
    for row, own, both, target in progress(r2_rows(proposals, names), desc="shuffled R^2"):
        shuffled = [np.hstack([own, both[rng.permutation(len(own)), 1:]]) for _ in range(SHUFFLES)]
        gains = [ridge_r2(features, target) - row["r2_baseline"] for features in shuffled]
        low, high = np.quantile(gains, (0.025, 0.975))
        check = {name: row[name] for name in ("component", "step_from", "step_to", "delta_r2")}
        check |= {"shuffled_low": low, "shuffled_high": high, "above_shuffled": int(row["delta_r2"] > high)}
        check["by_episode"] = ridge_r2(both, target, **whole) - ridge_r2(own, target, **whole)
        given = np.hstack([own, obs])
        r2_given = ridge_r2(given, target)
        gain = ridge_r2(np.hstack([given, both[:, 1:]]), target) - r2_given
        check["given_observation"] = gain if r2_given > row["r2_baseline"] else np.nan  # its own fit is unstable
        tables["delta_r2"].append(row)
        tables["delta_r2_checks"].append(check)
    return tables


def feedback_rows(policy: Policy, obs: np.ndarray, proposals: np.ndarray, args: Args) -> list[dict]:
    """Whether the policy uses what f reads: f reads x_k in place of m_k, m_K = c_1 f(s, x_0) + ... + c_K f(s, x_{K-1}).

        own            x_k = m_k(s), as trained
        zero           x_k = 0, so that m_K = (c_1 + ... + c_K) f(s, 0)
        another_state  x_k = m_k(s'), of a recorded state s' (obs, proposals) drawn anew at every step of an episode
        one_pass       no f: a network s -> 128 tanh -> 128 tanh -> action, fitted to m_K(s) in 20,000 other states

    return: of 100 episodes, the same for every row; lost: the own return minus this one, paired by episode; r2: R^2
    with which the row's m_K reproduces the own one in the recorded states, mean over action components.
    """
    pool, rng, own = proposals.astype(np.float32), np.random.default_rng(args.seed), policy.mean()
    states, _ = record_states(policy, replace(args, num_states=FIT_STATES), stream=3)
    network = fit_one_pass(states, own(states), args.seed)

    def another_state(obs: np.ndarray) -> np.ndarray:
        drawn = pool[:, rng.integers(pool.shape[1], size=len(obs))]
        return sum(c * refinement_field(policy.weights, obs, x) for c, x in zip(policy.coefficients, drawn))

    def one_pass(obs: np.ndarray) -> np.ndarray:
        return refinement_field(network, obs, obs[:, :0])  # it reads no proposal

    means = {"own": own, "zero": policy.reading_zero(), "another_state": another_state, "one_pass": one_pass}
    rows, own_returns = [], None
    for reads, mean in progress(means.items(), desc=f"feedback, {policy.label}"):
        returns, columns = final_returns(policy, mean, FEEDBACK_EPISODES)
        own_returns = returns if mean is own else own_returns
        lost, std = mean_and_std(own_returns - returns)
        columns |= {"lost_mean": lost, "lost_std": std, "r2": metrics.r2_score(own(obs), mean(obs))}
        rows.append({"reads": reads, "episodes": FEEDBACK_EPISODES} | columns)
    return rows


def anytime_tables(policy: Policy, episodes: int) -> dict[str, list[dict]]:
    """Return of a = m_k for k = 0..2K, and of (K/k) m_k, under the average schedule about as large as m_K. Past K
    uniform keeps c_k = 1, average its own 1/K, and inverse goes on with 1/k."""
    depth, tables = policy.args.refinement_depth, {"anytime": [], "anytime_scaled": []}
    coefficients = refineppo.refinement_coefficients(replace(policy.args, refinement_depth=2 * depth))
    if policy.args.refinement_schedule == "average":
        coefficients = policy.coefficients * 2
    for k in progress(range(len(coefficients) + 1), desc=f"anytime, {policy.label}"):
        own = coefficients[:k] or [0.0]  # m_0 = 0
        tables["anytime"].append({"steps": k} | final_returns(policy, policy.mean(own), episodes)[1])
        if k:
            _, columns = final_returns(policy, policy.mean(own, scale=depth / k), episodes)
            tables["anytime_scaled"].append({"steps": k} | columns)
    return tables


def adaptive_rows(policy: Policy, norms: np.ndarray, episodes: int) -> list[dict]:
    """Return and mean steps used if a state's refinement ends with the first correction below a tolerance, for
    tolerances that spread the mean steps as evenly as they can.

    norms: of the corrections in recorded states, (K, S). A state has stopped by step k < K if the smallest of its
    first k norms is below the tolerance; so the quantile q of these minima lets the recorded states use
    K - (K - 1) q steps on average. But a policy that stops early comes to other states. So where the mean steps in the
    episodes lie furthest apart, for two neighbouring quantiles from 0 and 1 on, the one half-way between is tried.
    """
    smallest, rows = np.minimum.accumulate(norms[:-1]), {}

    def try_out(quantile: float, tolerance: float):
        used = []

        def mean(obs: np.ndarray) -> np.ndarray:
            proposals = policy.proposals(obs)
            small = correction_norms(proposals.astype(float)) < tolerance  # as precise as `norms`
            used.append(np.where(small.any(0), small.argmax(0) + 1, len(small)))
            return proposals[used[-1], np.arange(len(obs))]

        _, columns = final_returns(policy, mean, episodes)
        steps = {"tolerance": tolerance, "steps_mean": np.concatenate(used).mean()}
        rows[quantile] = {"quantile": quantile} | steps | columns

    try_out(0.0, 0.0)  # below all norms, so that all K steps are used
    try_out(1.0, float(np.nextafter(smallest.max(), np.inf)))
    for _ in progress(range(TOLERANCES - 2), desc=f"adaptive, {policy.label}"):
        gaps = {(low, high): rows[low]["steps_mean"] - rows[high]["steps_mean"] for low, high in pairwise(sorted(rows))}
        quantile = float(np.mean(max(gaps, key=gaps.get)))
        try_out(quantile, float(np.quantile(smallest, quantile)))
    return [rows[quantile] for quantile in sorted(rows)]


def dynamics_rows(policy: Policy, obs: np.ndarray, proposals: np.ndarray, seed: int) -> list[dict]:
    """The refinement as a dynamical system: median over states, and 10th and 90th percentile; of what is outside the
    bounds the mean instead."""
    agent, coefficients = policy.agent, policy.coefficients
    weights = layers({name: p.double() for name, p in agent.params.items()}, "actor")
    obs, space = torch.from_numpy(obs).double(), gym.spaces.Box(agent.low, agent.high, seed=seed)
    starts = torch.from_numpy(np.array([[space.sample() for _ in obs] for _ in range(STARTS)])).double()
    outside = ((proposals < agent.low) | (proposals > agent.high)).astype(float)
    norms, steps = correction_norms(proposals), range(1, len(proposals))
    spreads, m = [], starts  # of m_k around its mean over the starts; 0 at the end: it forgets where it started
    for c in (0.0, *coefficients):
        m = torch.stack([m_r + c * refinement_field(weights, obs, m_r) for m_r in m])
        spreads.append((m - m.mean(0)).square().sum(-1).mean(0).sqrt())
    singular_values, radii = {}, {}
    for k, c in zip(steps, progress(coefficients, desc="Jacobians")):
        jacobians = step_jacobians(weights, obs, torch.from_numpy(proposals[k - 1]), c).numpy()
        singular_values[k] = np.linalg.svd(jacobians, compute_uv=False)[:, 0]
        radii[k] = np.abs(np.linalg.eigvals(jacobians)).max(-1)
    quantities = {  # of every step k its value in every state, (S,)
        "correction_norm": {k: norms[k - 1] for k in steps},
        "correction_ratio": {k: norms[k - 1] / np.maximum(norms[k - 2], 1e-12) for k in steps[1:]},
        "largest_singular_value": singular_values,
        "spectral_radius": radii,
        "spread_of_random_starts": dict(enumerate(torch.stack(spreads).div(spreads[0]).numpy())),
        "proposals_outside_bounds": {k: outside[k].max(-1) for k in steps},
        "components_outside_bounds": {k: outside[k].mean(-1) for k in steps},
    }
    rows = []
    for quantity, values in quantities.items():
        centre = np.mean if "outside" in quantity else np.median
        for k, x in values.items():
            low, high = np.quantile(x, (0.1, 0.9))
            rows.append({"quantity": quantity, "step": k, "value": centre(x), "q10": low, "q90": high})
    return rows


def training_rows(policy: Policy, obs: np.ndarray, proposals: np.ndarray, seed: int) -> list[dict]:
    """e_k (mean over components), delta R^2 of the step to k (mean over late components), the dynamics, and under
    k = K the return lost if f reads zero at every step, as in `feedback`."""
    values = [("settling_error", row["step"], row["error"]) for row in settling_rows(proposals, policy.names)]
    values += [("delta_r2", row["step_to"], row["delta_r2"]) for row, *_ in r2_rows(proposals, policy.names)]
    values += [(row["quantity"], row["step"], row["value"]) for row in dynamics_rows(policy, obs, proposals, seed)]
    means = policy.mean(), policy.reading_zero()
    own, zero = (final_returns(policy, mean, TRAINING_EPISODES)[0] for mean in means)
    values.append(("return_lost_reading_zero", policy.args.refinement_depth, np.mean(own - zero)))
    columns = ["seed", "global_step", "quantity", "step", "value"]
    table = pd.DataFrame([(policy.args.seed, policy.global_step, *row) for row in values], columns=columns)
    return table.groupby(columns[:-1], sort=False, as_index=False).mean().to_dict("records")


def analyse(policy: Policy, args: Args) -> dict[str, pd.DataFrame]:
    """The tables of the sections, of one checkpoint."""
    obs, episodes = record_states(policy, args)
    proposals, names = policy.proposals(obs).astype(float), policy.names
    sections = {
        "settling": lambda: {"settling_error": settling_rows(proposals, names)},
        "r2": lambda: r2_tables(proposals, names, obs, episodes, args.seed),
        "feedback": lambda: {"feedback": feedback_rows(policy, obs, proposals, args)},
        "anytime": lambda: anytime_tables(policy, args.episodes),
        "adaptive": lambda: {"adaptive": adaptive_rows(policy, correction_norms(proposals), args.episodes)},
        "dynamics": lambda: {"dynamics": dynamics_rows(policy, obs, proposals, args.seed)},
        "training": lambda: {"training": training_rows(policy, obs, proposals, args.seed)},
    }
    tables, path = {}, {"checkpoint": str(policy.path)}
    for section, rows_of in sections.items():
        if section in args.sections:
            tables |= {name: pd.DataFrame([path | row for row in rows]) for name, rows in rows_of().items() if rows}
    return tables


# --- Tables across checkpoints, and as text ---------------------------------------------------------------------------

KEYS = {  # the columns that name a row of a table
    "settling_error": ["component", "step"],
    **dict.fromkeys(("delta_r2", "delta_r2_checks"), ["component", "step_from", "step_to"]),
    "feedback": ["reads"],
    **dict.fromkeys(("anytime", "anytime_scaled"), ["steps"]),
    "adaptive": ["quantile"],
    "dynamics": ["quantity", "step"],
    "training": ["quantity", "step", "global_step"],
}
WIDE = {"settling_error": ("step", "error"), "dynamics": ("step", "value"), "training": ("global_step", "value")}


def compact(table: pd.DataFrame, keys: list[str], column: str = "", value: str = "") -> pd.DataFrame:
    """A row for every combination of the keys, which are its name; with a `column`, that key's values side by side."""
    names = table[[key for key in keys if key != column]].astype(str).agg(" ".join, axis=1)
    if not column:
        return table.drop(columns=["checkpoint", *keys]).set_index(names.rename(None))
    wide = table.assign(row=names).pivot(index="row", columns=column, values=value)
    return wide.loc[names.unique()].rename_axis(index=None, columns=None)


def across_seeds(table: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Mean and standard deviation (ddof 1) over checkpoints of every value column, and how many they are."""
    groups = table.drop(columns=["checkpoint", "seed"], errors="ignore").groupby(keys, sort=False)
    mean, std = (lambda x, i=i: mean_and_std(x.to_numpy())[i] for i in (0, 1))  # of one checkpoint the std is 0
    statistics = groups.agg([("mean", mean), ("std", std)])
    statistics.columns = ["_".join(column) for column in statistics.columns]
    statistics.insert(0, "seeds", groups.size())
    return statistics.reset_index()


# --- Figures ----------------------------------------------------------------------------------------------------------

AROUND_ONE = ("correction ratio", "largest singular value", "spectral radius", "spread of random starts")
PAST_K = {"uniform": "$c_k = 1$", "average": "$c_k = 1/K$", "inverse": "$c_k = 1/k$"}
STYLE = {"font.size": 7, "axes.titlesize": 7, "figure.titlesize": 7.5, "axes.formatter.useoffset": False}
STYLE["axes.formatter.limits"] = (-4, 5)  # long numbers in powers of ten
MARKERS = "os^Dv<>P*X"
BY_SEED = {
    "return_lost_reading_zero": "return lost if $f$ reads zero",
    "spectral_radius": "spectral radius (mean over $k$)",
    "settling_error": "$e_1$ (mean over components)",
    "delta_r2": r"$\Delta R^2$ (mean over components and $k$)",
}


def mean_with_bars(rows: pd.DataFrame, x: str, name: str, count: int = 1) -> pd.DataFrame:
    """To be drawn: a mean over `count` values against a column x, with bars of its standard error."""
    mean, error = rows[f"{name}_mean"], rows[f"{name}_std"] / count**0.5
    return rows.assign(x=rows[x], y=mean, low=mean - error, high=mean + error)


class Figures:
    """Draws the tables: checkpoints side by side or a line each, and if they are seeds also their mean."""

    def __init__(self, policies: list[Policy], args: Args, tables: dict[str, pd.DataFrame]):
        labels = [policy.label for policy in policies]
        labels = {str(p.path): p.label if labels.count(p.label) == 1 else str(p.path) for p in policies}
        self.tables = {name: rows.assign(line=rows["checkpoint"].map(labels)) for name, rows in tables.items()}
        self.policies, self.episodes, self.depth = policies, args.episodes, policies[0].args.refinement_depth
        self.single, seeds = len(policies) == 1, {policy.args.seed for policy in policies}
        self.seeds = len(seeds) == len(policies) > 1
        self.schedule = policies[0].args.refinement_schedule
        self.title = f"{policies[0].args.env_id}, $K = {self.depth}$, {self.schedule} schedule"
        self.title += f", {policies[0].label}" if self.single else f", seed {min(seeds)}" if len(seeds) == 1 else ""

    def axes(self, what: str, titles: list[str], columns: int, width: float, height: float, **share):
        """A titled figure and its titled axes, at most `columns` in a row, each of width x height inches."""
        rows = -(-len(titles) // columns)
        columns = -(-len(titles) // rows)
        figure = Figure((max(columns * width + 0.8, 3.8), rows * height + 0.6), layout="constrained", dpi=200)
        axes = figure.subplots(rows, columns, squeeze=False, **share).ravel().tolist()
        for axis, title in zip(axes, titles):
            axis.set_title(title)
        for axis in axes[len(titles) :]:
            axis.remove()
        figure.suptitle(f"{what}\n{self.title}")
        return figure, axes[: len(titles)]

    def heatmaps(self, what: str, label: str, rows: pd.DataFrame, names: list[str], value: str, text, width: float):
        """Component by column `at`, a panel per checkpoint (of seeds also mean and std), all on one colour scale."""
        keys = ["component", "at"]
        panels = {line: compact(group, keys, "at", value) for line, group in rows.groupby("line", sort=False)}
        if self.seeds:
            across = across_seeds(rows[["checkpoint", *keys, value]], keys)
            panels["mean over seeds"] = compact(across, keys, "at", f"{value}_mean")
            panels["std over seeds"] = compact(across[across["seeds"] > 1], keys, "at", f"{value}_std")
        columns, norm = rows["at"].unique(), colors.Normalize(min(0.0, rows[value].min()), rows[value].max())
        width, height, titles = width * len(columns) + 0.2, 0.17 * len(names) + 0.6, [""] if self.single else panels
        figure, axes = self.axes(what, titles, max(1, int(8 / width)), width, height, sharey=True)
        for axis, panel in zip(axes, panels.values()):
            matrix = panel.reindex(index=names, columns=columns).to_numpy()
            image = axis.imshow(matrix, cmap="cividis_r", norm=norm, aspect="auto")
            for (i, j), x in np.ndenumerate(matrix):
                color = "white" if norm(x) > 0.5 else "black"
                axis.text(j, i, "" if np.isnan(x) else text(x), color=color, ha="center", va="center", size=6)
            axis.set_xticks(range(len(columns)), columns)
            axis.set_yticks(range(len(names)), names)
            axis.set_xlabel("refinement step")
        figure.colorbar(image, ax=axes, label=label)
        return figure

    def lines(self, what: str, panels: dict[str, pd.DataFrame], columns: int, width: float, height: float, **labels):
        """`y` against `x` for every `line`, bars from `low` to `high`, a panel per table; of seeds also the mean."""
        figure, axes = self.axes(what, panels, columns, width, height)
        names = pd.concat(panels.values())["line"].unique().tolist()
        for axis, rows in zip(axes, panels.values()):
            for name, line in rows.groupby("line", sort=False):
                i = names.index(name)
                look = {"color": colormaps["cividis"](0.85 * i / len(names)), "marker": MARKERS[i % len(MARKERS)]}
                look |= {"linestyle": "none" if "points" in rows else "-", "markersize": 4, "linewidth": 1}
                error = [line["y"] - line["low"], line["high"] - line["y"]] if "low" in rows else None
                axis.errorbar(line["x"], line["y"], error, label=name, capsize=2, **look)
            if self.seeds and "points" not in rows:
                mean = rows.groupby("x", sort=False)["y"].mean()
                axis.plot(mean.index, mean, "k--", linewidth=1.5, label="mean over seeds")
            axis.set(**labels)
        return figure

    def settling_error(self) -> Figure:
        """Figure 3a, with a row for a correction that never changes, so that m_k only grows with the schedule."""
        rows, constant = self.tables["settling_error"].rename(columns={"step": "at"}), "(constant $f$)"
        done = np.cumsum([0, *self.policies[0].coefficients])
        names = rows[rows["at"] == 1].groupby("component", sort=False)["error"].mean().sort_values(kind="stable").index
        steps = pd.DataFrame({"component": constant, "at": range(len(done)), "error": 1 - done / done[-1]})
        checkpoints = rows[["checkpoint", "line"]].drop_duplicates()
        rows = pd.concat([rows, checkpoints.merge(steps, how="cross")])
        what, label = "Remaining refinement by action component", "$e_{k,j}$ (dark: far from its end)"
        return self.heatmaps(what, label, rows, [*names, constant], "error", "{:.2f}".format, width=0.34)

    def delta_r2(self) -> Figure:
        """Figure 3b."""
        rows = self.tables["delta_r2"]
        rows = rows.assign(at=rows["step_from"].astype(str) + "→" + rows["step_to"].astype(str))
        what, label = "What early components add to the prediction of late corrections", r"$\Delta R^2$ (dark: large)"
        return self.heatmaps(what, label, rows, rows["component"].unique(), "delta_r2", "{:.2g}".format, width=0.48)

    def feedback(self) -> Figure:
        rows = self.tables["feedback"].assign(points=True)
        rows["reads"] = rows["reads"].str.replace("_", "\n")
        panels = {
            f"return ({FEEDBACK_EPISODES} episodes)": mean_with_bars(rows, "reads", "return", FEEDBACK_EPISODES),
            "return lost, paired by episode": mean_with_bars(rows, "reads", "lost", FEEDBACK_EPISODES),
            "$R^2$ of $m_K$ in recorded states": rows.rename(columns={"reads": "x", "r2": "y"}),
        }
        return self.lines("What $f$ reads in place of $m_k$ (mean, standard error)", panels, 3, 2.0, 1.9, xmargin=0.15)

    def anytime(self) -> Figure:
        names = {"acting with $m_k$": "anytime", "acting with $(K/k) m_k$": "anytime_scaled"}
        panels = {title: mean_with_bars(self.tables[x], "steps", "return", self.episodes) for title, x in names.items()}
        label = f"steps $k$ (dotted: $K$; past it {PAST_K[self.schedule]})"
        what = f"Return of the policy stopped after $k$ steps (mean and standard error, {self.episodes} episodes)"
        figure = self.lines(what, panels, 2, 2.6, 2.1, xlabel=label)
        low, high = zip(*(axis.get_ylim() for axis in figure.axes))
        for axis in figure.axes:
            axis.axvline(self.depth, color="0.5", linestyle=":")
            axis.set_ylim(min(low), max(high))
        return figure

    def adaptive(self) -> Figure:
        """Points without lines: what lies between two tolerances was not measured."""
        rows = mean_with_bars(self.tables["adaptive"], "steps_mean", "return", self.episodes).assign(points=True)
        what = f"Return if refinement stops at a small correction (mean and standard error, {self.episodes} episodes)"
        label = f"mean steps used (tolerance from 0 at $K$ to {rows['tolerance'].max():.2g} on the left)"
        figure = self.lines(what, {"": rows}, 1, 3.6, 2.4, xlabel=label)
        if "anytime" in self.tables and (self.single or self.seeds):
            fixed = self.tables["anytime"].groupby("steps")["return_mean"].mean().loc[1 : self.depth]
            figure.axes[0].plot(fixed.index, fixed, "kx", label="the same number of steps in every state")
        return figure

    def dynamics(self) -> Figure:
        rows = self.tables["dynamics"].rename(columns={"step": "x", "value": "y", "q10": "low", "q90": "high"})
        panels = dict(list(rows.groupby(rows["quantity"].str.replace("_", " "), sort=False)))
        panels = {name: x.drop(columns=["low", "high"]) if "outside" in name else x for name, x in panels.items()}
        what, limits = "Dynamics of the refinement (median and 10 to 90 % of states)", (-0.3, self.depth + 0.3)
        figure = self.lines(what, panels, 4, 1.65, 1.5, xlabel="step $k$", xlim=limits)
        for axis, quantity in zip(figure.axes, panels):
            if quantity in AROUND_ONE:
                axis.axhline(1, color="0.5", linestyle=":")
            if "outside" in quantity:
                axis.set(ylabel="fraction", ylim=(-0.05, 1.05))
        return figure

    def training(self) -> Figure:
        """When refinement begins: what tells it, a line per seed, beside the learning curve."""
        table = self.tables["training"]
        files = {policy.path.with_name("evaluations.csv"): policy.args.seed for policy in self.policies}
        curves = [pd.read_csv(path).assign(seed=seed) for path, seed in files.items() if path.exists()]
        curves = [curve.assign(quantity="evaluation return", value=curve["return_mean"]) for curve in curves]
        chosen = table["quantity"].isin(BY_SEED) & ((table["step"] == 1) | (table["quantity"] != "settling_error"))
        rows = pd.concat([*curves, table[chosen].replace({"quantity": BY_SEED})])
        rows = rows.groupby(["quantity", "seed", "global_step"], sort=False)["value"].mean().reset_index()
        rows = rows.rename(columns={"global_step": "x", "value": "y"}).sort_values(["seed", "x"], kind="stable")
        rows["line"] = "seed " + rows["seed"].astype(str)
        panels = dict(list(rows.groupby("quantity", sort=False)))
        return self.lines("Refinement through training, a line per seed", panels, 3, 2.4, 1.5, xlabel="training step")


def as_png(figure: Figure) -> bytes:
    """The picture in 256 colours, a third of the bytes, with one legend below all axes."""
    lines, names = figure.axes[-1].get_legend_handles_labels()  # it has all; a run may lack its learning curve
    if len(names) > 1:
        columns = max(1, int(figure.get_figwidth() / (0.6 + 0.05 * max(map(len, names)))))
        figure.legend(lines, names, loc="outside lower center", ncols=columns, frameon=False)
    drawn, image = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png")
    Image.open(drawn).convert("RGB").quantize(method=Image.Quantize.MAXCOVERAGE).save(image, "png")
    return image.getvalue()


# --- Main -------------------------------------------------------------------------------------------------------------


def main():
    args = tyro.cli(Args, description=__doc__)
    policies = check(args)
    torch.set_num_threads(policies[0].args.num_threads)  # as in the run, for the same returns
    threadpool_limits(policies[0].args.num_threads)
    several = len(policies) > 1
    parts = [analyse(policy, args) for policy in tqdm(policies, desc="checkpoints", disable=None if several else True)]
    tables = {name: pd.concat([part[name] for part in parts], ignore_index=True) for name in parts[0]}

    files, figures = {}, Figures(policies, args, tables)
    checkpoints = {str(p.path): {"global_step": p.global_step, **asdict(p.args)} for p in policies}
    summary = {"flags": asdict(args), "checkpoints": checkpoints}
    for name, rows in tables.items():
        for whose, group in rows.groupby("seed" if name == "training" else "checkpoint", sort=False):
            shown = compact(group, KEYS[name], *WIDE.get(name, ()))
            print(f"\n{name}{f' of {whose}' if several else ''}")
            print(shown.to_string(float_format="{:.4g}".format, na_rep=""))
            shown = shown.astype(object).where(shown.notna(), None)  # JSON has no NaN
            summary.setdefault(name, {})[str(whose)] = shown.to_dict("index")
        rows = rows if several else rows.drop(columns="checkpoint")
        files[f"{name}.csv"] = rows.to_csv(index=False).encode()
        if figures.seeds or name == "training" and rows["seed"].nunique() > 1:
            files[f"{name}_across_seeds.csv"] = across_seeds(rows, KEYS[name]).to_csv(index=False).encode()
        if hasattr(figures, name):
            with rc_context(STYLE):
                files[f"{name}.png"] = as_png(getattr(figures, name)())
    files["summary.json"] = json.dumps(summary, indent=2, default=str).encode()
    try:
        for name, data in files.items():
            refineppo.write_atomically(args.folder / name, data)
    except OSError as error:
        refuse(f"cannot write to the output folder {args.folder}: {error.strerror}")
    if len(policies[0].names) == 1 and {"r2", "training"} & set(args.sections):
        print("\nan action has one component, which no other can inform: there is no delta R^2")
    for path, rows in tables["adaptive"].groupby("checkpoint", sort=False) if "adaptive" in tables else ():
        steps = np.sort(rows["steps_mean"])
        low, high = steps[np.diff(steps).argmax() :][:2]
        if high - low > (steps[-1] - steps[0]) / 2:
            print(f"\n{path}: no tolerance was found that takes between {low:.2f} and {high:.2f} steps on average")
    print(f"\nthe tables, figures and summary.json are in {args.folder}")


if __name__ == "__main__":
    main()
