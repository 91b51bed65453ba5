"""People's own tasks: what comes from them becomes what their spaces say, and what cannot be trained is refused."""

import json
import os
import signal

import numpy as np
import odd_envs
import pytest
import torch
from conftest import run
from resume_helpers import SCRIPTS, Run, differences, finish, flags, flatten, killed_after, outcome, refusal
from test_commands import QUICK, call_main

SLOW = pytest.mark.slow
SMALL = {"num_envs": 2, "num_steps": 50, "total_timesteps": 400, "learning_rate": 0.01}


def words(task: str, run_dir, *more, **settings) -> list:
    return flags(run_dir, *more, **SMALL | {"env_id": f"odd_envs:{task}-v0"} | settings)


@pytest.fixture(params=SCRIPTS)
def name(request):
    """The file name of each of the two training scripts."""
    return request.param


# --- What comes from a task becomes what its spaces say ---------------------------------------------------------------


def numbers(run_dir) -> dict[str, str]:
    """What two tasks that mean the same must have alike: all but their names and what replays their actions."""
    found = outcome(run_dir)
    return {key: x for key, x in found.items() if "actions" not in key and key not in ("result.json/env_id", "files")}


@pytest.fixture(scope="module")
def of_twin(tmp_path_factory):
    """A function from a script and a sound task to the numbers of its run."""
    runs = {}

    def get(script, task):
        if (script, task) not in runs:
            run_dir = tmp_path_factory.mktemp("twin") / "run"
            call_main(script, *words(task, run_dir))
            runs[script, task] = numbers(run_dir)
        return runs[script, task]

    return get


PAIRS = [*((task.__name__, "Line") for task in odd_envs.TWINS), ("TimeStamps", "TimeStampsInFloats")]


@pytest.mark.parametrize("task, twin", PAIRS, ids=[task for task, _ in PAIRS])
def test_trains_like_its_sound_twin(script, task, twin, of_twin, tmp_path):
    """To the same parameters, statistics, evaluations and logs, bit for bit."""
    call_main(script, *words(task, tmp_path / "run"))
    assert differences(of_twin(script, twin), numbers(tmp_path / "run")) == []


@pytest.mark.parametrize("task", ["ActionInPlace", *(pytest.param(x, marks=SLOW) for x in ("OneBuffer", "ObsInDict"))])
def test_continues_exactly(name, task, tmp_path):
    killed_after(2, name, words(task, tmp_path / "run", "--resume"), tmp_path / "log")
    assert "warning: odd" not in finish(name, words(task, tmp_path / "run", "--resume"), tmp_path / "log")
    finish(name, words(task, tmp_path / "whole"), tmp_path / "log")
    assert differences(outcome(tmp_path / "whole"), outcome(tmp_path / "run")) == []


def test_a_flattened_task_is_loaded(script, tmp_path, capsys):
    call_main(script, *words("ObsInDict", tmp_path / "run"))
    agent = script.load_agent(tmp_path / "run/best.pt")
    obs, _ = script.make_env(agent.args).reset(seed=3)
    assert obs.dtype == float and obs.shape == (2,) and agent.act(obs).shape == (1,)
    call_main(script, "--evaluate", tmp_path / "run/best.pt", "--final-eval-episodes", 2)
    mean = json.loads((tmp_path / "run/result.json").read_text())["best"]["mean"]
    assert f"mean return {mean:.3f}" in capsys.readouterr().out


# --- Refused, in one sentence -----------------------------------------------------------------------------------------

REFUSED = {
    "ShortObs": "shape (1,), where the space promises (2,)",
    "ColumnObs": "shape (2, 1), where the space promises (2,)",
    "TwoRewards": "",
    "WholeActions": "only a one-dimensional Box of real numbers",
    "GridActions": "only a one-dimensional Box of real numbers",
    "NoSeed": "seed",
    "OldReset": "",
    "OldStep": "",
    "OnlyOne": "an evaluation makes 2 more",
    "ExitsAtOnce": "no licence",
    "Mistake": "'gain'",
    "MistakeInReset": "start_again",
    "MistakeInStep": "division by zero",
}


@pytest.mark.parametrize("task", REFUSED)
def test_refused(name, task, tmp_path):
    sentence = refusal(name, words(task, tmp_path / "run"), tmp_path / "log")
    assert f"odd_envs:{task}-v0" in sentence and REFUSED[task] in sentence
    printed = (tmp_path / "log").read_text()
    assert ("Traceback" in printed and "odd_envs.py" in printed) == task.startswith(("Mistake", "OnlyOne"))
    assert not (tmp_path / "run").exists()


def test_a_shape_that_changes_in_training(name, tmp_path):
    failed = Run(name, words("ObsChangesShape", tmp_path / "run"), tmp_path / "log")
    assert failed.wait() == 1 and "shape (1,), where the space promises (2,)" in failed.output()


@pytest.mark.parametrize("where", ["step", "reset"])
def test_a_task_that_ends_the_program_has_failed(name, where, tmp_path):
    failed = Run(name, words("Exits", tmp_path / "run"), tmp_path / "log", before=set_variable("ODD", where))
    assert failed.wait() == 1, failed.output()
    assert "the task ended the program" in failed.output() and f"in {where}\n    raise SystemExit(0)" in failed.output()
    assert not (tmp_path / "run/result.json").exists()


def set_variable(name: str, value):
    """A function that sets the environment variable in the run's process."""

    def before():
        os.environ[name] = str(value)

    return before


# --- Said, and trained ------------------------------------------------------------------------------------------------


