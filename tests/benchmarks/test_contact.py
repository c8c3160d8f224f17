"""The contact benchmark. No test here checks speed:

* all solvers of a frame get the same problem, leave it unchanged, and report residuals that agree with an oracle;
* colourings are proper, with at least as many colours as contacts at one node;
* a step is timed by parts, each call once; a run lists the iterations of its steps;
* the plates of the crossover lie on each other, and both solvers solve them;
* limits are evaluated; the benchmark prints and writes its results, and an unmet limit sets the exit status.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import contact, contact_colouring, contact_runs, runner
from benchmarks.contact import CONTACTS, PILE, STEP_SCENE, count_table, find_limits
from benchmarks.contact_colouring import (
    REPORT,
    Colouring,
    Point,
    build_plates,
    colour_all,
    colour_table,
    crossover_text,
    find_under,
    grid,
    measure_crossover,
    proper,
)
from benchmarks.contact_problems import PLAIN
from benchmarks.contact_problems import Row as ProblemRow
from benchmarks.contact_runs import (
    COLD,
    COLOURED,
    GOAL,
    PARTS,
    SERIAL,
    WARM,
    Film,
    Outcome,
    Run,
    Solvers,
    StepCost,
    contact_jacobian,
    measure_film,
    measure_run,
    measure_step,
    observe_problems,
    open_explicit,
    open_scene,
    to_impulses,
)
from benchmarks.report_parts import phases
from benchmarks.report_parts.solvers import take_snapshot
from benchmarks.runner import REST, Stopwatch, patched
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import open_runtime
from taisoft.contact import SOLVERS
from taisoft.contact.colouring import node_graph
from tests.contact import contact_oracle as oracle

SCENE = "cube_on_box"


def to_numpy(p) -> oracle.NodeContacts:
    k = int(p.count[0])
    rows = {name: getattr(p, name).to_numpy()[:k] for name in ("node", "arity", "weight", "normal", "tangent", "friction")}
    return oracle.NodeContacts(**rows, inverse_mass=p.inverse_mass.to_numpy(), b=p.b.to_numpy()[:k].ravel())


@pytest.fixture(scope="module")
def sim():
    with open_explicit(SCENE, "cpu") as made:
        yield made


def next_problem(sim):
    """Take a step, and return its solved contact problem."""
    problems = []
    with observe_problems(problems.append):
        sim.step()
    return problems[-1]


def test_residuals_of_all_solvers_agree_with_the_oracle(sim, monkeypatch):
    residuals, make_residual = [], contact_runs.make_residual

    def make_logged(p):
        judge, contacts, W = make_residual(p), to_numpy(p), None

        def logged(r):
            nonlocal W
            W = contacts.W if W is None else W
            value = judge(r)
            residuals.append((value, oracle.residual(W, contacts.b, contacts.friction, r), np.abs(r).max()))
            return value

        return logged

    monkeypatch.setattr(contact_runs, "make_residual", make_logged)
    film = measure_film(SCENE, sim, 6, Solvers(threads=False))
    assert film.tets == 215 and 0 < film.dt < film.stable_dt and film.solvers == list(SOLVERS)
    assert 2 <= len(film.time) == len(film.contacts) <= 6 and np.all(np.diff(film.time) > 0)
    assert all(f >= n > 5 for f, n in zip(film.found, film.contacts))
    for start in (WARM, COLD):
        for name in film.solvers:
            assert len(film.of(name, start)) == len(film.time)
            assert all(o.residual <= GOAL and min(o.seconds) > 0 for o in film.of(name, start))
    assert film.missed(film.solvers) == 0
    assert all(o.sweeps > 0 for name in film.solvers for o in film.of(name, COLD))
    assert sum(min(o.colouring) > 0.01 * min(o.seconds) for o in film.of(COLOURED)) == len(film.time)
    values, expected, size = np.array(residuals).T
    assert np.allclose(values, expected, rtol=1e-6, atol=1e-12) and (size > 0).sum() > 3 * len(SOLVERS)


def test_solvers_leave_the_problem_unchanged_and_agree(sim):
    solvers, checked = Solvers(threads=False), []
    to_impulses(sim)

    def check(p):
        k = int(p.count[0])
        before = {name: getattr(p, name).to_numpy() for name in ("r", "order", "b", "factor", "friction")}
        found = solvers.outcomes(p, np.zeros((p.capacity, 3)), 2)
        assert set(found) == set(SOLVERS) and all(len(o.seconds) == 2 for o in found.values())
        assert all(np.array_equal(getattr(p, name).to_numpy(), old) for name, old in before.items())
        contacts = to_numpy(p)
        assert np.allclose(contact_jacobian(p).toarray(), contacts.jacobian)
        exact = oracle.gauss_seidel(contacts.W, contacts.b, contacts.friction, 2000)
        assert oracle.residual(contacts.W, contacts.b, contacts.friction, exact) < 1e-8
        checked.append((p, k, exact[:, 0].sum()))

    with observe_problems(check):
        report = sim.step()  # solves the problem itself after `check`
    p, n_contacts, normal_impulse = checked[-1]
    assert report.n_contacts == n_contacts and report.contact_residual <= GOAL
    assert p.r.to_numpy()[:n_contacts, 0].sum() == pytest.approx(normal_impulse, rel=1e-2, abs=1e-3)


def test_colourings_are_proper(sim):
    to_impulses(sim)
    p = next_problem(sim)
    contacts = to_numpy(p)
    graph = node_graph(contacts.node, contacts.arity, contacts.inverse_mass)
    colourings, colours = colour_all(SCENE, p, 4)
    assert [c.way for c in colourings] == list(colours) == ["greedy", "random", "parallel"]
    free = (contacts.inverse_mass > 0).any(axis=1)
    at = [i for c, n in enumerate(contacts.arity) for i in contacts.node[c, :n] if free[i]]
    for c in colourings:
        assert proper(graph, colours[c.way]) and c.contacts == len(contacts.arity)
        assert c.least == np.bincount(at).max() <= min(c.numbers) and max(c.largest) * min(c.numbers) >= c.contacts / 2
    assert len(colourings[1].numbers) == 4 and not proper(graph, 0 * colours["greedy"])
    table = colour_table([replace(colourings[0], scene="two_cubes_two_boxes")])
    assert "the report" in table and "125" in table and " 95 " in table and REPORT["two_cubes_two_boxes"][0] == 286
    snapshot = take_snapshot(SCENE, sim, colours)
    assert snapshot.touched.sum() == contacts.arity.sum() and snapshot.image.shape[2] == 3


def test_a_step_is_timed_by_parts(sim):
    cost = measure_step(SCENE, sim, 5)
    assert cost.solver == SERIAL and len(cost.whole) == 5 and cost.problems == []
    assert min(cost.contacts) > 0 and max(cost.sweeps) > 0 and cost.residual <= GOAL
    assert set(cost.parts) == {*PARTS, REST} and all(len(x) == 5 and min(x) > 0 for x in cost.parts.values())
    watch = Stopwatch()
    with phases.watched(watch, sim):  # the report's phases, which split the search
        sim.step()
    assert {*PARTS, *phases.CALLS} <= set(watch.spent) and min(watch.spent.values()) >= 0.0


def test_nested_calls_are_counted_once(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(runner, "clock", lambda: now[0])
    watch = Stopwatch()

    def wait(seconds):
        now[0] += seconds

    inner = watch.timed(wait, "inner")

    def outer():
        wait(1.0)
        inner(2.0)
        inner(4.0)

    watch.timed(outer, "outer")()
    assert watch.spent == {"inner": 6.0, "outer": 1.0} and watch.calls == {"wait": 2, "outer": 1}


def test_patched_attributes_are_restored():
    class Owner:
        def call(self):
            return 1

    made = Owner()
    with patched(made, "call", lambda: 2), patched(Owner, "call", lambda self: 3):
        assert made.call() == 2
    assert made.call() == 1 and "call" not in vars(made)


def test_plates_lie_on_each_other():
    points = np.random.default_rng(0).uniform(-3, 3, (200, 2))
    on, vertices, weights = find_under(points, 4)
    assert 50 < len(on) < 150 and set(on) == set(np.flatnonzero((np.abs(points) <= 2).all(axis=1)))
    assert weights.min() >= 0 and np.allclose(weights.sum(axis=1), 1)
    assert np.allclose(np.einsum("kj,kja->ka", weights, grid(4)[vertices]), points[on])
    assert len(find_under(grid(4), 4)[0]) == 25


def test_both_solvers_solve_the_plates(sim):
    runtime, arena = open_runtime("cpu", "f32", "a test of the benchmark"), FieldArena()
    try:
        p = build_plates(4, runtime, arena)
        contacts, first = to_numpy(p), 25
        assert (contacts.arity == 4).all() and np.allclose(contacts.weight.sum(axis=1), 0)
        above = np.where(contacts.weight > 0, contacts.node, first)[:, :4]
        below = np.where(contacts.weight < 0, contacts.node, 0)[:, :4]
        assert (above >= first).all() and (below < first).all() and (contacts.b[::3] < 0).mean() > 0.5
        fall = np.zeros((50, 3))
        fall[first:] = 1.0, 2.0, 3.0
        assert np.allclose((contacts.jacobian @ fall.ravel()).reshape(-1, 3), (2.0, 1.0, -3.0))
        (point,) = measure_crossover((4,), runtime)
    finally:
        arena.release()
        runtime.close()
    assert point.contacts == len(contacts.arity) and 3 <= point.colours < point.contacts
    assert max(point.serial.residual, point.coloured.residual) <= GOAL and min(point.serial.sweeps, point.coloured.sweeps) > 0
    assert len(point.serial.seconds) == contact_colouring.ROUNDS and min(point.coloured.colouring) > 0
    exact = oracle.gauss_seidel(contacts.W, contacts.b, contacts.friction, 50)
    assert oracle.residual(contacts.W, contacts.b, contacts.friction, exact) < GOAL


def test_a_run_lists_iterations(sim):
    """Explicit steps with made-up iterations: implicit steps would take longer to compile than the rest of this file."""
    sim.reset()
    plain, reports = sim.advance, []

    def counted(n):
        report = plain(n)
        k = len(reports)
        report.newton_iterations, report.linear_iterations, report.contact_iterations = k, 3 * k, k + 7
        reports.append(report)
        return report

    with patched(sim, "advance", counted):
        run = measure_run(SCENE, sim, 0.2)
    touching = [k for k, report in enumerate(reports) if report.n_contacts]
    assert run.status == "ok" and run.problems == [] and run.simulated == pytest.approx(0.2) and run.wall > sum(run.seconds)
    assert 10 < len(touching) == len(run.seconds) < len(reports) == 48 and run.newton == touching
    assert run.linear == [3 * k for k in touching] and run.outer == [k + 7 for k in touching]
    assert run.contacts == [reports[k].n_contacts for k in touching]


def test_scenes_are_opened_with_their_own_settings(monkeypatch):
    opened = []
    monkeypatch.setattr(contact_runs.ts, "Simulator", lambda scene, **settings: opened.append((scene, settings)))
    for name in (*contact.DEMOS, PILE):
        open_scene(name, "cpu")
        scene, settings = opened[-1]
        assert settings["integrator"] == "implicit_euler" and settings["precision"] == "f32" and "seconds" not in settings
    assert settings["dt"] == 1 / 100 and len(scene.bodies) == 27
    tets = [sum(body.mesh.n_tets for body in scene.bodies) for scene, _ in opened[:2]]
    assert tets == [215, 240]


# --- output -------------------------------------------------------------------------------------------------------


def made_film(scene: str, residual: float = 1e-5) -> Film:
    film = Film(scene, 100, 0.004, 0.01, [0.1, 0.2], [20, 22], [30, 31])
    for start in (WARM, COLD):
        film.outcomes[start] = {name: [Outcome(5, residual, [0.001], [0.0])] * 2 for name in SOLVERS}
    return film


def measurements(
    scenes=(SCENE, "two_cubes_two_boxes"), ms=1.9, wall=2.9, status="ok", residual=1e-5, verdict="best: pass"
) -> dict:
    cost = StepCost(SCENE, SERIAL, [1e-3 * ms] * 3, {part: [1e-4] for part in (*PARTS, REST)}, [20], [5], 9e-5, [])
    runs = [Run(scene, "implicit_euler", status, [], 2.0, 2 * wall, [0.02], [20], [3], [5], [30]) for scene in (SCENE, PILE)]
    colourings = [Colouring(scene, "greedy", 4, 2, [2], [2], [0.001]) for scene in scenes]
    points = [
        Point(n, 8, Outcome(5, 1e-5, [a], [0.0]), Outcome(5, 1e-5, [b], [b / 2]))
        for n, a, b in ((100, 1.0, 2.0), (10000, 2.0, 1.0))
    ]
    problems = [ProblemRow("Rover1039", 4, PLAIN, (1.0, 0.1, 0.01), 10, 0.5, 0.5, verdict)]
    return {
        "films": [made_film(scene, residual) for scene in scenes],
        "steps": [cost],
        "runs": runs,
        "colourings": colourings,
        "crossover": points,
        "problems": problems,
    }


def test_limits_are_met_or_not():
    assert [limit.met for limit in find_limits(measurements())] == [True] * 6
    bad = find_limits(measurements(ms=2.1, wall=3.1, status="degraded", residual=2e-4, verdict="best: FAIL"))
    assert [limit.met for limit in bad] == [False, True, False, False, False, False]
    assert bad[4].value == 8 and STEP_SCENE in bad[0].what
    nothing = {"films": [], "steps": [], "runs": [], "problems": []}
    assert not any(limit.met for limit in find_limits(nothing))


def test_tables_of_contact_counts_and_crossover():
    assert CONTACTS == {SCENE: 198, "two_cubes_two_boxes": 286}
    assert "21 (20 to 22)" in count_table([made_film(SCENE)]) and "89%" in count_table([made_film(SCENE)])
    points = measurements()["crossover"]
    assert "crossover at 1,000 contacts" in crossover_text(points, "cpu").splitlines()[0]
    assert "no crossover up to 100 contacts, serial" in crossover_text(points[:1], "cpu")


@pytest.fixture
def faked(monkeypatch):
    found = [measurements()]
    monkeypatch.setattr(contact, "measure", lambda quick, arch, document: found[0])
    return found


def test_command_writes_what_it_prints(faked, tmp_path, capsys):
    out = tmp_path / "new" / "a.json"
    assert contact.main(["--out", str(out)]) == 0
    printed, numbers = capsys.readouterr().out, json.loads(out.read_text())
    assert out.with_suffix(".md").read_text().strip() in printed
    assert numbers["films"][0]["outcomes"][WARM][SERIAL][0]["sweeps"] == 5 and len(numbers["limits"]) == 6
    assert "## Limits" in printed and "NOT met" not in printed


def test_an_unmet_limit_sets_the_exit_status(faked, capsys):
    faked[0] = measurements(wall=3.5)
    assert contact.main([]) == 1
    assert "NOT met" in capsys.readouterr().out
    assert contact.main(["--quick"]) == 0
    assert "## Limits" not in capsys.readouterr().out


def test_missing_problems_are_reported(monkeypatch, capsys):
    monkeypatch.setattr(contact.contact_problems, "missing", lambda names: "they are gone")
    assert contact._problems(True, contact.Document()) == []
    assert "Left out: they are gone." in capsys.readouterr().out
