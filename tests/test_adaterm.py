"""AdaTerm against its recursion, and as a torch optimizer."""

import copy
import io
import math

import pytest
import torch
from torch import nn
from torch._dynamo.testing import CompileCounterWithBackend

from torchrl_l2c2 import AdaTerm

SHAPES = ((7, 3), (7,), (1,), (2, 2, 5), ())


def reference_step(state, theta, g, lr=1e-3, beta=0.9, eps=1e-5, nu_min=1.0):
    """One tensor, one step, the equations one by one; ``state`` is (m, v, nu, t)."""
    m, v, nu, t = state
    tiny = torch.finfo(torch.float32).tiny
    s = (g - m) ** 2
    big_d = (s / v).mean()
    w = (nu + 1) / (nu + big_d)
    w_bar = (nu + 1) / nu
    tau = (1 - beta) * w / w_bar
    ds = torch.clamp((s - big_d * v) / nu, min=eps**2)
    wn = w - math.log(max(w, tiny))
    wn_bar = max(w_bar - math.log(w_bar), -math.log(tiny))
    tau_nu = (1 - beta) * wn / wn_bar
    lam = ((nu + 2) / (nu + 1) + nu) / wn * (1 - nu_min / nu) + (nu_min + eps)
    m = m + tau * (g - m)
    v = v + tau * (s + ds - v)
    nu = nu + tau_nu * (lam - nu)
    t = t + 1
    bias = 1 - beta**t
    return (m, v, nu, t), theta - lr * (m / bias) / torch.sqrt(v / bias)


def reference_start(theta, eps=1e-5, nu_min=1.0):
    return torch.zeros_like(theta), torch.full_like(theta, eps**2), nu_min + eps, 0


def make_parameters(dtype=torch.float64, shapes=SHAPES):
    torch.manual_seed(0)
    return [nn.Parameter(torch.randn(shape, dtype=dtype)) for shape in shapes]


def set_gradients(parameters, seed, scale=1e-2):
    """Normal gradients, one tensor in ten of them a hundred times as large."""
    torch.manual_seed(seed)
    for p in parameters:
        factor = 100.0 if torch.rand(()) < 0.1 else 1.0
        p.grad = (torch.randn(p.shape, dtype=torch.float64) * scale * factor).to(p.dtype)


def run(optimizer, parameters, seeds):
    for seed in seeds:
        set_gradients(parameters, seed)
        optimizer.step()


def equal(a, b):
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def test_it_follows_the_published_trace():
    """Two small gradients and an outlier, to all ten digits."""
    theta = nn.Parameter(torch.zeros(3, dtype=torch.float64))
    optimizer = AdaTerm([theta])
    steps = (
        ([1e-5, -2e-5, 5e-6], [-1.129572051e-4, 2.107466539e-4, -5.723674329e-5]),
        ([1.2e-5, -1.8e-5, 4e-6], [-3.028607210e-4, 5.037027624e-4, -1.361372197e-4]),
        ([5e-4, -2e-5, 5e-6], [-4.425944009e-4, 7.493688573e-4, -2.023179152e-4]),
    )
    for gradient, expected in steps:
        theta.grad = torch.tensor(gradient, dtype=torch.float64)
        optimizer.step()
        exact = torch.tensor(expected, dtype=torch.float64)
        torch.testing.assert_close(theta.detach(), exact, rtol=5e-10, atol=0.0)


