"""The folder of a study: its finished runs in runs/, study.md, study.csv, study.json and, with matplotlib, study.png.

Finished runs are JSON files, complete or absent, named by a key: a digest of everything that a run depends on (see `code_digest`,
`sources` and `Runner._key`). A file holds its record and the record's digest; a damaged file is reported and its run repeated.

The picture shows error against time on log axes, with the Pareto front, the tolerance and the references' own errors.
"""

import hashlib
import json
import sys
import sysconfig
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np

from taisoft import __version__
from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.machine import versions
from taisoft.output.files import make_folder
from taisoft.output.report import json_text
from taisoft.output.tables import require_matplotlib, save, ticks
from taisoft.study.accuracy import Row
from taisoft.study.results import Study, csv_of, plain_of, text_of

RUNS = "runs"
KIND, FORMAT = "taisoft study run", 1
PACKAGE = Path(__file__).resolve().parents[1]
NOT_COMPUTING = ("cli", "view", "output", "study")  # folders of the package that results do not depend on
COMPUTING = ("study/measure.py",)  # except these
FILES = ("study.md", "study.csv", "study.json", "study.png")
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c564b", "#555555")
MARKERS = {
    "symplectic_euler": "v",
    "velocity_verlet": "^",
    "linearly_implicit_euler": "D",
    "implicit_euler": "o",
    "bdf2": "s",
    "implicit_midpoint": "P",
}
REFERENCE = {"color": "#222222", "lw": 1.4, "ls": ":"}  # lines of the references' own errors
SIZE = (7.4, 5.4)  # [inch]
# Axes shown by colour if they vary, and their labels
COLOUR_AXES = {"refine": "refine {}", "order": "order {}", "precision": "{}", "contact_solver": "{}", "arch": "{}"}
MAX_LABELS = 8  # labelled points of the front
MAX_ERROR_RATIO = 100.0  # of the smallest error to a reference's own, above which the latter is not shown
OUTSIDE = 1e9  # beyond every axis


