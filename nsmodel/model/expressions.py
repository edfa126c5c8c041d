"""Questions about CasADi expressions: what they hold, whether they are constant, affine or concave, their values."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError, NsmodelError
from nsmodel.proof.graph import stack_column, stored_entries, symbol_hashes


def derivatives(expr: ca.SX, symbols: ca.SX) -> ca.SX:
    """The Jacobian, its entries that are numbers as numbers.

    Others stay as differentiation gives them: collecting terms, as `casadi.simplify` does, makes a (q - c) into a q - a c, which
    cancels far from 0.
    """
    J = ca.jacobian(expr, symbols)
    if J.is_constant():
        return J
    simple = ca.simplify(J)
    for k in range(J.nnz()):
        if simple.nz[k].is_constant():
            J.nz[k] = simple.nz[k]
    return J


def is_constant(expr: ca.SX, z: ca.SX) -> bool:
    """Whether ``expr`` does not change with z: read off, or else (y - y is not simplified) seen at sample points."""
    if not ca.depends_on(expr, z):
        return True
    values = evaluate_at_samples(expr, z, sample_points(z.numel(), 6))
    return bool(np.allclose(values, values[0], rtol=1e-9, atol=1e-12))


def is_affine(expr: ca.SX, z: ca.SX) -> bool:
    """Whether ``expr`` is affine in z."""
    return is_constant(ca.jacobian(expr, z), z)


def is_concave(expr: ca.SX, z: ca.SX) -> bool:
    """Whether ``expr`` is concave in z: read off where affine, else seen at sample points."""
    if is_affine(expr, z):
        return True
    n = z.numel()
    values = evaluate_at_samples(ca.hessian(expr, z)[0], z, sample_points(n, 32))
    spectra = np.linalg.eigvalsh(values[np.isfinite(values).all(axis=1)].reshape(-1, n, n))
    return bool((spectra <= 1e-9 * (1 + np.abs(spectra).max(initial=0))).all())


def sample_points(n: int, count: int) -> np.ndarray:
    """Return sample points (count, n) of sizes from 0.1 to 10."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, n)) * 10.0 ** rng.uniform(-1, 1, (count, 1))


def evaluate_at_samples(expr: ca.SX, z: ca.SX, samples: np.ndarray) -> np.ndarray:
    """Values (count, numel) of ``expr`` at samples (count, n) of z; each other symbol gets one number in (0.5, 2)."""
    own = symbol_hashes(z)
    others = stack_column(symbol for symbol in ca.symvar(expr) if symbol.element_hash() not in own)
    numbers = np.random.default_rng(0).uniform(0.5, 2, others.numel())
    function = ca.Function("values", [z, others], [ca.densify(ca.vec(expr))])
    return np.array(function(samples.T, numbers)).T


def check_finite(matrix: ca.SX, label: str, error: type[NsmodelError] = ModelError) -> None:
    """Refuse a constant entry that is not finite."""
    stored, symbols = stack_column(stored_entries(matrix)), stack_column(ca.symvar(matrix))
    values = np.array(ca.Function("values", [symbols], [stored])(np.full(symbols.numel(), 0.7))).ravel()
    where = np.column_stack(matrix.sparsity().get_triplet())
    for k in np.flatnonzero(~np.isfinite(values)):
        entry, (i, j) = stored[int(k)], where[k]
        if entry.is_constant():
            index = "" if matrix.numel() == 1 else f"[{i}]" if matrix.shape[1] == 1 else f"[{i}, {j}]"
            raise error(f"{label}{index} = {float(entry)}; expected a finite number")
