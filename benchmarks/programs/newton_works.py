"""Newton on the works, on the processor in float32. Warp captures the launches of 10 ms and replays them as a graph.

* "vbd": vertex block descent, implicit Euler with a fixed number of sweeps a step. Law SNH13 of works.semi_discrete. Contact is
  a spring of `stiffness` [N/m] a vertex; triangles of several bodies meet by `particle_enable_self_contact`, RADIUS apart, and
  are looked for within RADIUS + `gap` [m]. No vertex moves farther than 0.43 times that in a step: with a small gap bodies hang
  in the air.
* "semi_implicit": explicit, v first, then x with the new v. Law SNH. Started with the velocity of half a step before,
  v = -a(0) dt/2, its steps are leapfrog, of second order. Contact with the ground is an explicit spring of `stiffness` [N/m],
  a damper of `damping` and a friction slope of `slope` [N s/m] a vertex, at the distance `radius` [m]. Its contact of bodies
  tests every vertex against every triangle and cannot tell the sides of one, so it does not run W3 and W4.
"""

import numpy as np

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.machine import require

from ..exact_path import DENSITY, POISSON
from ..works.references import NEWTON, TAISOFT, masses
from ..works.scenes import Body, Work
from .session import Session, Setting

NAME, MODEL = "Newton", NEWTON
EXPLICIT_MODEL = TAISOFT  # semi_implicit has the law and the masses of taisoft's stable neo-Hookean
RADIUS = 1e-3  # m
# Steps of semi_implicit in 10 ms, by tets and Young's modulus [Pa]: about the fewest that last for 1 s, and finer.
STEPS = {(540, 1e6): (2, 3, 5, 10), (4320, 1e6): (5, 10, 20), (34560, 1e6): (9, 18), (540, 1e8): (20, 40), (540, 1e9): (62, 124)}
# semi_implicit on the ground: steps in 10 ms, then what GROUND names. Stiffer springs and larger slopes need shorter steps.
GROUND = ("stiffness", "damping", "slope", "radius")
ON_GROUND = ((8, 5e4, 10.0, 20.0, 3e-3), (12, 7e4, 10.0, 30.0, 3e-3), (16, 1e5, 20.0, 40.0, 3e-3), (32, 2e5, 120.0, 100.0, 1e-3))


def load():
    """Newton and Warp, without a log line per compiled module. Raises SimulationError where they are absent."""
    warp = require("warp", "the comparison with Newton", "peers", SimulationError)
    warp.config.log_level = warp.LOG_WARNING
    return require("newton", "the comparison with Newton", "peers", SimulationError), warp


def settings(work: Work, arch: str = "cpu") -> list[Setting]:
    """Steps and sweeps from coarse to fine, for large meshes only coarse ones; on the ground soft and stiff springs."""
    if work.kind == "stand":
        gaps = ((1, 3, 0.06), (1, 5, 0.06), (1, 10, 0.06), (2, 5, 0.03), (1, 5, RADIUS))
        implicit = [(steps, sweeps, {"stiffness": 1e6, "gap": gap}) for steps, sweeps, gap in gaps]
    elif work.touches:
        implicit = [(1, 20, {"stiffness": 1e5}), (1, 20, {"stiffness": 1e6}), (2, 10, {"stiffness": 1e6})]
    else:
        implicit = [(1, 20, {}), (2, 10, {}), (5, 20, {})][: 3 if work.tets < 1000 else 2 if work.tets < 10_000 else 1]
    return [Setting(NAME, MODEL, "vbd", n, {"sweeps": sweeps} | spring) for n, sweeps, spring in implicit] + _explicit(work)


def _explicit(work: Work) -> list[Setting]:
    if work.cells is not None:
        return [Setting(NAME, EXPLICIT_MODEL, "semi_implicit", n) for n in STEPS[work.tets, work.bodies[0].young]]
    if not work.ground or len(work.bodies) > 1:
        return []
    return [Setting(NAME, EXPLICIT_MODEL, "semi_implicit", steps, dict(zip(GROUND, numbers))) for steps, *numbers in ON_GROUND]


