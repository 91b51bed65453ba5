"""The loss, the update and the actor, held equal to the eager reference, torch.optim and torch.distributions."""

import json
import os

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import run
from reference import Agent as EagerAgent
from reference import eager_loss, eager_update, make_optimizer
from torch.distributions import Normal

import ppo_continuous
import refineppo_continuous

OBS_DIM, ACTION_DIM = 5, 3
POLICIES = [(ppo_continuous, {})] + [
    (refineppo_continuous, {"refinement_depth": depth, "refinement_schedule": schedule})
    for depth, schedule in ((1, "average"), (2, "uniform"), (4, "average"), (4, "inverse"), (8, "average"))
]
POLICY_NAMES = ["-".join([module.__name__, *map(str, flags.values())]) for module, flags in POLICIES]
policies = pytest.mark.parametrize("module, flags", POLICIES, ids=POLICY_NAMES)


def make_agent(module, dtype=torch.float64, **flags):
    """A small agent of 64 x 4 steps in 8 minibatches, away from the special initial parameters (0 and almost 0)."""
    sizes = {"num_steps": 64, "num_envs": 4, "num_minibatches": 8, "actor_hidden": (16, 16), "critic_hidden": (8, 8)}
    spaces = (gym.spaces.Box(-limit, limit, (dim,)) for limit, dim in ((np.inf, OBS_DIM), (1.0, ACTION_DIM)))
    agent = module.Agent(*spaces, module.Args(**sizes | flags))
    generator = torch.Generator().manual_seed(0)
    for name, p in agent.params.items():
        agent.params[name] = (p + 0.1 * torch.randn(p.shape, generator=generator)).to(dtype)
    return agent


def with_our_names(eager: EagerAgent) -> dict[str, torch.Tensor]:
    """The reference's parameters under the scripts' names, the weights as (in, out)."""
    params = {"log_std": eager.log_std}
    for name in ("actor", "critic"):
        for i, linear in enumerate(getattr(eager, name)[::2]):
            params |= {f"{name}.{i}.weight": linear.weight.T, f"{name}.{i}.bias": linear.bias}
    return params


def eager_copy(agent) -> EagerAgent:
    """The reference's agent with the same parameters."""
    args = agent.args
    K, schedule = getattr(args, "refinement_depth", None), getattr(args, "refinement_schedule", "")
    obs_dim, action_dim = len(agent.params["critic.0.weight"]), len(agent.params["log_std"])
    eager = EagerAgent(obs_dim, action_dim, K, schedule, args.actor_hidden, args.critic_hidden)
    eager.to(agent.params["log_std"].dtype)
    with torch.no_grad():
        for name, p in with_our_names(eager).items():
            p.copy_(agent.params[name])
    return eager


def make_batch(agent, seed=0) -> list[torch.Tensor]:
    """obs, actions, logprobs, advantages, returns, values; ratios and values move inside the clip and out of it."""
    generator, size = torch.Generator().manual_seed(seed), agent.args.batch_size

    def randn(*shape):
        return torch.randn(size, *shape, generator=generator).to(agent.params["log_std"].dtype)

    obs = randn(OBS_DIM)
    with torch.no_grad():
        old = eager_copy(agent).policy(obs)
        actions = old.mean + old.stddev * randn(ACTION_DIM)
        return [obs, actions, old.log_prob(actions).sum(-1) + 0.2 * randn(), randn(), 0.5 * randn(), 0.5 * randn()]


def assert_close(actual, expected, tolerance):
    """Equal within `tolerance`, relative to the largest element."""
    for name in expected:
        ours, theirs = actual[name].detach().numpy(), expected[name].detach().numpy()
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * np.abs(theirs).max(), err_msg=name)


# --- Loss and update --------------------------------------------------------------------------------------------------


@policies
@pytest.mark.parametrize("norm_adv", [True, False], ids=["norm_adv", "raw_adv"])
@pytest.mark.parametrize("clip_vloss", [True, False], ids=["clip_vloss", "plain_vloss"])
def test_loss_and_gradient(module, flags, norm_adv, clip_vloss):
    agent = make_agent(module, norm_adv=norm_adv, clip_vloss=clip_vloss, ent_coef=0.01, **flags)
    batch, eager = make_batch(agent), eager_copy(agent)
    loss, losses = module.ppo_loss(agent.params, agent.actor, agent.args, *batch)
    expected_loss, expected_losses = eager_loss(eager, agent.args, *batch)
    assert_close({"loss": loss, "losses": losses}, {"loss": expected_loss, "losses": expected_losses}, 1e-10)
    assert 0.1 < losses[module.LOSSES.index("clipfrac")] < 0.9

    grads, _ = torch.func.grad(module.ppo_loss, has_aux=True)(agent.params, agent.actor, agent.args, *batch)
    expected_loss.backward()
    for p in eager.parameters():
        p.data = p.grad  # to read the gradients under the scripts' names
    assert_close(grads, with_our_names(eager), 1e-10)


