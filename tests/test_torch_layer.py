"""Cortado as a layer of PyTorch, what it has alone (see test_layer.py): graphs, modules, bad uses in sentences."""

import gc
from functools import partial

import numpy as np
import pytest

import cortado
import layered
from cortado import DivergedError, InputError, Problem, Simulation, gradients, sensors
from layered import POINT, assert_refused, matched, same_bits, sheared, uses_of_parameters, uses_of_state
from scenes import Squares, plane, two_layers

torch = pytest.importorskip("torch", reason="PyTorch is not installed: its CPU wheel is optional", exc_type=ImportError)


@pytest.fixture(scope="module")
def layer():
    import cortado.torch

    return cortado.torch


@pytest.fixture(scope="module")
def simulation():
    return Simulation(sheared(), precision="float64")


@pytest.fixture(scope="module")
def problem(simulation):
    return matched(simulation)


ALONG = {"gravity": np.array([1.0, 0.5]), "viscosity": 3.0}


def tensor(values):
    return torch.tensor(np.asarray(values), dtype=torch.float64)


def wanted_of(values):
    return tensor(values).requires_grad_()


def test_dual_numbers_have_the_tangent_of_the_problem_and_no_graph_is_kept_where_none_is_asked_for(layer, problem):
    parameters, along = ({name: tensor(one) for name, one in own.items()} for own in (POINT, ALONG))
    with torch.autograd.forward_ad.dual_level():
        dual = {n: torch.autograd.forward_ad.make_dual(parameters[n], along[n]) for n in parameters}
        found = torch.autograd.forward_ad.unpack_dual(layer.value(problem)(dual)).tangent
    assert found.item() == problem.tangent(POINT, ALONG)
    with torch.no_grad():
        plain = layer.value(problem)({name: one.requires_grad_() for name, one in parameters.items()})
    assert plain.item() == problem.value(POINT) and not plain.requires_grad


def test_a_graph_is_gone_back_through_again_only_where_it_was_kept(layer, problem):
    viscosity = wanted_of(10.0)
    loss = layer.value(problem)({"viscosity": viscosity})
    loss.backward(retain_graph=True)
    first = viscosity.grad.clone()
    loss.backward()
    assert viscosity.grad == 2.0 * first
    with pytest.raises(RuntimeError, match="backward through the graph a second time"):
        loss.backward()


def test_residuals_of_a_graph_go_with_it(layer, simulation):
    from cortado.rollout.stepper import StepResidual

    def alive():
        gc.collect()
        return sum(isinstance(one, StepResidual) for one in gc.get_objects())

    before, viscosity = alive(), wanted_of(10.0)
    end = layer.step(simulation, layer.state(simulation), {"viscosity": viscosity}, steps=3)
    assert alive() == before + 1
    del end
    assert alive() == before


def test_a_state_may_be_a_view_and_be_written_to_afterwards(layer, simulation):
    state = layer.state(simulation)
    wanted = layer.step(simulation, state, steps=3)
    across = {**state, "positions": state["positions"].T.contiguous().T, "time": state["time"].expand(())}
    found = layer.step(simulation, across, steps=3)
    same_bits(found, wanted)
    found["positions"].zero_()
    found["reference_density"].mul_(2.0)
    same_bits(layer.step(simulation, state, steps=3), wanted)


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_a_lost_scene_of_a_map_adds_nothing_where_its_cotangent_is_0(layer, simulation, problem):
    gravities, first, viscosity = tensor([[0.4, -9.0], [9e5, 0.0], [-1.0, -8.0]]), layer.state(simulation), tensor(9.0)

    def end(gravity, viscosity):
        state = first
        for _ in range(2):
            state = layer.step(simulation, state, {"gravity": gravity, "viscosity": viscosity}, steps=3)
        return state["positions"].sum()

    def loss(gravity, viscosity):
        return layer.value(problem)({"gravity": gravity, "viscosity": viscosity})

    for function in (end, loss):
        each = torch.vmap(function, in_dims=(0, None))
        assert torch.isnan(each(gravities, viscosity)).tolist() == [False, True, False]
        found = torch.func.grad(lambda v, each=each: torch.nansum(each(gravities, v)))(viscosity)
        assert found == torch.func.grad(lambda v, each=each: each(gravities[[0, 2]], v).sum())(viscosity) != 0.0


