"""What worker processes are given to do, in a module that they can import. Their kernels are those of the tests."""

import os
import time

import numpy as np

from compiling_notice import FLAGS, compile_fast

compile_fast(FLAGS)


class FarFromHome:
    """A loss as users write them."""

    def __init__(self, home):
        self.home = home

    def value(self, end):
        return float(((end.positions - self.home) ** 2).sum())

    def adjoint(self, end):
        return 2.0 * (end.positions - self.home), np.zeros_like(end.positions)


class SlowValue:
    """The loss of a problem, and which process computed it."""

    def __init__(self, problem):
        self.problem = problem

    def __call__(self, point):
        time.sleep(0.1)
        return self.problem.value(point), os.getpid()


def square(number):
    return number * number


def process(_):
    time.sleep(0.05)
    return os.getpid()


def gpu_and_process(_):
    time.sleep(0.05)
    return os.environ["CUDA_VISIBLE_DEVICES"], os.getpid()
