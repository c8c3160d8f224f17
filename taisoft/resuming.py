"""Saving a simulator's state to a checkpoint, and restoring a simulator from one."""

import dataclasses
from pathlib import Path
from typing import Self

from taisoft.attributes import thawed
from taisoft.checkpoint import Checkpoint, check_scene, load_values, read_checkpoint, restore_numbers, write_checkpoint
from taisoft.errors import SceneError, SimulationError
from taisoft.loading import Loading
from taisoft.scene.scene import Scene
from taisoft.settings import Settings, check_dt, plan_of


class Resuming(Loading):
    """Checkpoints of a simulator; `Simulator` adds construction and stepping."""

    _start_scene: Scene  # the scene at the start of the run, frozen

    def save_checkpoint(self, path: str | Path, notes: dict | None = None) -> None:
        """Write everything the next step depends on to a file, atomically; see `taisoft/checkpoint.py`.

        notes: plain data to store with it. Raises SimulationError while a body is dragged or if the state is not finite, and
        OutputError.
        """
        simulation, (start, count) = self._open_simulation(), self._time_base
        if self.dragged is not None:
            raise SimulationError("a body is being dragged, which a checkpoint cannot hold: release it first")
        bad = simulation.find_nonfinite()
        if bad is not None:
            raise SimulationError(f"no checkpoint is written of a state that is not finite: {bad}")
        own = {"dt": self._dt, "time_base": start, "count_base": count}
        state = own | {"simulation": simulation.snapshot(), "stepper": self._stepper.snapshot(), "loads": load_values(self.scene)}
        write_checkpoint(path, dataclasses.asdict(self.settings), self.scene, self.plan.on, state, notes or {}, self._start_scene)

    @classmethod
    def load_checkpoint(cls, path: str | Path, scene: Scene, arch: str | None = None) -> Self:
        """Return a simulator that continues from a checkpoint of the same scene, with its settings and numbers.

        scene: supplies what the file does not hold: meshes, constraints, where loads act, obstacles and paths. Only functions of
        time are not compared. Its numbers must be those at the start of the run; the run continues with those at the time of
        saving. The scene is frozen, as by a new Simulator. arch: replaces the checkpoint's; only its own arch continues bitwise.
        No other setting can be changed here; dt, gravity, materials, loads and contact pairs can be changed later, as in any
        simulator. Initial overlaps are not checked. Raises SimulationError for a file that cannot be used and SceneError for
        another scene, both naming the file.
        """
        return cls.from_checkpoint(read_checkpoint(path), scene, arch)

    @classmethod
    def from_checkpoint(cls, saved: Checkpoint, scene: Scene, arch: str | None = None) -> Self:
        """Do as `load_checkpoint`, from a file's content."""
        if not isinstance(scene, Scene):
            raise SceneError(f"scene must be a Scene, not {type(scene).__name__}")
        settings = saved.settings | ({} if arch is None else {"arch": arch})
        if set(settings) != {field.name for field in dataclasses.fields(Settings)}:
            raise SimulationError(f"{saved.path} holds no state of this scene: its settings are not those of this version")
        check_scene(saved, scene, plan_of(scene, *(settings[key] for key in ("integrator", "self_collision", "draggable"))).on)
        start = scene.snapshot()
        start.allow_initial_overlap = True  # bodies move to the saved positions below
        sim = cls(start, **settings)
        try:
            with thawed(sim.scene):
                sim.scene.allow_initial_overlap = scene.allow_initial_overlap
            sim._restore(saved)
        except (KeyError, TypeError, ValueError) as error:  # the checksum is right, but the content does not fit this scene
            sim.close()
            raise SimulationError(f"{saved.path} holds no state of this scene: {type(error).__name__}: {error}") from None
        except BaseException:
            sim.close()
            raise
        scene.freeze()
        return sim

    def _restore(self, saved: Checkpoint) -> None:
        simulation, state = self._simulation, saved.state
        restore_numbers(saved, self.scene)
        self._load_gravity()
        simulation.upload_material(density=True)
        self._upload_loads()
        if self._contact is not None:
            self._contact.numbers_changed()
        self._stable_dt = None
        self._dt = check_dt(state["dt"])
        self._time_base = float(state["time_base"]), int(state["count_base"])
        simulation.restore(state["simulation"])
        self._stepper.restore(state["stepper"])
