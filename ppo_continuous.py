"""PPO for continuous control: the baseline of RefinePPO, with the settings of CleanRL's ppo_continuous_action.

    a ~ Normal(m(s), exp(log_std)),   m a tanh network of the normalised observation, in one pass

`refineppo_continuous.py` is this file with another actor; read the two side by side, their diff is the paper.

    python ppo_continuous.py --env-id HalfCheetah-v5
    python ppo_continuous.py --evaluate runs/.../best.pt --render
    tensorboard --logdir runs

Why it is fast: one observation goes through the actor in NumPy on views of the parameters (torch's overhead per call
is larger than the arithmetic), values and log-probabilities are computed once per rollout in one batch, and a
minibatch update (loss, gradient, clipping, Adam) is one compiled function.
"""

import errno
import gc
import io
import json
import math
import multiprocessing
import os
import platform
import random
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from copy import deepcopy
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import filelock
import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.utils.env_checker import check_env
from threadpoolctl import threadpool_limits
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from tqdm import tqdm


@dataclass(frozen=True)
class Args:
    env_id: str = "HalfCheetah-v5"
    """Gymnasium id of the task; `module:Env-v0` imports the module first"""
    total_timesteps: int = 6_000_000
    """environment steps to train for, over all environments together"""
    seed: int = 1
    """seed of the parameters, the action noise, the minibatches and the environments"""
    exp_name: str = Path(__file__).stem
    """name of the experiment, part of the default run folder's name"""
    run_dir: str | None = None
    """folder of the run; default runs/{env_id}__{exp_name}__{seed}__{unix time}"""
    resume: bool = False
    """continue the run in --run-dir where its last checkpoint left it, or begin it; a finished one is left as it is"""
    max_episode_steps: int | None = None
    """time limit of an episode, in steps; default the task's own"""

    # PPO, with CleanRL's names and defaults
    learning_rate: float = 3e-4
    """Adam's step size"""
    anneal_lr: bool = True
    """anneal the learning rate linearly to zero"""
    num_envs: int = 1
    """environments stepped together"""
    num_steps: int = 2048
    """steps per environment in one rollout"""
    num_minibatches: int = 32
    """minibatches into which a rollout is split"""
    update_epochs: int = 10
    """passes over each rollout"""
    gamma: float = 0.99
    """discount factor"""
    gae_lambda: float = 0.95
    """lambda of the generalized advantage estimate"""
    clip_coef: float = 0.2
    """half width of the clipping range of the probability ratio, and of the value if --clip-vloss"""
    norm_adv: bool = True
    """normalise the advantages of each minibatch"""
    clip_vloss: bool = True
    """clip the value's change in the value loss"""
    ent_coef: float = 0.0
    """weight of the entropy bonus; to anneal it, see `compile_update`"""
    vf_coef: float = 0.5
    """weight of the value loss"""
    max_grad_norm: float = 0.5
    """largest norm of the whole gradient"""
    target_kl: float | None = None
    """end an iteration's epochs once the approximate KL divergence exceeds this"""
    bootstrap_truncated: bool = False
    """at a time limit, add gamma V(final observation) to the reward, instead of treating it as an end"""
    normalize_obs: bool = True
    """normalise the observations by their running mean and standard deviation, and clip them to +-10"""
    normalize_reward: bool = True
    """divide the rewards by the running standard deviation of the discounted return, and clip them to +-10"""
    actor_hidden: tuple[int, ...] = (128, 128)
    """units of the actor's hidden layers"""
    critic_hidden: tuple[int, ...] = (64, 64)
    """units of the critic's hidden layers"""
    log_std_init: float = 0.0
    """initial log standard deviation of every action component"""

    # Evaluation and checkpoints
    eval_interval: int = 100_000
    """environment steps between evaluations of the deterministic policy"""
    eval_episodes: int = 10
    """episodes of each evaluation during training, each in an environment of its own"""
    final_eval_episodes: int = 10
    """episodes of the final evaluations, and of --evaluate"""
    checkpoint_interval: int = 50_000
    """environment steps between checkpoints to resume from (last.pt)"""
    save_every: int | None = None
    """environment steps between checkpoints to keep (step_{global_step}.pt); default none"""
    evaluate: str | None = None
    """train nothing: evaluate this checkpoint and print its returns"""
    render: bool = False
    """with --evaluate: show the episodes in a window"""
    capture_video: bool = False
    """record the best policy's final evaluation, or --evaluate's episodes (needs the extra `video`)"""

    # The machine
    compile: bool = True
    """compile the update with torch.compile"""
    cuda: bool = False
    """update on the GPU; acting stays on the CPU"""
    num_threads: int = 1
    """threads of torch and NumPy; sweeps fill cores with processes instead"""
    progress: bool = True
    """show a progress bar (on a terminal) and a line per evaluation"""
    track: bool = False
    """log to Weights & Biases as well (needs the extra `track`)"""
    wandb_project_name: str = "refineppo"
    """project in Weights & Biases"""
    wandb_entity: str | None = None
    """entity (team) in Weights & Biases"""

    @property
    def batch_size(self) -> int:
        """Environment steps in one rollout."""
        return self.num_envs * self.num_steps

    @property
    def last_step(self) -> int:
        """Environment steps of the whole run; as in CleanRL, a last incomplete rollout is left out."""
        return self.total_timesteps // self.batch_size * self.batch_size


# --- Policy -----------------------------------------------------------------------------------------------------------

ARRAY_OPS = np.ndarray.dot, np.tanh  # dot: on small arrays half the time of @
TENSOR_OPS = torch.mm, torch.tanh


def network(weights: list[tuple], x):
    """A tanh network, (batch, inputs) to (batch, outputs), in arrays or tensors; `weights` are its (weight, bias)."""
    dot, tanh = ARRAY_OPS if isinstance(x, np.ndarray) else TENSOR_OPS
    *hidden, (w_out, b_out) = weights
    for w, b in hidden:
        x = tanh(dot(x, w) + b)
    return dot(w_out.T, x.T).T + b_out  # = x @ w_out; torch is faster with the narrow matrix first


def init_params(sizes: dict[str, list[int]], args: Args) -> dict[str, torch.Tensor]:
    """Orthogonal weights, (in, out), of gain sqrt 2 (outputs: actor 0.01, critic 1), zero biases, and log_std."""
    generator = torch.Generator().manual_seed(args.seed)
    params = {}
    for name, output_gain in (("actor", 0.01), ("critic", 1.0)):
        *hidden, output = zip(sizes[name], sizes[name][1:])
        for i, (shape, gain) in enumerate([*((shape, math.sqrt(2)) for shape in hidden), (output, output_gain)]):
            params[f"{name}.{i}.weight"] = torch.nn.init.orthogonal_(torch.empty(shape), gain, generator)
            params[f"{name}.{i}.bias"] = torch.zeros(shape[1])
    params["log_std"] = torch.full((sizes["actor"][-1],), args.log_std_init)
    return params


def layers(params: dict, name: str) -> list[tuple]:
    """The (weight, bias) pairs of the network `name`, first to last."""
    tensors = [p for key, p in params.items() if key.startswith(f"{name}.")]
    return list(zip(tensors[::2], tensors[1::2]))


def in_rows_of_8(function, obs: np.ndarray) -> np.ndarray:
    """`function`, (8, obs_dim) to (..., 8, n), of one observation (obs_dim,) or of any number (rows, obs_dim).

    How a product of matrices rounds depends on its number of rows. With always eight, an action, and so an episode's
    return, does not depend on how many others are computed beside it.
    """
    rows = np.atleast_2d(obs)
    blocks = np.resize(rows, (math.ceil(len(rows) / 8), 8, rows.shape[1]))  # the last one is filled up with copies
    out = np.concatenate([function(block) for block in blocks], axis=-2)
    return out[..., : len(rows), :] if np.ndim(obs) == 2 else out[..., 0, :]


