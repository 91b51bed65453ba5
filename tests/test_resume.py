"""Exact resume: a run killed anywhere and continued leaves the same as one that nothing interrupted."""

import os
import random
import shutil
import signal
import time
from unittest import mock

import filelock
import numpy as np
import pytest
import torch
from conftest import wait_until
from resume_helpers import KILLED, TASKS, Run, ends_with, finish_exactly, flags, interrupt, outcome, refusal, send
from test_commands import call_main
from tqdm import tqdm

import ppo_continuous
import refineppo_continuous

SLOW = pytest.mark.slow

# --- Killed runs ------------------------------------------------------------------------------------------------------

VARIED = {
    "HalfCheetah-v5": {"total_timesteps": 1280, "eval_interval": 640, "eval_episodes": 1},
    "Hopper-v5": {"num_envs": 3, "save_every": 256, "target_kl": 0.01},
    "Humanoid-v5": {"num_envs": 2, "anneal_lr": False, "checkpoint_interval": 200},
    "BipedalWalker-v3": {},
    "LunarLanderContinuous-v3": {"num_envs": 4, "total_timesteps": 1024, "normalize_reward": False},
    "Pendulum-v1": {"num_envs": 2, "total_timesteps": 1024, "bootstrap_truncated": True, "num_steps": 96},
}


@pytest.mark.slow
@pytest.mark.parametrize("env_id", VARIED)
def test_killed_three_times(script, env_id, tmp_path):
    rng = random.Random(env_id + script.__name__)
    words = flags(tmp_path / "run", "--resume", env_id=env_id, **VARIED[env_id])
    for _ in range(3):
        killed = interrupt(rng, script, words)
        assert killed.wait() == KILLED, killed.output()
    finish_exactly(script, words)


@pytest.mark.slow
@pytest.mark.parametrize("place", ["open(temporary", "file.write(", "os.fsync(", "os.replace("])
def test_killed_while_writing_anything(script, place, tmp_path):
    """One kill after the other, each one file further, until the run is through."""
    words, kills = flags(tmp_path / "run", "--resume"), 0
    while (killed := Run(script, words, at=(place, kills + 1))).wait() != 0:
        assert killed.wait() == KILLED, killed.output()
        kills += 1
    assert kills >= 5
    finish_exactly(script, words)


@pytest.mark.slow
def test_killed_at_the_very_end(script, tmp_path):
    """After the last checkpoint: in the final evaluation, its logs, result.json and what follows it."""
    words = flags(tmp_path / "run", "--resume")
    ends_with(KILLED, script, words, after=("last.pt", 8))
    for piece, n in (
        ("load_checkpoint(self.dir", 2),
        ("final/{name}_mean", 1),
        ("final/{name}_mean", 2),
        ('"result.json", json.dumps', 1),
    ):
        ends_with(KILLED, script, words, at=(piece, n))
    ends_with(KILLED, script, words, after=("result.json", 1))
    assert "is finished" in finish_exactly(script, words)


def test_an_evaluation_that_is_made_up_for_is_logged_once(script, tmp_path):
    """Signals end it twice; the third process makes it and logs it, and is killed before it can save that."""
    words = flags(tmp_path / "run", "--resume")
    for _ in range(2):  # the second signal ends the one that is made up for
        ends_with(75, script, words, at=("lengths[i] += 1", 100), action=send(signal.SIGTERM))
    ends_with(KILLED, script, words, at=("run.save_last(training)", 1))
    finish_exactly(script, words)


@pytest.mark.slow
def test_killed_when_compiled(script, tmp_path):
    words = flags(tmp_path / "run", "--resume", compile=True)
    ends_with(KILLED, script, words, after=("last.pt", 3))
    assert "compiled in" in finish_exactly(script, words)
    assert torch.load(tmp_path / "run/last.pt")["compiled"] is True


@pytest.mark.parametrize("env_id", ["BipedalWalker-v3", "Hopper-v5", *(pytest.param(x, marks=SLOW) for x in TASKS)])
def test_replay_is_exact(script, env_id):
    """Environments brought back in the third episode go on like those that they were saved from, to the last bit."""
    args = script.Args(env_id=env_id, num_envs=2, seed=3, max_episode_steps=100)
    envs, again = script.Environments(args), script.Environments(args)
    actions = np.random.default_rng(7).uniform(-1, 1, (330, 2, *envs.envs[0].action_space.shape)).astype(np.float32)
    for action in actions[:230]:
        envs.step(action)
    again.load(envs.state())
    np.testing.assert_equal((again.obs, again.returns, again.episodes), (envs.obs, envs.returns, envs.episodes))
    for action in actions[230:]:
        np.testing.assert_equal(again.step(action), envs.step(action))


