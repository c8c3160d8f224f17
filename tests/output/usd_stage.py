"""What a USD file holds, for tests: what USD's validators say of it, and whether its frames are those given."""

import numpy as np
from pxr import Usd, UsdValidation

from taisoft.output.usd_scene import prim_names


def faults(stage) -> list[str]:
    """What all validators that there are have to say, warnings too."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    return [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(stage)]


def points_of(stage, path, index):
    return np.array(stage.GetAttributeAtPath(f"{path}.points").Get(index))


def check_frames(path, given, first=0, skinned=()):
    """Every frame in the file equals the positions given, in float32; returns the number of frames.

    given: per frame the positions (n,3) by body; skinned: bodies whose last nodes are those of a touched skin. What changes
    does so in every frame, at whole time codes, and each point has its numbers.
    """
    stage = Usd.Stage.Open(str(path))
    start, end = int(stage.GetStartTimeCode()), int(stage.GetEndTimeCode())
    assert start == first
    for prim in stage.Traverse():
        for attribute in prim.GetAttributes():
            assert attribute.GetTimeSamples() in ([], list(range(start, end + 1))), attribute.GetPath()
    for body, legal in zip(given[0], prim_names(list(given[0]))):
        prim = f"/World/{legal}"
        surface_only = not stage.GetPrimAtPath(f"{prim}/tets")  # of a rigid body
        if not surface_only:
            triangles = np.array(stage.GetAttributeAtPath(f"{prim}/tets.surfaceFaceVertexIndices").Get())
        local = np.array(stage.GetAttributeAtPath(f"{prim}/surface.faceVertexIndices").Get())
        samples = stage.GetAttributeAtPath(f"{prim}/surface.points").GetTimeSamples()
        assert samples == list(range(start, end + 1))
        for index in range(start, end + 1):
            expected = given[index][body].astype(np.float32)
            surface = points_of(stage, f"{prim}/surface", index)
            if surface_only:
                assert np.array_equal(surface, expected[-len(surface) :])
            else:
                assert np.array_equal(points_of(stage, f"{prim}/tets", index), expected)
                extent = np.array(stage.GetAttributeAtPath(f"{prim}/tets.extent").Get(index))
                assert np.array_equal(extent, [expected.min(axis=0), expected.max(axis=0)])
                if body not in skinned:
                    assert np.array_equal(surface[local].reshape(-1, 3, 3), expected[triangles])
                else:
                    assert np.array_equal(surface, expected[-len(surface) :])
            for part, n in (("tets", len(expected)), ("surface", len(surface)))[surface_only:]:
                stress = stage.GetAttributeAtPath(f"{prim}/{part}.primvars:vonMisesStress").Get(index)
                assert len(stress) == n and np.isfinite(np.array(stress)).all()
    return end - start + 1
