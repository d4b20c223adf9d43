"""The networks with their optimizers: the losses of one minibatch, and one gradient step on them.

Three parameter groups learn side by side with their own Adam: the actor (learning rate steered by the KL
divergence), the critic (fixed, much higher rate) and the estimator. A policy of 29 joints and a value
function want rates that lie an order of magnitude apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence

from lowlevel.learning.estimation import EstimationConfig, estimation_loss
from lowlevel.learning.symmetry import TensorMirrors
from lowlevel.networks.actor import (
    MOTION_SIZE,
    ActorOutput,
    Critic,
    NetworkConfig,
    ObservationSizes,
    PilotActor,
    TargetEncoder,
)
from lowlevel.runs.checks import NonFiniteError
from lowlevel.runs.distributed import average_over_ranks, broadcast
from robots.errors import PilotError

ACTOR_KEYS = ("history", "elevation_map", "flag")
"""What the policy sees."""
POLICY_KEYS = ("frame", "elevation_map", "flag", "motion", "latent")
"""What it decides on: the current frame is the end of the history, the last two are its own estimates."""


@dataclass(frozen=True)
class PPOConfig:
    """Settings of the learner."""

    steps_per_update: int = 24
    """Control steps per robot and update, at first."""
    epochs: int = 2
    """Passes over the rollout per update."""
    minibatches: int = 4
    """Gradient steps per pass."""
    gamma: float = 0.99
    """Discount per control step."""
    lam: float = 0.95
    """Decay of the generalized advantage estimate."""
    clip: float = 0.2
    """Clipping range of the probability ratio."""
    desired_kl: float = 0.01
    """KL divergence from the acting policy that steers the actor's learning rate [nat]; 0 keeps the rate."""
    actor_learning_rate: float = 1e-3
    """First learning rate of the actor; a run that continues another one keeps that one's."""
    actor_learning_rate_bounds: tuple[float, float] = (1e-5, 2e-3)
    """Range of the actor's adaptive learning rate."""
    critic_learning_rate: float = 5e-4
    """Learning rate of the critic."""
    estimator_learning_rate: float = 5e-4
    """Learning rate of the history encoder, the next-state encoder and the prototypes."""
    entropy_weight: float = 0.0
    """Weight of the entropy bonus [1/nat]."""
    initial_std: float = 0.8
    """First standard deviation of the exploration noise [action units]; the stages of a run bound it."""
    max_grad_norm: float = 1.0
    """Gradient norm to which each of the three groups is clipped."""
    gait_noise_steps: float = 100.0
    """Control steps for which a robot keeps its pattern, on average."""
    mirror_loss_weight: float = 0.1
    """Weight of the symmetry loss, the KL divergence between the policy and its mirror image [1/nat]; 0: none."""
    mirror_loss_share: float = 0.25
    """Share of a minibatch on which the symmetry loss is taken."""
    estimation: EstimationConfig = field(default_factory=EstimationConfig)
    """Weights of the estimator loss."""

    def __post_init__(self) -> None:
        for name in ("steps_per_update", "epochs", "minibatches"):
            if getattr(self, name) < 1:
                raise PilotError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not 0 < self.mirror_loss_share <= 0.5:
            raise PilotError(f"mirror_loss_share {self.mirror_loss_share} is not between 0 and 0.5")
        if self.initial_std <= 0.0:
            raise PilotError(f"initial_std {self.initial_std} is not above 0")


