"""The choice between one thread and several: its gain is measured once, and kept unless other programs may have hidden it."""

import json

import pytest

from taisoft.backend import parallel
from taisoft.backend.runtime import threads
from tests.backend.lanes import opened


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The file of the measurements, in a folder of its own."""
    monkeypatch.setattr(parallel, "cache_folder", lambda: str(tmp_path))
    parallel.gain.cache_clear()
    with opened("f64"):
        yield tmp_path / parallel.FILE
    parallel.gain.cache_clear()


def test_the_gain_is_measured_once_and_kept(cache, monkeypatch):
    real = parallel.measure()
    assert 0.0 < real.wake < 0.1 and 0.0 < real.speedup <= threads()
    monkeypatch.setattr(parallel, "measure", lambda: parallel.Gain(1e-5, 1.9))
    name = f"{parallel.processor()}, {threads()} threads"
    impossible = json.dumps({name: {"wake": 0.0, "speedup": 0.0}})
    for content in (None, "", "{", "[]", '{"a": 1}', '{"a": {"wake": "b", "speedup": 1}}', impossible):  # unusable files
        if content is not None:
            cache.write_text(content)
        parallel.gain.cache_clear()
        assert parallel.gain() == parallel.Gain(1e-5, 1.9)
        assert json.loads(cache.read_text()) == {name: {"wake": 1e-5, "speedup": 1.9}}
    cache.write_text(json.dumps({name: {"wake": 12.5, "speedup": 1.9}}))
    assert parallel.gain() == parallel.Gain(1e-5, 1.9)  # as long as the process runs
    parallel.gain.cache_clear()
    assert parallel.gain().wake == 12.5


def test_a_gain_that_other_programs_may_hide_is_not_kept(cache, monkeypatch):
    found = iter((1.0, 1.2, 1.1, 1.0))
    monkeypatch.setattr(parallel, "measure", lambda: parallel.Gain(1e-4, next(found)))
    assert parallel.gain().speedup == 1.2 and not cache.exists()


def test_short_loops_run_on_one_thread(monkeypatch):
    two = parallel.Gain(wake=5e-5, speedup=2.0)
    assert 1e-4 < two.shortest_loop < 2e-4 and parallel.Gain(wake=5e-5, speedup=4.0).shortest_loop < two.shortest_loop
    for speedup in (0.5, 1.0):  # more cores are visible than may be used
        assert parallel.Gain(wake=5e-5, speedup=speedup).shortest_loop == float("inf")
    monkeypatch.setattr(parallel, "gain", lambda: two)
    for cores, pays in ((2, [False, True]), (1, [False, False])):
        monkeypatch.setattr(parallel, "threads", lambda cores=cores: cores)
        assert [parallel.pays(factor * two.shortest_loop) for factor in (0.9, 1.1)] == pays
