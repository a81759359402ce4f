"""Lane-address traces from anywhere: an `.npz` with the byte address of every lane of every access,
to and from a Trace.

The file holds `addresses` (warps, loads, 32) uint64, 0 = inactive lane; the integers
`warps_per_cta`, `loads_in_flight`, `compute_per_load`, `bytes_per_lane`; and, where some accesses
are stores, `stores` (loads,) bool. Warp w is of CTA w // warps_per_cta. A warp runs one integer
instruction, then groups of `loads_in_flight` accesses issued back to back, each group followed by
`compute_per_load` FMAs per load of it, in load order, which use that load's result; then it exits.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from traces.check import ACCESS_BYTES, MAX_INSTRUCTIONS, MAX_WARPS_PER_CTA
from traces.errors import InputError
from traces.files import replacing, writing
from traces.texture import INACTIVE_ADDRESS, WARP_SIZE
from traces.trace import WAIT, Chunk, Instruction, Launch, Trace

PASS_NAME = "import"
REGISTERS_PER_THREAD = 32
_SCALARS = ("warps_per_cta", "loads_in_flight", "compute_per_load", "bytes_per_lane")
_ROWS_PER_CHUNK = 1 << 16
_MAX_COUNT = (1 << 31) - 1

Arithmetic = tuple[tuple[str, int], ...]


def read_lane_address(path: str | Path) -> Trace:
    """The Trace of a lane-address file, which is held in memory whole.

    Raises:
        InputError: no such file, not an `.npz`, truncated or corrupt, pickled arrays, a missing
            field, or a wrong shape, type or value.
    """
    path = Path(path)
    fields = _load(path)
    for field in ("addresses", *_SCALARS):
        if field not in fields:
            raise InputError(f"{path}: {field} is missing; need addresses, {', '.join(_SCALARS)}")
    scalars = {}
    for field in _SCALARS:
        value = fields[field]
        if value.shape != () or value.dtype.kind not in "iu":
            raise InputError(
                f"{path}: {field}: {value.dtype} of shape {value.shape}: need one integer"
            )
        scalars[field] = int(value)
    return lane_address_trace(
        fields["addresses"], **scalars, stores=fields.get("stores"), name=str(path)
    )


def write_lane_address(
    path: str | Path,
    addresses: npt.NDArray[np.uint64],
    *,
    warps_per_cta: int,
    loads_in_flight: int,
    compute_per_load: int,
    bytes_per_lane: int,
    stores: npt.NDArray[np.bool_] | None = None,
) -> None:
    """Write a lane-address file, with the arguments of `lane_address_trace`.

    Raises:
        InputError: arguments that `read_lane_address` would refuse, a name that does not end in
            `.npz`, or a folder that cannot be written to.
        WorkError: writing failed, for example for want of space. Nothing is left behind.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise InputError(f"{path}: the name of a lane-address file must end in .npz")
    scalars = {
        "warps_per_cta": warps_per_cta,
        "loads_in_flight": loads_in_flight,
        "compute_per_load": compute_per_load,
        "bytes_per_lane": bytes_per_lane,
    }
    lane_address_trace(addresses, **scalars, stores=stores, name=str(path))
    fields = {field: np.int64(value) for field, value in scalars.items()}
    optional = {} if stores is None else {"stores": stores}
    with replacing(path) as part, writing(path):
        np.savez_compressed(part, allow_pickle=False, addresses=addresses, **fields, **optional)


