"""Every command and every Python snippet of the README is run, in the README's order, with fewer steps.

Of a sweep the generator runs as it stands, and the executor only says what it would run: test_sweeps.py has the rest.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path

import pandas as pd
import pytest
import results_page
from conftest import ROOT
from test_commands import QUICK

import analysis_refinement
import ppo_continuous
import refineppo_continuous
from sweeps import report, tune

SCRIPTS = {f"{module.__name__}.py": module for module in (ppo_continuous, refineppo_continuous)}


def readme() -> str:
    return (ROOT / "README.md").read_text()


def blocks(text: str) -> list[tuple[str, str]]:
    """The (language, content) of every fenced block."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def table_commands(text: str) -> list[str]:
    """The commands in the cells of tables, where | is written \\|."""
    cells = re.findall(r"(?<=\| )`((?:python |sweeps/)[^`]+)`(?= \|)", text)
    return [cell.replace(r"\|", "|") for cell in cells]


def commands(block: str) -> list[str]:
    """Every command, also of those joined by &&, without comments: they would hide the flags that make it short."""
    lines = re.sub(r"(^| )#.*", "", block.replace("\\\n", " ").replace("&&", "\n"), flags=re.MULTILINE).splitlines()
    return [line.strip() for line in lines if line.strip()]


def bash(command: str, folder: Path, **env) -> str:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])  # as in its environment
    env = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)} | env
    words = "bash", "-o", "pipefail", "-c", command
    done = subprocess.run(words, cwd=folder, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def run_command(command: str, folder: Path):
    """Run a command of the README in `folder`, made short by more flags; fail if it does, or if it is unknown here.

    Of a flag that is given twice the last one counts.
    """
    short = dict.fromkeys(SCRIPTS, shlex.join(QUICK)) | {"analysis_refinement.py": "--num-states 100 --episodes 2"}
    short |= {"sweeps/tune.py": "--dry-run --flags=--no-compile", "sweeps/report.py": ""}
    match shlex.split(command, comments=True):
        case ["pip", "install", "-e", target]:
            extras = re.fullmatch(r"\.(?:\[([\w,]+)\])?", target)[1] or ""
            known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
            assert set(extras.split(",")) - {""} <= set(known)
        case ["pytest"]:
            pass  # it runs this
        case ["tensorboard", *_]:
            shown = bash(f"{command} --inspect", folder)
            assert "charts/SPS" in shown and "eval/return_mean" in shown
        case ["python", name, "--evaluate", checkpoint, "--render"] if name in SCRIPTS:
            # MuJoCo's windows need a display; LunarLander's opens without one
            assert (folder / checkpoint).is_file()
            run_command(f"python {name} --env-id LunarLanderContinuous-v3 --run-dir lander", folder)
            shown = bash(f"python {name} --evaluate lander/best.pt --render", folder, SDL_VIDEODRIVER="dummy")
            assert "return" in shown
        case ["python", name, "--evaluate", _] if name in SCRIPTS:
            assert "return" in bash(f"{command} --final-eval-episodes 1", folder)
        case words if {"|", "sweeps/run_local.sh"} <= {*words} or {"|", "sweeps/run_slurm.sh"} <= {*words}:
            planned = bash(re.sub(r"\| sweeps/run_\w+.sh", r"\g<0> --dry-run", command), folder)
            assert "_continuous.py --env-id" in planned
        case ["python", name, *flags] if name in short and not {"|", ">", ";", "&"} & set(flags):
            for pattern in re.findall(r"(\S+\*\S+)/", command):  # runs of a sweep
                shutil.copytree(folder / "runs/hopper", folder / pattern.replace("*", "__"))
            assert bash(f"{command} {short[name]}", folder)
        case _:
            pytest.fail(f"no test runs the README's command: {command}")


@pytest.mark.slow
def test_every_command_and_snippet(tmp_path):
    for name in (*SCRIPTS, "analysis_refinement.py", "sweeps"):
        (tmp_path / name).symlink_to(ROOT / name)
    ran = []
    for language, content in blocks(readme()):
        if language == "python":
            assert bash(f"python -c {shlex.quote(content)}", tmp_path)
            ran.append("snippet")
        if language == "bash":
            for command in commands(content):
                run_command(command, tmp_path)
                ran.append(command)
    for command in table_commands(readme()):
        run_command(command, tmp_path)
        ran.append(command)
    for part in ("pip", "pytest", "tensorboard", "snippet", "run_local.sh", "run_slurm.sh", "tune.py", "report.py"):
        assert any(part in command for command in ran)


def test_every_flag_that_is_named_exists():
    modules = *SCRIPTS.values(), analysis_refinement, tune, report
    flags = {field.name.replace("_", "-") for module in modules for field in fields(module.Args)}
    known = {f"--{prefix}{name}" for name in flags for prefix in ("", "no-")} | {"--help", "--logdir"}
    known |= {"--max-running", "--time", "--partition"}  # of run_slurm.sh and sbatch
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", readme()))
    assert named - known == set() and len(named) > 10


def test_the_results_are_those_of_the_data():
    """The page's tables, one of its cells by hand, and what it and the README say of all tasks together."""
    page, of_runs = (results_page.RESULTS / "README.md").read_text(), results_page.RESULTS / "benchmark" / "runs.csv"
    assert results_page.fill(page) == page
    runs = pd.read_csv(of_runs).query("task == 'Hopper-v5' and steps == 1e6 and actor == '128x128' and method == 'PPO'")
    runs = runs[runs["flags"] == "--eval-interval 50000"]
    assert f"| Hopper-v5 | {runs.best_mean.mean():.0f} ± {runs.best_mean.std():.0f} |" in page
    all_tasks = pd.read_csv(results_page.TABLES / "aggregate.csv").iloc[0]
    value, low, high = (f"{all_tasks[f'p_improvement_{part}']:.2f}" for part in ("value", "low", "high"))
    for text in (readme(), page):
        assert f"{value} of the pairs of seeds (95 % interval {low} to {high}" in " ".join(text.split())
