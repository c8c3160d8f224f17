"""3x3 matrices over SIMD lanes.

A matrix is a Python list of nine entries, row by row, each a `ti.Vector` with one value per lane (one tetrahedron each);
a 3-vector is a list of three. Lists are resolved while Taichi traces a kernel, so only lane arithmetic remains, which
LLVM turns into SIMD instructions. A list is never reassigned: each result gets a fresh name.
"""

import taichi as ti

from taisoft.backend.tracing import arithmetic

PAIRS = ((0, 1), (0, 2), (1, 2))


@arithmetic
def dot(a, b):
    """a . b of two 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@arithmetic
def cross(a, b):
    """a x b of two 3-vectors."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


@arithmetic
def transform(A, x):
    """A x."""
    return [dot(A[3 * i : 3 * i + 3], x) for i in ti.static(range(3))]


@arithmetic
def matmul(A, B):
    """A B."""
    return [dot(A[3 * i : 3 * i + 3], B[j::3]) for i in ti.static(range(3)) for j in ti.static(range(3))]


@arithmetic
def matmul_nt(A, B):
    """A B^T."""
    return [dot(A[3 * i : 3 * i + 3], B[3 * j : 3 * j + 3]) for i in ti.static(range(3)) for j in ti.static(range(3))]


@arithmetic
def matmul_tn(A, B):
    """A^T B."""
    return [dot(A[i::3], B[j::3]) for i in ti.static(range(3)) for j in ti.static(range(3))]


@arithmetic
def add_to_diagonal(A, t):
    """A + t I."""
    return [A[k] + (t if ti.static(k % 4 == 0) else 0.0) for k in ti.static(range(9))]


@arithmetic
def cofactor(F):
    """Cofactor matrix of F, dJ/dF. Each row is the cross product of the two others."""
    return cross(F[3:6], F[6:9]) + cross(F[6:9], F[0:3]) + cross(F[0:3], F[3:6])


@arithmetic
def cofactor_differential(F, D):
    """Change of the cofactor matrix of F along D (the cofactor is quadratic in F)."""
    return [
        F[4] * D[8] + D[4] * F[8] - F[5] * D[7] - D[5] * F[7],
        F[5] * D[6] + D[5] * F[6] - F[3] * D[8] - D[3] * F[8],
        F[3] * D[7] + D[3] * F[7] - F[4] * D[6] - D[4] * F[6],
        F[2] * D[7] + D[2] * F[7] - F[1] * D[8] - D[1] * F[8],
        F[0] * D[8] + D[0] * F[8] - F[2] * D[6] - D[2] * F[6],
        F[1] * D[6] + D[1] * F[6] - F[0] * D[7] - D[0] * F[7],
        F[1] * D[5] + D[1] * F[5] - F[2] * D[4] - D[2] * F[4],
        F[2] * D[3] + D[2] * F[3] - F[0] * D[5] - D[0] * F[5],
        F[0] * D[4] + D[0] * F[4] - F[1] * D[3] - D[1] * F[3],
    ]


@arithmetic
def determinant(F):
    """det F, from the same products as the cofactor, so that the compiler can share them."""
    return dot(F, cross(F[3:6], F[6:9]))


@arithmetic
def ddot(A, B):
    """A : B, the sum of the products of the entries."""
    half = A[0] * B[0] + A[1] * B[1] + A[2] * B[2] + A[3] * B[3] + A[4] * B[4]
    return half + A[5] * B[5] + A[6] * B[6] + A[7] * B[7] + A[8] * B[8]


@arithmetic
def jacobi_angle(app, aqq, apq):
    """(cosine, sine) of the rotation that zeroes the off-diagonal apq of a symmetric 2x2 matrix."""
    small = abs(apq) <= 1e-30
    tau = (aqq - app) / ti.select(small, 1.0 + 0.0 * apq, 2.0 * apq)
    sign = ti.select(tau >= 0.0, 1.0 + 0.0 * apq, -1.0 + 0.0 * apq)  # not of tau, which overflows in f32 if apq is tiny
    t = sign / (abs(tau) + ti.sqrt(1.0 + tau * tau))
    t0 = ti.select(small, 0.0 * t, t)
    c = 1.0 / ti.sqrt(1.0 + t0 * t0)
    return c, t0 * c


@ti.func
def signed_svd(F, sweeps: ti.template()):
    """F = U diag(s) V^T with U and V rotations, s0 >= s1 >= |s2|, and s2 < 0 exactly when F is inverted.

    One-sided Jacobi on the columns of F / max|F|: pairs of columns are rotated until they are orthogonal, then sorted by
    length. U's third column is the cross product of the first two, so a rank-deficient F gets a full rotation too.
    Returns (U, s, V), s a list of three. Any finite F is valid. Accuracy: s within a few rounding units of |F|.
    """
    largest = abs(F[0])
    for k in ti.static(range(1, 9)):
        largest = ti.max(largest, abs(F[k]))
    unit = ti.select(largest > 0.0, largest, 1.0 + 0.0 * largest)
    A = [F[k] / unit for k in ti.static(range(9))]
    one, zero = 1.0 + 0.0 * unit, 0.0 * unit
    V = [one, zero, zero, zero, one, zero, zero, zero, one]
    for _ in range(sweeps):
        for p, q in ti.static(PAIRS):
            _rotate_columns(A, V, p, q)
    for p, q in ti.static(((0, 1), (1, 2), (0, 1))):  # a sorting network of three comparisons
        _sort_columns(A, V, p, q)
    U, s = _left_frame(A)
    return U, [s[k] * unit for k in ti.static(range(3))], V


