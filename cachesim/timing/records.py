"""The machine's state as flat arrays of records: what the compiled loops read and write.

Records keep what one step touches together, and a loop needs one pointer per table. Fixed sizes in
them bound the machine: `check_bounds` in `cachesim.timing.machine` refuses a larger one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

MAX_WARPS = 64
MAX_SCHEDULERS = 8
MAX_BANKS = 64
MAX_LOADS = 64
MAX_DRAM_BANKS = 64
MAX_MEMORY_QUEUE = 64
MAX_COLLECTORS = 8
MAX_REGISTER_BANKS = 8
MAX_SUBSLICES = 8
MAX_WAYS = (1 << 15) - 1
MAX_SMS = (1 << 15) // MAX_WARPS - 1
#: Slots of the wheel that wakes warps: a power of two above every unit's latency.
WHEEL = 512

NEVER = 1 << 62

# What an instruction needs: the index of a ready mask. `MEMORY` is any access, WAIT issues nothing.
INT, FP32, SFU, CONTROL, MEMORY, WAIT = range(6)
KINDS = ("int", "fp32", "sfu", "control", "memory", "wait")

# Fetch paths of a request.
PATH_L1, PATH_BYPASS, PATH_FIFO = range(3)

# What a request is: asked by a warp, a write-back, a fetch for a store.
DEMANDED, WRITEBACK, WRITE_FILL = range(3)

# Levels: the index of a request's links, and of the tables of levels.
L1, GL1, L2, LLC = range(4)

# Outcomes of an access, GPGPU-Sim's (facts sheet 4), and the extra count MSHR_HIT.
HIT, HIT_RESERVED, MISS, SECTOR_MISS, FAIL, MSHR_HIT = range(6)
OUTCOMES = ("HIT", "HIT_RESERVED", "MISS", "SECTOR_MISS", "RESERVATION_FAIL", "MSHR_HIT")

# Why a look-up fails: no place in the miss queue, no MSHR, anything else.
NO_QUEUE, NO_MSHR, NO_OTHER = range(3)

# Reasons for an issue slot (a scheduler's cycle), in the order of `results.REASONS`; MEMORY_WAIT is
# shared out over interconnect, l2, dram and latency at the end.
R_ISSUE, R_ARITHMETIC, R_L1_BANDWIDTH, R_L1_RESERVATION, R_INTERCONNECT, R_IDLE, R_MEMORY = range(7)
NUM_REASONS = 7

# Stages between an L1 and its reply, whose times are summed.
S_REQUEST, S_L2, S_BELOW, S_REPLY = range(4)

#: Bytes of a line of the host's own cache: what is used together should share one.
_HOST_LINE = 64


def _in_lines(*fields: Any) -> np.dtype[np.void]:
    """A record of whole host lines, its fields packed in order."""
    packed = np.dtype(list(fields))
    offsets = [packed.fields[name][1] for name, *_ in fields]  # type: ignore[index]
    size = -(-packed.itemsize // _HOST_LINE) * _HOST_LINE
    return np.dtype(
        {
            "names": [name for name, *_ in fields],
            "formats": [packed[name] for name, *_ in fields],
            "offsets": offsets,
            "itemsize": size,
        }
    )


def zeros(count: int, dtype: np.dtype[np.void]) -> npt.NDArray[np.void]:
    """(count,) records from the start of a host line."""
    raw = np.zeros(count * dtype.itemsize + _HOST_LINE, np.uint8)
    start = -raw.ctypes.data % _HOST_LINE
    return raw[start : start + count * dtype.itemsize].view(dtype)


REQUEST = _in_lines(
    # One line: what every stage touches.
    ("address", "i8"),  # of its sector
    ("number", "i8"),  # line number inside its L2 slice
    ("born", "u4"),  # when it entered the load/store unit's hands, modulo 2^32
    ("mark", "u4"),  # when it entered the present stage, if the stage does not keep that itself
    ("next", "i4", (5,)),  # links of MSHR lists, one per level, and of DRAM's bank lists
    ("group", "i4"),  # of counters
    ("load", "i4"),  # which of the warp's loads
    ("warp", "i2"),  # sm * MAX_WARPS + slot, or -1
    ("unit", "i2"),  # L1 unit
    ("slice", "i2"),  # of the L2; -1 until it goes there
    ("operation", "u1"),  # `stream.LOAD` ...
    ("path", "u1"),
    ("kind", "u1"),
    ("source", "u1"),  # the level its data came from: 0 L1, 1 GL1, 2 L2, 3 LLC, 4 DRAM
    ("write", "u1"),
    ("is_part", "u1"),  # whether it has a parent
    # The other line: what few touch.
    ("parent", "i4"),  # the request it is a part of
    ("pending", "i4"),  # parts that have not returned, where it has parts
    ("lower", "i4"),  # slice of the LLC, or memory channel
    ("row", "i4"),
    ("bytes", "u4"),  # granules a store covers
    ("bank", "i2"),
    ("sectors", "u1"),  # L2 sectors that a texture line waits for
)

LINE = np.dtype(
    [
        ("key", "i8"),  # address >> line shift, -NEVER = never used
        ("chain", "i4"),  # next line of its hash bucket
        ("set", "i4"),
        ("newer", "i2"),  # ways of its neighbours in its set's order of use, or -1
        ("older", "i2"),
        ("valid", "u1"),  # sectors that can be read
        ("partial", "u1"),  # sectors some bytes of which were written
        ("modified", "u1"),
        ("reserved", "u1"),  # sectors on their way
    ],
    align=True,
)

SET = np.dtype([("newest", "i4"), ("oldest", "i4"), ("reserved_lines", "i4")], align=True)

MSHR = np.dtype(
    [
        ("key", "i8"),  # sector number
        ("chain", "i4"),
        ("first", "i4"),  # requests, oldest first
        ("last", "i4"),
        ("count", "i4"),
        ("ready_next", "i4"),  # next entry whose data is there; also the list of free ones
    ],
    align=True,
)

#: One instance of a level: an L1 unit, a GL1, a slice.
NODE = _in_lines(
    # One line: what every step looks at.
    ("wake", "i8"),
    ("port_time", "i8"),  # in 1/256 core cycles: when the data port is free
    ("fill_time", "i8"),
    ("delay_ready", "i8"),  # of the oldest request in the delay
    ("ready_first", "i4"),
    ("fill_count", "i4"),
    ("miss_count", "i4"),
    ("in_count", "i4"),
    ("out_count", "i4"),
    ("down_count", "i4"),
    ("delay_count", "i4"),
    ("is_stalled", "i4"),  # whether the last step's look-up failed: so does each until the next
    # The other: what a step that moves something needs.
    ("version", "i4"),  # counts what may turn a reservation fail into success
    ("failed", "i4"),  # version at which the head of the queue failed, or -1
    ("last_step", "i8"),
    ("num_filled", "i4"),  # counts what may turn a miss into a hit
    ("num_taken", "i4"),  # MSHRs taken so far
    ("dirty_lines", "i4"),
    ("mshr_free", "i4"),
    ("mshr_used", "i4"),
    ("ready_last", "i4"),
    ("in_head", "i4"),
    ("delay_head", "i4"),
    ("miss_head", "i4"),
    ("down_head", "i4"),
    ("fill_head", "i2"),
    ("out_head", "i2"),
    ("failed_write", "i2"),  # whether what failed is a store
    ("fail_reason", "i2"),  # of the last look-up that failed
    ("filled_sector", "i8"),  # numbers of the sectors filled and taken last
    ("taken_sector", "i8"),
)

#: The rules and sizes of one level.
LEVEL = np.dtype(
    [
        (name, "i8")
        for name in (
            "line_shift", "sector_shift", "sector_mask", "num_sets", "ways", "touch_on_hit",
            "on_miss_allocation", "on_hit", "on_store_miss", "all_bytes", "num_mshrs", "merge",
            "miss_queue", "bucket_mask", "mshr_mask", "port_cost", "fill_cost", "width",
            "latency", "texture_latency", "queue_in", "queue_down", "queue_fill", "queue_out",
            "reserve_in", "dirty_limit", "sectors_per_line", "is_read_only", "delay_capacity",
            "index", "set_kind", "num_instances",
        )
    ]
)  # fmt: skip

#: An instruction on its way to its unit.
ISSUED = np.dtype(
    [
        ("order", "i8"),  # of issue
        ("row", "i8"),  # of an access
        ("load", "i4"),
        ("since", "i4"),  # order of entry into the collector
        ("slot", "i1"),
        ("kind", "i1"),
        ("chain", "i1"),  # -1: an exit
        # Register banks to read, and those of them that are read twice.
        ("banks", "u1"),
        ("again", "u1"),
    ],
    align=True,
)

#: What LDST and issue logic of one SM need.
SM = _in_lines(
    # Two lines: what every step looks at.
    ("wake", "i8"),
    ("last_step", "i8"),
    # Until then, and until something new comes or room is made, stepping the collectors changes
    # nothing.
    ("collect_from", "i8"),
    ("eject_head", "i4"),
    ("eject_count", "i4"),
    ("waits_for_room", "i4"),  # whether it sleeps until its port has room
    ("num_timed", "i4"),
    ("num_resident", "i4"),
    ("is_stuck", "i4"),  # whether nothing can issue until something changes
    ("num_collecting", "i4"),
    ("free_places", "i4"),
    ("ready", "u8", (5,)),
    ("resident", "u8"),  # slots with a warp, and of those the ones that wait for loads or stores
    ("blocked", "u8"),
    ("stall", "i1", (MAX_SCHEDULERS,)),  # why each scheduler that did not issue did not
    ("queue_count", "i1", (MAX_SCHEDULERS,)),
    ("queue_head", "i1", (MAX_SCHEDULERS,)),
    # GPGPU-Sim's operand collectors, MAX_COLLECTORS places for each scheduler. Masks of places:
    # those in use, and of them those that wait for operands.
    ("collecting", "u8"),
    ("reading", "u8"),
    ("order", "i8"),  # of issue, and of entry into a collector
    ("resident_since", "i8"),
    # By unit: the schedulers whose issued instruction waits for a collector, as a mask and in
    # order, four bits each, the oldest lowest.
    ("waiting", "u1", (8,)),
    ("turn", "u4", (5,)),
    # An issued instruction of each unit and scheduler, then one in each collector.
    ("issued", ISSUED, (5, MAX_SCHEDULERS)),
    ("collector", ISSUED, (MAX_SCHEDULERS * MAX_COLLECTORS,)),
    # Register banks written last, MAX_REGISTER_BANKS bits for each scheduler, and when.
    ("written", "u8"),
    ("written_at", "i8"),
    ("unit_free", "i8", (4, MAX_SCHEDULERS)),
    ("last_issued", "i4", (MAX_SCHEDULERS,)),
    # Queues of the load/store unit, place by place: most hold one.
    ("queue_warp", "i4", (MAX_MEMORY_QUEUE, MAX_SCHEDULERS)),
    ("queue_time", "i8", (MAX_MEMORY_QUEUE, MAX_SCHEDULERS)),
    ("queue_row", "i8", (MAX_MEMORY_QUEUE, MAX_SCHEDULERS)),
    ("queue_load", "i4", (MAX_MEMORY_QUEUE, MAX_SCHEDULERS)),
    ("age", "i8", (MAX_WARPS,)),  # of the warp in each slot, the oldest least
    ("wheel", "u8", (WHEEL,)),
)

#: The load/store and texture pipe in front of one L1 unit.
PIPE = _in_lines(
    ("warp", "i4"),  # whose instruction it works on, or -1
    ("next_writeback", "i4"),
    ("next_global", "i4"),
    ("client", "i4"),
    ("response_head", "i4"),
    ("response_count", "i4"),
    ("in_banks", "i4"),
    ("blocked", "i4"),  # 0, or why nothing left the pipe this cycle
    # Of the last step; if it changed nothing, each cycle until the next has the same fails.
    ("has_moved", "i4"),
    ("read_fails", "i4"),
    ("write_fails", "i4"),
    ("clashes", "i4"),
    ("until", "i8"),  # when it may move without news from outside
    ("free_at", "i8"),  # when the tag, data and filter laws allow the next instruction
    # The instruction at hand.
    ("at", "i8"),  # request it works on, downwards
    ("first", "i8"),
    ("mask", "i4"),  # sectors of that request still to do
    ("left", "i4"),  # sectors of the instruction still to do
    ("load", "i4"),
    ("code", "i4"),  # instruction
    ("number", "i8"),  # line number of the sector at hand in its L2 slice
    ("slice", "i4"),  # that slice, or -1: not known yet
    ("path", "i2"),
    ("is_located", "i2"),  # whether the sector at hand has been located
    # The texture FIFOs.
    ("rob_count", "i4"),
    ("fragment_count", "i4"),
    ("request_head", "i4"),
    ("request_count", "i4"),
    ("result_count", "i4"),
    ("result_head", "i4"),
    ("fragment_head", "i4"),
)

#: A bank of an L1 unit: the accesses on their way to the tags.
L1_BANK = _in_lines(
    ("ready", "i8"),  # when the oldest access may be looked up
    ("head", "i4"),
    ("count", "i4"),
    ("entered", "i8"),  # the last cycle in which one entered
    ("failed", "i8"),  # version of the unit's node at which the oldest failed, or -1
    ("filled", "i8"),  # the node's num_filled and num_taken then
    ("taken", "i8"),
    ("write", "i4"),  # whether what failed is a store
    ("reason", "i4"),  # why it failed
    ("sector", "i8"),  # which sector was looked up
)

WARP = _in_lines(
    # One line: what a sector that comes back touches, and what waits for it.
    ("waits_for", "i4"),  # loads up to this sequence number must be back; -1 = not waiting
    ("oldest_load", "i4"),
    ("next_load", "i4"),
    ("stores", "i4"),
    ("operation", "i4"),  # micro-operation
    ("last_operation", "i4"),
    ("left", "i4"),  # of the micro-operation's count
    ("in_trailer", "i2"),
    ("chain", "i2"),
    ("row", "i8"),
    ("int_ready", "i8"),
    ("rows_left", "i8"),
    ("waits_chain", "i4"),  # for the unknown end of this chain, or -1
    ("alive", "i4"),
    ("exit_ready", "i8"),  # when its exit has left the pipeline
    ("chains_ready", "i8", (3,)),
    ("cta", "i4"),  # place
    ("num_issued", "i4"),  # instructions
    ("group", "i4"),  # first load of its present group
    ("pending", "i2", (MAX_LOADS,)),
)

#: A static access instruction, and the micro-operations before it.
INSTRUCTION = np.dtype(
    [
        ("first", "i4"),
        ("last", "i4"),
        ("operation", "i4"),
        ("path", "i4"),
        ("quad_cost", "i4"),  # cycles of one quad in a texture filter, 0 = no filter
        ("access_bytes", "i4"),
        ("num_outstanding", "i4"),
        ("waits", "i4"),  # whether loads are waited for before it: it begins a group
    ],
    align=True,
)
#: load: the place in its group of the load whose data the instructions take, -1 = none.
OPERATION = np.dtype([("kind", "i4"), ("count", "i4"), ("load", "i4")])

#: A row that waits in an SM: an access instruction of one warp.
ROW = np.dtype(
    [("first", "i8"), ("count", "i4"), ("lanes", "i4"), ("code", "i4"), ("sectors", "i4")],
    align=True,
)

#: A request of a row: its line number at the L1, and the sectors it asks for.
ASK = np.dtype([("line", "i8"), ("group", "i4"), ("mask", "u1")], align=True)

PORT = np.dtype([("head", "i4"), ("count", "i4"), ("busy", "i8")], align=True)
#: given: the input that a router has given the output to, or -1.
OUTLET = np.dtype(
    [("busy", "i8"), ("head", "i4"), ("count", "i4"), ("turn", "i4"), ("given", "i4")], align=True
)
#: A packet at an input, and one at an output. time: the cycle from which it may move on.
PACKET = np.dtype(
    [
        ("time", "i8"),
        ("request", "i4"),
        ("entered", "u4"),  # when it entered the network, modulo 2^32
        ("output", "i2"),
        ("flits", "i2"),
    ],
    align=True,
)
#: A request that waits for a time: at a network's output, in a level's delay. So many wait that
#: their records have left the host's cache.
WAITING = np.dtype(
    [
        ("time", "i8"),
        ("request", "i4"),
        ("entered", "u4"),  # when, modulo 2^32; in an L1 bank, where its line's chain begins
    ],
    align=True,
)

CHANNEL = np.dtype(
    [
        ("wake", "i8"),  # tick
        ("ccd", "i8"),
        ("rrd", "i8"),
        ("rtw", "i8"),
        ("wtr", "i8"),
        ("is_writing", "i4"),
        ("priority", "i4"),
        ("pending", "i4"),
        ("num_serving", "i4"),
        # Ticks before which no column or row command can be issued.
        ("column_from", "i8"),
        ("row_from", "i8"),
        ("serving", "u8"),  # mask of banks that have a request
        ("waiting", "u8"),  # mask of banks with requests behind
        ("last_borrower", "i4"),
        ("shared_credit", "i4"),
        ("private_credit", "i4", (MAX_SUBSLICES,)),
        ("latency_head", "i4"),
        ("latency_count", "i4"),
        ("entry_head", "i4"),
        ("entry_count", "i4"),
        ("data_head", "i4"),
        ("data_count", "i4"),
        ("return_head", "i4"),
        ("return_count", "i4"),
    ],
    align=True,
)
BANK = np.dtype(
    [
        ("serving", "i4"),
        ("left", "i4"),  # bursts of `serving`
        ("open_row", "i4"),  # -1 = none
        ("row", "i4"),  # of `serving`
        ("write", "i4"),
        ("first", "i4"),
        ("last", "i4"),
        ("rcd", "i8"),
        ("rcdwr", "i8"),
        ("ras", "i8"),
        ("rp", "i8"),
        ("rc", "i8"),
        ("wtp", "i8"),
        ("rtp", "i8"),
    ],
    align=True,
)
BANK_GROUP = np.dtype([("ccdl", "i8"), ("rtpl", "i8")])

#: Scalars of the whole machine: sizes and rules first, then what changes.
MACHINE = np.dtype(
    [
        (name, "i8")
        for name in (
            # rules
            "num_sms", "units", "num_schedulers", "is_gto", "issue_per_warp", "different_units",
            "int_on_fp32", "result_cycles", "memory_cycles", "memory_queue", "collector_units",
            "register_banks",
            "quads_per_cycle", "lines_per_cycle", "bytes_per_cycle", "num_banks", "bank_shift",
            "l1_latency", "bypass", "has_fifo_l1", "fragment_fifo", "request_fifo", "rob",
            "result_fifo", "launch_cycles", "cta_launch_cycles", "ejection",
            "response", "num_ports", "num_slices", "num_gl1", "num_llc", "num_channels",
            "sms_per_gl1", "subslices", "output_queued", "router_steps", "flit_bytes",
            "header_bytes", "input_packets", "output_packets",
            "l2_sector_shift", "core_hz", "dram_hz", "fixed_latency", "dram_queue",
            "return_queue", "dual_bus", "in_bank_order", "fr_fcfs", "num_dram_banks",
            "group_mask", "bursts",
            "ccd", "rrd", "rcd", "rcdwr", "ras", "rp", "rc", "cl", "wl", "rtw", "wtr", "wtp",
            "rtp", "ccdl", "rtpl", "shared_credits", "llc_sector_shift", "channel_shift",
            "num_pool", "warps_per_cta", "num_places", "sector_shift",
            # state
            "now", "tick", "tick_remainder", "free_top", "queued", "taken", "complete",
            "last_sm", "live_ctas", "age", "row_mask",
            "request_mask", "in_flight", "lacks_room",
            "place_from", "progress", "num_rows",
            "num_lane_fetches", "bank_conflicts", "instruction_threads", "has_gl1", "has_llc",
            "ctas_done", "trailer_first", "trailer_last", "queued_dram",
            "dram_reads", "dram_writes", "row_hits", "activates", "precharges",
            "store_bytes", "line_parts", "sectors_per_cycle", "returns_per_cycle",
            "replies_per_cycle", "first_turn",
        )
    ]
)  # fmt: skip
