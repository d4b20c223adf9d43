from __future__ import annotations

import math

import pytest
import torch
from small_learner import NETWORKS, SIZES, make_ppo
from torch.nn import functional

from lowlevel.learning.estimation import EstimationConfig, EstimationTerms, estimation_loss, sinkhorn
from lowlevel.networks.actor import HistoryEncoder, TargetEncoder


def _unit(*shape: int, seed: int = 0) -> torch.Tensor:
    return functional.normalize(torch.randn(*shape, generator=torch.Generator().manual_seed(seed)), dim=-1)


def test_sinkhorn_assigns_every_sample_and_uses_prototypes_equally() -> None:
    scores = _unit(512, 16, seed=1) @ _unit(24, 16, seed=2).T
    scores[:, 0] += 0.5  # one prototype that everyone likes
    assignment = sinkhorn(scores, temperature=0.05, iterations=50)
    torch.testing.assert_close(assignment.sum(dim=1), torch.ones(512), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(assignment.sum(dim=0), torch.full((24,), 512 / 24), rtol=0.02, atol=0)
    greedy = functional.softmax(scores / 0.05, dim=1).sum(dim=0)
    assert greedy[0] > 10 * 512 / 24, "without balancing the popular prototype would take almost all"


def test_contrastive_term_is_the_swapped_cross_entropy_summed_over_prototypes() -> None:
    config = EstimationConfig()
    latent, target, prototypes = _unit(64, 8, seed=1), _unit(64, 8, seed=2), _unit(16, 8, seed=3)
    motion, truth = torch.zeros(64, 5), torch.tensor([[0.5, 0.5, 0.5, 0.2, 0.2]]).repeat(64, 1)
    terms = estimation_loss(motion, latent, truth, target, prototypes, config)
    expected = 0.0
    for own, other in ((latent, target), (target, latent)):
        assignment = sinkhorn(other @ prototypes.T, config.sinkhorn_temperature, config.sinkhorn_iterations)
        expected += 0.5 * float(functional.cross_entropy(own @ prototypes.T / config.temperature, assignment))
    assert float(terms.contrastive) == pytest.approx(expected, rel=1e-5)
    assert float(terms.velocity_mse) == pytest.approx(0.25)
    assert float(terms.capture_point_mse) == pytest.approx(0.04)
    assert float(terms.loss) == pytest.approx(0.25 + 10.0 * 0.04 + 0.1 * expected, rel=1e-5)


def test_ignorance_costs_the_logarithm_of_the_number_of_prototypes() -> None:
    latent = functional.normalize(torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(32, 1), dim=1)
    prototypes = functional.normalize(torch.cat([torch.zeros(8, 2), torch.randn(8, 2)], dim=1), dim=1)
    terms = estimation_loss(torch.zeros(32, 5), latent, torch.zeros(32, 5), latent, prototypes, EstimationConfig())
    assert float(terms.contrastive) == pytest.approx(math.log(8), rel=1e-4)
    assert float(terms.assignment_entropy) == pytest.approx(1.0, rel=1e-4)


def _train(shuffled: bool) -> EstimationTerms:
    """Train the estimator on a linear system whose next state follows from the history, or from nothing."""
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(1)
    encoder, target_encoder = HistoryEncoder(SIZES, NETWORKS), TargetEncoder(SIZES, NETWORKS)
    parameters = [*encoder.parameters(), *target_encoder.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=3e-3)
    dynamics = 0.5 * torch.randn(SIZES.frame, SIZES.privileged, generator=generator)
    for _ in range(300):
        history = torch.randn(256, SIZES.history, generator=generator)
        privileged = history[:, -SIZES.frame :] @ dynamics
        next_privileged = privileged[torch.randperm(256, generator=generator)] if shuffled else privileged
        motion, latent = encoder(history, torch.zeros(256, 121))
        terms = estimation_loss(
            motion,
            latent,
            privileged[:, :5],
            target_encoder(next_privileged),
            target_encoder.prototypes,
            EstimationConfig(contrastive_weight=1.0),
        )
        optimizer.zero_grad()
        terms.loss.backward()
        optimizer.step()
        target_encoder.renormalize_prototypes()
    return EstimationTerms(*(term.detach() for term in terms))


def test_estimator_learns_velocity_and_next_state_where_the_history_tells_them() -> None:
    terms, unrelated = _train(shuffled=False), _train(shuffled=True)
    assert float(terms.velocity_mse) < 0.1
    assert float(terms.agreement) > 0.4, "chance is 1 / 16"
    assert float(terms.usage_entropy) > 0.9, "prototypes have collapsed"
    assert float(terms.contrastive) < 0.7 * math.log(16)
    assert float(unrelated.agreement) < 0.2, "agreement must be near chance where there is nothing to predict"


def test_gradient_does_not_vanish_as_with_the_mean_over_prototypes_at_temperature_three() -> None:
    prototypes, target = _unit(64, 32, seed=3), _unit(256, 32, seed=2)
    norms = []
    for temperature, share in ((0.1, 1.0), (3.0, 1.0 / 64.0)):
        latent = _unit(256, 32, seed=1).requires_grad_()
        config = EstimationConfig(temperature=temperature, contrastive_weight=share)
        terms = estimation_loss(torch.zeros(256, 5), latent, torch.zeros(256, 5), target, prototypes, config)
        norms.append(float(torch.autograd.grad(terms.loss, latent)[0].norm()))
    assert norms[0] > 500 * norms[1]


def test_commands_are_hidden_from_the_next_state_encoder() -> None:
    commands = torch.arange(SIZES.privileged) >= 9
    encoder = TargetEncoder(SIZES, NETWORKS, commands)
    state = torch.randn(5, SIZES.privileged)
    changed = state.clone()
    changed[:, 9:] += 3.0
    assert torch.equal(encoder(state), encoder(changed))
    changed[:, 8] += 3.0
    assert not torch.equal(encoder(state), encoder(changed))


def test_estimator_learns_only_in_its_epochs_and_from_its_own_loss() -> None:
    ppo = make_ppo(mirror_loss_weight=0.0)
    for estimating in (True, False):
        ppo.storage.flat("history").normal_()
        samples = ppo._samples(torch.arange(64), estimating)
        losses = ppo.learner.losses(samples, None, torch.full((4,), 0.5), estimating)
        assert ("estimator" in losses) == estimating
        before = [p.clone() for p in ppo.learner.groups["estimator"]]
        ppo.learner.step(losses)
        changed = [not torch.equal(a, b) for a, b in zip(before, ppo.learner.groups["estimator"], strict=True)]
        assert any(changed) == estimating