def test_actions_that_the_policy_never_reaches(script, tmp_path, capsys):
    call_main(script, *words("FarActions", tmp_path / "run"))
    warning = next(line for line in capsys.readouterr().out.splitlines() if "RescaleAction" in line)
    assert warning.startswith("warning: odd_envs:FarActions-v0 has actions in Box(100.0, 200.0")


@pytest.mark.parametrize("task", ["GlobalRandom", "Level", "Longer"])
def test_a_task_that_does_not_repeat_itself_is_warned_of(name, task, tmp_path):
    """Whether observations, rewards or ends show it; and where it is continued, not only at the start."""
    killed_after(2, name, words(task, tmp_path / "run", "--resume"), tmp_path / "log")
    warning = f"warning: odd_envs:{task}-v0 does not repeat itself"
    assert warning in finish(name, words(task, tmp_path / "run", "--resume"), tmp_path / "log")


def test_global_generators_follow_the_seed(script, tmp_path, capsys):
    """Whatever they were before, and however often the policy is evaluated."""
    for i, interval in enumerate((100, 100, 400)):
        np.random.seed(i)
        call_main(script, *words("GlobalRandom", tmp_path / str(i), eval_interval=interval))
    same, again, rarely = (tmp_path / str(i) for i in range(3))
    assert differences(outcome(same), outcome(again)) == []
    one, other = (flatten("", torch.load(run_dir / "last.pt")["params"]) for run_dir in (same, rarely))
    assert one == other
    result = json.loads((same / "result.json").read_text())
    for saved in ("best", "last"):
        capsys.readouterr()
        call_main(script, "--evaluate", same / f"{saved}.pt", "--final-eval-episodes", 2)
        printed = [line.split()[3] for line in capsys.readouterr().out.splitlines() if line.startswith("episode")]
        assert printed == [f"{x:.3f}," for x in result[saved]["returns"]]


def test_seeds_fit_a_c_int(script):
    for seed in (0, 1, 2**31, 2**32, 2**63 - 1):
        args = script.Args(seed=seed)
        seeds = [*script.episode_seeds(seed, 0, 3, 5), *script.episode_seeds(seed, 1, 2048, count=50)]
        seeds += [x for final in (False, True) for x in script.evaluation_seeds(args, 4096, final=final)]
        assert all(0 <= x < 2**31 for x in seeds) and len(set(seeds)) > 60


def test_largest_seed(script, tmp_path):
    call_main(script, *words("SeedOfAnInt", tmp_path / "run", seed=2**63 - 1))
    assert (tmp_path / "run/result.json").exists()


# --- Without end ------------------------------------------------------------------------------------------------------


def test_no_time_limit(name, tmp_path):
    """Said at the start; the first evaluation ends by a signal within seconds, and with a limit all goes on."""
    endless, run_dir = words("Goal", tmp_path / "run", "--resume"), tmp_path / "run"
    stopped = Run(
        name, endless, tmp_path / "log", at=("lengths[i] += 1", 5000), action=lambda: os.kill(os.getpid(), 15)
    )
    assert stopped.wait(60) == 75, stopped.output()
    assert "no time limit" in stopped.output() and "--max-episode-steps" in stopped.output()
    assert torch.load(run_dir / "last.pt")["global_step"] == 200
    assert (run_dir / "evaluations.csv").read_text().count("\n") == 1 and not (run_dir / "best.pt").exists()
    assert "--max-episode-steps None" in refusal(name, [*endless, "--max-episode-steps", 40], tmp_path / "log")
    printed = finish(name, words("Goal", tmp_path / "limit", max_episode_steps=40), tmp_path / "log")
    assert "no time limit" not in printed
    finish(name, words("Line", tmp_path / "line"), tmp_path / "log")
    assert differences(numbers(tmp_path / "line"), numbers(tmp_path / "limit")) == []


# --- Closed, however the run ends -------------------------------------------------------------------------------------


@pytest.mark.parametrize("task, at, code", [("Opened", None, 0), ("Opened", "lengths[i] += 1", 75),
    ("Opened", "rollout = collect(", 75), ("OpenedWholeActions", None, 2), ("OpenedCrash", None, 1),
    ("OpenedNan", None, 3)])  # fmt: skip
def test_every_environment_is_closed(name, task, at, code, tmp_path):
    """A thread of the task would else keep the finished program alive."""
    (tmp_path / "open").mkdir()
    at = at and (at, 1)
    before, stop = set_variable("ODD", tmp_path / "open"), lambda: os.kill(os.getpid(), signal.SIGTERM)
    ended = Run(name, words(task, tmp_path / "run"), tmp_path / "log", at=at, action=stop, before=before)
    assert ended.wait(60) == code, ended.output()
    assert list((tmp_path / "open").iterdir()) == []


def test_evaluated_environments_are_closed(name, tmp_path):
    (tmp_path / "open").mkdir()
    odd = set_variable("ODD", tmp_path / "open")
    finish(name, words("Opened", tmp_path / "run"), tmp_path / "log", before=odd)
    finish(name, ["--evaluate", tmp_path / "run/best.pt"], tmp_path / "log", before=odd)
    assert list((tmp_path / "open").iterdir()) == []


@pytest.mark.slow
def test_real_command_with_a_thread(name, tmp_path):
    (tmp_path / "open").mkdir()
    words = (*QUICK, "--env-id", "odd_envs:Opened-v0", "--run-dir", tmp_path / "run")
    done = run(name, *words, timeout=120, ODD=str(tmp_path / "open"))
    assert done.returncode == 0 and list((tmp_path / "open").iterdir()) == []
