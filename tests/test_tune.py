"""The hyperparameter search: its space and first trials, workers that share a study, and die, and what they leave.

Most of it runs `sweeps/tune.py` beside a stand-in for the training scripts, which takes a second and lets every step be
counted; real trainings come last. The tests on PostgreSQL need the URL of an empty database in REFINEPPO_TEST_POSTGRES.
"""

import csv
import fcntl
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import optuna
import pytest
import tyro
from conftest import ROOT

import refineppo_continuous
from sweeps import tune

pytestmark = pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
POSTGRES = os.environ.get("REFINEPPO_TEST_POSTGRES")
TASKS = """
    Ant-v5 HalfCheetah-v5 Hopper-v5 Walker2d-v5 Swimmer-v5 Pusher-v5 Reacher-v5 HumanoidStandup-v5 Humanoid-v5
    Pendulum-v1 MountainCarContinuous-v0 LunarLanderContinuous-v3 BipedalWalker-v3 BipedalWalkerHardcore-v3
""".split()
TRAINING = '''
"""A training of STEPS steps, each a line in steps.txt. The result follows from the flags; FAULTS is what goes wrong."""
import fcntl, json, math, os, signal, sys, time
from pathlib import Path

words, flags = sys.argv[1:], {}
while words:
    name = words.pop(0).removeprefix("--")
    flags[name] = words.pop(0) if words and not words[0].startswith("--") else True

def refuse(sentence):
    print(f"training.py: error: {sentence}", file=sys.stderr)
    sys.exit(2)

if flags["env-id"] == "Unknown-v0":
    refuse("cannot make the task Unknown-v0")
signals = []
signal.signal(signal.SIGTERM, lambda *_: signals.append(1))
run_dir = Path(flags["run-dir"])
run_dir.mkdir(parents=True, exist_ok=True)
try:
    fcntl.flock(os.open(run_dir, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
except BlockingIOError:
    refuse(f"another process is at work in {run_dir}")
if (run_dir / "result.json").exists():
    sys.exit(0)
steps = run_dir / "steps.txt"
fault = json.loads(os.environ.get("FAULTS", "{}")).get(run_dir.parent.name)
for step in range(len(steps.read_text().splitlines()) if steps.exists() else 0, int(os.environ.get("STEPS", 2))):
    time.sleep(0.05)
    if step == 1 and (fault == "crashes" or fault == "crashes once" and not (run_dir / "crashed").exists()):
        (run_dir / "crashed").touch()
        raise RuntimeError("the simulator crashed")
    if fault == "refused":
        refuse("the flags are bad")
    with open(steps, "a") as file:
        file.write(f"{step} {os.getpid()}\\n")
    if signals:
        sys.exit(75)
if fault == "not finite":
    sys.exit(3)
value = int(flags.get("seed", 0)) - (math.log10(float(flags["learning-rate"])) + 3) ** 2
result = {"train_return_last10pct": None if fault == "no episode" else value, "sps": 1000, "flags": flags}
(run_dir / "result.json").write_text(json.dumps(result))
'''


def flags_of(row: dict) -> dict:
    """The flags in a row of trials.csv, as values."""
    names = [*tune.DEFAULT, *tune.REFINEMENT]
    kinds = {**tune.DEFAULT, **tune.DEFAULT_REFINEMENT}
    read = {bool: lambda text: text == "True", int: int, float: float, str: str}
    return {name: read[type(kinds[name])](row[name]) for name in names if name in row}


def counted(rows: list[dict]) -> list[dict]:
    return [row for row in rows if row["state"] in ("finished", "failed")]


