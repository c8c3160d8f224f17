"""Problems that any mesh must solve to rounding: laws at a point, affine fields, rigid motion, free fall."""

from functools import partial

import numpy as np

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, INTEGRATORS
from taisoft.fem.reference import lumped_masses

from .record import GRAVITY, LAWS, Case, deformation_gradients, face, material, near, rotation, scene, small, worst

SEED = 7  # of the patch test's mesh


def stress_table(law: str, reference: dict, arch: str):
    """P and psi at the tabulated F, over max(|P|, E) and max(|psi|, E)."""
    rows, young = reference["value"], reference["material"]["E"]
    F = np.array([row["F"] for row in rows])
    psi, P = ts.evaluate_law(LAWS[law], F, young, reference["material"]["nu"])
    stresses, energies = [], []
    for k, row in enumerate(rows):
        exact = np.array(row[law]["P"])
        i = np.unravel_index(np.argmax(np.abs(P[k] - exact)), (3, 3))
        scale = max(np.linalg.norm(exact), young)
        stresses.append(near(f"{row['case']} P{i[0] + 1}{i[1] + 1}", P[k][i], exact[i], 1e-10, scale))
        energies.append(near(row["case"], psi[k], row[law]["psi"], 1e-10, max(abs(row[law]["psi"]), young)))
    return worst(stresses, "stress"), worst(energies, "energy density")


def uniaxial_stress(law: str, reference: dict, arch: str):
    """Lateral stretch and nominal stress of unit cubes, one for each stretch, all in one scene."""
    s = scene()
    for row in reference["value"]:
        cube = s.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1), (0.5, 0.5, 0.5)), material(reference, law))
        for axis in range(3):
            cube.fix(face(axis, 0.0), axes="xyz"[axis])
        cube.move(face(0, 1.0), lambda t, by=row["stretch"] - 1.0: (by, 0.0, 0.0), axes="x")
    result = ts.solve_static(s, tolerance=1e-13, arch=arch)
    lateral, stress = [], []
    for cube, row in zip(s.bodies, reference["value"]):
        x, pull, exact = result.positions(cube.name), result.reactions(cube.name)[:, 0], row[law]
        for axis in (1, 2):
            for node in np.flatnonzero(face(axis, 1.0)(cube.rest_positions)):
                lateral.append(near(f"stretch {row['stretch']}", x[node, axis], exact["lateral_stretch"], 1e-10))
        p11 = pull[face(0, 1.0)(cube.rest_positions)].sum()
        stress.append(near(f"stretch {row['stretch']}", p11, exact["P11"], 1e-10))
    return worst(lateral, "lateral stretch"), worst(stress, "P11 [Pa]")


def patch_test(reference: dict, arch: str):
    """Boundary nodes on the affine map x = A X + b, interior ones where the static solve puts them; a body for each law.

    The mesh is the unit cube in 3x3x3 cells, its eight interior nodes moved at random by up to a quarter of a cell.
    """
    A, b = np.array([[1.2, 0.3, -0.1], [0.05, 0.9, 0.2], [0.15, -0.25, 1.1]]), np.array([0.3, -0.2, 0.1])
    s, regular = scene(), ts.box_mesh((3, 3, 3), (1, 1, 1), (0.5, 0.5, 0.5))
    X = regular.vertices
    held = ((X < 1e-9) | (X > 1 - 1e-9)).any(axis=1)
    mesh = ts.TetMesh(np.where(held[:, None], X, X + np.random.default_rng(SEED).uniform(-1 / 12, 1 / 12, X.shape)), regular.tets)
    X = mesh.vertices
    exact = X @ A.T + b
    for law in LAWS:
        s.add_body(mesh, material(reference, law), name=law).move(held, lambda t: (exact - X)[held])
    result = ts.solve_static(s, tolerance=1e-14, arch=arch)
    young, h, checks = reference["material"]["E"], 1 / 3, []
    for cube in s.bodies:
        x = result.positions(cube.name)
        error = np.abs(x - exact)[~held].max()
        checks.append(small(f"{cube.name}: largest position error of an interior node [m]", error, 1e-12))
        strain = np.abs(deformation_gradients(cube, x) - A).max()
        checks.append(small(f"{cube.name}: largest |F - A|", strain, 1e-12 / h))
    force = result.residual * np.linalg.norm(result.reactions())  # N, of all interior nodes together
    density = sum(reference["value"]["energy_density"][law] for law in LAWS)
    return (
        *checks,
        small("interior nodal forces / (E h^2)", force / (young * h * h), 1e-12),
        # the reference has 12 digits, and each law is to be right to ten times as much
        near("energy of the three [J]", result.elastic, density * mesh.volumes.sum(), 3e-12),
    )


