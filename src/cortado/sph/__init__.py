"""The physical terms of a step, each with its kernels, their launches and the parameters that it depends on."""
