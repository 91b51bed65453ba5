"""Bad input ends with exit code 2 and one sentence before any work; numbers that are not finite with exit code 3."""

import json
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import run
from test_commands import QUICK, call_main

import ppo_continuous
import refineppo_continuous

# flags, and what the sentence must name
REFUSED = [
    ("--env-id NoSuchTask-v0", "NoSuchTask"),
    ("--env-id HalfCheetah-v99", "HalfCheetah-v99"),
    ("--env-id nonsense!", "nonsense!"),
    ("--env-id no_such_module:Task-v0", "no_such_module"),
    ("--env-id probe_envs:NoSuchTask-v0", "NoSuchTask"),
    ("--env-id CartPole-v1", "actions"),
    ("--env-id probe_envs:Discrete-v0", "actions"),
    ("--env-id probe_envs:ImageObs-v0", "observations"),
    ("--env-id probe_envs:DictObs-v0", "observations"),
    ("--num-minibatches 3", "3 minibatches"),
    ("--num-envs 3 --num-minibatches 5 --total-timesteps 1000", "96 steps"),
    ("--num-minibatches 64", "minibatch"),
    ("--num-minibatches 32", "minibatch"),
    ("--total-timesteps 31", "one rollout of 32 steps"),
    ("--num-envs 4", "one rollout of 128 steps"),
    ("--learning-rate nan", "--learning-rate"),
    ("--learning-rate inf", "--learning-rate"),
    ("--learning-rate -0.1", "--learning-rate"),
    ("--learning-rate 0", "--learning-rate"),
    ("--gamma 1.01", "--gamma"),
    ("--gamma -0.5", "--gamma"),
    ("--gamma nan", "--gamma"),
    ("--gae-lambda 2", "--gae-lambda"),
    ("--clip-coef 0", "--clip-coef"),
    ("--max-grad-norm -1", "--max-grad-norm"),
    ("--target-kl 0", "--target-kl"),
    ("--ent-coef nan", "--ent-coef"),
    ("--vf-coef inf", "--vf-coef"),
    ("--log-std-init nan", "--log-std-init"),
    ("--actor-hidden", "--actor-hidden"),
    ("--critic-hidden", "--critic-hidden"),
    ("--actor-hidden 16 0", "--actor-hidden"),
    ("--critic-hidden -4", "--critic-hidden"),
    *((f"--{name} 0", f"--{name}") for name in "total-timesteps num-envs num-steps num-minibatches".split()),
    *((f"--{name} 0", f"--{name}") for name in "update-epochs eval-interval eval-episodes save-every".split()),
    *((f"--{name} 0", f"--{name}") for name in "final-eval-episodes checkpoint-interval num-threads".split()),
    ("--num-envs -2 --num-steps -16", "--num-envs"),
    ("--seed -1", "--seed"),
    ("--seed 99999999999999999999", "--seed"),
    ("--render", "--evaluate"),
    ("--evaluate no/such.pt", "no/such.pt"),
    ("--evaluate .", "checkpoint"),
]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty current directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refuses(script, folder, capsys, recwarn):
    """Runs `main()`, which must end with exit code 2, one sentence and the disk as it was; gives the sentence."""

    def contents() -> dict:
        return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}

    def refuses(*flags) -> str:
        before = contents()
        with pytest.raises(SystemExit) as stop:
            call_main(script, *QUICK, "--env-id", "Pendulum-v1", *flags)
        assert stop.value.code == 2
        assert contents() == before
        shown = capsys.readouterr()
        assert shown.out == "" and not [w for w in recwarn if w.category is UserWarning]  # it would be shown, too
        (line,) = shown.err.splitlines()
        assert line.startswith(f"{script.__name__}.py: error: ")
        return line

    return refuses


@pytest.mark.parametrize("flags, named", REFUSED, ids=[flags for flags, _ in REFUSED])
def test_bad_flags(refuses, flags, named):
    assert named in refuses(*flags.split())


@pytest.mark.parametrize("script", [refineppo_continuous])
@pytest.mark.parametrize("depth", [0, -3])
def test_bad_depth(refuses, depth):
    assert "--refinement-depth must be at least 1" in refuses("--refinement-depth", depth)


