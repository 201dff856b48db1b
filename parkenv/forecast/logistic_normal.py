"""Means over a normal variable on the logit scale, by quadrature."""

from typing import NamedTuple, Self

import numpy as np
from scipy.special import expit

from parkenv.compiled.arrays import FloatArray


class NormalQuadrature(NamedTuple):
    nodes: FloatArray
    weights: FloatArray

    @classmethod
    def gauss_hermite(cls, n: int) -> Self:
        nodes, weights = np.polynomial.hermite_e.hermegauss(n)
        return cls(nodes, weights / weights.sum())

    @classmethod
    def evenly(cls, step: float, most: float) -> Self:
        """Return equally spaced nodes from -most to most.

        Their sum converges faster here than Gauss-Hermite quadrature, as both the normal density and the sigmoid are
        analytic in a strip.
        """
        nodes = np.arange(-most, most + step / 2, step)
        weights = np.exp(-0.5 * nodes**2)
        return cls(nodes, weights / weights.sum())

    def expit(self, mean: FloatArray, sd: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the means of sigmoid(mean + sd·Z) and of its derivative, elementwise."""
        p, slope = np.zeros(np.shape(mean)), np.zeros(np.shape(mean))
        for node, weight in zip(self.nodes, self.weights, strict=True):
            value = expit(mean + node * sd)
            p += weight * value
            slope += weight * value * (1.0 - value)
        return p, slope


EVEN = NormalQuadrature.evenly(0.375, 6.0)  # nodes of forecasts that trips correct
