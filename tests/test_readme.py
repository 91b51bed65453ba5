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
from conftest import ROOT, python, run
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


def commands(block: str) -> list[list[str]]:
    """The words of every command, also of those joined by &&."""
    lines = block.replace("\\\n", " ").replace("&&", "\n").splitlines()
    return [words for words in (shlex.split(line, comments=True) for line in lines) if words]


def output(*words, folder: Path) -> str:
    done = python(*words, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def train_or_evaluate(name: str, *flags, folder: Path, **env):
    """Run the command line as it stands, and flags that make it short: of a flag given twice the last one counts."""
    short = ("--final-eval-episodes", 1) if "--evaluate" in flags else QUICK
    done = run(name, *flags, *short, cwd=folder, **env)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "return" in done.stdout or "is finished" in done.stdout


def run_command(words: list[str], folder: Path):
    """Run a command of the README in `folder`; fail if it does, or if no case below knows how."""
    match words:
        case ["pip", "install", "-e", target]:
            extras = re.fullmatch(r"\.(?:\[([\w,]+)\])?", target)[1] or ""
            known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
            assert set(extras.split(",")) - {""} <= set(known)
        case ["pytest"]:
            found = output("-m", "pytest", "--collect-only", "-q", "-n", "0", "-p", "no:cacheprovider", folder=ROOT)
            assert "tests/test_readme.py" in found
        case ["tensorboard", "--logdir", logdir]:
            assert (folder / logdir).is_dir()
            shown = output("-m", "tensorboard.main", "--logdir", logdir, "--inspect", folder=folder)
            assert "charts/SPS" in shown and "eval/return_mean" in shown
        case ["python", name, "--evaluate", checkpoint, "--render"] if name in SCRIPTS:
            # MuJoCo's windows need a display; LunarLander's opens without one
            assert (folder / checkpoint).is_file()
            train_or_evaluate(name, "--env-id", "LunarLanderContinuous-v3", "--run-dir", "lander", folder=folder)
            window = {"SDL_VIDEODRIVER": "dummy"}
            train_or_evaluate(name, "--evaluate", "lander/best.pt", "--render", folder=folder, **window)
        case [*_] if "|" in words and words[words.index("|") + 1] in ("sweeps/run_local.sh", "sweeps/run_slurm.sh"):
            cut = words.index("|")
            chosen = dict(word.split("=") for word in words[:cut] if "=" in word)
            generator, (executor, *flags) = words[len(chosen) : cut], words[cut + 1 :]
            path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])  # as in its environment
            chosen, dry = os.environ | {"PATH": path} | chosen, [executor, "--dry-run", *flags]
            jobs = subprocess.run(generator, cwd=ROOT, env=chosen, capture_output=True, text=True)
            planned = subprocess.run(dry, cwd=ROOT, input=jobs.stdout, capture_output=True, text=True)
            assert (jobs.returncode, planned.returncode) == (0, 0), jobs.stderr + planned.stderr
            assert jobs.stdout.count("_continuous.py --env-id") == planned.stdout.count("_continuous.py --env-id") > 0
        case ["python", "sweeps/tune.py", *flags]:
            searched = run("sweeps/tune.py", *flags, "--dry-run", "--flags=--no-compile", cwd=folder)
            assert searched.returncode == 0, searched.stdout + searched.stderr
        case ["python", "sweeps/report.py", *flags]:
            reported = run("sweeps/report.py", *flags, cwd=folder)
            assert reported.returncode == 0 and "report.md" in reported.stdout, reported.stdout + reported.stderr
        case ["python", name, *flags] if name in SCRIPTS and not {"|", ">", ";", "&"} & set(flags):
            train_or_evaluate(name, *flags, folder=folder)
        case ["python", "analysis_refinement.py", "--checkpoint", pattern, *flags]:
            if "*" in pattern:  # the shell would find the runs of a sweep
                name = pattern.split("/")[1].replace("*", "__")
                shutil.copytree(folder / "runs" / "hopper", folder / "runs" / name)
                (pattern,) = folder.glob(pattern)
            flags = "--checkpoint", pattern, *flags
            analysed = run("analysis_refinement.py", *flags, "--num-states", 100, "--episodes", 2, cwd=folder)
            assert analysed.returncode == 0, analysed.stdout + analysed.stderr
        case _:
            pytest.fail(f"no test runs the README's command: {shlex.join(words)}")


@pytest.mark.slow
def test_every_command_and_snippet(tmp_path):
    ran = []
    (tmp_path / "sweeps/results").mkdir(parents=True)
    (tmp_path / "sweeps/results/policies").symlink_to(ROOT / "sweeps/results/policies")
    for language, content in blocks(readme()):
        if language == "python":
            assert output("-c", content, folder=tmp_path).strip()
            ran.append("snippet")
        for words in commands(content) if language in ("bash", "sh", "console") else []:
            run_command(words, tmp_path)
            ran.append(words[0])
    for command in table_commands(readme()):
        run_command(shlex.split(command), tmp_path)
        ran.append(command.split("/")[-1].split()[0])
    assert {"pip", "python", "pytest", "tensorboard", "snippet", "run_local.sh", "tune.py", "report.py"} <= set(ran)


def test_commands_are_found_and_unknown_ones_fail(tmp_path):
    text = '```bash\npip install -e ".[test]" && pytest  # both\n\npython a.py \\\n  --flag x\n```\n\n```\nnone\n```\n'
    (bash, content), plain = blocks(text)
    assert (bash, plain) == ("bash", ("", "none\n"))
    assert commands(content) == [["pip", "install", "-e", ".[test]"], ["pytest"], ["python", "a.py", "--flag", "x"]]
    for unknown in (["curl", "example.org"], ["python", "a.py"], ["python", "ppo_continuous.py", "|", "tee", "log"]):
        with pytest.raises(pytest.fail.Exception, match="no test runs"):
            run_command(unknown, tmp_path)


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
