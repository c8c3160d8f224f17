"""Output of `taisoft run` on the terminal: the plan before the run, one screen of results after it."""

import textwrap

from taisoft.cli.recording import Observers, Recording
from taisoft.records import RunReport
from taisoft.running import dt_sentence

WIDTH = 118
PROBLEMS_SHOWN = 5


def print_plan(sim) -> None:
    """Print which features the scene needs, and why; report.json also says why the others are left out."""
    on = [entry for entry in sim.plan.entries if entry["on"]]
    off = [entry["feature"] for entry in sim.plan.entries if not entry["on"]]
    width = max((len(entry["feature"]) for entry in on), default=0)
    for entry in on:
        _line("plan" if entry is on[0] else "", f"{entry['feature']:<{width}}  {entry['why']}")
    _line("left out", ", ".join(off) or "nothing")


def print_state(sim) -> None:
    """Print time and energies of the simulator's current state."""
    _line("time", f"{sim.time:.6g} s simulated in {sim.step_count} steps of {sim.dt:.6g} s")
    e = sim.energies()
    _line("energy", f"kinetic {e.kinetic:.6g} J, elastic {e.elastic:.6g} J, gravity {e.gravity:.6g} J")


def print_summary(result: RunReport, sim, observers: Observers, recording: Recording | None) -> None:
    """Print status and a changed dt, problems, time, smallest volume ratio, energies, files."""
    print()
    changed = dt_sentence(result)
    early = ", ended early by a signal" if result.interrupted else ""
    _line("status", f"{result.status}{early}{changed and '; ' + changed}")
    problems = [problem for problem in result.problems if not (changed and problem.startswith(f"note: {changed}"))]
    for problem in problems[:PROBLEMS_SHOWN]:
        _line("problem", problem)
    if len(problems) > PROBLEMS_SHOWN:
        _line("", f"and {len(problems) - PROBLEMS_SHOWN} more problems")
    print_state(sim)
    wall, output = result.wall_seconds, observers.seconds
    _line("wall", f"{wall:.2f} s, {output:.2f} s of it for output; plus {result.compile_seconds:.2f} s to compile")
    if result.step_reports:
        worst = min(result.step_reports, key=lambda report: report.min_volume_ratio)
        _line("min J", f"{worst.min_volume_ratio:.4g} at {worst.time:.4g} s, {worst.n_inverted} tets inverted")
        divided = [report.substeps for report in result.step_reports if report.substeps > 1]
        if divided:
            _line("substeps", f"{len(divided)} steps were divided, into at most {max(divided)} substeps")
    if recording is not None:
        for index, text in enumerate(recording.files()):
            _line("" if index else "files", text)


def _line(name: str, text: str) -> None:
    indent = " " * 9
    print(textwrap.fill(text, WIDTH, initial_indent=f"{name:<9}", subsequent_indent=indent, break_long_words=False))
