"""Exact resume: a run killed anywhere and continued leaves the same as one that nothing interrupted."""

import io
import os
import random
import shutil
import signal
import time
from importlib import import_module

import filelock
import numpy as np
import pytest
import torch
from conftest import run
from resume_helpers import (
    SCRIPTS,
    TASKS,
    Run,
    count_lines,
    differences,
    finish,
    flags,
    flatten,
    killed_after,
    outcome,
    refusal,
    send,
)
from test_commands import call_main
from tqdm import tqdm


@pytest.fixture(params=SCRIPTS)
def name(request):
    """The file name of each of the two training scripts."""
    return request.param


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A function from a script's name to the folder of a tiny run that nothing interrupted."""
    runs = {}

    def get(name):
        if name not in runs:
            runs[name] = tmp_path_factory.mktemp("whole") / "run"
            finish(name, flags(runs[name], save_every=192), runs[name].with_suffix(".log"))
        return runs[name]

    return get


SLOW = pytest.mark.slow

# --- Killed runs ------------------------------------------------------------------------------------------------------

KILLED = {
    "HalfCheetah-v5": {"total_timesteps": 1280, "eval_interval": 640, "eval_episodes": 1},
    "Hopper-v5": {"num_envs": 3, "save_every": 256, "target_kl": 0.01},
    "Humanoid-v5": {"num_envs": 2, "anneal_lr": False, "checkpoint_interval": 200},
    "BipedalWalker-v3": {},
    "LunarLanderContinuous-v3": {"num_envs": 4, "total_timesteps": 1024, "normalize_reward": False},
    "Pendulum-v1": {"num_envs": 2, "total_timesteps": 1024, "bootstrap_truncated": True, "num_steps": 96},
}


