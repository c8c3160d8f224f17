"""Saving a simulator's state, and a simulator that goes on from it."""

import dataclasses
from pathlib import Path
from typing import Self

from taisoft.attributes import thawed
from taisoft.checkpoint import Checkpoint, check_scene, load_values, read_checkpoint, take_numbers, write_checkpoint
from taisoft.errors import SceneError, SimulationError
from taisoft.loading import Loading
from taisoft.scene.scene import Scene
from taisoft.settings import Settings, check_dt, plan_of


class Resuming(Loading):
    """Checkpoints of a simulator; `Simulator` adds building and stepping."""

    _given: Scene  # as the run began with it, frozen

    def save_checkpoint(self, path: str | Path, notes: dict | None = None) -> None:
        """Write all that the next step rests on to a file, whole or not at all; see `taisoft/checkpoint.py`.

        notes: plain data to keep in it. Raises SimulationError while a body is pulled and for a state that is not finite, and
        OutputError.
        """
        simulation, (start, count) = self._open_simulation(), self._time_base
        if self.dragged is not None:
            raise SimulationError("a body is being pulled, which no checkpoint holds: release it first")
        bad = simulation.find_nonfinite()
        if bad is not None:
            raise SimulationError(f"no checkpoint is made of such a state: {bad}")
        own = {"dt": self._dt, "time_base": start, "count_base": count}
        state = own | {"simulation": simulation.snapshot(), "stepper": self._stepper.snapshot(), "loads": load_values(self.scene)}
        write_checkpoint(path, dataclasses.asdict(self.settings), self.scene, self.plan.on, state, notes or {}, self._given)

    @classmethod
    def load_checkpoint(cls, path: str | Path, scene: Scene, arch: str | None = None) -> Self:
        """A simulator that goes on from a checkpoint of the same scene, with its settings and its numbers.

        scene: gives what the file does not hold: meshes, constraints, where loads act, obstacles, and paths; functions of time
        alone are not compared. Its numbers must be those that the run began with; it goes on with those it had when it was
        saved. It is frozen as by a new Simulator. arch: another one than the checkpoint's; steps go on bitwise
        with its own only. Nothing else of the settings can be changed here; dt, gravity, materials, loads and contact pairs can
        be later, as in any simulator. Initial overlaps are not looked for. Raises SimulationError for a file that cannot be used
        and SceneError for another scene, both naming the file.
        """
        return cls.from_checkpoint(read_checkpoint(path), scene, arch)

    @classmethod
    def from_checkpoint(cls, saved: Checkpoint, scene: Scene, arch: str | None = None) -> Self:
        """As `load_checkpoint`, from a file's content."""
        if not isinstance(scene, Scene):
            raise SceneError(f"scene must be a Scene, not {type(scene).__name__}")
        settings = saved.settings | ({} if arch is None else {"arch": arch})
        if set(settings) != {field.name for field in dataclasses.fields(Settings)}:
            raise SimulationError(f"{saved.path} holds no state of this scene: its settings are not those of this version")
        check_scene(saved, scene, plan_of(scene, *(settings[key] for key in ("integrator", "self_collision", "draggable"))).on)
        start = scene.snapshot()
        start.allow_initial_overlap = True  # where bodies start is not where they are
        sim = cls(start, **settings)
        try:
            with thawed(sim.scene):
                sim.scene.allow_initial_overlap = scene.allow_initial_overlap
            sim._restore(saved)
        except (KeyError, TypeError, ValueError) as error:  # a right checksum does not make it fit
            sim.close()
            raise SimulationError(f"{saved.path} holds no state of this scene: {type(error).__name__}: {error}") from None
        except BaseException:
            sim.close()
            raise
        scene.freeze()
        return sim

    def _restore(self, saved: Checkpoint) -> None:
        simulation, state = self._simulation, saved.state
        take_numbers(saved, self.scene)
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
