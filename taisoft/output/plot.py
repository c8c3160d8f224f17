"""Helpers for matplotlib plots: import of the optional package, axis ticks, and writing of PNG files."""

import io
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.output.files import write_bytes


def require_matplotlib(what: str = "--plot"):
    """Return the matplotlib module. what: the feature that needs it. Raises OutputError if it is missing."""
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
    """Label a logarithmic axis with plain numbers at powers of ten, and between them if the axis spans few decades.

    ratio: upper over lower limit of the axis.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0,) if ratio > 300.0 else (1.0, 3.0) if ratio > 30.0 else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def log_ticks(panel) -> None:
    """Apply `ticks` to the logarithmic axes of a panel, by their present limits."""
    for axis, (low, high) in ((panel.xaxis, panel.get_xlim()), (panel.yaxis, panel.get_ylim())):
        if axis.get_scale() == "log":
            ticks(axis, high / low)
