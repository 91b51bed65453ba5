"""Flags of the training scripts, as settings files and as words of a command, which the scripts' own parser reads."""

import io
import shlex
import sys
from contextlib import redirect_stderr
from importlib import import_module
from pathlib import Path

import tyro
from common import ROOT


def default_args(algorithm: str):
    """The script's flags (`Args`) where nothing is given; imports the script, which takes two seconds."""
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    return import_module(f"{algorithm}_continuous").Args()


def parse(text: str, default):
    """Flags as in a settings file (`#` begins a comment) on top of `default`; ValueError says what is wrong."""
    words, said = shlex.split(text, comments=True), io.StringIO()
    try:
        with redirect_stderr(said):
            return tyro.cli(type(default), args=words, default=default, add_help=False)
    except SystemExit:
        raise ValueError(sentence(said.getvalue())) from None


def sentence(said: str) -> str:
    """The sentence with which a script refuses its flags: its own, or the one in the box that tyro draws."""
    own = [line.split(": error: ")[1] for line in said.splitlines() if ": error: " in line]
    boxed = [line.strip("│ ") for line in said.splitlines() if line.startswith("│")]
    rule = next((i for i, line in enumerate(boxed) if line.startswith("─")), None)
    return own[0] if own else " ".join(boxed[:rule]) or said


def words(flags: dict) -> list[str]:
    """{"num_envs": 2, "anneal_lr": False, "actor_hidden": (8, 8)} as --num-envs 2 --no-anneal-lr --actor-hidden 8 8."""
    words = []
    for name, value in flags.items():
        name = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{name}" if value else f"--no-{name}")
        else:
            values = value if isinstance(value, tuple) else [value]
            words += [f"--{name}", *(str(x).removesuffix(".0") if isinstance(x, float) else str(x) for x in values)]
    return words


def file_name(task: str) -> str:
    """A task's id as a part of file names: my_tasks:Maze-v0 as my_tasks_Maze-v0."""
    return task.replace("/", "_").replace(":", "_")


def settings_file(folder: Path, algorithm: str, task: str) -> Path:
    return folder / algorithm / f"{file_name(task)}.args"
