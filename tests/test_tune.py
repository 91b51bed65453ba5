"""The hyperparameter search: its space and first trials, workers that share a study, and die, and what they leave.

Most of it runs `sweeps/tune.py` beside a stand-in for the training scripts, stand_in_training.py; real trainings come
last. The tests on PostgreSQL need the URL of an empty database in REFINEPPO_TEST_POSTGRES.
"""

import fcntl
import json
import math
import os
import pickle
import re
import shlex
import shutil
import signal
import subprocess
import sys
import uuid
from collections import Counter
from dataclasses import fields
from pathlib import Path

import optuna
import pytest
import space
import tyro
from conftest import ROOT, python, read_csv, run, wait_until
from flags import default_args
from test_sweeps import parent

import ppo_continuous
import refineppo_continuous

pytestmark = pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
POSTGRES = os.environ.get("REFINEPPO_TEST_POSTGRES")
DEFAULT = vars(refineppo_continuous.Args())


def flags_of(row: dict) -> dict:
    """The flags in a row of trials.csv, as values."""
    read = {bool: lambda text: text == "True", int: int, float: float, str: str}
    names = [name for name in (*space.FLAGS, *space.REFINEMENT) if name in row]
    return {name: read[type(DEFAULT[name])](row[name]) for name in names}


class Place:
    """A copy of the tuner beside stand-ins for the training scripts, and a folder to work in."""

    def __init__(self, path: Path):
        self.path, self.workers = path, []
        shutil.copytree(ROOT / "sweeps", path / "sweeps", ignore=shutil.ignore_patterns("results"))
        for script in (ppo_continuous, refineppo_continuous):
            shutil.copy(ROOT / "tests" / "stand_in_training.py", path / f"{script.__name__}.py")
            args = [(field.name, field.type, field.default) for field in fields(script.Args)]
            (path / f"{script.__name__}.pickle").write_bytes(pickle.dumps(args))

    def begin(self, *flags, **env) -> subprocess.Popen:
        """A worker in the background."""
        given = {"--algorithm": "ppo", "--env-id": "HalfCheetah-v5", "--trials": 3, "--seeds": 1, "--steps": 5000}
        given |= dict(zip(flags[::2], flags[1::2]))
        command = [sys.executable, "sweeps/tune.py", *(str(word) for pair in given.items() for word in pair)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        self.workers.append(subprocess.Popen(command, cwd=self.path, env=os.environ | env, **pipes))
        return self.workers[-1]

    def end(self, worker: subprocess.Popen, code: int = 0, errors: str = "") -> str:
        """What a worker says until its end, which is this one."""
        output, said = worker.communicate(timeout=300)
        assert (worker.returncode, said) == (code, errors), output
        return output

    def tune(self, *flags, **env) -> str:
        return self.end(self.begin(*flags, **env))

    def rows(self, study: str = "HalfCheetah-v5__ppo") -> list[dict]:
        return read_csv(self.path / "runs/tune" / study / "trials.csv")

    def steps(self, folder: str = "trial_*") -> dict[str, list[tuple[int, int]]]:
        """The (step, process) pairs of each trial, with a seed each."""
        found = self.path.glob(f"runs/tune/*/{folder}/seed_1001/steps.txt")
        made = {path.parent.parent.name: path.read_text().splitlines() for path in found}
        return {trial: [tuple(map(int, line.split())) for line in lines] for trial, lines in made.items()}

    def processes(self, trial: str) -> set[int]:
        return {process for _, process in self.steps()[trial]}

    def wait_for_steps(self, count: int, folder: str = "trial_*") -> int:
        """Wait until a training has made some steps; its process."""
        wait_until(lambda: any(len(steps) >= count for steps in self.steps(folder).values()))
        return max(self.steps(folder).values(), key=len)[-1][1]

    def check_books(self, trials: int, steps: int):
        """As many settings count as were asked for, each once, and no run lost a step or made one twice."""
        rows = [row for row in self.rows() if row["state"] in ("finished", "failed")]
        assert len(rows) == len({row["folder"] for row in rows}) == trials
        assert Counter(row["source"] for row in rows)["default"] == 1
        made = {trial: [step for step, _ in of_trial] for trial, of_trial in self.steps().items()}
        assert made == {row["folder"]: [*range(steps)] for row in rows}


@pytest.fixture
def place(tmp_path):
    place = Place(tmp_path)
    yield place
    for worker in place.workers:
        worker.kill()
        worker.communicate()


def ended(process: int) -> bool:
    """Gone, or a zombie, which has no command line."""
    path = Path(f"/proc/{process}/cmdline")
    return not path.exists() or not path.read_text()


# --- The space and the first trials -----------------------------------------------------------------------------------


def first_settings(env_id: str) -> list[tuple[str, dict]]:
    return space.first_settings(env_id, default_args("ppo"))


def check_trainable(args):
    """A rollout has whole minibatches of more than one step."""
    assert args.batch_size % args.num_minibatches == 0 and args.batch_size > args.num_minibatches


def test_the_default_comes_first_and_then_what_was_published(script):
    """Exactly so: Swimmer's as RL Baselines3 Zoo has them."""
    (_, default), (source, published) = first_settings("Swimmer-v5")
    assert source == "published" and default == {name: DEFAULT[name] for name in space.FLAGS}
    swimmer = dict(learning_rate=6e-4, anneal_lr=False, gamma=0.9999, gae_lambda=0.98)
    assert published == default | swimmer | dict(num_envs=4, num_steps=1024, num_minibatches=16)  # of 256
    assert [source for source, _ in first_settings("probe_envs:Counter-v0")] == ["default"]
    tasks = [path.stem for path in space.PUBLISHED.glob("*.args")]
    assert len(tasks) == 14
    for task in tasks:
        check_trainable(script.Args(**first_settings(task)[1][1]))


def test_the_sampler_learns_from_the_nearest_point():
    refinement = {"refinement_depth": 4, "refinement_schedule": "average"}
    default = first_settings("")[0][1] | refinement
    assert space.to_flags(space.nearest_point(default, space.SPACE | space.REFINEMENT), default) == default
    walker = space.nearest_point(first_settings("BipedalWalker-v3")[1][1], space.SPACE)
    assert walker.pop("one_minus_gamma") == pytest.approx(1e-3)
    assert walker.pop("one_minus_lambda") == pytest.approx(0.05)
    assert [*walker.values()] == [3e-4, 16, 4096, 64, 10, 0.2, False, 0.5, 0.0]  # published: 32 environments


def test_every_point_of_the_space_can_be_trained(script):
    refinement = space.REFINEMENT if script is refineppo_continuous else {}
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    points = [space.suggest(study.ask(), space.SPACE | refinement) for _ in range(300)]
    found = [script.Args(**space.to_flags(point, first_settings("")[0][1])) for point in points]
    for args in found:
        check_trainable(args)
        assert 1e-5 <= args.learning_rate <= 3e-3 and 0.9 <= args.gamma <= 0.9999 and 0.8 <= args.gae_lambda <= 0.995
        assert args.ent_coef == 0 or 1e-6 <= args.ent_coef <= 2e-2
    assert {args.batch_size for args in found} == {512, 1024, 2048, 4096}
    assert {args.batch_size // args.num_minibatches for args in found} == {64, 128, 256, 512}
    entropies = {args.ent_coef for args in found}
    assert 0 in entropies and 100 < len(entropies) < 200  # half of them are 0
    if refinement:
        assert {args.refinement_depth for args in found} == {2, 4, 8}  # K = 1 is PPO's own policy


# --- Workers ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_one_worker_searches(place):
    search = "--algorithm", "refineppo", "--trials", 14, "--seeds", 2
    output = place.tune(*search)
    study = place.path / "runs/tune/HalfCheetah-v5__refineppo"
    rows = place.rows(study.name)
    assert [row["state"] for row in rows] == ["finished"] * 14
    assert "14 trials x 2 seeds x 5,000 steps = 140,000 environment steps" in output
    assert [row["source"] for row in rows] == ["default", "published", *["sampled"] * 12]
    refinement = {"refinement_depth": 4, "refinement_schedule": "average"}
    assert [flags_of(row) for row in rows[:2]] == [x | refinement for _, x in first_settings("HalfCheetah-v5")]
    assert len({json.dumps(flags_of(row)) for row in rows}) == 14
    for row in rows:
        for seed in (1001, 1002):
            given = json.loads((study / row["folder"] / f"seed_{seed}/result.json").read_text())["flags"]
            assert flags_of(row).items() <= given.items()
            rollout = given["num_envs"] * given["num_steps"]
            assert given["total_timesteps"] == 5000 // rollout * rollout
            expected = seed - (math.log10(float(row["learning_rate"])) + 3) ** 2
            assert float(row[f"return_{seed}"]) == pytest.approx(expected)
        assert float(row["value"]) == pytest.approx(expected - 0.5)  # the mean of both
    best = max(rows, key=lambda row: float(row["value"]))
    which = f"trial {best['folder'].removeprefix('trial_')} ({best['source']})"
    default, published, value = (f"{float(row['value']):.2f}" for row in (*rows[:2], best))
    assert f"{which} of 14 is best with {value}" in output
    assert re.search(rf"^    default +{default}\n    published +{published}$", output, re.M)
    lines = [line for line in output.splitlines() if " of 14 done, about " in line]
    assert len(lines) == 14 and f"best {value}" in lines[-1]

    # the winner, as the scripts read it
    text = (place.path / "runs/tune/settings/refineppo/HalfCheetah-v5.args").read_text()
    assert f"{which}, the best of 14" in text and "5000 steps, seeds 1001 1002" in text
    assert f"(default {default}; published {published})" in text
    assert "#     python sweeps/tune.py --algorithm refineppo --env-id HalfCheetah-v5 --trials 14" in text
    args = vars(tyro.cli(refineppo_continuous.Args, args=shlex.split(text, comments=True)))
    assert flags_of(best).items() <= args.items()
    assert place.tune(*search).startswith("the search is over") and place.rows(study.name) == rows


def test_a_dry_run_states_the_cost_and_leaves_nothing(place):
    before = sorted(place.path.rglob("*"))
    done = python("sweeps/tune.py", *"--algorithm ppo --env-id HalfCheetah-v5 --dry-run".split(), cwd=place.path)
    assert "30 trials x 3 seeds x 1,000,000 steps = 90,000,000 environment steps" in done.stdout
    assert "train at 1,000 steps/s here" in done.stdout and "about 25." in done.stdout  # hours
    assert sorted(place.path.rglob("*")) == before


@pytest.mark.slow
def test_both_methods_are_searched_alike(place):
    place.tune("--trials", 6)
    place.tune("--trials", 6, "--algorithm", "refineppo")
    place.tune("--trials", 6, "--sampler-seed", 1, "--study-name", "other")
    ppo, refineppo = place.rows(), place.rows("HalfCheetah-v5__refineppo")
    shared = [{name: flags_of(row)[name] for name in space.FLAGS} for row in refineppo]
    assert [flags_of(row) for row in ppo] == shared  # until results lead the sampler elsewhere
    assert shared[2:] != [flags_of(row) for row in place.rows("other")][2:]


def test_a_fixed_depth_is_an_arm_of_its_own(place):
    """The command for the winner has the search's --flags; a password of the database goes into no file."""
    fixed = "--algorithm", "refineppo", "--refinement-depth", 4, "--refinement-schedule", "average"
    storage = f"sqlite:///{place.path}/study.db?timeout=20"
    output = place.tune(*fixed, "--flags", " --eval-episodes 2", "--storage", storage)
    rows = place.rows("HalfCheetah-v5__refineppo-K4-average")
    assert [(row["refinement_depth"], row["refinement_schedule"]) for row in rows] == [("4", "average")] * 3
    command = "FLAGS=' --eval-episodes 2' SETTINGS=runs/tune/settings-K4-average sweeps/benchmark.sh HalfCheetah-v5"
    assert command in output
    winner = (place.path / "runs/tune/settings-K4-average/refineppo/HalfCheetah-v5.args").read_text()
    assert "--refinement-depth 4\n--refinement-schedule average\n" in winner and "sqlite" not in winner
    assert not (place.path / "runs/tune/settings").exists()


def test_a_later_call_with_more_trials_continues(place):
    assert "trial 0 (default) of 1 is best" in place.tune("--trials", 1)
    assert (place.path / "runs/tune/settings/ppo/HalfCheetah-v5.args").read_text().count("\n--") == 0  # the default
    place.tune("--trials", 4)
    assert [row["source"] for row in place.rows()] == ["default", "published", "sampled", "sampled"]


def test_a_trial_waits_for_the_training_that_a_dead_worker_left(place):
    run = place.path / "runs/tune/HalfCheetah-v5__ppo/trial_0/seed_1001"
    run.mkdir(parents=True)
    lock = os.open(run, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    worker, log = place.begin("--trials", 1), run.with_suffix(".log")
    wait_until(lambda: log.exists() and "another process is at work" in log.read_text())
    os.close(lock)
    place.end(worker)
    place.check_books(trials=1, steps=2)


@pytest.mark.slow
@pytest.mark.parametrize("signum, workers", [(signal.SIGTERM, 2), (signal.SIGINT, 1), (signal.SIGHUP, 1)])
def test_a_signal_puts_the_trials_back(place, signum, workers):
    worker = place.begin("--trials", 2, "--workers", workers, STEPS="100")
    training = place.wait_for_steps(5, f"trial_{workers - 1}")
    worker.send_signal(signum)
    output = place.end(worker, code=75)
    assert f"stopped by {signal.Signals(signum).name}; the same command continues the search" in output
    assert ended(training)
    place.tune("--trials", 2, STEPS="100")
    place.check_books(trials=2, steps=100)
    assert [row["state"] for row in place.rows()].count("put back") == workers


@pytest.mark.slow
def test_a_closed_terminal_under_nohup_stops_no_search(place):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a child begins so, too
    try:
        worker = place.begin("--trials", 1, STEPS="20")
    finally:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    place.wait_for_steps(2)
    worker.send_signal(signal.SIGHUP)
    place.end(worker)


@pytest.mark.slow
def test_what_goes_wrong_is_counted_and_said(place):
    faults = "no episode", "crashes", "crashes once", "not finite", "", "exits"
    faults = {f"trial_{n}": fault for n, fault in enumerate(faults)}
    said = "the search is over: no trial succeeded, see runs/tune/HalfCheetah-v5__ppo/trials.csv\n"
    place.end(place.begin("--trials", 1, FAULTS=json.dumps(faults)), code=1, errors=said)
    assert not (place.path / "runs/tune/settings").exists()
    output = place.tune("--trials", 6, FAULTS=json.dumps(faults))
    assert [(row["state"], row["reason"]) for row in place.rows()] == [
        ("failed", "no episode ended in the last 10 % of seed 1001"),
        ("failed", "seed 1001 crashed twice, with exit code 1: RuntimeError: the simulator crashed"),
        ("finished", ""),
        ("failed", "numerical failure with seed 1001"),
        ("finished", ""),
        ("failed", "seed 1001 crashed twice, with exit code 0: -"),
    ]
    assert "6 of 6 done" in output and "    default   failed: no episode ended" in output
    assert [step for step, _ in place.steps()["trial_2"]] == [0, 1]


@pytest.mark.slow
def test_a_refusal_during_the_search_ends_the_worker(place):
    worker = place.begin(FAULTS='{"trial_1": "the flags are bad"}')
    place.end(worker, code=2, errors="tune.py: error: the flags are bad\n")
    place.tune()
    assert [row["state"] for row in place.rows()] == ["finished", "put back", "finished", "finished"]


# --- Bad input --------------------------------------------------------------------------------------------------------

BAD_INPUT = {
    "--trials 0": "--trials must be at least 1, not 0",
    "--steps 4000": "--steps must be at least 4096, the longest rollout among the trials, not 4000",
    "--steps 65535 --env-id BipedalWalker-v3": "--steps must be at least 65536",
    "--refinement-depth 4 --algorithm refineppo": "are fixed together or not at all",
    "--refinement-depth 4 --refinement-schedule average": "ppo has no --refinement-depth to fix",
    "--env-id NoSuchTask-v0": "cannot make the task NoSuchTask-v0",
    "--flags=--no-anneal-lr": "--flags cannot hold --anneal-lr, which the search sets itself",
    "--flags='x": "--flags: No closing quotation",
    "--flags=--no-such-flag": "--flags: Unrecognized options: --no-such-flag",
    "--out-dir /dev/null/out": "cannot write to /dev/null/out",
    "--storage nonsense": "--storage must be a database's URL",
    "--storage postgresql+psycopg://nobody@127.0.0.1:1/x": "cannot use the database",
}


@pytest.mark.slow
@pytest.mark.parametrize("flags, sentence", BAD_INPUT.items(), ids=BAD_INPUT)
def test_bad_input_is_refused(flags, sentence, tmp_path):
    done = run("sweeps/tune.py", *"--algorithm ppo --env-id HalfCheetah-v5".split(), *flags.split(), cwd=tmp_path)
    assert done.returncode == 2 and sentence in done.stderr
    assert done.stderr.startswith("tune.py: error: ") and done.stderr.count("\n") == 1
    assert not list(tmp_path.rglob("trial_*"))


@pytest.mark.slow
def test_another_study_and_a_damaged_one_are_refused(place):
    mine = "--trials", 1, "--study-name", "mine"
    place.tune(*mine)
    for flags, sentence in (
        (("--seeds", 2), "--seeds 1"),
        (("--flags", " --eval-episodes 2"), "--flags "),
        (("--env-id", "Ant-v5", "--steps", 40000), "--env-id HalfCheetah-v5, --steps 5000"),
        (("--algorithm", "refineppo"), "--algorithm ppo"),
    ):
        said = f"tune.py: error: the study mine was begun with other flags than these: {sentence}\n"
        place.end(place.begin(*mine, *flags), code=2, errors=said)
    journal = Path("runs/tune/mine/journal.log")
    for damage, sentence in (('{"op_code":4', "ends in half a line"), ("garbage\n" * 2, "is damaged")):
        with open(place.path / journal, "a") as file:
            file.write(damage)
        worker = place.begin(*mine)
        _, said = worker.communicate()
        assert worker.returncode == 2 and said.count("\n") == 1
        assert said.startswith(f"tune.py: error: the journal {journal} {sentence}")


def test_without_optuna_one_sentence_says_what_to_do(tmp_path):
    (tmp_path / "optuna.py").write_text("raise ModuleNotFoundError")
    done = run("sweeps/tune.py", "--help", PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stderr) == (2, "tune.py: error: Optuna is missing: pip install -e '.[tune]'\n")


# --- Workers together -------------------------------------------------------------------------------------------------


@pytest.fixture(params=["journal", "postgresql"])
def storage(request):
    """Flags for the study's place; on PostgreSQL a schema of its own in the server of REFINEPPO_TEST_POSTGRES."""
    if request.param == "journal":
        yield ()
        return
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


@pytest.mark.slow
def test_workers_share_a_study_and_take_over_from_the_dead(place, storage):
    workers = [place.begin(*storage, "--trials", 9, "--workers", 2, STEPS="30") for _ in range(3)]  # all at once
    training = place.wait_for_steps(5, "trial_0")
    killed = parent(training)
    os.kill(killed, signal.SIGKILL)
    wait_until(lambda: ended(training))
    assert len(place.steps()["trial_0"]) < 30  # it does not train on by itself
    winners = {place.end(worker).splitlines()[-3] for worker in workers if worker.pid != killed}
    place.check_books(trials=9, steps=30)
    rows = place.rows()
    before, after = (row for row in rows if row["folder"] == "trial_0")
    assert (before["state"], after["state"]) == ("put back", "finished") and len(place.processes("trial_0")) == 2
    assert before["worker"].endswith(f":{killed}") and after["worker"] != before["worker"]
    assert {row["state"] for row in rows if row is not before} == {"finished"}  # nobody else was taken for dead
    assert len({row["worker"] for row in rows}) > 2 and len(winners) == 1
    sources = sorted(row["source"] for row in rows if row is not before)
    assert sources == ["default", "published", *["sampled"] * 7]


@pytest.mark.parametrize("storage", ["postgresql"], indirect=True)
def test_a_worker_that_hung_loses_its_trial(place, storage):
    hung = place.begin(*storage, "--trials", 1, STEPS="200")
    training = place.wait_for_steps(5, "trial_0")
    hung.send_signal(signal.SIGSTOP)  # its training goes on
    place.tune(*storage, "--trials", 1, STEPS="200")
    hung.send_signal(signal.SIGCONT)
    output = place.end(hung)
    assert "another worker has taken it over" in output and "the search is over" in output
    place.check_books(trials=1, steps=200)
    assert place.processes("trial_0") == {training}


# --- Real trainings ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_real_trainings(tmp_path):
    """Episodes have 999 steps: with the 256 steps of 16 environments, as published, none ends."""
    task = "--algorithm ppo --env-id MountainCarContinuous-v0 --trials 2 --seeds 1 --steps 7000 --workers 2".split()
    done = run("sweeps/tune.py", *task, "--flags=--no-compile", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    study = tmp_path / "runs/tune/MountainCarContinuous-v0__ppo"
    default, published = read_csv(study / "trials.csv")
    assert (default["state"], published["state"]) == ("finished", "failed")
    assert published["reason"] == "no episode ended in the last 10 % of seed 1001"
    for row, steps in ((default, 6144), (published, 4096)):  # whole rollouts of 2048 and of 4096
        config = json.loads((study / row["folder"] / "seed_1001/config.json").read_text())["args"]
        assert flags_of(row).items() <= config.items()
        assert (config["seed"], config["total_timesteps"], config["compile"]) == (1001, steps, False)
    result = json.loads((study / "trial_0/seed_1001/result.json").read_text())
    assert float(default["value"]) == result["train_return_last10pct"]
