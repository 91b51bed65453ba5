"""Tasks with one odd behaviour each, of kinds that people bring; use them as `odd_envs:NAME-v0`.

`Line` is sound. What the others differ in is said by their docstrings; those under "Twins" mean the same as Line, so
that they must train to the very same numbers. Episodes have 40 steps, but those of the tasks under "Without end".
"""

import os
import random
import threading

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.spaces import Box, Dict, Tuple


class Line(gym.Env):
    """A point x on a line in steps of 1/16, which float16 holds exactly; reward -x^2; starts at a whole number."""

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


class WholeFirst(Line):
    """The first observation is of whole numbers, the others are not."""

    def reset(self, **kwargs):
        obs, info = super().reset(**kwargs)
        return obs.astype(int), info


class HalfPrecision(Line):
    observation_space = Box(-np.inf, np.inf, (2,), np.float16)

    def look(self):
        return super().look().astype(np.float16)


class AsList(Line):
    def look(self):
        return super().look().tolist()


class OneBuffer(Line):
    """Every observation is the same array, into which the task goes on writing."""

    def look(self):
        self.buffer = getattr(self, "buffer", np.empty(2))
        self.buffer[:] = super().look()
        return self.buffer

    def step(self, action):
        self.buffer[:] = 1e6
        return super().step(action)


class ObsInDict(Line):
    observation_space = Dict(place=Box(-np.inf, np.inf, (1,), float), time=Box(-np.inf, np.inf, (1, 1), float))

    def look(self):
        x, t = super().look()
        return {"time": np.array([[t]]), "place": np.array([x])}


class ObsInTuple(Line):
    observation_space = Tuple([Box(-np.inf, np.inf, (1,), float)] * 2)

    def look(self):
        return tuple(super().look().reshape(2, 1))


class ObsInGrid(Line):
    observation_space = Box(-np.inf, np.inf, (2, 1), float)

    def look(self):
        return super().look().reshape(2, 1)


class RewardArray(Line):
    def step(self, action):
        obs, reward, *rest = super().step(action)
        return obs, np.array([reward]), *rest


class RewardScalarArray(Line):
    def step(self, action):
        obs, reward, *rest = super().step(action)
        return obs, np.array(reward, np.float32), *rest  # exact in float32


class TerminatedArray(Line):
    def step(self, action):
        obs, reward, *_ = super().step(action)
        return obs, reward, np.array([False]), np.bool_(False), {}


class TruncatedArray(Line):
    """Has its time limit itself."""

    def step(self, action):
        obs, reward, *_ = super().step(action)
        return obs, reward, 0, np.array([self.t == 40]), {}


class ActionInPlace(Line):
    """Changes the array that it is given."""

    def step(self, action):
        outcome = super().step(action)
        action *= 0.5
        return outcome


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


class ColumnObs(Line):
    def look(self):
        return super().look().reshape(2, 1)


class ObsChangesShape(Line):
    """Sound until its 60th step in an environment's life."""

    steps = 0

    def step(self, action):
        self.steps += 1
        obs, *rest = super().step(action)
        return obs if self.steps < 60 else obs[:1], *rest


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


class MistakeInReset(Line):
    def reset(self, **kwargs):
        return self.start_again()


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


class Exits(Line):
    """Ends the program, with the code for success, in the way that ODD says: in step or in reset."""

    steps = 0

    def step(self, action):
        Exits.steps += 1
        if os.environ["ODD"] == "step" and Exits.steps > 300:
            raise SystemExit(0)
        return super().step(action)

    def reset(self, **kwargs):
        if os.environ["ODD"] == "reset" and Exits.steps > 300:
            raise SystemExit(0)
        return super().reset(**kwargs)


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

    action_space = Box(0, 4, (1,), np.int64)


class OpenedCrash(Opened):
    """The 300th step of all fails."""

    steps = 0

    def step(self, action):
        OpenedCrash.steps += 1
        if OpenedCrash.steps > 300:
            raise RuntimeError("the simulator crashed")
        return super().step(action)


class OpenedNan(OpenedCrash):
    def step(self, action):
        try:
            return super().step(action)
        except RuntimeError:
            return np.full(2, np.nan), 0.0, False, False, {}


class Faulty(gym.Env):
    """Random observations and rewards; one is bad in the episode, at the step and in the way that FAULT names.

    FAULT is "seed step way"; step 0 is the first observation, and a way a crash, or a number and in what it is.
    """

    observation_space = Box(-1, 1, (3,), float)
    action_space = Box(-1, 1, (1,))

    def __init__(self, render_mode=None, scale=1.0):
        self.scale = scale

    def outcome(self):
        obs, reward = self.np_random.uniform(-1, 1, 3), self.scale * self.np_random.normal()
        if self.steps == self.fault:
            if self.way == "crash":
                raise RuntimeError("the simulator crashed")
            number, what = self.way.rsplit("-", 1)
            if what == "obs":
                obs[1] = float(number)
            else:
                reward = float(number)
        return obs, reward

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        fault_seed, step, self.way = os.environ.get("FAULT", "-1 0 none").split()
        self.steps, self.fault = 0, int(step) if seed == int(fault_seed) else None
        return self.outcome()[0], {}

    def step(self, action):
        self.steps += 1
        return *self.outcome(), False, False, {}


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


# --- Without end ------------------------------------------------------------------------------------------------------


class Goal(Line):
    """Ends at a goal that nobody reaches."""

    def step(self, action):
        obs, reward, *_ = super().step(action)
        return obs, reward, bool(self.x > 100), False, {}


for task in (Line, *Line.__subclasses__(), *Opened.__subclasses__(), OpenedNan, TimeStampsInFloats, Longer, Faulty):
    own_end = task in (Goal, TruncatedArray)
    gym.register(f"{task.__name__}-v0", task, max_episode_steps=None if own_end else 40)
gym.register("Unstable-v0", Unstable, max_episode_steps=150)
gym.register("Huge-v0", Faulty, max_episode_steps=40, kwargs={"scale": 1e30})
