"""Compiled functions: the same numbers, from one graph, for every run of a sweep."""

import pytest
import torch
from torch._inductor import config as inductor_config

from torchrl_l2c2.experiment.errors import CompilerError
from torchrl_l2c2.experiment.learn import compilation
from torchrl_l2c2.experiment.learn.compilation import compiled, compiler_available

pytestmark = pytest.mark.skipif(not compiler_available(), reason="no C++ compiler")


def counted(function):
    """The function, and how often it ran as Python."""
    runs = []

    def counting(*args):
        runs.append(args)
        return function(*args)

    return counting, runs


def test_random_numbers_and_gradients_are_those_of_the_plain_function():
    """PyTorch's own generator, and one graph with the gradient in it; tracing draws nothing."""

    def noisy_slope(x):
        y = (x * torch.rand_like(x)).square().sum()
        return torch.autograd.grad(y, [x])[0]

    x = torch.arange(4.0, requires_grad=True)
    ours = compiled(noisy_slope)
    for seed in range(2):
        torch.manual_seed(seed)
        expected = noisy_slope(x)
        torch.manual_seed(seed)
        torch.testing.assert_close(ours(x), expected)


def test_what_is_written_into_tensors_is_followed_and_nothing_else():
    """The graph has the tensors, and the settings of its first call."""
    weight, setting = torch.ones(2), {"scale": 1.0}
    ours = compiled(lambda x: setting["scale"] * weight * x)
    assert ours(torch.ones(2)).tolist() == [1.0, 1.0]
    weight.fill_(3.0)
    assert ours(torch.ones(2)).tolist() == [3.0, 3.0]
    setting["scale"] = 10.0
    assert ours(torch.ones(2)).tolist() == [3.0, 3.0]


def test_tracing_writes_into_nothing_and_every_call_does():
    """Also by another name for the same memory, as parameters and their ``data`` are."""
    total = torch.nn.Parameter(torch.zeros(2))
    half = total.data[:1]

    def add(x):
        total.data.add_(x)
        half.add_(10.0)
        return total * 1.0

    ours = compiled(add)
    assert ours(torch.ones(2)).tolist() == [11.0, 1.0]
    assert ours(torch.ones(2)).tolist() == [22.0, 2.0]
    assert total.tolist() == [22.0, 2.0]


def test_other_arguments_have_graphs_of_their_own_and_known_ones_none_anew():
    """By shape, strides, type, nesting, and by value where they are no tensors."""
    scaled, runs = counted(lambda pair, double: pair[0] * (2.0 if double else 1.0))
    ours = compiled(scaled)
    x = torch.ones(2)
    for arguments, expected in (
        (((x, None), False), [1.0, 1.0]),
        (((x, None), True), [2.0, 2.0]),
        (((x.double(), None), True), [2.0, 2.0]),
        (((x, x), True), [2.0, 2.0]),
        (((torch.ones(3), None), False), [1.0, 1.0, 1.0]),
        (((torch.tensor([[1.0, 9.0], [3.0, 9.0]])[:, 0], None), False), [1.0, 3.0]),
    ):
        for _ in range(2):
            assert ours(*arguments).tolist() == expected
    assert len(runs) == 6


def test_contents_may_not_decide_what_is_done():
    """It is told, instead of what the first call's contents decide being done ever after."""
    with pytest.raises(torch.fx.experimental.symbolic_shapes.GuardOnDataDependentSymNode):
        compiled(lambda x: x if x.sum() > 0 else -x)(torch.ones(2))


def test_what_keeps_a_traced_tensor_is_told():
    """At the next graph that would read it."""
    kept = []

    def keeping(x):
        kept.append(x * 2.0)
        return x + kept[0]

    ours = compiled(keeping)
    assert ours(torch.ones(2)).tolist() == [3.0, 3.0]
    with pytest.raises(RuntimeError, match=r"shape \(2,\) of an earlier trace"):
        ours(torch.ones(1))


def test_a_compiler_that_fails_is_one_line(tmp_path, monkeypatch):
    """The one that says why, with what to do; the rest is the error's cause."""
    broken = tmp_path / "g++"
    lines = ("#!/bin/sh", '[ "$*" = --version ] && exec g++ "$@"', "echo In file included >&2")
    broken.write_text("\n".join([*lines, "echo a.h:1: error: no >&2", "exit 1"]))
    broken.chmod(0o755)
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    options = {"cpp.cxx": (str(broken),), "force_disable_caches": True}
    why = r"^the compiler failed \(a.h:1: error: no\): set compile="
    with inductor_config.patch(options), pytest.raises(CompilerError, match=why) as told:
        compiled(lambda x: x.sin() + 7.5)(torch.rand(3))
    assert "In file included" in str(told.value.__cause__)


@pytest.mark.parametrize("inside", [True, False])
def test_an_incomplete_library_in_the_cache_is_compiled_again(tmp_path, monkeypatch, inside):
    """A process that was killed while it compiled left it; files elsewhere are not touched."""
    cache = tmp_path / "cache"
    library = (cache if inside else tmp_path) / "abc.main.so"
    cache.mkdir()
    library.touch()
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(cache))

    def load(*args):
        if library.exists():
            raise RuntimeError(f"ImportError: {library}: file too short")
        return lambda x: [x.sin()]

    monkeypatch.setattr(compilation, "compile_graph", load)
    x = torch.rand(3)
    if inside:
        assert torch.equal(compiled(torch.sin)(x), x.sin())
    else:
        with pytest.raises(CompilerError, match="file too short"):
            compiled(torch.sin)(x)
    assert library.exists() is not inside
