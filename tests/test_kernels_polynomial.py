"""Our float32 functions against float64 NumPy, and their OpenCL twins against NumPy's bits."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest

from kernels import polynomial

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

    text = resources.files("kernels").joinpath("polynomial.cl").read_text() + _KERNEL
    x = log_uniform(1e-6, 80)
    turns = RANDOM.integers(0, 1 << 32, COUNT, dtype=np.uint32)
    flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
    sources = [cl.Buffer(device.context, flags, hostbuf=array) for array in (x, turns)]
    target = cl.Buffer(device.context, cl.mem_flags.WRITE_ONLY, 6 * x.nbytes)
    program = device.build(text, [f"-DWIDTH={width}"])
    program.run(device.queue, (COUNT,), None, *sources, target)
    found = np.empty((6, COUNT), np.float32)
    cl.enqueue_copy(device.queue, found, target)
    expected = [
        polynomial.poly_log(x),
        polynomial.poly_exp(-x),
        polynomial.poly_cbrt(x),
        polynomial.poly_gamma(x),
        *polynomial.poly_cos_sin(turns),
    ]
    names = ("log", "exp", "cbrt", "gamma", "cos", "sin")
    for name, got, want in zip(names, found, expected, strict=True):
        assert np.array_equal(got.view(np.uint32), want.view(np.uint32)), name
