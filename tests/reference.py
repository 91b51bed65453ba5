"""PPO and RefinePPO written the obvious way, for the tests to hold the training scripts equal to: eager PyTorch,
gymnasium's own wrappers, and no thought of speed.
"""

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal


def mlp(sizes: list[int], output_gain: float) -> nn.Sequential:
    """A tanh network with orthogonal weights and zero biases."""
    layers = [nn.Linear(*shape) for shape in zip(sizes, sizes[1:])]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, output_gain if layer is layers[-1] else 2**0.5)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*(module for layer in layers for module in (layer, nn.Tanh())))[:-1]


class Agent(nn.Module):
    """The Gaussian policy and the value function; without a refinement depth, K = None, plain PPO."""

    def __init__(self, obs_dim: int, action_dim: int, args):
        super().__init__()
        self.K, self.schedule = getattr(args, "refinement_depth", None), getattr(args, "refinement_schedule", "")
        self.action_dim, inputs = action_dim, obs_dim if self.K is None else obs_dim + action_dim
        self.actor = mlp([inputs, *args.actor_hidden, action_dim], 0.01)
        self.critic = mlp([obs_dim, *args.critic_hidden, 1], 1.0)
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
