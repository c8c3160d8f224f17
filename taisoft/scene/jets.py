"""Numbers with their first and second derivatives, by which a law's stress and tangent follow from its energy density.

A `Jet` is f(u) with df/du_i and d2f/du_i du_j at one u, exact but for rounding: forward differentiation. Derivatives that are 0
for every u are left out. Values are NumPy arrays here, and SIMD lanes while a kernel is traced: a `Space` has their functions.
Energies are written with Python's operators and NumPy's functions, such as np.log(J), which find the methods of a jet.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np

Derivatives = dict[Any, Any]  # by variable, or by pair of variables (i, j), i <= j


class Space:
    """NumPy arrays as values."""

    log, exp, sqrt, tanh, power = (staticmethod(getattr(np, name)) for name in ("log", "exp", "sqrt", "tanh", "power"))
    select = staticmethod(np.where)

    def __init__(self, order: int = 2):
        """order: of the highest derivatives that are computed."""
        self.order, self.eps = order, float(np.finfo(np.float64).eps)

    def constant(self, value: float) -> Any:
        """Return a number that keeps the precision of the values."""
        return value

    def bind(self, value: Any) -> Any:
        """Return a value that is computed once, however often it is used."""
        return value

    def variable(self, value: Any, name: Any) -> "Jet":
        """Return an independent variable; name: anything that sorts among the other variables'."""
        return Jet(self, value, {name: 1.0} if self.order else {}, {})

    def fixed(self, value: Any) -> "Jet":
        """Return a value without derivatives."""
        return Jet(self, self.constant(value) if isinstance(value, (int, float)) else value, {}, {})