class Place:
    """A copy of the tuner beside stand-ins for the training scripts, and a folder to work in."""

    def __init__(self, path: Path):
        self.path, self.workers = path, []
        (path / "sweeps").mkdir()
        shutil.copy(ROOT / "sweeps" / "tune.py", path / "sweeps")
        for name in ("ppo_continuous.py", "refineppo_continuous.py"):
            (path / name).write_text(TRAINING)

    def begin(self, *flags, **env) -> subprocess.Popen:
        """A worker in the background."""
        given = {"--algorithm": "ppo", "--env-id": "HalfCheetah-v5", "--trials": 3, "--seeds": 1, "--steps": 5000}
        given |= dict(zip(flags[::2], flags[1::2]))
        command = [sys.executable, "sweeps/tune.py", *(str(word) for pair in given.items() for word in pair)]
        worker = subprocess.Popen(command, cwd=self.path, env=os.environ | env, text=True,
                                  stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # fmt: skip
        self.workers.append(worker)
        return worker

    def end(self, worker: subprocess.Popen) -> tuple[int, str, str]:
        output, errors = worker.communicate(timeout=300)
        return worker.returncode, output, errors

    def tune(self, *flags, **env) -> str:
        """What a worker says that comes to a good end."""
        code, output, errors = self.end(self.begin(*flags, **env))
        assert (code, errors) == (0, ""), output + errors
        return output

    def rows(self, study: str = "HalfCheetah-v5__ppo") -> list[dict]:
        with open(self.path / "runs" / "tune" / study / "trials.csv", newline="") as file:
            return list(csv.DictReader(file))

    def steps(self, folder: str = "trial_*") -> dict[str, list[tuple[int, int]]]:
        """(step, process) of each run."""
        found = (self.path / "runs" / "tune").glob(f"*/{folder}/seed_*/steps.txt")
        return {str(path.parent): [tuple(map(int, line.split())) for line in path.read_text().splitlines()]
                for path in found}  # fmt: skip

    def wait_for_steps(self, count: int, folder: str = "trial_*") -> int:
        """Wait until a training has made some steps; its process."""
        limit = time.time() + 120
        while time.time() < limit:
            for steps in self.steps(folder).values():
                if len(steps) >= count:
                    return steps[-1][1]
            time.sleep(0.02)
        raise AssertionError("no training got that far")


@pytest.fixture
def place(tmp_path):
    place = Place(tmp_path)
    yield place
    for worker in place.workers:
        worker.kill()
        worker.communicate()


def worker_of(folder: str, workers: list[subprocess.Popen]) -> subprocess.Popen:
    """The worker whose training runs in a folder."""
    for worker in workers:
        for child in Path(f"/proc/{worker.pid}/task/{worker.pid}/children").read_text().split():
            if folder in Path(f"/proc/{child}/cmdline").read_text():
                return worker
    raise AssertionError(f"nobody trains in {folder}")


def check_books(place: Place, rows: list[dict], trials: int, steps: int):
    """As many settings count as were asked for, each once, and no run lost a step or made one twice."""
    assert len(counted(rows)) == trials
    assert len({row["folder"] for row in counted(rows)}) == trials
    assert Counter(row["source"].split()[0] for row in counted(rows))["default"] == 1
    for run, made in place.steps().items():
        assert [step for step, _ in made] == list(range(steps)), run
    assert {Path(run).parent.name for run in place.steps()} == {row["folder"] for row in counted(rows)}


def ended(process: int) -> bool:
    limit = time.time() + 60
    while time.time() < limit:
        try:
            state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except FileNotFoundError:
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


# --- The space and the first trials -----------------------------------------------------------------------------------


def test_the_default_is_that_of_the_scripts(script):
    defaults = asdict(script.Args())
    assert tune.DEFAULT == {name: defaults[name] for name in tune.DEFAULT}
    if script is refineppo_continuous:
        assert tune.DEFAULT_REFINEMENT == {name: defaults[name] for name in tune.DEFAULT_REFINEMENT}


@pytest.mark.parametrize(
    "env_id, source, changed",
    [
        ("HalfCheetah-v5", "rl-zoo3", dict(
            num_steps=512, num_minibatches=8, update_epochs=20, learning_rate=2.06e-5, anneal_lr=False, gamma=0.98,
            gae_lambda=0.92, clip_coef=0.1, ent_coef=4e-4, vf_coef=0.58, max_grad_norm=0.8, log_std_init=-2.0)),
        ("Hopper-v5", "rl-zoo3", dict(
            num_steps=512, num_minibatches=16, update_epochs=5, learning_rate=9.8e-5, anneal_lr=False, gamma=0.999,
            gae_lambda=0.99, ent_coef=2.3e-3, vf_coef=0.84, max_grad_norm=0.7, log_std_init=-2.0)),
        ("Pendulum-v1", "Baselines", dict(
            num_envs=8, anneal_lr=False, normalize_obs=False, normalize_reward=False)),
        ("BipedalWalker-v3", "rl-zoo3", dict(
            num_envs=32, num_minibatches=1024, anneal_lr=False, gamma=0.999, clip_coef=0.18)),
        ("BipedalWalkerHardcore-v3", "rl-zoo3", dict(
            num_envs=16, num_minibatches=512, learning_rate=2.5e-4, ent_coef=1e-3)),
    ],
)  # fmt: skip
def test_published_settings_are_kept_exactly(env_id, source, changed):
    default, published = tune.first_settings(env_id)
    assert default == ("default", tune.DEFAULT)
    assert published == (f"published ({source})", tune.DEFAULT | changed)


@pytest.mark.parametrize("env_id", TASKS)
def test_every_first_trial_can_be_trained(env_id, script):
    first = tune.first_settings(env_id)
    assert len(first) == 2
    for _, flags in first:
        script.check_args(script.Args(env_id=env_id, **flags))


def test_a_task_without_published_settings_has_the_default_alone():
    assert tune.first_settings("probe_envs:Counter-v0") == [("default", tune.DEFAULT)]


def test_the_sampler_learns_from_the_nearest_point():
    space = tune.SPACE | tune.REFINEMENT
    default = tune.DEFAULT | tune.DEFAULT_REFINEMENT
    assert tune.to_flags(tune.nearest_point(default, space)) == default
    walker = tune.first_settings("BipedalWalker-v3")[1][1]
    point = tune.nearest_point(walker, tune.SPACE)
    assert point == {
        "learning_rate": 3e-4, "one_minus_gamma": pytest.approx(1e-3), "one_minus_lambda": pytest.approx(0.05),
        "num_envs": 16, "rollout": 4096, "minibatch": 64, "update_epochs": 10, "clip_coef": 0.2, "entropy": False,
        "ent_coef": 1e-6, "vf_coef": 0.5, "log_std_init": 0.0,
    }  # fmt: skip
    swimmer = tune.nearest_point(tune.first_settings("Swimmer-v5")[1][1], tune.SPACE)
    assert swimmer["one_minus_gamma"] == 1e-4  # 1 - 0.9999 is a little less, and out of the space


def test_every_point_of_the_space_can_be_trained(script):
    space = tune.SPACE | (tune.REFINEMENT if script is refineppo_continuous else {})
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    found = [tune.to_flags(tune.suggest(study.ask(), space)) for _ in range(300)]
    for flags in found:
        args = script.Args(env_id="Pendulum-v1", total_timesteps=4096, **flags)
        script.check_args(args)
        assert 1e-5 <= args.learning_rate <= 3e-3 and 0.9 <= args.gamma <= 0.9999 and 0.8 <= args.gae_lambda <= 0.995
        assert args.ent_coef == 0 or 1e-6 <= args.ent_coef <= 2e-2
        assert 0.2 <= args.vf_coef <= 1
    seen = {name: {flags[name] for flags in found} for name in found[0]}
    assert seen["num_envs"] == {1, 4, 8, 16}
    assert {f["num_envs"] * f["num_steps"] for f in found} == {512, 1024, 2048, 4096}
    assert {f["num_envs"] * f["num_steps"] // f["num_minibatches"] for f in found} == {64, 128, 256, 512}
    assert 1 in seen["num_minibatches"]  # a rollout of 512 in minibatches of 512
    assert (seen["update_epochs"], seen["clip_coef"]) == ({4, 10, 20}, {0.1, 0.2, 0.3})
    assert seen["log_std_init"] == {0.0, -0.5, -1.0, -2.0}
    assert 0.0 in seen["ent_coef"] and len(seen["ent_coef"]) > 100
    if script is refineppo_continuous:
        assert seen["refinement_depth"] == {2, 4, 8}
        assert seen["refinement_schedule"] == {"average", "uniform", "inverse"}


# --- Workers ----------------------------------------------------------------------------------------------------------


def test_one_worker_searches(place):
    output = place.tune("--algorithm", "refineppo", "--trials", 14, "--seeds", 2)
    rows = place.rows("HalfCheetah-v5__refineppo")
    check_books(place, rows, trials=14, steps=2)
    assert "14 trials x 2 seeds x 5,000 steps = 140,000 environment steps" in output
    assert "train at 1,000 steps/s here" in output
    minutes = float(re.search(r"about ([\d.]+) min with one worker", output)[1])
    assert 14 * 2 * 5000 / 1000 / 60 - 0.1 < minutes < 14 * 2 * (5000 / 1000 + 20) / 60  # a start takes up to 20 s
    assert [row["source"] for row in rows] == ["default", "published (rl-zoo3)", *["sampled"] * 12]
    first = [flags | tune.DEFAULT_REFINEMENT for _, flags in tune.first_settings("HalfCheetah-v5")]
    assert [flags_of(row) for row in rows[:2]] == first
    assert len({json.dumps(flags_of(row)) for row in rows}) == 14
    for row in rows:
        for seed in (1001, 1002):
            run = place.path / "runs/tune/HalfCheetah-v5__refineppo" / row["folder"] / f"seed_{seed}"
            given = json.loads((run / "result.json").read_text())["flags"]
            words = tune.words(flags_of(row))  # every flag as in the table
            assert [given[word[2:]] for word in words if word.startswith("--")] == [
                True if following.startswith("--") else following
                for word, following in zip(words, [*words[1:], "--"])
                if word.startswith("--")
            ]
            rollout = int(given["num-envs"]) * int(given["num-steps"])
            assert int(given["total-timesteps"]) == 5000 // rollout * rollout
            expected = seed - (math.log10(float(row["learning_rate"])) + 3) ** 2
            assert float(row[f"return_{seed}"]) == pytest.approx(expected)
        assert float(row["value"]) == pytest.approx((float(row["return_1001"]) + float(row["return_1002"])) / 2)
    best = max(rows, key=lambda row: float(row["value"]))
    assert f"trial {best['number']} of 14 is best with {float(best['value']):.2f}" in output
    assert f"the default reached {float(rows[0]['value']):.2f}" in output
    lines = [line for line in output.splitlines() if line.startswith("trial ")]
    assert len(lines) == 14 and f"best {float(best['value']):.2f}" in lines[-1]

    # the winner, as the scripts read it
    text = (place.path / "runs/tune/settings/refineppo/HalfCheetah-v5.args").read_text()
    assert f"trial {best['number']}, best of 14" in text and "5000 steps, seeds 1001 1002" in text
    words = [word for line in text.splitlines() for word in line.split("#")[0].split()]
    args = asdict(tyro.cli(refineppo_continuous.Args, args=words))
    assert {name: args[name] for name in flags_of(best)} == flags_of(best)

    again = place.tune("--algorithm", "refineppo", "--trials", 14, "--seeds", 2)
    assert again.startswith("the search is over") and place.rows("HalfCheetah-v5__refineppo") == rows


def test_a_dry_run_states_the_cost_and_leaves_nothing(place):
    before = sorted(place.path.rglob("*"))
    command = [sys.executable, "sweeps/tune.py", "--algorithm", "ppo", "--env-id", "HalfCheetah-v5", "--dry-run"]
    output = subprocess.run(command, cwd=place.path, text=True, capture_output=True, check=True).stdout
    assert "30 trials x 3 seeds x 1,000,000 steps = 90,000,000 environment steps" in output
    assert "train at 1,000 steps/s here" in output and "about 25." in output  # hours
    assert sorted(place.path.rglob("*")) == before


def test_both_methods_are_searched_alike(place):
    place.tune("--trials", 6)
    place.tune("--trials", 6, "--algorithm", "refineppo")
    place.tune("--trials", 6, "--sampler-seed", 1, "--study-name", "other")
    ppo, refineppo = place.rows(), place.rows("HalfCheetah-v5__refineppo")
    shared = [{name: flags_of(row)[name] for name in tune.DEFAULT} for row in refineppo]
    assert [flags_of(row) for row in ppo] == shared  # until results lead the sampler elsewhere
    assert [flags_of(row) for row in ppo][2:] != [flags_of(row) for row in place.rows("other")][2:]


def test_a_fixed_depth_is_an_arm_of_its_own(place):
    fixed = "--algorithm", "refineppo", "--refinement-depth", 4, "--refinement-schedule", "average"
    place.tune(*fixed)
    rows = place.rows("HalfCheetah-v5__refineppo-K4-average")
    assert [(row["refinement_depth"], row["refinement_schedule"]) for row in rows] == [("4", "average")] * 3
    winner = place.path / "runs/tune/settings-K4-average/refineppo/HalfCheetah-v5.args"
    assert "--refinement-depth 4\n--refinement-schedule average\n" in winner.read_text()
    assert not (place.path / "runs/tune/settings").exists()


def test_workers_that_start_at_once_share_the_trials(place):
    workers = [place.begin("--trials", 9, STEPS="4") for _ in range(4)]
    outputs = [place.end(worker) for worker in workers]
    assert [(code, errors) for code, _, errors in outputs] == [(0, "")] * 4
    rows = place.rows()
    check_books(place, rows, trials=9, steps=4)
    assert {row["state"] for row in rows} <= {"finished", "surplus"}  # nobody was taken for dead
    assert len({row["worker"] for row in counted(rows)}) > 1
    assert len({output.splitlines()[-4] for _, output, _ in outputs}) == 1  # all name the same winner
    sources = sorted(row["source"] for row in counted(rows))
    assert sources == ["default", "published (rl-zoo3)", *["sampled"] * 7]


def test_a_surplus_trial_is_given_back(tmp_path):
    """Two workers saw room for one trial, at the same moment; and two put the same trial back."""
    args = tune.Args("ppo", "HalfCheetah-v5", trials=1, out_dir=tmp_path)
    worker = tune.Worker(args)
    worker.open_study(worker.open_storage())
    first, second = worker.study.ask(), worker.study.ask()
    with pytest.raises(tune.PutBack):
        worker.evaluate(second)
    worker.study.tell(second, state=tune.TrialState.FAIL)
    first.set_user_attr("worker", tune.WORKER)
    worker.study.tell(first, state=tune.TrialState.FAIL)
    worker.put_back()
    worker.put_back()  # changes nothing
    copy = worker.study.get_trials()[-1]
    assert (copy.number, copy.state, tune.origin(copy), copy.user_attrs) == (2, tune.TrialState.WAITING, 0, {})
    worker.study.add_trial(copy)
    assert worker.study.ask().number == 2
    with pytest.raises(tune.PutBack):
        worker.evaluate(worker.study.ask())
    states = [tune.state(trial) for trial in worker.study.get_trials()]
    assert states == ["put back", "surplus", "running", "running"]
    assert worker.study.get_trials()[3].user_attrs == {"surplus": True}
    assert tune.finished(worker.study.get_trials()) == []


def test_a_later_call_with_more_trials_continues(place):
    with_one = place.tune("--trials", 1)
    assert "trial 0 of 1 is best" in with_one
    assert (place.path / "runs/tune/settings/ppo/HalfCheetah-v5.args").read_text().count("\n--") == 0  # the default
    place.tune("--trials", 4)
    assert [row["source"] for row in place.rows()] == ["default", "published (rl-zoo3)", "sampled", "sampled"]


def test_after_kill_9_another_call_finishes(place):
    worker = place.begin(STEPS="40")
    training = place.wait_for_steps(5)
    worker.kill()
    assert ended(training)
    assert len(place.steps("trial_0").popitem()[1]) < 40  # it does not train on by itself
    output = place.tune(STEPS="40")
    rows = place.rows()
    check_books(place, rows, trials=3, steps=40)
    assert [row["state"] for row in rows] == ["put back", *["finished"] * 3]
    assert rows[1]["folder"] == "trial_0" and "the search is over" in output
    processes = {process for _, process in place.steps("trial_0").popitem()[1]}
    assert len(processes) == 2 and training in processes


def test_after_kill_9_another_worker_takes_the_trial(place):
    killed = place.begin("--trials", 2, STEPS="60")
    place.wait_for_steps(5)
    other = place.begin("--trials", 2, STEPS="60")
    place.wait_for_steps(5, "trial_1")
    killed.kill()
    code, output, errors = place.end(other)
    assert (code, errors) == (0, "")
    check_books(place, place.rows(), trials=2, steps=60)


def test_a_trial_waits_for_the_training_that_a_dead_worker_left(place):
    run = place.path / "runs/tune/HalfCheetah-v5__ppo/trial_0/seed_1001"
    run.mkdir(parents=True)
    lock = os.open(run, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    worker, log, limit = place.begin("--trials", 1), run.with_suffix(".log"), time.time() + 60
    while not (log.exists() and "another process is at work" in log.read_text()) and time.time() < limit:
        time.sleep(0.05)
    os.close(lock)
    code, _, errors = place.end(worker)
    assert (code, errors) == (0, "")
    check_books(place, place.rows(), trials=1, steps=2)


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
def test_a_signal_puts_the_trial_back(place, signum):
    worker = place.begin("--trials", 2, STEPS="40")
    training = place.wait_for_steps(5)
    worker.send_signal(signum)
    code, output, errors = place.end(worker)
    assert (code, errors) == (75, "")
    assert f"stopped by {signal.Signals(signum).name}; the same command continues the search" in output
    assert ended(training)
    place.tune("--trials", 2, STEPS="40")
    rows = place.rows()
    check_books(place, rows, trials=2, steps=40)
    assert [row["state"] for row in rows].count("put back") == 1


def test_what_goes_wrong_is_counted_and_said(place):
    faults = {"trial_0": "no episode", "trial_1": "crashes", "trial_2": "crashes once", "trial_3": "not finite"}
    output = place.tune("--trials", 5, FAULTS=json.dumps(faults))
    rows = place.rows()
    assert [row["state"] for row in rows] == ["failed", "failed", "finished", "failed", "finished"]
    assert [row["reason"] for row in rows] == [
        "no episode ended in the last 10 % of seed 1001",
        "seed 1001 crashed twice, with exit code 1: RuntimeError: the simulator crashed",
        "",
        "numerical failure with seed 1001",
        "",
    ]
    assert "5 of 5 done" in output and "the default failed" in output
    assert [step for step, _ in place.steps("trial_2").popitem()[1]] == [0, 1]


def test_a_search_in_which_all_fails_says_so(place):
    code, output, errors = place.end(place.begin("--trials", 1, FAULTS='{"trial_0": "not finite"}'))
    assert code == 1 and "no trial succeeded" in errors
    assert not (place.path / "runs/tune/settings").exists()


def test_a_refusal_during_the_search_ends_the_worker(place):
    code, output, errors = place.end(place.begin(FAULTS='{"trial_1": "refused"}'))
    assert (code, errors) == (2, "tune.py: error: the flags are bad\n")
    place.tune()
    assert [row["state"] for row in place.rows()] == ["finished", "put back", "finished", "finished"]


def test_a_trial_of_another_machine_is_left_alone(place):
    worker = place.begin("--trials", 1, STEPS="100")
    place.wait_for_steps(2)
    worker.kill()
    worker.wait()
    journal = place.path / "runs/tune/HalfCheetah-v5__ppo/journal.log"
    host = os.uname().nodename
    journal.write_text(journal.read_text().replace(f'"{host}:', '"elsewhere:'))
    output = place.tune("--trials", 1)
    assert "what is left runs on other machines, or died there: 0 (elsewhere:" in output
    assert "start one there" in output


# --- Bad input --------------------------------------------------------------------------------------------------------

BAD = [
    (("--trials", 0), "--trials must be at least 1, not 0"),
    (("--seeds", 0), "--seeds must be at least 1, not 0"),
    (("--heartbeat", 0), "--heartbeat must be at least 1, not 0"),
    (("--steps", 4000), "--steps must be at least 4096, the longest rollout among the trials, not 4000"),
    (("--steps", 65535, "--env-id", "BipedalWalker-v3"), "--steps must be at least 65536"),
    (("--refinement-depth", 4, "--algorithm", "refineppo"), "are fixed together or not at all"),
    (("--refinement-depth", 4, "--refinement-schedule", "average"), "ppo has no --refinement-depth to fix"),
    (("--env-id", "Unknown-v0"), "cannot make the task Unknown-v0"),
    (("--env-id", "Unknown-v0", "--dry-run"), "cannot make the task Unknown-v0"),
    (("--flags=--no-anneal-lr",), "--flags cannot hold --no-anneal-lr, which the search sets itself"),
    (("--flags=--run-dir=x",), "--flags cannot hold --run-dir, which the search sets itself"),
    (("--flags='--x",), "--flags cannot be read"),
    (("--out-dir", "ppo_continuous.py/out"), "cannot write to ppo_continuous.py/out"),
    (("--storage", "nonsense"), "--storage must be a database's URL"),
    (("--storage", "nonsense://x"), "cannot use the database"),
    (("--storage", "postgresql+psycopg://nobody@127.0.0.1:1/x"), "cannot use the database"),
]


@pytest.mark.parametrize("flags, sentence", BAD, ids=[" ".join(map(str, flags)) for flags, _ in BAD])
def test_bad_input_is_refused(place, flags, sentence):
    given = ["--algorithm", "ppo", "--env-id", "HalfCheetah-v5", *map(str, flags)]
    done = subprocess.run([sys.executable, "sweeps/tune.py", *given], cwd=place.path, text=True, capture_output=True)
    assert done.returncode == 2 and sentence in done.stderr
    assert done.stderr.startswith("tune.py: error: ") and done.stderr.count("\n") == 1
    assert place.steps() == {}


@pytest.mark.parametrize(
    "flags, sentence",
    [
        (("--seeds", 2), "--seeds 1"),
        (("--steps", 6000), "--steps 5000"),
        (("--flags", "x"), "--flags "),
        (("--env-id", "Ant-v5", "--steps", 40000), "--env-id HalfCheetah-v5, --steps 5000"),
        (("--algorithm", "refineppo"), "--algorithm ppo"),
    ],
)
def test_another_protocol_is_refused(place, flags, sentence):
    place.tune("--trials", 1, "--study-name", "mine")
    code, _, errors = place.end(place.begin("--trials", 1, "--study-name", "mine", *flags))
    assert code == 2
    assert errors == f"tune.py: error: the study mine was begun with other flags than these: {sentence}\n"


@pytest.mark.parametrize("damage, sentence", [(b"garbage\n" * 2, "is damaged"), (b'{"op_code":4', "half a line")])
def test_a_damaged_journal_is_refused(place, damage, sentence):
    place.tune("--trials", 1)
    with open(place.path / "runs/tune/HalfCheetah-v5__ppo/journal.log", "ab") as file:
        file.write(damage)
    code, _, errors = place.end(place.begin())
    assert code == 2 and sentence in errors and errors.count("\n") == 1


def test_without_optuna_one_sentence_says_what_to_do(tmp_path):
    (tmp_path / "optuna.py").write_text("raise ModuleNotFoundError")
    command = [sys.executable, str(ROOT / "sweeps/tune.py"), "--help"]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(tmp_path)}, text=True, capture_output=True)
    assert done.returncode == 2
    assert done.stderr == "tune.py: error: Optuna is missing: pip install -e '.[tune]'\n"


# --- PostgreSQL -------------------------------------------------------------------------------------------------------


@pytest.fixture
def database():
    """Flags for a schema of its own, empty, in the server that REFINEPPO_TEST_POSTGRES names."""
    if not POSTGRES:
        pytest.skip("no PostgreSQL: REFINEPPO_TEST_POSTGRES holds no URL of a server to test with")
    import sqlalchemy

    engine, schema = sqlalchemy.create_engine(POSTGRES), f"tune_{uuid.uuid4().hex}"
    with engine.begin() as connection:
        connection.execute(sqlalchemy.text(f"CREATE SCHEMA {schema}"))
    yield "--storage", f"{POSTGRES}?options=-csearch_path%3D{schema}", "--heartbeat", 1
    with engine.begin() as connection:
        connection.execute(sqlalchemy.text(f"DROP SCHEMA {schema} CASCADE"))
    engine.dispose()


def test_workers_share_a_database_and_take_over_from_the_dead(place, database):
    workers = [place.begin(*database, "--trials", 6, STEPS="30") for _ in range(3)]  # all make the tables at once
    place.wait_for_steps(5, "trial_0")
    killed = worker_of("trial_0", workers)
    killed.kill()
    ends = [place.end(worker) for worker in workers if worker is not killed]
    assert [(code, errors) for code, _, errors in ends] == [(0, "")] * 2
    rows = place.rows()
    check_books(place, rows, trials=6, steps=30)
    assert len({process for _, process in place.steps("trial_0").popitem()[1]}) == 2
    attempts = [row for row in rows if row["folder"] == "trial_0"]
    assert [row["state"] for row in attempts] == ["put back", "finished"]
    assert attempts[0]["worker"].endswith(f":{killed.pid}") and attempts[1]["worker"] != attempts[0]["worker"]


def test_a_worker_that_hung_loses_its_trial(place, database):
    hung = place.begin(*database, "--trials", 1, STEPS="200")
    training = place.wait_for_steps(5, "trial_0")
    hung.send_signal(signal.SIGSTOP)  # its training goes on
    code, output, errors = place.end(place.begin(*database, "--trials", 1, STEPS="200"))
    assert (code, errors) == (0, "")
    hung.send_signal(signal.SIGCONT)
    code, output, errors = place.end(hung)
    assert (code, errors) == (0, "")
    assert "another worker has taken it over" in output and "the search is over" in output
    check_books(place, place.rows(), trials=1, steps=200)
    assert {process for _, process in place.steps("trial_0").popitem()[1]} == {training}


# --- Real trainings ---------------------------------------------------------------------------------------------------


def real(path: Path, *flags) -> subprocess.Popen:
    env = os.environ | {"PYTHONPATH": str(ROOT / "tests"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(ROOT / "sweeps/tune.py"), "--seeds", "1", *map(str, flags)]
    return subprocess.Popen(command, cwd=path, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_real_trainings(tmp_path):
    """Episodes have 999 steps: with the 256 steps of 16 environments, as published, none ends."""
    worker = real(tmp_path, "--algorithm", "ppo", "--env-id", "MountainCarContinuous-v0", "--trials", 2,
                  "--steps", 5000, "--flags=--no-compile")  # fmt: skip
    output, errors = worker.communicate(timeout=300)
    assert (worker.returncode, errors) == (0, ""), output
    study = tmp_path / "runs/tune/MountainCarContinuous-v0__ppo"
    with open(study / "trials.csv", newline="") as file:
        default, published = csv.DictReader(file)
    assert (default["state"], published["state"]) == ("finished", "failed")
    assert published["reason"] == "no episode ended in the last 10 % of seed 1001"
    for row in (default, published):
        config = json.loads((study / row["folder"] / "seed_1001/config.json").read_text())["args"]
        assert {name: config[name] for name in flags_of(row)} == flags_of(row)
        assert (config["seed"], config["total_timesteps"], config["compile"]) == (1001, 4096, False)
    result = json.loads((study / "trial_0/seed_1001/result.json").read_text())
    assert float(default["value"]) == result["train_return_last10pct"]


@pytest.mark.parametrize(
    "flags, sentence",
    [
        (["--env-id", "NoSuchTask-v0"], "cannot make the task NoSuchTask-v0"),
        (["--env-id", "Pendulum-v1", "--flags=--no-such-flag"], "Unrecognized options: --no-such-flag"),
    ],
)
def test_what_the_script_refuses_is_refused_before_the_search(tmp_path, flags, sentence):
    worker = real(tmp_path, "--algorithm", "ppo", *flags)
    _, errors = worker.communicate(timeout=300)
    assert worker.returncode == 2 and errors.startswith("tune.py: error: " + sentence) and errors.count("\n") == 1


def test_a_real_training_is_resumed_by_another_worker_on_a_database(tmp_path, database):
    flags = (*database, "--algorithm", "refineppo", "--env-id", "probe_envs:Counter-v0", "--trials", 2,
             "--steps", 8192, "--flags=--no-compile --checkpoint-interval 2048")  # fmt: skip
    workers = [real(tmp_path, *flags) for _ in range(2)]
    study = tmp_path / "runs/tune/probe_envs:Counter-v0__refineppo"
    log, limit = study / "trial_0/seed_1001.log", time.time() + 300
    while not (study / "trial_0/seed_1001/last.pt").exists() and time.time() < limit:
        time.sleep(0.05)
    killed = worker_of("trial_0", workers)
    killed.kill()
    killed.communicate()
    (other,) = (worker for worker in workers if worker is not killed)
    output, errors = other.communicate(timeout=300)
    assert (other.returncode, errors) == (0, "")
    with open(study / "trials.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows if row["folder"] == "trial_0"] == ["put back", "finished"]
    assert len(counted(rows)) == 2
    assert log.read_text().count("the run is in") == 1
    assert "stopped by SIGTERM" in log.read_text()
