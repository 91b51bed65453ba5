"""The hyperparameter search: its space and first trials, workers that share a study, and die, and what they leave.

Most of it runs `sweeps/tune.py` beside a stand-in for the training scripts, stand_in_training.py; real trainings come
last. The tests on PostgreSQL need the URL of an empty database in REFINEPPO_TEST_POSTGRES.
"""

import csv
import fcntl
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections import Counter
from pathlib import Path

import optuna
import pytest
import space
import tune
import tyro
from conftest import ROOT
from flags import default_args

import ppo_continuous
import refineppo_continuous

pytestmark = pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
POSTGRES = os.environ.get("REFINEPPO_TEST_POSTGRES")


def flags_of(row: dict) -> dict:
    """The flags in a row of trials.csv, as values."""
    default = vars(refineppo_continuous.Args())
    read = {bool: lambda text: text == "True", int: int, float: float, str: str}
    names = [name for name in (*space.FLAGS, *space.REFINEMENT) if name in row]
    return {name: read[type(default[name])](row[name]) for name in names}


def counted(rows: list[dict]) -> list[dict]:
    return [row for row in rows if row["state"] in ("finished", "failed")]


class Place:
    """A copy of the tuner beside stand-ins for the training scripts, and a folder to work in."""

    def __init__(self, path: Path):
        self.path, self.workers = path, []
        shutil.copytree(ROOT / "sweeps", path / "sweeps", ignore=shutil.ignore_patterns("results"))
        for name in ("ppo_continuous.py", "refineppo_continuous.py"):
            shutil.copy(ROOT / "tests" / "stand_in_training.py", path / name)

    def begin(self, *flags, **env) -> subprocess.Popen:
        """A worker in the background."""
        given = {"--algorithm": "ppo", "--env-id": "HalfCheetah-v5", "--trials": 3, "--seeds": 1, "--steps": 5000}
        given |= dict(zip(flags[::2], flags[1::2]))
        command = [sys.executable, "sweeps/tune.py", *(str(word) for pair in given.items() for word in pair)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        worker = subprocess.Popen(command, cwd=self.path, env=os.environ | env, **pipes)
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
        made = {str(path.parent): path.read_text().splitlines() for path in found}
        return {run: [tuple(map(int, line.split())) for line in lines] for run, lines in made.items()}

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


DEFAULT = vars(ppo_continuous.Args())
TABLE = """
task                     envs steps batch epochs lr      lin gamma lambda clip ent    vf   norm log_std normalise
HalfCheetah-v5              1   512    64     20 2.06e-5 no  .98   .92    .1   4e-4   .58  .8   -2      yes
Hopper-v5                   1   512    32      5 9.8e-5  no  .999  .99    .2   2.3e-3 .84  .7   -2      yes
Walker2d-v5                 1   512    32     20 5.05e-5 no  .99   .95    .1   5.9e-4 .87  1     0      yes
Swimmer-v5                  4  1024   256     10 6e-4    no  .9999 .98    .2   0      .5   .5    0      yes
Ant-v5                     16  2048    64     10 1.5e-4  no  .988  .928   .2   0      .5   .5    0      yes
Reacher-v5                 16  2048    64     10 2e-4    no  .997  .97    .2   1e-3   .5   .5    0      yes
Pusher-v5                  16  2048    64     10 2e-4    no  .997  .97    .2   1e-3   .5   .5    0      yes
Humanoid-v5                 1   512   256      5 3.6e-5  no  .95   .9     .3   2.4e-3 .43  2    -2      yes
HumanoidStandup-v5          1   512    32     20 2.6e-5  no  .99   .9     .3   3.6e-6 .43  .7   -2      yes
Pendulum-v1                 8  2048   512     10 3e-4    no  .99   .95    .2   0      .5   .5    0      no
MountainCarContinuous-v0   16   256   512      4 2.5e-4  no  .99   .94    .2   0      .5   .5    0      yes
LunarLanderContinuous-v3   16  1024    64      4 3e-4    no  .999  .98    .2   .01    .5   .5    0      no
BipedalWalker-v3           32  2048    64     10 3e-4    no  .999  .95    .18  0      .5   .5    0      yes
BipedalWalkerHardcore-v3   16  2048    64     10 2.5e-4  yes .99   .95    .2   1e-3   .5   .5    0      yes
"""
NAMES = "num_envs num_steps num_minibatches update_epochs learning_rate anneal_lr gamma gae_lambda clip_coef ent_coef"
NAMES = f"{NAMES} vf_coef max_grad_norm log_std_init normalize_obs".split()


def first_settings(env_id: str) -> list[tuple[str, dict]]:
    return space.first_settings(env_id, default_args("ppo"))


@pytest.mark.parametrize("row", TABLE.strip().splitlines()[1:], ids=lambda row: row.split()[0])
def test_published_settings_are_kept_exactly(row, script):
    env_id, *values = row.split()
    values = {name: value == "yes" if value in ("yes", "no") else float(value) for name, value in zip(NAMES, values)}
    values["num_minibatches"] = values["num_envs"] * values["num_steps"] / values["num_minibatches"]
    (_, default), (_, published) = first_settings(env_id)
    assert default == {name: DEFAULT[name] for name in space.FLAGS}
    assert published == values | {"normalize_reward": values["normalize_obs"]}
    check_trainable(script.Args(env_id=env_id, **published))


def check_trainable(args):
    """A rollout has whole minibatches of more than one step."""
    assert args.batch_size % args.num_minibatches == 0 and args.batch_size > args.num_minibatches


def test_a_task_without_published_settings_has_the_default_alone():
    assert [source for source, _ in first_settings("probe_envs:Counter-v0")] == ["default"]


def test_the_sampler_learns_from_the_nearest_point():
    both, refinement = space.SPACE | space.REFINEMENT, {"refinement_depth": 4, "refinement_schedule": "average"}
    default = first_settings("")[0][1] | refinement
    assert space.to_flags(space.nearest_point(default, both), default) == default
    walker = space.nearest_point(first_settings("BipedalWalker-v3")[1][1], space.SPACE)
    assert walker.pop("one_minus_gamma") == pytest.approx(1e-3)
    assert walker.pop("one_minus_lambda") == pytest.approx(0.05)
    assert [*walker.values()] == [3e-4, 16, 4096, 64, 10, 0.2, False, 0.5, 0.0]  # published: 32 environments
    swimmer = space.nearest_point(first_settings("Swimmer-v5")[1][1], space.SPACE)
    assert swimmer["one_minus_gamma"] == 1e-4  # 1 - 0.9999 is a little less, and out of the space


def test_every_point_of_the_space_can_be_trained(script):
    searched = space.SPACE | (space.REFINEMENT if script is refineppo_continuous else {})
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    found = [space.to_flags(space.suggest(study.ask(), searched), first_settings("")[0][1]) for _ in range(300)]
    for flags in found:
        args = script.Args(env_id="Pendulum-v1", total_timesteps=4096, **flags)
        check_trainable(args)
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


@pytest.mark.slow
def test_one_worker_searches(place):
    output = place.tune("--algorithm", "refineppo", "--trials", 14, "--seeds", 2)
    rows = place.rows("HalfCheetah-v5__refineppo")
    check_books(place, rows, trials=14, steps=2)
    assert "14 trials x 2 seeds x 5,000 steps = 140,000 environment steps" in output
    assert "train at 1,000 steps/s here" in output
    minutes = float(re.search(r"about ([\d.]+) min with one worker", output)[1])
    assert 14 * 2 * 5000 / 1000 / 60 - 0.1 < minutes < 14 * 2 * (5000 / 1000 + 20) / 60  # a start takes up to 20 s
    assert [row["source"] for row in rows] == ["default", "published", *["sampled"] * 12]
    refinement = {"refinement_depth": 4, "refinement_schedule": "average"}
    first = [flags | refinement for _, flags in first_settings("HalfCheetah-v5")]
    assert [flags_of(row) for row in rows[:2]] == first
    assert len({json.dumps(flags_of(row)) for row in rows}) == 14
    for row in rows:
        for seed in (1001, 1002):
            run = place.path / "runs/tune/HalfCheetah-v5__refineppo" / row["folder"] / f"seed_{seed}"
            given = json.loads((run / "result.json").read_text())["flags"]
            assert {name: given[name] for name in flags_of(row)} == flags_of(row)
            rollout = given["num_envs"] * given["num_steps"]
            assert given["total_timesteps"] == 5000 // rollout * rollout
            expected = seed - (math.log10(float(row["learning_rate"])) + 3) ** 2
            assert float(row[f"return_{seed}"]) == pytest.approx(expected)
        assert float(row["value"]) == pytest.approx((float(row["return_1001"]) + float(row["return_1002"])) / 2)
    best = max(rows, key=lambda row: float(row["value"]))
    number = best["folder"].removeprefix("trial_")
    assert f"trial {number} ({best['source']}) of 14 is best with {float(best['value']):.2f}" in output
    for source, row in zip(("default", "published"), rows):
        assert re.search(rf"^    {source} +{float(row['value']):.2f}$", output, re.M)
    lines = [line for line in output.splitlines() if " of 14 done, about " in line]
    assert len(lines) == 14 and f"best {float(best['value']):.2f}" in lines[-1]

    # the winner, as the scripts read it
    text = (place.path / "runs/tune/settings/refineppo/HalfCheetah-v5.args").read_text()
    assert f"trial {number} ({best['source']}), the best of 14" in text and "5000 steps, seeds 1001 1002" in text
    assert f"(default {float(rows[0]['value']):.2f}; published {float(rows[1]['value']):.2f})" in text
    assert "#     python sweeps/tune.py --algorithm refineppo --env-id HalfCheetah-v5 --trials 14" in text
    args = vars(tyro.cli(refineppo_continuous.Args, args=shlex.split(text, comments=True)))
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


@pytest.mark.slow
def test_both_methods_are_searched_alike(place):
    place.tune("--trials", 6)
    place.tune("--trials", 6, "--algorithm", "refineppo")
    place.tune("--trials", 6, "--sampler-seed", 1, "--study-name", "other")
    ppo, refineppo = place.rows(), place.rows("HalfCheetah-v5__refineppo")
    shared = [{name: flags_of(row)[name] for name in space.FLAGS} for row in refineppo]
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


@pytest.mark.slow
def test_workers_that_start_at_once_share_the_trials(place):
    workers = [place.begin("--trials", 9, "--workers", 2, STEPS="4") for _ in range(2)]
    outputs = [place.end(worker) for worker in workers]
    assert [(code, errors) for code, _, errors in outputs] == [(0, "")] * 2
    rows = place.rows()
    check_books(place, rows, trials=9, steps=4)
    assert {row["state"] for row in rows} == {"finished"}  # nobody was taken for dead
    assert len({row["worker"] for row in counted(rows)}) > 2
    assert len({output.splitlines()[-3] for _, output, _ in outputs}) == 1  # all name the same winner
    sources = sorted(row["source"] for row in counted(rows))
    assert sources == ["default", "published", *["sampled"] * 7]


def test_a_surplus_attempt_is_given_back(tmp_path):
    """Two workers queue the same trial, and three ask for it."""
    worker = tune.Worker(tune.Args("ppo", "HalfCheetah-v5", trials=1, out_dir=tmp_path))
    worker.open_study()
    worker.queue(0, {})
    worker.queue(0, {})
    first, second, third = (worker.study.ask() for _ in range(3))
    for surplus in (second, third):
        with pytest.raises(tune.PutBack):
            worker.evaluate(surplus)
        worker.study.tell(surplus, state=tune.TrialState.FAIL)
    worker.fill_queue()  # changes nothing: the first attempt has just begun
    assert [tune.state(attempt) for attempt in worker.study.get_trials()] == ["running", "surplus", "surplus"]
    worker.study.tell(first, state=tune.TrialState.FAIL)
    worker.fill_queue()
    worker.fill_queue()
    attempts = worker.study.get_trials()
    assert [tune.state(attempt) for attempt in attempts] == ["put back", "surplus", "surplus", "waiting"]
    assert tune.number(attempts[-1]) == 0 and attempts[-1].params == attempts[0].params
    assert tune.ended(attempts) == {}


def test_a_later_call_with_more_trials_continues(place):
    with_one = place.tune("--trials", 1)
    assert "trial 0 (default) of 1 is best" in with_one
    assert (place.path / "runs/tune/settings/ppo/HalfCheetah-v5.args").read_text().count("\n--") == 0  # the default
    place.tune("--trials", 4)
    assert [row["source"] for row in place.rows()] == ["default", "published", "sampled", "sampled"]


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("signum, workers", [(signal.SIGTERM, 2), (signal.SIGINT, 1), (signal.SIGHUP, 1)])
def test_a_signal_puts_the_trials_back(place, signum, workers):
    worker = place.begin("--trials", 2, "--workers", workers, STEPS="100")
    place.wait_for_steps(5, f"trial_{workers - 1}")
    training = place.wait_for_steps(5)
    worker.send_signal(signum)
    code, output, errors = place.end(worker)
    assert (code, errors) == (75, "")
    assert f"stopped by {signal.Signals(signum).name}; the same command continues the search" in output
    assert ended(training)
    place.tune("--trials", 2, STEPS="100")
    rows = place.rows()
    check_books(place, rows, trials=2, steps=100)
    assert [row["state"] for row in rows].count("put back") == workers


@pytest.mark.slow
def test_a_signal_while_the_budget_is_stated(place):
    """No further worker begins."""
    worker = place.begin("--trials", 2, "--workers", 2, STEPS="100")
    children = Path(f"/proc/{worker.pid}/task/{worker.pid}/children")
    while not children.read_text():
        time.sleep(0.02)
    worker.send_signal(signal.SIGINT)
    code, output, errors = place.end(worker)
    assert (code, errors) == (75, "") and "stopped by SIGINT" in output and place.steps() == {}


@pytest.mark.slow
def test_a_closed_terminal_under_nohup_stops_no_search(place):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a child begins so, too
    try:
        worker = place.begin("--trials", 1, STEPS="20")
    finally:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    place.wait_for_steps(2)
    worker.send_signal(signal.SIGHUP)
    assert place.end(worker)[0] == 0


def test_the_command_for_the_winner(place):
    """It has the search's --flags; a password of the database goes into no file."""
    storage = f"sqlite:///{place.path}/study.db?timeout=20"
    output = place.tune("--trials", 1, "--flags", " --eval-episodes 2", "--storage", storage)
    assert "    FLAGS=' --eval-episodes 2' SETTINGS=runs/tune/settings sweeps/benchmark.sh HalfCheetah-v5" in output
    assert "sqlite" not in (place.path / "runs/tune/settings/ppo/HalfCheetah-v5.args").read_text()


@pytest.mark.slow
def test_what_goes_wrong_is_counted_and_said(place):
    faults = "no episode", "crashes", "crashes once", "not finite", "", "exits"
    faults = {f"trial_{n}": fault for n, fault in enumerate(faults)}
    output = place.tune("--trials", 6, FAULTS=json.dumps(faults))
    rows = place.rows()
    assert [row["state"] for row in rows] == ["failed", "failed", "finished", "failed", "finished", "failed"]
    assert [row["reason"] for row in rows] == [
        "no episode ended in the last 10 % of seed 1001",
        "seed 1001 crashed twice, with exit code 1: RuntimeError: the simulator crashed",
        "",
        "numerical failure with seed 1001",
        "",
        "seed 1001 crashed twice, with exit code 0: -",
    ]
    assert "6 of 6 done" in output and "    default   failed: no episode ended" in output
    assert [step for step, _ in place.steps("trial_2").popitem()[1]] == [0, 1]


def test_a_search_in_which_all_fails_says_so(place):
    code, output, errors = place.end(place.begin("--trials", 1, FAULTS='{"trial_0": "not finite"}'))
    assert code == 1 and "no trial succeeded" in errors
    assert not (place.path / "runs/tune/settings").exists()


@pytest.mark.slow
def test_a_refusal_during_the_search_ends_the_worker(place):
    code, output, errors = place.end(place.begin(FAULTS='{"trial_1": "refused"}'))
    assert (code, errors) == (2, "tune.py: error: the flags are bad\n")
    place.tune()
    assert [row["state"] for row in place.rows()] == ["finished", "put back", "finished", "finished"]


@pytest.mark.slow
def test_a_trial_of_another_machine_is_left_alone(place):
    worker = place.begin("--trials", 1, STEPS="100")
    place.wait_for_steps(2)
    worker.kill()
    worker.wait()
    journal = place.path / "runs/tune/HalfCheetah-v5__ppo/journal.log"
    host = os.uname().nodename
    journal.write_text(journal.read_text().replace(f'"{host}:', '"elsewhere:'))
    other = place.begin("--trials", 1)
    said = next(line for line in other.stdout if line.startswith("waiting"))
    assert said.startswith("waiting for the trials of other workers: 0 (elsewhere:")


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
    (("--flags=--no-anneal-lr",), "--flags cannot hold --anneal-lr, which the search sets itself"),
    (("--flags=--run-dir=x",), "--flags cannot hold --run-dir, which the search sets itself"),
    (("--flags='--x",), "--flags: No closing quotation"),
    (("--flags=--no-such-flag",), "--flags: Unrecognized options: --no-such-flag"),
    (("--workers", 0), "--workers must be at least 1, not 0"),
    (("--out-dir", "ppo_continuous.py/out"), "cannot write to ppo_continuous.py/out"),
    (("--storage", "nonsense"), "--storage must be a database's URL"),
    (("--storage", "nonsense://x"), "cannot use the database"),
    (("--storage", "postgresql+psycopg://nobody@127.0.0.1:1/x"), "cannot use the database"),
]


