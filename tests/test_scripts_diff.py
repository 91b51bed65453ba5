"""The two training scripts are one file with two actors: outside of what the method needs, they agree line by line."""

import ast
import difflib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PPO, REFINEPPO = ((ROOT / f"{name}_continuous.py").read_text() for name in ("ppo", "refineppo"))
ACTOR = {"refinement_coefficients", "Actor", "refinement_scalars"}


def own_statements(source: str) -> list[ast.stmt]:
    """The statements in which a script may differ from the other."""
    module = ast.parse(source)
    named = {statement.name: statement for statement in module.body if hasattr(statement, "name")}
    flags, docstrings = named["Args"].body, named["Args"].body[1:]

    def is_flag(statement):
        return isinstance(statement, ast.AnnAssign) and statement.target.id.startswith("refinement_")

    def text_of(function):
        return [(ast.unparse(s), s) for s in ast.walk(named[function]) if isinstance(s, ast.Assign | ast.AugAssign)]

    return [
        module.body[0],  # the docstring
        *(s for s in module.body if ast.unparse(s) == "from typing import Literal"),
        *(s for pair in zip(flags, docstrings) if is_flag(pair[0]) for s in pair),
        *(s for text, s in text_of("check_args") if text == "counts += ' refinement_depth'"),
        *(named[name] for name in ACTOR & named.keys()),
        *(s for text, s in text_of("main") if text.startswith("low, high =") or "refinement_scalars(" in text),
    ]


def common_lines(source: str) -> list[str]:
    """A script without the statements that are its own, the comments above them, and blank lines."""
    lines = source.splitlines()
    for statement in own_statements(source):
        first = statement.lineno - 1
        while lines[first - 1].strip().startswith("#") and not lines[first - 1].startswith("# ---"):
            first -= 1
        lines[first : statement.end_lineno] = [""] * (statement.end_lineno - first)
    return [line for line in lines if line.strip()]


def difference(ppo: str, refineppo: str) -> str:
    diff = difflib.unified_diff(common_lines(ppo), common_lines(refineppo), "PPO", "RefinePPO", lineterm="", n=0)
    return "\n".join(diff)


def test_scripts_differ_only_where_the_method_does():
    offending = difference(PPO, REFINEPPO)
    assert not offending, f"lines that must be the same in both scripts:\n{offending}"


@pytest.mark.parametrize(
    "text, changed, allowed",
    [
        ("import json\n", "import json\nimport csv\n", False),
        ("gamma: float = 0.99", "gamma: float = 0.98", False),
        ("discount factor", "discount", False),
        ("# --- Normaliser", "# --- Normalizer", False),
        ("def gae(", "def advantages(", False),
        ("refinement_depth: int = 4", "refinement_depth: int = 8", True),
        ("def proposals(", "def all_proposals(", True),
    ],
)
def test_difference_is_noticed(text, changed, allowed):
    assert text in REFINEPPO
    before, after = difference(PPO, REFINEPPO), difference(PPO, REFINEPPO.replace(text, changed))
    assert (before == after) == allowed


@pytest.mark.parametrize("source, other", [(PPO, "refineppo_continuous"), (REFINEPPO, "ppo_continuous")])
def test_neither_script_imports_the_other(source, other):
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {node.module}
        elif isinstance(node, ast.Constant):  # import_module("...")
            names |= {node.value}
    assert other not in names