@pytest.mark.parametrize(
    "settings", [{}, {"lr": 0.1, "beta": 0.6, "eps": 1e-3, "nu_min": 3.0}], ids=["paper", "other"]
)
def test_the_fast_form_is_the_recursion_for_every_tensor(settings):
    """Fifty random steps with outliers give what the plain equations give, tensor by tensor."""
    parameters = make_parameters()
    optimizer = AdaTerm(parameters, **settings)
    start = {k: v for k, v in settings.items() if k in ("eps", "nu_min")}
    expected = [p.detach().clone() for p in parameters]
    states = [reference_start(p, **start) for p in expected]
    for seed in range(50):
        run(optimizer, parameters, [seed])
        for i, p in enumerate(parameters):
            states[i], expected[i] = reference_step(states[i], expected[i], p.grad, **settings)
    for p, theta, (m, v, nu, _) in zip(parameters, expected, states, strict=True):
        state = optimizer.state[p]
        torch.testing.assert_close(p.detach(), theta, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(state["exp_avg"], m, rtol=1e-9, atol=1e-14)
        torch.testing.assert_close(state["exp_avg_var"], v, rtol=1e-9, atol=0.0)
        assert state["nu"].item() == pytest.approx(float(nu), rel=1e-12)
        assert state["step"].item() == 50


def test_float32_follows_float64():
    """But for the degrees of freedom, whose changes next to nu_min float32 rounds away."""
    results = []
    for dtype in (torch.float32, torch.float64):
        parameters = make_parameters(dtype, shapes=((4, 3), (3,)))
        optimizer = AdaTerm(parameters)
        run(optimizer, parameters, range(600))
        nu = torch.stack([optimizer.state[p]["nu"] for p in parameters]).double()
        results.append(([p.detach().double() for p in parameters], nu))
    (single, single_nu), (double, double_nu) = results
    torch.testing.assert_close(single, double, rtol=1e-4, atol=1e-5)
    assert (double_nu - 1.0 > 2e-5).all()
    assert (single_nu - 1.0 < 1.1e-5).all()


@pytest.mark.parametrize("nu_min", [0.5, 1.0, 10.0])
def test_the_degrees_of_freedom_stay_above_their_minimum(nu_min):
    """Whatever the gradients: zero, constant, tiny, heavy-tailed or huge."""
    torch.manual_seed(0)
    theta = nn.Parameter(torch.zeros(6))
    optimizer = AdaTerm([theta], nu_min=nu_min)
    heavy = torch.distributions.StudentT(torch.tensor(1.0))
    draws = (
        lambda: torch.zeros(6),
        lambda: torch.ones(6),
        lambda: torch.randn(6) * 1e-12,
        lambda: heavy.sample((6,)),
        lambda: torch.randn(6) * 1e12,
    )
    for draw in draws:
        for _ in range(60):
            theta.grad = draw()
            optimizer.step()
            assert optimizer.state[theta]["nu"] >= nu_min
    assert theta.isfinite().all()


def test_fewer_outliers_raise_the_degrees_of_freedom():
    """Clean gradients end with a larger nu than gradients with outliers among them."""

    def final_nu(outliers):
        torch.manual_seed(1)
        theta = nn.Parameter(torch.zeros(50, dtype=torch.float64))
        optimizer = AdaTerm([theta], beta=0.5)
        for step in range(1500):
            factor = 100.0 if outliers and step % 10 == 0 else 1.0
            theta.grad = torch.randn(50, dtype=torch.float64) * 1e-2 * factor
            optimizer.step()
        return optimizer.state[theta]["nu"].item()

    clean, noisy = final_nu(False), final_nu(True)
    assert clean > 2.0
    assert noisy - 1.0 < 0.5 * (clean - 1.0)


@pytest.mark.parametrize("nu_min", [1.0, 1e6])
def test_an_outlier_hardly_moves_the_moments_unless_nu_is_large(nu_min):
    """Next to an exponential moving average, the limit of large nu, which it moves in full."""
    torch.manual_seed(0)
    theta = nn.Parameter(torch.zeros(20, dtype=torch.float64))
    optimizer = AdaTerm([theta], nu_min=nu_min)
    for _ in range(300):
        theta.grad = torch.randn(20, dtype=torch.float64) * 1e-2
        optimizer.step()
    before = optimizer.state[theta]["exp_avg"].clone()
    theta.grad = torch.full((20,), 1.0, dtype=torch.float64)
    optimizer.step()
    moved = (optimizer.state[theta]["exp_avg"] - before) / (0.1 * (theta.grad - before))
    if nu_min == 1.0:
        assert (moved < 1e-3).all()
    else:
        assert (moved > 0.95).all()


def test_warm_up_takes_as_long_as_documented():
    """The first gradient gets next to no weight; the scale arrives at the gradients' in time."""
    torch.manual_seed(0)
    theta = nn.Parameter(torch.zeros(100))
    optimizer = AdaTerm([theta])
    theta.grad = torch.randn(100) * 1e-2
    optimizer.step()
    assert optimizer.state[theta]["exp_avg"].abs().max() < 1e-5 * theta.grad.abs().max()
    steps = 1
    while optimizer.state[theta]["exp_avg_var"].mean() < 0.5e-4:
        theta.grad = torch.randn(100) * 1e-2
        optimizer.step()
        steps += 1
    documented = 2.0 * math.log(1e-2 / 1e-5) / (1.0 - 0.9)
    assert 0.8 * documented < steps < documented


def test_it_minimizes_a_quadratic_with_noisy_gradients():
    """Ill-conditioned, from afar, with an outlier in every twentieth gradient."""
    torch.manual_seed(0)
    curvature = torch.tensor([1.0, 10.0])
    x = nn.Parameter(torch.tensor([2.0, -1.0]))
    optimizer = AdaTerm([x], lr=1e-2)
    for step in range(1500):
        factor = 1000.0 if step % 20 == 19 else 0.1
        x.grad = curvature * x.detach() + factor * torch.randn(2)
        optimizer.step()
    assert (0.5 * curvature * x.detach().square()).sum() < 1e-2


def test_tensors_do_not_depend_on_each_other_nor_on_their_order():
    """A tensor alone, among others, and in reversed order: the same bits."""
    together, order, alone = make_parameters(), make_parameters(), make_parameters()
    first, second = AdaTerm(together), AdaTerm(order[::-1])
    singles = [AdaTerm([p]) for p in alone]
    for seed in range(5):
        for parameters in (together, order, alone):
            set_gradients(parameters, seed)
        for optimizer in (first, second, *singles):
            optimizer.step()
    assert equal(together, order)
    assert equal(together, alone)


def test_dtypes_and_devices_may_be_mixed_in_one_group():
    """A float32 and a float64 parameter each follow as if alone, also next to another device."""
    mixed = [nn.Parameter(torch.ones(3)), nn.Parameter(torch.ones(3, dtype=torch.float64))]
    alone = copy.deepcopy(mixed)
    elsewhere = nn.Parameter(torch.ones(3, device="meta"))
    elsewhere.grad = torch.ones(3, device="meta")
    run(AdaTerm([elsewhere, *mixed]), mixed, range(3))
    for i, p in enumerate(alone):
        optimizer = AdaTerm([p])
        for seed in range(3):
            set_gradients(alone, seed)
            optimizer.step()
        assert torch.equal(p, mixed[i])
        assert p.dtype == mixed[i].dtype


def test_settings_of_other_optimizers_are_refused():
    """A group that should decay would not; one without decay is as meant."""
    p = nn.Parameter(torch.ones(2))
    with pytest.raises(TypeError, match=r"'nu_min'\], got \['weight_decay'\], which would have no"):
        AdaTerm([{"params": [p], "weight_decay": 0.5}])
    AdaTerm([{"params": [p], "weight_decay": 0.0, "name": "actor"}])


def test_parameters_without_gradient_keep_value_and_state():
    """They are skipped, and go on from where they were when a gradient comes."""
    a, b = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(2))
    optimizer = AdaTerm([a, b])
    a.grad, b.grad = torch.ones(2), torch.ones(2)
    optimizer.step()
    value, state = b.detach().clone(), copy.deepcopy(optimizer.state[b])
    optimizer.zero_grad()
    assert b.grad is None
    a.grad = torch.ones(2)
    optimizer.step()
    assert optimizer.state[a]["step"] == 2
    assert torch.equal(b, value)
    assert equal(optimizer.state[b].values(), state.values())
    b.grad = torch.ones(2)
    optimizer.step()
    assert optimizer.state[b]["step"] == 2
    assert torch.equal(b, _two_steps_of_ones())


