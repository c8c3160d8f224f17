"""Small vibration: eigenfrequencies of clamped beams, and what each integrator makes of one linear oscillator."""

import warnings
from functools import partial

import numpy as np

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, INTEGRATORS

from .record import SAME_MESH, Case, face, label, material, near, order, scene, worst

# --- eigenfrequencies ---------------------------------------------------------------------------------------------


def half_beam(reference: dict, cells) -> ts.Scene:
    """The half z <= 0 of the beam, its cut face sliding: its modes are exactly the whole's that are symmetric in z.

    The five-tet pattern of an even number of cells is its own mirror image, and the half's tets are among the whole's.
    """
    length, height, width = reference["geometry"]["box"]
    s, half = scene(), (cells[0], cells[1], cells[2] // 2)
    mesh = ts.box_mesh(half, (length, height, width / 2), (length / 2, 0.0, -width / 4))
    beam = s.add_body(mesh, material(reference, "SVK"))  # every law has Hooke's tangent at rest
    beam.fix(face(0, 0.0))
    beam.fix(face(2, 0.0), axes="z")
    return s


def modal(meshes, reference: dict, arch: str):
    """Three lowest symmetric frequencies on meshes that halve the width of the one before."""
    rows = reference["value"]["linear_tet_consistent_mass"]
    exact, errors = reference["value"]["f"], []
    for cells in meshes:
        f = ts.modes(half_beam(reference, cells), 3, mass="consistent").frequencies
        row = next(r for r in rows if tuple(r["cells"]) == cells)
        yield near(f"f1, same mesh {label(cells)} [Hz]", f[0], row["f1"], SAME_MESH)
        checks = [near(f"f{k + 1}, converged in space, {label(cells)} [Hz]", f[k], exact[k]) for k in range(3)]
        errors.append([check.error for check in checks])
        yield from checks
    for coarse, fine, cells in zip(errors, errors[1:], meshes[1:]):
        # the third is axial: the edge of the clamp, where the stress is singular, lowers its order
        for k in range(3):
            yield order(f"order in h of f{k + 1}, at {label(cells)}", coarse[k], fine[k], 2.0, 0.35 if k < 2 else None)


# --- one oscillator -------------------------------------------------------------------------------------------------

# The energy of one tet's shear is even in the displacement, so that its force is linear up to the third order: 1e-11 of
# relative error here. Rounding of the positions is 1e-10 of the amplitude.
AMPLITUDE = 1e-6  # m, of a tet of 1 m
LARGEST = 5e-6  # m: a growing motion is followed no further, so that it stays linear
STEPS = 24  # per start
APEX = 3  # the node that moves
LIMIT = 1e-7  # relative, of |lambda| and of the frequency
LINEARISED = "linearly_implicit_euler"
# in the table Verlet has symplectic Euler's recurrence, and a linear force is its own linearisation
TABULATED_AS = {"velocity_verlet": "symplectic_euler", LINEARISED: "implicit_euler"}


def oscillator(integrator: str, reference: dict, arch: str):
    """Amplification |lambda| and frequency of the update matrix, read off the motion of a body with one free axis."""
    key = next(k for k in reference["value"] if k.startswith(TABULATED_AS.get(integrator, integrator)))
    s, omega = sheared_tet()
    tight = {"newton_tolerance": 1e-13, "linear_tolerance": 1e-13}
    settings = {"allow_unstable": True} if integrator in EXPLICIT else tight
    sizes, frequencies = [], []
    with (
        warnings.catch_warnings(),
        ts.Simulator(s, dt=1.0 / omega, integrator=integrator, precision="f64", arch=arch, **settings) as sim,
    ):
        warnings.simplefilter("ignore", UserWarning)  # that steps of z > 2 are unstable is what is measured
        for text, (amplification, frequency) in reference["value"][key].items():
            z = float(text)
            sim.dt = z / omega
            root = _root(integrator, [_motion(sim, omega, start) for start in ((1.0, 0.0), (0.0, 1.0))], z)
            sizes.append(near(f"z = {z:g}", abs(root), amplification, LIMIT))
            frequencies.append(near(f"z = {z:g}", np.angle(root) / z, frequency, LIMIT))
    return worst(sizes, "|lambda| per step"), worst(frequencies, "frequency / exact one")


def sheared_tet() -> tuple[ts.Scene, float]:
    """One tet on a fixed base, whose apex may only move sideways, along y; and its omega [rad/s].

    Height h = 1 m: stiffness mu V/h^2, mass rho V/4, so omega^2 = 4 mu/(rho h^2).
    """
    s = scene()
    mesh = ts.TetMesh(np.array([(0, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0)], float), np.array([(0, 1, 2, APEX)]))
    body = s.add_body(mesh, ts.Material(law="st_venant_kirchhoff", young=1e4, poisson=0.3, density=1000.0))
    body.fix([0, 1, 2])
    body.fix([APEX], axes="xz")
    return s, float(np.sqrt(4.0 * body.material.mu / body.material.density))


def _motion(sim: ts.Simulator, omega: float, start) -> np.ndarray:
    """(k, 2): displacement and velocity / omega of the apex at the start and after each step, over the amplitude."""
    rest = sim.scene.bodies[0].rest_positions
    x, v = rest.copy(), np.zeros_like(rest)
    x[APEX, 1] += AMPLITUDE * start[0]
    v[APEX, 1] = AMPLITUDE * start[1] * omega
    sim.set_state(x, v)
    rows = [tuple(start)]
    while len(rows) <= STEPS and np.abs(rows[-1]).max() * AMPLITUDE < LARGEST:
        sim.step()
        displacement = sim.positions()[APEX, 1] - rest[APEX, 1]
        rows.append((displacement / AMPLITUDE, sim.velocities()[APEX, 1] / (omega * AMPLITUDE)))
    return np.array(rows)


def _root(integrator: str, motions: list[np.ndarray], z: float) -> complex:
    """The eigenvalue of the update matrix that is tabulated.

    BDF2 has two, and the table holds the one nearest to exp(iz), the exact factor. At z = 10 that is the smaller one: a
    motion that goes on there decays as the other, by 0.3007 a step.
    """
    if integrator != "bdf2":
        before, after = (np.concatenate([m[a:b] for m in motions]) for a, b in ((0, -1), (1, None)))
        step = np.linalg.lstsq(before, after, rcond=None)[0]
        root = max(np.linalg.eigvals(step), key=abs)
        return complex(root.real, abs(root.imag))  # of a conjugate pair
    # w = x - i v/omega obeys w2 = a w1 + b w0 with complex a, b; the start-up step only chooses the initial values
    past, after = [], []
    for m in motions:
        w = m[:, 0] - 1j * m[:, 1]
        past.append(np.column_stack([w[1:-1], w[:-2]]))
        after.append(w[2:])
    a, b = np.linalg.lstsq(np.concatenate(past), np.concatenate(after), rcond=None)[0]
    return min(np.roots([1.0, -a, -b]), key=lambda root: abs(root - np.exp(1j * z)))


CASES = (
    Case("modal_thick", "all", "11x2x2 22x4x4", partial(modal, ((11, 2, 2), (22, 4, 4)))),
    Case("modal_thick", "all", "22x4x4 44x8x8", partial(modal, ((22, 4, 4), (44, 8, 8))), fine=True),
    Case("modal_slender", "all", "20x2x2 40x4x4", partial(modal, ((20, 2, 2), (40, 4, 4)))),
    *(
        # a linear force is its own linearisation, so the tests need not repeat implicit Euler
        Case("oscillator_amplification", "SVK", f"one tet {name}", partial(oscillator, name), name == LINEARISED)
        for name in INTEGRATORS
    ),
)
