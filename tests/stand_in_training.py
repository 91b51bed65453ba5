"""Stands in for a training script beside tune.py: it takes a second, and every step of it can be counted.

A training has STEPS steps, each a line in steps.txt; its result follows from the flags. FAULTS names what goes wrong in
which trial, as in {"trial_1": "crashes"}. Its flags are those of the script for which it stands, from a file beside it.
"""

import fcntl
import json
import math
import os
import pickle
import signal
import sys
import time
from dataclasses import asdict, make_dataclass
from pathlib import Path

import tyro

Args = make_dataclass("Args", pickle.loads(Path(__file__).with_suffix(".pickle").read_bytes()), frozen=True)


def main(args):
    signals, run_dir = [], Path(args.run_dir)
    signal.signal(signal.SIGTERM, lambda *_: signals.append(1))
    fault = json.loads(os.environ.get("FAULTS", "{}")).get(run_dir.parent.name)
    run_dir.mkdir(parents=True, exist_ok=True)
    try:
        fcntl.flock(os.open(run_dir, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fault = "another process is at work"
    if fault in ("another process is at work", "the flags are bad"):
        print(f"training.py: error: {fault}", file=sys.stderr)
        sys.exit(2)
    if (run_dir / "result.json").exists():
        sys.exit(0)
    made = run_dir / "steps.txt"
    made.touch()
    for step in range(len(made.read_text().splitlines()), int(os.environ.get("STEPS", 2))):
        time.sleep(0.05)
        if step == 1 and (fault == "crashes" or fault == "crashes once" and not (run_dir / "crashed").exists()):
            (run_dir / "crashed").touch()
            raise RuntimeError("the simulator crashed")
        with open(made, "a") as file:
            file.write(f"{step} {os.getpid()}\n")
        if signals:
            sys.exit(75)
    if fault == "not finite":
        sys.exit(3)
    value = args.seed - (math.log10(args.learning_rate) + 3) ** 2
    result = {"train_return_last10pct": None if fault == "no episode" else value, "sps": 1000, "flags": asdict(args)}
    if fault != "exits":
        (run_dir / "result.json").write_text(json.dumps(result))


if __name__ == "__main__":
    main(tyro.cli(Args))