class Agent:
    """The policy, the value function and the normalizer: all that is needed to act. See `load_agent`."""

    def __init__(self, obs_space: gym.spaces.Box, action_space: gym.spaces.Box, args: Args):
        self.args, self.device = args, torch.device("cuda" if args.cuda else "cpu")
        self.low, self.high = action_space.low, action_space.high
        (obs_dim,), (action_dim,) = obs_space.shape, action_space.shape
        sizes = {
            "actor": [obs_dim, *args.actor_hidden, action_dim],
            "critic": [obs_dim, *args.critic_hidden, 1],
        }
        self.params = {name: p.to(self.device) for name, p in init_params(sizes, args).items()}
        self.normalizer = Normalizer(args.num_envs, obs_dim, args)

    def mean(self, obs: np.ndarray) -> np.ndarray:
        """m(s), (action_dim,) or (n, action_dim), of raw observations (obs_dim,) or (n, obs_dim)."""
        weights, normalize = layers(self.arrays(), "actor"), self.normalizer.normalize
        return in_rows_of_8(lambda rows: network(weights, normalize(rows)), obs)

    def act(self, obs: np.ndarray) -> np.ndarray:
        """The deterministic action of raw observations, (obs_dim,) or (n, obs_dim): the policy's mean (Algorithm 1,
        line 10), clipped to the action bounds, as training clips its actions and CleanRL does.
        """
        return np.clip(self.mean(obs), self.low, self.high)

    def arrays(self) -> dict[str, np.ndarray]:
        """The parameters to act with: on the CPU views that follow every update, on a GPU copies."""
        return {name: p.cpu().numpy() for name, p in self.params.items()}

    def state(self) -> dict:
        return {"params": self.params, "normalizer": self.normalizer.state()}

    def load(self, state: dict):
        copy_into(self.params, state["params"], state["path"])
        copy_into(self.normalizer.state(), state["normalizer"], state["path"])


# --- Environments and normalizer --------------------------------------------------------------------------------------


class Environments:
    """N copies of a task, stepped one after the other; one whose episode ends starts the next at once.

    gymnasium's SyncVectorEnv does the same under SAME_STEP autoreset, but merges every info dict: that costs 100 us a
    step, where HalfCheetah's own takes 60. Every episode has a seed of its own: with its actions it can be replayed.
    """

    def __init__(self, args: Args):
        self.args = args
        self.envs: list[Task | None] = [None] * args.num_envs
        self.episodes = [0] * args.num_envs  # episodes started
        self.actions = [[] for _ in self.envs]  # since the running episode's start
        self.returns = [0.0] * args.num_envs  # of the running episode, raw: before any normalisation
        self.obs = np.stack([self.reset(i) for i in range(args.num_envs)])  # (N, obs_dim), raw

    def reset(self, i: int) -> np.ndarray:
        """Start environment i's next episode."""
        # BipedalWalker's Box2D world keeps state between episodes: only a new one replays an episode exactly
        if self.envs[i] is None or "BipedalWalker" in self.args.env_id:
            if self.envs[i] is not None:
                self.envs[i].close()
            self.envs[i] = make_env(self.args, env=i)
        (seed,) = episode_seeds(self.args.seed, TRAINING, i, self.episodes[i])
        self.episodes[i] += 1
        self.actions[i], self.returns[i] = [], 0.0
        return self.envs[i].reset(seed=seed)[0]

    def step_one(self, i: int, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """Step environment i and record what its replay and its return need."""
        obs, reward, terminated, truncated, _ = self.envs[i].step(action)
        self.actions[i].append(action)
        self.returns[i] += reward
        return obs, reward, terminated, truncated

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, list, list, list, dict]:
        """Step every environment with its row of (N, action_dim).

        Returns obs (N, obs_dim), rewards, terminated, truncated, each of N, and {i: (last obs, return, length)} of
        the episodes that ended; their obs is the first of the next episode.
        """
        rewards, terminated, truncated, ended = [], [], [], {}
        for i, action in enumerate(actions):
            obs, reward, terminal, timeout = self.step_one(i, action)
            if terminal or timeout:
                ended[i] = obs.copy(), self.returns[i], len(self.actions[i])
                obs = self.reset(i)
            self.obs[i] = obs
            rewards.append(reward)
            terminated.append(terminal)
            truncated.append(timeout)
        return self.obs, rewards, terminated, truncated, ended

    def state(self) -> dict:
        """How many episodes each environment has started, and of the running one its actions and where they led."""
        actions = [torch.tensor(np.array(a)) for a in self.actions]
        return {"episodes": self.episodes, "actions": actions, "returns": self.returns, "obs": torch.tensor(self.obs)}

    def load(self, state: dict):
        """Bring every environment exactly to where it was, by replaying its running episode; warn if that fails."""
        same = True
        for i, actions in enumerate(state["actions"]):
            self.episodes[i] = state["episodes"][i] - 1  # `reset` counts it again
            self.obs[i] = self.reset(i)
            for action in actions.numpy():
                self.obs[i], _, *ends = self.step_one(i, action)
                if any(ends):
                    same, self.obs[i] = False, self.reset(i)
                    break
        if not (same and self.returns == state["returns"] and np.array_equal(self.obs, state["obs"].numpy())):
            say(f"warning: {self.args.env_id} does not repeat itself, so that the resumed run will differ")


class RunningMeanStd:
    """Running mean and variance by batched Welford updates: gymnasium's arithmetic, with its initial count of 1e-4."""

    def __init__(self, *shape: int):
        self.count, self.mean = np.full((), 1e-4), np.zeros(shape)
        self.squares = np.full(shape, 1e-4)  # count * variance, which starts at 1

    def update(self, x: np.ndarray):
        """Count a batch (n, *shape)."""
        n, count = len(x), self.count.item()
        mean = x[0] if n == 1 else np.add.reduce(x) / n
        if n > 1:
            self.squares += np.add.reduce((x - mean) ** 2)
        delta = mean - self.mean
        self.mean += delta * (n / (count + n))
        self.squares += delta * delta * (count * n / (count + n))
        self.count += n

    def update_each(self, x: np.ndarray) -> np.ndarray:
        """Count the batches x[0], x[1], ... of (T, n) one after the other; the variance after each, (T,)."""
        shifted = x - self.mean
        count = self.count + len(x[0]) * np.arange(1, len(x) + 1)
        sums = np.cumsum(shifted.sum(1))
        squares = self.squares + np.cumsum((shifted**2).sum(1)) - sums**2 / count
        self.count[...], self.squares[...] = count[-1], squares[-1]
        self.mean += sums[-1] / count[-1]
        return squares / count


def discounted_sums(x: np.ndarray, decay: np.ndarray, initial: np.ndarray) -> np.ndarray:
    """y_t = x_t + decay_t y_{t-1} down each column of x and decay (T, N), with y_{-1} = initial (N,)."""
    columns = []
    for x_column, decay_column, y in zip(x.T.tolist(), decay.T.tolist(), initial.tolist()):
        column = []
        for x_t, decay_t in zip(x_column, decay_column):  # floats: faster than small arrays
            y = x_t + decay_t * y
            column.append(y)
        columns.append(column)
    return np.array(columns).T


class Normalizer:
    """Running statistics of the observations and of the discounted returns, over all environments.

    They belong to the agent: saved in every checkpoint, and frozen at evaluation, so that a policy is evaluated on
    observations scaled as in its training.
    """

    def __init__(self, num_envs: int, obs_dim: int, args: Args):
        self.args = args
        self.obs, self.returns = RunningMeanStd(obs_dim), RunningMeanStd()
        self.discounted = np.zeros(num_envs)  # G of every environment

    def observe(self, obs: np.ndarray) -> np.ndarray:
        """Count raw observations (n, obs_dim), then normalise them."""
        if self.args.normalize_obs:
            self.obs.update(obs)
        return self.normalize(obs)

    def normalize(self, obs: np.ndarray) -> np.ndarray:
        """Raw observations (n, obs_dim), normalised and clipped to +-10 in float32, with the statistics as they are."""
        if self.args.normalize_obs:
            mean, squares = self.obs.mean[None], self.obs.squares[None]  # as rows: NumPy is faster
            obs = ((obs - mean) / np.sqrt(squares / self.obs.count.item() + 1e-8)).clip(-10.0, 10.0)
        return obs.astype(np.float32)

    def scale_rewards(self, rewards: np.ndarray, terminated: np.ndarray) -> np.ndarray:
        """Divide a rollout's rewards (T, N) by the running std of G = gamma G (1 - terminated) + r; clip to +-10.

        As in gymnasium and CleanRL, a truncation does not reset G, and a terminal reward leaks into the next episode.
        """
        if not self.args.normalize_reward:
            return rewards.copy()
        discounted = discounted_sums(rewards, self.args.gamma * (1.0 - terminated), self.discounted)
        self.discounted[...] = discounted[-1]
        variance = self.returns.update_each(discounted)
        return np.clip(rewards / np.sqrt(variance + 1e-8)[:, None], -10, 10)

    def state(self) -> dict[str, torch.Tensor]:
        """Everything that changes, as tensors that share its memory."""
        arrays = {f"obs.{name}": array for name, array in vars(self.obs).items()}
        arrays |= {f"returns.{name}": array for name, array in vars(self.returns).items()}
        return {name: torch.from_numpy(array) for name, array in (arrays | {"discounted": self.discounted}).items()}


# --- Rollout and advantages -------------------------------------------------------------------------------------------


