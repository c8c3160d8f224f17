"""The results of `run_many`: a row for each mapping of parameters, and columns by name."""

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from taisoft.errors import SceneError, listed, one_line
from taisoft.files import write_bytes
from taisoft.many.store import digest
from taisoft.output.tables import csv_text, markdown
from taisoft.scene.checks import nearest

ROWS_SHOWN = 20
LEFT_OUT = "left out"


@dataclass(frozen=True, eq=False)
class Row:
    """One run of `run_many`."""

    parameters: dict  #: arguments of `make`
    status: str = LEFT_OUT  #: "ok", "degraded", "failed" or "left out"
    problems: list[str] = field(default_factory=list)  #: sentences: of the RunReports, of an exception, warnings
    values: dict = field(default_factory=dict)  #: numbers, texts and None that `make` returned
    arrays: dict[str, np.ndarray] = field(default_factory=dict, repr=False)  #: that it returned
    wall_seconds: float = math.nan  #: of the call of `make`, with what it compiled [s]

    def to_dict(self) -> dict:
        """Return the row of the table: parameters, status, wall time, values and problems."""
        own = {"status": self.status, "wall_seconds": self.wall_seconds}
        return self.parameters | own | self.values | {"problem": "; ".join(self.problems)}


class Results(Sequence):
    """Rows in the order of the parameters: `results[3]` is a `Row`, `results["force"]` a column, a NumPy array (n,).

    A column holds a parameter, a number or text that `make` returned, `status`, `problem` or `wall_seconds`; where a row has
    no number there is nan, no text None. notes: sentences on the whole, such as rows that were run again.
    """

    def __init__(self, rows: Sequence[Row], notes: Sequence[str] = ()):
        self.rows, self.notes = tuple(rows), list(notes)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int | slice | str):
        return self.column(index) if isinstance(index, str) else self.rows[index]

    @property
    def names(self) -> list[str]:
        """Names of the columns: parameters, status, wall time, what `make` returned, problem."""
        kinds = ("parameters", "values")
        parameters, values = ([name for row in self.rows for name in getattr(row, kind)] for kind in kinds)
        return list(dict.fromkeys([*parameters, "status", "wall_seconds", *values, "problem"]))

    def column(self, name: str) -> np.ndarray:
        """Return a column (n,). Raises SceneError for an unknown name."""
        if name not in self.names:
            is_array = any(name in row.arrays for row in self.rows)
            other = f": results.arrays('{name}') returns its arrays" if is_array else nearest(name, self.names)
            raise SceneError(f"no column is called '{name}'{other}; there are {listed(self.names)}")
        found = [row.to_dict().get(name) for row in self.rows]
        large = None in found and any(isinstance(one, int) and abs(one) > 2**53 for one in found)  # that a float would change
        if large or any(isinstance(one, str | list | dict) for one in found) or all(one is None for one in found):
            column = np.empty(len(found), object)
            column[:] = found
            return column
        return np.array([math.nan if one is None else one for one in found])

    def arrays(self, name: str) -> list[np.ndarray | None]:
        """Return the arrays of this name, None for rows without. Raises SceneError if no row has one."""
        if not (known := {known for row in self.rows for known in row.arrays}) & {name}:
            raise SceneError(f"no row has an array called '{name}'; there are {listed(sorted(known)) or 'none'}")
        return [row.arrays.get(name) for row in self.rows]

    def counts(self) -> dict[str, int]:
        """Return how many rows have each status."""
        return dict(Counter(row.status for row in self.rows))

    def to_dicts(self) -> list[dict]:
        """Return the rows of the table, which pandas.DataFrame takes."""
        return [dict.fromkeys(self.names) | row.to_dict() for row in self.rows]

    def write(self, path: str | Path) -> None:
        """Write the table as CSV. Raises OutputError."""
        write_bytes(path, csv_text([self.names, *(row.values() for row in self.to_dicts())]).encode(errors="backslashreplace"))

    def digest(self) -> str:
        """Return a SHA-256 digest of all bits of parameters, status, values and arrays, whatever the order of the rows."""
        parts = []
        for row in self.rows:
            total = hashlib.sha256(digest([row.parameters, row.status, row.values]).encode())
            for name, array in row.arrays.items():
                total.update(repr((name, array.dtype.str, array.shape)).encode() + array.tobytes())
            parts.append(total.hexdigest())
        return digest(sorted(parts))

    def __repr__(self) -> str:
        """What became of the runs, the first rows, and the first that failed."""
        counts = ", ".join(f"{n} {status}" for status, n in self.counts().items())
        names = [name for name in self.names if name != "problem" or any(row.problems for row in self.rows)]
        failed = [k for k, row in enumerate(self.rows) if row.status == "failed" and k >= ROWS_SHOWN][:ROWS_SHOWN]
        shown, all_rows = [*range(min(len(self), ROWS_SHOWN)), *failed], self.to_dicts()
        rows = [[_cell(all_rows[k].get(name)) for name in names] for k in shown]
        more = [f"and {len(self) - len(shown)} more rows"] if len(self) > len(shown) else []
        left = [k for k, name in enumerate(names) if name in ("status", "problem")]
        table = [markdown(names, rows, left)] if self.rows else []
        return "\n".join([f"Results of {len(self)} runs: {counts}", *self.notes, *table, *more])


def _cell(value) -> str:
    return "" if value is None or value != value else f"{value:.6g}" if isinstance(value, float) else one_line(str(value))
