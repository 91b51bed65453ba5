"""Runs that are killed, stopped or starved at an exact place, and all that a run leaves behind, made comparable."""

import hashlib
import itertools
import json
import multiprocessing
import os
import runpy
import signal
import sys
import tempfile
import time
from functools import cache
from pathlib import Path

import torch
import torch._inductor  # seconds that every fork would spend again
from flags import words
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

TASKS = (
    "Ant-v5 HalfCheetah-v5 Hopper-v5 Walker2d-v5 Swimmer-v5 Pusher-v5 Reacher-v5 HumanoidStandup-v5 Humanoid-v5 "
    "Pendulum-v1 MountainCarContinuous-v0 LunarLanderContinuous-v3 BipedalWalker-v3 BipedalWalkerHardcore-v3"
).split()
TINY = dict(env_id="Pendulum-v1", total_timesteps=512, num_steps=64, num_minibatches=4, update_epochs=2)
TINY |= dict(actor_hidden=16, critic_hidden=16, eval_interval=128, eval_episodes=2, final_eval_episodes=2)
TINY |= dict(checkpoint_interval=64, save_every=192, compile=False, progress=False)


def flags(run_dir: Path, *more: str, **settings) -> list:
    """A tiny run's flags: num_envs=2, compile=False as --num-envs 2 --no-compile."""
    return ["--run-dir", run_dir, *more, *words(TINY | settings)]


# --- Processes --------------------------------------------------------------------------------------------------------

KILLED = -signal.SIGKILL  # the exit code


def send(*signals: int):
    """An action: this process sends itself the signals, one after the other."""

    def action():
        for signum in signals:
            os.kill(os.getpid(), signum)
            time.sleep(0.01)  # for Python's handler

    return action


class Run:
    """The script's command in a fork of this process, which saves the seconds that importing torch takes.

    `action`, else SIGKILL, is called at an exact place, where a clock would only hit the slow ones: with `at` = (piece
    of text, n) before the script executes for the n-th time a line that contains the text, with `after` = (file name,
    n) when the n-th version of the file is in place. `before` is called first; `odd` tells odd_envs.py what to do.
    """

    def __init__(self, script, words: list, **more):
        self.path, self.words, self.log = script.__file__, [str(word) for word in words], tempfile.TemporaryFile()
        self.process = multiprocessing.get_context("fork").Process(target=self.child, kwargs=more)
        self.process.start()

    def child(self, at=None, after=None, action=None, before=None, odd=""):
        for descriptor in (1, 2):
            os.dup2(self.log.fileno(), descriptor)
        sys.stdout, sys.stderr, sys.argv = open(1, "w"), open(2, "w"), [self.path, *self.words]
        os.environ["ODD"], action = str(odd), action or send(signal.SIGKILL)
        if before:
            before()
        if at:
            self.act_at(*at, action)
        if after:
            self.act_after(*after, action)
        runpy.run_path(self.path, run_name="__main__")

    def act_at(self, piece: str, n: int, action):
        source, executions = enumerate(Path(self.path).read_text().splitlines(), start=1), itertools.count(1)
        lines = {number for number, line in source if piece in line}
        assert lines, f"no line of {self.path} contains {piece!r}"

        @cache  # most functions have none of the lines, and go on at full speed
        def is_watched(code) -> bool:
            return code.co_filename == self.path and any(line in lines for *_, line in code.co_lines())

        def trace(frame, event, _):
            if event == "call" and not is_watched(frame.f_code):
                return None
            if event == "line" and frame.f_lineno in lines and next(executions) == n:
                action()
            return trace

        sys.settrace(trace)

    def act_after(self, name: str, n: int, action):
        replace, versions = os.replace, itertools.count(1)

        def replace_and_act(source, target):
            replace(source, target)
            if Path(target).name == name and next(versions) == n:
                action()

        os.replace = replace_and_act

    def wait(self, timeout=600) -> int:
        """The exit code; minus the signal's number if one killed the process."""
        self.process.join(timeout)
        if self.process.is_alive():
            self.process.kill()  # else pytest would wait for it at its own end
            raise TimeoutError(self.output())
        return self.process.exitcode

    def output(self) -> str:
        return os.pread(self.log.fileno(), 10**6, 0).decode(errors="replace")


def ends_with(code: int, script, words: list, timeout=600, **more) -> str:
    """Run until it ends with this exit code; what it printed."""
    run = Run(script, words, **more)
    assert run.wait(timeout) == code, run.output()
    return run.output()


def refusal(script, words: list) -> str:
    """What is printed where the command is refused: one sentence, below a task's own traceback and warnings."""
    printed = ends_with(2, script, words)
    *above, sentence = printed.splitlines()
    assert sentence.startswith(f"{script.__name__}.py: error: "), printed
    assert not above or above[0].startswith(("warning: ", "Traceback")), printed
    return printed


@cache
def uninterrupted(script, *words) -> dict[str, str]:
    """What a run with these flags leaves where nothing interrupts it."""
    with tempfile.TemporaryDirectory() as folder:
        ends_with(0, script, ["--run-dir", Path(folder, "run"), *words])
        return outcome(Path(folder, "run"))


def finish_exactly(script, words: list, *now, **more) -> str:
    """Continue the run to its end, with the flags `now` as well; what it printed.

    It must leave what `words`, which are its own `flags`, leave where nothing interrupts it.
    """
    printed = ends_with(0, script, [*words, *now], **more)
    _, run_dir, *own = words
    whole = uninterrupted(script, *(word for word in own if word != "--resume"))
    assert differences(whole, outcome(run_dir)) == []
    return printed


PLACES = {  # pieces of the scripts' lines, and how often a process may execute one before it is interrupted
    "training = run.begin_or_resume()": 1,
    "self.actions[i].append(": 100,
    "torch.from_numpy(rollout.obs)": 2,
    "update_function(agent.params": 20,
    "add_scalar(": 40,
    "lengths[i] += 1": 300,
    "torch.save(state": 4,
    "os.fsync(": 8,
    "os.replace(": 8,
}


def interrupt(rng, script, words: list, signum=signal.SIGKILL, scale=1) -> Run:
    """Start the run and interrupt it at a random place."""
    place = rng.choice(list(PLACES))
    n = int((scale * PLACES[place]) ** rng.random())  # as often among the first ten as among the first hundred
    return Run(script, words, at=(place, n), action=send(signum))


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
    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0, "tensors": 0}).Reload()
    scalars = [tag for tag in events.Tags()["scalars"] if tag != "charts/SPS"]
    found |= {tag: str([(event.step, event.value) for event in events.Scalars(tag)]) for tag in scalars}
    found |= {tag: f"{len(events.Tensors(tag))} times" for tag in events.Tags()["tensors"]}
    return found | flatten("result.json", result)


def differences(one: dict, other: dict) -> list[str]:
    """What differs between two outcomes."""
    return sorted(key for key in one.keys() | other.keys() if one.get(key) != other.get(key))
