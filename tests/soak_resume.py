"""Kills random runs at random moments until the time is up, and compares each with the same run left alone.

    python tests/soak_resume.py --minutes 60 --seed 0

Script, task, settings, the number of kills, their moments and signals are drawn anew every round. It stops at the first
difference, keeps both run folders, and says where they are.
"""

import argparse
import logging
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent.parent), str(Path(__file__).parent)]

import torch  # noqa: E402
from resume_helpers import SCRIPTS, TASKS, Run, differences, finish, flags, outcome, send  # noqa: E402

import ppo_continuous  # noqa: E402, F401  (every run is a fork of this process and needs the same imports)

PLACES = {  # pieces of the scripts' lines, and how often a process may execute one before it is interrupted
    "training = run.begin_or_resume()": 1,
    "self.actions[i].append(": 2000,
    "torch.from_numpy(rollout.obs)": 8,
    "update_function(agent.params": 100,
    "add_scalar(": 200,
    "lengths[i] += 1": 2000,
    "torch.save(state": 20,
    "os.fsync(": 30,
    "os.replace(": 30,
}
SIGNALS = (signal.SIGKILL,) * 6 + (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGHUP)


def random_settings(rng: random.Random) -> dict:
    """A small run's settings; every choice is one that resume must not depend on."""
    num_envs, num_steps = rng.choice((1, 1, 2, 3, 8, 17)), rng.choice((32, 64, 96, 200))
    iterations = rng.randint(4, 16)
    batch = num_envs * num_steps
    settings = {
        "env_id": rng.choice(TASKS),
        "seed": rng.randrange(1000),
        "num_envs": num_envs,
        "num_steps": num_steps,
        "num_minibatches": rng.choice((1, 4, 8)),
        "total_timesteps": batch * iterations + rng.randrange(batch),
        "eval_interval": batch * rng.randint(2, 6),
        "checkpoint_interval": batch * rng.choice((1, 1, 2, 3)),
        "max_episode_steps": rng.choice((30, 100, 300)),
        "actor_hidden": rng.choice((16, 64)),
        "compile": rng.random() < 0.1,
    }
    switches = "anneal_lr norm_adv clip_vloss bootstrap_truncated normalize_obs normalize_reward".split()
    settings |= {switch: rng.random() < 0.5 for switch in switches}
    settings |= {"target_kl": 0.01} if rng.random() < 0.2 else {}
    return settings | ({"save_every": batch * 2} if rng.random() < 0.3 else {})


def interrupt(rng: random.Random, script: str, words: list, log: Path, seconds: float) -> str:
    """Start the run and interrupt it, by line or by the clock; the signal's name, or "end" if the run was faster."""
    signum = rng.choice(SIGNALS)
    if rng.random() < 0.5:
        place = rng.choice(list(PLACES))
        n = int(PLACES[place] ** rng.random())  # as often among the first ten as among the first thousand
        run = Run(script, words, log, at=(place, n), action=send(signum))
    else:
        run = Run(script, words, log)
        run.process.join(rng.uniform(0, seconds))
        if run.process.is_alive():
            os.kill(run.process.pid, signum)
    code = run.wait(1200)
    if code not in (0, 75, -signum):  # minus the signal: it was SIGKILL, or came before the handlers were in place
        raise SystemExit(f"exit code {code} after {signum.name}:\n{run.output()}")
    return signum.name if code else "end"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60, help="how long to go on")
    parser.add_argument("--seed", type=int, default=0, help="seed of every choice but the clock")
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.disable(logging.WARNING)  # TensorBoard tells of every purge
    folder = Path(tempfile.mkdtemp(prefix="soak_resume_"))
    end, rounds, interrupts = time.time() + 60 * options.minutes, 0, Counter()
    while time.time() < end:
        rng = random.Random(f"{options.seed} {rounds}")
        script, settings = rng.choice(SCRIPTS), random_settings(rng)
        start = time.time()
        finish(script, flags(folder / "whole", **settings), folder / "whole.log")
        seconds, words, ends = time.time() - start, flags(folder / "killed", "--resume", **settings), []
        for _ in range(rng.randint(1, 10)):
            ends.append(interrupt(rng, script, words, folder / "killed.log", seconds))
            if ends[-1] == "end":
                break
        last = Run(script, words, folder / "killed.log")
        if last.wait(1200):
            raise SystemExit(f"{script} {settings} could not be continued:\n{last.output()}\nfolders kept: {folder}")
        differing = differences(outcome(folder / "whole"), outcome(folder / "killed"))
        verdict = f"DIFFERENT in {differing}" if differing else "same"
        rounds, interrupts = rounds + 1, interrupts + Counter(ends)
        details = f"{settings['num_envs']} x {settings['num_steps']}{', compiled' if settings['compile'] else ''}"
        print(f"{rounds}: {script} {settings['env_id']} {details}: {' '.join(ends)}: {verdict}", flush=True)
        if differing:
            raise SystemExit(f"{settings}\nfolders kept: {folder}")
        shutil.rmtree(folder / "whole")
        shutil.rmtree(folder / "killed")
    shutil.rmtree(folder)
    print(f"{rounds} rounds, all the same after {dict(interrupts)}")


if __name__ == "__main__":
    main()
