"""Runs that are killed, stopped or starved at an exact place, and all that a run leaves behind, made comparable."""

import hashlib
import json
import multiprocessing
import os
import runpy
import signal
import sys
import time
from collections import Counter
from functools import cache
from pathlib import Path

import torch
import torch._inductor  # seconds that every fork would spend again
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


def lines_with(script: str, piece: str) -> list[int]:
    """The numbers of the script's lines that contain the piece of text."""
    lines = (ROOT / script).read_text().splitlines()
    numbers = [number for number, line in enumerate(lines, start=1) if piece in line]
    assert numbers, f"no line of {script} contains {piece!r}"
    return numbers


class Run:
    """`python SCRIPT FLAGS` in a fork of this process, which saves the seconds that importing torch takes.

    `action` is called at an exact place, where a clock would only hit the slow ones: with `at` = (piece of text, n)
    before the script executes for the n-th time a line that contains the text (or has this number), with `after` =
    (file name, n) when the n-th version of the file is in place. `before` is called first.
    """

    def __init__(self, script: str, words: list, log: Path, at=None, after=None, action=kill, before=None):
        self.path, self.words, self.log = str(ROOT / script), [str(word) for word in words], log
        self.after, self.action, self.before = after, action, before
        if at:
            piece, n = at
            at = lines_with(script, piece) if isinstance(piece, str) else [piece], n
        self.at = at
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
        if self.after:
            os.replace = self.replacing(os.replace, *self.after)
        if self.at:
            (lines, n), executed = self.at, 0

            def count(_):
                nonlocal executed
                executed += 1
                if executed == n:
                    self.action()

            sys.settrace(tracer(self.path, count, frozenset(lines)))
        runpy.run_path(self.path, run_name="__main__")

    def replacing(self, replace, name: str, n: int):
        """os.replace, which acts as soon as it has put the n-th version of the file in place."""
        versions = 0

        def replace_and_act(source, target):
            nonlocal versions
            replace(source, target)
            versions += Path(target).name == name
            if Path(target).name == name and versions == n:
                self.action()

        return replace_and_act

    def wait(self, timeout=600) -> int:
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
        return self.log.read_text(errors="replace") if self.log.exists() else ""


def tracer(path: str, seen, lines: frozenset = frozenset()):
    """For sys.settrace: `seen(line number)` before every line, or every one of these lines, that the file executes."""

    @cache  # most functions have none of the lines, and go on at full speed
    def is_watched(code) -> bool:
        return code.co_filename == path and (not lines or any(line in lines for *_, line in code.co_lines()))

    def trace(frame, event, _):
        if event == "call" and not is_watched(frame.f_code):
            return None
        if event == "line" and (not lines or frame.f_lineno in lines):
            seen(frame.f_lineno)
        return trace

    return trace


def finish(script: str, words: list, log: Path, **more) -> str:
    """Run to the end; what it printed."""
    run = Run(script, words, log, **more)
    assert run.wait() == 0, run.output()
    return run.output()


def killed_after(versions: int, script: str, words: list, log: Path):
    """Run until last.pt is there for this time, and kill it there."""
    killed = Run(script, words, log, after=("last.pt", versions))
    assert killed.wait() == -signal.SIGKILL, killed.output()


def refusal(script: str, words: list, log: Path) -> str:
    """The one sentence with which the command is refused, below a task's own traceback and warnings."""
    refused = Run(script, words, log)
    assert refused.wait() == 2, refused.output()
    *above, sentence = refused.output().splitlines()
    assert sentence.startswith(f"{script}: error: "), refused.output()
    assert not above or above[0].startswith(("warning: ", "Traceback")), refused.output()
    return sentence


def count_lines(script: str, words: list, log: Path) -> Counter:
    """Run to the end; how often it executed each of the script's lines."""
    counts, file = Counter(), log.with_suffix(".json")

    def count(line):
        counts[line] += 1

    def before():
        sys.settrace(tracer(str(ROOT / script), count))
        multiprocessing.util.Finalize(None, lambda: file.write_text(json.dumps(counts)), exitpriority=0)

    finish(script, words, log, before=before)
    return Counter({int(line): n for line, n in json.loads(file.read_text()).items()})


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
    names = sorted(path.name for path in run_dir.iterdir() if not path.name.startswith(("events.out", ".lock")))
    found = {"files": " ".join(names), "evaluations.csv": (run_dir / "evaluations.csv").read_text()}
    for path in run_dir.glob("*.pt"):
        state = torch.load(path, weights_only=True)
        del state["args"]  # they hold --resume and --run-dir
        state.pop("logs", None)  # names with the time in them
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
