"""What TensorBoard is told to draw together, read back from the event file, and what it really serves."""

import json
import re
import subprocess
import sys
import time
import urllib.parse
import urllib.request

import pytest
from tensorboard.plugins.custom_scalar import layout_pb2
from test_commands import QUICK, call_main, read_events

import refineppo_continuous

FLAGS = (*QUICK, "--env-id", "probe_envs:Counter-v0", "--no-progress")


def expected_charts(script, depth: int) -> dict[str, set[str]]:
    charts = {"return": {"eval/return_mean", "charts/episodic_return"}}
    if script is refineppo_continuous:
        for name in ("correction_norm", "settling_error", "outside_bounds"):
            charts[name] = {f"refinement/{name}_{k}" for k in range(1, depth + 1)}
    return charts


@pytest.mark.parametrize("depth", [1, 4, 11])
def test_layout_in_the_event_file(script, tmp_path, depth):
    depth_flags = ("--refinement-depth", depth) if script is refineppo_continuous else ()
    call_main(script, *FLAGS, *depth_flags, "--run-dir", tmp_path)
    events = read_events(tmp_path)
    (event,) = events.Tensors("custom_scalars__config__")
    (category,) = layout_pb2.Layout.FromString(event.tensor_proto.string_val[0]).category
    drawn = {}
    for chart in category.chart:
        regexes = [re.compile(regex) for regex in chart.multiline.tag]
        drawn[chart.title] = {tag for tag in events.Tags()["scalars"] if any(regex.match(tag) for regex in regexes)}
    assert drawn == expected_charts(script, depth)


@pytest.fixture
def tensorboard():
    """Start TensorBoard on a folder; a function that fetches JSON from it."""
    processes = []

    def start(logdir):
        command = [
            sys.executable,
            "-m",
            "tensorboard.main",
            "--logdir",
            str(logdir),
            "--port",
            "0",
            "--reload_interval=1",
        ]
        processes.append(subprocess.Popen(command, stderr=subprocess.PIPE, text=True))
        address = next(re.search(r"http://\S+", line)[0] for line in processes[0].stderr if "http://" in line)

        def fetch(path, **query):
            with urllib.request.urlopen(f"{address}data/{path}?{urllib.parse.urlencode(query)}") as answer:
                return json.load(answer)

        return fetch

    yield start
    for process in processes:
        process.terminate()
        process.communicate()


@pytest.mark.slow
def test_what_tensorboard_serves(tmp_path, tensorboard):
    call_main(refineppo_continuous, *FLAGS, "--run-dir", tmp_path / "a run")
    fetch = tensorboard(tmp_path)
    for _ in range(600):
        if fetch("runs") == ["a run"] and (layout := fetch("plugin/custom_scalars/layout")):
            break
        time.sleep(0.1)
    served = {}
    for chart in layout["category"][0]["chart"]:
        answers = [fetch("plugin/custom_scalars/scalars", run="a run", tag=tag) for tag in chart["multiline"]["tag"]]
        assert all(answer["regex_valid"] for answer in answers)
        served[chart["title"]] = set().union(*(answer["tag_to_events"] for answer in answers))
        assert all(points for answer in answers for points in answer["tag_to_events"].values())
    assert served == expected_charts(refineppo_continuous, 4)
