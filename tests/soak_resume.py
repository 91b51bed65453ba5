"""Kills random runs at random moments until the time is up, and compares each with the same run left alone.

    python tests/soak_resume.py --minutes 60 --seed 0

Script, task, settings, the number of kills, their moments and signals are drawn anew every round. It stops at the first
difference, and keeps both run folders.
"""

import logging
import os
import random
import shutil
import signal
import tempfile
import time
from pathlib import Path

import conftest  # noqa: F401  # it says where the others are
import torch
import tyro
from resume_helpers import TASKS, Run, differences, ends_with, flags, interrupt, outcome

import ppo_continuous
import refineppo_continuous

SIGNALS = (signal.SIGKILL,) * 6 + (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGHUP)


def random_settings(rng: random.Random) -> dict:
    """A small run's settings; every choice is one that resume must not depend on."""
    num_envs, num_steps = rng.choice((1, 1, 2, 3, 8, 17)), rng.choice((32, 64, 96, 200))
    batch = num_envs * num_steps
    settings = dict(env_id=rng.choice(TASKS), seed=rng.randrange(1000), num_envs=num_envs, num_steps=num_steps)
    settings |= dict(num_minibatches=rng.choice((1, 4, 8)))
    settings |= dict(total_timesteps=batch * rng.randint(4, 16) + rng.randrange(batch))
    settings |= dict(eval_interval=batch * rng.randint(2, 6), checkpoint_interval=batch * rng.choice((1, 1, 2, 3)))
    settings |= dict(save_every=batch * rng.choice((2, 100, 100)), max_episode_steps=rng.choice((30, 100, 300)))
    settings |= dict(actor_hidden=rng.choice((16, 64)), compile=rng.random() < 0.1)
    settings |= dict(target_kl=rng.choice((0.01, 1e9, 1e9, 1e9)))
    switches = "anneal_lr norm_adv clip_vloss bootstrap_truncated normalize_obs normalize_reward".split()
    return settings | {switch: rng.random() < 0.5 for switch in switches}


def main(minutes: float = 60, seed: int = 0):
    """Go on for so many minutes; the seed is of every choice but the clock."""
    torch.set_num_threads(1)
    logging.disable(logging.WARNING)  # TensorBoard tells of every purge
    end, rounds = time.time() + 60 * minutes, 0
    while time.time() < end:
        rng, folder = random.Random(f"{seed} {rounds}"), Path(tempfile.mkdtemp(prefix="soak_resume_"))
        script, settings = rng.choice((ppo_continuous, refineppo_continuous)), random_settings(rng)
        print(f"{rounds}: {script.__name__} {settings} in {folder}", flush=True)
        start = time.time()
        ends_with(0, script, flags(folder / "whole", **settings), timeout=1200)
        seconds, words = time.time() - start, flags(folder / "killed", "--resume", **settings)
        for _ in range(rng.randint(1, 10)):
            signum, by_line = rng.choice(SIGNALS), rng.random() < 0.5
            run = interrupt(rng, script, words, signum, scale=10) if by_line else Run(script, words)
            run.process.join(None if by_line else rng.uniform(0, seconds))
            if run.process.is_alive():
                os.kill(run.process.pid, signum)
            code = run.wait(1200)
            print(signum.name if code else "end", end=" ", flush=True)
            # minus the signal: it was SIGKILL, or came before the handlers were in place
            assert code in (0, 75, -signum), f"exit code {code}:\n{run.output()}"
            if code == 0:
                break
        ends_with(0, script, words, timeout=1200)
        differing = differences(outcome(folder / "whole"), outcome(folder / "killed"))
        assert not differing, f"{differing}, in the folder above"
        print("and the same", flush=True)
        shutil.rmtree(folder)
        rounds += 1


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
