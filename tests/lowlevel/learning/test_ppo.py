from __future__ import annotations

import dataclasses
import io
import math

import pytest
import torch
from small_learner import (
    COMMANDS,
    MIRRORS,
    NETWORKS,
    SIZES,
    asymmetry,
    best_action,
    make_ppo,
    observation,
    run_update,
    tracking_error,
)

from lowlevel.learning.learner import adapted_rate, clipped_surrogate
from lowlevel.learning.ppo import PPO, NonFiniteError, PPOConfig
from lowlevel.learning.symmetry import TensorMirrors

FAST = {"critic_learning_rate": 2e-3, "actor_learning_rate": 1e-3, "initial_std": 0.3}


def test_clipped_surrogate_by_hand() -> None:
    # ratios 1, 1.5, 1.5, 0.5, 0.5 with advantages 2, 1, -1, 1, -1 and clip 0.2
    log_ratio = torch.tensor([1.0, 1.5, 1.5, 0.5, 0.5]).log()
    advantage = torch.tensor([2.0, 1.0, -1.0, 1.0, -1.0])
    loss = clipped_surrogate(log_ratio - 3.0, torch.full((5,), -3.0), advantage, 0.2)
    torch.testing.assert_close(loss, torch.tensor([-2.0, -1.2, 1.5, -0.5, 0.8]))


def test_learning_rate_follows_the_kl_divergence() -> None:
    bounds = (1e-5, 1e-3)
    assert adapted_rate(3e-4, 0.021, 0.01, bounds) == pytest.approx(2e-4)
    assert adapted_rate(3e-4, 0.004, 0.01, bounds) == pytest.approx(4.5e-4)
    assert adapted_rate(3e-4, 0.01, 0.01, bounds) == 3e-4
    assert adapted_rate(1.2e-5, 1.0, 0.01, bounds) == 1e-5
    assert adapted_rate(9e-4, 0.0, 0.01, bounds) == 1e-3
    assert adapted_rate(3e-4, 1.0, 0.0, bounds) == 3e-4


def test_only_the_actor_rate_adapts() -> None:
    ppo = make_ppo(desired_kl=1e-9, epochs=4)
    run_update(ppo, 0)
    rates = {name: o.param_groups[0]["lr"] for name, o in ppo.learner.optimizers.items()}
    assert rates == {"actor": 1e-5, "critic": 5e-4, "estimator": 5e-4}


def test_a_continued_run_has_the_rates_of_its_configuration() -> None:
    first = make_ppo()
    first.learner.optimizers["actor"].param_groups[0]["lr"] = 1e-3
    second = make_ppo(critic_learning_rate=1e-4, estimator_learning_rate=2e-4, actor_learning_rate_bounds=(1e-5, 6e-4))
    second.load_state_dict(first.state_dict())
    rates = {name: o.param_groups[0]["lr"] for name, o in second.learner.optimizers.items()}
    assert rates == {"actor": 6e-4, "critic": 1e-4, "estimator": 2e-4}


def test_kl_is_that_of_two_gaussians() -> None:
    ppo = make_ppo(mirror_loss_weight=0.0, epochs=1, minibatches=1)
    run_update(ppo, 0)
    generator = torch.Generator().manual_seed(1)
    observed = observation(generator, 32)
    for _ in range(12):
        ppo.act(observed)
        never = torch.zeros(32, dtype=torch.bool)
        ppo.record(torch.randn(32, generator=generator), never, never, observed["privileged"])
    old_mean, old_std = ppo.storage.flat("mean").clone(), ppo.actor.log_std.detach().exp()
    with torch.no_grad():
        ppo.actor.log_std.add_(torch.tensor([0.1, -0.2, 0.0, 0.3]))
        ppo.actor.head.output_bias.add_(0.2)  # every expert proposes 0.2 more
    new_std = ppo.actor.log_std.detach().exp()
    index = torch.arange(ppo.storage.size)
    losses = ppo.learner.losses(ppo._samples(index, estimating=False), None, old_std, estimating=False)
    expected = torch.log(new_std / old_std) + (old_std**2 + 0.2**2) / (2 * new_std**2) - 0.5
    assert old_mean.shape == (384, 4)
    assert float(losses["kl"]) == pytest.approx(float(expected.sum()), rel=1e-4)


