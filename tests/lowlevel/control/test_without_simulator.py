"""What travels to a robot loads where there is neither MuJoCo nor Pinocchio."""

import subprocess
import sys

BLOCKED = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("mujoco", "pinocchio"):
            raise ModuleNotFoundError(f"{name} is blocked")

sys.meta_path.insert(0, Blocker())
"""


def run(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", BLOCKED + program], capture_output=True, text=True)


def test_a_controller_loads_and_acts_without_a_simulator() -> None:
    program = """
from pathlib import Path
from lowlevel.control.controller import Controller
folder = sorted(Path("checkpoints/lowlevel").iterdir())[0]
controller = Controller.load(folder)
controller.reset(2)  # loading has replayed the golden vectors
print(controller.config.control_period)
"""
    done = run(program)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "0.02"


def test_the_simulator_is_really_blocked() -> None:
    assert "mujoco is blocked" in run("import lowlevel.world.simulation").stderr
