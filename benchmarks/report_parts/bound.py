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
STEPS, GROWTH, KICK = 600, 100.0, 1e-6
PRECISE = 1e-3  # relative width at which the bisection ends
STRETCH, LONG = 0.1, 50  # initial stretch and steps of a long run
FACTORS = {  # dt of long runs over the explicit limit
    EXPLICIT: (0.25, 0.5, 0.8, 0.95, 1.05, 1.2, 2.0),
    IMPLICIT: (1.0, 10.0, 100.0, 1000.0),
}
BOUNDED = 3.0  # displacement of a stable run over the initial one, at most
FAR = 1e3  # the same, at which the picture is cut
LOOSE = 0.1  # tolerance of a measured exponent


@dataclass(frozen=True)
class Limit:
    """Largest stable step of a cube, measured and by the simulator's stable_dt [s]."""

    cells: int
    young: float
    density: float
    measured: float
    stable_dt: float


@dataclass(frozen=True)
class LongRun:
    """A run from an initial stretch. factor: dt over the measured limit; reach: largest displacement over the initial one."""

    integrator: str
    young: float
    factor: float
    reach: float
    status: str

    @property
    def stable(self) -> bool:
        """Whether the motion stayed bounded."""
        return self.reach <= BOUNDED


def open_cube(cells: int, integrator: str, arch: str) -> ts.Simulator:
    """A simulator of a unit cube of n^3 cells, held on one side, which allows unstable steps."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    material = ts.Material(young=YOUNG, poisson=0.3, density=DENSITY)
    body = scene.add_body(ts.box_mesh((cells,) * 3, (1.0, 1.0, 1.0), pattern="six"), material, name="cube")
    body.fix(lambda X: X[:, 0] < -0.5 + 1e-9)
    return ts.Simulator(scene, 1e-5, integrator, precision="f64", arch=arch, allow_unstable=integrator == EXPLICIT)


def rest_of(sim: ts.Simulator) -> np.ndarray:
    """The nodes (n,3) [m] at rest."""
    return sim.scene.bodies[0].rest_positions


def largest_displacement(sim: ts.Simulator) -> float:
    """Largest displacement of a node [m]."""
    return float(np.linalg.norm(sim.positions() - rest_of(sim), axis=1).max())


def is_stable(sim: ts.Simulator, dt: float, sound: float) -> bool:
    """Whether small vibrations stay small. sound: its speed [m/s]."""
    sim.reset()
    sim.dt = dt
    sim.set_state(rest_of(sim), KICK * sound * np.random.default_rng(5).standard_normal(rest_of(sim).shape))
    try:
        advance(sim, STEPS)
    except SimulationError:
        return False
    return largest_displacement(sim) < GROWTH * KICK  # [m]: the cube is 1 m long


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


def long_runs(sim: ts.Simulator, limit: Limit) -> list[LongRun]:
    """Release the cube of a limit from a stretch, with multiples of that dt."""
    sim.set_material("cube", young=limit.young, density=limit.density)
    X, found = rest_of(sim), []
    for factor in FACTORS[sim.settings.integrator]:
        sim.reset()
        sim.dt = factor * limit.measured
        sim.set_state(X + STRETCH * (X[:, :1] + 0.5) * np.array([1.0, 0.0, 0.0]), np.zeros_like(X))
        reaches = [largest_displacement(sim)]
        done = sim.run(LONG * sim.dt, lambda sim, *_, reaches=reaches: reaches.append(largest_displacement(sim)), fps=None)
        reach = np.inf if done.status == "failed" else max(reaches) / reaches[0]
        found.append(LongRun(sim.settings.integrator, limit.young, factor, float(reach), done.status))
    return found


# --- what it says -------------------------------------------------------------------------------------------------------


def claims_of(youngs: list[Limit], sizes: list[Limit], densities: list[Limit], runs: list[LongRun]) -> list[Claim]:
    """Claims on the exponents and on bounded runs. Each list of limits varies one parameter."""
    by_young, off = exponent([x.young for x in youngs], [x.measured for x in youngs])
    by_size, _ = exponent([1.0 / x.cells for x in sizes], [x.measured for x in sizes])
    by_density, _ = exponent([x.density for x in densities], [x.measured for x in densities])
    beyond = [r for r in runs if r.integrator == EXPLICIT and r.factor > 1.0]
    below = [r for r in runs if r.integrator == EXPLICIT and r.factor < 1.0]
    implicit = [r for r in runs if r.integrator == IMPLICIT]
    good = [r.stable and r.status == "ok" for r in implicit]
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
            "The report puts E in the place of the force on a vertex, with a constant between them. That constant is an area, "
            "like h^2; with it the same lines give dt < c (m / (h E))^1/2, which is h (density / E)^1/2.",
        ),
        Claim(
            "beyond the bound semi-implicit steps are unstable.",
            not any(r.stable for r in beyond),
            f"{sum(not r.stable for r in beyond)} of {len(beyond)} runs beyond the limit exceed {BOUNDED:g} times the initial "
            f"stretch or fail; below it {sum(r.stable for r in below)} of {len(below)} stay.",
        ),
        Claim(
            "implicit steps may be larger.",
            all(good),
            f"implicit Euler at 1 to {implicit[-1].factor:g} times that limit stays within {BOUNDED:g} times the initial stretch "
            f"and ends ok in {sum(good)} of {len(good)} runs.",
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


def run_table(runs: list[LongRun]) -> str:
    """A row per Young's modulus and integrator: the reach at each factor."""

    def reaches(kind: tuple[str, float]) -> str:
        return ", ".join(f"{r.factor:g}: {r.reach:.3g} {r.status}" for r in runs if (r.integrator, r.young) == kind)

    heading = "<dt / limit: largest displacement / that at the start, status"
    kinds = dict.fromkeys((r.integrator, r.young) for r in runs)
    return table(kinds, (("<steps", "{[0]}"), ("E [Pa]", "{[1]:.0e}"), (heading, reaches)))


