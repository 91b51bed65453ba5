"""Stands in for a training script beside tune.py: it takes a second, and every step of it can be counted.

A training has STEPS steps, each a line in steps.txt; its result follows from the flags. FAULTS names what goes wrong in
which trial, as in {"trial_1": "crashes"}.
"""

import fcntl
import json
import math
import os
import signal
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Args:
    env_id: str = "HalfCheetah-v5"
    total_timesteps: int = 6_000_000
    seed: int = 1
    run_dir: str | None = None
    resume: bool = False
    refinement_depth: int = 4
    refinement_schedule: str = "average"
    learning_rate: float = 3e-4
    anneal_lr: bool = True
    num_envs: int = 1
    num_steps: int = 2048
    num_minibatches: int = 32
    update_epochs: int = 10
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_coef: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    log_std_init: float = 0.0
    normalize_obs: bool = True
    normalize_reward: bool = True
    eval_interval: int = 100_000
    eval_episodes: int = 10
    final_eval_episodes: int = 10
    progress: bool = True


def main(args: Args):
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
