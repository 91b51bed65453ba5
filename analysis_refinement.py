"""What refinement does in a trained policy, from its checkpoints: the paper's two analyses, and what follows from them.

    python analysis_refinement.py --checkpoint runs/.../best.pt
    python analysis_refinement.py --checkpoint runs/seed-*/best.pt --sections settling r2 anytime adaptive dynamics
    python analysis_refinement.py --checkpoint runs/.../step_*.pt --sections training

settling  how far each action component still is from its end after k steps: e_{k,j}, figure 3a of the paper
r2        whether early components predict the next correction of late ones: delta R^2, figure 3b, beside three checks:
          early components shuffled across states, folds of whole episodes, the observation added to both models
anytime   return of the policy stopped after k = 0..2K steps
adaptive  return and mean number of steps if a state's refinement stops once its correction is small
dynamics  corrections, Jacobians of one step, the spread left of random starts, proposals outside the action bounds
training  settling, r2 and dynamics against the training step, from several checkpoints of a run (`--save-every`)

Each section writes CSVs, a figure and its part of summary.json into --out-dir, all at the end. Several checkpoints (seeds
of one setting) add a `checkpoint` column, and `*_across_seeds.csv` with the mean and standard deviation (ddof 1).
"""

import csv
import io
import json
import tempfile
from contextlib import suppress
from copy import copy
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Literal

import gymnasium as gym
import mujoco
import numpy as np
import sklearn
import torch
import tyro
from matplotlib import colormaps
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from sklearn.linear_model import Ridge
from sklearn.model_selection import GroupKFold, KFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from tqdm import tqdm

import refineppo_continuous as refineppo
from refineppo_continuous import Actor, Agent, episode_seeds, evaluate, layers, mean_and_std, refuse, write_atomically

FOLDS, MIN_EPISODES, SHUFFLES, STARTS = 5, 20, 50, 8
SHUFFLED_FOLDS = KFold(FOLDS, shuffle=True, random_state=0)
QUANTILES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the corrections' sizes: the tolerances of `adaptive`

Section = Literal["settling", "r2", "anytime", "adaptive", "dynamics", "training"]


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
    episodes: int = 8
    """episodes behind each return of `anytime` and `adaptive`"""
    seed: int = 0
    """seed of the recorded episodes, the shuffles and the random starts"""
    out_dir: Path | None = None
    """folder of the results; default analysis/ beside the first checkpoint"""


@dataclass
class Policy:
    """A saved policy, and the states (S, obs_dim, normalised) whose refinement is analysed."""

    path: Path
    agent: Agent
    global_step: int
    states: np.ndarray | None = None
    episodes: np.ndarray | None = None  # (S,), the episode of each state

    @property
    def label(self) -> str:
        return f"seed {self.agent.args.seed}, step {self.global_step:,}"

    def proposals(self) -> np.ndarray:
        """m_0, ..., m_K of the recorded states, (K + 1, S, action_dim)."""
        weights = layers(self.agent.arrays(), "actor")
        return with_start(self.agent.actor.proposals(weights, self.states)).astype(np.float64)


# --- Input ------------------------------------------------------------------------------------------------------------


def load_policy(path: Path) -> Policy:
    """A checkpoint's policy on the CPU, or a refusal."""
    ppo_flags = {field.name for field in fields(refineppo.Args)} - {"refinement_depth", "refinement_schedule"}
    with suppress(Exception):  # load_checkpoint says what is wrong with a file that cannot be read
        if set(torch.load(path, map_location="cpu", weights_only=True)["args"]) == ppo_flags:
            refuse(f"{path} is a checkpoint of PPO, which has no refinement to analyse")
    saved = refineppo.load_checkpoint(path)
    try:
        args = refineppo.Args(**saved["args"] | {"cuda": False, "track": False, "capture_video": False})
        agent = Agent(*refineppo.check_args(args), args)
        agent.load(saved)
        policy = Policy(path, agent, int(saved["global_step"]))
    except Exception:  # the right flags, but parts missing or of other shapes
        refuse(f"{path} is damaged: it does not hold a policy for its task")
    if not all(p.isfinite().all() for part in agent.tensors().values() for p in part.values()):
        refuse(f"{path} holds parameters that are not finite")
    if args.refinement_depth == 1:
        refuse(f"{path} has refinement depth K = 1: one step, so that there is no refinement to analyse")
    return policy


