"""Strangers' policies: what a card says reaches the network, and what it says wrongly is refused in one sentence."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from evaluation.baselines.card import Action, CardError, Clock, Input, PolicyCard, Ranges, Source, Term, read_card
from evaluation.baselines.onnx_policy import CARDS, OnnxPolicy, load_controller, load_policy
from evaluation.baselines.terms import upright_orientation
from evaluation.lowlevel import main as evaluate
from evaluation.protocols.arena import Arena, constant
from lowlevel.commands import ARMS, HEIGHT, TORSO, VELOCITY
from lowlevel.control.controller import Controller
from lowlevel.control.observation import Proprioception
from lowlevel.world.terrain import TerrainConfig
from robots.g1.constants import ARM_JOINTS, JOINT_NAMES, joint_index
from robots.g1.nominal_pose import NominalPose
from robots.rotations import from_roll_pitch_yaw, rotate_inverse

LIMITS = (-torch.full((14,), 2.0), torch.full((14,), 2.0))
KNEES = ("left_knee_joint", "right_knee_joint")


def sum_of_inputs(
    path: Path, widths: dict[str, int], batch: int | str = "robots", states: tuple[str, ...] = ()
) -> Path:
    """A network with two outputs per robot: the sum of all its inputs, and of those beside the ``states``.

    Every state comes out as the sum of itself and the other inputs.
    """
    names = list(widths)
    nodes, weights = [], []
    for name, width in widths.items():
        weights.append(numpy_helper.from_array(np.ones((width, 2), np.float32), f"ones_{name}"))
        nodes.append(helper.make_node("MatMul", [name, f"ones_{name}"], [f"sum_{name}"]))
    nodes.append(helper.make_node("Sum", [f"sum_{name}" for name in names], ["action"]))
    outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, [batch, 2])]
    for name in states:
        nodes.append(helper.make_node("Identity", ["action"], [f"next_{name}"]))
        outputs.append(helper.make_tensor_value_info(f"next_{name}", TensorProto.FLOAT, [batch, 2]))
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [batch, width]) for name, width in widths.items()]
    graph = helper.make_graph(nodes, "policy", inputs, outputs, weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), path)
    return path


def card(*inputs: Input, **changes: object) -> PolicyCard:
    plain = PolicyCard(
        name="a stranger",
        source=Source("", "", "", "", ""),
        command=Ranges(vx=(-0.5, 1.0), vy=(-0.2, 0.2), yaw_rate=(0.0, 0.0), height=(0.5, 0.74), arms=True),
        default_position={".*_knee_joint": 0.3, ".*": 0.1},
        stiffness={".*": 100.0},
        damping={".*": 2.0},
        inputs=inputs,
        action=Action("action", KNEES, (0.5, 0.25)),
        commanded_joints=("waist_yaw_joint", ".*_elbow_joint"),
    )
    return replace(plain, **changes)  # type: ignore[arg-type]


def measured(count: int = 1, joints: float = 0.0) -> Proprioception:
    gravity = torch.tensor([[0.0, 0.0, -1.0]]).repeat(count, 1)
    return Proprioception(torch.full((count, 29), joints), torch.zeros(count, 29), torch.zeros(count, 3), gravity)


def told(**parts: float) -> torch.Tensor:
    command = torch.zeros(1, 21)
    for name, value in parts.items():
        command[0, {"vx": 0, "vy": 1, "height": HEIGHT, "yaw": TORSO.stop - 1, "elbow": ARMS.start + 3}[name]] = value
    return command


def act(policy: OnnxPolicy, command: torch.Tensor, joints: float = 0.0) -> torch.Tensor:
    return policy.act(
        measured(len(command), joints), torch.zeros(len(command), 121), command, torch.ones(len(command), 1)
    )


def test_terms_scales_and_offsets_reach_the_network_and_its_output_the_motors(tmp_path: Path) -> None:
    terms = (Term("velocity_command", (2.0, 3.0, 1.0)), Term("height_command", offset=-0.02))
    policy = OnnxPolicy(card(Input("obs", terms)), sum_of_inputs(tmp_path / "p.onnx", {"obs": 4}), LIMITS)
    policy.reset(1)
    targets = act(policy, told(vx=0.5, vy=0.1, height=0.72, yaw=0.4, elbow=1.5))[0]
    output = 2.0 * 0.5 + 3.0 * 0.1 + 0.72 - 0.02
    assert targets[joint_index("left_knee_joint")] == pytest.approx(0.3 + 0.5 * output)
    assert targets[joint_index("right_knee_joint")] == pytest.approx(0.3 + 0.25 * output)
    assert targets[joint_index("waist_yaw_joint")] == pytest.approx(0.4)
    assert targets[joint_index("left_elbow_joint")] == pytest.approx(1.5)
    assert targets[joint_index("left_hip_roll_joint")] == pytest.approx(0.1)


@pytest.mark.parametrize(("first", "begin"), [("zeros", 0.0), ("first frame", 1.0)])
def test_history_holds_the_oldest_frame_first(tmp_path: Path, first: str, begin: float) -> None:
    entry = Input("obs", (Term("height_command"), Term("torso_yaw_command")), history=3, first=first)  # type: ignore[arg-type]
    seen: list[list[float]] = []
    for layout in ("frames", "terms"):
        policy = OnnxPolicy(
            card(replace(entry, layout=layout)),  # type: ignore[arg-type]
            sum_of_inputs(tmp_path / "p.onnx", {"obs": 6}),
            LIMITS,
        )
        policy.reset(1)
        run = policy._run
        policy._run = lambda fed, run=run: seen.append(fed["obs"][0].tolist()) or run(fed)  # type: ignore
        for height, yaw in ((1.0, 10.0), (2.0, 20.0)):
            act(policy, told(height=height, yaw=yaw))
    frames, terms = seen[1], seen[3]
    assert frames == [begin, 10.0 * begin, 1.0, 10.0, 2.0, 20.0]
    assert terms == [begin, 1.0, 2.0, 10.0 * begin, 10.0, 20.0]


def test_every_input_has_a_history_of_its_own(tmp_path: Path) -> None:
    entries = [
        Input(name, (Term("height_command", (scale,)),), history=2, first="first frame")
        for name, scale in (("slow", 1.0), ("fast", 10.0))
    ]
    policy = OnnxPolicy(card(*entries), sum_of_inputs(tmp_path / "p.onnx", {"slow": 2, "fast": 2}), LIMITS)
    policy.reset(1)
    knee = joint_index("left_knee_joint")
    assert float(act(policy, told(height=0.5))[0, knee]) == pytest.approx(0.3 + 0.5 * 11.0)
    assert float(act(policy, told(height=0.7))[0, knee]) == pytest.approx(0.3 + 0.5 * (0.5 + 0.7) * 11.0)


def test_positions_are_relative_to_the_default_and_in_the_cards_order(tmp_path: Path) -> None:
    terms = (Term("joint_position", joints=("right_knee_joint", "left_hip_roll_joint")), Term("last_action"))
    policy = OnnxPolicy(card(Input("obs", terms)), sum_of_inputs(tmp_path / "p.onnx", {"obs": 4}), LIMITS)
    policy.reset(1)
    first = act(policy, told(), joints=0.5)[0, joint_index("left_knee_joint")]
    output = (0.5 - 0.3) + (0.5 - 0.1)
    assert first == pytest.approx(0.3 + 0.5 * output)
    second = act(policy, told(), joints=0.5)[0, joint_index("left_knee_joint")]
    assert second == pytest.approx(0.3 + 0.5 * (output + 2.0 * output))


@pytest.mark.parametrize("batch", ["robots", 1])
def test_a_state_goes_from_output_to_input_and_reset_clears_it(tmp_path: Path, batch: int | str) -> None:
    file = sum_of_inputs(tmp_path / "p.onnx", {"obs": 1, "memory": 2}, batch, states=("memory",))
    policy = OnnxPolicy(card(Input("obs", (Term("height_command"),)), states={"memory": "next_memory"}), file, LIMITS)
    assert policy.batched is (batch == "robots")
    policy.reset(2)
    knee, command = joint_index("left_knee_joint"), told(height=1.0).repeat(2, 1)

    def output() -> list[float]:
        return ((act(policy, command)[:, knee] - 0.3) / 0.5).tolist()

    assert output() == pytest.approx([1.0, 1.0])
    assert output() == pytest.approx([3.0, 3.0])
    policy.reset(2, torch.tensor([1]))
    assert output() == pytest.approx([7.0, 1.0])


def test_the_clock_runs_while_it_walks_and_starts_anew(tmp_path: Path) -> None:
    terms = (Term("sine_of_phase", (1.0, 0.0)), Term("cosine_of_phase", (0.0, 10.0)))
    clocked = card(Input("obs", terms), clock=Clock(period=0.08, offsets=(0.0, np.pi), standing=np.pi))
    policy = OnnxPolicy(clocked, sum_of_inputs(tmp_path / "p.onnx", {"obs": 4}), LIMITS)
    policy.reset(1)

    def output(vx: float) -> float:
        return float((act(policy, told(vx=vx))[0, joint_index("left_knee_joint")] - 0.3) / 0.5)

    assert output(0.0) == pytest.approx(-10.0, abs=1e-4)
    assert [output(0.5) for _ in range(3)] == pytest.approx([-10.0, 1.0, 10.0], abs=1e-4)
    assert output(0.0) == pytest.approx(-10.0, abs=1e-4)
    assert output(0.5) == pytest.approx(-10.0, abs=1e-4)


def test_an_orientation_measures_the_gravity_that_it_is_made_from() -> None:
    tilt = torch.tensor([[0.3, -0.4, 0.0], [0.0, 0.0, 0.0], [-1.2, 0.9, 0.0]])
    down = torch.tensor([[0.0, 0.0, -1.0]]).repeat(3, 1)
    gravity = rotate_inverse(from_roll_pitch_yaw(tilt), down)
    torch.testing.assert_close(rotate_inverse(upright_orientation(gravity), down), gravity)


def test_commands_are_cut_to_what_it_supports(tmp_path: Path) -> None:
    policy = OnnxPolicy(
        card(Input("obs", (Term("walks"),)), action=Action("action", KNEES, (0.0,))),
        sum_of_inputs(tmp_path / "p.onnx", {"obs": 1}),
        LIMITS,
    )
    stands = told(height=0.2, yaw=1.0)
    walks = told(vx=2.0, height=0.9)
    cut = policy.supports.cut(torch.cat([stands, walks]))
    assert cut[0, [HEIGHT, TORSO.stop - 1]].tolist() == pytest.approx([0.5, 0.0])
    assert cut[1, VELOCITY].tolist() == pytest.approx([1.0, 0.0, 0.0]) and cut[1, HEIGHT] == pytest.approx(0.74)


def test_a_policy_stands_in_the_arena(tmp_path: Path) -> None:
    """One that gives nothing: the robot is held in the nominal pose by the card alone."""
    stance = NominalPose.load().lookup(torch.tensor([[0.74, 0.0, 0.0, 0.0]])).position[0]
    default = dict(zip(JOINT_NAMES, [*stance.tolist(), *[0.0] * 14], strict=True))
    stiffness = {".*_(hip|knee)_.*": 200.0, "waist_.*": 200.0, ".*": 60.0}
    still = card(
        Input("obs", (Term("walks"),)),
        default_position=default,
        stiffness=stiffness,
        damping={".*": 4.0},
        commanded_joints=(".*_(shoulder|elbow|wrist)_.*",),
    )
    policy = OnnxPolicy(still, sum_of_inputs(tmp_path / "p.onnx", {"obs": 1}), LIMITS)
    arena = Arena(policy, TerrainConfig(tile_size=16.0), num_threads=1, batch=2)
    moments = list(arena.run([constant(seed, 1.0, arena.space.neutral(), flag=1.0) for seed in range(2)]))
    assert moments[-1].active.all() and moments[-1].command[0, HEIGHT] == pytest.approx(0.74)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"default_position": {"left_kne_joint": 0.0, ".*": 0.0}}, "no joint of the G1 matches 'left_kne_joint'"),
        ({"stiffness": {".*_knee_joint": 1.0}}, "stiffness has no value for left_hip_pitch_joint"),
        ({"inputs": (Input("obs", (Term("height"),)),)}, "has a term 'height'; the terms are"),
        ({"inputs": (Input("obs", (Term("velocity_command", (1.0, 2.0)),)),)}, "has 3 numbers, but 2 scales"),
        (
            {"inputs": (Input("obs", (Term("velocity_command"),)),)},
            "with 1 frames of 3 numbers, p.onnx takes 4 numbers",
        ),
        ({"inputs": (Input("obs", (Term("sine_of_phase"),)),)}, "'sine_of_phase' of a stranger needs a clock"),
        ({"inputs": (Input("observation", ()),)}, "has an input 'obs', which the card of a stranger neither fills"),
        ({"states": {"memory": "next_memory"}}, "fills 'memory', but the inputs of p.onnx are obs"),
        ({"action": Action("actions", KNEES, (1.0,))}, "reads 'actions', but the outputs of p.onnx are action"),
        ({"action": Action("action", ("left_knee_joint",), (1.0,))}, "has 1 joints, 'action' has shape"),
        ({"action": Action("action", KNEES, (1.0, 1.0, 1.0))}, "has 2 numbers, but 3 scales"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    file = sum_of_inputs(tmp_path / "p.onnx", {"obs": 4})
    fits = card(Input("obs", (Term("velocity_command"), Term("height_command"))))
    OnnxPolicy(fits, file, LIMITS)
    with pytest.raises(CardError, match=message.replace("(", r"\(")):
        OnnxPolicy(replace(fits, **changes), file, LIMITS)  # type: ignore[arg-type]


def test_shapes_that_cannot_be_filled_are_named(tmp_path: Path) -> None:
    file = sum_of_inputs(tmp_path / "p.onnx", {"obs": 1}, batch=2)
    with pytest.raises(CardError, match=r"a tensor 'obs' of shape \[2, 1\]: the first number must be 1 or free"):
        OnnxPolicy(card(Input("obs", (Term("walks"),))), file, LIMITS)


def test_a_controller_of_pilot_is_given_by_its_folder(untrained_controller: Path) -> None:
    with pytest.raises(CardError, match="give its folder"):
        load_controller(untrained_controller / "controller.onnx")
    assert isinstance(load_controller(untrained_controller)[1], Controller)


def test_a_recurrent_file_needs_its_state(tmp_path: Path) -> None:
    file = sum_of_inputs(tmp_path / "p.onnx", {"obs": 1, "memory": 2}, states=("memory",))
    with pytest.raises(
        CardError, match=r"p.onnx has an input 'memory', which the card of a stranger neither fills nor"
    ):
        OnnxPolicy(card(Input("obs", (Term("walks"),))), file, LIMITS)


def test_the_card_lies_beside_the_file(tmp_path: Path) -> None:
    file = sum_of_inputs(tmp_path / "p.onnx", {"obs": 1})
    with pytest.raises(CardError, match=r"no card is known for .*p.onnx \(sha256 [0-9a-f]{64}\): write one as p.json"):
        load_policy(file, LIMITS)
    file.with_suffix(".json").write_text(json.dumps(asdict(card(Input("obs", (Term("walks"),))))))
    name, policy = load_controller(file)
    assert name == "a stranger" and isinstance(policy, OnnxPolicy)
    with pytest.raises(CardError, match="there is no file"):
        load_controller(tmp_path / "q.onnx")
    (tmp_path / "r.onnx").write_bytes(b"no network")
    (tmp_path / "r.json").write_text(file.with_suffix(".json").read_text())
    with pytest.raises(CardError, match=r"r.onnx is no valid ONNX file"):
        load_controller(tmp_path / "r.onnx")


@pytest.mark.parametrize("path", sorted(CARDS.glob("*.json")), ids=lambda path: path.stem)
def test_shipped_cards_can_be_read(path: Path) -> None:
    shipped = read_card(path)
    assert len(shipped.source.sha256) == 64 and shipped.source.license


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is no JSON file"),
        ('{"name": "x"}', "PolicyCard lacks its field"),
        ('{"nmae": "x"}', "has no field 'nmae'"),
    ],
)
def test_damaged_cards_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "card.json").write_text(text)
    with pytest.raises(CardError, match=message):
        read_card(tmp_path / "card.json")
    with pytest.raises(CardError, match="there is no card"):
        read_card(tmp_path / "none.json")


def test_arm_joints_follow_the_command_of_a_policy_that_leaves_them_alone(tmp_path: Path) -> None:
    alone = card(Input("obs", (Term("walks"),)), commanded_joints=(".*_(shoulder|elbow|wrist)_.*",))
    policy = OnnxPolicy(alone, sum_of_inputs(tmp_path / "p.onnx", {"obs": 1}), LIMITS)
    policy.reset(1)
    command = torch.zeros(1, 21)
    command[0, ARMS] = torch.linspace(-1.0, 1.0, 14)
    assert torch.equal(act(policy, command)[0, ARM_JOINTS], command[0, ARMS])


def test_a_stranger_is_evaluated_and_compared(tmp_path: Path, untrained_controller: Path) -> None:
    """By the command: a policy without experts, alone and beside PILOT's."""
    file = sum_of_inputs(tmp_path / "p.onnx", {"obs": 1})
    file.with_suffix(".json").write_text(json.dumps(asdict(card(Input("obs", (Term("walks"),))))))
    options = ["--episodes", "1", "--walk-episodes", "1", "--skill-episodes", "0", "--robots", "1", "--threads", "1"]
    evaluate(["--controller", str(file), "--output", str(tmp_path / "alone"), *options])
    assert not (tmp_path / "alone" / "experts.png").exists()
    text = (tmp_path / "alone" / "report.md").read_text()
    assert "Controller `a stranger`" in text and "## Experts" not in text
    assert "| standing | 0.00 to 0.00 | 0.00 to 0.00 | 0.00 to 0.00 | 0.50 to 0.74 |" in text
    ours = ["--controller", str(untrained_controller), "--output", str(tmp_path / "both"), *options]
    evaluate([*ours, "--against", str(file)])
    content = json.loads((tmp_path / "both" / "metrics.json").read_text())
    assert set(content["others"]) == set(content["differences"]) == {"a stranger"}
    with pytest.raises(SystemExit, match="same name or are the same"):
        evaluate([*ours, "--against", str(file), str(file)])


def test_controllers_with_nothing_in_common_are_not_compared(tmp_path: Path, untrained_controller: Path) -> None:
    low = card(Input("obs", (Term("walks"),)), command=Ranges((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), height=(0.1, 0.2)))
    file = sum_of_inputs(tmp_path / "p.onnx", {"obs": 1})
    file.with_suffix(".json").write_text(json.dumps(asdict(low)))
    with pytest.raises(SystemExit, match="have no base_height in common while they stand"):
        evaluate(["--controller", str(untrained_controller), "--against", str(file), "--output", str(tmp_path / "x")])
