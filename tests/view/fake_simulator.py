"""A stand-in for Simulator whose motion is a formula: for tests of what reads a simulation, not of what computes it."""

from types import SimpleNamespace

import numpy as np

import taisoft as ts
from taisoft.records import Energies, RunReport, StepReport
from taisoft.scene.plan import Plan
from taisoft.settings import Settings

RUBBER = ts.Material(law="stable_neo_hookean", young=1e5, poisson=0.3, density=1000.0)


def beam_scene(names=("beam",), cells=(8, 2, 2), order=1):
    """Beams of 4 x 1 x 1 m, 1.5 m above one another, fixed at their left end."""
    scene = ts.Scene()
    for k, name in enumerate(names):
        body = scene.add_body(ts.box_mesh(cells, (4, 1, 1)), RUBBER, name=name, position=(0, 1.5 * k, 0), order=order)
        body.fix(lambda x: x[:, 0] < -1.99)
    return scene


def plan_of(touching: bool, why: str) -> Plan:
    """A plan of contact forces alone."""
    return Plan([{"feature": "contact_forces", "on": touching, "why": why}])


class FakeSimulator:
    """Bends every body about its left end, more and more with time.

    Stress grows with time and along x, and each body's node 0 is pushed by the next one's, or by an obstacle.
    """

    settings, plan, draggable, dragged, stable_dt = Settings(), plan_of(False, "one body"), False, None, 1.0

    def __init__(self, scene, dt=1 / 60):
        self.scene, self.dt = scene, dt
        self.time, self.step_count, self.compile_seconds = 0.0, 0, 0.0
        self._along = {b.name: b.mesh.vertices[b.mesh.tets, 0].mean(axis=1) for b in scene.bodies}

    def positions(self, name=None):
        if name is None:
            return np.concatenate([self.positions(body.name) for body in self.scene.bodies])
        body = self.scene.body(name)
        x = body.rest_positions + body.position
        bent = x.copy()
        bent[:, 1] -= 0.1 * np.sin(self.time) * (x[:, 0] - x[:, 0].min()) ** 2
        return bent

    def velocities(self, name=None):
        return np.sin(3.0 * self.positions(name) + self.time)

    def stress(self, name=None):
        if name is None:
            return np.concatenate([self.stress(body.name) for body in self.scene.bodies])
        return 1e3 * (self.time + self._along[name])[:, None, None] * np.diag([1.0, 0.2, -0.4])

    def contacts(self):
        names = [collider.name for collider in self.scene.colliders]
        k = len(self.scene.bodies)
        first = np.cumsum([0] + [body.n_nodes for body in self.scene.bodies])
        nodes = np.full((k, 6), -1)
        nodes[:, 0] = first[:-1]
        nodes[:-1, 3] = first[1:-1]
        nodes[:, 4] = np.where(nodes[:, 3] >= 0, nodes[:, 3] + 1, -1)
        weights = np.where(nodes >= 0, (1.0, 0.0, 0.0, 0.75, 0.25, 0.0), 0.0)
        impulse = np.array([(self.time + 0.1 * j, 1.0 + j, -self.time) for j in range(k)])
        names_b = np.array([*names, "an obstacle"][1 : k + 1], dtype=object)
        found = SimpleNamespace(nodes=nodes, weights=weights, impulse=impulse)
        found.body_a, found.body_b = np.array(names[:k], dtype=object), names_b
        found.point, found.normal = self.positions()[nodes[:, 0]], np.tile((0.0, 1.0, 0.0), (k, 1))
        return found

    def energies(self):
        return Energies(kinetic=1.0 + self.time, elastic=2.0, gravity=-3.0)

    def step(self):
        self.time, self.step_count = self.time + self.dt, self.step_count + 1
        return StepReport(time=self.time)

    def run(self, seconds, on_frame=None, fps=60, stop=None):
        self.time, self.step_count = self.time + seconds, self.step_count + 1
        return RunReport(steps=1)

    def reset(self):
        self.time, self.step_count = 0.0, 0
