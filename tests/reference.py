"""PPO and RefinePPO written the obvious way: eager PyTorch, gymnasium's own wrappers, and no thought of speed.

The tests hold the training scripts equal to `eager_loss` and `eager_update`; `sweeps/speed.py` compares the speed of
the scripts with that of this file's command:

    python tests/reference.py --algorithm refineppo --env-id HalfCheetah-v5 --total-timesteps 20480

Every environment has the usual stack of wrappers, as in the well-known scripts, but an episode's last step is also
the next one's reset (SAME_STEP): the default of gymnasium 1 puts one fake transition per episode into the batch. At
one environment this is the very algorithm of the training scripts. With several, each has statistics of its own, where
the scripts share them: the same speed, but one policy sees differently scaled states, and learns worse.
"""

import time
from dataclasses import dataclass
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch import nn
from torch.distributions import Normal


@dataclass
class Args:
    """Flags as those of the training scripts, whose --help explains them."""

    algorithm: Literal["ppo", "refineppo"] = "ppo"
    env_id: str = "HalfCheetah-v5"
    total_timesteps: int = 1_000_000
    seed: int = 1
    cuda: bool = False  # act there too
    refinement_depth: int = 4
    refinement_schedule: Literal["average", "uniform", "inverse"] = "average"
    num_envs: int = 1
    num_steps: int = 2048
    num_minibatches: int = 32
    update_epochs: int = 10
    learning_rate: float = 3e-4
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_coef: float = 0.2
    norm_adv: bool = True
    clip_vloss: bool = True
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5


def mlp(sizes: list[int], output_gain: float) -> nn.Sequential:
    """A tanh network with orthogonal weights and zero biases."""
    layers = [nn.Linear(*shape) for shape in zip(sizes, sizes[1:])]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, output_gain if layer is layers[-1] else 2**0.5)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*(module for layer in layers for module in (layer, nn.Tanh())))[:-1]


class Agent(nn.Module):
    """The Gaussian policy and the value function; K = None is plain PPO."""

    def __init__(self, obs_dim, action_dim, K, schedule, actor_hidden=(128, 128), critic_hidden=(64, 64)):
        super().__init__()
        self.K, self.schedule, self.action_dim = K, schedule, action_dim
        self.actor = mlp([obs_dim if K is None else obs_dim + action_dim, *actor_hidden, action_dim], 0.01)
        self.critic = mlp([obs_dim, *critic_hidden, 1], 1.0)
        self.log_std = nn.Parameter(torch.zeros(action_dim))

    def proposals(self, obs: torch.Tensor) -> list[torch.Tensor]:
        """m_k = m_{k-1} + c_k f([s; m_{k-1}]) from m_0 = 0: m_1, ..., m_K, each (n, action_dim); of PPO only f(s)."""
        if self.K is None:
            return [self.actor(obs)]
        m, all_m = obs.new_zeros(len(obs), self.action_dim), []
        for k in range(1, self.K + 1):
            c = {"average": 1 / self.K, "uniform": 1.0, "inverse": 1 / k}[self.schedule]
            m = m + c * self.actor(torch.cat([obs, m], dim=-1))
            all_m.append(m)
        return all_m

    def policy(self, obs: torch.Tensor) -> Normal:
        return Normal(self.proposals(obs)[-1], self.log_std.exp())

    def value(self, obs: torch.Tensor) -> torch.Tensor:
        return self.critic(obs).squeeze(-1)


def eager_loss(agent: Agent, args, obs, actions, logprobs, advantages, returns, values):
    """PPO's loss on a minibatch; its policy loss, value loss, entropy, old and new KL estimate and clip fraction."""
    policy = agent.policy(obs)
    logratio = policy.log_prob(actions).sum(-1) - logprobs
    ratio = logratio.exp()
    if args.norm_adv:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    unclipped = -advantages * ratio
    clipped = -advantages * torch.clamp(ratio, 1 - args.clip_coef, 1 + args.clip_coef)
    policy_loss = torch.max(unclipped, clipped).mean()

    new_values = agent.value(obs)
    value_loss = (new_values - returns) ** 2
    if args.clip_vloss:
        values_clipped = values + torch.clamp(new_values - values, -args.clip_coef, args.clip_coef)
        value_loss = torch.max(value_loss, (values_clipped - returns) ** 2)
    value_loss = 0.5 * value_loss.mean()

    entropy = policy.entropy().sum(-1).mean()
    loss = policy_loss - args.ent_coef * entropy + args.vf_coef * value_loss
    with torch.no_grad():
        old_kl, kl = (-logratio).mean(), ((ratio - 1) - logratio).mean()
        clip_fraction = ((ratio - 1).abs() > args.clip_coef).to(ratio.dtype).mean()
        losses = torch.stack([policy_loss, value_loss, entropy, old_kl, kl, clip_fraction])
    return loss, losses


