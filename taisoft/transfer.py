"""Arrays into fields and back: on the CPU through the fields' own memory, elsewhere many by one kernel.

Compiling one kernel for each, as Taichi does, takes 0.08 s and more apiece. Where a tree of fields lies, one small kernel
tells; where each field lies in it, Taichi's layout does. This rests on 1.7.4, the version that taisoft asks for.
"""

import ctypes
import weakref

import numpy as np
import taichi as ti
from taichi.lang import impl

from taisoft.runtime import check_program, kernel

MOST = 2**26  # entries in one launch, which are held once more as f64: half a GB
DTYPES = {ti.f32: np.float32, ti.f64: np.float64, ti.i32: np.int32, ti.u8: np.uint8}  # each exact in f64

_places: "weakref.WeakKeyDictionary" = weakref.WeakKeyDictionary()  # field -> its place, on the CPU


class _Tree:
    """Fields placed together; where they lie is found when one of them is first moved."""

    def __init__(self, fields: list):
        self._first = weakref.ref(fields[0])
        self._program = impl.get_runtime().prog
        self._start: int | None = None

    @property
    def start(self) -> int:
        """Its address. Raises SimulationError where it is no more."""
        check_program(self._program)
        if self._start is None:
            first = self._first()
            self._start = _address(first, (0,) * len(first.shape)) - _offset(first)
        return self._start


class _Place:
    def __init__(self, tree: _Tree):
        self._tree, self._view = tree, None

    def view(self, field) -> np.ndarray:
        start = self._tree.start
        if self._view is None:
            shape, kind = _array_shape(field), np.dtype(DTYPES[field.dtype])
            size = int(np.prod(shape, dtype=np.int64)) * kind.itemsize
            whole = (ctypes.c_char * size).from_address(start + _offset(field))
            self._view = np.frombuffer(whole, dtype=kind).reshape(shape)
        return self._view


@kernel
def _address(field: ti.template(), entry: ti.template()) -> ti.u64:
    return ti.get_addr(field, entry)


def _offset(field) -> int:
    """Bytes from the start of its tree to the field, which lies there by itself."""
    return (field.parent() if field.shape else field.snode)._offset_bytes_in_parent_cell


def placed(fields: list) -> None:
    """These fields are one whole tree now: on the CPU they are moved through their memory."""
    if ti.cfg.arch != ti.cuda:
        tree = _Tree(fields)
        for field in fields:
            _places[field] = _Place(tree)


def removed(fields: list) -> None:
    """Their tree is about to be destroyed."""
    for field in fields:
        _places.pop(field, None)


@ti.func
def _move(field: ti.template(), shape: ti.template(), writes: ti.template(), row, at, data: ti.template()):
    """One row of a field from data, or into it, where its entries start at `at`."""
    columns, n = ti.static(shape[1:-1], shape[-1])
    if ti.static(n > 0):
        for c in ti.static(range(n)):
            if ti.static(writes):
                field[row][c] = ti.cast(data[at + c], field.dtype)
            else:
                data[at + c] = ti.cast(field[row][c], ti.f64)
    elif ti.static(len(columns) == 0):
        if ti.static(writes):
            field[row] = ti.cast(data[at], field.dtype)
        else:
            data[at] = ti.cast(field[row], ti.f64)
    elif ti.static(len(columns) == 1):
        for i in range(columns[0]):
            if ti.static(writes):
                field[row, i] = ti.cast(data[at + i], field.dtype)
            else:
                data[at + i] = ti.cast(field[row, i], ti.f64)
    else:
        for i in range(columns[0]):
            for j in range(columns[1]):
                if ti.static(writes):
                    field[row, i, j] = ti.cast(data[at + (i * columns[1] + j)], field.dtype)
                else:
                    data[at + (i * columns[1] + j)] = ti.cast(field[row, i, j], ti.f64)


@kernel
def _transfer(
    fields: ti.template(), shapes: ti.template(), writes: ti.template(), n_rows: ti.i32, first: ti.types.ndarray(),
    starts: ti.types.ndarray(), data: ti.types.ndarray(),
):  # fmt: skip
    """Rows first[k] to first[k + 1] are those of field k, whose entries start at starts[k].

    shapes: with the number of a vector's components last, 0 for scalars. One loop over all rows is one piece of code to
    compile; a loop for each field takes twice as long.
    """
    for row in range(n_rows):
        for k in ti.static(range(len(fields))):
            if first[k] <= row and row < first[k + 1]:
                own = row - first[k]
                wide = ti.static(_width(shapes[k]))
                _move(fields[k], shapes[k], writes, own, starts[k] + own * wide, data)


def _width(shape: tuple[int, ...]) -> int:
    """Numbers in a row of a field."""
    return int(np.prod(shape[1:-1], dtype=np.int64)) * max(shape[-1], 1)


def _array_shape(field) -> tuple[int, ...]:
    return (*field.shape, field.n) if hasattr(field, "n") else field.shape


def _launch(fields: list, rows: list[int], writes: bool, data: np.ndarray) -> None:
    shapes = tuple((*field.shape, getattr(field, "n", 0)) for field in fields)
    first = np.concatenate([[0], np.cumsum(rows)]).astype(np.int32)
    starts = np.concatenate([[0], np.cumsum([n * _width(s) for n, s in zip(rows, shapes)])]).astype(np.int32)
    _transfer(tuple(fields), shapes, writes, int(first[-1]), first, starts, data)


def upload(pairs: list[tuple]) -> None:
    """pairs: field of one to three dimensions, and an array of its shape, and of its components where it has any.

    Raises ValueError for an array of another shape, before anything is written.
    """
    for field, data in pairs:
        if data.shape != _array_shape(field):
            raise ValueError(f"a field of shape {_array_shape(field)} cannot take an array of shape {data.shape}")
    others = [pair for pair in pairs if pair[0] not in _places]
    for field, data in pairs:
        if field in _places:
            np.copyto(_places[field].view(field), data, casting="unsafe")
    if len(others) < 2 or sum(data.size for _, data in others) > MOST:
        for field, data in others:
            field.from_numpy(np.ascontiguousarray(data, dtype=DTYPES[field.dtype]))
        return
    flat = np.concatenate([np.asarray(data, dtype=np.float64).ravel() for _, data in others])
    _launch([field for field, _ in others], [len(data) for _, data in others], True, flat)


def download(fields: list, rows: int | None = None) -> list[np.ndarray]:
    """The fields as arrays, of their first `rows` rows if that is given."""
    places = [_places.get(field) for field in fields]
    if None not in places:
        views = [place.view(field) for place, field in zip(places, fields)]
        return [view.copy() if rows is None else view[:rows].copy() for view in views]
    counts = [field.shape[0] if rows is None else rows for field in fields]
    shapes = [_array_shape(field)[1:] for field in fields]
    sizes = [n * int(np.prod(shape, dtype=np.int64)) for n, shape in zip(counts, shapes)]
    if len(fields) < 2 or sum(sizes) > MOST:
        return [field.to_numpy()[:n] for field, n in zip(fields, counts)]
    flat = np.empty(sum(sizes))
    _launch(fields, counts, False, flat)
    parts = np.split(flat, np.cumsum(sizes)[:-1])
    return [p.reshape(n, *s).astype(DTYPES[f.dtype]) for p, n, s, f in zip(parts, counts, shapes, fields)]


def array_of(field, rows: int | None = None) -> np.ndarray:
    """One field as `download` gives it."""
    return download([field], rows)[0]
