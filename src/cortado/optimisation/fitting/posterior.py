"""The density that samplers need: how likely other parameters are, given what was measured."""

from typing import Any

import numpy as np

from cortado.arrays import as_numbers
from cortado.errors import DivergedError, InputError
from cortado.optimisation.fitting.fitted import Fit


def log_posterior(fitted: Fit, u: Any) -> float:
    """Minus half of the weighted sum of squares, beyond its least; see `Fit.log_posterior`.

    Correlated noise makes bars longer than the curvature N of the sum of squares has them. Distances from the estimate
    are therefore shortened by the matrix W with W^T N W = V^-1, the inverse of the covariance of the bars: the
    curvature adjustment of Ribatet, Cooley and Davison (2012).
    """
    point = as_numbers("u", u)
    if point.shape != fitted.u.shape:
        raise InputError(f"u has shape {point.shape}, but must be {fitted.u.shape}, one for each fitted number.")
    if fitted.problem is None:
        raise InputError("The fit was pickled, but must have its experiments to say how likely other parameters are.")
    lower, upper = fitted.coordinates.bounds
    root = np.linalg.cholesky(fitted.hessian)
    wanted = np.linalg.cholesky(np.linalg.inv(fitted.coordinate_covariance))
    shortened = fitted.u + np.linalg.solve(root.T, wanted.T @ (point - fitted.u))
    if not (np.isfinite(point) & (lower <= point) & (point <= upper)).all():
        return -np.inf
    try:
        residuals = fitted.problem.residuals(np.clip(shortened, lower, upper))
    except DivergedError:
        return -np.inf
    squares = fitted.problem.sum_of_squares(residuals, [part.weighting for part in fitted.parts])
    return -0.5 * (squares - fitted.sum_of_squares)
