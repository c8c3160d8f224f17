"""Section 3.3 of the report: the largest stable step over Young's modulus, density and tet size, found by running it.

The largest stable step is found by bisection. Each dt is tried on a cube, held on one side, with random initial velocities of
about 1e-6 of the speed of sound. Stable vibrations stay at about 1e-6 of the cube's size; unstable ones grow by orders of
magnitude, so the threshold GROWTH is uncritical. `stable_dt` is only compared with.
"""

from dataclasses import dataclass

import numpy as np

import taisoft as ts
from taisoft.errors import SimulationError

from ..charts import Panel
from ..document import exponent, table
from ..runner import without_warnings
from ..timed_run import advance
from .page import Claim, Extent, Part, is_near, plot_png

EXPLICIT, IMPLICIT = "symplectic_euler", "implicit_euler"
YOUNGS = (1e4, 1e5, 1e6, 1e7, 1e8, 1e9), (1e4, 1e6, 1e9)  # [Pa], in a full and in a quick run
CELLS = (2, 3, 4, 6, 8), (2, 3, 4)  # along each edge of the cube, MESH among them
DENSITIES = (100.0, 1000.0, 10000.0)  # [kg/m^3]
YOUNG, DENSITY, MESH = 1e6, 1000.0, 3  # defaults when another parameter varies
STEPS, IMPLICIT_STEPS, GROWTH, KICK = 600, 50, 100.0, 1e-6
PRECISE = 1e-3  # relative width at which the bisection ends
FACTORS = {  # dt over the explicit limit
    EXPLICIT: (0.25, 0.5, 0.8, 0.95, 1.05, 1.2, 2.0),
    IMPLICIT: (1.0, 10.0, 100.0, 1000.0),
}
LOOSE = 0.1  # tolerance of a measured exponent


@dataclass(frozen=True)
class Limit:
    """Largest stable step of a cube, measured and by the simulator's stable_dt [s]."""

    cells: int
    young: float
    density: float
    measured: float
    stable_dt: float


