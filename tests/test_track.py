"""--track: what Weights & Biases keeps on the disk, against TensorBoard; its failures are not the training's.

Of one script: the other has the same lines, which a test on their difference holds equal.
"""

import json
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, run, wait_until
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_commands import read_json

wandb = pytest.importorskip("wandb")

SCRIPT = "refineppo_continuous.py"
FLAGS = """
    --env-id Pendulum-v1 --num-envs 2 --num-steps 256 --num-minibatches 4 --update-epochs 1 --total-timesteps 20480
    --eval-interval 1024 --eval-episodes 2 --final-eval-episodes 2 --actor-hidden 16 --critic-hidden 16 --no-compile
    --run-dir runs/one --resume
""".split()


def records(path: Path):
    """The records of a .wandb file: LevelDB's log format after 7 bytes, in blocks of 32 KiB, of protocol buffers."""
    data, at, record = path.read_bytes(), 7, b""
    while at + 7 <= len(data):
        left = -at % 32768
        if 0 < left < 7:  # no room for a header in this block
            at += left
            continue
        length, kind = int.from_bytes(data[at + 4 : at + 6], "little"), data[at + 6]
        record = (b"" if kind in (1, 2) else record) + data[at + 7 : at + 7 + length]  # whole, first, middle, last
        at += 7 + length
        if kind in (1, 4):
            yield wandb.proto.wandb_internal_pb2.Record.FromString(record)


def in_wandb(folder: Path) -> tuple[set[str], list[int], Counter]:
    """The ids of W&B's runs, their exit codes, and how often each (tag, step, value) was logged."""
    ids, codes, scalars = set(), [], Counter()
    for path in sorted(folder.glob("wandb/offline-run-*/*.wandb")):
        for record in records(path):
            if record.HasField("run"):
                ids.add(record.run.run_id)
            if record.HasField("exit"):
                codes.append(record.exit.exit_code)
            row = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}
            scalars.update((tag, row["global_step"], np.float32(x).item()) for tag, x in row.items() if "/" in tag)
    return ids, codes, scalars


def in_tensorboard(folder: Path) -> Counter:
    events = EventAccumulator(str(folder / "runs/one"), size_guidance={"scalars": 0}).Reload()
    return Counter((tag, e.step, e.value) for tag in events.Tags()["scalars"] for e in events.Scalars(tag))


def start(folder: Path, *flags) -> subprocess.Popen:
    """A training, after two evaluations."""
    out = folder / "out"
    with out.open("w") as file:
        command = [sys.executable, ROOT / SCRIPT, *FLAGS, *flags]
        process = subprocess.Popen(command, cwd=folder, stdout=file, stderr=subprocess.STDOUT)
    wait_until(lambda: process.poll() is not None or out.read_text().count("evaluation return") >= 2, pause=0.02)
    assert process.poll() is None, out.read_text()
    return process


def stop(process: subprocess.Popen):
    process.send_signal(signal.SIGTERM)
    assert process.wait(120) == 75


@pytest.fixture(autouse=True)
def offline(monkeypatch, tmp_path):
    for name in ("WANDB_API_KEY", "WANDB_DIR", "NETRC"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("WANDB_MODE", "offline")


@pytest.mark.slow
def test_every_number_arrives_once(tmp_path):
    """Of a run that is tracked from its first resume on, and over its second one."""
    stop(start(tmp_path))
    assert not (tmp_path / "wandb").exists()
    before = in_tensorboard(tmp_path)
    stop(start(tmp_path, "--track"))
    done = run(SCRIPT, *FLAGS, "--track", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    ids, codes, scalars = in_wandb(tmp_path)
    assert len(ids) == 1 and codes == [1, 0]
    assert before and scalars == in_tensorboard(tmp_path) - before
    counts = Counter(tag for tag, _, _ in in_tensorboard(tmp_path).elements())
    assert counts["charts/episodic_return"] == 102  # 10240 steps of two environments, in episodes of 200
    assert counts["eval/return_mean"] == 20 and counts["losses/value_loss"] == 40 and counts["final/last_mean"] == 1
    assert {path.parent for path in tmp_path.rglob("*tfevents*")} == {tmp_path / "runs/one"}


def test_no_key(tmp_path):
    done = run(SCRIPT, *FLAGS, "--track", cwd=tmp_path, WANDB_MODE="online")
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert "wandb login" in line and "WANDB_MODE=offline" in line
    assert {path.name for path in tmp_path.iterdir()} <= {"home"}


@pytest.mark.slow
def test_training_outlives_wandb(tmp_path):
    process = start(tmp_path, "--track")
    subprocess.run(["pkill", "-KILL", "-P", str(process.pid), "wandb-core"], check=True)
    assert process.wait(120) == 0
    assert (tmp_path / "out").read_text().count("warning: W&B failed") == 1
    assert read_json(tmp_path / "runs/one/result.json")["last"]["global_step"] == 20480
