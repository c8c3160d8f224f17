"""Springs and tendons in USD: a linear BasisCurves each, `/World/<name>`, whose points follow the bodies.

`primvars:tension` [N] is uniform, one number for the curve; a spring that pushes has a negative one.
"""

import numpy as np

from taisoft.output.appearance import linear_rgb
from taisoft.output.connection_lines import ConnectionLines
from taisoft.output.viewpoint import start_positions

TENSION = "tension"  # primvar
COLOUR = np.array([0.75, 0.20, 0.15])  # sRGB
WIDTH = 0.004  # of the scene's size


class Curves:
    """Defines the curves of a scene on a stage, below a path. names: legal names of its springs, then its tendons."""

    def __init__(self, stage, root: str, scene, names: list[str]):
        from pxr import Gf, Sdf, UsdGeom

        self._lines = ConnectionLines(scene, [*scene.springs, *scene.tendons])
        width = WIDTH * float(np.linalg.norm(np.ptp(start_positions(scene), axis=0)))
        self._attributes = []
        for k, (one, name) in enumerate(zip((*scene.springs, *scene.tendons), names)):
            curve = UsdGeom.BasisCurves.Define(stage, f"{root}/{name}")
            curve.GetPrim().SetDisplayName(one.name)
            curve.GetPrim().SetCustomDataByKey("taisoft:name", one.name)
            curve.CreateTypeAttr(UsdGeom.Tokens.linear)
            curve.CreateCurveVertexCountsAttr([int(self._lines.start[k + 1] - self._lines.start[k])])
            curve.CreateWidthsAttr([width])
            curve.SetWidthsInterpolation(UsdGeom.Tokens.constant)
            curve.CreateDisplayColorAttr([Gf.Vec3f(*linear_rgb(COLOUR).tolist())])
            primvar = UsdGeom.PrimvarsAPI(curve).CreatePrimvar(TENSION, Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.uniform)
            primvar.GetAttr().SetDocumentation("tension [N]; negative: it pushes")
            attributes = curve.CreatePointsAttr(), curve.CreateExtentAttr(), primvar.GetAttr()
            self._attributes.append([attribute.GetPath() for attribute in attributes])
        self._half = 0.5 * width

    def samples(self, sim, x: np.ndarray) -> list[tuple]:
        """Return (path, value) of each attribute in sim's present state. x: (n_nodes,3) [m]. Raises OutputError."""
        from pxr import Vt

        points, tensions, found = self._lines.points(x, sim.time).astype(np.float32), self._lines.tensions(sim), []
        for k, (at, extent, tension) in enumerate(self._attributes):
            own = points[self._lines.start[k] : self._lines.start[k + 1]]
            box = np.stack([own.min(axis=0) - self._half, own.max(axis=0) + self._half]).astype(np.float32)
            value = np.array([tensions[k]], dtype=np.float32)
            found += [(at, Vt.Vec3fArray.FromNumpy(own)), (extent, Vt.Vec3fArray.FromNumpy(box))]
            found.append((tension, Vt.FloatArray.FromNumpy(value)))
        return found
