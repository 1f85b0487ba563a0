import dataclasses
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from mjcollect.envs.batch import BatchedFlightEnv
from mjcollect.envs.course import Course
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.ddpg import Learner, algorithm_1, make_buffer
from mjcollect.learning.evaluation import Evaluation, Evaluator
from mjcollect.learning.policy import TrainedPolicy
from mjcollect.learning.random_streams import stream, torch_seed
from mjcollect.learning.trainer import make_simulations, segment_trainer
from mjcollect.scene.scene import Scene
from train.support.run_folder import RunFolder

SMALL = LearnConfig(
    updates=120, extra_updates=0, envs=8, u2=4, batch=32, buffer=2000, width=16,
    demonstrations=400, eval_every=60, eval_episodes=3, threads=1,
)  # fmt: skip


@pytest.fixture(scope="module")
def course():
    scene = Scene(
        name="gate",
        seed=0,
        bounds=[[0, 0, 0], [200, 200, 200]],
        depot=[100, 20, 100],
        items=[[100, 180, 100]],
        obstacles=[[[70, 90, 60], [130, 110, 140]]],
    )
    return Course.segment(scene, (0,), 0)


def weights(trainer):
    return torch.cat([p.detach().flatten() for p in trainer.learner.actor.parameters()])


def trained(course, config, seed=0):
    trainer = segment_trainer(course, config, seed)
    for _ in trainer.run():
        pass
    trainer.close()
    return trainer


def test_same_seed_same_policy_other_seed_another(course):
    one, two, other = (trained(course, SMALL, seed) for seed in (3, 3, 4))
    assert torch.equal(weights(one), weights(two))
    assert str(one.rows) == str(two.rows)
    assert not torch.equal(weights(one), weights(other))


def test_weights_are_evaluated_before_they_change(course):
    own = TrainedPolicy(segment_trainer(course, SMALL, 5).learner.actor, SMALL.observation)
    trainer = segment_trainer(course, SMALL, 0, policy=own)
    begun = torch.cat([p.flatten() for p in own.actor.parameters()])
    assert torch.equal(weights(trainer), begun)
    next(trainer.run())
    assert trainer.rows[0]["update"] == 0
    assert trainer.rows[0]["eval_return"] == trainer.evaluator(own).mean_return
    trainer.close()


@pytest.mark.parametrize("stop_after", [1, 15, 29])
def test_stopped_and_resumed_equals_one_go(course, tmp_path, stop_after):
    whole = trained(course, SMALL)
    folder = RunFolder(tmp_path)
    first = segment_trainer(course, SMALL, 0)
    for rounds, _ in enumerate(first.run(), start=1):
        if rounds == stop_after:
            break
    folder.save_checkpoint(trainer=first, buffer=first.buffer)
    first.close()
    second = segment_trainer(course, SMALL, 0)
    assert folder.load_checkpoint(trainer=second, buffer=second.buffer)
    for _ in second.run():
        pass
    second.close()
    assert torch.equal(weights(whole), weights(second))
    assert str(whole.rows) == str(second.rows)
    assert (whole.env_steps, whole.episodes) == (second.env_steps, second.episodes)
    assert whole.best_policy.keys() == second.best_policy.keys()
    for name, value in whole.best_policy.items():
        assert torch.equal(value, second.best_policy[name])


def test_both_actors_are_reported(course):
    trainer = trained(course, SMALL)
    last, evaluator = trainer.rows[-1], Evaluator([course], SMALL, seed=0)
    averaged = evaluator(TrainedPolicy(trainer.learner.averaged, SMALL.observation))
    plain = evaluator(TrainedPolicy(trainer.learner.actor, SMALL.observation))
    evaluator.close()
    assert str(trainer.last) == str(averaged)  # NaN where nothing arrives
    for name, result in (("actor", plain), ("average", averaged)):
        cost = result.mean_cost if result.success_rate == 1.0 else math.nan
        np.testing.assert_equal(last[f"eval_{name}_cost"], cost)
        np.testing.assert_equal(last[f"eval_{name}_time"], result.point_time)
    better = max(plain, averaged, key=lambda result: result.rank)
    np.testing.assert_equal(last["eval_time"], better.point_time)
    assert last["eval_shield_share"] == better.shield_share


