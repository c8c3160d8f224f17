"""Simulation state shared by all steppers: model, constraints, loads and time."""

from dataclasses import dataclass

import numpy as np

from taisoft.backend.arrays import FieldArena, download, upload
from taisoft.backend.runtime import Runtime
from taisoft.dynamics.dirichlet import DirichletConditions
from taisoft.fem.model import Layout, Model, body_loads, damping_table, law_table, upload_mass_matrix
from taisoft.fem.reference import gravity_masses, lumped_masses
from taisoft.scene.scene import Scene


@dataclass
class SimulationState:
    """A scene on the device. time [s] is start + count * dt, so that it does not drift."""

    scene: Scene
    runtime: Runtime
    arena: FieldArena
    model: Model
    layout: Layout
    dirichlet: DirichletConditions
    time: float = 0.0
    step_count: int = 0
    releases: int = 0  # number of releases of prescribed nodes; each invalidates the steppers' history
    loads: np.ndarray | None = None  # (n_nodes, 3) [N] of the scene's tractions and forces; None: not computed, or outdated

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities of all nodes, in their stored precision."""
        x, v = download([self.model.state.x, self.model.state.v])
        return x, v

    def set_state(self, x: np.ndarray, v: np.ndarray) -> None:
        """Set positions [m] and velocities [m/s] of all nodes, (n_nodes, 3)."""
        upload([(self.model.state.x, x), (self.model.state.v, v)])

    def snapshot(self) -> dict:
        """Return the state for a checkpoint; see `taisoft/checkpoint.py`."""
        x, v = self.state()
        return {"time": self.time, "step_count": self.step_count, "released": self.dirichlet.released(), "x": x, "v": v}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`, also one of another instance of the same scene."""
        self.dirichlet.set_released(kept["released"])
        self.upload_constraints()
        self.set_state(kept["x"], kept["v"])
        self.time, self.step_count = float(kept["time"]), int(kept["step_count"])

    def restart(self) -> None:
        """Set the initial state of the scene."""
        self.dirichlet.reset()
        self.upload_constraints()
        self.set_state(self.layout.rest, self._rest_velocities())  # compiles it before a step may need it
        self.time, self.step_count = 0.0, 0

    def upload_constraints(self) -> None:
        """Upload the free axes."""
        upload([(self.model.free, ~self.dirichlet.constrained())])

    def upload_gravity(self) -> None:
        """Upload the scene's gravity."""
        upload([(self.model.gravity, self.scene.gravity[None])])

    def upload_material(self, density: bool) -> None:
        """Upload material numbers of the bodies, and masses if a density changed."""
        m = self.model
        numbers = [(m.law_constants, law_table(self.scene, self.layout, m.elasticity_by_tet))]
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
        """Upload the scene's loads, plus forces (k, 3) [N] on nodes (k,) if given."""
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
        """Return initial velocities, 0 on constrained axes, (n_nodes, 3)."""
        start = [np.broadcast_to(b.velocity, b.rest_positions.shape) for b in self.scene.bodies]
        return np.where(self.dirichlet.constrained(), 0.0, np.concatenate(start))

    def next_targets(self, times: np.ndarray) -> np.ndarray | None:
        """Return targets of prescribed nodes (r, n_prescribed, 3), r >= 1, for the first r of the times; None without such nodes.

        Nodes whose path ends at the first time are released.
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
        """Return targets (n_prescribed, 3) at one time; None without prescribed nodes."""
        rows = self.next_targets(np.array([t]))
        return None if rows is None else rows[0]

    def find_nonfinite(self, force: np.ndarray | None = None) -> str | None:
        """Describe the first node whose position, velocity or force (n_nodes, 3) is not finite; None if there is none."""
        x, v = self.state()
        # explicit steps fail beyond the range of f32
        finite = np.isfinite(x).all(axis=1) & (np.abs(v) <= np.finfo(np.float32).max).all(axis=1)
        if force is not None:
            with np.errstate(over="ignore"):  # a force whose square overflows counts as infinite
                finite &= np.isfinite((force.astype(np.float64) ** 2).sum(axis=1))
        bad = np.flatnonzero(~finite)
        if len(bad) == 0:
            return None
        body = int(np.searchsorted(self.layout.node_start, bad[0], side="right")) - 1
        name, node = self.scene.bodies[body].name, bad[0] - self.layout.node_start[body]
        return f"body '{name}', node {node}: position, velocity or force is no longer finite ({len(bad)} nodes in all)"