# --- Negative controls: every part of the saved state is needed -------------------------------------------------------


def parts(state: dict) -> list[str]:
    """The paths of all that a checkpoint holds; flags, machine and random generator are a part each."""
    found = []
    for name, value in state.items():
        whole = not isinstance(value, dict) or name in ("args", "machine", "rng")
        found += [name] if whole else [f"{name}/{part}" for part in parts(value)]
    return found


# of the timings nothing depends; obs and returns are there to be compared, machine and compiled decide a refusal
NOT_NEEDED = {"args", "global_step", "compiled", "machine", "envs/obs", "envs/returns"}
NOT_NEEDED |= {f"progress/{name}" for name in ("train_seconds", "wall_seconds", "wandb_id")}


@pytest.mark.slow
def test_every_saved_part_is_needed(tmp_path):
    """With one part as it was 18 iterations before, the continued run ends otherwise, or not at all."""
    script, run_dir = refineppo_continuous, tmp_path / "run"
    words = flags(run_dir, "--resume", num_envs=2, num_steps=32, total_timesteps=1280)
    ends_with(KILLED, script, words, after=("last.pt", 1))
    early = torch.load(run_dir / "last.pt")
    ends_with(KILLED, script, words, after=("last.pt", 18))
    late = torch.load(run_dir / "last.pt")
    assert (early["global_step"], late["global_step"]) == (64, 19 * 64)
    shutil.copytree(run_dir, tmp_path / "late")
    finish_exactly(script, words)
    whole, not_needed = outcome(run_dir), set()
    for part in parts(late):
        state, source = torch.load(tmp_path / "late/last.pt"), early
        target, (*path, name) = state, part.split("/")
        for key in path:
            target, source = target[key], source[key]
        target[name] = source[name]
        shutil.rmtree(run_dir)
        shutil.copytree(tmp_path / "late", run_dir)
        torch.save(state, run_dir / "last.pt")
        if Run(script, words).wait() == 0 and outcome(run_dir) == whole:
            not_needed.add(part)
    assert not_needed == NOT_NEEDED


# --- Rules for run folders --------------------------------------------------------------------------------------------


@pytest.fixture
def killed(script, tmp_path):
    """The folder of a run killed after its second checkpoint, and the flags that continue it."""
    words = flags(tmp_path / "run", "--resume")
    ends_with(KILLED, script, words, after=("last.pt", 2))
    return tmp_path / "run", words


def contents(run_dir) -> dict:
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in run_dir.iterdir()}


def edit(checkpoint, **changes):
    torch.save(torch.load(checkpoint) | changes, checkpoint)


def test_a_run_without_last_pt_starts_from_the_beginning(script, tmp_path):
    """In a folder with other files, after a kill before the first checkpoint, and after one that left best.pt alone."""
    run_dir, words = tmp_path / "run", flags(tmp_path / "run", "--resume")
    run_dir.mkdir()
    (run_dir / "notes.txt").write_text("mine")
    ends_with(KILLED, script, words, at=("rollout = collect(", 1))
    assert not list(run_dir.glob("*.pt"))
    ends_with(KILLED, script, [*words, "--checkpoint-interval", 10**6], after=("best.pt", 1))
    assert not (run_dir / "last.pt").exists()
    assert "--seed 1" in refusal(script, [*words, "--seed", 2])
    assert (run_dir / "notes.txt").read_text() == "mine"
    (run_dir / "notes.txt").unlink()
    finish_exactly(script, words)


def test_a_file_system_without_locks(script, tmp_path):
    """There the lock is a file that goes with its process, and with it what says whose the folder is."""

    def without_flock():
        filelock.FileLock = filelock.SoftFileLock

    words, at = flags(tmp_path / "run", "--resume"), ("update_function = run.compile(", 1)
    ends_with(75, script, words, at=at, action=send(signal.SIGTERM), before=without_flock)
    assert not list((tmp_path / "run").glob("*.pt"))
    finish_exactly(script, words, before=without_flock)


