"""What a setting may be: one behaviour for all of them."""

import math

import numpy as np
import pytest

from torchrl_l2c2._checks import check_choice, check_positive_int, check_real


@pytest.mark.parametrize("value", [True, np.True_, 1.0, "1", None])
def test_what_is_no_integer_is_a_type_error(value):
    """With the value and its type; a bool is no number."""
    name = type(value).__name__
    with pytest.raises(TypeError, match=rf"^k must be an integer, got .* \({name}\)\.$"):
        check_positive_int("k", value)


def test_integers_start_at_one():
    """Below is a ValueError."""
    check_positive_int("k", 1)
    check_positive_int("k", np.int64(1))
    with pytest.raises(ValueError, match=r"^k must be at least 1, got 0\.$"):
        check_positive_int("k", 0)


@pytest.mark.parametrize("value", [True, np.True_, "0.5", None, 1j])
def test_what_is_no_real_number_is_a_type_error(value):
    """Whatever the bounds."""
    with pytest.raises(TypeError, match=r"^x must be a real number, got .* \(\w+\)\.$"):
        check_real("x", value)


@pytest.mark.parametrize(
    ("bounds", "inside", "outside", "allowed"),
    [
        ({"above": 0}, [1e-30, 5], [0, -1.0, math.inf, math.nan], "finite and greater than 0"),
        ({"at_least": 0}, [0, np.float32(2)], [-1e-30, math.inf], "finite and at least 0"),
        ({"above": 0, "finite": False}, [math.inf], [0.0, math.nan], "greater than 0"),
        ({"above": 0, "below": 1}, [0.5], [0.0, 1.0, math.nan], r"in \(0, 1\)"),
        ({"at_least": 0, "at_most": 1}, [0, 1.0], [1.5, -math.inf], r"in \[0, 1\]"),
        ({"at_least": 0, "below": 0.25}, [0], [0.25], r"in \[0, 0.25\)"),
        ({}, [-1e30], [math.nan, -math.inf], "finite"),
    ],
)
def test_bounds(bounds, inside, outside, allowed):
    """The message says what is allowed; NaN is nowhere."""
    for value in inside:
        check_real("x", value, **bounds)
    for value in outside:
        with pytest.raises(ValueError, match=rf"^x must be {allowed}, got .*\. Try less\.$"):
            check_real("x", value, **bounds, hint="Try less.")


def test_choices():
    """Another string is a ValueError, another type a TypeError."""
    check_choice("mode", "b", ("a", "b"))
    with pytest.raises(ValueError, match=r"^mode must be 'a' or 'b', got 'c'\.$"):
        check_choice("mode", "c", ("a", "b"))
    with pytest.raises(TypeError, match=r"^mode must be 'a' or 'b', got 1 \(int\)\.$"):
        check_choice("mode", 1, ("a", "b"))
