"""Proximal policy optimization (Schulman et al., arXiv 1707.06347) for the PILOT networks.

While the actor learns from a rollout it sees the estimates of that rollout, so that ratio and KL measure the
actor's own change and not the estimator's. All statistics are taken over all ranks
(:mod:`lowlevel.runs.distributed`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.distributions import kl_divergence

from lowlevel.learning.estimation import ESTIMATED
from lowlevel.learning.learner import ACTOR_KEYS, POLICY_KEYS, Learner, PPOConfig
from lowlevel.learning.rollout import RolloutStorage, generalized_advantages, normalized_by_task
from lowlevel.learning.symmetry import TensorMirrors
from lowlevel.networks.actor import CAPTURE_POINT, MOTION_SIZE, NetworkConfig, ObservationSizes
from lowlevel.runs.checks import NonFiniteError, require_finite
from lowlevel.runs.distributed import rank
from robots.errors import PilotError
from robots.g1.mirror import Mirror

__all__ = ["PPO", "NonFiniteError", "PPOConfig"]

OBSERVATION_KEYS = (*ACTOR_KEYS, "privileged")


class PPO:
    """The algorithm: acts, records what came of it, and updates the networks once a rollout is full.

    Call :meth:`act` and :meth:`record` in turn until the ``storage`` is full, then :meth:`update`. On the CPU
    everything that follows a restored :meth:`state_dict` is bit-identical to what would have followed without
    the interruption.
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
        gait_clock: slice | None = None,
        tasks: int = 1,
        seed: int = 0,
    ) -> None:
        """Build networks, optimizers and storage.

        ``mirrors``: one per "history", "elevation_map", "privileged" and "action". ``command_columns`` (F,)
        bool marks the frame columns that already have a fixed scale and are not normalized, commands above all;
        ``privileged_command_columns`` (P,) bool does the same for the critic and also hides these columns
        from the next-state encoder. ``gait_clock``: the columns of a frame with its sine and cosine, for noise that
        repeats with the gait; without it all noise is white. ``tasks``: advantages are normalized within each of as
        many, see :func:`lowlevel.learning.rollout.normalized_by_task`. Ranks draw different noise from the same
        ``seed``.

        Raises:
            PilotError: if sizes do not fit together.
        """
        self.config = config
        self.sizes = sizes
        self.device = torch.device(device)
        self.seed = seed
        self.updates = 0
        torch.manual_seed(seed)
        self.mirrors = TensorMirrors(mirrors, sizes, self.device)
        self.learner = Learner(
            config,
            network_config,
            sizes,
            self.mirrors,
            self.device,
            command_columns,
            privileged_command_columns,
            gait_clock,
        )
        self.actor = self.learner.actor
        self.critic = self.learner.critic
        self.generator = torch.Generator(self.device).manual_seed(seed + 1000 * rank())
        widths = {"history": sizes.history, "elevation_map": sizes.elevation_map, "flag": 1}
        widths |= {"privileged": sizes.privileged, "next_privileged": sizes.privileged}
        widths |= {"action": sizes.action, "mean": sizes.action}
        widths |= {"motion": MOTION_SIZE, "latent": network_config.latent}
        shapes: dict[str, tuple[int, ...]] = {name: (width,) for name, width in widths.items()}
        shapes |= dict.fromkeys(("log_prob", "reward", "advantage", "returns"), ())
        self._shapes = shapes
        self.gait_clock = gait_clock
        self.tasks = tasks
        self.gait_noise_share, self.normalizes_by_task, self.advantage_limit = 0.0, False, math.inf
        self._gait_noise = torch.zeros(num_envs, sizes.action, 3, device=self.device)
        """Constant, sine and cosine part of each robot's pattern."""
        self.storage = self._room_for(config.steps_per_update, num_envs)
        if self.storage.size % config.minibatches:
            raise PilotError(
                f"{self.storage.size} samples per update do not split into {config.minibatches} minibatches"
            )

    def _room_for(self, steps: int, num_envs: int) -> RolloutStorage:
        return RolloutStorage(steps, num_envs, self._shapes, self.device)

    @property
    def _minibatch(self) -> int:
        return self.storage.size // self.config.minibatches

    @property
    def learning_rate(self) -> float:
        """Current learning rate of the actor."""
        return self.learner.learning_rate

    @torch.no_grad()
    def act(self, observation: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Sample actions (N, A) for the observations of N robots and store both.

        Returns:
            the actions, and the estimated capture point (N, 2) [m], heading frame.

        Raises:
            NonFiniteError: if an action is not finite; the message names the observation that caused it, if
            any.
        """
        observation = {key: observation[key].to(self.device) for key in OBSERVATION_KEYS}
        output = self.learner.policy(observation)
        frame = observation["history"][:, -self.sizes.frame :]
        action = output.mean + self.learner.std(frame) * self._noise(frame)
        if not bool(torch.isfinite(action).all()):
            for key, values in observation.items():
                require_finite(f"observation {key!r} at rollout step {self.storage.position}", values)
            require_finite(f"action at rollout step {self.storage.position}", action)
        estimates = {"motion": output.motion, "latent": output.latent}
        acted = {
            "action": action,
            "mean": output.mean,
            "log_prob": self.learner.log_prob(output.mean, action, frame),
        }
        self.storage.write({**observation, **estimates, **acted})
        return action, output.motion[:, CAPTURE_POINT]

    def _noise(self, frame: Tensor) -> Tensor:
        """Exploration noise of unit variance (N, A), a share of which is a pattern over the gait clock.

        White noise at 50 Hz hardly changes how a robot walks, and what it does change drowns in what falls do to the
        returns. A robot that keeps a pattern for a while has a slightly different gait, and its returns tell whether
        that is a better one. As in gSDE (Raffin et al., arXiv 2005.05719) the probability of an action stays that of
        its marginal distribution.
        """
        share, shape = self.gait_noise_share, (len(frame), self.sizes.action)

        def normal(*size: int) -> Tensor:
            return torch.randn(*size, generator=self.generator, device=self.device)

        if self.gait_clock is None or share == 0.0:
            return normal(*shape)
        chance = torch.rand(shape[0], generator=self.generator, device=self.device)
        renewed = chance * self.config.gait_noise_steps < 1.0
        fresh = torch.where(self._gait_noise.any(), renewed, True)[:, None, None]
        self._gait_noise = torch.where(fresh, normal(*shape, 3), self._gait_noise)
        clock = frame[:, self.gait_clock]
        # Sine and cosine share the variance with the constant; at a stand, where the clock is zero, it has all of it.
        walking = clock.square().sum(dim=1, keepdim=True)
        parts = torch.cat([torch.sqrt(1.0 - 0.5 * walking), clock * 0.5**0.5], dim=1)
        pattern = (self._gait_noise * parts[:, None]).sum(dim=2)
        return (1.0 - share) ** 0.5 * normal(*shape) + share**0.5 * pattern

    def enter(
        self,
        std: tuple[float, float],
        acting: int,
        rollout_doublings: int = 0,
        gait_noise_share: float = 0.0,
        normalizes_by_task: bool = False,
        noise_at_rest: float = 1.0,
        advantage_limit: float = math.inf,
    ) -> None:
        """Go on with exploration noise between the bounds ``std``, in the first ``acting`` actions only.

        ``noise_at_rest``: noise of robots whose gait clock rests, as a share of that of those that walk.
        Rollouts are 2 to the power of ``rollout_doublings`` times as long as at first. ``gait_noise_share``: share of
        the noise's variance that repeats with the gait. ``normalizes_by_task``: whether advantages are normalized
        within each task. ``advantage_limit``: normalized advantages are clipped to +- this.

        Raises:
            ValueError: in the middle of a rollout.
        """
        steps = self.config.steps_per_update * 2**rollout_doublings
        if self.storage.position > 0:
            raise ValueError(f"step {self.storage.position} of a rollout of {self.storage.steps} is recorded already")
        if steps != self.storage.steps:
            self.storage = self._room_for(steps, self.storage.num_envs)
        self.learner.acting = slice(0, acting)
        self.learner.std_bounds, self.learner.noise_at_rest = std, noise_at_rest
        self.gait_noise_share, self.normalizes_by_task = gait_noise_share, normalizes_by_task
        self.advantage_limit = advantage_limit
        self.learner.limit_noise()

    @torch.no_grad()
    def deterministic(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Mean actions (N, A), without noise; nothing is stored."""
        return self.learner.policy({key: observation[key].to(self.device) for key in ACTOR_KEYS}).mean

    def record(
        self,
        reward: Tensor,
        terminated: Tensor,
        truncated: Tensor,
        next_privileged: Tensor,
        task: Tensor | None = None,
    ) -> None:
        """Store what followed the last :meth:`act`.

        ``reward`` (N,); ``terminated`` (N,) bool, the episode ended in failure; ``truncated`` (N,) bool, it
        ran out of time, or what follows has nothing to do with the action; ``next_privileged`` (N, P) as it was
        *before* any reset; ``task`` (N,) long, below ``tasks``, all the same by default.

        Raises:
            NonFiniteError: if a reward or a privileged observation is not finite.
        """
        where = f"at rollout step {self.storage.position}"
        require_finite(f"reward {where}", reward)
        require_finite(f"next privileged observation {where}", next_privileged)
        self.storage.write({"reward": reward.to(self.device), "next_privileged": next_privileged.to(self.device)})
        task = torch.zeros_like(terminated, dtype=torch.long) if task is None else task
        self.storage.finish_step(terminated.to(self.device), truncated.to(self.device), task.to(self.device))

    def update(self, observation_after: Mapping[str, Tensor]) -> dict[str, float]:
        """Learn from the full rollout and return what happened, as means over the gradient steps.

        ``observation_after`` is the observation that follows the last recorded step, after resets; robots
        whose episode went on are bootstrapped with its privileged part.

        Raises:
            NonFiniteError: if a loss or a gradient is not finite; the step in question is not taken.
            ValueError: if the rollout is not full.
        """
        storage, config = self.storage, self.config
        if not storage.full:
            raise ValueError(f"only {storage.position} of {storage.steps} rollout steps are recorded")
        first_rollout = float(self.actor.normalizer.count) == 0
        if first_rollout:
            self._fit_normalizers()
        explained = self._store_returns(observation_after["privileged"].to(self.device))
        old_std = self.actor.log_std.detach().exp().clone()
        history: dict[str, list[float]] = {}
        minibatches = self._draw_minibatches()
        # All of them now, because the first step changes the estimator.
        images = [self._images(index) for index in minibatches]
        for step, index in enumerate(minibatches):
            estimating = step < config.minibatches  # a supervised learner needs but one pass
            losses = self.learner.losses(self._samples(index, estimating), images[step], old_std, estimating)
            for name, number in self.learner.step(losses).items():
                history.setdefault(name, []).append(number)
        means = {name: sum(numbers) / len(numbers) for name, numbers in history.items()}
        means |= {f"estimation/{name}_rmse": math.sqrt(means.pop(f"estimation/{name}_mse")) for name in ESTIMATED}
        means["estimation/policy_drift"] = self._estimator_drift()
        means |= {"explained_variance": explained, "std": float(old_std[self.learner.acting].mean())}
        if not first_rollout:
            self._update_normalizers()
        storage.clear()
        self.updates += 1
        return means

    @torch.no_grad()
    def _values(self, privileged: Tensor) -> Tensor:
        return self.critic(privileged)

    @torch.no_grad()
    def _store_returns(self, privileged_after: Tensor) -> float:
        """Fill in returns and normalized advantages; returns the share of the returns' variance explained."""
        storage = self.storage
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
            self.config.gamma,
            self.config.lam,
        )
        storage.data["returns"].copy_(advantages + values)
        explained = 1.0 - float(advantages.var() / storage.data["returns"].var().clamp(min=1e-8))
        task = storage.task if self.normalizes_by_task else torch.zeros_like(storage.task)
        normalized = normalized_by_task(advantages, task, self.tasks)
        storage.data["advantage"].copy_(normalized.clamp(-self.advantage_limit, self.advantage_limit))
        return explained

    def _update_normalizers(self) -> None:
        self.actor.normalizer.update(self.storage.flat("history")[:, -self.sizes.frame :])
        self.critic.normalizer.update(self.storage.flat("privileged")[:, : self.critic.seen])

    @torch.no_grad()
    def _fit_normalizers(self) -> None:
        """Fit the normalizers to the very first rollout before anything is learned from unscaled numbers.

        The untrained policy is almost constant, so its action means hardly change; they are computed again.
        """
        self._update_normalizers()
        rows = self.storage.flat
        for start in range(0, self.storage.size, self._minibatch):
            part = slice(start, start + self._minibatch)
            output = self.learner.policy({key: rows(key)[part] for key in ACTOR_KEYS})
            rows("mean")[part].copy_(output.mean)
            rows("motion")[part].copy_(output.motion)
            rows("latent")[part].copy_(output.latent)
            frame = rows("history")[part][:, -self.sizes.frame :]
            rows("log_prob")[part].copy_(self.learner.log_prob(output.mean, rows("action")[part], frame))

    def _draw_minibatches(self) -> list[Tensor]:
        """Indices of the samples of every gradient step: one shuffled pass over the rollout per epoch."""

        def shuffled() -> Tensor:
            return torch.randperm(self.storage.size, generator=self.generator, device=self.device)

        return [index for _ in range(self.config.epochs) for index in torch.split(shuffled(), self._minibatch)]

    def _samples(self, index: Tensor, estimating: bool) -> dict[str, Tensor]:
        """The samples at ``index``, with what the estimator learns from if ``estimating``."""
        names = [*POLICY_KEYS, "privileged", "action", "mean", "log_prob", "advantage", "returns"]
        if estimating:
            names += ["history", "next_privileged"]
        return {name: self._rows(name).index_select(0, index) for name in names}

    @torch.no_grad()
    def _images(self, index: Tensor) -> dict[str, Tensor] | None:
        """Mirror images of the last samples at ``index``, for the policy."""
        if self.config.mirror_loss_weight == 0.0:
            return None
        share = max(1, int(self.config.mirror_loss_share * len(index)))
        rows = {key: self.storage.flat(key).index_select(0, index[-share:]) for key in ACTOR_KEYS}
        image = {key: self.mirrors(key, values) for key, values in rows.items()}
        motion, latent = self.actor.encode(image["history"], image["elevation_map"])
        frame = image.pop("history")[:, -self.sizes.frame :].clone()
        return {**image, "frame": frame, "motion": motion, "latent": latent}

    def _rows(self, name: str) -> Tensor:
        if name == "frame":
            return self.storage.flat("history")[:, -self.sizes.frame :]
        return self.storage.flat(name)

    @torch.no_grad()
    def _estimator_drift(self) -> float:
        """KL divergence of the policy [nat] that the estimator's own learning caused, on the last control step."""
        recorded = {key: self.storage.data[key][-1] for key in (*ACTOR_KEYS, *POLICY_KEYS[3:])}
        recorded["frame"] = recorded["history"][:, -self.sizes.frame :]
        before, _ = self.actor.decide(*(recorded[key] for key in POLICY_KEYS))
        after = self.learner.policy(recorded).mean
        divergence = kl_divergence(*(self.learner.distribution(mean, recorded["frame"]) for mean in (before, after)))
        return float(divergence[:, self.learner.acting].sum(dim=1).mean())

    def state_dict(self) -> dict[str, Any]:
        """Everything that learning depends on, as tensors, numbers, strings, lists and dicts."""
        own = {"generator": self.generator.get_state(), "updates": self.updates, "gait_noise": self._gait_noise}
        return {**self.learner.state_dict(), **own}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a :meth:`state_dict`, dropping a half-filled rollout.

        A single process continues bit for bit. With several ranks the state is rank 0's: it continues its own
        noise, and the others draw a fresh sequence.
        """
        self.learner.load_state_dict(state)
        self.updates = int(state["updates"])
        if rank() == 0:
            self.generator.set_state(state["generator"].cpu())
            if state["gait_noise"].shape == self._gait_noise.shape:  # else of another number of robots
                self._gait_noise = state["gait_noise"].to(self.device, copy=True)
        else:
            self.generator.manual_seed(self.seed + 1000 * rank() + 1_000_003 * self.updates)
        self.storage.clear()
