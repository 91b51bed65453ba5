"""Tasks with one odd behaviour each, of kinds that people bring; use them as `odd_envs:NAME-v0`.

`Line` is sound. What the others differ in is said by their docstrings; those under "Twins" mean the same as Line, so
that they must train to the very same numbers. Episodes have 40 steps.
"""

import os
import random
import threading

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.spaces import Box, Dict


class Line(gym.Env):
    """A point x on a line in steps of 1/16; reward -x^2; starts at a whole number."""

    observation_space = Box(-np.inf, np.inf, (2,), float)
    action_space = Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def look(self):
        return np.array([self.x, self.t / 64])

    def start(self):
        return float(self.np_random.integers(-1, 2))

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = self.start(), 0
        return self.look(), {}

    def step(self, action):
        self.t += 1
        self.x = min(max(self.x + round(16 * float(action[0])) / 16, -4.0), 4.0)
        return self.look(), -(self.x**2), False, False, {}


# --- Twins ------------------------------------------------------------------------------------------------------------


class Lists(Line):
    """Observations are lists, the first one of whole numbers."""

    def look(self):
        return super().look().tolist()

    def reset(self, **kwargs):
        obs, info = super().reset(**kwargs)
        return [int(x) for x in obs], info


class Overwrites(Line):
    """Every observation is the same array, into which the task goes on writing, as into the actions."""

    def look(self):
        self.buffer = getattr(self, "buffer", np.empty(2))
        self.buffer[:] = super().look()
        return self.buffer

    def step(self, action):
        self.buffer[:] = 1e6
        outcome = super().step(action)
        action *= 0.5
        return outcome


class ObsInDict(Line):
    observation_space = Dict(place=Box(-np.inf, np.inf, (1,), float), time=Box(-np.inf, np.inf, (1, 1), float))

    def look(self):
        x, t = super().look()
        return {"time": np.array([[t]]), "place": np.array([x])}


class ObsInGrid(Line):
    observation_space = Box(-np.inf, np.inf, (2, 1), float)

    def look(self):
        return super().look().reshape(2, 1)


class Arrays(Line):
    """Rewards and ends are arrays; has its time limit itself."""

    def step(self, action):
        obs, reward, *_ = super().step(action)
        return obs, np.array([reward], np.float32), np.array([False]), np.array([self.t == 40]), {}  # exact in float32


class StrictAction(Line):
    """Takes an action in double precision, and nothing else."""

    action_space = Box(-1, 1, (1,), float)

    def step(self, action):
        assert action.dtype == float and self.action_space.contains(action)
        return super().step(action)


class SeedOfAnInt(Line):
    """The simulator's seed is a C int."""

    def reset(self, seed=None, options=None):
        np.array(0 if seed is None else seed, np.int32)
        return super().reset(seed=seed)


class ClosedOnce(Line):
    """Fails where it is closed a second time."""

    closed = False

    def close(self):
        assert not self.closed
        self.closed = True


TWINS = Line.__subclasses__()


class TimeStamps(Line):
    """Large whole numbers, which neither float32 nor its squares hold."""

    observation_space = Box(0, 2**62, (2,), np.int64)

    def look(self):
        return np.array([1_700_000_000_000 + self.t, round(16 * self.x) + 100])


class TimeStampsInFloats(TimeStamps):
    """Its twin."""

    observation_space = Box(0, 2**62, (2,), float)

    def look(self):
        return super().look().astype(float)


# --- What cannot be trained -------------------------------------------------------------------------------------------


class ShortObs(Line):
    def look(self):
        return super().look()[:1]


class TwoRewards(Line):
    def step(self, action):
        obs, reward, *rest = super().step(action)
        return obs, np.array([reward, reward]), *rest


class WholeActions(Line):
    action_space = Box(0, 4, (1,), np.int64)


class GridActions(Line):
    action_space = Box(-1, 1, (2, 2))


class NoSeed(Line):
    def reset(self):
        return super().reset()


class OldReset(Line):
    def reset(self, **kwargs):
        return super().reset(**kwargs)[0]


class OldStep(Line):
    def step(self, action):
        obs, reward, done, _, info = super().step(action)
        return obs, reward, done, info


class OnlyOne(Line):
    """Holds what there is one of, as a port, until it is closed."""

    held = False

    def __init__(self, render_mode=None):
        if OnlyOne.held:
            raise OSError("port 7100 is in use")
        OnlyOne.held = True

    def close(self):
        OnlyOne.held = False


