"""Two gloo processes with half of the robots each must learn what one process learns from all of them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small_learner import SIZES, make_ppo, observation

from lowlevel.learning.ppo import PPO
from lowlevel.runs import distributed

ROBOTS = 8
SETTINGS = {"mirror_loss_weight": 0.0, "minibatches": 1, "epochs": 3, "gamma": 0.9, "actor_learning_rate": 1e-3}


def _fill(ppo: PPO, robots: slice, seed: int) -> dict[str, torch.Tensor]:
    """Fill the rollout with recorded data for ``robots`` of the 8; returns the observation after it."""
    generator = torch.Generator().manual_seed(seed)
    width = robots.stop - robots.start
    for _ in range(ppo.storage.steps):
        observed = observation(generator, ROBOTS)
        action = 0.5 * torch.randn(ROBOTS, SIZES.action, generator=generator)
        reward = torch.randn(ROBOTS, generator=generator)
        ended = torch.rand(ROBOTS, generator=generator) < 0.2
        final = torch.randn(ROBOTS, SIZES.privileged, generator=generator)
        mine = {key: value[robots] for key, value in observed.items()}
        with torch.no_grad():
            output = ppo.learner.policy(mine)
        ppo.storage.write(
            {
                **mine,
                "action": action[robots],
                "mean": output.mean,
                "motion": output.motion,
                "latent": output.latent,
                "log_prob": ppo.learner.log_prob(
                    output.mean, action[robots], mine["history"][:, -SIZES.frame :]
                ).detach(),
            }
        )
        ppo.record(reward[robots], ended[robots], torch.zeros(width, dtype=torch.bool), final[robots])
    return {key: value[robots] for key, value in observation(generator, ROBOTS).items()}


def _learn(robots: slice) -> dict[str, object]:
    ppo = make_ppo(robots.stop - robots.start, **SETTINGS)
    figures = {}
    for seed in range(2):
        figures = ppo.update(_fill(ppo, robots, seed))
    return {"state": ppo.state_dict(), "figures": figures, "rank": distributed.rank()}


def _rank(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", f"file://{folder}/rendezvous", rank=rank, world_size=2)
    torch.manual_seed(rank)
    share = ROBOTS // 2
    result = _learn(slice(rank * share, (rank + 1) * share))
    mixed = [torch.full((2, 2), float(rank)), torch.tensor(10.0 * rank)]
    distributed.average_over_ranks(mixed)
    different = torch.full((3,), float(rank))
    distributed.broadcast([different])
    stops = [distributed.any_rank(rank == 1), distributed.any_rank(False)]
    rows = distributed.gathered(torch.full((1 + rank, 2), float(rank)))
    result |= {"mixed": mixed, "broadcast": different, "stops": stops, "rows": rows}
    torch.save(result, f"{folder}/rank{rank}.pt")
    distributed.stop()


def _flat(tree: object, name: str = "") -> dict[str, torch.Tensor]:
    if isinstance(tree, dict):
        return {key: value for part in tree for key, value in _flat(tree[part], f"{name}/{part}").items()}
    return {name: tree} if isinstance(tree, torch.Tensor) else {}


def test_two_ranks_learn_what_one_process_learns_from_all_robots(tmp_path: Path) -> None:
    torch.multiprocessing.spawn(_rank, args=(str(tmp_path),), nprocs=2)
    first, second = (torch.load(tmp_path / f"rank{rank}.pt", weights_only=True) for rank in range(2))
    assert (first["rank"], second["rank"]) == (0, 1)
    for rank in (first, second):
        assert torch.equal(rank["mixed"][0], torch.full((2, 2), 0.5)) and float(rank["mixed"][1]) == 5.0
        assert torch.equal(rank["broadcast"], torch.zeros(3))
        assert rank["rows"].tolist() == [[0.0, 0.0], [1.0, 1.0], [1.0, 1.0]]
        assert rank["stops"] == [True, False], "all ranks must stop when one is asked to"
    single = _learn(slice(0, ROBOTS))
    modules = ("actor", "critic", "target_encoder")
    expected = _flat({module: single["state"][module] for module in modules})  # type: ignore[index]
    start = _flat({m: make_ppo(ROBOTS, **SETTINGS).state_dict()[m] for m in modules})
    moved = max(float((expected[name].float() - start[name].float()).abs().max()) for name in expected)
    assert moved > 1e-3, "nothing was learned, so equality would mean nothing"
    for rank in (first, second):
        actual = _flat({module: rank["state"][module] for module in modules})
        for name, value in expected.items():
            torch.testing.assert_close(actual[name], value, rtol=1e-5, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}")
        assert rank["figures"]["kl"] == pytest.approx(single["figures"]["kl"], rel=1e-3)  # type: ignore[index]
        assert rank["figures"]["learning_rate"] == single["figures"]["learning_rate"]  # type: ignore[index]
    ours, theirs = (_flat(rank["state"]["actor"]) for rank in (first, second))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours), "ranks have drifted apart"


def test_one_process_needs_no_group(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert distributed.start("cpu") == torch.device("cpu")
    assert (distributed.rank(), distributed.world_size()) == (0, 1)
    values = torch.arange(3.0)
    distributed.average_over_ranks([values])
    assert distributed.sum_over_ranks(values) is values and distributed.gathered(values) is values
    assert values.tolist() == [0, 1, 2]
    distributed.stop()


def test_bad_environments_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "two")
    with pytest.raises(ValueError, match="WORLD_SIZE is 'two'"):
        distributed.start("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="PyTorch finds none"):
        distributed.start("cuda")
