"""Clean stops and clear failures: signals, a full disk, damaged files, bad numbers and crashing simulators."""

import ast
import errno
import json
import os
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import time
import zipfile

import pytest
import torch
from conftest import ROOT
from resume_helpers import SCRIPTS, Run, differences, finish, flags, killed_after, outcome, refusal, send
from test_commands import call_main


@pytest.fixture(params=SCRIPTS)
def name(request):
    """The file name of each of the two training scripts."""
    return request.param


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A function from a script's name and settings to the outcome of a tiny run that nothing interrupted."""
    outcomes = {}

    def get(name, **settings):
        key = name, *settings.items()
        if key not in outcomes:
            folder = tmp_path_factory.mktemp("whole")
            finish(name, flags(folder / "run", **settings), folder / "log")
            outcomes[key] = outcome(folder / "run")
        return outcomes[key]

    return get


def global_step(path) -> int:
    return torch.load(path, weights_only=True)["global_step"]


# --- Signals ----------------------------------------------------------------------------------------------------------

SLOW = pytest.mark.slow
MOMENTS = {  # before which execution of which line, and the step at which the run then stops
    "start": (("training = run.begin_or_resume()", 1), None),
    "rollout": (("= envs.step(", 150), 192),
    "update": (("update_function(agent.params", 20), 192),
    "evaluation": (("lengths[i] += 1", 100), 128),
    "checkpoint": (("torch.save(state, buffer)", 1), 64),
    "final evaluation": (("lengths[i] += 1", 1700), 512),
}
CASES = [
    ("rollout", signal.SIGHUP),
    ("evaluation", signal.SIGTERM),
    *(pytest.param("rollout", signum, marks=SLOW) for signum in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)),
    pytest.param("start", signal.SIGTERM, marks=SLOW),
    pytest.param("update", signal.SIGINT, marks=SLOW),
    pytest.param("checkpoint", signal.SIGUSR1, marks=SLOW),
    pytest.param("final evaluation", signal.SIGINT, marks=SLOW),
]


@pytest.mark.parametrize("moment, signum", CASES)
def test_signal_saves_and_stops(name, moment, signum, whole, tmp_path):
    at, stop = MOMENTS[moment]
    settings = {"checkpoint_interval": 64 if moment == "checkpoint" else 100_000}
    words = flags(tmp_path / "run", **settings)
    stopped = Run(name, words, tmp_path / "log", at=at, action=send(signum))
    assert stopped.wait() == 75, stopped.output()
    assert f"stopped by {signum.name}; continue with" in stopped.output() and "Traceback" not in stopped.output()
    if stop:
        assert global_step(tmp_path / "run/last.pt") == stop
    python, script, *printed = shlex.split(stopped.output().splitlines()[-1])
    assert (python, script) == (sys.executable, stopped.path) and printed == [*map(str, words), "--resume"]
    finish(name, printed, tmp_path / "log")
    assert differences(whole(name), outcome(tmp_path / "run")) == []


@pytest.mark.slow
def test_printed_command_continues(name, tmp_path):
    """It can be pasted into a shell, and without --run-dir names the folder that the run has made for itself."""
    folder = tmp_path / "it's mine"
    folder.mkdir()

    def leave():
        os.chdir(folder)

    words = [*flags("x")[2:], "--exp-name", "a b"]
    stopped = Run(name, words, tmp_path / "log", at=("rollout = collect(", 3), action=send(15), before=leave)
    assert stopped.wait() == 75, stopped.output()
    (run_dir,) = (folder / "runs").iterdir()
    *_, command = stopped.output().splitlines()
    assert command.endswith(f" --run-dir 'runs/{run_dir.name}' --resume")
    done = subprocess.run(command, shell=True, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0 and (run_dir / "result.json").exists(), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("signals", [(signal.SIGINT, signal.SIGINT), (signal.SIGTERM, signal.SIGINT)])
@pytest.mark.parametrize(
    "at", [("lengths[i] += 1", 100), ("os.fsync(", 3), ("torch.func.grad(", 10)], ids=lambda at: at[0]
)
def test_second_interrupt_stops_at_once(name, at, signals, whole, tmp_path):
    words = flags(tmp_path / "run", "--resume")
    stopped = Run(name, words, tmp_path / "log", at=at, action=send(*signals))
    assert stopped.wait() == -signal.SIGINT and stopped.output().split() == "stopping after this iteration ...".split()
    finish(name, words, tmp_path / "log")
    assert differences(whole(name), outcome(tmp_path / "run")) == []


@pytest.mark.slow
def test_a_reader_that_leaves_ends_no_training(name, tmp_path):
    """As in `| head -1`, with standard error or without."""
    for i, end in enumerate(("", "2>&1")):
        words = shlex.join(map(str, flags(tmp_path / str(i), progress=True)))
        command = f"{sys.executable} {name} {words} {end} | head -1"
        shown = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True)
        assert "evaluation return" in shown.stdout and shown.stdout.count("\n") == 1 and shown.stderr == ""
        assert (tmp_path / str(i) / "result.json").exists()


