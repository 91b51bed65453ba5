"""RefinePPO: PPO for continuous control whose action mean is built in K steps (Iterative Action Refinement).

    m_0 = 0,   m_{k+1} = m_k + c_{k+1} f(s, m_k),   k = 0..K-1,   a ~ Normal(m_K, exp(log_std))

One network f serves every step, and gradients flow through the whole chain. The rest is plain PPO: it differs from
`ppo_continuous.py` in the flags of the refinement, the actor and the `refinement/*` logs, and in nothing else.

    python refineppo_continuous.py --env-id HalfCheetah-v5 --refinement-depth 4 --refinement-schedule average
    python refineppo_continuous.py --evaluate runs/.../best.pt --render
    tensorboard --logdir runs

Why it is fast: one observation goes through the actor in NumPy on views of the parameters (torch's overhead per call
is larger than the arithmetic), whatever acting does not need is computed once per rollout in one batch, and a
minibatch update (loss, gradient, clipping, Adam) is one compiled function.
"""

import errno
import fcntl
import gc
import io
import json
import math
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import time
import warnings
import zipfile
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from itertools import accumulate
from pathlib import Path
from typing import Literal

import gymnasium as gym
import mujoco
import numpy as np
import torch
import tyro
from threadpoolctl import threadpool_limits
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from tqdm import tqdm


@dataclass
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
    """continue the run in --run-dir where its last checkpoint left it; a finished run is left as it is"""

    # The paper's idea
    refinement_depth: int = 4
    """K, the number of refinement steps that build the action mean"""
    refinement_schedule: Literal["average", "uniform", "inverse"] = "average"
    """the step sizes c_k: average 1/K, uniform 1, inverse 1/k"""

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
    """weight of the entropy bonus"""
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
    """episodes of each evaluation during training"""
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
    """threads of torch; sweeps fill cores with processes instead"""
    torch_deterministic: bool = True
    """allow only deterministic algorithms on the GPU; on the CPU there are no others here"""
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
    def num_iterations(self) -> int:
        """Rollouts in the whole run; as in CleanRL, a last incomplete one is left out."""
        return self.total_timesteps // self.batch_size


SCRIPT = Path(__file__).name
EXIT_BAD_ARGUMENTS, EXIT_FAILURE, EXIT_STOPPED = 2, 3, 75
FREE_ON_RESUME = {"resume", "run_dir", "progress", "track", "capture_video", "checkpoint_interval"}


def refuse(sentence: str):
    """End the program with one sentence about its input."""
    print(f"{Path(sys.argv[0]).name}: error: {sentence}", file=sys.stderr)
    raise SystemExit(EXIT_BAD_ARGUMENTS)


def first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def check_args(args: Args) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Refuse what cannot be trained before any work starts; return the task's observation and action space."""
    counts = "total_timesteps num_envs num_steps num_minibatches update_epochs eval_interval eval_episodes num_threads"
    counts += " final_eval_episodes checkpoint_interval save_every actor_hidden critic_hidden"
    counts += " refinement_depth"
    rules = (
        ("at least 1", counts, lambda x: x >= 1),
        ("positive", "learning_rate clip_coef max_grad_norm target_kl", lambda x: 0 < x < math.inf),
        ("between 0 and 1", "gamma gae_lambda", lambda x: 0 <= x <= 1),
        ("a finite number", "ent_coef vf_coef log_std_init", math.isfinite),
        ("from 0 to 2^63 - 1", "seed", lambda x: 0 <= x < 2**63),
    )
    for rule, names, holds in rules:
        for name in names.split():
            value = getattr(args, name)
            if value is not None and not all(map(holds, (value or (0,)) if isinstance(value, tuple) else (value,))):
                refuse(f"--{name.replace('_', '-')} must be {rule}, not {value}")
    if args.batch_size % args.num_minibatches:
        steps = f"{args.batch_size} steps ({args.num_envs} environments x {args.num_steps} steps)"
        refuse(f"{args.num_minibatches} minibatches do not divide a rollout of {steps} evenly")
    if args.batch_size == args.num_minibatches:
        refuse("a minibatch must have at least 2 steps, to normalise its advantages; use fewer --num-minibatches")
    if args.num_iterations < 1:
        refuse(f"--total-timesteps {args.total_timesteps} is less than one rollout of {args.batch_size} steps")
    if args.resume and not args.run_dir:
        refuse("--resume needs --run-dir, the folder of the run to continue")
    if args.render and not args.evaluate:
        refuse("--render shows the episodes of --evaluate; training is not shown")
    for extra, wanted, module in (("track", args.track, "wandb"), ("video", args.capture_video, "moviepy")):
        if wanted and find_spec(module) is None:
            refuse(f"the package {module} is missing: pip install -e '.[{extra}]'")
    if args.cuda and not torch.cuda.is_available():
        refuse("--cuda was asked for, but torch finds no CUDA device")
    try:
        with warnings.catch_warnings(action="ignore"):  # shown again when training makes its environments
            task = make_env(args.env_id)
    except Exception as error:  # unknown id, missing module or package: whatever gymnasium or the module raises
        refuse(f"cannot make the task {args.env_id}: {first_line(error)}")
    task.close()
    if task.spec.max_episode_steps is None and not args.evaluate:
        print(f"warning: {args.env_id} has no time limit; --resume replays the running episode, however long")
    for what, space in (("observations", task.observation_space), ("actions", task.action_space)):
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or space.shape[0] < 1:
            refuse(f"{args.env_id} has {what} in {space}; only a one-dimensional Box is supported")
    return task.observation_space, task.action_space


def limit_threads(args: Args):
    """torch's threads and NumPy's, the number of which decides the last bits of their results."""
    torch.set_num_threads(args.num_threads)
    threadpool_limits(args.num_threads)


# --- Environment ------------------------------------------------------------------------------------------------------

mujoco_warnings: list[str] = []  # where MuJoCo reports an unstable simulation, which it otherwise hides
mujoco.set_mju_user_warning(mujoco_warnings.append)