class Jet:
    """A value with its derivatives. Factors of 1.0 and 0.0 that Python knows are left out."""

    def __init__(self, space: Space, value: Any, first: Derivatives, second: Derivatives):
        self.space, self.value, self.first, self.second = space, value, first, second

    def _made(self, value: Any, first: Derivatives, second: Derivatives) -> "Jet":
        bind = self.space.bind
        return Jet(self.space, bind(value), *({key: bind(one) for key, one in part.items()} for part in (first, second)))

    def _lifted(self, other: Any) -> "Jet":
        return other if isinstance(other, Jet) else self.space.fixed(float(other))

    def _chained(self, value: Any, slope: Callable, curvature: Callable) -> "Jet":
        """f(self), from f and functions that give f' and f''."""
        if not self.first:
            return self._made(value, {}, {})
        f1 = self.space.bind(slope())
        first = {i: _product(f1, a) for i, a in self.first.items()}
        second = {pair: _product(f1, a) for pair, a in self.second.items()}
        if self.space.order == 2:
            f2 = self.space.bind(curvature())
            for i, j, product in _pairs(self.first, self.first):
                if i <= j:
                    _add(second, (i, j), _product(f2, product))
        return self._made(value, first, second)

    def __add__(self, other):
        if not isinstance(other, (Jet, int, float, np.number)):
            return NotImplemented
        other = self._lifted(other)
        first, second = dict(self.first), dict(self.second)
        for total, part in ((first, other.first), (second, other.second)):
            for key, value in part.items():
                _add(total, key, value)
        return self._made(self.value + other.value, first, second)

    def __mul__(self, other):
        if not isinstance(other, (Jet, int, float, np.number)):
            return NotImplemented
        other = self._lifted(other)
        a, b = self.value, other.value
        first = {i: _product(b, value) for i, value in self.first.items()}
        second = {pair: _product(b, value) for pair, value in self.second.items()}
        for total, part in ((first, other.first), (second, other.second)):
            for key, value in part.items():
                _add(total, key, _product(a, value))
        if self.space.order == 2:
            for i, j, product in _pairs(self.first, other.first):
                _add(second, (min(i, j), max(i, j)), product if i != j else 2.0 * product)
        return self._made(a * b, first, second)

    def __pow__(self, exponent):
        if isinstance(exponent, (int, float, np.number)) and float(exponent).is_integer() and 0 <= exponent <= 4:
            power = self.space.fixed(1.0) if exponent == 0 else self
            for _ in range(int(exponent) - 1):
                power = power * self
            return power
        if isinstance(exponent, Jet) and exponent.first:
            return (exponent * self.log()).exp()
        n = self._lifted(exponent).value
        x, y = self.value, self.space.bind(self.space.power(self.value, n))
        return self._chained(y, lambda: n * y / x, lambda: n * (n - 1.0) * y / (x * x))

    def _inverse(self):
        y = self.space.bind(1.0 / self.value)
        return self._chained(y, lambda: -y * y, lambda: 2.0 * y * y * y)

    def log(self):
        """Natural logarithm."""
        x = self.value
        return self._chained(self.space.log(x), lambda: 1.0 / x, lambda: -1.0 / (x * x))

    def exp(self):
        """Exponential function."""
        y = self.space.bind(self.space.exp(self.value))
        return self._chained(y, lambda: y, lambda: y)

    def sqrt(self):
        """Square root."""
        y = self.space.bind(self.space.sqrt(self.value))
        return self._chained(y, lambda: 0.5 / y, lambda: -0.25 / (y * y * y))

    def tanh(self):
        """Hyperbolic tangent."""
        y = self.space.bind(self.space.tanh(self.value))
        return self._chained(y, lambda: 1.0 - y * y, lambda: -2.0 * y * (1.0 - y * y))

    def maximum(self, other):
        """The larger one; derivatives are those of that one, and of self where both are equal."""
        other = self._lifted(other)
        is_self, zero = self.space.bind(self.value >= other.value), 0.0 * self.value

        def merged(a: Derivatives, b: Derivatives) -> Derivatives:
            return {key: self.space.select(is_self, zero + a.get(key, 0.0), zero + b.get(key, 0.0)) for key in {**a, **b}}

        value = self.space.select(is_self, self.value + 0.0 * other.value, other.value + zero)
        return self._made(value, merged(self.first, other.first), merged(self.second, other.second))

    def minimum(self, other):
        """The smaller one."""
        return -(-self).maximum(-self._lifted(other))

    def __abs__(self):
        return self.maximum(-self)

    def __neg__(self):
        return self * -1.0

    def __sub__(self, other):
        return self + -other

    def __rsub__(self, other):
        return -self + other

    def __truediv__(self, other):
        return self * (other._inverse() if isinstance(other, Jet) else 1.0 / other)

    def __rtruediv__(self, other):
        return self._inverse() * other

    def __rpow__(self, base):
        return (self * float(np.log(base))).exp()

    __radd__, __rmul__ = __add__, __mul__

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs, **kwargs):
        """Apply one of NumPy's functions, entry by entry where an input is an array of jets."""
        function = UFUNCS.get(ufunc.__name__)
        if method != "__call__" or kwargs or function is None:
            raise TypeError(f"there is no numpy.{ufunc.__name__} for energies; there are {', '.join(NAMES)}")
        if any(np.ndim(one) for one in inputs if not isinstance(one, Jet)):
            return np.frompyfunc(function, len(inputs), 1)(*[_boxed(one) for one in inputs])
        return function(*inputs)

    def __bool__(self):
        raise TypeError("an energy density cannot branch on its variables: use np.maximum or np.minimum")

    def __float__(self):
        raise TypeError("a variable has no single value here: use NumPy's functions, such as np.log")

    def __lt__(self, other):
        return bool(self)

    __le__ = __gt__ = __ge__ = __eq__ = __ne__ = __lt__
    __hash__ = None


# NumPy's functions that energies may use
UFUNCS: dict[str, Callable] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
    "power": operator.pow,
    "negative": operator.neg,
    "absolute": abs,
    "square": lambda x: x * x,
    "sqrt": Jet.sqrt,
    "exp": Jet.exp,
    "log": Jet.log,
    "tanh": Jet.tanh,
    "maximum": lambda a, b: a.maximum(b) if isinstance(a, Jet) else b.maximum(a),
    "minimum": lambda a, b: a.minimum(b) if isinstance(a, Jet) else b.minimum(a),
}
NAMES = ("exp", "log", "sqrt", "tanh", "power", "square", "maximum", "minimum", "absolute")  # of functions, not operators


def _boxed(value: Any) -> Any:
    """Return a jet as an array of one object, which NumPy does not take apart."""
    if not isinstance(value, Jet):
        return value
    box = np.empty((), dtype=object)
    box[()] = value
    return box


def _product(a: Any, b: Any) -> Any:
    """a b, without a factor of 1 that Python knows."""
    if isinstance(b, float) and b == 1.0:
        return a
    return b if isinstance(a, float) and a == 1.0 else a * b


def _add(total: Derivatives, key: Any, value: Any) -> None:
    total[key] = total[key] + value if key in total else value


def _pairs(a: Derivatives, b: Derivatives):
    """Products a_i b_j of first derivatives."""
    for i, x in a.items():
        for j, y in b.items():
            yield i, j, _product(x, y)
