"""Runs that are killed at an exact line, and everything a run leaves behind, made comparable."""

import hashlib
import json
import multiprocessing
import os
import re
import resource
import runpy
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

ROOT = Path(__file__).parent.parent

TINY = {
    "total_timesteps": 768,
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
}


def as_flags(**settings) -> list[str]:
    """{"num_envs": 2, "compile": False} as ["--num-envs", "2", "--no-compile"]."""
    flags = []
    for name, value in settings.items():
        name = name.replace("_", "-")
        flags += [f"--{name}" if value else f"--no-{name}"] if isinstance(value, bool) else [f"--{name}", str(value)]
    return flags


# --- Processes --------------------------------------------------------------------------------------------------------


class Run:
    """`python SCRIPT FLAGS` in a fork of this process, which saves the seconds that importing torch takes.

    `action` is called at line number `line` of those that the process executes in the script's function `function`:
    an exact place, where a clock would only hit the slow ones. Lines are counted from 1, over all calls.
    """

    def __init__(self, script: str, flags: list, log: Path, function="", line=0, action=None, file_limit=None, env=None):
        self.path, self.flags, self.log = str(ROOT / script), [str(flag) for flag in flags], log
        self.function, self.line, self.action = function, line, action or kill
        self.file_limit, self.env, self.lines = file_limit, env or {}, log.with_suffix(".lines")
        self.process = multiprocessing.get_context("fork").Process(target=self.child)
        self.process.start()

    def child(self):
        output = os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.stdout, sys.stderr = open(1, "w"), open(2, "w")
        os.environ |= self.env
        sys.argv = [self.path, *self.flags]
        if self.file_limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (self.file_limit, self.file_limit))
        counts = Counter()

        def trace(frame, event, _):
            function = frame.f_code.co_name
            if frame.f_code.co_filename != self.path or (self.line and function != self.function):
                return None
            if event == "line":
                counts[function] += 1
                if function == self.function and counts[function] == self.line:
                    self.action()
            return trace

        if self.function:
            sys.settrace(trace)
        try:
            runpy.run_path(self.path, run_name="__main__")
        finally:
            sys.settrace(None)
            if self.function and not self.line:
                self.lines.write_text(json.dumps(counts))

    def wait(self, timeout=120) -> int:
        """The exit code; minus the signal's number if one killed the process."""
        self.process.join(timeout)
        assert self.process.exitcode is not None, f"still running after {timeout} s"
        return self.process.exitcode

    def wait_for(self, text: str, timeout=60):
        """Return once the process has printed `text`."""
        end = time.time() + timeout
        while not re.search(text, self.output()):
            assert time.time() < end and self.process.is_alive(), self.output()
            time.sleep(0.01)

    def send(self, signum: int):
        os.kill(self.process.pid, signum)

    def output(self) -> str:
        return self.log.read_text() if self.log.exists() else ""


def kill():
    os.kill(os.getpid(), signal.SIGKILL)


def finish(script: str, flags: list, log: Path) -> str:
    """Run to the end; what it printed."""
    run = Run(script, flags, log)
    assert run.wait() == 0, run.output()
    return run.output()


def count_lines(script: str, flags: list, log: Path) -> dict[str, int]:
    """Run to the end; how many lines it executed in each of the script's functions."""
    run = Run(script, flags, log, function="any")
    assert run.wait() == 0, run.output()
    return json.loads(run.lines.read_text())


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
    """All that must be equal in two runs with the same flags: everything but timings and the flags of the command."""
    files = sorted(path.name for path in run_dir.iterdir() if not path.name.startswith("events.out"))
    found = {"files": " ".join(files), "evaluations.csv": (run_dir / "evaluations.csv").read_text()}
    for path in run_dir.glob("*.pt"):
        state = torch.load(path, weights_only=True)
        del state["args"]
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
    return found | {tag: str(len(events.Tensors(tag))) for tag in tags["tensors"]}


def differences(one: dict, other: dict) -> list[str]:
    """What differs between two outcomes."""
    return sorted(key for key in one.keys() | other.keys() if one.get(key) != other.get(key))
