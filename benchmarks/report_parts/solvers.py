"""The contact solve: colourings of the contact graph (figure 19 of the report) and contact solvers (figure 20).

Colourings are measured on two cubes on two boxes, solvers on a cube on a box and on plates with many contacts.
"""

from contextlib import closing
from dataclasses import dataclass

import numpy as np

from taisoft.backend.runtime import open_runtime
from taisoft.contact.colouring import groups
from taisoft.contact.matrix_contacts import jacobian
from taisoft.machine import summarise
from taisoft.view.offscreen import Offscreen

from ..contact import CONTACTS, count_table, solver_table
from ..contact_colouring import (
    QUICK_SEEDS,
    REPORT,
    SEEDS,
    Colouring,
    Point,
    colour_all,
    colour_table,
    crossover_table,
    crossover_text,
    measure_crossover,
)
from ..contact_runs import COLOURED, SERIAL, THREADED, Film, Solvers, measure_film, open_explicit, to_impulses
from ..document import ms
from .page import COLOURS, Claim, Extent, Part, clearly_less, is_near, new_figure, plot_png

COLOURED_SCENE = "two_cubes_two_boxes"
REPORTS_CONTACTS, COLOURS_FOUND = REPORT[COLOURED_SCENE]
SETTLE = 60  # steps after the first impulse until the cubes rest on their boxes
SCENE = "cube_on_box"
FRAMES, QUICK_FRAMES = 60, 5
PLATES = (8, 32, 96)  # cells of two plates on each other: about 130 to 17,000 contacts
JACOBI, HYBRID = "jacobi", "hybrid"
SPIKE = 5.0  # time over the median from which a frame is a spike
MOSTLY = 0.9  # fraction of frames in which a solver must win to be by far the fastest
BANDS = COLOURS[:2]  # alternating colours of groups
COLOURINGS = ("random", "greedy")  # drawn as grouped Jacobians
PICTURE = (640, 520)  # pixels of a scene
NEAR = 0.25  # relative difference from the report's number that counts as equal


# --- colours ------------------------------------------------------------------------------------------------------------


def colour_claims(found: list[Colouring]) -> list[Claim]:
    """Claims on colours and contacts. found: colourings of scenes from coarse to fine."""
    by = {(c.scene, c.way): c for c in found}
    scenes = list(dict.fromkeys(c.scene for c in found))
    greedy, random = ([float(np.median(by[scene, way].numbers)) for scene in scenes] for way in ("greedy", "random"))
    contacts, least = ([getattr(by[scene, "greedy"], name) for scene in scenes] for name in ("contacts", "least"))
    spans = [int(np.ptp(by[scene, "random"].numbers)) for scene in scenes]
    each = f"of {_listed(contacts)} contacts"
    groups = [is_near(k / n, REPORTS_CONTACTS / COLOURS_FOUND["greedy"], NEAR * 3) for k, n in zip(contacts, greedy)]
    fewer, theirs = all(g < r for g, r in zip(greedy, random)), COLOURS_FOUND["greedy"]
    return [
        Claim(
            f"the scene has {REPORTS_CONTACTS} contacts.",
            any(is_near(k, REPORTS_CONTACTS, NEAR * REPORTS_CONTACTS) for k in contacts),
            f"ours has {_listed(contacts)}, on the demo's mesh and on that once refined.",
            "The number depends on the mesh, which the report does not give, and on its reduction.",
        ),
        Claim(
            f"greedy colouring needs fewer groups than random, {theirs} against {COLOURS_FOUND['random']}.",
            fewer,
            f"greedy needs {_listed(greedy)}, random {_listed(random)} (median over seeds), {each}.",
            "" if fewer else "Both reach the minimum.",
        ),
        Claim(
            "each group holds only about three contacts.",
            all(groups),
            f"greedy groups hold {_listed(round(k / n, 1) for k, n in zip(contacts, greedy))} contacts each, {each}.",
            ""
            if all(groups)
            else f"A colouring needs at least as many groups as contacts meet at one node, here {_listed(least)}, and greedy "
            f"needs about as many. With {theirs} greedy colours, a contact of the report had at least {theirs - 1} neighbours.",
        ),
        Claim(
            "random colouring varies.",
            max(spans) > 0,
            f"over {len(by[scenes[0], 'random'].numbers)} seeds its numbers of groups span {_listed(spans)}.",
        ),
    ]


def _listed(values) -> str:
    return " and ".join(f"{v:g}" for v in values)


@dataclass
class Snapshot:
    """A scene at one moment. image (h,w,3); touched (k, n_nodes) bool: nodes of each contact; colours: method -> (k,)."""

    scene: str
    image: np.ndarray
    touched: np.ndarray
    colours: dict[str, np.ndarray]