def lane_address_trace(
    addresses: npt.NDArray[np.uint64],
    *,
    warps_per_cta: int,
    loads_in_flight: int,
    compute_per_load: int,
    bytes_per_lane: int,
    stores: npt.NDArray[np.bool_] | None = None,
    name: str = "lane addresses",
) -> Trace:
    """The Trace of an array of addresses.

    addresses: (warps, loads, 32) uint64 byte addresses, multiples of bytes_per_lane, 0 = inactive.
        A last CTA with fewer than warps_per_cta warps is filled up with warps that have no
        accesses; the manifest's `padding_warps` counts them.
    warps_per_cta: 1 to 32. loads_in_flight: at least 1. compute_per_load: at least 0.
        bytes_per_lane: 1, 2, 4, 8 or 16.
    stores: (loads,) bool, the accesses that are stores. name: what messages call the trace.

    The FMAs of a group stand in the `arithmetic` of the access after it, those of the last group in
    the launch's `trailing_arithmetic`: per load a wait until only those behind it in the group may
    be in flight, and a run of `compute_per_load`. Without FMAs a load's result is waited for by the
    load that takes its register, the one at its place in the next group: its `num_outstanding` then
    keeps to `loads_in_flight`. A thread has 32 registers.

    Raises:
        InputError: a wrong shape, type or value.
    """
    scalars = {
        "warps_per_cta": warps_per_cta,
        "loads_in_flight": loads_in_flight,
        "compute_per_load": compute_per_load,
        "bytes_per_lane": bytes_per_lane,
    }
    stores = _check(addresses, scalars, stores, name)
    num_warps, num_loads, _ = addresses.shape
    num_ctas = -(-num_warps // warps_per_cta)
    instructions, program, trailing = _program(
        stores, loads_in_flight, compute_per_load, bytes_per_lane
    )
    if len(instructions) > MAX_INSTRUCTIONS:
        raise InputError(
            f"{name}: stores, loads_in_flight: {len(instructions)} different instructions: "
            f"allowed are up to {MAX_INSTRUCTIONS}"
        )
    index = program.astype(np.uint16)
    launch = Launch(
        0,
        PASS_NAME,
        num_ctas,
        warps_per_cta,
        registers_per_thread=REGISTERS_PER_THREAD,
        trailing_arithmetic=trailing,
    )
    ctas_per_chunk = max(1, _ROWS_PER_CHUNK // max(1, warps_per_cta * num_loads))

    def chunks() -> Iterator[Chunk]:
        for first in range(0, num_ctas, ctas_per_chunk):
            last = min(first + ctas_per_chunk, num_ctas)
            part = addresses[first * warps_per_cta : last * warps_per_cta]
            lanes = np.where(part == 0, INACTIVE_ADDRESS, part).reshape(-1, WARP_SIZE)
            warp = np.arange((last - first) * warps_per_cta + 1, dtype=np.int64)
            offsets = np.minimum(warp, len(part)) * num_loads
            yield Chunk(0, first, offsets, np.tile(index, len(part)), lanes)

    manifest = {
        "format": "lane-address",
        "name": name,
        **scalars,
        "padding_warps": num_ctas * warps_per_cta - num_warps,
    }
    return Trace(manifest, (), instructions, [launch], chunks)


def _program(
    stores: npt.NDArray[np.bool_], loads_in_flight: int, compute_per_load: int, bytes_per_lane: int
) -> tuple[list[Instruction], npt.NDArray[np.int64], Arithmetic]:
    """The different instructions, the one of each of the warp's accesses, and the arithmetic after
    the last.
    """
    known: dict[Instruction, int] = {}
    program = np.zeros(len(stores), np.int64)
    arithmetic: Arithmetic = (("int", 1),)
    # The load that last took the register of each place among a group's loads, and how many loads
    # are known to be back.
    owner: dict[int, int] = {}
    num_loads = num_done = 0
    for begin in range(0, len(stores), loads_in_flight):
        group = stores[begin : begin + loads_in_flight]
        place = 0
        for slot, store in enumerate(group, begin):
            num_outstanding = -1
            if not store:
                if not compute_per_load and owner.get(place, -1) >= num_done:
                    num_done = owner[place] + 1
                    num_outstanding = num_loads - num_done
                owner[place] = num_loads
                num_loads, place = num_loads + 1, place + 1
            instruction = Instruction(
                PASS_NAME,
                -1,
                "store" if store else "load",
                access_bytes=bytes_per_lane,
                arithmetic=arithmetic,
                num_outstanding=num_outstanding,
            )
            program[slot] = known.setdefault(instruction, len(known))
            arithmetic = ()
        arithmetic = _uses(place, compute_per_load)
    return list(known), program, arithmetic


def _uses(num_loads: int, compute_per_load: int) -> Arithmetic:
    """What follows a group of accesses: per load of it, in order, the FMAs that need it."""
    if not compute_per_load:
        return ()
    runs = (((WAIT, num_loads - 1 - k), ("fp32", compute_per_load)) for k in range(num_loads))
    return tuple(item for run in runs for item in run)


def _check(
    addresses: Any, scalars: dict[str, int], stores: Any, name: str
) -> npt.NDArray[np.bool_]:
    """Check the fields of a lane-address trace. Returns `stores`, all false if there is none.
    Raises: InputError.
    """
    if not isinstance(addresses, np.ndarray) or addresses.dtype != np.uint64:
        raise InputError(f"{name}: addresses: {_type(addresses)}: need uint64")
    if addresses.ndim != 3 or addresses.shape[2] != WARP_SIZE or not len(addresses):
        raise InputError(
            f"{name}: addresses: shape {addresses.shape}: "
            f"need (warps, loads, {WARP_SIZE}), at least one warp"
        )
    for field, least, most in (
        ("warps_per_cta", 1, MAX_WARPS_PER_CTA),
        ("loads_in_flight", 1, _MAX_COUNT),
        ("compute_per_load", 0, _MAX_COUNT),
    ):
        if not least <= scalars[field] <= most:
            raise InputError(f"{name}: {field} {scalars[field]}: allowed are {least} to {most}")
    size = scalars["bytes_per_lane"]
    if size not in ACCESS_BYTES:
        raise InputError(f"{name}: bytes_per_lane {size}: allowed are {ACCESS_BYTES}")
    # As in hardware, which faults on anything else; this also keeps the mark of inactive lanes out
    # of the addresses.
    bad = (addresses & np.uint64(size - 1)) != 0
    bad |= addresses == INACTIVE_ADDRESS
    if bad.any():
        warp, load, lane = (int(i) for i in np.unravel_index(int(bad.argmax()), bad.shape))
        raise InputError(
            f"{name}: addresses: {int(addresses[warp, load, lane]):#x} at warp {warp}, "
            f"load {load}, lane {lane}: need multiples of bytes_per_lane {size}, up to 2^64 - 2"
        )
    num_loads = addresses.shape[1]
    if stores is None:
        return np.zeros(num_loads, np.bool_)
    if (
        not isinstance(stores, np.ndarray)
        or stores.dtype != np.bool_
        or stores.shape != (num_loads,)
    ):
        shape = getattr(stores, "shape", ())
        raise InputError(
            f"{name}: stores: {_type(stores)} of shape {shape}: need bool of shape ({num_loads},)"
        )
    return stores


def _type(value: Any) -> str:
    return str(value.dtype) if isinstance(value, np.ndarray) else type(value).__name__


def _load(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays of an `.npz` that we know. Raises: InputError."""
    try:
        # np.load leaves a file of its own open when it fails.
        with path.open("rb") as raw:
            file = np.load(raw, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise InputError(f"{path}: is not an .npz archive")
            with file:
                known = {*_SCALARS, "addresses", "stores"} & set(file.files)
                return {field: file[field] for field in sorted(known)}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except InputError:
        raise
    except ValueError as error:
        if "pickle" in str(error).lower():
            raise InputError(
                f"{path}: holds pickled Python objects, which are not read; need plain arrays"
            ) from None
        raise InputError(f"{path}: corrupt: {str(error).splitlines()[0]}") from None
    except (
        OSError,
        EOFError,
        KeyError,
        SyntaxError,
        NotImplementedError,
        zipfile.BadZipFile,
        zlib.error,
        RuntimeError,
    ) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: not a readable .npz file: {reason}") from None
