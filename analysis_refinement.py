"""What refinement does in a trained policy, from its checkpoints: the paper's two analyses, and what follows from them.

    python analysis_refinement.py --checkpoint runs/.../best.pt
    python analysis_refinement.py --checkpoint runs/seed-*/best.pt --sections settling r2 anytime adaptive dynamics
    python analysis_refinement.py --checkpoint runs/.../step_*.pt --sections training

    settling  how far each action component still is from its end after k steps: e_{k,j}, figure 3a of the paper
    r2        whether early components predict the next correction of late ones: delta R^2, figure 3b, beside three
              checks: early components shuffled across states, folds of whole episodes, the observation in both models
    anytime   return of the policy stopped after k = 0..2K steps; past K uniform goes on with c_k = 1, inverse with
              1/k, and average with its own 1/K
    adaptive  return and mean number of steps if a state's refinement stops once a correction is small
    dynamics  corrections, Jacobians of one step, spread left of random starts, proposals outside the action bounds
    training  settling, r2 and dynamics against the training step, from several checkpoints of a run (--save-every)

Each section writes CSVs, figures and its part of summary.json into --out-dir, all at the end. With several checkpoints
the CSVs gain a `checkpoint` column, and if these are seeds of one setting there are also `*_across_seeds.csv`, with the
mean and standard deviation (ddof 1).
"""

import csv
import io
import json
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from copy import copy
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
import sklearn
import torch
import tyro
from matplotlib import colormaps, rc_context
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from sklearn.linear_model import Ridge
from sklearn.model_selection import GroupKFold, KFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from tqdm import tqdm

import refineppo_continuous as refineppo
from refineppo_continuous import Actor, Agent, layers, mean_and_std, refuse

FOLDS, MIN_EPISODES, SHUFFLES, STARTS = 5, 20, 50, 8  # of a regression, recorded, of early components, per state
SHUFFLED_FOLDS = KFold(FOLDS, shuffle=True, random_state=0)
QUANTILES = (0.0, 0.02, 0.1, 0.3, 0.6, 0.9)  # of the corrections' norms: the tolerances of `adaptive`

Section = Literal["settling", "r2", "anytime", "adaptive", "dynamics", "training"]
Rows = list[dict]  # of a table
progress = partial(tqdm, disable=None, leave=False)  # on a terminal only


@dataclass
class Args:
    checkpoint: tuple[Path, ...]
    """checkpoints of refineppo_continuous.py: one, several seeds of one setting, or several steps of one run"""
    sections: tuple[Section, ...] = ("settling", "r2")
    """what to analyse"""
    num_states: int = 1000
    """states whose refinement is recorded, spread evenly over at least 20 episodes"""
    sample_actions: bool = False
    """record states of the stochastic policy instead of the deterministic one"""
    episodes: int = 5
    """episodes behind each return of `anytime` and `adaptive`"""
    seed: int = 0
    """seed of the recorded episodes, the shuffles and the random starts"""
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

    @property
    def args(self) -> refineppo.Args:
        return self.agent.args

    @property
    def label(self) -> str:
        return f"seed {self.args.seed}, step {self.global_step:,}"


# --- Input ------------------------------------------------------------------------------------------------------------


def load_policy(path: Path) -> Policy:
    """A checkpoint's policy on the CPU, or a refusal."""
    ppo_flags = {field.name for field in fields(refineppo.Args)} - {"refinement_depth", "refinement_schedule"}
    with suppress(Exception):  # load_checkpoint says what is wrong with a file that cannot be read
        if zipfile.is_zipfile(path) and set(torch.load(path, "cpu", weights_only=True)["args"]) == ppo_flags:
            refuse(f"{path} is a checkpoint of PPO, which has no refinement to analyse")
    saved = refineppo.load_checkpoint(path)
    try:
        here = {"evaluate": str(path), "cuda": False, "track": False, "capture_video": False}
        args = refineppo.Args(**saved["args"] | here)
        agent = Agent(*refineppo.check_args(args), args)
        agent.load(saved)
        step = int(saved["global_step"])
    except Exception:  # the right flags, but parts missing or of other shapes
        refuse(f"{path} is damaged: it does not hold a policy for its task")
    if not all(p.isfinite().all() for part in agent.tensors().values() for p in part.values()):
        refuse(f"{path} holds parameters that are not finite")
    if args.refinement_depth == 1:
        refuse(f"{path} has refinement depth K = 1: one step, so that there is no refinement to analyse")
    return Policy(path, agent, step, component_names(args.env_id))


def component_names(env_id: str) -> list[str]:
    """Of each action component: the joint that its actuator drives, else the actuator's name, else a0, ...; unique."""
    env = refineppo.make_env(env_id)
    model, names = getattr(env.unwrapped, "model", None), [""] * env.action_space.shape[0]
    if isinstance(model, mujoco.MjModel) and model.nu == len(names):
        on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        names = [on_joint[i] and model.joint(model.actuator_trnid[i, 0]).name or model.actuator(i).name
                 for i in range(model.nu)]  # fmt: skip
    env.close()
    names = [name or f"a{i}" for i, name in enumerate(names)]
    return [name if names.count(name) == 1 else f"{name} (a{i})" for i, name in enumerate(names)]