class Run(Session):
    """`build` captures the launches of one SAMPLE as a graph."""

    def build(self) -> None:
        newton, self.warp = load()
        work, setting = self.work, self.setting
        self.explicit = setting.method == "semi_implicit"
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -work.gravity, 0.0))
        builder.default_particle_radius = setting.options.get("radius", RADIUS)
        touch = {"ke": setting.options.get("stiffness", 0.0), "kd": setting.options.get("damping", 0.0)}
        slope = {"kf": setting.options["slope"]} if "slope" in setting.options else {}
        if work.ground:
            builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=work.friction, **touch, **slope))
        kg = np.where(self.free, masses(work, setting.model), 0.0)
        for body, nodes in zip(work.bodies, work.slices().values()):
            if self.explicit:
                _add_bare(builder, body, kg[nodes], self.warp)
            else:
                _add(builder, body, self.warp)
        for node in np.flatnonzero(~self.free):
            builder.particle_mass[node] = 0.0
            builder.particle_flags[node] &= ~int(newton.ParticleFlags.ACTIVE)
        builder.color()
        self.model = builder.finalize(device="cpu")
        if work.touches:
            self.model.soft_contact_ke, self.model.soft_contact_kd = touch["ke"], touch["kd"]
            self.model.soft_contact_mu = work.friction
            self.model.soft_contact_kf = slope.get("kf", self.model.soft_contact_kf)
        self.solver = self._solver(newton)
        self.pipeline = newton.CollisionPipeline(self.model) if work.ground else None
        self.contacts = self.pipeline.contacts() if self.pipeline else None
        self.states, self.control = [self.model.state(), self.model.state()], self.model.control()
        self._launch()  # compiles
        with self.warp.ScopedCapture(device="cpu") as capture:
            self._launch()
        self.graph = capture.graph

    def _solver(self, newton):
        if self.explicit:
            self.model.particle_grid = None  # nodes do not meet nodes
            return newton.solvers.SolverSemiImplicit(self.model, enable_tri_contact=False)
        several = len(self.work.bodies) > 1
        meeting = {"particle_enable_self_contact": several}
        if several:
            meeting |= {"particle_self_contact_margin": RADIUS, "particle_self_contact_gap": self.setting.options["gap"]}
        return newton.solvers.SolverVBD(self.model, iterations=self.setting.options["sweeps"], **meeting)

    def _launch(self) -> None:
        """The steps of 10 ms; they start and end in the first state, since a graph holds addresses."""
        now, then = self.states
        for _ in range(self.setting.steps):
            now.clear_forces()
            if self.pipeline is not None:
                self.pipeline.collide(now, self.contacts)
            self.solver.step(now, then, self.control, self.contacts, self.setting.dt)
            now, then = then, now
        if now is not self.states[0]:
            self.warp.copy(then.particle_q, now.particle_q)
            self.warp.copy(then.particle_qd, now.particle_qd)

    def reset(self) -> None:
        velocity = np.zeros((len(self.free), 3), np.float32)
        if self.explicit:
            velocity[self.free, 1] = self.work.gravity * self.setting.dt / 2  # -a(0) dt/2: at rest gravity alone accelerates
        for state in self.states:
            state.particle_q.assign(self.work.start.astype(np.float32))
            state.particle_qd.assign(velocity)

    def step(self) -> None:
        self.warp.capture_launch(self.graph)

    def positions(self) -> np.ndarray:
        return self.states[0].particle_q.numpy().astype(float)


def _add(builder, body: Body, warp) -> None:
    """Add a soft mesh with its surface, for contact between bodies."""
    material = ts.Material(young=body.young, poisson=POISSON)
    place = {"pos": warp.vec3(0.0), "rot": warp.quat_identity(), "scale": 1.0, "vel": warp.vec3(0.0)}
    law = {"density": DENSITY, "k_mu": material.mu, "k_lambda": material.lam, "k_damp": 0.0}
    vertices, tets = [warp.vec3(*x) for x in body.mesh.vertices], body.mesh.tets.ravel().tolist()
    builder.add_soft_mesh(**place, **law, vertices=vertices, indices=tets, add_surface_mesh_edges=True)


def _add_bare(builder, body: Body, kg: np.ndarray, warp) -> None:
    """Add nodes and tets without surface triangles, which semi_implicit would visit in every step."""
    material, first, n = ts.Material(young=body.young, poisson=POISSON), builder.particle_count, body.mesh.n_verts
    positions, at_rest = [warp.vec3(*x) for x in body.mesh.vertices], [warp.vec3(0.0)] * n
    radius = [builder.default_particle_radius] * n
    builder.add_particles(pos=positions, vel=at_rest, mass=kg.tolist(), radius=radius)
    for tet in (first + body.mesh.tets).tolist():
        # its law has no factors that match Lame's parameters at small strain (Smith, de Goes and Kim 2018, eq. 16)
        builder.add_tetrahedron(*tet, 4 / 3 * material.mu, material.lam + 5 / 6 * material.mu, 0.0)