def clipped_surrogate(log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """PPO's clipped objective as a loss, per sample (N,) (arXiv 1707.06347, equation 7)."""
    ratio = torch.exp(log_prob - old_log_prob)
    return -torch.minimum(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage)


def adapted_rate(rate: float, kl: float, desired_kl: float, bounds: tuple[float, float]) -> float:
    """Next learning rate: divided by 1.5 above twice the desired KL, times 1.5 below half of it."""
    if desired_kl <= 0:
        return rate
    if kl > 2.0 * desired_kl:
        rate /= 1.5
    elif kl < 0.5 * desired_kl:
        rate *= 1.5
    return min(max(rate, bounds[0]), bounds[1])


class Learner:
    """Actor, critic and estimator, their losses and their optimizers."""

    def __init__(
        self,
        config: PPOConfig,
        network_config: NetworkConfig,
        sizes: ObservationSizes,
        mirrors: TensorMirrors,
        device: torch.device,
        command_columns: Tensor,
        privileged_command_columns: Tensor | None,
        gait_clock: slice | None = None,
    ) -> None:
        """Build networks, equal on all ranks, and optimizers; arguments as in :class:`lowlevel.learning.ppo.PPO`."""
        self.config = config
        self.mirrors = mirrors
        self.device = device
        self.actor = PilotActor(sizes, network_config, command_columns, config.initial_std).to(device)
        self.critic = Critic(sizes, network_config, privileged_command_columns).to(device)
        self.target_encoder = TargetEncoder(sizes, network_config, privileged_command_columns).to(device)
        self.acting = slice(0, sizes.action)
        """The actions that take part: the others are neither explored nor learned."""
        self.std_bounds = (1e-6, math.inf)
        """Range of the exploration noise [action units]."""
        self.gait_clock = gait_clock
        self.noise_at_rest = 1.0
        """Noise of a robot whose gait clock rests, as a share of that of one that walks."""
        self.modules: dict[str, nn.Module] = {
            "actor": self.actor,
            "critic": self.critic,
            "target_encoder": self.target_encoder,
        }
        for module in self.modules.values():
            broadcast([*module.parameters(), *module.buffers()])
        self.groups: dict[str, list[nn.Parameter]] = {
            "actor": self.actor.policy_parameters(),
            "critic": list(self.critic.parameters()),
            "estimator": [*self.actor.estimator_parameters(), *self.target_encoder.parameters()],
        }
        rates = (config.actor_learning_rate, config.critic_learning_rate, config.estimator_learning_rate)
        self.optimizers = {
            name: torch.optim.Adam(parameters, lr=rate, fused=True)
            for (name, parameters), rate in zip(self.groups.items(), rates, strict=True)
        }

    @property
    def learning_rate(self) -> float:
        """Current learning rate of the actor."""
        return float(self.optimizers["actor"].param_groups[0]["lr"])

    def policy(self, observation: Mapping[str, Tensor]) -> ActorOutput:
        """Evaluate the actor on raw observations."""
        return self.actor(*(observation[key] for key in ACTOR_KEYS))

    def std(self, frame: Tensor, std: Tensor | None = None) -> Tensor:
        """Standard deviation (N, A) of the exploration noise [action units] at ``frame`` (N, F).

        ``std`` (A,) is that of a robot that walks, by default what it has become. One that stands deep and bent falls
        under noise that does one good that walks, and would learn to bend less.
        """
        std = self.actor.log_std.exp() if std is None else std
        if self.gait_clock is None:
            return std.expand(len(frame), -1)
        walks = frame[:, self.gait_clock].square().sum(dim=1, keepdim=True)
        return std * torch.lerp(torch.full_like(walks, self.noise_at_rest), torch.ones_like(walks), walks)

    def distribution(self, mean: Tensor, frame: Tensor) -> Normal:
        """The exploration noise around ``mean`` (N, A) at ``frame`` (N, F)."""
        return Normal(mean, self.std(frame), validate_args=False)

    def log_prob(self, mean: Tensor, action: Tensor, frame: Tensor) -> Tensor:
        """Log-probability (N,) of ``action`` (N, A) under the noise around ``mean`` (N, A) at ``frame`` (N, F)."""
        return self.distribution(mean, frame).log_prob(action)[:, self.acting].sum(dim=1)

    def losses(
        self, samples: Mapping[str, Tensor], images: Mapping[str, Tensor] | None, old_std: Tensor, estimating: bool
    ) -> dict[str, Tensor]:
        """Losses "actor", "critic" and, if ``estimating``, "estimator", with figures to log; all scalars.

        ``samples``: B rows per name. ``images``: mirror images of the last rows, for the symmetry loss.
        ``old_std`` (A,) is the noise of the policy that acted, of robots that walk.
        """
        losses = self._actor_losses(samples, images, old_std)
        losses["critic"] = (self.critic(samples["privileged"]) - samples["returns"]).square().mean()
        return losses | self._estimator_losses(samples) if estimating else losses

    def _actor_losses(
        self, samples: Mapping[str, Tensor], images: Mapping[str, Tensor] | None, old_std: Tensor
    ) -> dict[str, Tensor]:
        config = self.config
        mean, gate = self.actor.decide(*(samples[key] for key in POLICY_KEYS))
        frame = samples["frame"]
        distribution = self.distribution(mean, frame)
        log_prob = distribution.log_prob(samples["action"])[:, self.acting].sum(dim=1)
        surrogate = clipped_surrogate(log_prob, samples["log_prob"], samples["advantage"], config.clip).mean()
        entropy = distribution.entropy()[:, self.acting].sum(dim=1).mean()
        figures = {"surrogate": surrogate, "entropy": entropy}
        loss = surrogate - config.entropy_weight * entropy
        if images is not None:
            image, _ = self.actor.decide(*(images[key] for key in POLICY_KEYS))
            difference = image - self.mirrors("action", mean[-len(image) :])
            deviations = difference / self.std(images["frame"]).detach()
            figures["asymmetry"] = 0.5 * deviations[:, self.acting].square().sum(dim=1).mean()
            loss = loss + config.mirror_loss_weight * figures["asymmetry"]
        with torch.no_grad():
            old = Normal(samples["mean"], self.std(frame, old_std), validate_args=False)
            figures["kl"] = kl_divergence(old, distribution)[:, self.acting].sum(dim=1).mean()
            ratio = torch.exp(log_prob - samples["log_prob"])
            figures["clip_fraction"] = ((ratio - 1.0).abs() > config.clip).float().mean()
            figures["gate_entropy"] = torch.special.entr(gate).sum(dim=1).mean()
            figures["gate_largest_share"] = gate.mean(dim=0).max()
        return {"actor": loss, **figures}

    def _estimator_losses(self, samples: Mapping[str, Tensor]) -> dict[str, Tensor]:
        motion, latent = self.actor.encode(samples["history"], samples["elevation_map"])
        target = self.target_encoder(self.critic.normalized(samples["next_privileged"]))
        true_motion = samples["privileged"][:, :MOTION_SIZE]
        prototypes = self.target_encoder.prototypes
        terms = estimation_loss(motion, latent, true_motion, target, prototypes, self.config.estimation)
        figures = {f"estimation/{name}": term for name, term in terms._asdict().items() if name != "loss"}
        return {"estimator": terms.loss, **figures}

    def step(self, losses: Mapping[str, Tensor]) -> dict[str, float]:
        """Take one gradient step in every group that has a loss; returns the figures, averaged over ranks.

        Raises:
            NonFiniteError: naming what is not finite; no parameter has changed then.
        """
        groups = [name for name in self.groups if name in losses]
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)
        torch.stack([losses[name] for name in groups]).sum().backward()
        figures = {name: term.detach().clone() for name, term in losses.items()}
        gradients = [p.grad for name in groups for p in self.groups[name] if p.grad is not None]
        average_over_ranks([*gradients, *figures.values()])
        for name in groups:
            norm = nn.utils.clip_grad_norm_(self.groups[name], self.config.max_grad_norm)
            figures[f"gradient_norm/{name}"] = norm
        numbers = torch.stack([term.float() for term in figures.values()]).tolist()
        result = dict(zip(figures, numbers, strict=True))
        bad = [f"{name} = {number}" for name, number in result.items() if not math.isfinite(number)]
        if bad:
            raise NonFiniteError(f"the gradient step was refused, not finite: {', '.join(bad)}")
        bounds = self.config.actor_learning_rate_bounds
        rate = adapted_rate(self.learning_rate, result["kl"], self.config.desired_kl, bounds)
        self.optimizers["actor"].param_groups[0]["lr"] = rate
        for name in groups:
            self.optimizers[name].step()
        self.limit_noise()
        if "estimator" in groups:
            self.target_encoder.renormalize_prototypes()
        return {**result, "learning_rate": rate}

    @torch.no_grad()
    def limit_noise(self) -> None:
        """Move the standard deviations of the exploration noise into their bounds."""
        lowest, highest = self.std_bounds
        self.actor.log_std.clamp_(math.log(lowest), math.log(highest))

    def state_dict(self) -> dict[str, Any]:
        """Networks and optimizers."""
        state: dict[str, Any] = {name: module.state_dict() for name, module in self.modules.items()}
        state["optimizers"] = {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()}
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a :meth:`state_dict`. The actor's rate goes on from where it was; the others are this
        configuration's."""
        for name, module in self.modules.items():
            module.load_state_dict(state[name])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        low, high = self.config.actor_learning_rate_bounds
        rates = {
            "actor": min(max(self.learning_rate, low), high),
            "critic": self.config.critic_learning_rate,
            "estimator": self.config.estimator_learning_rate,
        }
        for name, rate in rates.items():
            self.optimizers[name].param_groups[0]["lr"] = rate
