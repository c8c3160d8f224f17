"""The reproduction of the report. No test here checks speed:

* a verdict follows from its claims, and the claims of each experiment depend on its numbers;
* exponents are those of made-up laws, and the law of the stable step follows from real runs;
* the interpreted loop finds the deepest point of a triangle in a known distance, and that of the compiled search in a scene;
* the page has the results and pictures; what cannot be measured is reported, and sets the exit status;
* a second run is compared with the first, and a partial run writes only to a given folder.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib import image as pictures

from benchmarks import document, report
from benchmarks.collision_cases import cubes_setup
from benchmarks.collision_runs import HASH, PHASES, TREES, Rig, Row, Sweep
from benchmarks.collision_runs import Film as SearchFilm
from benchmarks.contact_colouring import Colouring, Point
from benchmarks.contact_runs import COLD, COLOURED, PARTS, THREADED, WARM, Film, Outcome
from benchmarks.document import again_text, agrees, exponent
from benchmarks.report_parts import bound, demos, phases, points, search, solvers
from benchmarks.report_parts.page import (
    AGREE,
    DISAGREE,
    MISSING,
    PARTLY,
    Claim,
    Part,
    clearly_less,
    part_text,
    short_text,
    small_png,
    verdict_of,
)
from benchmarks.runner import REST
from taisoft.backend.runtime import open_runtime
from taisoft.errors import OutputError, SimulationError
from taisoft.machine import summarise
from taisoft.mesh.sdf import SdfGrid

SPREAD = (0.98, 1.0, 1.02)  # of rounds about their median


def rounds(seconds: float) -> list[float]:
    return [seconds * s for s in SPREAD]


def holds(claims: list[Claim]) -> list[bool]:
    return [claim.holds for claim in claims]


def test_a_verdict_follows_from_its_claims():
    assert [verdict_of(x) for x in ([True, True], [True, False], [False], [])] == [AGREE, PARTLY, DISAGREE, MISSING]
    part = Part("a", "A", "figure 1", "runs", [Claim("it is so.", True, "it is.")])
    assert part.verdict == AGREE and replace(part, failure="no memory").verdict == MISSING


def test_exponents_are_those_of_the_law():
    x = np.array([1.0, 3.0, 10.0, 50.0])
    p, off = exponent(x, 7.0 * x**-0.5)
    assert p == pytest.approx(-0.5, abs=1e-12) and off < 1e-12
    y = x**2
    y[1] *= 1.1
    p, off = exponent(x, y)
    assert 1.9 < p < 2.1 and 0.05 < off < 0.1


def test_differences_within_the_spread_are_unclear():
    assert clearly_less(rounds(1.0), rounds(1.1)) and not clearly_less(rounds(1.0), rounds(1.005))
    assert not clearly_less(rounds(1.1), rounds(1.0))


# --- claims --------------------------------------------------------------------------------------


def limits(power: float) -> tuple[list[bound.Limit], ...]:
    """Limits of a law dt ~ h^power (density / E)^1/2, as arguments of `claims_of`."""

    def made(cells=3, young=1e6, density=1e3) -> bound.Limit:
        dt = (1.0 / cells) ** power * (density / young) ** 0.5
        return bound.Limit(cells, young, density, dt, 1.01 * dt)

    youngs = [made(young=e) for e in (1e4, 1e6, 1e9)]
    return youngs, [made(cells=n) for n in (2, 4, 8)], [made(density=d) for d in (1e2, 1e4)]


def test_claims_on_the_stable_step():
    runs = [bound.LongRun("symplectic_euler", 1e6, f, 1.0 if f < 1 else np.inf, "ok" if f < 1 else "failed") for f in (0.5, 2.0)]
    runs += [bound.LongRun("implicit_euler", 1e6, f, 1.0, "ok") for f in (1.0, 100.0)]
    claims = bound.claims_of(*limits(1.0), runs)
    assert holds(claims) == [True, True, False, True, True] and "h^1.00" in claims[2].found and "1.0%" in claims[0].found
    assert holds(bound.claims_of(*limits(2.0), runs))[2]
    youngs, sizes, densities = limits(1.0)
    constant = [replace(x, measured=1.0) for x in youngs]
    assert not bound.claims_of(constant, sizes, densities, runs)[0].holds
    large = [*runs[:3], replace(runs[3], reach=40.0)]
    assert holds(bound.claims_of(*limits(1.0), large)) == [True, True, False, True, False]
    assert "E = 1e+06 Pa at 100: reach 40" in bound.claims_of(*limits(1.0), large)[4].found
    stable = [runs[0], replace(runs[1], reach=1.0), *runs[2:]]
    assert not bound.claims_of(*limits(1.0), stable)[3].holds


def sweep(tets: int, hashed: float, tree: float) -> Sweep:
    times = {HASH: rounds(hashed)} | {name: rounds(tree) for name in TREES}
    return Sweep("tets", f"cubes {tets}", tets, tets, tets, dict.fromkeys(times, 10), times)


def film_of(**numbers) -> SearchFilm:
    return SearchFilm("cubes", "proximity", 1250, True, {name: list(values) for name, values in numbers.items()})


def test_claims_on_broad_phases():
    before = film_of(**{HASH: (1.0, 1.1), TREES[-1]: (2.0, 2.1)})
    crossing = [sweep(1000, 2.0, 1.0), sweep(5000, 1.5, 1.2), sweep(12000, 2.0, 2.6), sweep(80000, 3.0, 9.0)]
    assert holds(search.broad_claims(before, crossing)) == [True, True, True]
    slower = [sweep(s.tets, 2.0, 1.0) for s in crossing]
    claims = search.broad_claims(film_of(**{HASH: (1.0, 3.0), TREES[-1]: (2.0, 2.0)}), slower)
    assert holds(claims) == [False, True, False] and "50% of 2 frames" in claims[0].found and "do not cross" in claims[2].found
    early = [sweep(100, 2.0, 1.0), sweep(1000, 1.0, 2.0), sweep(80000, 3.0, 9.0)]
    assert holds(search.broad_claims(before, early)) == [True, False, False]


def test_claims_on_cell_sizes():
    def cells(best: float) -> list[Sweep]:
        return [replace(sweep(1250, 1.0 + abs(np.log(r / best)), 1.0), at=r, setup="cubes 5") for r in (0.5, 2.2, 6.0)]

    assert holds(search.cell_claims(cells(2.2))) == [True, True]
    assert holds(search.cell_claims(cells(0.5))) == [False, False]


def test_claims_on_reductions():
    def row(found: int, fast: float, slow: float) -> Row:
        phases_ = dict.fromkeys(PHASES, rounds(1.0)) | {"reduction": rounds(fast)}
        return Row("pile", "proximity", 10 * found, found=found, phases=phases_, quadratic=rounds(slow), same=True)

    film = film_of(reduction=(1.0, 1.1), quadratic=(2.0, 6.0), found=(10, 20))
    rows = [row(n, 1e-6 * n, 1e-7 * n**2) for n in (1000, 3000, 9000)]
    assert holds(search.reduction_claims(rows, film)) == [True, True, False, True]
    flat = [row(n, 1e-3, 1e-7 * n) for n in (1000, 3000, 9000)]
    assert holds(search.reduction_claims(flat, film_of(reduction=(1.0, 9.0), quadratic=(2.0, 2.0), found=(10, 20)))) == [
        False,
        False,
        True,
        False,
    ]


def measured(where: str, per_tet: float, plain_seconds: float, first: float = 9.0) -> points.Measured:
    sizes = [
        points.Points(f"cubes {n}", n, n, n, first, rounds(per_tet * n), rounds(plain_seconds * n)) for n in (100, 1000, 9000)
    ]
    return points.Measured(where, [rounds(per_tet)] * 3, sizes, [rounds(plain_seconds)] * 3)


def test_claims_on_contact_points():
    many, one = measured("2 threads", 1e-7, 1e-3), measured("1 thread", 2e-7, 1e-3)
    claims = points.claims_of(many, one)
    assert holds(claims) == [True, False, True, False] and "tets^1.00" in claims[3].found and "2.00" in claims[1].found
    flat = measured("GPU", 1e-7, 1e-3)
    flat.sizes = [replace(p, seconds=rounds(1e-5)) for p in flat.sizes]
    assert points.claims_of(flat, one)[3].holds
    slow = measured("2 threads", 1e-3, 1e-7, first=1e-6)
    assert holds(points.claims_of(slow, one))[:3] == [False, False, False]
    assert points.claims_of(measured("2 threads", 1e-7, 2e-3), measured("1 thread", 1e-3, 2e-3))[1].holds


def fractions(search: float, points_: float, reduced: float) -> list[phases.Profile]:
    parts = dict.fromkeys((*PHASES, phases.OTHER, *PARTS, REST), [0.01])
    parts.pop(phases.SEARCH)
    parts |= {phases.POINTS: [search * points_], "reduction": [reduced], "candidates": [reduced], REST: [1.0 - search]}
    return [phases.Profile(*phases.REPORTED, 1e-3, parts)]


def test_claims_on_phases():
    assert holds(phases.claims_of(fractions(0.8, 0.9, 0.4))) == [True, False, True]
    assert holds(phases.claims_of(fractions(0.8, 0.9, 0.01))) == [True, True, False]
    assert holds(phases.claims_of(fractions(0.2, 0.9, 0.01))) == [False, True, False]
    assert fractions(0.8, 0.9, 0.1)[0].search == pytest.approx(0.94 / 1.17)  # medians of 0.72, 0.2, two and three of 0.01


def test_claims_on_colours():
    def made(contacts: int, greedy: int, random: tuple) -> list[Colouring]:
        numbers = {"greedy": [greedy], "random": list(random), "parallel": [greedy]}
        return [Colouring("two", way, contacts, 9, n, [1], [1.0]) for way, n in numbers.items()]

    assert holds(solvers.colour_claims(made(286, 95, (120, 125, 131)))) == [True, True, True, True]
    assert holds(solvers.colour_claims(made(72, 10, (10, 10)))) == [False, False, False, False]


def test_claims_on_solvers():
    def film(contacts: int, **of) -> Film:
        made = Film("cube_on_box", 215, 1e-3, 1e-2, [0.1, 0.2], [contacts] * 2, [contacts] * 2)
        for name, (sweeps, seconds) in of.items():
            outcomes = [Outcome(n, 1e-5, rounds(t)) for n, t in zip(sweeps, seconds)]
            made.outcomes[WARM][name] = made.outcomes[COLD][name] = outcomes
        return made

    def plates(coloured: float) -> list[Point]:
        return [Point(17000, 9, Outcome(50, 1e-5, rounds(1.0), [0.0] * 3), Outcome(50, 1e-5, rounds(coloured), [0.1] * 3))]

    like = {
        "gauss_seidel": ((5, 5), (2.0, 2.0)),
        "jacobi": ((20, 90), (3.0, 99.0)),
        "hybrid": ((20, 80), (1.0, 1.0)),
        COLOURED: ((5, 6), (4.0, 4.0)),
        COLOURED + THREADED: ((5, 6), (5.0, 5.0)),
    }
    assert holds(solvers.solver_claims(film(198, **like), plates(0.5))) == [True, True, True, True, False, True]
    rare = {name: ((*sweeps, sweeps[0]), (*seconds, seconds[0])) for name, (sweeps, seconds) in like.items()}
    assert holds(solvers.solver_claims(film(198, **rare), [])) == [True, True, True, True, True]  # one spike of three frames
    unlike = like | {"gauss_seidel": ((5, 99), (0.5, 9.0)), "hybrid": ((20, 80), (8.0, 8.0))}
    claims = solvers.solver_claims(film(30, **unlike), plates(2.0))
    assert holds(claims) == [False, False, False, False, False, False]


def test_claim_on_hours():
    assert demos.hours_claim(5 * 3600.0, 4.0).holds
    claim = demos.hours_claim(36.0, 4.0)
    assert not claim.holds and "1,000 times less" in claim.found


# --- interpreted loop -------------------------------------------------------------------------------------------------


def grid_of(phi) -> SdfGrid:
    axes = np.meshgrid(*[np.linspace(-1.0, 1.0, 41)] * 3, indexing="ij")
    return SdfGrid(-np.ones(3), np.full(3, 0.05), phi(np.stack(axes, axis=-1)))


def test_the_interpreted_loop_finds_the_deepest_point():
    slope = np.array([0.3, -0.2, 0.5])
    flat = grid_of(lambda X: X @ slope - 0.1)
    value, gradient = points.sample(flat, np.array([0.123, -0.456, 0.789]))
    assert value == pytest.approx(np.dot([0.123, -0.456, 0.789], slope) - 0.1) and np.allclose(gradient, slope)
    corners = np.array([(0.5, 0.0, 0.0), (-0.5, 0.2, 0.1), (0.0, 0.3, -0.6)])
    w, phi = points.deepest_point(flat, corners)
    assert np.array_equal(w, (0, 0, 1)) and phi == pytest.approx((corners @ slope - 0.1).min())
    ball = grid_of(lambda X: np.linalg.norm(X, axis=-1) - 0.5)
    corners = np.array([(0.4, 0.3, 0.0), (-0.4, 0.3, 0.1), (0.0, 0.3, -0.5)])
    w, phi = points.deepest_point(ball, corners)
    samples = np.random.default_rng(0).dirichlet((1, 1, 1), 4000) @ corners
    lowest = min(points.sample(ball, X)[0] for X in samples)
    assert lowest - 1e-9 <= phi <= lowest + 0.01 and w.min() >= 0 and w.sum() == pytest.approx(1.0)


def test_the_interpreted_loop_agrees_with_the_search():
    runtime = open_runtime("cpu", "f32", "a test of the report")
    try:
        with Rig(cubes_setup(2), points.CONTACT_MODES, runtime) as rig:
            made = points.measure_size(rig, 2, points.PlainPoints(rig))
            pairs = points.candidate_pairs(rig)
            body = rig.detection.topology.body
            assert len(pairs) == rig.n_pairs() == made.pairs and (body[pairs[:, 0]] != body[pairs[:, 1]]).all()
    finally:
        runtime.close()
    assert made.deepest == pytest.approx(made.plain_deepest, abs=1e-6) and made.deepest < 0
    assert len(made.seconds) == 2 and made.plain and made.tets == 80


def test_one_thread_is_measured_in_a_child():
    assert points.measure_on_one_thread(quick=True).where == "1 thread"


def test_the_error_of_a_child_is_reported(monkeypatch):
    monkeypatch.setattr(points, "CHILD", "raise SystemExit('no thread for {!r}')")
    with pytest.raises(SimulationError, match="no thread for True"):
        points.measure_on_one_thread(quick=True)


# --- page ---------------------------------------------------------------------------------------------------------------


def fake(seconds: float) -> Part:
    picture = small_png(np.full((8, 12, 3), 200, dtype=np.uint8))
    claims = [Claim("it is so.", False, "it is not, by 3."), Claim("that too.", True, "it is.")]
    times = {"a step": summarise(rounds(seconds))}
    return Part("bound", "A bound", "figure 99", "made up", claims, ["| a |"], {"b.png": picture}, times, ["no GPU."])


@pytest.fixture
def faked(monkeypatch):
    made = {"seconds": 1.0}
    monkeypatch.setattr(report, "PARTS", {"bound": lambda extent: fake(made["seconds"])})
    return made


def test_the_page_has_the_results(faked, tmp_path):
    assert report.main(["--out", str(tmp_path / "page")]) == 0
    text = (tmp_path / "page" / "README.md").read_text()
    assert "## A bound" in text and f"**{PARTLY}**" in text and "![b](b.png)" in text and "1 of 2" in text
    assert "**Disagree**: it is not, by 3." in text and "* A bound: no GPU." in text and "no earlier run" in text
    assert pictures.imread(tmp_path / "page" / "b.png").shape[:2] == (8, 12)
    numbers = json.loads((tmp_path / "page" / "report.json").read_text())
    assert numbers["parts"][0]["verdict"] == PARTLY and numbers["parts"][0]["times"]["a step"]["median"] == 1.0


def test_a_second_run_is_compared_with_the_first(faked, tmp_path):
    for seconds, text in ((1.0, "no earlier run"), (1.01, "1 of 1 times agree"), (2.0, "0 of 1 times agree")):
        faked["seconds"] = seconds
        assert report.main(["--out", str(tmp_path)]) == 0
        assert text in (tmp_path / "README.md").read_text()
    assert "1.98" in (tmp_path / "README.md").read_text()  # 2 over 1.01
    assert report.main(["--quick", "--out", str(tmp_path)]) == 0
    assert "another quick" in (tmp_path / "README.md").read_text()


def test_times_agree_within_both_spreads():
    one, two = ({"median": m, "spread": s} for m, s in ((1.0, 0.1), (1.25, 0.1)))
    assert not agrees(one, two) and agrees(one, two | {"spread": 0.2})
    assert "no earlier run" in again_text(None, {}, {})


def test_a_failed_part_is_reported(monkeypatch, tmp_path):
    def broken(extent):
        raise SimulationError("no such thing")

    monkeypatch.setattr(report, "PARTS", {"bound": broken})
    assert report.main(["--out", str(tmp_path)]) == 1
    text = (tmp_path / "README.md").read_text()
    assert f"**{MISSING}**: no such thing" in text and "* bound: no such thing" in text
    assert "Nothing" in short_text([]) and MISSING in part_text(Part("a", "A", "", "", failure="gone"))


def test_partial_runs_write_only_to_a_given_folder(faked, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(document, "RESULTS", tmp_path)
    assert report.main(["--quick"]) == 0 and report.main(["--only", "bound"]) == 0
    assert not list(tmp_path.iterdir()) and "A bound" in capsys.readouterr().out
    assert report.main([]) == 0 and (next(tmp_path.iterdir()) / "README.md").is_file()
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file"):
        report.main(["--out", str(tmp_path / "file")])


def test_the_stable_step_is_measured(monkeypatch, tmp_path):
    """A real experiment, smaller than any other."""
    for name, value in (("YOUNGS", ((), (1e5, 1e7))), ("CELLS", ((), (2, 3))), ("AROUND", (0.5, 1.2)), ("FACTORS", (1.0, 100.0))):
        monkeypatch.setattr(bound, name, value)
    assert report.main(["--quick", "--only", "bound", "--out", str(tmp_path)]) == 0
    part = json.loads((tmp_path / "report.json").read_text())["parts"][0]
    assert [claim["holds"] for claim in part["claims"]] == [True, True, False, True, True]
    height, width = pictures.imread(tmp_path / "bound.png").shape[:2]
    assert width > 3 * height