def _two_steps_of_ones():
    p = nn.Parameter(torch.ones(2))
    optimizer = AdaTerm([p])
    for _ in range(2):
        p.grad = torch.ones(2)
        optimizer.step()
    return p.detach()


def test_groups_have_their_own_settings():
    """Twice the learning rate moves twice as far; a group added later starts from its own eps."""
    slow, fast, late = (nn.Parameter(torch.zeros(3, dtype=torch.float64)) for _ in range(3))
    optimizer = AdaTerm([{"params": [slow]}, {"params": [fast], "lr": 2e-3}])
    optimizer.add_param_group({"params": [late], "eps": 1e-4})
    for p in (slow, fast, late):
        p.grad = torch.tensor([1e-3, 2e-3, 3e-3], dtype=torch.float64)
    optimizer.step()
    torch.testing.assert_close(fast.detach(), 2.0 * slow.detach(), rtol=1e-12, atol=0.0)
    state = reference_start(torch.zeros(3, dtype=torch.float64), eps=1e-4)
    _, expected = reference_step(state, torch.zeros(3), late.grad, eps=1e-4)
    torch.testing.assert_close(late.detach(), expected, rtol=1e-10, atol=0.0)


@pytest.mark.parametrize("tensor", [False, True])
def test_a_scheduled_learning_rate_takes_effect(tensor):
    """Half the rate, half the step, whether it is a float or a tensor."""
    theta = nn.Parameter(torch.zeros(3, dtype=torch.float64))
    start = torch.tensor(1e-3, dtype=torch.float64) if tensor else 1e-3
    halved, constant = AdaTerm([theta], lr=start), AdaTerm([copy.deepcopy(theta)])
    schedule = torch.optim.lr_scheduler.ExponentialLR(halved, gamma=0.5)
    steps = []
    for optimizer in (halved, constant):
        p = optimizer.param_groups[0]["params"][0]
        for i in range(2):
            before = p.detach().clone()
            p.grad = torch.tensor([1e-3, -2e-3, 1e-4 * i], dtype=torch.float64)
            optimizer.step()
            if optimizer is halved:
                schedule.step()
        steps.append(p.detach() - before)
    torch.testing.assert_close(steps[0], 0.5 * steps[1], rtol=1e-9, atol=0.0)


