"""Plots by matplotlib, which is an extra: looked for, labelled and written in one way."""

import io
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.output.files import write_bytes


def require_matplotlib(what: str = "--plot"):
    """The module. what: needs it. Raises OutputError where it is missing."""
    try:
        import matplotlib
    except ImportError:
        raise OutputError(f"{what} needs the package matplotlib, which is missing: pip install 'taisoft[plot]'") from None
    matplotlib.use("Agg")
    return matplotlib


def save(figure, path: Path, dpi: int = 130) -> None:
    """Write a figure as PNG and close it. Raises OutputError."""
    from matplotlib import pyplot

    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=dpi)
    pyplot.close(figure)
    write_bytes(path, picture.getvalue())


def ticks(axis, ratio: float) -> None:
    """Plain numbers at powers of ten, and between them too where the axis spans few."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0,) if ratio > 300.0 else (1.0, 3.0) if ratio > 30.0 else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def log_ticks(panel) -> None:
    """`ticks` of those axes of a panel that are logarithmic, by their present limits."""
    for axis, (least, most) in ((panel.xaxis, panel.get_xlim()), (panel.yaxis, panel.get_ylim())):
        if axis.get_scale() == "log":
            ticks(axis, most / least)
