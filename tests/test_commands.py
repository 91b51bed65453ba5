"""The real command lines: all tasks of the paper, the files that a run leaves, the flags and their help."""

import ast
import csv
import inspect
import json
import re
import signal
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path
from unittest import mock

import gymnasium as gym
import pytest
import torch
from conftest import ROOT, imports, python, run
from resume_helpers import TASKS
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

import refineppo_continuous

QUICK = "--no-compile --num-steps 32 --num-minibatches 2 --update-epochs 1 --eval-episodes 1 --final-eval-episodes 1"
QUICK = (*QUICK.split(), *"--actor-hidden 16 --critic-hidden 16 --total-timesteps 64".split())

LOSSES = "policy_loss value_loss entropy old_approx_kl approx_kl clipfrac explained_variance grad_norm"
SCALARS = {"charts/learning_rate", "charts/SPS", "charts/mujoco_warnings", "final/best_mean", "final/last_mean"}
SCALARS |= {"eval/return_mean", "eval/return_std", "eval/episode_length", *(f"losses/{x}" for x in LOSSES.split())}
EPISODES = {"charts/episodic_return", "charts/episodic_length"}
REFINEMENT = ("correction_norm", "settling_error", "outside_bounds")
REFINEMENT = {f"refinement/{name}_{k}" for name in REFINEMENT for k in (1, 2, 3, 4)}


def call_main(script, *flags):
    """`main()` in this process, as with these flags on the command line; signals and torch are then as before."""
    handlers = {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGHUP)}
    try:
        with mock.patch.object(sys, "argv", [script.__file__, *map(str, flags)]):
            script.main()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        torch.set_num_threads(1)


def read_events(run_dir: Path) -> EventAccumulator:
    """All of the run's one event file."""
    (path,) = run_dir.rglob("events.out.tfevents.*")
    assert path.parent == run_dir
    return EventAccumulator(str(path), size_guidance={"scalars": 0}).Reload()


def read_json(path: Path):
    """Strict JSON: Python also reads NaN and Infinity, which others do not."""
    return json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} in {path}"))


def flag_names(script) -> set[str]:
    return {field.name for field in fields(script.Args)}


def check_config(run_dir: Path, script, env_id: str):
    config = read_json(run_dir / "config.json")
    assert set(config["args"]) == flag_names(script) and config["args"]["env_id"] == env_id
    assert config["versions"].items() >= {"torch": torch.__version__, "gymnasium": gym.__version__}.items()
    assert {"python", "numpy", "mujoco"} <= set(config["versions"]) and {"git_commit", "cpu", "gpu"} <= set(config)
    x86 = re.search(r"Model name: +(.+)\s+CPU family: +(.+)\s+Model: +(.+)", subprocess.getoutput("lscpu"))
    assert x86 is None or config["cpu"].startswith(", ".join(x86.groups()) + " (")  # None: ARM, or no lscpu


def check_result(run_dir: Path, script, env_id: str, total: int):
    """And evaluations.csv, which has the one evaluation of the training."""
    result, refines = read_json(run_dir / "result.json"), script is refineppo_continuous
    known = {"env_id": env_id, "exp_name": script.__name__, "seed": 1, "total_timesteps": total, "std_ddof": 1}
    known |= {"refinement_depth": 4 if refines else None, "refinement_schedule": "average" if refines else None}
    assert {key: result.pop(key) for key in known} == known
    assert set(result) == {"best", "last", "train_return_last10pct", "wall_time_s", "sps"}
    assert result["wall_time_s"] > 0 and result["sps"] > 0
    selection_return = result["best"].pop("selection_return")
    for final in (result["best"], result["last"]):
        (only,) = final["returns"]
        assert final == {"global_step": total, "returns": [only], "mean": only, "std": 0} and isinstance(only, float)
    header, row = csv.reader((run_dir / "evaluations.csv").read_text().splitlines())
    assert header == ["global_step", "return_mean", "return_std", "return_min", "return_max", "length_mean"]
    step, mean, std, low, high, length = map(float, row)
    assert row[0] == str(total) and mean == low == high == selection_return and std == 0 and length >= 1


