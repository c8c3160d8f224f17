"""Errors of contact forces in double precision, for `taisoft bench error`: scenes with references, each on two meshes.

A soft half ball pressed on a plane, smooth and rough; a block pushed over a rough plane; a half ball pressed on a block. Steps of
implicit Euler of bodies with almost no mass are load steps. The companion on another mesh is the scene with half, or twice, the
cells. Bodies start at the contact offset, which depends on the mesh. True errors: in space, the distance to the reference; in
time, to the run with TRUTH times the steps on the same mesh; of the solvers, to one with tolerances of EXACT, which not every
mesh meets.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

import taisoft as ts
from taisoft.mesh.quality import mean_surface_edge
from taisoft.records import ERROR_KINDS, Quantity

from .document import Limit, table
from .error_cases import estimate_columns
from .reference_cases.pressing import quarter_ball, quarter_block

TRUTH = 16  # steps of the truth over those of the run
EXACT = {"newton_tolerance": 1e-9, "contact_tolerance": 1e-8}
FACTOR, ENOUGH = 3.0, 0.9  # within which an estimate of a force is to be, either way, and for what fraction of them
SETTLED = 1e-6  # errors over the quantity that are below the tolerances of the reference or of a solve
OFFSET = 2e-3  # contact offset over the mean surface edge
YOUNG = 1e6  # Pa
PUSHED = (0.0, 0.0, 2e-3, 4e-3, 6e-3, 8e-3, 1e-2)  # displacements of the block's face at t = 0, 1, ... [m]


@dataclass(frozen=True)
class Force:
    """A force in a scene. build: number of cells -> scene; steps: of 1 s; cells: of the run and of its companion; truth: [N]."""

    name: str
    build: Callable[[int], ts.Scene] = field(repr=False)
    steps: int
    cells: tuple[int, int]
    quantity: str
    truth: float

    def __str__(self) -> str:
        return f"force: {self.name}, {self.cells[0]} cells, {self.quantity}"


@dataclass
class ForceRow:
    """Value [N], and estimated and true errors [N] by kind."""

    name: str
    cells: tuple[int, int]
    quantity: str
    value: float
    estimated: dict[str, float | None]
    true: dict[str, float]
    notes: list[str]

    def ratio(self, kind: str) -> float:
        """Estimate over truth; NaN if one is unknown, or both are settled."""
        estimate, truth = self.estimated[kind], self.true[kind]
        if estimate is None or max(estimate, truth) <= SETTLED * abs(self.value):
            return math.nan
        return estimate / truth


# --- scenes -----------------------------------------------------------------------------------------------------------


def offset(*meshes: ts.TetMesh, order: int = 1) -> float:
    """The contact offset [m] of bodies of these meshes; a quadratic face touches as four triangles."""
    return OFFSET * min(mean_surface_edge([(mesh.vertices, mesh.surface)]) for mesh in meshes) / order


def ball(n: int, order: int = 1, friction: float = 0.0, block: bool = False) -> ts.Scene:
    """A quarter of a half ball, pressed by 1/50 of its radius on a plane, or by 1/25 on a block of its kind, in 1 s."""
    scene, mesh = ts.Scene(gravity=(0.0, 0.0, 0.0)), quarter_ball(n)
    law, depth = ("st_venant_kirchhoff", 0.04) if block else ("stable_neo_hookean", 0.02)
    meshes = {"ball": mesh}
    if block:
        meshes["block"] = quarter_block(n + n // 4, 3 * n // 4)
    else:
        scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="plane", friction=friction)
    gap = offset(*meshes.values(), order=order)
    for name, one in meshes.items():
        material = ts.Material(law, young=YOUNG, poisson=0.3, density=1e-3, friction=friction)
        body = scene.add_body(one, material, name=name, order=order, position=(0.0, gap if name == "ball" else 0.0, 0.0))
        body.fix(lambda X: X[:, 0] < 1e-9, axes="x")
        body.fix(lambda X: X[:, 2] < 1e-9, axes="z")
    scene.body("ball").move(lambda X: X[:, 1] > 1.0 - 1e-9, lambda t: (0.0, -depth * t, 0.0), axes="y")
    if block:
        scene.body("block").fix(lambda X: X[:, 1] < -1.0 + 1e-9, axes="y")
    return scene


def pushed(n: int) -> ts.Scene:
    """A block of 4 x 1 x 0.2 m in plane strain under 10 kPa, whose left face is pushed over a rough plane."""
    scene, mesh = ts.Scene(gravity=(0.0, 0.0, 0.0)), ts.box_mesh((n, n // 4, 1), (4.0, 1.0, 0.2), (2.0, 0.5, 0.0), "six")
    rubber = ts.Material("stable_neo_hookean", young=YOUNG, poisson=0.3, density=1e-4, friction=0.4)
    body = scene.add_body(mesh, rubber, name="block", position=(0.0, offset(mesh), 0.0))
    body.fix(lambda X: X[:, 0] < np.inf, axes="z")
    body.move(lambda X: X[:, 0] < 1e-9, lambda t: (float(np.interp(t, range(len(PUSHED)), PUSHED)), 0.0, 0.0), axes="x")
    body.add_traction(lambda C: C[:, 1] > 1.0 - 1e-9, (0.0, -1e4, 0.0))
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="plane", friction=0.4)
    return scene


F_Y, F_X = "contact_force.y ball", "contact_force.x ball"
# References of the whole ball: axisymmetric elements, normal force and sum of the radial friction. A quarter has the fourth part
# of the former, and 1/(2 pi) of the latter along x. The block: plane-strain elements, T/N = 0.2946 of N = 4e4 N/m. The ball on
# the block: four meshes of both orders, with the errors of the ball on the plane on the same meshes; they agree to 0.1 %.
FORCES = (
    Force("ball", ball, 1, (8, 16), F_Y, 4361.2 / 4),
    Force("ball", ball, 1, (16, 8), F_Y, 4361.2 / 4),
    Force("quadratic ball", partial(ball, order=2), 1, (4, 8), F_Y, 4361.2 / 4),
    Force("quadratic ball", partial(ball, order=2), 1, (8, 4), F_Y, 4361.2 / 4),
    Force("rough ball", partial(ball, friction=0.5), 1, (8, 16), F_Y, 4501.3 / 4),
    Force("rough ball", partial(ball, friction=0.5), 1, (16, 8), F_Y, 4501.3 / 4),
    Force("rough ball", partial(ball, friction=0.5), 1, (8, 16), F_X, 1337.8 / (2.0 * math.pi)),
    Force("rough ball", partial(ball, friction=0.5), 1, (16, 8), F_X, 1337.8 / (2.0 * math.pi)),
    Force("rough ball", partial(ball, friction=0.5), 1, (12, 24), F_X, 1337.8 / (2.0 * math.pi)),
    Force("pushed block", pushed, 6, (20, 40), "contact_force.x block", -0.2946 * 4e4 * 0.2),
    Force("pushed block", pushed, 6, (40, 20), "contact_force.x block", -0.2946 * 4e4 * 0.2),
    Force("ball on block", partial(ball, block=True), 1, (8, 16), F_Y, 6304.0 / 4),
    Force("ball on block", partial(ball, block=True), 1, (16, 8), F_Y, 6304.0 / 4),
)


# --- measurements -----------------------------------------------------------------------------------------------------


def value_of(case: Force, steps: int = 1, **settings) -> float:
    """The force on the mesh of the run, with so many steps a second [N]; NaN if one did not converge or was cut, since it gives
    the mean over its parts."""
    with ts.Simulator(case.build(case.cells[0]), dt=1.0 / steps, precision="f64", **settings) as sim:
        result = sim.run(case.steps, fps=None, quantities={"force": case.quantity})
        return (
            result.quantities["force"].value
            if all(one.converged and one.substeps == 1 for one in result.step_reports)
            else math.nan
        )


def estimated(case: Force) -> Quantity:
    """Run a scene with its companions."""
    with ts.Simulator(case.build(case.cells[0]), dt=1.0, precision="f64") as sim:
        other = case.build(case.cells[1])
        return sim.run(case.steps, fps=None, error=True, error_mesh=other, quantities={"force": case.quantity}).quantities[
            "force"
        ]


def force_row(case: Force) -> ForceRow:
    """A scene's estimates and truths."""
    one = estimated(case)
    truths = {"time": value_of(case, TRUTH), "space": case.truth, "solver": value_of(case, **EXACT)}
    estimates = {kind: getattr(one, kind) for kind in ERROR_KINDS}
    true = {kind: abs(one.value - truth) for kind, truth in truths.items()}
    return ForceRow(case.name, case.cells, case.quantity.split()[0], one.value, estimates, true, one.notes)


