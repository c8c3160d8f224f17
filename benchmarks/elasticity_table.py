"""Limits that are met or not, and their table."""

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass

from taisoft.output.tables import markdown, percent


@dataclass(frozen=True)
class Limit:
    """A number beside its limit. spread: of the number, relative; None for one that does not vary. at_least: a lower limit."""

    what: str
    value: float
    limit: float
    spread: float | None = None
    at_least: bool = False

    @property
    def met(self) -> bool:
        """Whether the number keeps the limit; one that is not a number never does."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit

    @property
    def close(self) -> bool:
        """Whether the spread is as large as the distance to the limit: another run may tell otherwise."""
        return self.spread is not None and abs(self.value - self.limit) <= self.spread * abs(self.value)

    def record(self) -> dict:
        """As plain data."""
        return asdict(self) | {"met": self.met, "close": self.close}

    def row(self) -> tuple[str, ...]:
        """Cells of limit_table."""
        verdict = ("met" if self.met else "NOT met") + (", within the spread" if self.close else "")
        sign = ">=" if self.at_least else "<="
        return self.what, f"{self.value:.4g}", percent(self.spread), f"{sign} {self.limit:.4g}", verdict


def limit_table(limits: Iterable[Limit]) -> str:
    """A row a limit."""
    return markdown(("limit", "measured", "spread", "wanted", "verdict"), [x.row() for x in limits], left=(0, 3, 4))


def slug(text: str) -> str:
    """The text as part of a file's name: lower case, trade marks dropped, everything else but letters and digits a dash."""
    text = re.sub(r"\((r|tm|c)\)", "", text.lower())
    return re.sub(r"[^a-z0-9]+", "-", text).strip("-")
