"""Our float32 functions against float64 NumPy, and their OpenCL twins against NumPy's bits."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest

from kernels.maths import polynomial

RANDOM = np.random.default_rng(20200501)
COUNT = 20_000

_KERNEL = """
__kernel void run(__global const float *x, __global const uint *turn, __global float *out)
{
    const uint i = (uint)get_global_id(0), n = (uint)get_global_size(0);
    real c, s;
    poly_cos_sin((word)(turn[i]), &c, &s);
    const real v = (real)(x[i]);
    const real results[6] = {poly_log(v), poly_exp(-v), poly_cbrt(v), poly_gamma(v), c, s};
    for (uint k = 0; k < 6; ++k)
#if WIDTH == 1
        out[k * n + i] = results[k];
#else
        out[k * n + i] = results[k].s5;
#endif
}
"""


def ulps(value, exact):
    return np.abs(value.astype(np.float64) - exact) / np.spacing(np.abs(exact).astype(np.float32))


def log_uniform(low, high):
    return np.exp(RANDOM.uniform(np.log(low), np.log(high), COUNT)).astype(np.float32)


@pytest.mark.parametrize(
    ("function", "exact", "x", "bound"),
    [
        (polynomial.poly_log, np.log, log_uniform(1e-37, 1e37), 2),
        (polynomial.poly_log, np.log, RANDOM.uniform(0.5, 2, COUNT).astype(np.float32), 2),
        (polynomial.poly_exp, np.exp, RANDOM.uniform(-86, 86, COUNT).astype(np.float32), 2),
        (polynomial.poly_exp, np.exp, -log_uniform(1e-9, 1), 2),
        (polynomial.poly_cbrt, np.cbrt, log_uniform(1e-37, 1e37), 4),
        (polynomial.poly_gamma, lambda v: v ** (1 / 2.2), log_uniform(1e-7, 1e5), 12),
    ],
)
def test_functions_are_within_a_few_ulp(function, exact, x, bound):
    assert ulps(function(x), exact(x.astype(np.float64))).max() < bound


def test_exact_points():
    one = np.ones(1, np.float32)
    assert polynomial.poly_log(one) == 0
    assert polynomial.poly_exp(0 * one) == 1
    assert polynomial.poly_gamma(0 * one) == 0
    turns = np.array([0, 1 << 30, 1 << 31, 3 << 30], np.uint32)
    cosine, sine = polynomial.poly_cos_sin(turns)
    assert cosine.tolist() == [1, 0, -1, 0]
    assert sine.tolist() == [0, 1, 0, -1]


def test_cosine_and_sine_over_the_whole_turn():
    turns = RANDOM.integers(0, 1 << 32, COUNT, dtype=np.uint32)
    cosine, sine = polynomial.poly_cos_sin(turns)
    angle = turns * (2 * np.pi / 2**32)
    assert np.abs(cosine - np.cos(angle)).max() < 1.2e-7
    assert np.abs(sine - np.sin(angle)).max() < 1.2e-7


@pytest.mark.parametrize("width", [1, 8])
def test_devices_compute_the_same_bits(device, width):
    from importlib import resources

    text = resources.files("kernels.maths").joinpath("polynomial.cl").read_text() + _KERNEL
    x = log_uniform(1e-6, 80)
    turns = RANDOM.integers(0, 1 << 32, COUNT, dtype=np.uint32)
    found = run(device, text, width, x, turns)
    names = ("log", "exp", "cbrt", "gamma", "cos", "sin")
    for name, got, want in zip(names, found, computed(x, turns), strict=True):
        assert np.array_equal(got.view(np.uint32), want.view(np.uint32)), name


def run(device, text, width, x, turns):
    """What a text's functions make of the numbers, a row per function."""
    flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
    sources = [cl.Buffer(device.context, flags, hostbuf=array) for array in (x, turns)]
    target = cl.Buffer(device.context, cl.mem_flags.WRITE_ONLY, 6 * x.nbytes)
    program = device.build(text, [f"-DWIDTH={width}"])
    program.run(device.queue, (COUNT,), None, *sources, target)
    found = np.empty((6, COUNT), np.float32)
    cl.enqueue_copy(device.queue, found, target)
    return found


def computed(x, turns):
    """The same by NumPy."""
    return [
        polynomial.poly_log(x),
        polynomial.poly_exp(-x),
        polynomial.poly_cbrt(x),
        polynomial.poly_gamma(x),
        *polynomial.poly_cos_sin(turns),
    ]


@pytest.mark.opencl
def test_the_native_twins_compute_the_same_functions(device):
    """They are only counted: here the device's built-in functions stand for the units."""
    from importlib import resources

    units = """
    #define UNIT_LOG2 native_log2
    #define UNIT_EXP2 native_exp2
    #define UNIT_COS(turns) native_cos((turns) * 0x1.921fb6p+2f)
    #define UNIT_SIN(turns) native_sin((turns) * 0x1.921fb6p+2f)
    """
    text = resources.files("kernels.maths").joinpath("native.cl").read_text() + _KERNEL
    x = log_uniform(1e-6, 80)
    turns = RANDOM.integers(0, 1 << 32, COUNT, dtype=np.uint32)
    found = run(device, "\n".join(line.strip() for line in units.splitlines()) + text, 1, x, turns)
    for got, want in zip(found, computed(x, turns), strict=True):
        assert np.abs(got - want).max() < 1e-4 * max(1, np.abs(want).max())
