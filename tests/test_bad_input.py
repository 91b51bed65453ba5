"""Bad input ends with exit code 2 and one sentence before any work."""

import zipfile

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
    ("--log-std-init 1000", "--log-std-init must be from -20 to 20"),
    ("--actor-hidden", "--actor-hidden"),
    ("--critic-hidden", "--critic-hidden"),
    ("--actor-hidden 16 0", "--actor-hidden"),
    ("--critic-hidden -4", "--critic-hidden"),
    *((f"--{name} 0", f"--{name}") for name in "total-timesteps num-envs num-steps num-minibatches".split()),
    *((f"--{name} 0", f"--{name}") for name in "update-epochs eval-interval eval-episodes save-every".split()),
    *(
        (f"--{name} 0", f"--{name}")
        for name in "final-eval-episodes checkpoint-interval num-threads max-episode-steps".split()
    ),
    ("--num-envs -2 --num-steps -16", "--num-envs"),
    ("--seed -1", "--seed"),
    ("--seed 99999999999999999999", "--seed"),
    ("--resume", "--run-dir"),
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


def no_parameters(path):
    torch.save(torch.load(path) | {"params": {}}, path)


def small_parameters(path):  # which would fill the right ones, if copied into them
    checkpoint = torch.load(path)
    torch.save(checkpoint | {"params": {name: torch.ones(1) for name in checkpoint["params"]}}, path)


NO_CHECKPOINTS = torn, text, another_zip, another_model, a_tensor, a_folder
MALFORMED = no_parameters, small_parameters


@pytest.mark.parametrize("damage", [*NO_CHECKPOINTS, *MALFORMED], ids=lambda damage: damage.__name__)
def test_evaluating_what_is_no_checkpoint(checkpoint, refuses, damage):
    damage(checkpoint)
    assert str(checkpoint) in refuses("--evaluate", checkpoint)


def test_evaluating_a_checkpoint_of_the_other_script(refuses, script, folder, capsys):
    (other,) = {ppo_continuous, refineppo_continuous} - {script}
    call_main(other, *QUICK, "--env-id", "Pendulum-v1", "--run-dir", "run")
    capsys.readouterr()
    assert script.__name__ in refuses("--evaluate", "run/best.pt")


@pytest.mark.parametrize("flags", ["--eval-episodes 99", "--max-episode-steps 50", "--seed 9", "--no-normalize-obs"])
def test_evaluating_with_flags_that_are_the_checkpoints(checkpoint, refuses, flags):
    """They would change nothing; the sentence says which do."""
    refused = refuses("--evaluate", checkpoint, *flags.split())
    assert flags.split()[0].replace("no-", "") in refused and "--final-eval-episodes" in refused


# --- Real commands ----------------------------------------------------------------------------------------------------


OLD_TASK = "--env-id LunarLanderContinuous-v2"  # gymnasium also warns of its age


@pytest.mark.slow
@pytest.mark.parametrize("flags", [OLD_TASK, "--num-threads 0", "--run-dir /dev/null/run", "--evaluate no/such.pt"])
def test_real_commands(script, flags, tmp_path):
    done = run(f"{script.__name__}.py", *flags.split(), cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"{script.__name__}.py: error: ")
    assert list(tmp_path.iterdir()) == []
