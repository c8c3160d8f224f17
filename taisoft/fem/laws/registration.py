"""Laws of one's own: `register_law`."""

import inspect
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from taisoft.backend.runtime import open_kind
from taisoft.errors import SceneError, value_text
from taisoft.fem.laws.checking import LawCheck, check_law
from taisoft.scene import checks
from taisoft.scene.law import HOOKE, VARIABLES, Law, Parameter, arguments_of
from taisoft.scene.laws import LAWS, SHIPPED
from taisoft.scene.material import Material

# names of numbers and of arguments beside which a parameter stands
TAKEN = {*VARIABLES, *HOOKE, *inspect.signature(Material).parameters, "D", "self", "name", "body", "region", "activation"}
TAKEN |= {"fibre", "floor", "projected", "dF"}
LANE_FUNCTIONS = ("N_CONSTANTS", "SOFTENS_BELOW", "POINT_SECONDS", "constants")
LANE_FUNCTIONS += ("psi", "pk1", "prepare", "dpk1", "block", "hessian_eigen")


def register_law(
    name: str,
    psi: Callable | None = None,
    parameters: Mapping[str, Parameter | str] | None = None,
    *,
    pk1: Callable | None = None,
    dpk1: Callable | None = None,
    dilatation: Callable | None = None,
    modulus: str | None = None,
    functions: Any = None,
) -> LawCheck:
    """Make a law available as Material(law=name, ...), after `check_law`.

    psi: energy density [Pa] as a function of some of F (3,3), the invariants I1 = tr C, I2 = (I1^2 - tr C^2) / 2, J = det F and
    I4 = a.C a along the fibres a (C = F^T F), the principal `stretches` (three) and their sum trS; and of the parameters, by
    their names, or of Lamé's `mu` and `lam` from young and poisson. It uses Python's operators and NumPy's functions; stress
    and tangent follow from it exactly. parameters: a `Parameter` each, or its unit. pk1, dpk1: the stress (3,3) as a function
    of F, and its differential of F and D, of the same arguments besides, if they are not to follow from psi. dilatation,
    modulus: theta(J) and the name of a parameter, or "lam", of which psi has modulus/2 theta^2 besides: mean dilatation then
    keeps linear tets from locking. functions: lane functions written by hand, as the modules of taisoft.fem.laws, instead.
    A name may be registered again, but those of the package. Raises SceneError with what is wrong and where.
    """
    what = f"law {name!r}"
    if not isinstance(name, str) or not name.isidentifier():
        raise SceneError(f"law: name must be an identifier, not {name!r}")
    if name in [law.name for law in SHIPPED]:
        raise SceneError(f"{what}: the name is that of a law of the package")
    if functions is not None:
        missing = [one for one in LANE_FUNCTIONS if not hasattr(functions, one)]
        if missing or any(one is not None for one in (psi, parameters, pk1, dpk1, dilatation, modulus)):
            raise SceneError(f"{what}: its lane functions lack {missing[0]}" if missing else f"{what}: functions are given alone")
        law = Law(name, functions=functions)
    else:
        if not isinstance(parameters or {}, Mapping):
            raise SceneError(f"{what}: parameters must be a dict of units or Parameters, not {value_text(parameters)}")
        made = {key: one if isinstance(one, Parameter) else Parameter(one) for key, one in (parameters or {}).items()}
        law = Law(name, psi, made, dilatation, modulus or "", pk1=pk1, dpk1=dpk1)
        _check_arguments(law)
    before = LAWS.get(name)
    if before is not None and open_kind() is not None:
        raise SceneError(f"{what}: it is registered already, and a simulator that may use it is open: close that first")
    LAWS[name] = law
    try:
        found = check_law(name)
    except BaseException as error:
        if before is None:
            del LAWS[name]
        else:
            LAWS[name] = before  # at its place among the others
        free = [f"{key} = {one.sample:g}" for key, one in law.parameters.items() if one.default is None]
        if isinstance(error, SceneError) and "unstable at rest" in str(error) and free:
            rule = f"checked with {', '.join(free)}: give a Parameter a default to check the law with another"
            raise SceneError(f"{error} ({rule})") from None
        raise
    if not found.is_finite_inverted:
        rule = "is not finite where det F < 0, so a tet that inverts ends a run: ts.positive(J) continues J"
        warnings.warn(f"{what} {rule}", UserWarning, stacklevel=2)
    return found


def _check_arguments(law: Law) -> None:
    """Raise SceneError if arguments of psi, pk1 and dpk1 are not known, or parameters not used."""
    what = f"law {law.name!r}"
    for name, function in (("psi", law.psi), ("pk1", law.pk1), ("dpk1", law.dpk1), ("dilatation", law.dilatation)):
        try:
            _ = None if function is None and name != "psi" else arguments_of(function)
        except (TypeError, ValueError):
            raise SceneError(f"{what}: {name} must be a function with named arguments, not {value_text(function)}") from None
    if (law.pk1 is None) != (law.dpk1 is None):
        raise SceneError(f"{what}: pk1 and dpk1 must be given together")
    for name, one in law.parameters.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise SceneError(f"{what}: a parameter's name must be an identifier, not {name!r}")
        if one.default is not None:
            one.checked(one.default, f"{what}: the default of {name}")
        if name in TAKEN or hasattr(Material, name):
            raise SceneError(f"{what}: a parameter cannot be called {name}, which has a meaning already")
    numbers = tuple(law.parameters) or HOOKE
    for function, extra in ((law.psi, ()), (law.pk1, ()), (law.dpk1, ("D",))):
        for name in () if function is None else arguments_of(function):
            if name not in (*VARIABLES, *numbers, *extra):
                there = f"{', '.join(VARIABLES)} and its numbers {', '.join(numbers)}"
                hint = " (I3 is J**2)" if name == "I3" else checks.nearest(name, (*VARIABLES, *numbers))
                raise SceneError(f"{what}: {name} is no variable{hint}; there are {there}")
    if not law.variables:
        raise SceneError(f"{what}: psi depends on none of {', '.join(VARIABLES)}")
    if {"stretches", "trS"} & set(law.variables) and {"F", "I4"} & set(law.variables):
        raise SceneError(f"{what}: psi of principal stretches cannot depend on F or I4 as well")
    if {"stretches", "trS"} & set(law.variables) and law.pk1 is not None:
        raise SceneError(f"{what}: pk1 and dpk1 are functions of F and invariants, and psi beside them, too")
    if law.pk1 is not None and law.dilatation is not None:
        raise SceneError(f"{what}: pk1 and dpk1 are the whole stress, which leaves nothing to a dilatation")
    if (law.dilatation is not None or law.modulus) and law.modulus not in numbers or bool(law.modulus) != bool(law.dilatation):
        raise SceneError(f"{what}: dilatation needs a modulus, one of {', '.join(numbers)}, not {law.modulus!r}")
    for name in law.parameters:
        if name not in law.arguments and name != law.modulus:
            raise SceneError(f"{what}: its parameter {name} is not used")
