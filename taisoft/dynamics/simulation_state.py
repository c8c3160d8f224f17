"""World: what every stepper works on: model, constraints, time; the one place that touches them together."""

from dataclasses import dataclass

import numpy as np

from taisoft.dynamics.dirichlet import DirichletConditions
from taisoft.fields import FieldArena
from taisoft.mass import gravity_masses, lumped_masses, upload_mass_matrix
from taisoft.model import Layout, Model, body_loads, damping_table, material_table
from taisoft.runtime import Runtime
from taisoft.scene.scene import Scene
from taisoft.transfer import download, upload


@dataclass
class SimulationState:
    """A scene in the machine. time [s] is start + count * dt, so that it does not drift."""

    scene: Scene
    runtime: Runtime
    arena: FieldArena
    model: Model
    layout: Layout
    dirichlet: DirichletConditions
    time: float = 0.0
    step_count: int = 0
    releases: int = 0  # times that led nodes were let go: what steppers know of the past then no longer holds
    loads: np.ndarray | None = None  # (n_nodes, 3) [N] of the scene's tractions and forces; None: not known, or changed since

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities of all nodes, as they are held."""
        x, v = download([self.model.state.x, self.model.state.v])
        return x, v

    def set_state(self, x: np.ndarray, v: np.ndarray) -> None:
        """Positions [m] and velocities [m/s] of all nodes (n_nodes, 3)."""
        upload([(self.model.state.x, x), (self.model.state.v, v)])

    def snapshot(self) -> dict:
        """What the next step rests on, for a checkpoint; see `taisoft/checkpoint.py`."""
        x, v = self.state()
        return {"time": self.time, "step_count": self.step_count, "released": self.dirichlet.released(), "x": x, "v": v}

    def restore(self, kept: dict) -> None:
        """Back to what `snapshot` told, also of another world of the same scene."""
        self.dirichlet.set_released(kept["released"])
        self.upload_constraints()
        self.set_state(kept["x"], kept["v"])
        self.time, self.step_count = float(kept["time"]), int(kept["step_count"])

    def restart(self) -> None:
        """The state at the scene's start."""
        self.dirichlet.reset()
        self.upload_constraints()
        self.set_state(self.layout.rest, self._rest_velocities())  # so that it is compiled before a step must be taken back
        self.time, self.step_count = 0.0, 0

    def upload_constraints(self) -> None:
        """Free axes to the device."""
        upload([(self.model.free, ~self.dirichlet.constrained())])

    def upload_material(self, density: bool) -> None:
        """Material numbers of the bodies to the device, and masses if a density changed."""
        m = self.model
        numbers = [(m.law_constants, material_table([b.material for b in self.scene.bodies]))]
        if m.damping is not None:
            numbers.append((m.damping, damping_table(self.scene)))
        if density:
            numbers.append((m.mass, lumped_masses(self.scene)))
            if m.gravity_mass is not m.mass:
                numbers.append((m.gravity_mass, gravity_masses(self.scene)))
        upload(numbers)
        if density and m.consistent:
            upload_mass_matrix(self.scene, m.mass_matrix)

    def upload_loads(self, nodes: np.ndarray | None = None, forces: np.ndarray | None = None) -> None:
        """The scene's loads to the device, with more forces (k, 3) [N] on nodes (k,) added to them where these are given."""
        if not self.model.loaded:
            return
        if self.loads is None:
            self.loads = body_loads(self.scene)
        loads = self.loads
        if nodes is not None:
            loads = loads.copy()
            np.add.at(loads, nodes, forces)
        upload([(self.model.loads, loads)])

    def _rest_velocities(self) -> np.ndarray:
        """Initial velocities with 0 on constrained axes (n_nodes, 3)."""
        start = [np.broadcast_to(b.velocity, b.rest_positions.shape) for b in self.scene.bodies]
        return np.where(self.dirichlet.constrained(), 0.0, np.concatenate(start))

    def next_targets(self, times: np.ndarray) -> np.ndarray | None:
        """Targets of led nodes (r, n_prescribed, 3), r >= 1, for the first r of the times; None when nothing is led.

        Nodes that let go at the first time are released here.
        """
        if self.dirichlet.n_prescribed == 0:
            return None
        rows, releasing = self.dirichlet.targets(times)
        while releasing and len(rows) == 0:
            self.releases += 1
            self.upload_constraints()
            rows, releasing = self.dirichlet.targets(times)
        return rows

    def next_target(self, t: float) -> np.ndarray | None:
        """Targets (n_prescribed, 3) at one time."""
        rows = self.next_targets(np.array([t]))
        return None if rows is None else rows[0]

    def find_nonfinite(self, force: np.ndarray | None = None) -> str | None:
        """Names the first node whose position, velocity or force (n_nodes, 3) is not finite, in a few words."""
        x, v = self.state()
        # explicit steps give up beyond the range of f32
        good = np.isfinite(x).all(axis=1) & (np.abs(v) <= np.finfo(np.float32).max).all(axis=1)
        if force is not None:
            with np.errstate(over="ignore"):  # a force whose square overflows is as bad as an infinite one
                good &= np.isfinite((force.astype(np.float64) ** 2).sum(axis=1))
        bad = np.flatnonzero(~good)
        if len(bad) == 0:
            return None
        body = int(np.searchsorted(self.layout.node_start, bad[0], side="right")) - 1
        name, node = self.scene.bodies[body].name, bad[0] - self.layout.node_start[body]
        return f"body '{name}', node {node}: position, velocity or force is no longer finite ({len(bad)} nodes in all)"
