"""What TensorBoard draws together under Custom Scalars, as it really serves it."""

import json
import re
import subprocess
import sys
import time
import urllib.parse
import urllib.request

import pytest
from test_commands import QUICK, call_main

import refineppo_continuous


@pytest.fixture
def fetch(tmp_path):
    """A function that fetches JSON from a TensorBoard that shows the folder."""
    command = [sys.executable, "-m", "tensorboard.main", "--logdir", tmp_path, "--port", "0", "--reload_interval=1"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        address = next(re.search(r"http://\S+", line)[0] for line in process.stderr if "http://" in line)

        def fetch(path, **query):
            with urllib.request.urlopen(f"{address}data/{path}?{urllib.parse.urlencode(query)}") as answer:
                return json.load(answer)

        yield fetch
        process.terminate()
        process.communicate()


def test_custom_scalars(script, tmp_path, fetch):
    """Beside the returns, a chart for each refinement quantity, with its K lines."""
    expected = {"return": {"eval/return_mean", "charts/episodic_return"}}
    flags = (*QUICK, "--env-id", "probe_envs:Counter-v0", "--run-dir", tmp_path / "a run")
    if script is refineppo_continuous:
        flags += ("--refinement-depth", 11)
        for name in ("correction_norm", "settling_error", "outside_bounds"):
            expected[name] = {f"refinement/{name}_{k}" for k in range(1, 12)}
    call_main(script, *flags)
    for _ in range(600):
        if "final/last_mean" in fetch("plugin/scalars/tags").get("a run", {}):  # it is written last
            break
        time.sleep(0.1)
    served = {}
    for chart in fetch("plugin/custom_scalars/layout")["category"][0]["chart"]:
        answers = [fetch("plugin/custom_scalars/scalars", run="a run", tag=tag) for tag in chart["multiline"]["tag"]]
        assert all(answer["regex_valid"] and all(answer["tag_to_events"].values()) for answer in answers)
        served[chart["title"]] = set().union(*(answer["tag_to_events"] for answer in answers))
    assert served == expected
