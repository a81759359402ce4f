"""Synthetic traces are valid, repeat exactly, and touch what their docstrings say."""

from collections.abc import Callable

import numpy as np
import pytest

from traces.analysis import lane_fetches
from traces.check import check
from traces.synthetic import gather, pixel_pass, scatter, stream
from traces.texture import Texture, unpack_texel
from traces.trace import Trace, warp_of_rows

TEXTURE = Texture("setup", "RGBA16F", 37, 21, 3)


def active(trace: Trace) -> np.ndarray:
    """All active lanes' values, in order."""
    return np.concatenate([chunk.lanes[chunk.active] for chunk in trace.chunks()])


@pytest.mark.parametrize(
    ("make", "num_lane_fetches"),
    [
        (lambda: stream(40, 16), 40 * 16 * 32),
        (lambda: pixel_pass(TEXTURE, mip=1), 18 * 10),
        (lambda: gather(TEXTURE, 5, 4), 37 * 21 * 4),
        (lambda: scatter(37, 21, 18.0, 4, frames=2), 2 * 37 * 21 * (1 + 3 * 4)),
    ],
    ids=["stream", "pixel pass", "gather", "scatter"],
)
def test_traces_are_valid_and_repeat(make: Callable[[], Trace], num_lane_fetches: int) -> None:
    trace = make()
    assert check(trace).num_lane_fetches == num_lane_fetches
    np.testing.assert_array_equal(active(trace), active(trace))
    np.testing.assert_array_equal(active(trace), active(make()))


def test_another_seed_gives_other_samples() -> None:
    assert (active(gather(TEXTURE, 5, 4, seed=0)) != active(gather(TEXTURE, 5, 4, seed=1))).any()


def test_a_stream_reads_one_contiguous_run_once() -> None:
    addresses = np.sort(active(stream(16, 3, bytes_per_lane=4, warps_per_cta=2)))
    np.testing.assert_array_equal(np.diff(addresses), np.full(16 * 3 * 32 - 1, 4, np.uint64))


def test_a_pixel_pass_touches_every_texel_of_its_level_once() -> None:
    mip, y, x = unpack_texel(active(pixel_pass(TEXTURE, mip=1)))
    assert set(mip) == {1}
    assert sorted(zip(y, x, strict=True)) == [
        (row, column) for row in range(10) for column in range(18)
    ]


def test_a_warp_is_eight_by_four_pixels_row_major() -> None:
    chunk = next(iter(pixel_pass(Texture("a", "R8", 16, 16)).chunks()))
    _, y, x = unpack_texel(chunk.lanes[3])
    # The lower warp of the second tile.
    np.testing.assert_array_equal(x.reshape(4, 8), np.tile(np.arange(8, 16), (4, 1)))
    np.testing.assert_array_equal(y.reshape(4, 8), np.tile(np.arange(4, 8)[:, None], (1, 8)))


def test_gathered_texels_stay_within_the_radius_and_fill_it() -> None:
    texture = Texture("a", "R8", 64, 64)
    home = np.concatenate([np.repeat(c.lanes, 50, axis=0) for c in pixel_pass(texture).chunks()])
    reached = np.concatenate([c.lanes for c in gather(texture, 6, 50).chunks()])
    for at_home, at_sample in list(zip(unpack_texel(home), unpack_texel(reached), strict=True))[1:]:
        distance = at_sample.astype(int) - at_home
        assert (distance.min(), distance.max()) == (-6, 6)


def test_an_adaptive_scatter_fetches_less_and_its_lanes_end_at_different_steps() -> None:
    fixed, adaptive = (scatter(32, 32, 18.0, 16, adaptive=a) for a in (False, True))
    assert check(adaptive).num_lane_fetches < check(fixed).num_lane_fetches
    partial = [chunk.active.sum(axis=1) for chunk in adaptive.chunks()]
    assert ((np.concatenate(partial) > 0) & (np.concatenate(partial) < 32)).any()
    lengths = [np.bincount(warp_of_rows(chunk)) for chunk in adaptive.chunks()]
    assert len(set(np.concatenate(lengths))) > 1


def test_a_wider_scatter_reads_coarser_colour_but_planes_stay_at_mip_0() -> None:
    mean_mip = []
    for pixels_per_mm in (2.0, 18.0, 60.0):
        frame = lane_fetches(scatter(64, 64, pixels_per_mm, 8))
        colour = frame[frame["texture"] == "setup"]
        mean_mip.append(np.average(colour["mip"], weights=colour["lane_fetches"]))
        assert (frame[frame["texture"] != "setup"]["mip"] == 0).all()
    assert mean_mip[0] < mean_mip[1] < mean_mip[2]