def check(args: Args) -> list[Policy]:
    """Refuse what cannot be analysed before any work starts; make the output folder and return the policies."""
    if not args.checkpoint or not args.sections:
        refuse("--checkpoint and --sections need at least one value each")
    if args.num_states < 2 * FOLDS:
        refuse(f"--num-states must be at least {2 * FOLDS}, two for each of the {FOLDS} folds, not {args.num_states}")
    if args.episodes < 2 or args.seed < 0:
        refuse(f"--episodes must be at least 2 and --seed at least 0, not {args.episodes} and {args.seed}")
    if len({path.resolve() for path in args.checkpoint}) < len(args.checkpoint):
        refuse("--checkpoint names a file twice")
    policies = [load_policy(path) for path in args.checkpoint]
    settings = [(p.args.env_id, p.args.refinement_depth, p.args.refinement_schedule) for p in policies]
    for path, setting in zip(args.checkpoint, settings):
        if setting != settings[0]:
            both = f"{args.checkpoint[0]} has {settings[0]}, {path} has {setting}"
            refuse(f"the checkpoints must have the same task, depth and schedule: {both}")
    if set(args.sections) == {"r2"} and len(policies[0].names) == 1:
        refuse(f"an action of {settings[0][0]} has one component, which no other can inform: there is no delta R^2")
    seeds = [seed for seed, _ in {(p.args.seed, p.global_step) for p in policies}]
    if "training" in args.sections and any(seeds.count(seed) == 1 for seed in seeds):
        refuse("--sections training needs checkpoints of each run at two or more training steps (see --save-every)")
    try:
        args.folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=args.folder).close()
    except OSError as error:
        refuse(f"cannot write to the output folder {args.folder}: {error.strerror}")
    return policies


# --- Acting -----------------------------------------------------------------------------------------------------------


def with_start(proposals: list[np.ndarray]) -> np.ndarray:
    """m_0 = 0, m_1, ..., m_K, (K + 1, batch, action_dim), from m_1, ..., m_K."""
    return np.stack([np.zeros_like(proposals[0]), *proposals])


def correction_norms(proposals: np.ndarray) -> np.ndarray:
    """||m_k - m_{k-1}|| for k = 1..K, (K, batch), of proposals (K + 1, batch, action_dim)."""
    return np.linalg.norm(np.diff(proposals, axis=0), axis=-1)


def steps_used(proposals: np.ndarray, tolerance: float) -> np.ndarray:
    """The first step k >= 1 whose correction's norm is below the tolerance, else K, (batch,)."""
    small = correction_norms(proposals) < tolerance
    return np.where(small.any(0), small.argmax(0) + 1, len(small))


class RecordingActor:
    """An agent's actor, which keeps the observations it acts on; with the policy's noise if `rng` is given."""

    def __init__(self, agent: Agent, rng: np.random.Generator | None, bar: tqdm):
        self.actor, self.std, self.rng, self.bar = agent.actor, np.exp(agent.arrays()["log_std"]), rng, bar
        self.obs = []

    def mean(self, weights: list, obs: np.ndarray) -> np.ndarray:
        self.obs.append(obs)
        self.bar.update()
        m = self.actor.mean(weights, obs)
        return m if self.rng is None else m + self.std * self.rng.standard_normal(m.shape)


class AdaptiveActor:
    """An actor that leaves a state's refinement after the first correction smaller than the tolerance."""

    def __init__(self, actor: Actor, tolerance: float):
        self.actor, self.tolerance, self.steps = actor, tolerance, []

    def mean(self, weights: list, obs: np.ndarray) -> np.ndarray:
        proposals = with_start(self.actor.proposals(weights, obs))
        self.steps.append(steps_used(proposals, self.tolerance))
        return proposals[self.steps[-1], np.arange(len(obs))]


