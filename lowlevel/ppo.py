"""Proximal policy optimisation (Schulman et al., arXiv 1707.06347) for the PILOT networks.

Three parameter groups learn side by side with their own Adam: the actor (learning rate steered by the KL divergence),
the critic (fixed, much higher rate) and the estimator. Left-right symmetry can be used as data augmentation or as a
loss. All statistics are taken over all ranks (:mod:`lowlevel.distributed`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence

from lowlevel.checks import NonFiniteError, require_finite
from lowlevel.distributed import average_over_ranks, broadcast, rank, sum_over_ranks, world_size
from lowlevel.estimation import EstimationConfig, estimation_loss
from lowlevel.networks import ActorOutput, Critic, NetworkConfig, ObservationSizes, PilotActor, TargetEncoder
from lowlevel.rollout import RolloutStorage, generalized_advantages
from lowlevel.symmetry import TensorMirrors
from robots.g1.mirror import Mirror

ACTOR_KEYS = ("history", "elevation_map", "flag")
OBSERVATION_KEYS = (*ACTOR_KEYS, "privileged")


@dataclass(frozen=True)
class PPOConfig:
    """Settings of the learner."""

    steps_per_update: int = 24
    """Control steps per robot and update."""
    epochs: int = 5
    """Passes over the rollout per update."""
    minibatches: int = 6
    """Gradient steps per pass."""
    gamma: float = 0.99
    """Discount per control step."""
    lam: float = 0.95
    """Decay of the generalised advantage estimate."""
    clip: float = 0.2
    """Clipping range of the probability ratio."""
    desired_kl: float = 0.01
    """KL divergence per gradient step that the actor's learning rate is steered to [nat]; 0 keeps the rate."""
    actor_learning_rate: float = 3e-4
    """First learning rate of the actor."""
    actor_learning_rate_bounds: tuple[float, float] = (1e-5, 1e-3)
    """Range of the actor's adaptive learning rate."""
    critic_learning_rate: float = 5e-4
    """Learning rate of the critic."""
    estimator_learning_rate: float = 5e-4
    """Learning rate of the history encoder, the next-state encoder and the prototypes."""
    entropy_weight: float = 0.0
    """Weight of the entropy bonus [1/nat]."""
    initial_std: float = 0.5
    """First standard deviation of the exploration noise [action units]."""
    std_bounds: tuple[float, float] = (0.05, 1.0)
    """Range of the exploration noise [action units]."""
    max_grad_norm: float = 1.0
    """Gradient norm to which each of the three groups is clipped."""
    symmetry: Literal["none", "augmentation", "loss"] = "augmentation"
    """Mirror half of every minibatch, or penalise an asymmetric mean action, or neither."""
    mirror_loss_weight: float = 1.0
    """Weight of the symmetry loss [1/action units^2]; used by symmetry "loss" only."""
    mirror_loss_share: float = 0.25
    """Share of a minibatch on which the symmetry loss is taken."""
    autocast: bool = False
    """Compute hidden layers in bfloat16; worth it on GPUs, slower than float32 on CPUs measured so far."""
    estimation: EstimationConfig = field(default_factory=EstimationConfig)
    """Weights of the estimator loss."""

    def __post_init__(self) -> None:
        if self.symmetry not in ("none", "augmentation", "loss"):
            raise ValueError(f"symmetry must be none, augmentation or loss, not {self.symmetry!r}")
        low, high = self.std_bounds
        if not 0 < low <= self.initial_std <= high:
            raise ValueError(f"initial_std {self.initial_std} is outside std_bounds {self.std_bounds}")


class Samples(NamedTuple):
    """One minibatch of B samples; the first ``mirrored`` of them are reflected."""

    observation: dict[str, Tensor]
    action: Tensor
    log_prob: Tensor
    mean: Tensor
    advantage: Tensor
    returns: Tensor
    next_privileged: Tensor
    mirrored: int


