"""Every command and every Python snippet of the README is run, in the README's order, with fewer steps."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest
from conftest import ROOT, run
from test_commands import QUICK

import analysis_refinement
import ppo_continuous
import refineppo_continuous

SCRIPTS = {f"{module.__name__}.py": module for module in (ppo_continuous, refineppo_continuous)}


def readme() -> str:
    return (ROOT / "README.md").read_text()


def blocks(text: str) -> list[tuple[str, str]]:
    """The (language, content) of every fenced block."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def commands(block: str) -> list[list[str]]:
    """The words of every command, also of those joined by &&."""
    lines = block.replace("\\\n", " ").replace("&&", "\n").splitlines()
    return [words for words in (shlex.split(line, comments=True) for line in lines) if words]


def python(*words, folder: Path) -> str:
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    done = subprocess.run([sys.executable, *words], cwd=folder, env=os.environ | {"PYTHONPATH": paths},
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def train_or_evaluate(name: str, *flags, folder: Path, **env):
    """Run the command line as it stands, and flags that make it short: of a flag given twice the last one counts."""
    done = run(name, *flags, *QUICK, cwd=folder, **env)
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
            found = python("-m", "pytest", "--collect-only", "-q", "-n", "0", "-p", "no:cacheprovider", folder=ROOT)
            assert "tests/test_readme.py" in found
        case ["tensorboard", "--logdir", logdir]:
            assert (folder / logdir).is_dir()
            shown = python("-m", "tensorboard.main", "--logdir", logdir, "--inspect", folder=folder)
            assert "charts/SPS" in shown and "eval/return_mean" in shown
        case ["python", name, "--evaluate", checkpoint, "--render"] if name in SCRIPTS:
            # MuJoCo's windows need a display; LunarLander's opens without one
            assert (folder / checkpoint).is_file()
            train_or_evaluate(name, "--env-id", "LunarLanderContinuous-v3", "--run-dir", "lander", folder=folder)
            window = {"SDL_VIDEODRIVER": "dummy"}
            train_or_evaluate(name, "--evaluate", "lander/best.pt", "--render", folder=folder, **window)
        case ["python", name, *flags] if name in SCRIPTS and not {"|", ">", ";", "&"} & set(flags):
            train_or_evaluate(name, *flags, folder=folder)
        case ["python", "analysis_refinement.py", *flags]:
            analysed = run("analysis_refinement.py", *flags, "--num-states", 100, "--episodes", 2, cwd=folder)
            assert analysed.returncode == 0, analysed.stdout + analysed.stderr
        case _:
            pytest.fail(f"no test runs the README's command: {shlex.join(words)}")


def test_every_command_and_snippet(tmp_path):
    ran = []
    for language, content in blocks(readme()):
        if language == "python":
            assert python("-c", content, folder=tmp_path).strip()
            ran.append("snippet")
        for words in commands(content) if language in ("bash", "sh", "console") else []:
            run_command(words, tmp_path)
            ran.append(words[0])
    assert {"pip", "python", "pytest", "tensorboard", "snippet"} <= set(ran)


def test_commands_are_found_and_unknown_ones_fail(tmp_path):
    text = '```bash\npip install -e ".[test]" && pytest  # both\n\npython a.py \\\n  --flag x\n```\n\n```\nnone\n```\n'
    (bash, content), plain = blocks(text)
    assert (bash, plain) == ("bash", ("", "none\n"))
    assert commands(content) == [["pip", "install", "-e", ".[test]"], ["pytest"], ["python", "a.py", "--flag", "x"]]
    for unknown in (["curl", "example.org"], ["python", "a.py"], ["python", "ppo_continuous.py", "|", "tee", "log"]):
        with pytest.raises(pytest.fail.Exception, match="no test runs"):
            run_command(unknown, tmp_path)


def test_every_flag_that_is_named_exists():
    modules = *SCRIPTS.values(), analysis_refinement
    flags = {field.name.replace("_", "-") for module in modules for field in fields(module.Args)}
    known = {f"--{prefix}{name}" for name in flags for prefix in ("", "no-")} | {"--help", "--logdir"}
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", readme()))
    assert named - known == set() and len(named) > 10
