"""The contact benchmark compared with another version of taisoft, here with this version itself:

* captured states are solved again, in both precisions;
* drops and contact-free scenes take the same iterations in both versions, and limits follow from the numbers.
"""

import json

from benchmarks import contact, contact_versions


def test_captured_states_are_replayed(tmp_path, capsys):
    """Two small scenes."""
    scenes = ["gripper", "cloth on sphere"]
    only = [word for name in scenes for word in ("--only", name)]
    assert contact.main(["--capture", str(tmp_path), "--quick", *only]) == 0
    assert {file.stem for file in tmp_path.glob("*.pkl")} == set(scenes)
    out = tmp_path / "replay.json"
    status = contact.main(["--replay", str(tmp_path), "--only", "gripper", "--out", str(out)])
    numbers = json.loads(out.read_text())
    assert status == (0 if all(limit["met"] for limit in numbers["limits"]) else 1)
    for precision in ("f32", "f64"):
        rows = numbers["rows"][f"this version, {precision}"]
        assert [row["step"] for row in rows] == [20, 21, 22] and all(row["converged"] for row in rows)
        assert all(row["residual"] <= 1e-4 and row["contact residual"] <= 1e-4 for row in rows)
        assert all(0 < row["newton"] <= row["linear"] and 0.0 < row["error"] < 0.1 and row["launches"] > 5 for row in rows)
    assert "## Limits" in capsys.readouterr().out


def test_drops(tmp_path, capsys):
    """The first steps of a cube at rest; this version compared with itself takes the same iterations."""
    out = tmp_path / "drops.json"
    here = str(contact_versions.HERE)
    assert contact.main(["--drops", "--quick", "--only", "cube at rest", "--baseline", here, "--out", str(out)]) == 0
    runs = json.loads(out.read_text())["runs"]
    this, older = (runs[label]["cube at rest"] for label in ("this", "older"))
    assert this["newton"] == older["newton"] and len(this["newton"]) == 5 and this["tets"] == 384 and this["unconverged"] == 0
    assert capsys.readouterr().out.count("| cube at rest |") == 2
    scenes = {
        label: {name: own["cube at rest"] | {"seconds": [times] * 5} for name in ("bunny", "cloth")}
        for label, own, times in (("this", runs["this"], 1.0), ("older", runs["older"], 4.0))
    }
    met = {limit.what: limit.met for limit in contact_versions.drop_limits(scenes)}
    assert met["bunny: time of the older version over this one's"] and not met["cloth: time of the older version over this one's"]
    assert len(met) == 6 and sum(met.values()) == 4


def test_steps_without_contacts(tmp_path, capsys):
    """A few steps and static solves, this version compared with itself. Steps that only one version converges in do not count."""
    out, here = tmp_path / "free.json", str(contact_versions.HERE)
    names = ["beam, BDF2", "static beams"]
    only = [word for name in names for word in ("--only", name)]
    assert contact.main(["--free", "--quick", *only, "--baseline", here, "--out", str(out)]) == 0
    runs = json.loads(out.read_text())["runs"]
    for name in names:
        (this,), (older,) = (runs[name][label] for label in ("this", "older"))
        assert this["newton"] == older["newton"] and this["linear"] == older["linear"] and min(this["newton"]) > 0
        assert this["converged"] == [True] * 3
    assert capsys.readouterr().out.count("| beam, BDF2") == 2
    older |= {"converged": [True, False, True], "newton": [1, 1, 1]}
    own = {"this": [this], "older": [older]}
    assert contact_versions.total(own, "this", "newton")[0] == this["newton"][0] + this["newton"][2]
    limits = {limit.what: limit for limit in contact_versions.free_limits({"static beams": own})}
    ratio = limits["static beams: Newton iterations over the older version's"]
    assert ratio.value == (this["newton"][0] + this["newton"][2]) / 2 and not ratio.met
    inverted = contact_versions.free_limits({"inverted beam, BDF2": {"this": [this]}})
    assert [limit.value for limit in inverted] == [sum(this["newton"]) / 3]
