"""The tables of `cuda_check.py`, one a part."""

from collections import Counter

from taisoft.output.tables import markdown


def part_text(title: str, name: str, ended: str, seconds: float, found: list[dict], tail: str) -> str:
    """A part of the page. tail: what its process printed last, where it failed."""
    head = f"## {title}\n\nEnded: {ended}, {seconds:.0f} s."
    body = TABLES[name](found) if found else "It found nothing."
    return "\n\n".join([head, body, *([f"```\n{tail}\n```"] if tail else [])])


def _tests(found: list[dict]) -> str:
    counts = Counter(one["result"] for one in found)
    bad = [f"* {one['test']}: {one['result']}" for one in found if one["result"] != "passed"]
    return "\n".join([", ".join(f"{n} {what}" for what, n in sorted(counts.items())) + ".", *(["", *bad] if bad else [])])


def _number(value: float | None, form: str = ".3g") -> str:
    return "" if value is None else f"{value:{form}}"


def _works(found: list[dict]) -> str:
    rows = []
    for one in found:
        if "failure" in one:
            rows.append((one["work"], f"{one['tets']:,}", one["setting"], one["arch"], one["failure"], "", "", "", ""))
            continue
        error = f"{100 * one['error']:.2g} %" if one["error"] is not None else "stands" if one["stands"] else "does not stand"
        rows.append(
            (
                one["work"],
                f"{one['tets']:,}",
                one["setting"],
                one["arch"],
                _number(one["seconds"]),
                error,
                str(one["inverted"]),
                str(one["unconverged"]),
                _number(one["build_seconds"]),
            )
        )
    headings = ("work", "tets", "setting", "arch", "s/sim. s", "error", "inverted", "unconverged", "build [s]")
    return markdown(headings, rows, left=(0, 2, 3))


def _sweeps(found: list[dict]) -> str:
    rows = [
        (
            f"{one['contacts']:,}",
            str(one["colours"]),
            _number(one["serial_ms"]),
            _number(one["coloured_ms"]),
            _number(one["serial_ms"] / one["coloured_ms"]),
            str(one["serial_sweeps"]),
            str(one["coloured_sweeps"]),
            _number(max(one["serial_residual"], one["coloured_residual"]), ".1e"),
        )
        for one in found
    ]
    headings = ("contacts", "colours", "serial [ms]", "coloured [ms]", "serial / coloured", "sweeps", "coloured", "residual")
    return markdown(headings, rows)


def _sizes(found: list[dict]) -> str:
    rows = []
    for one in found:
        cells = [f"{one['tets']:,}", one["integrator"]]
        if "failure" in one:
            rows.append((*cells, one["failure"], "", "", "", "", "", ""))
            continue
        per_tet = 1e6 * one["step_ms"] / one["tets"]
        rows.append(
            (
                *cells,
                _number(one["step_ms"]),
                _number(per_tet),
                f"{one['newton']}/{one['linear']}",
                str(one["unconverged"]),
                _number(one["field_bytes"] / 2**20, ".0f"),
                _number(one["build_seconds"]),
                _number(one["compile_seconds"]),
            )
        )
    headings = (
        "tets",
        "integrator",
        "step [ms]",
        "ns/tet",
        "Newton/CG",
        "unconverged",
        "fields [MiB]",
        "build [s]",
        "compile [s]",
    )
    return markdown(headings, rows, left=(1,))


def _reruns(found: list[dict]) -> str:
    rows = [(one["scene"], one["integrator"], str(one["reruns"]), _number(one["spread"], ".1e")) for one in found]
    return markdown(("scene", "integrator", "runs", "largest difference / excursion"), rows, left=(0, 1))


TABLES = {"tests": _tests, "works": _works, "sweeps": _sweeps, "sizes": _sizes, "reruns": _reruns}
