"""The two training scripts are one file with two actors. `refinement.diff` holds all in which they differ, under the
name of the function or class in which it stands: the paper on one page. A change there is to be seen in review.

    python tests/test_scripts_diff.py       writes the page anew
"""

import ast
import difflib
from pathlib import Path

import pytest
from conftest import imports

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "tests" / "refinement.diff"
PPO, REFINEPPO = ((ROOT / f"{name}_continuous.py").read_text() for name in ("ppo", "refineppo"))


def lines_and_names(source: str) -> tuple[list[str], list[str]]:
    """The lines of a script that are not blank, and the name of the innermost function or class of each."""
    lines = source.splitlines()
    names = ["the module"] * len(lines)

    def name_inside(node: ast.AST, outer: str):
        for child in ast.iter_child_nodes(node):
            name = outer
            if isinstance(child, ast.ClassDef | ast.FunctionDef):
                name = f"{outer}.{child.name}" if outer else child.name
                first = min([child.lineno, *(decorator.lineno for decorator in child.decorator_list)])
                names[first - 1 : child.end_lineno] = [name] * (child.end_lineno - first + 1)
            name_inside(child, name)

    name_inside(ast.parse(source), "")
    kept = [i for i, line in enumerate(lines) if line.strip()]
    return [lines[i] for i in kept], [names[i] for i in kept]


def page(ppo: str = PPO, refineppo: str = REFINEPPO) -> str:
    """The lines that only one of the scripts has, `-` PPO and `+` RefinePPO, under the names of where they stand."""
    (old, old_names), (new, new_names) = lines_and_names(ppo), lines_and_names(refineppo)
    changed = {}
    for tag, a, a_end, b, b_end in difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes():
        if tag != "equal":
            for name, line in zip(old_names[a:a_end], old[a:a_end]):
                changed.setdefault(name, []).append(f"-{line}\n")
            for name, line in zip(new_names[b:b_end], new[b:b_end]):
                changed.setdefault(name, []).append(f"+{line}\n")
    parts = [f"\n# {name}\n{''.join(lines)}" for name, lines in changed.items()]
    return "".join(["--- ppo_continuous.py\n+++ refineppo_continuous.py\n", *parts])


def test_scripts_differ_as_the_page_says():
    pages = PAGE.read_text().splitlines(), page().splitlines()
    difference = "\n".join(difflib.unified_diff(*pages, "the page", "the scripts", lineterm="", n=0))
    assert not difference, (
        "the scripts do not differ as tests/refinement.diff says. If they are to, write the page anew with\n"
        f"    python tests/test_scripts_diff.py\nIf not, make them the same where they differ:\n{difference}"
    )


@pytest.mark.parametrize(
    "text, changed",
    [
        ("import json\n", "import json\nimport csv\n"),
        ("gamma: float = 0.99", "gamma: float = 0.98"),
        ("discount factor", "discount"),
        ("# --- Rollout", "# --- A rollout"),
        ("def gae(", "def advantages("),
    ],
)
def test_a_change_in_one_script_alone_is_noticed(text, changed):
    assert text in PPO and text in REFINEPPO
    assert page(refineppo=REFINEPPO.replace(text, changed)) != page() != page(ppo=PPO.replace(text, changed))
    in_both = page(PPO.replace(text, changed), REFINEPPO.replace(text, changed))
    assert in_both == page()


def test_page_by_hand():
    ppo = "import a\n\n\nclass A:\n    x = 1\n\n    def f(self):\n        return 2\n\n\nprint(1)\n"
    refineppo = (
        "import a\n\n\nclass A:\n    x = 3\n\n    @property\n    def f(self):\n\n        return 4\n\n\nprint(1)\n"
    )
    assert page(ppo, refineppo).splitlines()[2:] == [
        *("", "# A", "-    x = 1", "+    x = 3"),
        *("", "# A.f", "+    @property", "-        return 2", "+        return 4"),
    ]


@pytest.mark.parametrize("source, other", [(PPO, "refineppo_continuous"), (REFINEPPO, "ppo_continuous")])
def test_neither_script_imports_the_other(source, other):
    constants = {node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant)}
    assert other not in imports(source) | constants  # import_module("...")


if __name__ == "__main__":
    PAGE.write_text(page())
    print(f"wrote {PAGE}")
