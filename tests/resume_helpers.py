"""Runs that are killed, stopped or starved at an exact place, and all that a run leaves behind, made comparable.

It also registers `resume_helpers:Faulty-v0`: the episode with the seed, at the step and in the way that the environment
variable FAULT names, as "seed step way", has a bad number or crashes.
"""

import hashlib
import json
import multiprocessing
import os
import runpy
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import gymnasium as gym
import torch
import torch._inductor  # seconds that every fork would spend again
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

ROOT = Path(__file__).parent.parent

SCRIPTS = "ppo_continuous.py", "refineppo_continuous.py"
TASKS = (
    "Ant-v5 HalfCheetah-v5 Hopper-v5 Walker2d-v5 Swimmer-v5 Pusher-v5 Reacher-v5 HumanoidStandup-v5 Humanoid-v5 "
    "Pendulum-v1 MountainCarContinuous-v0 LunarLanderContinuous-v3 BipedalWalker-v3 BipedalWalkerHardcore-v3"
).split()
TINY = {
    "env_id": "Pendulum-v1",
    "total_timesteps": 512,
    "num_steps": 64,
    "num_minibatches": 4,
    "update_epochs": 2,
    "actor_hidden": 16,
    "critic_hidden": 16,
    "eval_interval": 128,
    "eval_episodes": 2,
    "final_eval_episodes": 2,
    "checkpoint_interval": 64,
    "compile": False,
    "progress": False,
}


def flags(run_dir: Path, *more: str, **settings) -> list:
    """A tiny run's flags: num_envs=2, compile=False as --num-envs 2 --no-compile."""
    words = ["--run-dir", run_dir, *more]
    for name, value in (TINY | settings).items():
        name = name.replace("_", "-")
        words += [f"--{name}" if value else f"--no-{name}"] if isinstance(value, bool) else [f"--{name}", value]
    return words


# --- Processes --------------------------------------------------------------------------------------------------------


def send(*signals: int):
    """An action: this process sends itself the signals, one after the other."""

    def action():
        for signum in signals:
            os.kill(os.getpid(), signum)
            time.sleep(0.01)  # for Python's handler

    return action


kill = send(signal.SIGKILL)


class Run:
    """`python SCRIPT FLAGS` in a fork of this process, which saves the seconds that importing torch takes.

    With `at` = (function, n), `action` is called before the n-th line, counted from 1, that the process executes in
    that function of the script: an exact place, where a clock would only hit the slow ones. `before` is called first.
    """

    def __init__(self, script: str, words: list, log: Path, at=None, action=kill, before=None):
        self.path, self.words, self.log = str(ROOT / script), [str(word) for word in words], log
        self.at, self.action, self.before = at, action, before
        self.process = multiprocessing.get_context("fork").Process(target=self.child)
        self.process.start()

    def child(self):
        output = os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for descriptor in (1, 2):
            os.dup2(output, descriptor)
        sys.stdout, sys.stderr = open(1, "w"), open(2, "w")
        sys.argv = [self.path, *self.words]
        if self.before:
            self.before()
        if self.at:
            sys.settrace(self.tracer(*self.at))
        runpy.run_path(self.path, run_name="__main__")

    def tracer(self, function: str, n: int):
        lines = 0

        def trace(frame, event, _):
            nonlocal lines
            if frame.f_code.co_name != function or frame.f_code.co_filename != self.path:
                return None
            lines += event == "line"
            if event == "line" and lines == n:
                self.action()
            return trace

        return trace

    def wait(self, timeout=300) -> int:
        """The exit code; minus the signal's number if one killed the process."""
        self.process.join(timeout)
        assert self.process.exitcode is not None, f"still running after {timeout} s"
        return self.process.exitcode

    def wait_until(self, condition, timeout=120):
        end = time.time() + timeout
        while not condition():
            assert self.process.is_alive() and time.time() < end, self.output()
            time.sleep(0.01)

    def output(self) -> str:
        return self.log.read_text() if self.log.exists() else ""


def finish(script: str, words: list, log: Path) -> str:
    """Run to the end; what it printed."""
    run = Run(script, words, log)
    assert run.wait() == 0, run.output()
    return run.output()


