"""Clean stops and clear failures: signals, a full disk, damaged files, bad numbers and crashing simulators."""

import ast
import io
import os
import re
import resource
import shlex
import signal
import subprocess
import sys
import time
import zipfile
from unittest import mock

import pytest
import torch
from conftest import ROOT, wait_until
from resume_helpers import KILLED, Run, ends_with, finish_exactly, flags, outcome, refusal, send
from test_commands import call_main, read_json

# --- Signals ----------------------------------------------------------------------------------------------------------

SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "signum, at, step",
    [
        (signal.SIGHUP, ("= envs.step(", 150), 192),
        (signal.SIGTERM, ("lengths[i] += 1", 100), 128),
        pytest.param(signal.SIGTERM, ("training = run.begin_or_resume()", 1), None, marks=SLOW),
        pytest.param(signal.SIGINT, ("update_function(agent.params", 20), 192, marks=SLOW),
        pytest.param(signal.SIGUSR1, ("torch.save(state, buffer)", 1), 128, marks=SLOW),
        pytest.param(signal.SIGINT, ("lengths[i] += 1", 1700), 512, marks=SLOW),  # in the final evaluation
    ],
)
def test_signal_saves_and_stops(script, signum, at, step, tmp_path):
    words = flags(tmp_path / "run", checkpoint_interval=100_000)
    printed = ends_with(75, script, words, at=at, action=send(signum))
    assert f"stopped by {signum.name}; continue with" in printed and "Traceback" not in printed
    assert step is None or torch.load(tmp_path / "run/last.pt")["global_step"] == step
    command = shlex.split(printed.splitlines()[-1])
    assert command == [sys.executable, script.__file__, *map(str, words), "--resume"]
    finish_exactly(script, [*words, "--resume"])


@pytest.mark.slow
def test_printed_command_continues(script, tmp_path):
    """It can be pasted into a shell, and without --run-dir names the folder that the run has made for itself."""
    folder = tmp_path / "it's mine"
    folder.mkdir()

    def leave():
        os.chdir(folder)

    words, at = [*flags("x")[2:], "--exp-name", "a b"], ("rollout = collect(", 3)
    *_, command = ends_with(75, script, words, at=at, action=send(signal.SIGTERM), before=leave).splitlines()
    (run_dir,) = (folder / "runs").iterdir()
    assert re.fullmatch(r"Pendulum-v1__a b__1__\d+", run_dir.name)
    assert command.endswith(f" --run-dir 'runs/{run_dir.name}' --resume")
    done = subprocess.run(command, shell=True, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0 and (run_dir / "result.json").exists(), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("at", [("lengths[i] += 1", 100), ("os.fsync(", 3), ("torch.func.grad(", 10)])
@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
def test_second_interrupt_stops_at_once(script, first, at, tmp_path):
    words = flags(tmp_path / "run", "--resume")
    printed = ends_with(-signal.SIGINT, script, words, at=at, action=send(first, signal.SIGINT))
    assert printed.split() == "stopping after this iteration ...".split()
    finish_exactly(script, words)


@pytest.mark.slow
@pytest.mark.parametrize("end", ["| head -1", "2>&1 | head -1", ">&- 2>&-"])
def test_a_reader_that_leaves_ends_no_training(script, end, tmp_path):
    """Nor do standard output and error that are closed from the start, as a daemon's may be."""
    words = shlex.join(map(str, [sys.executable, script.__file__, *flags(tmp_path / "run", progress=True)]))
    shown = subprocess.run(f"{words} {end}", shell=True, cwd=ROOT, capture_output=True, text=True)
    assert shown.returncode == 0 and shown.stderr == ""
    assert shown.stdout.count("evaluation return") == shown.stdout.count("\n") == end.count("head")
    assert (tmp_path / "run/result.json").exists()


@pytest.mark.slow
def test_a_closed_terminal_under_nohup_stops_nothing(script, tmp_path):
    def nohup():
        signal.signal(signal.SIGHUP, signal.SIG_IGN)

    at = "rollout = collect(", 3
    finish_exactly(script, flags(tmp_path / "run"), at=at, action=send(signal.SIGHUP), before=nohup)


@pytest.mark.slow
def test_interrupt_while_compiling(script, tmp_path):
    """Ctrl-C reaches the C++ compiler as well, and its failure must not look like one of the machine."""
    cache = tmp_path / "cache"

    def isolate():
        os.setsid()  # Ctrl-C signals a whole process group
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(cache)

    stopped = Run(script, flags(tmp_path / "run", compile=True), before=isolate)
    wait_until(lambda: any(cache.rglob("*.cpp")))
    time.sleep(0.3)
    os.killpg(stopped.process.pid, signal.SIGINT)
    assert stopped.wait() == 75, stopped.output()
    assert "stopped by SIGINT; continue with" in stopped.output()
    assert not (tmp_path / "run/last.pt").exists()


# --- A full disk ------------------------------------------------------------------------------------------------------


LONG = {"total_timesteps": 1536, "checkpoint_interval": 256}  # where the log grows beyond last.pt


@pytest.mark.parametrize("settings, missing", [({"actor_hidden": 64}, 1000), pytest.param(LONG, 0, marks=SLOW)])
def test_full_disk(script, settings, missing, tmp_path):
    """One clear line, a failing exit code, and the checkpoint from before is whole and is continued from."""
    last, words = tmp_path / "run/last.pt", flags(tmp_path / "run", "--resume", **settings)
    ends_with(KILLED, script, words, after=("last.pt", 2))
    before = last.read_bytes()
    largest = len(before) - missing  # of the files that there is space for

    def limit_files():
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))

    *_, sentence = ends_with(1, script, words, before=limit_files).splitlines()
    assert sentence == f"{script.__name__}.py: error: File too large; every checkpoint saved before is intact"
    if missing:
        assert last.read_bytes() == before and not list(last.parent.glob("*.tmp"))
    finish_exactly(script, words)


