import copy
import io

import pytest
import torch
from tensordict import TensorDict

from mjcollect.learning.ddpg import make_buffer, sample
from mjcollect.learning.fast_ddpg import LEARNERS
from mjcollect.learning.lessons import Lessons
from mjcollect.learning.norm_relu import norm_relu_backward, torch_backward

SETTINGS = {
    "width": 32, "gamma": 0.97, "alpha_actor": 1e-3, "alpha_critic": 2e-3, "alpha_target": 0.05,
    "final_rate": 0.1, "total_updates": 10, "average_rate": 0.1,
}  # fmt: skip
SIZE = 11
KINDS = sorted(LEARNERS)


def make(kind, size=SIZE, **changes):
    torch.manual_seed(1)
    return LEARNERS[kind](size, **SETTINGS | changes)


def batch(n, seed, size=SIZE):
    rng = torch.Generator().manual_seed(seed)
    return TensorDict(
        {
            "observation": torch.randn(n, size, generator=rng),
            "action": torch.rand(n, 3, generator=rng) * 2 - 1,
            "next": {
                "observation": torch.randn(n, size, generator=rng),
                "reward": torch.randn(n, 1, generator=rng),
                "done": torch.rand(n, 1, generator=rng) < 0.4,  # a time-out is not terminated
                "terminated": torch.rand(n, 1, generator=rng) < 0.2,
            },
        },
        [n],
    )


def filled(seed=0):
    buffer = make_buffer(500, 16, seed)
    buffer.extend(batch(400, seed=9))
    return buffer


def vector(module):
    return torch.cat([p.detach().flatten() for p in module.parameters()])


@pytest.fixture
def double():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def close(one, other, tolerance):
    torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance)


def lessons(size, weight, seed=3):
    rng = torch.Generator().manual_seed(seed)
    seen, actions = torch.randn(50, size, generator=rng), torch.rand(50, 3, generator=rng) - 0.5
    return Lessons(seen, actions, weight=weight, batch=7, seed=seed)


def check_lean_is_torchrl(size, n, tolerance, steps, taught=False, **changes):
    """Losses, gradients, parameters, targets and averages of both over several updates."""
    lean, plain = make("lean", size, **changes), make("torchrl", size, **changes)
    loss, lesson = plain.loss, ()
    if taught:
        lean.lessons = plain.lessons = lessons(size, 0.7)
    for step in range(6):
        part = batch(n, seed=step, size=size)
        if steps:
            part["steps_to_next_obs"] = torch.arange(n)[:, None] % 5 + 1
        expected = plain.loss(part.clone())
        loss.zero_grad()
        expected["loss_value"].backward()
        expected["loss_actor"].backward()
        if taught:
            lesson = lean.lessons.sample(1)
            miss = plain.actor(observation=lesson[0])[-1] - lesson[1]
            (0.7 * (miss**2).sum() / 7).backward()
        with torch.no_grad():
            critic_loss, actor_loss = lean._gradient(*lean._columns(part), *lesson)
        close(critic_loss, expected["loss_value"].detach(), tolerance)
        close(actor_loss, expected["loss_actor"].detach(), tolerance)
        for module, got in zip((plain.critic, plain.actor), lean._gradients, strict=True):
            wanted = torch.cat([p.grad.flatten() for p in module.parameters()])
            assert wanted.abs().max() > 1e-4
            close(got.flat / wanted.abs().max(), wanted / wanted.abs().max(), tolerance)
        close(lean.update(part, lesson), plain.update(part.clone(), lesson), tolerance)
        for name in ("actor", "critic", "averaged"):
            close(vector(getattr(lean, name)), vector(getattr(plain, name)), tolerance)
        for module, targets in (
            (lean.target_actor, loss.target_actor_network_params),
            (lean.target_critic, loss.target_value_network_params),
        ):
            targets = dict(targets.flatten_keys(".").items())
            for name, parameter in module.named_parameters():
                close(parameter.data, targets[name].data, tolerance)
    assert not torch.allclose(vector(lean.target_actor), vector(lean.actor), atol=1e-3)


