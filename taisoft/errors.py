"""Errors that users can get. Each message is one sentence: the object, the index, the rule it breaks."""


class TaisoftError(Exception):
    """Base of every error that taisoft raises on purpose."""


class MeshError(TaisoftError):
    """A mesh, or a file that should hold one, breaks a rule."""


class SceneError(TaisoftError):
    """A scene, a material or a setting breaks a rule."""


class OutputError(TaisoftError):
    """A result could not be written."""


class SimulationError(TaisoftError):
    """A run cannot start, or a step failed; the state stays the last good one."""


def no_memory(what: str, error: MemoryError) -> SimulationError:
    """Return the SimulationError for a MemoryError; NumPy's text gives the requested size."""
    from taisoft.machine import available_memory, format_bytes  # rarely needed, and every module imports this one

    reason = str(error).rstrip(".") or "the system refused more"
    return SimulationError(f"not enough memory for {what}: {reason}; available: {format_bytes(available_memory())}")