# --- Damaged, foreign and malicious checkpoints -----------------------------------------------------------------------


@pytest.fixture
def last(script, tmp_path):
    """The checkpoint of a run that was killed."""
    ends_with(KILLED, script, flags(tmp_path / "run"), after=("last.pt", 1))
    return tmp_path / "run/last.pt"


def saved(state) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def check_refused(script, path, data: bytes, sentence: str, evaluated=True):
    """With --resume and with --evaluate; the file is left as it is."""
    path.write_bytes(data)
    commands = flags(path.parent, "--resume"), ["--evaluate", path]
    for words in commands if evaluated else commands[:1]:
        assert refusal(script, words).startswith(f"{script.__name__}.py: error: {path} {sentence}")
    assert path.read_bytes() == data


def test_what_is_no_checkpoint_is_refused(script, last):
    data = last.read_bytes()
    flipped = bytearray(data)
    with zipfile.ZipFile(last) as file:
        tensor = max((file.read(name) for name in file.namelist() if "/data/" in name), key=len)
    flipped[data.index(tensor) + len(tensor) // 2] ^= 1
    others = saved(torch.nn.Linear(2, 2).state_dict()), saved(torch.zeros(3))
    for damaged in (flipped, data[: len(data) // 2], b"", b"weights, weights, weights", *others):
        check_refused(script, last, bytes(damaged), f"is damaged or not a checkpoint of {script.__name__}.py")


def test_incomplete_checkpoint_is_refused(script, last):
    state = torch.load(last)

    def without(part):
        return saved({name: x for name, x in state.items() if name != part})

    for part in ("args", "global_step", "params", "normalizer"):
        check_refused(script, last, without(part), "is damaged")
    for part in ("adam", "envs", "rng", "progress", "compiled", "machine", "logs"):
        check_refused(script, last, without(part), "is no checkpoint to continue from", evaluated=False)
    small = {name: torch.ones(1) for name in state["params"]}  # which would fill the right ones, if copied into them
    for params in ({}, small):
        check_refused(script, last, saved(state | {"params": params}), "does not fit")


class Malicious:
    def __reduce__(self):
        return os.mkdir, ("ran",)


@pytest.mark.parametrize("as_zip", [True, False], ids=["zip", "pickle"])
def test_malicious_checkpoint_runs_nothing(script, as_zip, last, tmp_path, monkeypatch):
    """That it would run is shown by loading it without care."""
    monkeypatch.chdir(tmp_path)
    torch.save(torch.load(last) | {"params": Malicious()}, last, _use_new_zipfile_serialization=as_zip)
    torch.load(last, weights_only=False)
    os.rmdir("ran")
    check_refused(script, last, last.read_bytes(), "is damaged")
    assert not os.path.exists("ran")


# --- Bad numbers and crashes ------------------------------------------------------------------------------------------

FAULTY = {"env_id": "odd_envs:Faulty-v0", "num_envs": 3, "num_steps": 20, "total_timesteps": 600}


def failure(run_dir) -> dict:
    """failure.json of a run that is not complete."""
    assert not (run_dir / "result.json").exists()
    return read_json(run_dir / "failure.json")


@pytest.mark.parametrize(
    "way, episode, step, begun, normalize",
    [
        ("inf-obs", 0, 0, 0, True),
        ("nan-obs", 1, 0, 60, True),
        ("nan-reward", 1, 23, 180, True),
        ("-inf-reward", 1, 40, 180, False),
        ("inf-obs", 1, 23, 180, False),
    ],
)
def test_bad_number_in_a_rollout(script, way, episode, step, begun, normalize, tmp_path):
    """Environment 1's second episode is its steps 41 to 80, and the first observation of it comes with step 40."""
    settings = FAULTY | {"normalize_obs": normalize, "normalize_reward": normalize}
    words, (seed,) = flags(tmp_path / "run", "--resume", **settings), script.episode_seeds(1, 0, 1, episode)
    printed = ends_with(3, script, words, odd=f"{seed} {step} {way}")
    facts, (number, what) = failure(tmp_path / "run"), way.rsplit("-", 1)
    assert what[:3] in facts["what"] and number in facts["value"]
    assert (facts["global_step"], facts["env"]) == (begun, 1)
    assert (facts["episode_seed"], facts["episode_step"]) == (seed, step)
    line = printed.splitlines()[-1]
    assert line.startswith(f"{script.__name__}.py: numerical failure: ") and "'env': 1" in line
    assert "Traceback" not in printed
    assert begun < 180 or torch.load(tmp_path / "run/last.pt")["global_step"] == begun
    finish_exactly(script, words)  # the fault is gone


def test_crashing_environment(script, tmp_path):
    """The simulator's own error is shown, in the replay too, where no checkpoint is called damaged."""
    words, (seed,) = flags(tmp_path / "run", "--resume", **FAULTY), script.episode_seeds(1, 0, 1, 1)
    for step in (23, 7):
        printed = ends_with(1, script, words, odd=f"{seed} {step} crash")
        assert "RuntimeError: the simulator crashed" in printed and "damaged" not in printed
        assert torch.load(tmp_path / "run/last.pt")["global_step"] == 180
    finish_exactly(script, words)


@pytest.mark.parametrize("final, step", [(False, 180), (True, 600)])
def test_bad_number_in_an_evaluation(script, final, step, tmp_path):
    args = script.Args(eval_episodes=2, final_eval_episodes=2)
    seed = script.evaluation_seeds(args, step, final=final)[1]
    ends_with(3, script, flags(tmp_path / "run", **FAULTY), odd=f"{seed} 7 nan-reward")
    facts = failure(tmp_path / "run")
    assert (facts["what"], facts["global_step"], facts["evaluation_episode"]) == ("a reward", step, 1)
    assert (facts["episode_seed"], facts["episode_step"], facts["value"]) == (seed, 7, "nan")


@pytest.mark.parametrize(
    "culprit, way, settings",
    [
        ("losses/value_loss", "1e30-reward", {"normalize_reward": False}),
        ("obs.squares", "1e200-obs", {}),
        ("actor.0.weight", "0-obs", {"learning_rate": 1e38}),
    ],
)
def test_bad_number_in_an_update(script, culprit, way, settings, tmp_path):
    """A loss, a running statistic and a parameter: each is named, in the iteration in which it appears."""
    (seed,), words = script.episode_seeds(1, 0, 0, 0), flags(tmp_path / "run", **FAULTY | settings)
    ends_with(3, script, words, odd=f"{seed} 3 {way}")
    facts = failure(tmp_path / "run")
    assert facts["global_step"] == 0 and culprit in facts["not_finite"]
    assert not list((tmp_path / "run").glob("*.pt"))


def test_bad_number_on_a_full_disk(script, tmp_path, monkeypatch):
    """Logs that cannot be closed do not hide what failed."""

    (seed,) = script.episode_seeds(1, 0, 0, 0)
    monkeypatch.setenv("ODD", f"{seed} 3 nan-obs")
    monkeypatch.setattr(script.SummaryWriter, "close", mock.Mock(side_effect=OSError))
    with pytest.raises(SystemExit) as stop:
        call_main(script, *flags(tmp_path / "run", **FAULTY))
    assert stop.value.code == 3 and failure(tmp_path / "run")["episode_seed"] == seed


def test_mujoco_warnings_are_counted(script, tmp_path):
    """An unstable simulation resets itself silently; the chart tells, also after a resume."""
    words = flags(tmp_path / "run", "--resume", env_id="odd_envs:Unstable-v0")
    ends_with(KILLED, script, words, after=("last.pt", 2))
    finish_exactly(script, words)
    counts = dict(ast.literal_eval(outcome(tmp_path / "run")["charts/mujoco_warnings"]))
    assert [step for step, count in counts.items() if count] == [128, 256, 448]  # they hold steps 100, 250 and 400
    assert set(counts.values()) == {0, 1}
