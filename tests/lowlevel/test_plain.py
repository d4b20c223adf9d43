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


def test_the_shipped_learning_state_is_of_this_version() -> None:
    run = Path(__file__).resolve().parents[2] / "checkpoints" / "training" / "pilot-g1-simple"
    assert read_training_config(run).environment.terrain.tiles == ("flat", "irregular")