def check(args: Args) -> list[Policy]:
    """Refuse what cannot be analysed before any work starts; return the policies. Makes the output folder."""
    for name, least in (("num_states", 2 * FOLDS), ("episodes", 2), ("seed", 0)):
        if getattr(args, name) < least:
            reason = f", two for each of the {FOLDS} folds" if name == "num_states" else ""
            refuse(f"--{name.replace('_', '-')} must be at least {least}{reason}, not {getattr(args, name)}")
    if not args.checkpoint or not args.sections:
        refuse("--checkpoint and --sections need at least one value each")
    if len({path.resolve() for path in args.checkpoint}) < len(args.checkpoint):
        refuse("a checkpoint is named twice")
    policies = [load_policy(path) for path in args.checkpoint]
    settings = [(a.env_id, a.refinement_depth, a.refinement_schedule) for a in (p.agent.args for p in policies)]
    for policy, setting in zip(policies, settings):
        if setting != settings[0]:
            refuse(f"the checkpoints must share task, depth and schedule: {policies[0].path} has {settings[0]}, "
                   f"{policy.path} has {setting}")  # fmt: skip
    if set(args.sections) == {"r2"} and len(policies[0].agent.low) == 1:
        refuse(f"{settings[0][0]} has a one-dimensional action, so that no component can inform another: no delta R^2")
    steps = {(policy.agent.args.seed, policy.global_step) for policy in policies}
    if "training" in args.sections and any([seed for seed, _ in steps].count(seed) < 2 for seed, _ in steps):
        refuse("--sections training needs checkpoints of a run at two training steps or more (train with --save-every)")
    out_dir = output_folder(args)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out_dir).close()
    except OSError as error:
        refuse(f"cannot write to the output folder {out_dir}: {error.strerror}")
    return policies


def output_folder(args: Args) -> Path:
    return args.out_dir or args.checkpoint[0].parent / "analysis"


def differ_in_seed(policies: list[Policy]) -> bool:
    """Whether there are several checkpoints, each of another training seed."""
    return len({policy.agent.args.seed for policy in policies}) == len(policies) > 1


def component_names(env: gym.Env) -> list[str]:
    """Of each action component: the joint that its actuator drives, or the actuator's name, or a0, a1, ...; unique."""
    model, action_dim = getattr(env.unwrapped, "model", None), env.action_space.shape[0]
    names = [""] * action_dim
    if isinstance(model, mujoco.MjModel) and model.nu == action_dim:
        joint_driven = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        names = [joint_driven[i] and model.joint(model.actuator_trnid[i, 0]).name or model.actuator(i).name
                 for i in range(action_dim)]  # fmt: skip
    return [name and (name if names.count(name) == 1 else f"{name} (a{i})") or f"a{i}" for i, name in enumerate(names)]


# --- States and returns -----------------------------------------------------------------------------------------------


def with_start(proposals: list[np.ndarray]) -> np.ndarray:
    """m_0 = 0, m_1, ..., (K + 1, batch, action_dim), from m_1, ..."""
    return np.stack([np.zeros_like(proposals[0]), *proposals])


class RecordingActor:
    """The actor of `agent`, which keeps the observations that it acts on; with noise if `rng` is given."""

    def __init__(self, agent: Agent, rng: np.random.Generator | None, bar: tqdm):
        self.actor, self.rng, self.bar, self.obs = agent.actor, rng, bar, []
        self.std = agent.params["log_std"].exp().numpy()

    def mean(self, weights: list, obs: np.ndarray) -> np.ndarray:
        self.obs.append(obs)
        self.bar.update()
        m = self.actor.mean(weights, obs)
        return m if self.rng is None else m + self.std * self.rng.standard_normal(m.shape)


class AdaptiveActor:
    """The actor, which leaves a state's refinement at the first correction smaller than the tolerance."""

    def __init__(self, actor: Actor, tolerance: float):
        self.actor, self.tolerance, self.steps = actor, tolerance, []

    def mean(self, weights: list, obs: np.ndarray) -> np.ndarray:
        proposals = with_start(self.actor.proposals(weights, obs))
        self.steps.append(steps_used(proposals, self.tolerance))
        return proposals[self.steps[-1], np.arange(len(obs))]


def with_actor(agent: Agent, actor) -> Agent:
    """The same agent, acting with another actor."""
    agent = copy(agent)
    agent.actor = actor
    return agent


def correction_norms(proposals: np.ndarray) -> np.ndarray:
    """||m_k - m_{k-1}|| for k = 1..K, (K, batch), of proposals (K + 1, batch, action_dim)."""
    return np.linalg.norm(np.diff(proposals, axis=0), axis=-1)


def steps_used(proposals: np.ndarray, tolerance: float) -> np.ndarray:
    """The first step k >= 1 whose correction's norm is below the tolerance, else K, (batch,)."""
    small = correction_norms(proposals) < tolerance
    return np.where(small.any(0), small.argmax(0) + 1, len(small))