def rigid_motion(reference: dict, arch: str):
    """Energy and forces of rigidly moved and of rigidly moving bodies, read from one explicit step without gravity."""
    s = scene()
    for law in LAWS:
        s.add_body(ts.box_mesh((3, 2, 2), (1.0, 0.7, 0.6)), material(reference, law), name=law)
    young, dt, shift = reference["material"]["E"], 1e-4, np.array([10.0, -5.0, 3.0])
    motions = {"0.7 rad about z": rotation((0, 0, 1), 0.7), "180 deg about (1,1,1)": rotation((1, 1, 1), np.pi)}
    mass = lumped_masses(s)[:, None]
    rest = np.concatenate([body.rest_positions for body in s.bodies])
    laws = np.repeat(list(LAWS), [body.n_nodes for body in s.bodies])
    checks = []
    with ts.Simulator(s, dt=dt, integrator="symplectic_euler", precision="f64", arch=arch) as sim:

        def forces(x, v):
            sim.set_state(x, v)
            sim.step()
            return np.abs(mass * (sim.velocities() - v) / dt)

        for name, R in motions.items():
            for law in LAWS:  # the others stay at rest, so that the energy is this one's
                x = np.where((laws == law)[:, None], rest @ R.T + shift, rest)
                sim.set_state(x, np.zeros_like(x))
                checks.append(small(f"{law}, {name}: energy / (E L^3)", sim.energies().elastic / young, 1e-13))
            f = forces(rest @ R.T + shift, np.zeros_like(rest)) / young
            checks += [small(f"{law}, {name}: force / (E L^2)", f[laws == law].max(), 1e-13) for law in LAWS]
        f = forces(rest, np.cross((1.0, 2.0, 6.0), rest) + (3.0, -1.0, 2.0)) / young
        checks += [small(f"{law}, spinning: force at t = 0 / (E L^2)", f[laws == law].max(), 1e-13) for law in LAWS]
    return checks


def _fallen(integrator: str, n: int) -> float:
    """Fall after n steps from rest, in units of g dt^2."""
    if integrator in ("symplectic_euler", "implicit_euler", "linearly_implicit_euler"):
        return n * (n + 1) / 2
    # BDF2 is exact but for its first step, implicit Euler's; that error goes on as e2 = 4/3 e1 - 1/3 e0
    return n * n / 2 + (0.75 * (1.0 - 3.0**-n) if integrator == "bdf2" else 0.0)


def free_fall(law: str, integrator: str, reference: dict, arch: str):
    """Fall of n steps against the discrete formula, and the strain that must not appear."""
    example = reference["value"]["example"]
    dt, n = example["dt"], example["n"]
    s = scene(gravity=True)
    body = s.add_body(ts.box_mesh((2, 1, 1), (2, 1, 1)), material(reference, law))
    tight = {} if integrator in EXPLICIT else {"newton_tolerance": 1e-13, "linear_tolerance": 1e-13}
    with ts.Simulator(s, dt=dt, integrator=integrator, precision="f64", arch=arch, **tight) as sim:
        while sim.step_count < n:
            sim.advance(n - sim.step_count)
        x, energies = sim.positions(), sim.energies()
    fall = -GRAVITY * dt * dt * _fallen(integrator, n)
    displacement = (x - body.rest_positions)[:, 1]
    strain = np.abs(deformation_gradients(body, x) - np.eye(3)).max()
    return (
        near("fall [m]", displacement[np.argmax(np.abs(displacement - fall))], fall, 1e-12),
        small("largest |F - I|", strain, 1e-12),
        small("elastic / gravity energy", energies.elastic / abs(energies.gravity), 1e-12),
    )


QUICK_FALL = ("SNH", "symplectic_euler")
CASES = (
    *(Case("stress_table", law, "", partial(stress_table, law)) for law in LAWS),
    *(Case("uniaxial_stress", law, "1x1x1", partial(uniaxial_stress, law), law != "SNH") for law in LAWS),
    Case("patch_test", "+".join(LAWS), "3x3x3 irregular", patch_test),
    Case("rigid_motion", "+".join(LAWS), "3x2x2", rigid_motion),
    *(
        Case("free_fall", law, f"2x1x1 {name}", partial(free_fall, law, name), (law, name) != QUICK_FALL)
        for name in INTEGRATORS
        for law in (LAWS if name == "symplectic_euler" else ("SNH",))
    ),
)
