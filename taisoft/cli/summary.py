"""What `taisoft run` prints: the plan, and a summary of the run at its end."""

import textwrap

from taisoft.cli.recording import Observers, Recording
from taisoft.display import PROBLEMS_SHOWN, percent
from taisoft.frame_steps import dt_sentence
from taisoft.records import ERROR_KINDS, ErrorEstimate, RunReport

WIDTH = 118  # of the terminal
KINDS = ("problem", "warning", "note")  # of entries of RunReport.problems, the most important first
MOST = 0.5  # fraction of a run's wall time above which the summary says what pictures cost


def print_plan(sim, verbose: bool) -> None:
    """Print which features the scene needs; verbose: why, and which are left out, which report.json says too."""
    on = [entry for entry in sim.plan.entries if entry["on"]]
    if not verbose:
        _print_lines("plan", [", ".join(entry["feature"] for entry in on)])
        return
    off = [entry["feature"] for entry in sim.plan.entries if not entry["on"]]
    width = max((len(entry["feature"]) for entry in on), default=0)
    _print_lines("plan", [f"{entry['feature']:<{width}}  {entry['why']}" for entry in on])
    _print_lines("left out", [", ".join(off) or "nothing"])


def print_state(sim) -> None:
    """Print time and energies of the simulator's current state."""
    _print_lines("time", [f"{sim.time:.6g} s simulated in {sim.step_count} steps of {sim.dt:.6g} s"])
    e = sim.energies()
    _print_lines("energy", [f"kinetic {e.kinetic:.6g} J, elastic {e.elastic:.6g} J, gravity {e.gravity:.6g} J"])


def print_summary(result: RunReport, sim, observers: Observers, recording: Recording | None) -> None:
    """Print status and a changed dt, problems, time, smallest volume ratio, energies, files."""
    print()
    changed = dt_sentence(result)
    early = ", ended early by a signal" if result.interrupted else ""
    _print_lines("status", [f"{result.status}{early}{changed and '; ' + changed}"])
    problems = [problem for problem in result.problems if not (changed and problem.startswith(f"note: {changed}"))]
    entries = sorted((_named(problem) for problem in problems), key=lambda entry: KINDS.index(entry[0]))
    for kind, text in entries[:PROBLEMS_SHOWN]:
        _print_lines(kind, [text])
    if len(entries) > PROBLEMS_SHOWN:
        _print_lines("", [f"and {len(entries) - PROBLEMS_SHOWN} more"])
    if result.error_estimate is not None:
        _print_lines("error", describe_error(result.error_estimate))
    for name, quantity in result.quantities.items():
        _print_lines("quantity", [f"{name} = {quantity}", *(note for note in quantity.notes if note not in result.problems)])
    print_state(sim)
    output = f"{observers.seconds:.2f} s of it for output"
    compiling = f"{result.compile_seconds:.2f} s for kernels"
    trials = f"{result.trial_seconds:.2f} s of trials and " if result.trial_seconds else ""
    companions = result.error_estimate.wall_seconds if result.error_estimate is not None else 0.0
    companions_text = f"{companions:.2f} s of companions for the error and " if companions else ""
    _print_lines("wall", [f"{result.wall_seconds:.2f} s, {output}; plus {trials}{companions_text}{compiling}"])
    if observers.picture_seconds > MOST * result.wall_seconds:
        share = f"{observers.picture_seconds:.2f} s of it, {observers.picture_seconds / result.wall_seconds:.0%}, for pictures"
        _print_lines("", [f"{share}: a lower --fps draws fewer, --no-frames none"])
    if result.step_reports:
        worst = min(result.step_reports, key=lambda report: report.min_volume_ratio)
        _print_lines("min J", [f"{worst.min_volume_ratio:.4g} at {worst.time:.4g} s, {worst.n_inverted} tets inverted"])
        divided = [report.substeps for report in result.step_reports if report.substeps > 1]
        if divided:
            _print_lines("substeps", [f"{len(divided)} steps were divided, into at most {max(divided)} substeps"])
    if recording is not None:
        _print_lines("files", recording.files())


def describe_error(estimate: ErrorEstimate) -> list[str]:
    """Return sentences on the error of a run, and the notes."""
    parts = {name: getattr(estimate, name) for name in ERROR_KINDS}
    known = {name: value for name, value in parts.items() if value is not None}
    listed = ", ".join(f"{name} {percent(value)}" for name, value in known.items())
    sentences = []
    if estimate.total is not None:
        on_mesh = "" if "space" in known else " on this mesh"
        sentences.append(f"about {percent(estimate.total)} % of the largest excursion{on_mesh} ({listed})")
    elif estimate.time_until_then is not None:
        until = f"until t = {estimate.agree_until:.4g} s"
        sentences.append(f"about {percent(estimate.time_until_then)} % in time {until}, then unknown")
        apart = max(estimate.spread_after.values())
        sentences.append(f"afterwards the mean positions of bodies change by up to {percent(apart)} % with the step")
    elif known:
        sentences.append(f"unknown in time; in percent of the largest excursion {listed}")
    return sentences + estimate.notes


def _named(problem: str) -> tuple[str, str]:
    """Return the kind of an entry of `RunReport.problems`, and its text."""
    kind, colon, text = problem.partition(": ")
    return (kind, text) if colon and kind in KINDS else (KINDS[0], problem)


def _print_lines(name: str, texts: list[str]) -> None:
    """Print texts in a column, the first one beside the name."""
    for index, text in enumerate(texts):
        first = f"{'' if index else name:<9}"
        print(textwrap.fill(text, WIDTH, initial_indent=first, subsequent_indent=" " * 9, break_long_words=False))