@pytest.mark.parametrize("flags", ["--num-envs two", "--gamma", "--no-such-flag", "--anneal-lr maybe", "positional"])
def test_flags_that_cannot_be_read(script, flags, folder, capsys):
    with pytest.raises(SystemExit) as stop:
        call_main(script, *QUICK, *flags.split())
    assert stop.value.code == 2
    assert flags.split()[-1] in capsys.readouterr().err
    assert list(folder.iterdir()) == []


def test_unknown_schedule(folder, capsys):
    with pytest.raises(SystemExit) as stop:
        call_main(refineppo_continuous, *QUICK, "--refinement-schedule", "cosine")
    assert stop.value.code == 2
    shown = capsys.readouterr().err
    assert "cosine" in shown and "average" in shown and "inverse" in shown
    assert list(folder.iterdir()) == []


def test_resume_without_a_folder(refuses):
    assert "--run-dir" in refuses("--resume")


def test_no_gpu(refuses, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "--cuda" in refuses("--cuda")


def test_folder_with_a_file_of_the_user(refuses, folder):
    (folder / "mine").mkdir()
    (folder / "mine" / "thesis.txt").write_text("three years")
    assert "mine is not empty" in refuses("--run-dir", "mine")


@pytest.mark.parametrize("run_dir", ["/dev/null/run", "file", "file/run"])
def test_folder_that_cannot_be_written(refuses, folder, run_dir):
    (folder / "file").write_text("not a folder")
    assert run_dir in refuses("--run-dir", run_dir)


# --- Checkpoints that are none ----------------------------------------------------------------------------------------


@pytest.fixture
def checkpoint(script, folder, capsys):
    """A checkpoint of the script, of a run of its own."""
    call_main(script, *QUICK, "--env-id", "Pendulum-v1", "--run-dir", "run")
    capsys.readouterr()
    return folder / "run" / "best.pt"


def torn(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def text(path):
    path.write_text("weights, weights, weights")


def another_zip(path):
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("notes.txt", "not torch's")


def another_model(path):
    torch.save(torch.nn.Linear(2, 2).state_dict(), path)


def a_tensor(path):
    torch.save(torch.zeros(3), path)


def a_folder(path):
    path.unlink()
    path.mkdir()


def other_parts(path, **parts):
    torch.save(torch.load(path) | parts, path)


def no_parameters(path):
    other_parts(path, params={})


def small_parameters(path):  # which would fill the right ones, if copied into them
    other_parts(path, params={name: torch.ones(1) for name in torch.load(path)["params"]})


def text_for_a_number(path):
    other_parts(path, args=torch.load(path)["args"] | {"num_envs": "3"})


def text_for_the_step(path):
    other_parts(path, global_step="many")


NO_CHECKPOINTS = torn, text, another_zip, another_model, a_tensor, a_folder
MALFORMED = no_parameters, small_parameters, text_for_a_number, text_for_the_step


@pytest.mark.parametrize("damage", [*NO_CHECKPOINTS, *MALFORMED], ids=lambda damage: damage.__name__)
def test_evaluating_what_is_no_checkpoint(checkpoint, refuses, damage):
    damage(checkpoint)
    assert str(checkpoint) in refuses("--evaluate", checkpoint)


def test_evaluating_a_checkpoint_of_the_other_script(refuses, script, folder, capsys):
    (other,) = {ppo_continuous, refineppo_continuous} - {script}
    call_main(other, *QUICK, "--env-id", "Pendulum-v1", "--run-dir", "run")
    capsys.readouterr()
    assert script.__name__ in refuses("--evaluate", "run/best.pt")


# --- Real commands ----------------------------------------------------------------------------------------------------


OLD_TASK = "--env-id LunarLanderContinuous-v2"  # gymnasium also warns of its age


@pytest.mark.parametrize("flags", [OLD_TASK, "--num-threads 0", "--run-dir /dev/null/run", "--evaluate no/such.pt"])
def test_real_commands(script, flags, tmp_path):
    done = run(f"{script.__name__}.py", *flags.split(), cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"{script.__name__}.py: error: ")
    assert list(tmp_path.iterdir()) == []


# --- Numbers that are not finite --------------------------------------------------------------------------------------


def read_failure(run_dir) -> dict:
    """failure.json, in strict JSON, of a run that is not complete."""
    assert not (run_dir / "result.json").exists()
    return json.loads((run_dir / "failure.json").read_text(), parse_constant=pytest.fail)


def check_checkpoints(run_dir, step: int):
    """The checkpoints from before the failure load and are sound."""
    for name, saved in (("last.pt", {step}), ("best.pt", range(1, step + 1))):
        checkpoint = torch.load(run_dir / name, weights_only=True)
        assert checkpoint["global_step"] in saved
        tensors = [*checkpoint["params"].values(), *checkpoint["normalizer"].values()]
        assert all(tensor.isfinite().all() for tensor in tensors)


KEEP_ALL = ("--checkpoint-interval", 1, "--eval-interval", 1)


@pytest.mark.parametrize("env, name, value", [("NanReward", "reward", "nan"), ("InfReward", "reward", "inf"),
                                              ("NanObs", "next_obs", "nan")])  # fmt: skip
def test_environment_that_goes_wrong(script, env, name, value, tmp_path):
    flags = ("--num-envs", 2, "--total-timesteps", 640, "--run-dir", tmp_path / "run")
    done = run(f"{script.__name__}.py", *QUICK, *KEEP_ALL, "--env-id", f"probe_envs:{env}-v0", *flags)
    assert done.returncode == 3
    # both environments fail at their 101st step, in the fourth rollout of 64 steps
    failure = read_failure(tmp_path / "run")
    assert (failure["global_step"], failure["env"]) == (202, 0)
    assert value in failure[name] and "[" in failure["action"]
    (line,) = done.stderr.splitlines()
    assert failure["what"] in line and "202" in line and value in line and "failure.json" in line
    check_checkpoints(tmp_path / "run", step=192)


def test_first_observation_that_is_not_finite(script, tmp_path):
    """The third copy of the task is the second environment; its third episode begins after 2 x 50 steps in each."""
    flags = ("--num-envs", 2, "--total-timesteps", 640, "--run-dir", tmp_path / "run")
    done = run(f"{script.__name__}.py", *QUICK, *KEEP_ALL, "--env-id", "probe_envs:NanFirstObs-v0", *flags)
    failure = read_failure(tmp_path / "run")
    assert (done.returncode, failure["global_step"], failure["env"], failure["first_obs"]) == (3, 200, 1, "[nan]")


@pytest.mark.parametrize("env, step", [("NanObs", 102), ("NanReward", 101)])
def test_evaluation_that_is_not_finite(script, env, step, monkeypatch):
    """An episode's return is NaN as soon as an observation or a reward is, though the other stays sound."""
    task = gym.make(f"probe_envs:{env}-v0", max_episode_steps=step)
    args = script.Args(env_id=f"probe_envs:{env}-v0", actor_hidden=(8,), critic_hidden=(8,))
    agent = script.Agent(task.observation_space, task.action_space, args)
    monkeypatch.setattr(script, "make_env", lambda *_: gym.make(args.env_id, max_episode_steps=step - 1))
    assert np.isfinite(script.evaluate(agent, [0, 2])[0]).all()
    monkeypatch.setattr(script, "make_env", lambda *_: gym.make(args.env_id, max_episode_steps=step))
    assert np.isnan(script.evaluate(agent, [0, 2])[0]).all()


def test_absurd_learning_rate(script, tmp_path):
    flags = ("--env-id", "Pendulum-v1", "--learning-rate", "1e30", "--run-dir", tmp_path / "run")
    done = run(f"{script.__name__}.py", *QUICK, *KEEP_ALL, *flags)
    assert done.returncode == 3
    failure = read_failure(tmp_path / "run")
    assert "loss" in failure["what"] and failure["global_step"] == 32
    assert {"nan", "inf"} & {value for name, value in failure.items() if name.startswith("losses/")}
    (line,) = done.stderr.splitlines()
    assert failure["what"] in line and "32" in line
    assert not {"last.pt", "best.pt"} & {path.name for path in (tmp_path / "run").iterdir()}


def test_divergence_after_a_while_keeps_the_last_good_checkpoint(script, tmp_path):
    # the entropy bonus adds 5 to log_std in each of the two minibatches of an iteration, until exp(log_std) overflows
    flags = ("--env-id", "Pendulum-v1", "--learning-rate", 5, "--no-anneal-lr", "--ent-coef", 1000)
    with pytest.raises(SystemExit) as stop:
        call_main(script, *QUICK, *KEEP_ALL, *flags, "--total-timesteps", 3200, "--run-dir", tmp_path)
    assert stop.value.code == 3
    step = read_failure(tmp_path)["global_step"]
    assert 64 <= step < 3200
    check_checkpoints(tmp_path, step - 32)
