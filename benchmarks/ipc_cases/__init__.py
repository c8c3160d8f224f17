"""The nine scenes of Li et al. 2020, "Incremental Potential Contact", remade from the parameters of their input files.

Each builder makes a scene in two sizes: "full" has about the published number of nodes, "small" is for tests. Meshes that are not
in a folder `shared/meshes` beside the repository are replaced by equivalent ones of the same size; where there is none, the case
is skipped. Published seconds a step: figure 23 of the paper, on another machine with many threads.
"""

from .case import Case
from .falling import FALLING
from .squeezed import ROUGH, SQUEEZED
from .twisted import TWISTED

CASES: tuple[Case, ...] = (*FALLING, *SQUEEZED, *TWISTED)
EXTRA: tuple[Case, ...] = (ROUGH,)  # only for the table of friction
NAMES: tuple[str, ...] = tuple(case.name for case in CASES)


def find(name: str) -> Case:
    """The case of that name."""
    return next(case for case in (*CASES, *EXTRA) if case.name == name)
