"""How fast the training scripts are, beside their fastest peers and the bare environment.

    python sweeps/speed.py --env-id HalfCheetah-v5 --num-envs 1 --depths 1 2 4 8 --repeats 3
    python sweeps/speed.py --depths 4 --repeats 5 --against ../another-checkout

All train with the same networks, rollouts of 2048 steps, 32 minibatches, 10 epochs and one thread. The methods take
turns, so that a busy moment of the machine does not hit one alone. A first round, not counted, compiles with an empty
cache and finds out how many steps take --seconds. Steps per second are without compilation and evaluation.
The peers are Stable-Baselines3 and SBX, its sibling in JAX (the extra `bench`).

Prints a table, and leaves it in sweeps/results/ as speed-<env>-<N>envs.md, with every run in a .csv beside it.
"""

import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from datetime import date
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from statistics import median

import pandas as pd
import tyro
from common import ONE_THREAD, ROOT, refuse
from flags import file_name

PEERS = {"Stable-Baselines3 PPO": "stable_baselines3", "SBX PPO": "sbx"}
PACKAGES = {"stable_baselines3": "stable-baselines3", "sbx": "sbx-rl"}


@dataclass
class Args:
    env_id: str = "HalfCheetah-v5"
    """Gymnasium id of the task"""
    num_envs: int = 1
    """environments stepped together"""
    depths: tuple[int, ...] = (1, 2, 4, 8)
    """refinement depths K"""
    repeats: int = 3
    """runs of each method that count"""
    seconds: float = 15
    """training time of each run"""
    steps: int | None = None
    """environment steps of each run, instead of --seconds"""
    cuda: bool = False
    """update on the GPU"""
    against: Path | None = None
    """another checkout, whose scripts take their turns in the same rounds"""
    out_dir: Path = ROOT / "sweeps" / "results"
    """folder for the table and the runs"""

    @property
    def batch_size(self) -> int:
        return self.num_envs * (2048 // self.num_envs)


def commands(args: Args) -> dict[str, list]:
    """What to run for each method, but for the number of steps."""
    task = ["--env-id", args.env_id, "--num-envs", args.num_envs, "--num-steps", 2048 // args.num_envs]
    learner = [*task, "--cuda"] if args.cuda else task
    ours = [*learner, "--eval-interval", 10**12, "--eval-episodes", 1, "--final-eval-episodes", 1, "--no-progress"]
    methods = {"PPO": ["ppo_continuous.py", *ours]}
    for depth in args.depths:
        methods[f"RefinePPO K = {depth}"] = ["refineppo_continuous.py", *ours, "--refinement-depth", depth]
    if args.against:
        pairs = [
            ((name, command), (f"{name} there", [args.against / command[0], *command[1:]]))
            for name, command in methods.items()
        ]
        methods = dict(method for pair in pairs for method in pair)
    for name, module in PEERS.items():
        if find_spec(module):
            methods[name] = ["sweeps/speed.py", "peer", "--module", module, *learner]
        else:
            print(f"{name} is missing and left out: pip install -e '.[bench]'")
    return methods | {"environment alone": ["sweeps/speed.py", "environment", *task]}


def run(command: list, steps: int, work: Path) -> dict:
    """One process: its output, speed, peak memory and the seconds from its start until the update was compiled."""
    script, *flags = command
    run_dir = work / "run" / str(time.time_ns())
    if "--eval-interval" in flags:
        flags += ["--run-dir", run_dir]
    command = [*map(str, [sys.executable, ROOT / script, *flags, "--total-timesteps", steps])]
    cache = work / "cache" / (ROOT / script).parent.name  # each checkout compiles for itself
    env = os.environ | ONE_THREAD | {"TORCHINDUCTOR_CACHE_DIR": str(cache)}
    start, compiled_after, output = time.time(), None, ""
    process = subprocess.Popen(command, cwd=work, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    for line in process.stdout:
        output += line
        if line.startswith("compiled in"):
            compiled_after = time.time() - start
    _, status, usage = os.wait4(process.pid, 0)  # the peak memory of this very process; Linux counts it in KiB
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"\n{shlex.join(command)}\n{output}exit code {process.returncode}")
    if (run_dir / "result.json").exists():
        sps = json.loads((run_dir / "result.json").read_text())["sps"]
    else:
        sps = float(re.findall(r"^([\d.]+) steps/s$", output, re.M)[-1])
    measured = {"steps": steps, "sps": sps, "peak_mib": usage.ru_maxrss / 1024, "compiled_after_s": compiled_after}
    return measured | {"output": output}


# --- Each in a process of its own: python sweeps/speed.py peer|environment|breakdown FLAGS ----------------------------


def peer(module: str, env_id: str, num_envs: int, num_steps: int, total_timesteps: int, cuda: bool = False):
    """The PPO of a package with Stable-Baselines3's interface, with the settings of the training scripts. SBX clips no
    value, and JAX has a thread for each core that it sees: it sees one."""
    if module == "sbx":
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    import gymnasium as gym
    import torch
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    torch.set_num_threads(1)
    envs = VecNormalize(DummyVecEnv([lambda: Monitor(gym.make(env_id))] * num_envs))
    networks = {"net_arch": {"pi": [128, 128], "vf": [64, 64]}}
    more = {"policy_kwargs": networks}
    if module == "stable_baselines3":
        networks["activation_fn"] = torch.nn.Tanh  # SBX's default
        more |= {"clip_range_vf": 0.2, "device": "cuda" if cuda else "cpu"}
    model = import_module(module).PPO(
        "MlpPolicy",
        envs,
        learning_rate=lambda remaining: 3e-4 * remaining,
        n_steps=num_steps,
        n_epochs=10,
        batch_size=num_envs * num_steps // 32,
        seed=1,
        **more,
    )
    model.learn(num_envs * num_steps)  # not counted, as the compilation of the scripts is not
    start = time.time()
    model.learn(total_timesteps)
    print(f"{total_timesteps / (time.time() - start):.1f} steps/s")


def environment(env_id: str, num_envs: int, num_steps: int, total_timesteps: int):
    """Random actions in one environment: the rate that nothing which steps the task in Python can pass."""
    import gymnasium as gym

    env = gym.make(env_id, disable_env_checker=True)
    env.action_space.seed(1)
    actions = [env.action_space.sample() for _ in range(num_envs * num_steps)]
    env.reset(seed=1)
    start = time.time()
    for step in range(total_timesteps):
        _, _, terminated, truncated, _ = env.step(actions[step % len(actions)])
        if terminated or truncated:
            env.reset()
    print(f"{total_timesteps / (time.time() - start):.1f} steps/s")


PARTS = ("environment", "acting", "normalising", "batch quantities", "update", "logging and other")


def breakdown(script: str, *flags: str):
    """Train with a clock around the functions that the main loop calls; print the us per environment step.

    Nothing inside the compiled update is touched: that would break its compilation.
    """
    sys.path.insert(0, str(ROOT))
    module = import_module(Path(script).stem)
    spent, begun = Counter(), {}

    def time_calls(owner, name: str):
        function = getattr(owner, name)

        def timed(*args, **kwargs):
            start = time.perf_counter()
            begun.setdefault(name, start)
            result = function(*args, **kwargs)
            spent[name] += time.perf_counter() - start
            return result

        setattr(owner, name, timed)

    time_calls(module.Environments, "step")
    time_calls(module.Normalizer, "observe")
    for name in ("collect", "prepare_batch", "learn", "evaluate"):
        time_calls(module, name)
    sys.argv = [script, *flags]
    module.main()
    total = begun["evaluate"] - begun["collect"]  # the first evaluation follows the last update
    acting = spent["collect"] - spent["step"] - spent["observe"]
    parts = [spent["step"], acting, spent["observe"], spent["prepare_batch"], spent["learn"]]
    steps = int(flags[flags.index("--total-timesteps") + 1])
    print("us per step:", json.dumps([1e6 * seconds / steps for seconds in (*parts, total - sum(parts))]))
    print(f"{steps / total:.1f} steps/s")


# --- The table --------------------------------------------------------------------------------------------------------


def markdown(header: list[str], *rows: list[str]) -> str:
    return "".join(f"| {' | '.join(row)} |\n" for row in (header, ["-"] + ["-:"] * (len(header) - 1), *rows))


def speed_table(runs: dict[str, list[dict]]) -> str:
    """A row per method: medians over the rounds that count, which are all but the first."""
    sps = {name: median(r["sps"] for r in rounds[1:]) for name, rounds in runs.items()}

    def ratio(name: str, other: str) -> str:
        return f"{sps[name] / sps[other]:.2f}" if name in sps and other in sps else ""

    rows = []
    for name, (cold, *warm) in runs.items():
        speeds, waits = [r["sps"] for r in warm], [r["compiled_after_s"] for r in (cold, *warm)]
        row = {"method": name, "steps/s, median (min-max)": f"{sps[name]:.0f} ({min(speeds):.0f}-{max(speeds):.0f})"}
        if any(other.endswith(" there") for other in sps):
            row["x there"] = f"{sps[name] / sps[f'{name} there']:.3f}" if f"{name} there" in sps else ""
        row |= {f"x {peer.removesuffix(' PPO')}": ratio(name, peer) for peer in PEERS}
        row["time per step / K = 1"] = ratio("RefinePPO K = 1", name) if name.startswith("RefinePPO") else ""
        row["of the environment's rate"] = f"{100 * sps[name] / sps['environment alone']:.0f} %"
        row["peak MiB: cold, warm"] = f"{cold['peak_mib']:.0f}, {max(r['peak_mib'] for r in warm):.0f}"
        compiled = f"{waits[0]:.0f}, {median(waits[1:]):.0f}" if all(waits) else ""
        rows.append([*row.values(), compiled])
    return markdown([*row, "seconds until compiled: cold, warm"], *rows)


def breakdown_table(methods: dict[str, list], runs: dict[str, list[dict]], work: Path) -> str:
    """Where the time of a step goes, from one more run of each of our own methods."""
    rows = [["us per step", *PARTS, "together"]]
    for name, (script, *flags) in methods.items():
        if script in ("ppo_continuous.py", "refineppo_continuous.py"):
            print(f"breakdown of {name}", flush=True)
            done = run(["sweeps/speed.py", "breakdown", script, *flags], runs[name][-1]["steps"], work)
            parts = json.loads(re.findall(r"^us per step: (.*)$", done["output"], re.M)[-1])
            rows.append([name, *(f"{part:.1f}" for part in [*parts, sum(parts)])])
    return markdown(*rows)


def head(args: Args, config: dict) -> str:
    """The report's first lines: task, machine, versions, the other checkout, the command."""
    versions = config["versions"] | {
        package: version(package) for module, package in PACKAGES.items() if find_spec(module)
    }
    machine = f"{config['cpu']}, {os.cpu_count()} cores" + (f", {config['gpu']}" if args.cuda else "")
    number = f"{args.num_envs} environment{'s' * (args.num_envs > 1)}"
    there = ""
    if args.against:
        commit = subprocess.run(
            ["git", "-C", args.against, "rev-parse", "--short", "HEAD"], text=True, capture_output=True
        )
        there = f"`there` is {args.against}, commit {commit.stdout.strip() or 'unknown'}\n\n"
    return f"""# Speed: {args.env_id}, {number}{", updates on the GPU" if args.cuda else ""}

{machine}, 1 thread each; {", ".join(f"{name} {number}" for name, number in versions.items())}; {date.today()}

{there}    {shlex.join(["python", "sweeps/speed.py", *sys.argv[1:]])}

Steps per second without compilation and evaluation, of {args.repeats} runs each, in which the methods took turns.
"""


def main(args: Args):
    if args.repeats < 1 or not 1 <= args.num_envs <= 2048:
        refuse("--repeats must be at least 1, and --num-envs from 1 to 2048")
    if args.against:
        args.against = args.against.expanduser().resolve()
        if not (args.against / "ppo_continuous.py").exists():
            refuse(f"{args.against} is no checkout: it has no ppo_continuous.py")
    methods, runs = commands(args), {}
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for i in range(args.repeats + 1):
            for name, command in methods.items():
                print(f"round {i} of {args.repeats}, {name}: ", end="", flush=True)
                rounds = runs.setdefault(name, [])
                wanted = args.steps or (rounds[0]["sps"] * args.seconds if rounds else 2 * args.batch_size)
                rounds.append(run(command, max(1, round(wanted / args.batch_size)) * args.batch_size, work))
                print(f"{rounds[-1]['sps']:.0f} steps/s", flush=True)
        where = breakdown_table(methods, runs, work)
        config = json.loads(next(work.glob("run/*/config.json")).read_text())

    text = f"""{head(args, config)}
{speed_table(runs)}
Where the time of a step goes, from one more run of each with a clock around its functions:

{where}"""
    name = f"speed-{file_name(args.env_id)}-{args.num_envs}envs{'-cuda' * args.cuda}"
    name += f"-against-{args.against.name}" if args.against else ""
    args.out_dir.mkdir(parents=True, exist_ok=True)
    (args.out_dir / f"{name}.md").write_text(text)
    rows = [{"method": method, "round": i} | r for method, rounds in runs.items() for i, r in enumerate(rounds)]
    pd.DataFrame(rows).drop(columns="output").to_csv(args.out_dir / f"{name}.csv", index=False)
    print(f"\n{text}\nsaved as {args.out_dir / name}.md and .csv")


if __name__ == "__main__":
    if sys.argv[1:2] == ["breakdown"]:
        breakdown(*sys.argv[2:])
    elif sys.argv[1:2] in (["peer"], ["environment"]):
        tyro.cli({"peer": peer, "environment": environment}[sys.argv[1]], args=sys.argv[2:])
    else:
        main(tyro.cli(Args, description=__doc__))
