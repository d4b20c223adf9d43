"""Configurations survive JSON, and what does not fit is refused."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from lowlevel.plain import from_plain
from lowlevel.provenance import read_training_config
from lowlevel.trainer import TrainingConfig


def test_a_configuration_comes_back_from_json_as_it_was() -> None:
    config = TrainingConfig(total_steps=7)
    assert from_plain(TrainingConfig, json.loads(json.dumps(asdict(config)))) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda nominal: nominal | {"colour": 1}, "NominalConfig has no field 'colour'"),
        (lambda nominal: {k: v for k, v in nominal.items() if k != "lean"}, "NominalConfig lacks its field 'lean'"),
    ],
)
def test_unknown_and_absent_fields_are_refused(change, message: str) -> None:
    plain = asdict(TrainingConfig())
    plain["environment"]["nominal"] = change(plain["environment"]["nominal"])
    with pytest.raises(KeyError, match=message):
        from_plain(TrainingConfig, plain)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("stepping_time", "long", "stepping_time must be of type float, not 'long'"),
        ("stepping_time", True, "stepping_time must be of type float, not True"),
        ("gait_clock", 1, "gait_clock must be of type bool, not 1"),
        ("torso_rate", 1.0, r"torso_rate must be a list, not 1\.0"),
        ("lean", [0.1], "lean must have 2 entries, not 1"),
        ("lean", [0.1, None], "lean must be of type float, not None"),
        ("kind", "gallop", "kind must be one of default, pose, march, not 'gallop'"),
    ],
)
def test_values_of_another_type_are_refused(field: str, value: object, message: str) -> None:
    plain = asdict(TrainingConfig())
    plain["environment"]["nominal"][field] = value
    with pytest.raises((TypeError, ValueError), match=message):
        from_plain(TrainingConfig, plain)
    plain["environment"] = 3
    with pytest.raises(TypeError, match="environment must hold the fields of EnvironmentConfig, not 3"):
        from_plain(TrainingConfig, plain)


def test_the_shipped_learning_state_is_of_this_version() -> None:
    run = Path(__file__).resolve().parents[2] / "checkpoints" / "training" / "pilot-g1-simple"
    assert read_training_config(run).environment.terrain.tiles == ("flat", "irregular")