def test_learns_to_track_a_linear_function_of_the_frame_and_the_mirror_loss_keeps_it_symmetric() -> None:
    asymmetries = []
    for weight in (0.0, 1.0):
        ppo = make_ppo(64, mirror_loss_weight=weight, **FAST)
        before = tracking_error(ppo)
        figures = [run_update(ppo, seed) for seed in range(8)]
        assert tracking_error(ppo) < 0.5 * before, weight
        assert all(math.isfinite(number) for update in figures for number in update.values())
        assert ("asymmetry" in figures[0]) == (weight > 0.0)
        asymmetries.append(asymmetry(ppo))
    assert asymmetries[1] < 0.4 * asymmetries[0]


def test_mirror_images_are_consistent_with_the_mirrors() -> None:
    ppo = make_ppo(epochs=1)
    run_update(ppo, 0)
    storage = ppo.storage
    images = ppo._images(torch.arange(12))
    assert images is not None
    assert torch.equal(images["frame"], ppo.mirrors("history", storage.flat("history")[9:12])[:, -SIZES.frame :])
    assert torch.equal(images["elevation_map"], ppo.mirrors("elevation_map", storage.flat("elevation_map")[9:12]))


def test_tensor_mirrors_check_what_they_are_given() -> None:
    cpu = torch.device("cpu")
    mirrors = TensorMirrors(MIRRORS, SIZES, cpu)
    action = torch.randn(3, 4)
    assert torch.equal(mirrors("action", mirrors("action", action)), action)
    with pytest.raises(ValueError, match="no mirror was given for privileged"):
        TensorMirrors({key: mirror for key, mirror in MIRRORS.items() if key != "privileged"}, SIZES, cpu)
    with pytest.raises(ValueError, match="mirror of action has 121 entries, expected 4"):
        TensorMirrors({**MIRRORS, "action": MIRRORS["elevation_map"]}, SIZES, cpu)


def test_resume_is_bit_exact() -> None:
    straight = make_ppo()
    for seed in range(4):
        straight_figures = run_update(straight, seed)

    first = make_ppo()
    for seed in range(2):
        run_update(first, seed)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second = make_ppo()
    run_update(second, 17)  # whatever was there before must not matter
    second.load_state_dict(torch.load(file, weights_only=True))
    for seed in range(2, 4):
        resumed_figures = run_update(second, seed)

    assert resumed_figures == straight_figures
    for module in ("actor", "critic"):
        expected, actual = getattr(straight, module).state_dict(), getattr(second, module).state_dict()
        assert all(torch.equal(expected[name], actual[name]) for name in expected)
    assert second.updates == straight.updates == 4
    assert second.learning_rate == straight.learning_rate


def test_observations_that_are_not_finite_are_named() -> None:
    ppo = make_ppo()
    observed = observation(torch.Generator().manual_seed(0), 32)
    observed["history"][7, 3] = float("nan")
    with pytest.raises(NonFiniteError, match="'history' at rollout step 0 is not finite in 1 of 32 rows: 7"):
        ppo.act(observed)


def test_rewards_that_are_not_finite_are_named() -> None:
    ppo = make_ppo()
    observed = observation(torch.Generator().manual_seed(0), 32)
    ppo.act(observed)
    never = torch.zeros(32, dtype=torch.bool)
    reward = torch.zeros(32)
    reward[5] = float("inf")
    with pytest.raises(NonFiniteError, match="reward at rollout step 0 is not finite in 1 of 32 rows: 5"):
        ppo.record(reward, never, never, observed["privileged"])


def test_a_loss_that_is_not_finite_never_reaches_the_weights() -> None:
    ppo = make_ppo(mirror_loss_weight=0.0)
    run_update(ppo, 0)
    observed = observation(torch.Generator().manual_seed(0), 32)
    never = torch.zeros(32, dtype=torch.bool)
    for _ in range(12):
        ppo.act(observed)
        ppo.record(torch.full((32,), 1e25), never, never, observed["privileged"])
    weights = [p.clone() for group in ppo.learner.groups.values() for p in group]
    with pytest.raises(NonFiniteError, match="critic"):
        ppo.update(observed)
    after = [p for group in ppo.learner.groups.values() for p in group]
    assert all(torch.equal(old, new) for old, new in zip(weights, after, strict=True))


def test_timeouts_are_bootstrapped_with_the_state_before_the_reset() -> None:
    ppo = make_ppo(robots=2, steps_per_update=1, minibatches=1, gamma=0.5, mirror_loss_weight=0.0)
    before, after = (observation(torch.Generator().manual_seed(seed), 2) for seed in (0, 1))
    final = torch.randn(2, SIZES.privileged)
    ppo.actor.normalizer.update(before["history"][:, -SIZES.frame :])
    ppo.act(before)
    ppo.record(torch.ones(2), torch.tensor([True, False]), torch.tensor([False, True]), final)
    with torch.no_grad():
        expected = torch.stack([torch.tensor(1.0), 1.0 + 0.5 * ppo.critic(final)[1]])
    ppo._store_returns(after["privileged"])
    torch.testing.assert_close(ppo.storage.flat("returns"), expected)