def open_cube(cells: int, integrator: str, arch: str) -> ts.Simulator:
    """A simulator of a unit cube of n^3 cells, held on one side, which allows unstable steps."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    material = ts.Material(young=YOUNG, poisson=0.3, density=DENSITY)
    body = scene.add_body(ts.box_mesh((cells,) * 3, (1.0, 1.0, 1.0), pattern="six"), material, name="cube")
    body.fix(lambda X: X[:, 0] < -0.5 + 1e-9)
    return ts.Simulator(scene, 1e-5, integrator, precision="f64", arch=arch, allow_unstable=integrator == EXPLICIT)


def is_stable(sim: ts.Simulator, dt: float, sound: float) -> bool:
    """Whether small vibrations stay small. sound: its speed [m/s]."""
    rest = sim.scene.bodies[0].rest_positions
    sim.reset()
    sim.dt = dt
    sim.set_state(rest, KICK * sound * np.random.default_rng(5).standard_normal(rest.shape))
    try:
        advance(sim, STEPS if sim.settings.explicit else IMPLICIT_STEPS)
    except SimulationError:
        return False
    return float(np.linalg.norm(sim.positions() - rest, axis=1).max()) < GROWTH * KICK  # [m]: the cube is 1 m long


def find_limit(sim: ts.Simulator, cells: int, young: float = YOUNG, density: float = DENSITY) -> Limit:
    """Find the limit of a cube of this material by bisection, from an interval found by doubling."""
    sim.set_material("cube", young=young, density=density)
    sound = np.sqrt(young / density)
    low = 0.1 / cells / sound
    while not is_stable(sim, low, sound):
        low *= 0.5
    high = 2.0 * low
    while is_stable(sim, high, sound):
        low, high = high, 2.0 * high
    while high - low > PRECISE * low:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(sim, middle, sound) else (low, middle)
    return Limit(cells, young, density, low, sim.stable_dt)


def around(sim: ts.Simulator, limit: Limit) -> dict[float, bool]:
    """Whether multiples of a limit are stable, by factor."""
    sim.set_material("cube", young=limit.young, density=limit.density)
    sound = np.sqrt(limit.young / limit.density)
    return {factor: is_stable(sim, factor * limit.measured, sound) for factor in FACTORS[sim.settings.integrator]}


# --- what it says -------------------------------------------------------------------------------------------------------


def claims_of(youngs: list[Limit], sizes: list[Limit], densities: list[Limit], stable: dict[str, list[dict]]) -> list[Claim]:
    """Claims on the exponents and on multiples of the limits. Each list of limits varies one parameter."""
    by_young, off = exponent([x.young for x in youngs], [x.measured for x in youngs])
    by_size, _ = exponent([1.0 / x.cells for x in sizes], [x.measured for x in sizes])
    by_density, _ = exponent([x.density for x in densities], [x.measured for x in densities])
    below, beyond = ([ok for one in stable[EXPLICIT] for f, ok in one.items() if (f > 1.0) == side] for side in (False, True))
    implicit = [ok for one in stable[IMPLICIT] for ok in one.values()]
    apart = max(abs(x.measured / x.stable_dt - 1.0) for x in (*youngs, *sizes, *densities))
    return [
        Claim(
            "the largest stable step of semi-implicit Euler falls like E^-1/2.",
            is_near(by_young, -0.5, LOOSE),
            f"from E = {youngs[0].young:.0e} to {youngs[-1].young:.0e} Pa it falls like E^{by_young:.3f} (no point is more than "
            f"{off:.1%} off). What runs show and `stable_dt` differ by at most {apart:.1%}.",
        ),
        Claim(
            "it grows like m^1/2, m being a vertex's mass.",
            is_near(by_density, 0.5, LOOSE),
            f"on one mesh, from {densities[0].density:g} to {densities[-1].density:g} kg/m^3, it grows like m^{by_density:.3f}.",
        ),
        Claim(
            "it grows like (h m)^1/2, so with m like h^3 it is like h^2.",
            is_near(by_size, 2.0, LOOSE),
            f"from h = 1/{sizes[0].cells} to 1/{sizes[-1].cells} m at one density it is like h^{by_size:.2f}.",
            "The report puts E in the place of a force, but for a constant. That is an area, like h^2: dt < c (m / (h E))^1/2.",
        ),
        Claim(
            "beyond the bound semi-implicit steps are unstable.",
            not any(beyond),
            f"{beyond.count(False)} of {len(beyond)} runs beyond it grow or fail; below it {sum(below)} of {len(below)} stay.",
        ),
        Claim(
            "implicit steps may be larger.",
            all(implicit),
            f"implicit Euler stays in {sum(implicit)} of {len(implicit)} runs at up to {max(FACTORS[IMPLICIT]):g} times it.",
        ),
    ]


def limit_table(limits: list[Limit]) -> str:
    """A row per cube and material."""
    columns = (
        ("E [Pa]", "{.young:.0e}"),
        ("density", "{.density:g}"),
        ("h [m]", "1/{.cells}"),
        ("by runs [ms]", lambda x: f"{1e3 * x.measured:.4g}"),
        ("stable_dt [ms]", lambda x: f"{1e3 * x.stable_dt:.4g}"),
        ("runs / stable_dt", lambda x: f"{x.measured / x.stable_dt:.4f}"),
        ("dt / (h (density / E)^1/2)", lambda x: f"{x.measured * x.cells * np.sqrt(x.young / x.density):.3f}"),
    )
    return table(limits, columns)


def draw(youngs: list[Limit], sizes: list[Limit]) -> bytes:
    """The limit over E and h."""
    by_young = Panel("largest stable step [ms] over E", "E [Pa]", log="xy")
    by_young.curve([x.young for x in youngs], [1e3 * x.measured for x in youngs], "by runs", 0, "o")
    by_young.curve([x.young for x in youngs], [1e3 * x.stable_dt for x in youngs], "stable_dt", 1, "-")
    by_size = Panel("over the size of the tets", "h [m]", log="xy")
    h, dt = np.array([1.0 / x.cells for x in sizes]), np.array([1e3 * x.measured for x in sizes])
    by_size.curve(h, dt, "by runs", 0, "o")
    by_size.curve(h, dt[0] * h / h[0], "like h", 2, "-")
    by_size.curve(h, dt[0] * (h / h[0]) ** 2, "like h^2, the report's", 6, ":")
    return plot_png(by_young, by_size)


def measure(extent: Extent) -> Part:
    """Limits over E, h and density, then long runs at multiples of them."""
    quick = extent.quick
    with without_warnings():  # of steps that are unstable
        sizes = []
        for cells in CELLS[quick]:
            with open_cube(cells, EXPLICIT, extent.arch) as sim:
                sizes.append(find_limit(sim, cells))
        with open_cube(MESH, EXPLICIT, extent.arch) as sim:
            densities = [find_limit(sim, MESH, density=density) for density in DENSITIES]
            youngs = [find_limit(sim, MESH, young=young) for young in YOUNGS[quick]]
            stable = {EXPLICIT: [around(sim, limit) for limit in youngs]}
        with open_cube(MESH, IMPLICIT, extent.arch) as sim:
            stable[IMPLICIT] = [around(sim, limit) for limit in youngs]
    return Part(
        "bound",
        "The largest stable step",
        "section 3.3, figure 21",
        "a unit cube of n^3 cells (six tets each), held on one side, in f64. The limit: bisection to a width of "
        f"{PRECISE:.1%}, each dt tried for {STEPS} steps ({IMPLICIT_STEPS} implicit ones) after a kick of {KICK:g} of the speed "
        "of sound. Then multiples of the limits are tried in the same way.",
        claims_of(youngs, sizes, densities, stable),
        [limit_table([*youngs, *sizes, *densities])],
        {"bound.png": draw(youngs, sizes)},
    )