def make_env(env_id: str, render_mode: str | None = None) -> gym.Env:
    """One environment of the task; what MuJoCo says of the model file while it loads is dropped."""
    seen = len(mujoco_warnings)
    rendering = {"render_mode": render_mode} if render_mode else {}  # a task need not know the keyword
    env = gym.make(env_id, disable_env_checker=True, **rendering)
    del mujoco_warnings[seen:]
    return env


def episode_seeds(seed: int, *key: int, count: int = 1) -> list[int]:
    """Seeds for `env.reset`, a stream of its own for every key: (0, env, episode) trains, (1, step) evaluates."""
    return np.random.SeedSequence(seed, spawn_key=key).generate_state(count).tolist()


class Environments:
    """N copies of a task, stepped one after the other; one whose episode ends starts the next at once.

    gymnasium's SyncVectorEnv does the same under SAME_STEP autoreset, but merges every info dict: 100 us a step where
    HalfCheetah takes 60. Every episode has a seed of its own, so that its seed and its actions replay it exactly.
    """

    def __init__(self, env_id: str, num_envs: int, seed: int):
        self.env_id, self.seed = env_id, seed
        self.envs = [None] * num_envs
        self.episodes = [0] * num_envs  # episodes started
        self.actions = [[] for _ in range(num_envs)]  # since the running episode's start
        self.returns = [0.0] * num_envs  # of the running episode, raw: before any normalisation
        self.obs = np.stack([self.reset(i) for i in range(num_envs)])

    def reset(self, i: int) -> np.ndarray:
        """Start environment i's next episode."""
        if self.envs[i] is None or "BipedalWalker" in self.env_id:  # this one's Box2D world keeps state between
            self.envs[i] = make_env(self.env_id)  # episodes: only in a new world can one be replayed exactly
        (seed,) = episode_seeds(self.seed, 0, i, self.episodes[i])
        self.episodes[i] += 1
        self.actions[i], self.returns[i] = [], 0.0
        return self.envs[i].reset(seed=seed)[0]

    def step_one(self, i: int, action: np.ndarray) -> tuple:
        """Step environment i and record what its replay and its return need."""
        obs, reward, terminated, truncated, _ = self.envs[i].step(action)
        self.actions[i].append(action)
        self.returns[i] += float(reward)
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
                ended[i] = np.array(obs), self.returns[i], len(self.actions[i])
                obs = self.reset(i)
            self.obs[i] = obs
            rewards.append(reward)
            terminated.append(terminal)
            truncated.append(timeout)
        return self.obs, rewards, terminated, truncated, ended

    def state(self) -> dict:
        """How many episodes each environment has started, its actions since the last one's start, and where it is."""
        actions = [torch.tensor(np.array(a)) for a in self.actions]
        return {"episodes": self.episodes, "actions": actions, "obs": torch.tensor(self.obs)}

    def load(self, state: dict):
        """Bring every environment exactly to where it was, by replaying its running episode."""
        for i, actions in zip(range(len(self.envs)), state["actions"], strict=True):
            self.episodes[i] = state["episodes"][i] - 1
            self.obs[i] = self.reset(i)
            for action in actions.numpy():
                self.obs[i], *_ = self.step_one(i, action)
        if not np.array_equal(self.obs, state["obs"].numpy()):
            print(f"warning: {self.env_id} does not repeat itself, so that the resumed run will differ")


# --- Normaliser -------------------------------------------------------------------------------------------------------


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
    columns = zip(x.T.tolist(), decay.T.tolist(), initial.tolist())  # floats: faster than small arrays
    sums = [accumulate(zip(xs, ds), lambda y, xd: xd[0] + xd[1] * y, initial=y) for xs, ds, y in columns]
    return np.array([list(column)[1:] for column in sums]).T


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
            std = np.sqrt(self.obs.squares / self.obs.count.item() + 1e-8)
            obs = np.minimum(np.maximum((obs - self.obs.mean) / std, -10.0), 10.0)  # np.clip is slower
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

    def tensors(self) -> dict[str, torch.Tensor]:
        """Everything that changes, as tensors that share its memory."""
        arrays = {f"obs.{name}": array for name, array in vars(self.obs).items()}
        arrays |= {f"returns.{name}": array for name, array in vars(self.returns).items()}
        return {name: torch.from_numpy(array) for name, array in (arrays | {"discounted": self.discounted}).items()}


# --- Actor and critic -------------------------------------------------------------------------------------------------

ARRAY_OPS = np.ndarray.dot, np.tanh  # dot: on small arrays half the time of @
TENSOR_OPS = torch.mm, torch.tanh


def refinement_coefficients(schedule: str, depth: int) -> list[float]:
    """c_1, ..., c_K of the paper's three schedules; for K = 1 all are [1]."""
    schedules = {"average": lambda k: 1 / depth, "uniform": lambda k: 1.0, "inverse": lambda k: 1 / k}
    return [schedules[schedule](k) for k in range(1, depth + 1)]


class Actor:
    """The policy mean m_K, refined from m_0 = 0 (Algorithm 1, lines 1 to 4), in tensors or in arrays.

    f is a tanh network over concat(s, m); its weights come with every call, as `layers` gives them.
    """

    def __init__(self, obs_dim: int, action_dim: int, args: Args):
        self.obs_dim = obs_dim
        self.sizes = [obs_dim + action_dim, *args.actor_hidden, action_dim]
        self.coefficients = refinement_coefficients(args.refinement_schedule, args.refinement_depth)

    def proposals(self, weights: list, obs) -> list:
        """m_1, ..., m_K by m_{k+1} = m_k + c_{k+1} f(s, m_k), each (batch, action_dim); obs is (batch, obs_dim)."""
        dot, tanh = ARRAY_OPS if isinstance(obs, np.ndarray) else TENSOR_OPS
        (w, b), *hidden, (w_out, b_out) = weights
        w_s, w_m = w[: self.obs_dim], w[self.obs_dim :]
        state_share = dot(obs, w_s) + b  # W [s; m] = W_s s + W_m m, of which W_s s is the same at every step
        m, proposals = None, []
        for c in self.coefficients:
            x = tanh(state_share if m is None else state_share + dot(m, w_m))  # m_0 = 0
            for w, b in hidden:
                x = tanh(dot(x, w) + b)
            correction = c * (dot(w_out.T, x.T).T + b_out)  # x w_out: BLAS is faster with the narrow side first
            m = correction if m is None else m + correction
            proposals.append(m)
        return proposals

    def mean(self, weights: list, obs):
        """m_K, (batch, action_dim)."""
        return self.proposals(weights, obs)[-1]


