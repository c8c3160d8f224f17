"""The errors a user can meet. Each message is one sentence: the thing, the index, the rule it breaks."""


class TaisoftError(Exception):
    """Base of every error that taisoft raises on purpose."""


class MeshError(TaisoftError):
    """A mesh, or a file that should hold one, breaks a rule."""


class SceneError(TaisoftError):
    """A scene, a material or a setting breaks a rule."""


class OutputError(TaisoftError):
    """A result could not be written."""


class SimulationError(TaisoftError):
    """A run cannot start, or a step failed; the state is the last good one."""


def no_memory(what: str, error: MemoryError) -> SimulationError:
    """The SimulationError for a MemoryError, whose text tells how much was asked for where NumPy raised it."""
    from taisoft.memory import available_memory, format_bytes  # a rare case, in a module that everything imports

    asked = str(error).rstrip(".") or "the system gave no more"
    return SimulationError(f"not enough memory for {what}: {asked}; available: {format_bytes(available_memory())}")
