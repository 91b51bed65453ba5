"""Fixtures shared by all tests. The scripts are imported as modules; their commands run as a user types them."""

import ast
import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the tests themselves run in parallel
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored, and so inherited, where they run in the background
ROOT = Path(__file__).parent.parent
PATHS = [str(ROOT), str(ROOT / "tests"), str(ROOT / "sweeps")]
sys.path[:0] = PATHS

import matplotlib.image  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402
from gymnasium.spaces import Box  # noqa: E402

import ppo_continuous  # noqa: E402
import refineppo_continuous  # noqa: E402

torch.set_num_threads(1)


@pytest.fixture(params=[ppo_continuous, refineppo_continuous], ids=lambda module: module.__name__)
def script(request):
    """Each of the two training scripts, as a module."""
    return request.param


def python(*words, cwd=ROOT, timeout=600, **env) -> subprocess.CompletedProcess:
    """`python WORDS` in a process of its own, which imports what the tests do, for `module:Env-v0` ids."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join(PATHS)} | env
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, cwd=cwd, timeout=timeout, text=True, capture_output=True, env=env)


def run(name: str, *flags, **options) -> subprocess.CompletedProcess:
    """The script NAME with these flags, as `python` runs it."""
    return python(ROOT / name, *flags, **options)


def wait_until(condition, timeout=300, pause=0.05):
    end = time.time() + timeout
    while not condition():
        assert time.time() < end, "it did not happen in time"
        time.sleep(pause)


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def files_of(folder: Path) -> dict[str, bytes]:
    """Everything in a folder, at any depth; of folders nothing but their names."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


def check_picture(path: Path):
    """It opens, has a white corner, and is neither of one colour nor a dot on an empty page."""
    pixels = matplotlib.image.imread(path)[..., :3]
    assert min(pixels.shape[:2]) > 200 and (pixels[0, 0] == 1).all()
    assert (pixels.min(-1) < 0.9).mean() > 0.01 and len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20


def imports(source: str) -> set[str]:
    """The modules that a program's text imports, anywhere in it."""
    nodes = list(ast.walk(ast.parse(source)))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return names | {node.module for node in nodes if isinstance(node, ast.ImportFrom)}


def policy_mean(module, params: dict, args, obs):
    """The script's action mean (batch, action_dim) of normalised observations, in arrays or in tensors."""
    weights = module.layers(params, "actor")
    if module is ppo_continuous:
        return module.network(weights, obs)
    return module.proposals(weights, module.refinement_coefficients(args), obs)[-1]


def make_agent(module, obs_dim=3, action_dim=2, **flags):
    """A fresh agent for no task in particular, with actions within +-1."""
    return module.Agent(Box(-1, 1, (obs_dim,)), Box(-1, 1, (action_dim,)), module.Args(**flags))
