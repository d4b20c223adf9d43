from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from lowlevel.networks.actor import Critic, MixtureOfExperts, NetworkConfig, ObservationSizes, PilotActor
from lowlevel.networks.map_encoder import MapEncoder, cell_coordinates, pooling_matrix

SIZES = ObservationSizes(frame=120, history_length=5, elevation_map=121, privileged=300, action=29)
NO_COMMANDS = torch.zeros(120, dtype=torch.bool)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def _inputs(samples: int = 16) -> tuple[Tensor, Tensor, Tensor]:
    flag = torch.randint(0, 2, (samples, 1)).float()
    return torch.randn(samples, SIZES.history), 0.2 * torch.randn(samples, 121), flag


def test_attention_equals_multi_head_attention_with_explicit_keys_and_values() -> None:
    config = NetworkConfig()
    encoder = MapEncoder(SIZES, config)
    nn.init.normal_(encoder.value_bias)
    reference = nn.MultiheadAttention(config.attention_width, 4, kdim=11, vdim=11, batch_first=True)
    with torch.no_grad():
        reference.q_proj_weight.copy_(torch.eye(config.attention_width))
        reference.k_proj_weight.copy_(encoder.key_weight)
        reference.v_proj_weight.copy_(encoder.value_weight)
        # A key bias shifts all scores of a head alike, so that the encoder can do without one.
        key_bias = torch.randn(config.attention_width)
        reference.in_proj_bias.copy_(torch.cat([torch.zeros(32), key_bias, encoder.value_bias]))
        reference.out_proj.load_state_dict(encoder.output.state_dict())
    heights = torch.randn(16, 121)
    query = (10.0 * torch.randn(16, config.attention_width)).requires_grad_()
    features, geometry = encoder.tokens(heights)
    tokens = torch.cat([features, geometry], dim=1).transpose(1, 2)
    expected, weights = reference(query[:, None], tokens, tokens)
    actual = encoder.attend(query, features, geometry)
    assert weights.max() > 0.1, "attention is so flat that the comparison would prove little"
    torch.testing.assert_close(actual, expected.squeeze(1), rtol=1e-4, atol=1e-5)
    gradients = [torch.autograd.grad(out.square().sum(), query, retain_graph=True)[0] for out in (actual, expected)]
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-3, atol=1e-4)


def test_tokens_hold_pooled_heights_and_coordinates_of_their_cell() -> None:
    heights = torch.randn(5, 121)
    pooled = (heights @ pooling_matrix(11, (1, 3))).unflatten(1, (2, 11, 11))
    image = heights.view(5, 11, 11)
    torch.testing.assert_close(pooled[:, 0], image)
    torch.testing.assert_close(pooled[:, 1, 4, 7], image[:, 3:6, 6:9].mean(dim=(1, 2)))
    torch.testing.assert_close(pooled[:, 1, 0, 10], image[:, 0:2, 9:11].mean(dim=(1, 2)))
    x, y = cell_coordinates(11)
    assert (x[0], y[0], x[-1], y[-1]) == (-1, -1, 1, 1)
    assert x[11] > x[0] and y[1] > y[0] and x[1] == x[0], "the map's rows run along x, its columns along y"


def test_attention_can_tell_cells_apart() -> None:
    encoder = MapEncoder(SIZES, NetworkConfig(pooling_windows=(1,)))
    heights = torch.zeros(2, 121)
    heights[0, 5], heights[1, 115] = 1.0, 1.0
    query = torch.randn(1, 32).expand(2, -1)
    front, back = encoder.attend(query, *encoder.tokens(heights))
    assert (front - back).abs().max() > 1e-3


def test_mixture_is_the_probability_weighted_sum_of_separate_experts() -> None:
    mixture = MixtureOfExperts(20, 7, NetworkConfig(expert_hidden=(12, 10), output_gain=1.0))
    nn.init.normal_(mixture.output_bias)
    inputs = torch.randn(9, 20)
    action, gate = mixture(inputs)
    torch.testing.assert_close(gate.sum(dim=1), torch.ones(9))
    expected = torch.zeros(9, 7)
    for expert in range(4):
        rows = slice(12 * expert, 12 * (expert + 1))
        hidden = functional.elu(functional.linear(inputs, mixture.first.weight[rows], mixture.first.bias[rows]))
        hidden = functional.elu(hidden @ mixture.second_weight[expert] + mixture.second_bias[expert])
        proposal = hidden @ mixture.output_weight[expert] + mixture.output_bias[expert]
        expected += gate[:, expert : expert + 1] * proposal
    torch.testing.assert_close(action, expected)