def force_table(rows: list[ForceRow]) -> str:
    """A row per force: its value, and estimate, truth and ratio of each kind of error."""

    columns = (
        ("<scene", lambda r: r.name),
        ("cells", lambda r: str(r.cells[0])),
        ("of the companion", lambda r: str(r.cells[1])),
        ("<quantity", lambda r: r.quantity),
        ("value [N]", lambda r: f"{r.value:.5g}"),
        *(column for kind in ERROR_KINDS for column in estimate_columns(kind, "N", "{:.2g}".format)),
    )
    return table(rows, columns, [f"{row.name}, {row.cells[0]} cells: {note}" for row in rows for note in row.notes])


def force_limits(rows: list[ForceRow]) -> list[Limit]:
    """The fraction of errors in time and space within FACTOR of the truth; settled ones do not count."""
    ratios = [row.ratio(kind) for row in rows for kind in ("time", "space")]
    known = [ratio for ratio in ratios if not math.isnan(ratio)]
    inside = sum(1.0 / FACTOR <= ratio <= FACTOR for ratio in known)
    unknown = sum(row.estimated[kind] is None for row in rows for kind in ("time", "space"))
    name = f"forces: fraction within a factor of {FACTOR:g}"
    return [Limit(name, inside / (len(known) + unknown), ENOUGH, at_least=True)]
