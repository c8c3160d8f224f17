"""The GPU path: what its steps launch and read, and on a GPU what that costs, beside the estimates of its design.

taisoft bench gpu [--arch cuda|cpu] [--only PART ...] [--quick] [--budget SECONDS] [--keep DIR] [--out [FILE.json]]

On a GPU it takes at most eight minutes, and starts with what tells most. Each part runs in a process of its own with a time
limit, which what earlier parts have left over extends; results before a failure remain. FILE.json and its page are rewritten
after every part. On the CPU, the default where there is no GPU, the parts that need no clock of a device take the GPU path there.
Exit status: 0, or 1 if a part failed or did not end, or a count is above its limit. benchmarks/gpu.sh installs the requirements
from wheels first.
"""

import shutil
import subprocess
import sys
import time

from taisoft.cli.doctor import cuda
from taisoft.errors import OutputError

from .document import RESULTS, Limit, begin, newest, rows_table
from .gpu_parts import PARTS, Part, answer
from .suite import LEFT_OUT, UNFINISHED, chosen, runs_of, suite_options, suite_parser

BUDGET = 470.0  # seconds for all parts: ten less than eight minutes
PACKAGES = ("taichi", "numpy", "scipy", "meshio")


def gpu_name() -> str:
    """Name, memory and driver of the GPU as nvidia-smi prints them; "no nvidia-smi" without it."""
    if shutil.which("nvidia-smi") is None:
        return "no nvidia-smi"
    query = ("nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader")
    try:
        done = subprocess.run(query, capture_output=True, text=True, timeout=20, check=False)
    except subprocess.TimeoutExpired:
        return "nvidia-smi does not answer"
    return "; ".join((done.stdout or done.stderr).strip().splitlines()[:4])


def not_run() -> str:
    """That this is no run on a device, and when there was one."""
    text = "Not run on a device: the CPU took the GPU path, and nothing here is a time of a GPU."
    try:
        last = newest(RESULTS, "gpu", "cuda")
    except OutputError:
        return text
    return f"{text} It was last run on a device on {last['date'][:10]}: {last['gpu']}."


def section(part: Part, record: dict) -> str:
    """A part of the page."""
    rows = record.get(UNFINISHED, record).get("rows")
    notes = [f"Left out: {record[LEFT_OUT]}."] if LEFT_OUT in record else []
    return "\n\n".join([f"## {part.title}", rows_table(rows) if rows else "It found nothing.", *notes])


def count_limits(rows: list[dict]) -> list[Limit]:
    """Limits on what is counted."""
    return [Limit(f"{what}, {row['of']}", row[what], row[f"{what} at most"]) for row in rows for what in ("launches", "accesses")]


def main(argv=None) -> int:
    """Run the parts and write the page after each. Raises OutputError."""
    parser = suite_parser("gpu", __doc__, "small sizes, no limits")
    where = "cuda" if cuda().startswith("yes") else "cpu"
    parser.add_argument("--arch", choices=("cpu", "cuda"), default=where, help=f"where to compute (here {where})")
    parser.set_defaults(budget=BUDGET)
    options = suite_options(parser, argv, answer, arch=False)
    parts = {name: one for name, one in PARTS.items() if options.arch == "cuda" or options.only != [""] or one.counts}
    parts = chosen(parser, options.only, parts)
    document, numbers = begin("The GPU path", f"arch {options.arch}", packages=PACKAGES)
    numbers |= {"arch": options.arch, "quick": options.quick, "gpu": gpu_name(), "parts": []}
    document.add(numbers["gpu"] if options.arch == "cuda" else not_run())
    limits: list[Limit] = []
    with runs_of("gpu", options, "gpu*.py", "contact_*.py", "scaling_bytes.py", "kinds.py") as runs:
        for k, (name, part) in enumerate(parts.items()):
            later = sum(one.seconds for one in list(parts.values())[k + 1 :])
            request = {"part": name, "arch": options.arch, "quick": options.quick}
            seconds = max(part.seconds, runs.end - time.monotonic() - later)
            (record,) = runs.records({name: request}, lambda record: f"{record['seconds']:.0f} s", seconds)
            document.add(section(part, record))
            numbers["parts"].append({"part": name, "title": part.title} | record.get(UNFINISHED, record))
            if name == "counts" and LEFT_OUT not in record and not options.quick:
                limits = count_limits(record["rows"])
            if options.out:
                document.write(options.out, numbers)
    return runs.finish(document, options, numbers, limits)


if __name__ == "__main__":
    sys.exit(main())
