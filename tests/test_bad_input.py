"""Bad input ends with exit code 2 and one sentence before any work."""

import pytest
import torch
from conftest import files_of, run
from test_commands import QUICK, call_main

import refineppo_continuous

BAD_VALUES = {  # of flags that the sentence must name
    **dict.fromkeys("total-timesteps num-envs num-steps num-minibatches update-epochs num-threads".split(), ["0"]),
    **dict.fromkeys("eval-interval eval-episodes final-eval-episodes save-every checkpoint-interval".split(), ["0"]),
    **dict.fromkeys("learning-rate clip-coef max-grad-norm target-kl".split(), ["0", "-0.1", "nan", "inf"]),
    **dict.fromkeys("gamma gae-lambda".split(), ["1.01", "-0.5", "nan"]),
    **dict.fromkeys("ent-coef vf-coef".split(), ["nan", "inf"]),
    "max-episode-steps": ["0", "-2"],
    "log-std-init": ["1000", "nan"],
    **dict.fromkeys(("actor-hidden", "critic-hidden"), ["", "16 0", "-4"]),
    "seed": ["-1", "99999999999999999999"],
}
REFUSED = [(f"--{name} {value}", f"--{name}") for name, values in BAD_VALUES.items() for value in values]
REFUSED += [  # flags, and what the sentence must name
    ("--env-id NoSuchTask-v0", "NoSuchTask"),
    ("--env-id HalfCheetah-v99", "HalfCheetah-v99"),
    ("--env-id nonsense!", "nonsense!"),
    ("--env-id no_such_module:Task-v0", "no_such_module"),
    ("--env-id probe_envs:NoSuchTask-v0", "NoSuchTask"),
    ("--env-id CartPole-v1", "actions"),
    ("--num-envs 3 --num-minibatches 5 --total-timesteps 1000", "5 minibatches do not divide a rollout of 96 steps"),
    ("--num-minibatches 64", "minibatch"),
    ("--num-minibatches 32", "minibatch"),
    ("--num-envs 4", "one rollout of 128 steps"),
    ("--resume", "--run-dir"),
    ("--render", "--evaluate"),
    ("--evaluate no/such.pt", "no/such.pt"),
    ("--evaluate .", "checkpoint"),
    ("--run-dir mine", "mine is not empty"),
    ("--run-dir mine --resume", "are not of a run of"),
    ("--run-dir /dev/null/run", "/dev/null/run"),
    ("--run-dir mine/config.json", "mine/config.json"),
    ("--run-dir mine/config.json/run", "mine/config.json/run"),
]


@pytest.fixture
def refuses(script, tmp_path, monkeypatch, capsys, recwarn):
    """Runs `main()`, which must end with exit code 2, one sentence and the disk as it was; gives the sentence."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/config.json").write_text("of another program")

    def refuses(*flags) -> str:
        before = files_of(tmp_path)
        with pytest.raises(SystemExit) as stop:
            call_main(script, *QUICK, "--env-id", "Pendulum-v1", *flags)
        assert stop.value.code == 2
        assert files_of(tmp_path) == before
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
def test_bad_depth(refuses):
    assert "--refinement-depth must be at least 1" in refuses("--refinement-depth", 0)


UNREADABLE = "--num-envs two", "--gamma", "--no-such-flag", "positional", "--refinement-schedule cosine"


@pytest.mark.parametrize("flags", UNREADABLE)
def test_flags_that_cannot_be_read(flags, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        call_main(refineppo_continuous, *QUICK, *flags.split())
    shown = capsys.readouterr().err
    assert stop.value.code == 2 and flags.split()[-1] in shown and list(tmp_path.iterdir()) == []
    assert "cosine" not in flags or "average" in shown and "inverse" in shown


def test_no_gpu(refuses, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "--cuda" in refuses("--cuda")


@pytest.mark.parametrize("flags", ["--max-episode-steps 50", "--no-normalize-obs"])
def test_evaluating_with_flags_that_are_the_checkpoints(script, refuses, flags, tmp_path, capsys):
    """They would change nothing; the sentence says which do."""
    call_main(script, *QUICK, "--env-id", "Pendulum-v1", "--run-dir", tmp_path / "run")
    capsys.readouterr()
    refused = refuses("--evaluate", tmp_path / "run/best.pt", *flags.split())
    assert flags.split()[0].replace("no-", "") in refused and "--final-eval-episodes" in refused


@pytest.mark.slow
@pytest.mark.parametrize("flags", ["--env-id LunarLanderContinuous-v2", "--evaluate no/such.pt"])
def test_real_commands(script, flags, tmp_path):
    """Of the first task's age gymnasium also warns."""
    done = run(f"{script.__name__}.py", *flags.split(), cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"{script.__name__}.py: error: ")
    assert list(tmp_path.iterdir()) == []