def test_a_module_learns_its_parameters(layer, simulation):
    target = simulation.run(20, {"gravity": [1.0, -9.0]}).positions[-1]
    module = layer.Steps(simulation, 20, trained={"gravity": [0.0, -9.81]})
    optimiser, first, losses = torch.optim.LBFGS(module.parameters(), max_iter=10), layer.state(simulation), []

    def closure():
        optimiser.zero_grad()
        loss = 1e4 * torch.mean((module(first)["positions"] - tensor(target)) ** 2)
        loss.backward()
        losses.append(loss.item())
        return loss

    optimiser.step(closure)
    (gravity,) = module.parameters()
    np.testing.assert_allclose(gravity.detach(), [1.0, -9.0], atol=0.02)
    assert losses[-1] < 1e-3 * losses[0]
    viscous = layer.Steps(simulation, 20, {"gravity": [0.0, -9.81]}, gradients.AdjointViscosity())
    problem = Problem(simulation, 20, Squares({"positions": 1.0}), state=simulation.state())
    (viscous(first)["positions"] ** 2).sum().backward()
    wanted = problem.value_and_gradient({"gravity": [0.0, -9.81]}, gradients.AdjointViscosity())[1]
    np.testing.assert_allclose(next(viscous.parameters()).grad, wanted["gravity"], rtol=1e-12)
    again = layer.Steps(simulation, 20, trained={"gravity": [0.0, 0.0]})
    again.load_state_dict(module.state_dict())
    with torch.no_grad():
        same_bits(again(first, {"viscosity": 30.0}), module(first, {"viscosity": 30.0}))
    with pytest.raises(InputError, match="parameter gravity is given, but must be left out, as the module"):
        module(first, {"gravity": [0.0, 0.0]})


def test_a_compiled_function_leaves_it_as_it_is(layer, problem):
    def loss(viscosity):
        return 3.0 * layer.value(problem)({"viscosity": 2.0 * viscosity})

    compiled = torch.compile(loss, backend="eager")
    one, other = wanted_of(5.0), wanted_of(5.0)
    assert compiled(one).item() == loss(other).item()
    compiled(one).backward()
    loss(other).backward()
    assert one.grad == other.grad != 0.0


def test_what_is_measured_and_drawn_has_the_derivatives_of_differences(layer):
    simulation = Simulation(two_layers(), precision="float64")
    state = layer.state(simulation, simulation.step(simulation.state(), steps=5))
    renderer, colours = simulation.renderer(resolution=(9, 8)), wanted_of([[0.1, 0.4, 0.9], [0.7, 0.2, 0.1]])
    check = partial(torch.autograd.gradcheck, eps=1e-7, atol=1e-5, rtol=1e-4, fast_mode=True)
    own = state["positions"].clone().requires_grad_(), state["mass_fractions"].clone().requires_grad_()
    assert check(partial(layer.picture, renderer), (*own, colours), check_forward_ad=False)
    for what in ("pressure", sensors.PressureProbe([0.1, 0.1, 0.1])):
        reading = layer.measure(simulation, what)

        def read(positions, reading=reading):
            return 1e-3 * reading({**state, "positions": positions})

        assert check(read, (own[0],), check_forward_ad=True)


