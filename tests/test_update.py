"""The policy, the loss and the update, held equal to the eager reference, torch.optim and torch.distributions."""

import os
from dataclasses import replace
from types import SimpleNamespace

import conftest
import numpy as np
import pytest
import torch
from conftest import policy_mean, run
from reference import Agent, eager_loss, eager_update, make_optimizer
from test_commands import QUICK, read_json

import ppo_continuous
import refineppo_continuous

OBS_DIM, ACTION_DIM = 5, 3
POLICIES = {"ppo": (ppo_continuous, {})}
for depth, schedule in ((1, "average"), (2, "uniform"), (4, "average"), (4, "inverse"), (8, "average")):
    flags = {"refinement_depth": depth, "refinement_schedule": schedule}
    POLICIES[f"{schedule}-{depth}"] = refineppo_continuous, flags
policies = pytest.mark.parametrize("module, flags", POLICIES.values(), ids=POLICIES)


def make_agent(module, dtype=torch.float64, **flags):
    """A small agent of 64 x 4 steps in 8 minibatches, away from the special initial parameters (0 and almost 0)."""
    sizes = {"num_steps": 64, "num_envs": 4, "num_minibatches": 8, "actor_hidden": (16, 16), "critic_hidden": (8, 8)}
    agent = conftest.make_agent(module, OBS_DIM, ACTION_DIM, **sizes | flags)
    generator = torch.Generator().manual_seed(0)
    for name, p in agent.params.items():
        agent.params[name] = (p + 0.1 * torch.randn(p.shape, generator=generator)).to(dtype)
    return agent


def with_our_names(eager: Agent) -> dict[str, torch.Tensor]:
    """The reference's parameters under the scripts' names, the weights as (in, out)."""
    params = {"log_std": eager.log_std}
    for name in ("actor", "critic"):
        for i, linear in enumerate(getattr(eager, name)[::2]):
            params |= {f"{name}.{i}.weight": linear.weight.T, f"{name}.{i}.bias": linear.bias}
    return params


def eager_copy(agent) -> Agent:
    """The reference's agent with the same parameters."""
    obs_dim, action_dim = len(agent.params["critic.0.weight"]), len(agent.params["log_std"])
    eager = Agent(obs_dim, action_dim, agent.args).to(agent.params["log_std"].dtype)
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


# --- The policy -------------------------------------------------------------------------------------------------------


@policies
@pytest.mark.parametrize("hidden", [(16,), (128, 128), (16, 12, 8)], ids=str)
def test_mean_in_numpy_and_in_torch(module, flags, hidden):
    agent = make_agent(module, actor_hidden=hidden, **flags)
    for rows in (1, 100):
        obs = torch.randn(rows, OBS_DIM, generator=torch.Generator().manual_seed(1)).double()
        in_numpy = policy_mean(module, agent.arrays(), agent.args, obs.numpy())
        means = {"numpy": torch.from_numpy(in_numpy), "torch": policy_mean(module, agent.params, agent.args, obs)}
        assert_close(means, dict.fromkeys(means, eager_copy(agent).proposals(obs)[-1]), 1e-12)


@policies
def test_rollout_logprobs_are_those_of_its_actions(module, flags):
    """`collect` computes them from the noise alone."""
    args = module.Args(env_id="Pendulum-v1", num_envs=3, actor_hidden=(16,), log_std_init=-0.7, **flags)
    training = module.Training(args)
    training.agent.params["actor.1.weight"] *= 50
    roll = module.collect(training.agent, training.envs, 250, training.rng)  # past an episode's end, at 200
    with torch.no_grad():
        policy = eager_copy(training.agent).policy(torch.from_numpy(roll.obs[:-1]).flatten(0, 1))
        logprobs = policy.log_prob(torch.from_numpy(roll.actions).flatten(0, 1)).sum(-1)
    assert policy.mean.std() > 0.1
    np.testing.assert_allclose(roll.logprobs.ravel(), logprobs.numpy(), rtol=1e-5, atol=1e-5)


# --- Loss and update --------------------------------------------------------------------------------------------------


@policies
@pytest.mark.parametrize("norm_adv", [True, False], ids=["norm_adv", "raw_adv"])
@pytest.mark.parametrize("clip_vloss", [True, False], ids=["clip_vloss", "plain_vloss"])
def test_loss_and_gradient(module, flags, norm_adv, clip_vloss):
    """The gradient flows through all K steps, as autograd's does in the plain chain."""
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


@pytest.mark.parametrize("update_epochs, target_kl", [(3, None), (10, 16.0)])
def test_every_epoch_visits_every_row_once(script, update_epochs, target_kl):
    """Every loss here, so also the KL estimate, is the number of the minibatch: epochs end with 8, 16 and 24."""
    training = training_of(script, make_agent(script, update_epochs=update_epochs, target_kl=target_kl))
    training.adam.steps, rows, step_sizes = 80, [], []

    def record(params, moments, args, batch, index, step_size):
        rows.append(index.tolist())
        step_sizes.append(step_size)
        return torch.full((len(script.LOSSES),), float(len(rows)))

    losses = script.learn(record, training, make_batch(script, training.agent), 1e-3)
    assert losses == {f"losses/{name}": 12.5 for name in script.LOSSES}  # the mean of 1 .. 24
    assert training.adam.steps == 80 + 24 and [len(minibatch) for minibatch in rows] == [32] * 24
    epochs = np.reshape(rows, (3, 256)).tolist()
    assert all(sorted(epoch) == [*range(256)] for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    t = torch.arange(81, 105, dtype=torch.float64)  # Adam's steps go on from the 80 earlier ones
    sizes = torch.stack([1e-3 / (1 - 0.9**t), (1 - 0.999**t) ** -0.5], dim=1)
    torch.testing.assert_close(torch.stack(step_sizes), sizes.float())


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
    """Compiling changes nothing; a coefficient is annealed through a tensor, as `compile_update` says."""
    ours, eager, untouched = (training_of(script, make_agent(script, torch.float32)) for _ in range(3))
    ent_coef, batch = torch.tensor(0.5), make_batch(script, ours.agent)
    ours.agent.args = eager.agent.args = replace(ours.agent.args, ent_coef=ent_coef)
    update = script.compile_update(ours)
    assert update not in (None, script.update)
    for tensors, before in ((ours.agent.params, untouched.agent.params), (ours.adam.moments, untouched.adam.moments)):
        assert all(torch.equal(tensors[name], before[name]) for name in before)
    for value in (0.5, 5.0):
        ent_coef.fill_(value)
        results = []
        for function, training in ((update, ours), (script.update, eager)):
            losses = torch.tensor(list(script.learn(function, training, batch, 3e-4).values()))
            results.append({"losses": losses, **training.agent.params})
        assert_close(*results, 1e-5)


@pytest.mark.slow
def test_training_goes_on_where_compilation_fails(script, tmp_path):
    flags = (*QUICK, "--compile", "--env-id", "Pendulum-v1", "--run-dir", tmp_path / "run")
    done = run(f"{script.__name__}.py", *flags, CXX="/nonexistent", TORCHINDUCTOR_CACHE_DIR=str(tmp_path / "cache"))
    assert done.returncode == 0 and "Traceback" not in done.stdout + done.stderr, done.stderr
    assert done.stdout.count("compilation failed") == 1
    assert read_json(tmp_path / "run/result.json")["last"]["global_step"] == 64