@pytest.mark.slow
def test_without_any_output(name, tmp_path):
    """Standard output and error are closed, as a daemon's may be."""
    words = shlex.join(map(str, flags(tmp_path / "run")))
    assert subprocess.run(f"{sys.executable} {name} {words} >&- 2>&-", shell=True, cwd=ROOT).returncode == 0
    assert (tmp_path / "run/result.json").exists()


@pytest.mark.slow
def test_a_closed_terminal_under_nohup_stops_nothing(name, whole, tmp_path):
    def nohup():
        signal.signal(signal.SIGHUP, signal.SIG_IGN)

    at = "rollout = collect(", 3
    finish(name, flags(tmp_path / "run"), tmp_path / "log", at=at, action=send(signal.SIGHUP), before=nohup)
    assert differences(whole(name), outcome(tmp_path / "run")) == []


@pytest.mark.slow
def test_interrupt_while_compiling(name, tmp_path):
    """Ctrl-C reaches the C++ compiler as well, and its failure must not look like one of the machine."""
    cache = tmp_path / "cache"

    def isolate():
        os.setsid()  # Ctrl-C signals a whole process group
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(cache)

    stopped = Run(name, flags(tmp_path / "run", compile=True), tmp_path / "log", before=isolate)
    stopped.wait_until(lambda: any(cache.rglob("*.cpp")))
    time.sleep(0.3)
    os.killpg(stopped.process.pid, signal.SIGINT)
    assert stopped.wait() == 75, stopped.output()
    assert "stopped by SIGINT; continue with" in stopped.output()
    assert not (tmp_path / "run/last.pt").exists()


# --- A full disk ------------------------------------------------------------------------------------------------------


def limit_files(size: int):
    """A function that lets no file of this process grow beyond so many bytes."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


@pytest.mark.parametrize("what", ["checkpoint", pytest.param("log", marks=pytest.mark.slow)])
def test_full_disk(name, what, whole, tmp_path):
    """One clear line, a failing exit code, and the checkpoint from before is whole and is continued from."""
    settings = {"actor_hidden": 64} if what == "checkpoint" else {"total_timesteps": 1536, "checkpoint_interval": 256}
    run_dir, words = tmp_path / "run", flags(tmp_path / "run", "--resume", **settings)
    killed_after(2, name, words, tmp_path / "log")
    before = (run_dir / "last.pt").read_bytes()
    size = len(before) if what == "log" else len(before) - 1000
    full = Run(name, words, tmp_path / "log", before=limit_files(size))
    assert full.wait() == 1, full.output()
    assert full.output().splitlines()[-1] == f"{name}: error: File too large; every checkpoint saved before is intact"
    if what == "checkpoint":
        assert (run_dir / "last.pt").read_bytes() == before and not list(run_dir.glob("*.tmp"))
    finish(name, words, tmp_path / "log")
    assert differences(whole(name, **settings), outcome(run_dir)) == []


def test_leftovers_of_a_kill_are_cleaned_up(name, whole, tmp_path):
    """Temporary files, a torn record at the event file's end, and a report of a failure that is over."""
    run_dir, words = tmp_path / "run", flags(tmp_path / "run", "--resume")
    killed_after(2, name, words, tmp_path / "log")
    for leftover in ("last.pt.tmp", "result.json.tmp", "failure.json"):
        (run_dir / leftover).write_bytes(b"torn")
    (events,) = run_dir.glob("events*")
    with open(events, "ab") as file:
        file.write(events.read_bytes()[:100] + b"\x18\0\0\0")
    finish(name, words, tmp_path / "log")
    assert differences(whole(name), outcome(run_dir)) == []


