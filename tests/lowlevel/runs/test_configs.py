"""Configurations survive JSON, and what does not fit is refused."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import pytest

from lowlevel.presets import PRESETS
from lowlevel.runs.configs import from_plain
from lowlevel.trainer import TrainingConfig


@pytest.mark.parametrize("name", PRESETS)
def test_a_configuration_comes_back_from_json_as_it_was(name: str) -> None:
    config = replace(PRESETS[name], total_steps=7)
    assert from_plain(TrainingConfig, json.loads(json.dumps(asdict(config)))) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda noise: noise | {"color": 1}, "NoiseConfig has no field 'color'"),
        (lambda noise: {k: v for k, v in noise.items() if k != "elevation"}, "NoiseConfig lacks its field 'elevation'"),
    ],
)
def test_unknown_and_absent_fields_are_refused(change, message: str) -> None:
    plain = asdict(TrainingConfig())
    plain["environment"]["noise"] = change(plain["environment"]["noise"])
    with pytest.raises(KeyError, match=message):
        from_plain(TrainingConfig, plain)


@pytest.mark.parametrize(
    ("part", "field", "value", "message"),
    [
        ("network", "latent", "wide", "latent must be of type int, not 'wide'"),
        ("network", "latent", True, "latent must be of type int, not True"),
        ("network", "vision", 1, "vision must be of type bool, not 1"),
        ("network", "history_hidden", 1.0, r"history_hidden must be a list, not 1\.0"),
        ("network", "expert_hidden", [1], "expert_hidden must have 2 entries, not 1"),
        ("network", "expert_hidden", [1, None], "expert_hidden must be of type int, not None"),
    ],
)
def test_values_of_another_type_are_refused(part: str, field: str, value: object, message: str) -> None:
    plain = asdict(TrainingConfig())
    plain[part][field] = value
    with pytest.raises((TypeError, ValueError), match=message):
        from_plain(TrainingConfig, plain)
    plain["environment"] = 3
    with pytest.raises(TypeError, match="environment must hold the fields of EnvironmentConfig, not 3"):
        from_plain(TrainingConfig, plain)