def take_snapshot(scene: str, sim, colours: dict[str, np.ndarray]) -> Snapshot:
    """Picture of a simulator and its contact Jacobian, for nodes with contacts."""
    J = jacobian(sim._dynamics.contact.problem).tocoo()
    touched = np.zeros((J.shape[0] // 3, J.shape[1] // 3), dtype=bool)
    touched[J.row // 3, J.col // 3] = True
    image = Offscreen(sim.scene, PICTURE).image(sim)
    return Snapshot(scene, image, touched[:, touched.any(axis=0)], colours)


def figure_19(panels, s: Snapshot) -> None:
    """Plot the scene, its Jacobian, and the Jacobian grouped by colour with alternating tints."""
    panels[0].imshow(s.image)
    panels[0].set_axis_off()
    panels[0].set_title(f"{s.scene} (as fig. 19)")
    _spy(panels[1], s.touched, np.zeros(len(s.touched), dtype=int), f"contact Jacobian: {len(s.touched)} contacts")
    for panel, method in zip(panels[2:], COLOURINGS):
        order, start = groups(s.colours[method])
        band = np.repeat(np.arange(len(start) - 1), np.diff(start))
        _spy(panel, s.touched[order], band % len(BANDS), f"grouped, {method}: {len(start) - 1} colours")
        for at in start[1:-1]:
            panel.axhline(at - 0.5, color="#bbbbbb", lw=0.6, zorder=0)


def _spy(panel, touched: np.ndarray, band: np.ndarray, title: str) -> None:
    row, column = np.nonzero(touched)
    size = min(30.0, 4e4 / touched.size + 2.0)
    panel.scatter(column, row, s=size, marker="s", linewidths=0, c=np.array(BANDS)[band[row]])
    panel.set(title=title, xlabel="nodes in contact", ylabel="contacts")
    panel.set_xlim(-0.5, touched.shape[1] - 0.5)
    panel.set_ylim(touched.shape[0] - 0.5, -0.5)


def measure_colours(extent: Extent) -> Part:
    """Measure the demo in explicit steps, in a full run also refined once."""
    found, times, picture = [], {}, b""
    for refine in extent.of((0, 1), (0,)):
        with open_explicit(COLOURED_SCENE, extent.arch, refine or None) as sim:
            sim.reset()
            to_impulses(sim)
            for _ in range(SETTLE):
                sim.step()
            name = COLOURED_SCENE if not refine else f"{COLOURED_SCENE}, refined"
            made, colours = colour_all(name, sim._dynamics.contact.problem, extent.of(SEEDS, QUICK_SEEDS))
            found += made
            times |= {f"{name}, {c.way}": summarise(c.seconds) for c in made}
            if not refine:
                figure, (panels,) = new_figure(4)
                figure_19(panels, take_snapshot(name, sim, colours))
                picture = plot_png(figure)
    return Part(
        "colours",
        "Colours of the contact graph",
        "section 3.2.3, figure 19",
        f"the contacts of the demo {COLOURED_SCENE} in explicit steps, {SETTLE} after the first impulse; two contacts are "
        "neighbours where they share a node that can move. Each colouring is checked: no two neighbours have one colour.",
        colour_claims(found),
        [colour_table(found)],
        {"colours.png": picture},
        times,
        [f"the report does not give its mesh, so its {REPORTS_CONTACTS} contacts are reproduced only approximately."],
    )


# --- solvers ------------------------------------------------------------------------------------------------------------


def solver_claims(film: Film, points: list[Point]) -> list[Claim]:
    """Claims on iterations, times, spikes, and serial against parallel. points: of the crossover, empty in a quick run."""
    contacts = float(np.median(film.contacts))
    sweeps = {name: np.array([o.sweeps for o in film.of(name)]) for name in film.solvers}
    times = {name: [o.median for o in film.of(name)] for name in film.solvers}
    times_text = ", ".join(f"{name} {ms(np.median(t))}" for name, t in times.items())
    beaten = float((sweeps[SERIAL] <= sweeps[JACOBI]).mean())
    few = beaten == 1.0 and np.median(sweeps[SERIAL]) < np.median(sweeps[JACOBI])
    fastest = min(times, key=lambda name: np.median(times[name]))
    hybrid = min((name for name in times if name.startswith(HYBRID)), key=lambda name: np.median(times[name]))
    wins = [float(np.less(times[hybrid], t).mean()) for name, t in times.items() if not name.startswith(HYBRID)]
    is_clear = min(wins) >= MOSTLY
    parallel = [name for name in times if name.startswith(COLOURED)]
    slow = all(np.median(times[SERIAL]) <= np.median(times[name]) for name in parallel)
    jacobi = [name for name in times if name.startswith(JACOBI)]
    spikes = [max(times[name]) / np.median(times[name]) for name in jacobi]
    claims = [
        Claim(
            f"the scene has {CONTACTS[SCENE]} contacts.",
            is_near(contacts, CONTACTS[SCENE], NEAR * CONTACTS[SCENE]),
            f"ours has {contacts:g}, median over {len(film.contacts)} frames.",
            "The number depends on the mesh, which the report does not give, and on its reduction.",
        ),
        Claim(
            "Gauss-Seidel needs fewer iterations than Jacobi in every frame.",
            bool(few),
            f"medians are {np.median(sweeps[SERIAL]):g} and {np.median(sweeps[JACOBI]):g} sweeps (hybrid "
            f"{np.median(sweeps[HYBRID]):g}); Gauss-Seidel needs no more in {beaten:.0%} of the frames. The residual is "
            "computed after every fifth sweep.",
        ),
        Claim(
            "the parallel hybrid is by far the fastest.",
            is_clear,
            f"{fastest} is the fastest in the median; {hybrid} is faster than each of the others in at least {min(wins):.0%} of "
            f"the frames. Medians, in ms: {times_text}.",
            ""
            if is_clear
            else "Hybrid sweeps are Jacobi sweeps with the newest normal impulse in the friction bound and about as many. With "
            "tens of contacts a compiled serial sweep takes microseconds, less than waking a thread.",
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
            "The report attributes them to the machine; frames that need more sweeps take longer, too.",
        ),
    ]
    return claims + ([more_contacts(points)] if points else [])


def more_contacts(points: list[Point]) -> Claim:
    """Claim on larger scenes."""
    last = points[-1]
    overtaken = clearly_less(last.coloured.seconds, last.serial.seconds)
    return Claim(
        "with more contacts parallel Gauss-Seidel will overtake serial (expected, not measured there).",
        overtaken,
        f"at {last.contacts:,} contacts a solve takes {ms(last.serial.median)} ms serial and {ms(last.coloured.median)} ms "
        f"coloured; a sweep alone {ms(last.serial.per_sweep)} and {ms(last.coloured.per_sweep)} ms.",
        "" if overtaken else "On so few threads the gain per sweep is less than the cost of colouring and of additional sweeps.",
    )


def draw(film: Film) -> bytes:
    """Plot figure 20: sweeps and time of each solver over frames, and the contacts."""
    figure, (panels,) = new_figure(3)
    for name, colour in zip(film.solvers, COLOURS):
        style = {"color": colour, "label": name, "lw": 1.2, "ls": "--" if name.endswith(THREADED) else "-"}
        if not name.endswith(THREADED):  # threads change no sweeps
            panels[0].plot(film.time, [o.sweeps for o in film.of(name)], **style)
        panels[1].plot(film.time, [1e3 * o.median for o in film.of(name)], **style)
    panels[2].plot(film.time, film.contacts, color=COLOURS[0], label="contacts")
    panels[2].plot(film.time, film.found, ":", color=COLOURS[1], label="before reduction")
    panels[0].set_ylim(bottom=0)
    panels[1].set_yscale("log")
    panels[2].set_ylim(bottom=0)
    panels[2].legend(fontsize="small", frameon=False)
    for panel, what in zip(panels, ("sweeps (fig. 20)", "solve [ms] (fig. 20)", "contacts")):
        panel.set(title=f"{film.scene}: {what}", xlabel="time [s]")
        panel.grid(True, which="major", color="#eeeeee")
    handles, labels = panels[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize="small", frameon=False)
    return plot_png(figure)


def measure_solvers(extent: Extent) -> Part:
    """Measure a film of the demo's contact problems with every solver, and plates with many contacts."""
    with open_explicit(SCENE, extent.arch) as sim:
        film = measure_film(SCENE, sim, extent.of(FRAMES, QUICK_FRAMES), Solvers(threads=not extent.quick))
    tables, points = [count_table([film]), solver_table([film])], []
    if not extent.quick:
        with closing(open_runtime(extent.arch, "f32", "the report's plates")) as runtime:
            points = measure_crossover(PLATES, runtime)
        tables.append(crossover_table(points) + "\n\n" + crossover_text(points, extent.arch))
    part = Part(
        "solvers",
        "Contact solvers",
        "section 3.2.4, figure 20",
        f"the contact problems of explicit steps of the demo {SCENE}, one a frame, each solved to a residual of 1e-4 by all "
        f"solvers in turn; loops run on one thread, or on all if marked '{THREADED}'. Also two plates with many contacts.",
        solver_claims(film, points),
        tables,
        {"solvers.png": draw(film)},
    )
    part.short.append(
        f"the report's {CONTACTS[SCENE]} contacts are not reproduced: it does not give its mesh, and ours has "
        f"{np.median(film.contacts):g}. It does not give the solvers' tolerance either."
    )
    if extent.quick:
        part.short.append("a quick run leaves out solvers on all threads and the plates with many contacts.")
    part.times = {name: summarise(o.median for o in film.of(name)) for name in film.solvers}
    return part