@dataclass
class Rollout:
    """T steps in N environments, and the episodes that ended in them."""

    obs: np.ndarray  # (T + 1, N, obs_dim), normalised
    actions: np.ndarray  # (T, N, action_dim), before they are clipped to the bounds
    logprobs: np.ndarray  # (T, N)
    rewards: np.ndarray  # (T, N), raw
    terminated: np.ndarray  # (T, N)
    truncated: np.ndarray  # (T, N)
    final_obs: dict[tuple[int, int], np.ndarray]  # (t, i) -> last observation of the episode that ended, normalised
    episodes: list[tuple[int, float, int]]  # (steps into the rollout, raw return, length)


class Batch(NamedTuple):
    """A rollout's transitions in one row of T * N, or a minibatch of them, float32."""

    obs: torch.Tensor  # (batch, obs_dim), normalised
    actions: torch.Tensor  # (batch, action_dim)
    logprobs: torch.Tensor  # (batch,), under the policy that acted; so are the values
    advantages: torch.Tensor  # (batch,)
    returns: torch.Tensor  # (batch,)
    values: torch.Tensor  # (batch,)


def collect(agent: Agent, envs: Environments, num_steps: int, rng: np.random.Generator) -> Rollout:
    """Act with a = mean + exp(log_std) * noise; what acting does not need, as the values, is computed later, at once.

    The actor runs in NumPy: for one observation torch's overhead per call is larger than the arithmetic.
    """
    mujoco_warnings.clear()  # those of this rollout are logged with it
    arrays = agent.arrays()
    log_std, obs = arrays["log_std"], agent.normalizer.normalize(envs.obs)
    weights = [(w, b[None]) for w, b in layers(arrays, "actor")]  # NumPy adds a row to a row in half of a vector's time
    noise = rng.standard_normal((num_steps, len(obs), len(log_std)), dtype=np.float32)
    perturbation = noise * np.exp(log_std)
    # the density of a depends on the noise alone: a - mean = exp(log_std) * noise
    logprobs = -(0.5 * noise**2 + log_std + 0.5 * math.log(2 * math.pi)).sum(-1)
    all_obs, actions = np.empty((num_steps + 1, *obs.shape), np.float32), np.empty_like(noise)
    outcomes, final_obs, episodes = [], {}, []
    for t in range(num_steps):
        all_obs[t] = obs
        actions[t] = network(weights, obs) + perturbation[t]
        raw_obs, *outcome, ended = envs.step(actions[t].clip(agent.low, agent.high))
        outcomes.append(outcome)
        if ended:  # last observations are counted too, before the ones that follow, as in gymnasium's wrapper
            last_obs = agent.normalizer.observe(np.stack([last for last, _, _ in ended.values()]))
            final_obs |= {(t, i): last for i, last in zip(ended, last_obs)}
            episodes += [((t + 1) * len(obs), episode_return, length) for _, episode_return, length in ended.values()]
        obs = agent.normalizer.observe(raw_obs)
    all_obs[-1] = obs
    rewards, terminated, truncated = map(np.array, zip(*outcomes))
    return Rollout(all_obs, actions, logprobs, rewards, terminated, truncated, final_obs, episodes)


def gae(rewards: np.ndarray, values: np.ndarray, ends: np.ndarray, gamma: float, gae_lambda: float) -> np.ndarray:
    """Generalized advantage estimates (T, N), from rewards (T, N), values (T + 1, N) and episode ends (T, N).

    A_t = delta_t + gamma lambda (1 - end_t) A_{t+1},   delta_t = r_t + gamma (1 - end_t) V_{t+1} - V_t
    """
    discount = gamma * (1.0 - ends)
    delta = rewards + discount * values[1:] - values[:-1]
    return discounted_sums(delta[::-1], gae_lambda * discount[::-1], np.zeros(len(delta[0])))[::-1]


def prepare_batch(agent: Agent, rollout: Rollout) -> tuple[Batch, float]:
    """A rollout's transitions for `learn`, and the explained variance of the value function."""
    args, weights = agent.args, layers(agent.params, "critic")
    obs = torch.from_numpy(rollout.obs).to(agent.device)
    values = network(weights, obs.flatten(0, 1)).view(obs.shape[:2]).cpu().numpy()
    rewards = agent.normalizer.scale_rewards(rollout.rewards, rollout.terminated)
    timeouts = [at for at in rollout.final_obs if not rollout.terminated[at]] if args.bootstrap_truncated else []
    if timeouts:
        final_obs = torch.from_numpy(np.stack([rollout.final_obs[at] for at in timeouts])).to(agent.device)
        for at, value in zip(timeouts, network(weights, final_obs).squeeze(1).tolist()):
            rewards[at] += args.gamma * value
    advantages = gae(rewards, values, rollout.terminated | rollout.truncated, args.gamma, args.gae_lambda)
    returns = advantages + values[:-1]
    explained_variance = 1 - advantages.var() / returns.var() if returns.var() else math.nan
    arrays = (rollout.actions, rollout.logprobs, advantages, returns, values[:-1])
    flat = (torch.from_numpy(x.reshape(args.batch_size, *x.shape[2:]).astype(np.float32)) for x in arrays)
    return Batch(obs[:-1].flatten(0, 1), *(x.to(agent.device) for x in flat)), explained_variance


# --- Update -----------------------------------------------------------------------------------------------------------

LOSSES = ("policy_loss", "value_loss", "entropy", "old_approx_kl", "approx_kl", "clipfrac", "grad_norm")


