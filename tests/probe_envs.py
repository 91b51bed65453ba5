"""Tiny environments, each of which asks one thing; use them as `probe_envs:NAME-v0`."""

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box


class Probe(gym.Env):
    """Uniform random observations and reward 0, without an end."""

    observation_space = Box(-1, 1, (1,))
    action_space = Box(-1, 1, (1,))

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def observe(self):
        self.obs = self.np_random.uniform(-1, 1, self.observation_space.shape).astype(np.float32)
        return self.obs

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        return self.observe(), {}

    def step(self, action):
        return self.observe(), 0.0, False, False, {}


class ConstantReward(Probe):
    """One step, reward 1: the value must become 1."""

    def step(self, action):
        return self.observe(), 1.0, True, False, {}


class MatchAction(Probe):
    """One step; the right action is -s, the reward minus the squared distance from it."""

    def step(self, action):
        reward = -float((action[0] + self.obs[0]) ** 2)
        return self.observe(), reward, True, False, {}


class TwoStepCredit(Probe):
    """Observes (s, 0), then (0, 1); the second step's reward is that of the first one's action."""

    observation_space = Box(-1, 1, (2,))

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.obs[1] = 0
        self.delayed = None
        return self.obs, {}

    def step(self, action):
        if self.delayed is not None:
            return np.zeros(2, np.float32), self.delayed, True, False, {}
        self.delayed = -float((action[0] + self.obs[0]) ** 2)
        return np.array([0, 1], np.float32), 0.0, False, False, {}


class Counter(Probe):
    """The observation and the reward are the number of steps; truncated after 7."""

    observation_space = Box(0, np.inf, (1,))
    last_step = None

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.full(1, self.steps, np.float32), self.steps, self.steps == self.last_step, False, {}


class Terminator(Counter):
    """Terminated after 5 instead."""

    last_step = 5


class Unbounded(Probe):
    action_space = Box(-np.inf, np.inf, (2,))


for env in (ConstantReward, MatchAction, TwoStepCredit, Terminator):
    gym.register(f"{env.__name__}-v0", env)
gym.register("Counter-v0", Counter, max_episode_steps=7)
gym.register("Unbounded-v0", Unbounded, max_episode_steps=50)