def test_the_progress_bar_of_a_resumed_run(script, killed):
    """It begins where the run goes on, so that steps/s and the time left are those of this process."""
    with mock.patch.object(script, "tqdm", wraps=tqdm) as bar:
        call_main(script, *killed[1])
    assert (bar.call_args.kwargs["initial"], bar.call_args.kwargs["total"]) == (128, 512)


def test_finished_run_is_left_as_it_is(script, tmp_path):
    run_dir = tmp_path / "run"
    ends_with(0, script, flags(run_dir))
    before = contents(run_dir)
    assert "is finished" in ends_with(0, script, flags(run_dir, "--resume", progress=True, checkpoint_interval=128))
    assert "--seed 1" in refusal(script, flags(run_dir, "--resume", seed=2))
    assert "is not empty" in refusal(script, flags(run_dir))
    assert contents(run_dir) == before
    (run_dir / "last.pt").unlink()
    assert "is finished" in ends_with(0, script, flags(run_dir, "--resume", seed=2))


def test_another_run_is_not_continued(script, killed):
    """One of other flags, of the other script, or of other versions; the folder stays as it was."""
    run_dir, words = killed
    (other,) = {ppo_continuous, refineppo_continuous} - {script}
    before = contents(run_dir)
    refused = refusal(script, [*words, "--gamma", "0.9", "--num-steps", "128", "--progress"])
    assert "--num-steps 64" in refused and "--gamma 0.99" in refused and "--progress" not in refused
    refused = refusal(other, [*words, "--exp-name", script.__name__])
    assert "last.pt was not written by" in refused and "has --refinement-depth, --refinement-schedule" in refused
    assert contents(run_dir) == before
    machine = torch.load(run_dir / "last.pt")["machine"]
    edit(run_dir / "last.pt", machine=machine | {"versions": machine["versions"] | {"torch": "1.0"}})
    assert "'torch': '1.0'" in refusal(script, words)


def test_what_changes_nothing(script, killed):
    """Other free flags, a torn config.json, what a kill or a failure left, and, with a warning, another machine."""
    run_dir, words = killed
    for leftover in ("config.json", "last.pt.tmp", "result.json.tmp", "failure.json"):
        (run_dir / leftover).write_bytes(b"torn")
    (events,) = run_dir.glob("events*")
    with open(events, "ab") as file:
        file.write(events.read_bytes()[:100] + b"\x18\0\0\0")
    machine = torch.load(run_dir / "last.pt")["machine"]
    edit(run_dir / "last.pt", machine=machine | {"cpu": "abacus", "git_commit": "c0ffee"})
    printed = finish_exactly(script, words, "--progress", "--checkpoint-interval", 150)
    cpu, commit = (line for line in printed.splitlines() if "warning" in line)
    assert "abacus" in cpu and "c0ffee" in commit


def test_two_processes_in_one_folder(script, killed):
    """The lock of a process that was killed does not block."""
    run_dir, words = killed
    first = Run(script, words, at=("rollout = collect(", 1), action=lambda: time.sleep(60))
    wait_until(lambda: len(list(run_dir.glob("events*"))) == 2)
    assert "another process" in refusal(script, words)
    os.kill(first.process.pid, signal.SIGKILL)
    first.wait()
    finish_exactly(script, words)


@pytest.mark.slow
def test_another_compile_mode_is_refused(script, tmp_path):
    """The flag is as before, but torch.compile is switched off; begun so, a run is not compiled later either."""

    def switch_off():
        torch._dynamo.config.disable = True  # as TORCHDYNAMO_DISABLE=1 does

    words = flags(tmp_path / "run", "--resume", compile=True)
    printed = ends_with(KILLED, script, words, after=("last.pt", 1), before=switch_off)
    assert "training goes on uncompiled" in printed and torch.load(tmp_path / "run/last.pt")["compiled"] is False
    shutil.copytree(tmp_path / "run", tmp_path / "sound")
    assert "compiling the update" not in ends_with(0, script, ["--run-dir", tmp_path / "sound", *words[2:]])
    edit(tmp_path / "run/last.pt", compiled=True)
    assert "was compiled, and continues exactly only so" in ends_with(2, script, words, before=switch_off)
