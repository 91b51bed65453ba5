"""People's own tasks: what comes from them becomes what their spaces say, and what cannot be trained is refused."""

import signal

import numpy as np
import odd_envs
import pytest
import torch
from resume_helpers import KILLED, differences, ends_with, finish_exactly, flags, outcome, refusal, send, uninterrupted
from test_commands import call_main, read_json

SMALL = {"num_envs": 2, "num_steps": 50, "total_timesteps": 400, "learning_rate": 0.01}


def words(task: str, run_dir, *more, **settings) -> list:
    return flags(run_dir, *more, **SMALL | {"env_id": f"odd_envs:{task}-v0"} | settings)


# --- What comes from a task becomes what its spaces say ---------------------------------------------------------------


def check_like(twin: str, script, run_dir):
    """All but the tasks' names and what replays their actions is alike: parameters, evaluations, logs, bit for bit."""
    unlike = differences(uninterrupted(script, *words(twin, None)[2:]), outcome(run_dir))
    assert [key for key in unlike if "actions" not in key and key != "result.json/env_id"] == []


PAIRS = {task.__name__: "Line" for task in odd_envs.TWINS} | {"TimeStamps": "TimeStampsInFloats"}


@pytest.mark.parametrize("task", PAIRS)
def test_trains_like_its_sound_twin(script, task, tmp_path):
    call_main(script, *words(task, tmp_path / "run"))
    check_like(PAIRS[task], script, tmp_path / "run")


@pytest.mark.parametrize("task", ["Overwrites", "ObsInDict"])
def test_continues_exactly(script, task, tmp_path):
    continued = words(task, tmp_path / "run", "--resume")
    ends_with(KILLED, script, continued, after=("last.pt", 2))
    assert "warning: odd" not in finish_exactly(script, continued)


def test_a_flattened_task_is_loaded(script, tmp_path):
    call_main(script, *words("ObsInDict", tmp_path / "run"))
    agent = script.load_agent(tmp_path / "run/best.pt")
    obs, _ = script.make_env(agent.args).reset(seed=3)
    assert obs.dtype == float and obs.shape == (2,) and agent.act(obs).shape == (1,)


def test_largest_seed(script, tmp_path):
    """Its episodes' seeds still fit a C int."""
    call_main(script, *words("SeedOfAnInt", tmp_path / "run", seed=2**63 - 1))
    assert (tmp_path / "run/result.json").exists()


# --- Refused, in one sentence -----------------------------------------------------------------------------------------

REFUSED = {
    "ShortObs": "shape (1,), where the space promises (2,)",
    "TwoRewards": "",
    "WholeActions": "only a one-dimensional Box of real numbers",
    "GridActions": "only a one-dimensional Box of real numbers",
    "NoSeed": "seed",
    "OldReset": "",
    "OldStep": "",
    "OnlyOne": "an evaluation makes 2 more",
    "ExitsAtOnce": "no licence",
    "Mistake": "'gain'",
    "MistakeInStep": "division by zero",
}


@pytest.mark.parametrize("task", REFUSED)
def test_refused(script, task, tmp_path):
    printed = refusal(script, words(task, tmp_path / "run"))
    sentence = printed.splitlines()[-1]
    assert f"odd_envs:{task}-v0" in sentence and REFUSED[task] in sentence
    assert ("Traceback" in printed and "odd_envs.py" in printed) == task.startswith(("Mistake", "OnlyOne"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("where", ["step", "reset"])
def test_a_task_that_ends_the_program_has_failed(script, where, tmp_path):
    printed = ends_with(1, script, words("Exits", tmp_path / "run"), odd=where)
    assert "the task ended the program" in printed and f"in {where}\n    self.exit_in(" in printed
    assert not (tmp_path / "run/result.json").exists()


# --- Said, and trained ------------------------------------------------------------------------------------------------


def test_actions_that_the_policy_never_reaches(script, tmp_path, capsys):
    call_main(script, *words("FarActions", tmp_path / "run"))
    warning = next(line for line in capsys.readouterr().out.splitlines() if "RescaleAction" in line)
    assert warning.startswith("warning: odd_envs:FarActions-v0 has actions in Box(100.0, 200.0")


@pytest.mark.parametrize("task", ["GlobalRandom", "Level", "Longer"])
def test_a_task_that_does_not_repeat_itself_is_warned_of(script, task, tmp_path):
    """Whether observations, rewards or ends show it; and where it is continued, not only at the start."""
    continued = words(task, tmp_path / "run", "--resume")
    ends_with(KILLED, script, continued, after=("last.pt", 2))
    assert f"warning: odd_envs:{task}-v0 does not repeat itself" in ends_with(0, script, continued)


def test_global_generators_follow_the_seed(script, tmp_path, capsys):
    """Whatever they were before, and however often the policy is evaluated."""
    for i, interval in enumerate((100, 100, 400)):
        np.random.seed(i)
        call_main(script, *words("GlobalRandom", tmp_path / str(i), eval_interval=interval))
    same, again, rarely = (tmp_path / str(i) for i in range(3))
    assert differences(outcome(same), outcome(again)) == []
    unlike = differences(outcome(same), outcome(rarely))
    assert unlike and not [key for key in unlike if key.startswith("last.pt/params")]
    for name in ("best", "last"):
        capsys.readouterr()
        call_main(script, "--evaluate", same / f"{name}.pt", "--final-eval-episodes", 2)
        printed = [line.split()[3] for line in capsys.readouterr().out.splitlines() if line.startswith("episode")]
        assert printed == [f"{x:.3f}," for x in read_json(same / "result.json")[name]["returns"]]


# --- Without end ------------------------------------------------------------------------------------------------------


def test_no_time_limit(script, tmp_path):
    """Said at the start; the first evaluation ends by a signal within seconds, and with a limit all goes on."""
    endless, run_dir = words("Goal", tmp_path / "run", "--resume"), tmp_path / "run"
    stop = {"at": ("lengths[i] += 1", 5000), "action": send(signal.SIGTERM)}
    printed = ends_with(75, script, endless, timeout=60, **stop)
    assert "no time limit" in printed and "--max-episode-steps" in printed
    assert torch.load(run_dir / "last.pt")["global_step"] == 200
    assert (run_dir / "evaluations.csv").read_text().count("\n") == 1 and not (run_dir / "best.pt").exists()
    assert "--max-episode-steps None" in refusal(script, [*endless, "--max-episode-steps", 40])
    assert "no time limit" not in ends_with(0, script, words("Goal", tmp_path / "limit", max_episode_steps=40))
    check_like("Line", script, tmp_path / "limit")


# --- Closed, however the run ends -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "task, at, code",
    [
        ("Opened", None, 0),
        ("Opened", ("lengths[i] += 1", 1), 75),
        ("OpenedWholeActions", None, 2),
        ("Opened", ("rollout = collect(", 2), 1),
    ],
)
def test_every_environment_is_closed(script, task, at, code, tmp_path):
    """A thread of the task would else keep the finished program alive."""

    def crash():
        raise RuntimeError

    (tmp_path / "open").mkdir()
    odd, action = tmp_path / "open", crash if code == 1 else send(signal.SIGTERM)
    ends_with(code, script, words(task, tmp_path / "run"), timeout=60, at=at, action=action, odd=odd)
    if code == 0:
        ends_with(0, script, ["--evaluate", tmp_path / "run/best.pt"], timeout=60, odd=odd)
    assert list((tmp_path / "open").iterdir()) == []