def clipped_surrogate(log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """PPO's clipped objective as a loss, per sample (N,)."""
    ratio = torch.exp(log_prob - old_log_prob)
    return -torch.minimum(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage)


def adapted_rate(rate: float, kl: float, desired_kl: float, bounds: tuple[float, float]) -> float:
    """Learning rate for the next step: divided by 1.5 above twice the desired KL, times 1.5 below half of it."""
    if desired_kl <= 0:
        return rate
    if kl > 2.0 * desired_kl:
        rate /= 1.5
    elif kl < 0.5 * desired_kl:
        rate *= 1.5
    return min(max(rate, bounds[0]), bounds[1])


class PPO:
    """The learner: acts, records what came of it, and updates the networks once a rollout is full.

    Call :meth:`act` and :meth:`record` in turn, ``steps_per_update`` times, then :meth:`update`. On the CPU everything
    that follows a restored :meth:`state_dict` is bit-identical to what would have followed without the interruption.
    """

    def __init__(
        self,
        config: PPOConfig,
        network_config: NetworkConfig,
        sizes: ObservationSizes,
        mirrors: Mapping[str, Mirror],
        num_envs: int,
        device: torch.device | str,
        command_columns: Tensor,
        privileged_command_columns: Tensor | None = None,
        seed: int = 0,
    ) -> None:
        """Build networks, optimisers and storage.

        ``mirrors``: one per "history", "elevation_map", "privileged" and "action". ``command_columns`` (F,) bool marks
        the frame columns that already have a fixed scale and are not normalised; ``privileged_command_columns`` (P,)
        bool does the same for the critic and also hides these columns from the next-state encoder. Ranks draw
        different exploration noise from the same ``seed``.

        Raises:
            ValueError: if sizes do not fit together.
        """
        self.config = config
        self.sizes = sizes
        self.device = torch.device(device)
        self.seed = seed
        self.updates = 0
        torch.manual_seed(seed)
        hidden = None if privileged_command_columns is None else ~privileged_command_columns.bool()
        self.actor = PilotActor(sizes, network_config, command_columns, config.initial_std).to(self.device)
        self.critic = Critic(sizes, network_config, privileged_command_columns).to(self.device)
        self.target_encoder = TargetEncoder(sizes, network_config, hidden).to(self.device)
        for module in (self.actor, self.critic, self.target_encoder):
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
        self.mirrors = TensorMirrors(mirrors, sizes, self.device)
        self.generator = torch.Generator(self.device).manual_seed(seed + 1000 * rank())
        widths = {"history": sizes.history, "elevation_map": sizes.elevation_map, "flag": 1}
        widths |= {"privileged": sizes.privileged, "next_privileged": sizes.privileged}
        widths |= {"action": sizes.action, "mean": sizes.action}
        shapes: dict[str, tuple[int, ...]] = {name: (width,) for name, width in widths.items()}
        shapes |= {"log_prob": (), "reward": ()}
        self.storage = RolloutStorage(config.steps_per_update, num_envs, shapes, self.device)
        samples = config.steps_per_update * num_envs
        if samples % config.minibatches:
            raise ValueError(f"{samples} samples per update do not split into {config.minibatches} equal minibatches")

    @property
    def learning_rate(self) -> float:
        """Current learning rate of the actor."""
        return float(self.optimizers["actor"].param_groups[0]["lr"])

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.autocast)

    def _policy(self, observation: Mapping[str, Tensor]) -> ActorOutput:
        with self._autocast():
            return self.actor(*(observation[key] for key in ACTOR_KEYS))

    def _distribution(self, mean: Tensor) -> Normal:
        return Normal(mean, self.actor.log_std.exp().expand_as(mean), validate_args=False)

    @torch.no_grad()
    def act(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Sample actions (N, A) for the observations of N robots and store both.

        Raises:
            NonFiniteError: if an action is not finite; the message also names the observation that caused it.
        """
        observation = {key: observation[key].to(self.device) for key in OBSERVATION_KEYS}
        mean = self._policy(observation).mean
        noise = torch.randn(mean.shape, generator=self.generator, device=self.device)
        distribution = self._distribution(mean)
        action = mean + distribution.stddev * noise
        if not bool(torch.isfinite(action).all()):
            for key, values in observation.items():
                require_finite(f"observation {key!r} at rollout step {self.storage.position}", values)
            require_finite(f"action at rollout step {self.storage.position}", action)
        log_prob = distribution.log_prob(action).sum(dim=1)
        self.storage.write({**observation, "action": action, "mean": mean, "log_prob": log_prob})
        return action

    @torch.no_grad()
    def deterministic(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Mean actions (N, A), without noise; nothing is stored."""
        return self._policy({key: observation[key].to(self.device) for key in ACTOR_KEYS}).mean

    def record(self, reward: Tensor, terminated: Tensor, truncated: Tensor, next_privileged: Tensor) -> None:
        """Store what followed the last :meth:`act`.

        ``reward`` (N,); ``terminated`` (N,) bool, the episode ended in failure; ``truncated`` (N,) bool, it ran out of
        time; ``next_privileged`` (N, P) as it was *before* any reset.

        Raises:
            NonFiniteError: if a reward or a privileged observation is not finite.
        """
        where = f"at rollout step {self.storage.position}"
        require_finite(f"reward {where}", reward)
        require_finite(f"next privileged observation {where}", next_privileged)
        self.storage.write({"reward": reward.to(self.device), "next_privileged": next_privileged.to(self.device)})
        self.storage.finish_step(terminated.to(self.device), truncated.to(self.device))

    @torch.no_grad()
    def _values(self, privileged: Tensor) -> Tensor:
        with self._autocast():
            return self.critic(privileged)

    @torch.no_grad()
    def _returns_and_advantages(self, privileged_after: Tensor) -> tuple[Tensor, Tensor, float]:
        """Returns and normalised advantages, (T * N,) each, and the share of the returns' variance explained."""
        storage, config = self.storage, self.config
        values = self._values(storage.flat("privileged")).view(storage.steps, storage.num_envs)
        next_values = torch.cat([values[1:], self._values(privileged_after)[None]])
        ended = storage.terminated | storage.truncated
        if bool(ended.any()):
            next_values[ended] = self._values(storage.data["next_privileged"][ended])
        advantages = generalized_advantages(
            storage.data["reward"],
            values,
            next_values,
            storage.terminated,
            storage.truncated,
            config.gamma,
            config.lam,
        )
        returns = (advantages + values).flatten()
        explained = 1.0 - float((advantages.var() / returns.var().clamp(min=1e-8)))
        flat = advantages.flatten()
        count = flat.numel() * world_size()
        mean = sum_over_ranks(flat.sum()) / count
        variance = sum_over_ranks((flat - mean).square().sum()) / count
        return returns, (flat - mean) / (variance.sqrt() + 1e-8), explained

    def _update_normalizers(self) -> None:
        self.actor.normalizer.update(self.storage.flat("history")[:, -self.sizes.frame :])
        self.critic.normalizer.update(self.storage.flat("privileged"))

    def _calibrate(self) -> None:
        """Fit the normalisers to the very first rollout before anything is learned from unscaled observations.

        The untrained policy is almost constant, so its action means hardly change; they are computed again.
        """
        self._update_normalizers()
        storage = self.storage
        mean = self._means({key: storage.flat(key) for key in ACTOR_KEYS})
        log_prob = self._log_prob(mean, storage.flat("action"))
        storage.flat("mean").copy_(mean)
        storage.flat("log_prob").copy_(log_prob)

    @torch.no_grad()
    def _means(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Action means (B, A) of many samples, computed in minibatches to bound memory."""
        chunks = [torch.split(observation[key], self._minibatch) for key in ACTOR_KEYS]
        return torch.cat(
            [self._policy(dict(zip(ACTOR_KEYS, parts, strict=True))).mean for parts in zip(*chunks, strict=True)]
        )

    @torch.no_grad()
    def _log_prob(self, mean: Tensor, action: Tensor) -> Tensor:
        return self._distribution(mean).log_prob(action).sum(dim=1)

    @torch.no_grad()
    def _with_mirror_images(self, data: dict[str, Tensor]) -> dict[str, Tensor]:
        """Append the mirror image of every sample, with its log-probability under the policy that acted.

        With the log-probability of the original instead, the first ratio of a mirrored sample would not be one, and
        an asymmetric policy would diverge.
        """
        mirrored = {key: self.mirrors(key, data[key]) for key in (*OBSERVATION_KEYS, "next_privileged", "action")}
        mirrored["mean"] = self._means(mirrored)
        mirrored["log_prob"] = self._log_prob(mirrored["mean"], mirrored["action"])
        mirrored |= {key: data[key] for key in ("advantage", "returns")}
        return {key: torch.cat([values, mirrored[key]]) for key, values in data.items()}

    @property
    def _minibatch(self) -> int:
        return self.storage.steps * self.storage.num_envs // self.config.minibatches

    def _samples(self, data: dict[str, Tensor], index: Tensor) -> Samples:
        mirrored = 0
        if self.config.symmetry == "augmentation":
            mirrored = len(index) // 2
            images = self.storage.steps * self.storage.num_envs
            index = torch.cat([index[:mirrored] + images, index[mirrored:]])
        chosen = {key: values.index_select(0, index) for key, values in data.items()}
        observation = {key: chosen.pop(key) for key in OBSERVATION_KEYS}
        return Samples(observation=observation, mirrored=mirrored, **chosen)

    def _losses(self, samples: Samples, old_std: Tensor) -> dict[str, Tensor]:
        """Losses of the three groups ("actor", "critic", "estimator") and figures to log, all scalars."""
        config = self.config
        output = self._policy(samples.observation)
        distribution = self._distribution(output.mean)
        log_prob = distribution.log_prob(samples.action).sum(dim=1)
        surrogate = clipped_surrogate(log_prob, samples.log_prob, samples.advantage, config.clip).mean()
        entropy = distribution.entropy()[0].sum()
        actor = surrogate - config.entropy_weight * entropy
        figures: dict[str, Tensor] = {}
        if config.symmetry == "loss":
            share = max(1, int(config.mirror_loss_share * len(samples.action)))
            images = {key: self.mirrors(key, samples.observation[key][:share]) for key in ACTOR_KEYS}
            asymmetry = self._policy(images).mean - self.mirrors("action", output.mean[:share])
            figures["symmetry"] = asymmetry.square().mean()
            actor = actor + config.mirror_loss_weight * figures["symmetry"]
        with self._autocast():
            value = self.critic(samples.observation["privileged"])
            target = self.target_encoder(self.critic.normalizer(samples.next_privileged))
        critic = (value - samples.returns).square().mean()
        estimation = estimation_loss(
            output.velocity,
            output.latent,
            samples.observation["privileged"][:, :3],
            target,
            self.target_encoder.prototypes,
            config.estimation,
        )
        with torch.no_grad():
            plain = slice(samples.mirrored, None)
            old = Normal(samples.mean[plain], old_std, validate_args=False)
            figures["kl"] = kl_divergence(old, self._distribution(output.mean[plain])).sum(dim=1).mean()
            ratio = torch.exp(log_prob - samples.log_prob)
            figures["clip_fraction"] = ((ratio - 1.0).abs() > config.clip).float().mean()
            figures["gate_entropy"] = torch.special.entr(output.gate).sum(dim=1).mean()
            figures["gate_largest_share"] = output.gate.mean(dim=0).max()
        figures |= {"surrogate": surrogate, "entropy": entropy}
        figures |= {f"estimation/{key}": term for key, term in estimation._asdict().items() if key != "loss"}
        return {"actor": actor, "critic": critic, "estimator": estimation.loss, **figures}

    def _step(self, losses: dict[str, Tensor]) -> dict[str, Tensor]:
        """One gradient step of all three groups, refused as a whole if anything is not finite."""
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)
        (losses["actor"] + losses["critic"] + losses["estimator"]).backward()
        figures = {key: term.detach().clone() for key, term in losses.items()}
        trained = [p.grad for parameters in self.groups.values() for p in parameters if p.grad is not None]
        average_over_ranks([*trained, *figures.values()])
        for name, parameters in self.groups.items():
            norm = nn.utils.clip_grad_norm_(parameters, self.config.max_grad_norm)
            figures[f"gradient_norm/{name}"] = norm
        values = torch.stack([term.float() for term in figures.values()])
        if not bool(torch.isfinite(values).all()):
            bad = [f"{key} = {float(term)}" for key, term in figures.items() if not math.isfinite(float(term))]
            raise NonFiniteError(f"update {self.updates} was refused, not finite: {', '.join(bad)}")
        rate = adapted_rate(
            self.learning_rate,
            float(figures["kl"]),
            self.config.desired_kl,
            self.config.actor_learning_rate_bounds,
        )
        self.optimizers["actor"].param_groups[0]["lr"] = rate
        for optimizer in self.optimizers.values():
            optimizer.step()
        low, high = self.config.std_bounds
        with torch.no_grad():
            self.actor.log_std.clamp_(math.log(low), math.log(high))
        self.target_encoder.renormalise_prototypes()
        return figures

    def update(self, observation_after: Mapping[str, Tensor]) -> dict[str, float]:
        """Learn from the full rollout and return what happened.

        ``observation_after`` is the observation that follows the last recorded step, after resets; robots whose
        episode went on are bootstrapped with its privileged part.

        Raises:
            NonFiniteError: if a loss or a gradient is not finite; the step in question is not taken.
            ValueError: if the rollout is not full.
        """
        storage, config = self.storage, self.config
        if not storage.full:
            raise ValueError(f"only {storage.position} of {storage.steps} rollout steps are recorded")
        calibrating = float(self.actor.normalizer.count) == 0
        if calibrating:
            self._calibrate()
        privileged_after = observation_after["privileged"].to(self.device)
        returns, advantages, explained = self._returns_and_advantages(privileged_after)
        names = (*OBSERVATION_KEYS, "next_privileged", "action", "mean", "log_prob")
        data = {name: storage.flat(name) for name in names} | {"advantage": advantages, "returns": returns}
        if config.symmetry == "augmentation":
            data = self._with_mirror_images(data)
        old_std = self.actor.log_std.detach().exp().clone()
        history: list[dict[str, Tensor]] = []
        for _ in range(config.epochs):
            order = torch.randperm(storage.steps * storage.num_envs, generator=self.generator, device=self.device)
            for index in torch.split(order, self._minibatch):
                history.append(self._step(self._losses(self._samples(data, index), old_std)))
        if not calibrating:
            self._update_normalizers()
        storage.clear()
        self.updates += 1
        means = {key: float(torch.stack([step[key] for step in history]).mean()) for key in history[0]}
        means["estimation/velocity_rmse"] = math.sqrt(means.pop("estimation/velocity_mse"))
        means |= {"explained_variance": explained, "learning_rate": self.learning_rate, "std": float(old_std.mean())}
        return means

    def state_dict(self) -> dict[str, Any]:
        """Everything that learning depends on, as tensors, numbers, strings, lists and dicts."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "target_encoder": self.target_encoder.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "generator": self.generator.get_state(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a :meth:`state_dict`, dropping a half-filled rollout.

        A single process continues bit for bit. With several ranks the state is rank 0's: it continues its own noise,
        and the others draw a fresh sequence.
        """
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.target_encoder.load_state_dict(state["target_encoder"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.updates = int(state["updates"])
        if rank() == 0:
            self.generator.set_state(state["generator"].cpu())
        else:
            self.generator.manual_seed(self.seed + 1000 * rank() + 1_000_003 * self.updates)
        self.storage.clear()