def spread_evenly(lengths: np.ndarray, total: int) -> list[np.ndarray]:
    """Which steps to take of each episode, evenly spaced: `total` altogether, as equal in number as lengths allow."""
    chosen, left = [np.array([], int)] * len(lengths), total
    for rank, i in enumerate(np.argsort(lengths, kind="stable")):  # short episodes leave their share to longer ones
        count = min(lengths[i], left // (len(lengths) - rank))
        chosen[i] = np.linspace(0, lengths[i] - 1, count).round().astype(int)
        left -= count
    return chosen


def record_states(policy: Policy, num_states: int, seed: int, sample_actions: bool):
    """Run at least 20 episodes, and more until they hold `num_states` steps; keep that many, spread over all."""
    rng, episodes = np.random.default_rng(seed) if sample_actions else None, []
    with tqdm(desc=f"episodes of {policy.label}", unit=" steps", disable=None, leave=False) as bar:
        while sum(map(len, episodes)) < num_states:
            recorder = RecordingActor(policy.agent, rng, bar)
            seeds = episode_seeds(seed, 2, len(episodes), count=MIN_EPISODES)
            _, lengths = evaluate(with_actor(policy.agent, recorder), seeds)
            episodes += [obs[:length] for obs, length in zip(np.stack(recorder.obs, axis=1), lengths)]
    chosen = spread_evenly(np.array([len(obs) for obs in episodes]), num_states)
    policy.states = np.concatenate([obs[steps] for obs, steps in zip(episodes, chosen)])
    policy.episodes = np.repeat(np.arange(len(chosen)), [len(steps) for steps in chosen])


def continued_coefficients(schedule: str, depth: int) -> list[float]:
    """c_1, ..., c_2K: the policy's own K; past them uniform keeps 1, average keeps 1/K, inverse goes on with 1/k."""
    own = refineppo.refinement_coefficients(schedule, depth)
    doubled = refineppo.refinement_coefficients(schedule, 2 * depth)
    return own + ([own[-1]] * depth if schedule == "average" else doubled[depth:])


# --- Quantities -------------------------------------------------------------------------------------------------------


def settling_error(proposals: np.ndarray) -> np.ndarray:
    """e_{k,j} = E|m_K,j - m_k,j| / (E|m_K,j| + eps), (K + 1, action_dim), of proposals (K + 1, S, action_dim)."""
    last = proposals[-1]
    return np.abs(last - proposals).mean(1) / (np.abs(last).mean(0) + 1e-8)


def early_and_late(error: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Components in the order of e_{1,j}, the earliest and the latest of them: five, or half of fewer than ten."""
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


def refine_field(weights: list, obs: torch.Tensor, m: torch.Tensor) -> torch.Tensor:
    """f(s, m), (..., action_dim), of obs (..., obs_dim) and m (..., action_dim), from any proposal m."""
    *hidden, (w_out, b_out) = weights
    x = torch.cat([obs, m], dim=-1)
    for w, b in hidden:
        x = torch.tanh(x @ w + b)
    return x @ w_out + b_out


def step_jacobians(weights: list, obs: torch.Tensor, m: torch.Tensor, c: float) -> torch.Tensor:
    """d(m + c f(s, m)) / dm, (S, action_dim, action_dim), exact, at obs (S, obs_dim) and m (S, action_dim)."""
    jacobian = torch.func.vmap(torch.func.jacfwd(refine_field, argnums=2), in_dims=(None, 0, 0), chunk_size=1000)
    return torch.eye(m.shape[1], dtype=m.dtype) + c * jacobian(weights, obs, m)


def start_spread(weights: list, obs: torch.Tensor, starts: torch.Tensor, coefficients: list[float]) -> np.ndarray:
    """Spread over the starts (R, S, action_dim) of m_k for k = 0..K, (K + 1, S), as a fraction of that of m_0.

    The spread is the root of the mean squared distance from the mean over starts. 0: the end forgets the start.
    """
    spreads, m = [], starts
    for c in (0.0, *coefficients):
        m = torch.stack([m_r + c * refine_field(weights, obs, m_r) for m_r in m])
        spreads.append((m - m.mean(0)).square().sum(-1).mean(0).sqrt())
    return torch.stack(spreads).div(spreads[0]).numpy()


def dynamics(policy: Policy, proposals: np.ndarray, seed: int) -> dict[str, dict[int, np.ndarray]]:
    """Quantities of the refinement as a dynamical system: name -> step k -> value in every state, (S,)."""
    agent = policy.agent
    weights = layers({name: p.double() for name, p in agent.params.items()}, "actor")
    obs, coefficients = torch.from_numpy(policy.states).double(), agent.actor.coefficients
    space = gym.spaces.Box(agent.low, agent.high, seed=seed)
    starts = torch.from_numpy(np.array([[space.sample() for _ in obs] for _ in range(STARTS)])).double()
    norms = correction_norms(proposals)
    outside = (proposals < agent.low) | (proposals > agent.high)
    values = {name: {} for name in ("correction_norm", "correction_ratio", "singular_value", "spectral_radius")}
    for k, c in enumerate(tqdm(coefficients, desc="Jacobians", disable=None, leave=False), start=1):
        jacobians = step_jacobians(weights, obs, torch.from_numpy(proposals[k - 1]), c).numpy()
        values["correction_norm"][k] = norms[k - 1]
        if k > 1:
            values["correction_ratio"][k] = norms[k - 1] / np.maximum(norms[k - 2], 1e-12)
        values["singular_value"][k] = np.linalg.svd(jacobians, compute_uv=False)[:, 0]
        values["spectral_radius"][k] = np.abs(np.linalg.eigvals(jacobians)).max(-1)
    values["start_spread"] = dict(enumerate(start_spread(weights, obs, starts, coefficients)))
    values["outside_bounds"] = {k: outside[k].any(-1) for k in range(1, len(outside))}
    values["outside_bounds_components"] = {k: outside[k].mean(-1) for k in range(1, len(outside))}
    return values


# --- Sections: their tables, as lists of rows -------------------------------------------------------------------------


def settling_rows(proposals: np.ndarray, names: list[str]) -> list[dict]:
    """Every e_{k,j}, in the order of e_{1,j}."""
    error = settling_error(proposals)
    order, _, _ = early_and_late(error)
    return [{"component": names[j], "rank": rank, "step": k, "error": error[k, j]}
            for rank, j in enumerate(order, start=1) for k in range(len(error))]  # fmt: skip


def transitions(proposals: np.ndarray, names: list[str]):
    """Every regression: (key of its row, own value (S,), early components' values (S, n), next correction (S,))."""
    _, early, late = early_and_late(settling_error(proposals))
    for j in late:
        for k in range(1, len(proposals) - 1):  # at k = 0 every input is zero
            key = {"component": names[j], "step_from": k, "step_to": k + 1}
            yield key, proposals[k][:, j], proposals[k][:, early], proposals[k + 1][:, j] - proposals[k][:, j]


def r2_rows(proposals: np.ndarray, names: list[str]) -> list[dict]:
    """The paper's delta R^2 of every late component and transition."""
    rows = []
    for key, own, early, target in transitions(proposals, names):
        baseline, augmented = ridge_r2([own], target), ridge_r2([own, early], target)
        rows.append(key | {"r2_baseline": baseline, "r2_augmented": augmented, "delta_r2": augmented - baseline})
    return rows


def r2_check_rows(policy: Policy, proposals: np.ndarray, names: list[str], seed: int) -> list[dict]:
    """Beside the paper's delta R^2: the middle 95 % of what early components shuffled across states give, folds of
    whole episodes (states of one episode resemble each other), and the observation as a feature of both models."""
    rows, rng = [], np.random.default_rng(seed)
    cells = list(transitions(proposals, names))
    for key, own, early, target in tqdm(cells, desc="shuffled R^2", disable=None, leave=False):
        baseline = ridge_r2([own], target)
        shuffled = [ridge_r2([own, early[rng.permutation(len(own))]], target) - baseline for _ in range(SHUFFLES)]
        low, high = np.quantile(shuffled, (0.025, 0.975))
        by_episode = delta_r2([own], early, target, folds=GroupKFold(FOLDS), groups=policy.episodes)
        rows.append(key | {"delta_r2": delta_r2([own], early, target), "shuffled_low": low, "shuffled_high": high,
                           "by_episode": by_episode,
                           "given_observation": delta_r2([own, policy.states], early, target)})  # fmt: skip
    return rows


def return_columns(agent: Agent, actor, seeds: list[int]) -> tuple[dict, np.ndarray]:
    """Return over the episodes of `seeds`, acting with `actor`; and the episodes' lengths."""
    returns, lengths = evaluate(with_actor(agent, actor), seeds)
    mean, std = mean_and_std(returns)
    return {"return_mean": mean, "return_std": std, "length_mean": lengths.mean()}, lengths


def final_seeds(policy: Policy, episodes: int) -> list[int]:
    """The seeds of `refineppo_continuous.py --evaluate`: k = K gives its returns."""
    args = replace(policy.agent.args, final_eval_episodes=episodes)
    return refineppo.evaluation_seeds(args, policy.global_step, final=True)


def anytime_rows(policy: Policy, episodes: int) -> list[dict]:
    """Return of the deterministic policy a = m_k for k = 0..2K."""
    args, rows = policy.agent.args, []
    coefficients = continued_coefficients(args.refinement_schedule, args.refinement_depth)
    for k in tqdm(range(len(coefficients) + 1), desc=f"anytime, {policy.label}", disable=None, leave=False):
        actor = copy(policy.agent.actor)
        actor.coefficients = coefficients[:k] or [0.0]  # m_0 = 0
        rows.append({"steps": k} | return_columns(policy.agent, actor, final_seeds(policy, episodes))[0])
    return rows


def adaptive_rows(policy: Policy, norms: np.ndarray, episodes: int) -> list[dict]:
    """Return against mean steps used, for tolerances at quantiles of the corrections' norms (K, S) before the last."""
    rows = []
    for quantile in tqdm(QUANTILES, desc=f"adaptive, {policy.label}", disable=None, leave=False):
        tolerance = float(np.quantile(norms[:-1], quantile)) if quantile else 0.0  # 0: all K steps
        actor = AdaptiveActor(policy.agent.actor, tolerance)
        columns, lengths = return_columns(policy.agent, actor, final_seeds(policy, episodes))
        used = np.concatenate([steps[:length] for steps, length in zip(np.stack(actor.steps, axis=1), lengths)])
        rows.append({"quantile": quantile, "tolerance": tolerance, "steps_mean": used.mean()} | columns)
    return rows


def dynamics_rows(values: dict[str, dict[int, np.ndarray]]) -> list[dict]:
    """Median over states, and 10th and 90th percentile; of what is outside the bounds the mean instead."""
    rows = []
    for quantity, steps in values.items():
        centre = np.mean if quantity.startswith("outside") else np.median
        for k, x in steps.items():
            low, high = np.quantile(x, (0.1, 0.9))
            rows.append({"quantity": quantity, "step": k, "value": centre(x), "q10": low, "q90": high})
    return rows


def training_rows(policy: Policy, tables: dict[str, list[dict]]) -> list[dict]:
    """e_k (mean over components), delta R^2 of the step to k (mean over late components), and the dynamics."""
    values = {}
    for row in tables["settling_error"]:
        values.setdefault(("settling_error", row["step"]), []).append(row["error"])
    for row in tables["delta_r2"]:
        values.setdefault(("delta_r2", row["step_to"]), []).append(row["delta_r2"])
    for row in tables["dynamics"]:
        values[row["quantity"], row["step"]] = [row["value"]]
    run = {"seed": policy.agent.args.seed, "global_step": policy.global_step}
    return [run | {"quantity": q, "step": k, "value": float(np.mean(x))} for (q, k), x in values.items()]


def analyse(policy: Policy, names: list[str], args: Args) -> dict[str, list[dict]]:
    """Every table that the sections need, of one checkpoint."""
    record_states(policy, args.num_states, args.seed, args.sample_actions)
    sections, proposals, tables = set(args.sections), policy.proposals(), {}
    if sections & {"settling", "training"}:
        tables["settling_error"] = settling_rows(proposals, names)
    if sections & {"r2", "training"}:
        tables["delta_r2"] = r2_rows(proposals, names)
    if "r2" in sections:
        tables["delta_r2_checks"] = r2_check_rows(policy, proposals, names, args.seed)
    if "anytime" in sections:
        tables["anytime"] = anytime_rows(policy, args.episodes)
    if "adaptive" in sections:
        tables["adaptive"] = adaptive_rows(policy, correction_norms(proposals), args.episodes)
    if sections & {"dynamics", "training"}:
        tables["dynamics"] = dynamics_rows(dynamics(policy, proposals, args.seed))
    if "training" in sections:
        tables["training"] = training_rows(policy, tables)
    return {name: rows for name, rows in tables.items() if TABLES[name].section in sections and rows}


# --- Tables across checkpoints, and as text ---------------------------------------------------------------------------


@dataclass
class Table:
    """Of a CSV: its section, the columns that name a row, and how it is shown: one of its columns spread out."""

    section: Section
    keys: tuple[str, ...]
    spread: tuple[str, str] | None = None  # (the key that becomes columns, the value shown)


TABLES = {
    "settling_error": Table("settling", ("component", "step"), ("step", "error")),
    "delta_r2": Table("r2", ("component", "step_from", "step_to")),
    "delta_r2_checks": Table("r2", ("component", "step_from", "step_to")),
    "anytime": Table("anytime", ("steps",)),
    "adaptive": Table("adaptive", ("quantile",)),
    "dynamics": Table("dynamics", ("quantity", "step"), ("step", "value")),
    "training": Table("training", ("quantity", "step", "global_step"), ("global_step", "value")),
}


def grouped(rows: list[dict], *keys: str) -> dict[tuple, list[dict]]:
    """Rows by the values of `keys`, in the order of their first appearance."""
    groups = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def pivot(rows: list[dict], index: tuple[str, ...], column: str, value: str) -> dict[str, dict]:
    """{row label: {column label: value}}."""
    return {" ".join(map(str, key)): {row[column]: row[value] for row in group}
            for key, group in grouped(rows, *index).items()}  # fmt: skip


def across_seeds(rows: list[dict], keys: tuple[str, ...]) -> list[dict]:
    """Mean and standard deviation (ddof 1) over checkpoints of every value column, and of how many seeds."""
    values = [name for name in rows[0] if name not in {*keys, "checkpoint", "seed"}]
    result = []
    for key, group in grouped(rows, *keys).items():
        result.append(dict(zip(keys, key)) | {"seeds": len(group)})
        for name in values:
            result[-1][f"{name}_mean"], result[-1][f"{name}_std"] = mean_and_std([row[name] for row in group])
    return result


def as_text(rows: list[dict], table: Table) -> str:
    """A table of aligned columns."""
    if table.spread:
        column, value = table.spread
        shown = pivot(rows, tuple(key for key in table.keys if key != column), column, value)
    else:
        shown = {" ".join(str(row[key]) for key in table.keys):
                 {k: v for k, v in row.items() if k not in {*table.keys, "checkpoint"}} for row in rows}  # fmt: skip
    columns = list(dict.fromkeys(name for row in shown.values() for name in row))
    lines = [["", *map(str, columns)]]
    lines += [[label, *(f"{row[c]:.4g}" if c in row else "" for c in columns)] for label, row in shown.items()]
    widths = [max(map(len, column)) for column in zip(*lines)]
    return "\n".join("  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]) for line in lines)


def as_csv(rows: list[dict]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


# --- Figures ----------------------------------------------------------------------------------------------------------

QUANTITIES = {
    "settling_error": "settling error $e_k$",
    "delta_r2": r"$\Delta R^2$ of the step to $k$",
    "correction_norm": r"correction $\|m_k - m_{k-1}\|$",
    "correction_ratio": "correction / the one before",
    "singular_value": "largest singular value",
    "spectral_radius": "spectral radius",
    "start_spread": "spread left of random starts",
    "outside_bounds": "proposals outside the bounds",
    "outside_bounds_components": "components outside the bounds",
}
PAST_K = {"uniform": "$c_k = 1$", "average": "$c_k = 1/K$", "inverse": "$c_k = 1/k$"}
MARKERS = "os^Dv<>P*X"


class Figures:
    """Draws the tables; checkpoints of different seeds are averaged too, others (steps of a run) stand side by side."""

    def __init__(self, policies: list[Policy], episodes: int):
        args = policies[0].agent.args
        self.labels = {str(policy.path): policy.label for policy in policies}
        self.seeds = differ_in_seed(policies)
        self.depth, self.schedule, self.episodes = args.refinement_depth, args.refinement_schedule, episodes
        self.title = f"{args.env_id}, $K = {self.depth}$, {self.schedule} schedule"
        self.title += f", {policies[0].label}" if len(policies) == 1 else ""

    def axes(self, what: str, count: int, columns: int, width: float, height: float) -> tuple[Figure, list]:
        """A titled figure of `count` axes, at most `columns` in a row, each of width x height inches."""
        columns = min(count, columns)
        rows = -(-count // columns)
        figure = Figure((max(columns * width, 4.5), rows * height + 0.7), layout="constrained", dpi=200)
        axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
        for axis in axes[count:]:
            axis.remove()
        figure.suptitle(f"{what}\n{self.title}", size=9)
        return figure, axes[:count]

    def heatmaps(self, what: str, rows: list[dict], column: str, value: str, names: list[str], scale: str, x: str):
        """Component by `column`, a panel per checkpoint (with seeds also mean and std) on one stated colour scale."""
        panels = {self.labels[path]: pivot(group, ("component",), column, value)
                  for (path,), group in grouped(rows, "checkpoint").items()}  # fmt: skip
        if self.seeds:
            across = across_seeds(rows, ("component", column))
            panels["mean over seeds"] = pivot(across, ("component",), column, f"{value}_mean")
            panels["std over seeds"] = pivot(across, ("component",), column, f"{value}_std")
        columns = list(dict.fromkeys(row[column] for row in rows))
        values = [v for panel in panels.values() for row in panel.values() for v in row.values()]
        norm = Normalize(min(0.0, *values), max(values))
        figure, axes = self.axes(what, len(panels), 4, 0.5 * len(columns) + 1.5, 0.21 * len(names) + 1)
        for axis, (title, panel) in zip(axes, panels.items()):
            matrix = np.array([[panel.get(name, {}).get(c, np.nan) for c in columns] for name in names])
            image = axis.imshow(matrix, cmap="cividis_r", norm=norm, aspect="auto")
            for (i, j), cell in np.ndenumerate(matrix):
                shade = "white" if norm(cell) > 0.5 else "black"
                axis.text(j, i, "" if np.isnan(cell) else f"{cell:.2f}", color=shade, ha="center", va="center", size=6)
            axis.set_xticks(range(len(columns)), columns)
            axis.set_yticks(range(len(names)), names, size=7)
            axis.set_xlabel(x)
            axis.set_title(title if len(panels) > 1 else "", size=8)
        figure.colorbar(image, ax=axes, label=scale)
        return figure

    def curve(self, axis, rows: list[dict], x: str, y: str, interval=None, **style):
        """y against x, with error bars to `interval(row)`; of seeds each one in grey, and their mean +- std."""
        groups = grouped(rows, "checkpoint")
        style = {"markersize": 4, "linewidth": 1, "capsize": 2} | style
        if self.seeds:
            xs, ys = (np.array([[row[name] for row in group] for group in groups.values()]) for name in (x, y))
            axis.plot(xs.T, ys.T, color="0.7", linewidth=0.8)
            axis.errorbar(xs.mean(0), ys.mean(0), ys.std(0, ddof=1), color="black", marker="o", **style)
            return
        for i, ((path,), group) in enumerate(groups.items()):
            xs, ys = ([row[name] for row in group] for name in (x, y))
            error = np.abs(np.array([interval(row) for row in group]).T - ys) if interval else None
            axis.errorbar(xs, ys, error, color=colormaps["cividis"](0.85 * i / len(groups)), label=self.labels[path],
                          marker=MARKERS[i % len(MARKERS)], **style)  # fmt: skip

    def legend(self, figure: Figure, axis):
        """One legend below all axes."""
        handles, labels = axis.get_legend_handles_labels()
        if len(labels) > 1:
            figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=7, frameon=False)

    def standard_error(self, row: dict) -> tuple[float, float]:
        half = row["return_std"] / self.episodes**0.5
        return row["return_mean"] - half, row["return_mean"] + half

    def note(self) -> str:
        return "mean and std over seeds" if self.seeds else f"mean and standard error of {self.episodes} episodes"

    def settling(self, tables: dict[str, list[dict]]) -> dict[str, Figure]:
        first = grouped([row for row in tables["settling_error"] if row["step"] == 1], "component")
        names = sorted((name for (name,) in first), key=lambda name: np.mean([r["error"] for r in first[(name,)]]))
        return {"settling_error": self.heatmaps(
            "Remaining refinement by action component", tables["settling_error"], "step", "error", names,
            "remaining distance $e_{k,j}$ (dark: far from its end)", "refinement step $k$")}  # fmt: skip

    def r2(self, tables: dict[str, list[dict]]) -> dict[str, Figure]:
        rows = [r | {"step": f"{r['step_from']}→{r['step_to']}"} for r in tables["delta_r2"]]
        names = list(dict.fromkeys(row["component"] for row in rows))
        heatmap = self.heatmaps(
            "What early components add to the prediction of late components' corrections", rows, "step", "delta_r2",
            names, r"$\Delta R^2$, five-fold (dark: much)", "transition")  # fmt: skip
        checks = grouped(tables["delta_r2_checks"], "checkpoint", "step_from")
        columns = len(grouped(rows, "step"))
        figure, axes = self.axes(r"$\Delta R^2$ of the paper beside stricter ones", len(checks), columns, 2.4, 1.9)
        for axis, ((path, k), group) in zip(axes, checks.items()):
            y = np.arange(len(group))[::-1]
            low, high, *points = ([row[name] for row in group] for name in (
                "shuffled_low", "shuffled_high", "delta_r2", "by_episode", "given_observation"))  # fmt: skip
            axis.axvline(0, color="0.6", linewidth=0.7)
            axis.hlines(y, low, high, color="0.75", linewidth=7, label="early components shuffled (95 %)")
            labels = ("the paper's", "folds of whole episodes", "observation in both models")
            for x, marker, fill, label in zip(points, "osx", ("black", "none", "black"), labels):
                axis.scatter(x, y, 22, marker=marker, facecolor=fill, edgecolor="black" if marker != "x" else None,
                             linewidth=0.9, label=label)  # fmt: skip
            axis.set_yticks(y, [row["component"] for row in group], size=7)
            title = f"{self.labels[path]}\n" if len(self.labels) > 1 else ""
            axis.set_title(f"{title}{k}→{k + 1}", size=8)
            axis.set_xlabel(r"$\Delta R^2$")
        self.legend(figure, axes[0])
        return {"delta_r2": heatmap, "delta_r2_checks": figure}

    def anytime(self, tables: dict[str, list[dict]]) -> dict[str, Figure]:
        figure, (axis,) = self.axes("Return of the policy stopped after $k$ steps", 1, 1, 5, 3)
        self.curve(axis, tables["anytime"], "steps", "return_mean", self.standard_error)
        axis.axvline(self.depth, color="0.5", linestyle=":")
        axis.set(xlabel=f"steps $k$ (past $K$, dotted, {PAST_K[self.schedule]} goes on)",
                 ylabel=f"return\n({self.note()})")  # fmt: skip
        self.legend(figure, axis)
        return {"anytime": figure}

    def adaptive(self, tables: dict[str, list[dict]]) -> dict[str, Figure]:
        figure, (axis,) = self.axes("Return when a state's refinement stops at a small correction", 1, 1, 5, 3)
        if "anytime" in tables:
            fixed = [row for row in tables["anytime"] if 1 <= row["steps"] <= self.depth]
            self.curve(axis, fixed, "steps", "return_mean", linestyle=":", fillstyle="none")
        self.curve(axis, tables["adaptive"], "steps_mean", "return_mean", self.standard_error)
        axis.set(xlabel="mean steps used" + (" (dotted: the same number in every state)" if "anytime" in tables else ""),
                 ylabel=f"return\n({self.note()})")  # fmt: skip
        self.legend(figure, axis)
        return {"adaptive": figure}

    def dynamics(self, tables: dict[str, list[dict]]) -> dict[str, Figure]:
        quantities = grouped(tables["dynamics"], "quantity")
        what = "Refinement as a dynamical system: " + (
            "median over states, mean and std over seeds" if self.seeds else "median and 10 to 90 % of the states")
        figure, axes = self.axes(what, len(quantities), 4, 2.3, 2.1)
        for axis, ((quantity,), rows) in zip(axes, quantities.items()):
            outside = quantity.startswith("outside")
            self.curve(axis, rows, "step", "value", None if outside else lambda row: (row["q10"], row["q90"]))
            if quantity in ("correction_ratio", "singular_value", "spectral_radius", "start_spread"):
                axis.axhline(1, color="0.5", linestyle=":")
            axis.set_title(QUANTITIES[quantity] + (" (mean)" if outside else ""), size=8)
            axis.set(xlabel="refinement step $k$", xticks=range(self.depth + 1), xlim=(-0.3, self.depth + 0.3))
        self.legend(figure, axes[0])
        return {"dynamics": figure}

    def training(self, tables: dict[str, list[dict]]) -> dict[str, Figure]:
        quantities = grouped(tables["training"], "quantity")
        note = ", mean and std over seeds" if len(grouped(tables["training"], "seed")) > 1 else ""
        figure, axes = self.axes(f"Refinement through training{note}", len(quantities), 3, 2.6, 1.9)
        for axis, ((quantity,), rows) in zip(axes, quantities.items()):
            for (k,), of_step in grouped(rows, "step").items():
                points = sorted(grouped(of_step, "global_step").items())
                mean, std = zip(*(mean_and_std([row["value"] for row in group]) for _, group in points))
                axis.errorbar([step for (step,), _ in points], mean, std if note else None, label=f"$k = {k}$",
                              marker=MARKERS[k % len(MARKERS)], markersize=4, linewidth=1, capsize=2,
                              color=colormaps["cividis"](0.85 * k / self.depth))  # fmt: skip
            axis.set_title(QUANTITIES[quantity], size=8)
            axis.set_xlabel("training step")
        self.legend(figure, axes[0])
        return {"training": figure}


def as_png(figure: Figure) -> bytes:
    image = io.BytesIO()
    figure.savefig(image, format="png")
    return image.getvalue()


# --- Main -------------------------------------------------------------------------------------------------------------


def summarise(name: str, rows: list[dict]) -> dict:
    """What one checkpoint's table comes to."""
    if name == "settling_error":
        first = [row["component"] for row in rows if row["step"] == 1]
        count = min(5, len(first) // 2)
        mean = {k: np.mean([row["error"] for row in group]) for (k,), group in grouped(rows, "step").items()}
        return {"order": first, "early": first[:count], "late": first[len(first) - count :], "mean_error": mean}
    if name in ("delta_r2", "delta_r2_checks"):
        values = [column for column in rows[0] if column not in {*TABLES[name].keys, "checkpoint"}]
        means = {f"{column}_mean": np.mean([row[column] for row in rows]) for column in values}
        if name == "delta_r2":
            return means
        return means | {"above_shuffled": np.mean([row["delta_r2"] > row["shuffled_high"] for row in rows])}
    if TABLES[name].spread:
        (index,) = (key for key in TABLES[name].keys if key not in ("step", "global_step"))
        return pivot(rows, (index,), "step", "value")
    return {"rows": [{k: v for k, v in row.items() if k != "checkpoint"} for row in rows]}


def main():
    args = tyro.cli(Args, description=__doc__)
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    policies = check(args)
    out_dir = output_folder(args)
    several, seeds = len(policies) > 1, differ_in_seed(policies)
    task = refineppo.make_env(policies[0].agent.args.env_id)
    names = component_names(task)
    task.close()

    tables = {}
    for policy in tqdm(policies, desc="checkpoints", disable=None if several else True):
        for name, rows in analyse(policy, names, args).items():
            tables.setdefault(name, []).extend({"checkpoint": str(policy.path)} | row for row in rows)

    files, summary = {}, {"flags": json.loads(json.dumps(asdict(args), default=str)), "checkpoints": {}}
    for policy in policies:
        flags = policy.agent.args
        facts = {name: getattr(flags, name) for name in ("env_id", "refinement_depth", "refinement_schedule", "seed")}
        facts |= {"global_step": policy.global_step, "states": len(policy.states), "episodes": len(set(policy.episodes))}
        summary["checkpoints"][str(policy.path)] = facts
    for name, rows in tables.items():
        section = summary.setdefault(TABLES[name].section, {})
        for (path,), group in grouped(rows, "checkpoint").items():
            section.setdefault(path, {}).update(summarise(name, group))
            label = f", {path}" if several else ""
            print(f"\n{name}{label}\n{as_text(group, TABLES[name])}")
        files[f"{name}.csv"] = as_csv(rows if several else [{k: v for k, v in r.items() if k != "checkpoint"} for r in rows])
        if seeds:
            files[f"{name}_across_seeds.csv"] = as_csv(across_seeds(rows, TABLES[name].keys))
    figures = Figures(policies, args.episodes)
    for section in dict.fromkeys(TABLES[name].section for name in tables):
        files |= {f"{name}.png": as_png(figure) for name, figure in getattr(figures, section)(tables).items()}
    files["summary.json"] = json.dumps(summary, indent=2, default=float).encode()
    try:
        for name, data in files.items():
            write_atomically(out_dir / name, data)
    except OSError as error:
        refuse(f"cannot write to the output folder {out_dir}: {error.strerror}")
    print(f"\nthe tables, figures and summary.json are in {out_dir}")


if __name__ == "__main__":
    main()