@ti.func
def _rotate_columns(A: ti.template(), V: ti.template(), p: ti.template(), q: ti.template()):
    c, s = jacobi_angle(dot(A[p::3], A[p::3]), dot(A[q::3], A[q::3]), dot(A[p::3], A[q::3]))
    for r in ti.static(range(3)):
        ap, aq = c * A[3 * r + p] - s * A[3 * r + q], s * A[3 * r + p] + c * A[3 * r + q]
        vp, vq = c * V[3 * r + p] - s * V[3 * r + q], s * V[3 * r + p] + c * V[3 * r + q]
        A[3 * r + p], A[3 * r + q] = ap, aq
        V[3 * r + p], V[3 * r + q] = vp, vq


@ti.func
def _sort_columns(A: ti.template(), V: ti.template(), p: ti.template(), q: ti.template()):
    """Swap two columns of A and V if the later one is longer; one changes sign, so V stays a rotation."""
    swap = dot(A[q::3], A[q::3]) > dot(A[p::3], A[p::3])
    for r in ti.static(range(3)):
        ap, aq = ti.select(swap, A[3 * r + q], A[3 * r + p]), ti.select(swap, -A[3 * r + p], A[3 * r + q])
        vp, vq = ti.select(swap, V[3 * r + q], V[3 * r + p]), ti.select(swap, -V[3 * r + p], V[3 * r + q])
        A[3 * r + p], A[3 * r + q] = ap, aq
        V[3 * r + p], V[3 * r + q] = vp, vq


@arithmetic
def _left_frame(A):
    """Orthonormal frame (a rotation) of A's nearly orthogonal, sorted columns, and their signed lengths."""
    s0 = ti.sqrt(dot(A[0::3], A[0::3]))
    is_zero = s0 <= 0.0
    d0 = ti.select(is_zero, 1.0 + 0.0 * s0, s0)
    u = [ti.select(is_zero, 1.0 + 0.0 * s0, A[0] / d0), A[3] / d0, A[6] / d0]
    projection = dot(u, A[1::3])
    w = [A[3 * k + 1] - projection * u[k] for k in ti.static(range(3))]
    s1 = ti.sqrt(dot(w, w))
    # below this the second column's direction is rounding noise, so any direction orthogonal to u will do
    is_rank_one = s1 <= 1e-30 + 0.0 * s1
    use_x = abs(u[0]) < 0.6
    e = [ti.select(use_x, 1.0 + 0.0 * s1, 0.0 * s1), ti.select(use_x, 0.0 * s1, 1.0 + 0.0 * s1)]
    n = [-e[1] * u[2], e[0] * u[2], e[1] * u[0] - e[0] * u[1]]  # u x (e0, e1, 0), orthogonal to u
    m = cross(u, n)
    d1 = ti.select(is_rank_one, ti.sqrt(dot(m, m)), s1)
    t = [ti.select(is_rank_one, m[k], w[k]) / d1 for k in ti.static(range(3))]
    b = cross(u, t)
    U = [u[0], t[0], b[0], u[1], t[1], b[1], u[2], t[2], b[2]]
    return U, [s0, dot(t, A[1::3]), dot(b, A[2::3])]


@ti.func
def clamp_symmetric(A, sweeps: ti.template()):
    """Nearest positive semi-definite matrix to a symmetric A (nine entries): negative eigenvalues become 0.

    Two-sided Jacobi accumulates A's eigenvectors Q, then Q max(0, D) Q^T is formed.
    """
    D = [A[k] + 0.0 for k in ti.static(range(9))]
    one, zero = 1.0 + 0.0 * A[0], 0.0 * A[0]
    Q = [one, zero, zero, zero, one, zero, zero, zero, one]
    for _ in range(sweeps):
        for p, q in ti.static(PAIRS):
            c, s = jacobi_angle(D[4 * p], D[4 * q], D[3 * p + q])
            for r in ti.static(range(3)):
                dp, dq = c * D[3 * r + p] - s * D[3 * r + q], s * D[3 * r + p] + c * D[3 * r + q]
                qp, qq = c * Q[3 * r + p] - s * Q[3 * r + q], s * Q[3 * r + p] + c * Q[3 * r + q]
                D[3 * r + p], D[3 * r + q] = dp, dq
                Q[3 * r + p], Q[3 * r + q] = qp, qq
            for r in ti.static(range(3)):
                dp, dq = c * D[3 * p + r] - s * D[3 * q + r], s * D[3 * p + r] + c * D[3 * q + r]
                D[3 * p + r], D[3 * q + r] = dp, dq
    d = [ti.max(D[4 * k], 0.0) for k in ti.static(range(3))]
    QD = [Q[3 * i + j] * d[j] for i in ti.static(range(3)) for j in ti.static(range(3))]
    return matmul_nt(QD, Q)


@arithmetic
def plus_pressure(s, p):
    """A stress s plus the pressure p[4] of mean dilatation, if a law's constants p have it; see `fem.laws`."""
    total = s
    if ti.static(len(p) > 4):
        total = s + p[4]
    return total