def test_without_an_average_the_last_is_the_actors(course):
    trainer = trained(course, dataclasses.replace(SMALL, average_rate=0.0))
    evaluator = Evaluator([course], SMALL, seed=0)
    plain = evaluator(TrainedPolicy(trainer.learner.actor, SMALL.observation))
    evaluator.close()
    assert str(trainer.last) == str(plain)
    for row in trainer.rows:
        assert math.isnan(row["eval_average_cost"])
        assert math.isnan(row["eval_average_time"])


def test_the_share_of_slots_is_counted_from_evaluation_to_evaluation(course, monkeypatch):
    trainer = segment_trainer(course, SMALL, 0)
    acted, steps = [], []
    operate, step = trainer._operate, trainer.env.simulations.step

    def stepped(action):
        outcome = step(action)
        acted.append(outcome.shielded.copy())
        return outcome

    def operated(guided):
        operate(guided)
        steps.append(len(trainer.rows))

    monkeypatch.setattr(trainer.env.simulations, "step", stepped)
    monkeypatch.setattr(trainer, "_operate", operated)
    for _ in trainer.run():
        pass
    trainer.close()
    for index, row in enumerate(trainer.rows):
        own = [shares for shares, rows in zip(acted, steps, strict=True) if rows == index]
        assert row["shield_share"] == pytest.approx(np.mean(own))
    assert trainer.rows[0]["shield_share"] > 0.0
    assert all(0.0 <= row["eval_shield_share"] <= 1.0 for row in trainer.rows)


def test_without_a_shield_none_acts(course):
    trainer = trained(course, dataclasses.replace(SMALL, shield=False))
    assert {row["shield_share"] for row in trainer.rows} == {0.0}
    assert {row["eval_shield_share"] for row in trainer.rows} == {0.0}
    assert any(row["crash_rate"] > 0.0 for row in trainer.rows)


def test_the_law_is_evaluated_like_a_policy(course):
    evaluator = Evaluator([course], SMALL, seed=0)
    law = evaluator.law()
    assert law.success_rate == law.point_rate == 1.0
    assert law == evaluator(lambda _: evaluator.sims.episodes.guidance_action())
    evaluator.close()


def test_budget_grows_only_without_success(course):
    trainer = segment_trainer(course, dataclasses.replace(SMALL, extra_updates=40), 0)
    assert trainer.budget == 160
    trainer.best = Evaluation(1.0, True, 5.0, 5.0, 5.0, 0.0)
    assert trainer.budget == 120
    trainer.close()


def test_update_follows_algorithm_1():
    """One update against the formulas of Algorithm 1 written out in plain torch."""
    torch.manual_seed(0)
    size, gamma, tau = 7, 0.9, 0.25
    learner = Learner(
        size, width=16, gamma=gamma, alpha_actor=1e-2, alpha_critic=1e-2, alpha_target=tau,
        final_rate=1.0, total_updates=10,
    )  # fmt: skip
    batch = TensorDict(
        {
            "observation": torch.randn(32, size),
            "action": torch.rand(32, 3) * 2 - 1,
            "next": {
                "observation": torch.randn(32, size),
                "reward": torch.randn(32, 1),
                "done": torch.ones(32, 1, dtype=torch.bool),  # time-outs too: bootstrap through
                "terminated": torch.rand(32, 1) < 0.3,
            },
        },
        [32],
    )

    def q(s, a):
        return learner.critic(TensorDict({"observation": s, "action": a}, [32]))[
            "state_action_value"
        ]

    def pi(s):
        return learner.actor(TensorDict({"observation": s}, [32]))["action"]

    after = batch["next"]
    with torch.no_grad():  # at the start the targets equal the networks
        u = after["reward"] + gamma * q(after["observation"], pi(after["observation"])) * (
            ~after["terminated"]
        )
    critic_loss = (u - q(batch["observation"], batch["action"])).pow(2).mean()
    grad = torch.autograd.grad(critic_loss, list(learner.critic.parameters()))
    actor_loss = -q(batch["observation"], pi(batch["observation"])).mean()
    before = [p.detach().clone() for p in learner.critic.parameters()]
    target = learner.loss.target_value_network_params.flatten_keys().clone()
    got_critic, got_actor = learner.update(batch)
    torch.testing.assert_close(got_critic, critic_loss.detach())
    torch.testing.assert_close(got_actor, actor_loss.detach())
    for old, g, new in zip(before, grad, learner.critic.parameters(), strict=True):
        # Adam's first step is the rate times the sign of the gradient (up to its epsilon).
        clear = g.abs() > 1e-5
        torch.testing.assert_close((old - new)[clear], 1e-2 * g.sign()[clear], rtol=2e-3, atol=1e-6)
    online = learner.loss.value_network_params.flatten_keys()
    for name, value in learner.loss.target_value_network_params.flatten_keys().items():
        torch.testing.assert_close(value, (1 - tau) * target[name] + tau * online[name].detach())