def test_no_sample_outweighs_the_others() -> None:
    ppo = make_ppo(robots=64, steps_per_update=1, minibatches=1, gamma=0.0)
    ppo.enter((0.05, 1.0), acting=4, advantage_limit=1.5)
    ppo.act(observation(torch.Generator().manual_seed(0), 64))
    reward = torch.zeros(64)
    reward[0], reward[1:4] = -100.0, 100.0
    ended = torch.ones(64, dtype=torch.bool)
    ppo.record(reward, ended, ~ended, torch.zeros(64, SIZES.privileged))
    ppo._store_returns(torch.zeros(64, SIZES.privileged))
    advantage = ppo.storage.data["advantage"][0]
    assert advantage[0] == -1.5 and (advantage[1:4] == 1.5).all() and advantage[4:].abs().max() < 1.0


def test_exploration_noise_has_the_stated_deviation_and_is_clamped() -> None:
    ppo = make_ppo(2048, initial_std=0.3, steps_per_update=1, minibatches=1)
    ppo.enter((0.3, 0.4), acting=4)
    observed = observation(torch.Generator().manual_seed(0), 2048)
    noise = ppo.act(observed)[0] - ppo.deterministic(observed)
    torch.testing.assert_close(noise.std(dim=0), torch.full((4,), 0.3), rtol=0.06, atol=0)
    with torch.no_grad():
        ppo.actor.log_std.fill_(5.0)
    ppo.storage.clear()
    run_update(ppo, 0)
    deviations = ppo.actor.log_std.detach().exp()
    assert float(deviations.min()) > 0.2999 and float(deviations.max()) < 0.4001


def test_gait_noise_has_unit_variance_and_repeats_with_the_clock() -> None:
    robots = 4096
    ppo = make_ppo(robots, gait_noise_steps=1e9)
    ppo.gait_noise_share = 1.0
    ppo.gait_clock = slice(0, 2)

    def noise(phase: float | None) -> torch.Tensor:
        frame = torch.zeros(robots, SIZES.frame)
        if phase is not None:
            frame[:, 0], frame[:, 1] = math.sin(phase), math.cos(phase)
        return ppo._noise(frame)

    first, half, again, still = noise(0.4), noise(0.4 + math.pi), noise(0.4), noise(None)
    assert torch.equal(first, again) and not torch.allclose(first, half)
    torch.testing.assert_close(noise(None), still)
    for pattern in (first, half, still):
        torch.testing.assert_close(pattern.std(dim=0), torch.ones(SIZES.action), rtol=0.05, atol=0.0)
    ppo.gait_noise_share = 0.5
    assert torch.corrcoef(torch.stack([noise(0.4)[:, 0], first[:, 0]]))[0, 1] == pytest.approx(0.5**0.5, abs=0.05)


def test_a_robot_at_rest_has_a_share_of_the_noise_and_its_probability_knows() -> None:
    robots = 4096
    ppo = make_ppo(robots, initial_std=0.4, steps_per_update=1, minibatches=1, mirror_loss_weight=0.0)
    ppo.learner.gait_clock = slice(0, 2)
    ppo.enter((0.4, 0.4), acting=4, noise_at_rest=0.25)
    observed = observation(torch.Generator().manual_seed(0), robots)
    clock = observed["history"][:, -SIZES.frame :][:, :2]
    angle = torch.linspace(0.0, 6.0, robots)
    clock[:] = torch.stack([angle.sin(), angle.cos()], dim=1)
    rests = torch.arange(robots) % 2 == 0
    clock[rests] = 0.0
    noise = ppo.act(observed)[0] - ppo.deterministic(observed)
    for which, std in ((rests, 0.1), (~rests, 0.4)):
        torch.testing.assert_close(noise[which].std(dim=0), torch.full((4,), std), rtol=0.06, atol=0.0)
        by_hand = (-0.5 * (noise[which] / std) ** 2 - math.log(std) - 0.5 * math.log(2.0 * math.pi)).sum(dim=1)
        torch.testing.assert_close(ppo.storage.data["log_prob"][0][which], by_hand, rtol=1e-3, atol=1e-3)
    never = torch.zeros(robots, dtype=torch.bool)
    ppo.record(torch.ones(robots), never, never, observed["privileged"])
    losses = ppo.learner.losses(
        ppo._samples(torch.arange(robots), estimating=False), None, torch.full((4,), 0.4), estimating=False
    )
    assert float(losses["kl"]) == pytest.approx(0.0, abs=1e-6) and float(losses["clip_fraction"]) == 0.0


