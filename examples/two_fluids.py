"""Two fluids in a cup, seen from above: milk on coffee that is tilted, in a picture.

Gravity leans as the cup feels it when it is tilted; the milk, lighter and thicker, slides to one side and mixes with
the coffee. The picture is written to the folder in which this is run.
"""

import numpy as np

import cortado

COFFEE, MILK = [0.20, 0.09, 0.04], [0.95, 0.92, 0.85]  # red, green and blue, linear
scene = cortado.Scene(
    name="milk on coffee",
    dimension=3,
    discretisation={"spacing": 0.004},
    phase=[
        {"name": "coffee", "rest_density": 1000.0, "viscosity": 0.02, "colour": COFFEE},
        {"name": "milk", "rest_density": 900.0, "viscosity": 0.04, "colour": MILK},
    ],
    fluid=[
        {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.035, "height": 0.015, "phase": "coffee"},
        {"shape": "cylinder", "base": [0.0, 0.015, 0.0], "radius": 0.018, "height": 0.01, "phase": "milk"},
    ],
    container={"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.035, "height": 0.04},
    mixture={"free_energy": "miscible", "mobility": 2e-5, "mobility_form": "constant"},  # m2/s
    solver={"time_step": 0.0018},
)
simulation = cortado.Simulation(scene)
trajectory = simulation.run(steps=40, controls={"tilt": [20.0, 10.0]}, record_every=10)  # degrees, towards x and z
print(simulation, trajectory, sep="\n")

renderer = simulation.renderer(resolution=(160, 160))
before, after = (renderer.render(trajectory[k]) for k in (0, -1))
print("written:", cortado.pictures.write_picture("two_fluids.png", after))


def milk_at(picture):
    """Where in a row the milk is, from -1, the left end, to 1: the mean over the cup, weighted by how white it is."""
    columns = np.linspace(-1.0, 1.0, picture.shape[1])
    x, y = np.meshgrid(columns, columns)
    whiteness = np.where(x**2 + y**2 < 0.9, picture.mean(axis=2) - np.mean(COFFEE), 0.0)
    return np.average(x, weights=whiteness)


# Fluids mix, but none of a fluid comes or goes; and the picture shows where the milk went.
density = trajectory.constants["reference_density"].astype(float)  # (n,), in proportion to the mass of each particle
milk = np.array([density @ frame.mass_fractions[:, 1] for frame in trajectory])
coffee_in_milk = trajectory[-1].mass_fractions[trajectory[0].mass_fractions[:, 1] > 0.5, 0].mean()
print(f"milk is kept to {np.ptp(milk) / milk[0]:.1g}, and goes from {milk_at(before):.2f} to {milk_at(after):.2f}")
print(f"{coffee_in_milk:.1%} of what was milk is coffee now")
assert np.ptp(milk) < 1e-4 * milk[0], "milk was lost or made"
assert 0.01 < coffee_in_milk < 0.5, "the fluids have not mixed a little"
assert abs(milk_at(before)) < 0.01 and milk_at(after) > 0.05, "the milk is not where the tilt sends it"