@policies
def test_update_equals_torch_adam_and_clip_grad_norm(module, flags):
    """200 minibatches, of four iterations with an annealed learning rate; some gradients are clipped, some are not."""
    agent = make_agent(module, max_grad_norm=1.2, ent_coef=0.01, **flags)
    args, moments, eager = agent.args, module.init_moments(agent.params), eager_copy(agent)
    optimizer, rng, norms = make_optimizer(eager, args), np.random.default_rng(0), []
    for iteration in range(4):
        batch, learning_rate = make_batch(agent, seed=iteration), args.learning_rate * (1 - iteration / 4)
        optimizer.param_groups[0]["lr"] = learning_rate
        for step_size in torch.from_numpy(module.adam_step_sizes(learning_rate, 1 + 50 * iteration, 50)):
            index = torch.from_numpy(rng.choice(args.batch_size, 32, replace=False))
            losses = module.update(agent.params, moments, agent.actor, args, batch, index, step_size)
            expected = eager_update(eager, optimizer, args, *(x[index] for x in batch))
            assert_close({"losses": losses}, {"losses": expected}, 1e-9)
            norms.append(losses[-1].item())
    assert min(norms) < 0.9 * args.max_grad_norm and max(norms) > 1.1 * args.max_grad_norm
    assert_close(agent.params, with_our_names(eager), 1e-9)


# --- The epochs over one rollout --------------------------------------------------------------------------------------


class Recorder:
    """Stands in for `update`: keeps what it is called with, and reports the number of the call as every loss."""

    def __init__(self, module):
        self.module, self.rows, self.step_sizes = module, [], []

    def __call__(self, params, moments, actor, args, batch, index, step_size):
        self.rows.append(index.tolist())
        self.step_sizes.append(step_size)
        return torch.full((len(self.module.LOSSES),), float(len(self.rows)))


