"""Plots over time: history, axes, their place on pictures; captions and colour bars."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taisoft.errors import OutputError, SceneError
from taisoft.records import Energies, ErrorEstimate, StepReport
from taisoft.view import annotations
from taisoft.view.annotations import Annotations, curves_of
from taisoft.view.choices import PLOTS
from taisoft.view.colouring import GRADIENT, Colouring
from taisoft.view.plots import QUANTITIES, History, Plots, plain_history, series_of
from taisoft.view.scene_view import Surfaces
from tests.cli.command import BEAM, run, write
from tests.output.png import decode
from tests.view.drawing import body_mask, sampled
from tests.view.fake_simulator import FakeSimulator, beam_scene, plan_of


def started(capacity: int = 8, time: float = 0.0, kinetic: float = 0.0) -> History:
    return History(SimpleNamespace(time=time, energies=lambda: Energies(kinetic, 1.0, 2.0)), capacity)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1e6, 1e6, allow_subnormal=False) | st.just(float("nan")), max_size=200), st.sampled_from([2, 4, 8, 10])
)
def test_entries_hold_the_extremes_of_their_steps(values, capacity):
    history = started(capacity)
    for k, value in enumerate(values):
        history.take(StepReport(time=k + 1.0, kinetic=value, elastic=1.0, gravity=2.0, n_contacts=k), 0.001, {})
    kinetic, steps, n = np.array([0.0, *values]), np.arange(len(values) + 1.0), len(history.times)
    length = 2 ** math.ceil(math.log2(len(kinetic) / n))
    assert n <= capacity and (length == 1 or 2 * n > capacity) and history.times[-1] == len(values)
    for j in range(n):
        covered = slice(j * length, (j + 1) * length)
        finite = kinetic[covered][np.isfinite(kinetic[covered])]
        ends = (finite.min(), finite.max()) if len(finite) else (np.nan, np.nan)
        assert np.array_equal((history.low[j, 0], history.high[j, 0]), ends, equal_nan=True)
        assert history.times[j] == steps[covered][-1]


def test_energies_are_changes_and_unmodelled_quantities_are_nan():
    history = started(kinetic=10.0, time=3.0)
    energies = {"kinetic": 11.0, "elastic": 3.0, "gravity": -1.0}
    implicit = {"newton_residual": 1e-5, "newton_iterations": 2, "linear_iterations": 30}
    solved = {"residual": 1e-5, "newton_iterations": 2, "linear_iterations": 30, "contact_residual": float("inf")}
    report = StepReport(time=3.1, steps=4, contact_iterations=8, n_contacts=5, **energies, **solved)
    expected = {"kinetic": 1.0, "elastic": 2.0, "gravity": -3.0, "total": 0.0, "step_time": 5.0}
    for solves, touching in ((True, True), (False, True), (False, False), (True, False)):
        history.take(report, 0.02, {"implicit": solves, "contact": touching})
        modelled = expected | (implicit if solves else {})
        modelled |= {"contact_iterations": 2.0, "n_contacts": 5} if touching else {}
        assert {name: value for name, value in zip(QUANTITIES, history.last) if np.isfinite(value)} == pytest.approx(modelled)
    assert history.begin == 3.0
    history.take(report, 0.02, {}, ErrorEstimate(time=0.012, excursion=1.0, energies=Energies(0.1, 0.2, 0.3)))
    assert history.last[QUANTITIES.index("time_error")] == pytest.approx(1.2)
    assert history.low[-1, :4] == pytest.approx([0.9, 1.8, -3.3, -0.6]), "energies less their errors"
    assert history.high[-1, :4] == pytest.approx([1.1, 2.2, -2.7, 0.6])


class Stub:
    """The part of a simulator that plots use."""

    time = 0.0
    scene, forces = SimpleNamespace(bodies=[SimpleNamespace(name="a"), SimpleNamespace(name="b")]), {}

    def __init__(self, explicit=False, touching=True):
        self.settings = SimpleNamespace(explicit=explicit, integrator="velocity_verlet" if explicit else "bdf2")
        self.plan = plan_of(touching, "two bodies" if touching else "one body")

    def energies(self):
        return Energies(0.0, 0.0, 0.0)

    def _open(self):
        return SimpleNamespace(body_energies=lambda: [Energies(1.0, 2.0, 0.0), Energies(3.0, 4.0, 0.0)])

    def pairs_in_contact(self):
        return list(self.forces)

    def contact_force(self, a, b):
        return np.array(self.forces[a, b])


def filled(n=400):
    plots, rng = Plots(Stub(), tuple(Plots(Stub()).available())), np.random.default_rng(0)
    for k in range(n):
        energies = dict(zip(("kinetic", "elastic", "gravity"), rng.normal(size=3)))
        plots.take(StepReport(time=0.01 * (k + 1), residual=10.0 ** rng.uniform(-9, -3), n_contacts=k % 7, **energies), 0.01)
    return plots


def axis(*values, log=False):
    """Ticks for values, and the heights of these."""
    column = np.array(values, dtype=float)[:, None]
    ticks, ((low, high),) = curves_of(column, column, log, 5.0)
    assert np.array_equal(low, high, equal_nan=True)
    return ticks.tolist(), low


def test_an_axis_has_round_ticks_and_all_values_between_them():
    ticks, heights = axis(0, 10, 37, np.nan, 20)
    assert ticks == [0, 10, 20, 30, 40] and np.array_equal(heights, [0, 0.25, 0.925, np.nan, 0.5], equal_nan=True)
    assert axis(5.0, -12.0)[0] == pytest.approx([-15, -10, -5, 0, 5]) and axis(-3e-6, -1e-6)[0][-1] == 0.0
    ticks, bands = curves_of(np.array([[1.0, -4.0], [0.5, 2.0]]), np.array([[2.0, -4.0], [4.0, 4.0]]), False, 4.0)
    assert ticks.tolist() == [-4, -2, 0, 2, 4] and np.allclose(8 * bands - 4, [[[1, 0.5], [2, 4]], [[-4, 2], [-4, 4]]])


def test_of_many_pairs_the_few_with_the_largest_forces_are_drawn_and_bodies_only_where_wanted():
    """Also of what the process of pictures gets. A pair that does not press has no force; what was not recorded is a gap."""
    sim = Stub()
    plots = Plots(sim)
    for k, names in enumerate(((), ("forces",), ("forces",), ("forces", "kinetic"))):
        plots.names = names
        sim.forces = {("a", str(j)): (3.0 * j * (k == 1), 4.0 * j, 0.0) for j in range(9 if k == 1 else 7)}
        plots.take(StepReport(time=k + 1.0), 0.01)
    sent = SimpleNamespace(**plain_history(plots.history))
    assert (
        len(sent.columns) == len(QUANTITIES) + 4 + 2 == sent.low.shape[1] and len(plots.history.columns) == len(QUANTITIES) + 11
    )
    for history in (plots.history, sent):
        shown = series_of(PLOTS["forces"], history)
        columns = [history.columns.index(one.quantity) for one in shown]
        assert [one.name for one in shown] == ["a, 5", "a, 6", "a, 7", "a, 8"] and len({one.colour for one in shown}) == 4
        assert np.allclose(history.last[columns], [20, 24, 0, 0])
        assert np.array_equal(history.high[-4:, columns[3]], [np.nan, (24**2 + 32**2) ** 0.5, 0, 0], equal_nan=True)
        assert [one.name for one in series_of(PLOTS["kinetic"], history)] == ["a", "b"]
        assert series_of(PLOTS["elastic"], history) == ()


def test_a_logarithmic_axis_accepts_zero():
    ticks, heights = axis(0.0, 1e-6, 3e-5, 1e-3, log=True)
    assert ticks == pytest.approx([1e-6, 1e-5, 1e-4, 1e-3]) and np.allclose(heights, [0, 0, (np.log10(3e-5) + 6) / 3, 1])
    assert axis(0.0, 0.0, log=True)[0] == [1, 10]
    ticks, heights = axis(1e-300, 1.0, np.nan, log=True)
    assert 1e-15 <= ticks[0] <= 1e-12 and ticks[-1] == 1.0 and heights[0] == 0.0


@pytest.mark.parametrize("log", [False, True])
def test_extreme_values_stay_on_the_axis(log):
    for values in ([0.0], [0.0, 0.0], [np.nan, np.nan], [1e-320, 0.0], [5e-324], [1e300, -1e300], [-3.0]):
        ticks, heights = axis(*values, log=log)
        finite = heights[np.isfinite(heights)]
        assert len(ticks) > 1 and (finite >= 0).all() and (finite <= 1).all() and len(finite) == np.isfinite(values).sum()


def test_only_simulated_quantities_are_available():
    newton, contact = {"residuals": ["Newton"], "iterations": ["Newton", "CG"]}, ["contacts"]
    touched = dict.fromkeys(("residuals", "iterations", "contacts"), contact)
    both = {name: newton.get(name, []) + contact for name in touched}
    for kind, expected in (((False, True), both), ((False, False), newton), ((True, True), touched), ((True, False), {})):
        available = {name: [s.name for s in plot.series] for name, plot in Plots(Stub(*kind)).available().items()}
        assert available.pop("step_time") == ["step"] and len(available.pop("energies")) == 4
        assert available.pop("kinetic") and available.pop("elastic")
        assert [bool(available.pop(name, None)) for name in ("forces", "torques")] == [kind[1]] * 2 and available == expected
    for stub, name, message in (
        (Stub(True, False), "residuals", "not available: steps of velocity_verlet are explicit .* and contact forces"),
        (Stub(), "energy", "plot must be one of .*, not 'energy'; did you mean 'energies'"),
    ):
        with pytest.raises(SceneError, match=message):
            Plots(stub, (name,))


SIZE, LARGE = (640, 360), (1280, 720)


def grey(size=SIZE):
    return np.full((size[1], size[0], 3), 120, dtype=np.uint8)


def bounds(picture, before):
    """Return left, top, right, bottom of the differing pixels."""
    rows, columns = np.nonzero((picture != before).any(axis=2))
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def near(picture, colour, by=60):
    return np.abs(picture.astype(int) - np.round(255 * np.array(colour))).max(axis=2) < by


def test_lines_show_their_values():
    plots, sim = filled(), FakeSimulator(beam_scene())
    column, half = QUANTITIES.index("n_contacts"), len(plots.history.times) // 2
    for part, value in ((slice(0, half), 1.0), (slice(half, None), 4.5)):
        plots.history.low[part, column] = plots.history.high[part, column] = value
    plots.names = ("contacts",)
    before = grey(LARGE)
    picture = Annotations(plots).draw(before, sim, 0)
    left, top, right, bottom = bounds(picture, before)
    assert 963 <= left and right <= 1265 and 15 <= top and bottom <= 170 and (before == 120).all(), "on a copy, at the right"
    rows, columns = np.nonzero(near(picture[42:152, 1010:1255], PLOTS["contacts"].series[0].colour))
    low, high = rows[columns < 100], rows[columns > 150]
    assert np.ptp(low) < 4 and np.ptp(high) < 4 and low.min() == pytest.approx(high.min() + 0.7 * 106, abs=2)


def test_a_caption_is_at_the_bottom(monkeypatch):
    sim = FakeSimulator(beam_scene())
    sim.time = 0.5
    state = sampled(sim)
    plain = Annotations(name="bücher").draw(grey(), state, 7)
    left, top, right, bottom = bounds(plain, grey())
    assert left < 12 and 190 < right < 340 and 318 < top < 336 and bottom <= 355
    assert not np.array_equal(Annotations(name="bücher").draw(grey(), state, 8), plain), "frame number"
    dark = Annotations(name="bücher").draw(grey() // 4, state, 7)
    assert plain.min() < 60 and plain.max() < 230 and dark.max() > 240, "light text on dark pictures"
    both = Annotations(filled(), "beam").draw(grey(), state, 0)
    assert (both[10:280, : SIZE[0] - 160] == 120).all(), "the bodies stay visible"
    monkeypatch.setattr(annotations, "find_spec", lambda name: None if name == "matplotlib" else 1)
    with pytest.raises(OutputError, match=r"text in pictures needs matplotlib: pip install 'taisoft\[plot\]'"):
        Annotations(name="beam")


def test_a_colour_bar_follows_the_scale_and_fits_a_small_picture():
    sim = FakeSimulator(beam_scene())
    colouring = Colouring(Surfaces(sim.scene), "stress")
    bar_alone, pictures = Annotations(colouring=colouring), []
    assert np.array_equal(bar_alone.draw(grey(LARGE), None, 0), grey(LARGE)), "no scale yet"
    for sim.time in (0.0, 0.0, 9.0):
        state = sampled(sim, (), "stress")
        colouring.base(state)
        pictures.append(bar_alone.draw(grey(LARGE), state, 0))
    left, top, right, bottom = bounds(pictures[0], grey(LARGE))
    assert 8 < left < 18 and 230 < right < 252 and 640 < top and bottom <= 704
    bar = pictures[0][681, 16:236]
    assert np.abs(bar[[0, 110, -1]] - 255 * GRADIENT[[0, 2, -1]]).max() < 6
    assert np.array_equal(pictures[0], pictures[1]) and not np.array_equal(pictures[1], pictures[2])
    assert np.array_equal(pictures[2][681, 16:236], bar), "only the numbers differ"
    both = Annotations(name="beam", colouring=colouring).draw(grey(LARGE), state, 0)
    assert np.array_equal(both[681 - 60, 16:236], bar), "above the caption"
    for size in ((64, 36), (1, 1)):  # where the steps of the bar, and letters, are smaller than a pixel
        everything = Annotations(filled(), "a $b", colouring).draw(grey(size), state, 7)
        assert everything.shape == (size[1], size[0], 3) and (size == (1, 1) or (everything != 120).any())


def test_a_run_draws_plots_and_captions(tmp_path):
    path, options = write(tmp_path / "beam.py", BEAM), ("--plots", "energies,step_time", "--caption", "--colour", "stress")
    assert run(path, "--out", tmp_path / "out", "--no-usd", "--fps", 10, *options) == 0
    first, last = (decode(file.read_bytes()) for file in sorted((tmp_path / "out" / "frames").iterdir()))
    for series in PLOTS["energies"].series[:3]:
        assert near(last[30:140, 970:], series.colour).sum() > 40, series.name
    assert (last[170:280, 970:] > 225).all(axis=2).mean() > 0.25, "a second plot, whose curve depends on the load"
    assert (last[650:710, 10:600] < 60).all(axis=2).sum() > 500 and not np.array_equal(first[650:710], last[650:710]), "caption"
    assert body_mask(last[580:660, :250]).mean() > 0.1, "colour bar"
