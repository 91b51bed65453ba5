"""The paper's two-dimensional coordination example, `sweeps.toy_env:Coordination-v0`: one-step episodes with

    reward = -(a_1 - phi(s))^2 - (a_2 - psi(s, phi(s)))^2,   s uniform in [-1, 1]

The right a_2 depends on the right a_1. The paper leaves phi and psi open (section "Why Iterative Action Refinement Can
Work"); these two are smooth and stay within the action bounds.
"""

import gymnasium as gym
import numpy as np


def phi(s):
    """The right first component."""
    return np.sin(2 * s)


def psi(s, a_1):
    """The right second component, given the first."""
    return 2 * s * a_1 - 1


class Coordination(gym.Env):
    """Observation s (1,), action (a_1, a_2); every episode is one step."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.s = self.np_random.uniform(-1, 1, 1).astype(np.float32)
        return self.s.copy(), {}

    def step(self, action):
        a_1 = phi(self.s[0])
        reward = -((action[0] - a_1) ** 2) - (action[1] - psi(self.s[0], a_1)) ** 2
        return self.s.copy(), float(reward), True, False, {}


gym.register("Coordination-v0", Coordination, max_episode_steps=2)  # it has a time limit, and never meets it
