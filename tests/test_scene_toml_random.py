"""A random edit of a scene file is read or refused with SceneError or MeshError, and so is random text."""

import tomllib
import warnings
from pathlib import Path

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from toml_scenes import TEXT, floats

import taisoft as ts
from taisoft.scene.toml_writer import toml_of


def places(values, at=()):
    """The ways to all values of nested dicts and lists."""
    yield at
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for key, value in items:
        yield from places(value, (*at, key))


WAYS = [way for way in places(tomllib.loads(TEXT)) if way]
# No number that makes a large but possible mesh.
scalars = st.integers(-3, 3) | st.integers(2**40) | floats() | st.text(max_size=5) | st.booleans()
scalars |= st.sampled_from(["1e5 Pa", "beam", "box", "all", "none", "rubber", "../a.msh", "__import__('os')"])
junk = scalars | st.lists(scalars, max_size=4) | st.lists(st.lists(scalars, max_size=3), max_size=3)
junk |= st.dictionaries(st.sampled_from(["shape", "file", "min", "box", "young", "a"]), scalars, max_size=2)


def read_or_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "edited.toml"
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scene, solver = ts.read_scene(path)
        except (ts.SceneError, ts.MeshError) as error:
            text = str(error)
            assert text.startswith(str(path)) and text.count(str(path)) == 1 and "\n" not in text and len(text) < 1000
        else:
            assert isinstance(scene, ts.Scene) and isinstance(solver, dict)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(WAYS), st.sampled_from(["replace", "remove", "rename"]), junk, st.text(max_size=8))
def test_random_edits_are_read_or_refused(tmp_path, way, act, value, name):
    tables = tomllib.loads(TEXT)
    within = tables
    for key in way[:-1]:
        within = within[key]
    if act == "replace":
        within[way[-1]] = value
    elif act == "remove" or isinstance(within, list):
        del within[way[-1]]
    else:
        within[name] = within.pop(way[-1])
    try:
        text = toml_of(tables)
    except (AttributeError, KeyError, TypeError):  # a table in a list of others: the writer has no words for it
        return
    read_or_refused(tmp_path, text.encode())


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, len(TEXT)), st.integers(0, 12), st.text('[]{}=".\n#,\x00é-', max_size=5).map(str.encode) | st.binary())
def test_random_text_is_read_or_refused(tmp_path, start, length, more):
    more = bytes(byte for byte in more if not 48 <= byte <= 57)  # digits could ask for a huge mesh
    data = TEXT.encode()
    read_or_refused(tmp_path, data[:start] + more + data[start + length :])
