"""What the timing model needs of a machine besides the counting model's geometry: latencies in core
cycles, widths, queues. Each class is one table of a preset, beside the level's own.

The mechanisms are those of facts sheet sections 3.3 to 3.5; a value of 0 lifts a limit where the
field says so.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from cachesim.units import parse_size

MAX_CYCLES = 1 << 20
MAX_ENTRIES = 1 << 16


def _whole(value: object) -> object:
    if isinstance(value, bool):
        raise ValueError(f"{value!r} is not a whole number")
    return value


Cycles = Annotated[int, BeforeValidator(_whole), Field(ge=0, le=MAX_CYCLES)]
#: Latency of an execution unit: the wheel that wakes warps has this many slots.
UnitCycles = Annotated[int, BeforeValidator(_whole), Field(gt=0, le=384)]
Entries = Annotated[int, BeforeValidator(_whole), Field(gt=0, le=MAX_ENTRIES)]
#: 0 lifts the limit.
Limit = Annotated[int, BeforeValidator(_whole), Field(ge=0, le=MAX_ENTRIES)]
Hertz = Annotated[int, BeforeValidator(_whole), Field(gt=0, le=1 << 40)]
PortBytes = Annotated[int, BeforeValidator(parse_size), Field(gt=0, le=1 << 20)]
#: 0 lifts the limit.
PortLimit = Annotated[int, BeforeValidator(_whole), Field(ge=0, le=1 << 20)]

Scheduler = Literal["gto", "lrr"]
Allocation = Literal["on-miss", "on-fill", "streaming"]
Queueing = Literal["input-fifo", "output-queued"]
DramScheduler = Literal["fr-fcfs", "fifo"]
CommandBus = Literal["single", "dual", "bank-order"]


class _Timing(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SmTiming(_Timing):
    """How an SM issues and executes.

    num_schedulers: warp slots are dealt to them in turn. scheduler: greedy-then-oldest or loose
        round robin. issue_per_warp: instructions a scheduler may issue of its chosen warp in a
        cycle. dual_issue_different_units: whether those must go to different units.
    *_latency_cycles, *_initiation_cycles: of the execution units, per scheduler. A "control"
        instruction is a branch, barrier or move to or from a special register.
    int_on_fp32: integer instructions share the fp32 unit.
    result_cycles: from issue to the first cycle in which a dependent instruction may issue, over
        the unit's latency (operand collection, dispatch, write-back).
    memory_cycles: from issue of a memory instruction to the cycle in which its first access leaves
        the load/store unit.
    memory_queue: memory instructions of one scheduler that may wait for the load/store unit.
    collector_units: operand collectors of a scheduler; waiting memory instructions hold them, and
        arithmetic stops when all are held. 0 = they are not modelled.
    register_banks: of a scheduler's registers. A bank gives its collectors one operand a step, two
        steps a cycle; 0 = operands never clash.
    texture_quads_per_cycle: bilinear quads of up to 64-bit texels that the SM's texture units
        filter in a cycle; 128-bit texels take four times as long. 0 = no limit.
    launch_cycles: added before each kernel. cta_launch_cycles: before each CTA.
    """

    num_schedulers: Annotated[int, BeforeValidator(_whole), Field(gt=0, le=8)]
    scheduler: Scheduler
    issue_per_warp: Annotated[int, BeforeValidator(_whole), Field(gt=0, le=2)]
    dual_issue_different_units: bool
    int_latency_cycles: UnitCycles
    int_initiation_cycles: UnitCycles
    fp32_latency_cycles: UnitCycles
    fp32_initiation_cycles: UnitCycles
    sfu_latency_cycles: UnitCycles
    sfu_initiation_cycles: UnitCycles
    control_latency_cycles: UnitCycles
    control_initiation_cycles: UnitCycles
    int_on_fp32: bool
    result_cycles: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=64)]
    memory_cycles: Annotated[int, BeforeValidator(_whole), Field(gt=0, le=64)]
    memory_queue: Annotated[int, BeforeValidator(_whole), Field(gt=0, le=64)]
    collector_units: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=8)]
    register_banks: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=8)]
    texture_quads_per_cycle: Limit
    launch_cycles: Cycles
    cta_launch_cycles: Cycles


class L1Timing(_Timing):
    """One L1 unit (RDNA: the L0).

    latency_cycles: from entering the L1 to its tag look-up; a hit's data is there then, and a miss
        pays it too. texture_latency_cycles: the same for fetch path "texture".
    num_banks: accesses that may enter in a cycle, one per bank; bank_bytes: their interleaving.
    lines_per_cycle: tags that one instruction may look up in a cycle; then num_banks accesses of
        these lines may enter, and none clash. 0 = the banks alone limit.
    bytes_per_cycle: data returned to the SM in a cycle; 0 = no limit.
    num_mshrs, mshr_merge: misses in flight, and requests per miss, the first included.
    miss_queue: entries. allocation: when a line is taken.
    fill_bytes_per_cycle: of the port by which replies enter; with output-queued interconnects as
        many misses leave in a cycle, and bytes_per_cycle of data return to the registers. With
        others it is one sector each.
    dirty_limit_percent: dirty lines are spared from eviction below this share of dirty lines.
    """

    latency_cycles: Annotated[int, BeforeValidator(_whole), Field(gt=0, le=4096)]
    texture_latency_cycles: Annotated[int, BeforeValidator(_whole), Field(gt=0, le=4096)]
    num_banks: Annotated[int, BeforeValidator(_whole), Field(gt=0, le=64)]
    bank_bytes: PortBytes
    lines_per_cycle: Limit
    bytes_per_cycle: PortLimit
    num_mshrs: Entries
    mshr_merge: Entries
    miss_queue: Entries
    allocation: Allocation
    fill_bytes_per_cycle: PortBytes
    dirty_limit_percent: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=100)]


class L1TextureTiming(_Timing):
    """GPGPU-Sim's texture L1: tags at once, data in order through FIFOs (facts sheet 3.5, 9).

    fragment_fifo, request_fifo, reorder_buffer, result_fifo: entries.
    """

    fragment_fifo: Entries
    request_fifo: Entries
    reorder_buffer: Entries
    result_fifo: Entries


class CacheTiming(_Timing):
    """A cache below the L1: GL1, L2 slice or LLC slice.

    clock_hz: of this level's ports. latency_cycles: core cycles between arrival and tag look-up.
    port_bytes: data a slice moves in one of its cycles.
    num_mshrs, mshr_merge, miss_queue, allocation, dirty_limit_percent: as in `L1Timing`.
    queue_in, queue_down, queue_fill, queue_out: entries of the queues from the SMs, to memory, from
        memory and to the SMs.
    """

    clock_hz: Hertz
    latency_cycles: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=4096)]
    port_bytes: PortBytes
    num_mshrs: Entries
    mshr_merge: Entries
    miss_queue: Entries
    allocation: Allocation
    queue_in: Entries
    queue_down: Entries
    queue_fill: Entries
    queue_out: Entries
    dirty_limit_percent: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=100)] = 0


class L2Timing(CacheTiming):
    """The L2. texture_latency_cycles: as `latency_cycles`, for requests of a separate texture L1,
    which GPGPU-Sim lets pass the delay.
    """

    texture_latency_cycles: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=4096)]


class Icnt(_Timing):
    """The interconnect between the SMs (RDNA: the GL1s) and the L2 slices: a request and a reply
    network.

    queueing: "input-fifo" is a crossbar whose inputs are FIFOs, so that a blocked head blocks what
        is behind it; "output-queued" has no such blocking.
    router_steps: at "input-fifo", steps a cycle of a router that first gives an output to one of
        the inputs that ask for it and moves that one's packet in a later step (BookSim, with its
        internal speed-up). 0 = a packet moves in one step, and its input may then send the next
        one to a later output in the same cycle (GPGPU-Sim's built-in crossbar).
    request_latency_cycles, reply_latency_cycles: on top of one cycle's transfer.
    flit_bytes: an output moves so many in a cycle; at "input-fifo" a packet holds it for whole
        cycles. header_bytes: of each packet.
    input_packets, output_packets: room of each port's buffer.
    ejection_packets: room for replies at each SM. response_packets: of the load/store unit's FIFO.
    """

    queueing: Queueing
    router_steps: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=8)]
    request_latency_cycles: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=4096)]
    reply_latency_cycles: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=4096)]
    flit_bytes: PortBytes
    header_bytes: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=1024)]
    input_packets: Entries
    output_packets: Entries
    ejection_packets: Entries
    response_packets: Entries


class DramTiming(_Timing):
    """One memory channel per channel of the last cache, and its devices.

    clock_hz: command clock. bus_bytes x burst_length = the atom; data_rate: beats per command
        cycle. CCD ... RTPL: command cycles, under their names in the device's data sheet.
    fixed_latency_cycles: core cycles before a request reaches the controller.
    queue: requests that the scheduler sees. return_queue: entries.
    command_bus: "single": one row or column command a cycle; "dual": one of each; "bank-order":
        GPGPU-Sim's single bus, which tries the banks in turn, so that a bank's row command does not
        keep a later bank from its column command.
    row_bytes: of one bank. num_bank_groups: consecutive banks lie in different groups.
    address_map: GPGPU-Sim's 64-character map of address bits (facts sheet 3.4).
    """

    clock_hz: Hertz
    bus_bytes: Entries
    burst_length: Entries
    data_rate: Entries
    num_banks: Annotated[int, BeforeValidator(_whole), Field(gt=0, le=64)]
    num_bank_groups: Annotated[int, BeforeValidator(_whole), Field(gt=0, le=64)]
    ccd: Cycles
    rrd: Cycles
    rcd: Cycles
    ras: Cycles
    rp: Cycles
    rc: Cycles
    cl: Cycles
    wl: Cycles
    cdlr: Cycles
    wr: Cycles
    ccdl: Cycles
    rtpl: Cycles
    fixed_latency_cycles: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=4096)]
    scheduler: DramScheduler
    queue: Entries
    return_queue: Entries
    command_bus: CommandBus
    address_map: str

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.num_banks % self.num_bank_groups:
            raise ValueError(
                f"num_bank_groups = {self.num_bank_groups} does not divide "
                f"num_banks = {self.num_banks}"
            )
        if (self.burst_length % self.data_rate) and self.burst_length > self.data_rate:
            raise ValueError(
                f"data_rate = {self.data_rate} does not divide burst_length = {self.burst_length}"
            )
        letters = [c for c in self.address_map.partition(";")[2] if c not in ".| "]
        if (
            not self.address_map.startswith("dramid@")
            or len(letters) != 64
            or set(letters) - set("BRCS0")
        ):
            raise ValueError(
                f"address_map = {self.address_map!r}: allowed is 'dramid@<bit>;' and 64 letters of "
                "B, R, C, S, 0"
            )
        banks = 1 << letters.count("B")
        if banks != self.num_banks:
            raise ValueError(f"address_map names {banks} banks, num_banks = {self.num_banks}")
        return self

    @property
    def atom_bytes(self) -> int:
        """Bytes of one burst."""
        return self.bus_bytes * self.burst_length

    @property
    def burst_cycles(self) -> int:
        """Command cycles that one burst holds the data bus."""
        return max(1, self.burst_length // self.data_rate)
