"""Data into fields, many fields by one kernel: compiling one for each, as `from_numpy` does, takes 0.05 s and more apiece."""

import numpy as np
import taichi as ti

MOST = 2**28  # entries in one launch, which are held once more as f64


@ti.kernel
def _write(
    fields: ti.template(), shapes: ti.template(), types: ti.template(), starts: ti.types.ndarray(), data: ti.types.ndarray()
):  # fmt: skip
    """Entries of each field from data, row by row from starts[k] on. shapes: with the number of components, 0 for scalars."""
    for k in ti.static(range(len(fields))):
        shape, n = ti.static(shapes[k][:-1], shapes[k][-1])
        for row in range(shape[0]):
            if ti.static(n > 0):
                for c in ti.static(range(n)):
                    fields[k][row][c] = ti.cast(data[starts[k] + row * n + c], types[k])
            elif ti.static(len(shape) == 1):
                fields[k][row] = ti.cast(data[starts[k] + row], types[k])
            else:
                for column in range(shape[1]):
                    fields[k][row, column] = ti.cast(data[starts[k] + row * shape[1] + column], types[k])


def upload(pairs: list[tuple]) -> None:
    """pairs: field of one or two dimensions, and an array of its shape, and of its components where it has any."""
    together, alone = [], []
    for field, data in pairs:
        (together if data.size and len(field.shape) <= 2 else alone).append((field, data))
    if len(together) < 2 or sum(data.size for _, data in together) > MOST:
        together, alone = [], pairs
    for field, data in alone:
        field.from_numpy(data)
    if not together:
        return
    starts = np.concatenate([[0], np.cumsum([data.size for _, data in together])])[:-1].astype(np.int32)
    flat = np.concatenate([np.asarray(data, dtype=np.float64).ravel() for _, data in together])
    shapes = tuple((*field.shape, getattr(field, "n", 0)) for field, _ in together)
    _write(tuple(f for f, _ in together), shapes, tuple(f.dtype for f, _ in together), starts, flat)
