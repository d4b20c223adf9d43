"""The robustness command: every condition changes what it names, and the report shows all of them."""

import json
from dataclasses import fields
from pathlib import Path

import mujoco
import numpy as np
import pytest

from evaluation.protocols.conditions import CONDITIONS, PUSH_TIMES, condition_of
from evaluation.protocols.suites import suite_of
from evaluation.reporting.statistics import Figure
from evaluation.robustness import SHOWN, main, ratios
from lowlevel.control.controller import Controller
from robots.errors import PilotError
from robots.g1.model import ModelOptions, build_spec


def test_a_condition_is_other_than_the_protocol_in_one_thing() -> None:
    nominal = condition_of("nominal")
    for name, condition in CONDITIONS.items():
        settings = [
            (part, field.name) for part in ("randomization", "options") for field in fields(getattr(nominal, part))
        ]
        changed = [
            name
            for part, name in settings
            if not np.array_equal(
                np.array(getattr(getattr(condition, part), name), dtype=object),
                np.array(getattr(getattr(nominal, part), name), dtype=object),
            )
        ]
        changed += ["push_speed"] * (condition.push_speed != nominal.push_speed)
        assert len(changed) == (name != "nominal"), (name, changed)
    with pytest.raises(PilotError, match="unknown condition 'on-ice'; choose one of nominal, late-20ms"):
        condition_of("on-ice")


def test_pushes_are_as_strong_as_said_and_the_same_for_every_controller(untrained_controller: Path) -> None:
    space = Controller.load(untrained_controller).command_space
    episodes = suite_of("flat").episodes(space, 3, 0)
    pushed = condition_of("pushes-0.5").disturbed(episodes)
    again = condition_of("pushes-0.5").disturbed(suite_of("flat").episodes(space, 3, 0))
    assert [episode.pushes for episode in pushed] == [episode.pushes for episode in again]
    for episode in pushed:
        assert tuple(push.time for push in episode.pushes) == PUSH_TIMES
        for push in episode.pushes:
            assert np.linalg.norm(push.velocity_change) == pytest.approx(0.5) and push.velocity_change[2] == 0.0
    assert pushed[0].pushes != pushed[1].pushes
    assert condition_of("slippery").disturbed(episodes) is episodes


def test_a_heavy_torso_and_heavy_rotors_are_as_heavy_as_said() -> None:
    light, heavy = (build_spec(options).compile() for options in (ModelOptions(), ModelOptions(torso_mass=5.0)))
    assert heavy.body_subtreemass[0] - light.body_subtreemass[0] == pytest.approx(5.0)
    masses = []
    for model in (light, heavy):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        masses.append(data.subtree_com[model.body("torso_link").id] - data.xipos[model.body("torso_link").id])
    assert np.linalg.norm(masses[1]) < np.linalg.norm(masses[0])  # the load hangs at the torso's own center
    rotors = build_spec(ModelOptions(armature_scale=2.0)).compile()
    np.testing.assert_allclose(rotors.dof_armature[6:], 2.0 * light.dof_armature[6:])


def test_ratios_are_errors_over_those_of_the_protocol() -> None:
    figures = {
        key: {name: Figure(2.0 if key == "slippery" else 1.0, "", None, 4) for name in SHOWN} for key in CONDITIONS
    }
    table = ratios(figures)
    assert table.shape == (len(CONDITIONS), len(SHOWN) - 1)
    assert (table[list(CONDITIONS).index("slippery")] == 2.0).all() and table.sum() == table.size + len(SHOWN) - 1


def test_the_command_reports_every_condition(untrained_controller: Path, tmp_path: Path) -> None:
    output = tmp_path / "report"
    main(["--controller", str(untrained_controller), "--episodes", "1", "--robots", "1", "--output", str(output)])
    content = json.loads((output / "metrics.json").read_text())
    (conditions,) = content["conditions"].values()
    assert conditions.keys() == CONDITIONS.keys() and conditions["slippery"].keys() == set(SHOWN)
    report = (output / "report.md").read_text()
    for condition in CONDITIONS.values():
        assert f"| {condition.group}: {condition.label} |" in report
    assert (output / "falls.png").is_file() and (output / "errors-1.png").is_file()
