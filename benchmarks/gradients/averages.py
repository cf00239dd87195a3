"""Other averages over an ensemble than the mean, which a few large gradients move less."""

import numpy as np

from cortado.gradients import EnsembleMean


class TrimmedMean(EnsembleMean):
    """The mean of the middle half of the samples, number by number; its standard error is that of the whole mean."""

    def combined(self, gradients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        quarter = len(gradients) // 4
        middle = np.sort(gradients, axis=0)[quarter : len(gradients) - quarter]
        return middle.mean(axis=0), super().combined(gradients)[1]


class MedianOfMeans(EnsembleMean):
    """The median of the means of antithetic pairs, number by number; its standard error is that of the whole mean."""

    def combined(self, gradients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.median((gradients[::2] + gradients[1::2]) / 2.0, axis=0), super().combined(gradients)[1]