@pytest.mark.slow
@pytest.mark.parametrize("flags, sentence", BAD, ids=[" ".join(map(str, flags)) for flags, _ in BAD])
def test_bad_input_is_refused(place, flags, sentence):
    given = ["--algorithm", "ppo", "--env-id", "HalfCheetah-v5", *map(str, flags)]
    done = subprocess.run([sys.executable, "sweeps/tune.py", *given], cwd=place.path, text=True, capture_output=True)
    assert done.returncode == 2 and sentence in done.stderr
    assert done.stderr.startswith("tune.py: error: ") and done.stderr.count("\n") == 1
    assert place.steps() == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    "flags, sentence",
    [
        (("--seeds", 2), "--seeds 1"),
        (("--steps", 6000), "--steps 5000"),
        (("--flags", " --eval-episodes 2"), "--flags "),
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


@pytest.mark.slow
def test_real_trainings(tmp_path):
    """Episodes have 999 steps: with the 256 steps of 16 environments, as published, none ends."""
    task = "--algorithm ppo --env-id MountainCarContinuous-v0 --trials 2 --workers 2 --steps 7000".split()
    worker = real(tmp_path, *task, "--flags=--no-compile")
    output, errors = worker.communicate(timeout=300)
    assert (worker.returncode, errors) == (0, ""), output
    study = tmp_path / "runs/tune/MountainCarContinuous-v0__ppo"
    with open(study / "trials.csv", newline="") as file:
        default, published = csv.DictReader(file)
    assert (default["state"], published["state"]) == ("finished", "failed")
    assert published["reason"] == "no episode ended in the last 10 % of seed 1001"
    for row, steps in ((default, 6144), (published, 4096)):  # whole rollouts of 2048 and of 4096
        config = json.loads((study / row["folder"] / "seed_1001/config.json").read_text())["args"]
        assert {name: config[name] for name in flags_of(row)} == flags_of(row)
        assert (config["seed"], config["total_timesteps"], config["compile"]) == (1001, steps, False)
    result = json.loads((study / "trial_0/seed_1001/result.json").read_text())
    assert float(default["value"]) == result["train_return_last10pct"]


def test_what_the_script_refuses_is_refused_before_the_search(tmp_path):
    worker = real(tmp_path, "--algorithm", "ppo", "--env-id", "NoSuchTask-v0")
    _, errors = worker.communicate(timeout=300)
    assert worker.returncode == 2 and errors.count("\n") == 1
    assert errors.startswith("tune.py: error: cannot make the task NoSuchTask-v0")


def test_a_real_training_is_resumed_by_another_worker_on_a_database(tmp_path, database):
    task = "--algorithm refineppo --env-id probe_envs:Counter-v0 --trials 2 --steps 8192".split()
    flags = "--flags=--no-compile --checkpoint-interval 2048"
    workers = [real(tmp_path, *database, *task, flags) for _ in range(2)]
    study = tmp_path / "runs/tune/probe_envs_Counter-v0__refineppo"
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