@pytest.mark.parametrize("steps", [False, True])
def test_lean_update_is_torchrls(steps):
    """In single precision, up to the rounding of sums of 256, whose order differs by processor."""
    check_lean_is_torchrl(45, 256, 256 * 2.0**-24, steps, width=128)


@pytest.mark.parametrize("taught", [False, True])
@pytest.mark.parametrize("steps", [False, True])
def test_lean_update_is_torchrls_in_double_precision(double, steps, taught):
    check_lean_is_torchrl(SIZE, 20, 1e-10, steps, taught, alpha_actor=1e-2, alpha_critic=1e-2)


def test_both_learners_draw_the_same_lessons(double):
    """And what they learn from them brings the actor nearer to the teacher."""
    learners = [make(kind, total_updates=300) for kind in KINDS]
    for learner in learners:
        learner.lessons = lessons(SIZE, 10.0)
        with torch.no_grad():
            before = learner.actor(observation=learner.lessons.observations)[-1]
        learner.learn(filled(), 300)
        after = learner.actor(observation=learner.lessons.observations)[-1].detach()
        wanted = learner.lessons.actions
        assert (after - wanted).norm() < 0.5 * (before - wanted).norm()
    close(vector(learners[0].actor), vector(learners[1].actor), 1e-6)


def test_lessons_go_on_where_they_were():
    whole, other = lessons(SIZE, 1.0), lessons(SIZE, 1.0)
    whole.sample(3)
    other.load_state_dict(whole.state_dict())
    close(whole.sample(2), other.sample(2), 0.0)


@pytest.mark.parametrize("backward", [norm_relu_backward, torch_backward])
def test_gradient_of_norm_and_relu_is_autograds(double, backward):
    """Compiled for the CPU, and the torch version for other devices."""
    rng = torch.Generator().manual_seed(0)
    z, d = (torch.randn(30, 9, generator=rng) * 2 for _ in range(2))
    scale, shift = (torch.randn(9, generator=rng) for _ in range(2))
    bias, rows = torch.zeros(9, requires_grad=True), 20
    leaves = [tensor.clone().requires_grad_() for tensor in (z, scale, shift)]
    wanted = torch.nn.functional.layer_norm(leaves[0] + bias, (9,), *leaves[1:]).relu()
    to_z = torch.autograd.grad(wanted, leaves[0], d, retain_graph=True)[0]
    to_rest = torch.autograd.grad(wanted[:rows], [bias, *leaves[1:]], d[:rows])
    y, mean, rstd = torch.native_layer_norm(z, (9,), scale, shift, 1e-5)
    out = tuple(torch.full((9,), 7.0) for _ in range(3))
    got = backward(d.clone(), y.relu(), z, mean, rstd, scale, rows, out)
    close(got, to_z, 1e-12)
    close(out, to_rest, 1e-12)