def test_a_closure_is_evaluated_with_gradients():
    """The step returns its loss and uses its gradients."""
    x = nn.Parameter(torch.tensor([2.0]))
    optimizer = AdaTerm([x], lr=1.0)

    def closure():
        optimizer.zero_grad()
        loss = x.square().sum()
        loss.backward()
        return loss

    assert optimizer.step(closure).item() == 4.0
    assert x.item() < 2.0


def test_its_state_resumes_bit_for_bit():
    """Saved to disk in the safe format, loaded into a fresh optimizer, and copied in memory."""
    parameters = make_parameters(torch.float32)
    optimizer = AdaTerm(parameters, lr=1e-2)
    run(optimizer, parameters, range(10))

    file = io.BytesIO()
    torch.save(optimizer.state_dict(), file)
    file.seek(0)
    resumed = [nn.Parameter(p.detach().clone()) for p in parameters]
    loaded = AdaTerm(resumed, lr=0.5)
    loaded.load_state_dict(torch.load(file, weights_only=True))
    copied, copy_of_optimizer = copy.deepcopy((parameters, optimizer))

    run(optimizer, parameters, range(10, 20))
    run(loaded, resumed, range(10, 20))
    run(copy_of_optimizer, copied, range(10, 20))
    assert equal(parameters, resumed)
    assert equal(parameters, copied)
    for p, q in zip(parameters, resumed, strict=True):
        assert equal(optimizer.state[p].values(), loaded.state[q].values())


def test_a_loaded_state_lives_where_the_parameters_live():
    """The step count, too, which torch would leave where it was saved."""
    saved = AdaTerm([nn.Parameter(torch.ones(2))]).state_dict()
    p = nn.Parameter(torch.ones(2, device="meta"))
    optimizer = AdaTerm([p])
    optimizer.load_state_dict(saved)
    assert {value.device.type for value in optimizer.state[p].values()} == {"meta"}


def test_large_gradients_pass_and_those_that_are_not_finite_show():
    """1e18 is ignored; NaN and infinity reach their own tensor, and no other."""
    huge, nan, inf, fine = (nn.Parameter(torch.zeros(2)) for _ in range(4))
    optimizer = AdaTerm([huge, nan, inf, fine])
    for p, value in ((huge, 1e18), (nan, math.nan), (inf, math.inf), (fine, 1e-3)):
        p.grad = torch.full((2,), value)
    optimizer.step()
    assert huge.isfinite().all()
    assert all(value.isfinite().all() for value in optimizer.state[huge].values())
    assert nan.isnan().all()
    assert inf.isnan().all()
    assert (fine.isfinite() & (fine != 0.0)).all()


