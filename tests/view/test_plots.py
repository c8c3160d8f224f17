"""Plots over time:

* curves lie in the unit square, at heights given by the axis; gaps stay gaps; a logarithmic axis accepts zero;
* only simulated quantities are available, and a refusal gives the reason; a key hides the plots and shows them again;
* in the window plots do not overlap and lie inside it, as many as fit.
"""

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from taisoft.errors import SceneError
from taisoft.records import Energies, StepReport
from taisoft.scene.plan import Plan
from taisoft.view.annotations import MAX_SEGMENTS, cells, drawing, write
from taisoft.view.plots import CAPACITY, GRID_LINES, PLOTS, QUANTITIES, Plots, curves_of


class Stub:
    """The part of a simulator that plots use."""

    def __init__(self, explicit=False, touching=True):
        self.settings = SimpleNamespace(explicit=explicit, integrator="velocity_verlet" if explicit else "bdf2")
        self.plan = Plan()
        self.plan.add("contact_forces", touching, "two bodies", "one body")
        self.time = 0.0

    def energies(self):
        return Energies(0.0, 0.0, 0.0)


def filled(n=1000, **kind):
    plots = Plots(Stub(**kind), tuple(Plots(Stub(**kind)).available()))
    rng = np.random.default_rng(0)
    for k in range(n):
        energies = dict(zip(("kinetic", "elastic", "gravity"), rng.normal(size=3)))
        report = StepReport(time=0.01 * (k + 1), residual=10.0 ** rng.uniform(-9, -3), n_contacts=k % 7, **energies)
        plots.take(report, rng.uniform(0.001, 0.1))
    return plots


class RecordingGui:
    """A GGUI that records names and places of sub-windows."""

    def __init__(self):
        self.names, self.places = [], []

    @contextmanager
    def sub_window(self, name, *place):
        self.names.append(name)
        self.places.append(place)
        yield SimpleNamespace(text=lambda line, color=None: None)


def curves_with(series: dict, name: str):
    """Curves of a plot of the given values by quantity, at times 0, 1, ..."""
    n = len(next(iter(series.values())))
    values = np.full((n, len(QUANTITIES)), np.nan)
    for quantity, column in series.items():
        values[:, QUANTITIES.index(quantity)] = column
    times = np.arange(n, dtype=float)
    return curves_of(PLOTS[name], SimpleNamespace(times=times, low=values, high=values, last=values[-1], begin=0.0))


def test_curves_have_the_heights_given_by_the_axis():
    curves = curves_with({"n_contacts": [0, 10, 37, np.nan, 20]}, "contacts")
    assert curves.ends == ("0", "40") and curves.times == (0.0, 4.0)
    assert curves.grid == pytest.approx([0.25, 0.5, 0.75]) and len(curves.grid) <= GRID_LINES
    ((_, points),) = curves.lines
    known = points[~np.isnan(points[:, 1])]
    assert np.allclose(known, [(0, 0), (0.25, 0.25), (0.5, 0.925), (1, 0.5)])
    assert np.isnan(points[3]).all(), "NaN is a gap"
    assert curves.legend[0][1] == "20"
    down = curves_with({"kinetic": [0.0, 5.0], "gravity": [0.0, -12.0]}, "energies")
    assert down.ends == ("-15 J", "5 J") and np.allclose(down.lines[2][1][-1], (1, 0.15))
    assert [value for _, value, _ in down.legend] == ["5 J", "-", "-12 J", "-"]


def test_a_logarithmic_axis_accepts_zero():
    curves = curves_with({"newton_residual": [0.0, 1e-6, 3e-5, 1e-3]}, "residuals")
    assert curves.ends == ("1e-06", "0.001")
    assert np.allclose(curves.lines[0][1][:, 1], [0, 0, (np.log10(3e-5) + 6) / 3, 1])
    assert curves_with({"newton_residual": [0.0, 0.0]}, "residuals").ends == ("0.1", "1")
    wide = curves_with({"newton_residual": [1e-300, 1.0, np.nan]}, "residuals")
    assert wide.ends == ("1e-12", "1") and wide.lines[0][1][0, 1] == 0.0