@pytest.mark.slow
@pytest.mark.parametrize("env_id", KILLED)
def test_killed_at_random_lines(name, env_id, tmp_path):
    """Three kills at lines of the loop, each in the first tenth of the line's executions: it comes before the end."""
    rng = random.Random(env_id + name)
    settings = KILLED[env_id] | {"env_id": env_id}
    executed = count_lines(name, flags(tmp_path / "whole", **settings), tmp_path / "log")
    words = flags(tmp_path / "killed", "--resume", **settings)
    for line in rng.sample([line for line, n in executed.items() if n >= 10], 3):
        killed = Run(name, words, tmp_path / "log", at=(line, rng.randint(1, executed[line] // 10)))
        assert killed.wait() == -signal.SIGKILL, killed.output()
    finish(name, words, tmp_path / "log")
    assert differences(outcome(tmp_path / "whole"), outcome(tmp_path / "killed")) == []


@pytest.mark.slow
@pytest.mark.parametrize("place", ["open(temporary", "file.write(", "os.fsync(", "os.replace("])
def test_killed_while_writing_anything(name, place, whole, tmp_path):
    """One kill after the other, each one file further, until the run is through."""
    words, kills = flags(tmp_path / "run", "--resume", save_every=192), 0
    while (process := Run(name, words, tmp_path / "log", at=(place, kills + 1))).wait() != 0:
        assert process.wait() == -signal.SIGKILL, process.output()
        kills += 1
    assert kills >= 5
    assert differences(outcome(whole(name)), outcome(tmp_path / "run")) == []


@pytest.mark.slow
def test_killed_at_the_very_end(name, whole, tmp_path):
    """After the last checkpoint: in the final evaluation, its logs, result.json and what follows it."""
    words = flags(tmp_path / "run", "--resume", save_every=192)
    assert Run(name, words, tmp_path / "log", after=("last.pt", 8)).wait() == -signal.SIGKILL
    for place in ("load_checkpoint(self.dir", 2), ("final/{name}_mean", 1), ("final/{name}_mean", 2):
        assert Run(name, words, tmp_path / "log", at=place).wait() == -signal.SIGKILL
    for word in ("at", "after"):
        place = {"at": ('"result.json", json.dumps', 1), "after": ("result.json", 1)}[word]
        assert Run(name, words, tmp_path / "log", **{word: place}).wait() == -signal.SIGKILL
    assert "is finished" in finish(name, words, tmp_path / "log")
    assert differences(outcome(whole(name)), outcome(tmp_path / "run")) == []


def test_an_evaluation_that_is_made_up_for_is_logged_once(name, whole, tmp_path):
    """Signals end it twice; the third process makes it and logs it, and is killed before it can save that."""
    words = flags(tmp_path / "run", "--resume", save_every=192)
    for _ in range(2):  # the second signal ends the one that is made up for
        stopped = Run(name, words, tmp_path / "log", at=("lengths[i] += 1", 100), action=send(signal.SIGTERM))
        assert stopped.wait() == 75, stopped.output()
    assert Run(name, words, tmp_path / "log", at=("run.save_last(training)", 1)).wait() == -signal.SIGKILL
    finish(name, words, tmp_path / "log")
    assert differences(outcome(whole(name)), outcome(tmp_path / "run")) == []


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [False, True], ids=["uncompiled", "compiled"])
def test_killed_by_the_clock(compiled, tmp_path):
    """SIGKILL soon after a checkpoint was written, whatever the process does then."""
    name, env_id = ("refineppo_continuous.py", "Hopper-v5") if compiled else ("ppo_continuous.py", "BipedalWalker-v3")
    settings = {"env_id": env_id, "compile": compiled, "total_timesteps": 6400, "eval_interval": 1000}
    words, rng, last = flags(tmp_path / "killed", "--resume", **settings), random.Random(0), tmp_path / "killed/last.pt"
    for _ in range(2):
        before = last.stat().st_mtime_ns if last.exists() else 0
        process = Run(name, words, tmp_path / "log")
        process.wait_until(lambda before=before: last.exists() and last.stat().st_mtime_ns > before)
        time.sleep(rng.uniform(0, 0.1))
        os.kill(process.process.pid, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL, process.output()
    finish(name, words, tmp_path / "log")
    whole = run(name, *flags(tmp_path / "whole", **settings))  # in a process that imports all by itself
    assert whole.returncode == 0, whole.stderr
    assert ("compiled in" in whole.stdout) == compiled
    assert differences(outcome(tmp_path / "whole"), outcome(tmp_path / "killed")) == []


# --- Replay -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("episodes", [1, 3], ids=["first_episode", "later_episode"])
@pytest.mark.parametrize("env_id", ["BipedalWalker-v3", "Hopper-v5", *(pytest.param(x, marks=SLOW) for x in TASKS)])
def test_replay_is_exact(script, env_id, episodes):
    """Environments brought back by replay go on like those that they were saved from, to the last bit."""
    rng = np.random.default_rng(7)
    args = script.Args(env_id=env_id, num_envs=2, seed=3)
    envs = script.Environments(args)

    def act():
        return rng.uniform(-1, 1, (2, *envs.envs[0].action_space.shape)).astype(np.float32)

    while episodes > 1 and min(envs.episodes) < episodes and len(envs.actions[0]) < 300:
        envs.step(act())
    for _ in range(30):
        envs.step(act())
    again = script.Environments(args)
    again.load(envs.state())
    assert again.obs.tolist() == envs.obs.tolist()
    assert (again.episodes, again.returns) == (envs.episodes, envs.returns)
    for _ in range(100):
        actions = act()
        obs, *others, ended = envs.step(actions)
        obs, ended = obs.tolist(), repr(ended)
        obs_again, *others_again, ended_again = again.step(actions)
        assert (obs_again.tolist(), others_again, repr(ended_again)) == (obs, others, ended)


@pytest.mark.parametrize("part", ["obs", "returns"])
def test_a_task_that_does_not_repeat_itself_is_warned_of(script, part, capsys):
    """`envs/obs` and `envs/returns` are there to be compared with what the replay leads to."""
    args = script.Args(env_id="Pendulum-v1", num_envs=2, seed=3)
    envs = script.Environments(args)
    envs.step(np.zeros((2, 1), np.float32))
    state = envs.state()
    script.Environments(args).load(state)
    assert capsys.readouterr().out == ""
    state[part] = state[part].clone() if part == "obs" else list(state[part])
    state[part][1] += 1e-6
    script.Environments(args).load(state)
    assert "Pendulum-v1 does not repeat itself" in capsys.readouterr().out


# --- Negative controls: every part of the saved state is needed -------------------------------------------------------

NETWORKS = [f"{net}.{i}.{kind}" for net in ("actor", "critic") for i in (0, 1) for kind in ("weight", "bias")]
STATISTICS = [f"{of}.{name}" for of in ("obs", "returns") for name in ("count", "mean", "squares")]
PARTS = [
    *(f"params/{name}" for name in (*NETWORKS, "log_std")),
    *(f"adam/moments/{name}.{moment}" for name in (*NETWORKS, "log_std") for moment in ("mean", "square")),
    *(f"normalizer/{name}" for name in (*STATISTICS, "discounted")),
    *("adam/steps", "envs/episodes", "envs/actions", "rng"),
    *(f"progress/{name}" for name in ("global_step", "best_return", "evaluations", "late_returns")),
]
# of the timings nothing depends; obs and returns are there to be compared, machine and compiled decide a refusal
NOT_COMPARED = "args", "global_step", "compiled", "machine", "progress/train_seconds", "progress/wall_seconds"
NOT_COMPARED += "logs", "envs/obs", "envs/returns", "progress/wandb_id"


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """Folders of the same run killed after 1 and after 19 of its 20 iterations, and the last one's continuation."""
    folder = tmp_path_factory.mktemp("interrupted")
    settings = {"num_envs": 2, "num_steps": 32, "total_timesteps": 1280}
    for checkpoints in (1, 19):
        killed_after(
            checkpoints,
            "refineppo_continuous.py",
            flags(folder / str(checkpoints), "--resume", **settings),
            folder / "log",
        )
        assert torch.load(folder / str(checkpoints) / "last.pt")["global_step"] == 64 * checkpoints
    shutil.copytree(folder / "19", folder / "20")
    words = flags(folder / "20", "--resume", **settings)
    finish("refineppo_continuous.py", words, folder / "log")
    return folder, words


@pytest.mark.slow
def test_parts_are_all_that_is_saved(interrupted):
    saved = flatten("", torch.load(interrupted[0] / "19/last.pt"))
    known = *PARTS, *NOT_COMPARED
    assert [key for key in saved if not any(f"{key}/".startswith(f"/{part}/") for part in known)] == []


@pytest.mark.slow
@pytest.mark.parametrize("part", [None, *PARTS])
def test_every_saved_part_is_needed(part, interrupted, tmp_path):
    """With one part as it was 18 iterations before, the continued run ends otherwise, or not at all."""
    folder, words = interrupted
    shutil.copytree(folder / "19", tmp_path / "run")
    state = torch.load(folder / "19/last.pt")
    if part:
        target, source = state, torch.load(folder / "1/last.pt")
        *path, name = part.split("/")
        for key in path:
            target, source = target[key], source[key]
        target[name] = source[name]
    torch.save(state, tmp_path / "run/last.pt")
    continued = Run("refineppo_continuous.py", ["--run-dir", tmp_path / "run", *words[2:]], tmp_path / "log")
    same = continued.wait() == 0 and not differences(outcome(folder / "20"), outcome(tmp_path / "run"))
    assert same == (part is None)


# --- Rules for run folders --------------------------------------------------------------------------------------------


@pytest.fixture
def killed(name, tmp_path):
    """The folder of a run killed after its second checkpoint, and the flags that continue it."""
    words = flags(tmp_path / "run", "--resume", save_every=192)
    killed_after(2, name, words, tmp_path / "log")
    return tmp_path / "run", words


def contents(run_dir) -> dict:
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in run_dir.iterdir()}


FRESH = "missing", "empty", "without a checkpoint", "with other files"


def edit(checkpoint, **changes):
    torch.save(torch.load(checkpoint) | changes, checkpoint)


@pytest.mark.parametrize("folder", ["without last.pt", *(pytest.param(x, marks=SLOW) for x in FRESH)])
def test_resume_starts_from_the_beginning(name, folder, whole, tmp_path):
    run_dir, words = tmp_path / "deep/run", flags(tmp_path / "deep/run", "--resume", save_every=192)
    if folder == "without a checkpoint":
        killed = Run(name, words, tmp_path / "log", at=("rollout = collect(", 1))
        assert killed.wait() == -signal.SIGKILL and not list(run_dir.glob("*.pt"))
    elif folder == "without last.pt":
        rarely = flags(run_dir, "--resume", save_every=192, checkpoint_interval=10**6)
        killed = Run(name, rarely, tmp_path / "log", after=("best.pt", 1))
        assert killed.wait() == -signal.SIGKILL and not (run_dir / "last.pt").exists()
        assert "--seed 1" in refusal(name, [*words, "--seed", 2], tmp_path / "log")
    elif folder != "missing":
        run_dir.mkdir(parents=True)
    if folder == "with other files":
        (run_dir / "notes.txt").write_text("mine")
    finish(name, words, tmp_path / "log")
    found = outcome(run_dir)
    if folder == "with other files":
        assert (run_dir / "notes.txt").read_text() == "mine"
        found["files"] = found["files"].replace(" notes.txt", "")
    assert differences(outcome(whole(name)), found) == []


def test_a_file_system_without_locks(name, whole, tmp_path):
    """There the lock is a file that goes with its process, and with it what says whose the folder is."""

    def without_flock():
        filelock.FileLock = filelock.SoftFileLock

    words = flags(tmp_path / "run", "--resume", save_every=192)
    at = "update_function = run.compile(", 1
    stopped = Run(name, words, tmp_path / "log", at=at, action=send(signal.SIGTERM), before=without_flock)
    assert stopped.wait() == 75 and not list((tmp_path / "run").glob("*.pt")), stopped.output()
    finish(name, words, tmp_path / "log", before=without_flock)
    assert differences(outcome(whole(name)), outcome(tmp_path / "run")) == []


def test_the_progress_bar_of_a_resumed_run(name, killed, monkeypatch):
    """It begins where the run goes on, so that steps/s and the time left are those of this process."""
    script, bars, (_, words) = import_module(name.removesuffix(".py")), [], killed

    def bar(**given):
        bars.append(tqdm(**given | {"disable": False, "file": io.StringIO()}))
        return bars[0]

    bar.write = tqdm.write
    monkeypatch.setattr(script, "tqdm", bar)
    call_main(script, *words)
    assert (bars[0].initial, bars[0].n, bars[0].total) == (128, 512, 512)


def test_finished_run_is_left_as_it_is(name, whole, tmp_path):
    run_dir = whole(name)
    before = contents(run_dir)
    free = {"progress": True, "checkpoint_interval": 128}
    assert "is finished" in finish(name, flags(run_dir, "--resume", **free), tmp_path / "log")
    assert "--seed 1" in refusal(name, flags(run_dir, "--resume", seed=2), tmp_path / "log")
    assert "is not empty" in refusal(name, flags(run_dir), tmp_path / "log")
    assert contents(run_dir) == before
    shutil.copytree(run_dir, tmp_path / "small", ignore=shutil.ignore_patterns("last.pt"))
    assert "is finished" in finish(name, flags(tmp_path / "small", "--resume", seed=2), tmp_path / "log")


def test_other_flags_are_refused_by_name(name, killed, tmp_path):
    run_dir, words = killed
    before = contents(run_dir)
    refused = refusal(name, [*words, "--gamma", "0.9", "--num-steps", "128", "--progress"], tmp_path / "log")
    assert "--num-steps 64" in refused and "--gamma 0.99" in refused and "--progress" not in refused
    assert contents(run_dir) == before


@pytest.mark.parametrize("config", ["torn", *(pytest.param(x, marks=SLOW) for x in ("missing", "as it was"))])
def test_free_flags_and_config_json_change_nothing(name, config, killed, whole, tmp_path):
    run_dir, words = killed
    if config != "as it was":
        text = (run_dir / "config.json").read_text()
        (run_dir / "config.json").unlink()
    if config == "torn":
        (run_dir / "config.json").write_text(text[:100])
    finish(name, [*words, "--progress", "--checkpoint-interval", "150"], tmp_path / "log")
    found, expected = outcome(run_dir), outcome(whole(name))
    if config == "missing":
        found.pop("files"), expected.pop("files")
    assert differences(expected, found) == []


@pytest.mark.parametrize("left", ["last.pt", "best.pt"])
def test_folder_of_the_other_script_is_refused(name, left, killed, tmp_path):
    (other,) = set(SCRIPTS) - {name}
    for path in killed[0].glob("*.pt"):
        path.rename(killed[0] / left)
    assert left in refusal(other, [*killed[1], "--exp-name", name.removesuffix(".py")], tmp_path / "log")


def test_other_versions_are_refused(name, killed, tmp_path):
    machine = torch.load(killed[0] / "last.pt")["machine"]
    edit(killed[0] / "last.pt", machine=machine | {"versions": machine["versions"] | {"torch": "1.0"}})
    assert "'torch': '1.0'" in refusal(name, killed[1], tmp_path / "log")


def test_another_processor_or_commit_is_warned_of(name, killed, whole, tmp_path):
    machine = torch.load(killed[0] / "last.pt")["machine"]
    edit(killed[0] / "last.pt", machine=machine | {"cpu": "abacus", "git_commit": "c0ffee"})
    warnings = [line for line in finish(name, killed[1], tmp_path / "log").splitlines() if "warning" in line]
    assert len(warnings) == 2 and "abacus" in warnings[0] and "c0ffee" in warnings[1]
    found, expected = outcome(killed[0]), outcome(whole(name))
    assert differences(expected, found) == []


@pytest.mark.slow
def test_another_compile_mode_is_refused(name, tmp_path):
    """The flag is as before, but this time compilation fails; begun uncompiled, a run is not compiled later either."""

    def no_compiler(*_):
        raise RuntimeError("no C++ compiler")

    def break_compiler():
        torch.compile = lambda *_, **__: no_compiler

    words = flags(tmp_path / "run", "--resume", compile=True)
    killed = Run(name, words, tmp_path / "log", after=("last.pt", 1), before=break_compiler)
    assert killed.wait() == -signal.SIGKILL and "training goes on uncompiled" in killed.output()
    assert torch.load(tmp_path / "run/last.pt")["compiled"] is False
    shutil.copytree(tmp_path / "run", tmp_path / "sound")
    words_there = ["--run-dir", tmp_path / "sound", *words[2:]]
    assert "compiling the update" not in finish(name, words_there, tmp_path / "log there")
    edit(tmp_path / "run/last.pt", compiled=True)
    refused = Run(name, words, tmp_path / "log", before=break_compiler)
    assert refused.wait() == 2 and "was compiled, and continues exactly only so" in refused.output()


@pytest.mark.slow
def test_dynamo_switched_off_is_not_called_compiled(name, tmp_path):
    off = {"TORCHDYNAMO_DISABLE": "1"}
    done = run(name, *flags(tmp_path / "run", compile=True), **off)
    assert done.returncode == 0 and "training goes on uncompiled" in done.stdout, done.stderr
    assert torch.load(tmp_path / "run/last.pt")["compiled"] is False


@pytest.mark.parametrize("foreign", ["another run's", "best.pt"])
def test_checkpoint_of_another_run_is_refused(name, foreign, killed, tmp_path):
    run_dir, words = killed
    if foreign == "another run's":
        edit(run_dir / "last.pt", args=torch.load(run_dir / "last.pt")["args"] | {"seed": 2})
    else:
        shutil.copy(run_dir / "best.pt", run_dir / "last.pt")
    assert str(run_dir) in refusal(name, words, tmp_path / "log")


def test_two_processes_in_one_folder(name, killed, whole, tmp_path):
    """The lock of a process that was killed does not block."""
    run_dir, words = killed
    first = Run(name, words, tmp_path / "log", at=("rollout = collect(", 1), action=lambda: time.sleep(60))
    first.wait_until(lambda: len(list(run_dir.glob("events*"))) == 2)
    assert "another process" in refusal(name, words, tmp_path / "log2")
    os.kill(first.process.pid, signal.SIGKILL)
    first.wait()
    finish(name, words, tmp_path / "log")
    assert differences(outcome(whole(name)), outcome(run_dir)) == []
