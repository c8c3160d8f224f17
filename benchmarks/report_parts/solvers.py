"""Figure 20 of the report: iterations and time of the contact solvers on a cube on a box, and its hope for more contacts."""

import numpy as np

from taisoft.backend.runtime import open_runtime
from taisoft.timing import summarise

from ..contact_captured import COLOURED, SERIAL, THREADED, Solvers
from ..contact_crossover import Point, crossover_table, crossover_text, measure_crossover
from ..contact_plot import figure_20
from ..contact_runs import Film, measure_film, open_explicit
from ..contact_table import CONTACTS, count_table, solver_table
from .page import Claim, Extent, Part, clearly_less, is_near, ms, new_figure, plot_png

SCENE = "cube_on_box"
FRAMES, QUICK_FRAMES = 60, 5
PLATES = (8, 32, 96)  # cells of two plates on each other: some 130 to 17,000 contacts
JACOBI, HYBRID = "jacobi", "hybrid"
SPIKE = 5.0  # times the median: a frame that counts as a spike
MOSTLY = 0.9  # of the frames in which what is by far the fastest is faster
NEAR = 0.25  # of the report's number of contacts


def claims_of(film: Film, points: list[Point]) -> list[Claim]:
    """Iterations, times, spikes, serial against parallel. points: of the crossover, none in a quick run."""
    contacts = float(np.median(film.contacts))
    sweeps = {name: np.array([o.sweeps for o in film.of(name)]) for name in film.solvers}
    times = {name: [o.median for o in film.of(name)] for name in film.solvers}
    told = ", ".join(f"{name} {ms(np.median(t))}" for name, t in times.items())
    beaten = float((sweeps[SERIAL] <= sweeps[JACOBI]).mean())
    few = beaten == 1.0 and np.median(sweeps[SERIAL]) < np.median(sweeps[JACOBI])
    fastest = min(times, key=lambda name: np.median(times[name]))
    hybrid = min((name for name in times if name.startswith(HYBRID)), key=lambda name: np.median(times[name]))
    won = [float(np.less(times[hybrid], t).mean()) for name, t in times.items() if not name.startswith(HYBRID)]
    clear = min(won) >= MOSTLY
    parallel = [name for name in times if name.startswith(COLOURED)]
    slow = all(np.median(times[SERIAL]) <= np.median(times[name]) for name in parallel)
    jacobi = [name for name in times if name.startswith(JACOBI)]
    spikes = [max(times[name]) / np.median(times[name]) for name in jacobi]
    claims = [
        Claim(
            f"the scene has {CONTACTS[SCENE]} contacts.",
            is_near(contacts, CONTACTS[SCENE], NEAR * CONTACTS[SCENE]),
            f"ours has {contacts:g}, median over {len(film.contacts)} frames.",
            "The number is that of the mesh, which the report does not tell, and of what its reduction leaves.",
        ),
        Claim(
            "Gauss-Seidel needs fewer iterations than Jacobi in every frame.",
            bool(few),
            f"medians are {np.median(sweeps[SERIAL]):g} and {np.median(sweeps[JACOBI]):g} sweeps (hybrid "
            f"{np.median(sweeps[HYBRID]):g}); Gauss-Seidel needs no more in {beaten:.0%} of the frames. The residual is looked "
            "at after every fifth sweep.",
        ),
        Claim(
            "the parallel hybrid is by far the fastest.",
            clear,
            f"{fastest} is the fastest in the median; {hybrid} is faster than each of the others in at least {min(won):.0%} of "
            f"the frames. Medians, in ms: {told}.",
            ""
            if clear
            else "Hybrid sweeps are Jacobi's with the newest normal impulse in the friction bound: they need about "
            "as many. With tens of contacts a compiled serial sweep takes microseconds, less than waking a thread.",
        ),
        Claim(
            "in so small a scene parallel Gauss-Seidel is no faster than serial.",
            slow,
            f"serial takes {ms(np.median(times[SERIAL]))} ms, coloured "
            + ", ".join(f"{ms(np.median(times[name]))} ms ({name})" for name in parallel)
            + ", colouring included.",
        ),
        Claim(
            "parallel Jacobi has spikes in time.",
            max(spikes) > SPIKE,
            "the slowest frame takes "
            + ", ".join(f"{s:.1f} times the median ({n})" for n, s in zip(jacobi, spikes))
            + f"; the frame with most sweeps has {sweeps[JACOBI].max() / np.median(sweeps[JACOBI]):.1f} times the median's.",
            "The report blames the machine; frames that need more sweeps take longer, too.",
        ),
    ]
    return claims + ([more_contacts(points)] if points else [])


def more_contacts(points: list[Point]) -> Claim:
    """What the report expects of larger scenes."""
    last = points[-1]
    overtaken = clearly_less(last.coloured.seconds, last.serial.seconds)
    return Claim(
        "with more contacts parallel Gauss-Seidel will overtake serial (expected, not measured there).",
        overtaken,
        f"at {last.contacts:,} contacts a solve takes {ms(last.serial.median)} ms serial and {ms(last.coloured.median)} ms "
        f"coloured; a sweep alone {ms(last.serial.per_sweep)} and {ms(last.coloured.per_sweep)} ms.",
        ""
        if overtaken
        else "On so few threads what a sweep gains is less than colouring costs and than the sweeps lose by their order.",
    )


def short_of(film: Film) -> str:
    """What of the report's figure could not be had."""
    return (
        f"the report's {CONTACTS[SCENE]} contacts are not reached: its mesh is not told, and ours has "
        f"{np.median(film.contacts):g}. Its solvers were run to a tolerance that it does not tell."
    )


def draw(film: Film) -> bytes:
    """Figure 20."""
    figure, (panels,) = new_figure(3)
    figure_20(panels, film)
    handles, labels = panels[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize="small", frameon=False)
    return plot_png(figure)


def measure(extent: Extent) -> Part:
    """A film of the demo's contact problems, each solved by every solver, and plates with many contacts."""
    with open_explicit(SCENE, extent.arch) as sim:
        film = measure_film(SCENE, sim, extent.of(FRAMES, QUICK_FRAMES), Solvers(threads=not extent.quick))
    tables, points = [count_table([film]), solver_table([film])], []
    if not extent.quick:
        runtime = open_runtime(extent.arch, "f32", "the report's plates")
        try:
            points = measure_crossover(PLATES, runtime)
        finally:
            runtime.close()
        tables.append(crossover_table(points) + "\n\n" + crossover_text(points, extent.arch))
    part = Part(
        "solvers",
        "Contact solvers",
        "section 3.2.4, figure 20",
        f"the contact problems of explicit steps of the demo {SCENE}, one a frame, each solved to a residual of 1e-4 by all "
        f"solvers in turns; loops run on one thread, or, where it says{THREADED}, on all. And two plates with many contacts.",
        claims_of(film, points),
        tables,
        {"solvers.png": draw(film)},
    )
    part.short.append(short_of(film))
    if extent.quick:
        part.short.append("a quick run leaves out solvers on all threads and the plates with many contacts.")
    part.times = {name: summarise(o.median for o in film.of(name)) for name in film.solvers}
    return part