def test_buffer_samples_by_its_own_stream():
    def draw():
        buffer = make_buffer(100, 8, seed=5)
        buffer.extend(TensorDict({"x": torch.arange(100.0)}, [100]))
        torch.rand(3)
        return buffer.sample()["x"]

    torch.manual_seed(0)
    first = draw()
    torch.manual_seed(1)
    assert torch.equal(first, draw())


def test_streams_are_named():
    one = np.random.default_rng(stream(0, "start")).random(4)
    assert np.array_equal(one, np.random.default_rng(stream(0, "start")).random(4))
    assert not np.array_equal(one, np.random.default_rng(stream(0, "noise")).random(4))


@pytest.mark.parametrize(
    ("field", "value"),
    [("updates", 0), ("envs", 0), ("buffer", 10), ("noise_max", 0.0), ("gamma", 1.0),
     ("observation", "camera"), ("reward", "free"), ("eval_episodes", 0)],
)  # fmt: skip
def test_bad_settings_name_the_field(field, value):
    with pytest.raises(ValueError, match=field):
        LearnConfig(**{field: value})


@pytest.mark.slow
def test_learns_to_fly_round_the_gate(course):
    """A short budget arrives from everywhere."""
    config = LearnConfig(updates=4000)
    evaluator = Evaluator([course], config, seed=0)
    law = evaluator.law()
    untrained = evaluator(segment_trainer(course, config, 0).policy)
    evaluator.close()
    best = trained(course, config).best
    assert best.success_rate == 1.0
    assert untrained.success_rate < 0.5  # learned, not given
    assert best.mean_time < 1.1 * law.mean_time


def test_the_training_loop_is_algorithm_1(course):
    """Without demonstrations, the trainer's weights are those of the plain loop, bit for bit."""
    config = dataclasses.replace(
        SMALL, updates=40, learner="torchrl", demonstrations=0, guided_share=0.0, noise_min=0.2,
        noise_max=0.2, actor_delay=0,
    )  # fmt: skip
    trainer = trained(course, config)
    torch.manual_seed(torch_seed(0, "torch"))
    env = BatchedFlightEnv(make_simulations([course], config, 0))
    learner = Learner(
        env.observation_spec["observation"].shape[-1], width=config.width, gamma=config.gamma,
        alpha_actor=config.alpha_actor, alpha_critic=config.alpha_critic,
        alpha_target=config.alpha_target, final_rate=config.final_rate, total_updates=40,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(torch_seed(0, "noise"))
    torch.randperm(config.envs, generator=generator)  # the trainer shuffles its simulations' noise
    buffer = make_buffer(config.buffer, config.batch, torch_seed(0, "replay"))
    algorithm_1(
        env, learner, buffer, updates=40, u1=config.u1, u2=config.u2, noise=0.2,
        generator=generator,
    )  # fmt: skip
    env.close()
    plain = torch.cat([p.detach().flatten() for p in learner.actor.parameters()])
    assert learner.updates == trainer.learner.updates == 40
    assert torch.equal(plain, weights(trainer))
