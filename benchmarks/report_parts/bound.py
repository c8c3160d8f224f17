"""Section 3.3 of the report: the largest stable step over Young's modulus, density and tet size, found by running it.

The largest stable step is found by bisection. Each dt is tried on a cube, held on one side, with random initial velocities of
about 1e-6 of the speed of sound. Stable vibrations stay at about 1e-6 of the cube's size; unstable ones grow by orders of
magnitude, so the threshold GROWTH is uncritical. `stable_dt` is only compared with.
"""

from dataclasses import dataclass

import numpy as np

import taisoft as ts
from taisoft.errors import SimulationError

from ..document import exponent, table
from ..runner import without_warnings
from ..timed_run import advance
from .page import COLOURS, Claim, Extent, Part, is_near, new_figure, plot_png

EXPLICIT, IMPLICIT = "symplectic_euler", "implicit_euler"
YOUNGS = (1e4, 1e5, 1e6, 1e7, 1e8, 1e9), (1e4, 1e6, 1e9)  # [Pa], in a full and in a quick run
CELLS = (2, 3, 4, 6, 8), (2, 3, 4)  # along each edge of the cube, MESH among them
DENSITIES = (100.0, 1000.0, 10000.0)  # [kg/m^3]
YOUNG, DENSITY, MESH = 1e6, 1000.0, 3  # defaults when another parameter varies
STEPS, GROWTH, KICK = 600, 100.0, 1e-6
PRECISE = 1e-3  # relative width at which the bisection ends
SEED = 5
STRETCH, LONG = 0.1, 50  # initial stretch and steps of a long run
FACTORS = (1.0, 10.0, 100.0, 1000.0)  # steps of implicit Euler over the explicit limit
AROUND = (0.25, 0.5, 0.8, 0.95, 1.05, 1.2, 2.0)  # steps of symplectic Euler over the limit
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


class Cube:
    """A unit cube of n^3 cells, held on one side; a context manager. Unstable steps are allowed without warnings."""

    def __init__(self, cells: int, integrator: str, arch: str, young: float = YOUNG):
        scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
        material = ts.Material(young=young, poisson=0.3, density=DENSITY)
        body = scene.add_body(ts.box_mesh((cells,) * 3, (1.0, 1.0, 1.0), pattern="six"), material, name="cube")
        body.fix(lambda X: X[:, 0] < -0.5 + 1e-9)
        explicit = integrator == EXPLICIT
        self.cells, self.rest, self.young, self.density = cells, body.rest_positions, young, DENSITY
        with without_warnings():
            self.sim = ts.Simulator(scene, 1e-5, integrator, precision="f64", arch=arch, allow_unstable=explicit)

    def __enter__(self) -> "Cube":
        return self

    def __exit__(self, *error) -> None:
        self.sim.close()

    def set(self, young: float = YOUNG, density: float = DENSITY) -> None:
        """Change the material."""
        self.young, self.density = young, density
        with without_warnings():
            self.sim.set_material("cube", young=young, density=density)

    def _begin(self, dt: float, positions: np.ndarray | None = None, velocities: np.ndarray | None = None) -> None:
        self.sim.reset()
        with without_warnings():
            self.sim.dt = dt
        self.sim.set_state(positions, velocities)

    def largest_displacement(self) -> float:
        """Largest displacement of a node [m]."""
        return float(np.linalg.norm(self.sim.positions("cube") - self.rest, axis=1).max())

    def is_stable(self, dt: float) -> bool:
        """Whether small vibrations stay small."""
        sound = np.sqrt(self.young / self.density)
        kick = KICK * sound * np.random.default_rng(SEED).standard_normal(self.rest.shape)
        self._begin(dt, self.rest, kick)
        try:
            advance(self.sim, STEPS)
        except SimulationError:
            return False
        return self.largest_displacement() < GROWTH * KICK  # [m]: the cube is 1 m long

    def limit(self) -> Limit:
        """Find the limit by bisection, from an interval found by doubling."""
        low = 0.1 / self.cells * np.sqrt(self.density / self.young)
        while not self.is_stable(low):
            low *= 0.5
        high = 2.0 * low
        while self.is_stable(high):
            low, high = high, 2.0 * high
        while high - low > PRECISE * low:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.is_stable(middle) else (low, middle)
        return Limit(self.cells, self.young, self.density, low, self.sim.stable_dt)

    def long_run(self, factor: float, limit: float) -> LongRun:
        """Release the cube from a stretch, with dt = factor * limit [s]."""
        X = self.rest
        start = X + STRETCH * (X[:, :1] + 0.5) * np.array([1.0, 0.0, 0.0])
        dt = factor * limit
        self._begin(dt, start, np.zeros_like(X))
        before, reach = self.largest_displacement(), 0.0

        def on_frame(_sim, _index, _report) -> None:
            nonlocal reach
            reach = max(reach, self.largest_displacement() / before)

        done = self.sim.run(LONG * dt, on_frame, fps=None)
        reach = np.inf if done.status == "failed" else reach
        return LongRun(self.sim.settings.integrator, self.young, factor, float(reach), done.status)


# --- what it says -----------------------------------------------------------------------------------------------------