def ppo_loss(params: dict, args: Args, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """PPO's loss on a minibatch, and the first six of LOSSES."""
    log_std = params["log_std"]
    mean = network(layers(params, "actor"), batch.obs)
    z = (batch.actions - mean) * torch.exp(-log_std)
    logratio = -(0.5 * z**2 + log_std + 0.5 * math.log(2 * math.pi)).sum(-1) - batch.logprobs
    ratio = logratio.exp()
    advantages = batch.advantages
    if args.norm_adv:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    clipped_ratio = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    policy_loss = -torch.minimum(advantages * ratio, advantages * clipped_ratio).mean()

    values = network(layers(params, "critic"), batch.obs)[:, 0]  # its gradient is faster than squeeze's
    value_errors = (values - batch.returns) ** 2
    if args.clip_vloss:
        clipped_values = batch.values + (values - batch.values).clamp(-args.clip_coef, args.clip_coef)
        value_errors = torch.maximum(value_errors, (clipped_values - batch.returns) ** 2)
    value_loss = 0.5 * value_errors.mean()

    entropy = (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()
    loss = policy_loss - args.ent_coef * entropy + args.vf_coef * value_loss
    clipfrac = ((ratio - 1).abs() > args.clip_coef).to(ratio.dtype).mean()
    losses = (policy_loss, value_loss, entropy, -logratio.mean(), (ratio - 1 - logratio).mean(), clipfrac)
    return loss, torch.stack(losses).detach()


class Adam:
    """Adam's state: the running averages of every parameter's gradient and of its square, and the step count."""

    def __init__(self, params: dict[str, torch.Tensor]):
        names = [(name, moment) for name in params for moment in ("mean", "square")]
        self.moments = {f"{name}.{moment}": torch.zeros_like(params[name]) for name, moment in names}
        self.steps = 0

    def step_sizes(self, learning_rate: float, count: int) -> torch.Tensor:
        """(count, 2), for the next `count` steps t: lr / (1 - beta1^t) and 1 / sqrt(1 - beta2^t)."""
        t = np.arange(self.steps + 1, self.steps + count + 1)
        sizes = np.stack([learning_rate / (1 - 0.9**t), 1 / np.sqrt(1 - 0.999**t)], axis=1)
        return torch.from_numpy(sizes.astype(np.float32))

    def state(self) -> dict:
        return {"moments": self.moments, "steps": self.steps}

    def load(self, state: dict):
        copy_into(self.moments, state["moments"], "Adam's state")
        self.steps = state["steps"]


def update(params: dict, moments: dict, args: Args, batch: Batch, index, step_size: torch.Tensor) -> torch.Tensor:
    """One minibatch: loss, gradient, clipping, and Adam with eps 1e-5, in place on `params` and Adam's `moments`.

    index: the minibatch's rows of `batch`; step_size: a row of `Adam.step_sizes`. Returns LOSSES. Written out, instead
    of with torch.optim, so that all of it is one graph for torch.compile.
    """
    minibatch = Batch(*(x[index] for x in batch))
    grads, losses = torch.func.grad(ppo_loss, has_aux=True)(params, args, minibatch)
    norm = sum(g.square().sum() for g in grads.values()).sqrt()
    scale = (args.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
    size, root_scale = step_size[0], step_size[1]
    for name, p in params.items():
        grad, mean, square = grads[name] * scale, moments[f"{name}.mean"], moments[f"{name}.square"]
        mean.lerp_(grad, 1 - 0.9)
        square.lerp_(grad.square(), 1 - 0.999)
        p.sub_(size * mean / (square.sqrt() * root_scale + 1e-5))
    return torch.cat([losses, norm[None]])


def learn(update_function, training: "Training", batch: Batch, learning_rate: float) -> dict[str, float]:
    """The epochs over one rollout: the means of LOSSES over all minibatches (CleanRL logs the last one's)."""
    agent, adam, args, losses = training.agent, training.adam, training.agent.args, []
    step_sizes = adam.step_sizes(learning_rate, args.update_epochs * args.num_minibatches).to(agent.device).unbind()
    for _ in range(args.update_epochs):
        order = torch.from_numpy(training.rng.permutation(args.batch_size)).to(agent.device)
        for index in order.split(args.batch_size // args.num_minibatches):
            step_size = step_sizes[len(losses)]
            losses.append(update_function(agent.params, adam.moments, args, batch, index, step_size))
        if args.target_kl is not None and losses[-1][LOSSES.index("approx_kl")] > args.target_kl:
            break
    adam.steps += len(losses)
    means = {f"losses/{name}": mean for name, mean in zip(LOSSES, torch.stack(losses).mean(0).tolist())}
    check_finite("the update", means | agent.params | agent.normalizer.state())
    return means


# --- Main -------------------------------------------------------------------------------------------------------------


@dataclass
class Progress:
    """How far a training is."""

    global_step: int = 0  # environment steps, over all environments together
    best_return: float = -math.inf  # of the evaluations
    evaluations: list[tuple] = field(default_factory=list)  # the rows of evaluations.csv
    late_returns: list[float] = field(default_factory=list)  # of training episodes in the last tenth of the steps
    train_seconds: float = 0.0  # in rollouts and updates
    wall_seconds: float = 0.0
    wandb_id: str | None = None


class Training:
    """All that training changes, and so what last.pt holds beside the flags and the machine."""

    def __init__(self, args: Args):
        seed_global_rng(*episode_seeds(args.seed, GLOBAL_RNG, 0))
        self.envs = Environments(args)
        self.agent = Agent(self.envs.envs[0].observation_space, self.envs.envs[0].action_space, args)
        self.agent.normalizer.observe(self.envs.obs)
        self.adam = Adam(self.agent.params)
        self.rng = np.random.default_rng(args.seed)  # of the action noise and of the minibatches
        self.progress = Progress()

    def state(self) -> dict:
        parts = {"adam": self.adam.state(), "envs": self.envs.state(), "rng": self.rng.bit_generator.state}
        return self.agent.state() | parts | {"progress": asdict(self.progress)}

    def load(self, state: dict):
        self.agent.load(state)
        self.adam.load(state["adam"])
        self.envs.load(state["envs"])
        self.rng.bit_generator.state = state["rng"]
        self.progress = Progress(**state["progress"])


def main():
    args = tyro.cli(Args, description=__doc__)
    if args.evaluate is not None:
        return evaluate_checkpoint(args)
    catch_signals()
    check_args(args)
    with Run(args) as run:
        training = run.begin_or_resume()
        agent, envs, progress = training.agent, training.envs, training.progress
        update_function = run.compile(training)
        if run.evaluate_if_due(agent):  # a resumed run makes up for the one that a signal ended
            run.save_last(training)
        run.exit_if_stopped()
        while progress.global_step < args.last_step:
            start, before = time.time(), progress.global_step
            seed_global_rng(*episode_seeds(args.seed, GLOBAL_RNG, before))
            rollout = collect(agent, envs, args.num_steps, training.rng)
            batch, explained_variance = prepare_batch(agent, rollout)
            learning_rate = args.learning_rate * (1 - before / args.last_step if args.anneal_lr else 1)
            scalars = learn(update_function, training, batch, learning_rate)
            progress.global_step = step = before + args.batch_size
            progress.train_seconds += time.time() - start

            scalars["losses/explained_variance"] = explained_variance
            scalars["charts/learning_rate"] = learning_rate
            scalars["charts/SPS"] = step / progress.train_seconds
            run.log(scalars, [(before + offset, *episode) for offset, *episode in rollout.episodes])
            run.evaluate_if_due(agent)
            if passed(args.save_every, before, step):
                run.save(f"step_{step}.pt", agent)
            if passed(args.checkpoint_interval, before, step) or step == args.last_step or stop_signals:
                run.save_last(training)
                run.exit_if_stopped()
        run.finish(agent)


# --- Nothing below is the algorithm: evaluation, the task's boundary, arguments, compilation, files, signals ----------


def passed(interval: int | None, before: int, now: int) -> bool:
    """Whether a multiple of the interval lies in (before, now]; never, if there is no interval."""
    return interval is not None and now // interval > before // interval


def evaluate(agent: Agent, seeds: list[int], render_mode: str | None = None, videos: Path | None = None):
    """Returns and lengths, (len(seeds),), of one episode per seed, acting with `agent.act` in new environments.

    The normalizer is frozen, and no random stream of the training is touched. A signal ends it with what there is.
    """
    if render_mode and len(seeds) > 1:  # one after the other: a window each, or all frames of an episode in memory
        episodes = [evaluate(agent, [seed], render_mode, videos) for seed in seeds]
        return tuple(np.concatenate(each) for each in zip(*episodes))
    returns, lengths = np.zeros(len(seeds)), np.zeros(len(seeds), int)
    seed_global_rng(seeds[0])
    envs = [make_env(agent.args, render_mode, evaluation_episode=i) for i in range(len(seeds))]
    if videos:
        recorded = {"video_folder": str(videos), "episode_trigger": lambda _: True, "disable_logger": True}
        with warnings.catch_warnings(action="ignore"):  # that the folder is there already
            envs = [gym.wrappers.RecordVideo(env, name_prefix=f"seed-{seeds[0]}", **recorded) for env in envs]
    obs = {i: env.reset(seed=seed)[0] for i, (env, seed) in enumerate(zip(envs, seeds))}  # of episodes that go on
    while obs and not stop_signals:
        for i, action in zip(list(obs), agent.act(np.stack(list(obs.values())))):
            obs[i], reward, terminated, truncated, _ = envs[i].step(action)
            returns[i] += reward
            lengths[i] += 1
            if terminated or truncated:
                del obs[i]
    for env in envs:
        env.close()
    return returns, lengths


def evaluation_seeds(args: Args, global_step: int, final: bool = False) -> list[int]:
    """Odd seeds for a final evaluation, even ones for those during training, so that no seed serves both."""
    count = args.final_eval_episodes if final else args.eval_episodes
    return [seed - seed % 2 + int(final) for seed in episode_seeds(args.seed, EVALUATION, global_step, count=count)]


def mean_and_std(x) -> tuple[float, float]:
    """Mean and standard deviation with ddof 1 (0 for a single value)."""
    return float(np.mean(x)), float(np.std(x, ddof=1)) if len(x) > 1 else 0.0


def evaluate_checkpoint(given: Args):
    """--evaluate: print a saved policy's returns, which for best.pt and last.pt are those in result.json.

    All flags are the checkpoint's, but for those that say how to evaluate.
    """
    path = Path(given.evaluate).expanduser()
    checkpoint = load_checkpoint(path)
    own = ("evaluate", "final_eval_episodes", "render", "capture_video", "num_threads", "cuda")
    args = replace(Args(**checkpoint["args"]), **{name: getattr(given, name) for name in own})
    for name, value in asdict(given).items():
        if name not in FREE_ON_RESUME and value not in (getattr(args, name), getattr(Args, name)):
            its_own = f"{flag(name)} is the checkpoint's own, {getattr(args, name)}"
            refuse(f"{its_own}; beside --evaluate go only {', '.join(map(flag, own[1:]))}")
    check_args(args)
    videos = path.with_suffix(".videos") if args.capture_video else None
    if videos and videos.exists():
        refuse(f"{videos} exists already; move it away to record again")
    render_mode = "human" if args.render else "rgb_array" if videos else None
    agent, seeds = agent_of(checkpoint, args), evaluation_seeds(args, checkpoint["global_step"], final=True)
    returns, lengths = evaluate(agent, seeds, render_mode, videos)
    for i, (episode_return, length) in enumerate(zip(returns, lengths), start=1):
        say(f"episode {i}: return {episode_return:.3f}, length {length}")
    mean, std = mean_and_std(returns)
    say(f"step {checkpoint['global_step']:,}: mean return {mean:.3f}, std {std:.3f} (ddof 1)")
    if videos:
        say(f"videos are in {videos}")


# The boundary between a task and everything else

mujoco_warnings: list[str] = []  # where MuJoCo reports an unstable simulation, which it otherwise hides
open_tasks: list["Task"] = []


class NotFinite(Exception):
    """A number is not finite; `facts` say what it is, and where it is met again."""

    def __init__(self, **facts):
        super().__init__(f"not finite: {facts}")
        self.facts = facts


class TaskExit(RuntimeError):
    """A task that ends the program (a missing licence, a closed window) has failed."""

    def __init__(self, stop: SystemExit):
        super().__init__(f"the task ended the program, with exit code {stop.code}")


def check_finite(what: str, numbers: dict):
    """NotFinite, with their names, if any of these numbers and tensors are not."""
    bad = [name for name, x in numbers.items() if not torch.as_tensor(x).isfinite().all()]
    if bad:
        values = {name: str(x) for name, x in numbers.items() if isinstance(x, float)}  # JSON has no NaN
        raise NotFinite(what=what, not_finite=bad, **values)


class Task(gym.Wrapper):
    """One environment, held to what its spaces promise: all that comes from a task passes here.

    Observations become float64 arrays of the space's shape (else ValueError), which the next step may overwrite,
    rewards floats, ends bools; the task gets an action of its own in the space's dtype, which it may change. A number
    that is not finite raises NotFinite with the episode's seed and the step in it, where it is met again, and `facts`.
    """

    def __init__(self, env: gym.Env, facts: dict):
        super().__init__(env)
        self.facts = facts
        self.obs_shape, self.action_dtype = env.observation_space.shape, env.action_space.dtype
        with suppress(AttributeError):  # in some tasks it is a property
            self.unwrapped.action_space = deepcopy(self.unwrapped.action_space)  # copies of a task often share it
        open_tasks.append(self)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        self.facts |= {"episode_seed": seed, "episode_step": 0}
        self.unwrapped.action_space.seed(seed)  # some tasks draw from it
        try:
            obs, info = self.env.reset(seed=seed, options=options)
        except SystemExit as stop:
            raise TaskExit(stop) from stop
        return self.checked(obs), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.facts["episode_step"] += 1
        try:
            obs, reward, terminated, truncated, info = self.env.step(np.array(action, self.action_dtype))
        except SystemExit as stop:
            raise TaskExit(stop) from stop
        reward = np.asarray(reward, float).item()
        return self.checked(obs, reward), reward, bool(terminated), bool(truncated), info

    def checked(self, obs, reward: float = 0.0) -> np.ndarray:
        obs = np.asarray(obs, float)
        if obs.shape != self.obs_shape:
            raise ValueError(f"an observation has the shape {obs.shape}, where the space promises {self.obs_shape}")
        if not math.isfinite(obs.dot(obs) + reward):  # the square of a large number may be infinite: look closer
            for what, x in (("an observation", obs), ("a reward", reward)):
                if not np.isfinite(x).all():
                    raise NotFinite(what=what, **self.facts, value=str(x))
        return obs

    def close(self):
        if self in open_tasks:  # once: a task may fail at the second time
            open_tasks.remove(self)
            super().close()


def make_env(args: Args, render_mode: str | None = None, **facts) -> Task:
    """One environment of the task; observations that are no vector are flattened, as CleanRL does.

    `facts` are told where a number is not finite. What MuJoCo says of the model file while it loads is dropped.
    """
    mujoco = load_mujoco()
    seen, options = len(mujoco_warnings), {"max_episode_steps": args.max_episode_steps, "disable_env_checker": True}
    if render_mode:  # a task need not know the keyword
        options["render_mode"] = render_mode
    try:
        env = gym.make(args.env_id, **options)
    except SystemExit as stop:
        raise TaskExit(stop) from stop
    del mujoco_warnings[seen:]
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    if render_mode and getattr(renderer, "camera_id", None) == -1:  # stays where the robot starts
        renderer.camera_id = mujoco.mj_name2id(renderer.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")  # or -1 again
    if not isinstance(env.observation_space, gym.spaces.Box) or len(env.observation_space.shape) != 1:
        env = gym.wrappers.FlattenObservation(env)
    return Task(env, facts)


def load_mujoco():
    """MuJoCo, its warnings heard. It loads OpenGL at once, of the kind that MUJOCO_GL names, which may be missing."""
    try:
        import mujoco
    except Exception as error:  # an ImportError, an AttributeError, a RuntimeError: each kind fails in its own way
        sentence = f"MuJoCo does not start with MUJOCO_GL={os.environ.get('MUJOCO_GL')} on this machine"
        refuse(f"{sentence}: {first_line(error)}; training needs none, {HOW_TO_DRAW}")
    mujoco.set_mju_user_warning(mujoco_warnings.append)
    return mujoco


TRAINING, EVALUATION, GLOBAL_RNG = 0, 1, 2


def episode_seeds(seed: int, *key: int, count: int = 1) -> list[int]:
    """Seeds of 31 bits (some simulators keep theirs in a C int), a stream of its own for every key: (TRAINING, env,
    episode), (EVALUATION, global_step) and (GLOBAL_RNG, global_step).
    """
    return (np.random.SeedSequence(seed, spawn_key=key).generate_state(count) >> 1).tolist()


def seed_global_rng(seed: int):
    """Python's, NumPy's and torch's global generators: a task may draw from them, nothing here does.

    Seeded anew before each rollout and each evaluation, they are the same in a resumed run.
    """
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


# Arguments

SCRIPT = Path(__file__).name
HOW_TO_DRAW = "a window needs a screen, videos MUJOCO_GL=egl, or MUJOCO_GL=osmesa and the package libosmesa6"
EXIT_BAD_ARGUMENTS, EXIT_FAILURE, EXIT_STOPPED = 2, 3, 75
POSITIVE, FRACTION = ("positive", lambda x: 0 < x < math.inf), ("between 0 and 1", lambda x: 0 <= x <= 1)
RULES = {"seed": ("from 0 to 2^63 - 1", lambda x: 0 <= x < 2**63), "gamma": FRACTION, "gae_lambda": FRACTION}
RULES |= dict.fromkeys(("learning_rate", "clip_coef", "max_grad_norm", "target_kl"), POSITIVE)
RULES["log_std_init"] = "from -20 to 20", lambda x: -20 <= x <= 20
RULES_BY_TYPE = {int: ("at least 1", lambda x: x >= 1), float: ("a finite number", math.isfinite)}


def say(text: str):
    """Print a line, above the progress bar; a reader that has left (`| head`, a closed terminal) ends no training."""
    try:
        tqdm.write(text)
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def refuse(sentence: str):
    """End the program with one sentence about its input."""
    print(f"{Path(sys.argv[0]).name}: error: {sentence}", file=sys.stderr)
    raise SystemExit(EXIT_BAD_ARGUMENTS)


def flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def first_line(error: BaseException) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def draw_once(args: Args):
    """Show or record an episode of one step, by a policy that has learned nothing; refuse what cannot be drawn."""
    args, folder = replace(args, max_episode_steps=1), tempfile.TemporaryDirectory()
    with refusing(f"cannot draw {args.env_id}", HOW_TO_DRAW), folder, warnings.catch_warnings(action="ignore"):
        task = make_env(args)
        agent = Agent(task.observation_space, task.action_space, args)
        if args.render:
            evaluate(agent, [0], "human")
        else:
            evaluate(agent, [0], "rgb_array", Path(folder.name))
            if not any(Path(folder.name).iterdir()):
                raise ValueError("it gives no pictures as rgb_array")


@contextmanager
def refusing(sentence: str, advice: str = ""):
    """What fails in the block is refused; an error that arose in the task's own code keeps its traceback."""
    try:
        yield
    except NotFinite:
        raise
    except Exception as error:  # whatever gymnasium or the task raises
        innermost = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
        if Path(gym.__file__).parent not in innermost.parents and innermost != Path(__file__):
            traceback.print_exception(error)
        refuse(f"{sentence}: {first_line(error)}{advice and f'; {advice}'}")


def check_args(args: Args):
    """Refuse what cannot be trained or evaluated; set the number of threads, which changes the last bits of results."""
    for name, value in asdict(args).items():
        for x in value or (0,) if isinstance(value, tuple) else (value,):  # no layers are refused as one of 0 units
            rule, holds = RULES.get(name) or RULES_BY_TYPE.get(type(x)) or ("", lambda x: True)
            if x is not None and not holds(x):
                refuse(f"{flag(name)} must be {rule}, not {value}")
    if args.batch_size % args.num_minibatches:
        steps = f"{args.batch_size} steps ({args.num_envs} environments x {args.num_steps} steps)"
        refuse(f"{args.num_minibatches} minibatches do not divide a rollout of {steps} evenly")
    if args.norm_adv and args.batch_size == args.num_minibatches:
        refuse("a minibatch must have at least 2 steps, to normalise its advantages; use fewer --num-minibatches")
    if args.last_step < 1:
        refuse(f"--total-timesteps {args.total_timesteps} is less than one rollout of {args.batch_size} steps")
    if args.resume and not args.run_dir and not args.evaluate:
        refuse("--resume needs --run-dir, the folder of the run to continue")
    if args.render and (args.capture_video or not args.evaluate):
        refuse("--render shows the episodes of --evaluate; it does not show training, and excludes --capture-video")
    for extra, wanted, module in (
        ("track", args.track and not args.evaluate, "wandb"),
        ("video", args.capture_video, "moviepy"),
    ):
        if wanted and find_spec(module) is None:
            refuse(f"the package {module} is missing: pip install -e '.[{extra}]'")
    if args.track and not args.evaluate:
        check_wandb()
    if args.cuda and not torch.cuda.is_available():
        refuse("--cuda was asked for, but torch finds no CUDA device")
    check_task(args)
    torch.set_num_threads(args.num_threads)
    threadpool_limits(args.num_threads)


def check_wandb():
    """Refuse to go online without a key; it is looked for where W&B's own programs look."""
    import wandb  # an optional extra

    try:
        online = wandb.setup().settings.mode == "online"
        problem = online and not wandb.login(prompt=False, verify=False) and "it has no key on this machine"
    except wandb.errors.Error as error:
        problem = first_line(error)
    if problem:
        refuse(f"--track cannot log in to Weights & Biases: {problem}; use `wandb login`, or WANDB_MODE=offline")


def check_task(args: Args):
    """Refuse a task that breaks the rules of gymnasium's Env, or cannot be drawn; warn of what else is doubtful."""
    task_id = args.env_id
    with refusing(f"cannot make the task {task_id}"), warnings.catch_warnings(action="ignore"):
        task = make_env(args)  # its warnings are shown again when training makes its environments
    actions, problems = task.action_space, []
    if not (isinstance(actions, gym.spaces.Box) and len(actions.shape) == 1 and actions.dtype.kind == "f"):
        refuse(f"{task_id} has actions in {actions}; only a one-dimensional Box of real numbers is supported")
    with warnings.catch_warnings(record=True, action="always") as notes:
        try:
            check_env(task.unwrapped, skip_render_check=True, skip_close_check=True)
        except (Exception, SystemExit) as error:  # whatever the checker or the task raises
            problems = [first_line(error)]
    problems += [str(note.message).partition("WARN: ")[2].removesuffix("\x1b[0m") for note in notes]
    fine = ("infinity", "symmetric and normalized", "dtype")  # infinite bounds, ranges of actions, types of numbers
    for problem in dict.fromkeys(problems):
        if problem and not any(words in problem for words in fine):
            say(f"warning: gymnasium's check_env says of {task_id}: {problem}")
    with refusing(f"{task_id} does not work as gymnasium's Env should"), suppress(NotFinite):  # training says where
        task.reset(seed=args.seed % 2**31)
        task.step(actions.sample())
    others = f"training keeps {args.num_envs}, and an evaluation makes {args.eval_episodes} more"
    with refusing(f"cannot make {task_id} a second time beside the first ({others})"):
        make_env(args).close()
    task.close()
    if args.render or args.capture_video:
        try:  # in a process of its own, since a missing window or driver may end it in the middle
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                pool.submit(draw_once, args).result()
        except BrokenProcessPool:
            refuse(f"cannot draw {task_id}: it ended the process that tried to; {HOW_TO_DRAW}")
    std = math.exp(args.log_std_init)
    bounds = zip((actions.low / std).tolist(), (actions.high / std).tolist())
    if min(math.erf(high / 2**0.5) - math.erf(low / 2**0.5) for low, high in bounds) < 0.02:  # of 2
        start = f"a policy that starts as Normal(0, {std:.2g}) hardly ever gets there"
        say(f"warning: {task_id} has actions in {actions}; {start}: rescale them with gymnasium's RescaleAction")
    if task.spec.max_episode_steps is None:
        wait = "evaluations wait for their episodes to end, and --resume replays the running one"
        say(f"warning: {task_id} has no time limit: {wait}; --max-episode-steps sets a limit")


# Compilation


def compile_update(training: Training):
    """The compiled `update`, or None, with one line that says why, where it cannot be compiled.

    It is compiled by running it once, on zeros and copies. Shapes never change in a run, so all guards are skipped: the
    compiled function keeps every number that it saw at this first call. What is to change while training must therefore
    be a tensor, which it reads anew at every call. To anneal the entropy bonus, in main, before this and in its loop:

        agent.args = replace(args, ent_coef=torch.tensor(args.ent_coef, device=agent.device))
        agent.args.ent_coef.fill_(args.ent_coef * (1 - before / args.last_step))
    """
    agent, args = training.agent, training.agent.args
    shapes = (len(agent.params["critic.0.weight"]),), (len(agent.params["log_std"]),), (), (), (), ()
    batch = Batch(*(torch.zeros(args.batch_size, *shape, device=agent.device) for shape in shapes))
    index = torch.arange(args.batch_size // args.num_minibatches, device=agent.device)
    step_size = torch.ones(2, device=agent.device)
    options = {"guard_filter_fn": torch.compiler.skip_all_guards_unsafe}
    if not args.cuda:  # C++ calls the kernels; tanh from exp; on small matrices a bias in the next kernel beats addmm
        options |= {"cpp_wrapper": True, "cpp.use_decompose_tanh": True, "pattern_matcher": False}
    start, changed = time.time(), deepcopy((agent.params, training.adam.moments))
    say("compiling the update (up to a minute the first time, seconds from the cache after that) ...")

    def compile_and_run():
        compiled = torch.compile(update, fullgraph=True, dynamic=False, options=options)
        compiled(*changed, args, batch, index, step_size)
        return compiled

    try:
        try:
            compiled = compile_and_run()
        except Exception:  # whoever was killed while compiling may have left half a library in the cache
            from torch._inductor.utils import fresh_cache  # takes seconds

            torch._dynamo.reset()
            with tempfile.TemporaryDirectory() as folder, fresh_cache(dir=folder):
                compiled = compile_and_run()
    except Exception as error:  # no C++ compiler, no Python headers, ...: whatever it is, training can go on
        lines = (line for line in str(error).splitlines() if " error: " in line)  # the C++ compiler's own
        say(f"compilation failed, training goes on uncompiled: {next(lines, first_line(error))}")
        return None
    if not torch._dynamo.utils.counters["stats"]["unique_graphs"]:
        say("torch.compile is switched off (TORCHDYNAMO_DISABLE?), training goes on uncompiled")
        return None
    say(f"compiled in {time.time() - start:.0f} s")
    return compiled


# Checkpoints


def write_atomically(path: Path, data: bytes):
    """Replace `path` in one step: a full disk or a kill half-way leaves what was there."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)  # after a failure: a full disk is not to stay full of it


def save_checkpoint(path: Path, state: dict):
    """Save dicts and lists of tensors and plain Python values."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomically(path, buffer.getvalue())


def load_checkpoint(path: Path) -> dict:
    """What `save_checkpoint` wrote, on the CPU, or a refusal.

    Nothing in the file is executed; but as on the command line, the id of its task can name a module to import.
    """
    if not path.is_file():
        refuse(f"there is no checkpoint {path}")
    try:
        torn = zipfile.ZipFile(path).testzip()  # torch.load looks at no checksum
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:  # torn, foreign and malicious files fail in many ways
        torn, state = True, None
    if torn or not isinstance(state, dict) or not state.keys() >= {"args", "global_step", "params", "normalizer"}:
        refuse(f"{path} is damaged or not a checkpoint of {SCRIPT}")
    unlike = sorted(state["args"].keys() ^ {x.name for x in fields(Args)})
    if unlike:
        refuse(f"{path} was not written by this {SCRIPT}: only one of them has {', '.join(map(flag, unlike))}")
    return state | {"path": str(path)}


def copy_into(tensors: dict[str, torch.Tensor], saved: dict[str, torch.Tensor], path: str):
    """Copy a checkpoint's tensors in place, or refuse it if they are not of the same names and shapes."""
    for name in tensors.keys() | saved.keys():
        have, want = (tuple(x[name].shape) if name in x else "missing" for x in (saved, tensors))
        if have != want:
            refuse(f"{path} does not fit this {SCRIPT}: {name} is {have} there, and {want} here")
    for name, tensor in tensors.items():
        tensor.copy_(saved[name])


def load_agent(path: str | Path) -> Agent:
    """The agent of a checkpoint (best.pt, last.pt, step_N.pt): `action = load_agent(path).act(obs)`."""
    checkpoint = load_checkpoint(Path(path).expanduser())
    return agent_of(checkpoint, replace(Args(**checkpoint["args"]), cuda=False))


def agent_of(checkpoint: dict, args: Args) -> Agent:
    with refusing(f"cannot make the task {args.env_id}"):
        task = make_env(args)
    task.close()
    agent = Agent(task.observation_space, task.action_space, args)
    agent.load(checkpoint)
    return agent


# The run's folder

FREE_ON_RESUME = {"resume", "run_dir", "progress", "track", "capture_video", "checkpoint_interval", "save_every"}
EVALUATION_COLUMNS = "global_step,return_mean,return_std,return_min,return_max,length_mean"
RESUMED = {"adam", "envs", "rng", "progress", "compiled", "machine", "logs"}  # in last.pt alone


def describe_machine() -> dict:
    """Versions, commit and hardware: what the numbers of a run may depend on beside its flags."""
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip() if shutil.which("git") else ""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if sys.platform == "linux" else []
    info = dict(map(str.strip, line.split(":", 1)) for line in lines if ":" in line)
    # Generations of one name may round differently: family and model (x86) or part (ARM) tell them apart
    kind = [info[name] for name in ("model name", "cpu family", "model", "CPU part") if name in info]
    versions = {name: version(name) for name in ("torch", "numpy", "gymnasium", "mujoco", "box2d")}
    return {
        "versions": {"python": platform.python_version(), **versions},
        "git_commit": commit or None,
        "cpu": f"{', '.join(kind) or platform.processor()} ({torch.backends.cpu.get_cpu_capability()})",
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


class Run:
    """The folder of a run: locked while it is at work, never overwritten; what is written there, and how it ends."""

    def __init__(self, args: Args):
        name = f"runs/{args.env_id}__{args.exp_name}__{args.seed}__{int(time.time())}"
        self.args, self.dir = args, Path(args.run_dir or name).expanduser()
        self.machine, self.start, self.compiled = describe_machine(), time.time(), False
        self.last_return = self.last_evaluation = "-"  # shown by the progress bar
        self.stack = ExitStack()  # what is to be closed, however the run ends
        self.progress, self.wandb_run = Progress(), None
        try:
            str(self.dir).encode()
            self.dir.mkdir(parents=True, exist_ok=True)
            begun = [path.name for path in self.dir.iterdir() if path.name != ".lock"]
            table = self.dir / "evaluations.csv"  # it or .lock: a run of ours was here before
            ours = table.is_file() and table.read_bytes().startswith(EVALUATION_COLUMNS.encode())
            known = ours or (self.dir / ".lock").exists()
        except UnicodeEncodeError:  # it has bytes that the locale cannot decode
            refuse(f"this locale cannot spell the folder {ascii(str(self.dir))}; PYTHONUTF8=1 helps")
        except OSError as error:
            refuse(f"cannot write to the run folder {self.dir}: {error.strerror}")
        if begun and not args.resume:
            refuse(f"the run folder {self.dir} is not empty; name another --run-dir, or continue its run with --resume")
        if not known and not any(name.endswith((".pt", "result.json")) for name in begun):
            written = ("config.json", "evaluations.csv", "events.out.tfevents.")
            if any(name.startswith(written) for name in begun):
                refuse(f"the files in {self.dir} are not of a run of {SCRIPT}; name another --run-dir")
        if not (self.dir / "result.json").exists():
            self.lock()
        self.checkpoint = self.find_checkpoint()

    def lock(self):
        """Refuse a folder in which another process is at work; the lock ends with its process, even one killed."""
        try:
            self.stack.enter_context(filelock.FileLock(self.dir / ".lock", blocking=False))
        except filelock.Timeout:
            refuse(f"another process is at work in {self.dir}")
        except NotImplementedError:  # this file system has no locks
            pass
        except OSError as error:
            refuse(f"cannot write to the run folder {self.dir}: {error.strerror}")

    def find_checkpoint(self) -> dict | None:
        """last.pt, if the run can go on from there; exits if it is finished, refuses if it is another one's."""
        last, finished = self.dir / "last.pt", (self.dir / "result.json").exists()
        kept = [last] if last.exists() else [] if finished else sorted(self.dir.glob("*.pt"))[:1]
        for path in kept:
            saved, now = load_checkpoint(path), asdict(self.args)
            changed = [name for name in now if name not in FREE_ON_RESUME and now[name] != saved["args"][name]]
            if changed:
                was = ", ".join(f"{flag(name)} {saved['args'][name]}" for name in changed)
                refuse(f"the run in {self.dir} was started with other flags than these: {was}")
        if finished:
            say(f"the run in {self.dir} is finished")
            raise SystemExit(0)
        for leftover in (*self.dir.glob("*.pt.tmp"), *self.dir.glob("*.json.tmp"), self.dir / "failure.json"):
            leftover.unlink(missing_ok=True)  # of a process that was killed or failed
        if kept != [last]:
            for leftover in self.dir.glob("events.out.tfevents.*"):
                leftover.unlink()
            config = json.dumps({"args": asdict(self.args), **self.machine}, indent=2)
            write_atomically(self.dir / "config.json", config.encode())  # for people: nothing here reads it
            return None
        if not saved.keys() >= RESUMED:
            refuse(f"{last} is no checkpoint to continue from")
        begun = saved["machine"]
        if begun["versions"] != self.machine["versions"]:
            refuse(f"the run in {self.dir} can be continued exactly with its own versions only: {begun['versions']}")
        for name in ("cpu", "git_commit"):
            if begun[name] != self.machine[name]:
                say(f"warning: begun with {name} {begun[name]}, now {self.machine[name]}: its numbers may differ")
        return saved

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        """Close everything; where a number was not finite, say which, where and when, and leave what was saved."""
        try:
            self.stack.close()
        finally:  # where the disk is full, the logs cannot be closed
            self.tell_wandb("finish", 0 if error is None else 1)
            if isinstance(error, NotFinite):
                facts = error.facts | {"global_step": self.progress.global_step, "mujoco_warnings": mujoco_warnings[:5]}
                write_atomically(self.dir / "failure.json", json.dumps(facts, indent=2).encode())
                print(f"{SCRIPT}: numerical failure: {facts} (also in {self.dir / 'failure.json'})", file=sys.stderr)
                raise SystemExit(EXIT_FAILURE)

    def begin_or_resume(self) -> Training:
        """The training, as it was when last.pt was saved; and its logs, where what followed it is dropped."""
        training, saved = Training(self.args), self.checkpoint
        if saved:
            training.load(saved)
            for path in self.dir.glob("events.out.tfevents.*"):
                if path.name not in saved["logs"]:  # begun after the checkpoint: all in it will be logged again
                    path.unlink()
        progress = self.progress = training.progress
        self.start -= progress.wall_seconds  # the time of a resumed run's earlier parts counts too
        self.write_evaluations()
        if self.args.track:
            self.track()
        self.writer = SummaryWriter(self.dir, purge_step=progress.global_step + 1 if saved else None)
        self.stack.callback(self.writer.close)
        if not saved:
            self.log_hyperparameters()
        hidden = None if self.args.progress else True  # None: only where there is no terminal
        steps = {"total": self.args.last_step, "initial": progress.global_step, "unit": " steps", "unit_scale": True}
        self.bar = tqdm(**steps, smoothing=0.05, disable=hidden)
        self.stack.callback(self.bar.close)
        return training

    def track(self):
        """Begin a run in Weights & Biases, or go on with the checkpoint's; offline where there is no network."""
        import wandb  # an optional extra

        names = {"project": self.args.wandb_project_name, "entity": self.args.wandb_entity, "name": self.dir.name}
        names |= {"id": self.progress.wandb_id, "resume": "allow", "config": asdict(self.args)}
        settings = wandb.Settings(init_timeout=30, finish_timeout=10)  # seconds; what is not sent stays on the disk
        try:
            self.wandb_run = wandb.init(**names, settings=settings)
        except wandb.errors.Error as error:
            say(f"warning: W&B goes on offline, for `wandb sync` to send it later: {first_line(error)}")
            self.wandb_run = wandb.init(**names, settings=settings, mode="offline")
        self.progress.wandb_id = self.wandb_run.id
        self.wandb_run.define_metric("*", step_metric="global_step")

    def tell_wandb(self, method: str, value):
        """Call a method of W&B's run, if there is one; when that fails, the training goes on without it."""
        try:
            if self.wandb_run:
                getattr(self.wandb_run, method)(value)
        except Exception as error:  # its own process has died, a disk is full, ...
            say(f"warning: W&B failed, and is told nothing more: {first_line(error)}")
            self.wandb_run = None

    def log_scalars(self, scalars: dict[str, float], step: int):
        """To TensorBoard and to W&B, where each call is a row of its own: episodes may end at the same step."""
        for name, value in scalars.items():
            self.writer.add_scalar(name, value, step)
        self.tell_wandb("log", scalars | {"global_step": step})

    def log_hyperparameters(self):
        """The flags, as text and in the HParams tab, and which charts stand together under Custom Scalars."""
        flags = asdict(self.args)
        table = "".join(f"|{name}|{value}|\n" for name, value in flags.items())
        self.writer.add_text("hyperparameters", f"|flag|value|\n|-|-|\n{table}")
        plain = {k: v if isinstance(v, bool | int | float | str) else str(v) for k, v in flags.items()}
        for summary in hparams(plain, {"final/best_mean": 0, "final/last_mean": 0}):
            self.writer.file_writer.add_summary(summary)  # add_hparams would make a subfolder
        charts = {"return": ["Multiline", ["eval/return_mean", "charts/episodic_return"]]}
        self.writer.add_custom_scalars({"charts": charts})

    def compile(self, training: Training):
        """`update`, compiled if that is wanted and possible, and if the run was begun so."""
        begun = self.checkpoint["compiled"] if self.checkpoint else None
        compiled = compile_update(training) if self.args.compile and begun is not False else None
        self.compiled = compiled is not None
        self.exit_if_stopped()
        if begun and not self.compiled:
            refuse(f"the run in {self.dir} was compiled, and continues exactly only so")
        gc.freeze()  # the garbage collector need not look through all of torch again and again
        return compiled or update

    def log(self, scalars: dict[str, float], episodes: list[tuple[int, float, int]]):
        """An iteration's numbers, and its episodes' (step, return, length)."""
        step = self.progress.global_step
        for episode_step, episode_return, length in episodes:
            ended = {"charts/episodic_return": episode_return, "charts/episodic_length": length}
            self.log_scalars(ended, episode_step)
            self.last_return = f"{episode_return:.1f}"
            if episode_step > 0.9 * self.args.total_timesteps:
                self.progress.late_returns.append(episode_return)
        self.log_scalars(scalars | {"charts/mujoco_warnings": len(mujoco_warnings)}, step)
        self.bar.set_postfix_str(f"return {self.last_return}, evaluation {self.last_evaluation}", refresh=False)
        self.bar.update(self.args.batch_size)

    def evaluate_if_due(self, agent: Agent) -> bool:
        """At the first rollout's end at or after each multiple of --eval-interval, and at the end; whether it was.

        One that a signal ends leaves no trace, and is made when the run is continued.
        """
        args, progress, step = self.args, self.progress, self.progress.global_step
        due = passed(args.eval_interval, max(step - args.batch_size, 0), step) or step == args.last_step
        if not due or (progress.evaluations and progress.evaluations[-1][0] == step):
            return False
        returns, lengths = evaluate(agent, evaluation_seeds(args, step))
        if stop_signals:
            return False
        mean, std = mean_and_std(returns)
        progress.evaluations.append((step, mean, std, *map(float, (returns.min(), returns.max(), lengths.mean()))))
        self.write_evaluations()
        scalars = {"return_mean": mean, "return_std": std, "episode_length": lengths.mean()}
        self.log_scalars({f"eval/{name}": value for name, value in scalars.items()}, step)
        if mean > progress.best_return:
            progress.best_return = mean
            self.save("best.pt", agent, selection_return=mean)
        self.last_evaluation = f"{mean:.1f}"
        if args.progress:
            rate = f"best {progress.best_return:.1f}, {step / progress.train_seconds:.0f} steps/s"
            say(f"step {step:,}: evaluation return {mean:.1f} +- {std:.1f}, {rate}")
        return True

    def write_evaluations(self):
        rows = [EVALUATION_COLUMNS, *(",".join(map(str, row)) for row in self.progress.evaluations)]
        write_atomically(self.dir / "evaluations.csv", "".join(f"{row}\n" for row in rows).encode())

    def save(self, name: str, agent: Agent, **more):
        """A checkpoint that acts: the agent, the flags and the step; `more` goes with it."""
        policy = {"args": asdict(self.args), "global_step": self.progress.global_step, **agent.state()}
        save_checkpoint(self.dir / name, policy | more)

    def save_last(self, training: Training):
        """The checkpoint that continues the run."""
        self.writer.flush()
        self.progress.wall_seconds = time.time() - self.start
        logs = [path.name for path in self.dir.glob("events.out.tfevents.*")]
        more = {"compiled": self.compiled, "machine": self.machine, "logs": logs}
        self.save("last.pt", training.agent, **training.state(), **more)

    def exit_if_stopped(self):
        """Exit if a signal has asked for it, and say how to go on."""
        if stop_signals:
            missing = [] if self.args.run_dir else ["--run-dir", str(self.dir)]
            missing += [] if self.args.resume else ["--resume"]
            command = shlex.join([sys.executable, *sys.argv, *missing])
            say(f"\nstopped by {signal.Signals(stop_signals[0]).name}; continue with\n    {command}")
            raise SystemExit(EXIT_STOPPED)

    def finish(self, agent: Agent):
        """The final evaluation of the best and the last policy; then result.json, the sign that the run is complete."""
        args, progress, final = self.args, self.progress, {}
        for name in ("best", "last"):
            saved = load_checkpoint(self.dir / f"{name}.pt")
            agent.load(saved)
            videos = self.dir / "videos" if args.capture_video and name == "best" else None
            seeds = evaluation_seeds(args, saved["global_step"], final=True)
            returns, _ = evaluate(agent, seeds, "rgb_array" if videos else None, videos)
            self.exit_if_stopped()
            mean, std = mean_and_std(returns)
            final[name] = {"global_step": saved["global_step"], "returns": returns.tolist(), "mean": mean, "std": std}
            say(f"{name}: return {mean:.1f} +- {std:.1f} at step {saved['global_step']:,}")
        # one step on: if a kill precedes result.json, the resumed run drops it
        self.log_scalars({f"final/{name}_mean": final[name]["mean"] for name in final}, progress.global_step + 1)
        self.writer.flush()
        final["best"]["selection_return"] = progress.best_return
        flags = ("env_id", "exp_name", "seed", "total_timesteps", "refinement_depth", "refinement_schedule")
        result = {name: getattr(args, name, None) for name in flags} | final  # None: PPO has no refinement
        result["std_ddof"] = 1
        result["train_return_last10pct"] = float(np.mean(progress.late_returns)) if progress.late_returns else None
        result["wall_time_s"] = time.time() - self.start
        result["sps"] = progress.global_step / progress.train_seconds
        write_atomically(self.dir / "result.json", json.dumps(result, indent=2).encode())
        with suppress(OSError):  # Windows removes no open file
            (self.dir / ".lock").unlink()
        say(f"the run is in {self.dir}; look at it with: tensorboard --logdir {shlex.quote(str(self.dir))}")


# Signals

stop_signals: list[int] = []


def catch_signals():
    """SIGTERM, Ctrl-C, Slurm's SIGUSR1 and, without nohup, a closed terminal ask a run to save and stop."""
    for name in ("SIGTERM", "SIGINT", "SIGUSR1", "SIGHUP"):
        signum = getattr(signal, name, None)  # Windows lacks the last two
        if signum and (name != "SIGHUP" or signal.getsignal(signum) is not signal.SIG_IGN):
            signal.signal(signum, request_stop)


def request_stop(signum, _):
    stop_signals.append(signum)
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a second Ctrl-C stops at once
    with suppress(OSError):  # nobody may be left to read it
        os.write(2, b"\nstopping after this iteration ...\n")  # print() may be in the middle of a line


if __name__ == "__main__":
    sys.stdout, sys.stderr = (stream or open(os.devnull, "w") for stream in (sys.stdout, sys.stderr))  # may be closed
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="backslashreplace")  # a locale may lack the letters of a path
    try:
        main()
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        sys.exit(f"{SCRIPT}: error: {error.strerror}; every checkpoint saved before is intact")
    finally:
        for task in list(open_tasks):
            task.close()

# What `uv run` and `pipx run` install to run this file alone (inline script metadata, PEP 723):
# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "torch==2.13.0",
#     "gymnasium[mujoco,box2d]==1.4.0",
#     "mujoco>=4.0,<5",
#     "numpy>=2.0",
#     "tensorboard>=2.21",
#     "tyro>=1.0",
#     "tqdm>=4.66",
#     "threadpoolctl>=3.1",
#     "filelock>=3.16",
# ]
# ///
