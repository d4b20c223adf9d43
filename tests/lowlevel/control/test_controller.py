"""The frozen controller: golden vectors, ONNX parity, resets, and refusal of bad folders."""

import json
import pickle
import shutil
from copy import deepcopy
from pathlib import Path
from typing import Literal

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from safetensors.torch import load_file, save_file
from some_correction import fill

from lowlevel.control.control_step import ControlStep
from lowlevel.control.controller import (
    CONFIG_FILE,
    GOLDEN_FILE,
    LOST_AFTER,
    ONNX_FILE,
    WEIGHTS_FILE,
    Controller,
    ControllerError,
    content_hash,
)
from lowlevel.control.golden import replay
from lowlevel.control.onnx_step import CONVENTIONS, FIRST_MEMORY, INPUTS
from lowlevel.environment import EnvironmentConfig
from lowlevel.export import export_controller
from lowlevel.trainer import Trainer, TrainingConfig

SHIPPED = sorted((Path(__file__).parents[3] / "checkpoints" / "lowlevel").glob("*/"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exported controller with random weights that matter."""
    path = tmp_path_factory.mktemp("controller")
    trainer = Trainer(TrainingConfig(environment=EnvironmentConfig(num_robots=6, num_threads=1)), path)
    weight = trainer.ppo.actor.head.output_weight
    weight.data += 0.05 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(0))
    fill(trainer.environment.correction)
    export_controller(trainer, path / "exported")
    return path / "exported"


def golden_steps(folder: Path) -> list[dict[str, torch.Tensor]]:
    golden = json.loads((folder / GOLDEN_FILE).read_text())
    return [{name: torch.tensor(value) for name, value in step.items()} for step in golden["steps"]]


@pytest.mark.parametrize(
    ("name", "runtime"), [("exported", "torch"), *((name, "onnx") for name in ("exported", *SHIPPED))]
)
def test_golden_vectors_replay(folder: Path, name: str | Path, runtime: Literal["torch", "onnx"]) -> None:
    path = folder if name == "exported" else Path(name)
    controller = Controller.load(path, runtime=runtime)
    controller.reset(4)
    for step in golden_steps(path):
        assert torch.allclose(replay(controller, step), step["targets"], atol=1e-5)
        assert torch.allclose(controller.last_action, step["action"], atol=1e-4)


def test_onnx_file_needs_nothing_of_this_package(folder: Path) -> None:
    """A port feeds measurements and what came out last, by name, for any number of robots."""
    session = onnxruntime.InferenceSession(folder / ONNX_FILE)
    metadata = session.get_modelmeta().custom_metadata_map
    first = json.loads(metadata[FIRST_MEMORY])
    assert len(first) <= 4
    assert json.loads(metadata[CONVENTIONS]) == json.loads((folder / CONFIG_FILE).read_text())["config"]
    memory = {name: np.repeat(np.array([value], dtype=np.float32), 4, axis=0) for name, value in first.items()}
    names = [output.name for output in session.get_outputs()]
    for step in golden_steps(folder):
        measured = {name: value.numpy() for name, value in step.items() if name in INPUTS}
        outputs = dict(zip(names, session.run(names, measured | memory), strict=True))
        np.testing.assert_allclose(outputs["targets"], step["targets"], atol=1e-5)
        memory = {name: outputs[f"next_{name}"] for name in memory}


def test_the_onnx_file_can_be_read_by_last_years_runtimes_and_names_no_source_files(folder: Path) -> None:
    assert onnx.load(folder / ONNX_FILE).ir_version <= 10
    content = (folder / ONNX_FILE).read_bytes()
    assert b".py" not in content and str(Path.cwd()).encode() not in content


def test_a_controller_without_weights_runs_in_onnx_runtime_alone(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    (copy / WEIGHTS_FILE).unlink()
    Controller.load(copy)
    with pytest.raises(ControllerError, match=WEIGHTS_FILE):
        Controller.load(copy, runtime="torch")


def test_an_onnx_file_that_hides_its_first_memory_is_refused(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    model = onnx.load(copy / ONNX_FILE)
    del model.metadata_props[:]
    onnx.save(model, copy / ONNX_FILE)
    with pytest.raises(ControllerError, match="does not say what its first memory is"):
        Controller.load(copy)


def test_unknown_runtimes_are_refused(folder: Path) -> None:
    with pytest.raises(ControllerError, match="no runtime 'tensorflow'"):
        Controller.load(folder, runtime="tensorflow")  # type: ignore[arg-type]
    with pytest.raises(ControllerError, match="on the CPU"):
        Controller.load(folder, device="meta", runtime="onnx")


@pytest.mark.parametrize("keep", [None, 0, 1000])
def test_missing_or_truncated_onnx_files_are_refused(folder: Path, tmp_path: Path, keep: int | None) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    content = (copy / ONNX_FILE).read_bytes()
    if keep is None:
        (copy / ONNX_FILE).unlink()
    else:
        (copy / ONNX_FILE).write_bytes(content[:keep])
    with pytest.raises(ControllerError, match=ONNX_FILE):
        Controller.load(copy)
    Controller.load(copy, runtime="torch")


def test_resetting_one_robot_forgets_only_that_robot(folder: Path) -> None:
    steps = golden_steps(folder)
    controller, fresh = Controller.load(folder), Controller.load(folder)
    controller.reset(4)
    fresh.reset(4)
    for step in steps:
        replay(controller, step)
    unbroken = controller.twin(4)
    for step in steps:
        replay(unbroken, step)
    controller.reset(4, torch.tensor([2]))
    after, first, continued = (replay(c, steps[0]) for c in (controller, fresh, unbroken))
    assert torch.equal(after[2], first[2])
    assert torch.equal(after[[0, 1, 3]], continued[[0, 1, 3]])
    assert not torch.equal(after[0], first[0])


@pytest.mark.parametrize("runtime", ["onnx", "torch"])
@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_sample_that_is_not_finite_holds_the_targets_and_is_forgotten(
    folder: Path, runtime: Literal["onnx", "torch"], name: str, bad: float
) -> None:
    controller, spared = (Controller.load(folder, runtime=runtime) for _ in range(2))
    first, second, third = golden_steps(folder)
    controller.reset(4)
    spared.reset(4)
    before = replay(controller, first)
    replay(spared, first)
    spoiled = {key: value.clone() for key, value in second.items()}
    spoiled[name][1, 0] = bad
    held, others = replay(controller, spoiled), replay(spared, second)
    assert torch.equal(held[1], before[1])
    assert torch.equal(held[[0, 2, 3]], others[[0, 2, 3]])
    assert controller.holds.tolist() == [False, True, False, False]
    spared.reset(4)
    replay(spared, first)
    assert torch.equal(replay(controller, third)[1], replay(spared, third)[1])
    assert not controller.holds.any()


def test_a_robot_without_usable_samples_is_lost_after_a_while_and_begins_at_the_default_pose(folder: Path) -> None:
    controller = Controller.load(folder)
    controller.reset(4)
    good = golden_steps(folder)[0]
    bad = good | {"joint_position": good["joint_position"].clone()}
    bad["joint_position"][2] = float("nan")
    for _ in range(LOST_AFTER - 1):
        targets = replay(controller, bad)
        assert not controller.lost.any()
    assert torch.equal(targets[2], torch.tensor(controller.config.default_position))
    replay(controller, bad)
    assert controller.lost.tolist() == [False, False, True, False]
    controller.reset(4, torch.tensor([2]))
    assert not controller.lost.any()


@pytest.mark.parametrize("runtime", ["onnx", "torch"])
def test_inference_mode_may_begin_and_end_between_two_steps(folder: Path, runtime: Literal["onnx", "torch"]) -> None:
    controller = Controller.load(folder, runtime=runtime)
    first, second, _ = golden_steps(folder)
    with torch.inference_mode():
        controller.reset(4)
        replay(controller, first)
    controller.reset(4, torch.tensor([0]))
    replay(controller, second)


@pytest.mark.parametrize("runtime", ["onnx", "torch"])
def test_double_precision_around_it_changes_nothing(folder: Path, runtime: Literal["onnx", "torch"]) -> None:
    first = golden_steps(folder)[0]
    usual = Controller.load(folder, runtime=runtime)
    usual.reset(4)
    torch.set_default_dtype(torch.float64)
    try:
        controller = Controller.load(folder, runtime=runtime)
        controller.reset(4)
        targets = replay(controller, {name: value.double() for name, value in first.items()})
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(targets, replay(usual, first))


def test_a_controller_can_be_copied_and_pickled_with_what_it_remembers(folder: Path) -> None:
    controller = Controller.load(folder)
    controller.reset(4)
    first, second, _ = golden_steps(folder)
    replay(controller, first)
    copies = deepcopy(controller), pickle.loads(pickle.dumps(controller))
    targets = replay(controller, second)
    assert all(torch.equal(replay(other, second), targets) for other in copies)


def test_acting_leaves_no_gradient_and_no_changed_weight(folder: Path) -> None:
    controller = Controller.load(folder, runtime="torch")
    assert isinstance(controller.step, ControlStep)
    before = {name: tensor.clone() for name, tensor in controller.step.actor.state_dict().items()}
    controller.reset(4)
    targets = replay(controller, golden_steps(folder)[0])
    assert not targets.requires_grad
    assert all(torch.equal(tensor, before[name]) for name, tensor in controller.step.actor.state_dict().items())


def test_wrong_number_of_robots_is_refused(folder: Path) -> None:
    controller = Controller.load(folder)
    with pytest.raises(RuntimeError, match=r"reset\(4\)"):
        replay(controller, golden_steps(folder)[0])


def test_the_identity_covers_every_file(folder: Path, tmp_path: Path) -> None:
    identities = {content_hash(folder)}
    for number, file in enumerate(sorted(folder.iterdir())):
        copy = Path(shutil.copytree(folder, tmp_path / str(number)))
        if file.suffix == ".json":
            content = json.loads(file.read_text())
            (copy / file.name).write_text(json.dumps(content | {"more": 1}))
        else:
            (copy / file.name).write_bytes(file.read_bytes() + b" ")
        identities.add(content_hash(copy))
    assert len(identities) == 1 + len(list(folder.iterdir())) == 5


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def refused(folder: Path) -> str:
    with pytest.raises(ControllerError) as error:
        Controller.load(folder, runtime="torch")
    message = str(error.value)
    assert "\n" not in message
    return message


def test_empty_folder_is_refused(tmp_path: Path) -> None:
    assert CONFIG_FILE in refused(tmp_path)


def test_missing_weights_are_refused(copy: Path) -> None:
    (copy / WEIGHTS_FILE).unlink()
    assert "is missing" in refused(copy)


def test_truncated_weights_are_refused(copy: Path) -> None:
    (copy / WEIGHTS_FILE).write_bytes((copy / WEIGHTS_FILE).read_bytes()[:1000])
    assert "damaged or truncated" in refused(copy)


def test_weights_that_are_not_finite_are_refused_by_name(copy: Path) -> None:
    tensors = load_file(copy / WEIGHTS_FILE)
    tensors["actor.head.first.weight"][0, 0] = float("nan")
    save_file(tensors, copy / WEIGHTS_FILE)
    assert "'actor.head.first.weight'" in refused(copy)


def test_a_controller_that_is_not_finite_is_not_saved(tmp_path: Path) -> None:
    trainer = Trainer(TrainingConfig(environment=EnvironmentConfig(num_robots=6, num_threads=1)), tmp_path)
    trainer.ppo.actor.head.output_weight.data[0] = float("inf")
    with pytest.raises(ControllerError, match=r"'actor\.head\.output_weight' is not finite"):
        export_controller(trainer, tmp_path / "broken")
    assert not (tmp_path / "broken").exists()


def test_weights_of_another_network_are_refused(copy: Path) -> None:
    tensors = load_file(copy / WEIGHTS_FILE)
    tensors["actor.head.first.weight"] = tensors["actor.head.first.weight"][:, :-1].contiguous()
    save_file(tensors, copy / WEIGHTS_FILE)
    assert "does not fit" in refused(copy)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d | {"format_version": 99}, "format version 99"),
        (lambda d: d | {"config": {k: v for k, v in d["config"].items() if k != "stiffness"}}, "incomplete"),
        (
            lambda d: d | {"config": d["config"] | {"joint_names": d["config"]["joint_names"][::-1]}},
            "joint order",
        ),
    ],
)
def test_wrong_descriptions_are_refused(copy: Path, change, message: str) -> None:
    description = json.loads((copy / CONFIG_FILE).read_text())
    (copy / CONFIG_FILE).write_text(json.dumps(change(description)))
    assert message in refused(copy)


def test_damaged_json_is_refused(copy: Path) -> None:
    (copy / CONFIG_FILE).write_text("{")
    assert "damaged" in refused(copy)