def code_digest(besides: Iterable[str] = ()) -> str:
    """Return a digest of the files of taisoft that results depend on and of the versions of taisoft, Taichi and NumPy.

    besides: further folders of the package that the results do not depend on.
    """
    ignored = {*NOT_COMPUTING, *besides}
    found = versions("taichi", "numpy")
    total = hashlib.sha256(f"{__version__} {found['taichi']} {found['numpy']}".encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if name in COMPUTING or name.split("/")[0] not in ignored:
            total.update(name.encode() + path.read_bytes())
    return total.hexdigest()


def sources(path: Path) -> dict[str, str]:
    """Return digests of a scene file and of modules loaded from its folder, by relative path, without installed packages."""
    path = path.absolute()
    installed = [PACKAGE, *(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib"))]
    loaded = {Path(file).absolute() for module in list(sys.modules.values()) if (file := getattr(module, "__file__", None))}
    own = (one for one in loaded if path.parent in one.parents and not any(place in one.parents for place in installed))
    names = sorted(one.relative_to(path.parent).as_posix() for one in {path, *own})
    return digests(path, names)


def digests(path: Path, names: Iterable[str]) -> dict[str, str]:
    """Return digests of the named files in the folder of a scene file; empty for one that cannot be read."""
    found = dict.fromkeys(names, "")
    for name in found:
        with suppress(OSError):
            found[name] = hashlib.sha256((path.parent / name).read_bytes()).hexdigest()
    return found


def digest(values) -> str:
    """Return the SHA-256 digest of plain data."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


class Store:
    """Finished runs in a study's folder, which the caller has locked. damaged: sentences on files that could not be used."""

    def __init__(self, folder: Path):
        self._folder = make_folder(folder / RUNS)
        for part in (*self._folder.glob("*.part"), *folder.glob("study.*.part")):
            with suppress(OSError):  # left by a study that was killed; harmless if it cannot be removed
                part.unlink()
        self.damaged: list[str] = []

    def read(self, key: str) -> dict | None:
        """Return the record with this key, or None if it is absent or damaged."""
        path = self._folder / f"{key}.json"
        try:
            content = json.loads(path.read_bytes())
            if (content["kind"], content["format"]) != (KIND, FORMAT) or content["key"] != key:
                raise ValueError("it has another kind, format or key")
            if content["sha256"] != digest(content["record"]):
                raise ValueError("its digest does not match its content")
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            self.damaged.append(f"{path} is damaged and its run is repeated: {reason}")
            return None
        return content["record"]

    def write(self, key: str, record: dict) -> dict:
        """Save a record; return it as it will be read back. Raises OutputError."""
        plain = json.loads(json_text(record))  # numbers that are not finite become null, here as in the file
        content = {"kind": KIND, "format": FORMAT, "key": key, "sha256": digest(plain), "record": plain}
        write_bytes(self._folder / f"{key}.json", json.dumps(content).encode())
        return plain


class NoStore:
    """Store of a study without a folder: keeps nothing."""

    damaged: list[str] = []

    def read(self, key: str) -> None:
        """Return None."""

    def write(self, key: str, record: dict) -> dict:
        """Return the record as Store.write does."""
        return json.loads(json_text(record))


def check_scene(folder: Path, scene: str) -> None:
    """Raise OutputError if the folder holds a study of a scene with another digest."""
    try:
        found = json.loads((folder / "study.json").read_bytes())
        name, same = found["request"]["scene"], found["scene_digest"] == scene
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise OutputError(f"the folder {folder} holds a study.json not written by this version: name another folder") from error
    if not same:
        raise OutputError(f"the folder {folder} holds a study of another scene ({name}, with other content): name another folder")


def write(study: Study, folder: Path) -> str:
    """Write all files. Return a sentence if there is no picture, else an empty text. Raises OutputError."""
    write_bytes(folder / "study.md", text_of(study).encode())
    write_bytes(folder / "study.csv", csv_of(study).encode())
    write_bytes(folder / "study.json", json_text(plain_of(study)).encode())
    picture = folder / "study.png"
    try:
        require_matplotlib("study.png")
    except OutputError as error:
        reason = str(error)
    else:
        if rows := study.comparable_rows():
            _draw(study, rows, picture)
            return ""
        reason = "study.png is not drawn, because no setting has both a time and an error"
    try:
        picture.unlink(missing_ok=True)  # from an earlier study: the folder holds only one
    except OSError as error:
        raise OutputError(f"cannot remove the earlier {picture}: {error.strerror or error}") from error
    return reason


def _draw(study: Study, rows: list[Row], path: Path) -> None:
    """Write study.png. rows: the comparable ones, at least one."""
    from matplotlib import pyplot

    by, tolerance = study.request.by, study.request.tolerance
    figure, panel = pyplot.subplots(figsize=SIZE, layout="constrained")
    smallest, largest = (limit(row.resolved_error(by) for row in rows) for limit in (min, max))
    own_errors = sorted({row.error(by)[1] for row in rows})
    shown = [error for error in own_errors if error > smallest / MAX_ERROR_RATIO]
    _draw_front(panel, study)
    panel.axhline(tolerance, color="#555555", lw=0.9, ls="--", zorder=1, label=f"tolerance {tolerance:g}")
    for k, error in enumerate(shown):
        panel.axhline(error, **REFERENCE, zorder=1, label="reference's own error" if k == 0 else None)
    if not shown:
        panel.plot([], [], **REFERENCE, label=f"reference's own error:\n{own_errors[-1]:.1g}, far below")
    _draw_points(panel, study, rows)
    _label_front(panel, study)
    times = [x for row in rows for x in np.percentile(row.seconds, (25, 75))]
    low, high = min(smallest, tolerance, *shown), max(largest, tolerance, *shown)
    panel.set(xscale="log", yscale="log", xlim=(min(times) / 1.6, max(times) * 1.9), ylim=(low / 2.0, high * 2.0))
    ticks(panel.xaxis, max(times) / min(times))
    ticks(panel.yaxis, high / low)
    space = "relative to the finest mesh, " if study.space is not None else ""
    panel.set_xlabel("wall time per simulated second [s], median; bars: quartiles")
    panel.set_ylabel(f"error in position ({space}{by}, over the largest excursion)")
    panel.set_title(Path(study.request.scene).stem)
    panel.grid(True, which="major", color="#eeeeee")
    panel.set_axisbelow(True)
    panel.legend(fontsize="small", frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)


def _draw_front(panel, study: Study) -> None:
    """Plot the front as steps: vertical before the first point, horizontal after the last."""
    times, errors = zip(*((row.timing.median, row.resolved_error(study.request.by)) for row in study.front()))
    corners = [times[0], *times, OUTSIDE], [OUTSIDE, *errors, errors[-1]]
    panel.step(*corners, where="post", color="#999999", lw=1.2, zorder=1, label="Pareto front")


def _label_front(panel, study: Study) -> None:
    """Label points of the front with their time step, at most MAX_LABELS of them."""
    front = study.front()
    for row in front[:: -(-len(front) // MAX_LABELS)]:
        place = (row.timing.median, row.resolved_error(study.request.by))
        text = f"{1e3 * row.setting['dt']:.3g} ms"
        box = {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 0.5}
        panel.annotate(text, place, (5, 7), textcoords="offset points", fontsize=7, color="#333333", bbox=box)


def _draw_points(panel, study: Study, rows: list[Row]) -> None:
    """Plot one series per integrator and kind: marker by integrator, colour by kind, or by integrator if there is one kind."""
    varying = {key: label for key, label in COLOUR_AXES.items() if len({row.setting[key] for row in rows}) > 1}

    def kind_of(row: Row) -> str:
        return ", ".join(label.format(row.setting[key]) for key, label in varying.items())

    integrators = list(dict.fromkeys(row.setting["integrator"] for row in rows))
    kinds = list(dict.fromkeys(map(kind_of, rows)))
    for kind in kinds:
        for integrator in integrators:
            series = [row for row in rows if row.setting["integrator"] == integrator and kind_of(row) == kind]
            series.sort(key=lambda row: row.setting["dt"])
            colour = COLOURS[(kinds.index(kind) if len(kinds) > 1 else integrators.index(integrator)) % len(COLOURS)]
            places = [row.timing.median for row in series], [row.resolved_error(study.request.by) for row in series]
            panel.plot(*places, color=colour, lw=0.8, alpha=0.4, zorder=1)
            for status, fill, suffix in (("ok", colour, ""), ("degraded", "white", " (degraded)")):
                if selected := [row for row in series if row.status == status]:
                    label = ", ".join(filter(None, (integrator, kind))) + suffix
                    _draw_series(panel, study, selected, color=colour, mfc=fill, marker=MARKERS.get(integrator, "X"), label=label)


def _draw_series(panel, study: Study, rows: list[Row], **style) -> None:
    middle = [row.timing.median for row in rows]
    bars = np.transpose([np.abs(np.percentile(row.seconds, (25, 75)) - row.timing.median) for row in rows])
    errors = [row.resolved_error(study.request.by) for row in rows]
    panel.errorbar(middle, errors, xerr=bars, ls="none", ms=6, elinewidth=1.0, capsize=2, **style)
