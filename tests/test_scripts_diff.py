"""The two training scripts are one file with two actors. `refinement.diff` holds all in which they differ, under the
name of the function or class in which it stands: the paper on one page. A change there is to be seen in review.

    python tests/test_scripts_diff.py       writes the page anew
"""

import ast
import difflib

from conftest import ROOT, imports

PAGE = ROOT / "tests" / "refinement.diff"
PPO, REFINEPPO = ((ROOT / f"{name}_continuous.py").read_text() for name in ("ppo", "refineppo"))


def lines_and_names(source: str) -> list[tuple[str, str]]:
    """The lines of a script that are not blank, and the name of the innermost function or class of each."""
    lines = source.splitlines()
    names = [""] * len(lines)
    for node in ast.walk(ast.parse(source)):  # outer ones come first
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)]) - 1
            name = f"{names[first]}.{node.name}".removeprefix(".")
            names[first : node.end_lineno] = [name] * (node.end_lineno - first)
    return [(line, name or "the module") for line, name in zip(lines, names) if line.strip()]


def page(ppo: str = PPO, refineppo: str = REFINEPPO) -> str:
    """The lines that only one of the scripts has, `-` PPO and `+` RefinePPO, under the names of where they stand."""
    old, new, changed = lines_and_names(ppo), lines_and_names(refineppo), {}
    matcher = difflib.SequenceMatcher(None, [line for line, _ in old], [line for line, _ in new], autojunk=False)
    for tag, a, a_end, b, b_end in matcher.get_opcodes():
        if tag != "equal":
            for sign, part in (("-", old[a:a_end]), ("+", new[b:b_end])):
                for line, name in part:
                    changed.setdefault(name, []).append(f"{sign}{line}\n")
    parts = [f"\n# {name}\n{''.join(lines)}" for name, lines in changed.items()]
    return "".join(["--- ppo_continuous.py\n+++ refineppo_continuous.py\n", *parts])


def test_scripts_differ_as_the_page_says():
    pages = PAGE.read_text().splitlines(), page().splitlines()
    difference = "\n".join(difflib.unified_diff(*pages, "the page", "the scripts", lineterm="", n=0))
    assert not difference, (
        "the scripts do not differ as tests/refinement.diff says. If they are to, write the page anew with\n"
        f"    python tests/test_scripts_diff.py\nIf not, make them the same where they differ:\n{difference}"
    )


def test_page_by_hand():
    old = "# a\nimport a\n\n\nclass A:\n    x = 1\n\n    def f(self):\n        return 2\n\n\nprint(1)\n"
    new = "# b\nimport a\n\nclass A:\n    x = 3\n\n    @property\n    def f(self):\n\n        return 4\n\nprint(1)\n"
    assert page(old, new).splitlines()[2:] == [
        *("", "# the module", "-# a", "+# b"),
        *("", "# A", "-    x = 1", "+    x = 3"),
        *("", "# A.f", "+    @property", "-        return 2", "+        return 4"),
    ]


def test_neither_script_imports_the_other():
    for source, other in ((PPO, "refineppo_continuous"), (REFINEPPO, "ppo_continuous")):
        constants = {node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant)}
        assert other not in imports(source) | constants  # import_module("...")


if __name__ == "__main__":
    PAGE.write_text(page())
    print(f"wrote {PAGE}")