def test_untrained_actions_are_almost_zero_and_all_experts_take_part() -> None:
    actor = PilotActor(SIZES, NetworkConfig(), NO_COMMANDS)
    output = actor(*_inputs(256))
    assert output.mean.abs().max() < 0.1
    assert output.gate.shape == (256, 4) and output.gate.min() > 0.1
    assert output.motion.shape == (256, 5)
    torch.testing.assert_close(output.latent.norm(dim=1), torch.ones(256))


def test_policy_gradient_reaches_everything_but_the_history_encoder() -> None:
    actor = PilotActor(SIZES, NetworkConfig(), NO_COMMANDS)
    output = actor(*_inputs())
    (output.mean.square().sum() + actor.log_std.sum()).backward()
    assert all(parameter.grad is None for parameter in actor.estimator_parameters())
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in actor.policy_parameters())
    named = {id(p) for p in actor.estimator_parameters()} | {id(p) for p in actor.policy_parameters()}
    assert named == {id(p) for p in actor.parameters()}


def test_policy_uses_the_estimates_the_flag_and_the_map() -> None:
    actor = PilotActor(SIZES, NetworkConfig(output_gain=1.0), NO_COMMANDS)
    history, heights, flag = _inputs()
    velocity, latent = actor.encode(history, heights)
    frame = history[:, -120:]
    mean, _ = actor.decide(frame, heights, flag, velocity, latent)
    torch.testing.assert_close(mean, actor(history, heights, flag).mean)
    changes = {
        "velocity": (frame, heights, flag, velocity + 1, latent),
        "latent": (frame, heights, flag, velocity, -latent),
        "flag": (frame, heights, 1 - flag, velocity, latent),
        "map": (frame, heights.flip(1), flag, velocity, latent),
    }
    for name, arguments in changes.items():
        assert (actor.decide(*arguments)[0] - mean).abs().max() > 1e-3, name


def test_without_vision_the_map_has_no_influence() -> None:
    actor = PilotActor(SIZES, NetworkConfig(vision=False, output_gain=1.0), NO_COMMANDS)
    history, heights, flag = _inputs()
    for seen, unseen in zip(actor(history, heights, flag), actor(history, heights + 5, flag), strict=True):
        assert torch.equal(seen, unseen)
    assert not any(p.requires_grad for p in actor.map_encoder.parameters())


def test_ablations_have_comparable_size() -> None:
    def weights(config: NetworkConfig) -> int:
        return sum(p.numel() for p in PilotActor(SIZES, config, NO_COMMANDS).parameters())

    full = weights(NetworkConfig())
    assert weights(NetworkConfig(mixture=False)) == pytest.approx(full, rel=0.1)
    assert weights(NetworkConfig(attention=False)) == pytest.approx(full, rel=0.1)
    plain = PilotActor(SIZES, NetworkConfig(attention=False, mixture=False), NO_COMMANDS)
    output = plain(*_inputs())
    assert output.mean.shape == (16, 29) and torch.equal(output.gate, torch.ones(16, 1))


def test_default_networks_stay_within_their_arithmetic_budget() -> None:
    actor, critic = PilotActor(SIZES, NetworkConfig(), NO_COMMANDS), Critic(SIZES, NetworkConfig())
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        actor(*_inputs(8))
        critic(torch.randn(8, 300))
    multiply_adds = counter.get_total_flops() / 2 / 8
    assert 300_000 < multiply_adds < 560_000


def test_commands_keep_their_fixed_scale() -> None:
    commands = torch.arange(120) >= 100
    actor = PilotActor(SIZES, NetworkConfig(), commands)
    frames = 5.0 + 2.0 * torch.randn(4096, 120)
    actor.normalizer.update(frames)
    scaled = actor.normalizer(frames)
    assert torch.equal(scaled[:, 100:], frames[:, 100:].clamp(-10, 10))
    torch.testing.assert_close(scaled[:, :100].std(dim=0), torch.ones(100), rtol=0.02, atol=0.02)


def test_wrong_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="do not fit a map of 100 cells"):
        MapEncoder(ObservationSizes(10, 5, 100, 12, 4), NetworkConfig(pooling_windows=(1, 11)))
    with pytest.raises(ValueError, match="multiple of 5 heads"):
        NetworkConfig(attention_heads=5)
    with pytest.raises(ValueError, match="must be odd"):
        NetworkConfig(pooling_windows=(2,))
