"""Exact resume: a run killed anywhere and continued leaves the same as one that nothing interrupted."""

import json
import os
import random
import shutil
import signal
import time

import numpy as np
import pytest
import torch
from conftest import run
from resume_helpers import SCRIPTS, TASKS, Run, count_lines, differences, finish, flags, flatten, outcome


@pytest.fixture(params=SCRIPTS)
def name(request):
    """The file name of each of the two training scripts."""
    return request.param


# --- Killed runs ------------------------------------------------------------------------------------------------------

PLACES = "main", "collect", "step", "learn", "evaluate", "write_atomically", "save_checkpoint"
KILLED = {
    "HalfCheetah-v5": {"total_timesteps": 1280, "eval_interval": 640, "eval_episodes": 1},
    "Hopper-v5": {"num_envs": 3, "save_every": 256, "target_kl": 0.01},
    "Humanoid-v5": {"num_envs": 2, "anneal_lr": False, "checkpoint_interval": 200},
    "BipedalWalker-v3": {},
    "LunarLanderContinuous-v3": {"num_envs": 4, "total_timesteps": 1024, "normalize_reward": False},
    "Pendulum-v1": {"num_envs": 2, "total_timesteps": 1024, "bootstrap_truncated": True, "num_steps": 96},
}


@pytest.mark.parametrize("env_id", KILLED)
def test_killed_at_random_lines(name, env_id, tmp_path):
    """Three kills; no process may run more than a third of the lines, so that each comes before the end."""
    rng = random.Random(env_id + name)
    settings = KILLED[env_id] | {"env_id": env_id}
    lines = count_lines(name, flags(tmp_path / "whole", **settings), tmp_path / "log", PLACES)
    words = flags(tmp_path / "killed", "--resume", **settings)
    for place in rng.sample(PLACES, 3):
        killed = Run(name, words, tmp_path / "log", at=(place, rng.randint(1, lines[place] // 3)))
        assert killed.wait() == -signal.SIGKILL, killed.output()
    finish(name, words, tmp_path / "log")
    assert differences(outcome(tmp_path / "whole"), outcome(tmp_path / "killed")) == []


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


def test_killed_while_writing_anything(name, whole, tmp_path):
    """One kill after the other, each some lines further into the writing of files, until the run is through."""
    words, kills = flags(tmp_path / "run", "--resume", save_every=192), 0
    for n in range(1, 1000, 5):
        process = Run(name, words, tmp_path / "log", at=("write_atomically", n))
        if process.wait() == 0:
            break
        assert process.wait() == -signal.SIGKILL, process.output()
        kills += 1
    assert kills >= 10
    assert differences(outcome(whole(name)), outcome(tmp_path / "run")) == []


def test_killed_at_the_very_end(name, whole, tmp_path):
    """After the last checkpoint: in the final evaluation, its logs, result.json and what follows it."""
    words = flags(tmp_path / "run", "--resume", save_every=192)
    assert Run(name, words, tmp_path / "log", at=("load_checkpoint", 1)).wait() == -signal.SIGKILL
    shutil.copytree(tmp_path / "run", tmp_path / "copy")
    copied = flags(tmp_path / "copy", "--resume", save_every=192)
    rest = count_lines(name, copied, tmp_path / "log", ("main", "write_atomically"))
    for function, to_go in ("main", 35), ("main", 20), ("main", 15), ("write_atomically", 5), ("write_atomically", 0):
        killed = Run(name, words, tmp_path / "log", at=(function, rest[function] - to_go))
        assert killed.wait() == -signal.SIGKILL, killed.output()
    finish(name, words, tmp_path / "log")
    assert differences(outcome(whole(name)), outcome(tmp_path / "run")) == []


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
@pytest.mark.parametrize("env_id", TASKS)
def test_replay_is_exact(script, env_id, episodes):
    """Environments brought back by replay go on like those that they were saved from, to the last bit."""
    rng = np.random.default_rng(7)
    envs = script.Environments(env_id, 2, seed=3)

    def act():
        return rng.uniform(-1, 1, (2, *envs.envs[0].action_space.shape)).astype(np.float32)

    while episodes > 1 and min(envs.episodes) < episodes and len(envs.actions[0]) < 300:
        envs.step(act())
    for _ in range(30):
        envs.step(act())
    again = script.Environments(env_id, 2, seed=3)
    again.load(envs.state())
    assert again.obs.tolist() == envs.obs.tolist()
    assert (again.episodes, again.returns) == (envs.episodes, envs.returns)
    for _ in range(100):
        actions = act()
        obs, *others, ended = envs.step(actions)
        obs, ended = obs.tolist(), repr(ended)
        obs_again, *others_again, ended_again = again.step(actions)
        assert (obs_again.tolist(), others_again, repr(ended_again)) == (obs, others, ended)


def test_a_task_that_does_not_repeat_itself_is_warned_of(script, capsys):
    """`envs/obs` is there to be compared with what the replay leads to."""
    envs = script.Environments("Pendulum-v1", 2, seed=3)
    envs.step(np.zeros((2, 1), np.float32))
    state = envs.state()
    script.Environments("Pendulum-v1", 2, seed=3).load(state)
    assert capsys.readouterr().out == ""
    state["obs"][1, 0] += 1e-6
    script.Environments("Pendulum-v1", 2, seed=3).load(state)
    assert "Pendulum-v1 does not repeat itself" in capsys.readouterr().out


# --- Negative controls: every part of the saved state is needed -------------------------------------------------------

NETWORKS = [f"{net}.{i}.{kind}" for net in ("actor", "critic") for i in (0, 1) for kind in ("weight", "bias")]
STATISTICS = [f"{of}.{name}" for of in ("obs", "returns") for name in ("count", "mean", "squares")]
PARTS = [
    *(f"params/{name}" for name in (*NETWORKS, "log_std")),
    *(f"moments/{name}.{moment}" for name in (*NETWORKS, "log_std") for moment in ("mean", "square")),
    *(f"normalizer/{name}" for name in (*STATISTICS, "discounted")),
    *("envs/episodes", "envs/actions", "rng"),
    *(f"progress/{name}" for name in ("global_step", "adam_steps", "best_return", "evaluations", "late_returns")),
]
NOT_COMPARED = "args", "global_step", "compiled", "progress/train_seconds", "progress/wall_seconds", "envs/obs"


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """Folders of the same run killed after 1 and after 19 of its 20 iterations, and the last one's continuation."""
    folder = tmp_path_factory.mktemp("interrupted")
    settings = {"num_envs": 2, "num_steps": 32, "total_timesteps": 1280}
    for checkpoints in (1, 19):
        words = flags(folder / str(checkpoints), "--resume", **settings)
        killed = Run("refineppo_continuous.py", words, folder / "log", at=("exit_if_stopped", checkpoints + 1))
        assert killed.wait() == -signal.SIGKILL, killed.output()
        assert torch.load(folder / str(checkpoints) / "last.pt")["global_step"] == 64 * checkpoints
    shutil.copytree(folder / "19", folder / "20")
    words = flags(folder / "20", "--resume", **settings)
    finish("refineppo_continuous.py", words, folder / "log")
    return folder, words


def test_parts_are_all_that_is_saved(interrupted):
    saved = flatten("", torch.load(interrupted[0] / "19/last.pt"))
    known = *PARTS, *NOT_COMPARED
    assert [key for key in saved if not any(f"{key}/".startswith(f"/{part}/") for part in known)] == []


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
    assert Run(name, words, tmp_path / "log", at=("exit_if_stopped", 3)).wait() == -signal.SIGKILL
    return tmp_path / "run", words


def refusal(name, words, tmp_path) -> str:
    """The one sentence with which the command is refused."""
    refused = Run(name, words, tmp_path / "refused.log")
    assert refused.wait() == 2, refused.output()
    assert refused.output().startswith(f"{name}: error: ") and refused.output().count("\n") == 1, refused.output()
    return refused.output()


def contents(run_dir) -> dict:
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in run_dir.iterdir()}


@pytest.mark.parametrize("folder", ["missing", "empty", "without a checkpoint", "with other files"])
def test_resume_starts_from_the_beginning(name, folder, whole, tmp_path):
    run_dir, words = tmp_path / "deep/run", flags(tmp_path / "deep/run", "--resume", save_every=192)
    if folder == "without a checkpoint":
        assert Run(name, words, tmp_path / "log", at=("prepare_batch", 1)).wait() == -signal.SIGKILL
        assert (run_dir / "config.json").exists() and not (run_dir / "last.pt").exists()
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


def test_never_overwritten_without_resume(name, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run/notes.txt").write_text("mine")
    before = contents(tmp_path / "run")
    assert "not empty" in refusal(name, flags(tmp_path / "run"), tmp_path)
    assert contents(tmp_path / "run") == before


def test_resume_needs_a_run_dir(name, tmp_path):
    assert "--resume needs --run-dir" in refusal(name, ["--resume"], tmp_path)


def test_finished_run_is_left_as_it_is(name, whole, tmp_path):
    run_dir = whole(name)
    before = contents(run_dir)
    free = {"progress": True, "checkpoint_interval": 128}
    assert "is finished" in finish(name, flags(run_dir, "--resume", save_every=192, **free), tmp_path / "log")
    refused = refusal(name, flags(run_dir, "--resume", save_every=192, seed=2), tmp_path)
    assert "--seed 1" in refused
    assert contents(run_dir) == before


def test_other_flags_are_refused_by_name(name, killed, tmp_path):
    run_dir, words = killed
    before = contents(run_dir)
    refused = refusal(name, [*words, "--gamma", "0.9", "--num-steps", "128", "--progress"], tmp_path)
    assert "--num-steps 64" in refused and "--gamma 0.99" in refused and "--progress" not in refused
    assert contents(run_dir) == before


def test_free_flags_change_nothing(name, killed, whole, tmp_path):
    run_dir, words = killed
    finish(name, [*words, "--progress", "--checkpoint-interval", "150"], tmp_path / "log")
    assert differences(outcome(whole(name)), outcome(run_dir)) == []


def test_folder_of_the_other_script_is_refused(name, killed, tmp_path):
    (other,) = set(SCRIPTS) - {name}
    (killed[0] / "last.pt").unlink()
    exp_name = name.removesuffix(".py")
    assert "config.json" in refusal(other, [*killed[1], "--exp-name", exp_name], tmp_path)


@pytest.mark.parametrize("text", ["", '{"args": {', "[]", "{}", '{"args": {}}', "\0"])
def test_damaged_config_is_refused(name, text, killed, tmp_path):
    (killed[0] / "config.json").write_text(text)
    assert "config.json is damaged" in refusal(name, killed[1], tmp_path)


def test_lost_config_is_refused(name, killed, tmp_path):
    (killed[0] / "config.json").unlink()
    assert "has lost its config.json" in refusal(name, killed[1], tmp_path)


def edit_config(run_dir, **changes):
    config = json.loads((run_dir / "config.json").read_text())
    (run_dir / "config.json").write_text(json.dumps(config | changes))


def test_other_versions_are_refused(name, killed, tmp_path):
    edit_config(killed[0], versions={"torch": "1.0"})
    assert "'torch': '1.0'" in refusal(name, killed[1], tmp_path)


def test_versions_before_the_first_checkpoint_do_not_matter(name, killed, whole, tmp_path):
    run_dir, words = killed
    versions = json.loads((run_dir / "config.json").read_text())["versions"]
    (run_dir / "last.pt").unlink()
    edit_config(run_dir, versions={"torch": "1.0"})
    finish(name, words, tmp_path / "log")
    assert json.loads((run_dir / "config.json").read_text())["versions"] == versions
    assert differences(outcome(whole(name)), outcome(run_dir)) == []


def test_another_processor_is_warned_of(name, killed, tmp_path):
    edit_config(killed[0], cpu="abacus")
    assert "warning: begun on abacus" in finish(name, killed[1], tmp_path / "log")


def test_another_compile_mode_is_refused(name, tmp_path):
    """The flag is as before, but this time compilation fails; begun uncompiled, a run is not compiled later either."""

    def no_compiler(*_):
        raise RuntimeError("no C++ compiler")

    def break_compiler():
        torch.compile = lambda *_, **__: no_compiler

    words = flags(tmp_path / "run", "--resume", compile=True)
    killed = Run(name, words, tmp_path / "log", at=("exit_if_stopped", 2), before=break_compiler)
    assert killed.wait() == -signal.SIGKILL and "training goes on uncompiled" in killed.output()
    state = torch.load(tmp_path / "run/last.pt")
    assert state["compiled"] is False
    shutil.copytree(tmp_path / "run", tmp_path / "sound")
    words_there = ["--run-dir", tmp_path / "sound", *words[2:]]
    assert "compiling the update" not in finish(name, words_there, tmp_path / "log there")
    torch.save(state | {"compiled": True}, tmp_path / "run/last.pt")
    refused = Run(name, words, tmp_path / "log", before=break_compiler)
    assert refused.wait() == 2 and "was compiled, and continues exactly only so" in refused.output()


@pytest.mark.parametrize("foreign", ["another run's", "best.pt"])
def test_checkpoint_of_another_run_is_refused(name, foreign, killed, tmp_path):
    run_dir, words = killed
    source = run_dir / "best.pt"
    if foreign == "another run's":
        other = flags(tmp_path / "other", save_every=192, seed=2)
        assert Run(name, other, tmp_path / "log", at=("exit_if_stopped", 3)).wait() == -signal.SIGKILL
        source = tmp_path / "other/last.pt"
    shutil.copy(source, run_dir / "last.pt")
    assert "last.pt" in refusal(name, words, tmp_path)


def test_two_processes_in_one_folder(name, killed, whole, tmp_path):
    run_dir, words = killed
    first = Run(name, words, tmp_path / "log", at=("prepare_batch", 1), action=lambda: time.sleep(60))
    first.wait_until(lambda: len(list(run_dir.glob("events*"))) == 2)
    assert "another process" in refusal(name, words, tmp_path)
    os.kill(first.process.pid, signal.SIGKILL)
    first.wait()
    finish(name, words, tmp_path / "log")
    assert differences(outcome(whole(name)), outcome(run_dir)) == []


def test_task_without_a_time_limit_is_warned_of(name, tmp_path):
    printed = finish(name, flags(tmp_path / "run", env_id="probe_envs:MatchAction-v0"), tmp_path / "log")
    assert "warning: probe_envs:MatchAction-v0 has no time limit" in printed
