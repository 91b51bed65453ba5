"""The loss, the update and the actor, held equal to the eager reference, torch.optim and torch.distributions."""

import json
import os
from dataclasses import replace
from types import SimpleNamespace

import conftest
import numpy as np
import pytest
import torch
from conftest import policy_mean, run
from reference import Agent as EagerAgent
from reference import eager_loss, eager_update, make_optimizer
from test_commands import QUICK

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
    agent = conftest.make_agent(module, OBS_DIM, ACTION_DIM, **sizes | flags)
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


def training_of(module, agent) -> SimpleNamespace:
    """What `learn` and `compile_update` take of a Training, whose environments are not needed here."""
    return SimpleNamespace(agent=agent, adam=module.Adam(agent.params), rng=np.random.default_rng(0))


def make_batch(module, agent, seed=0):
    """A rollout's Batch, whose ratios and values move inside the clip and out of it."""
    generator, size = torch.Generator().manual_seed(seed), agent.args.batch_size

    def randn(*shape):
        return torch.randn(size, *shape, generator=generator).to(agent.params["log_std"].dtype)

    obs = randn(OBS_DIM)
    with torch.no_grad():
        old = eager_copy(agent).policy(obs)
        actions = old.mean + old.stddev * randn(ACTION_DIM)
        logprobs = old.log_prob(actions).sum(-1) + 0.2 * randn()
        return module.Batch(obs, actions, logprobs, randn(), 0.5 * randn(), 0.5 * randn())


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
    batch, eager = make_batch(module, agent), eager_copy(agent)
    loss, losses = module.ppo_loss(agent.params, agent.args, batch)
    expected_loss, expected_losses = eager_loss(eager, agent.args, *batch)
    assert_close({"loss": loss, "losses": losses}, {"loss": expected_loss, "losses": expected_losses}, 1e-10)
    assert 0.1 < losses[module.LOSSES.index("clipfrac")] < 0.9

    grads, _ = torch.func.grad(module.ppo_loss, has_aux=True)(agent.params, agent.args, batch)
    expected_loss.backward()
    for p in eager.parameters():
        p.data = p.grad  # to read the gradients under the scripts' names
    assert_close(grads, with_our_names(eager), 1e-10)


@policies
def test_update_equals_torch_adam_and_clip_grad_norm(module, flags):
    """200 minibatches, of four iterations with an annealed learning rate; some gradients are clipped, some are not."""
    agent = make_agent(module, max_grad_norm=1.2, ent_coef=0.01, **flags)
    args, moments, eager = agent.args, module.Adam(agent.params).moments, eager_copy(agent)
    optimizer, rng, norms = make_optimizer(eager, args), np.random.default_rng(0), []
    for iteration in range(4):
        batch, learning_rate = make_batch(module, agent, seed=iteration), args.learning_rate * (1 - iteration / 4)
        optimizer.param_groups[0]["lr"] = learning_rate
        for t in range(50 * iteration + 1, 50 * iteration + 51):
            step_size = torch.tensor([learning_rate / (1 - 0.9**t), (1 - 0.999**t) ** -0.5], dtype=torch.float64)
            index = torch.from_numpy(rng.choice(args.batch_size, 32, replace=False))
            losses = module.update(agent.params, moments, args, batch, index, step_size)
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

    def __call__(self, params, moments, args, batch, index, step_size):
        self.rows.append(index.tolist())
        self.step_sizes.append(step_size)
        return torch.full((len(self.module.LOSSES),), float(len(self.rows)))