def draw(youngs: list[Limit], sizes: list[Limit], runs: list[LongRun]) -> bytes:
    """The limit over E and h, and the reach of runs."""
    by_young = Panel("largest stable step [ms] over E", "E [Pa]", log="xy")
    by_young.curve([x.young for x in youngs], [1e3 * x.measured for x in youngs], "by runs", 0, "o")
    by_young.curve([x.young for x in youngs], [1e3 * x.stable_dt for x in youngs], "stable_dt", 1, "-")
    by_size = Panel("over the size of the tets", "h [m]", log="xy")
    h, dt = np.array([1.0 / x.cells for x in sizes]), np.array([1e3 * x.measured for x in sizes])
    by_size.curve(h, dt, "by runs", 0, "o")
    by_size.curve(h, dt[0] * h / h[0], "like h", 2, "-")
    by_size.curve(h, dt[0] * (h / h[0]) ** 2, "like h^2, the report's", 6, ":")
    young = youngs[len(youngs) // 2].young
    reach = Panel(f"reach / stretch, E = {young:.0e} Pa (cut at {FAR:g})", "dt / limit", log="xy")
    for colour, integrator in enumerate(FACTORS, 3):
        own = [r for r in runs if r.integrator == integrator and r.young == young]
        reach.curve([r.factor for r in own], [min(r.reach, FAR) for r in own], integrator, colour)
    reach.level("x", 1.0)
    return plot_png(by_young, by_size, reach)


def measure(extent: Extent) -> Part:
    """Limits over E, h and density, then long runs at multiples of them."""
    quick = extent.quick
    with without_warnings():  # of steps that are unstable
        sizes, runs = [], []
        for cells in CELLS[quick]:
            with open_cube(cells, EXPLICIT, extent.arch) as sim:
                sizes.append(find_limit(sim, cells))
        with open_cube(MESH, EXPLICIT, extent.arch) as sim:
            densities = [find_limit(sim, MESH, density=density) for density in DENSITIES]
            youngs = [find_limit(sim, MESH, young=young) for young in YOUNGS[quick]]
            runs += [run for limit in youngs for run in long_runs(sim, limit)]
        with open_cube(MESH, IMPLICIT, extent.arch) as sim:
            runs += [run for limit in youngs for run in long_runs(sim, limit)]
    return Part(
        "bound",
        "The largest stable step",
        "section 3.3, figure 21",
        "a unit cube of n^3 cells (six tets each), held on one side, in f64. The limit: bisection to a width of "
        f"{PRECISE:.1%}, each dt tried for {STEPS} steps after a kick of {KICK:g} of the speed of sound. Then runs of "
        f"{LONG} steps from a stretch of {STRETCH:.0%}, at multiples of the limit.",
        claims_of(youngs, sizes, densities, runs),
        [limit_table([*youngs, *sizes, *densities]), run_table(runs)],
        {"bound.png": draw(youngs, sizes, runs)},
    )
