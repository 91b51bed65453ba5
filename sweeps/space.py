"""What tune.py searches: the space, and the settings with which a search begins."""

import optuna
from common import ROOT
from flags import file_name, parse
from optuna.distributions import CategoricalDistribution, FloatDistribution

PUBLISHED = ROOT / "sweeps" / "settings" / "published"

SPACE = {
    "learning_rate": FloatDistribution(1e-5, 3e-3, log=True),
    "one_minus_gamma": FloatDistribution(1e-4, 0.1, log=True),
    "one_minus_lambda": FloatDistribution(5e-3, 0.2, log=True),
    "num_envs": CategoricalDistribution((1, 4, 8, 16)),
    "rollout": CategoricalDistribution((512, 1024, 2048, 4096)),  # steps of all environments together
    "minibatch": CategoricalDistribution((64, 128, 256, 512)),
    "update_epochs": CategoricalDistribution((4, 10, 20)),
    "clip_coef": CategoricalDistribution((0.1, 0.2, 0.3)),
    "entropy": CategoricalDistribution((False, True)),
    "ent_coef": FloatDistribution(1e-6, 2e-2, log=True),  # only with entropy, 0 without
    "vf_coef": FloatDistribution(0.2, 1.0),
    "log_std_init": CategoricalDistribution((0.0, -0.5, -1.0, -2.0)),
}
REFINEMENT = {  # without K = 1, which is PPO's own policy: as the winner it would compare PPO with itself
    "refinement_depth": CategoricalDistribution((2, 4, 8)),
    "refinement_schedule": CategoricalDistribution(("average", "uniform", "inverse")),
}
FLAGS = (  # what settings are made of, in the space or published
    "learning_rate anneal_lr num_envs num_steps num_minibatches update_epochs gamma gae_lambda clip_coef ent_coef"
    " vf_coef max_grad_norm log_std_init normalize_obs normalize_reward"
).split()


def settings_of(args) -> dict:
    return {name: getattr(args, name) for name in FLAGS}


def first_settings(env_id: str, default) -> list[tuple[str, dict]]:
    """(where they come from, flags) of the trials 0 and, where something was published for the task, 1."""
    found, published = [("default", settings_of(default))], PUBLISHED / f"{file_name(env_id)}.args"
    if published.exists():
        found.append(("published", settings_of(parse(published.read_text(), default))))
    return found


def digits(x: float) -> float:
    """Four significant digits, so that settings can be read and typed."""
    return float(f"{x:.4g}")


def to_flags(point: dict, default: dict) -> dict:
    """The flags of a point of the space; whatever is not in the space keeps its default."""
    return default | {
        **{name: value for name, value in point.items() if name in (*FLAGS, *REFINEMENT)},
        "learning_rate": digits(point["learning_rate"]),
        "gamma": round(1 - digits(point["one_minus_gamma"]), 8),
        "gae_lambda": round(1 - digits(point["one_minus_lambda"]), 8),
        "num_steps": point["rollout"] // point["num_envs"],
        "num_minibatches": point["rollout"] // point["minibatch"],
        "ent_coef": digits(point["ent_coef"]) if point["entropy"] else 0.0,
        "vf_coef": digits(point["vf_coef"]),
    }


def nearest_point(flags: dict, space: dict) -> dict:
    """The point of the space that is nearest to some flags, from which the sampler learns what they were worth."""
    rollout = flags["num_envs"] * flags["num_steps"]
    exact = flags | {
        "one_minus_gamma": 1 - flags["gamma"],
        "one_minus_lambda": 1 - flags["gae_lambda"],
        "rollout": rollout,
        "minibatch": rollout // flags["num_minibatches"],
        "entropy": flags["ent_coef"] > 0,
    }

    def nearest(value, domain):
        if isinstance(domain, FloatDistribution):
            return min(max(value, domain.low), domain.high)
        return value if value in domain.choices else min(domain.choices, key=lambda choice: abs(choice - value))

    point = {name: nearest(exact[name], domain) for name, domain in space.items()}
    return {name: value for name, value in point.items() if name != "ent_coef" or point["entropy"]}


def suggest(trial: optuna.Trial, space: dict) -> dict:
    """Ask the sampler for a point; what the trial has already is kept."""
    point = {}
    for name, domain in space.items():
        if name == "ent_coef" and not point["entropy"]:
            continue
        if isinstance(domain, FloatDistribution):
            point[name] = trial.suggest_float(name, domain.low, domain.high, log=domain.log)
        else:
            point[name] = trial.suggest_categorical(name, domain.choices)
    return point
