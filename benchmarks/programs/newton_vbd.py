"""Newton's vertex block descent on the works, on the processor: implicit Euler, a fixed number of sweeps a step, float32.

Its law is SNH13 of works.semi_discrete. Contact is a spring of `stiffness` [N/m] a vertex; between soft bodies triangles meet by
`particle_enable_self_contact`, which needs a radius [m].
"""

from time import perf_counter

import numpy as np

import taisoft as ts

from ..exact_path import DENSITY, POISSON
from ..works.references import NEWTON
from ..works.scenes import Body, Work
from .session import Setting, sampled

NAME, MODEL = "Newton", NEWTON
RADIUS = 1e-3  # m


def problem() -> str:
    """Why it cannot be had."""
    try:
        _import_newton()
    except ImportError:
        return "the comparison with Newton needs the package newton"
    return ""


def _import_newton():
    """Newton and Warp, who would tell of every module that they compile."""
    import warp

    warp.config.log_level = warp.LOG_WARNING
    import newton

    return newton, warp


def settings(work: Work, arch: str = "cpu") -> list[Setting]:
    """Steps and sweeps, coarse to fine; large meshes the coarse ones only; with contact soft and stiff springs."""
    tried = ((1, 20), (2, 10), (5, 20)) if work.tets < 10_000 else ((1, 20),)
    springs = ({"stiffness": 1e5}, {"stiffness": 1e6}) if work.touches else ({},)
    return [
        Setting(NAME, MODEL, "vbd", steps, {"sweeps": sweeps} | spring)
        for steps, sweeps in tried for spring in springs
        if steps < 5 or spring is springs[-1]
    ]  # fmt: skip


class Run:
    """A Session."""

    unconverged = 0  # it does not tell

    def __init__(self, work: Work, setting: Setting) -> None:
        newton, warp = _import_newton()

        self.work, self.setting, start = work, setting, perf_counter()
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -work.gravity, 0.0))
        builder.default_particle_radius = RADIUS
        if work.ground:
            ground = newton.ModelBuilder.ShapeConfig(mu=work.friction, ke=setting.options["stiffness"], kd=0.0)
            builder.add_ground_plane(cfg=ground)
        for body in work.bodies:
            _add(builder, body, newton, warp)
        builder.color()
        self.model = builder.finalize(device="cpu")
        several = len(work.bodies) > 1
        if work.touches:
            self.model.soft_contact_ke, self.model.soft_contact_kd = setting.options["stiffness"], 0.0
            self.model.soft_contact_mu = work.friction
        meeting = {"particle_self_contact_radius": RADIUS, "particle_self_contact_margin": 2 * RADIUS} if several else {}
        self.solver = newton.solvers.SolverVBD(
            self.model, iterations=setting.options["sweeps"], particle_enable_self_contact=several, **meeting
        )
        self.pipeline = newton.CollisionPipeline(self.model) if work.ground else None
        self.contacts = self.pipeline.contacts() if self.pipeline else None
        self.states, self.control = [self.model.state(), self.model.state()], self.model.control()
        self._step()  # compiles
        self.build_seconds = perf_counter() - start

    def _step(self) -> None:
        now, then = self.states
        now.clear_forces()
        if self.pipeline is not None:
            self.pipeline.collide(now, self.contacts)
        self.solver.step(now, then, self.control, self.contacts, self.setting.dt)
        self.states = [then, now]

    def run(self, follow: bool) -> tuple[np.ndarray | None, float]:
        self.states = [self.model.state(), self.model.state()]

        def steps() -> None:
            for _ in range(self.setting.steps):
                self._step()

        return sampled(self.work, NAME, follow, steps, lambda: self.states[0].particle_q.numpy().astype(float))

    def close(self) -> None:
        """Nothing is held."""


def start(work: Work, setting: Setting) -> Run:
    """Ready to run."""
    return Run(work, setting)


def _add(builder, body: Body, newton, warp) -> None:
    material = ts.Material(young=body.young, poisson=POISSON)
    first = builder.particle_count
    builder.add_soft_mesh(
        pos=warp.vec3(0.0), rot=warp.quat_identity(), scale=1.0, vel=warp.vec3(0.0), density=DENSITY, k_mu=material.mu,
        k_lambda=material.lam, k_damp=0.0, vertices=[warp.vec3(*x) for x in body.mesh.vertices],
        indices=body.mesh.tets.ravel().tolist(), add_surface_mesh_edges=True,
    )  # fmt: skip
    for node in first + np.flatnonzero(body.fixed):
        builder.particle_mass[node] = 0.0
        builder.particle_flags[node] &= ~int(newton.ParticleFlags.ACTIVE)