def refinement_scalars(proposals: list[torch.Tensor], low: torch.Tensor, high: torch.Tensor) -> dict[str, float]:
    """What the refinement does, from m_1, ..., m_K, each (batch, action_dim).

    correction_norm_k: mean norm of c_k f; settling_error_k: e_k of the paper, averaged over the action components;
    outside_bounds_k: fraction of the proposals m_k with a component outside the action bounds.
    """
    scalars, last, before = {}, proposals[-1], 0
    for k, m in enumerate(proposals, start=1):
        scalars[f"correction_norm_{k}"] = (m - before).norm(dim=-1).mean()
        scalars[f"settling_error_{k}"] = ((last - m).abs().mean(0) / (last.abs().mean(0) + 1e-8)).mean()
        scalars[f"outside_bounds_{k}"] = ((m < low) | (m > high)).any(-1).float().mean()
        before = m
    return {f"refinement/{name}": value.item() for name, value in scalars.items()}


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


def init_moments(params: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Adam's running averages of every parameter's gradient and of its square."""
    return {f"{name}.{moment}": torch.zeros_like(p) for name, p in params.items() for moment in ("mean", "square")}


def layers(params: dict, name: str) -> list[tuple]:
    """The (weight, bias) pairs of the network `name`, first to last."""
    tensors = [p for key, p in params.items() if key.startswith(name)]
    return list(zip(tensors[::2], tensors[1::2]))


def critic_value(weights: list, obs: torch.Tensor) -> torch.Tensor:
    """V(s), (batch,), of normalised observations (batch, obs_dim)."""
    *hidden, (w_out, b_out) = weights
    for w, b in hidden:
        obs = torch.tanh(obs @ w + b)
    return (w_out.T @ obs.T).squeeze(0) + b_out


class Agent:
    """The policy, the value function and the normaliser: all that a checkpoint needs to act."""

    def __init__(self, obs_space: gym.spaces.Box, action_space: gym.spaces.Box, args: Args):
        self.args, self.device = args, torch.device("cuda" if args.cuda else "cpu")
        self.low, self.high = action_space.low, action_space.high
        obs_dim, action_dim = obs_space.shape[0], action_space.shape[0]
        self.actor = Actor(obs_dim, action_dim, args)
        sizes = {"actor": self.actor.sizes, "critic": [obs_dim, *args.critic_hidden, 1]}
        self.params = {name: p.to(self.device) for name, p in init_params(sizes, args).items()}
        self.normalizer = Normalizer(args.num_envs, obs_dim, args)

    def arrays(self) -> dict[str, np.ndarray]:
        """The parameters to act with: on the CPU views that follow every update, on a GPU copies."""
        return {name: p.cpu().numpy() for name, p in self.params.items()}

    def tensors(self) -> dict[str, dict[str, torch.Tensor]]:
        return {"params": self.params, "normalizer": self.normalizer.tensors()}

    def load(self, checkpoint: dict):
        for part, tensors in self.tensors().items():
            copy_into(tensors, checkpoint[part])


def copy_into(tensors: dict[str, torch.Tensor], saved: dict[str, torch.Tensor]):
    """Copy saved tensors in place; ValueError if they are not the same ones."""
    if {name: x.shape for name, x in tensors.items()} != {name: x.shape for name, x in saved.items()}:
        raise ValueError
    for name, tensor in tensors.items():
        tensor.copy_(saved[name])


# --- Rollout and advantages -------------------------------------------------------------------------------------------


@dataclass
class Rollout:
    """T steps in N environments, and the episodes that ended in them."""

    obs: np.ndarray  # (T + 1, N, obs_dim), normalised
    next_obs: np.ndarray  # (T, N, obs_dim), raw, what each step led to: the last observation where an episode ended
    actions: np.ndarray  # (T, N, action_dim), before they are clipped to the bounds
    logprobs: np.ndarray  # (T, N)
    rewards: np.ndarray  # (T, N), raw
    terminated: np.ndarray  # (T, N)
    truncated: np.ndarray  # (T, N)
    final_obs: dict[tuple[int, int], np.ndarray]  # (t, i) -> last observation of the episode that ended, normalised
    first_obs: dict[tuple[int, int], np.ndarray]  # (t, i) -> first observation of the episode that followed, raw
    episodes: list[tuple[int, float, int]]  # (steps into the rollout, raw return, length)


def collect(agent: Agent, envs: Environments, obs: np.ndarray, num_steps: int, rng: np.random.Generator) -> Rollout:
    """Act with a = m + exp(log_std) * noise from the normalised obs (N, obs_dim) on; values can wait for the batch.

    The actor runs in NumPy: for one observation torch's overhead per call is larger than the arithmetic.
    """
    arrays = agent.arrays()
    weights, log_std, num_envs = layers(arrays, "actor"), arrays["log_std"], len(obs)
    noise = rng.standard_normal((num_steps, num_envs, len(log_std)), dtype=np.float32)
    perturbation = noise * np.exp(log_std)
    # the density of a depends on the noise alone: a - m = exp(log_std) * noise
    logprobs = -(0.5 * noise**2 + log_std + 0.5 * math.log(2 * math.pi)).sum(-1)
    all_obs, actions = np.empty((num_steps + 1, *obs.shape), np.float32), np.empty_like(noise)
    next_obs = np.empty((num_steps, *obs.shape))
    outcomes, final_obs, first_obs, episodes = [], {}, {}, []
    for t in range(num_steps):
        all_obs[t] = obs
        actions[t] = agent.actor.mean(weights, obs) + perturbation[t]
        raw_obs, *outcome, ended = envs.step(np.minimum(np.maximum(actions[t], agent.low), agent.high))
        outcomes.append(outcome)
        next_obs[t] = raw_obs
        if ended:  # last observations are counted too, before the ones that follow, as in gymnasium's wrapper
            next_obs[t, list(ended)] = [last for last, _, _ in ended.values()]
            last_obs = agent.normalizer.observe(next_obs[t, list(ended)])
            final_obs |= {(t, i): last for i, last in zip(ended, last_obs)}
            first_obs |= {(t, i): raw_obs[i].copy() for i in ended}
            episodes += [((t + 1) * num_envs, episode_return, length) for _, episode_return, length in ended.values()]
        obs = agent.normalizer.observe(raw_obs)
    all_obs[-1] = obs
    rewards, *ends = map(np.array, zip(*outcomes))
    return Rollout(all_obs, next_obs, actions, logprobs, rewards.astype(float), *ends, final_obs, first_obs, episodes)


def gae(rewards: np.ndarray, values: np.ndarray, ends: np.ndarray, gamma: float, gae_lambda: float) -> np.ndarray:
    """Generalized advantage estimates (T, N), from rewards (T, N), values (T + 1, N) and episode ends (T, N).

    A_t = delta_t + gamma lambda (1 - end_t) A_{t+1},   delta_t = r_t + gamma (1 - end_t) V_{t+1} - V_t
    """
    discount = gamma * (1.0 - ends)
    delta = rewards + discount * values[1:] - values[:-1]
    return discounted_sums(delta[::-1], gae_lambda * discount[::-1], np.zeros(len(delta[0])))[::-1]


def prepare_batch(agent: Agent, roll: Rollout) -> tuple[list[torch.Tensor], float]:
    """A rollout's tensors for `update`, each (T * N, ...), and the explained variance of the value function."""
    args, weights = agent.args, layers(agent.params, "critic")
    obs = torch.from_numpy(roll.obs).to(agent.device)
    values = critic_value(weights, obs.flatten(0, 1)).view(obs.shape[:2]).cpu().numpy()
    rewards = agent.normalizer.scale_rewards(roll.rewards, roll.terminated)
    cut = [at for at in roll.final_obs if not roll.terminated[at]] if args.bootstrap_truncated else []
    if cut:
        final_obs = torch.from_numpy(np.stack([roll.final_obs[at] for at in cut])).to(agent.device)
        for at, value in zip(cut, critic_value(weights, final_obs).tolist()):
            rewards[at] += args.gamma * value
    advantages = gae(rewards, values, roll.terminated | roll.truncated, args.gamma, args.gae_lambda)
    returns = advantages + values[:-1]
    arrays = (roll.obs[:-1], roll.actions, roll.logprobs, advantages, returns, values[:-1])
    flat = (x.reshape(args.batch_size, *x.shape[2:]).astype(np.float32) for x in arrays)
    explained_variance = 1 - advantages.var() / returns.var() if returns.var() else math.nan
    return [torch.from_numpy(x).to(agent.device) for x in flat], explained_variance


# --- Update -----------------------------------------------------------------------------------------------------------

LOSSES = ("policy_loss", "value_loss", "entropy", "old_approx_kl", "approx_kl", "clipfrac", "grad_norm")


def ppo_loss(params, actor: Actor, args: Args, obs, actions, logprobs, advantages, returns, values):
    """PPO's loss on a minibatch, the tensors of which are (batch, ...), and the first six of LOSSES."""
    log_std = params["log_std"]
    z = (actions - actor.mean(layers(params, "actor"), obs)) * torch.exp(-log_std)
    logratio = -(0.5 * z**2 + log_std + 0.5 * math.log(2 * math.pi)).sum(-1) - logprobs
    ratio = logratio.exp()
    if args.norm_adv:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    clipped_ratio = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    policy_loss = -torch.minimum(advantages * ratio, advantages * clipped_ratio).mean()

    new_values = critic_value(layers(params, "critic"), obs)
    value_errors = (new_values - returns) ** 2
    if args.clip_vloss:
        clipped_values = values + (new_values - values).clamp(-args.clip_coef, args.clip_coef)
        value_errors = torch.maximum(value_errors, (clipped_values - returns) ** 2)
    value_loss = 0.5 * value_errors.mean()

    entropy = (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()
    loss = policy_loss - args.ent_coef * entropy + args.vf_coef * value_loss
    clipfrac = ((ratio - 1).abs() > args.clip_coef).to(ratio.dtype).mean()
    losses = (policy_loss, value_loss, entropy, -logratio.mean(), (ratio - 1 - logratio).mean(), clipfrac)
    return loss, torch.stack(losses).detach()


def update(params, moments, actor: Actor, args: Args, batch: list, index, step_size) -> torch.Tensor:
    """One minibatch: loss, gradient, clipping, and Adam with eps 1e-5, in place on `params` and `moments`.

    index: the minibatch's rows of `batch`; moments: Adam's two averages of every parameter's gradient, as
    `init_moments` makes them; step_size: from `adam_step_sizes`. Returns LOSSES. Written out, instead of with
    torch.optim, so that all of it is one graph for torch.compile.
    """
    grads, losses = torch.func.grad(ppo_loss, has_aux=True)(params, actor, args, *(x[index] for x in batch))
    norm = sum(g.square().sum() for g in grads.values()).sqrt()
    scale = (args.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
    for name, p in params.items():
        grad, mean, square = grads[name] * scale, moments[f"{name}.mean"], moments[f"{name}.square"]
        mean.lerp_(grad, 1 - 0.9)
        square.lerp_(grad.square(), 1 - 0.999)
        p.sub_(step_size[0] * mean / (square.sqrt() * step_size[1] + 1e-5))
    return torch.cat([losses, norm[None]])


def adam_step_sizes(learning_rate: float, first: int, count: int) -> np.ndarray:
    """(count, 2): lr / (1 - beta1^t) and 1 / sqrt(1 - beta2^t), Adam's bias corrections, from step t = `first` on."""
    t = np.arange(first, first + count)
    return np.stack([learning_rate / (1 - 0.9**t), 1 / np.sqrt(1 - 0.999**t)], axis=1)


def learn(update_function, agent: Agent, moments, batch: list, rng, learning_rate: float, adam_steps: int):
    """The epochs over one rollout, after `adam_steps` earlier minibatches: the mean LOSSES and how many there were."""
    args, losses = agent.args, []
    sizes = adam_step_sizes(learning_rate, adam_steps + 1, args.update_epochs * args.num_minibatches)
    sizes = torch.from_numpy(sizes.astype(np.float32)).to(agent.device).unbind()
    for _ in range(args.update_epochs):
        order = torch.from_numpy(rng.permutation(args.batch_size)).to(agent.device)
        for index in order.split(args.batch_size // args.num_minibatches):
            out = update_function(agent.params, moments, agent.actor, args, batch, index, sizes[len(losses)])
            losses.append(out.clone() if args.cuda else out)  # a CUDA graph's next output comes to the same place
        if args.target_kl is not None and losses[-1][LOSSES.index("approx_kl")] > args.target_kl:
            break
    return torch.stack(losses).mean(0).tolist(), len(losses)


def compile_update(agent: Agent, moments) -> tuple:
    """(the compiled `update`, True), or, where compilation fails, (`update`, False) with one line that says why.

    It is compiled by running it once on zeros; parameters and moments are restored. Shapes never change in a run, so
    the guards against that are skipped. On a GPU the whole call is replayed as a CUDA graph.
    """
    args, tensors = agent.args, [*agent.params.values(), *moments.values()]
    obs_dim, action_dim = len(agent.params["critic.0.weight"]), len(agent.params["log_std"])
    batch = [torch.zeros(args.batch_size, *shape, device=agent.device)
             for shape in ((obs_dim,), (action_dim,), (), (), (), ())]  # fmt: skip
    index = torch.arange(args.batch_size // args.num_minibatches, device=agent.device)
    if args.cuda:
        options = {"triton.cudagraphs": True}
        for x in tensors:
            torch._dynamo.mark_static_address(x)  # a graph may update in place only what never moves
    else:  # C++ calls the kernels; tanh from exp; and on small matrices a bias in the next kernel is faster than addmm
        options = {"cpp_wrapper": True, "cpp.use_decompose_tanh": True, "pattern_matcher": False}
    options["guard_filter_fn"] = torch.compiler.skip_all_guards_unsafe
    start, before = time.time(), [x.clone() for x in tensors]
    print("compiling the update (up to a minute the first time, seconds from the cache after that) ...", flush=True)

    def run_once():
        compiled = torch.compile(update, fullgraph=True, dynamic=False, options=options)
        compiled(agent.params, moments, agent.actor, args, batch, index, torch.ones(2, device=agent.device))
        return compiled

    try:
        try:
            compiled = run_once()
        except Exception:  # whoever was killed while compiling may have left half a library in the cache
            from torch._inductor.utils import fresh_cache  # takes seconds

            torch._dynamo.reset()
            with fresh_cache():
                compiled = run_once()
    except Exception as error:  # no C++ compiler, no Python headers, ...: whatever it is, training can go on
        print(f"compilation failed, training goes on uncompiled: {first_line(error)}", flush=True)
        return update, False
    for x, old in zip(tensors, before):
        x.copy_(old)
    print(f"compiled in {time.time() - start:.0f} s", flush=True)
    return compiled, True


# --- Evaluation -------------------------------------------------------------------------------------------------------


def evaluate(agent: Agent, seeds: list[int], render_mode: str | None = None, videos: Path | None = None):
    """Returns and lengths of one episode per seed under the deterministic policy a = m (Algorithm 1, line 9).

    The environments are new, the normaliser is frozen, and no random stream of the training is touched. The episodes
    run side by side, or in a window one after the other; each keeps its row, so that the numbers are the same.
    """
    envs = [make_env(agent.args.env_id, render_mode) for _ in seeds]
    if videos:
        envs = [gym.wrappers.RecordVideo(env, str(videos), lambda _: True, name_prefix=f"episode-{i}",
                                         disable_logger=True) for i, env in enumerate(envs)]  # fmt: skip
    weights, everyone = layers(agent.arrays(), "actor"), list(range(len(seeds)))
    obs = np.zeros((len(seeds), *envs[0].observation_space.shape))
    returns, lengths = np.zeros(len(seeds)), np.zeros(len(seeds), int)
    for running in [[i] for i in everyone] if render_mode == "human" else [everyone]:
        for i in running:
            obs[i], _ = envs[i].reset(seed=seeds[i])
        while running:
            returns[~np.isfinite(obs).all(-1)] = math.nan
            actions = np.clip(agent.actor.mean(weights, agent.normalizer.normalize(obs)), agent.low, agent.high)
            for i in running[:]:
                obs[i], reward, terminated, truncated, _ = envs[i].step(actions[i])
                returns[i] += float(reward)
                lengths[i] += 1
                if terminated or truncated:
                    running.remove(i)
                    envs[i].close()
    return returns, lengths


def evaluation_seeds(args: Args, global_step: int, final: bool = False) -> list[int]:
    """Odd seeds for a final evaluation, even ones for those during training, so that no seed serves both."""
    count = args.final_eval_episodes if final else args.eval_episodes
    return [s & ~1 | final for s in episode_seeds(args.seed, 1, global_step, count=count)]


def mean_and_std(x) -> tuple[float, float]:
    """Mean and standard deviation with ddof 1 (0 for a single value)."""
    return float(np.mean(x)), float(np.std(x, ddof=1)) if len(x) > 1 else 0.0


def evaluate_checkpoint(path: Path, given: Args):
    """--evaluate: print a saved policy's returns, which for best.pt and last.pt are those in result.json."""
    checkpoint = load_checkpoint(path)
    own = ("evaluate", "final_eval_episodes", "render", "capture_video", "num_threads", "cuda", "track")
    with refusing_damage(path):
        args = Args(**checkpoint["args"] | {name: getattr(given, name) for name in own})
        agent = Agent(*check_args(args), args)
        agent.load(checkpoint)
        seeds = evaluation_seeds(args, checkpoint["global_step"], final=True)
    limit_threads(args)
    videos = path.with_suffix(".videos") if args.capture_video else None
    if videos and videos.exists():
        refuse(f"{videos} exists already; move it away to record again")
    returns, lengths = evaluate(agent, seeds, "human" if args.render else "rgb_array" if videos else None, videos)
    for i, (episode_return, length) in enumerate(zip(returns, lengths), start=1):
        print(f"episode {i}: return {episode_return:.3f}, length {length}")
    mean, std = mean_and_std(returns)
    print(f"step {checkpoint['global_step']:,}: mean return {mean:.3f}, std {std:.3f} (ddof 1)")
    if videos:
        print(f"videos are in {videos}")


# --- Files of a run ---------------------------------------------------------------------------------------------------


def write_atomically(path: Path, data: bytes):
    """Replace `path` in one step: a full disk or a kill half-way leaves what was there."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        temporary.unlink(missing_ok=True)  # a full disk is not to stay full of it
        raise
    os.replace(temporary, path)


def save_checkpoint(path: Path, state: dict):
    """Save dicts and lists of tensors and plain Python values."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomically(path, buffer.getvalue())


@contextmanager
def refusing_damage(path: Path):
    """Refuse the checkpoint if what is done with it fails; torn, foreign and malicious ones fail in many ways."""
    try:
        yield
    except Exception:
        refuse(f"{path} is damaged or not a checkpoint of {SCRIPT}")


def load_checkpoint(path: Path) -> dict:
    """What `save_checkpoint` wrote, on the CPU, or a refusal.

    Nothing in the file is executed; but as on the command line, the id of its task can name a module to import.
    """
    if not path.is_file():
        refuse(f"there is no checkpoint {path}")
    with refusing_damage(path):
        if zipfile.ZipFile(path).testzip():  # torch.load looks at no checksum
            raise ValueError
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not state.keys() >= {"args", "global_step", "params", "normalizer"}:
            raise ValueError
        flags = set(state["args"])
    if flags != {field.name for field in fields(Args)}:
        refuse(f"{path} was not written by this {SCRIPT}: it has other flags")
    return state


def describe_machine() -> dict:
    """Versions, commit and hardware, for config.json."""
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip() if shutil.which("git") else ""
    cpu = Path("/proc/cpuinfo").read_text() if sys.platform == "linux" else ""
    versions = {name: version(name) for name in ("torch", "numpy", "gymnasium", "mujoco", "box2d")}
    return {
        "versions": {"python": platform.python_version(), **versions},
        "git_commit": commit or None,
        "cpu": next((line.split(": ")[1] for line in cpu.splitlines() if "model name" in line), platform.processor()),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


RESUMED = {"moments", "envs", "rng", "progress", "compiled"}  # what last.pt holds beyond the agent


def changed_flags(args: dict, others: dict) -> list[str]:
    """The flags that a run cannot change when it is continued, and which differ."""
    if args.keys() != others.keys():
        raise KeyError
    return [name for name in args if name not in FREE_ON_RESUME and args[name] != others[name]]


def open_run(args: Args) -> tuple[Path, dict | None]:
    """The run's folder, made if need be, and the checkpoint to continue from, if any. Never overwrites a run."""
    run_dir = Path(args.run_dir or f"runs/{args.env_id}__{args.exp_name}__{args.seed}__{int(time.time())}")
    config = json.loads(json.dumps({"args": asdict(args), **describe_machine()}))  # tuples as lists, as in the file
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        try:
            fcntl.flock(os.open(run_dir, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)  # until this process ends
        except BlockingIOError:
            refuse(f"another process is at work in {run_dir}")
        except OSError:  # this file system has no locks
            pass
        if any(run_dir.iterdir()) and not args.resume:
            refuse(f"the run folder {run_dir} is not empty; name another --run-dir, or continue its run with --resume")
        begun = (run_dir / "config.json").exists()
        if not begun:
            if any((run_dir / name).exists() for name in ("best.pt", "last.pt", "evaluations.csv", "result.json")):
                refuse(f"the run in {run_dir} has lost its config.json, so that it cannot be continued")
            write_atomically(run_dir / "config.json", json.dumps(config, indent=2).encode())
        old = json.loads((run_dir / "config.json").read_text())
        changed = changed_flags(config["args"], old["args"])
        if old.keys() != config.keys():
            raise KeyError
    except OSError as error:
        refuse(f"cannot write to the run folder {run_dir}: {error.strerror}")
    except (ValueError, KeyError, TypeError):
        refuse(f"{run_dir / 'config.json'} is damaged or not of this {SCRIPT}")
    if changed:
        was = ", ".join(f"--{name.replace('_', '-')} {old['args'][name]}" for name in changed)
        refuse(f"the run in {run_dir} was started with other flags than these: {was}")
    if (run_dir / "result.json").exists():
        print(f"the run in {run_dir} is finished")
        raise SystemExit(0)
    if not begun:
        return run_dir, None
    saved = None
    if (run_dir / "last.pt").exists():
        if old["versions"] != config["versions"]:
            refuse(f"the run in {run_dir} can be continued exactly with its own versions only: {old['versions']}")
        if old["cpu"] != config["cpu"]:
            print(f"warning: begun on {old['cpu']}; on {config['cpu']} the last bits of its numbers may differ")
        if old["git_commit"] != config["git_commit"]:
            print(f"warning: begun with the code of commit {old['git_commit']}, which is another one now")
        saved = load_checkpoint(run_dir / "last.pt")
        if changed_flags(saved["args"], asdict(args)) or not saved.keys() >= RESUMED:
            refuse(f"{run_dir / 'last.pt'} is no checkpoint to continue the run in {run_dir} from")
    for leftover in (*run_dir.glob("*.pt.tmp"), *run_dir.glob("*.json.tmp"), run_dir / "failure.json"):
        leftover.unlink(missing_ok=True)  # of a process that was killed or failed
    if saved is None:
        for leftover in run_dir.glob("events.out.tfevents.*"):
            leftover.unlink()
        write_atomically(run_dir / "config.json", json.dumps(config, indent=2).encode())
    return run_dir, saved


def fail_numerically(run_dir: Path, **facts):
    """End the run where a number is not finite: say which, where and when; the last checkpoint is left as it is."""
    facts["mujoco_warnings"] = mujoco_warnings[:5]
    print(f"{SCRIPT}: numerical failure: {facts} (also in {run_dir / 'failure.json'})", file=sys.stderr)
    write_atomically(run_dir / "failure.json", json.dumps(facts, indent=2).encode())
    raise SystemExit(EXIT_FAILURE)


def check_rollout(run_dir: Path, roll: Rollout, step: int):
    """Fail at the first reward or observation that is not finite."""
    bad = ~np.isfinite(roll.rewards) | ~np.isfinite(roll.next_obs).all(-1)
    for at, obs in roll.first_obs.items():
        bad[at] |= not np.isfinite(obs).all()
    if bad.any():
        t, i = np.argwhere(bad)[0].tolist()
        values = {"reward": roll.rewards[t, i], "action": roll.actions[t, i], "next_obs": roll.next_obs[t, i]}
        values |= {"first_obs": roll.first_obs[t, i]} if (t, i) in roll.first_obs else {}
        values = {name: str(value.tolist()) for name, value in values.items()}  # JSON has no NaN
        step += (t + 1) * bad.shape[1]
        fail_numerically(run_dir, what="a reward or an observation", global_step=step, env=i, **values)


def check_evaluation(run_dir: Path, returns: np.ndarray, step: int):
    """Fail if an episode's return is not finite."""
    if not np.isfinite(returns).all():
        fail_numerically(run_dir, what="an evaluation return", global_step=step, returns=str(returns.tolist()))


# --- Main -------------------------------------------------------------------------------------------------------------


def main():
    args = tyro.cli(Args, description=__doc__)
    if args.evaluate is not None:
        return evaluate_checkpoint(Path(args.evaluate), args)
    clock, signals = time.time(), []

    def request_stop(signum, _):
        signals.append(signum)
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a second Ctrl-C stops at once
        os.write(2, b"\nstopping after this iteration ...\n")  # print() may be in the middle of a line

    def exit_if_stopped():
        if signals:
            missing = ([] if args.run_dir else ["--run-dir", str(run_dir)]) + ([] if args.resume else ["--resume"])
            print(f"\nstopped by {signal.Signals(signals[0]).name}; continue with\n"
                  f"    {shlex.join([sys.executable, *sys.argv, *missing])}")  # fmt: skip
            raise SystemExit(EXIT_STOPPED)

    for signum in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1):
        signal.signal(signum, request_stop)
    obs_space, action_space = check_args(args)
    limit_threads(args)
    run_dir, saved = open_run(args)
    if args.cuda:  # on the CPU all that is used here is deterministic
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # without it cuBLAS refuses to be
        torch.use_deterministic_algorithms(args.torch_deterministic)

    # All that training changes, and what an earlier process has saved of it
    agent = Agent(obs_space, action_space, args)
    moments = init_moments(agent.params)
    envs, rng = Environments(args.env_id, args.num_envs, args.seed), np.random.default_rng(args.seed)
    progress = {"global_step": 0, "adam_steps": 0, "best_return": -math.inf, "evaluations": [], "late_returns": [],
                "train_seconds": 0.0, "wall_seconds": 0.0}  # fmt: skip
    if saved:
        with refusing_damage(run_dir / "last.pt"):
            agent.load(saved)
            copy_into(moments, saved["moments"])
            envs.load(saved["envs"])
            rng.bit_generator.state = saved["rng"]
            progress = {name: saved["progress"][name] for name in progress}
    obs = agent.normalizer.normalize(envs.obs) if saved else agent.normalizer.observe(envs.obs)
    step, last_step = progress["global_step"], args.num_iterations * args.batch_size

    def checkpoint(name: str, **more):
        save_checkpoint(run_dir / name, {"args": asdict(args), "global_step": step, **agent.tensors(), **more})

    def write_evaluations():
        rows = ["global_step,return_mean,return_std,return_min,return_max,length_mean", *progress["evaluations"]]
        write_atomically(run_dir / "evaluations.csv", "".join(f"{row}\n" for row in rows).encode())

    # Logs; a resumed run drops what followed its checkpoint, since it will log that again
    write_evaluations()
    if args.track:
        import_module("wandb").init(project=args.wandb_project_name, entity=args.wandb_entity, name=run_dir.name,
                                    dir=run_dir, config=asdict(args), sync_tensorboard=True)  # fmt: skip
    writer = SummaryWriter(run_dir, purge_step=step + 1 if saved else None)
    if not saved:
        table = "".join(f"|{name}|{value}|\n" for name, value in asdict(args).items())
        writer.add_text("hyperparameters", f"|flag|value|\n|-|-|\n{table}")
        flags = {k: v if isinstance(v, bool | int | float | str) else str(v) for k, v in asdict(args).items()}
        for summary in hparams(flags, {"final/best_mean": 0, "final/last_mean": 0}):
            writer.file_writer.add_summary(summary)  # add_hparams would make a subfolder
    compiling = args.compile and (not saved or saved["compiled"])
    update_function, compiled = compile_update(agent, moments) if compiling else (update, False)
    exit_if_stopped()
    if compiling and saved and not compiled:
        refuse(f"the run in {run_dir} was compiled, and continues exactly only so")

    bar = tqdm(total=last_step, initial=step, unit=" steps", unit_scale=True, smoothing=0.05,
               disable=None if args.progress else True)  # fmt: skip
    last_return = last_eval = "-"
    gc.freeze()  # the garbage collector need not look through all of torch again and again
    while step < last_step:
        # Rollout
        start, step_before = time.time(), step
        mujoco_warnings.clear()
        roll = collect(agent, envs, obs, args.num_steps, rng)
        check_rollout(run_dir, roll, step)
        obs = roll.obs[-1]

        # Update
        batch, explained_variance = prepare_batch(agent, roll)
        learning_rate = args.learning_rate * (1 - step / last_step if args.anneal_lr else 1)
        losses, updates = learn(update_function, agent, moments, batch, rng, learning_rate, progress["adam_steps"])
        progress["adam_steps"] += updates
        step = progress["global_step"] = step + args.batch_size
        scalars = {f"losses/{name}": value for name, value in zip(LOSSES, losses)}
        tensors = {**agent.params, **agent.normalizer.tensors()}
        bad = [name for name, x in (scalars | tensors).items() if not torch.as_tensor(x).isfinite().all()]
        if bad:
            values = {name: str(value) for name, value in scalars.items()}
            what = "a loss, the gradient, a parameter or a running statistic"
            fail_numerically(run_dir, what=what, global_step=step, not_finite=bad, **values)

        # Logs
        scalars |= {"losses/explained_variance": explained_variance, "charts/learning_rate": learning_rate,
                    "charts/mujoco_warnings": len(mujoco_warnings)}  # fmt: skip
        low, high = (torch.from_numpy(bound).to(agent.device) for bound in (agent.low, agent.high))
        scalars |= refinement_scalars(
            agent.actor.proposals(layers(agent.params, "actor"), batch[0][::8]),  # an eighth of the states will do
            low,
            high,
        )
        for offset, episode_return, length in roll.episodes:
            writer.add_scalar("charts/episodic_return", episode_return, step_before + offset)
            writer.add_scalar("charts/episodic_length", length, step_before + offset)
            last_return = f"{episode_return:.1f}"
            if step_before + offset > 0.9 * args.total_timesteps:
                progress["late_returns"].append(episode_return)
        progress["train_seconds"] += time.time() - start
        scalars["charts/SPS"] = step / progress["train_seconds"]

        def due(interval: int | None, step=step, step_before=step_before) -> bool:
            return interval is not None and step // interval > step_before // interval

        # Evaluation
        if due(args.eval_interval) or step == last_step:
            returns, lengths = evaluate(agent, evaluation_seeds(args, step))
            check_evaluation(run_dir, returns, step)
            mean, std = mean_and_std(returns)
            scalars |= {"eval/return_mean": mean, "eval/return_std": std, "eval/episode_length": lengths.mean()}
            row = step, mean, std, returns.min(), returns.max(), lengths.mean()
            progress["evaluations"].append(",".join(map(str, row)))
            write_evaluations()
            if mean > progress["best_return"]:
                progress["best_return"] = mean
                checkpoint("best.pt", selection_return=mean)
            last_eval = f"{mean:.1f}"
            if args.progress:
                rate = f"best {progress['best_return']:.1f}, {scalars['charts/SPS']:.0f} steps/s"
                bar.write(f"step {step:,}: evaluation return {mean:.1f} +- {std:.1f}, {rate}")
        for name, value in scalars.items():
            writer.add_scalar(name, value, step)

        # Checkpoints
        if due(args.save_every):
            checkpoint(f"step_{step}.pt")
        if due(args.checkpoint_interval) or step == last_step or signals:
            writer.flush()
            progress["wall_seconds"], clock = progress["wall_seconds"] + time.time() - clock, time.time()
            checkpoint("last.pt", moments=moments, envs=envs.state(), rng=rng.bit_generator.state, compiled=compiled,
                       progress=progress)  # fmt: skip
            exit_if_stopped()
        bar.set_postfix_str(f"return {last_return}, evaluation {last_eval}", refresh=False)
        bar.update(args.batch_size)
    bar.close()

    # The final evaluation; result.json is written last, since it says that the run is complete
    final = {}
    for name in ("best", "last"):
        saved = load_checkpoint(run_dir / f"{name}.pt")
        agent.load(saved)
        videos = run_dir / "videos" if args.capture_video and name == "best" else None
        seeds = evaluation_seeds(args, saved["global_step"], final=True)
        returns, _ = evaluate(agent, seeds, "rgb_array" if videos else None, videos)
        check_evaluation(run_dir, returns, step)
        mean, std = mean_and_std(returns)
        final[name] = {"global_step": saved["global_step"], "returns": returns.tolist(), "mean": mean, "std": std}
        exit_if_stopped()
    final["best"]["selection_return"] = progress["best_return"]
    metrics = {f"final/{name}_mean": final[name]["mean"] for name in final}
    for name, value in metrics.items():
        writer.add_scalar(name, value, step + 1)  # one on: if a kill precedes result.json, the resume drops it
    writer.close()
    late = progress["late_returns"]
    result = {name: getattr(args, name) for name in ("env_id", "exp_name", "seed", "total_timesteps")}
    result |= {name: getattr(args, name, None) for name in ("refinement_depth", "refinement_schedule")}  # null for PPO
    result |= final
    result |= {
        "std_ddof": 1,
        "train_return_last10pct": float(np.mean(late)) if late else None,
        "wall_time_s": progress["wall_seconds"] + time.time() - clock,
        "sps": step / progress["train_seconds"],
    }
    write_atomically(run_dir / "result.json", json.dumps(result, indent=2).encode())
    for name in ("best", "last"):
        print("{}: return {mean:.1f} +- {std:.1f} at step {global_step:,}".format(name, **final[name]))
    print(f"the run is in {run_dir}; look at it with: tensorboard --logdir {run_dir}")


if __name__ == "__main__":
    try:
        main()
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        sys.exit(f"{SCRIPT}: error: {error.strerror}; every checkpoint saved before is intact")