BAD_STATES = {
    **layered.BAD_STATES,
    "float32": (lambda s: {**s, "positions": s["positions"].float()}, "state positions is torch.float32, but must be"),
    "sparse": (lambda s: {**s, "positions": s["positions"].to_sparse()}, "torch.sparse_coo, but must be a dense"),
    "another device": (lambda s: {**s, "positions": s["positions"].to("meta")}, "state positions is on meta, but must"),
}
BAD_PARAMETERS = {
    **layered.BAD_PARAMETERS,
    "a tensor": (lambda: torch.ones(3), "parameters is tensor.*, but must be a dictionary"),
    "float32": (lambda: {"viscosity": torch.tensor(3.0)}, "parameter viscosity is torch.float32, but must be torch"),
    "another device": (lambda: {"viscosity": torch.zeros((), device="meta").double()}, "viscosity is on meta"),
    "negative": (lambda: {"viscosity": tensor(-1.0)}, "parameter viscosity is -1.0, but must be at least 0"),
}


@pytest.mark.parametrize("name", BAD_STATES)
def test_a_bad_state_is_refused_in_a_sentence(layer, simulation, problem, name):
    change, words = BAD_STATES[name]
    bad = change(layer.state(simulation))
    assert_refused(words, *uses_of_state(layer, simulation, problem, bad), lambda: layer.Steps(simulation)(bad))


@pytest.mark.parametrize("name", BAD_PARAMETERS)
def test_bad_parameters_are_refused_in_a_sentence(layer, simulation, problem, name):
    make, words = BAD_PARAMETERS[name]
    assert_refused(words, *uses_of_parameters(layer, simulation, problem, make))


def test_other_bad_uses_are_refused_in_a_sentence(layer, simulation, problem):
    state = layer.state(simulation)
    other = layer.state(Simulation(plane(discretisation={"spacing": 0.04}), precision="float64"))
    viscosity, flat = wanted_of(10.0), Simulation(plane(), precision="float64")
    picture, first = partial(layer.picture, flat.renderer(resolution=(9, 8))), layer.state(flat)["positions"]
    for use, words in [
        (lambda: layer.step(simulation, other), "state positions has shape"),
        (lambda: layer.rollout(simulation, state, steps=5, record_every=2), "record_every is 2, but must divide the 5"),
        (lambda: layer.value(simulation), "problem is Simulation.*, but must be a cortado.Problem"),
        (lambda: layer.picture(simulation, state["positions"]), "renderer is .*, but must be a renderer, such as"),
        (lambda: layer.Steps(problem), "simulation is .*, but must be a cortado.Simulation"),
        (lambda: layer.Steps(simulation, trained={"viscosity": "thick"}), "parameter viscosity is 'thick', but must"),
        (lambda: second(layer, problem, viscosity), "first derivatives exist: leave out create_graph=True"),
        (lambda: torch.func.hessian(lambda m: layer.value(problem)({"viscosity": m}))(tensor(1.0)), "only first"),
        (lambda: torch.func.jvp(picture, (first,), (first,)), "reverse mode only"),
    ]:
        assert_refused(words, use)
    with pytest.raises(DivergedError, match="The simulation diverged in step 1"):
        layer.step(simulation, {**state, "velocities": torch.full((64, 2), 400.0).double()}, steps=2)


def second(layer, problem, viscosity):
    loss = layer.value(problem)({"viscosity": viscosity})
    (gradient,) = torch.autograd.grad(loss, viscosity, create_graph=True)
    gradient.backward()


def test_a_float32_simulation_takes_float32(layer):
    simulation = Simulation(sheared())
    end = layer.step(simulation, layer.state(simulation), {"viscosity": torch.tensor(3.0), "gravity": [0.0, -9.0]})
    assert end["positions"].dtype == end["time"].dtype == torch.float32
    with pytest.raises(InputError, match=r"parameter viscosity is torch.float64, but must be torch.float32"):
        layer.step(simulation, layer.state(simulation), {"viscosity": tensor(3.0)})


def test_where_it_is_not_installed_there_is_one_sentence(monkeypatch):
    import sys

    for name in [name for name in sys.modules if name.endswith("layers.with_torch") or name == "cortado.torch"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ImportError, match=r"PyTorch is not installed, which cortado.torch needs: pip install torch$"):
        cortado.lazy.getter("cortado")("torch")