def count_lines(script: str, words: list, log: Path, functions: tuple[str, ...]) -> Counter:
    """Run to the end; how many lines it executed in each of the functions."""
    path, counts, file = str(ROOT / script), Counter(), log.with_suffix(".json")

    def trace(frame, event, _):
        function = frame.f_code.co_name
        if function not in functions or frame.f_code.co_filename != path:
            return None
        counts[function] += event == "line"
        return trace

    def before():
        sys.settrace(trace)
        multiprocessing.util.Finalize(None, lambda: file.write_text(json.dumps(counts)), exitpriority=0)

    run = Run(script, words, log, before=before)
    assert run.wait() == 0, run.output()
    return Counter(json.loads(file.read_text()))


# --- What a run leaves behind -----------------------------------------------------------------------------------------


def flatten(name: str, x) -> dict[str, str]:
    """Nested dicts and lists of tensors and plain values as {path: exact value}."""
    if isinstance(x, dict | list | tuple):
        items = x.items() if isinstance(x, dict) else enumerate(x)
        return {key: value for k, v in items for key, value in flatten(f"{name}/{k}", v).items()}
    if isinstance(x, torch.Tensor):
        return {name: f"{x.dtype} {tuple(x.shape)} {hashlib.sha256(x.numpy().tobytes()).hexdigest()}"}
    return {name: repr(x)}


def outcome(run_dir: Path) -> dict[str, str]:
    """All that must be equal in two runs of the same flags: everything but timings and the machine."""
    names = sorted(path.name for path in run_dir.iterdir() if not path.name.startswith("events.out"))
    found = {"files": " ".join(names), "evaluations.csv": (run_dir / "evaluations.csv").read_text()}
    for path in run_dir.glob("*.pt"):
        state = torch.load(path, weights_only=True)
        del state["args"]  # they hold --resume and --run-dir
        for timing in ("train_seconds", "wall_seconds"):
            state.get("progress", {}).pop(timing, None)
        found |= flatten(path.name, state)
    result = json.loads((run_dir / "result.json").read_text())
    del result["wall_time_s"], result["sps"]
    return found | flatten("result.json", result) | tensorboard(run_dir)


def tensorboard(run_dir: Path) -> dict[str, str]:
    """Every scalar but charts/SPS, as TensorBoard shows them, and how often text and hyperparameters are there."""
    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0, "tensors": 0}).Reload()
    tags = events.Tags()
    found = {tag: str([(e.step, e.value) for e in events.Scalars(tag)]) for tag in tags["scalars"] if "SPS" not in tag}
    return found | {tag: f"{len(events.Tensors(tag))} times" for tag in tags["tensors"]}


def differences(one: dict, other: dict) -> list[str]:
    """What differs between two outcomes."""
    return sorted(key for key in one.keys() | other.keys() if one.get(key) != other.get(key))


# --- Environments that fail on demand ---------------------------------------------------------------------------------


class Faulty(gym.Env):
    """Random observations and rewards; in the episode and at the step that FAULT names, one of them is bad."""

    observation_space = gym.spaces.Box(-1, 1, (3,), float)
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, render_mode=None, scale=1.0):
        self.render_mode, self.scale = render_mode, scale

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        fault_seed, step, self.way = os.environ.get("FAULT", "-1 0 none").split()
        self.steps, self.fault = 0, int(step) if seed == int(fault_seed) else None
        return self.np_random.uniform(-1, 1, 3), {}

    def step(self, action):
        obs, reward = self.np_random.uniform(-1, 1, 3), self.scale * self.np_random.normal()
        self.steps += 1
        if self.steps == self.fault:
            if self.way == "crash":
                raise RuntimeError("the simulator crashed")
            number, what = self.way.rsplit("-", 1)
            if what == "reward":
                reward = float(number)
            else:
                obs[1] = float(number)
        return obs, reward, False, False, {}


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


gym.register("Faulty-v0", Faulty, max_episode_steps=40)
gym.register("Huge-v0", Faulty, max_episode_steps=40, kwargs={"scale": 1e30})
gym.register("Unstable-v0", Unstable, max_episode_steps=150)
