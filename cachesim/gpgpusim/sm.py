"""The table `sm_timing` of a preset: schedulers, execution units and the way to the L1."""

from __future__ import annotations

from cachesim.gpgpusim.options import MAX_SPECIAL_UNITS, Options, label
from cachesim.presets.files import Sourced

Fields = dict[str, Sourced]

_SCHEDULERS = {"gto": "gto", "lrr": "lrr"}
_INT_UNITS, _SP_UNITS = "-gpgpu_num_int_units", "-gpgpu_num_sp_units"
#: Places in -gpgpu_pipeline_widths of the stages before and after the operand collectors.
_ID_OC_MEM, _OC_EX_MEM = 4, 9
#: ADD, MAX, MUL, MAD, DIV: what stands for a unit in the execution-driven mode's lists.
_PTX_PLACES = {"int": 0, "sp": 3, "sfu": 0}


def sm_timing(options: Options) -> Fields:
    """The fields of `sm_timing`.

    Raises:
        InputError: an option's value is wrong, or no preset can express it.
    """
    num_schedulers = options.number("-gpgpu_num_sched_per_core", 1, 8)
    issue, dual = "-gpgpu_max_insn_issue_per_warp", "-gpgpu_dual_issue_diff_exec_units"
    launch, cta_launch = "-gpgpu_kernel_launch_latency", "-gpgpu_TB_launch_latency"
    collector_units, memory_queue = _collectors(options, num_schedulers)
    fields = {
        "num_schedulers": options.sourced(num_schedulers, "-gpgpu_num_sched_per_core"),
        "scheduler": options.sourced(
            options.choice("-gpgpu_scheduler", _SCHEDULERS), "-gpgpu_scheduler"
        ),
        "issue_per_warp": options.sourced(options.number(issue, 1, 2), issue),
        "dual_issue_different_units": options.sourced(options.flag(dual), dual),
        **_unit(options, "int", "int", _integer_units(options)),
        **_unit(options, "fp32", "sp", _SP_UNITS),
        **_unit(options, "sfu", "sfu", "-gpgpu_num_sfu_units"),
        **_control_unit(options),
        "int_on_fp32": options.sourced(_integer_units(options) == _SP_UNITS, _INT_UNITS),
        "result_cycles": Sourced(5, "counted over the stages of GPGPU-Sim's pipeline", "D"),
        "memory_cycles": Sourced(4, "counted over the stages of GPGPU-Sim's pipeline", "D"),
        "memory_queue": memory_queue,
        "collector_units": collector_units,
        "register_banks": _register_banks(options, num_schedulers),
        "texture_quads_per_cycle": Sourced(0, "GPGPU-Sim has no limit of filtering", "S"),
        "launch_cycles": options.sourced(options.number(launch), launch),
        "cta_launch_cycles": options.sourced(options.number(cta_launch), cta_launch),
    }
    return {f"sm_timing.{field}": entry for field, entry in fields.items()}


def _integer_units(options: Options) -> str:
    """The option that counts the units of integer instructions: SP units where there are none."""
    return _INT_UNITS if options.number(_INT_UNITS) else _SP_UNITS


def _unit(options: Options, unit: str, kind: str, count: str) -> Fields:
    """Latency and initiation of a unit.

    kind: its name in the options of the trace-driven mode. count: the option with the number of
        units; where schedulers share one, each gets it in its turn.
    """
    option = f"-trace_opcode_latency_initiation_{kind}"
    if not options.given(option) and options.given(_ptx("latency", kind)):
        latency, initiation = _ptx_number(options, "latency", kind), 1
        source = f"{options.source(_ptx('latency', kind))}, no trace.config given"
        if options.given(_ptx("initiation", kind)):
            initiation = _ptx_number(options, "initiation", kind)
    else:
        latency, initiation = options.numbers(option, ",", 2, 2)
        source = f"{options.source(option)} {latency},{initiation}"
    sharers = -(-options.number("-gpgpu_num_sched_per_core", 1) // options.number(count, 1))
    slower = f", {sharers} schedulers to a unit of {count}" if sharers > 1 else ""
    return {
        f"{unit}_latency_cycles": Sourced(latency, source, "S"),
        f"{unit}_initiation_cycles": Sourced(
            initiation * sharers, source + slower, "D" if slower else "S"
        ),
    }


def _ptx(what: str, kind: str) -> str:
    return f"-ptx_opcode_{what}_{'fp' if kind == 'sp' else kind}"


def _ptx_number(options: Options, what: str, kind: str) -> int:
    place = _PTX_PLACES[kind]
    return options.numbers(_ptx(what, kind), ",", place + 1)[place]


def _control_unit(options: Options) -> Fields:
    """Branches have a special unit on some chips; elsewhere they take the integer unit."""
    for number in range(1, MAX_SPECIAL_UNITS + 1):
        unit = f"-specialized_unit_{number}"
        if not options.given(unit):
            continue
        words = [word.strip() for word in options.settings[unit].text.split(",")]
        if words[0] == "1" and words[-1] == "BRA":
            options.setting(unit)
            option = f"-trace_opcode_latency_initiation_spec_op_{number}"
            latency, initiation = options.numbers(option, ",", 2, 2)
            source = f"{options.source(option)} {latency},{initiation}: {unit} is BRA"
            return {
                "control_latency_cycles": Sourced(latency, source, "S"),
                "control_initiation_cycles": Sourced(initiation, source, "S"),
            }
    fields = _unit(options, "control", "int", _integer_units(options))
    return {
        field: Sourced(entry.value, f"{entry.source}: branches take the integer unit", "D")
        for field, entry in fields.items()
    }


def _register_banks(options: Options, num_schedulers: int) -> Sourced:
    """Register banks of one scheduler: all of them where the sub-core model is off."""
    option = "-gpgpu_num_reg_banks"
    banks = options.number(option, 1, 64)
    return Sourced(
        min(8, max(1, banks // num_schedulers)),
        f"{options.source(option)} {banks} over {num_schedulers} schedulers",
        "D",
    )


def _collectors(options: Options, num_schedulers: int) -> tuple[Sourced, Sourced]:
    """Operand collectors of one scheduler that memory and arithmetic share, and the memory
    instructions that may stand between decode and the load/store unit, in collectors or not.
    """
    separate = "-gpgpu_enable_specialized_operand_collector"
    if options.flag(separate):
        units = "-gpgpu_operand_collector_num_units_mem"
        of_scheduler = max(1, options.number(units, 1, 512) // num_schedulers)
        shared = Sourced(0, f"{options.source(separate)}: memory has collectors of its own", "D")
    else:
        units = "-gpgpu_operand_collector_num_units_gen"
        of_scheduler = max(1, options.number(units, 1, 512) // num_schedulers)
        source = f"{options.source(units)} {options.number(units)} over {num_schedulers} schedulers"
        shared = Sourced(of_scheduler, source, "D")
    widths = options.numbers("-gpgpu_pipeline_widths", ",", 11)
    before, after = (max(1, widths[place] // num_schedulers) for place in (_ID_OC_MEM, _OC_EX_MEM))
    name = label(options.setting("-gpgpu_pipeline_widths"))
    queued = Sourced(
        min(64, before + of_scheduler + after),
        f"{name} -gpgpu_pipeline_widths: ID_OC {before} + {units} {of_scheduler} + OC_EX {after} "
        "of each scheduler",
        "D",
    )
    return shared, queued