def check_tensorboard(run_dir: Path, script):
    events = read_events(run_dir)
    scalars = set(events.Tags()["scalars"])
    assert scalars - EPISODES == SCALARS | (REFINEMENT if script is refineppo_continuous else set())
    (table,) = events.Tensors("hyperparameters/text_summary")
    _, _, *lines = table.tensor_proto.string_val[0].decode().splitlines()
    assert {line.split("|")[1] for line in lines} == flag_names(script)
    content = events.PluginTagToContent("hparams")
    start, experiment = (content[f"_hparams_/{name}"] for name in ("session_start_info", "experiment"))
    hparams = HParamsPluginData.FromString(start).session_start_info.hparams
    assert set(hparams) == flag_names(script) and hparams["learning_rate"].number_value == 3e-4
    metrics = {info.name.tag for info in HParamsPluginData.FromString(experiment).experiment.metric_infos}
    assert metrics and metrics <= scalars


def check_checkpoint(path: Path, script, env_id: str, total: int):
    assert torch.serialization.get_unsafe_globals_in_checkpoint(path) == []
    checkpoint = torch.load(path, weights_only=True)
    assert checkpoint["global_step"] == total and script.Args(**checkpoint["args"]).env_id == env_id


SLOW = [pytest.param(task, 1 + 2 * (i % 2), marks=pytest.mark.slow) for i, task in enumerate(TASKS)]


@pytest.mark.parametrize("env_id, num_envs", [*SLOW, ("probe_envs:Unbounded-v0", 3)])
def test_every_task_trains_and_leaves_all_files(script, env_id, num_envs, tmp_path):
    """The real command in a folder of its own; of the paper's tasks nothing is to be said."""
    total, run_dir = 64 * num_envs, tmp_path / "a" / "run"
    flags = ("--env-id", env_id, "--num-envs", num_envs, "--total-timesteps", total, "--run-dir", run_dir)
    done = run(f"{script.__name__}.py", *QUICK, *flags, cwd=tmp_path)
    assert done.returncode == 0 and done.stderr == "" and "warning" not in done.stdout, done.stdout + done.stderr
    assert f"tensorboard --logdir {run_dir}" in done.stdout.splitlines()[-1]
    assert {path.name for path in tmp_path.iterdir()} == {"a"}
    names = {re.sub(r"tfevents\..*", "tfevents", path.name) for path in run_dir.iterdir()}
    assert names == {"best.pt", "last.pt", "config.json", "evaluations.csv", "result.json", "events.out.tfevents"}
    check_config(run_dir, script, env_id)
    check_result(run_dir, script, env_id, total)
    check_tensorboard(run_dir, script)
    for name in ("best.pt", "last.pt"):
        check_checkpoint(run_dir / name, script, env_id, total)


def test_what_a_longer_run_logs_keeps_and_prints(script, tmp_path, capsys):
    flags = (*QUICK, "--env-id", "probe_envs:Counter-v0", "--total-timesteps", 160, "--eval-interval", 32)
    call_main(script, *flags, "--save-every", 50, "--run-dir", tmp_path / "shown")
    assert capsys.readouterr().out.count("evaluation return") == 5
    assert EPISODES <= set(read_events(tmp_path / "shown").Tags()["scalars"])
    # iterations end at 32, 64, ..., 160; kept are the first at or after 50, 100 and 150
    kept = {path.name: path for path in (tmp_path / "shown").glob("step_*.pt")}
    assert set(kept) == {"step_64.pt", "step_128.pt", "step_160.pt"}
    for step in (64, 128, 160):
        check_checkpoint(kept[f"step_{step}.pt"], script, "probe_envs:Counter-v0", step)
    call_main(script, *flags, "--run-dir", tmp_path / "quiet", "--no-progress")
    assert "evaluation" not in capsys.readouterr().out


def test_what_tensorboard_draws_together(script, tmp_path):
    """Under Custom Scalars, by its own rule, re.match: the returns, and each refinement quantity's K lines."""
    depth = ("--refinement-depth", 11) if script is refineppo_continuous else ()
    call_main(script, *QUICK, *depth, "--env-id", "probe_envs:Counter-v0", "--run-dir", tmp_path)
    events, expected = read_events(tmp_path), {"return": {"eval/return_mean", "charts/episodic_return"}}
    for name in {scalar[:-2].removeprefix("refinement/") for scalar in REFINEMENT} if depth else ():
        expected[name] = {f"refinement/{name}_{k}" for k in range(1, 12)}
    (layout,) = events.Tensors("custom_scalars__config__")
    (category,) = Layout.FromString(layout.tensor_proto.string_val[0]).category
    tags = events.Tags()["scalars"]
    shown = {
        chart.title: {t for t in tags if any(re.match(x, t) for x in chart.multiline.tag)} for chart in category.chart
    }
    assert shown == expected