@pytest.mark.parametrize("steps", ["adam", "sgd"])
@pytest.mark.parametrize("kind", KINDS)
def test_updates_follow_algorithm_1(double, kind, steps):
    """Several updates against plain modules, autograd, and one Adam each or plain steps."""
    learner = make(kind, optimizer=steps)
    actor, critic = copy.deepcopy(learner.actor), copy.deepcopy(learner.critic)
    nets, averaged = (actor, critic), copy.deepcopy(actor)
    targets = copy.deepcopy(nets)
    optimizers = [torch.optim.Adam(net.parameters()) for net in nets]

    def q(net, s, a):
        return net(s, a)

    def pi(net, s):
        return net(observation=s)[1]

    def move(old, new, rate):
        with torch.no_grad():
            for p, r in zip(old.parameters(), new.parameters(), strict=True):
                p.copy_((1 - rate) * p + rate * r)

    for step in range(12):
        part = batch(24, seed=step)
        s, a, after = part["observation"], part["action"], part["next"]
        with torch.no_grad():
            follow = q(targets[1], after["observation"], pi(targets[0], after["observation"]))
            u = after["reward"] + SETTINGS["gamma"] * follow * (~after["terminated"])
        losses = (-q(critic, s, pi(actor, s)).mean(), (u - q(critic, s, a)).pow(2).mean())
        gradients = [
            torch.autograd.grad(loss, list(net.parameters()), retain_graph=True)
            for loss, net in zip(losses, nets, strict=True)
        ]
        factor = 1.0 - 0.9 * min(step / 10, 1.0)  # falls to final_rate over total_updates
        rates = (SETTINGS["alpha_actor"], SETTINGS["alpha_critic"])
        for net, optimizer, gradient, rate in zip(nets, optimizers, gradients, rates, strict=True):
            for p, g in zip(net.parameters(), gradient, strict=True):
                p.grad = g
                if steps == "sgd":
                    p.data -= rate * factor * g
            if steps == "adam":
                optimizer.param_groups[0]["lr"] = rate * factor
                optimizer.step()
        for target, net in zip(targets, nets, strict=True):
            move(target, net, SETTINGS["alpha_target"])
        move(averaged, actor, SETTINGS["average_rate"])
        got = learner.update(part)
        close(got, (losses[1].detach(), losses[0].detach()), 1e-9)
        close(vector(learner.critic), vector(critic), 1e-9)
        close(vector(learner.actor), vector(actor), 1e-9)
        close(vector(learner.averaged), vector(averaged), 1e-9)


def test_one_call_draws_the_batches_of_many():
    one, many = filled(), filled()
    drawn = sample(one, 5)
    for part in drawn.split(16):
        assert (part == many.sample()).all()
    assert (sample(one, 1) == many.sample()).all()  # the streams stay together


@pytest.mark.parametrize("kind", KINDS)
def test_learn_is_updates_on_the_buffers_samples(kind):
    one, other = make(kind), make(kind)
    one_buffer, other_buffer = filled(), filled()
    losses = one.learn(one_buffer, 7)
    wanted = [torch.stack(other.update(other_buffer.sample())) for _ in range(7)]
    assert torch.equal(losses, torch.stack(wanted))
    assert not losses.requires_grad
    assert one.updates == other.updates == 7
    for name in ("actor", "critic", "averaged"):
        assert torch.equal(vector(getattr(one, name)), vector(getattr(other, name)))


@pytest.mark.parametrize("kind", KINDS)
def test_state_resumes_exactly(kind):
    whole, first = make(kind), make(kind)
    for learner, count in ((whole, 6), (first, 3)):
        for step in range(count):
            learner.update(batch(16, seed=step))
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    kept = first.state_dict()
    first.update(batch(16, seed=77))  # a state is a copy: later updates leave it alone
    for state in (torch.load(file, weights_only=True), kept):
        second = make(kind)
        second.update(batch(16, seed=5))
        second.load_state_dict(state)
        assert second.updates == 3
        for step in range(3, 6):
            second.update(batch(16, seed=step))
        for name in ("actor", "critic", "averaged"):
            assert torch.equal(vector(getattr(second, name)), vector(getattr(whole, name)))


@pytest.mark.parametrize("kind", KINDS)
def test_actor_can_be_loaded_and_saved_like_any_module(kind):
    """Weights set from outside take part in the next update; the file holds the actor alone."""
    learner, other = make(kind), make(kind)
    for step in range(3):
        other.update(batch(16, seed=step))
    learner.actor.load_state_dict(other.actor.state_dict())
    s = batch(16, seed=4)["observation"]
    with torch.no_grad():
        expected = -learner.critic(s, other.actor(observation=s)[1]).mean()
    close(learner.update(batch(16, seed=4))[1], expected, 1e-6)
    file = io.BytesIO()
    torch.save(learner.actor.state_dict(), file)
    assert len(file.getvalue()) < 4 * len(vector(learner.actor)) + 6000