def test_compiled_it_gives_the_same_numbers_without_recompiling():
    """With a scheduled learning rate as a tensor, several dtypes, and gradients set inside."""
    torch._dynamo.reset()
    outcomes, compilations = [], []
    for compiled in (False, True):
        parameters = make_parameters(torch.float32)
        parameters.append(nn.Parameter(torch.ones(2, dtype=torch.float64)))
        lr = torch.tensor(1e-2)
        optimizer = AdaTerm(parameters, lr=lr)

        def update(gradients, parameters=parameters, optimizer=optimizer):
            for p, gradient in zip(parameters, gradients, strict=True):
                p.grad = gradient
            optimizer.step()

        if compiled:
            counter = CompileCounterWithBackend("aot_eager")
            update = torch.compile(update, backend=counter, fullgraph=True)
        for seed in range(4):
            set_gradients(parameters, seed)
            gradients = [p.grad.clone() for p in parameters]
            optimizer.zero_grad()
            update(gradients)
            lr.mul_(0.5)
            if compiled:
                compilations.append(counter.frame_count)
        state = [x for p in parameters for x in optimizer.state[p].values()]
        outcomes.append([*parameters, *state])
    assert equal(*outcomes)
    assert compilations[0] > 0
    assert len(set(compilations)) == 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"lr": -1e-3}, "lr must be finite and at least 0"),
        ({"lr": math.nan}, "lr must be finite"),
        ({"lr": torch.ones(2)}, "lr must be a single number"),
        ({"beta": 0.0}, r"beta must be in \(0, 1\)"),
        ({"beta": 1.0}, r"beta must be in \(0, 1\)"),
        ({"eps": 0.0}, "eps must be finite and greater than"),
        ({"eps": 1e-20}, "eps must be finite and greater than 1.08.e-19"),
        ({"nu_min": 0.0}, "nu_min must be finite and greater than 0"),
        ({"nu_min": math.inf}, "nu_min must be finite"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    """At construction and for a group of its own, naming the setting and what is allowed."""
    with pytest.raises(ValueError, match=message):
        AdaTerm([nn.Parameter(torch.ones(1))], **settings)
    optimizer = AdaTerm([nn.Parameter(torch.ones(1))])
    with pytest.raises(ValueError, match=message):
        optimizer.add_param_group({"params": [nn.Parameter(torch.ones(1))], **settings})
    assert len(optimizer.param_groups) == 1


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.complex64])
def test_other_dtypes_are_refused(dtype):
    """Half precision cannot hold the squared scales; the optimizer stays as it was."""
    optimizer = AdaTerm([nn.Parameter(torch.ones(1))])
    with pytest.raises(TypeError, match="must be float32 or float64"):
        optimizer.add_param_group({"params": [nn.Parameter(torch.ones(2, dtype=dtype))]})
    assert len(optimizer.param_groups) == 1


def test_sparse_gradients_are_refused():
    """With a message of its own."""
    embedding = nn.Embedding(4, 2, sparse=True)
    embedding(torch.tensor([1])).sum().backward()
    with pytest.raises(RuntimeError, match="sparse gradients are not supported"):
        AdaTerm(embedding.parameters()).step()


@pytest.mark.parametrize("other", [torch.optim.Adam, torch.optim.SGD])
def test_another_optimizers_state_is_refused(other):
    """When it is loaded, and with nothing changed."""
    x = torch.nn.Parameter(torch.ones(2))
    optimizer = AdaTerm([x], lr=0.5)
    with pytest.raises(ValueError, match=r"the state has no .*nu_min.* it is another optimizer's"):
        optimizer.load_state_dict(other([x], lr=0.1).state_dict())
    assert optimizer.param_groups[0]["lr"] == 0.5


def test_the_state_of_parameters_of_other_shapes_is_refused():
    """When it is loaded, and with nothing changed."""
    small, large = (
        AdaTerm([nn.Parameter(torch.ones(1)), nn.Parameter(torch.ones(size))], lr=0.1 * size)
        for size in (2, 3)
    )
    with pytest.raises(ValueError, match=r"parameter 1 of the state has the shape \(3,\), got .*2"):
        small.load_state_dict(large.state_dict())
    assert small.param_groups[0]["lr"] == 0.2


def test_a_parameter_without_numbers_stays_as_it_is():
    """And leaves no NaN in what is saved."""
    empty, x = torch.nn.Parameter(torch.ones(0)), torch.nn.Parameter(torch.ones(1))
    optimizer = AdaTerm([empty, x], lr=0.5)
    for _ in range(100):
        optimizer.zero_grad()
        (x.square().sum() + empty.sum()).backward()
        optimizer.step()
    assert x.item() < 1.0
    assert all(state["nu"].isfinite() for state in optimizer.state.values())