def claims_of(youngs: list[Limit], sizes: list[Limit], densities: list[Limit], runs: list[LongRun]) -> list[Claim]:
    """Claims on the exponents and on bounded runs. Each list of limits varies one parameter."""
    by_young, off = exponent([x.young for x in youngs], [x.measured for x in youngs])
    by_size, _ = exponent([1.0 / x.cells for x in sizes], [x.measured for x in sizes])
    by_density, _ = exponent([x.density for x in densities], [x.measured for x in densities])
    explicit = [r for r in runs if r.integrator == EXPLICIT]
    implicit = [r for r in runs if r.integrator == IMPLICIT]
    beyond = [r for r in explicit if r.factor > 1.0]
    good = [r.stable and r.status == "ok" for r in implicit]
    apart = max(abs(x.measured / x.stable_dt - 1.0) for x in (*youngs, *sizes, *densities))
    square = is_near(by_size, 2.0, LOOSE)
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
            square,
            f"from h = 1/{sizes[0].cells} to 1/{sizes[-1].cells} m at one density it is like h^{by_size:.2f}.",
            ""
            if square
            else "The report puts E in the place of the force on a vertex, with a constant between them. That "
            "constant is an area, like h^2; with it the same lines give dt < c (m / (h E))^1/2, which is h (density / E)^1/2.",
        ),
        Claim(
            "beyond the bound semi-implicit steps are unstable.",
            not any(r.stable for r in beyond),
            f"at {', '.join(f'{r.factor:g}' for r in beyond if r.young == beyond[0].young)} times the limit "
            f"{sum(not r.stable for r in beyond)} of {len(beyond)} runs exceed {BOUNDED:g} times the initial stretch or "
            f"fail; below it {sum(r.stable for r in explicit if r.factor < 1.0)} of "
            f"{sum(r.factor < 1.0 for r in explicit)} stay.",
        ),
        Claim("implicit steps may be larger.", all(good), _implicit_text(implicit, good)),
    ]


def _implicit_text(implicit: list[LongRun], good: list[bool]) -> str:
    """Reach of the implicit runs, and those that failed or were not bounded."""
    factors = ", ".join(f"{f:g}" for f in dict.fromkeys(r.factor for r in implicit))
    bad = [f"E = {r.young:.0e} Pa at {r.factor:g}: reach {r.reach:.3g}, {r.status}" for r, ok in zip(implicit, good) if not ok]
    text = (
        f"implicit Euler at {factors} times that limit stays within {BOUNDED:g} times the initial stretch and ends "
        f"ok in {sum(good)} of {len(good)} runs; the largest reach is {max(r.reach for r in implicit):.3g} times"
    )
    return f"{text}. {'; '.join(bad)}." if bad else f"{text}. No limit was found."


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
    """Plot the limit over E and h, and the reach of runs."""
    figure, ((over_young, over_size, reach),) = new_figure(3)
    over_young.plot([x.young for x in youngs], [1e3 * x.measured for x in youngs], "o", color=COLOURS[0], label="by runs")
    over_young.plot([x.young for x in youngs], [1e3 * x.stable_dt for x in youngs], "-", color=COLOURS[1], label="stable_dt")
    over_young.set(title="largest stable step over E", xlabel="E [Pa]", ylabel="ms", xscale="log", yscale="log")
    h, dt = np.array([1.0 / x.cells for x in sizes]), np.array([1e3 * x.measured for x in sizes])
    over_size.plot(h, dt, "o", color=COLOURS[0], label="by runs")
    over_size.plot(h, dt[0] * h / h[0], "-", color=COLOURS[2], label="like h")
    over_size.plot(h, dt[0] * (h / h[0]) ** 2, ":", color=COLOURS[6], label="like h^2, the report's")
    over_size.set(title="over the size of the tets", xlabel="h [m]", xscale="log", yscale="log")
    young = youngs[len(youngs) // 2].young
    for integrator, colour, marker in ((EXPLICIT, COLOURS[1], "o"), (IMPLICIT, COLOURS[0], "s")):
        own = [r for r in runs if r.integrator == integrator and r.young == young]
        reach.plot([r.factor for r in own], [min(r.reach, FAR) for r in own], f"{marker}-", ms=4, color=colour, label=integrator)
    reach.axvline(1.0, color="#555555", lw=0.9, ls="--")
    reach.set(title=f"reach / stretch, E = {young:.0e} Pa (cut at {FAR:g})", xlabel="dt / limit", xscale="log", yscale="log")
    for panel in (over_young, over_size, reach):
        panel.legend(fontsize="small", frameon=False)
    return plot_png(figure)


def measure(extent: Extent) -> Part:
    """Limits over E, h and density, then long runs at multiples of them."""
    k = int(extent.quick)
    youngs, sizes, densities, runs = [], [], [], []
    for cells in CELLS[k]:
        with Cube(cells, EXPLICIT, extent.arch) as cube:
            sizes.append(cube.limit())
            if cells != MESH:
                continue
            for density in DENSITIES:
                cube.set(density=density)
                densities.append(cube.limit())
            for young in YOUNGS[k]:
                cube.set(young=young)
                youngs.append(cube.limit())
                runs += [cube.long_run(factor, youngs[-1].measured) for factor in AROUND]
    with Cube(MESH, IMPLICIT, extent.arch) as cube:
        for limit in youngs:
            cube.set(young=limit.young)
            runs += [cube.long_run(factor, limit.measured) for factor in FACTORS]
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