@pytest.mark.parametrize("values", [[0.0], [0.0, 0.0], [np.nan, np.nan], [1e-320, 0.0], [1e300, -1e300], [-3.0]])
def test_curves_of_extreme_values_stay_in_the_unit_square(values):
    for name, quantity in (("energies", "total"), ("step_time", "step_time")):
        curves = curves_with({quantity: values}, name)
        for _, points in curves.lines:
            inside = points[np.isfinite(points).all(axis=1)]
            assert (inside >= 0).all() and (inside <= 1).all()
        assert all(0 < level < 1 for level in curves.grid)


def test_only_simulated_quantities_are_available():
    series = {
        (False, True): {
            "residuals": ["Newton", "contacts"],
            "iterations": ["Newton", "CG", "contacts"],
            "contacts": ["contacts"],
        },
        (False, False): {"residuals": ["Newton"], "iterations": ["Newton", "CG"]},
        (True, True): {"residuals": ["contacts"], "iterations": ["contacts"], "contacts": ["contacts"]},
        (True, False): {},
    }
    for (explicit, touching), expected in series.items():
        available = Plots(Stub(explicit, touching)).available()
        assert set(available) == {"energies", "step_time"} | set(expected)
        for name, names in expected.items():
            assert [s.name for s in available[name].series] == names
    with pytest.raises(SceneError, match=r"not available: contact forces are not modelled \(one body\); there are energies"):
        Plots(Stub(touching=False), ("contacts",))
    with pytest.raises(SceneError, match="not available: steps of velocity_verlet are explicit .* and contact forces"):
        Plots(Stub(True, False), ("residuals",))
    with pytest.raises(SceneError, match="plot 'energy' is unknown.*did you mean energies"):
        Plots(Stub(), ("energy",))


def test_the_key_hides_and_shows_again():
    sim = Stub()
    plots = Plots(sim)
    plots.toggle()
    assert plots.visible() == [name for name in PLOTS if name != "error"]  # a run without estimates
    plots.shown["residuals"] = False
    visible = plots.visible()
    plots.toggle()
    assert plots.visible() == []
    plots.toggle()
    assert plots.visible() == visible
    sim.plan = Stub(touching=False).plan
    assert "contacts" not in plots.visible()


def test_a_restart_clears_the_history():
    plots = filled(100)
    plots.restart()
    assert plots.history.times.tolist() == [0.0]
    plots.take(StepReport(time=0.5), 0.01)
    plots.take(StepReport(time=0.1), 0.01)  # the simulator was reset
    assert plots.history.times[-1] <= 0.1


@pytest.mark.parametrize("kind", [{}, {"explicit": True, "touching": False}])
@pytest.mark.parametrize("size", [(1280, 720), (800, 300), (300, 100)])
def test_plots_lie_in_the_window_without_overlap(kind, size):
    plots = filled(3 * CAPACITY // 2 - 1, **kind)
    shown = cells(plots, size)
    assert len(shown) == (len(plots.visible()) if size == (1280, 720) else 2 if size[0] == 800 else 0)
    boxes, ends, colours = drawing(shown, size)
    assert len(boxes) == len(shown) and len(ends) == len(colours) and len(ends) <= 2 * MAX_SEGMENTS
    assert np.isfinite(ends).all() and (ends >= 0).all() and (ends <= 1).all() and (boxes >= 0).all() and (boxes <= 1).all()
    gui = RecordingGui()
    write(gui, shown, (1280, 720))  # the initial size of the window
    assert len(set(gui.names)) == len(shown) and all(name.endswith(str(cell.text)) for name, cell in zip(gui.names, shown))
    for cell, place in zip(shown, gui.places):
        assert np.array(place) * (1280, 720, 1280, 720) == pytest.approx(cell.text)
    tops = [cell.box[1] for cell in shown]
    assert all(b >= a + cell.box[3] for a, b, cell in zip(tops, tops[1:], shown))
    for cell in shown:
        assert cell.text[0] + cell.text[2] == cell.box[0] and cell.contains(cell.box[0] + 1, cell.box[1] + 1)
        assert not cell.contains(cell.text[0] - 1, cell.box[1] + 1)