WITHOUT_POSIX = """
import runpy, signal, sys
sys.modules["fcntl"] = None  # `import fcntl` then raises ImportError
for name in ("SIGUSR1", "SIGUSR2", "SIGHUP", "SIGQUIT"):
    delattr(signal, name)
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo_continuous.py", "refineppo_continuous.py", "analysis_refinement.py"])
def test_without_posix(name, tmp_path):
    """As on Windows."""
    trains = name != "analysis_refinement.py"
    words = [*QUICK, "--env-id", "Pendulum-v1", "--run-dir", tmp_path] if trains else ["--help"]
    done = python("-c", WITHOUT_POSIX, name, *words)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "result.json").exists() == trains


def test_the_home_folder(script, tmp_path, monkeypatch, capsys):
    """`--run-dir=~/x`, which no shell expands."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    call_main(script, *QUICK, "--env-id", "Pendulum-v1", "--run-dir=~/x")
    call_main(script, "--evaluate=~/x/best.pt")
    assert "mean return" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["x"] and (tmp_path / "x/result.json").exists()


def test_processors_of_one_name_are_told_apart(script):
    """By the instructions that torch uses, which decide how it rounds; here by its own switch for them."""
    program = f"import {script.__name__} as script; print(script.describe_machine()['cpu'])"
    assert python("-c", program, ATEN_CPU_CAPABILITY="default").stdout.endswith(" (DEFAULT)\n")


# --- Flags ------------------------------------------------------------------------------------------------------------


def test_help_explains_every_flag(script):
    shown = run(f"{script.__name__}.py", "--help", COLUMNS="160")
    assert shown.returncode == 0 and shown.stderr == ""

    def words(text: str) -> str:
        return " ".join(re.sub("[│,]", " ", text).split())

    body = ast.parse(inspect.getsource(script.Args)).body[0].body
    docstrings = {flag.target.id: after.value.value for flag, after in zip(body, body[1:]) if hasattr(flag, "target")}
    assert set(docstrings) == flag_names(script)
    for name, docstring in docstrings.items():
        _, flag, explained = words(shown.stdout).partition(f" --{name.replace('_', '-')} ")
        assert flag and words(docstring) in explained, name


def test_flags_are_cleanrls_with_its_defaults(script):
    cleanrl = """seed=1 track=False wandb_entity=None capture_video=False learning_rate=0.0003 num_envs=1 num_steps=2048
        anneal_lr=True gamma=0.99 gae_lambda=0.95 num_minibatches=32 update_epochs=10 norm_adv=True clip_coef=0.2
        clip_vloss=True ent_coef=0.0 vf_coef=0.5 max_grad_norm=0.5 target_kl=None"""
    own = """total_timesteps=6000000 log_std_init=0.0 eval_interval=100000 eval_episodes=10 final_eval_episodes=10
        compile=True bootstrap_truncated=False normalize_obs=True normalize_reward=True"""
    defaults = {field.name: field.default for field in fields(script.Args)}
    expected = dict(flag.split("=") for flag in (cleanrl + " " + own).split()) | {"exp_name": script.__name__}
    assert {name: str(defaults.get(name, "missing")) for name in expected} == expected
    assert defaults["actor_hidden"] == (128, 128) and defaults["critic_hidden"] == (64, 64)
    assert {"cuda", "wandb_project_name", "env_id"} <= set(defaults)  # CleanRL's, with defaults of our own
    assert not {"save_model", "upload_model", "hf_entity", "torch_deterministic"} & set(defaults)


@pytest.mark.parametrize("flag, package", [("--capture-video", "moviepy"), ("--track", "wandb")])
def test_extras_that_are_missing(script, flag, package, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(script, "find_spec", lambda name: None)
    with pytest.raises(SystemExit) as stop:
        call_main(script, *QUICK, "--env-id", "Pendulum-v1", "--run-dir", tmp_path / "run", flag)
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert package in line and "pip install" in line
    assert list(tmp_path.iterdir()) == []


def test_a_copied_file_names_what_it_imports(script):
    """PEP 723's block, read as its reference implementation does, against the imports and pyproject."""
    text, project = Path(script.__file__).read_text(), tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (block,) = re.findall(r"(?m)^# /// script$\s((?:^#(?:| .*)$\s)+)^# ///$", text)
    metadata = tomllib.loads("".join(line.removeprefix("#").removeprefix(" ") for line in block.splitlines(True)))
    imported = {name.split(".")[0] for name in imports(text)} | {"tensorboard"}  # torch.utils.tensorboard's
    needed = [item for item in project["dependencies"] if re.match(r"[\w-]+", item)[0].replace("-", "_") in imported]
    assert metadata == {"requires-python": project["requires-python"], "dependencies": needed}