def make_optimizer(agent: Agent, args) -> torch.optim.Optimizer:
    return torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)


def eager_update(agent: Agent, optimizer: torch.optim.Optimizer, args, *minibatch) -> torch.Tensor:
    """One optimizer step; the six numbers of `eager_loss` and the gradient's norm before it is clipped."""
    loss, losses = eager_loss(agent, args, *minibatch)
    optimizer.zero_grad()
    loss.backward()
    norm = nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
    optimizer.step()
    return torch.cat([losses, norm[None]])


def make_env(env_id: str, gamma: float) -> gym.Env:
    """The task in the usual wrappers; episode statistics count raw rewards."""
    env = gym.wrappers.RecordEpisodeStatistics(gym.make(env_id))
    env = gym.wrappers.NormalizeObservation(gym.wrappers.ClipAction(env))
    env = gym.wrappers.TransformObservation(env, lambda obs: np.clip(obs, -10, 10), env.observation_space)
    env = gym.wrappers.NormalizeReward(env, gamma=gamma)
    return gym.wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))


def train(args: Args) -> tuple[list[float], float]:
    """Train; return the raw return of every episode, and the steps per second."""
    torch.manual_seed(args.seed)
    device = torch.device("cuda" if args.cuda else "cpu")
    makers = [lambda: make_env(args.env_id, args.gamma)] * args.num_envs
    envs = gym.vector.SyncVectorEnv(makers, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)
    obs_dim, action_dim = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    K = args.refinement_depth if args.algorithm == "refineppo" else None
    agent = Agent(obs_dim, action_dim, K, args.refinement_schedule).to(device)
    optimizer = make_optimizer(agent, args)

    shape = args.num_steps, args.num_envs
    all_obs, actions = torch.zeros(*shape, obs_dim, device=device), torch.zeros(*shape, action_dim, device=device)
    logprobs, rewards, ends, values = (torch.zeros(shape, device=device) for _ in range(4))
    batch_size, returns = args.num_envs * args.num_steps, []
    obs, _ = envs.reset(seed=args.seed)
    start = time.time()
    iterations = args.total_timesteps // batch_size
    for iteration in range(iterations):
        optimizer.param_groups[0]["lr"] = (1 - iteration / iterations) * args.learning_rate

        for t in range(args.num_steps):
            all_obs[t] = torch.as_tensor(obs)
            with torch.no_grad():
                policy = agent.policy(all_obs[t])
                actions[t] = policy.sample()
                logprobs[t] = policy.log_prob(actions[t]).sum(-1)
                values[t] = agent.value(all_obs[t])
            obs, reward, terminated, truncated, infos = envs.step(actions[t].cpu().numpy())
            rewards[t] = torch.as_tensor(reward)
            ends[t] = torch.as_tensor(terminated | truncated)
            if "final_info" in infos:
                episode = infos["final_info"]["episode"]
                returns += episode["r"][episode["_r"]].tolist()

        with torch.no_grad():
            next_value = agent.value(torch.as_tensor(obs, dtype=torch.float32, device=device))
        advantages, advantage = torch.zeros_like(rewards), 0.0
        for t in reversed(range(args.num_steps)):
            delta = rewards[t] + args.gamma * (1 - ends[t]) * next_value - values[t]
            advantages[t] = advantage = delta + args.gamma * args.gae_lambda * (1 - ends[t]) * advantage
            next_value = values[t]

        batch = [x.flatten(0, 1) for x in (all_obs, actions, logprobs, advantages, advantages + values, values)]
        for _ in range(args.update_epochs):
            for index in torch.randperm(batch_size, device=device).split(batch_size // args.num_minibatches):
                eager_update(agent, optimizer, args, *(x[index] for x in batch))
    return returns, iterations * batch_size / (time.time() - start)


if __name__ == "__main__":
    args = tyro.cli(Args, description=__doc__)
    torch.set_num_threads(1)
    returns, sps = train(args)
    if returns:
        print(f"mean return of the last 10 episodes: {np.mean(returns[-10:]):.1f}")
    print(f"{sps:.0f} steps/s")
