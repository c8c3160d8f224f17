"""Trains the hopper of docs/tutorials/gym.md, which takes minutes, and writes docs/tutorials/hopper.json."""

import json
import re
import sys
import time
from pathlib import Path

import numpy as np

from taisoft.files import write_bytes

HERE = Path(__file__).parent
STORED = HERE / "tutorials" / "hopper.json"


def program() -> dict:
    """Run the page's Python but the call of the search; return its names."""
    blocks = re.findall(r"```python\n(.*?)```", (HERE / "tutorials" / "gym.md").read_text(), re.S)
    names: dict = {}
    exec("\n".join(blocks).partition("\ncurve, mean = ")[0], names)
    return names


def main(generations: int) -> None:
    begin = time.perf_counter()
    curve, mean = program()["search"](generations)
    minutes = (time.perf_counter() - begin) / 60
    record = {"minutes": round(minutes, 1), "curve": np.round(curve, 4).tolist(), "mean": np.round(mean, 6).tolist()}
    write_bytes(STORED, json.dumps(record).encode())


if __name__ == "__main__":
    main(int(sys.argv[1]))