@pytest.mark.parametrize("by_task", [False, True])
def test_advantages_are_normalized_as_the_stage_has_it(by_task: bool) -> None:
    ppo = make_ppo(robots=64, steps_per_update=1, minibatches=1)
    ppo.tasks = 2
    ppo.enter((0.05, 1.0), acting=4, normalizes_by_task=by_task)
    ppo.act(observation(torch.Generator().manual_seed(0), 64))
    task = torch.arange(64) % 2
    reward = torch.where(task == 0, 100.0, 1.0) * torch.randn(64, generator=torch.Generator().manual_seed(1))
    ended = torch.ones(64, dtype=torch.bool)
    ppo.record(reward, ended, ~ended, torch.zeros(64, SIZES.privileged), task)
    ppo._store_returns(torch.zeros(64, SIZES.privileged))
    advantage = ppo.storage.data["advantage"][0]
    ratio = advantage[task == 0].std() / advantage[task == 1].std()
    assert ratio < 1.5 if by_task else ratio > 30.0


@pytest.mark.parametrize(("bounds", "expected"), [((0.05, 1.0), 0.2), ((0.05, 0.1), 0.1), ((0.4, 1.0), 0.4)])
def test_noise_moves_into_the_bounds_of_a_stage(bounds: tuple[float, float], expected: float) -> None:
    ppo = make_ppo(initial_std=0.2)
    ppo.enter(bounds, acting=4)
    torch.testing.assert_close(ppo.actor.log_std.exp(), torch.full((4,), expected))


@pytest.mark.parametrize(("doublings", "steps"), [(0, 3), (1, 6), (2, 12)])
def test_rollouts_are_as_long_as_a_stage_has_them(doublings: int, steps: int) -> None:
    ppo = make_ppo(4, steps_per_update=3, minibatches=2)
    ppo.enter((0.05, 1.0), acting=4, rollout_doublings=doublings)
    assert ppo.storage.steps == steps
    figures = run_update(ppo, 0)
    assert ppo.updates == 1 and math.isfinite(figures["kl"])


def test_actions_that_do_not_act_are_not_learned() -> None:
    ppo = make_ppo(epochs=2, mirror_loss_weight=0.0, actor_learning_rate=1e-2)
    ppo.enter((0.05, 1.0), acting=2)
    before = ppo.actor.head.output_weight.detach().clone(), ppo.actor.log_std.detach().clone()
    figures = run_update(ppo, 0)
    after = ppo.actor.head.output_weight, ppo.actor.log_std
    for old, new in zip(before, after, strict=True):
        assert torch.equal(old[..., 2:], new[..., 2:]) and not torch.equal(old[..., :2], new[..., :2])
    assert figures["kl"] > 0.0


def test_a_rollout_that_has_begun_keeps_its_length() -> None:
    ppo = make_ppo(4, steps_per_update=3, minibatches=2)
    ppo.act(observation(torch.Generator().manual_seed(0), 4))
    ppo.record(torch.zeros(4), *torch.zeros(2, 4, dtype=torch.bool), torch.zeros(4, SIZES.privileged))
    with pytest.raises(ValueError, match="step 1 of a rollout of 3"):
        ppo.enter((0.05, 1.0), acting=4, rollout_doublings=1)


def test_ablated_networks_learn_too() -> None:
    network = dataclasses.replace(NETWORKS, vision=False, attention=False, mixture=False)
    ppo = make_ppo(network=network)
    before = ppo.deterministic(observation(torch.Generator().manual_seed(5), 8))
    run_update(ppo, 0)
    after = ppo.deterministic(observation(torch.Generator().manual_seed(5), 8))
    assert not torch.equal(before, after)


def test_bad_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="is not above 0"):
        PPOConfig(initial_std=0.0)
    with pytest.raises(ValueError, match="do not split into 5 minibatches"):
        PPO(PPOConfig(steps_per_update=2, minibatches=5), NETWORKS, SIZES, MIRRORS, 4, "cpu", COMMANDS)
    with pytest.raises(ValueError, match="only 0 of 12 rollout steps"):
        make_ppo().update(observation(torch.Generator(), 32))


def test_best_action_of_the_test_task_is_symmetric() -> None:
    observed = observation(torch.Generator().manual_seed(0), 8)
    mirrors = TensorMirrors(MIRRORS, SIZES, torch.device("cpu"))
    mirrored = {key: mirrors(key, value) for key, value in observed.items()}
    torch.testing.assert_close(best_action(mirrored), mirrors("action", best_action(observed)))