def test_every_epoch_visits_every_row_once(script):
    agent, recorder = make_agent(script, update_epochs=3), Recorder(script)
    losses, count = script.learn(recorder, agent, {}, [], np.random.default_rng(0), 1e-3, 80)
    assert count == len(recorder.rows) == 3 * 8 and {len(rows) for rows in recorder.rows} == {32}
    epochs = [sum(recorder.rows[i : i + 8], []) for i in (0, 8, 16)]
    assert all(sorted(epoch) == list(range(256)) for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    assert losses == [12.5] * len(script.LOSSES)  # the mean of 1 .. 24
    t = torch.arange(81, 105, dtype=torch.float64)  # Adam's steps go on from the 80 earlier ones
    sizes = torch.stack([1e-3 / (1 - 0.9**t), (1 - 0.999**t) ** -0.5], dim=1)
    torch.testing.assert_close(torch.stack(recorder.step_sizes), sizes.float())


def test_target_kl_ends_the_epochs(script):
    """The KL estimate here is the number of the minibatch: 17 in the third epoch is the first above 16."""
    agent, recorder = make_agent(script, update_epochs=10, target_kl=16.0), Recorder(script)
    losses, count = script.learn(recorder, agent, {}, [], np.random.default_rng(0), 1e-3, 0)
    assert count == len(recorder.rows) == 24 and losses == [12.5] * len(script.LOSSES)


# --- Compilation ------------------------------------------------------------------------------------------------------


def test_a_damaged_compile_cache_is_left_aside(script, monkeypatch, capsys):
    """Compilation is tried again with a new cache; the update must then not be taken for uncompiled."""
    caches = []

    def compile_or_fail(function, **_):
        caches.append(os.environ.get("TORCHINDUCTOR_CACHE_DIR"))
        if len(caches) == 1:
            raise ImportError("main.so: file too short")
        return function

    monkeypatch.setattr(torch, "compile", compile_or_fail)
    agent = make_agent(script, torch.float32)
    assert script.compile_update(agent, script.init_moments(agent.params)) == (script.update, True)
    assert len(set(caches)) == 2 and "failed" not in capsys.readouterr().out


def test_compiled_update_equals_the_eager_one(script):
    agent = make_agent(script, torch.float32)
    moments, batch = script.init_moments(agent.params), make_batch(agent)
    eager_agent, eager_moments = make_agent(script, torch.float32), script.init_moments(agent.params)
    torch._dynamo.reset()  # the compiled code has no guards against the shapes of an earlier test
    update, compiled = script.compile_update(agent, moments)
    assert compiled and update is not script.update
    for ours, untouched in ((agent.params, eager_agent.params), (moments, eager_moments)):
        assert all(torch.equal(ours[name], untouched[name]) for name in untouched)

    results = []
    for function, one, its_moments in ((update, agent, moments), (script.update, eager_agent, eager_moments)):
        rng = np.random.default_rng(0)
        losses = [script.learn(function, one, its_moments, batch, rng, 3e-4, 80 * i)[0] for i in range(2)]
        results.append({"losses": torch.tensor(losses), **one.params})
    torch._dynamo.reset()
    assert_close(*results, 1e-5)


def test_training_goes_on_where_compilation_fails(script, tmp_path):
    flags = "--env-id Pendulum-v1 --num-steps 64 --num-minibatches 2 --update-epochs 2 --total-timesteps 128"
    flags += " --actor-hidden 8 --critic-hidden 8 --eval-episodes 1 --final-eval-episodes 1"
    done = run(f"{script.__name__}.py", *flags.split(), "--run-dir", tmp_path / "run",
               CXX="/nonexistent", TORCHINDUCTOR_CACHE_DIR=str(tmp_path / "cache"))  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert len([line for line in done.stdout.splitlines() if "compilation failed" in line]) == 1
    assert "Traceback" not in done.stdout + done.stderr
    assert json.loads((tmp_path / "run" / "result.json").read_text())["last"]["global_step"] == 128


# --- Actor and rollout ------------------------------------------------------------------------------------------------

SCHEDULES = [(K, schedule) for K in (1, 2, 4, 8) for schedule in ("average", "uniform", "inverse")]
ACTORS = [(ppo_continuous, {})] + [
    (refineppo_continuous, {"refinement_depth": K, "refinement_schedule": schedule}) for K, schedule in SCHEDULES
]


@pytest.mark.parametrize("module, flags", ACTORS, ids=["ppo", *(f"K{K}-{schedule}" for K, schedule in SCHEDULES)])
@pytest.mark.parametrize("hidden", [(16,), (16, 12), (128, 128), (16, 12, 8)], ids=str)
@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-6)], ids=["32", "64"])
def test_actor_in_numpy_in_torch_and_in_the_plain_form(module, flags, hidden, dtype, tolerance):
    agent = make_agent(module, dtype, actor_hidden=hidden, **flags)
    for batch in (1, 100):
        obs = torch.randn(batch, OBS_DIM, generator=torch.Generator().manual_seed(1)).to(dtype)
        in_torch = agent.actor.mean(module.layers(agent.params, "actor"), obs)
        in_numpy = agent.actor.mean(module.layers(agent.arrays(), "actor"), obs.numpy())
        assert in_numpy.shape == (batch, ACTION_DIM) and in_numpy.dtype == obs.numpy().dtype
        assert_close({"mean": torch.from_numpy(in_numpy)}, {"mean": in_torch}, tolerance)
        assert_close({"mean": in_torch}, {"mean": eager_copy(agent).mean(obs)}, tolerance)


@policies
def test_rollout_logprobs_are_those_of_its_actions(module, flags):
    """`collect` computes them from the noise alone."""
    args = module.Args(env_id="Pendulum-v1", num_envs=3, actor_hidden=(16,), log_std_init=-0.7, **flags)
    envs = module.Environments(args.env_id, args.num_envs, args.seed)
    agent = module.Agent(envs.envs[0].observation_space, envs.envs[0].action_space, args)
    agent.params["actor.1.weight"] *= 50
    first_obs = agent.normalizer.observe(envs.obs)
    roll = module.collect(agent, envs, first_obs, 250, np.random.default_rng(0))  # past an episode's end, at 200
    with torch.no_grad():
        mean = eager_copy(agent).mean(torch.from_numpy(roll.obs[:-1]).flatten(0, 1)).view(250, 3, 1)
        logprobs = Normal(mean, agent.params["log_std"].exp()).log_prob(torch.from_numpy(roll.actions)).sum(-1)
    assert mean.std() > 0.1
    np.testing.assert_allclose(roll.logprobs, logprobs.numpy(), rtol=1e-5, atol=1e-5)