class ExitsAtOnce(Line):
    def __init__(self, render_mode=None):
        raise SystemExit("no licence")


class Mistake(Line):
    def __init__(self, render_mode=None):
        self.gain = {"mass": 1.0}["gain"]


class MistakeInStep(Line):
    def step(self, action):
        return self.t / 0


# --- What is said, and trained ----------------------------------------------------------------------------------------


class FarActions(Line):
    action_space = Box(100, 200, (1,))

    def step(self, action):
        return super().step((action - 150) / 50)


class GlobalRandom(Line):
    """Draws from all global generators and from its own action space, at the start and in every step."""

    def draw(self):
        return np.random.uniform() + random.random() + torch.rand(1).item() + float(self.action_space.sample()[0])

    def start(self):
        return self.draw()

    def step(self, action):
        obs, reward, *rest = super().step(action)
        return obs, reward + self.draw(), *rest


class Level(Line):
    """A curriculum: rewards grow with the number of episodes in the environment's life, nothing else shows it."""

    level = 0

    def reset(self, **kwargs):
        self.level += 1
        return super().reset(**kwargs)

    def step(self, action):
        obs, reward, *rest = super().step(action)
        return obs, reward * self.level, *rest


class Longer(Level):
    """Its episodes become longer instead."""

    def step(self, action):
        obs, reward, *_ = Line.step(self, action)
        return obs, reward, self.t > 4 + 2 * self.level, False, {}


# --- What fails or ends, as the environment variable ODD says ---------------------------------------------------------


class Exits(Line):
    """Ends the program, with the code for success, in step or in reset."""

    steps = 0

    def step(self, action):
        Exits.steps += 1
        self.exit_in("step")
        return super().step(action)

    def reset(self, **kwargs):
        self.exit_in("reset")
        return super().reset(**kwargs)

    def exit_in(self, where):
        if os.environ["ODD"] == where and Exits.steps > 300:
            raise SystemExit(0)


class Opened(Line):
    """Its thread, for which Python waits at the end, and its file in the folder ODD are there until it is closed."""

    number = 0

    def __init__(self, render_mode=None):
        Opened.number += 1
        self.file = os.path.join(os.environ["ODD"], f"{os.getpid()}-{Opened.number}")
        open(self.file, "x").close()
        self.closed = threading.Event()
        threading.Thread(target=self.closed.wait).start()

    def close(self):
        os.remove(self.file)
        self.closed.set()


class OpenedWholeActions(Opened):
    """Is refused when it has been made."""

    action_space = WholeActions.action_space


class Faulty(Line):
    """One observation or reward is bad in the episode, at the step and in the way that ODD names, as "seed step way".

    Step 0 is the first observation, and a way a crash, or a number and in what it is.
    """

    def reset(self, seed=None, options=None):
        obs, info = super().reset(seed=seed)
        fault_seed, step, self.way = (os.environ.get("ODD") or "-1 0 none").split()
        self.fault = int(step) if seed == int(fault_seed) else None
        return self.spoilt(obs, 0.0)[0], info

    def step(self, action):
        obs, reward, *rest = super().step(action)
        return *self.spoilt(obs, reward), *rest

    def spoilt(self, obs, reward):
        if self.t != self.fault:
            return obs, reward
        if self.way == "crash":
            raise RuntimeError("the simulator crashed")
        number, what = self.way.rsplit("-", 1)
        return (np.array([0, float(number)]), reward) if what == "obs" else (obs, float(number))


class Unstable(HalfCheetahEnv):
    """HalfCheetah that explodes at the 100th step of every episode, upon which MuJoCo resets it with a warning."""

    steps = 0

    def reset(self, **kwargs):
        self.steps = 0
        return super().reset(**kwargs)

    def step(self, action):
        self.steps += 1
        if self.steps == 100:
            self.data.qvel[:] = 1e20
        return super().step(action)


class Goal(Line):
    """Ends at a goal that nobody reaches, and has no time limit."""

    def step(self, action):
        obs, reward, *_ = super().step(action)
        return obs, reward, bool(self.x > 100), False, {}


for task in (Line, *Line.__subclasses__(), OpenedWholeActions, TimeStampsInFloats, Longer):
    gym.register(f"{task.__name__}-v0", task, max_episode_steps=None if task in (Goal, Arrays) else 40)
gym.register("Unstable-v0", Unstable, max_episode_steps=150)