# --- Damaged, foreign and malicious checkpoints -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A function from a script's name to the folder of a run that was killed after its third checkpoint."""
    runs = {}

    def get(name):
        if name not in runs:
            runs[name] = tmp_path_factory.mktemp("stopped") / "run"
            killed_after(3, name, flags(runs[name], "--resume"), runs[name].with_suffix(".log"))
        return runs[name]

    return get


def longest_entry(path) -> bytes:
    """The largest tensor in a checkpoint."""
    with zipfile.ZipFile(path) as file:
        return max(map(file.read, file.namelist()), key=len)


@pytest.mark.slow
def test_damaged_checkpoint_is_refused_by_the_command(name, stopped, tmp_path):
    """With --resume and with --evaluate; the file is left as it is."""
    shutil.copytree(stopped(name), tmp_path / "run")
    path = tmp_path / "run/last.pt"
    data, longest = bytearray(path.read_bytes()), longest_entry(path)
    data[data.index(longest) + len(longest) // 2] ^= 1  # not in the padding between entries, which is nobody's
    for damaged in (bytes(data), bytes(data[: len(data) // 2]), b""):
        path.write_bytes(damaged)
        for words in (flags(tmp_path / "run", "--resume"), ["--evaluate", path]):
            refused = Run(name, words, tmp_path / "log")
            assert refused.wait() == 2, refused.output()
            assert refused.output() == f"{name}: error: {path} is damaged or not a checkpoint of {name}\n"
        assert path.read_bytes() == damaged


class Malicious:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.slow
@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "pickle"])
def test_malicious_checkpoint_runs_nothing(legacy, stopped, tmp_path):
    """In any script that reads checkpoints. That it would run is shown by loading it without care."""
    shutil.copytree(stopped("refineppo_continuous.py"), tmp_path / "run")
    path, mark = tmp_path / "run/last.pt", tmp_path / "ran"
    evil = torch.load(path) | {"params": Malicious(mark)}
    torch.save(evil, path, _use_new_zipfile_serialization=not legacy)
    torch.load(path, weights_only=False)
    mark.rmdir()
    refusal("analysis_refinement.py", ["--checkpoint", path], tmp_path / "log")
    for name in SCRIPTS:
        for words in (["--evaluate", path], flags(tmp_path / "run", "--resume")):
            refusal(name, words, tmp_path / "log")
    assert not mark.exists()


@pytest.mark.parametrize("missing", ["args", "global_step", "params", "normalizer"])
def test_incomplete_checkpoint_is_refused(name, missing, stopped, tmp_path):
    state = torch.load(stopped(name) / "best.pt")
    del state[missing]
    torch.save(state, tmp_path / "best.pt")
    refusal(name, ["--evaluate", tmp_path / "best.pt"], tmp_path / "log")


@pytest.mark.parametrize("missing", ["adam", "envs", "rng", "progress", "compiled", "machine", "logs"])
def test_checkpoint_without_a_part_cannot_be_resumed(name, missing, stopped, tmp_path):
    shutil.copytree(stopped(name), tmp_path / "run")
    state = torch.load(tmp_path / "run/last.pt")
    del state[missing]
    torch.save(state, tmp_path / "run/last.pt")
    assert "last.pt" in refusal(name, flags(tmp_path / "run", "--resume"), tmp_path / "log")


def test_checkpoints_need_no_unsafe_global(name, stopped):
    for path in stopped(name).glob("*.pt"):
        assert torch.serialization.get_unsafe_globals_in_checkpoint(path) == []
        torch.load(path, weights_only=True)


# --- Bad numbers and crashes ------------------------------------------------------------------------------------------

FAULTY = {"env_id": "odd_envs:Faulty-v0", "num_envs": 3, "num_steps": 20, "total_timesteps": 600}


def fault(seed: int, step: int, way: str):
    """A function that lets Faulty-v0 fail at the step of the episode with the seed."""

    def before():
        os.environ["FAULT"] = f"{seed} {step} {way}"

    return before


def failure(run_dir) -> dict:
    """failure.json, in strict JSON, of a run that is not complete."""
    assert not (run_dir / "result.json").exists()
    return json.loads((run_dir / "failure.json").read_text(), parse_constant=pytest.fail)


@pytest.mark.parametrize(
    "way, step, normalize",
    [
        ("nan-obs", 0, True),
        ("-inf-reward", 40, False),
        pytest.param("nan-reward", 23, True, marks=SLOW),
        pytest.param("nan-obs", 23, True, marks=SLOW),
        pytest.param("inf-obs", 40, False, marks=SLOW),
        pytest.param("inf-obs", 0, False, marks=SLOW),
    ],
)
def test_bad_number_in_a_rollout(script, way, step, normalize, whole, tmp_path):
    """Environment 1's second episode is its steps 41 to 80, and the first observation of it comes with step 40."""
    name, settings = f"{script.__name__}.py", FAULTY | {"normalize_obs": normalize, "normalize_reward": normalize}
    words = flags(tmp_path / "run", "--resume", **settings)
    (seed,) = script.episode_seeds(1, 0, 1, 1)
    failed = Run(name, words, tmp_path / "log", before=fault(seed, step, way))
    assert failed.wait() == 3, failed.output()
    facts, (number, what), begun = failure(tmp_path / "run"), way.rsplit("-", 1), 180 if step else 60
    assert what[:3] in facts["what"] and number in facts["value"]
    assert (facts["global_step"], facts["env"]) == (begun, 1)
    assert (facts["episode_seed"], facts["episode_step"]) == (seed, step)
    line = failed.output().splitlines()[-1]
    assert line.startswith(f"{name}: numerical failure: ") and "'env': 1" in line and "Traceback" not in failed.output()
    assert not step or global_step(tmp_path / "run/last.pt") == begun
    finish(name, words, tmp_path / "log")  # the fault is gone
    assert differences(whole(name, **settings), outcome(tmp_path / "run")) == []


def test_infinite_first_observation_of_all(script, tmp_path):
    (seed,) = script.episode_seeds(1, 0, 0, 0)
    words = flags(tmp_path / "run", "--resume", **FAULTY)
    failed = Run(f"{script.__name__}.py", words, tmp_path / "log", before=fault(seed, 0, "inf-obs"))
    assert failed.wait() == 3, failed.output()
    facts = failure(tmp_path / "run")
    assert "observation" in facts["what"] and (facts["env"], facts["episode_step"], facts["global_step"]) == (0, 0, 0)


@pytest.mark.slow
def test_crashing_environment(script, whole, tmp_path):
    """The simulator's own error is shown, and the run can be continued."""
    name, words = f"{script.__name__}.py", flags(tmp_path / "run", "--resume", **FAULTY)
    (seed,) = script.episode_seeds(1, 0, 1, 1)
    crashed = Run(name, words, tmp_path / "log", before=fault(seed, 23, "crash"))
    assert crashed.wait() == 1, crashed.output()
    assert "RuntimeError: the simulator crashed" in crashed.output()
    assert global_step(tmp_path / "run/last.pt") == 180
    finish(name, words, tmp_path / "log")
    assert differences(whole(name, **FAULTY), outcome(tmp_path / "run")) == []


def test_environment_that_crashes_in_the_replay(script, tmp_path):
    """It keeps its traceback; the checkpoint is not called damaged."""
    name, words = f"{script.__name__}.py", flags(tmp_path / "run", "--resume", **FAULTY)
    killed_after(2, name, words, tmp_path / "log")
    (seed,) = script.episode_seeds(1, 0, 1, 1)
    crashed = Run(name, words, tmp_path / "log", before=fault(seed, 7, "crash"))
    assert crashed.wait() == 1, crashed.output()
    assert "RuntimeError: the simulator crashed" in crashed.output() and "damaged" not in crashed.output()


@pytest.mark.parametrize("final", [False, True])
def test_bad_number_in_an_evaluation(script, final, tmp_path):
    name, words = f"{script.__name__}.py", flags(tmp_path / "run", **FAULTY)
    args = script.Args(eval_episodes=2, final_eval_episodes=2)
    bad_step = 600 if final else 180
    seed = script.evaluation_seeds(args, bad_step, final=final)[1]
    failed = Run(name, words, tmp_path / "log", before=fault(seed, 7, "nan-reward"))
    assert failed.wait() == 3, failed.output()
    facts = failure(tmp_path / "run")
    assert (facts["what"], facts["global_step"], facts["evaluation_episode"]) == ("a reward", bad_step, 1)
    assert (facts["episode_seed"], facts["episode_step"], facts["value"]) == (seed, 7, "nan")


BAD_UPDATES = {
    "losses/value_loss": {"env_id": "odd_envs:Huge-v0", "normalize_reward": False},
    "obs.squares": {"env_id": "odd_envs:Faulty-v0"},
    "actor.0.weight": {"learning_rate": 1e38},
}


@pytest.mark.parametrize("culprit", BAD_UPDATES)
def test_bad_number_in_an_update(script, culprit, tmp_path):
    """A loss, a running statistic and a parameter: each is named, in the iteration in which it appears."""
    name, words = f"{script.__name__}.py", flags(tmp_path / "run", **BAD_UPDATES[culprit])
    (seed,) = script.episode_seeds(1, 0, 0, 0)
    failed = Run(name, words, tmp_path / "log", before=fault(seed, 3, "1e200-obs"))
    assert failed.wait() == 3, failed.output()
    facts = failure(tmp_path / "run")
    assert facts["global_step"] == 0 and culprit in facts["not_finite"]
    assert not list((tmp_path / "run").glob("*.pt"))


def test_bad_number_on_a_full_disk(script, tmp_path, monkeypatch):
    """Logs that cannot be closed do not hide what failed."""

    def close(self):
        raise OSError(errno.ENOSPC, "No space left on device")

    (seed,) = script.episode_seeds(1, 0, 0, 0)
    monkeypatch.setenv("FAULT", f"{seed} 3 nan-obs")
    monkeypatch.setattr(script.SummaryWriter, "close", close)
    with pytest.raises(SystemExit) as stop:
        call_main(script, *flags(tmp_path / "run", env_id="odd_envs:Faulty-v0"))
    assert stop.value.code == 3 and failure(tmp_path / "run")["episode_seed"] == seed


def test_divergence_after_a_while_keeps_the_last_good_checkpoint(name, tmp_path):
    """The entropy bonus adds 5 to log_std in each of the minibatches, until exp(log_std) overflows."""
    settings = {"learning_rate": 5, "anneal_lr": False, "ent_coef": 1000, "num_steps": 32, "num_minibatches": 2}
    words = flags(tmp_path / "run", **settings, update_epochs=1, total_timesteps=3200, checkpoint_interval=1)
    failed = Run(name, words, tmp_path / "log")
    assert failed.wait() == 3, failed.output()
    step = failure(tmp_path / "run")["global_step"]
    assert 64 <= step < 3200
    last = torch.load(tmp_path / "run/last.pt", weights_only=True)
    assert last["global_step"] == step
    assert all(x.isfinite().all() for x in (*last["params"].values(), *last["normalizer"].values()))


def test_mujoco_warnings_are_counted(name, whole, tmp_path):
    """An unstable simulation resets itself silently; the chart tells, also after a resume."""
    settings = {"env_id": "odd_envs:Unstable-v0"}
    run_dir, words = tmp_path / "run", flags(tmp_path / "run", "--resume", **settings)
    killed_after(2, name, words, tmp_path / "log")
    finish(name, words, tmp_path / "log")
    found = outcome(run_dir)
    assert differences(whole(name, **settings), found) == []
    counts = dict(ast.literal_eval(found["charts/mujoco_warnings"]))
    assert [step for step, count in counts.items() if count] == [128, 256, 448]  # they hold steps 100, 250 and 400
    assert set(counts.values()) == {0, 1}