def run_episodes(agent: Agent, actor, seeds: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns and lengths of one episode per seed, the agent acting with `actor`."""
    agent = copy(agent)
    agent.actor = actor
    return refineppo.evaluate(agent, seeds)


def spread_evenly(lengths: np.ndarray, total: int) -> list[np.ndarray]:
    """Steps to take of each episode, evenly spaced: `total` altogether, as equal in number as the lengths allow."""
    chosen, left = [np.array([], int)] * len(lengths), total
    for rank, i in enumerate(np.argsort(lengths, kind="stable")):  # a short episode leaves its share to longer ones
        count = min(lengths[i], left // (len(lengths) - rank))
        chosen[i] = np.linspace(0, lengths[i] - 1, count).round().astype(int)
        left -= count
    return chosen


def record_states(policy: Policy, args: Args) -> tuple[np.ndarray, np.ndarray]:
    """Normalised observations (S, obs_dim) of 20 episodes, or more if they are short; and each one's episode, (S,)."""
    rng, episodes = np.random.default_rng(args.seed) if args.sample_actions else None, []
    with progress(desc=f"episodes of {policy.label}", unit=" steps") as bar:
        while sum(map(len, episodes)) < args.num_states:
            recorder = RecordingActor(policy.agent, rng, bar)
            seeds = refineppo.episode_seeds(args.seed, 2, len(episodes), count=MIN_EPISODES)
            _, lengths = run_episodes(policy.agent, recorder, seeds)
            episodes += [obs[:length] for obs, length in zip(np.stack(recorder.obs, axis=1), lengths)]
    chosen = spread_evenly(np.array([len(obs) for obs in episodes]), args.num_states)
    obs = np.concatenate([obs[steps] for obs, steps in zip(episodes, chosen)])
    return obs, np.repeat(np.arange(len(chosen)), [len(steps) for steps in chosen])


def continued_coefficients(schedule: str, depth: int) -> list[float]:
    """c_1, ..., c_2K: the policy's own K; past them uniform keeps 1, average keeps 1/K, inverse goes on with 1/k."""
    own = refineppo.refinement_coefficients(schedule, depth)
    return own + (own if schedule == "average" else refineppo.refinement_coefficients(schedule, 2 * depth)[depth:])


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


def ridge_r2(features: list[np.ndarray], target: np.ndarray, folds=SHUFFLED_FOLDS, groups=None) -> float:
    """Cross-validated R^2, mean over folds, of ridge regression (alpha 1) of target (S,) on standardised features."""
    model = make_pipeline(StandardScaler(), Ridge(alpha=1.0))
    with sklearn.config_context(assume_finite=True, skip_parameter_validation=True):  # a quarter of the time
        return cross_val_score(model, np.column_stack(features), target, groups=groups, cv=folds, scoring="r2").mean()


def delta_r2(own: list[np.ndarray], early: np.ndarray, target: np.ndarray, **folds) -> float:
    """What the early components' values (S, n) add to the R^2 of a component's next correction from its `own`."""
    return ridge_r2([*own, early], target, **folds) - ridge_r2(own, target, **folds)


def refinement_field(weights: list, obs: torch.Tensor, m: torch.Tensor) -> torch.Tensor:
    """f(s, m), (..., action_dim), of obs (..., obs_dim) and any proposal m (..., action_dim)."""
    *hidden, (w_out, b_out) = weights
    x = torch.cat([obs, m], dim=-1)
    for w, b in hidden:
        x = torch.tanh(x @ w + b)
    return x @ w_out + b_out


def step_jacobians(weights: list, obs: torch.Tensor, m: torch.Tensor, c: float) -> torch.Tensor:
    """d(m + c f(s, m)) / dm, exact, (S, action_dim, action_dim), of obs (S, obs_dim) and m (S, action_dim)."""
    jacobian = torch.func.vmap(torch.func.jacfwd(refinement_field, argnums=2), (None, 0, 0), chunk_size=1000)
    return torch.eye(m.shape[1], dtype=m.dtype) + c * jacobian(weights, obs, m)


def start_spread(weights: list, obs: torch.Tensor, starts: torch.Tensor, coefficients: list[float]) -> np.ndarray:
    """Root of the mean squared distance of m_k from its mean over the starts m_0 (R, S, action_dim), as a fraction of
    that of m_0, for k = 0..K, (K + 1, S). 0 at the end: the refinement forgets where it started."""
    spreads, m = [], starts
    for c in (0.0, *coefficients):
        m = torch.stack([m_r + c * refinement_field(weights, obs, m_r) for m_r in m])
        spreads.append((m - m.mean(0)).square().sum(-1).mean(0).sqrt())
    return torch.stack(spreads).div(spreads[0]).numpy()


def dynamics(agent: Agent, obs: np.ndarray, proposals: np.ndarray, seed: int) -> dict[str, dict[int, np.ndarray]]:
    """The refinement as a dynamical system: quantity -> step k -> its value in every state, (S,)."""
    weights = layers({name: p.double() for name, p in agent.params.items()}, "actor")
    obs, coefficients = torch.from_numpy(obs).double(), agent.actor.coefficients
    space = gym.spaces.Box(agent.low, agent.high, seed=seed)
    starts = torch.from_numpy(np.array([[space.sample() for _ in obs] for _ in range(STARTS)])).double()
    outside = ((proposals < agent.low) | (proposals > agent.high)).astype(float)
    norms, steps = correction_norms(proposals), range(1, len(proposals))
    singular_values, radii = {}, {}
    for k, c in zip(steps, progress(coefficients, desc="Jacobians")):
        jacobians = step_jacobians(weights, obs, torch.from_numpy(proposals[k - 1]), c).numpy()
        singular_values[k] = np.linalg.svd(jacobians, compute_uv=False)[:, 0]
        radii[k] = np.abs(np.linalg.eigvals(jacobians)).max(-1)
    return {
        "correction_norm": {k: norms[k - 1] for k in steps},
        "correction_ratio": {k: norms[k - 1] / np.maximum(norms[k - 2], 1e-12) for k in steps[1:]},
        "largest_singular_value": singular_values,
        "spectral_radius": radii,
        "spread_of_random_starts": dict(enumerate(start_spread(weights, obs, starts, coefficients))),
        "proposals_outside_bounds": {k: outside[k].max(-1) for k in steps},
        "components_outside_bounds": {k: outside[k].mean(-1) for k in steps},
    }


# --- Sections: their tables -------------------------------------------------------------------------------------------


def settling_rows(proposals: np.ndarray, names: list[str]) -> Rows:
    """Every e_{k,j}, in the order of e_{1,j}."""
    error = settling_error(proposals)
    order, _, _ = early_and_late(error)
    return [{"component": names[j], "rank": rank, "step": k, "error": error[k, j]}
            for rank, j in enumerate(order, start=1) for k in range(len(error))]  # fmt: skip


def transitions(proposals: np.ndarray, names: list[str]) -> Iterator[tuple[dict, np.ndarray, np.ndarray, np.ndarray]]:
    """Every regression: its row's key, own value (S,), early components' values (S, n), next correction (S,)."""
    _, early, late = early_and_late(settling_error(proposals))
    for j in late:
        for k in range(1, len(proposals) - 1):  # at k = 0 every input is zero
            key = {"component": names[j], "step_from": k, "step_to": k + 1}
            yield key, proposals[k][:, j], proposals[k][:, early], proposals[k + 1][:, j] - proposals[k][:, j]


def r2_rows(proposals: np.ndarray, names: list[str]) -> Rows:
    """The paper's delta R^2 of every late component and transition."""
    rows = []
    for key, own, early, target in transitions(proposals, names):
        baseline, augmented = ridge_r2([own], target), ridge_r2([own, early], target)
        rows.append(key | {"r2_baseline": baseline, "r2_augmented": augmented, "delta_r2": augmented - baseline})
    return rows


def r2_check_rows(proposals: np.ndarray, names: list[str], obs: np.ndarray, episodes: np.ndarray, seed: int) -> Rows:
    """Beside the paper's delta R^2: the middle 95 % of what early components shuffled across states give, folds of
    whole episodes (states of one episode resemble each other), and the observation as a feature of both models."""
    rows, rng = [], np.random.default_rng(seed)
    regressions = list(transitions(proposals, names))
    for key, own, early, target in progress(regressions, desc="shuffled R^2"):
        baseline = ridge_r2([own], target)
        shuffled = [ridge_r2([own, early[rng.permutation(len(own))]], target) - baseline for _ in range(SHUFFLES)]
        low, high = np.quantile(shuffled, (0.025, 0.975))
        paper = delta_r2([own], early, target)
        rows.append(key | {
            "delta_r2": paper,
            "shuffled_low": low,
            "shuffled_high": high,
            "above_shuffled": int(paper > high),
            "by_episode": delta_r2([own], early, target, folds=GroupKFold(FOLDS), groups=episodes),
            "given_observation": delta_r2([own, obs], early, target),
        })  # fmt: skip
    return rows


def return_columns(policy: Policy, actor, episodes: int) -> tuple[dict, np.ndarray]:
    """The return, acting with `actor` in the episodes of `refineppo_continuous.py --evaluate`; and their lengths."""
    args = replace(policy.args, final_eval_episodes=episodes)
    seeds = refineppo.evaluation_seeds(args, policy.global_step, final=True)
    returns, lengths = run_episodes(policy.agent, actor, seeds)
    mean, std = mean_and_std(returns)
    return {"return_mean": mean, "return_std": std, "length_mean": lengths.mean()}, lengths


def anytime_rows(policy: Policy, episodes: int) -> Rows:
    """Return of the deterministic policy a = m_k for k = 0..2K."""
    rows = []
    coefficients = continued_coefficients(policy.args.refinement_schedule, policy.args.refinement_depth)
    for k in progress(range(len(coefficients) + 1), desc=f"anytime, {policy.label}"):
        actor = copy(policy.agent.actor)
        actor.coefficients = coefficients[:k] or [0.0]  # m_0 = 0
        rows.append({"steps": k} | return_columns(policy, actor, episodes)[0])
    return rows


def adaptive_rows(policy: Policy, norms: np.ndarray, episodes: int) -> Rows:
    """Return against mean steps used, for tolerances at quantiles of the corrections' norms (K, S) before the last."""
    rows = []
    for quantile in progress(QUANTILES, desc=f"adaptive, {policy.label}"):
        tolerance = float(np.quantile(norms[:-1], quantile)) if quantile else 0.0  # 0: always all K steps
        actor = AdaptiveActor(policy.agent.actor, tolerance)
        columns, lengths = return_columns(policy, actor, episodes)
        used = [steps[:length] for steps, length in zip(np.stack(actor.steps, axis=1), lengths)]
        rows.append({"quantile": quantile, "tolerance": tolerance, "steps_mean": np.concatenate(used).mean()} | columns)
    return rows


def dynamics_rows(values: dict[str, dict[int, np.ndarray]]) -> Rows:
    """Median over states, and 10th and 90th percentile; of what is outside the bounds the mean instead."""
    rows = []
    for quantity, steps in values.items():
        centre = np.mean if "outside" in quantity else np.median
        for k, x in steps.items():
            low, high = np.quantile(x, (0.1, 0.9))
            rows.append({"quantity": quantity, "step": k, "value": centre(x), "q10": low, "q90": high})
    return rows


def training_rows(policy: Policy, settling: Rows, r2: Rows, dynamics: Rows) -> Rows:
    """e_k (mean over components), delta R^2 of the step to k (mean over late components), and the dynamics."""
    values = [("settling_error", row["step"], row["error"]) for row in settling]
    values += [("delta_r2", row["step_to"], row["delta_r2"]) for row in r2]
    values += [(row["quantity"], row["step"], row["value"]) for row in dynamics]
    means = {}
    for quantity, k, value in values:
        means.setdefault((quantity, k), []).append(value)
    run = {"seed": policy.args.seed, "global_step": policy.global_step}
    return [run | {"quantity": quantity, "step": k, "value": np.mean(x)} for (quantity, k), x in means.items()]


def analyse(policy: Policy, args: Args) -> dict[str, Rows]:
    """The tables of the sections, of one checkpoint."""
    obs, episodes = record_states(policy, args)
    proposals = with_start(policy.agent.actor.proposals(layers(policy.agent.arrays(), "actor"), obs)).astype(float)
    sections, names, tables = set(args.sections), policy.names, {}
    if sections & {"settling", "training"}:
        tables["settling_error"] = settling_rows(proposals, names)
    if sections & {"r2", "training"}:
        tables["delta_r2"] = r2_rows(proposals, names)
    if "r2" in sections:
        tables["delta_r2_checks"] = r2_check_rows(proposals, names, obs, episodes, args.seed)
    if "anytime" in sections:
        tables["anytime"] = anytime_rows(policy, args.episodes)
    if "adaptive" in sections:
        tables["adaptive"] = adaptive_rows(policy, correction_norms(proposals), args.episodes)
    if sections & {"dynamics", "training"}:
        tables["dynamics"] = dynamics_rows(dynamics(policy.agent, obs, proposals, args.seed))
    if "training" in sections:
        inputs = (tables[name] for name in ("settling_error", "delta_r2", "dynamics"))
        tables["training"] = training_rows(policy, *inputs)
    return {name: rows for name, rows in tables.items() if TABLES[name].section in sections and rows}


# --- Tables across checkpoints, and as text ---------------------------------------------------------------------------


class Table(NamedTuple):
    """Of a CSV: its section, the columns that name a row, and for printing the key that becomes columns of a value."""

    section: Section
    keys: tuple[str, ...]
    spread: tuple[str, str] | None = None


TABLES = {
    "settling_error": Table("settling", ("component", "step"), ("step", "error")),
    "delta_r2": Table("r2", ("component", "step_from", "step_to")),
    "delta_r2_checks": Table("r2", ("component", "step_from", "step_to")),
    "anytime": Table("anytime", ("steps",)),
    "adaptive": Table("adaptive", ("quantile",)),
    "dynamics": Table("dynamics", ("quantity", "step"), ("step", "value")),
    "training": Table("training", ("quantity", "step", "global_step"), ("global_step", "value")),
}


def differ_in_seed(policies: list[Policy]) -> bool:
    """Whether there are several checkpoints, each of another training seed."""
    return len({policy.args.seed for policy in policies}) == len(policies) > 1


def grouped(rows: Rows, *keys: str) -> dict[tuple, Rows]:
    """Rows by the values of `keys`, in the order of their first appearance."""
    groups = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def without(rows: Rows, *columns: str) -> Rows:
    return [{name: value for name, value in row.items() if name not in columns} for row in rows]


def pivot(rows: Rows, keys: tuple[str, ...], column: str, value: str) -> dict[str, dict]:
    """{label of the other keys: {column: value}}."""
    groups = grouped(rows, *(key for key in keys if key != column))
    return {" ".join(map(str, key)): {row[column]: row[value] for row in group} for key, group in groups.items()}


def across_seeds(rows: Rows, keys: tuple[str, ...]) -> Rows:
    """Mean and standard deviation (ddof 1) over checkpoints of every value column, and how many they are."""
    result = []
    for key, group in grouped(without(rows, "checkpoint", "seed"), *keys).items():
        statistics = {name: mean_and_std([row[name] for row in group]) for name in group[0] if name not in keys}
        columns = {f"{name}_{what}": x for name, both in statistics.items() for what, x in zip(("mean", "std"), both)}
        result.append(dict(zip(keys, key)) | {"seeds": len(group)} | columns)
    return result


def as_text(rows: Rows, table: Table) -> str:
    """A table of aligned columns."""
    if table.spread:
        shown = pivot(rows, table.keys, *table.spread)
        columns = sorted({column for row in shown.values() for column in row})
    else:
        shown = {" ".join(str(row[key]) for key in table.keys): row for row in rows}
        columns = [column for column in rows[0] if column not in {*table.keys, "checkpoint"}]
    lines = [["", *map(str, columns)]]
    lines += [[label, *(f"{row[c]:.4g}" if c in row else "" for c in columns)] for label, row in shown.items()]
    widths = [max(map(len, column)) for column in zip(*lines)]
    return "\n".join("  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]) for line in lines)


def as_csv(rows: Rows) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def as_summary(rows: Rows, table: Table) -> dict | Rows:
    """What one checkpoint's table comes to; of regressions the mean of every column over components and steps."""
    if table.section == "r2":
        values = without(rows, "checkpoint", *table.keys)
        return {name: np.mean([row[name] for row in values]) for name in values[0]}
    return pivot(rows, table.keys, *table.spread) if table.spread else without(rows, "checkpoint")


# --- Figures ----------------------------------------------------------------------------------------------------------

AROUND_ONE = ("correction_ratio", "largest_singular_value", "spectral_radius", "spread_of_random_starts")
PAST_K = {"uniform": "$c_k = 1$", "average": "$c_k = 1/K$", "inverse": "$c_k = 1/k$"}
STYLE = {"font.size": 7, "axes.titlesize": 7, "figure.titlesize": 7.5, "axes.formatter.useoffset": False}
LINE = {"markersize": 4, "linewidth": 1, "capsize": 2}
MARKERS = "os^Dv<>P*X"


class Figures:
    """Draws the tables; checkpoints of different seeds are averaged too, others (steps of a run) stand side by side."""

    def __init__(self, policies: list[Policy], episodes: int):
        args = policies[0].args
        labels = [policy.label for policy in policies]
        self.labels = {str(p.path): p.label if labels.count(p.label) == 1 else str(p.path) for p in policies}
        self.single, self.seeds, self.episodes = len(policies) == 1, differ_in_seed(policies), episodes
        self.depth, self.schedule = args.refinement_depth, args.refinement_schedule
        self.title = f"{args.env_id}, $K = {self.depth}$, {self.schedule} schedule"
        self.title += f", {policies[0].label}" if self.single else ""

    def axes(self, what: str, count: int, columns: int, width: float, height: float, **share) -> tuple[Figure, list]:
        """A titled figure of `count` axes, at most `columns` in a row, each of width x height inches."""
        rows = -(-count // columns)
        columns = -(-count // rows)
        figure = Figure((max(columns * width + 0.8, 3.8), rows * height + 0.6), layout="constrained", dpi=200)
        axes = figure.subplots(rows, columns, squeeze=False, **share).ravel().tolist()
        for axis in axes[count:]:
            axis.remove()
        figure.suptitle(f"{what}\n{self.title}")
        return figure, axes[:count]

    def heatmaps(self, what: str, rows: Rows, names: list[str], column: str, value: str, color: str, cell="{:.2f}"):
        """Component by `column`, a panel per checkpoint (with seeds also mean and std), all on one colour scale."""
        keys = ("component", column)
        panels = {self.labels[path]: pivot(group, keys, column, value)
                  for (path,), group in grouped(rows, "checkpoint").items()}  # fmt: skip
        if self.seeds:
            across = across_seeds(rows, keys)
            panels["mean over seeds"] = pivot(across, keys, column, f"{value}_mean")
            panels["std over seeds"] = pivot([row for row in across if row["seeds"] > 1], keys, column, f"{value}_std")
        columns = list(dict.fromkeys(row[column] for row in rows))
        norm = Normalize(min(0.0, *(row[value] for row in rows)), max(row[value] for row in rows))
        width, height = 0.34 * len(columns) + 0.2, 0.17 * len(names) + 0.6
        figure, axes = self.axes(what, len(panels), max(1, int(8 / width)), width, height, sharey=True)
        for axis, (title, panel) in zip(axes, panels.items()):
            matrix = np.array([[panel.get(name, {}).get(c, np.nan) for c in columns] for name in names])
            image = axis.imshow(matrix, cmap="cividis_r", norm=norm, aspect="auto")
            for (i, j), x in np.ndenumerate(matrix):
                text = "" if np.isnan(x) else cell.format(x)
                axis.text(j, i, text, color="white" if norm(x) > 0.5 else "black", ha="center", va="center", size=6)
            axis.set_xticks(range(len(columns)), columns)
            axis.set_yticks(range(len(names)), names)
            axis.set(xlabel=f"refinement {column}", title="" if self.single else title)
        figure.colorbar(image, ax=axes, label=color)
        return figure

    def curve(self, axis, rows: Rows, x: str, y: str, interval=None, label=None, **style):
        """y against x, with error bars to `interval(row)`; of seeds each one in grey, and their mean +- std."""
        groups = grouped(rows, "checkpoint")
        for i, ((path,), group) in enumerate(groups.items()):
            xs, ys = ([row[name] for row in group] for name in (x, y))
            error = np.abs(np.array([interval(row) for row in group]).T - ys) if interval and not self.seeds else None
            look = {"color": "0.7"} if self.seeds else {
                "color": colormaps["cividis"](0.85 * i / len(groups)), "marker": MARKERS[i % len(MARKERS)],
                "label": label if self.single else self.labels[path]}  # fmt: skip
            axis.errorbar(xs, ys, error, **LINE | look | style)
        if self.seeds:
            xs, ys = (np.array([[row[name] for row in group] for group in groups.values()]) for name in (x, y))
            look = {"color": "black", "marker": "o", "label": label}
            axis.errorbar(xs.mean(0), ys.mean(0), ys.std(0, ddof=1), **LINE | look | style)

    def returns(self, axis, rows: Rows, x: str, label: str | None = None):
        """Return against x; the error bars are standard errors over episodes, or with seeds their std."""

        def interval(row: dict) -> tuple[float, float]:
            half = row["return_std"] / self.episodes**0.5
            return row["return_mean"] - half, row["return_mean"] + half

        self.curve(axis, rows, x, "return_mean", interval, label)
        spread = "std over seeds" if self.seeds else f"standard error of {self.episodes} episodes"
        axis.set_ylabel(f"return (mean, {spread})")

    def legend(self, figure: Figure, axis):
        """One legend below all axes."""
        handles, labels = axis.get_legend_handles_labels()
        if len(labels) > 1:
            columns = int(figure.get_figwidth() / 1.3)
            figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)

    def settling(self, tables: dict[str, Rows]) -> dict[str, Figure]:
        """Figure 3a, with a row for a correction that never changes, so that m_k only grows with the schedule."""
        rows, constant = tables["settling_error"], "(constant $f$)"
        done = np.cumsum([0, *refineppo.refinement_coefficients(self.schedule, self.depth)])
        error = pivot(across_seeds(rows, ("component", "step")), ("component", "step"), "step", "error_mean")
        names = [*sorted(error, key=lambda name: error[name][1]), constant]
        rows = without(rows, "rank")
        rows += [{"checkpoint": path, "component": constant, "step": k, "error": 1 - c / done[-1]}
                 for path in self.labels for k, c in enumerate(done)]  # fmt: skip
        what, color = "Remaining refinement by action component", "$e_{k,j}$ (dark: far from its end)"
        return {"settling_error": self.heatmaps(what, rows, names, "step", "error", color)}

    def r2(self, tables: dict[str, Rows]) -> dict[str, Figure]:
        """Figure 3b, and its numbers beside the three checks."""
        rows = [row | {"transition": f"{row['step_from']}→{row['step_to']}"} for row in tables["delta_r2"]]
        names = list(dict.fromkeys(row["component"] for row in rows))
        what = "What early components add to the prediction of late corrections"
        color = r"$\Delta R^2$ (dark: large)"
        heatmap = self.heatmaps(what, rows, names, "transition", "delta_r2", color, "{:.3f}")
        panels = grouped(tables["delta_r2_checks"], "checkpoint", "step_from")
        columns, height = min(4, self.depth - 1), 0.15 * max(map(len, panels.values())) + 0.9
        figure, axes = self.axes(r"$\Delta R^2$ and three checks", len(panels), columns, 1.8, height, sharex=True)
        for axis, ((path, k), group) in zip(axes, panels.items()):
            x, y = {name: [row[name] for row in group] for name in group[0]}, np.arange(len(group))
            axis.axvline(0, color="0.6", linewidth=0.7)
            axis.hlines(y, x["shuffled_low"], x["shuffled_high"], "0.75", linewidth=6, label="shuffled (95 %)")
            axis.plot(x["delta_r2"], y, "ko", markersize=3.5, label="the paper's")
            axis.plot(x["by_episode"], y, "ks", markersize=6.5, fillstyle="none", label="folds of whole episodes")
            axis.plot(x["given_observation"], y, "kx", markersize=4.5, label="observation in both models")
            axis.set_yticks(y, x["component"])
            axis.set(ylim=(len(y) - 0.5, -0.5), xlabel=r"$\Delta R^2$")
            axis.locator_params(axis="x", nbins=3)
            axis.set_title(f"{k}→{k + 1}" if self.single else f"{self.labels[path]}\n{k}→{k + 1}")
        self.legend(figure, axes[0])
        return {"delta_r2": heatmap, "delta_r2_checks": figure}

    def anytime(self, tables: dict[str, Rows]) -> dict[str, Figure]:
        figure, (axis,) = self.axes("Return of the policy stopped after $k$ steps", 1, 1, 3.4, 2.2)
        self.returns(axis, tables["anytime"], "steps")
        axis.axvline(self.depth, color="0.5", linestyle=":")
        axis.set_xlabel(f"steps $k$ (dotted: $K$; past it {PAST_K[self.schedule]})")
        self.legend(figure, axis)
        return {"anytime": figure}

    def adaptive(self, tables: dict[str, Rows]) -> dict[str, Figure]:
        figure, (axis,) = self.axes("Return if refinement stops at a small correction", 1, 1, 3.4, 2.4)
        self.returns(axis, tables["adaptive"], "steps_mean", "stopped below a tolerance")
        fixed = [row for row in tables.get("anytime", []) if 1 <= row["steps"] <= self.depth]
        if fixed and (self.single or self.seeds):
            look = {"label": "the same number in every state", "linestyle": ":", "fillstyle": "none"}
            self.curve(axis, fixed, "steps", "return_mean", **look)
        tolerance = max(row["tolerance"] for row in tables["adaptive"])
        axis.set_xlabel(f"mean steps used (tolerance from 0 at $K$ to {tolerance:.2g} on the left)")
        self.legend(figure, axis)
        return {"adaptive": figure}

    def dynamics(self, tables: dict[str, Rows]) -> dict[str, Figure]:
        quantities = grouped(tables["dynamics"], "quantity")
        spread = "mean and std over seeds of the medians" if self.seeds else "median and 10 to 90 % of states"
        figure, axes = self.axes(f"Dynamics of the refinement ({spread})", len(quantities), 4, 1.65, 1.5)
        for axis, ((quantity,), rows) in zip(axes, quantities.items()):
            fraction = "outside" in quantity
            self.curve(axis, rows, "step", "value", None if fraction else lambda row: (row["q10"], row["q90"]))
            if quantity in AROUND_ONE:
                axis.axhline(1, color="0.5", linestyle=":")
            axis.set(title=quantity.replace("_", " "), xlabel="step $k$", xlim=(-0.3, self.depth + 0.3))
            if fraction:
                axis.set(ylabel="fraction", ylim=(-0.05, 1.05))
        self.legend(figure, axes[0])
        return {"dynamics": figure}

    def training(self, tables: dict[str, Rows]) -> dict[str, Figure]:
        quantities, seeds = grouped(tables["training"], "quantity"), len(grouped(tables["training"], "seed")) > 1
        what = "Refinement through training" + " (mean and std over seeds)" * seeds
        figure, axes = self.axes(what, len(quantities), 3, 2.0, 1.4)
        for axis, ((quantity,), rows) in zip(axes, quantities.items()):
            for (k,), of_step in grouped(rows, "step").items():
                points = sorted(across_seeds(of_step, TABLES["training"].keys), key=lambda point: point["global_step"])
                x, y, std = zip(*((p["global_step"], p["value_mean"], p["value_std"]) for p in points))
                axis.errorbar(x, y, std if seeds else None, label=f"$k = {k}$", marker=MARKERS[k % len(MARKERS)],
                              color=colormaps["cividis"](0.85 * k / self.depth), **LINE)  # fmt: skip
            axis.set(title=quantity.replace("_", " "), xlabel="training step")
        self.legend(figure, axes[0])
        return {"training": figure}


def as_png(figure: Figure) -> bytes:
    image = io.BytesIO()
    figure.savefig(image, format="png")
    return image.getvalue()


# --- Main -------------------------------------------------------------------------------------------------------------


def main():
    args = tyro.cli(Args, description=__doc__)
    policies = check(args)
    refineppo.limit_threads(policies[0].args)  # as in the run, for the same returns
    several, tables = len(policies) > 1, {}
    for policy in tqdm(policies, desc="checkpoints", disable=None if several else True):
        for name, rows in analyse(policy, args).items():
            tables.setdefault(name, []).extend({"checkpoint": str(policy.path)} | row for row in rows)

    facts = ("env_id", "seed", "refinement_depth", "refinement_schedule")
    files, summary = {}, {"flags": asdict(args), "checkpoints": {
        str(policy.path): {"global_step": policy.global_step} | {name: getattr(policy.args, name) for name in facts}
        for policy in policies}}  # fmt: skip
    for name, rows in tables.items():
        table = TABLES[name]
        for (path,), group in grouped(rows, "checkpoint").items():
            summary.setdefault(table.section, {}).setdefault(path, {})[name] = as_summary(group, table)
        for (whose,), group in grouped(rows, "seed" if name == "training" else "checkpoint").items():
            print(f"\n{name}{f' of {whose}' if several else ''}\n{as_text(group, table)}")
        files[f"{name}.csv"] = as_csv(rows if several else without(rows, "checkpoint"))
        if differ_in_seed(policies) or name == "training" and len(grouped(rows, "seed")) > 1:
            files[f"{name}_across_seeds.csv"] = as_csv(across_seeds(rows, table.keys))
    with rc_context(STYLE):
        figures = Figures(policies, args.episodes)
        for section in dict.fromkeys(TABLES[name].section for name in tables):
            files |= {f"{name}.png": as_png(figure) for name, figure in getattr(figures, section)(tables).items()}
    files["summary.json"] = json.dumps(summary, indent=2, default=str).encode()
    try:
        for name, data in files.items():
            refineppo.write_atomically(args.folder / name, data)
    except OSError as error:
        refuse(f"cannot write to the output folder {args.folder}: {error.strerror}")
    if len(policies[0].names) == 1 and {"r2", "training"} & set(args.sections):
        print("\nan action has one component, which no other can inform: there is no delta R^2")
    print(f"\nthe tables, figures and summary.json are in {args.folder}")


if __name__ == "__main__":
    main()
