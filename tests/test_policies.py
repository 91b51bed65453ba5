"""The policies that are kept in sweeps/results/policies return what the table of runs says of them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from threadpoolctl import threadpool_info

from refineppo_continuous import Args, agent_of, describe_machine, evaluate, evaluation_seeds, load_checkpoint

RESULTS = ROOT / "sweeps/results"
POLICIES = sorted(RESULTS.glob("policies/*.pt"))


@pytest.mark.slow
@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.stem)
def test_a_kept_policy_returns_what_the_table_says(path):
    """Digit for digit with the table's processor and versions; elsewhere most episodes are within the spread of those.

    The median, since in one episode of many a policy may fall by how a number is rounded.
    """
    runs = pd.read_csv(RESULTS / "benchmark/runs.csv", dtype=str, keep_default_na=False).set_index("run")
    checkpoint = load_checkpoint(path)
    args = Args(**checkpoint["args"])
    row = runs.loc[Path(args.run_dir).name]
    assert (row.task, row.method, row.depth, row.schedule, row.seed) == (path.stem, "RefinePPO", "4", "average", "1")
    assert checkpoint["global_step"] == int(row.best_global_step)
    returns, _ = evaluate(agent_of(checkpoint, args), evaluation_seeds(args, checkpoint["global_step"], final=True))
    machine = describe_machine()
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    kernels = {library.get("architecture") for library in threadpool_info()} - {None}
    trained_here = machine["cpu"].startswith(row.cpu) and kernels == {"SkylakeX"}  # OpenBLAS's, with AVX-512
    if trained_here and versions == row.versions:
        assert " ".join(map(repr, returns.tolist())) == row.best_returns
    else:
        assert abs(np.median(returns) - np.median([*map(float, row.best_returns.split())])) <= 3 * float(row.best_std)
