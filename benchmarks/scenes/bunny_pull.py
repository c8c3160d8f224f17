"""The ears of a rubber bunny are pulled up for a second and let go.

A bunny 3 m tall (bunny.msh of polyfem-data, 19,379 tets) of stable neo-Hookean rubber, E = 1 MPa, stands with its base
fixed, under gravity. The tips of its ears rise by 1.4 m, more than the ears are long; at 1 s they are released, fall
behind the head and swing up again. Without the 0.03 s of stiffness damping they would snap back hard enough to turn
tets inside out. Bodies do not touch in this version, so nothing but their own stiffness keeps the ears off the back.

The mesh is not part of taisoft. It is looked for at the path in the variable BUNNY_MESH, else at
shared/meshes/bunny.msh beside the repository.
"""

import os
from pathlib import Path

import numpy as np

import taisoft as ts

solver = {"integrator": "bdf2", "dt": 1 / 120, "seconds": 2.0, "fps": 60.0}

BESIDE = Path(__file__).resolve().parents[3] / "shared" / "meshes" / "bunny.msh"
BASE_BELOW, TIPS_ABOVE = -0.25, 2.45  # [m]: heights in the file's coordinates, which run from -0.34 to 2.74
RISE, RELEASE = 1.4, 1.0  # [m], [s]


def mesh_path() -> Path:
    """Where the mesh is looked for."""
    return Path(os.environ.get("BUNNY_MESH", BESIDE))


def build() -> ts.Scene:
    """The bunny at rest, its base fixed, its ears on the way up. Raises MeshError where its mesh is not found."""
    path = mesh_path()
    if not path.is_file():
        raise ts.MeshError(f"{path}: no such file; set the variable BUNNY_MESH to the path of polyfem-data's bunny.msh")
    scene = ts.Scene(gravity=(0.0, -9.81, 0.0))
    rubber = ts.Material(law="stable_neo_hookean", young=1e6, poisson=0.4, density=1000.0, stiffness_damping=0.03)
    bunny = scene.add_body(ts.read_mesh(path), rubber, name="bunny")
    bunny.fix(lambda X: X[:, 1] < BASE_BELOW)
    rise = ts.KeyFrames((0.0, RELEASE), [(0.0, 0.0, 0.0), (0.0, RISE, 0.0)], smooth=True, release=True)
    bunny.move(lambda X: X[:, 1] > TIPS_ABOVE, rise)
    return scene


def check(sim: ts.Simulator, result) -> None:
    """At the end: the base where it was, the ears let go of and moving. Before it: energy taken up, then given back."""
    assert result.status == "ok", result.problems
    X, x = sim.scene.body("bunny").rest_positions, sim.positions("bunny")
    base, tips = X[:, 1] < BASE_BELOW, X[:, 1] > TIPS_ABOVE
    assert np.abs(x[base] - X[base]).max() < 1e-12, "the base has moved"
    assert np.abs(sim.reactions("bunny")[tips]).max() == 0.0, "the released ears are still held"
    assert np.linalg.norm(sim.velocities("bunny")[tips], axis=1).min() > 0.1, "the released ears stand still"
    drop = (RISE + X[tips, 1] - x[tips, 1]).min()
    assert drop > 0.5 * RISE, f"an ear came down by {drop:.3f} m only"

    elastic = {round(report.time, 6): report.elastic for report in result.step_reports}
    pulled, left = elastic[RELEASE], min(elastic[time] for time in elastic if RELEASE < time < RELEASE + 0.3)
    assert left < 0.3 * pulled, f"of {pulled:.0f} J in the stretched ears {left:.0f} J stay"