def test_every_epoch_visits_every_row_once(script):
    training, recorder = training_of(script, make_agent(script, update_epochs=3)), Recorder(script)
    training.adam.steps = 80
    losses = script.learn(recorder, training, make_batch(script, training.agent), 1e-3)
    assert training.adam.steps - 80 == len(recorder.rows) == 3 * 8 and {len(rows) for rows in recorder.rows} == {32}
    epochs = [sum(recorder.rows[i : i + 8], []) for i in (0, 8, 16)]
    assert all(sorted(epoch) == list(range(256)) for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    assert losses == {f"losses/{name}": 12.5 for name in script.LOSSES}  # the mean of 1 .. 24
    t = torch.arange(81, 105, dtype=torch.float64)  # Adam's steps go on from the 80 earlier ones
    sizes = torch.stack([1e-3 / (1 - 0.9**t), (1 - 0.999**t) ** -0.5], dim=1)
    torch.testing.assert_close(torch.stack(recorder.step_sizes), sizes.float())


def test_target_kl_ends_the_epochs(script):
    """The KL estimate here is the number of the minibatch: 17 in the third epoch is the first above 16."""
    training, recorder = training_of(script, make_agent(script, update_epochs=10, target_kl=16.0)), Recorder(script)
    losses = script.learn(recorder, training, make_batch(script, training.agent), 1e-3)
    assert training.adam.steps == len(recorder.rows) == 24
    assert losses == {f"losses/{name}": 12.5 for name in script.LOSSES}


# --- Compilation ------------------------------------------------------------------------------------------------------


@pytest.fixture
def fresh_dynamo():
    """The compiled code has no guards against the shapes and numbers of another test."""
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


def test_a_damaged_compile_cache_is_left_aside(script, monkeypatch, capsys, fresh_dynamo):
    """Compilation is tried again with a new cache; the update must then not be taken for uncompiled."""
    caches, really_compile = [], torch.compile

    def fail_first(function, **_):
        caches.append(os.environ.get("TORCHINDUCTOR_CACHE_DIR"))
        if len(caches) == 1:
            raise ImportError("main.so: file too short")
        return really_compile(function, backend="eager")

    monkeypatch.setattr(torch, "compile", fail_first)
    assert script.compile_update(training_of(script, make_agent(script, torch.float32))) not in (None, script.update)
    assert len(set(caches)) == 2 and "uncompiled" not in capsys.readouterr().out


@pytest.mark.slow
def test_compiled_update_equals_the_eager_one(script, fresh_dynamo):
    ours, eager, untouched = (training_of(script, make_agent(script, torch.float32)) for _ in range(3))
    update, batch, results = script.compile_update(ours), make_batch(script, ours.agent), []
    assert update not in (None, script.update)
    for tensors, before in ((ours.agent.params, untouched.agent.params), (ours.adam.moments, untouched.adam.moments)):
        assert all(torch.equal(tensors[name], before[name]) for name in before)
    for function, training in ((update, ours), (script.update, eager)):
        losses = [list(script.learn(function, training, batch, 3e-4).values()) for _ in range(2)]
        results.append({"losses": torch.tensor(losses), **training.agent.params})
    assert_close(*results, 1e-5)


@pytest.mark.slow
def test_a_coefficient_is_annealed_through_a_tensor(fresh_dynamo):
    """As `compile_update` says: a tensor in `agent.args`, set before compiling and filled while training."""
    script = refineppo_continuous
    training = training_of(script, make_agent(script, torch.float32))
    agent, ent_coef = training.agent, torch.tensor(0.5)
    agent.args = replace(agent.args, ent_coef=ent_coef)
    update, batch, eager = script.compile_update(training), make_batch(script, agent), eager_copy(agent)
    optimizer, index, norms = make_optimizer(eager, agent.args), torch.arange(32), []
    for value, step_size in zip((0.5, 5.0), training.adam.step_sizes(agent.args.learning_rate, 2)):
        ent_coef.fill_(value)
        losses = update(agent.params, training.adam.moments, agent.args, batch, index, step_size)
        with_the_number = replace(agent.args, ent_coef=value)
        expected = eager_update(eager, optimizer, with_the_number, *(x[index] for x in batch))
        assert_close({"losses": losses, **agent.params}, {"losses": expected, **with_our_names(eager)}, 1e-5)
        norms.append(losses[-1].item())
    assert norms[1] > 2 * norms[0]  # the second value is seen in the gradient


@pytest.mark.slow
def test_training_goes_on_where_compilation_fails(script, tmp_path):
    flags = (*QUICK, "--compile", "--env-id", "Pendulum-v1", "--run-dir", tmp_path / "run")
    done = run(f"{script.__name__}.py", *flags, CXX="/nonexistent", TORCHINDUCTOR_CACHE_DIR=str(tmp_path / "cache"))
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("compilation failed") == 1
    assert "Traceback" not in done.stdout + done.stderr
    assert json.loads((tmp_path / "run" / "result.json").read_text())["last"]["global_step"] == 64


# --- Actor and rollout ------------------------------------------------------------------------------------------------

SCHEDULES = [(K, schedule) for K in (1, 2, 4, 8) for schedule in ("average", "uniform", "inverse")]
ACTORS = [(ppo_continuous, {})] + [
    (refineppo_continuous, {"refinement_depth": K, "refinement_schedule": schedule}) for K, schedule in SCHEDULES
]


@pytest.mark.parametrize("module, flags", ACTORS, ids=["ppo", *(f"K{K}-{schedule}" for K, schedule in SCHEDULES)])
@pytest.mark.parametrize("hidden", [(16,), (16, 12), (128, 128), (16, 12, 8)], ids=str)
@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-6)], ids=["32", "64"])
def test_mean_in_numpy_in_torch_and_in_the_plain_form(module, flags, hidden, dtype, tolerance):
    agent = make_agent(module, dtype, actor_hidden=hidden, **flags)
    for batch in (1, 100):
        obs = torch.randn(batch, OBS_DIM, generator=torch.Generator().manual_seed(1)).to(dtype)
        in_torch = policy_mean(module, agent.params, agent.args, obs)
        in_numpy = policy_mean(module, agent.arrays(), agent.args, obs.numpy())
        assert in_numpy.shape == (batch, ACTION_DIM) and in_numpy.dtype == obs.numpy().dtype
        assert_close({"mean": torch.from_numpy(in_numpy)}, {"mean": in_torch}, tolerance)
        assert_close({"mean": in_torch}, {"mean": eager_copy(agent).mean(obs)}, tolerance)


@policies
def test_rollout_logprobs_are_those_of_its_actions(module, flags):
    """`collect` computes them from the noise alone."""
    args = module.Args(env_id="Pendulum-v1", num_envs=3, actor_hidden=(16,), log_std_init=-0.7, **flags)
    training = module.Training(args)
    training.agent.params["actor.1.weight"] *= 50
    roll = module.collect(training.agent, training.envs, 250, training.rng)  # past an episode's end, at 200
    with torch.no_grad():
        policy = eager_copy(training.agent).policy(torch.from_numpy(roll.obs[:-1]))
        logprobs = policy.log_prob(torch.from_numpy(roll.actions)).sum(-1)
    assert policy.mean.std() > 0.1
    np.testing.assert_allclose(roll.logprobs, logprobs.numpy(), rtol=1e-5, atol=1e-5)
